"""Contact of bodies of revolution: patch tests, closed forms, the same body in 3D, balances."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import box, clamp, factors, highest, lawful, raised, refused, scene, slow
from revolved_scenes import COMM, Revolved, modulus, rectangle

import uem_dolfinx as uem

E, NU, R = 1000.0, 0.3, 1.5


def pressed(law, p, n, cell="quadrilateral", degree=1, *, hold=True, **how):
    """Two cylinders, one upon the other, pressed along their axis: scene, contact, problem."""
    lower, upper = (rectangle((0, z), (R, z + 1), (k, 3), cell) for z, k in zip((-1, 0), n))
    s = Revolved(lower, upper, cell=cell, degree=degree)
    if hold:
        s.hold_axis(2)
    s.hold(1, -1.0)
    contact = uem.Contact(s.side(1, 0.0, 1), s.side(1, 0.0, 0), **how)
    F = law.residual(s.u, s.v) * ufl.dx + p * s.v[1] * uem.ds(s.side(1, 1.0, 1))
    return s, contact, s.problem(F, [contact], rtol=1e-12)


@pytest.mark.parametrize(
    ("cell", "degree"), [("quadrilateral", 1), slow("quadrilateral", 2), slow("triangle", 1), ("triangle", 2)]
)
@pytest.mark.parametrize(
    ("coupling", "n"), [("node_to_surface", (4, 4)), slow("mortar", (4, 4)), ("mortar", (5, 3)), slow("mortar", (3, 7))]
)
def test_patch(coupling, n, cell, degree):
    """A uniaxial pressure is transmitted, also at the axis, where a node's area is that of the disc around it; no node has to be held."""
    p = 3.0
    for hold in (True, False):
        s, contact, problem = pressed(
            uem.LinearElastic(E, NU, kind="axisymmetric"), p, n, cell, degree, hold=hold, coupling=coupling
        )
        problem.solve()
        exact = np.stack([NU * p / E * s.X[:, 0], -p / E * (s.X[:, 1] + 1)], axis=1)
        assert highest(COMM, np.abs(s.U - exact)) < 1e-11 * p / E
        assert highest(COMM, np.abs(contact.pressures / p - 1)) < 1e-11
        assert contact.resultant().force == pytest.approx([0.0, p * np.pi * R**2], rel=1e-11)
        assert contact.resultant().normal == pytest.approx(p * np.pi * R**2, rel=1e-11)
        assert uem.integrate(contact.pressure * uem.ds(s.side(1, 0.0, 1))) == pytest.approx(p * np.pi * R**2, rel=1e-11)
        lawful(contact, force=p)


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
@pytest.mark.parametrize(("degree", "coupling"), [(1, "mortar"), (2, "node_to_surface"), (2, "mortar")])
def test_pressures_to_integrate(degree, coupling, cell):
    """The integral over a contactor that overhangs its target is the normal force, which holds what presses on the top."""
    p = 3.0
    s = Revolved(rectangle((0, -1), (1, 0), (4, 3), cell), rectangle((0, 0), (1.3, 1), (5, 3), cell), cell=cell, degree=degree)
    s.hold_axis(2)
    s.hold(1, -1.0)
    foot = s.side(1, 0.0, 1)
    contact = uem.Contact(foot, s.side(1, 0.0, 0), coupling=coupling)
    law = uem.LinearElastic(E, NU, kind="axisymmetric")
    s.problem(law.residual(s.u, s.v) * ufl.dx + p * s.v[1] * uem.ds(s.side(1, 1.0, 1)), [contact], rtol=1e-12).solve()
    assert contact.resultant().normal == pytest.approx(p * np.pi * 1.3**2, rel=1e-4)
    total = uem.integrate(contact.pressure_to_integrate() * uem.ds(foot))
    assert total == pytest.approx(contact.resultant().normal, rel=1e-10)


@pytest.mark.parametrize(("coupling", "n"), [("node_to_surface", (4, 4)), ("mortar", (5, 3))])
def test_tied_cylinders_are_pulled(coupling, n):
    """A uniaxial tension is transmitted by the tie."""
    p = -3.0
    s, contact, problem = pressed(uem.LinearElastic(E, NU, kind="axisymmetric"), p, n, coupling=coupling, tied=True)
    problem.solve()
    exact = np.stack([NU * p / E * s.X[:, 0], -p / E * (s.X[:, 1] + 1)], axis=1)
    assert highest(COMM, np.abs(s.U - exact)) < 1e-11 * abs(p) / E
    assert highest(COMM, np.abs(contact.pressures / p - 1)) < 1e-11
    assert contact.resultant().force == pytest.approx([0.0, p * np.pi * R**2], rel=1e-11)


