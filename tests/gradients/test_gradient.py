"""Gradients through contact: against differences, forward against adjoint, on any ranks, and where they are refused.

Read first: ``test_of_second_order``, Taylor's test for every kind of control.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx import mesh as dm
from gradient_scenes import SCENES, along, dot, orders, pressed, wave
from helpers import blocks, clamp, linear, modulus, raised, refused, run, slow

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.options import has_hypre
from uem_dolfinx.geometry.axisymmetry import revolved

COMM = MPI.COMM_WORLD


@pytest.mark.slow
@pytest.mark.parametrize("cell, degree, coupling, rigid, law", [*SCENES[:2], *(slow(*scene) for scene in SCENES[2:])])
def test_of_second_order(cell, degree, coupling, rigid, law):
    """``J(h) - J(0) - h J'`` vanishes with h^2 for moduli, fields, loads, prescribed values alone and in fields, and the shape."""
    s = pressed(cell, degree, coupling, rigid, law)
    assert min(orders(s, lambda problem: s.J).values()) >= 1.95


@pytest.mark.long
@pytest.mark.parametrize("cell, degree, coupling, rigid, law", SCENES)
def test_forward_and_adjoint_agree(cell, degree, coupling, rigid, law):
    """The derivative of J along any direction is that of u, put into J."""
    s = pressed(cell, degree, coupling, rigid, law)
    problem, g = s.solve(), s.b.gdim
    direction = [(s.E, 0.3), (s.load, np.arange(1.0, g + 1)), (s.top, np.ones(g)), (s.field, wave(s.field.function_space))]
    direction += [(s.sides, wave(s.b.V, 0.1))] + ([(s.X, wave(s.b.V, 0.05))] if degree == 1 else [])
    du = uem.tangent(problem, direction)
    explicit = ufl.derivative(s.J, s.u, du) + 0.3 * s.field * s.u[g - 1] * ufl.dx + s.E * direction[3][1] * s.u[g - 1] * ufl.dx
    if degree == 1:
        explicit += ufl.derivative(s.J, s.X, direction[5][1])
    adjoint = along(uem.gradient(problem, s.J, [control for control, _ in direction]), [change for _, change in direction])
    assert uem.integrate(ufl.algorithms.expand_derivatives(explicit)) == pytest.approx(adjoint, rel=1e-11)


@pytest.mark.long
def test_a_tangent_that_is_not_symmetric():
    """Under a pressure that follows the surface the adjoint problem has the transposed matrix."""
    b = blocks(COMM, "triangle", 2, 3, overhang=0.25)
    E, v = fem.Constant(b.scene.mesh, 1.0), ufl.TestFunction(b.V)
    push = ufl.cofac(ufl.Identity(2) + ufl.grad(b.u)) * ufl.FacetNormal(b.scene.mesh)
    F = uem.NeoHooke(E, 0.3, kind="plane_strain").residual(b.u, v) * ufl.dx + 0.2 * ufl.inner(push, v) * uem.ds(b.top)
    bcs = [*clamp(b.V, b.bottom), uem.dirichlet(b.V, b.high, 0)]
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[uem.Contact(b.high, b.low)], rtol=1e-13)
    run(problem)
    J = ufl.inner(b.u, b.u) * ufl.dx
    (by,), du = uem.gradient(problem, J, E), uem.tangent(problem, [(E, 1.0)])
    assert uem.integrate(ufl.derivative(J, b.u, du)) == pytest.approx(float(by), rel=1e-11)


