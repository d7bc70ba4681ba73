"""Motion in time: accuracy of the integration rules, balances of energy and momentum, impact, its instants, and what is refused.

Two tests to read first: ``test_bar_hits_wall`` (the closed form of an impact) and ``test_ranks_see_the_same_motion``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from bar_scenes import Bar
from dolfinx import fem
from helpers import at, box, clamp, highest, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def first_mode(X):
    """Velocity of a bar that is held at y = 0 and swings in its first mode."""
    v = np.zeros_like(X)
    v[:, -1] = np.sin(np.pi * X[:, -1] / 20)
    return v


# ---------------------------------------------------------------------------------------------- rules


@pytest.mark.long
@pytest.mark.parametrize(
    "scheme",
    [
        uem.newmark(),
        pytest.param(uem.newmark(0.3, 0.5), marks=pytest.mark.slow),
        pytest.param(uem.generalised_alpha(0.5), marks=pytest.mark.slow),
        uem.generalised_alpha(0.0),
    ],
)
def test_second_order(scheme):
    """The swing of a held bar converges like dt^2 to the mode of the lumped chain, whose frequency is known."""
    n = 20
    h, c = 10.0 / n, 30.0
    omega = 2 * c / h * np.sin(np.pi * h / 40)
    errors = []
    for dt in (0.02, 0.01, 0.005):
        bar = Bar(n, gap=0.0, v=first_mode, wall=False, held=True, scheme=scheme)
        bar.run(dt, 1.0)
        error = bar.u.x.array - np.sin(omega) / omega * bar.field(first_mode).x.array
        errors.append(highest(COMM, np.abs(error)) * omega)
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    assert errors[-1] < 0.03 and np.all(orders > 1.8), (errors, orders)


def test_energy_of_the_rules():
    """The trapezoidal rule keeps the energy of linear bodies, generalised-alpha takes it from what the steps cannot resolve."""

    def shock(X):
        v = np.zeros_like(X)
        v[:, 1] = X[:, 1] > 5
        return v

    ends = []
    for scheme in (uem.newmark(), uem.generalised_alpha(1.0), uem.generalised_alpha(0.5)):
        bar = Bar(20, gap=0.0, v=shock, wall=False, scheme=scheme)
        bar.run(0.05, 2.0)
        rows = bar.book.rows
        ends.append((rows[-1].kinetic + rows[-1].stored) / rows[0].kinetic)
    assert abs(ends[0] - 1) < 1e-12
    assert abs(ends[1] - 1) < 0.1
    assert ends[2] < 0.95 and np.isclose(bar.book.momenta[-1][1], bar.book.momenta[0][1], rtol=1e-12)


def test_words_of_schemes():
    for wrong in ({"beta": 0.0}, {"gamma": 0.4}):
        with pytest.raises(ValueError, match="expected a positive beta"):
            uem.newmark(**wrong)
    with pytest.raises(ValueError, match="rho_inf = 1.5"):
        uem.generalised_alpha(1.5)


# ---------------------------------------------------------------------------------------------- forces


def test_free_fall_strains_nothing():
    """Gravity and inertia cancel at every node, although the contactors' mass has been handed on."""
    bar = Bar(gap=50.0, v=-2.0, gravity=(0.0, -10.0))
    bar.run(0.05, 1.0)
    assert np.allclose(bar.u.x.array.reshape(-1, 2)[:, 1], -2.0 - 5.0, rtol=1e-12)
    rows = bar.book.rows
    assert all(row.stored < 1e-20 * rows[-1].kinetic for row in rows)
    assert np.isclose(rows[-1].external, 10.0 * 10.0 * 7.0, rtol=1e-12) and abs(rows[-1].defect) < 1e-9


def test_first_acceleration():
    """A bar in its weight's equilibrium stays there; one that is put down unstrained begins to sink."""
    bar = Bar(20, gap=0.0, v=0.0, gravity=(0.0, -10.0))
    bar.problem.solve()
    u = np.array(bar.u.x.array)
    force = bar.contact.resultant().force[1]
    assert np.isclose(force, 100.0, rtol=1e-9)
    forces = bar.run(0.01, 0.2)
    assert np.abs(bar.u.x.array - u).max(initial=0.0) < 1e-9 * highest(COMM, np.abs(u))
    assert np.allclose(forces[:, 1], 100.0, rtol=1e-8)
    held = Bar(20, gap=0.0, v=0.0, gravity=(0.0, -10.0), wall=False, held=True)
    held.run(1e-4, 1e-4)
    a = held.dynamics.acceleration.x.array.reshape(-1, 2)[:, 1]
    free = held.problem.bodies.free[:, 1]
    assert np.allclose(a[free], -10.0, rtol=1e-2) and np.all(a[~free] == 0.0)


