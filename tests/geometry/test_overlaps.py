"""Segments of pairs of facets against SciPy's half-spaces and against integrals in closed form.

The test to read first is ``test_common_part_of_polygons``.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

from uem_dolfinx.geometry.overlaps import Planes, clip, locate, overlap
from uem_dolfinx.geometry.shapes import facet_shape

KINDS = [("interval", 1), ("interval", 2), ("triangle", 1), ("triangle", 2), ("quadrilateral", 1), ("quadrilateral", 2)]
#: Contactor facet of a single pair.
ONE = np.zeros(1, dtype=np.int64)


def polygon(rng, corners, spread=1.0):
    """A convex polygon, counter-clockwise."""
    turn = np.sort(rng.uniform(0, 2 * np.pi, corners))
    return rng.uniform(-spread, spread, 2) + np.column_stack([np.cos(turn), np.sin(turn)]) * rng.uniform(0.3, 1.0)


def half_spaces(p):
    """``A x + b <= 0`` of a counter-clockwise polygon."""
    along = np.roll(p, -1, axis=0) - p
    out = np.column_stack([along[:, 1], -along[:, 0]])
    return np.column_stack([out, -(out * p).sum(axis=1)])


def area(p):
    q = np.roll(p, -1, axis=0)
    return 0.5 * float((p[:, 0] * q[:, 1] - p[:, 1] * q[:, 0]).sum())


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 10**6), st.integers(3, 4), st.integers(3, 4))
def test_common_part_of_polygons(seed, first, second):
    """Areas of what triangles and quadrilaterals have in common, in either sense of the subject."""
    rng = np.random.default_rng(seed)
    subject, frame = polygon(rng, first), polygon(rng, second)
    for way in (subject, subject[::-1]):
        corners, count = clip(way[None], frame[None])
        found = abs(area(corners[0, : count[0]])) if count[0] > 2 else 0.0
        inner = corners[0, : count[0]].mean(axis=0) if found > 1e-9 else None
        if inner is not None:
            try:
                exact = ConvexHull(
                    HalfspaceIntersection(np.vstack([half_spaces(subject), half_spaces(frame)]), inner).intersections
                )
            except QhullError:
                continue
            assert found == pytest.approx(exact.volume, rel=1e-8)
        else:
            sample = rng.uniform(-2, 2, (4000, 2))
            inside = [(sample @ h[:, :2].T + h[:, 2] < -1e-6).all(axis=1) for h in (half_spaces(subject), half_spaces(frame))]
            assert not (inside[0] & inside[1]).any()


@pytest.mark.parametrize(("cell", "degree"), KINDS)
def test_places_in_a_plane(cell, degree):
    """Reference coordinates from places in the plane, also where the map is not affine."""
    shape, rng = facet_shape(cell, degree), np.random.default_rng(1)
    y = shape.nodes + rng.uniform(-0.08, 0.08, (50, *shape.nodes.shape))
    xi = rng.dirichlet(np.ones(shape.dim + 1), 50)[:, : shape.dim]
    there = np.einsum("qa,qaf->qf", shape.tabulate(xi).N, y)
    assert np.abs(locate(shape, y, there) - xi).max() < 1e-12
    assert np.abs(shape.functions(xi) - shape.tabulate(xi).N).max() < 1e-14


def pair_of(cell, shift, tilt=0.0):
    """A facet, one that faces it from above, and their signs."""
    shape = facet_shape(cell, 1)
    flat = np.column_stack([shape.nodes, np.zeros(len(shape.nodes))])
    g = flat.shape[1]
    other = flat + np.array([shift, *[0.0] * (g - 2), 0.1])
    other[:, -1] += tilt * other[:, 0]
    return shape, flat, other


@pytest.mark.parametrize("cell", ["interval", "triangle", "quadrilateral"])
def test_integrals_over_a_segment(cell):
    """Size and mean gap of what a shifted and tilted facet covers."""
    shift, tilt = 0.25, 0.3
    shape, x, y = pair_of(cell, shift, tilt)
    sign = np.array([1.0 if cell != "interval" else -1.0])
    planes = Planes.of(shape, x[None], sign)
    assert planes.normal[0] == pytest.approx(np.eye(x.shape[1])[-1])
    s = overlap(planes, (shape, x[None]), (shape, y[None]), sign, ONE)
    # the second facet's inclined plane is z = 0.1 + tilt x
    size = {"interval": 0.75, "quadrilateral": 0.75, "triangle": 0.75**2 / 2}[cell]
    middle = {"interval": 0.625, "quadrilateral": 0.625, "triangle": 0.5}[cell]
    assert s.weight.sum() == pytest.approx(size, rel=1e-12)
    assert (s.weight * s.gap).sum() / size == pytest.approx(0.1 + tilt * middle, rel=1e-12)


def test_slivers():
    """Sides that coincide to rounding make no segments; a hundred times more does."""
    found = []
    for part in (3e-13, 3e-12):
        shape, x, y = pair_of("interval", 1.0 - part)
        planes = Planes.of(shape, x[None], np.array([-1.0]))
        found.append(len(overlap(planes, (shape, x[None]), (shape, y[None]), np.array([-1.0]), ONE).pair) > 0)
    assert found == [False, True]


def test_facets_that_are_affine():
    """Quadrature gets finer for quadrilaterals that depart from parallelograms by 3 %, not by 0.3 %."""
    counts = []
    for bend in (0.0, 0.003, 0.03):
        shape, x, y = pair_of("quadrilateral", 0.25)
        x[3, 0] += bend
        planes = Planes.of(shape, x[None], np.array([1.0]))
        counts.append(len(overlap(planes, (shape, x[None]), (shape, y[None]), np.array([1.0]), ONE).pair))
    assert counts[0] == counts[1] < counts[2]


def test_the_rule_of_a_pair_does_not_depend_on_others():
    """A bent pair in one call with a straight one has the points that it has alone, in any order."""
    shape, x, y = pair_of("quadrilateral", 0.25)
    bent = x.copy()
    bent[3, 0] += 0.03
    one = np.array([1.0])
    alone = [overlap(Planes.of(shape, a[None], one), (shape, a[None]), (shape, y[None]), one, ONE) for a in (bent, x, bent)]
    both, signs = np.stack([bent, x, bent]), np.ones(3)
    found = overlap(Planes.of(shape, both, signs), (shape, both), (shape, np.stack([y, y, y])), signs, np.arange(3))
    assert len(alone[1].pair) < len(alone[0].pair)
    for k, expected in enumerate(alone):
        of_pair = found.pair == k
        for name in ("xi", "eta", "weight", "gap"):
            np.testing.assert_array_equal(getattr(found, name)[of_pair], getattr(expected, name))


def test_slivers_change_no_integrals():
    """A side of the target that lies on the facet's and turns by 1e-9 either way cuts off a corner more or less, and changes little."""
    turn, sizes = [1, 3, 0, 2], set()
    for first in range(4):
        found = []
        for angle in (-1e-9, 0.0, 1e-9):
            shape, x, y = pair_of("quadrilateral", 0.0)
            x[3] += [0.007, -0.006, 0.05]
            y = y * [2.0, 0.7, 0.0] - [0.4, 0.0, 0.0] + [[0, 0, 0], [0, 0, 0], [0.005, 0.005, 0.1], [0, 0, 0.1]]
            y[:, 1] += angle * (y[:, 0] - 0.3)
            for _ in range(first):
                y = y[turn]
            planes = Planes.of(shape, x[None], np.array([1.0]))
            s = overlap(planes, (shape, x[None]), (shape, y[None]), np.array([1.0]), ONE)
            sizes.add(len(s.pair))
            found.append([s.weight.sum(), (s.weight * s.gap).sum(), (s.weight * s.gap * s.xi[:, 0] * s.eta[:, 1]).sum()])
        assert np.ptp(found, axis=0).max() <= 5e-10
    assert len(sizes) > 1


