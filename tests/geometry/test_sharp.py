"""Sharp edges and corners of surfaces; those of bent boxes are in ``test_skin.py``."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from body_scenes import skin_of
from helpers import box

from uem_dolfinx.geometry.sharp import CORNER, sharp_edges, sharp_nodes

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("slope, convex", [(0.14, True), (0.05, False), (-0.14, False)])
@pytest.mark.parametrize("size", [1e-9, 1.0, 1e3])
def test_a_tip_without_edges(slope, convex, size):
    """The tip of a cone is a corner though none of its facets meet at a sharp edge; that of a funnel is none that is convex."""

    def pose(x):
        y = x.copy()
        y[:, 2] -= slope * np.hypot(*(x[:, :2] - 0.5).T) * (x[:, 2] > 0.99)
        return size * y

    _, skin = skin_of("hexahedron", [box("hexahedron", [0.0] * 3, [1.0] * 3, [4, 4, 1])], pose=pose)
    x = skin.config.X[skin.dofs] / size
    within = (np.abs(x - 0.5)[..., :2] < 0.4).all(axis=2) & (x[..., 2] > 0.5)
    tip = within & (np.hypot(*np.moveaxis(x[..., :2] - 0.5, 2, 0)) < 1e-6)
    found, every = (sharp_nodes(skin, CORNER, convex=one) & within for one in (True, False))
    assert np.array_equal(found, tip & convex)
    assert np.array_equal(every, tip & (abs(slope) > 0.1))
    edges = skin.on_sides(sharp_edges(skin, CORNER).sharp)[skin.dofs]
    assert not (edges & within).any() and COMM.allreduce(int(tip.sum())) == 4
