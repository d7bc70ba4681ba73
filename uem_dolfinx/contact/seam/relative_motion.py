"""Motion of contactors relative to the nodes that they follow, in free and in prescribed components."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED
from uem_dolfinx.arrays import Array, Bools, Indices, Ints, sums_of_rows
from uem_dolfinx.geometry.configuration import Configuration

#: Where more than this part of what a prescribed contactor follows in a mean is prescribed as well, as on a plane of symmetry, this part
#: counts alone: integrals over one side of the plane have parts of the nodes next to it. Halves are on the safe side of rounding.
#: [convention; part of the weights; test_ties.py::test_what_is_held_tells]
MOST_HELD = 0.5 + 1e-6


@dataclass(frozen=True)
class Ties:
    """Weights by which contactors follow other nodes, and the free components of their relative motion."""

    config: Configuration
    nodes: Indices  # owned contactors ``(n,)``
    row: Ints  # index of the contactor of each term ``(k,)``
    followed: Ints  # global node of each term ``(k,)``
    weight: Array  # weight of this node ``(k,)``
    moves: Bools  # components of the relative motion not prescribed by Dirichlet conditions ``(n, gdim)``
    held: Array | None  # weights for the prescribed components ``(k, gdim)``; None if equal to ``weight``
    share: Array  # friction over the multipliers of tangential equations ``(n,)``

    @classmethod
    def of(
        cls,
        config: Configuration,
        nodes: Indices,
        terms: tuple[Ints, Ints, Array],
        free: Bools | None,
        at_feet: bool,
        share: Array | None = None,
    ) -> Ties:
        """Ties with the weights ``terms`` (collective).

        Args:
            config: configuration of the displacement.
            nodes: owned contactors ``(n,)``.
            terms: ``row``, ``followed`` and ``weight``.
            free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``; None if all contactors are free.
            at_feet: whether weights belong to points, not to means.
            share: friction over the multipliers of tangential equations ``(n,)``; None for 1.
        """
        row, followed, weight = terms
        share = np.ones(len(nodes)) if share is None else share
        if free is None:
            return cls(config, nodes, row, followed, weight, np.ones((len(nodes), config.gdim), dtype=bool), None, share)
        theirs = config.ask_owners(followed, free.astype(float))
        size = np.abs(weight)[:, None]
        of_free, of_held = (sums_of_rows(row, size * part, len(nodes)) for part in (theirs, 1.0 - theirs))
        others = of_free > MOSTLY_PRESCRIBED
        if at_feet:
            return cls(config, nodes, row, followed, weight, free[nodes] | others, None, share)
        moves = free[nodes] | (others & (of_held <= MOST_HELD * (of_held + of_free)))
        part, whole = (sums_of_rows(row, weight[:, None] * w, len(nodes)) for w in (1.0 - theirs, np.ones_like(theirs)))
        ratio = np.where(moves | (part == 0.0), 1.0, whole / np.where(part == 0.0, 1.0, part))
        return cls(config, nodes, row, followed, weight, moves, (weight[:, None] * (1.0 - theirs)) * ratio[row], share)

    def relative(self, du: Array) -> Array:
        """Relative motion of contactors in an increment ``(n_owned, gdim)``: ``(n, gdim)`` (collective)."""
        theirs, n = self.config.ask_owners(self.followed, du), len(self.nodes)
        way = du[self.nodes] - sums_of_rows(self.row, self.weight[:, None] * theirs, n)
        if self.held is None:
            return np.asarray(way)
        return np.where(self.moves, way, du[self.nodes] - sums_of_rows(self.row, self.held * theirs, n))

    def table(self, which: Ints) -> tuple[Ints, Array]:
        """Nodes in the relative motion of contactors ``which (k,)``, global numbers or -1, and their weights ``(k, m)``."""
        order = np.argsort(self.row, kind="stable")
        row = self.row[order]
        first = np.searchsorted(row, np.arange(len(self.nodes)))
        column = np.arange(len(row)) - first[row]
        nodes = np.full((len(self.nodes), int(column.max(initial=-1)) + 2), -1, dtype=np.int64)
        share = np.zeros(nodes.shape)
        nodes[:, 0], share[:, 0] = self.config.to_global(self.nodes), 1.0
        nodes[row, column + 1], share[row, column + 1] = self.followed[order], -self.weight[order]
        return nodes[which], share[which]

    def tables(self, way: Ties, which: Ints) -> tuple[Ints, Array, Array]:
        """``table`` with the weights ``way`` of another relative motion: nodes, own weights and other weights ``(k, m)``."""
        nodes, share = self.table(which)
        if way is self:
            return nodes, share, share
        more, other = way.table(which)
        return (
            np.concatenate([nodes, more], axis=1),
            np.concatenate([share, np.zeros_like(other)], axis=1),
            np.concatenate([np.zeros_like(share), other], axis=1),
        )

    def handed_on(self, tau: Array) -> tuple[Ints, Array]:
        """Global nodes ``(k,)`` and forces ``(k, gdim)`` on both bodies from tangential multipliers ``tau (n, gdim)``."""
        nodes = np.concatenate([self.config.to_global(self.nodes), self.followed])
        return nodes, np.concatenate([tau, -self.weight[:, None] * tau[self.row]])


class Terms(NamedTuple):
    """Terms of linear functions of the unknowns, one function per contactor."""

    row: Ints  # index of the contactor ``(k,)``
    node: Ints  # global row of vectors ``(k,)``
    vector: Array  # coefficients of the components there ``(k, gdim)``


def dyads(scale: Array, left: Terms, right: Terms) -> tuple[Ints, Array]:
    """``sum_i scale_i v_i w_i'`` of linear functions v and w of contactors.

    Returns global rows ``(k, m)``, -1 for no row, and blocks ``(k, m gdim, m gdim)``.
    """
    rows, which, v, w = grouped(scale, left, right)
    return rows, scale[which, None, None] * v[:, :, None] * w[:, None, :]


def grouped(scale: Array, left: Terms, right: Terms) -> tuple[Ints, Ints, Array, Array]:
    """Global rows of the contactors with a ``scale (n,)`` other than 0 ``(k, m)``, their indices, and v and w there ``(k, m gdim)``."""
    sides = (left,) if right is left else (left, right)
    row, node, vectors = (np.concatenate(parts) for parts in zip(*sides))
    some = np.flatnonzero(scale[row] != 0.0)
    # group the terms of each contactor
    order = some[np.argsort(row[some], kind="stable")]
    which, first, i = np.unique(row[order], return_index=True, return_inverse=True)
    place = np.arange(len(order)) - first[i]
    rows = np.full((len(which), int(place.max(initial=-1)) + 1), -1, dtype=np.int64)
    rows[i, place] = node[order]
    of_left, g = order < len(left.row), vectors.shape[1]
    both = np.zeros((2, *rows.shape, g))
    both[0, i, place], both[1, i, place] = (vectors[order] * own[:, None] for own in (of_left, of_left == (right is left)))
    v, w = both.reshape(2, len(which), rows.shape[1] * g)
    return rows, which, v, w
