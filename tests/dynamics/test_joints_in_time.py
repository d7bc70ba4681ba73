"""Joints and springs of rigid parts in motion.

Two tests to read first: ``test_a_pendulum``, angle, energy and bearing force, and ``test_a_double_pendulum``, against the equations of
Lagrange.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import box, linear, scene, slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.conditions.rigid_set import turned
from uem_dolfinx.geometry.rigid import rotation_matrix

COMM = MPI.COMM_WORLD
G = 9.81


class Row:
    """Rigid boxes of length 2 in a row, with gaps of 0.5 between them, and their masses by density or at their middles."""

    def __init__(self, cell="quadrilateral", n=1, meshed=True):
        g = 2 if cell == "quadrilateral" else 3
        self.g, self.meshed = g, meshed
        ends = [([2.5 * i, *[0.0] * (g - 1)], [2.5 * i + 2.0, *[1.0] * (g - 1)]) for i in range(n)]
        self.scene = scene(COMM, cell, [box(cell, *end, [2, *[1] * (g - 1)]) for end in ends])
        self.V = compat.function_space(self.scene.mesh, 1, (g,))
        self.u = fem.Function(self.V, name="u")
        self.tags = [self.scene.tag(f"body {i}", i, lambda x: x[:, 0] >= -1.0) for i in range(n)]
        self.mass = uem.lumped_mass(self.V, 1.5 if meshed else 0.0)
        # lumped on nodes: of the corners (1/4 each) and of the middle of every edge along x
        self.m = 3.0
        self.inertia = self.m * (0.5 * 1.0**2 + 0.5**2)

    def at(self, x, y=0.5):
        return np.array([x, y, 0.5])[: self.g]

    def part(self, i, **how):
        own = {} if self.meshed else {"mass": self.m, "inertia": self.inertia}
        return uem.RigidCoupling(self.tags[i], self.at(2.5 * i + 1.0), **own, **how)

    def problem(self, *couplings, law=st_venant, equations=(), **how):
        dynamics = uem.Dynamics(self.mass, gravity=np.array([0.0, -G, 0.0])[: self.g], **how)
        return uem.UnitedProblem(
            law(self.u, 1.0), self.u, couplings=list(couplings), equations=equations, dynamics=dynamics, rtol=1e-12
        ), dynamics

    def axis(self):
        return () if self.g == 2 else ((0.0, 0.0, 1.0),)


def swing(t, start, length, radius2):
    """Angle below the horizontal of a physical pendulum that starts at rest, by quadrature of its equation of motion."""
    from scipy.integrate import solve_ivp

    found = solve_ivp(
        lambda _, y: (y[1], -G * length / radius2 * np.cos(y[0])), (0.0, t[-1]), (start, 0.0), t_eval=t, rtol=1e-11, atol=1e-12
    )
    return found.y


@pytest.mark.slow
@pytest.mark.parametrize(("cell", "meshed"), [("quadrilateral", True), ("quadrilateral", False), slow("hexahedron", True)])
def test_a_pendulum(cell, meshed):
    """A bar on a hinge falls from the horizontal: angle and energy are right to second order in the step, the bearing's force to first."""
    errors = []
    for n in (20, 40):
        r = Row(cell, meshed=meshed)
        bar = r.part(0)
        hinge = uem.Hinge(None, bar, r.at(-0.5), *r.axis())
        problem, dynamics = r.problem(bar, hinge)
        total = []
        for _ in uem.time_steps(problem, 1.0 / n, 1.0):
            lost = r.m * G * bar.displacement[1]
            total.append(dynamics.kinetic_energy() + lost)
            at = r.at(-0.5) + np.array([1.5 * np.cos(hinge.angle), 1.5 * np.sin(hinge.angle), 0.0])[: r.g]
            assert np.allclose(r.at(1.0) + bar.displacement, at, atol=1e-11)
        J = r.inertia + r.m * 1.5**2
        angle, rate = swing(np.array([1.0]), 0.0, r.m * 1.5, J)
        e = np.array([np.cos(angle[0]), np.sin(angle[0])])
        turn = -r.m * G * 1.5 * np.cos(angle[0]) / J
        pull = r.m * (1.5 * (turn * np.array([-e[1], e[0]]) - rate[0] ** 2 * e) + (0.0, G))
        errors.append([hinge.angle - angle[0], np.abs(total).max() / 20.0, np.abs(hinge.force[:2] - pull).max()])
    first, second = np.abs(errors)
    assert (second <= [3e-3, 4e-3, 0.8]).all()
    assert (second <= np.array([0.3, 0.3, 0.6]) * first).all()


