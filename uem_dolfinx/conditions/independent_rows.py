"""Eliminated components of linear equations, components that rigid sets keep, and redundant equations: algebra of distributed rows.

With the equations ``A u = b`` of all ranks and one component p of each, with columns ``A_p``, the independent rows are

    R = T A,    R u = T b,    R_p = 1

Most equations have a component that no other equation has. It is eliminated directly: T divides by its coefficient. Other equations, e.g.
at the edges of cells that are periodic in several directions, are solved together by elimination, on every rank.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.conditions.equation import GivenRows
from uem_dolfinx.conditions.places import COINCIDENT, NEAR
from uem_dolfinx.conditions.rigid_set import Placement, RigidSets
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Halo
from uem_dolfinx.parallel import gathered, reduced


@dataclass(frozen=True)
class Solved:
    """Independent rows whose eliminated nodes this rank owns."""

    pivot: Ints  # eliminated component, as ``global node * gdim + component`` ``(m,)``
    row: Ints  # the row of each entry of R except the pivots ``(k,)``
    column: Ints  # component of each entry, numbered as ``pivot`` ``(k,)``
    entry: Array  # of R ``(k,)``
    weight_row: Ints  # the row of each entry of T ``(l,)``
    weight_value: Ints  # number of the value b that it multiplies ``(l,)``
    weight: Array  # of T ``(l,)``


def sizes(config: Configuration, rows: GivenRows, free: Bools) -> Array:
    """Sizes of coefficients of ``free (n_owned, gdim)`` components, relative to the largest in their row ``(k, gdim)`` (collective)."""
    largest = np.zeros(len(rows))
    np.maximum.at(largest, rows.row, np.abs(rows.coefficients).max(axis=1, initial=0.0))
    movable = config.ask_owners(rows.node, free.astype(float)) > 0
    size = np.where(movable, np.abs(rows.coefficients) / np.where(largest > 0, largest, 1.0)[rows.row, None], 0.0)
    return np.where(size > MOSTLY_PRESCRIBED, size, 0.0)


def singles(config: Configuration, rows: GivenRows, size: Array, spared: Bools) -> Ints:
    """Components that occur in one remaining row only, ``term * gdim + component (m,)``, or -1 (collective).

    Args:
        config: configuration of the displacement.
        rows: of this rank.
        size: as returned by ``sizes``; rows of zeros are ignored.
        spared: mask of terms of nodes that are eliminated only if no other node can be ``(k,)``.
    """
    g, counted = config.block, (size > 0).astype(float)
    counts, halo = config.add_at_owners(rows.node, counted), Halo(config, rows.node)
    chosen = np.full(len(rows), -1)
    row = np.repeat(rows.row, g)
    for allowed in (~spared, np.ones_like(spared)):
        while True:
            single = (halo.take(counts.__getitem__) == 1.0) & allowed[:, None] & (chosen < 0)[rows.row, None]
            value = np.where(single, size, 0.0).ravel()
            order = np.lexsort((-value, row))
            first = order[np.unique(row[order], return_index=True)[1]]
            first = first[value[first] > 0.0]
            chosen[row[first]] = first
            done = np.zeros(len(rows), dtype=bool)
            done[row[first]] = True
            terms = done[rows.row]
            counts = counts - config.add_at_owners(rows.node[terms], counted[terms])
            if not reduced(config.comm, len(first)):
                break
    return chosen


def divided(rows: GivenRows, chosen: Ints) -> Solved:
    """Rows that each eliminate a component that no other row has; their nodes may belong to any rank."""
    m, g = len(rows), rows.coefficients.shape[1]
    column = (rows.node[:, None] * g + np.arange(g)).ravel()
    scale = rows.coefficients.ravel()[chosen]
    row, entry = np.repeat(rows.row, g), rows.coefficients.ravel() / np.repeat(scale[rows.row], g)
    others = (entry != 0.0) & (np.arange(len(entry)) != chosen[row])
    return Solved(column[chosen], row[others], column[others], entry[others], np.arange(m), rows.value, 1.0 / scale)


def eliminated(config: Configuration, rows: GivenRows, item: Ints, size: Array, spared: Bools) -> tuple[Solved, Bools]:
    """Rows that share all of their components, solved in the order of their declaration and position (collective).

    Args:
        config: configuration of the displacement.
        rows: of this rank.
        item: number of the declaration of each ``(m,)``.
        size: as returned by ``sizes``.
        spared: as in ``singles``.

    Returns:
        The independent rows whose nodes this rank owns, and the mask of given rows that follow from earlier ones ``(m,)``.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    comm, g = config.comm, config.block
    first = np.searchsorted(rows.row, np.arange(len(rows)))
    known = config.ask_owners(rows.node[first], config.X[: config.n_owned])
    mine = rows.value, item, known, np.bincount(rows.row, minlength=len(rows)), rows.node, rows.coefficients, size > 0, spared
    parts = comm.allgather(mine)
    value, declared, x, count, node, c, movable, last = (np.concatenate(arrays) for arrays in zip(*parts))
    places = np.round(x / (COINCIDENT * config.size))
    order = np.lexsort([value, *places.T[::-1], declared])
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    row = np.repeat(rank, count)
    columns, at = np.unique((node[:, None] * g + np.arange(g)).ravel(), return_inverse=True)
    A = coo_matrix((c.ravel(), (np.repeat(row, g), at)), shape=(len(order), len(columns))).tocsr()
    free, spare = np.zeros((2, len(columns)), dtype=bool)
    free[at[movable.ravel()]] = True
    spare[at] = np.repeat(last, g)
    links = A[:, free]
    n_groups, label = connected_components(links @ links.T, directed=False)
    dependent = np.ones(len(order), dtype=bool)
    made = []
    for k in range(n_groups):
        which = np.flatnonzero(label == k)
        own = np.unique(A[which].indices)
        R, T, pivot = _gauss_jordan(A[which][:, own].toarray(), free[own], spare[own])
        kept = pivot >= 0
        dependent[which[kept]] = False
        made.append((columns[own[pivot[kept]]], R[kept], columns[own], T[kept], value[order][which]))
    start = sum(len(part[0]) for part in parts[: comm.rank])
    return _owned(config, made), dependent[rank[start : start + len(rows)]]


