"""Motions of contactor points relative to a target: as linear functions of the nodes of both bodies, and across sides of the target."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, NamedTuple

import numpy as np

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array, Bools, Ints, cross_products
from uem_dolfinx.geometry.overlaps import SLIVER, cross
from uem_dolfinx.geometry.shapes import FacetShape, area_vectors


@dataclass(frozen=True)
class Motions:
    """Motions of contactor points relative to the target, as linear functions of the nodes' displacements."""

    phi: Array  # the contactor's shape functions ``(q, nc)``
    N: Array  # the target's ``(q, nt)``
    part: Array  # gap over the size of the contactor facet ``(q,)``
    turning: Array  # derivative of its area vector a by the displacements ``(q, nc, gdim, gdim)``

    def __getitem__(self, which: Bools | Ints) -> Motions:
        return Motions(self.phi[which], self.N[which], self.part[which], self.turning[which])

    def with_those(self, others: Motions) -> Motions:
        """Motions of these points, then of others."""
        return Motions(*(np.concatenate([getattr(one, f.name) for one in (self, others)]) for f in fields(self)))

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


@dataclass(frozen=True)
class Sides:
    """Points on sides of target facets over contactor facets, and on chords of the contactor's sides over target facets."""

    pair: Ints  # number of the pair of facets, ascending ``(q,)``
    xi: Array  # reference coordinates on the contactor's facets ``(q, fdim)``
    b: Array  # values of the contactor's basis functions ``(q, nc)``
    phi: Array  # its shape functions ``(q, nc)``
    N: Array  # the target's shape functions ``(q, nt)``
    gap: Array  # ``(q,)``
    offset: Array  # part of the gap that is an offset ``(q,)``
    t: Array  # derivative of the gap by the position ``(q, gdim)``
    slope: Array  # derivative of the gap outward across the side ``(q,)``
    outward: Array  # direction out of the facet across its side, in the contactor's plane ``(q, gdim)``
    motions: Motions  # motions of the points relative to the side
    way: Array  # displacement of the contactor outward past the side, a linear function of the nodes ``(q, nc + nt, gdim)``
    ahead: Array  # direction along the side in that plane; zero in 2D ``(q, gdim)``
    shift: Array  # derivative of the functions of the side's nodes along ``ahead`` ``(q, nc + nt)``
    #: Displacement along the side of the point where it leaves the other facet, as ``way``; zero elsewhere ``(q, nc + nt, gdim)``.
    cut: Array
    weight: Array  # of the quadrature, a length in 3D; in axisymmetry ``2 pi r`` ``(q,)``
    end: Bools  # whether the covered part ends there ``(q,)``

    def gap_changes(self, n: Array, size: Array) -> Array:
        """Derivatives of the gaps, with normals ``(q, gdim)`` and sizes ``(q,)`` of the contactor facets ``(q, nc + nt, gdim)``."""
        part = self.gap / size
        fixed = Motions(self.phi, self.N, part, self.motions.turning)
        return fixed.along(self.t) + fixed.of_area(part[:, None] * n)

    def at_ends(self) -> Sides:
        """Points where the covered part ends."""
        return self.take(self.end)

    def between(self) -> Sides:
        """Points between two target facets."""
        return self.take(~self.end)

    def with_those(self, others: Sides) -> Sides:
        """These points, then others."""
        both = {f.name: (getattr(self, f.name), getattr(others, f.name)) for f in fields(self) if f.name != "motions"}
        joined: dict[str, Any] = {name: np.concatenate(parts) for name, parts in both.items()}
        return Sides(motions=self.motions.with_those(others.motions), **joined)

    def take(self, which: Bools | Ints) -> Sides:
        """Some of the points."""
        return Sides(*(getattr(self, f.name)[which] for f in fields(self)))


class SidePoints(NamedTuple):
    """Points on straight sides of facets over other facets, in the planes of the contactor facets."""

    pair: Ints  # number of the pair of facets, ascending ``(q,)``
    at: Array  # positions ``(q, fdim)``
    eta: Array  # reference coordinates on the facets of these sides ``(q, fdim)``
    outward: Array  # direction out of these facets ``(q, fdim)``
    ahead: Array  # direction along the side, zero in 2D ``(q, fdim)``
    stride: Array  # derivative of ``eta`` along ``ahead`` ``(q, fdim)``
    weight: Array  # of the quadrature, a length in 3D; 1 in 2D ``(q,)``
    cut: Array  # displacement along the side, per motion of the other facet's side there; zero but where it leaves this ``(q, fdim)``
    corners: Ints  # corners of the side, as numbers within the facet ``(q, gdim - 1)``


