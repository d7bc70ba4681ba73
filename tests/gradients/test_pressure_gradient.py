"""Gradients of functionals of contact pressures: against differences, forward against adjoint, closed forms, and where there are none.

Read first: ``test_pressures_of_second_order``, Taylor's test for every kind of control.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from corner_scenes import groove
from dolfinx import fem
from gradient_scenes import SCENES, along, orders, pressed, wave
from helpers import blocks, clamp, linear, refused, run, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
CASES = [(*scene, measure) for scene in SCENES for measure in ("reference", "current")]
#: Node to surface with one measure, mortar with the other.
QUICK = [CASES[1], CASES[2]]
BOTH = pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])


@pytest.mark.slow
@pytest.mark.parametrize(
    "cell, degree, coupling, rigid, law, measure", QUICK + [slow(*case) for case in CASES if case not in QUICK]
)
def test_pressures_of_second_order(cell, degree, coupling, rigid, law, measure):
    """``J(h) - J(0) - h J'`` vanishes with h^2 for functionals of the contact pressure."""
    s = pressed(cell, degree, coupling, rigid, law, measure)
    assert min(orders(s, s.of_pressures).values()) >= 1.95


@pytest.mark.slow
@BOTH
def test_pressures_past_the_ends_of_the_target(coupling):
    """Likewise on contactor facets that the target covers in part, or not at all."""
    s = pressed("triangle", 1, coupling, overhang=-0.15)
    assert min(orders(s, s.of_pressures, "E", "X").values()) >= 1.95


@pytest.mark.long
@pytest.mark.parametrize(
    "cell, degree, coupling, rigid, law, measure", QUICK + [slow(*case) for case in CASES if case not in QUICK]
)
def test_forward_and_adjoint_agree(cell, degree, coupling, rigid, law, measure):
    """The derivative of J along any direction is that of u and of the pressure, put into J."""
    s = pressed(cell, degree, coupling, rigid, law, measure)
    problem, g = s.solve(), s.b.gdim
    direction = [(s.E, 0.3), (s.load, np.arange(1.0, g + 1)), (s.top, np.ones(g)), (s.field, wave(s.field.function_space))]
    direction += [(s.sides, wave(s.b.V, 0.1))] + ([(s.X, wave(s.b.V, 0.05))] if degree == 1 else [])
    p = problem.contacts[0].pressure
    J, du, dp = s.of_pressures(problem), uem.tangent(problem, direction), uem.tangent(problem, direction, of=p)
    explicit = ufl.derivative(J, s.u, du) + ufl.derivative(J, p, dp) + 0.3 * 0.1 * p * ufl.ds
    if degree == 1:
        explicit += ufl.derivative(J, s.X, direction[5][1])
    adjoint = along(uem.gradient(problem, J, [control for control, _ in direction]), [change for _, change in direction])
    assert uem.integrate(ufl.algorithms.expand_derivatives(explicit)) == pytest.approx(adjoint, rel=1e-11)


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron", "hexahedron"])
def test_facets_grow(cell):
    """Derivatives of the areas of facets by their nodes, against differences."""
    problem = pressed(cell, 1, "mortar", law="linear").solve()
    of = problem.contacts[0].pair.discretisation
    facets, x, h = np.arange(len(of.surface.dofs)), of.surface.x, 1e-6
    for a, k in np.ndindex(x.shape[1:]):
        step = h * (np.arange(x.shape[1]) == a)[:, None] * np.eye(x.shape[2])[k]
        found = (of.sizes(x + step) - of.sizes(x - step)) / (2 * h)
        assert np.abs(of.growth(facets, x)[:, a, k] - found).max(initial=0.0) < 1e-9


@BOTH
def test_any_ranks(coupling):
    """All ranks together find what each of them finds by itself."""
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        s = pressed("triangle", 1, coupling, comm=comm)
        problem = s.solve()
        by_E, by_load, by_top, by_field, by_X = uem.gradient(problem, s.of_pressures(problem), [s.E, s.load, s.top, s.field, s.X])
        of_fields = [along([by], [wave(by.function_space)]) for by in (by_field, by_X)]
        found.append([float(by_E), *by_load, *by_top, *of_fields])
    assert found[0] == pytest.approx(found[1], rel=1e-10)


