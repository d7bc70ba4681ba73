"""What warnings name: facets that cannot follow a curve, and contactors that slide off the end of a target.

Worth reading first: ``test_surfaces_that_conform`` and ``test_contactors_that_slip_off``.
"""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import blocks, box, clamp, linear, modulus, raised, run, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.warnings import checks
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.search import MeshTarget

COMM = MPI.COMM_WORLD


def reported(caplog, words):
    """How often rank 0 has logged these words, on all ranks."""
    return COMM.bcast(sum(words in r.getMessage() for r in caplog.records))


def polar(x):
    """A quarter of a ring from radius and part of the quarter; the last axis stays."""
    angle = 0.5 * np.pi * x[:, 1]
    return np.column_stack([x[:, 0] * np.cos(angle), x[:, 0] * np.sin(angle), x[:, 2:]])


def pin_in_hole(clearance, n_pin, n_hole, *, size=1.0, g=2, hole_first=False, degree=1):
    """A quarter of a pin of radius 1 in a hole that is larger by the clearance; the hole is the target, or the pin."""
    cell, more = ("quadrilateral", []) if g == 2 else ("hexahedron", [0.5])
    pin = box(cell, [0.5, 0.0, *[0.0] * (g - 2)], [1.0, 1.0, *more], [2, n_pin, *[2] * (g - 2)]).mapped(polar)
    hole = box(cell, [1.0 + clearance, 0.0, *[0.0] * (g - 2)], [2.0, 1.0, *more], [2, n_hole, *[2] * (g - 2)]).mapped(polar)
    s = scene(COMM, cell, [pin, hole], pose=lambda x: size * x)
    V = compat.function_space(s.mesh, degree, (g,))
    u = fem.Function(V)

    def radius(r):
        return lambda x: np.abs(np.hypot(x[:, 0], x[:, 1]) - r) < 1e-9

    outer, inner = s.tag("pin", 0, radius(1.0)), s.tag("hole", 1, radius(1.0 + clearance))
    contact = uem.Contact(*((inner, outer) if hole_first else (outer, inner)))
    return uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0)), u, contacts=[contact])


# the facets of n = 10 sag by (pi / 20)^2 / 8 of the radius
SAG = (np.pi / 20) ** 2 / 8


@pytest.mark.parametrize("hole_first", [False, True])
@pytest.mark.parametrize("part, expected", [(0.1, 1), (0.5, 1), (2.0, 0), (10.0, 0)])
@pytest.mark.parametrize("size", [1.0, 1e-6, 1e3])
def test_surfaces_that_conform(hole_first, part, expected, size, caplog):
    """Told if the facets sag by more than the clearance, in any unit, and if there are more than a few of them."""
    for n, wanted in ((10, expected), (4, 0)):
        caplog.clear()
        pin_in_hole(part * SAG * (10 / n) ** 2, *((n, 25) if hole_first else (25, n)), size=size, hole_first=hole_first)
        assert reported(caplog, "the surfaces conform") == wanted


@pytest.mark.parametrize("kind", ["same nodes", "3D"])
def test_surfaces_that_conform_otherwise(kind, caplog):
    """Surfaces with the same nodes touch alike however their facets sag; in 3D a warning names it as in the plane."""
    pin_in_hole(0.3 * SAG, 10 if kind == "same nodes" else 25, 10, g=3 if kind == "3D" else 2)
    assert reported(caplog, "the surfaces conform") == (kind == "3D")


def two_discs(gap, n):
    """A half disc above another one: they touch in a point, however near they are."""
    below = box("quadrilateral", [0.5, 0.0], [1.0, 2.0], [2, n]).mapped(polar)
    above = box("quadrilateral", [0.5, 2.0], [1.0, 4.0], [2, n + 3]).mapped(lambda x: polar(x) + [0.0, 2.0 + gap])
    s = scene(COMM, "quadrilateral", [below, above])
    u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
    low = s.tag("low", 0, lambda x: np.abs(np.hypot(x[:, 0], x[:, 1]) - 1.0) < 1e-9)
    high = s.tag("high", 1, lambda x: np.abs(np.hypot(x[:, 0], x[:, 1] - 2.0 - gap) - 1.0) < 1e-9)
    return uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0)), u, contacts=[uem.Contact(high, low)])


@pytest.mark.parametrize("gap", [0.0, 1e-4, 1e-2])
@pytest.mark.parametrize("n", [6, 20, 41])
def test_surfaces_that_touch_in_a_point(gap, n, caplog):
    two_discs(gap, n)
    assert reported(caplog, "the surfaces conform") == 0


