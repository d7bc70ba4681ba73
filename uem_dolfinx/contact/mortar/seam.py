"""Contactors that equations of users give one displacement: one basis function lies on both sides of a seam."""

from __future__ import annotations

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.conditions.seams import Seams, groups_of
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import reduced


class Seam:
    """Contactors of one contact with one displacement: each has the row of the facets around all of them, and a part of its force.

    Args:
        space: nodes of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        seams: equations that make seams, or None.

    Attributes:
        sharing: number of contactors with the row of each ``(n,)``.
    """

    def __init__(self, space: Nodes, nodes: Indices, seams: Seams | None):
        node, group = (np.zeros(0, np.int64),) * 2 if seams is None else seams.groups(space, nodes)
        own = np.isin(node, space.to_global(nodes))
        kept = reduced(space.comm, own) > 0 if seams is not None else own
        kept[kept] = (np.bincount(group[kept]) > 1)[group[kept]]
        self._comm, self._n_owned, self._node = space.comm, space.n_owned, node[kept]
        _, self._group = np.unique(group[kept], return_inverse=True)
        #: Whether there are any.
        self.any = bool(kept.any())
        size = np.bincount(self._group)
        order = np.argsort(self._group, kind="stable")
        #: Contactors of each group, -1 for none.
        self._members = np.full((len(size), int(size.max(initial=0))), -1, dtype=np.int64)
        self._members[self._group[order], np.arange(len(order)) - np.repeat(np.cumsum(size) - size, size)] = self._node[order]
        local = groups_of(space.to_global(np.arange(space.n_local)), self._node, self._group)
        self._local = np.flatnonzero(local >= 0)
        self._of_local = local[self._local]
        self._owned = int(np.searchsorted(self._local, space.n_owned))
        sharing = np.ones(space.n_owned)
        sharing[self._local[: self._owned]] = size[self._of_local[: self._owned]]
        self.sharing: Array = sharing[nodes]

    def sums(self, values: Array) -> Array:
        """Values at owned or local nodes ``(n_owned, ...)`` or ``(n_local, ...)``, with the sum of each group at all of it (collective)."""
        if not self.any:
            return values
        sums = np.zeros((len(self._members), *values.shape[1:]))
        np.add.at(sums, self._of_local[: self._owned], values[self._local[: self._owned]])
        sums, some, out = reduced(self._comm, sums), self._local < len(values), values.copy()
        out[self._local[some]] = sums[self._of_local[some]]
        return out

    def evenly(self, nodes: Indices, values: Array) -> Array:
        """Values of owned contactors ``(n,)``, with the mean of each group at all of it (collective)."""
        nodal = np.zeros(self._n_owned)
        nodal[nodes] = values
        return np.asarray(self.sums(nodal)[nodes] / self.sharing)

    def apart(self, nodes: Indices, own: Array, values: Array) -> Array:
        """Terms ``own . v`` of all of a group, less those of its sum times the contactor's own values: 0 for equal ones (collective).

        Args:
            nodes: owned contactors ``(n,)``.
            own: each contactor's part of the coefficients of its group ``(n, k)``.
            values: of the owned nodes ``(n_owned, k)``.

        Returns:
            Component by component ``(n, k)``.
        """
        parts = np.zeros((len(values), 2 * own.shape[1]))
        parts[nodes] = np.concatenate([own, own * values[nodes]], axis=1)
        coefficients, terms = np.split(self.sums(parts)[nodes], 2, axis=1)
        return np.asarray(terms - coefficients * values[nodes])

    def same(self, nodes: Ints) -> Bools:
        """Whether two global nodes of a facet ``(m, nn)`` are one contactor, or of one group ``(m, nn, nn)``."""
        group = groups_of(nodes, self._node, self._group)
        number = np.where(group < 0, nodes, -1 - group)
        return np.asarray(number[:, :, None] == number[:, None])

    def rows(self, row: Ints, term: Ints, value: Array) -> tuple[Ints, Ints, Array]:
        """Terms of the rows of global nodes, those of a group for each of it; its rows follow none of it but their own node."""
        if not self.any:
            return row, term, value
        of_row, of_term = (groups_of(nodes, self._node, self._group) for nodes in (row, term))
        one, many = np.flatnonzero(of_row < 0), np.flatnonzero(of_row >= 0)
        i, j = np.nonzero(self._members[of_row[many]] >= 0)
        many = many[i]
        to = self._members[of_row[many], j]
        terms = np.where(of_term[many] == of_row[many], to, term[many])
        return np.concatenate([row[one], to]), np.concatenate([term[one], terms]), np.concatenate([value[one], value[many]])