@pytest.mark.long
@BOTH
@pytest.mark.parametrize("rigid", [False, True])
def test_pressures_are_as_the_modulus(coupling, rigid):
    """Where displacements alone are prescribed, pressures are as the modulus: a functional of degree n in p has the derivative n J / E."""
    s = pressed("quadrilateral", 1, coupling, rigid)
    s.load.value[:] = 0.0
    problem = s.solve()
    p, n = problem.contacts[0].pressure, 8
    J = p**n * uem.ds(s.b.high)
    by, of_E = uem.gradient(problem, J, [s.E])[0], n * uem.integrate(J) / float(s.E.value)
    assert float(by) == pytest.approx(of_E, rel=1e-8)
    dp = uem.tangent(problem, [(s.E, 1.0)], of=p)
    assert np.abs(dp.x.array - p.x.array / float(s.E.value)).max() <= 1e-8 * np.abs(p.x.array).max(initial=1.0)


@pytest.mark.long
@BOTH
def test_resultants(coupling):
    """The force that a contact exerts on the contactor is the residual with a unit vector at the contactors, and has a gradient."""
    s = pressed("triangle", 1, coupling)
    w = fem.Function(s.b.V)
    compat.set_bc_values(w.x.array, [uem.dirichlet(s.b.V, s.b.high, value=[0.0, 1.0])])
    force = ufl.replace(s.F, {s.v: w})
    problem = s.solve()
    assert uem.integrate(force) == pytest.approx(problem.contacts[0].resultant().force[1], rel=1e-9)
    assert min(orders(s, lambda problem: force, "field").values()) >= 1.95


@BOTH
def test_a_body_that_contact_alone_holds(coupling):
    """A block that lies on another by its weight bears the same whatever its modulus; pressures grow with the weight."""
    b = blocks(COMM, "triangle", 4, 6, overhang=0.25)
    weight = fem.Constant(b.scene.mesh, 0.05)
    F = linear(b.u, 1.0) + weight * ufl.TestFunction(b.V)[1] * ufl.dx
    contact = uem.Contact(b.high, b.low, coupling=coupling)
    problem = uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact], rtol=1e-13)
    run(problem)
    # the whole of the nodal pressures is the weight of the upper block
    (by,) = uem.gradient(problem, contact.pressure * uem.ds(b.high), [weight])
    assert float(by) == pytest.approx(1.0, rel=1e-3)
    dp = uem.tangent(problem, [(weight, 1.0)], of=contact.pressure)
    assert uem.integrate(dp * uem.ds(b.high)) == pytest.approx(float(by), rel=1e-10)


def test_what_has_no_gradient():
    """Other results of contacts, those of other problems, and pressures that several equations make together."""
    s = pressed("triangle")
    old, problem = s.solve(), s.solve()
    contact = problem.contacts[0]
    for field in (contact.gap, contact.active, old.contacts[0].pressure):
        J = field * uem.ds(s.b.high)
        refused(uem.InputError, (field.name, "a result of a contact"), lambda J=J: uem.gradient(problem, J, [s.E]))
    J, p = s.of_pressures(problem), contact.pressure
    refused(uem.InputError, f"controls[0] holds '{p.name}'", lambda: uem.gradient(problem, J, [p]))
    for of in (s.u, old.contacts[0].pressure, "pressure"):
        refused(uem.InputTypeError, "expected the pressure of a contact", lambda of=of: uem.tangent(problem, [], of=of))
    b = blocks(COMM, "triangle", 2, 2, overhang=0.25)
    contact = uem.Contact(b.high, b.low)
    driven = [*clamp(b.V, b.bottom), *clamp(b.V, b.high, value=[0.0, -0.01])]
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=[*driven, *clamp(b.V, b.top)], contacts=[contact])
    run(problem)
    J = contact.pressure * uem.ds(b.high)
    refused(uem.InputError, "equations of contactors conflict", lambda: uem.gradient(problem, J, []))
    corner = groove("triangle", 80.0, 64.0, 0.0, (0.02, 0.0), (-0.05, -0.01), tilt=0.0, floor=True)
    run(corner.problem)
    J = corner.contact.pressure * ufl.ds
    refused(uem.InputError, "a concave corner of the target holds contactors", lambda: uem.gradient(corner.problem, J, []))
    refused(uem.InputError, "a concave corner", lambda: uem.tangent(corner.problem, [], of=corner.contact.pressure))
    b = blocks(COMM, "triangle", 2, 2)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0, -0.01])]
    many = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[uem.GeneralContact()])
    run(many)
    J = many.contacts[0].pressure * ufl.ds
    refused(uem.InputError, "nodes at sharp edges of the contactor touch", lambda: uem.gradient(many, J, []))
