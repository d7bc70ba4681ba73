"""Central differences for bodies that yield: the plastic wave in closed form, steps that follow flattened cells, restart."""

from __future__ import annotations

from resource import RUSAGE_SELF, getrusage

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, raised, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.dynamics.explicit.stepper import ExplicitStepper
from uem_dolfinx.parallel import reduced

COMM = MPI.COMM_WORLD
E, NU, Y, H, LENGTH = 900.0, 0.3, 2.0, 60.0, 10.0
G = E / (2 * (1 + NU))
BULK = E / (3 * (1 - 2 * NU))
#: Moduli of uniaxial strain, elastic and plastic, and the stress at which it yields.
ELASTIC, PLASTIC, FIRST = BULK + 4 * G / 3, BULK + 4 * G * H / (3 * (3 * G + H)), Y * (BULK + 4 * G / 3) / (2 * G)

#: Cells and laws of bars in the plane.
PLANE = [
    ("quadrilateral", "NeoHooke"), ("triangle", "NeoHooke"), ("quadrilateral", "StVenantKirchhoff"), ("triangle", "LinearElastic"),
]  # fmt: skip


class Bar:
    """A bar of density 1 that cannot expand laterally and flies with ``speed`` onto a wall; laws and kinds as in ``uem``."""

    def __init__(self, law=uem.VonMises, cells=100, speed=0.4, coupling="node_to_surface", **how):
        s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, LENGTH], [1, cells])])
        V = compat.function_space(s.mesh, 1, (2,))
        u, v = fem.Function(V), ufl.TestFunction(V)
        material = law(u, E, NU, Y, H, kind="plane_strain")
        bcs = [uem.dirichlet(V, s.tag("sides", 0, lambda x: (x[:, 0] < 1e-9) | (x[:, 0] > 1 - 1e-9)), 0)]
        self.contact = uem.Contact(
            s.tag("foot", 0, at(1, 0.0)), uem.RigidPlane(np.zeros(2), np.array([0.0, 1.0])), coupling=coupling
        )
        self.dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=(0.0, -speed), scheme=uem.CentralDifferences(), **how)
        self.problem = uem.UnitedProblem(
            material.residual(v), u, bcs=bcs, contacts=[self.contact], materials=[material], dynamics=self.dynamics
        )
        self.u, self.speed = u, speed


@pytest.mark.long
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("law", [uem.VonMises, uem.FinitePlasticity])
def test_the_plastic_wave(law, coupling):
    """The wall feels the stress of both waves, ``s_Y + rho c_p (v - v_Y)``; what has flowed is dissipated."""
    speed = 0.4 if law is uem.VonMises else 0.2
    bar, rows = Bar(law, 60 if coupling == "mortar" else 100, speed, coupling), []
    book = uem.EnergyBook(bar.problem)
    for step in uem.time_steps(bar.problem, end=0.4):
        row = book.write(step)
        rows.append((step.time, bar.contact.resultant().force[1], row.defect / book.rows[0].kinetic))
    t, force, defect = np.array(rows).T
    v_first = FIRST / np.sqrt(ELASTIC)
    assert speed > 1.9 * v_first
    exact = FIRST + np.sqrt(PLASTIC) * (speed - v_first)
    plateau = force[(t > 0.15) & (t < 0.39)]
    assert abs(plateau.mean() / exact - 1) < 0.02
    # without flow the force would be that of elastic waves
    assert exact < 0.95 * np.sqrt(ELASTIC) * speed
    assert book.rows[-1].dissipated > 0.05 * book.rows[0].kinetic and np.abs(defect).max() < 0.02


