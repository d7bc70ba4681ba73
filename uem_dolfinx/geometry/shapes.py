"""Shape functions of contact facets, and the exact closest point of a facet to a point.

Everything is vectorised over pairs (facet, point); a facet is an interval, a triangle or a quadrilateral of
Lagrange degree 1 or 2, so one code serves straight, bilinear and curved facets.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property

import numpy as np
import numpy.typing as npt

from uem_dolfinx.arrays import Array, Indices, cross_products
from uem_dolfinx.forms import create_lagrange_element, quadrature_rule, reference_topology

#: Newton iterations for the position of a point in the plane of a facet; one is sufficient if the map of the facet is affine.
#: [bound; iterations; -]
IN_PLANE = 4


@dataclass(frozen=True)
class Tabulated:
    """Shape functions and their first and second derivatives at one point of each facet."""

    N: Array  # (n, nn)
    dN: Array  # (n, nn, fdim)
    ddN: Array  # (n, nn, fdim, fdim)


class FacetShape:
    """Lagrange facet of one degree: a ``"point"``, an ``"interval"``, a ``"triangle"`` or a ``"quadrilateral"``."""

    def __init__(self, cell: str, degree: int):
        self.cell, self.degree = cell, degree
        self.dim = {"point": 0, "interval": 1, "triangle": 2, "quadrilateral": 2}[cell]
        self.topology = reference_topology(cell) if self.dim else [[[0]]]
        self._element = create_lagrange_element(cell, degree) if self.dim else None
        #: Bound of ``|sum_a N_a v_a|`` on the facet for values ``|v_a| <= 1`` at its nodes, their Lebesgue constant.
        self.lebesgue = {"interval": 5 / 4, "triangle": 5 / 3, "quadrilateral": 25 / 16}.get(cell, 1.0) if degree > 1 else 1.0
        self.affine = degree == 1 and cell in ("point", "interval", "triangle")

    def tabulate(self, xi: Array) -> Tabulated:
        """Shape functions at ``xi (n, fdim)``."""
        n, d = len(xi), self.dim
        if self._element is None:
            return Tabulated(np.ones((n, 1)), np.zeros((n, 1, 0)), np.zeros((n, 1, 0, 0)))
        if n == 0:
            nn = self._element.dim
            return Tabulated(np.zeros((0, nn)), np.zeros((0, nn, d)), np.zeros((0, nn, d, d)))
        t = self._element.tabulate(2, np.ascontiguousarray(xi))[..., 0]
        ddN = np.empty((n, t.shape[2], d, d))
        if d == 1:
            ddN[..., 0, 0] = t[2]
        else:
            ddN[..., 0, 0], ddN[..., 1, 1] = t[3], t[5]
            ddN[..., 0, 1] = ddN[..., 1, 0] = t[4]
        return Tabulated(t[0], t[1 : 1 + d].transpose(1, 2, 0), ddN)

    def functions(self, xi: Array) -> Array:
        """Shape functions alone at ``xi (n, fdim)``: ``(n, nn)``."""
        if self.degree > 1 or self.dim == 0 or not len(xi):
            return self.tabulate(xi).N
        if self.cell != "quadrilateral":
            return np.column_stack([1 - xi.sum(axis=1), xi])
        x, y = xi.T
        return np.column_stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y])

    def chords(self, xi: Array) -> Array:
        """Weights of the straight pieces between neighbouring nodes at ``xi (n, fdim)``: ``(n, nn)`` [UEM, 4.5]."""
        if self.degree == 1:
            return self.tabulate(xi).N
        if self.cell != "triangle":
            return np.maximum(1 - 2 * np.abs(xi[:, None, :] - self.nodes), 0.0).prod(axis=2)
        b = np.column_stack([1 - xi.sum(axis=1), xi])
        middles = [np.minimum(np.minimum(2 * b[:, i], 2 * b[:, j]), 1 - 2 * b[:, 3 - i - j]) for i, j in self.topology[1]]
        return np.maximum(np.column_stack([2 * b - 1, *middles]), 0.0)

    @property
    def nodes(self) -> Array:
        """Reference positions of the nodes ``(nn, fdim)``."""
        return np.zeros((1, 0)) if self._element is None else np.asarray(self._element.points)

    @cached_property
    def nodal(self) -> Tabulated:
        """Shape functions at the nodes."""
        return self.tabulate(self.nodes)

    @property
    def ring(self) -> list[int]:
        """Corners of a facet with an area in their order around it, in the sense of its parametrisation."""
        return [0, 1, 3, 2] if self.cell == "quadrilateral" else [0, 1, 2]

    def corner_angles(self, x: Array) -> Array:
        """Angles of facets ``x (n, nn, gdim)`` at their corners, 1 at either end of an interval ``(n, n_corners)``."""
        if self.dim == 1:
            return np.ones((len(x), 2))
        ahead, back = (arms @ x for arms in self._sides_at_corners[:, None])
        across = np.linalg.norm(cross_products(ahead, back), axis=2)
        return np.asarray(np.arctan2(across, np.einsum("ncg,ncg->nc", ahead, back)))

    @cached_property
    def _sides_at_corners(self) -> Array:
        """Weights of the nodes in the tangents at the corners along the next side and along the one before ``(2, n_corners, nn)``."""
        ring, corners = self.ring, facet_shape(self.cell, 1).nodes
        sides = np.empty((2, len(ring), len(self.nodes)))
        for i, corner in enumerate(ring):
            for which, j in enumerate(((i + 1) % len(ring), i - 1)):
                sides[which, corner] = self.nodal.dN[corner] @ (corners[ring[j]] - corners[corner])
        return sides

    @property
    def middle(self) -> Array:
        """Reference midpoint ``(fdim,)``."""
        return np.full(self.dim, 1 / 3 if self.cell == "triangle" else 0.5)

    @cached_property
    def pieces(self) -> Indices:
        """Nodes of the simplices that the facet's nodes cut it into, in the sense of its parametrisation ``(n_pieces, gdim)``."""
        if self.dim == 1:
            order = np.argsort(self.nodes[:, 0])
            return np.column_stack([order[:-1], order[1:]])
        from scipy.spatial import Delaunay

        pieces = Delaunay(self.nodes).simplices
        turned = np.linalg.det(self.nodes[pieces[:, 1:]] - self.nodes[pieces[:, :1]]) < 0
        pieces[turned, 1:] = pieces[turned, :0:-1]
        return pieces

    def at_middle(self, n: int) -> Tabulated:
        """Shape functions at the middles of n facets (a read-only view)."""
        tab = self._at_middle
        return Tabulated(*[np.broadcast_to(values, (n, *values.shape[1:])) for values in (tab.N, tab.dN, tab.ddN)])

    @cached_property
    def _at_middle(self) -> Tabulated:
        return self.tabulate(self.middle[None])

    def contains(self, xi: Array) -> npt.NDArray[np.bool_]:
        """Which ``xi (n, fdim)`` lie in the closed reference facet."""
        below = xi.sum(axis=1) <= 1 if self.cell == "triangle" else (xi <= 1).all(axis=1)
        return np.asarray((xi >= 0).all(axis=1) & below)

    def side_distances(self, xi: Array) -> Array:
        """How far ``xi (n, fdim)`` is inside each side, in reference units ``(n, n_sides)``."""
        if self.dim == 1:
            return np.column_stack([xi, 1 - xi])
        if self.cell == "triangle":
            return np.column_stack([1 - xi.sum(axis=1), xi])
        return np.column_stack([xi[:, 1], xi[:, 0], 1 - xi[:, 0], 1 - xi[:, 1]])

    @cached_property
    def edges(self) -> list[tuple[FacetShape, Indices, Array, Array]]:
        """Boundary of the facet: per side its shape, its nodes in the facet, and the map ``xi = o + s @ D``."""
        if self.dim == 0:
            return []
        corners = facet_shape(self.cell, 1).nodes
        sides = []
        for i, vertices in enumerate(self.topology[self.dim - 1]):
            shape = facet_shape("point" if self.dim == 1 else "interval", self.degree)
            inner = [] if self.dim == 1 or self.degree == 1 else [len(self.topology[0]) + i]
            o = corners[vertices[0]]
            sides.append((shape, np.array([*vertices, *inner], dtype=np.int32), o, corners[vertices[1:]] - o))
        return sides


