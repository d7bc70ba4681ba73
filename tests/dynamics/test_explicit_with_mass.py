"""Central differences for contactors that keep their mass: waves, momentum, friction, general contact, what is lost in impacts."""

from __future__ import annotations

import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.dynamics.explicit.part_solver import MassSolver, PartSolver, SurfaceSolver
from uem_dolfinx.parallel import reduced

COMM = MPI.COMM_WORLD
C, LENGTH = 30.0, 10.0
SHAPES = {2: "quadrilateral", 3: "hexahedron"}


def bars(dim=2, cells=40, speed=1.0, gap=0.05, lower=False, general=False, coupling="node_to_surface", degree=1, wide=1):
    """Bars of density 1 that fly down onto a wall at 0, or onto a second bar in flight; the problem and the contact."""
    across = [1.0] * (dim - 1)
    starts = [-LENGTH, gap] if lower else [gap]
    parts = [
        box(SHAPES[dim], [*[0.0] * (dim - 1), y], [*across, y + LENGTH], [*[wide + k] * (dim - 1), cells])
        for k, y in enumerate(starts)
    ]
    s = scene(COMM, SHAPES[dim], parts)
    V = compat.function_space(s.mesh, degree, (dim,))
    u, v, velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
    upper = V.tabulate_dof_coordinates()[:, dim - 1] > 0.5 * gap
    velocity.x.array.reshape(-1, dim)[upper, dim - 1] = -speed
    law = uem.LinearElastic(C**2, 0.0, kind="plane_stress" if dim == 2 else "3d")
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=velocity, scheme=uem.CentralDifferences(), contactors="massy")
    plane = uem.RigidPlane(np.zeros(dim), np.eye(dim)[-1])
    top = plane if not lower else s.tag("top", 0, at(dim - 1, 0.0))
    contact = uem.Contact(s.tag("bottom", len(starts) - 1, at(dim - 1, gap)), top, coupling=coupling)
    if general:
        contact = uem.GeneralContact(rigid=[] if lower else [plane])
    problem = uem.UnitedProblem(law.residual(u, v) * ufl.dx, u, contacts=[contact], dynamics=dynamics, rtol=1e-10)
    return problem, contact, law.energy(u) * ufl.dx


@pytest.mark.parametrize(
    "how",
    [{}, {"general": True}, {"coupling": "mortar"}, {"dim": 3, "cells": 20}, {"dim": 3, "cells": 20, "general": True}],
    ids=str,
)
def test_a_bar_on_a_wall(how):
    """The wall feels rho c v for the time 2 L / c, and energy is lost with the mass of the surface alone."""
    problem, _, stored = bars(**how)
    book, rows = uem.EnergyBook(problem, stored), []
    for step in uem.time_steps(problem, end=0.05 + 2 * LENGTH / C + 0.1):
        row = book.write(step)
        rows.append((step.time, row.kinetic + row.stored, book.momenta[-1][-1]))
    t, energy, momentum = np.array(rows).T
    force = -np.gradient(-momentum, t)
    plateau = force[(t > 0.15) & (t < 0.65)]
    cell = LENGTH / how.get("cells", 40)
    assert abs(plateau.mean() / C - 1) < 0.02
    on = t[force > 0.3 * C]
    assert abs(on[0] - 0.05) < 2 * cell / C and abs(on[-1] - 0.05 - 2 * LENGTH / C) < 3 * cell / C
    # half a cell of mass stops at the wall
    lost = 1.0 - energy[-1] / book.rows[0].kinetic
    assert 0.0 <= lost < 1.3 * 0.5 * cell / LENGTH
    # which is work of contact, but for what central differences keep of the vibration within a step
    assert max(abs(row.defect) for row in book.rows) < 0.5 * 0.5 * cell / LENGTH * book.rows[0].kinetic