@pytest.mark.long
@pytest.mark.parametrize("coupling", [pytest.param("node_to_surface", marks=pytest.mark.slow), "mortar"])
def test_a_body_that_contact_alone_holds(coupling):
    """A block that lies on another by its weight stays where it is across it: derivatives along that motion are zero, others right."""
    b = blocks(COMM, "triangle", 4, 6, overhang=0.25)
    E, weight = fem.Constant(b.scene.mesh, 1.0), fem.Constant(b.scene.mesh, 0.05)
    F = uem.NeoHooke(E, 0.3, kind="plane_strain").residual(b.u, ufl.TestFunction(b.V)) * ufl.dx
    F += weight * ufl.TestFunction(b.V)[1] * ufl.dx
    J = ufl.inner(b.u, b.u) * ufl.dx + 0.1 * b.u[0] * ufl.dx

    def value(h, control):
        before = float(control.value)
        control.value += h
        b.u.x.array[:] = 0.0
        contact = uem.Contact(b.high, b.low, coupling=coupling)
        value.problem = uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact], rtol=1e-13)
        run(value.problem)
        control.value = before
        return uem.integrate(J)

    for control in (E, weight):
        value(0.0, control)
        (by,) = uem.gradient(value.problem, J, control)
        du = uem.tangent(value.problem, [(control, 1.0)])
        assert uem.integrate(ufl.derivative(J, b.u, du)) == pytest.approx(float(by), rel=1e-10)
        assert uem.taylor_test(lambda h, control=control: value(h, control), float(by), 1e-3, 2) >= 1.95


@pytest.mark.parametrize("law", ["neo", "linear"])
def test_the_state_is_left_as_it_was(law):
    """A gradient between two steps changes neither the state nor what comes next."""
    s, ends = pressed("triangle", law=law), []
    for requested in (False, True):
        s.top.value[1] = -0.05
        problem = s.solve()
        if requested:
            before = np.array(s.u.x.array)
            uem.gradient(problem, s.J, s.E)
            assert np.array_equal(before, s.u.x.array)
        s.top.value[1] = -0.06
        history = problem.solve()
        ends.append((np.array(s.u.x.array), len(history)))
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-14 and ends[0][1] == ends[1][1]


@pytest.mark.parametrize("rigid, coupling", [(False, "node_to_surface"), (True, "mortar")])
def test_linear_bodies_are_factorised_once(rigid, coupling):
    """Neither a gradient nor the step after it factorises the stiffness again, which is the same."""
    s = pressed("triangle", law="linear", rigid=rigid, coupling=coupling)
    problem = s.solve()

    def factorisations():
        return uem.timing("factorisation or preconditioner set-up")[0]

    assert (before := factorisations()) > 0
    uem.gradient(problem, s.J, [s.E, s.field])
    uem.tangent(problem, [(s.E, 1.0)])
    assert factorisations() == before
    s.top.value[1] *= 1.001
    problem.solve()
    assert factorisations() == before


def test_a_force_is_a_functional():
    """The force on a support, the residual with a unit vector for its test function; by the modulus of linear bodies it is F / E."""
    s = pressed("quadrilateral", law="linear", coupling="mortar")
    s.load.value[:] = 0.0
    s.sides.x.array[:] = 0.0
    problem = s.solve()
    w = fem.Function(s.b.V)
    compat.set_bc_values(w.x.array, [uem.dirichlet(s.b.V, s.b.top, value=[0.0, 1.0])])
    force = ufl.replace(s.F, {s.v: w})
    assert uem.integrate(force) == pytest.approx(problem.reaction(s.b.top)[1], rel=1e-12)
    (by,) = uem.gradient(problem, force, [s.E])
    assert float(by) == pytest.approx(uem.integrate(force), rel=1e-9)


def test_contactors_that_are_held():
    """Their equations move nodes of the target, of whatever rank: forward and adjoint agree, and J changes by that."""
    b = blocks(COMM, "quadrilateral", 2, 3, overhang=0.25)
    push = fem.Constant(b.scene.mesh, (0.0, -0.02))
    F, J = linear(b.u, 1.0), ufl.inner(b.u, b.u) * ufl.dx

    def value(h):
        push.value[1] = -0.02 + h
        b.u.x.array[:] = 0.0
        bcs = [*clamp(b.V, b.bottom), uem.dirichlet(b.V, b.high, value=push)]
        value.problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[uem.Contact(b.high, b.low)], rtol=1e-13)
        value.problem.solve()
        return uem.integrate(J)

    differences = (value(1e-4) - value(-1e-4)) / 2e-4
    value(0.0)
    (by,) = uem.gradient(value.problem, J, push)
    du = uem.tangent(value.problem, [(push, np.array([0.0, 1.0]))])
    assert by[1] == pytest.approx(differences, rel=1e-6)
    assert uem.integrate(ufl.derivative(J, b.u, du)) == pytest.approx(by[1], rel=1e-10)


