"""The united system: when gaps count as closed, and what steps a call of ``unite`` takes."""

from mpi4py import MPI

import numpy as np
import pytest
from helpers import blocks, linear, run

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def equilibrium(norm, scale, rounding):
    """What the Newton loop takes for one."""
    return norm <= max(1e-6 * scale, rounding)


@pytest.mark.parametrize("length", [1e-9, 1.0, 1e3])
def test_gaps_that_count_as_closed(length):
    """Active contactors may be 3e-14 of the model's size away from the target, not 3e-13."""
    b = blocks(COMM, "quadrilateral", 2, 4, pose=lambda x: length * x)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.01 * length), contacts=[contact])
    run(problem)
    system, config = problem.system, problem.config
    u, nodes = np.array(b.u.x.array), contact.pair.nodes
    for part, closed in ((0.0, True), (3e-14, True), (3e-13, False)):
        b.u.x.array[:] = u
        config.displacement[nodes, 1] += part * config.size
        b.u.x.scatter_forward()
        system.place(returning=False)
        system.assemble_residual()
        state = system.unite(equilibrium)
        assert state.closed == closed and not state.changed