@pytest.mark.slow
@pytest.mark.parametrize("dt", [None, 2e-3], ids=["longest", "given"])
@pytest.mark.parametrize("how", [{}, {"lower": True, "general": True}], ids=str)
def test_rows_of_an_energy_book_that_leaves_steps_out(how, dt):
    """Its rows have the work of contact in all steps, as of a book with a row for each, and the impulse of steps with rows at both ends."""
    problem, _, stored = bars(cells=10, **how)
    books = every, some, ends = [uem.EnergyBook(problem, stored) for _ in range(3)]
    before, struck = None, 0.0
    for step in uem.time_steps(problem, dt, end=0.2):
        for book in books[: 1 if step.number % 4 == 2 else 2]:
            book.write(step)
        if step.number % 4 == 2:
            continue
        energy = every.rows[0].kinetic
        assert abs(some.rows[-1].contact - every.rows[-1].contact) < 1e-12 * energy
        if before == step.number - 1:
            pushed = [b.impulses[-1] - b.impulses[-2] for b in books[:2]]
            np.testing.assert_allclose(pushed[0], pushed[1], rtol=1e-12, atol=1e-12 * np.abs(every.momenta[0]).max())
            struck += np.abs(pushed[0]).max()
        before = step.number
    assert abs(ends.write().contact - every.write().contact) < 1e-12 * energy
    assert every.rows[-1].contact < -1e-2 * energy and struck > 0.2 * np.abs(every.impulses[-1]).max()


@pytest.mark.long
def test_what_is_lost_is_of_the_mesh():
    """Twice as many cells lose half as much energy."""
    lost = []
    for cells in (20, 40, 80):
        problem, _, stored = bars(cells=cells)
        book = uem.EnergyBook(problem, stored)
        for step in uem.time_steps(problem, end=0.8):
            row = book.write(step)
        lost.append(1.0 - (row.kinetic + row.stored) / book.rows[0].kinetic)
    assert 0.8 < np.log2(lost[0] / lost[1]) < 1.2 and 0.8 < np.log2(lost[1] / lost[2]) < 1.2, lost


@pytest.mark.long
@pytest.mark.parametrize(
    "how", [{"cells": 20}, {"cells": 20, "general": True}, {"cells": 20, "coupling": "mortar"}, {"dim": 3, "cells": 10}], ids=str
)
def test_momentum_of_two_bars(how):
    """A bar hits a bar at rest: momentum stays to rounding, and they exchange their velocities."""
    problem, _, stored = bars(lower=True, **how)
    book = uem.EnergyBook(problem, stored)
    for step in uem.time_steps(problem, end=0.05 + 2 * LENGTH / C + 0.2):
        book.write(step)
    momenta = np.array(book.momenta)[:, -1]
    assert np.abs(momenta / momenta[0] - 1).max() < 1e-9
    config, dynamics = problem.config, problem.dynamics
    v = dynamics.velocity.x.array.reshape(-1, config.gdim)[: config.n_owned, -1]
    m = dynamics.mass.of_nodes[:, -1]
    upper = config.X[: config.n_owned, -1] > 0.025
    sums = [reduced(COMM, float(of.sum())) for of in (m[upper] * v[upper], m[~upper] * v[~upper])]
    assert abs(sums[0]) < 0.05 * LENGTH and abs(sums[1] + LENGTH) < 0.05 * LENGTH


def disc(middle):
    """A disc of radius 1 in 6 x 6 cells."""

    def onto(x):
        return np.column_stack([x[:, 0] * np.sqrt(1 - x[:, 1] ** 2 / 2), x[:, 1] * np.sqrt(1 - x[:, 0] ** 2 / 2)]) + middle

    return box("quadrilateral", [-1.0, -1.0], [1.0, 1.0], [6, 6]).mapped(onto)


@pytest.mark.parametrize("how", [{"dim": 2}, {"dim": 2, "coupling": "mortar"}, {"dim": 3, "cells": 10}], ids=str)
def test_united_masses(how):
    """The solution of P'MP is that of a factorisation of all unknowns, on any ranks; G and a Q of its own as well."""
    problem, contact, _ = bars(lower=True, wide=2, gap=0.0, **how)
    problem.contacts[0].pair.activate_touching()
    space, rows = problem.config.unknowns, problem.system._rows()
    P, M = rows.test, problem.bodies.update_tangent().copy()
    M.zeroEntries()
    assert rows.test.n_equations > 0
    wave = space.vector(1.0 + np.random.default_rng(3 + COMM.rank).random(space.block * space.n_owned))
    M.setDiagonal(wave)
    M.assemble()
    for G in (None, M):
        found, expected = MassSolver(space, "masses_"), UnitedSolver(space, "all_", {"ksp_type": "preonly", "pc_type": "lu"})
        rhs = P.transpose(space.vector(wave.array_r**2))
        for solver in (found, expected):
            solver.set_operator(P, M, G)
        one, other = (P.expand(solver.complete(solver.solve(rhs)[0])) for solver in (found, expected))
        assert (one - other).norm() <= 1e-10 * other.norm()