@pytest.mark.long
@pytest.mark.parametrize("coupling", [slow("node_to_surface"), "mortar"])
def test_true_pressures(coupling):
    """In large strains a dead load is a pressure per drawn area, and the true one that of the circle as it is now."""
    p, found = 300.0, {}
    for measure in ("reference", "current"):
        law = uem.NeoHooke(E, NU, kind="axisymmetric")
        s, contact, problem = pressed(law, p, (3, 3), coupling=coupling, measure=measure)
        problem.solve()
        found[measure] = contact.pressures
        top = highest(COMM, s.U[:, 0])
    assert top > 0.05
    assert highest(COMM, np.abs(found["reference"] / p - 1)) < 1e-9
    assert highest(COMM, np.abs(found["current"] / p * (1 + top / R) ** 2 - 1)) < 1e-9


def test_moments_are_about_a_point():
    """The resultant lies on the axis: its moment is zero about points there, and that of the axial force about others."""
    s, contact, problem = pressed(uem.LinearElastic(E, NU, kind="axisymmetric"), 1.0, (3, 3))
    problem.solve()
    assert contact.resultant().moment == pytest.approx([0.0], abs=1e-12)
    assert contact.resultant([2.0, 0.0]).moment == pytest.approx([-2.0 * np.pi * R**2])
    assert problem.reaction(s.side(1, -1.0)) == pytest.approx([0.0, np.pi * R**2])


def sphere_on_plane(n, degree, coupling="node_to_surface", depth=0.01):
    """A rigid sphere pressed into a block, whose cells are fine where they touch: scene, contact, ball."""
    size, radius = 4.0, 8.0
    b = rectangle((0, -1), (1, 0), (n, n)).mapped(lambda x: size * np.stack([x[:, 0] ** 2, -(x[:, 1] ** 2)], axis=1))
    s = Revolved(b, degree=degree)
    s.hold_axis()
    s.hold(1, -size)
    ball = uem.RigidSphere((0, radius), radius)
    contact = uem.Contact(s.side(1, 0.0), ball, coupling=coupling)
    F = uem.LinearElastic(E, NU, kind="axisymmetric").residual(s.u, s.v) * ufl.dx
    problem = s.problem(F, [contact], load=lambda t: ball.move((0, -depth * t)) and None)
    list(uem.load_steps(problem, 1))
    return contact, 4 / 3 * E / (1 - NU**2) * np.sqrt(radius) * depth**1.5, np.sqrt(radius * depth)


@pytest.mark.parametrize(("degree", "coupling"), [(1, "node_to_surface"), (2, "node_to_surface"), slow(2, "mortar")])
def test_hertz(degree, coupling):
    """Force, radius of contact and pressure at the axis of a rigid sphere, as of a half space."""
    contact, force, a = sphere_on_plane(36, degree, coupling)
    assert coupling == "mortar" or lawful(contact, force=force) is None
    # the block is 14 times as wide as the contact, and held below
    assert contact.resultant().force[1] == pytest.approx(-force, rel=0.06)
    x, p = contact.points[:, 0], contact.pressures
    touching = highest(COMM, x[p > 0])
    # as far as the next circle of nodes
    assert touching == pytest.approx(a, rel=0.13)
    peak = 1.5 * force / (np.pi * a**2)
    inside = x < 0.7 * a
    assert highest(COMM, np.abs(p[inside] / (peak * np.sqrt(1 - (x[inside] / a) ** 2)) - 1)) < 0.04


