"""Central differences with exact contact on a surface without mass: waves, impacts, critical step, restart, what is refused.

The test to read first is ``test_a_bar_on_a_wall``: force, duration, momentum and energy of an impact in closed form.
"""

from __future__ import annotations

import sys

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from flight_scenes import ATTEMPT, Flight
from helpers import at, box, clamp, scene

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.dynamics.explicit.part_solver import PartSolver, Prediction, SurfaceSolver
from uem_dolfinx.dynamics.explicit.stepper import ExplicitStepper
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.bodies.bodies import Bodies
from uem_dolfinx.solve.united import system

COMM = MPI.COMM_WORLD


@pytest.mark.long
@pytest.mark.parametrize(("dim", "law", "speed", "within"), [(2, uem.LinearElastic, 10.0, 5e-3), (3, uem.LinearElastic, 10.0, 5e-3),
                                                             (2, uem.NeoHooke, 1.0, 2e-2)])  # fmt: skip
def test_a_bar_on_a_wall(dim, law, speed, within):
    """The wall feels rho c v for the time 2 L / c; momentum is the impulse, and the energy stays."""
    bar = Flight(dim, 40 if dim == 2 else 20, speed, 0.05 * speed, law=law)
    t, force, energy, momentum = bar.run(0.05 + 2 * 10 / 30 + 0.1)
    plateau = force[(t > 0.12) & (t < 0.65)]
    cell = 10 / (40 if dim == 2 else 20) / 30
    assert abs(plateau.mean() / (30 * speed) - 1) < within
    on = t[force > 0]
    assert 0.05 <= on[0] <= 0.05 + 2 * bar.last.dt and abs(on[-1] - 0.05 - 2 / 3) < 2 * cell
    # no impulse but that of the wall
    assert abs(momentum[-1] + 10 * speed - bar.book.impulses[-1][0][-1]) < 1e-11 * 10 * speed
    assert np.abs(energy - 1).max() < (5e-3 if dim == 2 else 1e-2)


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("impedance", [1.0, 4.0])
def test_bars_of_other_impedance(coupling, impedance):
    """Force ``v Z1 Z2 / (Z1 + Z2)``, velocity of rebound by characteristics, momentum of both to rounding."""
    bars = Flight(2, 60, 1.0, 0.05, bars=2, impedance=impedance, coupling=coupling)
    t, force, energy, momentum = bars.run(0.05 + 2 * 10 / 30 + 0.05)
    plateau = force[(t > 0.12) & (t < 0.65)]
    assert abs(plateau.mean() / (30 * impedance / (1 + impedance)) - 1) < 1e-2
    assert np.abs(momentum + 10).max() < 1e-11
    assert np.abs(energy - 1).max() < 5e-3


@pytest.mark.slow
def test_a_block_slides_where_it_bounces():
    """A block thrown aslant onto a rough plane: friction takes mu times the normal impulse; it ends as by the trapezoidal rule."""

    def thrown(dt, **how):
        s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.002], [2.0, 1.002], [16, 12])])
        V = compat.function_space(s.mesh, 1, (2,))
        u, v = fem.Function(V), ufl.TestFunction(V)
        law = uem.LinearElastic(1000.0, 0.3, kind="plane_strain")
        dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=(0.5, -0.1), gravity=(0.0, -1.0), **how)
        contact = uem.Contact(s.tag("bottom", 0, at(1, 0.002)), uem.RigidPlane((0.0, 0.0), (0.0, 1.0)), friction=0.3)
        problem = uem.UnitedProblem(law.residual(u, v) * ufl.dx, u, contacts=[contact], dynamics=dynamics)
        book = uem.EnergyBook(problem, law.energy(u) * ufl.dx)
        for step in uem.time_steps(problem, dt, 0.2):
            book.write(step)
        return book

    book, other = thrown(None, scheme=uem.CentralDifferences()), thrown(0.002)
    impulse, momenta, row = book.impulses[-1][0], np.array(book.momenta), book.rows[-1]
    assert abs(impulse[0] / impulse[1] + 0.3) < 1e-9
    assert np.allclose(momenta[-1] - momenta[0], impulse - [0.0, 2.0 * row.time], rtol=0, atol=1e-9)
    assert np.allclose(impulse, other.impulses[-1][0], rtol=3e-2)
    assert abs(row.friction / other.rows[-1].friction - 1) < 3e-2 and abs(row.defect) < 5e-3 * book.rows[0].kinetic


