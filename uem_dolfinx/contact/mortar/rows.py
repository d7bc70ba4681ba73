"""Rows of weighted gaps as lists of terms, on the ranks that own their nodes.

Contactors that equations of users give one displacement have one row: one basis function lies on both sides of a seam.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypeAlias

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints, sums_of_groups
from uem_dolfinx.conditions.seams import Seam, Seams
from uem_dolfinx.contact.mortar.duals import basis_of
from uem_dolfinx.contact.mortar.points import SegmentPoints
from uem_dolfinx.contact.mortar.tangent import gap_derivatives
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets, facets_of
from uem_dolfinx.geometry.overlaps import Segments
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import Exchange


def density(config: Configuration, tag: Tag, nodes: Indices, amounts: Array, areas: Array) -> Array:
    """Values at the owned nodes ``(n_owned,)`` of a field of shape functions whose integral is the sum of the amounts (collective).

    Of degree 2 it is the combination of Bernstein's functions, which are nowhere negative, each with its amount over its integral.

    Args:
        config: configuration of the displacement.
        tag: facets of the contactor.
        nodes: owned contactor nodes ``(n,)``.
        amounts: at these ``(n,)``, which belong to shape functions, at degree 2 to Bernstein's functions.
        areas: integrals of these functions ``(n,)``.
    """
    whole, own = np.zeros((2, config.n_owned))
    whole[nodes], own[nodes] = amounts, areas
    if config.degree == 1:
        return _over(whole, own)
    surface, every = facets_of(config, tag, "contactor"), np.arange(config.n_owned)
    dofs, to_nodes = surface.dofs.ravel(), np.linalg.inv(basis_of(surface.shape).T)
    coefficients = config.from_owners(every, _over(whole, own)[:, None], dofs).reshape(surface.dofs.shape)
    values, count = (
        config.to_owners(dofs, part.ravel())[: config.n_owned]
        for part in (coefficients @ to_nodes.T, np.ones(surface.dofs.shape))
    )
    return _over(values, count)


def _over(values: Array, by: Array) -> Array:
    """Quotients, zero where there is nothing to divide by."""
    return np.where(by > 0, values / np.where(by > 0, by, 1.0), 0.0)


#: Facets around a node that are distinguished by the bits of one number; further ones are distinguished at their other nodes.
#: [bound; bits; -]
MOST_BITS = 52


#: Row, followed node and coefficient of each term.
Terms: TypeAlias = tuple[Ints, Ints, Array]


class Pieces(NamedTuple):
    """Segments of pairs of facets, with contactor and opposite facets; fields as in ``SegmentPoints``.

    ``facing`` is as in ``WeightedRows``.
    """

    segments: Segments
    facet: Ints
    to_gap: Array
    N: Array
    opposite: Ints
    y: Array
    shape_operator: Array | None
    facing: Ints


@dataclass(frozen=True)
class WeightedRows:
    """Equations of all contactors, one per contactor."""

    sharing: Array  # number of contactors with the same row, of which each has an equal part of the force, see ``Seam`` ``(n,)``
    equations: UnitingEquations  # in the order of the contactors, all inactive. Their left sides are the derivatives of the gaps
    length: Array  # divisors of these equations ``(n,)``
    plain: UnitingEquations  # the same equations with only the derivatives along the normals of the contactor's facets
    points: SegmentPoints  # quadrature points of the segments at the time when the rows were made
    facets: Ints  # numbers of the contactor's facets near the target ``(m,)``
    covered: Bools  # contactors whose equation comes from segments ``(n,)``
    ratio: Array  # covered part of the contactor's share of its facets ``(n,)``
    area: Array  # integral of the contactor's dual function, the area of its multiplier as a pressure, over ``sharing`` ``(n,)``
    stretch: Array  # current over reference area of the facets around the contactor ``(n,)``
    share: Array  # contact force of this area over the multiplier ``(n,)``; 1 except at the middle nodes of quadratic facets
    #: terms by which contactors follow other nodes in the same mean, for friction; None without friction.
    weights: Terms | None = None
    #: directions of the gaps' derivatives by the contactors' own displacements, normal to friction ``(n, gdim)``; None
    #: without friction.
    normal: Array | None = None
    slope: Array | None = None  # lengths of these derivatives over the lengths for the plain rows ``(n,)``; None without friction
    #: sum of the lengths of each facet's part of these derivatives, over the lengths for the plain rows ``(n,)``: the sum of
    #: the facets' forces along their own normals; None without friction.
    push: Array | None = None
    parts: Array | None = None  # each facet's part of the nodes' own derivatives ``(m, nc, gdim)``
    #: integral of the contactor's dual function times its own shape function, the divisor of ``weights`` ``(n,)``; None
    #: without friction.
    whole: Array | None = None
    #: keys, independent of the partition, of contactor and target facets that cover each other ``(p, 2)``.
    facing: Ints | None = None

    def at_gaps(self, gap: Array) -> WeightedRows:
        """The rows with other gaps of the plain ones ``(n,)``."""
        plain, equations = replace(self.plain, gap=gap), replace(self.equations, gap=gap / self.length)
        return replace(self, equations=equations, plain=plain)

    def turned(self, Q: Array) -> WeightedRows:
        """The rows, rotated by ``Q (gdim, gdim)`` with a rigid target."""
        plain, equations = (
            replace(eq, direction=eq.direction @ Q.T, coefficients=eq.coefficients @ Q.T) for eq in (self.plain, self.equations)
        )
        normal = None if self.normal is None else self.normal @ Q.T
        return replace(self, equations=equations, plain=plain, normal=normal)


class Elimination:
    """Assembly of the rows of one surface on the ranks that own the nodes.

    Args:
        nodes: owned contactor nodes ``(n,)``.
        seams: equations that give nodes one displacement, or None.

    Attributes:
        seam: contactors of one displacement.
    """

    def __init__(self, config: Configuration, nodes: Indices, seams: Seams | None = None):
        self.config, self.nodes, self.seam = config, nodes, Seam(config, nodes, seams)
        self._place = np.full(config.n_owned, -1, dtype=np.int64)
        self._place[nodes] = np.arange(len(nodes))
        self._own = config.to_global(nodes)

    def at_owners(self, parts: Sequence[Terms], scale: Array) -> Terms:
        """Send terms (node, followed node, coefficients) to the owners of their nodes and divide by ``scale (n,)`` (collective)."""
        node, term, value = self.seam.rows(*(np.concatenate(part) for part in zip(*parts)))
        node, term, value = Exchange.to(self.config.comm, self.config.owner_of(node)).send(node, term, value)
        row = self._place[node - self.config.first]
        return add_up_terms((row, term, value / scale[row, None]))

    def total(self, nodes: Ints, values: Array) -> Array:
        """Sums of values ``(m, k)`` at the facets' global nodes ``(m,)``, at the contactors ``(n, k)`` (collective)."""
        return np.asarray(self.seam.sums(self.config.add_at_owners(nodes, values))[self.nodes])

    def sides(self, nodes: Ints, values: Array) -> Array:
        """Parts of groups' coefficients that belong to each contactor itself ``(n, k)``; zeros without groups (collective).

        Args:
            nodes: of facets ``(m, nn)``.
            values: coefficients in the rows of the first by the second ``(m, nn, nn, k)``.
        """
        if not self.seam.any:
            return np.zeros((len(self.nodes), values.shape[3]))
        parts = np.einsum("mjak,mja->mak", values, self.seam.same(nodes))
        return np.asarray(self.config.add_at_owners(nodes.ravel(), parts.reshape(-1, values.shape[3]))[self.nodes])

    def variation(self, at: SegmentPoints, scale: Array, plain: UnitingEquations) -> tuple[Terms, Array]:
        """Terms of the gaps' derivatives by the variation of normals and weights, over ``scale (n,)`` (collective).

        They are dropped for contactors whose own coefficient would become negative, because the end of the target moves faster than
        the contactor. All other contactors can be eliminated for any active set.

        Returns:
            Terms, and each facet's part of its nodes' own derivatives ``(m, nc, gdim)``.
        """
        on_facet, on_target = gap_derivatives(at)
        terms = [terms_of(at.nodes, at.nodes, -on_facet), terms_of(at.nodes[at.facet], at.opposite, -on_target)]
        variation = row, term, value = self.at_owners(terms, scale)
        own = np.einsum("ng,ng->n", self.of_themselves(plain, variation), plain.direction)
        kept = own[row] > 0.0
        return (row[kept], term[kept], value[kept]), np.einsum("mjag,mja->mjg", on_facet, self.seam.same(at.nodes))

    def of_themselves(self, plain: UnitingEquations, variation: Terms) -> Array:
        """Directions of rows including the terms at their own contactors ``(n, gdim)``."""
        row, term, value = variation
        itself, direction = term == self._own[row], plain.direction.copy()
        # each row has at most one such term
        direction[row[itself]] -= value[itself]
        return direction

    def derivatives(self, plain: UnitingEquations, variation: Terms) -> tuple[UnitingEquations, Array]:
        """Equations whose left sides are the derivatives of the gaps, and their divisors ``(n,)``.

        Contactors follow each other with coefficients of second order in the angles between facets.
        """
        row, term, value = variation
        other, direction = term != self._own[row], self.of_themselves(plain, variation)
        by = np.linalg.norm(direction, axis=1)
        known = (plain.row, plain.followed, plain.coefficients)
        row, term, value = add_up_terms(known, (row[other], term[other], value[other]))
        made = replace(plain, row=row, followed=term, coefficients=value / by[row, None])
        return replace(made, direction=direction / by[:, None], gap=plain.gap / by), by


