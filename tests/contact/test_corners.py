"""Corners of faceted targets: which facets are one plane, against facets bent by known angles."""

from mpi4py import MPI

import numpy as np
import pytest
from helpers import blocks, clamp, linear

import uem_dolfinx as uem
from uem_dolfinx.contact.corners import find_corners

COMM = MPI.COMM_WORLD


def corner_of_two_facets(slope):
    """The corner that the two facets of a block's top form, one of them rising at a slope."""
    b = blocks(COMM, "triangle", 2, 2, pose=lambda x: x + np.stack([0 * x[:, 0], slope * np.maximum(x[:, 0] - 0.5, 0.0)], axis=1))
    contact = uem.Contact(b.high, b.low, max_penetration=1.0)
    uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])
    target = contact.pair.target
    numbers = np.concatenate(COMM.allgather(target.first[COMM.rank] + np.arange(len(target.dofs))))
    middles = np.concatenate(COMM.allgather(target.facets.config.X[target.dofs].mean(axis=1)))
    left, right = numbers[np.argsort(middles[:, 0])]
    here = np.zeros(1 if COMM.rank == 0 else 0, np.int64)
    points = np.tile([0.5, 0.1], (len(here), 1))
    return find_corners(COMM, target, points, here, np.tile([left, right], (len(here), 1)))


def on_rank_0(value):
    return COMM.bcast(value[0].item() if COMM.rank == 0 else None)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_facets_in_one_plane(sign):
    """A bend of 3e-10 is rounding of a plane, one of 3e-9 is a bend, concave or convex."""
    flat, bent = corner_of_two_facets(sign * 3e-10), corner_of_two_facets(sign * 3e-9)
    assert on_rank_0(flat.flat) and not on_rank_0(flat.concave)
    assert not on_rank_0(bent.flat) and on_rank_0(bent.concave) == (sign > 0)


@pytest.mark.parametrize("slope", [0.1, 0.7])
def test_a_corner_is_held_along_both_normals(slope):
    """Pulls are the coefficients of the facets' normals in a force; gaps along the axes vanish at the corner."""
    c = corner_of_two_facets(slope)
    a, b = 2.0, 3.0
    force = a * c.normals[:, 0] + b * c.normals[:, 1]
    assert np.allclose(c.pulls(force), [a, b])
    assert np.allclose(c.gaps(c.foot), 0.0)
    assert on_rank_0(c.rising) == pytest.approx(np.sin(np.arctan(slope)), rel=1e-9)