@pytest.mark.slow
@pytest.mark.parametrize("meshed", [True, False])
def test_a_pendulum_on_a_cart(meshed):
    """Equations lead the middle of a bar's end by ``A t^2 / 2``: it falls as in gravity that is oblique, to second order in the step."""
    from scipy.integrate import solve_ivp

    errors, A = [], 4.0
    for n in (20, 40):
        r = Row(meshed=meshed)
        bar = r.part(0)
        ends = [[(r.at(0.0, y), 0.5 * np.eye(2)[i]) for y in (0.0, 1.0)] for i in range(2)]
        cart = [uem.Equation(ends[0], b=lambda t: 0.5 * A * t**2), uem.Equation(ends[1])]
        problem, _ = r.problem(bar, equations=cart)
        for step in uem.time_steps(problem, 1.0 / n, 1.0):
            at = 0.5 * A * step.time**2 + np.cos(bar.rotation) - 1.0
            assert np.allclose(bar.displacement, (at, np.sin(bar.rotation)), atol=1e-11)
        by = r.m / (r.inertia + r.m)
        rates = lambda _, y: (y[1], by * (A * np.sin(y[0]) - G * np.cos(y[0])))  # noqa: E731
        errors.append(abs(bar.rotation - solve_ivp(rates, (0.0, 1.0), (0.0, 0.0), rtol=1e-11, atol=1e-12).y[0, -1]))
    assert errors[1] <= 6e-3 and errors[1] <= 0.3 * errors[0]


@pytest.mark.slow
def test_a_double_pendulum():
    """Two bars on hinges against the equations of Lagrange, both at a distance that is kept."""
    from scipy.integrate import solve_ivp

    r = Row(n=2)
    a, b = r.part(0), r.part(1)
    first, second = uem.Hinge(None, a, r.at(0.0)), uem.Hinge(a, b, r.at(2.25))
    m, J, s, L = r.m, r.inertia, 1.0, 2.25

    def lagrange(_, y):
        p, q, dp, dq = y
        M = [[J + m * s**2 + m * L**2, m * L * 1.25 * np.cos(p - q)], [m * L * 1.25 * np.cos(p - q), J + m * 1.25**2]]
        f = [
            -m * L * 1.25 * np.sin(p - q) * dq**2 - m * G * (s + L) * np.cos(p),
            m * L * 1.25 * np.sin(p - q) * dp**2 - m * G * 1.25 * np.cos(q),
        ]
        return [dp, dq, *np.linalg.solve(M, f)]

    exact = solve_ivp(lagrange, (0.0, 1.0), np.zeros(4), rtol=1e-11, atol=1e-12).y[:2, -1]
    problem, dynamics = r.problem(a, b, first, second)
    for _ in uem.time_steps(problem, 0.01, 1.0):
        pass
    assert a.rotation == pytest.approx(exact[0], abs=4e-3) and b.rotation == pytest.approx(exact[1], abs=8e-3)
    assert first.angle == pytest.approx(a.rotation, rel=1e-12) and second.angle == pytest.approx(
        b.rotation - a.rotation, rel=1e-12
    )
    energy = dynamics.kinetic_energy() + m * G * (a.displacement[1] + b.displacement[1])
    assert abs(energy) <= 2e-3 * dynamics.kinetic_energy()
    ends = [
        one.displacement + (rotation_matrix(np.array([one.rotation])) - np.eye(2)) @ (r.at(2.25) - one.point) for one in (a, b)
    ]
    assert np.allclose(*ends, atol=1e-12)