@pytest.mark.long
@pytest.mark.parametrize("rate", [0.5, 20.0])
def test_damping_form(rate):
    """Damping in proportion to the mass slows a free bar down like exp(-rate t)."""

    def damping(velocity):
        w = ufl.TestFunction(velocity.ufl_operands[1].function_space)
        return rate * ufl.inner(velocity, w) * ufl.dx

    bar = Bar(10, gap=5.0, v=-1.0, wall=False, mass=uem.consistent_mass, damping=damping)
    bar.run(0.01 / rate, 1.0 / rate)
    assert np.isclose(bar.dynamics.momentum()[1] / -10.0, np.exp(-1.0), rtol=1e-4)
    rows = bar.book.rows
    assert abs(rows[-1].defect) < 1e-10 * rows[0].kinetic and np.isclose(
        rows[-1].damped, rows[0].kinetic - rows[-1].kinetic, rtol=1e-9
    )


# ---------------------------------------------------------------------------------------------- impact


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "mass"),
    [
        pytest.param("quadrilateral", uem.lumped_mass, marks=pytest.mark.slow),
        pytest.param("quadrilateral", uem.consistent_mass, marks=pytest.mark.slow),
        pytest.param("hexahedron", uem.consistent_mass, marks=pytest.mark.slow),
        ("triangle", uem.lumped_mass),
    ],
)
def test_bar_hits_wall(cell, mass):
    """Pressure 300 from 0.5 to 1.1667 and rebound with the velocity of the impact; energy and momentum kept."""
    bar = Bar(100, cell=cell, mass=mass)
    f = bar.run(0.1 / 30, 1.5)
    pressed = f[f[:, 1] > 0, 0]
    assert abs(pressed[0] - 0.5) < 0.0101 and abs(pressed[-1] - 7 / 6) < 0.015
    inside = (f[:, 0] > 0.55) & (f[:, 0] < 1.1)
    assert np.abs(f[inside, 1] / 300 - 1).max() < 0.03
    rows, p = bar.book.rows, np.array(bar.book.momenta)[:, -1]
    total = np.array([row.kinetic + row.stored for row in rows])
    assert np.abs(total / total[0] - 1).max() < 1e-3
    assert np.isclose(p[-1], -p[0], rtol=0.03)
    impulses = np.array([i[0][-1] for i in bar.book.impulses])
    assert np.allclose(p - p[0], impulses, atol=1e-9 * abs(p[0]))


@pytest.mark.long
@pytest.mark.parametrize("unit", [1e-9, pytest.param(1e3, marks=pytest.mark.slow)])
def test_units(unit):
    """The same impact in nanometres and kilometres, with the density that keeps the wave's time."""
    here, there = Bar(20), Bar(20, unit=unit)
    a, b = here.run(0.01, 1.3), there.run(0.01, 1.3)
    assert np.allclose(b[:, 1], a[:, 1] * unit, rtol=1e-6, atol=1e-6 * unit)
    assert [s.newton_iterations for s in here.steps] == [s.newton_iterations for s in there.steps]


@pytest.mark.long
def test_linear_flight_assembles_once():
    """K is assembled once, and factored once, while nothing touches; so it is while the contact stays."""
    bar = Bar(20)
    bar.run(0.01, 0.45)
    assert bar.problem.bodies.tangent.number == 1
    bar.run(0.01, 1.1)
    assert bar.problem.bodies.tangent.number == 1


@pytest.mark.slow
def test_massless_contactors_have_no_velocity_of_their_own():
    """In contact with the wall they are at rest, and after it they move with the bar."""
    bar = Bar(50)
    bar.run(0.005, 0.8)
    at_tip = fem.locate_dofs_topological(bar.V, 1, bar.tip.entities)
    assert np.abs(bar.dynamics.velocity.x.array.reshape(-1, 2)[at_tip]).max(initial=0.0) < 1e-9
    assert np.abs(bar.dynamics.acceleration.x.array.reshape(-1, 2)[at_tip]).max(initial=0.0) == 0.0
    bar.run(0.005, 1.4)
    v = bar.dynamics.velocity.x.array.reshape(-1, 2)[at_tip, 1]
    assert np.all((v > 5) & (v < 15))


