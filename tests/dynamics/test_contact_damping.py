"""Contact that damps: a pressure by the gap and the speed of approach, and viscous friction.

Read first: ``test_restitution``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, box, clamp, highest, linear, refused, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def restitution(zeta):
    """Of a mass on a linear spring and dashpot in parallel that comes off without force (Schwager, Poeschel, Granular Matter 9 (2007))."""
    w = np.sqrt(1.0 - zeta**2)
    turn = np.arctan2(2.0 * zeta * w, 2.0 * zeta**2 - 1.0)
    return np.exp(-zeta / w * turn)


class Drop:
    """A stiff block of unit face and mass between rollers that flies onto a soft floor."""

    def __init__(
        self, normal, speed=1.0, cell="quadrilateral", gap=0.013, contactors="massless", gravity=0.0, general=False, **options
    ):
        g, E = 2 if cell in ("quadrilateral", "triangle") else 3, 1e6
        s = scene(COMM, cell, [box(cell, [0.0] * (g - 1) + [gap], [1.0] * (g - 1) + [gap + 1.0], [*[2] * (g - 1), 8])])
        V = compat.function_space(s.mesh, 1, (g,))
        self.u = fem.Function(V)
        bcs = [bc for c in range(g - 1) for end in (0.0, 1.0) for bc in clamp(V, s.tag("side", 0, at(c, end)), c)]
        floor = uem.RigidPlane([0.0] * g, [0.0] * (g - 1) + [1.0])
        if general:
            self.contact = uem.GeneralContact(rigid=[floor], normal=normal)
        else:
            self.contact = uem.Contact(s.tag("low", 0, at(g - 1, gap)), floor, normal=normal, **options)
        up = np.eye(g)[g - 1]
        self.dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=-speed * up, gravity=-gravity * up, contactors=contactors)
        self.problem = uem.UnitedProblem(linear(self.u, E, 0.0), self.u, bcs=bcs, contacts=[self.contact], dynamics=self.dynamics)

    @property
    def speed(self):
        return self.dynamics.momentum()[-1]


def lowest(values):
    return COMM.allreduce(np.min(values, initial=np.inf), op=MPI.MIN)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("zeta", "options"),
    [
        (0.1, {}),
        (0.5, {}),
        (0.5, {"coupling": "mortar"}),
        slow(0.9, {}),
        slow(0.5, {"cell": "hexahedron"}),
        slow(0.5, {"contactors": "massy"}),
    ],
)
def test_restitution(zeta, options):
    """The speed after impact is that of a spring with a dashpot, with an error of the step's first order; nothing ever pulls."""
    k, errors = 400.0, []
    for dt in (0.004, 0.002):
        drop = Drop(uem.SoftContact(k, damping=2.0 * zeta * np.sqrt(k)), **options)
        book = uem.EnergyBook(drop.problem)
        for step in uem.time_steps(drop.problem, dt, 0.25):
            row = book.write(step)
            assert lowest(drop.contact.pressures) >= 0.0 and step.newton_iterations <= 6
        errors.append(abs(drop.speed - restitution(zeta)))
        assert drop.contact.n_active == 0
    assert errors[1] <= 0.006 and errors[1] <= 0.65 * errors[0] + 1e-3
    lost = 0.5 * (1.0 - restitution(zeta) ** 2)
    assert drop.contact.dissipation == row.friction == pytest.approx(lost, rel=0.03)
    # contact has given back what the spring had stored
    assert row.contact + row.friction == pytest.approx(0.0, abs=0.02 * lost)


@pytest.mark.slow
@pytest.mark.parametrize(
    "law", [uem.SoftContact(uem.Exponential(0.5, 0.02), damping=3.0), uem.SoftContact([(-1.0, 400.0), (0.0, 0.0)], damping=20.0)]
)
def test_any_law_is_damped(law):
    """A block that lands rests in the end where its weight is the pressure of the law, whose damping has taken the energy."""
    drop = Drop(law, gap=0.0, speed=0.3, gravity=5.0)
    for step in uem.time_steps(drop.problem, 0.02, 8.0):
        assert lowest(drop.contact.pressures) >= 0.0
    assert abs(drop.speed) <= 1e-3 * 0.3
    assert highest(COMM, np.abs(drop.contact.pressures - 5.0)) <= 0.03
    gaps = drop.contact.pair.gaps()
    assert highest(COMM, np.abs(law.law.pressure(gaps)[0] - 5.0)) <= 0.03


@pytest.mark.slow
def test_damped_vibration():
    """In contact throughout, a block swings about its rest with the logarithmic decrement of its dashpot."""
    k, zeta, down = 400.0, 0.05, 4.0
    drop = Drop(uem.SoftContact(k, damping=2.0 * zeta * np.sqrt(k)), gap=0.0, speed=0.0, gravity=down)
    w = np.sqrt(k * (1.0 - zeta**2))
    dt, n = 2.0 * np.pi / w / 80, 160
    speeds = [drop.speed for _ in uem.time_steps(drop.problem, dt, n * dt)]
    # v = -g / w exp(-zeta w0 t) sin(w t)
    t = dt * np.arange(1, n + 1)
    exact = -down / w * np.exp(-zeta * np.sqrt(k) * t) * np.sin(w * t)
    assert np.abs(np.array(speeds) - exact).max() <= 0.04 * down / w


