"""Segments: overlaps of facets of two surfaces, and quadrature on them. Pure geometry of pairs of facets.

Each contactor facet has one normal n. The corners of both facets are projected along n into the mean plane of the contactor facet; the
intersection of the two polygons is a *segment*. Integrals run over the segments in that plane, so that the two forces at a quadrature point
lie on one line along n, without a resulting force or moment.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import reduce
from typing import TypeAlias

import numpy as np

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array, Bools, Ints, cross_products
from uem_dolfinx.geometry.shapes import FacetShape

#: Smaller segments are rounding of sides that coincide. [convention; part of the contactor facet; test_overlaps.py::test_slivers]
SLIVER = 1e-12
#: Pairs of facets in space whose maps differ less from affine maps are integrated like affine facets.
#: [convention; part of the facet; test_overlaps.py::test_facets_that_are_affine]
STRAIGHT = 0.01
#: Increase of the degree of quadrature where maps differ more, and products of shape functions are no polynomials.
#: [convention; degree; test_overlaps.py::test_products_that_are_no_polynomials]
BENT = 8
#: Smaller corners of polygons are integrated by themselves. [convention; part of the polygon; test_overlaps.py::test_small_corners]
SMALL_CORNER = 1e-3
#: Newton iterations for the position of a point in the plane of a facet whose map is not affine. [bound; iterations; -]
IN_MEAN_PLANE = 12


Facets: TypeAlias = tuple[FacetShape, Array]


@dataclass(frozen=True)
class Planes:
    """Mean planes of facets."""

    origin: Array  # a corner ``(m, gdim)``
    axes: Array  # orthonormal: axes in the plane, then the outward normal ``(m, gdim, gdim)``
    size: Array  # length or area of the facets projected into the planes ``(m,)``

    @classmethod
    def of(cls, shape: FacetShape, x: Array, sign: Array) -> Planes:
        """The planes of facets with nodes ``x (m, nn, gdim)``; the normal of the parametrisation times ``sign (m,)`` is outward."""
        corner = x[:, : len(shape.topology[0])]
        along = corner[:, 1] - corner[:, 0]
        if shape.dim == 1:
            size = np.linalg.norm(along, axis=1)
            t = along / size[:, None]
            n = np.stack([t[:, 1], -t[:, 0]], axis=1) * sign[:, None]
            return cls(corner[:, 0], np.stack([t, n], axis=1), size)
        # the diagonals of a quadrilateral span its mean plane
        last, start = (3, 1) if shape.cell == "quadrilateral" else (1, 0)
        area = 0.5 * cross_products(corner[:, last] - corner[:, 0], corner[:, 2] - corner[:, start])
        size = np.linalg.norm(area, axis=1)
        n = area / size[:, None] * sign[:, None]
        t = along - np.einsum("mg,mg->m", along, n)[:, None] * n
        t /= np.linalg.norm(t, axis=1, keepdims=True)
        return cls(corner[:, 0], np.stack([t, cross_products(n, t), n], axis=1), size)

    @property
    def normal(self) -> Array:
        """Outward unit normals ``(m, gdim)``."""
        return self.axes[:, -1]

    def take(self, which: Ints) -> Planes:
        """Planes with these numbers, which may be repeated."""
        return Planes(self.origin[which], self.axes[which], self.size[which])

    def coordinates(self, x: Array) -> Array:
        """Coordinates of points ``x (m, k, gdim)``: in the plane, then the height ``(m, k, gdim)``."""
        return np.einsum("mkg,mfg->mkf", x - self.origin[:, None], self.axes)


@dataclass(frozen=True)
class Segments:
    """Quadrature points of the segments of pairs of facets, in the order of the pairs."""

    pair: Ints  # number of the pair ``(q,)``, ascending
    xi: Array  # reference coordinates on the contactor facet ``(q, fdim)``
    eta: Array  # on the target facet ``(q, fdim)``
    weight: Array  # of the quadrature in the mean plane, a length or an area ``(q,)``
    gap: Array  # distance from the contactor to the target along the contactor's normal ``(q,)``


def degree_of_products(shape: FacetShape, straight: bool) -> int:
    """Degree of products of two shape functions on a piece of a facet.

    Args:
        shape: of the facets.
        straight: whether the maps of both facets are affine, so that the products are polynomials.
    """
    # bilinear functions are of degree 2 along the diagonals
    return 2 * shape.degree * (2 if shape.cell == "quadrilateral" else 1) + (0 if straight else BENT)


def _straight(shape: FacetShape, y: Array) -> Bools:
    """Mask of facets with nodes ``y (m, nn, fdim)`` in their planes whose maps are affine ``(m,)``."""
    # in 2D few points more are enough for derivatives of exact integrals
    if shape.affine or shape.dim == 1:
        return np.full(len(y), shape.affine)
    corners = y[:, : shape.dim + 1]
    made = corners[:, :1] + np.einsum("af,mfe->mae", shape.nodes, corners[:, 1:] - corners[:, :1])
    return np.abs(y - made).max(axis=(1, 2)) <= STRAIGHT * np.abs(y - y[:, :1]).max(axis=(1, 2))


def overlap(planes: Planes, contactor: Facets, target: Facets, sign: Array, facet: Ints) -> Segments:
    """Segments of pairs of facets.

    Args:
        planes: of the contactor facets ``(m,)``.
        contactor: shape, and nodes of the facets ``(m, nc, gdim)``.
        target: likewise, of every pair ``(k, nt, gdim)``.
        sign: of the contactor facets, as for ``Planes.of`` ``(m,)``.
        facet: contactor facet of every pair ``(k,)``.
    """
    (shape, x), (other, y) = contactor, target
    own, its = planes.coordinates(x), planes.take(facet).coordinates(y)
    (low, high), (least, most) = _box(own), _box(its)
    pair = np.flatnonzero(((low[facet] < most) & (least < high[facet]))[:, :-1].all(axis=1))
    planes, own, its, sign = planes.take(facet[pair]), own[facet[pair]], its[pair], sign[facet[pair]]
    # each pair has the rule of its own facets, whatever other pairs this rank has
    straight, parts = _straight(shape, own[:, :, :-1]) & _straight(other, its[:, :, :-1]), []
    cut = _intervals if shape.dim == 1 else _polygons
    for kind in np.unique(straight) if len(straight) else (True,):
        which = np.flatnonzero(straight == kind)
        degree = degree_of_products(shape, bool(kind))
        place, at, weight = cut(planes.take(which), (shape, own[which]), (other, its[which]), sign[which], degree)
        parts.append((which[place], at, weight))
    place, at, weight = (np.concatenate(part) for part in zip(*parts))
    order = np.argsort(place, kind="stable")
    place, at, weight = place[order], at[order], weight[order]
    xi, eta = locate(shape, own[place, :, :-1], at), locate(other, its[place, :, :-1], at)
    height = np.einsum("qa,qa->q", other.functions(eta), its[place, :, -1])
    height -= np.einsum("qa,qa->q", shape.functions(xi), own[place, :, -1])
    return Segments(pair[place], xi, eta, weight, height)


def _box(places: Array) -> tuple[Array, Array]:
    """Least and largest coordinates of facets with nodes at ``places (m, nn, f)``: ``(m, f)`` each."""
    nodes = np.moveaxis(places, 1, 0)
    return reduce(np.minimum, nodes), reduce(np.maximum, nodes)


def _intervals(planes: Planes, contactor: Facets, target: Facets, sign: Array, degree: int) -> tuple[Ints, Array, Array]:
    """Pairs, places in the plane ``(q, 1)`` and weights of the quadrature in 2D."""
    its, (points, weights) = target[1], forms.quadrature_rule("interval", degree)
    ends = np.sort(its[:, :2, 0], axis=1)
    low, high = np.maximum(0.0, ends[:, 0]), np.minimum(planes.size, ends[:, 1])
    found = np.flatnonzero(high - low > SLIVER * planes.size)
    s = low[found, None] * (1.0 - points[:, 0]) + high[found, None] * points[:, 0]
    return np.repeat(found, len(weights)), s.reshape(-1, 1), ((high - low)[found, None] * weights).ravel()


def _polygons(planes: Planes, contactor: Facets, target: Facets, sign: Array, degree: int) -> tuple[Ints, Array, Array]:
    """Pairs, places in the plane ``(q, 2)`` and weights of the quadrature in 3D."""
    (shape, own), (other, its) = contactor, target
    frame = own[:, shape.ring, :2]
    # counter-clockwise about the outward normal
    frame = np.where(sign[:, None, None] > 0, frame, frame[:, ::-1])
    corners, count = clip(its[:, other.ring, :2], frame)
    doubled = _fan(corners, count)[0].sum(axis=1)
    found = np.flatnonzero(np.abs(doubled) > 2 * SLIVER * planes.size)
    corners, count = corners[found], count[found]
    if shape.affine and other.affine:
        polygon, first = np.nonzero(np.arange(1, corners.shape[1] - 1) < count[:, None] - 1)
        pieces = [(polygon, corners[polygon[:, None], np.column_stack([0 * first, first + 1, first + 2])])]
    else:
        pieces = _pieces(corners, count, doubled[found])
    parts = [(of, *_rule(piece, degree)) for of, piece in pieces]
    polygon = np.concatenate([np.repeat(of, weight.shape[1]) for of, _, weight in parts])
    at, weight = (
        np.concatenate(values) for values in ([at.reshape(-1, 2) for _, at, _ in parts], [w.ravel() for _, _, w in parts])
    )
    return found[polygon], at, weight


def _rule(piece: Array, degree: int) -> tuple[Array, Array]:
    """Places ``(p, q, 2)`` and weights ``(p, q)`` to integrate polynomials over triangles or convex quadrilaterals ``(p, 3 or 4, 2)``."""
    if piece.shape[1] == 3:
        points, weights = forms.quadrature_rule("triangle", degree)
        sides = piece[:, 1:] - piece[:, :1]
        return piece[:, :1] + points @ sides, np.abs(cross(sides[:, 0], sides[:, 1]))[:, None] * weights
    # the area is of one degree more
    points, weights = forms.quadrature_rule("quadrilateral", degree + 1)
    start, side, across = piece[:, :1], (piece[:, 1] - piece[:, 0])[:, None], (piece[:, 3] - piece[:, 0])[:, None]
    twist = (piece[:, 0] - piece[:, 1] + piece[:, 2] - piece[:, 3])[:, None]
    x, y = points[:, :1], points[:, 1:]
    area = np.abs(cross(side + y * twist, across + x * twist))
    return start + x * side + y * across + x * y * twist, area * weights


def _pieces(corners: Array, count: Ints, doubled: Array) -> list[tuple[Ints, Array]]:
    """Triangles and quadrilaterals of which polygons consist: numbers of polygons, and corners ``(p, 3, 2)`` and ``(p, 4, 2)``.

    Where functions are no polynomials, integrals depend on the pieces. If sides of facets coincide, rounding makes one corner more or less,
    which leaves all other pieces as they are.

    Args:
        corners: in either order ``(m, k, 2)``.
        count: corners of each ``(m,)``.
        doubled: twice the signed areas ``(m,)``.
    """
    corners, count, polygon, cut_off = _without_small_corners(corners, count, doubled)
    few, many = np.flatnonzero(count <= 4), np.flatnonzero(count > 4)
    threes, fours = few[count[few] == 3], few[count[few] == 4]
    i = np.arange(corners.shape[1])
    row, first = np.nonzero(i < count[many, None])
    about = many[row]
    after = np.where(first + 1 < count[about], first + 1, 0)
    fan = np.stack([_centroids(corners[many], count[many])[row], corners[about, first], corners[about, after]], axis=1)
    triangles = np.concatenate([cut_off, corners[threes, :3], fan])
    return [(np.concatenate([polygon, threes, about]), triangles), (fours, corners[fours, :4])]


def _without_small_corners(corners: Array, count: Ints, doubled: Array) -> tuple[Array, Ints, Ints, Array]:
    """Polygons without their small corners, their numbers of corners, and the triangles cut off with the polygons that they are of."""
    corners, count, i = corners.copy(), count.copy(), np.arange(corners.shape[1])
    of, cut_off, left = [np.zeros(0, dtype=np.int64)], [np.zeros((0, 3, 2))], np.flatnonzero(count > 3)
    while len(left):
        some, number = corners[left], count[left]
        after = _following(some, number)
        before = some[np.arange(len(left))[:, None], np.where(i > 0, i, number[:, None]) - 1]
        size = np.where(i < number[:, None], cross(some - before, after - some) / doubled[left, None], np.inf)
        smallest = size.argmin(axis=1)
        row = np.flatnonzero(size.min(axis=1) <= SMALL_CORNER)
        at, left = smallest[row], left[row]
        of.append(left)
        cut_off.append(np.stack([before[row, at], some[row, at], after[row, at]], axis=1))
        corners[left, :-1] = np.where((i[:-1] < at[:, None])[..., None], some[row, :-1], some[row, 1:])
        count[left] -= 1
        left = left[count[left] > 3]
    return corners, count, np.concatenate(of), np.concatenate(cut_off)


def clip(subject: Array, frame: Array) -> tuple[Array, Ints]:
    """Intersections of convex polygons with convex frames (Sutherland and Hodgman, 1974, doi:10.1145/360767.360802).

    Args:
        subject: corners in either order ``(m, k, 2)``.
        frame: corners counter-clockwise ``(m, l, 2)``.

    Returns:
        Corners ``(m, k + l, 2)`` and their number ``(m,)``.
    """
    m, k, _ = subject.shape
    left, corners, count = np.arange(m), subject, np.full(m, k)
    for a in range(frame.shape[1]):
        start, along = frame[left, a], frame[left, (a + 1) % frame.shape[1]] - frame[left, a]
        corners, count = _cut(corners, count, start, along)
        # some polygons are empty now
        some = np.flatnonzero(count)
        left, corners, count = left[some], corners[some], count[some]
    every, counts = np.zeros((m, *corners.shape[1:])), np.zeros(m, dtype=np.int64)
    every[left], counts[left] = corners, count
    return every, counts


def _cut(corners: Array, count: Ints, start: Array, along: Array) -> tuple[Array, Ints]:
    """Parts of polygons to the left of lines, which may have one more corner."""
    m, k, _ = corners.shape
    i = np.arange(k)
    real = i < count[:, None]
    inside_by = cross(along[:, None], corners - start[:, None])
    following, beyond_by = (_following(values, count) for values in (corners, inside_by))
    inside = inside_by >= 0
    crosses = real & (inside != (beyond_by >= 0))
    drop = inside_by - beyond_by
    part = inside_by / np.where(crosses, drop, 1.0)
    met = corners + part[..., None] * (following - corners)
    kept = np.stack([real & inside, crosses], axis=2)
    polygon, corner, which = np.nonzero(kept)
    count = kept.sum(axis=(1, 2))
    place = np.arange(len(polygon)) - np.repeat(np.cumsum(count) - count, count)
    # convex polygons get at most one more corner, polygons bent by rounding may get more
    left = np.zeros((m, max(k + 1, int(count.max(initial=0))), 2))
    left[polygon, place] = np.where(which[:, None] == 0, corners[polygon, corner], met[polygon, corner])
    return left, count


def _following(values: Array, count: Ints) -> Array:
    """Values at the next corners of polygons, from ``values (m, k, ...)`` at their corners, of which ``count (m,)`` are used."""
    after = np.roll(values, -1, axis=1)
    after[np.arange(len(count)), count - 1] = values[:, 0]
    return after


def _fan(corners: Array, count: Ints) -> tuple[Array, Array]:
    """Twice the signed areas of the triangles about the first corner ``(m, k - 2)``, and arms from it to all corners ``(m, k, 2)``."""
    arm = corners - corners[:, :1]
    part = cross(arm[:, 1:-1], arm[:, 2:])
    return np.where(np.arange(1, corners.shape[1] - 1) < count[:, None] - 1, part, 0.0), arm


def _centroids(corners: Array, count: Ints) -> Array:
    """Centroids of polygons ``(m, 2)``."""
    part, arm = _fan(corners, count)
    moment = np.einsum("mk,mkf->mf", part, arm[:, 1:-1] + arm[:, 2:])
    return np.asarray(corners[:, 0] + moment / (3 * part.sum(axis=1))[:, None])


def cross(a: Array, b: Array) -> Array:
    """Cross products of vectors in a plane ``(..., 2)``."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])