@pytest.mark.slow
def test_instants_are_found():
    """A step begins at the touch and at the departure, to the given tolerance; departures converge with the steps."""

    def instants(dt, tolerance=1e-4):
        bar = Bar(50, v=-10.0)
        force = bar.run(dt, 1.5, event_tolerance=tolerance)
        touch = [s for s in bar.steps if s.touched]
        leave = [k for k, s in enumerate(bar.steps) if s.left]
        assert [s.touched for s in touch] == [("wall",)] and [bar.steps[k].left for k in leave] == [("wall",)]
        # before it next to nothing is left of the pressure of 300
        assert abs(force[leave[0] - 1, 1]) < 1e-4 * 300
        return bar, touch[0].start, bar.steps[leave[0]].start

    bar, touch, coarse = instants(0.02)
    assert abs(touch - 0.5) < 2e-6 and abs(coarse - instants(0.02, 1e-6)[2]) < 3e-6
    middle, fine = (instants(dt)[2] for dt in (0.01, 0.005))
    # to the first order: half of the way each time, to the departure of the bar of 50 elements
    assert (coarse - middle) / (middle - fine) == pytest.approx(2.0, rel=0.05)
    assert fine - (middle - fine) == pytest.approx(7 / 6, abs=0.01)
    # the grid of the steps continues as if nothing had been
    assert np.isclose(bar.steps[-1].time, 1.5, rtol=1e-14)
    grid = [s.time for s in bar.steps if abs(s.time / 0.02 - round(s.time / 0.02)) < 1e-9]
    assert len(grid) == 75


# ---------------------------------------------------------------------------------------------- tunnelling


@pytest.mark.parametrize("cfl", [5.0, 100.0])
@pytest.mark.parametrize("events", [None, 1e-3])
def test_opening_contacts_give_no_energy(cfl, events):
    """However long the steps, a bar does not leave the wall with more energy than it came with: they are cut where it would."""
    bar = Bar(n=16, gap=0.3, v=-1.0)
    dt = cfl * 10.0 / 16 / 30.0
    bar.run(dt, 0.3 + max(1.0, 6 * dt), event_tolerance=events)
    energies = np.array([row.kinetic + row.stored for row in bar.book.rows])
    assert any(step.left for step in bar.steps) and energies.max() <= 5.0 * (1 + 1e-9)
    assert cfl < 100 or any(step.cuts > 3 for step in bar.steps)


def bullet(comm=COMM, size=0.05):
    """A small block that flies with velocity 100 towards a thin plate that is held at its ends."""
    plate = box("quadrilateral", [-1.0, -0.1], [1.0, 0.0], [20, 2])
    block = box("quadrilateral", [0.013, 1.0], [0.013 + size, 1.0 + size], [4, 4])
    s = scene(comm, "quadrilateral", [plate, block])
    V = compat.function_space(s.mesh, 1, (2,))
    u, w, velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
    X = V.tabulate_dof_coordinates()
    velocity.x.array.reshape(-1, 2)[:, 1] = np.where(X[: len(velocity.x.array) // 2, 1] > 0.5, -100.0, 0.0)
    surface = s.tag("plate", 0, lambda x: np.isclose(x[:, 1], 0.0) | np.isclose(x[:, 1], -0.1))
    ends = s.tag("ends", 0, lambda x: np.isclose(np.abs(x[:, 0]), 1.0))
    contact = uem.Contact(s.tag("tip", 1, at(1, 1.0)), surface)
    material = uem.StVenantKirchhoff(1e6, 0.3, kind="plane_strain")
    problem = uem.UnitedProblem(
        material.residual(u, w) * ufl.dx, u, bcs=clamp(V, ends), contacts=[contact],
        dynamics=uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=velocity),
    )  # fmt: skip
    return problem, contact, X


@pytest.mark.slow
def test_no_step_jumps_through_a_plate():
    """A step of ten times the plate's thickness would end behind it; it is shortened until the block is stopped."""
    problem, contact, X = bullet()
    lowest, cuts, touched = 0.0, 0, False
    for step in uem.time_steps(problem, 0.02, 0.06):
        cuts += step.cuts
        touched |= bool(step.touched)
        block = X[: problem.config.n_owned, 1] > 0.5
        y = problem.config.x[: problem.config.n_owned, 1][block]
        lowest = min(COMM.allgather(float(y.min(initial=np.inf))) + [lowest])
    assert touched and cuts > 0
    assert lowest > -0.5


def test_a_blow_that_no_step_resolves_is_named(monkeypatch):
    """Where steps may not be shortened far enough the error says what is wrong with them, and the last good state is kept."""
    from uem_dolfinx.solve import step_control

    monkeypatch.setattr(step_control, "SHORTEST_LENGTH", 0.9)
    problem, contact, _ = bullet()
    with pytest.raises(uem.EnergyGivenError, match="contacts give the bodies .* of energy within a step of 0.02"):
        list(uem.time_steps(problem, 0.02, 0.06))
    assert problem.dynamics.time == pytest.approx(0.02) and np.array_equal(problem.u.x.array, problem.committed)


# ---------------------------------------------------------------------------------------------- ranks, and what is refused


@pytest.mark.long
def test_ranks_see_the_same_motion():
    """Positions and forces of two colliding bodies on all ranks, and on one alone."""
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        low = box("quadrilateral", [0.0, 0.0], [2.0, 1.0], [8, 4])
        high = box("quadrilateral", [0.43, 1.1], [1.27, 1.9], [5, 5])
        s = scene(comm, "quadrilateral", [low, high])
        V = compat.function_space(s.mesh, 1, (2,))
        u, w = fem.Function(V), ufl.TestFunction(V)
        material = uem.StVenantKirchhoff(100.0, 0.3, kind="plane_strain")
        contact = uem.Contact(s.tag("tip", 1, at(1, 1.1)), s.tag("top", 0, at(1, 1.0)))
        dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=(0.0, 0.0), gravity=(0.2, -10.0))
        problem = uem.UnitedProblem(
            material.residual(u, w) * ufl.dx, u, bcs=clamp(V, s.tag("base", 0, at(1, 0.0))), contacts=[contact],
            dynamics=dynamics, rtol=1e-11,
        )  # fmt: skip
        rows = [[*contact.resultant().force, *dynamics.momentum()] for _ in uem.time_steps(problem, 0.01, 0.25)]
        found.append(np.array(rows))
    assert found[0][:, 1].max() > 1.0
    assert np.allclose(*found, rtol=1e-7, atol=1e-7 * np.abs(found[1]).max())


