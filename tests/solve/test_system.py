"""Contact by elimination: when gaps count as closed, and what a solve predicts."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from friction_scenes import driven
from helpers import blocks, clamp, linear, modulus, run

import uem_dolfinx as uem
from uem_dolfinx.solve.united.newton import Increment

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
        system.place()
        problem.bodies.assemble()
        state = system.assemble_constraints(equilibrium)
        assert state.closed == closed and not state.changed


def lifted(b, contact, way, held=False):
    """The system in equilibrium but for the contactors, which have been lifted off the target."""
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, 0), *clamp(b.V, b.top, 1, value=-0.01)]
    bcs += clamp(b.V, b.high, 1, value=-0.01) if held else []
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact])
    run(problem)
    problem.config.displacement[contact.pair.nodes, 1] += way
    b.u.x.scatter_forward()
    problem.system.place()
    return problem


@pytest.mark.parametrize(
    ("way", "bound", "back"), [(1e-5, 1.0, True), (1e-5, 1e-7, False), (5e-15, 1.0, True), (4e-16, 1.0, False)]
)
def test_the_normal_return(way, bound, back):
    """Contactors are put back onto the bent target [UEM, 4.2] if forces allow and positions are not rounding anyway."""
    b = blocks(COMM, "quadrilateral", 2, 5)
    contact = uem.Contact(b.high, b.low)
    system = lifted(b, contact, way).system
    gap, u = contact.max_gap(), np.array(b.u.x.array)
    assert system.return_to_targets(bound) == back
    assert contact.max_gap() <= 1e-3 * gap + 1e-15 if back else np.array_equal(b.u.x.array, u)


def test_what_a_condition_holds_is_not_returned():
    """A contactor whose normal displacement is prescribed stays where it is, though the bent target's normal leans a little."""
    b = blocks(COMM, "quadrilateral", 2, 5)
    system = lifted(b, uem.Contact(b.high, b.low), 1e-5, held=True).system
    u = np.array(b.u.x.array)
    assert not system.return_to_targets(np.inf) and np.array_equal(b.u.x.array, u)


@pytest.mark.parametrize("length", [1e-9, 1.0, 1e3])
def test_what_a_solve_predicts(length):
    """Contactors that the increment lets sink by 3e-9 of it stay open, since a solve predicts no more; by 3e-8 of it they close."""
    b = blocks(COMM, "quadrilateral", 2, 4, gap=0.5, pose=lambda x: length * x)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top)], contacts=[contact])
    system, config = problem.system, problem.config
    system.place()
    problem.bodies.assemble()
    for part, closes in ((3e-9, False), (3e-8, True)):
        state = system.assemble_constraints(equilibrium)
        linearised = system.linearise(state, 0)
        du = problem.config.vector()
        way = np.zeros((config.n_owned, 2))
        way[config.X[: config.n_owned, 1] > 0.25 * length, 1] = -0.5 * length * (1 + part)
        du.array[:] = way.ravel()
        assert (system.exchange(linearised, Increment(du, du, linearised.rhs, 1, 0.0)) is not None) == closes


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_the_united_matrix_follows_q(coupling):
    """Where all contactors stick Q is P, and has rotated rows where they slip: the matrix is made anew, and back again."""
    d = driven(mu=0.3, how={"coupling": coupling, "sliding": "small"}, options={"consistent_tangent": False})
    for place in ((0.0, -0.01), (0.1, -0.01)):
        d.to(*place)
    system, pair = d.problem.system, d.contact.pair
    assert d.states[1] > 0
    system.place()
    d.problem.bodies.assemble()
    before = system.assemble_constraints(lambda *norms: False)
    system.linearise(before, 0)
    slips = pair.trial
    sticks = replace(slips, friction=replace(slips.friction, stick=slips.active))
    for trial in (slips, sticks, slips):
        pair.take(trial)
        state = system._with_rows(before)
        assert (state.test is state.trial) == (trial is sticks)
        linearised = system.linearise(state, None)
        loads = d.problem.bodies.residual.duplicate()
        loads.set(1.0)
        rhs = state.test.transpose(loads)
        loaded = linearised._replace(rhs=rhs)
        dq = system.complete(loaded, system.solve(loaded, 0.0, None)).dq
        left = state.test.transpose(d.problem.bodies.tangent.K * state.trial.expand(dq)) - rhs
        assert left.norm() <= 1e-9 * rhs.norm()
