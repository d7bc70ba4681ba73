"""Dirichlet values by functions of place and load factor or time, by UFL expressions, and by components of vectors.

Read ``test_an_affine_field_by_every_kind_of_value`` first.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, highest, linear, refused, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
G = np.array([[0.02, 0.05], [-0.03, 0.04]])


def square(degree=1, cell="triangle", n=3):
    """A unit square, its space, and the tags of its four sides."""
    s = scene(COMM, cell, [box(cell, [0.0, 0.0], [1.0, 1.0], [n, n])])
    V = compat.function_space(s.mesh, degree, (2,))
    return s, V, [s.tag(f"side {axis}{end:g}", 0, at(axis, end)) for axis in (0, 1) for end in (0.0, 1.0)]


def affine(x):
    return G @ x[:2]


def worst(u, wanted):
    """The largest difference of a displacement from a function of places."""
    x = u.function_space.tabulate_dof_coordinates().T
    return highest(COMM, np.abs(u.x.array.reshape(-1, 2).T - wanted(x)).ravel())


def values(V, kind):
    """A field of the gradient G as values of conditions ``(component, value)``, of every kind."""
    x, w = ufl.SpatialCoordinate(V.mesh), fem.Function(V)
    w.interpolate(affine)
    field = ufl.dot(ufl.as_matrix(G.tolist()), x)
    return {
        "function": [(None, affine)],
        "functions of components": [(i, lambda x, i=i: affine(x)[i]) for i in (0, 1)],
        "function of the factor, too": [(None, lambda x, s: s * affine(x))],
        "expression": [(None, field)],
        "components of an expression": [(i, field[i]) for i in (0, 1)],
        "components of a Function": [(i, w[i]) for i in (0, 1)],
        "a Function and a component": [(i, w) for i in (0, 1)],
    }[kind]


KINDS = [
    "function", "functions of components", "function of the factor, too", "expression", "components of an expression",
    "components of a Function", "a Function and a component",
]  # fmt: skip


@pytest.mark.every_case
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_an_affine_field_by_every_kind_of_value(kind, degree):
    """An edge that moves affinely strains the plate uniformly, and half of that at half of the load."""
    _, V, sides = square(degree)
    u = fem.Function(V)
    bcs = [uem.dirichlet(V, sides, i, value) for i, value in values(V, kind)]
    problem = uem.UnitedProblem(linear(u, 100.0), u, bcs=bcs)
    for step in uem.load_steps(problem, 2):
        assert worst(u, lambda x, s=step.factor: s * affine(x)) < 1e-14


@pytest.mark.parametrize("way", [lambda s: s**2, lambda s: np.sin(7 * s)])
def test_values_follow_the_load_factor(way):
    """Along any way, with conditions that are ramped; a function without a load factor is ramped."""
    _, V, (left, right, bottom, top) = square()
    u = fem.Function(V)
    bcs = [uem.dirichlet(V, left, 0), uem.dirichlet(V, right, 0, lambda x, s: 0.01 * way(s) + 0 * x[0])]
    bcs += [uem.dirichlet(V, bottom, 1), uem.dirichlet(V, top, 1, lambda x: 0.02)]
    problem = uem.UnitedProblem(linear(u, 100.0), u, bcs=bcs)
    for step in uem.load_steps(problem, 4):
        assert worst(u, lambda x, s=step.factor: [0.01 * way(s) * x[0], 0.02 * s * x[1]]) < 1e-14
    problem = uem.UnitedProblem(linear(u, 100.0), u, bcs=bcs)
    problem.solve()
    assert worst(u, lambda x: [0.01 * way(1.0) * x[0], 0.02 * x[1]]) < 1e-14


def test_values_in_steps():
    """Steps have conditions of their own, each a function of the step's own load factor."""
    _, V, (left, right, bottom, _) = square()
    u = fem.Function(V)
    still = [uem.dirichlet(V, left, 0), uem.dirichlet(V, bottom, 1)]
    go, back = (
        uem.dirichlet(V, right, 0, f) for f in (lambda x, s: 0.02 * s**2 + 0 * x[0], lambda x, s: 0.02 - 0.01 * s + 0 * x[0])
    )
    problem = uem.UnitedProblem(linear(u, 100.0), u, bcs=still)
    law_free = [
        (s.factor, highest(COMM, u.x.array[0::2]))
        for s in uem.load_steps(problem, [uem.Step("go", 2, bcs=[*still, go]), uem.Step("back", 2, bcs=[*still, back])])
    ]
    np.testing.assert_allclose([found for _, found in law_free], [0.005, 0.02, 0.015, 0.01], rtol=1e-12)