def _gauss_jordan(A: Array, free: Bools, spare: Bools) -> tuple[Array, Array, Ints]:
    """R, T and each row's column, with ``R = T A`` and a column of the identity; the column is -1 for rows that follow from others."""
    m = len(A)
    R, T, pivot = A.copy(), np.eye(m), np.full(m, -1)
    scale = np.abs(A).max(axis=1)
    for i in range(m):
        size = np.abs(R[i]) * free
        if size.max() <= MOSTLY_PRESCRIBED * scale[i]:
            continue
        good = (size > MOSTLY_PRESCRIBED * size.max()) & ~spare
        p = pivot[i] = int(np.argmax(np.where(good, size, 0.0) if good.any() else size))
        T[i], R[i] = T[i] / R[i, p], R[i] / R[i, p]
        factor = R[:, p].copy()
        factor[i] = 0.0
        R -= factor[:, None] * R[i]
        T -= factor[:, None] * T[i]
        R[:, p] = 0.0
        R[i, p] = 1.0
    return R, T, pivot


def _owned(config: Configuration, made: list[tuple[Ints, Array, Ints, Array, Ints]]) -> Solved:
    """Rows of solved groups whose pivots are at nodes that this rank owns."""
    none, numbers = np.zeros(0), np.zeros(0, dtype=np.int64)
    lists: list[list[Any]] = [[numbers], [numbers], [numbers], [none], [numbers], [numbers], [none]]
    count = 0
    for pivot, R, columns, T, values in made:
        own = config.owner_of(pivot // config.block) == config.comm.rank
        pivot, R, T = pivot[own], R[own], T[own]
        R = np.where(columns == pivot[:, None], 0.0, R)
        i, j = np.nonzero(np.abs(R) > np.finfo(float).eps)
        k, v = np.nonzero(T)
        for part, found in zip(lists, (pivot, i + count, columns[j], R[i, j], k + count, values[v], T[k, v])):
            part.append(found)
        count += len(pivot)
    return Solved(*(np.concatenate(part) for part in lists))


@dataclass(frozen=True)
class Basis:
    """Components q that sets keep, the same on all ranks."""

    node: Ints  # global nodes ``(k,)``
    component: Ints  # of each ``(k,)``
    part: Ints  # set of each ``(k,)``
    X: Array  # positions of the nodes in the reference configuration ``(k, gdim)``
    kept: Ints  # rows of C that are independent of those before them ``(n_kept,)``
    least: float  # smallest singular value of their rows and the rows of the prescribed motion, when they were chosen
    halo: Halo  # fetches values from the owners

    @cached_property
    def nodes(self) -> tuple[Ints, Ints]:
        """Distinct nodes, ascending, and the index of each component's node among them ``(k,)``."""
        nodes, which = np.unique(self.node, return_inverse=True)
        return nodes, which


def chosen(
    config: Configuration, s: RigidSets, names: Sequence[str], at: Sequence[Placement], C: Array, masks: tuple[Bools, Bools]
) -> Basis:
    """Components q that determine the motion together with C, each with the largest row orthogonal to the previous rows (collective).

    Args:
        config: configuration of the displacement.
        s: the sets.
        names: of their parts.
        at: their placements.
        C: scaled rows of length 1 ``(k, n_z)``.
        masks: free components of the nodes ``(n, gdim)``, and nodes that are preferably eliminated ``(n,)``.

    Raises:
        SurfaceError: if there are too few.
    """
    g, (free, avoided) = config.gdim, masks
    across, rest = s.velocities(at, s.X, s.part), C.copy()
    taken: list[Array] = []
    kept: list[int] = []
    for i in range(len(C)):
        if np.linalg.norm(rest[i]) > MOSTLY_PRESCRIBED:
            kept.append(i)
            across, rest = _without(across, rest[i]), _without(rest, rest[i])
    places = np.round(s.X / (COINCIDENT * config.size))
    numbers = config.to_global(s.nodes)
    for allowed in (~free, free & ~avoided[:, None], free):
        while len(taken) + len(kept) < across.shape[2]:
            size = np.where(allowed, np.linalg.norm(across, axis=2), 0.0)
            largest = float(reduced(config.comm, size.max(initial=0.0), op=MPI.MAX))
            if largest <= MOSTLY_PRESCRIBED:
                break
            # of equal candidates the first by position, on any number of ranks
            node, component = np.nonzero(size >= (1.0 - NEAR) * largest)
            order = np.lexsort([component, *places[node].T[::-1]])[:1]
            offer = np.full(2 * g + 3 + across.shape[2], np.inf)
            if len(order):
                i, j = node[order[0]], component[order[0]]
                offer = np.concatenate([places[i], [j, numbers[i], s.part[i]], s.X[i], across[i, j]])
            every = gathered(config.comm, offer)
            best = every[np.lexsort([*every[:, g::-1].T])[0]]
            taken.append(best[: 2 * g + 3])
            across = _without(across, best[2 * g + 3 :])
    if len(taken) + len(kept) < across.shape[2]:
        every_name = "', '".join(names)
        raise SurfaceError(
            f"the RigidCoupling of '{every_name}': its nodes do not determine its motion, given the prescribed "
            "components; give it more nodes, or leave out components of its motion"
        )
    table = np.array(taken).reshape(-1, 2 * g + 3)
    component, node, part = table[:, g : g + 3].astype(np.int64).T
    return Basis(node, component, part, table[:, g + 3 :], np.array(kept, dtype=np.int64), 0.0, Halo(config, node))


def _without(rows: Array, row: Array) -> Array:
    """Rows ``(..., n)`` without their components along another row."""
    q = row / np.linalg.norm(row)
    return rows - (rows @ q)[..., None] * q