@cache
def facet_shape(cell: str, degree: int) -> FacetShape:
    """The one ``FacetShape`` of this kind."""
    return FacetShape(cell, degree)


def tangents(tab: Tabulated, x: Array) -> Array:
    """Covariant tangents ``(n, fdim, gdim)`` of facets with nodes ``x (n, nn, gdim)``."""
    return np.einsum("naf,nag->nfg", tab.dN, x)


def area_vectors(tab: Tabulated, x: Array) -> Array:
    """Normals ``(n, gdim)`` in the sense of the parametrisation, whose lengths are the sizes of the facets."""
    return _across(tangents(tab, x))


def nodal_area_vectors(shape: FacetShape, x: Array) -> Array:
    """The same at the nodes of facets ``x (n, nn, gdim)``: ``(n, nn, gdim)``."""
    return _across(np.einsum("kaf,nag->nkfg", shape.nodal.dN, x))


def nodal_area_slopes(shape: FacetShape, x: Array) -> Array:
    """Derivatives of ``nodal_area_vectors`` by the positions of the facets' nodes ``(n, nn, nn, gdim, gdim)``."""
    dN = shape.nodal.dN
    if shape.dim == 1:
        quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
        return np.broadcast_to(np.einsum("kaf,gh->kagh", dN, quarter), (len(x), *dN.shape[:2], 2, 2))
    t = np.einsum("kaf,nag->nkfg", dN, x)
    across = np.swapaxes(np.cross(t[..., None, :], np.eye(3)), -1, -2)
    return np.asarray(
        np.einsum("ka,nkgh->nkagh", dN[..., 1], across[:, :, 0]) - np.einsum("ka,nkgh->nkagh", dN[..., 0], across[:, :, 1])
    )