@pytest.mark.parametrize("how", [{"dim": 2}, {"dim": 2, "coupling": "mortar"}, {"dim": 3, "cells": 10}], ids=str)
def test_a_surface_alone(how):
    """With only a few nodes free, the solution of P'KP is that of a factorisation of all unknowns, on any ranks; with G as well."""
    problem, contact, _ = bars(lower=True, wide=2, gap=0.0, **how)
    problem.contacts[0].pair.activate_touching()
    bodies, space = problem.bodies, problem.config.unknowns
    K, contactors = bodies.update_tangent(), problem.config.of(np.zeros(len(bodies.held), bool))
    contactors[problem.contacts[0].pair.nodes] = contactors[problem.contacts[0].pair.discretisation.followed] = True
    with bodies.holding(bodies.of_owners(~contactors.ravel())):
        P = problem.system._rows().test
        assert P.n_equations > 0
        wave = space.vector(1.0 + np.random.default_rng(3 + COMM.rank).random(space.block * space.n_owned))
        for G in (None, K):
            found, expected = (
                SurfaceSolver(space, "surface_"),
                UnitedSolver(space, "all_", {"ksp_type": "preonly", "pc_type": "lu"}),
            )
            for solver in (found, expected):
                solver.set_operator(P, K, G)
            one, other = (P.expand(solver.complete(solver.solve(P.transpose(wave))[0])) for solver in (found, expected))
            assert (one - other).norm() <= 1e-10 * other.norm()


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_discs_that_collide_off_centre(friction):
    """Momentum stays to rounding, moment of momentum to the arc's facets, and energy is lost with the mass of a few nodes alone."""
    s = scene(COMM, "quadrilateral", [disc((0.0, 0.0)), disc((0.3, 2.0))])
    V = compat.function_space(s.mesh, 1, (2,))
    u, v, velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
    velocity.x.array.reshape(-1, 2)[V.tabulate_dof_coordinates()[:, 1] > 1.0, 1] = -1.0
    law = uem.StVenantKirchhoff(1e3, 0.3, kind="plane_strain")
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=velocity, scheme=uem.CentralDifferences(), contactors="massy")
    contact = uem.GeneralContact(friction=friction)
    problem = uem.UnitedProblem(law.residual(u, v) * ufl.dx, u, contacts=[contact], dynamics=dynamics)
    book, config = uem.EnergyBook(problem, law.energy(u) * ufl.dx), problem.config
    m, own, spins = dynamics.mass.of_nodes, slice(config.n_owned), []

    def spin():
        p = m * dynamics.velocity.x.array.reshape(-1, 2)[own]
        return reduced(COMM, float((config.x[own, 0] * p[:, 1] - config.x[own, 1] * p[:, 0]).sum()))

    first, touched = spin(), 0
    for step in uem.time_steps(problem, end=0.4):
        book.write(step)
        spins.append(spin())
        touched = max(touched, contact.n_active)
    momenta, last = np.array(book.momenta), book.rows[-1]
    assert touched > 1 and contact.n_active == 0
    assert np.abs(momenta - momenta[0]).max() < 1e-9 * abs(momenta[0, 1])
    assert np.abs(np.array(spins) / first - 1.0).max() < 5e-3
    assert 0.0 < 1.0 - (last.kinetic + last.stored) / book.rows[0].kinetic < 0.02


@pytest.mark.long
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_a_block_slides_to_rest(coupling):
    """Friction stops a block with mu g, in closed form, and holds it."""
    mu, g, speed = 0.3, 10.0, 1.0
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 0.2], [3, 1])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    law = uem.LinearElastic(1e3, 0.0, kind="plane_stress")
    contact = uem.Contact(
        s.tag("foot", 0, at(1, 0.0)), uem.RigidPlane(np.zeros(2), np.array([0.0, 1.0])), friction=mu, coupling=coupling
    )
    dynamics = uem.Dynamics(
        uem.lumped_mass(V, 1.0), velocity=(speed, 0.0), gravity=(0.0, -g), scheme=uem.CentralDifferences(), contactors="massy"
    )
    problem = uem.UnitedProblem(law.residual(u, v) * ufl.dx, u, contacts=[contact], dynamics=dynamics)
    for step in uem.time_steps(problem, end=1.1 * speed / (mu * g)):
        pass
    way = speed**2 / (2 * mu * g)
    m, own = dynamics.mass.of_nodes[:, 0], slice(problem.config.n_owned)
    mean = reduced(COMM, float((m * u.x.array.reshape(-1, 2)[own, 0]).sum())) / reduced(COMM, float(m.sum()))
    assert abs(mean / way - 1) < 0.02


