"""Gradients through contact: against differences, forward against adjoint, on any ranks, and where they are refused.

Read first: ``test_of_second_order``, Taylor's test for every kind of control.
"""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import blocks, clamp, linear, modulus, raised, refused, run, slow

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra.options import has_hypre

COMM = MPI.COMM_WORLD
SCENES = [
    ("triangle", 1, "node_to_surface", False, "neo"),
    ("triangle", 1, "mortar", False, "neo"),
    ("triangle", 1, "node_to_surface", True, "neo"),
    ("quadrilateral", 1, "mortar", True, "neo"),
    ("triangle", 2, "node_to_surface", False, "neo"),
    ("quadrilateral", 2, "mortar", False, "linear"),
    ("tetrahedron", 1, "mortar", False, "linear"),
    ("hexahedron", 1, "node_to_surface", False, "neo"),
]


def wave(V, size=1.0):
    """A smooth Function, the same on any partition."""
    f = fem.Function(V)
    g = f.ufl_shape[0] if f.ufl_shape else 1
    f.interpolate(lambda x: np.squeeze(np.stack([size * np.sin(3 * x[0] + 2 * x[1] + i + x[2]) for i in range(g)])))
    f.x.scatter_forward()
    return f


def dot(a, b):
    """Product of the entries of two Functions (collective)."""
    V = a.function_space
    n = V.dofmap.index_map.size_local * V.dofmap.index_map_bs
    return COMM.allreduce(float(a.x.array[:n] @ b.x.array[:n]))


def pressed(cell, degree=1, coupling="node_to_surface", rigid=False, law="neo", **options):
    """A block with a bulging face, loaded and pressed onto another or onto a rigid ball, and all that its solution may depend on."""
    bulge = 0.1 if degree == 1 else 0.0
    b = blocks(
        COMM, cell, *((4, 6) if cell in ("triangle", "quadrilateral") else (2, 3)), overhang=0.25, degree=degree,
        pose=lambda x: x + np.where(x[:, -1:] > 0, bulge * (x[:, :1] - 0.5) ** 2, 0.0) * np.eye(x.shape[1])[-1],
    )  # fmt: skip
    mesh, g = b.scene.mesh, b.gdim
    u, v = b.u, ufl.TestFunction(b.V)
    E, load, top = fem.Constant(mesh, 1.0), fem.Constant(mesh, np.full(g, 0.01)), fem.Constant(mesh, np.zeros(g))
    field = fem.Function(compat.function_space(mesh, ("DG", 0)))
    field.interpolate(lambda x: 1.0 + 0.2 * np.sin(5 * x[0] + x[1]))
    top.value[:] = [0.02, *[0.0] * (g - 2), -0.05]
    kind = "plane_strain" if g == 2 else "3d"
    material = uem.NeoHooke(E, 0.3, kind=kind) if law == "neo" else uem.LinearElastic(E, 0.3, kind=kind)
    F = field * material.residual(u, v) * ufl.dx - ufl.inner(load, v) * ufl.dx
    sides = fem.Function(b.V)
    sides.x.array[:] = wave(b.V, 1e-3).x.array
    bcs = [uem.dirichlet(b.V, b.bottom, value=sides)]
    bcs.append(fem.dirichletbc(top, fem.locate_dofs_topological(b.V, g - 1, b.top.entities), b.V))
    target = uem.RigidSphere([0.4] * (g - 1) + [-3.0], 3.0) if rigid else b.low

    def solve():
        u.x.array[:] = 0.0
        contact = uem.Contact(b.high, target, coupling=coupling)
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], rtol=1e-13, **options)
        run(problem)
        return problem

    J = ufl.inner(u, u) * ufl.dx + E * field * u[g - 1] * ufl.dx
    return SimpleNamespace(
        b=b, F=F, J=J, E=E, load=load, top=top, field=field, sides=sides, X=ufl.SpatialCoordinate(mesh), solve=solve, u=u, v=v
    )


