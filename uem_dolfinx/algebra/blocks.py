"""Sparse matrices as lists of nodal blocks, whose rows and columns are global numbers of nodes; SciPy multiplies them on each rank."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.entries import blocks_of
from uem_dolfinx.arrays import Array, Ints, sums_of_groups
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import Exchange


class Blocks(NamedTuple):
    """Blocks of a sparse matrix; blocks with the same row and column are summed.

    Attributes:
        row: global node of each block's components ``(k,)``.
        column: global node of the unknowns that they take ``(k,)``.
        value: ``(k, block, block)``.
    """

    row: Ints
    column: Ints
    value: Array

    def some(self, which: Any) -> Blocks:
        """The blocks selected by a mask or indices."""
        return Blocks(self.row[which], self.column[which], self.value[which])

    @property
    def transposed(self) -> Blocks:
        """The transpose."""
        return Blocks(self.column, self.row, self.value.transpose(0, 2, 1))


def together(*parts: Blocks) -> Blocks:
    """The sum of matrices, as a list."""
    return Blocks(*(np.concatenate(arrays) for arrays in zip(*parts)))


def product(A: Blocks, B: Blocks) -> Blocks:
    """``A B`` without duplicates, zeros stored; columns of A without a row in B count as zero."""
    from scipy.sparse import bsr_matrix

    g = A.value.shape[1]
    inner, of_inner = np.unique(B.row, return_inverse=True)
    at = inner.searchsorted(A.column)
    kept = np.append(inner, -1)[at] == A.column
    rows, of_row = np.unique(A.row[kept], return_inverse=True)
    columns, of_column = np.unique(B.column, return_inverse=True)
    if not len(rows):
        return Blocks(rows, rows, np.zeros((0, g, g)))
    # for blocks of single numbers SciPy drops zeros, so that the sparsity would depend on values
    wide = np.zeros((len(B.row), g, max(g, 2)))
    wide[:, :, :g] = B.value
    left = in_rows(of_row, at[kept], A.value[kept], len(rows))
    right = in_rows(of_inner, of_column, wide, len(inner))
    C = bsr_matrix(left, shape=(g * len(rows), g * len(inner))) @ bsr_matrix(
        right, shape=(g * len(inner), wide.shape[2] * len(columns))
    )
    return Blocks(np.repeat(rows, np.diff(C.indptr)), columns[C.indices], C.data[:, :, :g])


def in_rows(row: Ints, column: Ints, value: Array, n_rows: int) -> tuple[Array, Ints, Ints]:
    """Blocks in the order of their rows, their columns, and the start of each row."""
    order = row.argsort(kind="stable")
    starts = np.zeros(n_rows + 1, dtype=np.int64)
    np.bincount(row, minlength=n_rows).cumsum(out=starts[1:])
    return value[order], column[order], starts


def summed(A: Blocks) -> Blocks:
    """The same matrix without duplicates, sorted by row and column."""
    order = np.lexsort((A.column, A.row))
    row, column = A.row[order], A.column[order]
    new = np.ones(len(row), dtype=bool)
    new[1:] = (row[1:] != row[:-1]) | (column[1:] != column[:-1])
    first = new.nonzero()[0]
    return Blocks(row[first], column[first], sums_of_groups(A.value, first, order) if len(row) else A.value)


def to_owners(space: Nodes, A: Blocks) -> Blocks:
    """Blocks of all ranks in rows that this rank owns (collective)."""
    if space.comm.size == 1:
        return A
    return Blocks(*Exchange.to(space.comm, space.owner_of(A.row)).send(*A))


def places_of(A: Blocks, rows: Ints) -> tuple[Ints, Ints]:
    """Places of the blocks in ``rows (m,)``, possibly repeated, row after row, and their number in each ``(m,)``."""
    order = A.row.argsort(kind="stable")
    known = A.row[order]
    low = known.searchsorted(rows)
    counts = known.searchsorted(rows, "right") - low
    return order[np.repeat(low - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())], counts


def rows_at(space: Nodes, A: Blocks, nodes: Ints) -> Blocks:
    """Rows of A, stored on their owners, at distinct global ``nodes (m,)`` of any rank (collective)."""
    asking = Exchange.to(space.comm, space.owner_of(nodes))
    (asked,) = asking.send(nodes)
    places, counts = places_of(A, asked)
    ranks = np.repeat(asking.origins, counts)
    lists = np.split(places, np.searchsorted(ranks, np.arange(1, space.comm.size)))
    return Blocks(*Exchange(space.comm, lists).send(*A))


def blocks_of_matrix(space: Nodes, A: PETSc.Mat) -> Blocks:
    """The blocks in owned rows of a matrix whose nodes have the same columns in all components."""
    g = space.block
    indptr, columns, values = A.getValuesCSR()
    nodes = np.flatnonzero(np.diff(indptr)[::g])
    places, i, width = blocks_of(nodes, indptr, g)
    k = np.arange(g)
    value = values[places[:, None, None] + width[:, None, None] * k[:, None] + k]
    return Blocks(nodes[i] + space.first, columns[places].astype(np.int64) // g, value)
