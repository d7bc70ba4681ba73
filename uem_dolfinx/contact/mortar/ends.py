"""Second derivatives of weighted gaps at target ends over contactor facets, where covered part and dual functions vary.

With multipliers l, and f the foremost node, the weighted gaps of a facet sum up to

    int (l_f + w . b) g    with    w = M^-1 (m D),    m_j = l_j - l_f for nodes with functions of their own, zero for others,

and vary with the covered part by the integral of ``h v`` over its boundary, where v is its outward velocity and

    h = l_f g + sum_j m_j b_j c_j + w . b (g - b . c)    with    c = M^-1 int b g.

The position of the target's boundary on the contactor facet, the gap there, c and w depend on the displacement. The derivatives of
``int h v`` by these, together with the effect of ends on the derivatives inside, are symmetric.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.mortar.duals import add_up, basis_of
from uem_dolfinx.contact.mortar.points import SegmentPoints
from uem_dolfinx.contact.mortar.segment_motions import Motions, Sides, dual_tangents, ring_of, skew, sum_of_products
from uem_dolfinx.contact.mortar.tangent import inner_curvature, stretched_means
from uem_dolfinx.geometry.shapes import FacetShape, tangents

#: Pairs of facets whose second derivatives are made at once, in a few times the memory that these take. [bound; pairs; -]
AT_ONCE = 1000


def curvature(at: SegmentPoints, pressure: Array) -> list[tuple[Ints, Array]]:
    """Minus the second derivatives of weighted gaps times their multipliers, including the target's ends.

    Args:
        at: points of the segments.
        pressure: multipliers of the contactor facets' nodes ``(m, nc)``.

    Returns:
        Lists of global nodes ``(p, c)`` and symmetric blocks ``(p, c gdim, c gdim)``.
    """
    return [inner_curvature(at, alone) for alone in _some_at_once(at, pressure)] + _at_ends(at, pressure)


def own_curvature(at: SegmentPoints, pressure: Array) -> Iterator[tuple[slice, Ints, Array]]:
    """Each node's own rows in ``curvature`` by its own multiplier alone; arguments as there.

    Yields:
        Places of nodes in their facets, global nodes ``(p, c)``, and rows of these nodes ``(p, n, gdim, c, gdim)``.
    """
    (_, nc), g = pressure.shape, at.x.shape[2]
    if not at.unequal:
        for alone in _some_at_once(at, pressure):
            nodes, rows = inner_curvature(at, alone, own=True)
            yield slice(nc), nodes, rows.reshape(len(nodes), nc, g, nodes.shape[1], g)
    for j, one in enumerate(np.eye(nc)):
        for nodes, blocks in (curvature if at.unequal else _at_ends)(at, pressure * one):
            p, width = nodes.shape
            yield slice(j, j + 1), nodes, blocks[:, j * g : (j + 1) * g].reshape(p, 1, g, width, g)


def _some_at_once(at: SegmentPoints, pressure: Array) -> Iterator[Array]:
    """The pressure of some facets after the other, zero on all others ``(m, nc)``."""
    pressing = np.flatnonzero(pressure.any(axis=1))
    last = np.cumsum(np.bincount(at.facet, minlength=len(pressure))[pressing])
    for some in np.split(pressing, np.flatnonzero(np.diff(last // AT_ONCE)) + 1):
        alone = np.zeros_like(pressure)
        alone[some] = pressure[some]
        yield alone


def _at_ends(at: SegmentPoints, pressure: Array) -> list[tuple[Ints, Array]]:
    """What ``curvature`` has from the target's ends."""
    if at.other is None:
        return []
    which = at.bounded()
    which = which[(pressure[at.facet[which]] != 0).any(axis=1)]
    if not len(which):
        return []
    return [(nodes, -blocks) for nodes, blocks in _Ends(at, at.other, pressure, which).second_derivatives()]