def test_momentum_is_kept_to_rounding():
    """Two free blocks meet off centre and turn: solves in motion are exact, or what each leaves would add up."""
    s = scene(
        COMM,
        "quadrilateral",
        [box("quadrilateral", [0.0, 0.0], [2.0, 1.0], [8, 4]), box("quadrilateral", [1.3, 1.02], [2.3, 2.0], [5, 5])],
    )
    V = compat.function_space(s.mesh, 1, (2,))
    u, w, velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
    velocity.x.array.reshape(-1, 2)[np.unique(compat.cell_dofs(V)[s.body == 1])] = -0.2, -1.0
    contact = uem.Contact(s.tag("tip", 1, at(1, 1.02)), s.tag("top", 0, at(1, 1.0)))
    dynamics = uem.Dynamics(uem.consistent_mass(V, 1.0), velocity=velocity)
    law = uem.LinearElastic(100.0, 0.3, kind="plane_strain")
    problem = uem.UnitedProblem(law.residual(u, w) * ufl.dx, u, contacts=[contact], dynamics=dynamics)
    before, impulse, several = dynamics.momentum(), 0.0, 0
    for step in uem.time_steps(problem, 0.01, 0.2):
        impulse, several = impulse + contact.resultant().force[1], several + (step.newton_iterations > 1)
        assert np.abs(dynamics.momentum() - before).max() <= 1e-13 * np.abs(before).max()
    assert impulse > 0 and several > 2


def test_statics_has_no_mass():
    bar = Bar(10, wall=False, held=True)
    static = uem.UnitedProblem(
        uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(bar.u, ufl.TestFunction(bar.V)) * ufl.dx, bar.u,
        bcs=clamp(bar.V, bar.tip),
    )  # fmt: skip
    with pytest.raises(uem.SpaceError, match="time steps need inertia"):
        next(uem.time_steps(static, 0.1, 1.0))
    with pytest.raises(uem.SpaceError, match="EnergyBook needs inertia"):
        uem.EnergyBook(static)


def test_a_failed_step_leaves_the_committed_state():
    """Displacement, velocity, time, forces and residual are those of the last step that converged."""
    bar = Bar(20, gap=0.5, v=-2.0, law=uem.StVenantKirchhoff, gravity=(0.0, -10.0))
    bar.run(0.01, 0.3)
    problem, dynamics = bar.problem, bar.dynamics
    problem.bodies.assemble()
    before = [np.array(x) for x in (bar.u.x.array, dynamics.velocity.x.array, problem.bodies.residual.array_r)]
    force, time = bar.contact.resultant().force, dynamics.time
    # no step of any length converges without an iteration
    vars(problem)["max_iterations"] = 0
    with pytest.raises(uem.ConvergenceError):
        next(uem.time_steps(problem, 0.01, 0.35))
    problem.bodies.assemble()
    after = (bar.u.x.array, dynamics.velocity.x.array, problem.bodies.residual.array_r)
    assert all(np.array_equal(a, b) for a, b in zip(before, after))
    assert dynamics.time == time and np.array_equal(bar.contact.resultant().force, force)
    problem.max_iterations = 50
    assert bar.run(0.01, 0.35)[-1, 1] > 50


