"""Friction that depends on the speed of slip, against closed forms of blocks that slide, stop, stick and slip.

Read first: ``test_a_block_on_a_spring_sticks_and_slips``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh
from helpers import at, box, linear, raised, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
COUPLINGS = ["node_to_surface", "mortar"]


class Slider:
    """A stiff block of unit size and mass on a rigid floor, pressed down by a guided top, on a spring whose end is drawn along.

    Args:
        law: of friction; None for a film of viscosity 2, a field.
        whole: whether all of its face touches, or the node in the middle alone.
        spring: its stiffness.
        speed: of the spring's end.
        velocity: of the block at the start.
        options: of the contact.
    """

    def __init__(self, law, *, whole=True, spring=0.0, speed=0.0, velocity=0.0, cell="quadrilateral", **options):
        g = 3 if cell in ("hexahedron", "tetrahedron") else 2
        s = scene(COMM, cell, [box(cell, [0.0] * g, [1.0] * g, [*[2] * (g - 1), 5])])
        self.V = compat.function_space(s.mesh, 1, (g,))
        self.u, self.end, self.k = fem.Function(self.V), fem.Constant(s.mesh, 0.0), fem.Constant(s.mesh, float(spring))
        v, low, top = ufl.TestFunction(self.V), s.tag("low", 0, at(g - 1, 0.0)), s.tag("top", 0, at(g - 1, 1.0))
        if not whole:
            tip = mesh.locate_entities(s.mesh, 0, lambda x: (np.abs(x[g - 1]) < 1e-9) & (np.abs(x[0] - 0.5) < 1e-9))
            low = uem.Tag("tip", 1, 0, s.mesh, tip.astype(np.int32))
        F = linear(self.u, 1e7) + self.k * (self.u[0] - self.end) * v[0] * ufl.dx
        if law is None:
            eta = fem.Function(compat.function_space(s.mesh, 1, ()))
            eta.x.array[:] = 2.0
            law = uem.ViscousFriction(eta)
        floor = uem.RigidPlane([0.0] * g, [*[0.0] * (g - 1), 1.0])
        bcs = [uem.dirichlet(self.V, top, g - 1, -1e-5 if not whole else -1e-6)]
        bcs += [uem.dirichlet(self.V, top, 1)] if g == 3 else []
        still = uem.Contact(low, floor)
        sides = [uem.dirichlet(self.V, top, 0)] if not spring else []
        uem.UnitedProblem(F, self.u, bcs=bcs + sides, contacts=[still], petsc_options_prefix="pressed_").solve()
        self.N = still.resultant().force[-1]
        self.contact = uem.Contact(low, floor, friction=law, **options)
        self.dynamics = uem.Dynamics(
            uem.lumped_mass(self.V, 1.0), scheme=uem.generalised_alpha(0.0), velocity=[velocity, *[0.0] * (g - 1)]
        )
        self.problem = uem.UnitedProblem(
            F, self.u, bcs=bcs, contacts=[self.contact], dynamics=self.dynamics,
            load=lambda t: setattr(self.end, "value", speed * t),
        )  # fmt: skip
        # the top's displacement is prescribed across, the block moves as one along
        self.way = lambda form=fem.form(self.u[0] * ufl.dx): COMM.allreduce(fem.assemble_scalar(form))

    def law_of_speed(self, dt):
        """By how much friction differs from what the law says of the slip of the first step, over the largest (collective)."""
        pair, law = self.contact.pair, self.contact.friction
        f, lam = pair.trial.friction, pair.trial.lam
        speed = np.linalg.norm(f.slipped, axis=1) / dt
        mu = (
            law.kinetic
            + (law.field - law.kinetic) * np.exp(-speed / law.velocity if law.velocity else -np.inf)
            + law.viscous * speed
        )
        off = np.linalg.norm(f.tau + (mu * lam)[:, None] * f.direction, axis=1).max(initial=0.0)
        return COMM.allreduce(off, op=MPI.MAX) / COMM.allreduce(lam.max(initial=0.0), op=MPI.MAX)

    def run(self, dt, end):
        """Times, ways, speeds and friction over the force along the normal at the ends of the steps ``(n, 4)``."""
        rows = []
        for step in uem.time_steps(self.problem, dt, end):
            friction, self.N = self.contact.resultant().force[[0, -1]]
            rows.append((step.time, self.way(), self.dynamics.momentum()[0], friction / self.N))
            assert step.newton_iterations <= 12
        return np.array(rows)


@pytest.mark.long
@pytest.mark.parametrize("law", [uem.Stribeck(0.5, 0.3), pytest.param(uem.Stribeck(0.5, 0.3, 0.01), marks=pytest.mark.slow)])
def test_a_block_on_a_spring_sticks_and_slips(law):
    """Static and kinetic coefficients: period and reach of the limit cycle, each to what a step can tell.

    Let ``D = (mu_s - mu_k) N / k`` and w be the block's frequency on the spring. The block sticks for ``2 D / V`` and slips for
    ``(2 pi - 2 atan(w D / V)) / w``, about ``mu_k N / k`` by the amplitude ``sqrt(D^2 + (V / w)^2)``.
    """
    V, k, dt = 0.5, 40.0, 0.02
    block = Slider(law, whole=False, spring=k, speed=V)
    t, way, _, friction = block.run(dt, 3.6).T
    D, w, stretch = 0.2 * block.N / k, np.sqrt(k), V * t - way
    period = 2 * D / V + (2 * np.pi - 2 * np.arctan(w * D / V)) / w
    peaks = np.flatnonzero((stretch[1:-1] > stretch[:-2]) & (stretch[1:-1] >= stretch[2:])) + 1
    lows = np.flatnonzero((stretch[1:-1] < stretch[:-2]) & (stretch[1:-1] <= stretch[2:])) + 1
    assert np.diff(t[peaks]) == pytest.approx([period] * (len(peaks) - 1), abs=dt)
    assert len(peaks) == 2
    reach = np.hypot(D, V / w)
    assert stretch[peaks].mean() - 0.3 * block.N / k == pytest.approx(reach, rel=0.02)
    assert stretch[lows].mean() - 0.3 * block.N / k == pytest.approx(-reach, rel=0.02)
    assert friction.min() == pytest.approx(-0.5, rel=0.05)


def stopping(a, b, v):
    """Way and time in which ``v' = -(a + b v)`` stops."""
    t = np.log(1 + b * v / a) / b
    return v / b - a / b * t, t


