"""Contact pairs: refusals at the start, and contactors with rows in P."""

from dataclasses import replace

from mpi4py import MPI

import pytest
from helpers import blocks, clamp, linear

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize(("part", "refused"), [(0.0167, False), (0.15, True)])
def test_default_bound_on_the_initial_penetration(part, refused):
    """An overlap of 1.7 % of the model's size is pressed apart and reported, one of 15 % is refused unless it is meant."""
    # the model's height is 2 - depth, its width 1
    depth = 0.5
    for _ in range(50):
        depth = part * (1.0 + (2.0 - depth) ** 2) ** 0.5
    b = blocks(COMM, "triangle", 2, 4, gap=-depth)
    for bound in (None, 1.0):
        contact = uem.Contact(b.high, b.low, max_penetration=bound)

        def make(contact=contact):
            return uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])

        if refused and bound is None:
            with pytest.raises(uem.PenetrationError, match="inside the target"):
                make()
        else:
            make()
            assert contact.initial_overlap == pytest.approx(depth, rel=1e-9)


def test_contactors_with_rows():
    """Those that touch first have rows alone; once another follows, so have all near the target, on any rank alike."""
    b = blocks(COMM, "quadrilateral", 2, 4, gap=0.01)
    contact = uem.Contact(b.high, b.low, normals="averaged")
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])
    pair, x = problem.pairs[0], problem.pairs[0].points[:, 0]
    for reach, rows in ((-1.0, 0), (0.1, 1), (0.3, 5), (0.6, 5)):
        pair.trial = replace(pair.trial, active=x < reach)
        assert COMM.allreduce(len(pair.equations().contactor)) == rows
        assert (pair.trial.reserved | ~pair.trial.active).all()
