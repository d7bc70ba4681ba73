"""How weighted gaps change with the displacement: their first derivatives are the rows, their second ones the contact's curvature.

The quadrature points stay where they are on the contactor's facets. The gap of such a point x, on a facet with area vector a and
normal n, is ``|a| gamma``, where ``y(eta) = x + gamma a`` is the point of the target opposite. With t, the target's normal over
minus its product with n, there is ``t . dy/deta = 0`` and ``t . n = -1``, so that

    d gap = t . (dx - dy + gamma da) + gamma n . da.

An offset is part of what is open, and of no height: areas grow with gaps less it.

Where a segment ends at a side between two target facets, gaps are continuous but their slopes are not: the motion of this side counts
in the second derivatives. The ends of the target move too, and dual functions with them (``mortar_ends``). Parts of quadratic
facets do not all grow as these do, and change dual functions as ends do. Their sides may be no chords, at which segments end. Gaps of
two target facets then differ there, and the contactor's points move past the chords of their own facet as past an end of the target.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.mortar.duals import add_up, products
from uem_dolfinx.contact.mortar.points import SegmentPoints
from uem_dolfinx.contact.mortar.segment_motions import Motions, dual_tangents, ring_of, skew, sum_of_products
from uem_dolfinx.geometry.shapes import FacetShape, Tabulated, area_vectors, tangents


def area_derivatives(at: SegmentPoints, growth: Array) -> tuple[Array, Array]:
    """Derivatives of the dual functions' areas, from those of facets' sizes ``(m, nc, gdim)``; shapes as of ``gap_derivatives``."""
    e, (k, nt) = at.facet[at.segments.pair], at.opposite.shape
    grown = (at.covered.D / at.planes.size[:, None])[:, :, None, None] * growth[:, None]
    if at.unequal:
        stretched = at.stretching.reshape(len(e), growth.shape[1] * growth.shape[2])
        weighted = products(at.segments.weight[:, None] * at.b, stretched)
        grown += add_up(e, weighted, len(grown)).reshape(grown.shape)
    on_target = np.zeros((k, grown.shape[1], nt, grown.shape[3]))
    if at.other is not None:
        which = at.bounded()
        sides = at.sides(at.other, which).at_ends()
        way = -(sides.weight[:, None] * sides.b)[:, :, None, None] * sides.way[:, None]
        np.add.at(grown, at.facet[which][sides.pair], way[:, :, : grown.shape[1]])
        np.add.at(on_target, which[sides.pair], way[:, :, grown.shape[1] :])
    return at.duals.added(np.arange(len(grown)), grown), at.duals.added(at.facet, on_target)


def gap_derivatives(at: SegmentPoints) -> tuple[Array, Array]:
    """Derivatives of weighted gaps in addition to ``-n int psi_j (phi_a, -N_l)``.

    Returns:
        Derivatives by the contactor facets' nodes ``(m, nc, nc, gdim)`` and by the target's, pair by pair ``(k, nc, nt, gdim)``.
    """
    s, e, g = at.segments, at.facet, at.to_gap.shape[1]
    (m, nc), (k, nt) = at.nodes.shape, at.opposite.shape
    n, size, weighted = at.planes.normal, at.planes.size, s.weight[:, None] * at.b
    vector = at.covered.G[:, :, None] * n[:, None]
    if at.other is not None and at.shape.affine and at.other.affine:
        # the same all over a pair
        tilt = np.zeros((k, g))
        tilt[s.pair] = at.tilt
        own, gap = np.split(at.covered.own, [nc], axis=2)
        on_facet = add_up(e, (own[..., None] * tilt[:, None, None]).reshape(k, nc * nc * g), m).reshape(m, nc, nc * g)
        on_target = (at.covered.N[..., None] * tilt[:, None, None]).reshape(k, nc, nt * g)
        vector = vector + add_up(e, (gap * tilt[:, None]).reshape(k, nc * g), m).reshape(m, nc, g)
    else:
        lean = products(weighted, at.tilt)
        on_facet = add_up(e[s.pair], products(lean, at.phi), m).reshape(m, nc, g, nc).swapaxes(2, 3).reshape(m, nc, nc * g)
        on_target = add_up(s.pair, products(lean, at.N), k).reshape(k, nc, g, nt).swapaxes(2, 3).reshape(k, nc, nt * g)
        if nt:
            vector = vector + add_up(e[s.pair], lean * s.gap[:, None], m).reshape(m, nc, g)
    # with the area, and on a mesh with the direction, of what is not closed
    vector = vector / size[:, None, None]
    on_facet += (vector[:, None] @ at.turning).swapaxes(1, 2).reshape(m, nc, nc * g)
    by_node = (at.duals.A @ on_facet).reshape(m, nc, nc, g)
    by_pair = -(at.duals.A[e] @ on_target).reshape(k, nc, nt, g)
    if at.unequal:
        grown = s.weight[:, None] * at.duals.at_end(e[s.pair], at.b, s.gap - at.offset)
        stretched = products(grown, at.stretching.reshape(len(grown), nc * g))
        by_node += add_up(e[s.pair], stretched, m).reshape(by_node.shape)
    if at.other is not None:
        _add_sides(at, at.other, by_node, by_pair)
    return by_node, by_pair


def _add_sides(at: SegmentPoints, shape: FacetShape, on_facet: Array, on_target: Array) -> None:
    """Add derivatives of weighted gaps at sides of the target's facets, of this ``shape``, over contactor facets: at its ends.

    Between curved facets too, whose gaps differ on the chords at which segments end.
    """
    which = at.bounded()
    sides = at.sides(shape, which)
    sides = sides if at.curved_sides else sides.at_ends()
    e = at.facet[which][sides.pair]
    force = sides.weight[:, None] * at.duals.at_end(e, sides.b, sides.gap - sides.offset)
    way = -force[:, :, None, None] * sides.way[:, None]
    nc = at.nodes.shape[1]
    np.add.at(on_facet, e, way[:, :, :nc])
    np.add.at(on_target, which[sides.pair], way[:, :, nc:])


def inner_curvature(at: SegmentPoints, pressure: Array, own: bool = False) -> tuple[Ints, Array]:
    """Minus the second derivatives of the weighted gaps times their multipliers, without those of ends.

    Args:
        at: points of the segments.
        pressure: multipliers of the contactor facets' nodes ``(m, nc)``.
        own: whether only each node's own rows in the derivatives of its own gap are made; not for ``unequal`` parts.

    Returns:
        Global nodes of the pairs with pressure ``(p, nc + nt)``, and symmetric blocks ``(p, (nc + nt) gdim, (nc + nt) gdim)``, or
        their ``own`` rows ``(p, nc gdim, (nc + nt) gdim)``.
    """
    nc, nt, g = at.nodes.shape[1], at.opposite.shape[1], at.to_gap.shape[1]
    some = np.bincount(at.segments.pair, minlength=len(at.facet)) > 0
    pressing = np.flatnonzero((pressure[at.facet] != 0).any(axis=1) & some)
    e, k = at.facet[pressing], len(pressing)
    amount = pressure[e][:, :, None] * at.duals.A[e]
    amount = amount if own else amount.sum(axis=1)
    pair, force, gap, offset, t, eta, motions = _loaded(at, pressing, amount)
    n, size = at.planes.normal[e], at.planes.size[e]
    turned = t + 2 * n[pair] if nt else n[pair]
    half = sum_of_products(pair, force, motions.along(t), motions.of_area(turned / size[pair, None]), k)
    if at.other is not None:
        tab = at.other.tabulate(eta)
        for slide, change in _slides(at, motions, at.other, tab, at.y[pressing][pair], n[pair], t):
            half += sum_of_products(pair, force, slide, change, k)
        sides = at.sides(at.other, pressing).between()
        step = np.einsum("qb,q...b,q->q...", sides.b, amount[sides.pair], sides.weight)
        slope = (step.T * sides.slope).T
        if at.curved_sides:
            half -= sum_of_products(sides.pair, step, sides.gap_changes(n[sides.pair], size[sides.pair]), sides.way, k)
            half += 0.5 * sum_of_products(sides.pair, slope, sides.way, sides.way, k)
        else:
            half -= 0.5 * sum_of_products(sides.pair, slope, sides.way, sides.way, k)
    elif at.shape_operator is not None:
        # pairs correspond to facets, with points in their order
        shape_operator = at.shape_operator[np.isin(at.segments.pair, pressing)]
        for row, unit in zip(np.moveaxis(shape_operator, 1, 0), np.eye(g)):
            half += 0.5 * sum_of_products(pair, force, motions.along(row), motions.along(np.tile(unit, (len(pair), 1))), k)
    if at.unequal:
        gaps = motions.along(t) + motions.of_area((((2 if nt else 1) * gap - offset) / size[pair])[:, None] * n[pair])
        half += _stretched(at, pressing, pair, pressure, gaps)
    blocks = half if own else half + half.transpose(0, 2, 1)
    # what is not closed, with the second order of the facet's size and direction: once for each facet
    _, first, of_facet = np.unique(e, return_index=True, return_inverse=True)

    def of_all(arm: Array) -> Array:
        open_force = products(force if own else force[:, None], arm)
        return add_up(of_facet[pair], open_force, len(first)).reshape(len(first), nc if own else 1, 1 + g)

    opened = _opened(at, e[first], of_all(np.column_stack([gap, gap[:, None] * turned])), at.other is not None)
    if at.offsets is not None:
        opened -= _opened(at, e[first], of_all(np.column_stack([offset, offset[:, None] * n[pair]])), False)
    blocks.reshape(k, nc if own else nc + nt, g, nc + nt, g)[first, :nc, :, :nc] += opened
    nodes = np.concatenate([at.nodes[e], at.opposite[pressing]], axis=1)
    return nodes, -blocks


def _stretched(at: SegmentPoints, pressing: Ints, pair: Ints, pressure: Array, gaps: Array) -> Array:
    """Half of the second derivatives with the parts of the plane that points stand for and with their ``gaps (q, nc + nt, gdim)``."""
    q, e, k = np.isin(at.segments.pair, pressing), at.facet[pressing], len(pressing)
    weight, b, grown, nc = at.segments.weight[q], at.b[q], at.stretching[q], at.nodes.shape[1]
    width, rows = gaps.shape[1] * gaps.shape[2], grown.shape[1] * grown.shape[2]
    of_gap, force, means, moved = stretched_means(at, q, pressure)
    out = np.zeros((k, width, width))
    flat, weighted = gaps.reshape(-1, width), weight[:, None] * grown.reshape(-1, rows)
    out[:, :rows] = add_up(pair, products(weighted * of_gap[:, None], flat), k).reshape(k, rows, width)
    projected = add_up(pair, products(weight[:, None] * b, flat), k).reshape(k, nc, width)
    # once for each facet
    _, first = np.unique(e, return_index=True)
    projected[first, :, :rows] += moved[e[first]]
    out[:, :rows] += (means.transpose(0, 2, 1) @ at.duals.inverse)[e] @ projected
    out[:, :rows, :rows] += _stretched_again(at, q, pair, weight * force, k)
    return out


def stretched_means(at: SegmentPoints, q: Bools, pressure: Array) -> tuple[Array, Array, Array, Array]:
    """How gaps weighted with multipliers change with the parts of the plane that points ``q`` stand for, and their means.

    Returns:
        At the points, derivatives by the gap, and by the part ``(q,)``; of the facets, derivatives by the mean gaps, and of these
        over the functions' products, by the nodes that stretch parts ``(m, nc, nc gdim)``.
    """
    e, b, (m, nc) = at.facet[at.segments.pair[q]], at.b[q], at.nodes.shape
    of_gap, of_mean = (values[..., 0] for values in at.duals.spread(e, b, pressure[:, :, None]))
    mean, gap = at.duals.gap[e], at.segments.gap[q] - at.offset[q]
    left = gap - np.einsum("qb,qb->q", b, mean)
    weighted = at.segments.weight[q, None] * at.stretching[q].reshape(len(e), nc * at.x.shape[2])
    means, moved = (
        add_up(e, products(values, weighted), m).reshape(m, nc, weighted.shape[1]) for values in (of_mean, left[:, None] * b)
    )
    return of_gap, of_gap * gap + np.einsum("qb,qb->q", of_mean, mean), means, moved


def _stretched_again(at: SegmentPoints, q: Bools, pair: Ints, force: Array, k: int) -> Array:
    """Half of the second derivatives of the parts that points ``q`` stand for, times forces, ``(k, nc gdim, nc gdim)``."""
    e, g = at.facet[at.segments.pair[q]], at.x.shape[2]
    tab, x, n, size = at.shape.tabulate(at.segments.xi[q]), at.x[e], at.planes.normal[e], at.planes.size[e]
    tangent, vector = tangents(tab, x), area_vectors(tab, x)
    over, turning = np.einsum("qg,qg->q", vector, n), at.turning[e] / size[:, None, None, None]
    if g == 2:
        own = tab.dN[:, :, 0, None, None] * np.array([[0.0, 1.0], [-1.0, 0.0]])
    else:
        own = tab.dN[:, :, 1, None, None] * skew(tangent[:, None, 0]) - tab.dN[:, :, 0, None, None] * skew(tangent[:, None, 1])
    own = own / over[:, None, None, None] - turning
    grown, out = at.stretching_at(e, tab), np.zeros((k, x.shape[1] * g, x.shape[1] * g))
    if at.radius is not None:
        radial = np.zeros(grown.shape)
        radial[:, :, 0] = at.phi[q] / at.radius[q, None]
        out += sum_of_products(pair, force, grown, radial, k)
    for c in range(g):
        out += sum_of_products(pair, force, turning[:, :, c], own[:, :, c], k)
    out -= sum_of_products(pair, 2 * force, (n[:, None, None] @ turning)[:, :, 0], grown, k)
    if g == 2:
        return out
    for row, unit in zip(np.moveaxis(skew(n / over[:, None]), 1, 0), np.eye(g)):
        out -= sum_of_products(pair, force, tab.dN[:, :, 0, None] * unit, tab.dN[:, :, 1, None] * row[:, None], k)
    ring = ring_of(at.shape)
    lean = add_up(pair, (force * at.sign[e] / size)[:, None] * (vector / over[:, None] - 2 * n), k)
    corners = out.reshape(k, x.shape[1], g, x.shape[1], g)
    corners[:, : len(ring), :, : len(ring)] -= 0.25 * ring[None, :, None, :, None] * skew(lean)[:, None, :, None, :]
    return out


def _loaded(at: SegmentPoints, pressing: Ints, amount: Array) -> tuple[Ints, Array, Array, Array, Array, Array, Motions]:
    """Points of pairs that press with ``amount (p, nc)`` in the basis: their pairs, forces, gaps, offsets, t, eta and motions.

    Where all facets are affine and grow evenly, t is the same all over a pair: one point stands for all, with sums for values.
    With an amount of each node's own ``(p, nc, nc)``, forces are ``(q, nc)``, and all points are kept.
    """
    k, s, e = len(pressing), at.segments, at.facet[pressing]
    place = np.full(len(at.facet), -1, dtype=np.int64)
    place[pressing] = np.arange(k)
    q = np.flatnonzero(place[s.pair] >= 0)
    pair = place[s.pair[q]]
    force = np.einsum("qb,q...b,q->q...", at.b[q], amount[pair], s.weight[q])
    phi, N, gap, size, turning = at.phi[q], at.N[q], s.gap[q], at.planes.size[e], at.turning[e]
    if at.other is None or at.unequal or amount.ndim == 3 or not (at.shape.affine and at.other.affine):
        return pair, force, gap, at.offset[q], at.to_gap[q], s.eta[q], Motions(phi, N, gap / size[pair], turning[pair])
    total = add_up(pair, force[:, None] * np.column_stack([phi, N, gap, at.offset[q]]), k)
    one = q[np.searchsorted(pair, np.arange(k))]
    phi, N, both = np.split(total, [phi.shape[1], phi.shape[1] + N.shape[1]], axis=1)
    gap, offset = both.T
    return np.arange(k), np.ones(k), gap, offset, at.to_gap[one], s.eta[one], Motions(phi, N, gap / size, turning)


def _opened(at: SegmentPoints, e: Ints, open_force: Array, high: bool) -> Array:
    """Second derivatives of open gaps with the sizes and directions of contactor facets ``e (p,)``, ``(p, nc, gdim, nc, gdim)``.

    Args:
        at: points of the segments.
        e: facets.
        open_force: forces times gaps, and these times ``t + 2 n``, or n unless they are ``high``, for all rows or for each node's
            ``(p, 1 or nc, 1 + gdim)``.
        high: whether gaps are heights over a mesh, which grow with the area vectors.
    """
    turn, n, size = at.turning[e], at.planes.normal[e], at.planes.size[e]
    square = np.einsum("pigh,pjgk->pihjk", turn, turn)
    if high:
        square *= 2.0
    else:
        grown = (n[:, None, None] @ turn)[:, :, 0]
        square -= grown[:, :, :, None, None] * grown[:, None, None]
    out = (open_force[:, :, 0] / size[:, None] ** 2)[:, :, None, None, None] * square
    if turn.shape[2] == 3:
        ring = ring_of(at.shape)
        c = len(ring)
        vector = (at.sign[e] / size)[:, None, None] * open_force[:, :c, 1:]
        out[:, :c, :, :c] -= 0.5 * ring[None, :, None, :, None] * skew(vector)[:, :, :, None, :]
    return np.asarray(out)


def _slides(
    at: SegmentPoints, motions: Motions, shape: FacetShape, tab: Tabulated, y: Array, n: Array, t: Array
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