def test_the_critical_step():
    """Lanczos' estimate is at most four per cent below the exact one, 2 over the highest frequency of the condensed system."""
    bar = Flight(2, 12, nu=0.3)
    stepper = ExplicitStepper(bar.problem)
    found = stepper.critical_step()
    if COMM.size == 1:
        K, m = bar.problem.bodies.tangent.K[:, :], stepper._mass
        i, s = np.flatnonzero(m > 0), np.flatnonzero(m == 0)
        condensed = K[np.ix_(i, i)] - K[np.ix_(i, s)] @ np.linalg.solve(K[np.ix_(s, s)], K[np.ix_(s, i)])
        root = np.sqrt(m[i])
        highest = np.linalg.eigvalsh(condensed / root[:, None] / root)[-1]
        assert 0.96 * 2 / np.sqrt(highest) < found <= 2 / np.sqrt(highest) * (1 + 1e-9)


def test_stiff_contactors_do_not_shorten_steps():
    """A thin layer of cells between surface and masses vibrates with nothing: the step is that without it, until it touches."""

    def stepper(thin):
        """Of a bar whose lowest cells are thin."""

        def pose(x):
            return x + np.outer(np.abs(x[:, 1] - 0.05) < 1e-9, [0.0, (1 - thin) * 10 / 12])

        return ExplicitStepper(Flight(2, 12, gap=0.05, pose=pose).problem)

    whole, thin = stepper(1.0), stepper(0.1)
    steps = whole.critical_step(), thin.critical_step()
    assert not whole.problem.step_control.of_contact and thin.problem.step_control.of_contact
    assert steps[1] > 0.8 * steps[0]


def test_a_step_beyond_the_critical_one():
    """A step that is too long is refused with both lengths, before any step."""
    bar = Flight(2, 12)
    critical = ExplicitStepper(bar.problem).critical_step()
    with pytest.raises(uem.InputError, match="no more than the critical step"):
        next(iter(uem.time_steps(bar.problem, 1.01 * critical, 1.0)))
    next(iter(uem.time_steps(bar.problem, 0.99 * critical, 1.0)))


@pytest.mark.slow
def test_a_thin_layer_at_the_wall():
    """Cells of a hundredth at the wall make contact stiff: steps resolve it from the first touch on, and energy and momentum are right."""

    def squeezed(x):
        y = x[:, 1] - 0.5
        return np.column_stack([x[:, 0], 0.5 + np.where(y < 0.5, y, np.where(y < 1.5, 0.01 + (y - 1.0), y))])

    bar = Flight(2, 10, pose=squeezed)
    t, _, energy, momentum = bar.run(0.05 + 2 * 10 / 30 + 0.05)
    assert abs(energy - 1).max() < 0.03 and abs(momentum[-1] / momentum[0] + 1) < 0.07
    # two thirds of the time of the run at a fifth of the step of other cells
    assert 200 < len(t) < 600


@pytest.mark.parametrize(("left", "steps"), [(3e-7, 1), (3e-6, 2)])
def test_steps_that_end(left, steps):
    """What is left to the end is a step, or rounding."""
    assert len(list(uem.time_steps(Flight(2, 12).problem, 0.01, 0.01 * (1 + left)))) == steps


def test_runs_without_a_step():
    """A run that ends where it begins has no step; with a velocity that is no number it does not begin, with any scheme."""
    bar = Flight(2, 4)
    assert list(uem.time_steps(bar.problem, None, bar.dynamics.time)) == []
    if COMM.rank == COMM.size - 1:
        bar.dynamics.velocity.x.array[:] = np.nan
    with pytest.raises(uem.NotFiniteError, match="the velocity at time 0 contains NaN"):
        next(iter(uem.time_steps(bar.problem, None, 1.0)))


