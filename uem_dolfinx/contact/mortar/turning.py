"""How mortar's forces of friction change with the displacement: with the traction's direction and size, and with what it is handed to.

The traction ``sum psi_j sigma_j`` is handed to both sides with their shape functions. Where the points opposite slide, target nodes get
other shares. The traction turns with the derivative of the weighted gap with the contactor's own displacement, and grows with its size;
these are the second derivatives of the gap of this contactor alone. Parts of quadratic facets do not all grow as these do. Where the
target ends over a facet, what is covered changes, and dual functions with it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.mortar.duals import add_up, basis_of, products
from uem_dolfinx.contact.mortar.ends import own_curvature
from uem_dolfinx.contact.mortar.points import SegmentPoints
from uem_dolfinx.contact.mortar.rows import Elimination, Terms, WeightedRows, add_up_terms, terms_of
from uem_dolfinx.contact.mortar.segment_motions import Motions, dual_tangents, sum_of_products
from uem_dolfinx.geometry.shapes import FacetShape, tangents


@dataclass(frozen=True)
class Frictional:
    """Contactors with friction, covered by the target."""

    which: Ints  # places among the contactors, ascending ``(k,)``
    normal: Array  # directions of their equations ``(k, gdim)``
    tau: Array  # friction, transmitted by the weights of followed nodes ``(k, gdim)``
    slips: Bools  # slipping contactors, whose friction depends on the normal force ``(k,)``


def handing_on(at: SegmentPoints, traction: Array) -> list[tuple[Ints, Array]]:
    """Derivatives of the nodal forces of a traction whose values at the contactors stay, on both sides.

    Args:
        at: points of the segments.
        traction: at the contactor facets' nodes, a force per area ``(m, nc, gdim)``.

    Returns:
        Lists of global nodes ``(p, c)`` and blocks ``(p, c gdim, c gdim)``.
    """
    s, g = at.segments, at.to_gap.shape[1]
    some = np.bincount(s.pair, minlength=len(at.facet)) > 0
    which = np.flatnonzero(traction[at.facet].any(axis=(1, 2)) & some)
    e, k = at.facet[which], len(which)
    place = np.full(len(at.facet), -1, dtype=np.int64)
    place[which] = np.arange(k)
    q = np.flatnonzero(place[s.pair] >= 0)
    pair = place[s.pair[q]]
    amount = np.einsum("pjb,pjg->pbg", at.duals.A[e], traction[e])
    force = s.weight[q, None] * np.einsum("qb,qbg->qg", at.b[q], amount[pair])
    n, size = at.planes.normal[e], at.planes.size[e]
    motions = Motions(at.phi[q], at.N[q], s.gap[q] / size[pair], at.turning[e][pair])
    share, one = np.concatenate([at.phi[q], -at.N[q]], axis=1), np.ones(len(q))
    width, (_, nc) = share.shape[1] * g, at.nodes.shape
    # all grow with the facet
    grown = ((n / size[:, None])[:, None, None] @ at.turning[e]).reshape(k, 1, nc * g)
    blocks = np.zeros((k, width, width))
    blocks[:, :, : nc * g] = add_up(pair, (share[:, :, None] * force[:, None]).reshape(-1, width), k)[:, :, None] * grown
    if at.unequal:
        blocks += _stretched(at, traction, which, q, pair)
    if at.other is not None:
        tab = at.other.tabulate(s.eta[q])
        over = dual_tangents(tangents(tab, at.y[which][pair]), n[pair])
        for f in range(at.other.dim):
            moved = -tab.dN[:, :, f, None] * force[:, None]
            blocks[:, nc * g :] += sum_of_products(pair, one, moved, motions.along(over[:, f]), k)
    made = [(np.concatenate([at.nodes[e], at.opposite[which]], axis=1), blocks)]
    return made if at.other is None else made + _at_ends(at, at.other, traction)


def _at_ends(at: SegmentPoints, other: FacetShape, traction: Array) -> list[tuple[Ints, Array]]:
    """What ``handing_on`` has from ends of the target, of facets of the shape ``other``: of each pair, and through the facet's mean."""
    which = at.bounded()
    which = which[traction[at.facet[which]].any(axis=(1, 2))]
    s = at.sides(other, which).at_ends()
    if not len(s.pair):
        return []
    facet, k, (nc, g), nt = at.facet[which], len(which), traction.shape[1:], at.opposite.shape[1]
    of_share, of_mean = at.duals.spread(facet[s.pair], s.b, traction)
    left = np.concatenate([s.phi, -s.N], axis=1)[:, :, None] * of_share[:, None]
    left[:, :nc] += basis_of(at.shape).T.T @ of_mean
    local = sum_of_products(s.pair, -s.weight, left, s.way, k)
    width = (nc + nt) * g
    means = add_up(s.pair, products(of_mean.reshape(-1, nc * g), (-s.way * s.weight[:, None, None]).reshape(-1, width)), k)
    found = [(np.concatenate([at.nodes[facet], at.opposite[which]], axis=1), local)]
    # the target's shape functions are projected onto the whole facet, with all that is opposite of it
    for places, nodes in at.in_facets(which):
        f, width = nodes.shape
        projected = at.duals.inverse[facet[places]] @ at.covered.N[which[places]]
        change = at.of_facets(means.reshape(k, nc * g, nc + nt, g)[places]).reshape(f, nc, g, width * g)
        out = np.zeros((f, width, g, width * g))
        out[:, nc:] = -np.einsum("fcbl,fbgw->fclgw", projected, change).reshape(f, width - nc, g, width * g)
        found.append((nodes, out.reshape(f, width * g, width * g)))
    return found