def integrals(shape: FacetShape, x: Array, axisymmetric: bool = False) -> Array:
    """Integrals of the shape functions over facets ``x (n, nn, gdim)``, in axisymmetry over whole circles: ``(n, nn)``."""
    points, weights = quadrature_rule(shape.cell, 2 * shape.degree + 1)
    tab = shape.tabulate(points)
    area = weights * np.linalg.norm(_across(np.einsum("qaf,nag->nqfg", tab.dN, x)), axis=2)
    if axisymmetric:
        area *= 2.0 * np.pi * x[:, :, 0] @ tab.N.T
    return np.asarray(area @ tab.N)


def _across(t: Array) -> Array:
    """Vectors across tangents ``t (..., fdim, gdim)``: ``(..., gdim)``."""
    return np.stack([t[..., 0, 1], -t[..., 0, 0]], axis=-1) if t.shape[-2] == 1 else cross_products(t[..., 0, :], t[..., 1, :])


def unit_normals(tab: Tabulated, x: Array) -> Array:
    """Unit normals ``(n, gdim)`` in the sense of the parametrisation."""
    n = area_vectors(tab, x)
    return n / np.linalg.norm(n, axis=1, keepdims=True)


def closest_point(shape: FacetShape, x: Array, p: Array, iterations: int = 20) -> tuple[Array, Array]:
    """Exact closest points of facets ``x (n, nn, gdim)`` to ``p (n, gdim)``: coordinates ``xi (n, fdim)``, squared distances ``(n,)``.

    The stationary point inside the facet, by at most ``iterations`` steps of Newton's method, or the closest point of a side, whichever is
    nearer; sides are treated likewise, down to the vertices.
    """
    if shape.dim == 0:
        return np.zeros((len(p), 0)), np.einsum("ng,ng->n", p - x[:, 0], p - x[:, 0])
    xi, d2 = _stationary_point(shape, x, p, iterations)
    for side, nodes, o, D in shape.edges:
        s, s2 = closest_point(side, x[:, nodes], p, iterations)
        # of equally near points the inner one, which has all coordinates
        nearer = s2 < d2
        xi[nearer] = (o + s @ D)[nearer]
        d2 = np.where(nearer, s2, d2)
    return xi, d2