def test_cells_that_are_flattened():
    """The critical step is found anew before a cell is flattened by a tenth since then; cells at rest are looked at as rarely as may be."""
    bar = Bar(speed=0.0)
    stepper, X = ExplicitStepper(bar.problem), bar.problem.config.X
    u, v = (f.x.array.reshape(-1, 2) for f in (bar.u, bar.dynamics.velocity))
    stepper.look()
    assert stepper.steps_to_look(1e-3) == 50
    v[:, 1] = -7.0 * X[:, 1]
    stepper.look()
    assert stepper.steps_to_look(1e-3) == 14 and stepper.steps_to_look(1.0) == 0
    # cells are strained by 0.05, and by 0.2
    for left, steps in ((0.9535, 6), (0.845, 0)):
        u[:, 1] = (left - 1.0) * X[:, 1]
        stepper.look()
        assert (stepper.steps_to_look(1e-3), stepper.steps_to_look(1e-3, anew=True)) == (steps, int(0.1 * left / 7e-3))
    stepper.count_from(bar.u.x.array)
    stepper.look()
    assert stepper.steps_to_look(1e-3) == stepper.steps_to_look(1e-3, anew=True) == 12
    # those that are strained are not those that go on
    u[:, 1], v[:, 1] = -0.05 * np.minimum(X[:, 1], 5.0), -7.0 * np.maximum(X[:, 1] - 5.0, 0.0)
    stepper.count_from(0.0 * bar.u.x.array)
    stepper.look()
    assert stepper.steps_to_look(1e-3) == 14


def test_cells_that_collapse():
    """A run continues with cells of a five-hundredth of their height, turned by a right angle, and ends at a two-thousandth."""
    bar = Bar(speed=0.0)
    stepper, config = ExplicitStepper(bar.problem), bar.problem.config
    for left in (0.5, 2e-3, 5e-4):
        bar.u.x.array.reshape(-1, 2)[:] = np.column_stack([-left * config.X[:, 1], config.X[:, 0]]) - config.X
        if left > 1e-3:
            stepper.look()
            # cells are 1 wide, and a tenth as high
            assert stepper.shortest == pytest.approx(0.1 * left, rel=5e-3)
        else:
            raised(uem.InvertedElementError, "cells collapse", stepper.look)


@pytest.mark.long
@pytest.mark.parametrize(
    ("law", "contactors"),
    [
        ("StVenantKirchhoff", "massless"), slow("NeoHooke", "massless"), slow("StVenantKirchhoff", "massy"),
        slow("LinearElastic", "massless"),
    ],
)  # fmt: skip
def test_cells_that_turn_inside_out(law, contactors):
    """The end of a bar that is pushed into itself ends the run when its cells have no height left, in the last state without such cells."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 10.0], [1, 10])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, velocity = fem.Function(V), fem.Function(V)
    velocity.interpolate(lambda x: [0.0 * x[1], -80.0 * np.maximum(x[1] - 8.0, 0.0)])
    foot = uem.Contact(s.tag("foot", 0, at(1, 0.0)), uem.RigidPlane((0.0, 0.0), (0.0, 1.0)))
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=velocity, scheme=uem.CentralDifferences(), contactors=contactors)
    F = getattr(uem, law)(900.0, 0.0, kind="plane_strain").residual(u, ufl.TestFunction(V)) * ufl.dx
    problem = uem.UnitedProblem(F, u, contacts=[foot], dynamics=dynamics, check_inversion=True)
    with pytest.raises(uem.InvertedElementError, match="inside out|collapse"):
        for _ in uem.time_steps(problem, end=1.0):
            pass
    assert np.array_equal(u.x.array, problem.committed) and not dynamics.moving
    # elastic forces delay it
    assert 0.0 < dynamics.time < 2.0 / 80.0
    heights = np.sort(problem.config.x[problem.config.X[:, 0] < 0.5, 1])
    assert COMM.size > 1 or (np.diff(heights) > 0.0).all()


@pytest.mark.slow
def test_the_memory_of_a_run():
    """Steps leave nothing behind: their vectors would fill 100 megabytes."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [60, 60])])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    foot = uem.Contact(s.tag("foot", 0, at(1, 0.0)), uem.RigidPlane((0.0, 0.0), (0.0, 1.0)))
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=(0.0, -0.01), scheme=uem.CentralDifferences())
    F = uem.NeoHooke(1.0, 0.3, "plane_strain").residual(u, ufl.TestFunction(V)) * ufl.dx
    steps = uem.time_steps(uem.UnitedProblem(F, u, contacts=[foot], dynamics=dynamics), end=100.0)
    most = [max(next(steps).number and getrusage(RUSAGE_SELF).ru_maxrss for _ in range(n)) for n in (20, 60)]
    assert reduced(COMM, float(most[1] - most[0]), op=MPI.MAX) < 20e3