def _stretched(at: SegmentPoints, traction: Array, which: Ints, q: Ints, pair: Ints) -> Array:
    """What ``handing_on`` has from parts of facets that do not grow as these do, at points ``q`` of the pairs ``which``."""
    e, k, (m, nc, g), nt = at.facet[which], len(which), traction.shape, at.opposite.shape[1]
    weight, grown = at.segments.weight[q], at.stretching[q].reshape(len(q), nc * g)
    of_share, of_mean = at.duals.spread(e[pair], at.b[q], traction)
    share = np.concatenate([at.phi[q], -at.N[q]], axis=1)
    left = share[:, :, None] * of_share[:, None]
    left[:, :nc] += basis_of(at.shape).T.T @ of_mean
    out = np.zeros((k, nc + nt, g, nc + nt, g))
    width = (nc + nt) * g
    out[:, :, :, :nc] = add_up(pair, products(weight[:, None] * left.reshape(-1, width), grown), k).reshape(k, nc + nt, g, nc, g)
    if nt:
        means = add_up(e[pair], products(weight[:, None] * of_mean.reshape(len(q), nc * g), grown), m).reshape(m, nc, g, nc, g)
        projected = at.duals.inverse[e] @ at.covered.N[which]
        out[:, nc:, :, :nc] -= np.einsum("kbl,kbgah->klgah", projected, means[e])
    return out.reshape(k, width, width)


class RowSlopes(NamedTuple):
    """Derivatives of the directions and sizes of contactors' own rows, by the positions of nodes."""

    nodes: Ints  # that some rows depend on or follow, -1 for no node ``(k, c)``
    weight: Array  # with which the contactor's friction acts on them ``(k, c)``
    normal: Array  # derivatives of the rows' directions, whose parts along the target count ``(k, c, gdim, gdim)``
    longer: Array  # relative growth of the force along them, of a unit of ``push`` ``(k, c, gdim)``
    whole: Array  # of the integral of the dual function times the contactor's own shape function ``(k, c, gdim)``


def row_slopes(elimination: Elimination, rows: WeightedRows, which: Ints, unit: Array, weights: Terms) -> RowSlopes:
    """How the rows of covered contactors ``which (k,)`` change (collective).

    Args:
        elimination: of the contactors.
        rows: equations of all contactors, where they were made.
        which: places among the contactors, ascending.
        unit: multipliers at the facets' nodes, of these contactors, that make the plain rows' 1 ``(m, nc)``.
        weights: weights by which all contactors follow other nodes.
    """
    at, config, n = rows.points, elimination.config, len(rows.covered)
    (m, nc), g = unit.shape, at.x.shape[2]
    assert rows.slope is not None and rows.parts is not None
    # of every contactor: derivatives of its multiplier times its part of the gap's gradient, and of its share of the facets
    turned = np.einsum("mg,magh->mah", at.planes.normal, at.turning) / at.planes.size[:, None, None]
    grown = np.einsum("mjb,bj->mj", at.duals.C, basis_of(at.shape).T)[:, :, None, None] * turned[:, None]
    if at.unequal:
        s = at.segments
        stretched = products(s.weight[:, None] * at.b, at.stretching.reshape(len(at.b), nc * g))
        on_facet = add_up(at.facet[s.pair], stretched, m).reshape(m, nc, nc, g)
        grown += np.einsum("mjb,bj,mbag->mjag", (at.duals.C != 0).astype(float), basis_of(at.shape).T, on_facet)
    parts = [terms_of(at.nodes, at.nodes, np.concatenate([np.zeros((m, nc, nc, g * g + g)), grown], axis=3))]
    if at.other is not None:
        ends = at.bounded()
        sides = at.sides(at.other, ends).at_ends()
        pair = ends[sides.pair]
        e = at.facet[pair]
        share = sides.weight[:, None] * np.einsum(
            "qjb,bj,qb->qj", (at.duals.C[e] != 0).astype(float), basis_of(at.shape).T, sides.b
        )
        grown = -share[:, :, None, None] * sides.way[:, None]
        over = np.concatenate([at.nodes[e], at.opposite[pair]], axis=1)
        parts.append(terms_of(at.nodes[e], over, np.concatenate([np.zeros((*grown.shape[:3], g * g + g)), grown], axis=3)))
    length = np.linalg.norm(rows.parts, axis=2, keepdims=True)
    outward = rows.parts / np.where(length > 0, length, 1.0)
    for some, nodes, blocks in own_curvature(at, unit):
        own = -blocks.swapaxes(2, 3)
        longer = np.einsum("pjg,pjwgh->pjwh", outward[_places(at.nodes, nodes[:, :nc])][:, some], own)
        columns = [own.reshape(*own.shape[:3], g * g), longer, np.zeros((*longer.shape[:3], g))]
        parts.append(terms_of(nodes[:, :nc][:, some], nodes, np.concatenate(columns, axis=3)))
    row, term, value = elimination.at_owners(parts, np.ones(n))
    values = np.zeros((len(row) + len(weights[0]) + len(which), 1 + g * g + 2 * g))
    values[: len(row), 1:] = value
    values[len(row) :, 0] = np.concatenate([-weights[2], np.ones(len(which))])
    rows_of_terms, terms = (
        np.concatenate(part)
        for part in ((row, weights[0], which), (term, weights[1], config.to_global(elimination.nodes[which])))
    )
    nodes, values = _table(add_up_terms((rows_of_terms, terms, values)), which, n)
    gradient, longer, whole = np.split(values[:, :, 1:], [g * g, g * g + g], axis=2)
    normal = gradient.reshape(*nodes.shape, g, g) / rows.slope[which, None, None, None]
    return RowSlopes(nodes, values[:, :, 0], normal, longer, whole)