def ends(own: Array, other: FacetShape, its: Array) -> SidePoints:
    """Ends of target facets over contactor facets in 2D.

    Args:
        own: nodes of the contactor facets in their planes ``(p, nc, 2)``.
        other: shape of the target facets.
        its: nodes of the target facets in these planes ``(p, nt, 2)``.
    """
    size, margin = own[:, 1, 0], SLIVER * own[:, 1, 0]
    pair, corner = np.nonzero((its[:, :2, 0] > margin[:, None]) & (its[:, :2, 0] < (size - margin)[:, None]))
    at = its[pair, corner, :1]
    out = np.sign(at - its[pair, 1 - corner, :1])
    none = np.zeros((len(pair), 1))
    return SidePoints(pair, at, other.nodes[corner], out, none, none, np.ones(len(pair)), none, corner[:, None])


def edges(shape: FacetShape, own: Array, other: FacetShape, its: Array, cuts: bool = False, closed: bool = False) -> SidePoints:
    """Quadrature points on the straight sides of some facets over others in 3D.

    Args:
        shape: of the facets below.
        own: their nodes in the planes ``(p, nc, 3)``.
        other: shape of the facets with the sides.
        its: their nodes ``(p, nt, 3)``.
        cuts: instead, points where sides leave the facets below, with weight 1 at the end of a side and -1 at its beginning.
        closed: whether sides that coincide with sides of the facets below are over these.
    """
    ring = np.array(other.ring)
    start, end = its[:, ring, :2], its[:, np.roll(ring, -1), :2]
    low, high = np.zeros(start.shape[:2]), np.ones(start.shape[:2])
    # sides of the facet below that cut them, -1 for none
    none: Ints = np.full(low.shape, -1, dtype=np.int64)
    cut_low, cut_high = none, none
    frame = own[:, shape.ring, :2]
    turn = np.sign(cross(frame[:, 1] - frame[:, 0], frame[:, 2] - frame[:, 0]))[:, None]
    borders = np.roll(frame, -1, axis=1) - frame
    for j in range(frame.shape[1]):
        corner, along = frame[:, None, j], borders[:, None, j]
        before, after = turn * cross(along, start - corner), turn * cross(along, end - corner)
        least = (-SLIVER if closed else SLIVER) * np.einsum("pkf,pkf->pk", along, along)
        enters, leaves = (before <= least) & (after > least), (before > least) & (after <= least)
        crossing = before / np.where(enters | leaves, before - after, 1.0)
        later, sooner = enters & (crossing > low), leaves & (crossing < high)
        low, cut_low = np.where(later, crossing, low), np.where(later, j, cut_low)
        high, cut_high = np.where(sooner, crossing, high), np.where(sooner, j, cut_high)
        high = np.where((before <= least) & (after <= least), -1.0, high)
    pair, side = np.nonzero(high > low)
    low, high = low[pair, side], high[pair, side]
    points, weights = side_rule(shape)
    # positions on sides, their weights, and the sides of facets below there
    part, first = low[:, None] + (high - low)[:, None] * points[:, 0], (high - low)[:, None] * weights
    border: Ints = np.zeros(part.shape, dtype=np.int64)
    if cuts:
        part, first = np.stack([low, high], axis=1), np.tile([-1.0, 1.0], (len(low), 1))
        border = np.stack([cut_low[pair, side], cut_high[pair, side]], axis=1)
    row, which = np.nonzero(border >= 0)
    part, first, border = part[row, which], first[row, which], border[row, which]
    pair, side = pair[row], side[row]
    a, b = start[pair, side], end[pair, side]
    length = np.linalg.norm(b - a, axis=1)
    ahead = (b - a) / length[:, None]
    out = np.stack([ahead[:, 1], -ahead[:, 0]], axis=1)
    middle = its[:, ring, :2].mean(axis=1)[pair]
    out = out * np.sign(np.einsum("qf,qf->q", out, a - middle))[:, None]
    from_, to = other.nodes[ring[side]], other.nodes[np.roll(ring, -1)[side]]
    cut, weight = np.zeros(a.shape), first * length
    if cuts:
        across = np.stack([borders[pair, border, 1], -borders[pair, border, 0]], axis=1)
        lean = np.einsum("qf,qf->q", across, ahead)
        cut, weight = -across / lean[:, None], first
    eta = from_ * (1 - part[:, None]) + to * part[:, None]
    corners = np.stack([ring[side], np.roll(ring, -1)[side]], axis=1)
    return SidePoints(pair, a + part[:, None] * (b - a), eta, out, ahead, (to - from_) / length[:, None], weight, cut, corners)