@pytest.mark.long
def test_steps_that_shrink():
    """A bar that is squeezed has shorter cells, and shorter steps each time that its cells are shorter by a tenth."""
    bar = Flight(2, 90, law=uem.NeoHooke)
    y = bar.problem.config.X[:, 1]
    bar.dynamics.velocity.x.array.reshape(-1, 2)[:, 1] = 1.5 * (5.5 - y)
    lengths = []
    for step in uem.time_steps(bar.problem, end=100.0):
        lengths.append(step.dt)
        if step.number == 51:
            break
    changed = np.flatnonzero(np.diff(lengths))
    assert 2 <= len(changed) <= 5 and lengths[50] < 0.95 * lengths[0]


def test_a_step_assembles_nothing(monkeypatch):
    """While a linear bar stays on the wall, a step multiplies by K alone: no residual is assembled, and nothing is factorised."""
    bar, made = Flight(2, 40), []
    bar.problem.rtol = 1e-8
    steps = uem.time_steps(bar.problem, end=0.4)
    while next(steps).time < 0.15:
        pass
    monkeypatch.setattr(uem.UnitedProblem, "attempt", ATTEMPT)
    monkeypatch.setattr(forms, "assemble_vector", lambda b, L: made.append("residual"))
    for kind, what in ((PartSolver, "_factorise"), (UnitedSolver, "_set_up")):
        monkeypatch.setattr(kind, what, lambda *a, **k: made.append("matrix"))
    for _ in range(20):
        assert bar.contact.n_active == 2 or COMM.size > 1
        next(steps)
    assert not made


@pytest.mark.long
@pytest.mark.parametrize("law", [uem.LinearElastic, uem.NeoHooke])
def test_a_surface_that_comes_and_goes(monkeypatch, law):
    """Where contact changes, the surface alone is factorised; its forces are those of the cells behind it, assembled without the others."""
    bar, sizes = Flight(2, 12, law=law), []
    monkeypatch.setattr(UnitedSolver, "_set_up", lambda *a, **k: pytest.fail("all unknowns are factorised"))
    factorise = PartSolver._factorise
    monkeypatch.setattr(PartSolver, "_factorise", lambda self, nodes, *a: sizes.append(len(nodes)) or factorise(self, nodes, *a))
    write, bodies = [], bar.problem.bodies
    assemble = Bodies.assemble
    monkeypatch.setattr(Bodies, "assemble", lambda self, by=None: write.append(by) or assemble(self, by))
    bar.run(0.8)
    assert bar.contact.n_active == 0 and bar.rows[-1][3] > 0.0
    assert sizes and reduced(COMM, max(sizes)) == 2
    parts = [by for by in write if by is not None]
    assert bool(parts) == (law is uem.NeoHooke)
    if parts:
        bodies.assemble()
        every, some = bodies.residual_of_all, compat.create_vector(bar.u.function_space)
        parts[-1](some)
        light = ~bar.dynamics.massy.ravel()
        assert np.abs((some.array_r - every)[light]).max(initial=0.0) <= 1e-12 * np.abs(every).max(initial=1.0)
        assert reduced(COMM, float(np.abs(some.array_r - every).max(initial=0.0))) > 0.0


def test_calls_of_a_step(monkeypatch):
    """While a linear bar stays on the wall, a step makes no more than 3,000 calls, whatever its size."""
    bar, calls = Flight(3, 10), []
    bar.problem.rtol = 1e-8
    steps = uem.time_steps(bar.problem, end=0.4)
    while next(steps).time < 0.15:
        pass
    monkeypatch.setattr(uem.UnitedProblem, "attempt", ATTEMPT)
    sys.setprofile(lambda frame, event, arg: calls.append(1) if event in ("call", "c_call") else None)
    try:
        for _ in range(5):
            next(steps)
    finally:
        sys.setprofile(None)
    # ranks exchange in more of them
    assert len(calls) <= 5 * 3000 or COMM.size > 1


