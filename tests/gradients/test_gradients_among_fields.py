"""Gradients of problems with a pressure or a temperature as a further field: against differences, and forward against adjoint."""

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from field_scenes import fields, strain, stress, with_pressure
from gradient_scenes import along, move, wave
from helpers import blocks, refused, run, slow

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def scene(kind, displacement=0, comm=COMM):
    """Blocks that are pressed together, nearly incompressible or heated, and changes of all that their state depends on."""
    degree, coupling = (2, "node_to_surface") if kind == "pressure" else (1, "mortar")
    b = blocks(comm, "triangle", 2, 3, overhang=0.25, degree=degree)
    mesh, f = b.scene.mesh, fields(b, degree, 1, displacement=displacement)
    (u, other), (v, q) = f.split(f.w), f.split(ufl.TestFunction(f.w.function_space))
    E, top, X = fem.Constant(mesh, 1.0), fem.Constant(mesh, -0.05), ufl.SpatialCoordinate(mesh)
    field, offset = fem.Function(uem.function_space(mesh, 1)), [0.0]
    field.x.array[:] = 1.0 + 0.2 * wave(field.function_space).x.array
    bcs = [uem.dirichlet(f.space, b.bottom, c) for c in (0, 1)] + [uem.dirichlet(f.space, b.top, 0, 0.02)]
    bcs.append(uem.dirichlet(f.space, b.top, 1, top))
    if kind == "pressure":
        F = with_pressure(f, field * E, 0.4999)
        shape = wave(uem.function_space(mesh, 1, (2,)), 0.05)
        controls = {"E": (E, 1.0), "top": (top, 1.0), "field": (field, wave(field.function_space)), "X": (X, shape)}
    else:
        alpha = fem.Constant(mesh, 0.02)
        F = ufl.inner(field * E * (stress(u, 1.0) - alpha * other * ufl.Identity(2)), strain(v)) * ufl.dx
        F += ((1.0 + other) * ufl.inner(ufl.grad(other), ufl.grad(q)) - ufl.dot(u, u) * q) * ufl.dx
        hot = fem.Function(f.other.collapse()[0])
        hot.interpolate(lambda x: 1.0 + 0.3 * x[0])
        bcs += [uem.dirichlet(f.other, b.top, value=0.2), uem.dirichlet(f.other, b.high, value=0.4)]
        dofs = fem.locate_dofs_topological((f.other, hot.function_space), 1, np.append(b.bottom.entities, b.low.entities))
        bcs.append(fem.dirichletbc(hot, dofs, f.other))
        shape = wave(f.space.collapse()[0], 0.05)
        controls = {"alpha": (alpha, 1.0), "top": (top, 1.0), "hot": (hot, wave(field.function_space)), "X": (X, shape)}

    def solve():
        f.w.x.array[:] = 0.0
        contact = uem.Contact(b.high, b.low, coupling=coupling, offset=offset[0])
        problem = uem.UnitedProblem(F, f.w, displacement=displacement, bcs=bcs, contacts=[contact], rtol=1e-13)
        run(problem)
        return problem

    def functional(problem):
        p = problem.contacts[0].pressure
        return (ufl.inner(u, u) + 0.1 * other**2 + other * u[1]) * ufl.dx + 10 * p**2 * u[1] * uem.ds(b.high)

    return SimpleNamespace(b=b, f=f, F=F, u=u, other=other, functional=functional, solve=solve, controls=controls, offset=offset)


def in_space(V, f):
    """A Function numbered as another space of its element is."""
    out = fem.Function(V)
    out.interpolate(f)
    out.x.scatter_forward()
    return out


def direction(s, contact):
    """Controls of a scene, and their changes."""
    return [*s.controls.values(), (uem.ContactParameter(contact, "offset"), 0.3)]