@pytest.mark.long
@pytest.mark.skipif(not has_hypre(), reason="needs hypre")
def test_iterative_solvers():
    """CG finds the gradient that a factorisation does."""
    found = []
    for options in (None, {"ksp_type": "cg", "pc_type": "hypre"}):
        s = pressed("hexahedron", petsc_options=options)
        by = uem.gradient(s.solve(), s.J, [s.E, s.top])
        found.append(np.append(by[1], by[0]))
    assert found[0] == pytest.approx(found[1], rel=1e-8)


def test_one_sided_contactors_are_warned_of(caplog):
    """Blocks that touch without force: the gradient is that of one side, and a warning names it."""
    b = blocks(COMM, "triangle", 2, 4)
    E = fem.Constant(b.scene.mesh, 1.0)
    problem = uem.UnitedProblem(
        linear(b.u, E), b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top)], contacts=[uem.Contact(b.high, b.low)]
    )
    run(problem)
    (by,) = uem.gradient(problem, ufl.inner(b.u, b.u) * ufl.dx, [E])
    assert float(by) == 0.0
    assert any("neither force nor gap" in record.getMessage() for record in caplog.records) or COMM.rank > 0


def test_what_is_refused():
    """What depends on all steps, what is no equilibrium, no functional and no control."""
    s = pressed("triangle")
    problem, J = s.solve(), s.J
    one = "a Constant, a Function, ufl.SpatialCoordinate(mesh) or a ContactParameter"
    refused(
        uem.InputTypeError, f"controls = 1.0: expected a list; each item must be {one}", lambda: uem.gradient(problem, J, 1.0)
    )
    refused(uem.InputTypeError, f"controls[0] = 1.0: expected {one}", lambda: uem.gradient(problem, J, [1.0]))
    refused(uem.InputError, "controls[0] holds the displacement", lambda: uem.gradient(problem, J, [s.u]))
    refused(uem.InputTypeError, "J = 2.0: expected a UFL form", lambda: uem.gradient(problem, 2.0, [s.E]))
    refused(uem.InputTypeError, "problem = 3", lambda: uem.gradient(3, J, [s.E]))
    raised(uem.InputError, "J", lambda: uem.gradient(problem, s.F, [s.E]))
    pair = f"expected a pair of {one} and its change"
    for direction in ([s.E], [(1.0, s.E)], [(s.E, 1.0, 2.0)]):
        refused(uem.InputTypeError, ("direction[0] = ", pair), lambda direction=direction: uem.tangent(problem, direction))
    refused(uem.InputTypeError, "direction = 1.0: expected a list", lambda: uem.tangent(problem, 1.0))
    refused(uem.InputTypeError, "direction = a Constant: expected a list", lambda: uem.tangent(problem, s.E))
    refused(uem.InputError, "direction[0] holds the displacement", lambda: uem.tangent(problem, [(s.u, s.u)]))
    the_change = "the change in direction[0]"
    for control, change, words in (
        (s.load, 1.0, f"{the_change} = 1.0: expected finite numbers of shape (2,)"),
        (s.E, np.nan, f"{the_change} = nan: expected finite numbers"),
        (s.field, s.u, f"{the_change} is a Function of another space: expected one of the control's space"),
        (s.X, s.field, f"{the_change} is a Function of another space: expected one of the mesh's nodes' space"),
    ):
        refused(uem.InputError, words, lambda control=control, change=change: uem.tangent(problem, [(control, change)]))
    for control, change, words in (
        (s.E, "much", f"{the_change} = 'much': expected finite numbers of shape ()"),
        (s.field, 1.0, f"{the_change} = 1.0: expected a Function of the control's space"),
    ):
        refused(uem.InputTypeError, words, lambda control=control, change=change: uem.tangent(problem, [(control, change)]))
    b = blocks(COMM, "triangle", 2, 2)
    F, options = linear(b.u, modulus(b.scene, 1.0, 1.0)), {"bcs": b.oedometer(0.01)}
    J = b.u[0] * ufl.dx
    new = uem.UnitedProblem(F, b.u, contacts=[uem.Contact(b.high, b.low)], **options)
    refused(uem.InputError, "has taken no step", lambda: uem.gradient(new, J, []))
    frictional = uem.UnitedProblem(F, b.u, contacts=[uem.Contact(b.high, b.low, friction=0.3)], **options)
    refused(uem.InputError, "the gradient of a contact with friction depends on all steps", lambda: uem.tangent(frictional, []))
    modified = uem.UnitedProblem(F, b.u, contacts=[uem.Contact(b.high, b.low)], newton="modified", **options)
    refused(uem.InputError, "needs newton='full'", lambda: uem.gradient(modified, J, []))
    fixed = uem.UnitedProblem(F, b.u, contacts=[uem.Contact(b.high, b.low, sliding="fixed")], **options)
    run(fixed)
    X = ufl.SpatialCoordinate(b.scene.mesh)
    refused(uem.InputError, "needs contacts of sliding='finite'", lambda: uem.gradient(fixed, J, X))