def test_an_expression_follows_constants_and_fields():
    """A Constant that the load sets is not ramped twice; a field that the script changes within a step is followed."""
    _, V, (left, right, bottom, top) = square()
    u, c, T = fem.Function(V), fem.Constant(V.mesh, 0.0), fem.Constant(V.mesh, 1.0)
    bcs = [uem.dirichlet(V, left, 0), uem.dirichlet(V, right, 0, 2.0 * c * T), uem.dirichlet(V, bottom, 1)]
    problem = uem.UnitedProblem(linear(u, 100.0), u, bcs=[*bcs, uem.dirichlet(V, top, 1)], load={c: 0.01})
    for step in uem.load_steps(problem, 2):
        for T.value in (1.0, 1.5):
            problem.solve()
            assert highest(COMM, u.x.array[0::2]) == pytest.approx(0.02 * step.factor * float(T.value), rel=1e-12)
        T.value = 1.0


@pytest.mark.long
def test_in_a_mixed_space():
    """Parts of a mixed space, vectors and scalars, and components: by numbers, Constants, functions, fields and expressions alike."""
    s, V, (_, _, _, top) = square()
    W = compat.function_space(s.mesh, [("Lagrange", 2, (2,)), 1])
    c, X = fem.Constant(s.mesh, np.array([0.5, 2.0])), ufl.SpatialCoordinate(s.mesh)
    linear_in_x = fem.Function(compat.function_space(s.mesh, 2, (2,)))
    linear_in_x.interpolate(lambda x: np.vstack([x[0], 2.0 + x[0]]))

    def by_place(x, s=0.0):
        return np.vstack([x[0], 2.0 + x[0]])

    vectors = [linear_in_x, by_place, lambda x, s: by_place(x), ufl.as_vector([X[0], 2.0 + X[0]])]
    scalars = (c[0], linear_in_x[0] - X[0] + 0.5, lambda x: 0.5 + 0.0 * x[0], 0.5, fem.Constant(s.mesh, 0.5))
    parts = [(W, W.sub(0), value, {0: 0.5, 1: 2.5}) for value in vectors] + [
        (W, W.sub(0), value, {0: 0.5, 1: 2.0}) for value in (c, (0.5, 2.0))
    ]
    for space, part, i in ((W, W.sub(0).sub(1), 1), (W, W.sub(1), 2), (V, V.sub(1), 1)):
        parts += [(space, part, value, {i: 0.5}) for value in scalars]
    for space, part, value, means in parts:
        w, bc = fem.Function(space), uem.dirichlet(part, top, None, value)
        compat.set_bc_values(w.x.array, [bc])
        for i, mean in means.items():
            assert uem.integrate(w[i] * uem.ds(top)) == pytest.approx(mean, rel=1e-12)


