"""Bodies and fields that nothing holds, in problems without contact too: they are named, and none flies away in a step that converges."""

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import CELLS, at, blocks, box, scene, st_venant

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
    # rounding decides whether a solver meets the singular matrix, which is an error before the field has grown
    reported = (
        "nothing holds the .* 'temperature' on the body with its middle at|is singular: hold bodies|a body may be free to move"
    )
    with pytest.raises((uem.FloatingBodyError, uem.LinearSolveError), match=reported):
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


class Pressed:
    """A block of some stiffness that is pressed on another one, whose cells the residual takes in or leaves out."""

    def __init__(self, cell, degree=1):
        self.b = b = blocks(COMM, cell, 2, 3, degree=degree)
        self.mesh, self.V, self.g = b.scene.mesh, b.V, b.gdim
        middle = self.mesh.geometry.x[compat.geometry_dofs(self.mesh)].mean(axis=1)[:, self.g - 1]
        self.tool, self.block = (
            uem.Tag(name, 1, self.g, self.mesh, np.flatnonzero(where).astype(np.int32))
            for name, where in (("tool", middle < 0), ("block", middle > 0))
        )
        self.down = [uem.dirichlet(self.V, b.top, i, -0.02 * (i == self.g - 1)) for i in range(self.g)]

    def problem(self, bcs, left_out=True, contacts=(), **how):
        """From rest."""
        self.b.u.x.array[:] = 0.0
        law = uem.LinearElastic(2.0, 0.3, kind="plane_strain" if self.g == 2 else "3d")
        F = law.residual(self.b.u, ufl.TestFunction(self.V)) * (uem.dx(self.block) if left_out else ufl.dx)
        return uem.UnitedProblem(F, self.b.u, bcs=[*bcs, *self.down], contacts=list(contacts), **how)

    def contact(self, **how):
        """Between the two."""
        return uem.Contact(self.b.high, self.b.low, **how)


@pytest.mark.long
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
@pytest.mark.parametrize(("coupling", "options"), [("node_to_surface", None), ("mortar", None), ("node_to_surface", CG)])
def test_a_held_body_that_is_left_out_of_the_residual(cell, coupling, options):
    """A tool drawn as a mesh and held at all of its nodes is pressed on as one of some stiffness."""
    p, forces = Pressed(cell), []
    for left_out in (False, True):
        contact = p.contact(coupling=coupling)
        p.problem([uem.dirichlet(p.V, p.tool)], left_out, [contact], petsc_options=options).solve()
        forces.append(contact.resultant().force)
    assert forces[0][-1] > 0.01
    np.testing.assert_allclose(forces[1], forces[0], rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("options", [None, CG])
@pytest.mark.parametrize("how", ["alone", "contact", "tied", "free"])
def test_a_body_that_is_left_out_of_the_residual(how, options):
    """Held at some of its nodes or none: nothing resists the others, which is reported."""
    p = Pressed("triangle", 2)
    contacts = [] if how == "alone" else [p.contact(tied=how == "tied")]
    bcs = [] if how == "free" else [uem.dirichlet(p.V, p.b.bottom)]
    with pytest.raises(uem.InputError, match=r"nothing resists \d+ nodes of the body with its middle at \(0\.5, -0\.5\)"):
        p.problem(bcs, True, contacts, petsc_options=options).solve()


@pytest.mark.parametrize("rotations", ["small", "large"])
@pytest.mark.parametrize("force", [0.0, 0.01, -0.01])
def test_a_free_rigid_body_without_stiffness(rotations, force):
    """It is pressed on the block, stays where it is, or is pulled away, and that is reported."""
    p = Pressed("quadrilateral")
    contact = p.contact()
    rigid = uem.RigidCoupling(p.tool, (0.5, -0.5), rotations=rotations, force=(0.0, force))
    problem = p.problem([], True, [contact], couplings=[rigid])
    if force < 0:
        with pytest.raises(uem.FloatingBodyError, match=r"\(0\.5, -0\.5\) moves along"):
            problem.solve()
        return
    problem.solve()
    np.testing.assert_allclose(contact.resultant().force, [0.0, force], atol=1e-12)


def test_conditions_of_a_body_without_stiffness_change():
    """What holds it in one step is gone in the next one: that is reported."""
    p = Pressed("triangle")
    problem = p.problem([uem.dirichlet(p.V, p.tool)])
    steps = [uem.Step("held"), uem.Step("loose", bcs=p.down)]
    with pytest.raises(uem.InputError, match="nothing resists"):
        list(uem.load_steps(problem, steps))


def squeezed(waves=2e-5):
    """A block between a clamped one and one that is led, all surfaces wavy by a small part of their size."""
    corners = [((0.0, 0.0), (2.0, 1.0), (6, 3)), ((0.3, 1.0), (1.7, 1.6), (5, 2)), ((0.6, 1.6), (1.4, 2.2), (3, 2))]
    s = scene(COMM, "quadrilateral", [box("quadrilateral", list(a), list(b), list(n)) for a, b, n in corners])
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    sides = ((1, 1.0), (0, 1.0), (2, 1.6), (1, 1.6), (0, 0.0), (2, 2.2))
    a, b, c, d, bottom, top = (s.tag(f"side {i}", body, at(1, y)) for i, (body, y) in enumerate(sides))
    x = s.mesh.geometry.x
    x[:, :2] += waves * np.stack([np.sin(3 * x[:, 0] + 2 * x[:, 1] + i) for i in range(2)], axis=1)
    bcs = [uem.dirichlet(V, bottom), uem.dirichlet(V, top, value=(0.04, -0.06))]
    F = elastic(uem.LinearElastic, u, v, 2)
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=[uem.Contact(a, b), uem.Contact(c, d)])


def test_a_body_that_is_squeezed_out():
    """A first step that throws the middle block out by many of its sizes is cut."""
    problem = squeezed()
    first = next(iter(uem.load_steps(problem, 4)))
    assert first.cuts > 0 and COMM.allreduce(np.abs(problem.u.x.array).max(initial=0.0), op=MPI.MAX) < 2.0
    assert problem.contacts[1].resultant().force[1] > 0.0


@pytest.mark.parametrize("waves", [2e-5, 1.7e-3])
def test_a_body_that_is_thrown_out(waves):
    """What ``solve`` cannot cut is an error, at 2,600 and at 30 times the way of all else, and the bodies are where they were."""
    problem = squeezed(waves)
    with pytest.raises(uem.ThrownBodyError, match="throws the body with its middle at .* out of the scene"):
        problem.solve()
    assert not problem.u.x.array.any()
