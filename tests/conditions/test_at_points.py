"""Forces and springs at nodes, and bodies that springs alone hold."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem, mesh
from helpers import MESHES, at, blocks, box, clamp, highest, linear, modulus, refused, run, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def bar():
    """A bar of 2 by 1 with its ends."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [2.0, 1.0], [4, 2])])
    V = compat.function_space(s.mesh, 1, (2,))
    return s, V, fem.Function(V, name="u"), s.tag("left", 0, at(0, 0.0)), s.tag("right", 0, at(0, 2.0))


def test_forces_of_a_surface():
    """Nodal forces that make up a traction do as it does, among finite strains, and follow the load."""
    s, V, u, left, right = bar()
    force, traction = fem.Constant(s.mesh, (0.0, 0.0)), fem.Constant(s.mesh, (0.0, 0.0))
    half = fem.Constant(s.mesh, (0.0, 0.0))
    points = [uem.PointLoad((2.0, 0.5), force), uem.PointLoad((2.0, 0.0), half), uem.PointLoad((2.0, 1.0), half)]
    load = {force: (0.01, 0.02), half: (0.005, 0.01)}
    problem = uem.UnitedProblem(st_venant(u, 1.0), u, bcs=clamp(V, left), points=points, load=load)
    steps = run(problem, 2)
    w = fem.Function(V)
    F = st_venant(w, 1.0) - ufl.dot(traction, ufl.TestFunction(V)) * uem.ds(right)
    run(uem.UnitedProblem(F, w, bcs=clamp(V, left), load={traction: (0.02, 0.04)}), 2)
    assert highest(COMM, np.abs(u.x.array - w.x.array)) <= 1e-12
    assert np.allclose(problem.reaction(left), (-0.02, -0.04), rtol=1e-9) and steps[-1].newton_iterations <= 5


def test_several_nodes_at_once():
    """A load and a spring on several nodes are one on each of them, held nodes included."""
    s, V, u, left, _ = bar()
    places = [(0.0, 0.5), (1.0, 0.5), (2.0, 0.0)]
    near = [mesh.locate_entities(s.mesh, 0, lambda x, p=p: np.hypot(x[0] - p[0], x[1] - p[1]) < 1e-6) for p in places]
    points = uem.Tag("points", 1, 0, s.mesh, np.unique(np.concatenate(near)).astype(np.int32))
    force, k, found = (0.03, -0.01), (0.2, 0.4), []
    for where in ([points], places):
        u.x.array[:] = 0.0
        loads = [one(at, value) for at in where for one, value in ((uem.PointLoad, force), (uem.PointSpring, k))]
        problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=clamp(V, left), points=loads)
        run(problem)
        found.append((np.array(u.x.array), problem.reaction(left)))
    assert highest(COMM, np.abs(found[0][0] - found[1][0])) <= 1e-14 and highest(COMM, np.abs(u.x.array)) > 0.03
    assert np.allclose(found[0][1], found[1][1], rtol=1e-12)


def test_a_body_on_springs():
    """Springs hold it where nothing else does: it moves by force over stiffness, turned as much as drawn, in one iteration."""
    s, V, u, left, right = bar()
    foot = np.array([[3.0, 1.0], [1.0, 2.0]])
    points = [uem.PointSpring((0.0, 0.0), foot), uem.PointSpring((2.0, 0.0), (0.0, 4.0)), uem.PointLoad((1.0, 1.0), (0.1, -0.3))]
    problem = uem.UnitedProblem(linear(u, 1e6), u, points=points)
    (step,) = run(problem)
    # rigid but for 1e-6: u at the feet by equilibrium of forces and of moments about the first one
    a = np.zeros((3, 3))
    a[:2, :2], a[1, 1:], a[2, 1:] = foot, (2.0 + 4.0, 8.0), (8.0, 16.0)
    ux, uy, turn = np.linalg.solve(a, [0.1, -0.3, -0.3 * 1.0 - 0.1 * 1.0])
    X, d = problem.config.X, problem.config.displacement
    assert highest(COMM, np.abs(d - np.column_stack([ux - turn * X[:, 1], uy + turn * X[:, 0]]))) <= 1e-5
    assert step.newton_iterations == 1


