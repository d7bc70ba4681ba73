"""Rows of weighted gaps as lists of terms, and how contactors whose gaps depend on each other are eliminated each for itself."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypeAlias

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.entries import entries_of
from uem_dolfinx.algebra.equations import NEGLIGIBLE, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.mortar_tangent import SegmentPoints
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import Exchange

#: The derivative of a gap that has less than this part of the plain row's component along its direction is left alone with that row:
#: little is covered there, far from the target, and the end of what covers it moves faster than the contactor.
#: [heuristic; part of the component; -]
MOSTLY_OWN = 0.5


#: Rows that terms belong to, the nodes they follow and the coefficients.
Terms: TypeAlias = tuple[Ints, Ints, Array]


@dataclass(frozen=True)
class WeightedRows:
    """Equations of all contactors, one each.

    Attributes:
        equations: in the order of the contactors; none is active. Their left sides are the derivatives of the gaps.
        plain: the same, along the normals of the contactor's facets alone.
        beside: terms that the derivatives have beside the plain rows'; none where all facets are parallel.
        points: quadrature points of the segments, where the rows were made.
        covered: contactors whose equation comes from segments ``(n,)``.
        facets: numbers of the contactor's facets near the target ``(m,)``.
        ratio: part of the contactor's share of its facets that is covered ``(n,)``.
        area: integral of the contactor's dual function, what its multiplier is a pressure on ``(n,)``.
        share: of the multiplier in the contact force that belongs to this area ``(n,)``; 1 but for the middles of quadratic facets.
        weights: by what contactors follow other nodes in the same mean, whatever the direction, for friction; None without.
        normal: directions of the gaps' derivatives with the contactors' own displacements, across which friction acts ``(n, gdim)``;
            None without.
        slope: lengths of these derivatives, over those of the plain rows ``(n,)``; None without friction.
        whole: integral of the contactor's dual function times its own shape function, that these weights are parts of ``(n,)``; None
            without friction.
    """

    equations: UnitingEquations
    plain: UnitingEquations
    beside: Terms
    points: SegmentPoints
    facets: Ints
    covered: Bools
    ratio: Array
    area: Array
    share: Array
    weights: Terms | None = None
    normal: Array | None = None
    slope: Array | None = None
    whole: Array | None = None


class Elimination:
    """Rows of the contactors of one surface, which live at the owners of their nodes.

    Args:
        config: configuration of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        free: components without Dirichlet condition ``(n, gdim)``.
    """

    def __init__(self, config: Configuration, nodes: Indices, free: Bools):
        self.config, self.nodes, self.free = config, nodes, free
        self._place = np.full(config.n_owned, -1, dtype=np.int64)
        self._place[nodes] = np.arange(len(nodes))
        self._own = config.to_global(nodes)
        #: Rows and active contactors of the last call of ``apart``, and what it returned.
        self._last: tuple[WeightedRows, Bools, UnitingEquations, Array] | None = None

    def at_owners(self, parts: Sequence[Terms], scale: Array) -> Terms:
        """Terms of rows, each a node, the node that it follows and the coefficients, at their owners, over ``scale (n,)`` (collective)."""
        node, term, value = (np.concatenate(part) for part in zip(*parts))
        node, term, value = Exchange.to(self.config.comm, self.config.owner_of(node)).send(node, term, value)
        row = self._place[node - int(self.config.index_map.local_range[0])]
        return add_up_terms((row, term, value / scale[row, None]))

    def beside(self, at: SegmentPoints, scale: Array, direction: Array) -> Terms:
        """What the derivatives of the gaps have beside the plain rows of ``direction (n, gdim)``, over ``scale (n,)`` (collective)."""
        on_facet, on_target = at.gap_derivatives()
        terms = [terms_of(at.nodes, at.nodes, -on_facet), terms_of(at.nodes[at.facet], at.opposite, -on_target)]
        row, term, value = self.at_owners(terms, scale)
        own = np.zeros(len(scale))
        itself = term == self._own[row]
        own[row[itself]] = -np.einsum("kg,kg->k", value[itself], direction[row[itself]])
        kept = (own > MOSTLY_OWN - 1)[row]
        return row[kept], term[kept], value[kept]

    def of_themselves(self, plain: UnitingEquations, beside: Terms) -> Array:
        """Directions of rows with what their terms have of their own contactors ``(n, gdim)``."""
        row, term, value = beside
        itself, direction = term == self._own[row], plain.direction.copy()
        # each row has at most one such term
        direction[row[itself]] -= value[itself]
        return direction

    def apart(self, rows: WeightedRows, active: Bools) -> tuple[UnitingEquations, Array]:
        """The equations without what those of other ``active (n,)`` contactors eliminate, as they would follow in circles (collective).

        Such parts, of second order in the angles between facets, are taken out with the plain rows of these contactors: those leave
        neither force nor moment behind either.

        Returns:
            The equations, and what each was divided by ``(n,)``.
        """
        if rows.equations is rows.plain:
            return rows.plain, np.ones(len(self.nodes))
        kept = self._last
        same = kept is not None and kept[0] is rows and np.array_equal(kept[1], active)
        if self.config.comm.allreduce(same, op=MPI.LAND):
            assert kept is not None
            return kept[2], kept[3]
        plain, own, free = rows.plain, self._own, self.free & (rows.covered & active)[:, None]
        beside, gap, at_nodes = rows.beside, plain.gap.copy(), np.zeros((self.config.n_owned, self.config.gdim + 1))
        while True:
            row, term, value = beside
            itself, direction = term == own[row], self.of_themselves(plain, beside)
            left = direction * free
            along = np.einsum("ng,ng->n", left, plain.direction)[:, None]
            at_nodes[self.nodes] = np.column_stack([left / np.where(along > 0, along, np.inf), plain.gap])
            there = self.config.ask_owners(term, at_nodes)
            follows = np.einsum("kg,kg->k", value, there[:, :-1])
            i = np.flatnonzero((np.abs(follows) > NEGLIGIBLE) & ~itself)
            if not self.config.comm.allreduce(len(i)):
                break
            beside = add_up_terms(beside, self._times_rows(plain, own[row[i]], term[i], follows[i]))
            np.add.at(gap, row[i], follows[i] * there[i, -1])
        by = np.linalg.norm(direction, axis=1)
        made = with_terms(plain, (row[~itself], term[~itself], value[~itself]))
        made = replace(made, direction=direction / by[:, None], gap=gap / by, coefficients=made.coefficients / by[made.row, None])
        self._last = rows, active.copy(), made, by
        return made, by

    def _times_rows(self, plain: UnitingEquations, node: Ints, other: Ints, factor: Array) -> Terms:
        """Terms that rows of ``node (k,)`` get where ``factor (k,)`` times the row of ``other (k,)`` is added to them (collective)."""
        config, own = self.config, np.arange(len(self.nodes))
        node, other, factor = Exchange.to(config.comm, config.owner_of(other)).send(node, other, factor)
        row = np.concatenate([own, plain.row])
        order = np.argsort(row, kind="stable")
        term = np.concatenate([self._own, plain.followed])[order]
        value = np.concatenate([-plain.direction, plain.coefficients])[order]
        first = np.searchsorted(row[order], np.arange(len(own) + 1))
        k, i = entries_of(self._place[other - int(config.index_map.local_range[0])], first)
        return self.at_owners([(node[i], term[k], factor[i, None] * value[k])], np.ones(len(own)))


def terms_of(rows: Ints, followed: Ints, values: Array, which: Bools | bool = True) -> Terms:
    """Terms of rows of nodes ``rows (m, nr)`` that follow ``followed (m, nf)`` with ``values (m, nr, nf, gdim)``, zeros left out."""
    m, i, a = np.nonzero(values.any(axis=3) & which)
    return rows[m, i], followed[m, a], values[m, i, a]


def add_up_terms(*parts: Terms) -> Terms:
    """Terms of several lists, those of the same row and node added up."""
    row, term, value = (np.concatenate(part) for part in zip(*parts))
    if not len(row):
        return row, term, value
    key = row * (term.max() + 1) + term
    order = np.argsort(key, kind="stable")
    row, term, value = row[order], term[order], value[order]
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    return row[first], term[first], np.add.reduceat(value, first, axis=0)


def with_terms(equations: UnitingEquations, terms: Terms) -> UnitingEquations:
    """The equations with more terms."""
    row, term, value = add_up_terms((equations.row, equations.followed, equations.coefficients), terms)
    return replace(equations, row=row, followed=term, coefficients=value)