@pytest.mark.long
@pytest.mark.parametrize("contactors", ["massy", slow("massless")])
def test_rubber_at_the_speed_of_its_waves(contactors):
    """Crushed cells are strained by at most a tenth in a step, and energy neither grows nor falls."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 7.0], [1, 7])])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    rubber = uem.NeoHooke(1.0, 0.0, "plane_strain")
    foot = uem.Contact(s.tag("foot", 0, at(1, 0.0)), uem.RigidPlane((0.0, 0.0), (0.0, 1.0)))
    scheme = uem.CentralDifferences(safety=0.3)
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=(0.0, -1.0), scheme=scheme, contactors=contactors)
    problem = uem.UnitedProblem(rubber.residual(u, ufl.TestFunction(V)) * ufl.dx, u, contacts=[foot], dynamics=dynamics)
    stepper, strains, lengths = ExplicitStepper(problem), [], None
    book = uem.EnergyBook(problem, rubber.energy(u) * ufl.dx)
    for step in uem.time_steps(problem, end=1.5):
        book.write(step)
        before, lengths = lengths, stepper._slopes(np.array(problem.config.x.T))[1, 1]
        if step.number > 5:
            strains.append(float(np.abs(lengths / before - 1).max(initial=0.0)))
    strain = COMM.allreduce(max(strains), op=MPI.MAX)
    assert 0.03 < strain < 0.11
    assert max(abs(row.defect) for row in book.rows) < 2e-3 * book.rows[0].kinetic


@pytest.mark.slow
def test_the_memory_of_critical_steps():
    """On several ranks, too, factors of critical steps go when others are made: 40 of them would fill 15 megabytes."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [300, 6])])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    foot = uem.Contact(s.tag("foot", 0, at(1, 0.0)), uem.RigidPlane((0.0, 0.0), (0.0, 1.0)))
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=(0.0, -0.01), scheme=uem.CentralDifferences())
    F = uem.NeoHooke(1.0, 0.3, "plane_strain").residual(u, ufl.TestFunction(V)) * ufl.dx
    stepper, most = ExplicitStepper(uem.UnitedProblem(F, u, contacts=[foot], dynamics=dynamics)), []
    stepper.begin()
    for n in (5, 40):
        for _ in range(n):
            # as of another state
            stepper.system.solver._made_of = stepper.system.solver._read_for = None
            stepper.critical_step()
        most.append(getrusage(RUSAGE_SELF).ru_maxrss)
    assert reduced(COMM, float(most[1] - most[0]), op=MPI.MAX) < 8e3


