"""Dual bases on the covered part of contactor facets, and the integrals of constraint equations.

Per facet, with integrals over its covered part, ``D_k = int b_k`` and ``M_kl = int b_k b_l``, the dual functions
``psi = D M^-1 b`` satisfy ``int psi_j b_k = delta_jk D_k`` and add up to one: the consistent basis of Cichosz and Bischoff (2011,
doi:10.1016/j.cma.2010.11.004). The functions b are the shape functions on surfaces of degree 1. Those of degree 2 have no integral,
or a negative one, at vertices; there b are Bernstein's, which are positive, and ``du = sum b_k (T du)_k``.

If little of a node's part of a facet is covered, its dual function would be large. It is added to the function of another node of
the facet, which preserves the sum.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from math import comb, factorial

import numpy as np

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array, Bools, Ints, sums_of_groups
from uem_dolfinx.geometry.overlaps import Segments
from uem_dolfinx.geometry.shapes import FacetShape

#: The dual function of a node is added to another's where less than this part of the node's share of a facet is covered.
#: [convention; part of the integral; test_duals.py::test_what_is_hardly_covered]
HARDLY_COVERED = 0.05
#: One that had its own before keeps it as long as more than this part is covered. Where the target ends on what moves with the forces,
#: it would else be added and taken back for ever.
#: [convention; part of the integral; test_mortar.py::test_dual_functions_are_kept]
STILL_COVERED = 0.01


class Basis:
    """Basis of the displacements of a facet: its shape functions, or Bernstein polynomials on facets of degree 2.

    Attributes:
        T: coefficients from nodal values ``(nn, nn)``.
        mean: means of the functions over the reference facet ``(nn,)``.
        rank: 0 for vertices, 1 and 2 for the middles of edges and facets ``(nn,)``: coefficients depend on nodes of lower rank only.
    """

    def __init__(self, shape: FacetShape):
        self.shape = shape
        n_vertices = len(shape.topology[0])
        n_edges = len(shape.topology[1]) if shape.dim == 2 else 1
        kinds = [0] * n_vertices + ([1] * n_edges + [2] * (len(shape.nodes) - n_vertices - n_edges) if shape.degree == 2 else [])
        self.rank: Ints = np.array(kinds, dtype=np.int64)
        self.T: Array = np.asarray(np.linalg.inv(self.at(shape.nodes)))
        # partition of unity with equal integrals
        self.mean: Array = np.full(len(self.rank), 1.0 / len(self.rank))

    @cached_property
    def products(self) -> Array:
        """Means over the reference facet of products with the shape functions ``(nn, nn)``."""
        xi, weights = forms.quadrature_rule(self.shape.cell, 2 * self.shape.degree)
        return np.asarray(self.at(xi).T @ (weights[:, None] * self.shape.functions(xi)) / weights.sum())

    def at(self, xi: Array) -> Array:
        """Values at ``xi (q, fdim)``: ``(q, nn)``."""
        if self.shape.degree == 1:
            return self.shape.functions(xi)
        if self.shape.cell == "quadrilateral":
            order = np.rint(2 * self.shape.nodes).astype(int)
            one = [comb(2, k) * xi**k * (1 - xi) ** (2 - k) for k in range(3)]
            return np.stack([one[i][:, 0] * one[j][:, 1] for i, j in order], axis=1)
        nodes, b = _barycentric(self.shape.nodes), _barycentric(xi)
        order = np.rint(2 * nodes).astype(int)
        return np.stack([2 / np.prod([factorial(k) for k in e]) * np.prod(b**e, axis=1) for e in order], axis=1)


def _barycentric(xi: Array) -> Array:
    return np.column_stack([1 - xi.sum(axis=1), xi])


@cache
def basis_of(shape: FacetShape) -> Basis:
    """The basis of a facet shape, made once."""
    return Basis(shape)


@dataclass(frozen=True)
class Covered:
    """Integrals over the covered parts of ``m`` facets in ``k`` pairs."""

    facet: Ints  # of each pair ``(k,)``, ascending
    D: Array  # integrals of the functions ``(m, nn)``
    M: Array  # of their products ``(m, nn, nn)``
    G: Array  # of their products with the gap minus the offset ``(m, nn)``
    N: Array  # of their products with the target's shape functions, pair by pair ``(k, nn, nt)``
    own: Array  # of their products with each other and with the gap, pair by pair ``(k, nn, nn + 1)``
    full: Array  # of the functions over the whole facets ``(m, nn)``

    @classmethod
    def of(cls, segments: Segments, b: Array, N: Array, facet: Ints, full: Array, offset: Array | None = None) -> Covered:
        """Integrate.

        Args:
            segments: of the pairs.
            b: functions of the contactor's basis at their points ``(q, nn)``.
            N: the target's shape functions there ``(q, nt)``.
            facet: contactor facet of each pair ``(k,)``.
            full: of the functions b over the whole facets ``(m, nn)``.
            offset: of the gap at the points ``(q,)``; None without offset.
        """
        s, k, (m, nn) = segments, len(facet), full.shape
        weighted = s.weight[:, None] * b
        own = add_up(s.pair, products(weighted, np.column_stack([b, s.gap])), k)
        M, G = np.split(add_up(facet, own, m).reshape(m, nn, nn + 1), [nn], axis=2)
        if offset is not None:
            G = G - add_up(facet[s.pair], weighted * offset[:, None], m)[:, :, None]
        D = add_up(facet[s.pair], weighted, m)
        pairs = add_up(s.pair, products(weighted, N), k).reshape(k, nn, N.shape[1])
        return cls(facet, D, M, G[:, :, 0], pairs, own.reshape(k, nn, nn + 1), full)


def add_up(place: Ints, values: Array, n: int) -> Array:
    """Sums of rows of ``values (q, c)`` with equal ``place (q,)``, which is ascending: ``(n, c)``."""
    out = np.zeros((n, values.shape[1]))
    if len(place):
        first = np.flatnonzero(np.diff(place, prepend=-1))
        out[place[first]] = sums_of_groups(values, first)
    return out


def products(left: Array, right: Array) -> Array:
    """Products of all columns of ``left (q, a)`` with all columns of ``right (q, b)``: ``(q, a b)``."""
    return (left[:, :, None] * right[:, None, :]).reshape(len(left), left.shape[1] * right.shape[1])


@dataclass(frozen=True)
class Duals:
    """Dual functions of ``m`` facets."""

    A: Array  # combinations of the functions b ``(m, nn, nn)``
    C: Array  # their integrals with the functions b ``(m, nn, nn)``
    kept: Bools  # nodes whose share is sufficiently covered for a dual function of their own ``(m, nn)``
    own: Bools  # nodes with such a function, except the foremost ``(m, nn)``
    foremost: Ints  # node whose dual function completes the sum to one ``(m,)``
    inverse: Array  # of the integrals of the functions' products; zero on facets without functions of their own ``(m, nn, nn)``
    gap: Array  # coefficients of the gap's projection onto the functions b ``(m, nn)``

    def spread(self, facet: Ints, b: Array, multipliers: Array) -> tuple[Array, Array]:
        """Derivative of ``sum l_j int psi_j f`` by the covered part at points of the facets: factors of f and of its projection.

        Args:
            facet: facets of the points ``(q,)``.
            b: functions there ``(q, nn)``.
            multipliers: l, of the facets' nodes ``(m, nn, c)``.

        Returns:
            Factors of f there ``(q, c)``, and of the coefficients of its projection onto the functions b ``(q, nn, c)``.
        """
        fore = multipliers[np.arange(len(multipliers)), self.foremost]
        more = np.where(self.own[:, :, None], multipliers - fore[:, None], 0.0)
        here = np.einsum("qb,qbc->qc", b, (self.A.transpose(0, 2, 1) @ more)[facet])
        return fore[facet] + here, b[:, :, None] * (more[facet] - here[:, None])

    def added(self, facet: Ints, values: Array) -> Array:
        """Sums ``(q, nn, ...)`` of ``values`` for the functions b of facets ``(q,)`` with those that are added to the foremost one."""
        own = self.own[facet].reshape(*values.shape[:2], *(1,) * (values.ndim - 2))
        out = np.where(own, values, 0.0)
        out[np.arange(len(facet)), self.foremost[facet]] += np.where(own, 0.0, values).sum(axis=1)
        return out

    def at_end(self, facet: Ints, b: Array, gap: Array) -> Array:
        """Derivative of weighted gaps by the covered part, at points of its boundary.

        The derivative of ``psi`` counts too: ``d int psi_j g = (b_j G_j + psi_j (g - sum_k b_k G_k)) ds`` with the gap's projection G.

        Args:
            facet: facets of the points ``(q,)``.
            b: functions there ``(q, nn)``.
            gap: gap there ``(q,)``.

        Returns:
            Derivatives for the nodes of each facet ``(q, nn)``.
        """
        mean = self.gap[facet]
        psi = np.einsum("qjb,qb->qj", self.A[facet], b)
        grown = b * mean + psi * (gap - np.einsum("qb,qb->q", b, mean))[:, None]
        grown = np.where(self.own[facet], grown, 0.0)
        grown[np.arange(len(b)), self.foremost[facet]] += gap - grown.sum(axis=1)
        return grown


def dual_functions(covered: Covered, precedence: Array, before: Bools) -> Duals:
    """Dual functions of facets.

    Args:
        covered: integrals over the facets.
        precedence: of the facets' nodes ``(m, nn)``; hardly covered functions are added to the foremost node of the facet.
        before: nodes that had a dual function of their own before ``(m, nn)``.
    """
    m, nn = covered.D.shape
    kept: Bools = np.where(before, STILL_COVERED, HARDLY_COVERED) * covered.full <= covered.D
    row, foremost = np.arange(m), np.argmax(precedence, axis=1)
    # if all nodes including the foremost are hardly covered, no dual function can be distinguished
    own = kept & (np.arange(nn) != foremost[:, None])
    A, inverse = np.zeros((2, m, nn, nn))
    some = np.flatnonzero(own.any(axis=1))
    if len(some):
        size = covered.D[some].sum(axis=1)
        # dropped functions enter only through the sum
        inverse[some] = np.linalg.pinv(covered.M[some] / size[:, None, None], hermitian=True) / size[:, None, None]
        A[some] = covered.D[some][:, :, None] * inverse[some] * own[some][:, :, None]
    A[row, foremost] = 1.0 - A.sum(axis=1)
    C, j = np.zeros((m, nn, nn)), np.arange(nn)
    C[:, j, j] = np.where(own, covered.D, 0.0)
    C[row, foremost] = np.where(own, 0.0, covered.D)
    A[covered.D.sum(axis=1) <= 0.0] = 0.0
    return Duals(A, C, kept & (covered.D > 0.0), own, foremost, inverse, np.einsum("mij,mj->mi", inverse, covered.G))
