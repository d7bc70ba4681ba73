"""The united system: when gaps count as closed, and what steps a call of ``unite`` takes."""

from mpi4py import MPI

import numpy as np
import pytest
from friction_scenes import driven
from helpers import blocks, clamp, linear, run

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


@pytest.mark.parametrize("length", [1e-9, 1.0, 1e3])
def test_what_a_solve_foretells(length):
    """Contactors that the increment lets sink by 3e-9 of it stay open, since a solve foretells no more; by 3e-8 of it they close."""
    b = blocks(COMM, "quadrilateral", 2, 4, gap=0.5, pose=lambda x: length * x)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top)], contacts=[contact])
    system, config = problem.system, problem.config
    system.place(returning=False)
    system.assemble_residual()
    for part, closes in ((3e-9, False), (3e-8, True)):
        state = system.unite(equilibrium)
        system.differentiate(first=True)
        system.linearise(state)
        du = problem.config.vector()
        way = np.zeros((config.n_owned, 2))
        way[config.X[: config.n_owned, 1] > 0.25 * length, 1] = -0.5 * length * (1 + part)
        du.array[:] = way.ravel()
        assert (system.exchange(state, du, 0.0, 0.0) is not None) == closes


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_the_united_matrix_follows_q(coupling):
    """Where limits of friction are held Q is P, which is what it was with tilted rows: the matrix is made anew, and back again."""
    d = driven(mu=0.3, how={"coupling": coupling, "sliding": "small"}, options={"consistent_tangent": False})
    for place in ((0.0, -0.01), (0.1, -0.01)):
        d.to(*place)
    system, pair = d.problem.system, d.contact.pair
    assert d.states[1] > 0
    system.place(returning=False)
    system.assemble_residual()
    system.unite(lambda *norms: False)
    system.differentiate(first=True)
    for lam in (None, pair.trial.lam, None):
        pair.friction.hold_limits(lam)
        rows = system._rows()
        state = system._state(rows, rows.test.transpose(system._residual()), 0.0, False, False)
        assert (state.test is state.trial) == (lam is not None)
        system.linearise(state)
        loads = d.problem.forces.residual.duplicate()
        loads.set(1.0)
        rhs = state.test.transpose(loads)
        dq, _ = system.solve(rhs, 0.0)
        left = state.test.transpose(d.problem.forces.tangent.K * state.trial.expand(dq)) - rhs
        assert left.norm() <= 1e-9 * rhs.norm()