def test_springs_in_the_form_hold_what_rests_on_a_target():
    """A block that a side load would push off its target stands where its springs balance that load, as quickly as a clamped one."""
    b = blocks(COMM, "quadrilateral", 3, 4, overhang=0.3)
    v, k, side = ufl.TestFunction(b.V), 0.1, 1e-3
    loads = (k * ufl.dot(b.u, v) + 0.01 * v[1] - side * v[0]) * uem.ds(b.top)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(
        st_venant(b.u, modulus(b.scene, 1.0, 1.0)) + loads, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact]
    )
    steps = run(problem, 1)
    # facets of the target lean a little
    leaning = contact.resultant().force[0]
    assert abs(leaning) < 0.01 * side
    assert abs(uem.integrate(b.u[0] * uem.ds(b.top)) * k - side - leaning) <= 1e-9 * side
    assert steps[0].newton_iterations <= 4


def test_energy_of_springs_and_loads():
    """A body on springs that a load sets in motion, one corner of which another one follows: no energy is gained or lost."""
    s, V, u, left, right = bar()
    points = [uem.PointSpring((0.0, 0.0), 3.0), uem.PointSpring((2.0, 0.0), (1.0, 4.0)), uem.PointLoad((1.0, 1.0), (0.1, -0.3))]
    level = uem.Equation([((0.0, 1.0), (0, 1)), ((2.0, 1.0), (0, -1))], b=lambda t: 0.1 * t**2)
    dynamics = uem.Dynamics(uem.consistent_mass(V, 1.0))
    problem = uem.UnitedProblem(linear(u, 10.0), u, points=points, equations=[level], dynamics=dynamics)
    law = uem.LinearElastic(10.0, 0.3, kind="plane_strain")
    book = uem.EnergyBook(problem, law.energy(u) * ufl.dx)
    for step in uem.time_steps(problem, 0.02, 0.6):
        row = book.write(step)
    assert row.external > 0.01 and row.stored > 0.01
    # velocities are prescribed to the second order of the step
    assert abs(row.defect) <= 1e-3 * row.external


def test_physical_points():
    """A physical point of a .geo file names the node; other groups are refused, and so are odd forces and springs."""
    mesh, tags = uem.read_gmsh(MESHES / "cantilevers.geo", COMM, gdim=2)
    V = uem.function_space(mesh, ("Lagrange", 1, (2,)))
    point = next(key for key in tags if tags[key].dim == 0)
    other = next(key for key in tags if tags[key].dim == 1)

    def loads(*points):
        from uem_dolfinx.conditions.at_points import AtPoints
        from uem_dolfinx.geometry.configuration import Configuration

        found, b = AtPoints(Configuration(fem.Function(V)), points), fem.Function(V)
        n = 2 * V.dofmap.index_map.size_local
        found.add_forces(b.x.array[:n])
        return COMM.allreduce(b.x.array[:n].reshape(-1, 2).sum(axis=0))

    assert np.array_equal(loads(uem.PointLoad(tags[point], (1.0, -2.0))), (-1.0, 2.0))
    for error, words, call in (
        (uem.TagError, ("points[0]", "dimension 1"), lambda: loads(uem.PointLoad(tags[other], (1.0, 0.0)))),
        (uem.InputError, "no node is there", lambda: loads(uem.PointLoad((1e3, 0.123), (1.0, 0.0)))),
        (uem.InputError, "force", lambda: loads(uem.PointLoad(tags[point], (1.0, 0.0, 0.0)))),
        (uem.InputTypeError, "force", lambda: uem.PointLoad(tags[point], None)),
        (uem.InputError, "stiffness", lambda: uem.PointSpring(tags[point], -1.0)),
        (uem.InputError, "stiffness", lambda: uem.PointSpring(tags[point], [[1.0, 2.0], [0.0, 1.0]])),
        (uem.InputTypeError, "stiffness", lambda: uem.PointSpring(tags[point], "hard")),
        (uem.InputTypeError, "stiffness = True", lambda: uem.PointSpring(tags[point], True)),
        (uem.InputError, "stiffness = [1.0]", lambda: uem.PointSpring(tags[point], [1.0])),
        (uem.InputError, "stiffness = []", lambda: uem.PointSpring(tags[point], [])),
        (uem.InputError, "stiffness", lambda: loads(uem.PointSpring(tags[point], (1.0, 1.0, 1.0)))),
    ):
        refused(error, words, call)