def test_small_corners():
    """Where a corner is cut off at 5e-4 of its sides, a triangle adds 6 points to the 9 of the rest; at 5e-3 five triangles have 30."""
    counts = []
    for cut in (0.0, 5e-4, 5e-3):
        shape, x, _ = pair_of("quadrilateral", 0.0)
        # a target turned by 45 degrees, whose side passes the corner at (1, 1) or cuts it off
        along, out = np.array([1.0, -1.0, 0.0]), np.array([1.0, 1.0, 0.0])
        middle = (1.0 - cut / 2 if cut else 1.1) * out
        y = np.array([middle + a * along + b * out for b in (-3, 0) for a in (-2, 2)])
        s = overlap(Planes.of(shape, x[None], np.array([1.0])), (shape, x[None]), (shape, y[None]), np.array([1.0]), ONE)
        assert s.weight.sum() == pytest.approx(1.0 - cut**2 / 2, rel=1e-12)
        counts.append(len(s.pair))
    assert counts == [9, 9 + 6, 5 * 6]


def test_products_that_are_no_polynomials():
    """Integrals of shape functions of a crooked quadrilateral over the piece below x = 0.6, to 1e-9 of a fine rule's; at few points."""
    shape, x, y = pair_of("quadrilateral", 0.0)
    y = np.array([[-1.0, -1.0, 0.1], [0.6, -1.0, 0.1], [-1.0, 3.0, 0.1], [0.6, 3.0, 0.1]])
    x[3, :2] += [0.25, -0.15]
    s = overlap(Planes.of(shape, x[None], np.array([1.0])), (shape, x[None]), (shape, y[None]), np.array([1.0]), ONE)
    found = s.weight @ shape.functions(s.xi)
    gauss, w = np.polynomial.legendre.leggauss(40)
    a, b = (values.ravel() for values in np.meshgrid(0.3 * gauss + 0.3, 0.5 * gauss + 0.5, indexing="ij"))
    high = 1.0 - a * 0.15 / 1.25
    N = shape.functions(locate(shape, np.tile(x[:, :2], (len(a), 1, 1)), np.column_stack([a, b * high])))
    assert np.abs(found - (np.outer(0.3 * w, 0.5 * w).ravel() * high) @ N).max() < 1e-9
    assert len(s.weight) == 49


@pytest.mark.parametrize("bend", [1e-3, 0.1])
def test_quadratic_sides_are_integrated_to_rounding(bend):
    """Products of shape functions of both sides, whose middles are off theirs a little or far, as by a fine rule of the same segment."""
    shape, found = facet_shape("interval", 2), []
    x, y = np.column_stack([shape.nodes, np.zeros(3)]), np.column_stack([shape.nodes * 1.3 - 0.7, np.full(3, 0.1)])
    x[2, 0] += bend
    y[2] -= bend * np.array([1.0, 0.5])
    s = overlap(Planes.of(shape, x[None], np.array([-1.0])), (shape, x[None]), (shape, y[None]), np.array([-1.0]), ONE)
    gauss, w = np.polynomial.legendre.leggauss(40)
    at = 0.6 * (gauss + 1) / 2
    xi, eta = (locate(shape, np.tile(nodes[:, :1], (40, 1, 1)), at[:, None]) for nodes in (x, y))
    for weight, here, there in ((s.weight, s.xi, s.eta), (0.3 * w, xi, eta)):
        found.append(np.einsum("q,qa,qb->ab", weight, shape.functions(here), shape.functions(there)))
    assert np.abs(found[0] - found[1]).max() <= 1e-9 * bend
