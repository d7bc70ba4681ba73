"""Gradients over features of contacts: each of second order by Taylor's test along all controls at once, or refused by name.

The page on gradients has a table of the same rows. Read first: ``EXACT`` and ``REFUSED``.
"""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from gradient_scenes import dot, move, wave
from helpers import blocks, refused

import uem_dolfinx as uem

pytestmark = pytest.mark.every_case

COMM = MPI.COMM_WORLD
ALL = ("E", "top", "X", "offset")


def pressed(cell="triangle", degree=1, target=None, general=False, controls=ALL, sizes=(3, 4), first=0.0, **how):
    """A block pressed onto another, or onto a rigid surface, and what its solution may depend on; ``solve`` takes its present values."""
    b = blocks(COMM, cell, *(sizes if cell in ("triangle", "quadrilateral") else (2, 3)), overhang=0.25, degree=degree)
    mesh, g, v = b.scene.mesh, b.gdim, ufl.TestFunction(b.V)
    E, top = fem.Constant(mesh, 1.0), fem.Constant(mesh, np.array([0.02, *[0.0] * (g - 2), -0.05]))
    F = uem.NeoHooke(E, 0.3, kind="plane_strain" if g == 2 else "3d").residual(b.u, v) * ufl.dx
    push = fem.dirichletbc(top, fem.locate_dofs_topological(b.V, g - 1, b.top.entities), b.V)
    s = SimpleNamespace(b=b, u=b.u, E=E, top=top, X=ufl.SpatialCoordinate(mesh), offset=first, controls=controls)
    s.J = (ufl.inner(b.u, b.u) + E * b.u[0] * b.u[g - 1]) * ufl.dx

    def solve():
        b.u.x.array[:] = 0.0
        surface = b.low if target is None else target(g)
        s.contact = uem.GeneralContact(**how) if general else uem.Contact(b.high, surface, offset=s.offset, **how)
        problem = uem.UnitedProblem(F, b.u, bcs=[uem.dirichlet(b.V, b.bottom), push], contacts=[s.contact], rtol=1e-13)
        problem.solve()
        return problem

    s.solve = solve
    return s


def order(s):
    """Taylor's test along a change of all controls of a scene."""
    g, x = s.b.gdim, s.b.scene.mesh.geometry.x
    changes = {"E": 0.3, "top": 0.01 * np.linspace(1.0, -1.0, g), "offset": 0.01}
    changes["X"] = wave(uem.function_space(s.b.scene.mesh, 1, (g,)), 0.01)
    problem = s.solve()
    controls = [uem.ContactParameter(s.contact, "offset") if name == "offset" else getattr(s, name) for name in s.controls]
    found = uem.gradient(problem, s.J, controls)
    slope = sum(
        dot(by, changes[name]) if name == "X" else float(np.sum(by * changes[name])) for name, by in zip(s.controls, found)
    )
    before = float(s.E.value), np.array(s.top.value), np.array(x), s.offset

    def functional(h):
        s.E.value = before[0] + h * changes["E"] * ("E" in s.controls)
        s.top.value[:] = before[1] + h * changes["top"] * ("top" in s.controls)
        if "offset" in s.controls:
            s.offset = h * changes["offset"]
        if "X" in s.controls:
            x[:] = before[2]
            move(s, changes["X"], h)
        s.solve()
        return uem.integrate(s.J)

    try:
        return uem.taylor_test(functional, slope, 0.02, 1)
    finally:
        s.E.value, s.top.value[:], x[:], s.offset = before


def plane(g):
    return uem.RigidPlane([0.0] * g, np.eye(g)[-1] + 0.02 * np.eye(g)[0])


def ball(g):
    return uem.RigidSphere([0.4] * (g - 1) + [-3.0], 3.0)


def bowl(g):
    return uem.RigidParaboloid([0.4] * (g - 1) + [0.0], -np.eye(g)[-1], 3.0)