@pytest.mark.slow
def test_a_ball_in_space():
    """A bar swings about a ball in space: energy is kept to second order in the step, and the ball carries no moment."""
    errors = []
    for n in (50, 100):
        r = Row("hexahedron")
        bar = r.part(0)
        ball = uem.Ball(None, bar, o := r.at(-0.5))
        v = fem.Function(r.V)
        v.interpolate(lambda x: turned(np.array([0.3, 1.5, 0.0]), x.T - o).T)
        problem, dynamics = r.problem(bar, ball, velocity=v)
        first, energy = dynamics.kinetic_energy(), []
        for _ in uem.time_steps(problem, 1.0 / n, 1.0):
            energy.append(dynamics.kinetic_energy() + r.m * G * bar.displacement[1])
            assert np.linalg.norm(r.at(1.0) + bar.displacement - o) == pytest.approx(1.5, rel=1e-12)
        errors.append(np.abs(np.array(energy) / first - 1.0).max())
    assert errors[1] <= 2e-3 and errors[1] <= 0.3 * errors[0]
    assert not ball.moment.any() and abs(bar.displacement[2]) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize("law", [linear, st_venant])
def test_a_mass_on_a_spring(law):
    """A slider with a spring, and a spring in its line, swing with the frequency of their stiffness; energy is conserved."""
    r = Row()
    bar = r.part(0)
    slider = uem.Slider(None, bar, r.at(0.0), (1.0, 0.0), stiffness=20.0)
    spring = uem.Spring(None, bar, 10.0, points=(r.at(-3.0), r.at(0.0)))
    v = fem.Function(r.V)
    v.interpolate(lambda x: np.stack([1.0 + 0.0 * x[0], 0.0 * x[0]]))
    problem, dynamics = r.problem(bar, slider, spring, law=law, velocity=v)
    book = uem.EnergyBook(problem)
    omega, dt = np.sqrt(30.0 / r.m), 0.02
    # frequency of the trapezoidal rule
    numeric = 2.0 / dt * np.arctan(0.5 * omega * dt)
    found = uem.modes(problem, 1)
    assert 2.0 * np.pi * found.frequencies[0] == pytest.approx(omega, rel=1e-9)
    for step in uem.time_steps(problem, dt, 1.0):
        row = book.write(step)
        assert slider.displacement == pytest.approx(np.sin(numeric * dynamics.time) / omega, abs=1e-9)
        assert row.kinetic + row.stored == pytest.approx(0.5 * r.m, rel=1e-9)
        assert abs(row.defect) <= 1e-9


@pytest.mark.slow
def test_a_run_continues(folder):
    """From a checkpoint the run continues to the last bit, with full turns of the hinge, and a step is taken twice."""

    def make():
        r = Row()
        bar = r.part(0)
        hinge = uem.Hinge(None, bar, r.at(0.0), stiffness=0.01)
        v = fem.Function(r.V)
        v.interpolate(lambda x: turned(np.array([9.0]), x[:2].T - r.at(0.0)).T)
        problem, _ = r.problem(bar, hinge, velocity=v)
        return r, hinge, problem

    r, hinge, problem = make()
    angles = []
    for step in uem.time_steps(problem, 0.1, 1.6):
        if step.number == 3:
            problem.solve()
        angles.append(hinge.angle)
        if step.number == 12:
            uem.write_checkpoint(folder / "run", problem.state())
    assert max(angles) > 2.0 * np.pi
    r, hinge, problem = make()
    uem.read_checkpoint(folder / "run", problem.state())
    assert hinge.angle == angles[11]
    assert [hinge.angle for _ in uem.time_steps(problem, 0.1, 1.6)] == angles[12:]