@pytest.mark.long
def test_a_run_continues(folder):
    """From a checkpoint amid the impact a run continues to the last bit, with what has been dissipated, and a step is taken twice."""

    def make():
        return Drop(uem.SoftContact(400.0, damping=20.0))

    drop, rows = make(), []
    for step in uem.time_steps(drop.problem, 0.004, 0.1):
        if step.number == 7:
            drop.problem.solve()
        rows.append((drop.speed, drop.contact.resultant().force[-1], drop.contact.dissipation))
        if step.number == 8:
            uem.write_checkpoint(folder / "run", drop.problem.state())
    assert 0.0 < rows[7][2] < rows[-1][2]
    drop = make()
    uem.read_checkpoint(folder / "run", drop.problem.state())
    assert (drop.speed, drop.contact.resultant().force[-1], drop.contact.dissipation) == rows[7]
    more = [
        (drop.speed, drop.contact.resultant().force[-1], drop.contact.dissipation)
        for _ in uem.time_steps(drop.problem, 0.004, 0.1)
    ]
    assert more == rows[8:]


@pytest.mark.slow
def test_a_general_contact():
    """Declared by all surfaces a block damps as by a contact of its own."""
    found = []
    for general in (False, True):
        drop = Drop(uem.SoftContact(400.0, damping=20.0), general=general)
        found.append([drop.speed for _ in uem.time_steps(drop.problem, 0.004, 0.1)])
    # surfaces without mass are all of them
    assert found[1] == pytest.approx(found[0], abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("how", [{}, slow({"coupling": "mortar"}), slow({"dim": 3}), slow({"zeta": 0.3})], ids=str)
def test_bodies_that_meet_corner_on_corner(how):
    """In general contact two stiff bodies of unit mass between rollers part as masses on a spring and a dashpot, in few iterations."""
    (dim, zeta), k, gap = (how.get(name, usual) for name, usual in (("dim", 2), ("zeta", 0.0))), 40.0, 0.0123
    cell = "quadrilateral" if dim == 2 else "hexahedron"
    low, one = [0.0] * (dim - 1), [1.0] * (dim - 1)
    lower = box(cell, [*low, -1.0 - gap], [*one, -gap], [*[2] * (dim - 1), 6])
    s = scene(COMM, cell, [lower, box(cell, [*low, 0.0], [*one, 1.0], [*[3] * (dim - 1), 6])])
    V = compat.function_space(s.mesh, 1, (dim,))
    sides = [s.tag(f"side {c}", body, at(c, end)) for c in range(dim - 1) for end in (0.0, 1.0) for body in (0, 1)]
    bcs = [bc for side in sides for bc in clamp(V, side, int(side.name[-1]))]
    u, velocity = fem.Function(V), fem.Function(V)
    velocity.x.array.reshape(-1, dim)[V.tabulate_dof_coordinates()[:, dim - 1] > -0.5 * gap, dim - 1] = -1.0
    normal = uem.SoftContact(k, damping=2.0 * zeta * np.sqrt(k / 2))
    contact = uem.GeneralContact(normal=normal, coupling=how.get("coupling", "node_to_surface"), max_penetration=0.5)
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=velocity)
    problem = uem.UnitedProblem(linear(u, 1e5, 0.0), u, bcs=bcs, contacts=[contact], dynamics=dynamics, rtol=1e-10)
    book, length, forces = uem.EnergyBook(problem), np.pi / np.sqrt(2.0 * k), []
    for step in uem.time_steps(problem, length / 30, 1.3 * length):
        book.write(step)
        forces.append(sum(abs(touch.force[-1]) for touch in contact.touching()))
        assert step.newton_iterations <= 4 and step.cuts == 0
    own = slice(problem.config.n_owned)
    upper = problem.config.X[own, -1] > -0.5 * gap
    ways = dynamics.mass.of_nodes[:, -1] * dynamics.velocity.x.array.reshape(-1, dim)[own, -1]
    parted = COMM.allreduce(float(ways[upper].sum() - ways[~upper].sum()))
    assert parted == pytest.approx(restitution(zeta) if zeta else 1.0, abs=2e-2 if zeta else 1e-3)
    assert np.abs(np.diff(np.array(book.momenta)[:, dim - 1])).max() < 1e-10 and forces[-1] == 0.0
    if not zeta:
        assert max(forces) == pytest.approx(np.sqrt(k / 2), rel=0.01)


def test_what_is_refused():
    refused(uem.InputError, "damping = -1", lambda: uem.SoftContact(1.0, damping=-1.0))
    assert repr(uem.SoftContact(1.0, damping=2.0)) == "SoftContact(Linear(k=1.0), damping=2.0)"
    s = scene(COMM, "triangle", [box("triangle", [0.0, 0.0], [1.0, 1.0], [2, 2])])
    u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
    floor = uem.RigidPlane([0.0, 0.0], [0.0, 1.0])
    contact = uem.Contact(s.tag("low", 0, at(1, 0.0)), floor, normal=uem.SoftContact(1.0, damping=1.0), name="sole")
    words = ("contact 'sole'", "damping", "statics")
    refused(uem.InputError, words, lambda: uem.UnitedProblem(linear(u, 1.0), u, contacts=[contact]))