@pytest.mark.parametrize("n, curved", [(2, False), (4, True)])
def test_corners_are_no_curves(n, curved, caplog):
    """Half an octagon is a curve of its radius, half a square has a corner; blocks in a box, flush with its walls, do not conform."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.5, 0.0], [1.0, 2.0], [2, n]).mapped(polar)])
    config = Configuration(fem.Function(compat.function_space(s.mesh, 1, (2,))))
    on_it = s.tag("polygon", 0, lambda x: np.hypot(x[:, 0], x[:, 1]) > 1.0 - 1e-9)
    curvatures = np.trace(checks.facet_curvatures(MeshTarget(TargetFacets(config, on_it))), axis1=1, axis2=2)
    largest = COMM.allreduce(float(curvatures.max(initial=0.0)), op=MPI.MAX)
    assert largest == (pytest.approx(1.0, rel=0.05) if curved else 0.0)
    b = blocks(COMM, "quadrilateral", 4, 9)
    uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, contacts=[uem.Contact(b.high, b.low)])
    assert reported(caplog, "the surfaces conform") == 0


# -- contactors that stay inside ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "depth, free, left_out, refused",
    [(3e-7, True, True, False), (3e-6, True, True, True), (3e-6, True, False, False), (3e-7, False, False, True)],
)
@pytest.mark.parametrize("size", [1e-6, 1.0, 1e3])
def test_contactors_that_are_left_inside(depth, free, left_out, refused, size):
    """One whose equation depends on others is by as much as surfaces bend, one that is prescribed never is."""
    b = blocks(COMM, "quadrilateral", 2, 2, pose=lambda x: size * x)
    contact = uem.Contact(b.high, b.low)
    pair = uem.UnitedProblem(linear(b.u, 1.0), b.u, contacts=[contact]).contacts[0].pair
    n = len(pair.nodes)
    at = SimpleNamespace(movable=np.full(n, free), projection=SimpleNamespace(gap=np.full(n, -depth * pair.config.size)))
    trial = SimpleNamespace(active=np.ones(n, bool), redundant=np.full(n, left_out), law_gap=None)
    seen = SimpleNamespace(
        members=[pair], discretisation=pair.discretisation, config=pair.config, nodes=pair.nodes, off=np.zeros(n, bool), trial=trial,
        tie=None, kinematics=at,
    )  # fmt: skip
    if refused:
        raised(uem.OverdeterminedError if free else uem.ConflictError, "inside the target", lambda: checks.check_prescribed(seen))
    else:
        checks.check_prescribed(seen)


@pytest.mark.parametrize("pull, refused", [(3e-9, False), (3e-8, True), (2e-3, True)])
@pytest.mark.parametrize("size", [1e-6, 1e3])
def test_contactors_that_pull(pull, refused, size):
    """Of hard contact no equilibrium has one, except by rounding; those that laws or ties hold may pull."""
    b = blocks(COMM, "quadrilateral", 2, 2, pose=lambda x: size * x)
    pair = uem.UnitedProblem(linear(b.u, 1.0), b.u, contacts=[uem.Contact(b.high, b.low)]).contacts[0].pair
    n = len(pair.nodes)
    lam = np.where(pair.config.X[pair.nodes, 0] > 0.9 * size, -pull, 1.0) * size

    def seen(active=True, tied=False, law=False):
        trial = SimpleNamespace(active=np.full(n, active), lam=lam, has_law=law)
        of = {"members": [pair], "discretisation": pair.discretisation, "config": pair.config, "nodes": pair.nodes}
        return SimpleNamespace(**of, tied=np.full(n, tied), trial=trial)

    for other in (seen(active=False), seen(tied=True), seen(law=True)):
        checks.check_signs([other], [np.zeros(n)])
    checks.check_signs([seen()], [np.full(n, 3.0 * pull * size)])
    if refused:
        raised(uem.ConvergenceError, "pulls with", lambda: checks.check_signs([seen()], [np.zeros(n)]))
    else:
        checks.check_signs([seen()], [np.zeros(n)])


# -- curved meshes -----------------------------------------------------------------------------------------------------


def quadratic_mesh(bulge):
    """A square of degree 2 whose lower side is bent."""
    x = np.array([[i / 4, j / 4] for j in range(5) for i in range(5)])
    x[:, 1] -= bulge * (1 - x[:, 1]) * 4 * x[:, 0] * (1 - x[:, 0])
    # Gmsh's order: corners, middles of sides, middle
    cells = [[5 * (j + b) + i + a for a, b in ((0, 0), (2, 0), (2, 2), (0, 2), (1, 0), (2, 1), (1, 2), (0, 1), (1, 1))]
             for j in (0, 2) for i in (0, 2)]  # fmt: skip
    given = slice(None) if COMM.rank == 0 else slice(0)
    return compat.create_mesh(COMM, np.array(cells, dtype=np.int64)[given], x[given], "quadrilateral", 2)


@pytest.mark.parametrize("degree, bulge, expected", [(1, 0.1, 1), (1, 0.0, 0), (2, 0.1, 0)])
def test_straight_facets_of_a_curved_mesh(degree, bulge, expected, caplog):
    from dolfinx import mesh as dmesh

    mesh = quadratic_mesh(bulge)
    u = fem.Function(compat.function_space(mesh, degree, (2,)))
    facets = dmesh.locate_entities_boundary(mesh, 1, lambda x: x[1] < 0.25)
    contact = uem.Contact(facets, uem.RigidPlane((0.0, -0.2), (0.0, 1.0)))
    uem.UnitedProblem(linear(u, 1.0), u, contacts=[contact])
    assert reported(caplog, "replaces the curved facets") == expected
    # a parabola of height 0.1 on two facets of half its width
    assert reported(caplog, "up to 0.025 away") == expected


# -- ends --------------------------------------------------------------------------------------------------------------


def bulging(n, overhang=0.0):
    """A stiff block pressed into a soft one, which bulges, of the same width or wider."""
    b = blocks(COMM, "quadrilateral", n, n, overhang=overhang)
    contact = uem.Contact(b.high, b.low)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=(0.0, -0.1))]
    run(uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 10.0)), b.u, bcs=bcs, contacts=[contact]), 3)
    return contact


def slipping(n, part):
    """A block whose bottom is as wide as its target, pulled past the target's end by a part of a facet."""
    b = blocks(COMM, "quadrilateral", n, n)
    contact = uem.Contact(b.high, b.low)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=(part / n, -1e-3))]
    run(uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1000.0)), b.u, bcs=bcs, contacts=[contact]))
    return contact