@pytest.mark.long
def test_the_same_as_a_wedge_in_3d():
    """A rigid sphere on a cylinder of rubber, and on a slice of 6 degrees of it in 3D: forces, and displacements along the top."""
    n, height, depth, radius, angle = 8, 0.8, 0.08, 2.0, np.radians(6.0)
    s = Revolved(rectangle((0, -height), (1, 0), (n, 5)))
    s.hold_axis()
    s.hold(1, -height)
    s.hold(1, -height, component=0)
    ball = uem.RigidSphere((0, radius), radius).move((0, -depth))
    law = uem.NeoHooke(E, NU, kind="axisymmetric")
    contact = uem.Contact(s.side(1, 0.0), ball, max_penetration=1.0)
    s.problem(law.residual(s.u, s.v) * ufl.dx, [contact]).solve()
    # from close to the axis on, in cells of the same cross section
    r0 = 1e-3
    body = box("hexahedron", (r0, -0.5, -height), (1, 0.5, 0), (n, 1, 5))

    def turn(x):
        return np.stack([x[:, 0] * np.cos(angle * x[:, 1]), x[:, 0] * np.sin(angle * x[:, 1]), x[:, 2]], axis=1)

    w = scene(COMM, "hexahedron", [body], pose=turn)
    V = uem.function_space(w.mesh, 1, (3,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    bottom, top, inner = (w.tag(name, 0, on) for name, on in (
        ("bottom", lambda x: np.abs(x[:, 2] + height) < 1e-9), ("top", lambda x: np.abs(x[:, 2]) < 1e-9),
        ("inner", lambda x: np.abs(x[:, 0] - r0) < 1e-9),
    ))  # fmt: skip
    # the symmetry of the slice: little moves across its sides
    sides = [w.tag("side", 0, lambda x, y=y: np.abs(x[:, 1] - y) < 1e-9) for y in (-0.5, 0.5)]
    normals = [np.array([np.sin(-angle / 2), -np.cos(angle / 2), 0.0]), np.array([np.sin(angle / 2), -np.cos(angle / 2), 0.0])]
    stiff = 1e6 * E
    F = uem.NeoHooke(E, NU).residual(u, v) * ufl.dx
    for side, normal in zip(sides, normals):
        m = ufl.as_vector(list(np.array([1.0, 1.0, 0.0]) * normal))
        F += stiff * ufl.dot(u, m) * ufl.dot(v, m) * uem.ds(side)
    bcs = [*clamp(V, bottom, 0), *clamp(V, bottom, 1), *clamp(V, bottom, 2), *clamp(V, inner, 0), *clamp(V, inner, 1)]
    rigid = uem.RigidSphere((0, 0, radius), radius).move((0, 0, -depth))
    touch = uem.Contact(top, rigid, max_penetration=1.0)
    uem.UnitedProblem(F, u, bcs=bcs, contacts=[touch]).solve()
    assert touch.resultant().force[2] * 2 * np.pi / np.sin(angle) == pytest.approx(contact.resultant().force[1], rel=0.01)
    assert touch.max_pressure() == pytest.approx(contact.max_pressure(), rel=0.05)


@pytest.mark.parametrize(("degree", "coupling"), [(1, "mortar"), (2, "node_to_surface")])
def test_press_fit(degree, coupling):
    """A shaft too large for its hub, between two planes: Lame's pressure, which the radial forces of whole circles make."""
    a, b, c, delta, height = 0.4, 1.0, 2.0, 1e-4, 0.25
    inner = rectangle((a, 0), (b + delta, height), (6, 2))
    outer = rectangle((b, 0), (c, height), (8, 2 if degree == 2 else 3))
    s = Revolved(inner, outer, degree=degree)
    for body in (0, 1):
        s.hold(1, 0.0, body)
        s.hold(1, height, body)
    moduli = 2000.0, 1000.0
    law = uem.LinearElastic(modulus(s, *moduli), NU, kind="axisymmetric")
    contact = uem.Contact(s.side(0, b + delta, 0), s.side(0, b, 1), coupling=coupling)
    s.problem(law.residual(s.u, s.v) * ufl.dx, [contact]).solve()
    shaft, hub = ((1 + NU) / E * b for E in moduli)
    gives = shaft * ((1 - 2 * NU) * b**2 + a**2) / (b**2 - a**2) + hub * ((1 - 2 * NU) * b**2 + c**2) / (c**2 - b**2)
    assert highest(COMM, np.abs(contact.pressures / (delta / gives) - 1)) < (0.01 if degree == 1 else 1e-3)
    assert contact.resultant().force == pytest.approx([0.0, 0.0], abs=1e-12)
    assert contact.balance().force < 1e-12
    normal = contact.resultant().normal
    assert normal == pytest.approx(2 * np.pi * b * height * delta / gives, rel=0.01)
    assert uem.integrate(contact.pressure_to_integrate() * uem.ds(s.side(0, b + delta, 0))) == pytest.approx(normal, rel=1e-10)


def punch_and_base(mu, **how):
    """A finer, narrower cylinder over a wider one, with friction: scene and contact."""
    s = Revolved(rectangle((0, -1), (2, 0), (8, 4)), rectangle((0, 0), (1, 0.8), (6, 4)))
    s.hold_axis(2)
    s.hold(1, -1.0)
    s.hold(1, -1.0, component=0)
    s.hold(1, 0.8, 1, value=-0.02)
    return s, uem.Contact(s.side(1, 0.0, 1), s.side(1, 0.0, 0), friction=mu, **how)


def punch(mu, **how):
    """Both of an elastic law: scene, law, contact, problem."""
    s, contact = punch_and_base(mu, **how)
    law = uem.StVenantKirchhoff(modulus(s, 1000.0, 3000.0), NU, kind="axisymmetric")
    return s, law, contact, s.problem(law.residual(s.u, s.v) * ufl.dx, [contact])


@pytest.mark.long
@pytest.mark.parametrize("coupling", [slow("node_to_surface"), "mortar"])
def test_energy_of_friction(coupling):
    """What drives a punch is stored, but for what friction takes; its tractions are within the cone at every circle."""
    s, law, contact, problem = punch(0.1, coupling=coupling)
    work = before = 0.0
    for _ in uem.load_steps(problem, 5):
        now = problem.reaction(s.side(1, 0.8, 1))[1]
        work, before = work - 0.5 * (before + now) * 0.004, now
    stored = uem.integrate(law.energy(s.u) * ufl.dx)
    assert contact.dissipation > 1e-3 * work
    assert stored + contact.dissipation == pytest.approx(work, rel=2e-3)
    tau, p = contact.traction.x.array.reshape(-1, 2)[contact.nodes], contact.pressures
    assert highest(COMM, np.linalg.norm(tau, axis=1) - 0.1 * p) < 1e-9 * highest(COMM, p)
    assert contact.resultant().force[1] == pytest.approx(-before, rel=1e-7)


@pytest.mark.parametrize("mu", [0.0, 0.2])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_newton_is_quadratic(coupling, mu):
    """With the curvature of the contact of circles, which grow as they go outward."""
    *_, problem = punch(mu, coupling=coupling)
    histories = [step.iterations for step in uem.load_steps(problem, 2)]
    assert max(len(history) for history in histories) < 10
    assert max(max(factors(history), default=0.0) for history in histories) < 30.0


def test_bodies_that_only_contact_holds():
    """A cylinder falls along the axis until its support takes it; it cannot fall to the side, or turn."""
    s = Revolved(rectangle((0, -1), (1, 0), (3, 3)), rectangle((0, 0.05), (1, 1.05), (3, 3)))
    s.hold(1, -1.0)
    law, weight = uem.LinearElastic(E, NU, kind="axisymmetric"), 2.0
    F = law.residual(s.u, s.v) * ufl.dx + weight * s.v[1] * ufl.dx
    contact = uem.Contact(s.side(1, 0.05, 1), s.side(1, 0.0, 0))
    s.problem(F, [contact]).solve()
    assert contact.resultant().force[1] == pytest.approx(weight * np.pi, rel=1e-9)
    s = Revolved(rectangle((0, 0), (1, 1), (3, 3)))
    F = law.residual(s.u, s.v) * ufl.dx + weight * s.v[1] * ufl.dx
    above = uem.Contact(s.side(1, 1.0), uem.RigidPlane((0, 2), (0, -1)))
    found = refused(uem.FloatingBodyError, ["moves along (0, -1)"], lambda: s.problem(F, [above]).solve())
    assert "turns" not in str(found)


def test_a_plane_problem_beside():
    """Of two meshes in one program, the one that has not been declared stays plane."""
    pressed(uem.LinearElastic(E, NU, kind="axisymmetric"), 1.0, (2, 2))
    plane = scene(COMM, "quadrilateral", [box("quadrilateral", (0, 0), (2, 3), (2, 2))])
    assert uem.integrate(fem.Constant(plane.mesh, 1.0) * ufl.dx) == pytest.approx(6.0)


@pytest.mark.long
@pytest.mark.parametrize("coupling", ["node_to_surface", slow("mortar")])
def test_checkpoints(coupling, folder):
    """A run with plasticity and friction that was left continues from its file as it would have; not as one with another law."""

    def make(strength=5.0):
        s, contact = punch_and_base(0.1, coupling=coupling)
        law = uem.VonMises(s.u, 1000.0, NU, strength, 10.0, kind="axisymmetric")
        return s, s.problem(law.residual(s.v), [contact], materials=[law]), contact, law

    path = folder / "run"
    whole, problem, _, _ = make()
    list(uem.load_steps(problem, 3))
    for step in uem.load_steps(make()[1], 3, checkpoint=uem.Checkpoint(path, every=1)):
        if step.number == 1:
            break
    s, problem, contact, law = make()
    steps = list(uem.load_steps(problem, 3, checkpoint=uem.Checkpoint(path, every=1)))
    assert [step.number for step in steps] == [2, 3]
    assert highest(COMM, np.abs(s.U - whole.U)) < 1e-13
    assert contact.dissipation > 0.0 and law.dissipation() > 0.0
    raised(uem.CheckpointError, "yield_stress", lambda: uem.read_checkpoint(path, make(strength=6.0)[1].state()))