def test_massless_nodes_are_refused():
    """Free nodes without mass cannot be moved."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [2, 2]),
                                      box("quadrilateral", [0.0, 2.0], [1.0, 3.0], [2, 2])])  # fmt: skip
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    x = ufl.SpatialCoordinate(s.mesh)
    mass = uem.lumped_mass(V, ufl.conditional(ufl.lt(x[1], 1.5), 0.0, 1.0))
    form = uem.LinearElastic(1.0, 0.0, kind="plane_stress").residual(u, v) * ufl.dx
    problem = uem.UnitedProblem(form, u, dynamics=uem.Dynamics(mass, scheme=uem.CentralDifferences(), contactors="massy"))
    with pytest.raises(uem.MassError, match="have no mass"):
        next(uem.time_steps(problem, end=1.0))


@pytest.mark.parametrize(
    ("how", "factors", "calls"), [({}, 0, 3000), ({"general": True}, 0, np.inf), ({"lower": True}, 1, np.inf)]
)
def test_a_step_in_lasting_contact(monkeypatch, how, factors, calls):
    """On a wall the last equations predict a step: no iteration, no factorisation, 3,000 calls. On a bar one factor serves a step."""
    problem, _, _ = bars(3, cells=10, gap=0.0, **how)
    made, called, factorise = [], [], PartSolver._factorise
    monkeypatch.setattr(PartSolver, "_factorise", lambda self, *a: made.append(1) or factorise(self, *a))
    steps = uem.time_steps(problem, end=0.5)
    while next(steps).time < 0.15:
        pass
    made.clear()
    sys.setprofile(lambda frame, event, arg: called.append(1) if event in ("call", "c_call") else None)
    try:
        taken = [next(steps).newton_iterations for _ in range(5)]
    finally:
        sys.setprofile(None)
    assert len(made) <= 5 * factors and (max(taken) == 0) == (factors == 0)
    # ranks exchange in more of them
    assert len(called) <= 5 * calls or COMM.size > 1


@pytest.mark.long
@pytest.mark.parametrize("lower", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_velocities_at_rest(lower):
    """Bodies that lie on a floor, or on each other, do not fall at the end of a step, by gravity times half a step or otherwise."""
    g = 10.0
    boxes = [box("quadrilateral", [0.0, float(y)], [1.0, y + 1.0], [3 - y, 2]) for y in range(2 if lower else 1)]
    s = scene(COMM, "quadrilateral", boxes)
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    law, eta = uem.LinearElastic(1e4, 0.0, kind="plane_stress"), 60.0
    contacts = [uem.Contact(s.tag("foot", 0, at(1, 0.0)), uem.RigidPlane(np.zeros(2), np.array([0.0, 1.0])))]
    if lower:
        contacts.append(uem.Contact(s.tag("upper", 1, at(1, 1.0)), s.tag("top", 0, at(1, 1.0))))
    dynamics = uem.Dynamics(
        uem.lumped_mass(V, 1.0), gravity=(0.0, -g), scheme=uem.CentralDifferences(), contactors="massy",
        damping=lambda rate: eta * ufl.inner(ufl.grad(rate), ufl.grad(v)) * ufl.dx,
    )  # fmt: skip
    problem = uem.UnitedProblem(law.residual(u, v) * ufl.dx, u, contacts=contacts, dynamics=dynamics)
    for step in uem.time_steps(problem, end=0.6 if lower else 0.2):
        pass
    fastest = reduced(COMM, float(np.abs(dynamics.velocity.x.array).max()), op=MPI.MAX)
    assert fastest < 1e-2 * 0.5 * step.dt * g
    weight = g * len(boxes)
    assert abs(contacts[0].resultant().force[1] / weight - 1.0) < 1e-3


def test_a_run_that_is_continued_is_the_same(tmp_path):
    """Two bars in contact, continued from a checkpoint of another run: the same steps, displacement and velocity to rounding."""
    path = COMM.bcast(str(tmp_path / "kept"))
    (whole, _, _), (first, _, _), (again, _, _) = (bars(cells=12, lower=True) for _ in range(3))
    lengths = [step.dt for step in uem.time_steps(whole, end=0.5)]
    steps = uem.time_steps(first, end=0.5, checkpoint=uem.Checkpoint(path, every=5))
    while next(steps).number < 12:
        pass
    steps.close()
    later = [step.dt for step in uem.time_steps(again, end=0.5, checkpoint=uem.Checkpoint(path, every=5))]
    assert 0 < len(later) < len(lengths) and later == lengths[-len(later) :]
    # of displacements and velocities of size 1
    assert np.allclose(again.u.x.array, whole.u.x.array, rtol=0, atol=1e-14)
    assert np.allclose(again.dynamics.velocity.x.array, whole.dynamics.velocity.x.array, rtol=0, atol=1e-12)


def ring(speed=0.6):
    """A rubber ring that is thrown onto a floor, where it folds and touches itself; the problem, the contact and the energy."""
    mesh, _ = uem.read_gmsh(Path(uem.__file__).parent / "meshes/ring.geo", COMM, gdim=2, parameters={"n": 32, "layers": 1})
    V = uem.function_space(mesh, 1, (2,))
    u, rubber = fem.Function(V), uem.NeoHooke(1.0, 0.3, kind="plane_strain")
    contact = uem.GeneralContact(rigid=[uem.RigidPlane((0.0, -1.05), (0.0, 1.0))], friction=0.3)
    mass, scheme = uem.lumped_mass(V, 1.0), uem.CentralDifferences()
    dynamics = uem.Dynamics(mass, velocity=(0.3 * speed, -speed), scheme=scheme, contactors="massy")
    F = rubber.residual(u, ufl.TestFunction(V)) * ufl.dx
    return uem.UnitedProblem(F, u, contacts=[contact], dynamics=dynamics), contact, rubber.energy(u) * ufl.dx


@pytest.mark.slow
@pytest.mark.parametrize("speed", [0.8, 0.9, 1.1, 1.2])
def test_rings_at_the_speed_of_waves(speed):
    """A ring does not gain energy while its cells collapse, which may end the run."""
    problem, _, stored = ring(speed)
    book, ends = uem.EnergyBook(problem, stored), False
    try:
        for step in uem.time_steps(problem, end=3.0):
            book.write(step)
    except uem.InvertedElementError:
        ends = True
    assert book.rows[-1].contact < -0.1 * book.rows[0].kinetic and ends == (speed > 1.0)
    defects = np.array([row.defect for row in book.rows]) / book.rows[0].kinetic
    # the first step of contact takes what central differences keep of the vibration within a step
    assert defects.min() > -1e-2 and defects.max() < 1e-3


@pytest.mark.slow
def test_a_ring_that_folds(tmp_path):
    """A rubber ring is thrown onto a floor, where it folds and touches itself, in steps that change.

    The floor's impulses are its change of momentum to rounding, energy is conserved, and a run continued from a checkpoint is the same.
    """

    problem, contact, stored = ring()
    n, m = problem.config.n_owned, problem.dynamics.mass.of_nodes
    book, impulse, lengths, errors, inside = uem.EnergyBook(problem, stored), np.zeros(2), [], [], 0
    start = reduced(COMM, m.sum(axis=0)) * [0.3 * 0.6, -0.6]
    for step in uem.time_steps(problem, end=4.0):
        book.write(step)
        lengths.append(step.dt)
        force = contact.force.x.array[: 2 * n].reshape(-1, 2)
        impulse += step.dt * reduced(COMM, force.sum(axis=0))
        momentum = reduced(COMM, (m * problem.dynamics.mean_velocity.x.array[: 2 * n].reshape(-1, 2)).sum(axis=0))
        errors.append(np.abs(momentum - start - impulse).max())
        inside += reduced(COMM, int(force[np.linalg.norm(problem.config.X[:n], axis=1) < 0.75].any()))
    assert inside > 0 and max(lengths) > 2.0 * min(lengths)
    assert max(errors) < 1e-12 * np.abs(start).max()
    assert max(abs(row.defect) for row in book.rows) < 5e-3 * book.rows[0].kinetic
    path, again = COMM.bcast(str(tmp_path / "run.h5")), []
    for stop in (len(lengths) // 2, np.inf):
        other = ring()[0]
        for step in uem.time_steps(other, end=4.0, checkpoint=uem.Checkpoint(path, every=7)):
            again.append(step.dt)
            if step.number >= stop:
                break
    assert again == lengths
    assert reduced(COMM, float(np.abs(other.u.x.array - problem.u.x.array).max(initial=0.0)), op=MPI.MAX) == 0.0
