"""Ties of a scalar field: linear temperatures pass through any pair of meshes, heat is conserved, conduction may be nonlinear.

The test to read first: ``test_a_linear_field_passes``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from benchmarks import patches
from dolfinx import fem, mesh
from helpers import MESHES, refused, slow

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.parallel import reduced

COMM = MPI.COMM_WORLD


def two_blocks(dim, n_1, n_2, quads=0):
    """Unit cubes or squares one upon the other, whose meshes do not match."""
    return uem.read_gmsh(MESHES / "blocks.geo", COMM, gdim=dim, parameters={"dim": dim, "n_1": n_1, "n_2": n_2, "quads": quads})


def conduction(u, k=1.0):
    return k * ufl.inner(ufl.grad(u), ufl.grad(ufl.TestFunction(u.function_space))) * ufl.dx


@pytest.mark.parametrize(
    ("dim", "degree", "quads", "cells", "coupling"),
    [
        (2, 2, 0, (3, 4), "mortar"),
        (3, 1, 1, (3, 2), "mortar"),
        (2, 1, 0, (2, 4), "node_to_surface"),
        slow(2, 1, 0, (4, 3), "mortar"),
        slow(3, 2, 0, (2, 3), "mortar"),
        slow(3, 1, 0, (2, 4), "node_to_surface"),
    ],
)
def test_a_linear_field_passes(dim, degree, quads, cells, coupling):
    """It is prescribed on the outside, also at nodes of both sides of the tie, and found everywhere else."""
    domain, tags = two_blocks(dim, *cells, quads)
    if coupling == "mortar" and not quads:
        patches.move_nodes(domain.geometry.x, 0.2 / max(cells))
    V = uem.function_space(domain, degree)
    u, exact = fem.Function(V), fem.Function(V)
    exact.interpolate(lambda x: 7.0 + np.array([1.0, 2.0, -3.0])[:dim] @ x[:dim])
    outside = [tags[name] for name in ("bottom_1", "top_2", "sides_x", "sides_y") if name in tags]
    tie = uem.Contact(tags["bottom_2"], tags["top_1"], coupling=coupling, tied=True)
    problem = uem.UnitedProblem(conduction(u), u, bcs=[uem.dirichlet(V, outside, value=exact)], contacts=[tie])
    problem.solve()
    assert reduced(COMM, np.abs(u.x.array - exact.x.array).max(initial=0.0), op=MPI.MAX) < 1e-13 * 10.0
    assert tie.name in repr(problem)


@pytest.mark.parametrize("contactor", ["upper", slow("lower")])
def test_nonlinear_conduction(contactor):
    """With k = 1 + u cells of degree 1 are exact at nodes: u + u^2 / 2 is linear, and as much heat goes in as comes out."""
    domain, tags = two_blocks(2, 3, 4, quads=1)
    V = uem.function_space(domain, 1)
    u = fem.Function(V)
    sides = (tags["bottom_2"], tags["top_1"])
    tie = uem.Contact(*(sides if contactor == "upper" else sides[::-1]), coupling="mortar", tied=True)
    ends = tags["bottom_1"], tags["top_2"]
    bcs = [uem.dirichlet(V, tag, value=value) for tag, value in zip(ends, (0.0, 1.0))]
    problem = uem.UnitedProblem(conduction(u, 1.0 + u), u, bcs=bcs, contacts=[tie], rtol=1e-12)
    iterations = [len(step.iterations) for step in uem.load_steps(problem, 2)]
    y = V.tabulate_dof_coordinates()[: len(u.x.array), 1]
    top = reduced(COMM, y.max(initial=-np.inf), op=MPI.MAX)
    bottom = -reduced(COMM, -y.min(initial=np.inf), op=MPI.MAX)
    kirchhoff = u.x.array + 0.5 * u.x.array**2
    assert np.abs(kirchhoff - 1.5 * (y - bottom) / (top - bottom)).max(initial=0.0) < 1e-11
    assert max(iterations) <= 7
    assert [problem.reaction(tag)[0] for tag in ends] == pytest.approx([-0.75, 0.75], rel=1e-10)


@pytest.mark.slow
def test_conditions_on_both_sides():
    """A harmonic field on the outside, which the meshes do not have alike, is found inside, better by four on a mesh twice as fine."""
    errors = []
    for n in (3, 6):
        domain, tags = two_blocks(3, n, n + 1, quads=1)
        V = uem.function_space(domain, 1)
        u, exact = fem.Function(V), fem.Function(V)
        exact.interpolate(lambda x: np.sin(2.0 * x[0]) * np.exp(2.0 * x[2] - 4.0) + x[1])
        outside = [tags[name] for name in ("bottom_1", "top_2", "sides_x", "sides_y")]
        tie = uem.Contact(tags["bottom_2"], tags["top_1"], coupling="mortar", tied=True)
        uem.UnitedProblem(conduction(u), u, bcs=[uem.dirichlet(V, outside, value=exact)], contacts=[tie]).solve()
        errors.append(reduced(COMM, np.abs(u.x.array - exact.x.array).max(initial=0.0), op=MPI.MAX))
    assert 3.0 < errors[0] / errors[1] < 6.0 and errors[1] < 2e-3


def test_linear_equations_of_a_scalar():
    """Periodic with a jump, and held at a corner, the field is linear."""
    square = mesh.create_unit_square(COMM, 3, 3)
    V = uem.function_space(square, 1)
    u = fem.Function(V)
    left, right = (mesh.locate_entities_boundary(square, 1, lambda x, at=at: np.isclose(x[0], at)) for at in (0.0, 1.0))
    corner = fem.locate_dofs_geometrical(V, lambda x: np.isclose(x[0], 0.0) & np.isclose(x[1], 0.0))
    bcs = [compat.dirichletbc(0.0, corner, V)]
    uem.UnitedProblem(conduction(u), u, bcs=bcs, equations=[uem.periodic(right, left, jump=2.0)]).solve()
    assert np.abs(u.x.array - 2.0 * V.tabulate_dof_coordinates()[: len(u.x.array), 0]).max(initial=0.0) < 1e-13


def test_refused():
    domain, tags = two_blocks(2, 1, 1)
    V = uem.function_space(domain, 1)
    u = fem.Function(V)
    sides = tags["bottom_2"], tags["top_1"]

    def problem(contact, **options):
        return lambda: uem.UnitedProblem(conduction(u), u, contacts=[contact], **options)

    plane = uem.RigidPlane((0.0, -1.0), (0.0, 1.0))
    refused(uem.SpaceError, ("1 component(s)", "tied=True"), problem(uem.Contact(*sides)))
    refused(uem.SpaceError, ("1 component(s)", "facets of a mesh"), problem(uem.Contact(sides[0], plane, tied=True)))
    refused(uem.SpaceError, "1 component(s)", problem(uem.Contact(*sides, tied="after")))
    load = [uem.PointLoad(tags["bottom_1"], (0.0, 1.0))]
    refused(uem.InputError, "points is for displacements", problem(uem.Contact(*sides, tied=True), points=load))
    tie = uem.Contact(*sides, tied=True)
    problem(tie)()
    refused(uem.SurfaceError, "ties a scalar field", lambda: tie.resultant())
    refused(uem.SpaceError, "belongs to another problem", problem(tie))
    refused(uem.InputTypeError, "declare a Contact", lambda: uem.GeneralContact(tied=True))