def test_prescribed_motion_in_time():
    """A bar that is shaken at its foot: the supports do the work, and the book closes."""
    bar = Bar(20, gap=0.0, v=0.0, wall=False, held=True)
    foot = fem.Function(bar.V)
    bcs = [fem.dirichletbc(foot, fem.locate_dofs_topological(bar.V, 1, bar.tip.entities))]

    def load(time):
        foot.x.array[1::2] = 0.1 * (1 - np.cos(2 * np.pi * time))

    dynamics = uem.Dynamics(uem.lumped_mass(bar.V, 1.0))
    material = uem.LinearElastic(900.0, 0.0, kind="plane_stress")
    F = material.residual(bar.u, ufl.TestFunction(bar.V)) * ufl.dx
    problem = uem.UnitedProblem(F, bar.u, bcs=bcs, dynamics=dynamics, load=load)
    book = uem.EnergyBook(problem, material.energy(bar.u) * ufl.dx)
    for _ in uem.time_steps(problem, 0.01, 0.5):
        book.write()
    at_foot = bar.u.x.array.reshape(-1, 2)[fem.locate_dofs_topological(bar.V, 1, bar.tip.entities), 1]
    assert np.allclose(at_foot, 0.2, rtol=1e-12)
    row = book.rows[-1]
    assert row.external > 0.1 and abs(row.defect) < 1e-9 * max(r.kinetic for r in book.rows)


def test_what_is_refused():
    bar = Bar(4)
    with pytest.raises(ValueError, match="contactors = 'none'"):
        uem.Dynamics(bar.dynamics.mass, contactors="none")
    for wrong in ({"dt": 0.0}, {"dt": np.inf}, {"dt": np.nan}, {"end": np.nan}, {"end": np.inf}, {"event_tolerance": 2.0}):
        with pytest.raises(
            ValueError, match="= (0.0|inf|nan|2.0): expected a (positive number|time that|number between 0 and 1)"
        ):
            next(uem.time_steps(bar.problem, **({"dt": 0.1, "end": 1.0} | wrong)))
    with pytest.raises(uem.SpaceError, match="make the mass with the function space"):
        Bar(4, mass=lambda V, rho: uem.lumped_mass(Bar(5).V, rho))
    with pytest.raises(uem.InputError, match="velocity = .* is not finite: expected 2 finite numbers"):
        Bar(4, v=np.nan)
    with pytest.raises(ValueError, match="gravity"):
        Bar(4, gravity=(1.0,))


@pytest.mark.slow
def test_a_body_without_mass_is_held_by_others():
    """A massless block between a heavy one and the ground is a spring: the heavy one swings on it with a known frequency."""
    low = box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [4, 4])
    high = box("quadrilateral", [0.0, 1.0], [1.0, 2.0], [2, 2])
    s = scene(COMM, "quadrilateral", [low, high])
    V = compat.function_space(s.mesh, 1, (2,))
    u, w = fem.Function(V), ufl.TestFunction(V)
    density, E = (fem.Function(compat.function_space(s.mesh, ("DG", 0))) for _ in range(2))
    middle = compat.function_space(s.mesh, ("DG", 0)).tabulate_dof_coordinates()[:, 1]
    density.x.array[:] = np.where(middle[: len(density.x.array)] > 1, 1.0, 0.0)
    E.x.array[:] = np.where(middle[: len(density.x.array)] > 1, 1e6, 100.0)
    contact = uem.Contact(s.tag("tip", 0, at(1, 1.0)), s.tag("bottom", 1, at(1, 1.0)))
    dynamics = uem.Dynamics(uem.lumped_mass(V, density), velocity=(0.0, -1.0))
    F = uem.LinearElastic(E, 0.0, kind="plane_stress").residual(u, w) * ufl.dx
    problem = uem.UnitedProblem(F, u, bcs=clamp(V, s.tag("base", 0, at(1, 0.0))), contacts=[contact], dynamics=dynamics)
    f = np.array([(step.time, contact.resultant(on="target").force[1]) for step in uem.time_steps(problem, 0.002, 0.25)])
    # a quarter of a swing, while the spring is pressed
    assert np.allclose(f[:, 1], 10.0 * np.sin(10.0 * f[:, 0]), atol=0.02)