def side_rule(shape: FacetShape) -> tuple[Array, Array]:
    """Quadrature on sides over facets of a ``shape`` in 3D; a single point in 2D."""
    if shape.dim == 1:
        return np.zeros((1, 0)), np.ones(1)
    # bilinear functions have degree 2 along a line across
    return forms.quadrature_rule("interval", 2 * shape.degree * (2 if shape.cell == "quadrilateral" else 1) + 2)


def outer(left: Array, right: Array) -> Array:
    """Outer products of linear functions of the nodes ``(q, nn, gdim)``, point by point: ``(q, nn gdim, nn gdim)``."""
    k = left.shape[1] * left.shape[2]
    return left.reshape(-1, k, 1) * right.reshape(-1, 1, k)


def slopes(shape: FacetShape, y: Array, normal: Array, pair: Ints, eta: Array) -> Array:
    """Derivatives of the gap by ``x - y`` at points ``eta (q, fdim)`` of target facets ``(q, gdim)``.

    Args:
        shape: of the target facets.
        y: their nodes, pair by pair ``(k, nt, gdim)``.
        normal: of the contactor facets, pair by pair ``(k, gdim)``.
        pair: pair of each point ``(q,)``.
        eta: reference coordinates.
    """
    if shape.affine:
        middle = shape.tabulate(np.tile(shape.middle, (len(y), 1)))
        return to_gap(area_vectors(middle, y), normal)[pair]
    return to_gap(area_vectors(shape.tabulate(eta), y[pair]), normal[pair])


def to_gap(across: Array, normal: Array) -> Array:
    """Vectors along the target's normals ``across (q, gdim)``, of any length, with product -1 with the contactor's normals."""
    return -across / np.einsum("qg,qg->q", across, normal)[:, None]


def dual_tangents(tangent: Array, n: Array) -> Array:
    """Vectors orthogonal to ``n (q, gdim)``, dual to the tangents ``(q, fdim, gdim)``."""
    if tangent.shape[1] == 1:
        across = np.stack([-n[:, 1], n[:, 0]], axis=1)[:, None]
    else:
        across = np.stack([cross_products(tangent[:, 1], n), cross_products(n, tangent[:, 0])], axis=1)
    return np.asarray(across / np.einsum("qfg,qfg->qf", across, tangent)[:, :, None])


def sum_of_products(pair: Ints, weight: Array, left: Array, right: Array, k: int) -> Array:
    """Sums of ``weight left' right`` over the points of each of ``k`` pairs ``(k, nn gdim, nn gdim)``.

    Args:
        pair: of the points, ascending ``(q,)``.
        weight: ``(q,)``; or one for each of the first nodes ``(q, nc)``, for their rows in the sums plus their transposes, each of its own
            weight ``(k, nc gdim, nn gdim)``.
        left: linear functions of the nodes ``(q, nn, gdim)``.
        right: likewise.
        k: number of pairs.
    """
    if weight.ndim == 2:
        both, one = ((left, right), (right, left)), np.ones(len(pair))
        parts = [sum_of_products(pair, one, weight[:, :, None] * a[:, : weight.shape[1]], b, k) for a, b in both]
        return parts[0] + parts[1]
    rows, size = left.shape[1] * left.shape[2], right.shape[1] * right.shape[2]
    left, right = (left * weight[:, None, None]).reshape(-1, rows), right.reshape(-1, size)
    out, count = np.zeros((k, rows, size)), np.bincount(pair, minlength=k)
    first = np.cumsum(count) - count
    for c in np.unique(count[count > 0]):
        which = np.flatnonzero(count == c)
        rows = first[which, None] + np.arange(c)
        out[which] = left[rows].transpose(0, 2, 1) @ right[rows]
    return out


def ring_of(shape: FacetShape) -> Array:
    """1 where a corner follows another around the facet, -1 where it precedes it ``(n_corners, n_corners)``."""
    ring, n = shape.ring, len(shape.ring)
    out = np.zeros((n, n))
    out[ring, np.roll(ring, -1)] = 1.0
    return out - out.T


def skew(v: Array) -> Array:
    """Matrices ``(..., 3, 3)`` of the cross products ``v x`` with ``v (..., 3)``."""
    out = np.zeros((*v.shape, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    return out - np.swapaxes(out, -1, -2)