def beneath(shape: FacetShape, x: Array, xi: Array, places: Array) -> tuple[Array, Tabulated]:
    """Points of facets below ``places (n, gdim)`` along the normal at ``xi (n, fdim)``: coordinates, and shape functions there.

    Facets ``x (n, nn, gdim)`` are continued past their sides.
    """
    tab = shape.tabulate(xi)
    t = tangents(tab, x)
    for _ in range(1 if shape.affine else IN_PLANE):
        missing = np.einsum("nfg,ng->nf", t, places - np.einsum("na,nag->ng", tab.N, x))
        xi = xi + _solved(np.einsum("nfg,neg->nfe", t, tangents(tab, x)), missing)
        tab = shape.tabulate(xi)
    return xi, tab


def _solved(m: Array, right: Array) -> Array:
    """Solutions ``(n, fdim)`` of ``m (n, fdim, fdim)`` with ``right (n, fdim)``; ``right`` itself for facets that have collapsed."""
    try:
        return np.asarray(np.linalg.solve(m, right[..., None])[..., 0])
    except np.linalg.LinAlgError:
        flat = np.linalg.det(m) == 0.0
        return np.asarray(np.linalg.solve(np.where(flat[:, None, None], np.eye(m.shape[1]), m), right[..., None])[..., 0])


def _stationary_point(shape: FacetShape, x: Array, p: Array, iterations: int) -> tuple[Array, Array]:
    """Newton on ``(p - y) . y,alpha = 0``; infinitely far where it ends outside the facet."""
    xi, d2, todo = _nearest_sample(shape, x, p), np.full(len(p), np.inf), np.arange(len(p))
    if shape.affine:
        tab = shape.at_middle(len(p))
        t, r = tangents(tab, x), p - np.einsum("na,nag->ng", tab.N, x)
        xi += _solved(np.einsum("nfg,neg->nfe", t, t), np.einsum("nfg,ng->nf", t, r))
    for _ in range(0 if shape.affine else iterations):
        if not len(todo):
            break
        tab = shape.tabulate(xi[todo])
        r = p[todo] - np.einsum("na,nag->ng", tab.N, x[todo])
        t = tangents(tab, x[todo])
        m = np.einsum("nfg,neg->nfe", t, t)
        curved = m - np.einsum("ng,nag,nafe->nfe", r, x[todo], tab.ddN)
        convex = np.linalg.eigvalsh(curved)[:, 0] > 0.0
        m = np.where(convex[:, None, None], curved, m)
        step = _solved(m, np.einsum("nfg,ng->nf", t, r))
        xi[todo] += _descending(shape, x[todo], p[todo], xi[todo], np.clip(step, -1.0, 1.0))
        far = (np.abs(xi[todo] - 0.5) > 1.5).any(axis=1)
        todo = todo[(np.abs(step).max(axis=1) > 1e-15) & ~far]
    inside = shape.contains(xi)
    d2[inside] = _squared_distance(shape, x[inside], p[inside], xi[inside])
    return xi, d2


def _nearest_sample(shape: FacetShape, x: Array, p: Array) -> Array:
    """Initial guess: the middle, or the nearest of middle and nodes of a curved facet ``(n, fdim)``."""
    if shape.degree == 1:
        return np.tile(shape.middle, (len(p), 1))
    samples = np.concatenate([shape.middle[None], shape.nodes])
    y = np.einsum("sa,nag->nsg", shape.tabulate(samples).N, x)
    return samples[np.linalg.norm(y - p[:, None], axis=2).argmin(axis=1)]


def _descending(shape: FacetShape, x: Array, p: Array, xi: Array, step: Array) -> Array:
    """Steps from ``xi``, halved at most four times as long as they increase the distance from ``p``."""
    now = _squared_distance(shape, x, p, xi)
    for _ in range(4):
        worse = _squared_distance(shape, x, p, xi + step) > now * (1 + 1e-10) + np.finfo(float).tiny
        if not worse.any():
            break
        step[worse] *= 0.5
    return step


def _squared_distance(shape: FacetShape, x: Array, p: Array, xi: Array) -> Array:
    """Squared distances ``(n,)`` of points ``p (n, gdim)`` from points ``xi (n, fdim)`` of their facets."""
    r = p - np.einsum("na,nag->ng", shape.functions(xi), x)
    return np.einsum("ng,ng->n", r, r)
