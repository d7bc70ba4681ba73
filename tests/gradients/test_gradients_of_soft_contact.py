"""Gradients through soft contact, by moduli, loads, motions of targets and the Constants of the law; and what is refused.

Read first: ``test_of_second_order``, Taylor's test for every law and coupling.
"""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from gradient_scenes import SCENES, along, orders, pressed, wave
from helpers import at, blocks, clamp, linear, refused, slow

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def numbers(mesh, *values):
    """Constants with values."""
    return [fem.Constant(mesh, value) for value in values]


LAWS = {
    "linear": lambda mesh: uem.SoftContact(*numbers(mesh, 20.0)),
    "exponential": lambda mesh: uem.SoftContact(uem.Exponential(*numbers(mesh, 2e-3, 1e-2))),
    "power": lambda mesh: uem.SoftContact(uem.PowerLaw(*numbers(mesh, 1e-2, 5e-3, 2.0))),
}
CASES = [
    (scene, sliding, law)
    for k, scene in enumerate(SCENES)
    for sliding in ("finite", ("small", "fixed")[k % 2])
    for law in LAWS
    # mortar of degree 2 has no derivatives of areas that change, nodes are tried at finite sliding
    if (sliding == "finite" if scene[2] != "mortar" or scene[3] else sliding != "finite" or scene[1] == 1)
]
QUICK = [(SCENES[0], "finite", "exponential"), (SCENES[1], "finite", "power"), (SCENES[5], "fixed", "exponential")]


def order_by(s, m, J):
    """Taylor's test by a Constant, whose changes are parts of its value."""
    value = float(m.value)
    slope = value * float(uem.gradient(s.solve(), J, m)[0])

    def anew(h):
        m.value = value * (1.0 + h)
        s.solve()
        found = uem.integrate(J)
        m.value = value
        return found

    return uem.taylor_test(anew, slope, 1e-2, 2)


@pytest.mark.slow
@pytest.mark.parametrize("scene, sliding, law", [*QUICK, *(slow(*case) for case in CASES if case not in QUICK)])
def test_of_second_order(scene, sliding, law):
    """``J(h) - J(0) - h J'`` vanishes with h^2 for moduli, fields, loads, prescribed values, and all Constants of the law."""
    s = pressed(*scene, sliding=sliding, normal=LAWS[law])
    assert min(orders(s, lambda problem: s.J, "E", "load", "top", "field", "sides").values()) >= 1.95
    assert s.soft.constants and min(order_by(s, m, s.J) for m in s.soft.constants) >= 1.95


@pytest.mark.parametrize("law", ["exponential", slow("power")])
def test_forward_and_adjoint_agree(law):
    """The derivative of J along any direction is that of u, put into J; the state stays as it was."""
    s = pressed("triangle", normal=LAWS[law])
    problem, J = s.solve(), ufl.inner(s.u, s.u) * ufl.dx
    before = np.array(s.u.x.array)
    direction = [(s.E, 0.3), (s.load, np.array([1.0, 2.0])), (s.sides, wave(s.b.V, 0.1)), *((m, 0.1) for m in s.soft.constants)]
    adjoint = along(uem.gradient(problem, J, [m for m, _ in direction]), [change for _, change in direction])
    du = uem.tangent(problem, direction)
    assert uem.integrate(ufl.derivative(J, s.u, du)) == pytest.approx(adjoint, rel=1e-10)
    assert np.array_equal(before, s.u.x.array)


@pytest.mark.parametrize("parameter, change", [("place", [0.3, 1.0]), ("turn", 1.0)])
def test_motions_of_a_rigid_target(parameter, change):
    """Of second order, too, by the place and the rotation of a rigid plane."""
    s = pressed("triangle", 1, "node_to_surface", "plane", normal=LAWS["exponential"])
    problem = s.solve()
    (by,) = uem.gradient(problem, s.J, uem.ContactParameter(problem.contacts[0], parameter))

    def anew(h):
        s.values[parameter] = h * np.array(change)
        s.solve()
        s.values[parameter] = 0.0 * np.array(change)
        return uem.integrate(s.J)

    assert uem.taylor_test(anew, float(np.sum(by * change)), 1e-3, 2) >= 1.95