#: What is exact, by what it is.
EXACT = {
    "nodes on triangles": {},
    "nodes on quadrilaterals": {"cell": "quadrilateral"},
    "nodes on hexahedra": {"cell": "hexahedron"},
    "nodes on tetrahedra": {"cell": "tetrahedron"},
    "nodes, degree 2": {"degree": 2, "sizes": (4, 6)},
    "nodes, degree 2, on quadrilaterals": {"degree": 2, "cell": "quadrilateral"},
    "mortar on triangles": {"coupling": "mortar"},
    "mortar on quadrilaterals": {"cell": "quadrilateral", "coupling": "mortar"},
    "mortar on tetrahedra": {"cell": "tetrahedron", "coupling": "mortar", "controls": ("E", "top", "X")},
    "mortar, degree 2": {"degree": 2, "coupling": "mortar"},
    "sliding='fixed'": {"sliding": "fixed", "controls": ("E", "top", "offset")},
    "sliding='small', the first step": {"sliding": "small", "controls": ("E", "top", "offset")},
    "averaged normals": {"normals": "averaged", "controls": ("E", "top", "X")},
    "averaged normals, degree 2": {"normals": "averaged", "degree": 2, "controls": ("E", "top", "X")},
    "averaged normals on hexahedra": {"normals": "averaged", "cell": "hexahedron", "controls": ("E", "top", "X")},
    "a plane": {"target": plane},
    "a plane with mortar": {"target": plane, "coupling": "mortar"},
    "a ball": {"target": ball},
    "a surface of functions": {"target": bowl, "controls": ("E", "top", "X")},
    "all surfaces": {"general": True, "controls": ("E", "top", "X")},
    "all surfaces with mortar": {"general": True, "coupling": "mortar", "controls": ("E", "top")},
    "gaps that were adjusted": {"adjust": 0.01, "controls": ("E", "top", "offset")},
    "an offset of places": {"first": lambda x: 0.01 * x[0], "controls": ("E", "top")},
}


@pytest.mark.long
@pytest.mark.parametrize("what", EXACT)
def test_exact(what):
    assert order(pressed(**EXACT[what])) >= 1.9


#: What is refused, by what it is: of which contact, by which control, and words of the refusal.
REFUSED = {
    "friction": ({"friction": 0.3}, "E", "contact with friction depends on all steps"),
    "wear": ({"wear": 1e-3}, "E", "contact with friction depends on all steps"),
    "a soft contact, averaged normals": ({"normal": uem.SoftContact(1e10), "normals": "averaged"}, "E", "normals='averaged'"),
    "chords": ({"chords": True, "degree": 2}, "E", "no gradient with chords=True"),
    "the shape, sliding='small'": ({"sliding": "small"}, "X", "needs contacts of sliding='finite'"),
    "the shape, adjusted gaps": ({"adjust": 0.01}, "X", "no adjust"),
    "the place, adjusted gaps": ({"adjust": 0.01, "target": plane}, "place", "no adjust"),
    "the place, sliding='fixed'": ({"sliding": "fixed", "target": plane}, "place", "expected 'finite'"),
    "the offset of a surface of functions": ({"target": bowl}, "offset", "a plane, a sphere or a cylinder"),
}


@pytest.mark.parametrize("what", REFUSED)
def test_refused(what):
    how, name, words = REFUSED[what]
    s = pressed(**how)
    problem = s.solve()
    control = getattr(s, name) if name in ("E", "X") else uem.ContactParameter(s.contact, name)
    refused(uem.InputError, words, lambda: uem.gradient(problem, s.J, control))


@pytest.mark.parametrize("cell, n, expected", [("triangle", 2, 3), ("triangle", 3, 2), ("tetrahedron", 2, 9)])
def test_contactors_on_edges(cell, n, expected, caplog):
    """On a flat target the shape has one-sided derivatives where contactors lie on edges or ends of facets; it says so, with a place."""
    b = blocks(COMM, cell, 2, n)
    v, kind = ufl.TestFunction(b.V), "plane_strain" if b.gdim == 2 else "3d"
    F = uem.LinearElastic(1.0, 0.3, kind=kind).residual(b.u, v) * ufl.dx
    problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.01), contacts=[uem.Contact(b.high, b.low)], rtol=1e-12)
    problem.solve()
    uem.gradient(problem, ufl.inner(b.u, b.u) * ufl.dx, ufl.SpatialCoordinate(b.scene.mesh))
    reported = [record.getMessage() for record in caplog.records if "edges between facets" in record.getMessage()]
    assert COMM.rank > 0 or (len(reported) == 1 and f": {expected} contactor(s), the first at (" in reported[0])


def test_nodes_that_moved():
    """A problem refers to the places of the nodes that it was made with: while they are elsewhere there is no step and no gradient."""
    s = pressed()
    problem, x = s.solve(), np.array(s.b.scene.mesh.geometry.x)
    with uem.recording(problem) as history:
        problem.solve()
        first = np.array(history.gradient(s.J, s.E)[0])
        move(s, wave(s.b.V, 1e-4), 1.0)
        for fails in (
            problem.solve,
            lambda: next(uem.load_steps(problem, 1)),
            lambda: uem.gradient(problem, s.J, s.E),
            lambda: history.gradient(s.J, s.E),
        ):
            refused(uem.InputError, "nodes have moved", fails)
        s.b.scene.mesh.geometry.x[:] = x
        again = np.array(history.gradient(s.J, s.E)[0])
    assert again == pytest.approx(first, rel=1e-10)