@pytest.mark.long
@pytest.mark.parametrize(
    ("coupling", "cell", "steps"),
    [("node_to_surface", "quadrilateral", (8, 32)), ("mortar", "quadrilateral", (8,)), ("node_to_surface", "hexahedron", (8,))],
)
def test_a_block_stops(coupling, cell, steps):
    """Friction that grows with the speed: the way to the stop in closed form, with an error of the step's first order."""
    errors = []
    for n in steps:
        block = Slider(uem.Stribeck(0.3, 0.3, viscous=0.1), velocity=1.0, coupling=coupling, cell=cell)
        dt = stopping(0.3 * block.N, 0.1 * block.N, 1.0)[1] / n
        block.run(dt, dt)
        assert block.law_of_speed(dt) <= 1e-8
        t, ways, speeds, _ = block.run(dt, 1.3 * n * dt).T
        way, time = stopping(0.3 * block.N, 0.1 * block.N, 1.0)
        errors.append(abs(ways[-1] / way - 1))
        assert np.abs(speeds[t > 1.2 * time]).max() <= 0.01
    assert errors[0] <= 0.1
    assert errors[-1] <= 0.3 ** (len(errors) - 1) * errors[0]


@pytest.mark.long
@pytest.mark.parametrize(("coupling", "cell"), [(c, "quadrilateral") for c in COUPLINGS] + [("node_to_surface", "hexahedron")])
def test_a_block_on_a_film(coupling, cell):
    """On a viscous film the speed of a block of mass 1 on area 1 falls as exp(-eta t), and the film dissipates its energy."""
    errors = []
    for dt in (0.1, 0.05):
        block = Slider(uem.ViscousFriction(2.0) if dt == 0.1 else None, velocity=1.0, coupling=coupling, cell=cell)
        (_, before, _, _), (_, way, speed, friction) = block.run(dt, 1.0)[-2:]
        errors.append([speed - np.exp(-2.0), way - 0.5 * (1.0 - np.exp(-2.0))])
        assert friction * block.N == pytest.approx(-2.0 * (way - before) / dt, rel=1e-3)
        assert block.contact.dissipation == pytest.approx(0.5 * (1.0 - speed**2), rel=0.02)
    assert (np.abs(errors[1]) <= 0.01).all() and (np.abs(errors[1]) <= 0.6 * np.abs(errors[0])).all()


