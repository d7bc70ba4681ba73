"""Forms, vectors and matrices for scripts; tangents, options of the compiler and settings of Newton's method of users.

Read ``test_any_number_of_measures`` first.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem, jit
from helpers import at, blocks, box, clamp, factors, highest, linear, refused, scene, st_venant
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def plate(cell="triangle", size=(1.0, 1.0), n=4):
    """A plate, a scalar space, and the tags of its sides."""
    s = scene(COMM, cell, [box(cell, [0.0, 0.0], list(size), [n, n])])
    sides = [s.tag(f"side {axis}{end:g}", 0, at(axis, end)) for axis in (0, 1) for end in (0.0, size[axis])]
    return s.mesh, uem.function_space(s.mesh, 1), sides


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_any_number_of_measures(cell):
    """The sum of a vector is the sum of loads on all sides, that of a matrix what springs on them hold."""
    mesh, V, sides = plate(cell, (2.0, 1.0))
    u, v = ufl.TrialFunction(V), ufl.TestFunction(V)
    L = sum((k + 1) * v * uem.ds(side) for k, side in enumerate(sides)) + 5 * v * ufl.dx
    exact = (1 + 2) * 1.0 + (3 + 4) * 2.0 + 5 * 2.0
    for form in (L, uem.form(L)):
        assert uem.assemble_vector(form).sum() == pytest.approx(exact, rel=1e-13)
    x = ufl.SpatialCoordinate(mesh)[0]
    a = ufl.dot(ufl.grad(u), ufl.grad(v)) * ufl.dx + sum((k + 1) * x * u * v * uem.ds(side) for k, side in enumerate(sides))
    ones = compat.create_vector(V)
    ones.set(1.0)
    for form in (a, uem.form(a)):
        A = uem.assemble_matrix(form)
        assert (A * ones).sum() == pytest.approx(2 * 2.0 * 1.0 + (3 + 4) * 2.0, rel=1e-13)
        assert A.isSymmetric(1e-13)
    M = uem.integrate(uem.form(x * uem.ds(sides[1]) + 3 * x * uem.ds(sides[3]) + x * ufl.dx))
    assert pytest.approx(2.0 + 3 * 2.0 + 2.0, rel=1e-13) == M


def test_ghosts_of_vectors_are_up_to_date():
    _, V, _ = plate()
    b, f = uem.assemble_vector(ufl.TestFunction(V) * ufl.dx), fem.Function(V)
    f.x.array[:] = b.array_r.sum() * 0
    n = len(b.array_r)
    f.x.array[:n] = b.array_r
    f.x.scatter_forward()
    with b.localForm() as local:
        np.testing.assert_array_equal(local.array_r, f.x.array)


def test_a_wall_with_a_film():
    """Conduction through a wall with a film on its other side, solved by the script itself and by a problem: the closed form."""
    _, V, (left, right, _, _) = plate(n=3)
    u, v, k, h, outside = ufl.TrialFunction(V), ufl.TestFunction(V), 2.0, 5.0, 10.0
    bcs, T = [uem.dirichlet(V, left)], fem.Function(V)
    A = uem.assemble_matrix(k * ufl.dot(ufl.grad(u), ufl.grad(v)) * ufl.dx + h * u * v * uem.ds(right), bcs=bcs)
    b = uem.assemble_vector(h * outside * v * uem.ds(right))
    assert A.isSymmetric(1e-14)
    held, n = compat.bc_dofs(bcs[0])
    b.array[held[:n]] = 0.0
    ksp = PETSc.KSP().create(COMM)
    ksp.setOperators(A)
    ksp.setTolerances(rtol=1e-14)
    ksp.solve(b, compat.petsc_vector(T))
    T.x.scatter_forward()
    F = k * ufl.dot(ufl.grad(T), ufl.grad(v)) * ufl.dx + h * (T - outside) * v * uem.ds(right)
    for _ in range(2):
        x = V.tabulate_dof_coordinates()[:, 0]
        assert highest(COMM, np.abs(T.x.array - outside * h / (k + h) * x)) < 1e-11
        T.x.array[:] = 0.0
        uem.UnitedProblem(F, T, bcs=bcs).solve()


def test_a_nonlinear_scalar_problem():
    """A conductivity 1 + T between two temperatures: T + T^2 / 2 is linear, to the second order of the cells' size."""
    errors = []
    for n in (4, 8):
        _, V, (left, right, _, _) = plate(n=n)
        T, v = fem.Function(V), ufl.TestFunction(V)
        F = (1 + T) * ufl.dot(ufl.grad(T), ufl.grad(v)) * ufl.dx
        problem = uem.UnitedProblem(F, T, bcs=[uem.dirichlet(V, left), uem.dirichlet(V, right, value=2.0)])
        assert len(problem.solve()) > 3
        x = V.tabulate_dof_coordinates()[:, 0]
        errors.append(highest(COMM, np.abs(T.x.array + T.x.array**2 / 2 - 4 * x)))
    assert errors[1] < 6e-3 and errors[0] > 3 * errors[1]