def test_where_earlier_steps_ended():
    """sliding='small' projects where the step before has ended: the first step has a gradient, a later one has none."""
    b = blocks(COMM, "quadrilateral", 2, 3)
    E = fem.Constant(b.scene.mesh, 1.0)
    F = uem.LinearElastic(E, 0.3, kind="plane_strain").residual(b.u, ufl.TestFunction(b.V)) * ufl.dx
    J = ufl.inner(b.u, b.u) * ufl.dx
    for steps in (1, 2):
        b.u.x.array[:] = 0.0
        contact = uem.Contact(b.high, b.low, sliding="small")
        problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.01), contacts=[contact])
        with uem.recording(problem) as history:
            for _ in uem.load_steps(problem, steps):
                pass
        for by in (lambda problem=problem: uem.gradient(problem, J, E), lambda history=history: history.gradient(J, E)):
            if steps == 1:
                assert np.isfinite(by()[0]).all()
            else:
                refused(uem.InputError, "where an earlier step ended", by)


@pytest.mark.long
def test_shape_with_mortar_on_hexahedra_is_refused():
    """Facets of hexahedra warp with their nodes; other controls, and nodes in place of mortar, keep their gradients."""
    s = pressed("hexahedron", law="linear", coupling="mortar")
    problem = s.solve()
    refused(uem.InputError, "coupling='mortar' on hexahedra", lambda: uem.gradient(problem, s.J, s.X))
    assert np.isfinite(uem.gradient(problem, s.J, s.E)[0]).all()


@pytest.mark.parametrize("functional, slope", [(lambda h: np.nan, 1.0), (lambda h: h, np.nan), (lambda h: h, 1.0)])
def test_taylor_tests_without_an_order(functional, slope):
    """What is not finite, or leaves nothing, has no order."""
    refused(uem.InputError, "has no order", lambda: uem.taylor_test(functional, slope))
    assert uem.taylor_test(lambda h: 2 * h + h**2, 2.0) == pytest.approx(2.0)


