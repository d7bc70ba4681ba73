"""Supports that are released, added and moved between time steps, against closed forms.

Read ``test_a_bar_that_is_let_go`` first.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, blocks, box, highest, linear, refused, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
LENGTH, E, DENSITY = 10.0, 900.0, 1.0
SPEED = np.sqrt(E / DENSITY)


class Bar:
    """A bar along y, its tags, and its dynamics."""

    def __init__(self, n=40, mass=uem.lumped_mass, gravity=None, contacts=lambda bar: [], **options):
        s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, LENGTH], [1, n])])
        self.V = V = compat.function_space(s.mesh, 1, (2,))
        self.u, self.end, self.top = fem.Function(V), s.tag("end", 0, at(1, 0.0)), s.tag("top", 0, at(1, LENGTH))
        self.side = s.tag("side", 0, at(0, 0.0))
        self.law = uem.LinearElastic(E, 0.0, kind="plane_stress")
        self.still = [uem.dirichlet(V, self.side, 0)]
        self.dynamics = uem.Dynamics(mass(V, DENSITY), gravity=gravity, **options)
        self.contacts = contacts(self)

    def problem(self, bcs, load=None):
        F = self.law.residual(self.u, ufl.TestFunction(self.V)) * ufl.dx
        return uem.UnitedProblem(
            F, self.u, bcs=[*self.still, *bcs], contacts=self.contacts, dynamics=self.dynamics, load=load, rtol=1e-12
        )

    def at(self, tag, f=None):
        nodes = fem.locate_dofs_topological(self.V, 1, tag.entities)
        return highest(COMM, (self.u if f is None else f).x.array.reshape(-1, 2)[nodes, 1])

    def energy(self):
        return self.dynamics.kinetic_energy() + uem.integrate(self.law.energy(self.u) * ufl.dx)


@pytest.mark.parametrize("mass", [uem.lumped_mass, uem.consistent_mass])
def test_a_bar_that_is_let_go(mass):
    """Its end moves at the speed of sound times the strain, until the wave comes back; the energy is that of the stretched bar."""
    bar, d = Bar(mass=mass), 0.1
    bar.u.interpolate(lambda x: np.stack([0 * x[0], d * x[1] / LENGTH]))
    held = uem.dirichlet(bar.V, bar.end, 1)
    problem = bar.problem([held, uem.dirichlet(bar.V, bar.top, 1, d)])
    dt = LENGTH / SPEED / 80
    for _ in uem.time_steps(problem, dt, 4 * dt):
        assert bar.at(bar.top) == pytest.approx(d, rel=1e-12)
    stored = bar.energy()
    assert stored == pytest.approx(0.5 * E * d**2 / LENGTH, rel=1e-12)
    problem.hold([*bar.still, held])
    places, energies = [], []
    for step in uem.time_steps(problem, dt, 164 * dt):
        places.append((step.time - 4 * dt, bar.at(bar.top)))
        energies.append(bar.energy())
    np.testing.assert_allclose(energies, stored, rtol=1e-8)
    t, place = np.array(places).T
    np.testing.assert_allclose(place, d - SPEED * d / LENGTH * t, atol=0.05 * d)
    assert problem.reaction(bar.top)[1] == 0.0


def test_a_block_that_is_dropped():
    """Released nodes fall from rest as they should from the first step on, within one loop, too."""
    bar, g = Bar(n=4, gravity=(0.0, -9.0)), 9.0
    everything = [uem.dirichlet(bar.V, [bar.end, bar.side, bar.top], 1), uem.dirichlet(bar.V, [bar.end, bar.side, bar.top])]
    right = fem.locate_dofs_geometrical(bar.V, lambda x: np.full(x.shape[1], True))
    everything.append(fem.dirichletbc(np.zeros(2), right, bar.V))
    problem = bar.problem(everything)
    for step in uem.time_steps(problem, 0.01, 0.1):
        if step.time < 0.05 - 1e-9:
            assert highest(COMM, np.abs(bar.u.x.array)) == 0.0
        elif step.time < 0.05 + 1e-9:
            problem.hold(bar.still)
        else:
            t = step.time - 0.05
            fallen = bar.u.x.array.reshape(-1, 2)[:, 1]
            assert highest(COMM, np.abs(fallen + g * t**2 / 2)) < 1e-12
            assert highest(COMM, np.abs(bar.dynamics.velocity.x.array.reshape(-1, 2)[:, 1] + g * t)) < 1e-11


def test_a_support_that_is_added_and_moves():
    """A free bar is gripped at its end and led at a speed: the end has it at once, and behind the front the bar has it, too."""
    bar, w = Bar(), 0.3
    problem = bar.problem([])
    dt = LENGTH / SPEED / 80
    for _ in uem.time_steps(problem, dt, 5 * dt):
        pass
    start = 5 * dt
    problem.hold([*bar.still, uem.dirichlet(bar.V, bar.end, 1, lambda x, t: w * (t - start) + 0 * x[0])])
    for step in uem.time_steps(problem, dt, 45 * dt):
        assert bar.at(bar.end, bar.dynamics.velocity) == pytest.approx(w, rel=1e-10)
        assert bar.at(bar.end) == pytest.approx(w * (step.time - start), rel=1e-12)
    # half of its energy is kinetic, and the front has come to the middle
    assert bar.energy() == pytest.approx(DENSITY * w**2 * LENGTH / 2, rel=0.03)
    assert problem.reaction(bar.end)[1] == pytest.approx(DENSITY * SPEED * w, rel=0.05)


def test_a_block_that_falls_onto_a_floor():
    """Contact continues across a release: momentum at the floor is that of the fall, to the length of a step."""
    floor = uem.RigidPlane((0.0, -0.05), (0.0, 1.0))
    bar = Bar(n=10, gravity=(0.0, -9.0), contacts=lambda bar: [uem.Contact(bar.end, floor)])
    grip = uem.dirichlet(bar.V, bar.top, 1)
    problem = bar.problem([grip])
    problem.hold(bar.still)
    low = []
    for _ in uem.time_steps(problem, 0.005, 0.2):
        low.append(bar.at(bar.end))
    # free fall until the floor, at sqrt(2 h / g)
    n = int(np.sqrt(2 * 0.05 / 9.0) / 0.005) - 1
    t = 0.005 * np.arange(1, n + 1)
    np.testing.assert_allclose(low[:n], -9.0 * t**2 / 2, atol=1e-12)
    assert min(low) == pytest.approx(-0.05, abs=1e-10)


def test_refused():
    b = blocks(COMM, "triangle", 2, 2)
    statics = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[uem.Contact(b.high, b.low)])
    refused(uem.InputError, ("hold() is for time steps", "Step(bcs=...)"), lambda: statics.hold([]))
    bar = Bar(n=4)
    problem = bar.problem([])
    refused(uem.SpaceError, "bcs[0]", lambda: problem.hold(b.oedometer(0.1)))
    refused(uem.InputTypeError, "bcs", lambda: problem.hold([3]))
    explicit = Bar(n=4, scheme=uem.CentralDifferences())
    led = explicit.problem([])
    refused(uem.InputError, "CentralDifferences", lambda: led.hold(explicit.still))
