"""Conditions of the contacts in the space of one degree more, on the contactors of a solution.

    integral of phi_i (n . (w_c - w_t) + g) >= 0          for each contactor i, and zero for an active one

w_c and w_t are values of a function w of that space on the contactor and at the closest point of the target. The gap g is the one that the
solution leaves, and phi_i a Bernstein function of that space on the contactor. Both couplings and rigid targets get the
same conditions; ties have one for each component, and so have contactors that stick. Where contactors slip, their friction is part of the
equation's forces, along ``n - mu s`` instead of n, with the coefficient mu and the direction of slip s.

Curvature of contacts in the space of one degree more, where contactors slide over their targets.

Normals turn with targets, and closest points move along these. So contact forces turn with a function w of that space, and the stiffness
of the bodies is that of a contact with these forces,

    K(v, w) + integral of lam d/dw [ (n - mu s) . (v_c - v_t) ]

with the multipliers lam of the solution's tractions. Contactors that stick keep their anchors, where forces do not turn.
"""

from __future__ import annotations

from dataclasses import replace
from math import factorial
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from uem_dolfinx import forms
from uem_dolfinx.accuracy.enriched import Enriched, of_facets
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.pair.tables import table_of
from uem_dolfinx.geometry.facets import TargetFacets, facets_of, nodes_of_facets, unit
from uem_dolfinx.geometry.shapes import area_vectors, facet_shape
from uem_dolfinx.parallel import gathered

#: Points whose second derivatives are made at once, in the memory that these take. [bound; points; -]
POINTS_AT_ONCE = 1000


class Side(NamedTuple):
    """The enriched space on facets of one side of a contact, at points of contactors."""

    node: Ints  # global nodes ``(n, nn)``
    value: Array  # their functions ``(n, nn)``
    free: Array  # 1 for their free components ``(n, nn, gdim)``
    x: Array  # their positions ``(n, nn, gdim)``


def curvature(
    projection: Any, lam: Array, rubbing: Array, contactor: Side, target: Side | None, shape: Any
) -> tuple[Ints, Ints, Array]:
    """Entries of the stiffness that sliding contacts add.

    Args:
        projection: of the points, onto the target.
        lam: multipliers at the points, with their part of the area ``(n,)``: negative in contact, zero where they do not slide.
        rubbing: mu s in the tangent plane ``(n, gdim)``.
        contactor: its functions.
        target: functions of the target; None for a rigid one.
        shape: of the target's facets in the enriched space.

    Returns:
        Global components of rows and of columns, and values ``(k,)``.
    """
    gdim, sides = projection.normal.shape[1], [contactor] if target is None else [contactor, target]
    found = np.concatenate([side.node for side in sides], axis=1)
    components, local = np.unique(found[:, :, None] * gdim + np.arange(gdim), return_inverse=True)
    local = local.reshape(*found.shape, gdim)
    total = csr_matrix((len(components),) * 2)
    slides = np.flatnonzero(lam)
    for i in np.split(slides, np.arange(POINTS_AT_ONCE, len(slides), POINTS_AT_ONCE)):
        p, which, every = projection, i, np.arange(len(i))
        if target is not None:
            tab, which = shape.tabulate(p.xi[i]), every
            p = replace(p.take(i), nodes=target.node[i], weights=tab.N, dN=tab.dN, ddN=tab.ddN, x=target.x[i])
        blocks = lam[i, None, None] * (p.hessians(which) - p.turnings(which, rubbing[i]))
        # motion of the contactor and of the target's nodes, by the components of the space
        size = blocks.shape[1]
        first = np.broadcast_to(size * every[:, None, None] + np.arange(gdim), contactor.free[i].shape)
        rows, values = [first], [contactor.value[i, :, None] * contactor.free[i]]
        if target is not None:
            rows.append(size * every[:, None, None] + np.arange(gdim, size).reshape(-1, gdim))
            values.append(target.free[i])
        row, value = (np.concatenate(one, axis=1).ravel() for one in (rows, values))
        motion = csr_matrix((value, (row, local[i].ravel())), shape=(size * len(i), len(components)))
        total = total + motion.T @ (bsr_matrix((blocks, every, np.arange(len(i) + 1)), shape=(size * len(i),) * 2) @ motion)
    whole = total.tocoo()
    return components[whole.row], components[whole.col], whole.data


#: Pieces of a rule along each side of a contactor facet, on which kinks of the target lie anywhere.
#: [bound; pieces; test_goal.py::test_effectivity]
PIECES = 4