@pytest.mark.parametrize("n, expected", [(4, 1), (8, 1), (16, 0)])
def test_contactors_that_slip_off(n, expected, caplog, monkeypatch):
    """Told, once, where what they carried is a good part of the contact."""
    contact = slipping(n, 0.4)
    assert COMM.allreduce(int(contact.pair.off.sum())) == 1
    assert reported(caplog, "slid off the end of the target") == expected
    share = COMM.allgather(float(contact._areas.sum()))
    assert sum(share) == pytest.approx(1.0)
    for threshold, wanted in ((10 * checks.SLIPPED, 0), (0.1 * checks.SLIPPED, 1)):
        caplog.clear()
        monkeypatch.setattr(checks, "SLIPPED", threshold)
        slipping(n, 0.4)
        assert reported(caplog, "slid off the end of the target") == wanted


@pytest.mark.parametrize("overhang", [0.25, 0.5])
def test_contactors_that_stay_on(overhang, caplog):
    bulging(4, overhang)
    assert reported(caplog, "slid off") == 0


def test_contactors_that_were_never_on(caplog):
    """A wide block on a narrow one."""
    b = blocks(COMM, "quadrilateral", 4, 3, overhang=0.3)
    contact = uem.Contact(b.low, b.high)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=(0.0, -0.1))]
    run(uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=bcs, contacts=[contact]), 2)
    assert contact.n_active and reported(caplog, "slid off") == 0


@pytest.mark.parametrize("coupling", ["mortar", "node_to_surface"])
@pytest.mark.parametrize("angle, slim", [(36.0, True), (43.0, False)])
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_slim_tips(coupling, angle, slim, cell, caplog):
    """Told of a wedge's edge whose facets meet at less than 39 degrees, with the coupling that cannot hold off both."""
    g, slope = (2 if cell == "quadrilateral" else 3), 1 / np.tan(np.radians(0.5 * angle))
    boxes = [
        box(cell, [-1.0, *[0.0] * (g - 2), -4.0], [1.0, *[1.0] * (g - 2), -3.0], [2] * g),
        box(cell, [-0.5, *[0.0] * (g - 2), 0.0], [0.5, *[1.0] * (g - 2), 1.0], [2] * g),
    ]
    s = scene(
        COMM, cell, boxes, pose=lambda x: x + np.outer(slope * np.abs(x[:, 0]) * (x[:, -1] > -1) * (1 - x[:, -1]), np.eye(g)[-1])
    )
    u = fem.Function(compat.function_space(s.mesh, 1, (g,)))
    low, high = s.tag("tip", 1, lambda x: np.abs(x[:, -1]) < 1e-9), s.tag("top", 0, lambda x: np.abs(x[:, -1] + 3) < 1e-9)
    uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0)), u, contacts=[uem.Contact(low, high, coupling=coupling)])
    assert reported(caplog, "meet at less than 40 degrees") == (slim and coupling == "mortar")