def locate(shape: FacetShape, y: Array, at: Array) -> Array:
    """Reference coordinates of points ``at (q, fdim)`` in the plane of facets with nodes ``y (q, nn, fdim)``."""
    sides = y[:, 1 : shape.dim + 1] - y[:, :1]
    xi = _solve(sides.transpose(0, 2, 1), at - y[:, 0])
    if shape.affine:
        return xi
    bilinear = shape.degree == 1
    twist = y[:, 0] - y[:, 1] - y[:, 2] + y[:, 3] if bilinear else np.zeros(0)
    for _ in range(IN_MEAN_PLANE):
        if bilinear:
            there = y[:, 0] + np.einsum("qf,qfe->qe", xi, sides) + (xi[:, 0] * xi[:, 1])[:, None] * twist
            slope = sides.transpose(0, 2, 1) + twist[:, :, None] * xi[:, None, ::-1]
        else:
            tab = shape.tabulate(xi)
            there, slope = np.einsum("qa,qaf->qf", tab.N, y), np.einsum("qae,qaf->qfe", tab.dN, y)
        step = _solve(slope, at - there)
        xi += step
        if not (np.abs(step) > 1e-14).any():
            break
    return xi


def _solve(A: Array, b: Array) -> Array:
    """Solutions of small systems ``A (q, f, f)`` for ``b (q, f)``, f = 1 or 2."""
    if A.shape[1] == 1:
        return b / A[:, 0]
    det = cross(A[:, :, 0], A[:, :, 1])
    return np.stack([cross(b, A[:, :, 1]), cross(A[:, :, 0], b)], axis=1) / det[:, None]