class EnrichedRows(NamedTuple):
    """Entries of the equations that this rank has integrated."""

    row: Ints  # global number of the equation ``(k,)``
    node: Ints  # global node of the enriched space ``(k,)``
    value: Array  # entries at its components, zero where these are prescribed ``(k, gdim)``
    #: the same of the forces of its multiplier, which differ from these where contactors slip with friction ``(k, gdim)``.
    force: Array
    gap_row: Ints  # global number of the equation of each part of a gap ``(j,)``
    gap: Array  # parts of the weighted gaps ``(j,)``
    active: Bools  # whether the solution's contactors of the rank's own equations are active ``(m,)``
    tied: Bools  # whether their equations always are ``(m,)``
    own: Ints  # owned nodes of the enriched space that they belong to ``(m,)``
    #: global components of rows and columns of the stiffness that contacts add, and values ``(l,)`` each.
    curvature: tuple[Ints, Ints, Array]
    first: Ints  # first equation of every rank, and one past the last


def enriched_rows(enriched: Enriched) -> EnrichedRows:
    """Equations of all contacts of a problem (collective)."""
    config, comm = enriched.problem.config, enriched.problem.comm
    parts = [_none(config.gdim)]
    states: list[tuple[Bools, Bools]] = []
    surfaces = [_Surface(enriched, contact) for contact in enriched.problem.contacts]
    first = np.append(0, np.cumsum(gathered(comm, sum(len(one.nodes) * one.width for one in surfaces))))
    at = int(first[comm.rank])
    for one in surfaces:
        count = len(one.nodes) * one.width
        parts.append(one.entries(at))
        states.append((np.repeat(one.active, one.width), np.repeat(one.tied, one.width)))
        at += count
    active, tied = (np.concatenate([np.zeros(0, bool), *part]) for part in (zip(*states) if states else ([], [])))
    row, node, value, force, gap_row, gap, *curvature = (np.concatenate(part) for part in zip(*parts))
    own = np.concatenate([np.zeros(0, np.int64), *(np.repeat(one.nodes, one.width) for one in surfaces)])
    return EnrichedRows(
        row, node, value, force, gap_row, gap, active, tied, own, (curvature[0], curvature[1], curvature[2]), first
    )


def _none(gdim: int) -> list[Any]:
    none, ints = np.zeros((0, gdim)), np.zeros(0, np.int64)
    return [ints, ints, none, none, ints, np.zeros(0), ints, ints, np.zeros(0)]