def test_a_tangent_of_the_user():
    """The derivative itself takes the same iterations; another one ends in the same equilibrium, in more."""
    found = {}
    for name in ("none", "own", "linear"):
        b = blocks(COMM, "quadrilateral", 2, 3)
        F, du = st_venant(b.u, 100.0), ufl.TrialFunction(b.V)
        stiffness = ufl.derivative(linear(b.u, 100.0), b.u, du)
        J = {"none": None, "own": ufl.derivative(F, b.u, du), "linear": stiffness}[name]
        contact = uem.Contact(b.high, b.low)
        problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.2), contacts=[contact], J=J, rtol=1e-10)
        n = sum(len(step.iterations) for step in uem.load_steps(problem, 2))
        found[name] = n, contact.resultant().force
        if name == "linear":
            refused(
                uem.InputError,
                "J = None",
                lambda p=problem, u=b.u: uem.gradient(p, u[1] * ufl.dx, [fem.Constant(p.config.mesh, 1.0)]),
            )
    assert found["own"][0] == found["none"][0] < found["linear"][0]
    for name in ("own", "linear"):
        np.testing.assert_allclose(found[name][1], found["none"][1], rtol=1e-8, atol=1e-8)


def test_options_of_the_compiler(monkeypatch):
    """They come to the compiler for the forms of this problem and this form, and for no others."""
    requested, compile_anew = [], jit.ffcx_jit

    def ffcx_jit(comm, what, *args, **options):
        if isinstance(what, ufl.Form):
            requested.append((options.get("jit_options") or options.get("jit_params") or {}).get("timeout"))
        return compile_anew(comm, what, *args, **options)

    monkeypatch.setattr(jit, "ffcx_jit", ffcx_jit)
    b = blocks(COMM, "triangle", 2, 2)
    number = 1.0 + 0.37 * ufl.SpatialCoordinate(b.scene.mesh)[0] ** 2
    uem.UnitedProblem(linear(b.u, number), b.u, bcs=clamp(b.V, b.bottom) + clamp(b.V, b.top), jit_options={"timeout": 234})
    uem.form(number * ufl.dx, jit_options={"timeout": 235})
    assert set(requested) == {234, 235}
    requested.clear()
    uem.integrate((number + 1) * ufl.dx)
    assert len(requested) == 1 and requested[0] not in (234, 235)


def test_settings_of_newton():
    """One object, or its words one by one: the same run."""
    found = []
    for how in ({"newton": "modified", "rtol": 1e-6}, {"newton": uem.Newton(method="modified", rtol=1e-6)}, {}):
        b = blocks(COMM, "quadrilateral", 2, 3)
        problem = uem.UnitedProblem(
            st_venant(b.u, 100.0), b.u, bcs=b.oedometer(0.2), contacts=[uem.Contact(b.high, b.low)], **how
        )
        found.append([len(step.iterations) for step in uem.load_steps(problem, 2)])
        assert problem.rtol == (1e-6 if how else 1e-8)
    assert found[0] == found[1] != found[2]
    assert repr(uem.Newton(rtol=1e-3)).startswith("Newton(method='full', consistent_tangent=True, line_search=True")
    assert factors([]) == []


def test_refused():
    mesh, V, _ = plate(n=2)
    u, v, T = ufl.TrialFunction(V), ufl.TestFunction(V), fem.Function(V)
    F, other = ufl.dot(ufl.grad(T), ufl.grad(v)) * ufl.dx, plate(n=2)[1]
    mass = u * v * ufl.dx

    def problem(**how):
        return lambda: uem.UnitedProblem(F, T, **how)

    for error, words, call in (
        (uem.InputError, "L has 2 argument(s)", lambda: uem.assemble_vector(mass)),
        (uem.InputError, "a has 1 argument(s)", lambda: uem.assemble_matrix(v * ufl.dx)),
        (uem.InputError, "a has 0 argument(s)", lambda: uem.assemble_matrix(uem.form(T * ufl.dx))),
        (uem.InputTypeError, ("L = 3", "uem.form"), lambda: uem.assemble_vector(3)),
        (uem.InputTypeError, ("integrals", "ufl.dx"), lambda: uem.form(T)),
        (uem.InputError, "at least", lambda: uem.form(ufl.Form([]))),
        (uem.InputTypeError, "jit_options = 3", lambda: uem.form(T * ufl.dx, jit_options=3)),
        (uem.InputTypeError, "bcs", lambda: uem.assemble_matrix(mass, bcs=[3])),
        (uem.InputTypeError, "J = 3", problem(J=3)),
        (uem.InputError, "J has 1 argument(s)", problem(J=v * ufl.dx)),
        (uem.SpaceError, "J", problem(J=ufl.TrialFunction(other) * ufl.TestFunction(other) * ufl.dx)),
        (uem.InputTypeError, "jit_options = 3", problem(jit_options=3)),
        (uem.InputError, ("newton = 'ful'", "'full'"), problem(newton="ful")),
        (
            uem.InputError,
            ("rtol is given in addition to newton", "uem.Newton(rtol=...)"),
            problem(newton=uem.Newton(), rtol=1e-3),
        ),
        (uem.InputError, ("method = 'quasi'", "'modified'"), lambda: uem.Newton(method="quasi")),
        (uem.InputError, "rtol = 2", lambda: uem.Newton(rtol=2)),
        (uem.InputError, "max_iterations = 0", lambda: uem.Newton(max_iterations=0)),
        (uem.InputTypeError, "line_search = 1", lambda: uem.Newton(line_search=1)),
    ):
        refused(error, words, call)
