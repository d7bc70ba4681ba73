"""How weighted gaps change with the displacement: their first derivatives are the rows, their second ones the contact's curvature.

The quadrature points stay where they are on the contactor's facets. The gap of such a point x, on a facet with area vector a and
normal n, is ``|a| gamma``, where ``y(eta) = x + gamma a`` is the point of the target opposite. With t, the target's normal over
minus its product with n, there is ``t . dy/deta = 0`` and ``t . n = -1``, so that

    d gap = t . (dx - dy + gamma da) + gamma n . da.

Where a segment ends at a side between two target facets, gaps are continuous but their slopes are not: the motion of this side counts
in the second derivatives. The ends of the target, and the change of dual functions on partly covered facets, are left out.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.duals import add_up, basis_of
from uem_dolfinx.geometry.overlaps import Planes, Segments, locate
from uem_dolfinx.geometry.shapes import FacetShape, Tabulated, area_vectors, tangents


@dataclass(frozen=True)
class SegmentPoints:
    """Quadrature points of segments with all that derivatives there need.

    Attributes:
        segments: of ``k`` pairs.
        facet: contactor facet of each pair, among ``m`` ``(k,)``, ascending.
        nodes: global nodes of the contactor facets ``(m, nc)``.
        opposite: of the target facets, pair by pair ``(k, nt)``; without any where the target is rigid.
        planes: of the contactor facets.
        A: dual functions in the basis of the facets ``(m, nc, nc)``.
        G: integrals of the basis and the gap ``(m, nc)``.
        b: functions of the basis at the points ``(q, nc)``.
        phi: the contactor's shape functions there ``(q, nc)``.
        N: the target's ``(q, nt)``.
        to_gap: change of the gap with ``x - y``, called t above; a rigid target's normal ``(q, gdim)``.
        shape: of the contactor's facets.
        other: of the target's; None where it is rigid.
        x: nodes of the contactor facets ``(m, nc, gdim)``.
        y: of the target facets, pair by pair ``(k, nt, gdim)``.
        sign: of the contactor facets, as for ``Planes.of`` ``(m,)``.
        bend: second derivatives of the gap with x on a rigid target ``(q, gdim, gdim)``; None on a mesh.
    """

    segments: Segments
    facet: Ints
    nodes: Ints
    opposite: Ints
    planes: Planes
    A: Array
    G: Array
    b: Array
    phi: Array
    N: Array
    to_gap: Array
    shape: FacetShape
    other: FacetShape | None
    x: Array
    y: Array
    sign: Array
    bend: Array | None

    @cached_property
    def turning(self) -> Array:
        """How area vectors change with the contactor facets' nodes ``(m, nc, gdim, gdim)``."""
        m, nc, g = self.x.shape
        out = np.zeros((m, nc, g, g))
        if g == 2:
            quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
            out[:, 0], out[:, 1] = -quarter, quarter
        else:
            ring = _ring(self.shape)
            # of a ring of corners, the area vector is half the sum of the products of each with the next
            out[:, : len(ring)] = 0.5 * skew(np.einsum("ab,mbg->mag", ring.T, self.x[:, : len(ring)]))
        return out * self.sign[:, None, None, None]

    @property
    def tilt(self) -> Array:
        """Part of ``to_gap`` across the contactor's normal: zero where the facets are parallel ``(q, gdim)``."""
        return self.to_gap + self.planes.normal[self.facet[self.segments.pair]]

    # -- first derivatives -----------------------------------------------------------------------------------------------

    def gap_derivatives(self) -> tuple[Array, Array]:
        """What the derivatives of weighted gaps have beyond ``-n int psi_j (phi_a, -N_l)``.

        Returns:
            With respect to the contactor facets' nodes ``(m, nc, nc, gdim)`` and to the target's, pair by pair ``(k, nc, nt, gdim)``.
        """
        s, e, g = self.segments, self.facet, self.to_gap.shape[1]
        (m, nc), (k, nt) = self.nodes.shape, self.opposite.shape
        weighted = s.weight[:, None] * self.b
        lean = (weighted[:, :, None] * self.tilt[:, None, :]).reshape(-1, nc, 1, g)
        own = (lean * self.phi[:, None, :, None]).reshape(len(lean), nc * nc * g)
        its = (lean * self.N[:, None, :, None]).reshape(len(lean), nc * nt * g)
        on_facet = add_up(e[s.pair], own, m).reshape(m, nc, nc * g)
        on_target = add_up(s.pair, its, k).reshape(k, nc, nt * g)
        # with the area, and on a mesh with the direction, of what is not closed
        n, size = self.planes.normal, self.planes.size
        vector = self.G[:, :, None] * n[:, None]
        if nt:
            leaning = (weighted * s.gap[:, None])[:, :, None] * self.tilt[:, None]
            vector = vector + add_up(e[s.pair], leaning.reshape(-1, nc * g), m).reshape(m, nc, g)
        vector = vector / size[:, None, None]
        on_facet += np.einsum("mjg,magh->mjah", vector, self.turning).reshape(m, nc, nc * g)
        return (self.A @ on_facet).reshape(m, nc, nc, g), -(self.A[e] @ on_target).reshape(k, nc, nt, g)

    # -- second derivatives ----------------------------------------------------------------------------------------------

    def curvature(self, pressure: Array) -> tuple[Ints, Array]:
        """Minus the second derivatives of the weighted gaps times their multipliers.

        Args:
            pressure: multipliers of the contactor facets' nodes ``(m, nc)``.

        Returns:
            Global nodes of the pairs that press ``(p, nc + nt)``, and symmetric blocks ``(p, (nc + nt) gdim, (nc + nt) gdim)``.
        """
        (nc, nt), g = (self.nodes.shape[1], self.opposite.shape[1]), self.to_gap.shape[1]
        pressing = np.flatnonzero((pressure[self.facet] != 0).any(axis=1))
        place = np.full(len(self.facet), -1, dtype=np.int64)
        place[pressing] = np.arange(len(pressing))
        q = np.flatnonzero(place[self.segments.pair] >= 0)
        pair, e, k = place[self.segments.pair[q]], self.facet[pressing], len(pressing)
        amount = np.einsum("mj,mjb->mb", pressure[e], self.A[e])
        force = np.einsum("qb,qb->q", self.b[q], amount[pair]) * self.segments.weight[q]
        n, size, gap, t = self.planes.normal[e], self.planes.size[e], self.segments.gap[q], self.to_gap[q]
        motions = _Motions(self.phi[q], self.N[q], gap / size[pair], self.turning[e][pair])
        turned = t + 2 * n[pair] if nt else n[pair]
        half = sum_of_products(pair, force, motions.along(t), motions.of_area(turned / size[pair, None]), k)
        if self.other is not None:
            tab = self.other.tabulate(self.segments.eta[q])
            for slide, change in self._slides(motions, self.other, tab, self.y[pressing][pair], n[pair], t):
                half += sum_of_products(pair, force, slide, change, k)
            half += self._sides(self.other, pressing, amount)
        elif self.bend is not None:
            for row, unit in zip(np.moveaxis(self.bend[q], 1, 0), np.eye(g)):
                half += 0.5 * sum_of_products(pair, force, motions.along(row), motions.along(np.tile(unit, (len(q), 1))), k)
        blocks = half + half.transpose(0, 2, 1)
        # what is not closed, times how the size of the facet and the direction change to the second order
        open_force = add_up(pair, (force * gap)[:, None] * turned, k) / size[:, None]
        amount = np.bincount(pair, force * gap, minlength=k) / size**2
        turn = self.turning[e]
        square = np.einsum("pigh,pjgk->pihjk", turn, turn)
        if nt:
            square *= 2.0
        else:
            grown = np.einsum("pg,pigh->pih", n, turn)
            square -= grown[:, :, :, None, None] * grown[:, None, None]
        more = amount[:, None, None, None, None] * square
        if g == 3:
            ring = _ring(self.shape)
            c = len(ring)
            twice = -0.5 * ring[None, :, None, :, None] * skew(self.sign[e, None] * open_force)[:, None, :, None, :]
            more[:, :c, :, :c] += twice
        blocks.reshape(k, nc + nt, g, nc + nt, g)[:, :nc, :, :nc] += more
        return np.concatenate([self.nodes[e], self.opposite[pressing]], axis=1), -blocks

    def _slides(
        self, motions: _Motions, shape: FacetShape, tab: Tabulated, y: Array, n: Array, t: Array
    ) -> Iterator[tuple[Array, Array]]:
        """How the points opposite slide on their facets ``y (q, nt, gdim)``, and what changes with that, for each of the coordinates."""
        tangent = tangents(tab, y)
        over = dual_tangents(tangent, n)
        slides = [motions.along(over[:, f]) for f in range(shape.dim)]
        for f, slide in enumerate(slides):
            change = np.zeros(slide.shape)
            change[:, motions.nc :] = -tab.dN[:, :, f, None] * t[:, None]
            if not shape.affine:
                bend = np.einsum("qg,qag,qae->qe", t, y, tab.ddN[:, :, f])
                change -= 0.5 * sum(bend[:, e, None, None] * other for e, other in enumerate(slides))
            yield slide, change

    def _sides(self, shape: FacetShape, pressing: Ints, amount: Array) -> Array:
        """Half the blocks of the motion of sides of target facets across contactor facets ``(p, (nc + nt) gdim, (nc + nt) gdim)``.

        Args:
            shape: of the target's facets.
            pressing: pairs ``(p,)``.
            amount: multipliers in the basis of their contactor facets ``(p, nc)``.
        """
        e, y = self.facet[pressing], self.y[pressing]
        planes = self.planes.take(e)
        own, its = planes.coordinates(self.x[e]), planes.coordinates(y)
        pair, at, eta, out, weight = (_ends if shape.dim == 1 else _edges)(self.shape, own, shape, its)
        xi = locate(self.shape, own[pair, :, :-1], at)
        tab, n, size = shape.tabulate(eta), planes.normal[pair], planes.size[pair]
        outward = np.einsum("qf,qfg->qg", out, planes.axes[pair, :-1])
        t = to_gap(area_vectors(tab, y[pair]), n)
        gap = np.einsum("qa,qa->q", tab.N, its[pair, :, -1]) - np.einsum("qa,qa->q", self.shape.functions(xi), own[pair, :, -1])
        motions = _Motions(self.shape.functions(xi), tab.N, gap / size, self.turning[e][pair])
        along = motions.along(outward)
        force = np.einsum("qb,qb->q", basis_of(self.shape).at(xi), amount[pair])
        slope = np.einsum("qg,qg->q", t, outward)
        return -0.5 * sum_of_products(pair, force * weight * slope, along, along, len(pressing))


