"""Bodies and fields that nothing holds, in problems without contact too: they are named, and none flies away in a step that converges."""

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import CELLS, at, box, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
CG = {"ksp_type": "cg", **uem.multigrid_options()}


def boxes(cell, number=1, n=2, degree=1):
    """Unit boxes one above the other, a gap of a half between them, and a displacement with its test function."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    low = [np.array([0.0] * (g - 1) + [1.5 * k]) for k in range(number)]
    s = scene(COMM, cell, [box(cell, a, a + 1.0, [n] * g) for a in low])
    V = compat.function_space(s.mesh, degree, (g,))
    return s, V, fem.Function(V), ufl.TestFunction(V), g


def elastic(law, u, v, g):
    """Internal forces of a law."""
    return law(100.0, 0.3, kind="plane_strain" if g == 2 else "3d").residual(u, v) * ufl.dx


def base(s, k=0):
    """The lowest facets of box k."""
    return s.tag(f"base {k}", k, lambda x: x[:, -1] < 1.5 * k + 1e-9)


def push(v, way):
    """A force per volume."""
    return ufl.dot(ufl.as_vector(way), v) * ufl.dx


@pytest.mark.parametrize(
    ("cell", "law", "options", "in_steps"),
    [*product(CELLS, (uem.LinearElastic, uem.NeoHooke), (None,), (False,)), ("quadrilateral", uem.LinearElastic, CG, True)],
)
@pytest.mark.parametrize("half", [False, True])
def test_a_body_without_supports(cell, law, options, in_steps, half):
    """Nothing holds it, or conditions hold one direction alone."""
    s, V, u, v, g = boxes(cell)
    bcs = [uem.dirichlet(V, base(s), g - 1)] if half else []
    F = elastic(law, u, v, g) - push(v, [1.0] + [0.0] * (g - 2) + [-2.0])
    problem = uem.UnitedProblem(F, u, bcs=bcs, petsc_options=options)
    with pytest.raises(uem.FloatingBodyError, match="the body with its middle at .* moves along") as caught:
        list(uem.load_steps(problem, 2)) if in_steps else problem.solve()
    assert ("0.5, 0.5" in str(caught.value)) and not u.x.array.any()


@pytest.mark.parametrize("cell", CELLS)
def test_a_second_body_that_is_free(cell):
    """The body that is named is the one that is not held, and it is right to leave it where no load is."""
    s, V, u, v, g = boxes(cell, 2)
    bcs = [uem.dirichlet(V, base(s))]
    problem = uem.UnitedProblem(elastic(uem.LinearElastic, u, v, g) - push(v, [0.0] * (g - 1) + [1.0]), u, bcs=bcs)
    with pytest.raises(uem.FloatingBodyError, match=r"0\.5, 2\) moves"):
        problem.solve()
    x = ufl.SpatialCoordinate(s.mesh)
    below = ufl.conditional(ufl.lt(x[g - 1], 1.2), 1.0, 0.0)
    problem = uem.UnitedProblem(elastic(uem.LinearElastic, u, v, g) - below * v[0] * ufl.dx, u, bcs=bcs)
    problem.solve()
    there = problem.config.X[:, -1] > 1.2
    assert not problem.config.displacement[there].any() and COMM.allreduce(np.abs(u.x.array).max(initial=0.0), op=MPI.MAX) > 0


def test_at_rest_in_dynamics():
    """``solve`` takes no inertia: a body that steps in time carry freely is one that nothing holds."""
    s, V, u, v, g = boxes("quadrilateral")
    F = elastic(uem.LinearElastic, u, v, g) - push(v, [1.0, 0.0])
    problem = uem.UnitedProblem(F, u, dynamics=uem.Dynamics(uem.lumped_mass(V, 1.0)))
    with pytest.raises(uem.FloatingBodyError, match="moves along"):
        problem.solve()
    for _ in uem.time_steps(problem, 0.25, 1.0):
        pass
    assert COMM.allreduce(np.abs(u.x.array).max(initial=0.0), op=MPI.MAX) == pytest.approx(0.5, rel=0.3)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_loads_in_balance(cell):
    """A bar that equal tractions pull is as long as one that is held, and stays in its middle."""
    s, V, u, v, g = boxes(cell)
    x = ufl.SpatialCoordinate(s.mesh)
    n = ufl.FacetNormal(s.mesh)
    ends = ufl.conditional(ufl.gt(abs(n[0]), 0.5), 1.0, 0.0)
    F = elastic(uem.LinearElastic, u, v, g) - ends * ufl.dot(n, v) * ufl.ds
    problem = uem.UnitedProblem(F, u)
    problem.solve()
    stretch = COMM.allreduce(fem.assemble_scalar(fem.form(ufl.grad(u)[0, 0] * ufl.dx(x.ufl_domain()))), op=MPI.SUM)
    assert stretch == pytest.approx((1 - 0.3**2) / 100.0 if g == 2 else 1 / 100.0, rel=1e-8)


def test_forms_that_hold_more_than_elasticity():
    """The Laplacian of a vector resists turns that stress does not."""
    s, V, u, v, g = boxes("triangle")
    left = s.tag("left", 0, at(0, 0.0))
    bcs = [uem.dirichlet(V, base(s), 0), uem.dirichlet(V, left, 1)]
    problem = uem.UnitedProblem(ufl.inner(ufl.grad(u), ufl.grad(v)) * ufl.dx - push(v, [1.0, 0.0]), u, bcs=bcs)
    assert problem.solve()[-1].residual < 1e-8 and COMM.allreduce(np.abs(u.x.array).max(initial=0.0), op=MPI.MAX) < 1.0


@pytest.mark.parametrize("law", [uem.LinearElastic, st_venant])
def test_springs_hold(law):
    """A foundation in the form is support enough."""
    s, V, u, v, g = boxes("quadrilateral")
    inner = elastic(law, u, v, g) if law is uem.LinearElastic else law(u, 100.0, 0.3)
    problem = uem.UnitedProblem(inner + 2.0 * ufl.dot(u, v) * ufl.dx - push(v, [0.0, -1.0]), u)
    problem.solve()
    assert COMM.allreduce(u.x.array.sum(), op=MPI.SUM) < 0.0
    np.testing.assert_allclose(problem.config.displacement[:, 1], -0.5, rtol=1e-7)


@pytest.mark.parametrize("far", [1.0, 1e6, 1e10])
def test_a_body_that_is_led_far(far):
    """Conditions that lead a body by many of its sizes leave rounding and nothing else."""
    s, V, u, v, g = boxes("triangle")
    uem.UnitedProblem(elastic(uem.LinearElastic, u, v, g), u, bcs=[uem.dirichlet(V, base(s), value=(far, -far))]).solve()
    np.testing.assert_allclose(np.abs(u.x.array), far, rtol=1e-12)


@pytest.mark.parametrize(("coupling", "options"), [*product(("node_to_surface", "mortar"), (None, CG))])
def test_a_scalar_field_that_nothing_holds(coupling, options):
    """Heat into two bodies that are tied to each other alone."""
    g = 2
    s = scene(COMM, "triangle", [box("triangle", [0.0, float(k)], [1.0, 1.0 + k], [2 + k] * g) for k in range(2)])
    V = uem.function_space(s.mesh, 1)
    T, q = fem.Function(V, name="temperature"), ufl.TestFunction(V)
    tie = uem.Contact(s.tag("high", 1, at(1, 1.0)), s.tag("low", 0, at(1, 1.0)), tied=True, coupling=coupling)
    F = ufl.inner(ufl.grad(T), ufl.grad(q)) * ufl.dx - 1.0 * q * ufl.dx
    problem = uem.UnitedProblem(F, T, contacts=[tie], petsc_options=options)
    with pytest.raises(uem.FloatingBodyError, match="nothing holds the .* 'temperature' on the body with its middle at"):
        problem.solve()
    assert not T.x.array.any()


@pytest.mark.parametrize("held", [False, True])
def test_fields_beside_a_displacement(held):
    """Heat into a body whose temperature nothing holds, while supports hold its displacement or do not."""
    s, _, _, _, _ = boxes("triangle")
    W = uem.function_space(s.mesh, [("Lagrange", 2, (2,)), ("Lagrange", 1)])
    w = fem.Function(W)
    (u, T), (v, q) = ufl.split(w), ufl.TestFunctions(W)
    stress = ufl.sym(ufl.grad(u)) + (ufl.div(u) - 0.1 * T) * ufl.Identity(2)
    F = ufl.inner(stress, ufl.grad(v)) * ufl.dx + ufl.inner(ufl.grad(T), ufl.grad(q)) * ufl.dx - q * ufl.dx - v[0] * ufl.dx
    bcs = [uem.dirichlet(W.sub(0), base(s), i) for i in range(2)] if held else []
    problem = uem.UnitedProblem(F, w, displacement=0, bcs=bcs)
    words = "nothing holds part 1 of the mixed space on the body" if held else "the body with its middle at .* moves along"
    with pytest.raises(uem.FloatingBodyError, match=words):
        problem.solve()