class _Surface:
    """The contactor's surface of a contact in the enriched space (collective)."""

    def __init__(self, enriched: Enriched, contact: Contact):
        config, self.enriched, self.contact = enriched.problem.config, enriched, contact
        self.facets = facets_of(config, contact.contactor, "contactor")
        self.dofs = self._dofs(contact.contactor)
        pair, nodes = contact.pair, enriched.nodes
        whole, rows = table_of(pair)
        friction = whole.friction
        self.width = config.gdim if contact.tied or friction is not None else 1  # number of equations of a node
        # active, stick, and mu s of contactors that slip, with their number
        state = np.zeros((config.n_owned, config.gdim + 3))
        state[pair.nodes, 0] = pair.tied if contact.tied else pair.trial.active
        state[:, 1] = contact.tied is not False
        if friction is not None:
            slips = friction.slipping(whole.trial)
            state[pair.nodes, 1] = (friction.active(whole.trial) & ~slips)[rows]
            state[pair.nodes, 2] = slips[rows]
            state[pair.nodes, 3:] = (friction.value[:, None] * friction.directions(whole.trial))[rows]
        at_nodes = of_facets(config, contact, state)
        whole = at_nodes[:, :, :2].min(axis=1, initial=1.0)
        #: Of each facet, a mean of mu s over the contactors that slip ``(m, gdim)``.
        self.rubbing = at_nodes[:, :, 3:].sum(axis=1) / np.maximum(at_nodes[:, :, 2].sum(axis=1), 1.0)[:, None]
        there, active, tied = (
            nodes.to_owners(self.dofs.ravel(), np.repeat(v, self.dofs.shape[1]))[: nodes.n_owned] > 0
            for v in (np.ones(len(whole)), *whole.T)
        )
        self.nodes = np.flatnonzero(there)  # owned nodes of the space on it ``(n,)``
        self.active: Bools = active[self.nodes]  # whether all contactors of a facet around them are active ``(n,)``
        self.tied: Bools = tied[self.nodes]  # whether they are tied, or all contactors of a facet around them stick ``(n,)``

    def _dofs(self, tag: Any) -> Indices:
        """Local nodes of the enriched space on this rank's facets ``(m, nn)``."""
        config, of = self.enriched.problem.config, self.enriched
        space: Any = SimpleNamespace(V=of.W, mesh=config.mesh, tdim=config.tdim, degree=of.degree)
        return nodes_of_facets(space, tag).dofs

    def entries(self, first: int) -> list[Any]:
        """Entries of the equations, which on this rank begin with the number ``first`` (collective)."""
        enriched, contact, facets = self.enriched, self.contact, self.facets
        config, target = enriched.problem.config, contact.pair.discretisation.target
        gdim, nodes = config.gdim, enriched.nodes
        numbers = np.zeros((nodes.n_owned, self.width + 1))
        numbers[self.nodes, :-1] = first + np.arange(len(self.nodes) * self.width).reshape(-1, self.width)
        numbers[self.nodes, -1] = self.tied
        at = (
            nodes.from_owners(np.arange(nodes.n_owned), numbers, self.dofs.ravel())
            .reshape(*self.dofs.shape, self.width + 1)
            .astype(np.int64)
        )
        at, tied = at[..., :-1], at[..., -1] > 0
        xi, weights = composite_rule(facets.shape.cell, 2 * enriched.degree, PIECES)
        N, n_q = facets.shape.functions(xi), len(xi)
        X = config.X[facets.dofs]
        size = np.stack(
            [
                w * np.linalg.norm(area_vectors(facets.shape.tabulate(np.tile(q, (len(facets.dofs), 1))), X), axis=1)
                for q, w in zip(xi, weights)
            ],
            axis=1,
        )
        if config.axisymmetric:
            size *= 2.0 * np.pi * X[:, :, 0] @ N.T
        projection = _projected(contact, np.einsum("qa,nag->nqg", N, X), np.einsum("qa,nag->nqg", N, config.x[facets.dofs]))
        opposite = ~projection.beyond.any(axis=1)
        if target.n_nodes:
            opposite &= projection.facet >= 0
        area = np.where(opposite, size.ravel(), 0.0)
        gap = np.where(opposite, projection.gap, 0.0)
        if (offset := contact.pair.discretisation.setting.offset) is not None:
            of_nodes = np.zeros((config.n_owned, 1))
            of_nodes[contact.pair.nodes, 0] = offset
            gap = gap - (of_facets(config, contact, of_nodes)[:, :, 0] @ N.T).ravel()
        # which facet and point of the rule
        facet, point = np.divmod(np.arange(len(facets.dofs) * n_q), n_q)
        # those of each test function's node: the normal, or all components of tied ones (points, test, direction, component)
        tied, n = tied[facet], projection.normal
        rubbing = _in_plane(self.rubbing[facet], n)
        directions, along = (np.zeros((*tied.shape, self.width, gdim)) for _ in range(2))
        directions[:, :, 0], along[:, :, 0] = n[:, None], (n - rubbing)[:, None]
        directions[tied] = along[tied] = np.eye(gdim)[: self.width]
        gaps = np.zeros(directions.shape[:-1])
        if not contact.tied:
            gaps = np.where(tied[:, :, None], (gap[:, None] * n)[:, None, : self.width], 0.0)
            gaps[:, :, 0] = np.where(tied, gaps[:, :, 0], gap[:, None])
        shape = facet_shape(facets.shape.cell, enriched.degree)
        here = self._side(facets, self.dofs, facet, shape.functions(xi)[point])
        there = self._opposite(projection) if target.n_nodes else None
        test = area[:, None] * bernstein(facets.shape.cell, enriched.degree, xi)[point]
        found: list[list[Any]] = [[], [], [], []]
        for sign, side in ((1.0, here), (-1.0, there)):
            if side is None:
                continue
            # (points, test, direction, node, component)
            value, force = (
                sign * np.einsum("pt,ptdg,pn,png->ptdng", test, one, side.value, side.free) for one in (directions, along)
            )
            found[0].append(np.broadcast_to(at[facet][:, :, :, None], value.shape[:-1]).ravel())
            found[1].append(np.broadcast_to(side.node[:, None, None, :], value.shape[:-1]).ravel())
            found[2].append(value.reshape(-1, gdim))
            found[3].append(force.reshape(-1, gdim))
        weighted = test[:, :, None] * gaps
        turned: Any = _none(gdim)[-3:]
        if contact.sliding == "finite" and enriched.traction is not None:
            t = np.einsum("qa,nag->nqg", N, enriched.traction.x.array.reshape(-1, gdim)[facets.dofs]).reshape(-1, gdim)
            lam = -np.einsum("ng,ng->n", t, n) * np.where(tied, 0.0, test).sum(axis=1)
            turned = curvature(projection, lam, rubbing, here, there, shape)
        return [*(np.concatenate(part) for part in found), at[facet].ravel(), weighted.ravel(), *turned]

    def _side(self, facets: TargetFacets, dofs: Indices, which: Ints, values: Array) -> Side:
        """Functions of the enriched space ``(n, nn)`` on some of this rank's facets ``(n,)``, with nodes ``dofs (m, nn)``."""
        of = self.enriched
        corners = facets.shape.functions(facet_shape(facets.shape.cell, of.degree).nodes)
        x = np.einsum("bn,mng->mbg", corners, facets.x)
        return Side(of.nodes.to_global(dofs)[which], values, np.where(of.held[dofs][which], 0.0, 1.0), x[which])

    def _opposite(self, projection: Any) -> Side:
        """Functions at the closest points on facets of any rank (collective)."""
        target: Any = self.contact.pair.discretisation.target
        facets, exchange = target.facets, target.facets.owners(projection.facet)
        facet, xi = exchange.send(projection.facet, projection.xi)
        values = facet_shape(facets.shape.cell, self.enriched.degree).functions(xi)
        side = self._side(facets, self._dofs(facets.tag), facet - facets.first[self.enriched.problem.comm.rank], values)
        found = []
        for answer in exchange.back(*side):
            found.append(np.zeros((len(projection.facet), *answer.shape[1:]), answer.dtype))
            found[-1][exchange.rows] = answer
        return Side(*found)