@pytest.mark.parametrize("axisymmetric", [False, True])
@pytest.mark.slow
def test_by_the_shape_from_a_cold_cache(axisymmetric):
    """Code that is compiled anew, by a step or by users' own forms, leaves coordinates in forms what they were."""
    mesh = dm.create_unit_square(COMM, 1, 1)
    c = 2.0 + COMM.bcast(np.random.default_rng().random())  # no code of before serves
    if axisymmetric:
        uem.axisymmetric(mesh)
    V = uem.function_space(mesh, ("Lagrange", 1, (2,)))
    u, v, X = fem.Function(V), ufl.TestFunction(V), ufl.SpatialCoordinate(mesh)
    kind = "axisymmetric" if axisymmetric else "plane_strain"
    F = (c + X[0]) * uem.LinearElastic(1.0, 0.3, kind=kind).residual(u, v) * ufl.dx
    J = (1 + X[0]) * u[1] * ufl.dx
    ends = [dm.locate_entities_boundary(mesh, 1, lambda x, z=z: np.isclose(x[1], z)) for z in (0.0, 1.0)]
    problem = uem.UnitedProblem(F, u, bcs=[uem.dirichlet(V, ends[0]), uem.dirichlet(V, ends[1], 1, -0.05)])
    element = mesh.ufl_domain().ufl_coordinate_element()
    run(problem)
    assert mesh.ufl_domain().ufl_coordinate_element() is element
    fem.form(c * X[0] * u[0] * ufl.dx)
    (by,) = uem.gradient(problem, J, ufl.SpatialCoordinate(mesh))
    du = uem.tangent(problem, [(X, wave(V))])
    whole = revolved(J)
    explicit = ufl.derivative(whole, u, du), forms.by_places(whole, mesh, wave(V))
    assert sum(forms.assemble_scalar(forms.form(one), COMM) for one in explicit) == pytest.approx(dot(by, wave(V)), rel=1e-10)


@pytest.mark.slow
def test_the_shape_with_quadratic_tetrahedra():
    """Nodes in the middle of straight edges move with these."""
    s = pressed("tetrahedron", 2, law="linear")
    assert min(orders(s, lambda problem: s.J, "X").values()) >= 1.95


def test_parameters_that_have_changed():
    """A load, a field, prescribed values, a target, nodes or the displacement of after the step: refused until they are back."""
    s = pressed("triangle", rigid="plane", law="linear")
    problem = s.solve()
    (first,) = uem.gradient(problem, s.J, s.E)
    places, target = s.b.scene.mesh.geometry.x, problem.contacts[0].target
    for values, entry in (
        (s.load.value, 0),
        (s.field.x.array, ...),
        (s.sides.x.array, ...),
        (s.top.value, 1),
        (places, (..., 0)),
    ):
        before = np.array(values)
        values[entry] = 1.01 * values[entry] + 1e-3 * np.sin(np.arange(np.size(values[entry])).reshape(np.shape(values[entry])))
        for ask in (lambda: uem.gradient(problem, s.J, s.E), lambda: uem.tangent(problem, [(s.E, 1.0)])):
            words = "nodes have moved in the mesh" if values is places else "not that of the present parameters"
            refused(uem.InputError, words, ask)
        values[...] = before
    # a thousand times what rtol = 1e-13 leaves of the forces lies between these changes of the load
    loaded = np.array(s.load.value)
    s.load.value[0] = (1 + 2e-10) * loaded[0]
    uem.gradient(problem, s.J, s.E)
    s.load.value[0] = (1 + 3e-9) * loaded[0]
    refused(uem.InputError, "not that of the present parameters", lambda: uem.gradient(problem, s.J, s.E))
    s.load.value[...] = loaded
    s.u.x.array[:] *= 1.001
    refused(uem.InputError, "not that of the present parameters", lambda: uem.gradient(problem, s.J, s.E))
    s.u.x.array[:] /= 1.001
    target.move(np.array([0.0, 0.01]))
    refused(uem.InputError, "not that of the present parameters", lambda: uem.gradient(problem, s.J, s.E))
    target.move(np.zeros(2))
    assert float(uem.gradient(problem, s.J, s.E)[0]) == pytest.approx(float(first), rel=1e-8)