def changed(s, h):
    """The functional of the state where all controls have changed together (collective)."""
    kept = [np.array(s.b.scene.mesh.geometry.x)]
    for name, (control, change) in s.controls.items():
        if name == "X":
            move(s, change, h)
        elif isinstance(control, fem.Function):
            kept.append(np.array(control.x.array))
            control.x.array[:] += h * in_space(control.function_space, change).x.array
        else:
            kept.append(np.array(control.value))
            control.value += h * change
    s.offset[0] = 0.3 * h
    value = uem.integrate(s.functional(s.solve()))
    s.offset[0], s.b.scene.mesh.geometry.x[:] = 0.0, kept.pop(0)
    for name, (control, _) in s.controls.items():
        if name != "X":
            (control.x.array if isinstance(control, fem.Function) else control.value)[...] = kept.pop(0)
    return value


@pytest.mark.long
@pytest.mark.parametrize(("kind", "displacement"), [("pressure", 1), ("temperature", 0), slow("temperature", 1)])
def test_of_second_order_and_forward_as_backward(kind, displacement):
    """Taylor's test along all controls together; the adjoint's derivative is that of the unknowns and pressures, put into J."""
    s = scene(kind, displacement)
    problem = s.solve()
    (contact,), J, pairs = problem.contacts, s.functional(problem), direction(s, problem.contacts[0])
    found = uem.gradient(problem, J, [control for control, _ in pairs])
    by = along(found, [in_space(b.function_space, c) if isinstance(c, fem.Function) else c for b, (_, c) in zip(found, pairs)])
    dw, dp = uem.tangent(problem, pairs), uem.tangent(problem, pairs, of=contact.pressure)
    explicit = ufl.derivative(J, s.f.w, dw) + ufl.derivative(J, contact.pressure, dp)
    if "X" in s.controls:
        explicit += ufl.derivative(J, *s.controls["X"])
    assert uem.integrate(ufl.algorithms.expand_derivatives(explicit)) == pytest.approx(by, rel=1e-11)
    assert uem.taylor_test(lambda h: changed(s, h), by, 4e-3, 2) >= 1.95


@pytest.mark.skipif(COMM.size == 1, reason="compares ranks")
@pytest.mark.parametrize("kind", ["pressure", "temperature"])
def test_on_any_ranks(kind):
    """The same derivatives, of which those by nodes are taken along a change."""
    found = []
    for comm in (COMM, MPI.COMM_SELF):
        s = scene(kind, comm=comm)
        problem = s.solve()
        pairs = direction(s, problem.contacts[0])
        by = uem.gradient(problem, s.functional(problem), [control for control, _ in pairs])
        changes = [in_space(b.function_space, c) if isinstance(c, fem.Function) else c for b, (_, c) in zip(by, pairs)]
        found.append([along([b], [c]) for b, c in zip(by, changes)])
    assert found[0] == pytest.approx(found[1], rel=1e-10)


def test_what_has_no_gradient():
    """Functionals of what only looks like the unknowns, and heat that passes through the contact."""
    s = scene("temperature")
    problem, E = s.solve(), s.controls["alpha"][0]
    w = s.f.w
    for J in (w.sub(1) * ufl.dx, w[0] * w.sub(1) * ufl.dx):
        refused(uem.InputError, ("J holds u.sub(i)", "ufl.split"), lambda J=J: uem.gradient(problem, J, E))
    copy = problem.config.functions()["field_1"]
    refused(uem.InputError, ("J holds 'field_1'", "a copy"), lambda: uem.gradient(problem, copy**2 * ufl.dx, E))
    contact = uem.Contact(s.b.high, s.b.low, heat=uem.Conductance(1.0, field=1))
    hot = uem.UnitedProblem(s.F, w, displacement=0, bcs=problem.bodies.bcs, contacts=[contact])
    refused(uem.InputError, "heat conducted through a contact", lambda: uem.gradient(hot, w[0] * ufl.dx, E))
    F = s.F + w.sub(1) * ufl.TestFunction(w.function_space)[0] * ufl.dx
    refused(uem.InputError, "F holds u.sub(i)", lambda: uem.UnitedProblem(F, w, displacement=0))
