"""Nodes that equations of users give one displacement, up to a jump, such as both sides of the seam of a periodic body."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uem_dolfinx.algebra.equations import NEGLIGIBLE
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.conditions.equation import GivenRows, LinearEquations
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Nodes


class Seams:
    """Groups of nodes with one displacement, equal on all ranks (collective).

    Args:
        space: the nodes.
        given: equations of this rank, several lists.

    Attributes:
        given: the same.
        node: global nodes ``(k,)``, ascending.
        group: number of the group of each ``(k,)``.
        others: row and global node of each term of this rank's equations that are not of such a group, list by list.
    """

    def __init__(self, space: Nodes, given: Sequence[GivenRows]):
        from scipy.sparse import coo_matrix
        from scipy.sparse.csgraph import connected_components

        self.given, equations = given, [_of_something(one.row, one.node, one.coefficients) for one in given]
        found = [_differences(*one) for one in equations]
        every = np.unique(np.concatenate(space.comm.allgather(np.concatenate([np.zeros((0, 3), np.int64), *found]))), axis=0)
        pairs, count = np.unique(every[:, :2], axis=0, return_counts=True)
        pairs = pairs[count == space.block]
        self.node, at = np.unique(pairs, return_inverse=True)
        start, end = at.reshape(pairs.shape).T
        n = len(self.node)
        self.group = connected_components(coo_matrix((np.ones(len(start)), (start, end)), (n, n)), directed=False)[1].astype(int)
        self.others = [self._others(row, node) for row, node, _ in equations]

    def _others(self, row: Ints, node: Ints) -> tuple[Ints, Ints]:
        """Terms of the equations that are not between two nodes of one group."""
        group, m = groups_of(node, self.node, self.group), int(row.max(initial=-1)) + 1
        lowest = np.full(m, len(self.node))
        np.minimum.at(lowest, row, group)
        alike = (lowest >= 0) & (np.bincount(row, group != lowest[row], m) == 0)
        return row[~alike[row]], node[~alike[row]]


def note_seams(config: Configuration, equations: Sequence[LinearEquations], contacts: Sequence[Any]) -> None:
    """Set the configuration's ``seams`` if there are equations of users and contacts, before these are made (collective)."""
    if equations and contacts:
        config.seams = Seams(config, [one.rows(config, f"equations[{i}]") for i, one in enumerate(equations)])


def groups_of(nodes: Ints, known: Ints, group: Ints) -> Ints:
    """Groups of global nodes ``(...)`` among the ``known (k,)``, ascending, with their ``group (k,)``; -1 for others."""
    if not len(known):
        return np.full(nodes.shape, -1, dtype=np.int64)
    place = np.minimum(np.searchsorted(known, nodes), len(known) - 1)
    return np.where(known[place] == nodes, group[place], -1)


def _of_something(row: Ints, node: Ints, coefficients: Array) -> tuple[Ints, Ints, Array]:
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
