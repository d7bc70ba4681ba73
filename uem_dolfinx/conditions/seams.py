"""Nodes that have one displacement, up to a jump, by equations of users, such as both sides of the seam of a periodic body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from uem_dolfinx.algebra.equations import NEGLIGIBLE
from uem_dolfinx.arrays import Array, Indices, Ints
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