@dataclass(frozen=True)
class _Motions:
    """Motions of contactor points past the target, as linear functions of the nodes' displacements.

    Attributes:
        phi: the contactor's shape functions ``(q, nc)``.
        N: the target's ``(q, nt)``.
        part: gap over the size of the facet ``(q,)``.
        turning: of its area vector ``(q, nc, gdim, gdim)``.
    """

    phi: Array
    N: Array
    part: Array
    turning: Array

    @property
    def nc(self) -> int:
        """Nodes of a contactor facet."""
        return self.phi.shape[1]

    def along(self, c: Array) -> Array:
        """``c . (dx - dy + gamma da)`` for ``c (q, gdim)``, without ``da`` on a rigid target ``(q, nc + nt, gdim)``."""
        out = np.concatenate([self.phi, -self.N], axis=1)[:, :, None] * c[:, None]
        if self.N.shape[1]:
            out[:, : self.nc] += self.part[:, None, None] * self._turned(c)
        return np.asarray(out)

    def of_area(self, c: Array) -> Array:
        """``c . da`` for ``c (q, gdim)``: ``(q, nc + nt, gdim)``."""
        return np.concatenate([self._turned(c), np.zeros((*self.N.shape, c.shape[1]))], axis=1)

    def _turned(self, c: Array) -> Array:
        return np.asarray((c[:, None, None] @ self.turning)[:, :, 0])


