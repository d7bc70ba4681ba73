"""A plug larger than the hole around it, with vertices opposite vertices: Lame's pressure, loose or tight, in 2D and 3D.

The test to read first is ``test_vertices_opposite_vertices``. Every contactor starts behind a concave vertex of the target, as deep in
one facet as in the next: with either normal alone, forces would turn a plug that almost nothing holds.
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from benchmarks.scenes import Body
from dolfinx import fem
from helpers import box, clamp, gathered_vector, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
INNER, OUTER, W = 0.5, 2.0, 0.01


def ring(cell: str, low: float, high: float, n: int, m: int, past: float = 0.0, layers: int = 1) -> Body:
    """A ring about the last axis, or a slice of a tube in layers, longer by ``past`` at each end, in n x m cells."""
    more = [] if cell in ("triangle", "quadrilateral") else [0.5 + past]
    b = box(cell, [low, 0.0, *[-past] * len(more)], [high, 2 * np.pi, *more], [n, m, *[layers] * len(more)])
    x = b.x.copy()
    x[:, 0], x[:, 1] = b.x[:, 0] * np.cos(b.x[:, 1]), b.x[:, 0] * np.sin(b.x[:, 1])
    _, first, inverse = np.unique(np.round(x, 9), axis=0, return_index=True, return_inverse=True)
    return Body(x[first], inverse.ravel()[b.cells])


def plug(
    cell="quadrilateral",
    m=24,
    degree=1,
    coupling="node_to_surface",
    springs=1e-6,
    general=False,
    law=uem.NeoHooke,
    past=0.0,
    layers=1,
):
    """A plug in a hole of radius 1, both of m facets, bedded on ``springs``; problem, contact and the surface of the plug."""
    s = scene(COMM, cell, [ring(cell, 1.0, OUTER, m // 6, m, 0.0, layers), ring(cell, INNER, 1.0 + W, m // 12, m, past, layers)])
    g = s.mesh.geometry.dim
    V = compat.function_space(s.mesh, degree, (g,))
    u, v = fem.Function(V), ufl.TestFunction(V)

    def at_radius(r):
        return lambda x: np.abs(np.hypot(x[:, 0], x[:, 1]) - r) < 1e-6

    contactor, hole = s.tag("plug", 1, at_radius(1.0 + W)), s.tag("hole", 0, at_radius(1.0))
    how = {"coupling": coupling, "max_penetration": 0.2}
    contact = uem.GeneralContact(**how) if general else uem.Contact(contactor, hole, **how)
    bcs = []
    if g == 3:
        ends = [(k, z) for k, more in enumerate((0.0, past)) for z in (-more, 0.5 + more)]
        bcs = [c for k, z in ends for c in clamp(V, s.tag("end", k, lambda x, z=z: np.abs(x[:, 2] - z) < 1e-9), 2)]
    F = law(1.0, 0.3, **({"kind": "plane_strain"} if g == 2 else {})).residual(u, v) * ufl.dx + springs * ufl.dot(u, v) * ufl.dx
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact]), contact


def lame() -> float:
    """The pressure of an interference of W between two rings in plane strain, with a modulus of 1 and Poisson's ratio of 0.3."""
    E, nu = 1 / (1 - 0.3**2), 0.3 / (1 - 0.3)
    outer, inner = ((OUTER**2 + 1) / (OUTER**2 - 1) + nu) / E, ((1 + INNER**2) / (1 - INNER**2) - nu) / E
    return W / (outer + inner)


def pressures(contact: uem.Contact) -> np.ndarray:
    """Of all nodes in contact on all ranks."""
    found = gathered_vector(contact.pressure.vector if hasattr(contact.pressure, "vector") else contact.pressure.x.petsc_vec)
    return found[found > 0.0]


@pytest.mark.parametrize(
    ("cell", "degree", "coupling", "springs", "general"),
    [
        ("quadrilateral", 1, "node_to_surface", 1e-6, False),
        ("quadrilateral", 1, "node_to_surface", 1e-6, True),
        slow("hexahedron", 1, "node_to_surface", 1e-6, False),
        *(slow("quadrilateral", 1, c, k, False) for c, k in (("node_to_surface", 1e-3), ("mortar", 1e-6))),
        *(slow("triangle", d, c, 1e-6, False) for d, c in product((1, 2), ("node_to_surface", "mortar"))),
        *(slow("quadrilateral", 2, c, 1e-6, False) for c in ("node_to_surface", "mortar")),
        slow("hexahedron", 1, "mortar", 1e-6, False),
    ],
)
def test_vertices_opposite_vertices(cell, degree, coupling, springs, general):
    """Lame's pressure within the mesh's error, in a few iterations; at degree 1 it is the same at all nodes, and nothing turns."""
    problem, contact = plug(cell, 24, degree, coupling, springs, general)
    (step,) = uem.load_steps(problem, 1)
    assert step.cuts == 0 and step.newton_iterations <= 5
    p = pressures(contact)
    assert len(p) == 24 * degree * (2 if cell == "hexahedron" else 1)
    # triangles are stiffer, and at degree 2 nodal pressures scatter along curved facets
    assert abs(p.mean() / lame() - 1) < 0.05
    if degree == 1:
        assert np.ptp(p) < 1e-9 * p.mean()


def test_pressures_converge():
    """On twice as many cells the error is a third of what it was, or less."""
    errors = []
    for m in (12, 24):
        problem, contact = plug(m=m)
        list(uem.load_steps(problem, 1))
        errors.append(abs(pressures(contact).mean() / lame() - 1))
    assert errors[1] < errors[0] / 3


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "layers", "past"),
    [
        ("hexahedron", 1, 0.0),
        *(slow("hexahedron", n, past) for n, past in product((1, 2), (0.01, 0.03))),
        *(slow("hexahedron", n, past) for n, past in product((1, 2, 4), (1e-12, -1e-12, 5e-4, -5e-4)) if n < 4 or past > 0.0),
        *(slow("tetrahedron", n, past) for n, past in product((1, 2), (0.0, 5e-4, -5e-4))),
    ],
)
def test_a_plug_as_long_as_its_tube(cell, layers, past):
    """Its nodes are at the ends of the tube, or past them by up to a tenth of a facet: they carry the closed form's pressure."""
    problem, contact = plug(cell, 12, springs=1e-4, past=past, layers=layers)
    (step,) = uem.load_steps(problem, 1)
    p = pressures(contact)
    assert step.cuts == 0 and len(p) == 12 * (layers + 1)
    # twelve facets sag by more than the overlap; tetrahedra with one or two cells across are stiff, and their nodal areas differ
    assert abs(p.mean() / lame() - 1) < (0.12 if cell == "hexahedron" else 0.3)
    if cell == "hexahedron":
        # ends carry the force of what is past them
        assert np.ptp(p) < (1e-9 if abs(past) < 1e-9 or layers == 1 else max(0.01, 4 * past)) * p.mean()


@pytest.mark.slow
def test_pressures_at_vertices_without_area():
    """Vertices of quadratic triangles in concave corners of the hole have the pressures around, and not a force over rounding."""
    problem, contact = plug("tetrahedron", 12, degree=2, springs=1e-4)
    problem.solve()
    p = pressures(contact)
    assert p.min() > 0.7 * lame() and p.max() < 1.3 * lame()
