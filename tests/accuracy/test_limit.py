"""A bound on the estimated error of load steps."""

from __future__ import annotations

import logging

from mpi4py import MPI

import numpy as np
import pytest
from benchmarks.scenes import clamp
from block_scenes import blocks, linear, modulus
from helpers import refused

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def sheared():
    """A block on another one: a patch while it is pressed, which a shear of its upper end disturbs."""
    b = blocks(COMM, "quadrilateral", 3, 3)
    contact = uem.Contact(b.high, b.low, friction=0.5)
    bcs = [*clamp(b.V, b.bottom, 1), uem.dirichlet(b.V, b.bottom, 0), uem.dirichlet(b.V, b.top, 1, -0.05)]
    bcs.append(uem.dirichlet(b.V, b.top, 0, lambda x, s: 0.2 * max(s - 0.5, 0.0) + 0 * x[0]))
    return uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0), 0.0), b.u, bcs=bcs, contacts=[contact])


@pytest.mark.long
def test_a_warning_where_the_bound_is_exceeded(caplog):
    """Once, in the step that exceeds it, with a place; estimates are those of error_estimate, and steps are the same."""
    limit, problem, alone = uem.ErrorLimit(0.05), sheared(), sheared()
    warned = []
    with caplog.at_level(logging.WARNING, logger="uem_dolfinx"):
        for step in uem.load_steps(problem, 4, estimate=limit):
            assert limit.found[-1] == pytest.approx(uem.error_estimate(problem).relative, rel=1e-12, abs=1e-12)
            warned.append(sum("by the mesh" in record.message for record in caplog.records))
    assert max(limit.found[:2]) < 1e-8 and min(limit.found[2:]) > 0.05
    if COMM.rank == 0:
        assert warned == [0, 0, 1, 1]
    assert [step.factor for step in uem.load_steps(alone, 4)] == [0.25, 0.5, 0.75, 1.0]
    assert np.abs(problem.u.x.array - alone.u.x.array).max(initial=0.0) < 1e-10


def test_what_is_refused():
    refused(uem.InputError, "between 0 and 1", lambda: uem.ErrorLimit(5.0))
    refused(uem.InputTypeError, "ErrorLimit", lambda: uem.load_steps(sheared(), 4, estimate=True))