@pytest.mark.long
def test_a_body_of_two_fields_is_led_as_one_of_one():
    """All components of the displacement by one condition, in load steps: the displacement of the same body without a second field."""
    s, V, (left, right, _, _) = square()
    W, found = compat.function_space(s.mesh, [("Lagrange", 1, (2,)), 1]), []
    way = fem.Constant(s.mesh, np.array([0.01, 0.02]))
    for space in (V, W):
        w = fem.Function(space)
        u, part = (w, space) if space is V else (ufl.split(w)[0], space.sub(0))
        v = ufl.TestFunction(space) if space is V else ufl.TestFunctions(space)[0]
        F = uem.NeoHooke(100.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
        if space is W:
            F += ufl.split(w)[1] * ufl.TestFunctions(space)[1] * ufl.dx
        bcs = [uem.dirichlet(part, left), uem.dirichlet(part, right, None, way)]
        problem = uem.UnitedProblem(F, w, bcs=bcs, rtol=1e-12, displacement=None if space is V else 0)
        found.append([uem.integrate(ufl.inner(u, u) * ufl.dx) for _ in uem.load_steps(problem, 2)])
    np.testing.assert_allclose(*found, rtol=1e-9)


@pytest.mark.parametrize("mass", [uem.lumped_mass, uem.consistent_mass])
def test_an_edge_that_is_led_in_time(mass):
    """An end that is dragged along a bar has its speed at once, and does the work of the same condition by ``load=``."""
    found = []
    for by_load in (False, True):
        s, V, (_, _, bottom, top) = square(cell="quadrilateral", n=4)
        u, c = fem.Function(V), fem.Constant(s.mesh, 0.0)
        value = c if by_load else lambda x, t: 0.3 * t + 0 * x[1]
        dynamics = uem.Dynamics(mass(V, 1.0))
        problem = uem.UnitedProblem(
            linear(u, 50.0), u, bcs=[uem.dirichlet(V, bottom, 1, value)], dynamics=dynamics, rtol=1e-12,
            load={c: lambda t: 0.3 * t} if by_load else None,
        )  # fmt: skip
        speeds = []
        for _ in uem.time_steps(problem, 0.01, 0.05):
            nodes = fem.locate_dofs_topological(V, 1, bottom.entities)
            speeds.append(highest(COMM, np.abs(dynamics.velocity.x.array.reshape(-1, 2)[nodes, 1] - 0.3)))
        assert max(speeds) < 1e-12
        found.append([problem.reaction(bottom)[1], highest(COMM, u.x.array)])
    np.testing.assert_allclose(*found, rtol=1e-11)


def test_a_run_continues(folder):
    """A checkpoint holds no values: the second run takes them from the same functions."""
    found = []
    for end in (2, 4):
        _, V, (left, right, bottom, _) = square()
        u = fem.Function(V)
        bcs = [
            uem.dirichlet(V, left, 0),
            uem.dirichlet(V, bottom, 1),
            uem.dirichlet(V, right, 0, lambda x, s: 0.01 * s**2 + 0 * x[1]),
        ]
        problem = uem.UnitedProblem(linear(u, 100.0), u, bcs=bcs)
        with uem.Checkpoint(folder / "run.uem") as checkpoint:
            for step in uem.load_steps(problem, 4, checkpoint=checkpoint):
                found.append((step.factor, highest(COMM, u.x.array[0::2])))
                if len(found) == end and end == 2:
                    break
    factors, largest = np.array(found).T
    assert factors[-1] == 1.0 and len(factors) in (4, 5)
    np.testing.assert_allclose(largest, 0.01 * factors**2, rtol=1e-12)


def test_refused():
    s, V, (left, right, bottom, _) = square()
    other = square()[1]
    x, v = ufl.SpatialCoordinate(s.mesh), ufl.TestFunction(V)
    for error, words, value in (
        (uem.InputError, ("'side 00'", "shape (5,)", "f(x, s)"), lambda x: np.zeros(5)),
        (uem.InputError, "shape (3,", lambda x: x + 1),
        (uem.InputTypeError, "x and the load factor", lambda: 0.0),
        (uem.InputTypeError, "x and the load factor", lambda x, s, t: 0.0),
        (uem.UserFunctionError, ("'side 00' at 0", "ZeroDivision"), lambda x: 1 / 0),
        (uem.InputError, "shape (2,)", x),
        (uem.InputError, "test or trial", v[0]),
        (uem.SpaceError, "another mesh", ufl.SpatialCoordinate(other.mesh)[0]),
    ):
        refused(error, words, lambda value=value: uem.dirichlet(V, left, 0, value))
    u = fem.Function(V)
    bcs = [
        uem.dirichlet(V, left, 0),
        uem.dirichlet(V, bottom, 1),
        uem.dirichlet(V, right, 0, lambda x, s: np.log(0.5 - s) + 0 * x[0]),
    ]
    problem = uem.UnitedProblem(linear(u, 100.0), u, bcs=bcs)
    with np.errstate(invalid="ignore"):
        refused(uem.NotFiniteError, ("bcs[2]", "nan"), problem.solve)
    c, w = fem.Constant(s.mesh, 0.01), fem.Function(V)
    problem = uem.UnitedProblem(
        linear(u, 100.0), u, bcs=[*bcs[:2], uem.dirichlet(V, right, 0, 2 * c), uem.dirichlet(V, right, 1, w)]
    )
    problem.solve()
    J = u[0] * uem.ds(right)
    for m in (c, w):
        refused(uem.InputError, "no derivative", lambda m=m: uem.gradient(problem, J, [m]))


@pytest.mark.long
def test_gradients_of_histories():
    """Derivatives of a history with such values, friction among it, against differences."""
    s, V, (left, right, bottom, top) = square(n=4)
    E, k = fem.Constant(s.mesh, 10.0), fem.Constant(s.mesh, 3.0)

    def run(record):
        u = fem.Function(V)
        F = linear(u, E) + k * u[0] * ufl.TestFunction(V)[0] * uem.ds(right)
        bcs = [uem.dirichlet(V, top, None, lambda x, s: [0.05 * s**2 * x[0], -0.1 * s + 0 * x[0]])]
        bcs.append(uem.dirichlet(V, left, 0, lambda x: 0.01 * x[1]))
        floor = uem.Contact(bottom, uem.RigidPlane((0.0, 0.0), (0.0, 1.0)), friction=0.2)
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[floor], rtol=1e-11)
        J = ufl.inner(u, u) * ufl.dx + u[0] * uem.ds(right)
        if not record:
            list(uem.load_steps(problem, 4))
            return uem.integrate(J)
        with uem.recording(problem) as history:
            list(uem.load_steps(problem, 4))
        return history.gradient(J, [E, k])

    for c, found in zip((E, k), run(True)):
        value, ends = float(c.value), []
        for change in (1e-4, -1e-4):
            c.value = value * (1 + change)
            ends.append(run(False))
        c.value = value
        assert float(found) == pytest.approx((ends[0] - ends[1]) / (2e-4 * value), rel=1e-6)