@pytest.mark.long
def test_how_long_a_factor_of_the_surface_serves(monkeypatch):
    """Four solves bring the surface of a bar of NeoHooke's law into equilibrium, or leave the rest to one iteration of Newton's method."""
    solves, factors, inside = [0], [0], []
    predict, prepare, solve = Prediction.predict, Prediction._prepare, SurfaceSolver.solve

    def predicting(self, start):
        solves.append(0)
        inside.append(1)
        predict(self, start)
        inside.clear()

    def solving(self, *args):
        solves[-1] += len(inside)
        return solve(self, *args)

    monkeypatch.setattr(Prediction, "predict", predicting)
    monkeypatch.setattr(Prediction, "_prepare", lambda self: factors.append(1) or prepare(self))
    monkeypatch.setattr(SurfaceSolver, "solve", solving)
    for speed, iterations in ((1.0, 0), (9.0, 1)):
        bar, solves[:], factors[:] = Flight(2, 12, speed, 0.0, law=uem.NeoHooke, nu=0.3), [0], []
        bar.problem.rtol = 1e-10
        taken = [step.newton_iterations for step in uem.time_steps(bar.problem, end=0.3)]
        assert max(solves) <= 4 and len(factors) == 2 and max(taken[1:]) == iterations and len(taken) > 10


