"""Scenes in which several features meet: the same in all units, continued from a checkpoint, and after a failed attempt.

The test to read first is ``test_units``.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import M, at, box, clamp, linear, modulus, scene
from restart_scenes import COMM, bits

import uem_dolfinx as uem
from uem_dolfinx import compat


class Blocks:
    """A block of width 1 on one of width 2, of size L and stiffness S; ``led(way)`` gives the lid a way, in parts of L."""

    def __init__(self, L: float, S: float, gap: float = 0.0, layers: int = 3):
        self.L, self.S = L, S
        bodies = [
            box("quadrilateral", [0.0, -1.0], [2.0, 0.0], [10, 4]),
            box("quadrilateral", [0.45, gap], [1.45, 0.5 + gap], [7, layers]),
        ]
        self.scene = scene(COMM, "quadrilateral", bodies, pose=lambda x: L * x)
        self.mesh, tag = self.scene.mesh, self.scene.tag
        self.V = compat.function_space(self.mesh, 1, (2,))
        self.u, self.v = fem.Function(self.V), ufl.TestFunction(self.V)
        self.F = uem.NeoHooke(S, 0.3, "plane_strain").residual(self.u, self.v) * ufl.dx
        self.top, self.foot, self.lid = tag("top", 0, at(1, 0.0)), tag("foot", 1, at(1, gap)), tag("lid", 1, at(1, 0.5 + gap))
        self.bcs, self.way = clamp(self.V, tag("base", 0, at(1, -1.0))), fem.Constant(self.mesh, np.zeros(2))

    def led(self) -> fem.Constant:
        self.bcs.append(fem.dirichletbc(self.way, fem.locate_dofs_topological(self.V, 1, self.lid.entities), self.V))
        return self.way

    def soft(self) -> Any:
        """Weak springs at the lid."""
        return 1e-3 * self.S / self.L * ufl.inner(self.u, self.v) * uem.ds(self.lid, self.mesh)


@dataclass
class Meeting:
    blocks: Blocks
    problem: uem.UnitedProblem
    steps: Callable[..., Iterator[Any]]


def meeting(b, contacts, steps, F=None, **how):
    contacts = contacts if isinstance(contacts, list) else [contacts]
    problem = uem.UnitedProblem(b.F if F is None else F, b.u, bcs=b.bcs, contacts=contacts, petsc_options_prefix="meet_", **how)
    return Meeting(b, problem, lambda checkpoint=None: steps(problem, checkpoint))


def loads(n):
    return lambda problem, checkpoint: uem.load_steps(problem, n, checkpoint=checkpoint)


def friction_under_a_coupling(L, S):
    b = Blocks(L, S)
    f = fem.Constant(b.mesh, (0.0, 0.0))
    lid = uem.RigidCoupling(b.lid, [0.95 * L, 0.5 * L], force=f)
    contact = uem.Contact(b.foot, b.top, friction=0.3, coupling="mortar")
    return meeting(b, contact, loads(4), couplings=[lid], load={f: (0.01 * S * L, -0.06 * S * L)})


def soft_in_general(L, S):
    b = Blocks(L, S)
    return meeting(b, uem.GeneralContact(normal=uem.SoftContact(20 * S / L)), loads(4), load={b.led(): (0.02 * L, -0.05 * L)})


def adhesion_pulled_off(L, S):
    b = Blocks(L, S)
    contact = uem.Contact(b.foot, b.top, cohesion=uem.Adhesion(0.002 * S * L, 0.2 * S))
    return meeting(b, contact, loads(5), load={b.led(): (0.0, 0.02 * L)})


def wear_in_steps(L, S):
    b = Blocks(L, S)
    way = b.led()
    steps = [uem.Step(loads={way: (0.0, -0.05 * L)}, n=2), uem.Step(loads={way: (0.2 * L, -0.05 * L)}, n=4)]
    return meeting(b, uem.Contact(b.foot, b.top, friction=0.3, wear=1e-2 / S), loads(steps))


def self_contact_with_friction(L, S):
    b = Blocks(L, S)
    return meeting(b, uem.GeneralContact(friction=0.2, self_contact=True), loads(4), load={b.led(): (0.1 * L, -0.05 * L)})


def arc_with_friction(L, S):
    b = Blocks(L, S)
    P = fem.Constant(b.mesh, 0.0)
    F = b.F + b.soft() + P * (b.v[1] + 0.2 * b.v[0]) * uem.ds(b.lid, b.mesh)

    def steps(problem, checkpoint):
        return uem.load_steps(problem, 4, arc_length=True, checkpoint=checkpoint)

    return meeting(b, uem.Contact(b.foot, b.top, friction=0.3), steps, F=F, load={P: 0.06 * S})


def follower_load_and_self_contact(L, S):
    b = Blocks(L, S)
    P, n, D = fem.Constant(b.mesh, 0.0), ufl.FacetNormal(b.mesh), ufl.Identity(2) + ufl.grad(b.u)
    F = b.F + b.soft() + P * ufl.dot(ufl.det(D) * ufl.inv(D).T * n, b.v) * uem.ds(b.lid, b.mesh)
    return meeting(b, uem.GeneralContact(self_contact=True, friction=0.1), loads(4), F=F, load={P: 0.1 * S})


def cohesion_pressed_then_sheared(L, S):
    b = Blocks(L, S)
    P, way = fem.Constant(b.mesh, 0.0), b.led()
    law = uem.Cohesive(0.05 * S, 0.001 * S * L, stiffness=50 * S / L)
    contact = uem.Contact(b.foot, b.top, cohesion=law, friction=0.2, sliding="small")
    steps = [uem.Step(loads={P: 0.02 * S / L}, n=2), uem.Step(loads={way: (0.06 * L, -0.01 * L)}, n=4)]
    return meeting(b, contact, loads(steps), F=b.F + P * b.v[1] * ufl.dx)


def explicit_steps_with_friction(L, S, contact=None, layers=3, contactors="massy", speed=0.015, end=0.7):
    b = Blocks(L, S, gap=0.01, layers=layers)
    velocity = fem.Function(b.V)
    velocity.x.array.reshape(-1, 2)[b.V.tabulate_dof_coordinates()[:, 1] > 0.005 * L] = np.sqrt(S) * np.array([speed, -0.05])
    how = {"velocity": velocity, "scheme": uem.CentralDifferences(), "contactors": contactors}

    def steps(problem, checkpoint):
        return uem.time_steps(problem, None, end * L / np.sqrt(S), checkpoint=checkpoint)

    own = uem.GeneralContact(friction=0.3) if contact is None else contact(b)
    return meeting(b, own, steps, dynamics=uem.Dynamics(uem.lumped_mass(b.V, 1.0), **how))


def explicit_steps_by_mortar(L, S):
    def contact(b):
        return uem.Contact(b.foot, b.top, friction=0.3, coupling="mortar")

    return explicit_steps_with_friction(L, S, contact, 6, "massless", 0.03, 1.5)


def adhesion_in_time(L, S):
    b = Blocks(L, S, gap=0.002, layers=6)
    velocity = fem.Function(b.V)
    velocity.x.array.reshape(-1, 2)[b.V.tabulate_dof_coordinates()[:, 1] > 0.001 * L, 1] = -0.02 * np.sqrt(S)

    def steps(problem, checkpoint):
        return uem.time_steps(problem, 0.05 * L / np.sqrt(S), 0.4 * L / np.sqrt(S), checkpoint=checkpoint)

    contact = uem.Contact(b.foot, b.top, cohesion=uem.Adhesion(0.0002 * S * L, 0.05 * S))
    return meeting(b, contact, steps, dynamics=uem.Dynamics(uem.lumped_mass(b.V, 1.0), velocity=velocity))


def slider_and_adhesion(L, S):
    b = Blocks(L, S)
    P, middle = fem.Constant(b.mesh, 0.0), (0.95 * L, 0.5 * L)
    lid = uem.RigidCoupling(b.lid, middle)
    slider = uem.Slider(None, lid, middle, axis=(0.0, 1.0), stiffness=0.5 * S)
    contact = uem.Contact(b.foot, b.top, cohesion=uem.Adhesion(0.002 * S * L, 0.2 * S), coupling="mortar")
    F = b.F - P * b.v[1] * uem.ds(b.lid, b.mesh)

    def steps(problem, checkpoint):
        for step in uem.load_steps(problem, 4, checkpoint=checkpoint):
            # pulled at the lid, held by the spring and by what attracts the foot
            left = contact.resultant().force[1] + step.factor * 0.04 * S * L - 0.5 * S * slider.displacement
            assert abs(left) <= 1e-10 * S * L and slider.displacement > 0.0
            yield step

    return meeting(b, contact, steps, F=F, couplings=[lid, slider], load={P: 0.04 * S})


def soft_in_general_under_a_coupling(L, S):
    b = Blocks(L, S)
    f = fem.Constant(b.mesh, (0.0, 0.0))
    lid = uem.RigidCoupling(b.lid, (0.95 * L, 0.5 * L), force=f, motion=(0.0, None, None))
    contact = uem.GeneralContact(normal=uem.SoftContact(20 * S / L))
    return meeting(b, contact, loads(4), couplings=[lid], load={f: (0.0, -0.06 * S * L)})


def leak_and_wear(L, S):
    b = Blocks(L, S)
    way = b.led()
    steps = [uem.Step(loads={way: (0.0, -0.05 * L)}, n=2), uem.Step(loads={way: (0.2 * L, -0.05 * L)}, n=4)]
    leak = uem.Leak(0.01 * S, b.scene.tag("inlet", 1, at(0, 0.45)))
    return meeting(b, uem.Contact(b.foot, b.top, friction=0.3, wear=1e-2 / S, leak=leak), loads(steps))


def cohesion_in_general(L, S):
    b = Blocks(L, S)
    law = uem.Cohesive(0.05 * S, 0.001 * S * L, stiffness=50 * S / L)
    bonds = uem.Contact(b.foot, b.top, cohesion=law, friction=0.2, sliding="small", coupling="mortar")
    contacts = [bonds, uem.GeneralContact(friction=0.2, coupling="mortar")]
    return meeting(b, contacts, loads(4), load={b.led(): (0.06 * L, -0.01 * L)})


def film_in_time(L, S):
    b = Blocks(L, S, layers=6)
    T, way = L / np.sqrt(S), b.led()

    def load(t):
        way.value[:] = (0.2 * L * max(t / T - 0.2, 0.0), -0.05 * L * min(t / T / 0.2, 1.0))

    def steps(problem, checkpoint):
        return uem.time_steps(problem, 0.1 * T, 0.8 * T, checkpoint=checkpoint)

    contact = uem.Contact(b.foot, b.top, friction=uem.ViscousFriction(0.1 * S / L * T, mu=0.3), coupling="mortar")
    return meeting(b, contact, steps, load=load, dynamics=uem.Dynamics(uem.lumped_mass(b.V, 1.0)))


def explicit_steps_about_a_hinge(L, S):
    b = Blocks(L, S, gap=0.01)
    pin, velocity = (1.95 * L, 0.51 * L), fem.Function(b.V)
    x = b.V.tabulate_dof_coordinates()[:, :2] - pin
    turning = 0.1 * np.sqrt(S) / L * np.column_stack([-x[:, 1], x[:, 0]])
    velocity.x.array[:] = np.where(x[:, 1:] > -0.505 * L, turning, 0.0).ravel()
    lid = uem.RigidCoupling(b.lid, (0.95 * L, 0.51 * L))
    how = {"velocity": velocity, "scheme": uem.CentralDifferences(), "contactors": "massy"}

    def steps(problem, checkpoint):
        return uem.time_steps(problem, None, 0.7 * L / np.sqrt(S), checkpoint=checkpoint)

    dynamics = uem.Dynamics(uem.lumped_mass(b.V, 1.0), **how)
    return meeting(b, uem.Contact(b.foot, b.top), steps, couplings=[lid, uem.Hinge(lid, None, pin)], dynamics=dynamics)


MEETINGS = [
    friction_under_a_coupling,  soft_in_general, adhesion_pulled_off, wear_in_steps, self_contact_with_friction,
    arc_with_friction, follower_load_and_self_contact, cohesion_pressed_then_sheared, explicit_steps_with_friction, adhesion_in_time,
    slider_and_adhesion, soft_in_general_under_a_coupling, leak_and_wear, cohesion_in_general, film_in_time, explicit_steps_about_a_hinge,
    explicit_steps_by_mortar,
]  # fmt: skip
meetings = pytest.mark.parametrize("make", MEETINGS, ids=lambda f: f.__name__)


def same(own, whole, scale=1e-10):
    """Displacements of two problems at the end are equal, in serial to the last bit (collective)."""
    if COMM.size == 1:
        assert np.array_equal(bits(own.problem.u.x.array), bits(whole.problem.u.x.array))
    a, b = (one.blocks.scene.gather(one.problem.u) for one in (own, whole))
    assert np.abs(a - b).max() <= scale * np.abs(b).max() > 0.0


@pytest.mark.long
@meetings
def test_units(make):
    """In nanometres and gigapascals, and in kilometres, bodies move as in units of one, in as many steps and iterations."""
    done = []
    for L, S in ((1.0, 1.0), (1e-9, 1e9), (1e3, 1e-3)):
        m = make(L, S)
        taken = [(step.number, step.newton_iterations) for step in m.steps()]
        done.append((taken, m.blocks.scene.gather(m.problem.u) / L))
    (taken, reference), *others = done
    assert np.abs(reference).max() > 1e-3
    for other, u in others:
        assert other == taken
        assert np.abs(u - reference).max() <= 1e-9 * np.abs(reference).max()


@pytest.mark.long
@meetings
def test_gone_on_with(make, tmp_path):
    """A run that stops in mid-way, and continues in a new problem, ends as the one left alone."""
    whole, path = make(1.0, 1.0), COMM.bcast(str(tmp_path / "run"))
    n = len(list(whole.steps()))
    first = make(1.0, 1.0)
    for k, _ in enumerate(first.steps(uem.Checkpoint(path)), 1):
        if k == n // 2:
            break
    last = make(1.0, 1.0)
    assert len(list(last.steps(uem.Checkpoint(path)))) == n - n // 2
    same(last, whole)


@pytest.mark.long
def test_other_fields_and_a_tie(tmp_path):
    """What a file has of displacement and temperature is there where ties are read, too."""

    def make():
        b = Blocks(1.0, 1.0)
        W = uem.function_space(b.mesh, [("Lagrange", 1, (2,)), 1])
        w, (v, q) = fem.Function(W), ufl.TestFunctions(W)
        u, T = ufl.split(w)
        F = (ufl.inner(ufl.sym(ufl.grad(u)), ufl.grad(v)) + ufl.inner(ufl.grad(T), ufl.grad(q)) - 0.1 * T * ufl.div(v)) * ufl.dx
        bcs = [uem.dirichlet(W.sub(0), b.scene.tag("base", 0, at(1, -1.0))), uem.dirichlet(W.sub(0), b.lid, 0, 0.05)]
        bcs += [uem.dirichlet(W.sub(1), b.lid, value=1.0), uem.dirichlet(W.sub(1), b.top)]
        return uem.UnitedProblem(F, w, displacement=0, bcs=bcs, contacts=[uem.Contact(b.foot, b.top, tied=True)]), w

    def sizes(w):
        return [uem.integrate(ufl.inner(part, part) * ufl.dx) for part in ufl.split(w)]

    path = COMM.bcast(str(tmp_path / "run"))
    problem, w = make()
    list(uem.load_steps(problem, 2))
    uem.write_checkpoint(path, problem.state())
    other, read = make()
    uem.read_checkpoint(path, other.state())
    assert min(sizes(w)) > 1e-5 and sizes(read) == pytest.approx(sizes(w), rel=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("iterations", [1, 50])
@pytest.mark.parametrize(
    "make", [m for m in MEETINGS if "time" not in m.__name__ and "explicit" not in m.__name__], ids=lambda f: f.__name__
)
def test_after_a_failed_attempt(make, iterations, monkeypatch):
    """A step that was tried, a part of it or all of it, and taken back, is the step without an attempt before, to the last bit."""
    whole, tried, attempt = make(1.0, 1.0), make(1.0, 1.0), uem.UnitedProblem.attempt
    taken = [step.newton_iterations for step in whole.steps()]

    def again(problem, **how):
        # the last step along an arc continues from one that is not committed
        if np.array_equal(problem.u.x.array, problem.committed):
            most, problem.max_iterations = problem.max_iterations, iterations
            with suppress(uem.ConvergenceError):
                attempt(problem, **how)
            problem.max_iterations = most
            problem.restore()
        return attempt(problem, **how)

    monkeypatch.setattr(uem.UnitedProblem, "attempt", again)
    assert [step.newton_iterations for step in tried.steps()] == taken
    same(tried, whole)


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_drawn_until_a_bond_gives_way(coupling):
    """Three guided blocks in series, of which a section that is shortened joins two, and a bond two: its law in closed form."""
    bodies = [box("quadrilateral", [0.0, k - 1.0], [1.0, float(k)], [n, 2]) for k, n in enumerate((1, 2, 4))]
    s = scene(COMM, "quadrilateral", bodies)
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    bcs = [bc for k in range(3) for x in (0.0, 1.0) for bc in clamp(V, s.tag("side", k, at(0, x)), 0)]
    bcs += [bc for k, y in ((0, -1.0), (2, 2.0)) for bc in clamp(V, s.tag("end", k, at(1, y)), 1)]
    section, bonded = ((s.tag("high", k + 1, at(1, float(k))), s.tag("low", k, at(1, float(k)))) for k in range(2))
    strength, most, full, k = 0.02, 5.0, 0.08, M / 3
    bolt = uem.Preload(*section, shortening=lambda t: 0.09 * t, coupling=coupling)
    law = uem.Cohesive(strength, 0.5 * strength * full, stiffness=most)
    joint = uem.Contact(*bonded, cohesion=law, sliding="small", coupling=coupling)
    problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0, 1.0)), u, bcs=bcs, contacts=[bolt, joint])
    first = strength / most
    falls, seen = strength / (full - first), set()
    for step in uem.load_steps(problem, 6):
        way = 0.09 * step.factor
        # the way of blocks and bond; the bond is whole, softens, or is gone
        opening = k * way / (k + most)
        if opening > first:
            opening = min((k * way - falls * full) / (k - falls), way)
        seen.add((opening > first) + (opening >= full))
        assert bolt.carried == pytest.approx(k * (way - opening), rel=1e-11, abs=1e-15)
    assert seen == {0, 1, 2}
