"""Pressures whose integrals are contact forces: any cell, degree and coupling, contactors that overhang, and general contact."""

from __future__ import annotations

from mpi4py import MPI

import pytest
from benchmarks.scenes import at, box, clamp, scene
from dolfinx import fem
from helpers import linear, slow

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
E, SETTLEMENT = 1e3, 0.01
CELLS = ["triangle", "quadrilateral", slow("tetrahedron"), "hexahedron"]


def pressed(cell, degree, contacts):
    """A block that is pressed on a smaller one: the contact that is made of the tags of foot and floor, these, and the top.

    Args:
        cell: kind of the cells.
        degree: of the displacement.
        contacts: makes the contact from foot and floor.
    """
    g = 3 if cell in ("tetrahedron", "hexahedron") else 2
    n, m = ((4, 3), (5, 3)) if g == 2 else ((2, 2, 1), (3, 3, 1))
    lower = box(cell, [0.0] * (g - 1) + [-1.0], [1.0] * (g - 1) + [0.0], n)
    upper = box(cell, [-0.2] * (g - 1) + [0.0], [1.25] * (g - 1) + [1.0], m)
    s = scene(COMM, cell, [lower, upper])
    V = uem.function_space(s.mesh, degree, (g,))
    u = fem.Function(V)
    bottom, top = s.tag("bottom", 0, at(g - 1, -1.0)), s.tag("top", 1, at(g - 1, 1.0))
    bcs = [*clamp(V, bottom, *range(g)), *clamp(V, top, *range(g), value=[0.0] * (g - 1) + [-SETTLEMENT])]
    foot, floor = s.tag("foot", 1, at(g - 1, 0.0)), s.tag("floor", 0, at(g - 1, 0.0))
    contact = contacts(foot, floor)
    problem = uem.UnitedProblem(linear(u, E), u, bcs=bcs, contacts=[contact], rtol=1e-12)
    problem.solve()
    return problem, contact, foot, floor, top


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("degree", [1, 2])
def test_contactors_that_overhang(cell, degree, coupling):
    """The integral over the contactor is the normal force, that of the condition at the top."""
    problem, contact, foot, _, top = pressed(
        cell, degree, lambda foot, floor: uem.Contact(foot, floor, coupling=coupling, sliding="small")
    )
    total = uem.integrate(contact.pressure_to_integrate() * uem.ds(foot))
    assert total == pytest.approx(contact.resultant().normal, rel=1e-10)
    assert total == pytest.approx(-problem.reaction(top)[-1], rel=1e-8)


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize(("degree", "coupling"), [(1, "node_to_surface"), (2, "node_to_surface"), slow(1, "mortar")])
def test_general_contact(cell, degree, coupling):
    """The same of a general contact, whose surfaces are those of whole bodies with their sharp edges."""
    _, contact, *sides, _ = pressed(
        cell, degree, lambda foot, _: uem.GeneralContact(order=[foot], coupling=coupling, max_penetration=0.1)
    )
    p = contact.pressure_to_integrate()
    total = sum(uem.integrate(p * uem.ds(side)) for side in sides)
    assert total == pytest.approx(contact.between("body 2", "body 1").normal, rel=1e-10)