@pytest.mark.parametrize("law", [uem.LinearElastic, uem.NeoHooke])
def test_forces_under_loads_that_change(law):
    """The forces of a step are those of the residual at its displacement and load, also where the load has changed or rests."""
    bar = Flight(2, 12, law=law)
    problem = bar.problem
    form, expected = forms.form(problem.bodies.F), compat.create_vector(bar.u.function_space)
    for step in uem.time_steps(problem, end=10.0):
        bar.pull.value = 5.0 * min(step.number // 3, 3)
        problem.bodies.assemble()
        forms.assemble_vector(expected, form)
        inertia = bar.dynamics.load()
        assert np.linalg.norm(problem.bodies.residual_of_all - expected.array_r - inertia) <= 1e-12 * max(expected.norm(), 1.0)
        if step.number == 20:
            break


def test_a_plane_pushes():
    """A plane that moves upwards at a constant speed from a bar at rest on presses it with rho c v."""
    bar = Flight(2, 40, 0.0, 0.0, move=lambda t: (0.0, 3.0 * t))
    rows = [(step.time, bar.contact.resultant().force[1]) for step in uem.time_steps(bar.problem, end=0.6)]
    t, force = np.array(rows).T
    plateau = force[(t > 0.1) & (t < 0.55)]
    assert abs(plateau.mean() / 90.0 - 1) < 5e-3


@pytest.mark.slow
def test_every_step_ends_with_a_check_of_signs(monkeypatch):
    """The check sees the forces that the step has, the wall's in the end."""
    bar, seen, check = Flight(2, 10, 10.0, 0.5), [], system.check_signs
    monkeypatch.setattr(
        system, "check_signs", lambda pairs, least: (seen.append([p.trial.lam.sum() for p in pairs]), check(pairs, least))
    )
    _, force, _, _ = bar.run(0.15)
    pushed = COMM.allreduce(np.array([sum(own) for own in seen[-len(force) :]]))
    assert pushed == pytest.approx(force, rel=1e-9) and force[-1] > 0.0


@pytest.mark.slow
def test_the_critical_step_is_found_where_cells_change(monkeypatch):
    """A bar of NeoHooke's law that is strained by 3 per cent keeps its critical step, one that is strained by a third does not."""
    found = []
    critical = ExplicitStepper.critical_step
    monkeypatch.setattr(ExplicitStepper, "critical_step", lambda self: found.append(1) or critical(self))
    counts = []
    for speed in (1.0, 9.0):
        found.clear()
        bar = Flight(2, 40, speed, 0.0, law=uem.NeoHooke)
        for step in uem.time_steps(bar.problem, end=0.8):
            pass
        counts.append(len(found))
        assert step.number > 70
    assert counts[0] == 1 < 10 < counts[1], counts


def test_supports_and_gravity():
    """A hanging bar whose end is moved follows: its momentum is that of weight and reaction, its end has the given motion."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 10.0], [1, 20])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, v, moved = fem.Function(V), ufl.TestFunction(V), fem.Constant(s.mesh, 0.0)
    top = s.tag("top", 0, at(1, 10.0))
    bcs = [fem.dirichletbc(moved, fem.locate_dofs_topological(V.sub(1), 1, top.entities), V.sub(1)), *clamp(V, top, 0)]
    law = uem.LinearElastic(900.0, 0.0, kind="plane_stress")
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), gravity=(0.0, -10.0), scheme=uem.CentralDifferences())
    problem = uem.UnitedProblem(
        law.residual(u, v) * ufl.dx, u, bcs=bcs, dynamics=dynamics, load={moved: lambda t: 0.1 * np.sin(5 * t) ** 2}
    )
    book, impulse, before = uem.EnergyBook(problem, law.energy(u) * ufl.dx), 0.0, None
    for step in uem.time_steps(problem, end=0.6):
        row = book.write(step)
        reaction = problem.reaction(top)[1]
        impulse += step.dt * (reaction if before is None else 0.5 * (reaction + before)) - step.dt * 100.0
        before = reaction
    highest = COMM.allreduce(u.x.array.max(initial=-np.inf), MPI.MAX)
    assert highest == pytest.approx(0.1 * np.sin(3.0) ** 2)
    assert abs(row.defect) < 1e-2 * max(r.kinetic + r.stored for r in book.rows)


REFUSED = {
    "a consistent mass": ({"consistent": True}, "lumped mass"),
    "a tie": ({"contact": {"tied": True}}, "is tied"),
    "a general contact": ({"general": True}, "GeneralContact"),
    "events": ({"steps": {"event_tolerance": 0.1}}, "event_tolerance"),
    "steps taken again": ({"again": True}, "not repeated"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_what_does_not_go_is_refused(what):
    """By name, before any work."""
    how, words = REFUSED[what]
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 10.0], [1, 12]),
                                      box("quadrilateral", [0.0, 10.0], [1.0, 20.0], [1, 12])])  # fmt: skip
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    form = uem.LinearElastic(900.0, 0.0, kind="plane_stress").residual(u, v) * ufl.dx
    mass = (uem.consistent_mass if "consistent" in how else uem.lumped_mass)(V, 1.0)
    contact = uem.Contact(s.tag("up", 1, at(1, 10.0)), s.tag("low", 0, at(1, 10.0)), **how.get("contact", {}))
    contact = uem.GeneralContact() if "general" in how else contact
    with pytest.raises(uem.InputError, match=words):
        problem = uem.UnitedProblem(
            form, u, contacts=[contact],
            dynamics=uem.Dynamics(mass, scheme=uem.CentralDifferences(), **how.get("dynamics", {})),
        )  # fmt: skip
        for _ in uem.time_steps(problem, end=0.1, **how.get("steps", {})):
            problem.solve()


@pytest.mark.parametrize("contactors", ["massless", "massy"])
@pytest.mark.parametrize("soft", [0, 1])
def test_what_explicit_steps_would_hide_is_refused(contactors, soft):
    """A negative modulus in one of two bodies, load steps and an equilibrium: each by its name, with nothing moved."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 10.0], [1, 12]),
                                      box("quadrilateral", [0.0, 10.1], [1.0, 20.0], [1, 12])])  # fmt: skip
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    sign = fem.Constant(s.mesh, 1.0)
    up = ufl.gt(ufl.SpatialCoordinate(s.mesh)[1], 10.05)
    factor = ufl.conditional(up, sign, 3.0) if soft else ufl.conditional(up, 3.0, sign)
    form = factor * uem.LinearElastic(900.0, 0.0, kind="plane_stress").residual(u, v) * ufl.dx
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), scheme=uem.CentralDifferences(), contactors=contactors)
    contact = uem.Contact(s.tag("up", 1, at(1, 10.1)), s.tag("low", 0, at(1, 10.0)))
    problem = uem.UnitedProblem(form, u, contacts=[contact], dynamics=dynamics)
    with pytest.raises(uem.InputError, match="load_steps are for statics"):
        uem.load_steps(problem, 2)
    with pytest.raises(uem.InputError, match="solve.. does not go with CentralDifferences"):
        problem.solve()
    sign.value = -1.0
    with pytest.raises(uem.InputError, match="tangent of the bodies is indefinite"):
        next(uem.time_steps(problem, end=0.1))
    assert not u.x.array.any()