@dataclass(frozen=True)
class _Ends:
    """Ends of the target over contactor facets with ``pressure (m, nc)``; ``which`` are pairs with all opposite facets of each."""

    at: SegmentPoints
    other: FacetShape
    pressure: Array
    which: Ints

    def second_derivatives(self) -> list[tuple[Ints, Array]]:
        """Global nodes and symmetric blocks: of each pair, and of each pair with all opposite facets of the same contactor facet."""
        at, which = self.at, self.which
        sides = at.sides(self.other, which).at_ends()
        half = self._local(sides)
        if self.other.dim == 2:
            half += self._at_cuts(at.sides(self.other, which, cuts=True).at_ends())
        e = at.facet[which]
        nodes = np.concatenate([at.nodes[e], at.opposite[which]], axis=1)
        return [(nodes, half + half.transpose(0, 2, 1)), *self._in_the_mean(sides)]

    def _factors(self, e: Ints, s: Sides) -> tuple[Array, Array, Array, Array]:
        """At points on facets ``e (q,)``: ``l_f + w . b``, h ``(q,)``, dh/db ``(q, nc)``, and ``g - b . c`` ``(q,)``."""
        duals = self.at.duals
        fore, more, w, c = (values[e] for values in self._of_facets())
        wb, left = np.einsum("qb,qb->q", w, s.b), s.gap - s.offset - np.einsum("qb,qb->q", s.b, duals.gap[e])
        h = fore * (s.gap - s.offset) + np.einsum("qb,qb->q", more * s.b, c) + wb * left
        return fore + wb, h, more * c + w * left[:, None] - wb[:, None] * c, left

    def _of_facets(self) -> tuple[Array, Array, Array, Array]:
        """l_f ``(m,)``, and m, w and c of the facets ``(m, nc)``."""
        duals, pressure = self.at.duals, self.pressure
        fore = pressure[np.arange(len(pressure)), duals.foremost]
        more = np.where(duals.own, pressure - fore[:, None], 0.0)
        return fore, more, np.einsum("mij,mj->mi", duals.inverse, more * self.at.covered.D), duals.gap

    def _local(self, s: Sides) -> Array:
        """Half of the terms within one pair ``(p, (nc + nt) gdim, (nc + nt) gdim)``."""
        at, k = self.at, len(self.which)
        e = at.facet[self.which[s.pair]]
        n, size = at.planes.normal[e], at.planes.size[e]
        press, h, with_b, _ = self._factors(e, s)
        # points on the contactor facet, and derivatives of the functions there
        tab = at.shape.tabulate(s.xi)
        tangent = tangents(tab, at.x[e])
        over = dual_tangents(tangent, n)
        v, grown = -s.way, s.motions.of_area(n / size[:, None])
        if at.unequal:
            grown[:, : s.motions.nc] += at.stretching_at(e, tab)
        steep, high = (np.einsum("qfg,qg->qf", tangent, direction) for direction in (s.t, n))
        rise, sinks = 2 * s.gap_changes(n, size), s.motions.along(n)
        for f in range(at.shape.dim):
            motion = -s.motions.along(over[:, f])
            rise, sinks = rise + steep[:, f, None, None] * motion, sinks + high[:, f, None, None] * motion
        if at.offsets is not None:
            for f, slope in enumerate(np.einsum("qaf,qa->fq", tab.dN, at.offsets[e])):
                rise = rise + slope[:, None, None] * s.motions.along(over[:, f])
        half = sum_of_products(s.pair, 0.5 * s.weight * press, v, rise, k)
        half += sum_of_products(s.pair, s.weight * h, grown, v, k)
        of_b = np.einsum("qb,qbf->qf", with_b, np.einsum("qaf,ab->qbf", tab.dN, np.linalg.inv(basis_of(at.shape).T)))
        if at.radius is not None:
            # circumferences grow with the point's outward motion, and with the nodes
            r, wider = np.einsum("qa,qa->q", s.phi, at.x[e][:, :, 0]), np.zeros(v.shape)
            of_b += (h / r)[:, None] * np.einsum("qaf,qa->qf", tab.dN, at.x[e][:, :, 0])
            wider[:, : s.motions.nc, 0] = s.phi / r[:, None]
            half += sum_of_products(s.pair, s.weight * h, wider, v, k)
        weight = s.weight * h
        for f in range(at.shape.dim):
            motion = -s.motions.along(over[:, f])
            half += sum_of_products(s.pair, 0.5 * s.weight * of_b[:, f], v, motion, k)
            spread = np.zeros(v.shape)
            spread[:, : s.motions.nc] = tab.dN[:, :, f, None] * s.outward[:, None]
            half -= sum_of_products(s.pair, weight, spread, motion, k)
        half += sum_of_products(s.pair, weight / size, sinks, s.motions.of_area(s.outward), k)
        if at.shape.dim == 1:
            return half
        # rotation of sides; area vectors are bilinear
        along = np.einsum("qfg,qg->qf", over, s.ahead)
        places, (_, nc) = np.concatenate([at.x[e], at.y[self.which[s.pair]]], axis=1), at.nodes.shape
        climb = np.einsum("qa,qag,qg->q", s.shift, places, n) - np.einsum("qf,qf->q", high, along)
        own = np.einsum("qaf,qf->qa", tab.dN, along) - s.shift[:, :nc]
        step = Motions(own, s.shift[:, nc:], climb / size, s.motions.turning)
        half += sum_of_products(s.pair, 0.5 * weight, s.motions.along(s.outward), step.along(s.ahead), k)
        half -= sum_of_products(s.pair, 0.5 * weight, s.motions.along(s.ahead), step.along(s.outward), k)
        ring = ring_of(at.shape)
        c, g = len(ring), n.shape[1]
        vector = add_up(s.pair, (at.sign[e] * weight * s.motions.part)[:, None] * s.outward, k)
        bent = half.reshape(k, v.shape[1], g, v.shape[1], g)
        bent[:, :c, :, :c] += 0.25 * ring[None, :, None, :, None] * skew(vector)[:, None, :, None, :]
        return half

    def _at_cuts(self, s: Sides) -> Array:
        """Half of the terms of points at which sides leave the contactor facet, which move along its sides."""
        e = self.at.facet[self.which[s.pair]]
        _, h, _, _ = self._factors(e, s)
        return sum_of_products(s.pair, 0.5 * s.weight * h, -s.way, s.cut, len(self.which))

    def _in_the_mean(self, s: Sides) -> Iterator[tuple[Ints, Array]]:
        """Terms through c and w, which couple all opposite facets of a contactor facet."""
        at, which, k = self.at, self.which, len(self.which)
        nc, nt, g = at.nodes.shape[1], at.opposite.shape[1], at.x.shape[2]
        width = (nc + nt) * g
        e = at.facet[which[s.pair]]
        _, more, w, _ = self._of_facets()
        _, _, _, left = self._factors(e, s)
        wb = np.einsum("qb,qb->q", w[e], s.b)
        v = (-s.way * s.weight[:, None, None]).reshape(len(e), 1, width)
        z, ends = (
            add_up(s.pair, (values[:, :, None] * v).reshape(len(e), nc * width), k).reshape(k, nc, width)
            for values in ((more[e] - wb[:, None]) * s.b, s.b * left[:, None])
        )
        # derivative of the gap's projection inside
        place = np.full(len(at.facet), -1, dtype=np.int64)
        place[which] = np.arange(k)
        inner = place[at.segments.pair] >= 0
        q = np.flatnonzero(inner)
        pair = place[at.segments.pair[q]]
        f = at.facet[which[pair]]
        n, size, gap = at.planes.normal[f], at.planes.size[f], at.segments.gap[q]
        inside = Motions(at.phi[q], at.N[q], gap / size, at.turning[f])
        change = inside.along(at.to_gap[q]) + inside.of_area((gap / size)[:, None] * n)
        weighted = (at.segments.weight[q, None] * at.b[q])[:, :, None] * change.reshape(len(q), 1, width)
        y = ends + add_up(pair, weighted.reshape(len(q), nc * width), k).reshape(k, nc, width)
        facet = at.facet[which]
        if at.unequal:
            # parts that do not grow alike change the mean as ends do: once for each facet
            _, _, means, moved = stretched_means(at, inner, self.pressure)
            first, grown = np.unique(facet, return_index=True)[1], np.zeros((k, nc, width))
            y[first, :, : nc * g] += moved[facet[first]]
            grown[first, :, : nc * g] = means[facet[first]]
            yield from self._of_pairs(grown, ends)
        yield from self._of_pairs(z, y)

    def _of_pairs(self, left: Array, right: Array) -> Iterator[tuple[Ints, Array]]:
        """Products of changes ``(p, nc, (nc + nt) gdim)`` of all pairs of a contactor facet, with what they have in common."""
        at = self.at
        shape = (-1, at.nodes.shape[1], at.nodes.shape[1] + at.opposite.shape[1], at.x.shape[2])
        left, right = left.reshape(shape), right.reshape(shape)
        for places, nodes in at.in_facets(self.which):
            inverse = at.duals.inverse[at.facet[self.which[places[:, 0]]]]
            half = at.of_facets(left[places]).transpose(0, 2, 1) @ inverse @ at.of_facets(right[places])
            yield nodes, half + half.transpose(0, 2, 1)
