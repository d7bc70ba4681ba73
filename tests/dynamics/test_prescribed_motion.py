"""Prescribed motion in time: velocities that jump, accuracy where they do not, and what supports give the bodies.

Read ``test_dragged_from_rest`` first.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, highest, scene
from scipy.integrate import solve_ivp

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
LENGTH, E, DENSITY = 10.0, 900.0, 1.0
SPEED = np.sqrt(E / DENSITY)
SCHEMES = {"trapezoidal": uem.newmark(), "alpha": uem.generalised_alpha(0.5), "alpha 1": uem.generalised_alpha(1.0)}
MASSES = {"lumped": uem.lumped_mass, "consistent": uem.consistent_mass}


class Dragged:
    """A bar, 1 wide, whose lower end, or all of it, is led along its axis by a function of time."""

    def __init__(self, way, *, n=20, scheme="trapezoidal", mass="lumped", whole=False, velocity=None, damping=0.0):
        s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, LENGTH], [1, n])])
        self.V = V = compat.function_space(s.mesh, 1, (2,))
        self.u, self.way, self.place = fem.Function(V), way, fem.Function(V)
        law = uem.LinearElastic(E, 0.0, kind="plane_stress")
        self.end, free = s.tag("end", 0, at(1, 0.0)), s.tag("free", 0, at(1, LENGTH))
        nodes = np.arange(len(self.u.x.array) // 2, dtype=np.int32)
        if not whole:
            nodes = fem.locate_dofs_topological(V, 1, self.end.entities)
        self.held, self.free = nodes, fem.locate_dofs_topological(V, 1, free.entities)

        def drag(v):
            return damping * ufl.inner(v, ufl.TestFunction(V)) * ufl.dx

        self.dynamics = uem.Dynamics(
            MASSES[mass](V, DENSITY), scheme=SCHEMES[scheme], velocity=velocity, damping=drag if damping else None
        )
        self.problem = uem.UnitedProblem(
            law.residual(self.u, ufl.TestFunction(V)) * ufl.dx, self.u, bcs=[fem.dirichletbc(self.place, nodes)],
            dynamics=self.dynamics, load=self.load, rtol=1e-12,
        )  # fmt: skip
        self.book = uem.EnergyBook(self.problem, law.energy(self.u) * ufl.dx)

    def load(self, t):
        self.place.x.array.reshape(-1, 2)[:, 1] = self.way(t)

    def run(self, dt, end):
        """Velocities of prescribed nodes after each step ``(n_steps,)``."""
        speeds = []
        for step in uem.time_steps(self.problem, dt, end):
            self.book.write(step)
            v = self.dynamics.velocity.x.array.reshape(-1, 2)[self.held, 1]
            speeds.append([-highest(COMM, -v), highest(COMM, v)])
        return np.array(speeds)

    def at_free_end(self, field):
        return highest(COMM, field.x.array.reshape(-1, 2)[self.free, 1])


@pytest.mark.parametrize("mass", MASSES)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_dragged_from_rest(scheme, mass):
    """An end led away at constant speed: it has that speed at once and for good, and a wave runs through the bar as in closed form."""
    w, end = 0.3, 0.2
    bar = Dragged(lambda t: w * t, n=40, scheme=scheme, mass=mass)
    speeds = bar.run(0.005, end)
    np.testing.assert_allclose(speeds, w, rtol=1e-12)
    row, wave = bar.book.rows[-1], 0.5 * DENSITY * SPEED * end * w**2
    # behind the front half of the energy is kinetic
    assert row.kinetic == pytest.approx(wave, rel=0.04) and row.stored == pytest.approx(wave, rel=0.04)
    assert row.external == pytest.approx(2 * wave, rel=0.04)
    bound = {"lumped": 1e-10, "consistent": 3e-3}[mass] if scheme == "trapezoidal" else 0.04
    assert max(abs(r.defect) for r in bar.book.rows) < bound * wave, max(abs(r.defect) for r in bar.book.rows) / wave


@pytest.mark.parametrize("mass", MASSES)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_jumps_are_impacts(scheme, mass):
    """All of a body is led: off, on, back and stopped, with steps of any length; supports have done what is kinetic energy."""
    w = 2.0

    def way(t):
        return w * np.interp(t, [0.0, 0.1, 0.3, 0.5, 1.0], [0.0, 0.0, 0.2, -0.2, -0.2])

    body = Dragged(way, n=3, scheme=scheme, mass=mass, whole=True)
    found = np.vstack([body.run(dt, end) for dt, end in ((0.05, 0.2), (0.02, 0.4), (0.1, 0.8))])
    v = [0.0] * 2 + [w] * 2 + [w] * 5 + [-2 * w] * 5 + [-2 * w] + [0.0] * 3
    np.testing.assert_allclose(found[:, 0], v, atol=1e-12)
    np.testing.assert_allclose(found[:, 1], v, atol=1e-12)
    kinetic = np.array([0.0, *(0.5 * DENSITY * LENGTH * np.array(v) ** 2)])
    for name in ("kinetic", "external"):
        np.testing.assert_allclose([getattr(row, name) for row in body.book.rows], kinetic, atol=1e-10)
    assert max(abs(row.defect) for row in body.book.rows) < 1e-10


def test_damping_of_what_is_led():
    """The damping form is given the velocities that prescribed nodes have."""
    w, c, dt = 2.0, 0.7, 0.01
    body = Dragged(lambda t: w * t, n=3, whole=True, damping=c)
    body.run(dt, 0.05)
    damped = np.array([row.damped for row in body.book.rows])
    np.testing.assert_allclose(np.diff(damped)[1:], c * LENGTH * w**2 * dt, rtol=1e-10)
    assert max(abs(row.defect) for row in body.book.rows) < 1e-10


def test_velocity_that_is_stopped_at_the_start():
    """Bodies that fly, and a support that holds an end of them: its nodes stand still at once."""
    bar = Dragged(lambda t: 0.0, velocity=(0.0, -1.0))
    np.testing.assert_array_equal(bar.run(0.01, 0.1), 0.0)
    assert abs(bar.book.rows[-1].defect) < 1e-10 * bar.book.rows[0].kinetic
    assert bar.book.rows[-1].external == pytest.approx(-0.5 * bar.book.rows[0].kinetic / 20, rel=1e-10)


def chain(mass, n, way, velocity):
    """The bar as a chain: displacement and velocity of the free end and the force on the other one ``(3,)`` as a function of time."""
    h = LENGTH / n
    cell = {"lumped": np.eye(2) / 2, "consistent": np.array([[2.0, 1.0], [1.0, 2.0]]) / 6}[mass]
    K, M = np.zeros((n + 1, n + 1)), np.zeros((n + 1, n + 1))
    for i in range(n):
        K[i : i + 2, i : i + 2] += E / h * np.array([[1.0, -1.0], [-1.0, 1.0]])
        M[i : i + 2, i : i + 2] += DENSITY * h * cell
    inner = np.linalg.inv(M[1:, 1:])

    def acceleration(t, u):
        up, ap = way(t)
        return -inner @ (K[1:, 0] * up + M[1:, 0] * ap + K[1:, 1:] @ u)

    def rate(t, y):
        return np.concatenate([y[n:], acceleration(t, y[:n])])

    found = solve_ivp(rate, (0.0, 1.0), [0.0] * n + [velocity] * n, rtol=1e-10, atol=1e-12, dense_output=True)

    def at(t):
        y = found.sol(t)
        up, ap = way(t)
        force = M[0, 0] * ap + M[0, 1:] @ acceleration(t, y[:n]) + K[0, 0] * up + K[0, 1:] @ y[:n]
        return np.array([y[n - 1], y[2 * n - 1], force])

    return at


@pytest.mark.long
@pytest.mark.parametrize("mass", MASSES)
@pytest.mark.parametrize(
    "scheme, from_rest",
    [
        ("trapezoidal", True),
        ("alpha", False),
        *(pytest.param(*how, marks=pytest.mark.slow) for how in (("alpha", True), ("trapezoidal", False))),
    ],
)
def test_second_order(scheme, mass, from_rest):
    """An end led to and fro: displacement and velocity of the other end, force on it and its own velocity, all along the run."""
    size, omega, n, errors = 0.1, 6.0, 4, []
    if from_rest:
        way, ahead = lambda t: size * (1 - np.cos(omega * t)), lambda t: size * omega**2 * np.cos(omega * t)
    else:
        way, ahead = lambda t: size * np.sin(omega * t), lambda t: -size * omega**2 * np.sin(omega * t)
    start = 0.0 if from_rest else size * omega
    exact = chain(mass, n, lambda t: (way(t), ahead(t)), start)
    for dt in (0.02, 0.01):
        bar, worst = Dragged(way, n=n, scheme=scheme, mass=mass, velocity=(0.0, start)), np.zeros(4)
        for k in range(1, round(1.0 / dt) + 1):
            (speed,) = bar.run(dt, k * dt)
            found = [bar.at_free_end(bar.u), bar.at_free_end(bar.dynamics.velocity), bar.problem.reaction(bar.end)[1], speed[0]]
            led = size * omega * (np.sin if from_rest else np.cos)(omega * k * dt)
            error = np.abs(found - np.array([*exact(k * dt), led]))
            # the first steps know nothing of the acceleration before them
            worst = np.maximum(worst, error if k > 5 else error * [1, 1, 0, 0])
        errors.append(worst)
    orders = np.log2(errors[0] / errors[1])
    # that force is mass times a difference of velocities
    assert (orders > [1.7, 1.7, 0.9, 1.7]).all() and (errors[1] < [2e-3, 0.05, 1.0, 0.01]).all(), (orders, errors)
