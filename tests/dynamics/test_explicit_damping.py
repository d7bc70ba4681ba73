"""Central differences with damping forms: decay in closed form, the critical step, bulk viscosity behind a wave."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.dynamics.explicit.stepper import ExplicitStepper
from uem_dolfinx.parallel import reduced

COMM = MPI.COMM_WORLD
LENGTH, C = 1.0, 1.0


class Bar:
    """A bar of density and wave speed 1, held at its lower end, that vibrates in its first mode; or one that hits a wall.

    ``damping`` is a function of the rate and the test function.
    """

    def __init__(self, damping=None, cells=20, contactors="massless", speed=0.01, wall=False):
        s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [0.1, LENGTH], [1, cells])])
        V = compat.function_space(s.mesh, 1, (2,))
        u, v, velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
        y = V.tabulate_dof_coordinates()[:, 1]
        velocity.x.array.reshape(-1, 2)[:, 1] = -speed if wall else speed * np.sin(0.5 * np.pi * y)
        law = uem.LinearElastic(C**2, 0.0, kind="plane_stress")
        bcs = [] if wall else [uem.dirichlet(V, s.tag("end", 0, at(1, 0.0)), c) for c in (0, 1)]
        contacts = []
        if wall:
            plane = uem.RigidPlane(np.zeros(2), np.array([0.0, 1.0]))
            contacts = [uem.Contact(s.tag("foot", 0, at(1, 0.0)), plane)]
        self.dynamics = uem.Dynamics(
            uem.lumped_mass(V, 1.0), velocity=velocity, scheme=uem.CentralDifferences(), contactors=contactors,
            damping=None if damping is None else lambda rate: damping(rate, v),
        )  # fmt: skip
        self.problem = uem.UnitedProblem(law.residual(u, v) * ufl.dx, u, bcs=bcs, contacts=contacts, dynamics=self.dynamics)
        self.stored = law.energy(u) * ufl.dx
        self.contact = contacts[0] if contacts else None


def by_mass(alpha):
    """Forces in proportion to the mass."""
    return lambda rate, v: alpha * ufl.inner(rate, v) * ufl.dx


def bulk(b, cells):
    """Linear bulk viscosity ``b rho c h``."""
    return lambda rate, v: b * C * LENGTH / cells * ufl.div(rate) * ufl.div(v) * ufl.dx


@pytest.mark.parametrize("contactors", ["massless", "massy"])
@pytest.mark.parametrize("alpha", [0.1, 1.0])
def test_decay(alpha, contactors):
    """Free vibrations decay like exp(-alpha t); what is lost is damped."""
    bar = Bar(by_mass(alpha), contactors=contactors)
    book = uem.EnergyBook(bar.problem, bar.stored)
    for step in uem.time_steps(bar.problem, end=4.0):
        row = book.write(step)
    first = book.rows[0].kinetic
    w = np.sqrt((0.5 * np.pi) ** 2 - alpha**2 / 4)
    # energy of a damped oscillator after one period
    period = 2 * np.pi / w
    assert period > 4.0
    t = 4.0
    q = np.exp(-alpha * t / 2) * np.sin(w * t) / w
    rate = np.exp(-alpha * t / 2) * (np.cos(w * t) - alpha / (2 * w) * np.sin(w * t))
    exact = rate**2 + (0.5 * np.pi * q) ** 2
    assert abs((row.kinetic + row.stored) / first - exact) < 0.01
    assert abs(row.defect) < 0.05 * first


@pytest.mark.slow
@pytest.mark.parametrize("contactors", ["massless", "massy"])
@pytest.mark.parametrize("b", [0.06, 1.0])
def test_the_critical_step(b, contactors):
    """With damping steps at 0.95 of the critical one are stable, and at 1.1 of it unstable."""
    cells = 20
    for part, stable in ((0.95, True), (1.1, False)):
        bar = Bar(bulk(b, cells), cells, contactors)
        dt = part * ExplicitStepper(bar.problem).critical_step()
        bar = Bar(bulk(b, cells), cells, contactors)
        if not stable:
            # the check of the length is for users
            ExplicitStepper.critical_step, kept = lambda self: np.inf, ExplicitStepper.critical_step
        try:
            for _ in uem.time_steps(bar.problem, dt, end=600 * dt):
                pass
            size = reduced(COMM, float(np.abs(bar.problem.u.x.array).max(initial=0.0)), op=MPI.MAX)
        except uem.UEMError:
            size = np.inf
        finally:
            if not stable:
                ExplicitStepper.critical_step = kept
        assert (size < 0.02) == stable, (part, size)


def test_damping_shortens_the_step():
    """By the closed form of the highest frequency and its damping."""
    cells, b = 20, 0.5
    w = 2.0 / ExplicitStepper(Bar(cells=cells).problem).critical_step()
    damped = ExplicitStepper(Bar(bulk(b, cells), cells).problem).critical_step()
    # the stiffness of a mode over its damping is c^2 / (b c h)
    c = w**2 * b * LENGTH / cells / C
    assert abs(damped * (c + np.sqrt(c**2 + 4 * w**2)) / 4 - 1) < 0.02


@pytest.mark.long
def test_bulk_viscosity_calms_a_wave():
    """Velocities overshoot behind the front of a bar that hits a wall, and much less with viscosity."""
    overshoot = []
    for b in (0.0, 0.5):
        bar = Bar(bulk(b, 60) if b else None, 60, wall=True)
        for _ in uem.time_steps(bar.problem, end=0.8):
            pass
        config, v = bar.problem.config, bar.dynamics.velocity.x.array.reshape(-1, 2)
        overshoot.append(reduced(COMM, float(v[: config.n_owned, 1].max(initial=0.0)), op=MPI.MAX) / 0.01)
    assert overshoot[0] > 0.1 and overshoot[1] < 0.05, overshoot