def turning(
    elimination: Elimination, rows: WeightedRows, dofs: Indices, frictional: Frictional, weights: Terms
) -> list[tuple[Ints, Array]]:
    """Minus the derivatives of friction forces (collective).

    Coefficients are constant for slipping contactors, multipliers for others.

    Args:
        elimination: of the contactors.
        rows: equations of all contactors, where they were made.
        dofs: local nodes of the contactor facets ``(m, nc)``.
        frictional: the contactors with friction.
        weights: weights by which all contactors follow other nodes.

    Returns:
        Lists of global nodes, -1 for no node ``(k, c)``, and blocks ``(k, c gdim, c gdim)``.
    """
    which, normal, tau = frictional.which, frictional.normal, frictional.tau
    assert rows.push is not None
    there, whole = at_facets(elimination, rows, dofs, which, tau)
    made = row_slopes(elimination, rows, which, there[:, :, 0], weights)
    (k, c), g = made.nodes.shape, tau.shape[1]
    along = made.longer * (frictional.slips / rows.push[which])[:, None, None]
    across = np.einsum("kg,kcgh->kch", tau, made.normal)
    change = np.einsum("kg,kch->kgch", tau, along - made.whole / whole[:, None]) - np.einsum("kg,kch->kgch", normal, across)
    blocks = np.einsum("ka,kgch->kagch", -made.weight, change).reshape(k, c * g, c * g)
    return [*handing_on(rows.points, -there[:, :, 1:]), (made.nodes, blocks)]


def at_facets(elimination: Elimination, rows: WeightedRows, dofs: Indices, which: Ints, tau: Array) -> tuple[Array, Array]:
    """Multipliers that make plain rows' 1, and tractions, of contactors ``which (k,)`` at facets' nodes ``dofs (m, nc)`` (collective).

    Returns:
        Both, ``(m, nc, 1 + gdim)``, and the divisors of the weights ``(k, 1)``.
    """
    assert rows.whole is not None
    n, g, whole = len(rows.covered), tau.shape[1], rows.whole[which, None]
    mine, sharing = np.zeros((n, 1 + g)), rows.sharing[which]
    # directions and their changes are the same for any force across the target: one that makes the plain row's multiplier 1
    mine[which] = np.column_stack([rows.share[which] / (rows.area[which] * sharing), sharing[:, None] * tau / whole])
    return elimination.config.from_owners(elimination.nodes, mine, dofs.ravel()).reshape(*dofs.shape, 1 + g), whole


def _places(facets: Ints, which: Ints) -> Ints:
    """Indices in ``facets (m, nc)`` of facets with the same nodes ``(p, nc)``."""
    _, number = np.unique(np.concatenate([facets, which]), axis=0, return_inverse=True)
    place = np.zeros(len(number), dtype=np.int64)
    place[number[: len(facets)]] = np.arange(len(facets))
    return place[number[len(facets) :]]


def _table(terms: Terms, which: Ints, n: int) -> tuple[Ints, Array]:
    """Terms of rows ``which (k,)`` of ``n``, one row each: followed nodes, -1 for none ``(k, c)``, and values ``(k, c, ...)``."""
    row, term, value = terms
    place = np.full(n, -1, dtype=np.int64)
    place[which] = np.arange(len(which))
    kept = place[row] >= 0
    row, term, value = place[row[kept]], term[kept], value[kept]
    column = np.arange(len(row)) - np.searchsorted(row, np.arange(len(which)))[row]
    nodes = np.full((len(which), int(column.max(initial=-1)) + 1), -1, dtype=np.int64)
    values = np.zeros((*nodes.shape, value.shape[1]))
    nodes[row, column], values[row, column] = term, value
    return nodes, values
