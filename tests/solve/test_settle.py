"""A linearised problem that is solved on arrays leaves the contacts the state that exchanges find, in one step of them.

The test to read first: ``test_arrays_find_what_exchanges_find``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from body_scenes import Discs, close
from driven_scenes import MORTAR, QUICK, SCENES, WAY
from friction_scenes import driven
from helpers import gathered_matrix, highest, slow, st_venant
from ramp_scenes import COMM

import uem_dolfinx as uem
from uem_dolfinx.algebra import relative
from uem_dolfinx.algebra.options import has_mumps
from uem_dolfinx.algebra.relative import Condensation
from uem_dolfinx.contact.seam.active_set import Violations
from uem_dolfinx.parallel import on_root
from uem_dolfinx.solve.bodies.tangent import together
from uem_dolfinx.solve.slots import settle
from uem_dolfinx.solve.united import exchanges, system
from uem_dolfinx.solve.united.exchanges import AS_LONG_IF_CHEAP, Exchanges
from uem_dolfinx.solve.united.rows import Rows
from uem_dolfinx.solve.united.system import BodySystem

pytestmark = [pytest.mark.every_case, pytest.mark.skipif(not has_mumps(), reason="needs MUMPS")]


def led(make):
    """Lead a scene along ``WAY``: active contactors, exchanges, displacements and forces of the steps."""
    problem, top = make()
    found, g = [], problem.config.gdim
    for place in WAY:
        top.x.array[:] = np.tile([place[0], *[0.0] * (g - 2), place[1]], len(top.x.array) // g)
        most = max(i.exchanges for i in problem.solve())
        active, forces = sum(c.n_active for c in problem.contacts), sum(c.force.x.array for c in problem.contacts)
        found.append((active, most, np.array(problem.u.x.array), np.array(forces)))
    return found


@pytest.mark.parametrize("name", [name if name in QUICK else slow(name) for name in SCENES])
def test_arrays_find_what_exchanges_find(name, monkeypatch):
    """By every coupling and law: from the first violation on, and never; most problems then take one exchange."""
    with monkeypatch.context() as never:
        never.setattr(Exchanges, "take_long", lambda *_: False)
        by_exchanges = led(SCENES[name])
    monkeypatch.setattr(exchanges, "AS_LONG_IF_CHEAP", 0)
    made, own = [], Rows.settle
    monkeypatch.setattr(Rows, "settle", lambda *given: made.append(own(*given)) or made[-1])
    for one, other in zip(by_exchanges, led(SCENES[name])):
        assert one[0] == other[0] and other[1] <= max(one[1], 2)
        for a, b in zip(one[2:], other[2:]):
            assert highest(COMM, np.abs(a - b)) <= 1e-6 * highest(COMM, np.abs(a))
    assert sum(one is not None for one in made) >= 0.5 * len(made)


@pytest.mark.parametrize("name", [name if name in QUICK else slow(name) for name in SCENES])
def test_the_solution_is_that_of_the_constrained_matrix(name, monkeypatch):
    """What is found on arrays solves ``Q'(K + G)P dq = Q'(r - K c)`` of its state, whose determinant has the same sign."""
    own, compared = BodySystem.solve, []

    def solve(system, problem, accuracy, near):
        step, state, solver = own(system, problem, accuracy, near), problem.state, system.solver
        if state.solved is not None and solver.tells_sign | (state.trial is state.test) and not solver.iterative:
            reported, kept = solver.negative, solver.take
            matrix = state.trial, system.bodies.tangent.K, together(system.curvature, state.added)
            solver.set_operator(*matrix, state.test)
            solver.begin_at(state.trial.c)
            dq = solver.complete(solver.solve(problem.rhs)[0])
            compared.append((dq - step.dq).norm() / max(dq.norm(), 1e-7))
            assert solver.negative == reported
            kept(state.solved, *matrix, state.test)
        return step

    monkeypatch.setattr(BodySystem, "solve", solve)
    monkeypatch.setattr(relative, "BALANCED", 1e-14)
    monkeypatch.setattr(system, "FORCING", 0.0)
    # contactors that have slipped in the step may stick to their anchors, whose rows differ a little from those at feet
    ahead = system.way_ahead
    monkeypatch.setattr(system, "way_ahead", lambda *of: ahead(*of) if of[-1] else None)
    monkeypatch.setattr(exchanges, "AS_LONG_IF_CHEAP", 0)
    led(SCENES[name])
    assert max(compared, default=0.0) <= 1e-8


@pytest.mark.parametrize("cell", ["quadrilateral", "triangle", slow("hexahedron"), slow("tetrahedron")])
@pytest.mark.parametrize("how", [{}, MORTAR], ids=str)
def test_relative_coordinates(cell, how):
    """T has the relative motions in its slots; condensed forces are the multipliers of given gaps and slips."""
    n = (3, 5) if cell in ("triangle", "quadrilateral") else (2, 3)
    scene = driven(cell, 0.3, law=st_venant, n=n, how=how)
    scene.to(*[0.0] * (scene.problem.config.gdim - 1), -0.03)
    problem, system = scene.problem, scene.problem.system
    g = problem.config.gdim
    rows = system._rows()
    slots = settle._Slots.of(rows.pairs[0], rows.equations[0], 0, np.ones(len(rows.equations[0]), dtype=bool))
    problem.bodies.update_tangent()
    coordinates = settle._coordinates(problem.bodies, rows.whole, rows.test, slots.rows)
    condensed = Condensation(rows.test.space, *coordinates, problem.bodies.tangent.K, None)
    K, T = gathered_matrix(problem.bodies.tangent.K), gathered_matrix(condensed.trial.T.P)
    # others are held at their places, as those of corners
    others = np.setdiff1d(np.flatnonzero(rows.whole.rows.active), slots.rows)
    which = np.append(slots.rows, others)
    B, back = (gathered_rows(problem.config, equations, which, g) for equations in (rows.whole.P, rows.whole.rows))
    mine = np.concatenate(COMM.allgather(np.arange(len(which)) < len(slots.rows)))
    place = np.concatenate(COMM.allgather(condensed.numbers(slots.rows)))
    number = np.concatenate(COMM.allgather(condensed.trial.slot[slots.rows] + g * problem.config.first))
    unit = np.zeros((len(number), len(T)))
    unit[np.arange(len(number)), number] = 1.0
    assert np.abs((B @ T)[mine] - unit).max() <= 1e-12
    free = np.concatenate(COMM.allgather(rows.test.free.ravel()))
    F = problem.bodies.residual.duplicate()
    F.array[:] = np.random.default_rng(3 + COMM.rank).standard_normal(F.local_size)
    condensed.begin(F)
    load, whole = condensed.forces(), np.concatenate(COMM.allgather(F.array_r))
    w = np.random.default_rng(0).standard_normal(len(number))
    # du of free components and forces of the rows: K du - back' force = -F, B du = w
    given = np.zeros(len(B))
    given[mine] = w
    A = np.block([[K[np.ix_(free, free)], -back[:, free].T], [B[:, free], np.zeros((len(B), len(B)))]])
    force = np.linalg.solve(A, np.append(-whole[free], given))[free.sum() :][mine]
    if COMM.rank == 0:
        found = condensed.stiffness @ w[np.argsort(place)] + load
        assert np.abs(found[place] - force).max() <= 1e-9 * np.abs(force).max()


@pytest.mark.parametrize("how", [{}, slow(MORTAR)], ids=str)
def test_a_condensation_serves_other_coordinates(how, monkeypatch):
    """Contactors of linear bodies that slide keep the first one, which leaves in a few passes what a new one leaves of the forces."""
    made, served, passes = [], [], []

    class Seen(relative.Condensation):
        def __init__(self, *of):
            made.append(self)
            super().__init__(*of)

        def begin(self, F):
            super().begin(F)
            served.append(self.moved_on)
            passes.append(-1)

        def forces(self):
            passes[-1] += 1
            return super().forces()

        def balanced(self, force, left):
            for much, holds in ((0.3, True), (3.0, False)):
                more = much * 1e-10 * self._left.norm() / np.sqrt(max(np.size(force), 1))
                exact = on_root(COMM, self._left.array_r[self._at])
                inside = self._inside().norm() < 1e-12 * self._left.norm()
                assert not inside or super().balanced(exact + more, 0.0) == holds
            return super().balanced(force, left)

    monkeypatch.setattr(relative, "Condensation", Seen)
    monkeypatch.setattr(exchanges, "AS_LONG_IF_CHEAP", 0)
    scene = driven("quadrilateral", 0.3, n=(3, 5), how=how)
    for place in ((0.0, -0.03), (0.01, -0.03), (0.02, -0.03), (0.0, -0.03)):
        scene.to(*place)
    assert len(made) == 1 and sum(served) > 4 and max(passes) <= 5, passes


def gathered_rows(config, equations, which, g):
    """Rows of all ranks as a dense matrix."""
    B = np.zeros((len(equations), config.n_global, g))
    B[np.arange(len(B)), equations.node + config.first] = equations.direction
    np.subtract.at(B, (equations.row, equations.followed), equations.coefficients)
    return np.concatenate(COMM.allgather(B[which].reshape(len(which), g * config.n_global)))


def test_slots_are_for_contactors_within_reach():
    """Gaps that both sides together cannot close have no slots: of two blocks, each of which goes half of the gap or less."""
    scene = driven("quadrilateral", 0.3, law=st_venant, n=(3, 5))
    rows, config = scene.problem.system._rows(), scene.problem.config
    equations = replace(rows.whole.P, gap=np.full(len(rows.whole), 0.1))
    for way, reached in ((0.0, False), (0.04, False), (0.06, True)):
        du = np.zeros((config.n_owned, config.gdim))
        du[:, -1] = way
        near = settle._near(equations, rows.test.space, du)[rows.whole.normal]
        assert (near == reached).all()


@pytest.mark.long
def test_time_steps_with_friction_begin_on_arrays(monkeypatch):
    """Discs that fall and slide move as by exchanges alone, of which arrays save most."""

    def moved():
        discs = Discs(2, 1)
        problem = discs.problem(discs.contacts(True))
        steps = [(s.newton_iterations, sum(i.exchanges for i in s.iterations)) for s in uem.time_steps(problem, 0.01, 0.12)]
        return problem, np.array(steps).T

    problem, (iterations, few) = moved()
    monkeypatch.setattr(system, "way_ahead", lambda *_: None)
    other, (without, many) = moved()
    close(problem.u, other.u, 10.0)
    # contactors that touch first have no rows before
    assert np.array_equal(iterations, without) and (few <= many).all() and few[9:].sum() == 0 < many[9:].sum()


def test_when_arrays_are_used():
    """Once in a problem, instead of the first factorisation for another state, or after ten solves without."""
    scene = driven(mu=0.3, law=st_venant, n=(3, 5))
    wrong = [Violations(np.zeros(n := len(pair.nodes), bool), np.ones(n, bool)) for pair in scene.problem.pairs]
    new = [replace(one, enter=one.release, release=one.enter) for one in wrong]
    none = [Violations.none(len(pair.nodes)) for pair in scene.problem.pairs]
    taken = []
    for cheap in (False, True):
        own = Exchanges(scene.problem.pairs)
        for number in range(15):
            # contactors that touch have no rows yet
            assert not own.take_long(none, cheap) and not own.take_long(new, cheap)
            taken += [number] * own.take_long(wrong, cheap)
            own._number += 1
    assert taken == [0, AS_LONG_IF_CHEAP] and 4 < taken[1] < 15
