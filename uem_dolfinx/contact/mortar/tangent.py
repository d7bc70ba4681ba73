"""How weighted gaps change with the displacement: their first derivatives are the rows, their second ones the contact's curvature.

The quadrature points stay where they are on the contactor's facets. The gap of such a point x, on a facet with area vector a and
normal n, is ``|a| gamma``, where ``y(eta) = x + gamma a`` is the point of the target opposite. With t, the target's normal over
minus its product with n, there is ``t . dy/deta = 0`` and ``t . n = -1``, so that

    d gap = t . (dx - dy + gamma da) + gamma n . da.

An offset is part of what is open, and of no height: areas grow with gaps less it.

Where a segment ends at a side between two target facets, gaps are continuous but their slopes are not: the motion of this side counts
in the second derivatives. The ends of the target move too, and dual functions with them (``mortar_ends``). Parts of quadratic
facets do not all grow as these do, and change dual functions as ends do. Their sides may be no chords, at which segments end: gaps of
two target facets differ there. Contactor's sides that are no chords in its plane, as of tetrahedra, are treated as such.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.mortar.duals import Covered, Duals, add_up, basis_of, products
from uem_dolfinx.contact.mortar.segment_motions import (
    Motions,
    Sides,
    dual_tangents,
    edges,
    ends,
    ring_of,
    skew,
    sum_of_products,
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
        """How the part of the plane that a point stands for grows with the contactor facet's nodes beside the facet ``(q, nc, gdim)``.

        Of affine facets all parts grow alike, but for circles.
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
        """Whether sides between target facets may be no chords."""
        return self.other is not None and self.other.dim == self.other.degree == 2

    def area_derivatives(self, growth: Array) -> tuple[Array, Array]:
        """Derivatives of the dual functions' areas, from those of facets' sizes ``(m, nc, gdim)``; shapes as of ``gap_derivatives``."""
        e, (k, nt) = self.facet[self.segments.pair], self.opposite.shape
        grown = (self.covered.D / self.planes.size[:, None])[:, :, None, None] * growth[:, None]
        if self.unequal:
            stretched = self.stretching.reshape(len(e), growth.shape[1] * growth.shape[2])
            weighted = products(self.segments.weight[:, None] * self.b, stretched)
            grown += add_up(e, weighted, len(grown)).reshape(grown.shape)
        on_target = np.zeros((k, grown.shape[1], nt, grown.shape[3]))
        if self.other is not None:
            which = self.partly_covered()
            sides = self.sides(self.other, which).at_ends()
            way = -(sides.weight[:, None] * sides.b)[:, :, None, None] * sides.way[:, None]
            np.add.at(grown, self.facet[which][sides.pair], way[:, :, : grown.shape[1]])
            np.add.at(on_target, which[sides.pair], way[:, :, grown.shape[1] :])
        return self.duals.added(np.arange(len(grown)), grown), self.duals.added(self.facet, on_target)

    # -- first derivatives -----------------------------------------------------------------------------------------------

    def gap_derivatives(self) -> tuple[Array, Array]:
        """Derivatives of weighted gaps in addition to ``-n int psi_j (phi_a, -N_l)``.

        Returns:
            Derivatives by the contactor facets' nodes ``(m, nc, nc, gdim)`` and by the target's, pair by pair ``(k, nc, nt, gdim)``.
        """
        s, e, g = self.segments, self.facet, self.to_gap.shape[1]
        (m, nc), (k, nt) = self.nodes.shape, self.opposite.shape
        n, size, weighted = self.planes.normal, self.planes.size, s.weight[:, None] * self.b
        vector = self.covered.G[:, :, None] * n[:, None]
        if self.other is not None and self.shape.affine and self.other.affine:
            # the same all over a pair
            tilt = np.zeros((k, g))
            tilt[s.pair] = self.tilt
            own, gap = np.split(self.covered.own, [nc], axis=2)
            on_facet = add_up(e, (own[..., None] * tilt[:, None, None]).reshape(k, nc * nc * g), m).reshape(m, nc, nc * g)
            on_target = (self.covered.N[..., None] * tilt[:, None, None]).reshape(k, nc, nt * g)
            vector = vector + add_up(e, (gap * tilt[:, None]).reshape(k, nc * g), m).reshape(m, nc, g)
        else:
            lean = products(weighted, self.tilt)
            on_facet = add_up(e[s.pair], products(lean, self.phi), m).reshape(m, nc, g, nc).swapaxes(2, 3).reshape(m, nc, nc * g)
            on_target = add_up(s.pair, products(lean, self.N), k).reshape(k, nc, g, nt).swapaxes(2, 3).reshape(k, nc, nt * g)
            if nt:
                vector = vector + add_up(e[s.pair], lean * s.gap[:, None], m).reshape(m, nc, g)
        # with the area, and on a mesh with the direction, of what is not closed
        vector = vector / size[:, None, None]
        on_facet += (vector[:, None] @ self.turning).swapaxes(1, 2).reshape(m, nc, nc * g)
        by_node = (self.duals.A @ on_facet).reshape(m, nc, nc, g)
        by_pair = -(self.duals.A[e] @ on_target).reshape(k, nc, nt, g)
        if self.unequal:
            grown = s.weight[:, None] * self.duals.at_end(e[s.pair], self.b, s.gap - self.offset)
            stretched = products(grown, self.stretching.reshape(len(grown), nc * g))
            by_node += add_up(e[s.pair], stretched, m).reshape(by_node.shape)
        if self.other is not None:
            self._add_sides(self.other, by_node, by_pair)
        return by_node, by_pair

    def _add_sides(self, shape: FacetShape, on_facet: Array, on_target: Array) -> None:
        """Add derivatives of weighted gaps at sides of the target's facets, of this ``shape``, over contactor facets: at its ends.

        Between curved facets too, whose gaps differ on the chords at which segments end.
        """
        some = self.partly_covered()
        which = np.arange(len(self.facet)) if self.curved_sides else some
        sides = self.sides(shape, which)
        sides = sides.take(~sides.end | np.isin(which, some)[sides.pair]) if self.curved_sides else sides.at_ends()
        e = self.facet[which][sides.pair]
        force = sides.weight[:, None] * self.duals.at_end(e, sides.b, sides.gap - sides.offset)
        way = -force[:, :, None, None] * sides.way[:, None]
        nc = self.nodes.shape[1]
        np.add.at(on_facet, e, way[:, :, :nc])
        np.add.at(on_target, which[sides.pair], way[:, :, nc:])

    def partly_covered(self) -> Ints:
        """Pairs whose contactor facets are partly covered ``(p,)``."""
        some = np.bincount(self.segments.pair, minlength=len(self.facet)) > 0
        return np.flatnonzero((self.covered.D.sum(axis=1) < (1 - SLIVER) * self.covered.full.sum(axis=1))[self.facet] & some)

    # -- second derivatives ----------------------------------------------------------------------------------------------

    def curvature(self, pressure: Array, own: bool = False) -> tuple[Ints, Array]:
        """Minus the second derivatives of the weighted gaps times their multipliers.

        Args:
            pressure: multipliers of the contactor facets' nodes ``(m, nc)``.
            own: whether only each node's own rows in the derivatives of its own gap are made; not for ``unequal`` parts.

        Returns:
            Global nodes of the pairs with pressure ``(p, nc + nt)``, and symmetric blocks ``(p, (nc + nt) gdim, (nc + nt) gdim)``, or
            their ``own`` rows ``(p, nc gdim, (nc + nt) gdim)``.
        """
        nc, nt, g = self.nodes.shape[1], self.opposite.shape[1], self.to_gap.shape[1]
        some = np.bincount(self.segments.pair, minlength=len(self.facet)) > 0
        pressing = np.flatnonzero((pressure[self.facet] != 0).any(axis=1) & some)
        e, k = self.facet[pressing], len(pressing)
        amount = pressure[e][:, :, None] * self.duals.A[e]
        amount = amount if own else amount.sum(axis=1)
        pair, force, gap, offset, t, eta, motions = self._loaded(pressing, amount)
        n, size = self.planes.normal[e], self.planes.size[e]
        turned = t + 2 * n[pair] if nt else n[pair]
        half = sum_of_products(pair, force, motions.along(t), motions.of_area(turned / size[pair, None]), k)
        if self.other is not None:
            tab = self.other.tabulate(eta)
            for slide, change in self._slides(motions, self.other, tab, self.y[pressing][pair], n[pair], t):
                half += sum_of_products(pair, force, slide, change, k)
            sides = self.sides(self.other, pressing).between()
            step = np.einsum("qb,q...b,q->q...", sides.b, amount[sides.pair], sides.weight)
            slope = (step.T * sides.slope).T
            if self.curved_sides:
                half -= sum_of_products(sides.pair, step, sides.gap_changes(n[sides.pair], size[sides.pair]), sides.way, k)
                half += 0.5 * sum_of_products(sides.pair, slope, sides.way, sides.way, k)
            else:
                half -= 0.5 * sum_of_products(sides.pair, slope, sides.way, sides.way, k)
        elif self.shape_operator is not None:
            # pairs correspond to facets, with points in their order
            shape_operator = self.shape_operator[np.isin(self.segments.pair, pressing)]
            for row, unit in zip(np.moveaxis(shape_operator, 1, 0), np.eye(g)):
                half += 0.5 * sum_of_products(pair, force, motions.along(row), motions.along(np.tile(unit, (len(pair), 1))), k)
        if self.unequal:
            gaps = motions.along(t) + motions.of_area((((2 if nt else 1) * gap - offset) / size[pair])[:, None] * n[pair])
            half += self._stretched(pressing, pair, pressure, gaps)
        blocks = half if own else half + half.transpose(0, 2, 1)
        # what is not closed, with the second order of the facet's size and direction: once for each facet
        _, first, of_facet = np.unique(e, return_index=True, return_inverse=True)

        def of_all(arm: Array) -> Array:
            open_force = products(force if own else force[:, None], arm)
            return add_up(of_facet[pair], open_force, len(first)).reshape(len(first), nc if own else 1, 1 + g)

        opened = self._opened(e[first], of_all(np.column_stack([gap, gap[:, None] * turned])), self.other is not None)
        if self.offsets is not None:
            opened -= self._opened(e[first], of_all(np.column_stack([offset, offset[:, None] * n[pair]])), False)
        blocks.reshape(k, nc if own else nc + nt, g, nc + nt, g)[first, :nc, :, :nc] += opened
        nodes = np.concatenate([self.nodes[e], self.opposite[pressing]], axis=1)
        return nodes, -blocks

    def _stretched(self, pressing: Ints, pair: Ints, pressure: Array, gaps: Array) -> Array:
        """Half of the second derivatives with the parts of the plane that points stand for and with their ``gaps (q, nc + nt, gdim)``."""
        q, e, k = np.isin(self.segments.pair, pressing), self.facet[pressing], len(pressing)
        weight, b, grown, nc = self.segments.weight[q], self.b[q], self.stretching[q], self.nodes.shape[1]
        width, rows = gaps.shape[1] * gaps.shape[2], grown.shape[1] * grown.shape[2]
        of_gap, force, means, moved = self.stretched_means(q, pressure)
        out = np.zeros((k, width, width))
        flat, weighted = gaps.reshape(-1, width), weight[:, None] * grown.reshape(-1, rows)
        out[:, :rows] = add_up(pair, products(weighted * of_gap[:, None], flat), k).reshape(k, rows, width)
        projected = add_up(pair, products(weight[:, None] * b, flat), k).reshape(k, nc, width)
        # once for each facet
        _, first = np.unique(e, return_index=True)
        projected[first, :, :rows] += moved[e[first]]
        out[:, :rows] += (means.transpose(0, 2, 1) @ self.duals.inverse)[e] @ projected
        out[:, :rows, :rows] += self._stretched_again(q, pair, weight * force, k)
        return out

    def stretched_means(self, q: Bools, pressure: Array) -> tuple[Array, Array, Array, Array]:
        """How gaps weighted with multipliers change with the parts of the plane that points ``q`` stand for, and their means.

        Returns:
            At the points, derivatives by the gap, and by the part ``(q,)``; of the facets, derivatives by the mean gaps, and of these
            over the functions' products, by the nodes that stretch parts ``(m, nc, nc gdim)``.
        """
        e, b, (m, nc) = self.facet[self.segments.pair[q]], self.b[q], self.nodes.shape
        of_gap, of_mean = (values[..., 0] for values in self.duals.spread(e, b, pressure[:, :, None]))
        mean, gap = self.duals.gap[e], self.segments.gap[q] - self.offset[q]
        left = gap - np.einsum("qb,qb->q", b, mean)
        weighted = self.segments.weight[q, None] * self.stretching[q].reshape(len(e), nc * self.x.shape[2])
        means, moved = (
            add_up(e, products(values, weighted), m).reshape(m, nc, weighted.shape[1]) for values in (of_mean, left[:, None] * b)
        )
        return of_gap, of_gap * gap + np.einsum("qb,qb->q", of_mean, mean), means, moved

    def _stretched_again(self, q: Bools, pair: Ints, force: Array, k: int) -> Array:
        """Half of the second derivatives of the parts that points ``q`` stand for, times forces, ``(k, nc gdim, nc gdim)``."""
        e, g = self.facet[self.segments.pair[q]], self.x.shape[2]
        tab, x, n, size = self.shape.tabulate(self.segments.xi[q]), self.x[e], self.planes.normal[e], self.planes.size[e]
        tangent, vector = tangents(tab, x), area_vectors(tab, x)
        over, turning = np.einsum("qg,qg->q", vector, n), self.turning[e] / size[:, None, None, None]
        if g == 2:
            own = tab.dN[:, :, 0, None, None] * np.array([[0.0, 1.0], [-1.0, 0.0]])
        else:
            own = tab.dN[:, :, 1, None, None] * skew(tangent[:, None, 0]) - tab.dN[:, :, 0, None, None] * skew(
                tangent[:, None, 1]
            )
        own = own / over[:, None, None, None] - turning
        grown, out = self.stretching_at(e, tab), np.zeros((k, x.shape[1] * g, x.shape[1] * g))
        if self.radius is not None:
            radial = np.zeros(grown.shape)
            radial[:, :, 0] = self.phi[q] / self.radius[q, None]
            out += sum_of_products(pair, force, grown, radial, k)
        for c in range(g):
            out += sum_of_products(pair, force, turning[:, :, c], own[:, :, c], k)
        out -= sum_of_products(pair, 2 * force, (n[:, None, None] @ turning)[:, :, 0], grown, k)
        if g == 2:
            return out
        for row, unit in zip(np.moveaxis(skew(n / over[:, None]), 1, 0), np.eye(g)):
            out -= sum_of_products(pair, force, tab.dN[:, :, 0, None] * unit, tab.dN[:, :, 1, None] * row[:, None], k)
        ring = ring_of(self.shape)
        lean = add_up(pair, (force * self.sign[e] / size)[:, None] * (vector / over[:, None] - 2 * n), k)
        corners = out.reshape(k, x.shape[1], g, x.shape[1], g)
        corners[:, : len(ring), :, : len(ring)] -= 0.25 * ring[None, :, None, :, None] * skew(lean)[:, None, :, None, :]
        return out

    def _loaded(self, pressing: Ints, amount: Array) -> tuple[Ints, Array, Array, Array, Array, Array, Motions]:
        """Points of pairs that press with ``amount (p, nc)`` in the basis: their pairs, forces, gaps, offsets, t, eta and motions.

        Where all facets are affine and grow evenly, t is the same all over a pair: one point stands for all, with sums for values.
        With an amount of each node's own ``(p, nc, nc)``, forces are ``(q, nc)``, and all points are kept.
        """
        k, s, e = len(pressing), self.segments, self.facet[pressing]
        place = np.full(len(self.facet), -1, dtype=np.int64)
        place[pressing] = np.arange(k)
        q = np.flatnonzero(place[s.pair] >= 0)
        pair = place[s.pair[q]]
        force = np.einsum("qb,q...b,q->q...", self.b[q], amount[pair], s.weight[q])
        phi, N, gap, size, turning = self.phi[q], self.N[q], s.gap[q], self.planes.size[e], self.turning[e]
        if self.other is None or self.unequal or amount.ndim == 3 or not (self.shape.affine and self.other.affine):
            return pair, force, gap, self.offset[q], self.to_gap[q], s.eta[q], Motions(phi, N, gap / size[pair], turning[pair])
        total = add_up(pair, force[:, None] * np.column_stack([phi, N, gap, self.offset[q]]), k)
        one = q[np.searchsorted(pair, np.arange(k))]
        phi, N, both = np.split(total, [phi.shape[1], phi.shape[1] + N.shape[1]], axis=1)
        gap, offset = both.T
        return np.arange(k), np.ones(k), gap, offset, self.to_gap[one], s.eta[one], Motions(phi, N, gap / size, turning)

    def _opened(self, e: Ints, open_force: Array, high: bool) -> Array:
        """Second derivatives of open gaps with the sizes and directions of contactor facets ``e (p,)``, ``(p, nc, gdim, nc, gdim)``.

        Args:
            e: facets.
            open_force: forces times gaps, and these times ``t + 2 n``, or n unless they are ``high``, for all rows or for each node's
                ``(p, 1 or nc, 1 + gdim)``.
            high: whether gaps are heights over a mesh, which grow with the area vectors.
        """
        turn, n, size = self.turning[e], self.planes.normal[e], self.planes.size[e]
        square = np.einsum("pigh,pjgk->pihjk", turn, turn)
        if high:
            square *= 2.0
        else:
            grown = (n[:, None, None] @ turn)[:, :, 0]
            square -= grown[:, :, :, None, None] * grown[:, None, None]
        out = (open_force[:, :, 0] / size[:, None] ** 2)[:, :, None, None, None] * square
        if turn.shape[2] == 3:
            ring = ring_of(self.shape)
            c = len(ring)
            vector = (self.sign[e] / size)[:, None, None] * open_force[:, :c, 1:]
            out[:, :c, :, :c] -= 0.5 * ring[None, :, None, :, None] * skew(vector)[:, :, :, None, :]
        return np.asarray(out)

    def _slides(
        self, motions: Motions, shape: FacetShape, tab: Tabulated, y: Array, n: Array, t: Array
    ) -> Iterator[tuple[Array, Array]]:
        """How the points opposite slide on their facets ``y (q, nt, gdim)``, and what changes with that, for each of the coordinates."""
        tangent = tangents(tab, y)
        over = dual_tangents(tangent, n)
        slides = [motions.along(over[:, f]) for f in range(shape.dim)]
        for f, slide in enumerate(slides):
            change = np.zeros(slide.shape)
            change[:, motions.nc :] = -tab.dN[:, :, f, None] * t[:, None]
            if not shape.affine:
                shape_operator = np.einsum("qg,qag,qae->qe", t, y, tab.ddN[:, :, f])
                change -= 0.5 * sum(shape_operator[:, e, None, None] * other for e, other in enumerate(slides))
            yield slide, change

    def sides(self, shape: FacetShape, which: Ints, cuts: bool = False) -> Sides:
        """Points on sides of target facets over contactor facets.

        Args:
            shape: of the target's facets.
            which: pairs ``(p,)``.
            cuts: where sides leave contactor facets, rather than quadrature points.
        """
        e, y = self.facet[which], self.y[which]
        planes = self.planes.take(e)
        own, its = planes.coordinates(self.x[e]), planes.coordinates(y)
        s = ends(own, shape, its) if shape.dim == 1 else edges(self.shape, own, shape, its, cuts)
        pair = s.pair
        # a side shared by two target facets occurs twice over a contactor facet
        code = np.column_stack([e[pair], np.sort(self.opposite[which][pair[:, None], s.corners], axis=1)])
        _, first, same = np.unique(code, axis=0, return_index=True, return_inverse=True)
        same = same.ravel()
        alone = ~np.isin(np.arange(len(first)), same[pair != pair[first][same]])[same]
        xi = locate(self.shape, own[pair, :, :-1], s.at)
        # segments end at the chord of a curved side, which moves with its corners; gaps are those of the target there
        linear = facet_shape(shape.cell, 1)
        eta = s.eta if shape.degree == 1 else locate(shape, its[pair, :, :-1], s.at)
        tab, phi, nc = shape.tabulate(eta), self.shape.functions(xi), linear.nodes.shape[0]
        chord, shift = np.zeros((2, *tab.N.shape))
        chord[:, :nc] = linear.functions(s.eta)
        shift[:, :nc] = np.einsum("qaf,qf->qa", linear.tabulate(s.eta).dN, s.stride)
        above = np.einsum("qa,qa->q", phi, own[pair, :, -1])
        outward, ahead, cut = (np.einsum("qf,qfg->qg", v, planes.axes[pair, :-1]) for v in (s.outward, s.ahead, s.cut))
        t = to_gap(area_vectors(tab, y[pair]), planes.normal[pair])
        gap, height = (np.einsum("qa,qa->q", N, its[pair, :, -1]) - above for N in (tab.N, chord))
        motions = Motions(phi, chord, height / planes.size[pair], self.turning[e][pair])
        weight = s.weight
        if self.radius is not None:
            weight = 2 * np.pi * np.einsum("qa,qa->q", phi, self.x[e[pair], :, 0]) * weight
        return Sides(
            pair=pair, xi=xi, b=basis_of(self.shape).at(xi), N=tab.N, gap=gap, offset=self._offset_at(e[pair], phi), t=t,
            slope=np.einsum("qg,qg->q", t, outward),
            outward=outward, motions=motions, way=motions.along(outward), ahead=ahead,
            shift=shift, cut=cut, weight=weight, end=alone,
        )  # fmt: skip
