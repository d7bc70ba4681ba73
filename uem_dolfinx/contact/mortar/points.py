"""Quadrature points of segments and of their sides, with all that derivatives there need.

Segments end at chords of sides. Target sides move with their nodes. The contactor's points move past the chords of their own facet, where
its sides are curved in its plane, as past an end of the target.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.mortar.duals import Covered, Duals, basis_of
from uem_dolfinx.contact.mortar.segment_motions import (
    Motions,
    SidePoints,
    Sides,
    dual_tangents,
    edges,
    ends,
    ring_of,
    skew,
    to_gap,
)  # fmt: skip
from uem_dolfinx.geometry.overlaps import SLIVER, Planes, Segments, locate
from uem_dolfinx.geometry.shapes import FacetShape, Tabulated, area_vectors, facet_shape, tangents


@dataclass(frozen=True)
class SegmentPoints:
    """Quadrature points of segments with all that derivatives there need."""

    segments: Segments  # of ``k`` pairs
    facet: Ints  # contactor facet of each pair, among ``m`` ``(k,)``, ascending
    nodes: Ints  # global nodes of the contactor facets ``(m, nc)``
    opposite: Ints  # of the target facets, pair by pair ``(k, nt)``; without any where the target is rigid
    planes: Planes  # of the contactor facets
    duals: Duals  # dual functions of the contactor facets
    covered: Covered  # integrals over them
    b: Array  # functions of the basis at the points ``(q, nc)``
    phi: Array  # the contactor's shape functions there ``(q, nc)``
    N: Array  # the target's ``(q, nt)``
    to_gap: Array  # change of the gap with ``x - y``, called t above; a rigid target's normal ``(q, gdim)``
    shape: FacetShape  # of the contactor's facets
    other: FacetShape | None  # of the target's; None where it is rigid
    x: Array  # nodes of the contactor facets ``(m, nc, gdim)``
    y: Array  # of the target facets, pair by pair ``(k, nt, gdim)``
    sign: Array  # of the contactor facets, as for ``Planes.of`` ``(m,)``
    shape_operator: Array | None  # second derivatives of the gap with x on a rigid target ``(q, gdim, gdim)``; None on a mesh
    radius: Array | None = None  # of the circles of points in axisymmetry, included in their weights ``(q,)``; None otherwise
    offsets: Array | None = None  # of the gap at the contactor facets' nodes ``(m, nc)``; None for none

    @cached_property
    def offset(self) -> Array:
        """Of the gap at the points ``(q,)``."""
        return self._offset_at(self.facet[self.segments.pair], self.phi)

    def _offset_at(self, e: Ints, phi: Array) -> Array:
        """Offsets at points of facets ``e (q,)`` with the shape functions ``phi (q, nc)``: ``(q,)``."""
        return np.zeros(len(e)) if self.offsets is None else np.einsum("qa,qa->q", phi, self.offsets[e])

    @cached_property
    def turning(self) -> Array:
        """How area vectors change with the contactor facets' nodes ``(m, nc, gdim, gdim)``."""
        m, nc, g = self.x.shape
        out = np.zeros((m, nc, g, g))
        if g == 2:
            quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
            out[:, 0], out[:, 1] = -quarter, quarter
        else:
            ring = ring_of(self.shape)
            # of a ring of corners, the area vector is half the sum of the products of each with the next
            out[:, : len(ring)] = 0.5 * skew(np.einsum("ab,mbg->mag", ring.T, self.x[:, : len(ring)]))
        return out * self.sign[:, None, None, None]

    @property
    def tilt(self) -> Array:
        """Part of ``to_gap`` across the contactor's normal: zero where the facets are parallel ``(q, gdim)``."""
        return self.to_gap + self.planes.normal[self.facet[self.segments.pair]]

    @cached_property
    def stretching(self) -> Array:
        """Growth of a point's part of the plane with motions of the contactor facet's nodes along the facet ``(q, nc, gdim)``.

        All parts of affine facets grow in the same proportion, except on circles.
        """
        grown = self.stretching_at(self.facet[self.segments.pair], self.shape.tabulate(self.segments.xi))
        if self.radius is not None:
            grown[:, :, 0] += self.phi / self.radius[:, None]
        return grown

    def stretching_at(self, e: Ints, tab: Tabulated) -> Array:
        """The same at points of facets ``e (q,)`` with shape functions ``tab``, without that of circles."""
        x, n = self.x[e], self.planes.normal[e]
        over = dual_tangents(tangents(tab, x), n)
        turned = (to_gap(area_vectors(tab, x), n) + 2 * n) / self.planes.size[e, None]
        return np.asarray(tab.dN @ over - (turned[:, None, None] @ self.turning[e])[:, :, 0])

    @property
    def unequal(self) -> bool:
        """Whether parts of facets do not grow as these do."""
        return self.shape.degree == 2 or self.radius is not None

    @property
    def curved_sides(self) -> bool:
        """Whether sides of facets on meshes may be no chords."""
        return self.other is not None and self.shape.dim == self.shape.degree == 2

    @cached_property
    def partly(self) -> Bools:
        """Contactor facets that are partly covered ``(m,)``."""
        return np.asarray(self.covered.D.sum(axis=1) < (1 - SLIVER) * self.covered.full.sum(axis=1))

    def bounded(self) -> Ints:
        """Pairs over whose contactor facets the covered part may end ``(p,)``."""
        some = np.bincount(self.segments.pair, minlength=len(self.facet)) > 0
        return np.flatnonzero(some & (self.partly[self.facet] | self.curved_sides))

    def in_facets(self, which: Ints) -> Iterator[tuple[Ints, Ints]]:
        """Pairs ``which (p,)`` by their contactor facets, as places there ``(f, c)``, and these facets' nodes with all opposite ones."""
        _, first, count = np.unique(self.facet[which], return_index=True, return_counts=True)
        for c in np.unique(count):
            places = first[count == c][:, None] + np.arange(c)
            pairs = which[places]
            yield (
                places,
                np.concatenate([self.nodes[self.facet[pairs[:, 0]]], self.opposite[pairs].reshape(len(pairs), -1)], axis=1),
            )

    def of_facets(self, parts: Array) -> Array:
        """Linear functions ``(f, c, r, nc + nt, gdim)`` of the nodes of pairs, added up in facets ``(f, r, (nc + c nt) gdim)``."""
        f, c, r, _, g = parts.shape
        own, other = np.split(parts, [self.nodes.shape[1]], axis=3)
        other = other.transpose(0, 2, 1, 3, 4).reshape(f, r, c * other.shape[3], g)
        return np.concatenate([own.sum(axis=1), other], axis=2).reshape(f, r, -1)

    def sides(self, shape: FacetShape, which: Ints, cuts: bool = False) -> Sides:
        """Points on sides of target facets over contactor facets, and on the contactor's own chords, past which its points move.

        Args:
            shape: of the target's facets.
            which: pairs ``(p,)``.
            cuts: where sides leave the other facets, rather than quadrature points.
        """
        found = self._sides(shape, which, cuts, mine=False)
        if not self.curved_sides:
            return found
        both = found.with_those(self._sides(shape, which, cuts, mine=True))
        return both.take(np.argsort(both.pair, kind="stable"))

    def _sides(self, other: FacetShape, which: Ints, cuts: bool, mine: bool) -> Sides:
        """Points on sides of target facets, or of contactor facets if they are ``mine``; other arguments as for ``sides``."""
        e, y, (nc, nt) = self.facet[which], self.y[which], (self.nodes.shape[1], self.opposite.shape[1])
        planes = self.planes.take(e)
        own, its = planes.coordinates(self.x[e]), planes.coordinates(y)
        shape, corners = (self.shape, own) if mine else (other, its)
        below = (other, its) if mine else (self.shape, own)
        s = ends(own, other, its) if shape.dim == 1 else edges(*below, shape, corners, cuts, closed=mine)
        pair = s.pair
        alone, kept = np.ones((2, len(pair)), dtype=bool)
        if not mine:
            # a side shared by two target facets occurs twice over a contactor facet
            code = np.column_stack([e[pair], np.sort(self.opposite[which][pair[:, None], s.corners], axis=1)])
            _, first, same = np.unique(code, axis=0, return_index=True, return_inverse=True)
            same = same.ravel()
            alone = ~np.isin(np.arange(len(first)), same[pair != pair[first][same]])[same]
            kept = ~alone | self.partly[e[pair]]
        s, pair, alone = SidePoints._make(part[kept] for part in s), pair[kept], alone[kept]
        xi = locate(self.shape, own[pair, :, :-1], s.at)
        # segments end at the chord of a curved side, which moves with its corners; gaps are those of the target there
        eta = s.eta if other.degree == 1 else locate(other, its[pair, :, :-1], s.at)
        tab, phi = other.tabulate(eta), self.shape.functions(xi)
        chord, shift = np.zeros((2, len(pair), nc + nt))
        linear, place = facet_shape(shape.cell, 1), 0 if mine else nc
        here = slice(place, place + len(linear.nodes))
        chord[:, here] = linear.functions(s.eta)
        shift[:, here] = np.einsum("qaf,qf->qa", linear.tabulate(s.eta).dN, s.stride)
        above = np.einsum("qa,qa->q", phi, own[pair, :, -1])
        gap = np.einsum("qa,qa->q", tab.N, its[pair, :, -1]) - above
        at_chord = np.einsum("qa,qa->q", chord, np.concatenate([own, its], axis=1)[pair, :, -1])
        outward, ahead = (np.einsum("qf,qfg->qg", v, planes.axes[pair, :-1]) for v in (s.outward, s.ahead))
        t, size, turning = to_gap(area_vectors(tab, y[pair]), planes.normal[pair]), planes.size[pair], self.turning[e][pair]
        motions = Motions(phi - chord[:, :nc], chord[:, nc:], (at_chord - above) / size, turning)
        cut = np.zeros((len(pair), nc + nt, outward.shape[1]))
        if cuts:
            # the chords of both facets move past each other
            at_chords = [_on_chords(*facets, pair, s.at) for facets in ((self.shape, own), (other, its))]
            (lin, low), (chords, high) = at_chords
            past = Motions(lin, chords, (high - low) / size, turning)
            cut = (1.0 if mine else -1.0) * past.along(np.einsum("qf,qfg->qg", s.cut, planes.axes[pair, :-1]))
        weight = s.weight
        if self.radius is not None:
            weight = 2 * np.pi * np.einsum("qa,qa->q", phi, self.x[e[pair], :, 0]) * weight
        return Sides(
            pair=pair, xi=xi, b=basis_of(self.shape).at(xi), phi=phi, N=tab.N, gap=gap, offset=self._offset_at(e[pair], phi), t=t,
            slope=np.einsum("qg,qg->q", t, outward),
            outward=outward, motions=motions, way=motions.along(outward), ahead=ahead,
            shift=shift, cut=cut, weight=weight, end=alone,
        )  # fmt: skip


def _on_chords(shape: FacetShape, nodes: Array, pair: Ints, at: Array) -> tuple[Array, Array]:
    """Functions of corners ``(q, nn)``, and heights of chords ``(q,)``, at points ``at (q, 2)`` of facets with ``nodes (p, nn, 3)``."""
    linear, out = facet_shape(shape.cell, 1), np.zeros((len(pair), nodes.shape[1]))
    corners = nodes[pair, : len(linear.nodes)]
    out[:, : len(linear.nodes)] = linear.functions(locate(linear, corners[:, :, :-1], at))
    return out, np.einsum("qa,qa->q", out, nodes[pair, :, -1])