class Remembered:
    """Bits of contactors, one for each facet around them, independent of the partition (collective).

    Args:
        nodes: owned contactor nodes ``(n,)``.
        surface: the contactor's facets.
    """

    def __init__(self, config: Configuration, nodes: Indices, surface: TargetFacets):
        self.config, self.nodes, self.dofs = config, nodes, surface.dofs
        node, key = config.to_global(self.dofs.ravel()), np.repeat(surface.keys, self.dofs.shape[1])
        meeting = Exchange.to(config.comm, config.owner_of(node))
        node, key = meeting.send(node, key)
        order = np.lexsort((key, node))
        number = np.empty(len(node), dtype=np.int64)
        number[order] = np.arange(len(node)) - np.searchsorted(node[order], node[order])
        place = np.empty(self.dofs.size, dtype=np.int64)
        (place[meeting.rows],) = meeting.back(number)
        #: Bit number of each facet at each of its nodes, limited by the digits of a float.
        self._place = place.reshape(self.dofs.shape)
        self._has = self._place < MOST_BITS

    def of(self, which: Bools) -> Ints:
        """Bits ``(n,)`` for nodes of facets ``which (m, nn)``, or for all nodes of facets ``(m, 1)`` (collective)."""
        bits = np.ldexp((self._has & which).astype(float), np.minimum(self._place, MOST_BITS))
        return self.config.to_owners(self.dofs.ravel(), bits.ravel())[self.nodes].astype(np.int64)

    def shares(self, bits: Ints) -> Bools:
        """Inverse of ``of``: the nodes of facets ``(m, nn)`` with these bits (collective)."""
        there = self.config.from_owners(self.nodes, bits[:, None].astype(float), self.dofs.ravel()).astype(np.int64)
        return np.asarray(self._has & (there.reshape(self.dofs.shape) >> np.minimum(self._place, MOST_BITS) & 1 > 0))


def terms_of(rows: Ints, followed: Ints, values: Array, which: Bools | bool = True) -> Terms:
    """Terms of rows of nodes ``rows (m, nr)`` that follow ``followed (m, nf)`` with ``values (m, nr, nf, gdim)``, zeros left out."""
    m, i, a = np.nonzero(values.any(axis=3) & which)
    return rows[m, i], followed[m, a], values[m, i, a]


def add_up_terms(*parts: Terms) -> Terms:
    """Terms of several lists; terms of the same row and node are added up."""
    row, term, value = (np.concatenate(part) for part in zip(*parts))
    if not len(row):
        return row, term, value
    key = row * (term.max() + 1) + term
    order = np.argsort(key, kind="stable")
    first = np.flatnonzero(np.diff(key[order], prepend=-1))
    each = order[first]
    return row[each], term[each], sums_of_groups(value, first, order)