def test_closed_form():
    """A stack of blocks under a pressure q closes by ``h log(q / p0)``: derivatives by the law's numbers to 1e-8."""
    h, p0, q = 1e-3, 2e-3, 0.02
    b = blocks(COMM, "quadrilateral", 2, 4)
    mesh = b.scene.mesh
    P0, H, load = numbers(mesh, p0, h, 0.0)
    sides = [(end, part) for end in (0.0, 1.0) for part in (0, 1)]
    bcs = clamp(b.V, b.bottom, 1) + [bc for end, part in sides for bc in clamp(b.V, b.scene.tag("side", part, at(0, end)), 0)]
    F = linear(b.u, 1.0) + load * ufl.TestFunction(b.V)[1] * uem.ds(b.top)
    contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(uem.Exponential(P0, H)))
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], load={load: q}, rtol=1e-13)
    for _ in uem.load_steps(problem, 1):
        pass
    area = uem.integrate(fem.Constant(mesh, 1.0) * uem.ds(b.top))
    by = [float(one) for one in uem.gradient(problem, b.u[1] / area * uem.ds(b.top), [P0, H])]
    assert by == pytest.approx([h / p0, -np.log(q / p0)], rel=1e-8)
    # a Constant of the law that changes is read by the next step
    P0.value = 2 * p0
    problem.solve()
    assert contact.max_pressure() == pytest.approx(q, rel=1e-10)
    assert -contact.gap.x.array[contact.nodes] == pytest.approx(h * np.log(q / p0 / 2), rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("moves", [False, True])
def test_histories(moves):
    """All steps of a recorded run, in statics and in time, by the modulus and by the Constants of the law."""
    b = blocks(COMM, "triangle", 2, 3, overhang=0.25)
    mesh = b.scene.mesh
    E, p0, h, full = numbers(mesh, 1.0, 2e-3, 1e-2, 0.0)
    F = linear(b.u, E) + full * ufl.TestFunction(b.V)[1] * uem.ds(b.top)
    normal = uem.SoftContact(uem.Exponential(p0, h))
    J = ufl.inner(b.u, b.u) * ufl.dx

    def solve():
        b.u.x.array[:] = 0.0
        dynamics = {"dynamics": uem.Dynamics(uem.consistent_mass(b.V, 1.0), contactors="massy")} if moves else {}
        contact = uem.Contact(b.high, b.low, normal=normal)
        bcs = clamp(b.V, b.bottom) + [uem.dirichlet(b.V, b.high, 0)]
        problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], load={full: 0.02}, rtol=1e-13, **dynamics)
        with uem.recording(problem) as history:
            for _ in uem.time_steps(problem, 0.2, 0.6) if moves else uem.load_steps(problem, 2):
                pass
        return history, uem.integrate(J)

    history, _ = solve()
    found = history.gradient(J, [E, p0, h])
    for m, by in zip((E, p0, h), found):
        value = float(m.value)

        def anew(size, m=m, value=value):
            m.value = value * (1.0 + size)
            total = solve()[1]
            m.value = value
            return total

        assert uem.taylor_test(anew, value * float(by), 1e-2, 2) >= 1.95


def test_the_same_on_any_ranks():
    """Gradients agree with those on one rank."""

    found = []
    for comm in (COMM, MPI.COMM_SELF):
        s = pressed("triangle", comm=comm, normal=LAWS["power"])
        found.append([float(by) for by in uem.gradient(s.solve(), s.J, [s.E, *s.soft.constants])])
    assert found[0] == pytest.approx(found[1], rel=1e-9)


def pushed(bulge):
    """A block with a bulging face pressed onto a wider one by a general contact: Constants, a functional, and ``solve``."""
    b = blocks(
        COMM, "triangle", 4, 7, overhang=0.25, gap=0.01,
        pose=lambda x: x + np.where(x[:, 1:] > 5e-3, bulge * (x[:, :1] - 0.5) ** 2, 0.0) * [0.0, 1.0],
    )  # fmt: skip
    E, p0, h = numbers(b.scene.mesh, 1.0, 1e-2, 5e-3)
    soft, F = uem.SoftContact(uem.PowerLaw(p0, h, 2.0)), linear(b.u, E)
    bcs = [*clamp(b.V, b.bottom), uem.dirichlet(b.V, b.top, value=[0.0, -0.02])]

    def solve():
        b.u.x.array[:] = 0.0
        problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[uem.GeneralContact(normal=soft)], rtol=1e-13)
        for _ in uem.load_steps(problem, 1):
            pass
        return problem

    return SimpleNamespace(E=E, soft=soft, J=ufl.inner(b.u, b.u) * ufl.dx + b.u[0] * ufl.dx, solve=solve)


@pytest.mark.slow
def test_general_contact():
    """Away from sharp edges, whose areas turn with the normals of the other body: there it is refused."""
    s = pushed(0.5)
    assert min(order_by(s, m, s.J) for m in (s.E, s.soft.constants[0])) >= 1.95
    s = pushed(0.0)
    problem = s.solve()
    refused(uem.errors.InputError, "sharp edges of the contactor press", lambda: uem.gradient(problem, s.J, s.E))


@pytest.mark.long
def test_what_is_refused():
    """Damping in time, areas that change, the shape, offsets and pressures are refused by name, before any work."""
    soft = LAWS["exponential"]
    for how, words in (
        ({"measure": "current"}, "measure='current'"),
        ({"coupling": "mortar", "degree": 2}, "sliding='small' or 'fixed'"),
        ({"coupling": "mortar", "sliding": "small", "rigid": True}, "a rigid target"),
    ):
        s = pressed("triangle", normal=soft, **how)
        problem = s.solve()
        refused(uem.errors.InputError, words, lambda s=s, problem=problem: uem.gradient(problem, s.J, s.E))
    s = pressed("triangle", normal=soft)
    problem = s.solve()
    refused(uem.errors.InputError, "by the shape with soft contact", lambda: uem.gradient(problem, s.J, s.X))
    offset = uem.ContactParameter(problem.contacts[0], "offset")
    refused(uem.errors.InputError, "which is soft", lambda: uem.gradient(problem, s.J, offset))
    of_pressures = s.of_pressures(problem)
    refused(uem.errors.InputError, "a soft contact", lambda: uem.gradient(problem, of_pressures, s.E))


def test_facets_that_are_covered_in_part():
    """Mortar at finite sliding has no derivatives of areas that end with the target: it is refused."""
    b = blocks(COMM, "triangle", 3, 4, overhang=0.25)
    contact = uem.Contact(b.low, b.high, normal=uem.SoftContact(1.0), coupling="mortar")
    bcs = [*clamp(b.V, b.bottom), uem.dirichlet(b.V, b.top, value=[0.01, -0.02])]
    E = fem.Constant(b.scene.mesh, 1.0)
    problem = uem.UnitedProblem(linear(b.u, E), b.u, bcs=bcs, contacts=[contact])
    for _ in uem.load_steps(problem, 1):
        pass
    refused(uem.errors.InputError, "covered in part", lambda: uem.gradient(problem, ufl.inner(b.u, b.u) * ufl.dx, E))