def bernstein(cell: str, degree: int, xi: Array) -> Array:
    """Bernstein's functions, numbered as the nodes of a facet of any degree, at ``xi (n, fdim)``: ``(n, nn)``."""

    def extended(points: Array) -> Array:
        """Pairs of coordinates of a sum of 1, one after the other; on a triangle three coordinates of a sum of 1."""
        if cell == "triangle":
            return np.column_stack([1 - points.sum(axis=1), points])[:, None]
        return np.stack([1 - points, points], axis=2)

    # nodes lie near those of equal distances
    powers = np.rint(degree * extended(facet_shape(cell, degree).nodes)).astype(int)
    b = extended(xi)[:, None]
    counts = factorial(degree) / np.vectorize(factorial)(powers).prod(axis=2)
    return np.asarray((b**powers).prod(axis=(2, 3)) * counts.prod(axis=1))


def composite_rule(cell: str, degree: int, pieces: int) -> tuple[Array, Array]:
    """Points ``(n, fdim)`` and weights ``(n,)`` of a rule in each of ``pieces`` along every side of a reference facet."""
    xi, weights = forms.quadrature_rule(cell, degree)
    d = xi.shape[1]
    corners = np.stack(np.meshgrid(*[np.arange(pieces)] * d, indexing="ij"), axis=-1).reshape(-1, d)
    if cell == "triangle":
        inside = corners.sum(axis=1) < pieces
        turned = corners.sum(axis=1) < pieces - 1
        parts = [corners[inside][:, None] + xi, corners[turned][:, None] + 1.0 - xi]
        points = np.concatenate([part.reshape(-1, d) for part in parts])
    else:
        points = (corners[:, None] + xi).reshape(-1, d)
    return points / pieces, np.tile(weights, len(points) // len(weights)) / pieces**d


def _projected(contact: Contact, drawn: Array, now: Array) -> Any:
    """Projection of points of the contactor, in the reference configuration and now ``(n, q, gdim)``, onto its target (collective)."""
    config, target = contact.pair.config, contact.pair.discretisation.target
    drawn, now = (points.reshape(-1, config.gdim) for points in (drawn, now))
    if contact.sliding != "fixed" or not target.n_nodes:
        return target.project(now)
    with config.at(np.zeros(len(config.whole.x.array))):
        anchor = target.project(drawn)
    return target.follow(now, anchor)


def _in_plane(vectors: Array, normal: Array) -> Array:
    """Vectors of the same length in the tangent plane ``(n, gdim)``."""
    along = vectors - np.einsum("ng,ng->n", vectors, normal)[:, None] * normal
    return unit(along) * np.linalg.norm(vectors, axis=1)[:, None]
