"""Nodes that have one displacement, up to a jump, by equations of users, such as both sides of the seam of a periodic body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from uem_dolfinx.algebra.equations import NEGLIGIBLE
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.conditions.equation import GivenRows


class Seams:
    """Equations of users by which two nodes have one displacement, up to a jump; from several lists that were given on this rank."""

    def __init__(self, given: Sequence[GivenRows]):
        self.given = given
        self._terms = [_nonzero(one.row, one.node, one.coefficients) for one in given]
        self._differences = np.concatenate([np.zeros((0, 3), np.int64), *(_differences(*terms) for terms in self._terms)])

    def groups(self, space: Nodes, nodes: Indices) -> tuple[Ints, Ints]:
        """Global nodes ``(k,)``, ascending, with one displacement as one of these, and their groups, the same on all ranks (collective)."""
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        here, before, ends = np.zeros((space.n_owned, 1)), -1, self._differences[:, :2]
        here[nodes] = 1.0
        # groups may contain nodes that are not contactors
        while (marked := int(reduced(space.comm, int(here.sum())))) > before:
            some = space.ask_owners(ends.ravel(), here).reshape(-1, 2).any(axis=1)
            reached = space.add_at_owners(ends[some].ravel(), np.ones((2 * some.sum(), 1)))
            here, before = np.sign(here + reached), marked
        every = np.unique(np.concatenate(space.comm.allgather(self._differences[some])), axis=0)
        pairs, count = np.unique(every[:, :2], axis=0, return_counts=True)
        node, at = np.unique(pairs[count == space.block], return_inverse=True)
        start, end = at.reshape(-1, 2).T
        graph = coo_matrix((np.ones(len(start)), (start, end)), (len(node), len(node)))
        return node, connected_components(graph, directed=False)[1].astype(int)

    def others(self, known: Ints, group: Ints) -> list[tuple[Ints, Ints]]:
        """Row and global node of the terms of equations that have nodes of other groups, by lists; arguments as from ``groups``."""
        found = []
        for row, node, _ in self._terms:
            own, lowest = groups_of(node, known, group), np.full(int(row.max(initial=-1)) + 1, len(known))
            np.minimum.at(lowest, row, own)
            within = (lowest >= 0) & (np.bincount(row, own != lowest[row], len(lowest)) == 0)
            found.append((row[~within[row]], node[~within[row]]))
        return found


class Seam:
    """Contactors of one contact with one displacement: each has the row of the facets around all of them, and a part of its force.

    Args:
        space: nodes of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        seams: equations that make seams, or None.
    """

    def __init__(self, space: Nodes, nodes: Indices, seams: Seams | None):
        node, group = (np.zeros(0, np.int64),) * 2 if seams is None else seams.groups(space, nodes)
        own = np.isin(node, space.to_global(nodes))
        kept = reduced(space.comm, own) > 0 if seams is not None else own
        kept[kept] = (np.bincount(group[kept]) > 1)[group[kept]]
        self._comm, self._n_owned, self._node = space.comm, space.n_owned, node[kept]
        _, self._group = np.unique(group[kept], return_inverse=True)
        self.any = bool(kept.any())  # whether there are any
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
        self.sharing: Array = sharing[nodes]  # number of contactors with the row of each ``(n,)``

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


def seams_of(config: Configuration) -> Seams | None:
    """The equations of users with a configuration, or None without any (first time: collective)."""
    if config.seams is None and config.equations:
        from uem_dolfinx.conditions.equation import rows_of

        config.seams = Seams(rows_of(config, config.equations))
    return config.seams


def groups_of(nodes: Ints, known: Ints, group: Ints) -> Ints:
    """Groups of global nodes ``(...)`` among the ``known (k,)``, ascending, with their ``group (k,)``; -1 for others."""
    if not len(known):
        return np.full(nodes.shape, -1, dtype=np.int64)
    place = np.minimum(np.searchsorted(known, nodes), len(known) - 1)
    return np.where(known[place] == nodes, group[place], -1)


def _nonzero(row: Ints, node: Ints, coefficients: Array) -> tuple[Ints, Ints, Array]:
    """The terms without those whose coefficients are zero."""
    some = np.abs(coefficients).max(axis=1, initial=0.0) > NEGLIGIBLE
    return row[some], node[some], coefficients[some]


def _differences(row: Ints, node: Ints, coefficients: Array) -> Ints:
    """Nodes, the lower first, and component of equations between equal components of two nodes ``(k, 3)``."""
    size, order = np.abs(coefficients), np.argsort(row, kind="stable")
    two = order[(np.bincount(row) == 2)[row[order]]].reshape(-1, 2)
    c, component = coefficients[two], size[two[:, 0]].argmax(axis=1) if len(two) else np.zeros(0, np.int64)
    largest = size[two[:, 0], component][:, None]
    single = (size[two[:, 0]] > NEGLIGIBLE * largest).sum(axis=1) == 1
    two, component = (part[single & (np.abs(c.sum(axis=1)) <= NEGLIGIBLE * largest).all(axis=1)] for part in (two, component))
    return np.column_stack([np.sort(node[two], axis=1), component])