def _ends(shape: FacetShape, own: Array, other: FacetShape, its: Array) -> tuple[Ints, Array, Array, Array, Array]:
    """Ends of target facets over contactor facets: pairs ``(q,)``, places in the plane and on the target, outward directions, weights.

    Args:
        shape: of the contactor's facets.
        own: their nodes in their planes ``(p, nc, 2)``.
        other: of the target's facets.
        its: their nodes ``(p, nt, 2)``.
    """
    size = own[:, 1, 0]
    pair, l = np.nonzero((its[:, :2, 0] > 0) & (its[:, :2, 0] < size[:, None]))
    at = its[pair, l, :1]
    out = np.sign(at - its[pair, 1 - l, :1])
    return pair, at, other.nodes[l], out, np.ones(len(pair))


def _edges(shape: FacetShape, own: Array, other: FacetShape, its: Array) -> tuple[Ints, Array, Array, Array, Array]:
    """Points on the straight sides of target facets over contactor facets; as ``_ends``, with weights that are lengths."""
    ring = np.array(other.ring)
    start, end = its[:, ring, :2], its[:, np.roll(ring, -1), :2]
    low, high = np.zeros(start.shape[:2]), np.ones(start.shape[:2])
    frame = own[:, shape.ring, :2]
    turn = np.sign(cross(frame[:, 1] - frame[:, 0], frame[:, 2] - frame[:, 0]))[:, None]
    for a in range(frame.shape[1]):
        corner, along = frame[:, None, a], (frame[:, (a + 1) % frame.shape[1]] - frame[:, a])[:, None]
        before, after = turn * cross(along, start - corner), turn * cross(along, end - corner)
        with np.errstate(divide="ignore", invalid="ignore"):
            met = before / (before - after)
        low = np.where((before < 0) & (after >= 0), np.maximum(low, met), low)
        high = np.where((before >= 0) & (after < 0), np.minimum(high, met), high)
        high = np.where((before < 0) & (after < 0), -1.0, high)
    pair, side = np.nonzero(high > low)
    points, weights = forms.quadrature_rule("interval", 2 * shape.degree + 2)
    k = len(weights)
    low, high = low[pair, side], high[pair, side]
    part = (low[:, None] + (high - low)[:, None] * points[:, 0]).ravel()
    pair, side, first = np.repeat(pair, k), np.repeat(side, k), np.repeat(high - low, k)
    a, b = start[pair, side], end[pair, side]
    length = np.linalg.norm(b - a, axis=1)
    out = np.stack([(b - a)[:, 1], -(b - a)[:, 0]], axis=1) / length[:, None]
    middle = its[:, ring, :2].mean(axis=1)[pair]
    out *= np.sign(np.einsum("qf,qf->q", out, a - middle))[:, None]
    eta = other.nodes[ring[side]] * (1 - part[:, None]) + other.nodes[np.roll(ring, -1)[side]] * part[:, None]
    return pair, a + part[:, None] * (b - a), eta, out, first * length * np.tile(weights, len(pair) // k)


def slopes(shape: FacetShape, y: Array, normal: Array, pair: Ints, eta: Array) -> Array:
    """Changes of the gap with ``x - y`` at points ``eta (q, fdim)`` of target facets ``(q, gdim)``.

    Args:
        shape: of the target's facets.
        y: their nodes, pair by pair ``(k, nt, gdim)``.
        normal: of the contactor's facets, pair by pair ``(k, gdim)``.
        pair: of each point ``(q,)``.
        eta: reference coordinates.
    """
    if shape.affine:
        middle = shape.tabulate(np.tile(shape.middle, (len(y), 1)))
        return to_gap(area_vectors(middle, y), normal)[pair]
    return to_gap(area_vectors(shape.tabulate(eta), y[pair]), normal[pair])


def to_gap(across: Array, normal: Array) -> Array:
    """Vectors along the target's normals ``across (q, gdim)``, of any length, whose product with the contactor's is -1."""
    return -across / np.einsum("qg,qg->q", across, normal)[:, None]


def dual_tangents(tangent: Array, n: Array) -> Array:
    """Vectors across ``n (q, gdim)`` whose products with tangents ``(q, fdim, gdim)`` are 1 with the same and 0 with the other."""
    if tangent.shape[1] == 1:
        across = np.stack([-n[:, 1], n[:, 0]], axis=1)[:, None]
    else:
        across = np.stack([np.cross(tangent[:, 1], n), np.cross(n, tangent[:, 0])], axis=1)
    return np.asarray(across / np.einsum("qfg,qfg->qf", across, tangent)[:, :, None])


def sum_of_products(pair: Ints, weight: Array, left: Array, right: Array, k: int) -> Array:
    """Sums of ``weight left' right`` over the points of each of ``k`` pairs.

    Args:
        pair: of the points, ascending ``(q,)``.
        weight: ``(q,)``.
        left: a linear function of the nodes each ``(q, nn, gdim)``.
        right: likewise.
        k: number of pairs.
    """
    size = left.shape[1] * left.shape[2]
    left, right = (left * weight[:, None, None]).reshape(-1, size), right.reshape(-1, size)
    out, count = np.zeros((k, size, size)), np.bincount(pair, minlength=k)
    first = np.cumsum(count) - count
    for c in np.unique(count[count > 0]):
        which = np.flatnonzero(count == c)
        rows = first[which, None] + np.arange(c)
        out[which] = left[rows].transpose(0, 2, 1) @ right[rows]
    return out


def _ring(shape: FacetShape) -> Array:
    """1 where a corner follows another around the facet, -1 where it goes before it ``(n_corners, n_corners)``."""
    ring, n = shape.ring, len(shape.ring)
    out = np.zeros((n, n))
    out[ring, np.roll(ring, -1)] = 1.0
    return out - out.T


def skew(v: Array) -> Array:
    """Matrices of the cross products with ``v (..., 3)`` from the left ``(..., 3, 3)``."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)


def cross(a: Array, b: Array) -> Array:
    """Cross products of vectors in a plane ``(..., 2)``."""
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