@pytest.mark.slow
@pytest.mark.parametrize("contactors", ["massy", "massless"])
@pytest.mark.parametrize(
    ("cell", "law", "speed"),
    [
        *((*one, speed) for one in PLANE for speed in (0.5, 1.0, 1.2)),
        ("hexahedron", "NeoHooke", 1.0),
        ("tetrahedron", "NeoHooke", 1.0),
    ],
)
def test_energy_at_the_speed_of_waves(cell, law, speed, contactors):
    """A bar that is crushed at a wall does not gain energy, also while its cells collapse between their vertices, which ends the run."""
    gdim, across, kind = (2, [2.0], "plane_strain") if (cell, law) in PLANE else (3, [1.0, 1.0], "3d")
    up = np.eye(gdim)[-1]
    s = scene(COMM, cell, [box(cell, [*[0.0] * len(across), 0.1], [*across, 7.1], [*[2] * len(across), 14])])
    V = compat.function_space(s.mesh, 1, (gdim,))
    u, body = fem.Function(V), getattr(uem, law)(1.0, 0.3, kind)
    foot = uem.Contact(s.tag("foot", 0, at(gdim - 1, 0.1)), uem.RigidPlane(0.0 * up, up))
    mass, scheme = uem.lumped_mass(V, 1.0), uem.CentralDifferences()
    dynamics = uem.Dynamics(mass, velocity=-speed * up, scheme=scheme, contactors=contactors)
    problem = uem.UnitedProblem(body.residual(u, ufl.TestFunction(V)) * ufl.dx, u, contacts=[foot], dynamics=dynamics)
    book, collapsed = uem.EnergyBook(problem, body.energy(u) * ufl.dx), False
    try:
        for step in uem.time_steps(problem, end=4.0):
            book.write(step)
    except uem.InvertedElementError:
        collapsed = True
    assert not collapsed or law != "LinearElastic"
    defects = np.array([row.defect for row in book.rows]) / book.rows[0].kinetic
    # central differences keep so much of the vibration within a step, of the row of cells at the wall
    within = 0.5 * 0.5 / 14
    assert -within < defects.min() and defects.max() < (3e-3 if law == "NeoHooke" else within)


def test_yielded_bars_have_the_critical_step_of_unloading():
    """Points that flow are soft until they unload: the critical step is that of elastic points."""
    bar = Bar()
    elastic = ExplicitStepper(bar.problem).critical_step()
    for step in uem.time_steps(bar.problem, end=0.15):
        pass
    assert bar.problem.materials[0].peeq.x.array.max(initial=0.0) > 0 or COMM.size > 1
    assert abs(ExplicitStepper(bar.problem).critical_step() / elastic - 1) < 1e-2


@pytest.mark.long
def test_a_step_returns_stresses_once(monkeypatch):
    """A step and its row in an energy book map stresses back once, while the bar yields at the wall; supports are held."""
    bar, updates, update = Bar(uem.FinitePlasticity, 20, 1.0, contactors="massy"), [], uem.FinitePlasticity.update
    monkeypatch.setattr(uem.FinitePlasticity, "update", lambda self: updates.append(1) or update(self))
    book, steps = uem.EnergyBook(bar.problem), uem.time_steps(bar.problem, end=0.2)
    for step in steps:
        if step.number > 3:
            break
        book.write(step)
    del updates[:]
    for _ in range(3):
        row = book.write(next(steps))
    assert row.dissipated > 0.0 and len(updates) == 3
    # energies are those of the committed history
    update(bar.problem.materials[0])
    assert abs(bar.problem.materials[0].energy() / row.stored - 1.0) < 1e-12


@pytest.mark.long
def test_restart(tmp_path):
    """A run that continues from a checkpoint is the uninterrupted one to rounding, with the same steps."""
    path = COMM.bcast(str(tmp_path / "kept"))
    whole, first, second = (Bar(uem.FinitePlasticity, 40, 3.0) for _ in range(3))
    lengths = [step.dt for step in uem.time_steps(whole.problem, end=0.2)]
    steps = uem.time_steps(first.problem, end=0.2, checkpoint=uem.Checkpoint(path, every=7))
    for step in steps:
        if step.number == 24:
            break
    steps.close()
    again = uem.time_steps(second.problem, end=0.2, checkpoint=uem.Checkpoint(path, every=7))
    later = [step.dt for step in again]
    assert len(set(lengths)) > 1
    assert later == lengths[-len(later) :] and 0 < len(later) < len(lengths)
    own = np.abs(second.u.x.array - whole.u.x.array).max(initial=0.0)
    assert reduced(COMM, float(own), op=MPI.MAX) < 1e-12