def move(s, change, h):
    """Move the nodes of a scene of degree 1."""
    at = np.zeros(len(s.b.scene.mesh.geometry.x), dtype=np.int64)
    at[compat.geometry_dofs(s.b.scene.mesh).ravel()] = compat.cell_dofs(s.b.V).ravel()
    s.b.scene.mesh.geometry.x[:, : s.b.gdim] += h * change.x.array.reshape(-1, s.b.gdim)[at]


@pytest.mark.parametrize("cell, degree, coupling, rigid, law", [*SCENES[:2], *(slow(*scene) for scene in SCENES[2:])])
def test_of_second_order(cell, degree, coupling, rigid, law):
    """``J(h) - J(0) - h J'`` vanishes with h^2 for moduli, fields, loads, prescribed values alone and in fields, and the shape."""
    s = pressed(cell, degree, coupling, rigid, law)
    g = s.b.gdim
    changes = {"E": 1.0, "load": np.eye(g)[-1], "top": np.linspace(1.0, -1.0, g), "field": wave(s.field.function_space)}
    changes |= {"sides": wave(s.b.V, 0.1)} | ({"X": wave(s.b.V, 0.05)} if degree == 1 else {})
    controls = [getattr(s, name) for name in changes]
    found = uem.gradient(s.solve(), s.J, controls)
    for (name, change), control, by in zip(changes.items(), controls, found):
        if name == "X":
            values, slope = s.b.scene.mesh.geometry.x, dot(by, change)
        elif isinstance(control, fem.Function):
            values, slope = control.x.array, dot(by, change)
        else:
            values, slope = control.value, float(np.sum(by * change))
        before = np.array(values)

        def functional(h, name=name, change=change, control=control, values=values, before=before):
            if name == "X":
                values[:] = before
                move(s, change, h)
            else:
                values[...] = before + h * (change.x.array if isinstance(change, fem.Function) else change)
            s.solve()
            return uem.integrate(s.J)

        assert uem.taylor_test(functional, slope, 1e-3, 2) >= 1.95, name
        values[...] = before


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
    by = uem.gradient(problem, s.J, [control for control, _ in direction])
    adjoint = sum(dot(b, d) if isinstance(b, fem.Function) else float(np.sum(b * d)) for b, (_, d) in zip(by, direction))
    assert uem.integrate(ufl.algorithms.expand_derivatives(explicit)) == pytest.approx(adjoint, rel=1e-11)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
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


def test_the_state_is_left_as_it_was():
    """A gradient between two steps changes neither the state nor what comes next."""
    s, ends = pressed("triangle"), []
    for asked in (False, True):
        s.top.value[1] = -0.05
        problem = s.solve()
        if asked:
            before = np.array(s.u.x.array)
            uem.gradient(problem, s.J, s.E)
            assert np.array_equal(before, s.u.x.array)
        s.top.value[1] = -0.06
        history = problem.solve()
        ends.append((np.array(s.u.x.array), len(history)))
    assert np.abs(ends[0][0] - ends[1][0]).max() < 1e-14 and ends[0][1] == ends[1][1]


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


@pytest.mark.skipif(not has_hypre(), reason="needs hypre")
def test_iterative_solvers():
    """CG finds the gradient that a factorisation does."""
    found = []
    for options in (None, {"ksp_type": "cg", "pc_type": "hypre"}):
        s = pressed("hexahedron", petsc_options=options)
        by = uem.gradient(s.solve(), s.J, [s.E, s.top])
        found.append(np.append(by[1], by[0]))
    assert found[0] == pytest.approx(found[1], rel=1e-8)


def test_one_sided_contactors_are_told(caplog):
    """Blocks that touch without force: the gradient is that of one side, and a warning tells of it."""
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
    refused(uem.InputTypeError, "controls = 1.0: expected Constants", lambda: uem.gradient(problem, J, [1.0]))
    refused(uem.InputError, "controls hold the displacement", lambda: uem.gradient(problem, J, [s.u]))
    refused(uem.InputTypeError, "J = 2.0: expected a UFL form", lambda: uem.gradient(problem, 2.0, [s.E]))
    refused(uem.InputTypeError, "problem = 3", lambda: uem.gradient(3, J, [s.E]))
    raised(uem.InputError, "J", lambda: uem.gradient(problem, s.F, [s.E]))
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
