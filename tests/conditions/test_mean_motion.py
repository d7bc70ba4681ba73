"""Prescribed means of displacements: as under a uniform traction, without stiffening, with contact, and what is refused."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, blocks, box, highest, refused, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def cantilever(cell, degree, g):
    """A block clamped at its foot, and its head as a part."""
    s = scene(COMM, cell, [box(cell, [0.0] * g, [1.0] * (g - 1) + [2.0], [2] * (g - 1) + [4])])
    V = compat.function_space(s.mesh, degree, (g,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    law = uem.StVenantKirchhoff(1.0, 0.3, kind="plane_strain" if g == 2 else "3d")
    return (
        u,
        v,
        law.residual(u, v) * ufl.dx,
        [uem.dirichlet(V, s.tag("foot", 0, at(g - 1, 0.0)))],
        s.tag("head", 0, at(g - 1, 2.0)),
    )


@pytest.mark.parametrize(
    ("cell", "degree", "g"), [("triangle", 2, 2), ("quadrilateral", 1, 2), slow("tetrahedron", 1, 3), slow("hexahedron", 2, 3)]
)
def test_as_under_a_uniform_traction(cell, degree, g):
    """Led in the mean along both components, the body deforms as under the traction that does this, at large displacements."""
    u, v, F, bcs, head = cantilever(cell, degree, g)
    traction = fem.Constant(u.function_space.mesh, np.linspace(0.02, 0.05, g))
    uem.UnitedProblem(F - ufl.dot(traction, v) * uem.ds(head), u, bcs=bcs, rtol=1e-12).solve()
    wanted, area = np.array(u.x.array), uem.integrate(fem.Constant(u.function_space.mesh, 1.0) * uem.ds(head))
    means = [uem.integrate(u[c] * uem.ds(head)) / area for c in range(g)]
    u.x.array[:] = 0.0
    equations = [uem.MeanMotion(head, 2.0 * np.eye(g)[c], b=2.0 * mean) for c, mean in enumerate(means)]
    problem = uem.UnitedProblem(F, u, bcs=bcs, equations=equations, rtol=1e-12)
    for _ in uem.load_steps(problem, 2):
        pass
    assert highest(COMM, np.abs(u.x.array - wanted)) < 1e-9 * highest(COMM, np.abs(wanted))


def test_of_a_body_and_of_points():
    """The mean over a volume is an integral, that over points a sum."""
    u, v, F, bcs, head = cantilever("quadrilateral", 1, 2)
    mesh = u.function_space.mesh
    cells = np.arange(mesh.topology.index_map(2).size_local, dtype=np.int32)
    body = uem.Tag("body", 1, 2, mesh, cells)
    problem = uem.UnitedProblem(F, u, bcs=bcs, equations=[uem.MeanMotion(body, (0, 1), b=lambda s: 0.03 * s)])
    for step in uem.load_steps(problem, 2):
        assert uem.integrate(u[1] * ufl.dx) / 2.0 == pytest.approx(0.03 * step.factor, rel=1e-9)


def test_pressed_in_the_mean():
    """A block that is led onto another one by its mean: the contact carries the traction, evenly where nothing else acts."""
    b = blocks(COMM, "quadrilateral", 2, 3, gap=0.01)
    F = uem.LinearElastic(1.0, 0.0, kind="plane_strain").residual(b.u, ufl.TestFunction(b.V)) * ufl.dx
    contact = uem.Contact(b.high, b.low, coupling="mortar")
    bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top, 0)]
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], equations=[uem.MeanMotion(b.top, (0, 1), b=-0.05)])
    problem.solve()
    area = uem.integrate(fem.Constant(b.scene.mesh, 1.0) * uem.ds(b.top))
    assert uem.integrate(b.u[1] * uem.ds(b.top)) / area == pytest.approx(-0.05, rel=1e-12)
    assert contact.resultant().force[1] == pytest.approx(0.04 / 2.0, rel=1e-9)


def test_what_is_refused():
    """Each with what is wrong."""
    u, v, F, bcs, head = cantilever("quadrilateral", 1, 2)
    refused(uem.InputTypeError, "c = 'y'", lambda: uem.MeanMotion(head, "y"))
    made = lambda *equations: lambda: uem.UnitedProblem(F, u, bcs=bcs, equations=equations)  # noqa: E731
    refused(uem.InputError, "c of equations[0]", made(uem.MeanMotion(head, (0, 0, 1))))
    foot = uem.compat.bc_dofs(bcs[0])
    assert len(foot) == 2
    twice = uem.MeanMotion(head, (0, 1), b=0.1), uem.MeanMotion(head, (0, 1), b=0.2)
    refused(uem.ConflictError, ("equations[1]", "follows from"), made(*twice))
