"""Smooth faces in classes: facets that meet at sharp edges are of different ones, on any ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from body_scenes import ball, dimension, skin_of
from helpers import CELLS, box

from uem_dolfinx.geometry.skin import classes_of_facets, facets_by_class

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("shuffle", [None, 3])
def test_opposite_sides_of_a_box(cell, shuffle):
    """They are of one class each, and no two that meet: as many classes as directions, for any number of boxes."""
    g = dimension(cell)
    boxes = [box(cell, [2.0 * k, *[0.0] * (g - 1)], [2.0 * k + 1, *[1.0] * (g - 1)], [2 + k] * g) for k in range(2)]
    _, skin = skin_of(cell, boxes, shuffle=shuffle)
    found, count = classes_of_facets(skin)
    axis = np.abs(skin.middles(skin.config.X[skin.dofs])[1]).argmax(axis=1)
    reported = np.unique(np.concatenate(COMM.allgather(np.column_stack([skin.body, axis, found]))), axis=0)
    assert count == g and len(reported) == 2 * g and all(len(np.unique(reported[reported[:, 0] == b, 2])) == g for b in range(2))


def test_a_round_body_is_one_face():
    """Its facets are of one class, next to those of a box; surfaces are made of classes with any of the given facets."""
    _, skin = skin_of("quadrilateral", [box("quadrilateral", (0, 0), (1, 1), (2, 2)), ball("quadrilateral", (3.0, 0.5), 0.5, 3)])
    found, count = classes_of_facets(skin)
    assert count == 2 and COMM.allreduce(int((found[skin.body == 1] != 0).sum())) == 0
    for which, many in ((skin.body == 1, 1), (skin.body == 0, 2), (skin.body >= 0, 2), (skin.body < 0, 0)):
        surfaces = facets_by_class(skin, found, count, which)
        assert len(surfaces) == many
        assert sum(len(surface.entities) for surface in surfaces) == which.sum()