@pytest.mark.slow
def test_a_film_with_a_limit():
    """A traction of at most mu p: the block is slowed down evenly, and then by the film."""
    fast = Slider(uem.ViscousFriction(2.0, mu=0.05), velocity=1.0)
    t, _, speed, friction = fast.run(0.02, 1.6).T
    limit = 0.05 * fast.N
    # the film takes over at the speed limit / eta
    even = speed > 0.6 * limit
    assert even.sum() > 30 and friction[even] == pytest.approx(-0.05, rel=1e-6)
    assert np.diff(speed[even])[6:] / np.diff(t[even])[6:] == pytest.approx(-limit, rel=5e-3)
    after = t[even][-1] + (speed[even][-1] - 0.5 * limit) / limit
    assert speed[-1] == pytest.approx(0.5 * limit * np.exp(-2.0 * (t[-1] - after)), rel=0.05)


def test_the_tangent_is_consistent():
    """A step with friction that falls with the speed takes no more iterations than Newton's method does."""
    block = Slider(uem.Stribeck(0.5, 0.2, 0.3), velocity=0.2)
    step = next(iter(uem.time_steps(block.problem, 0.01, 0.01)))
    norms = np.array([i.residual for i in step.iterations])
    assert step.newton_iterations <= 5
    assert norms[-1] <= 1e-3 * norms[-2]


def test_statics_has_no_speed():
    """A law of speed is refused there by name; stiction is not."""
    s = scene(COMM, "triangle", [box("triangle", [0.0, 0.0], [1.0, 1.0], [2, 2])])
    u = fem.Function(compat.function_space(s.mesh, 1, (2,)))

    def problem(law):
        contact = uem.Contact(s.tag("low", 0, at(1, 0.0)), uem.RigidPlane([0.0, 0.0], [0.0, 1.0]), friction=law, name="sole")
        return uem.UnitedProblem(linear(u, 1.0), u, contacts=[contact])

    raised(uem.InputError, "contact 'sole': Stribeck needs the speed of slip", lambda: problem(uem.Stribeck(0.3, 0.2, 0.1)))
    problem(uem.Stribeck(0.3, 0.2))
    raised(uem.InputError, "contact 'sole': ViscousFriction needs the speed", lambda: problem(uem.ViscousFriction(1.0)))
    film = uem.Contact(s.tag("low", 0, at(1, 0.0)), uem.RigidPlane([0.0, 0.0], [0.0, 1.0]), friction=uem.ViscousFriction(1.0))
    explicit = uem.Dynamics(uem.lumped_mass(u.function_space, 1.0), scheme=uem.CentralDifferences())
    words = r"ViscousFriction\(field=1.0, mu=inf\), which does not go with CentralDifferences"
    raised(uem.InputError, words, lambda: uem.UnitedProblem(linear(u, 1.0), u, contacts=[film], dynamics=explicit))
    raised(uem.InputError, "eta = -0.1", lambda: uem.ViscousFriction(-0.1))
    raised(uem.InputError, "mu = 0", lambda: uem.ViscousFriction(1.0, mu=0.0))
    raised(uem.InputError, "kinetic = -0.1", lambda: uem.Stribeck(0.3, -0.1))
