"""Sparse matrices with arrays shared by NumPy and PETSc, or as lists of nodal blocks by global numbers, multiplied by SciPy."""

from __future__ import annotations

from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import compat
from uem_dolfinx.arrays import Array, Bools, Ints, sums_of_groups
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import Exchange, reduced


class Blocks(NamedTuple):
    """Blocks of a sparse matrix; blocks with the same row and column are summed."""

    row: Ints  # global node of each block's components ``(k,)``
    column: Ints  # global node of the unknowns that they take ``(k,)``
    value: Array  # ``(k, block, block)``

    def some(self, which: Any) -> Blocks:
        """The blocks selected by a mask or indices."""
        return Blocks(self.row[which], self.column[which], self.value[which])

    @property
    def transposed(self) -> Blocks:
        """The transpose."""
        return Blocks(self.column, self.row, self.value.transpose(0, 2, 1))


def together(*parts: Blocks) -> Blocks:
    """The sum of matrices, as a list."""
    return Blocks(*map(np.concatenate, zip(*parts)))


def product(*factors: Blocks) -> Blocks:
    """Product of matrices without duplicates, zeros stored; columns of a factor without a row in the next one count as zero."""
    from scipy.sparse import bsr_matrix

    *others, last = factors
    g = last.value.shape[1]
    rows, of_row = np.unique(last.row, return_inverse=True)
    columns, of_column = np.unique(last.column, return_inverse=True)
    # for blocks of single numbers SciPy drops zeros, so that the sparsity would depend on values
    wide = np.zeros((len(last.row), g, max(g, 2)))
    wide[:, :, :g] = last.value
    shape = g * len(rows), wide.shape[2] * len(columns)
    C: Any = bsr_matrix(in_rows(of_row, of_column, wide, len(rows)), shape=shape) if len(rows) else None
    for A in reversed(others):
        at = rows.searchsorted(A.column)
        kept = np.append(rows, -1)[at] == A.column
        inner, (rows, of_row) = len(rows), np.unique(A.row[kept], return_inverse=True)
        if not len(rows):
            return Blocks(rows, rows, np.zeros((0, g, g)))
        left = in_rows(of_row, at[kept], A.value[kept], len(rows))
        C = bsr_matrix(left, shape=(g * len(rows), g * inner)) @ C
    C.sort_indices()
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
    (received,) = asking.send(nodes)
    places, counts = places_of(A, received)
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


#: A matrix is symmetric if no entry differs from the one across by more than this part of the root of their diagonals' product.
#: [convention; entries; test_linear_solver.py::test_what_counts_as_symmetric]
SYMMETRIC = 1e-11


class Entries:
    """Entries of the owned rows of a square matrix, shared with PETSc.

    Entries in own columns come first, row by row; on several ranks entries in other ranks' columns follow, row ``i`` in line ``n + i``.

    Args:
        indptr: first entry of every line, and the number of entries ``(lines + 1,)``; lines are the n owned rows, or twice as many.
        columns: global numbers, sorted in every line ``(k,)``.
        values: of the entries ``(k,)``.
        mat: the matrix that has them; to be assembled after changes.
    """

    def __init__(self, indptr: Ints, columns: Ints, values: Array, mat: PETSc.Mat):
        self.indptr, self.columns, self.values, self.mat = indptr, columns, values, mat

    @staticmethod
    def of_arrays(indptr: Ints, columns: Ints, values: Array, like: PETSc.Mat) -> Entries:
        """A matrix of the layout and block size of ``like`` from its arrays (collective)."""
        sizes, (first, last) = like.getSizes(), like.getOwnershipRange()
        n = last - first
        arrays: Any = indptr, columns, values
        if len(indptr) > n + 1:
            k = indptr[n]
            inside, outside = (indptr[: n + 1], columns[:k] - first), (indptr[n:] - k, columns[k:].copy())
            arrays = (*inside, values[:k]), (*outside, values[k:])
        mat = PETSc.Mat().createAIJWithArrays(sizes, arrays, bsize=like.getBlockSize(), comm=like.comm)
        # multigrid looks for it, and petsc4py 3.18 forgets it
        mat.setBlockSize(like.getBlockSize())
        return Entries(indptr, columns, values, mat)

    @staticmethod
    def within(K: PETSc.Mat) -> Entries | None:
        """Views of a matrix' entries, valid as long as it exists; None on several ranks, or if PETSc gives no access."""
        arrays = compat.arrays_of(K) if K.comm.size == 1 else None
        return None if arrays is None else Entries(*arrays, K)

    @staticmethod
    def as_in(K: PETSc.Mat) -> Entries:
        """Zeros with the sparsity of ``K``."""
        if K.comm.size == 1:
            indptr, columns = K.getRowIJ()
            return Entries.of_arrays(indptr, columns, np.zeros(len(columns)), K)
        first, last = K.getOwnershipRange()
        indptr, columns, _ = K.getValuesCSR()
        inside, _ = K.getDiagonalBlock().getRowIJ()
        own = (columns >= first) & (columns < last)
        lines = np.append(inside, inside[-1] + (indptr - inside)[1:]).astype(indptr.dtype)
        return Entries.of_arrays(lines, np.append(columns[own], columns[~own]), np.zeros(len(columns)), K)

    def find(self, lines: Ints, columns: Ints) -> tuple[Ints, Bools]:
        """Positions of entries of these lines and columns, or of their insertion, and whether they exist, ``(m,)`` each."""
        low, high = self.indptr[lines], self.indptr[lines + 1]
        end = high
        # all lines are bisected at once
        while (low < high).any():
            middle = (low + high) // 2
            before = (low < high) & (self.columns[np.minimum(middle, len(self.columns) - 1)] < columns)
            low, high = np.where(before, middle + 1, low), np.where(before, high, np.minimum(middle, high))
        there = low < end
        there[there] = self.columns[low[there]] == columns[there]
        return low, there


def entries_of(which: Ints, starts: Ints) -> tuple[Ints, Ints]:
    """Positions of the entries of some lines, one line after the other, and the index in ``which (k,)`` of each entry's line.

    ``starts`` are the first entry of every line and the number of entries.
    """
    lengths = starts[which + 1] - starts[which]
    ends = np.cumsum(lengths, dtype=starts.dtype)
    places = np.arange(ends[-1] if len(ends) else 0, dtype=starts.dtype)
    return places + np.repeat(starts[which] - ends + lengths, lengths), np.repeat(
        np.arange(len(which), dtype=starts.dtype), lengths
    )


def blocks_of(lines: Ints, starts: Ints, g: int) -> tuple[Ints, Ints, Ints]:
    """Places where blocks of lines of nodes begin, which of ``lines (k,)`` each is in, and how many entries a line of it has.

    ``starts`` are the first entry of every line of components, g of them to a node, whose entries are in the same columns.
    """
    places, i = entries_of((g * lines).astype(starts.dtype), starts)
    width = starts[g * lines + 1] - starts[g * lines]
    return places[::g], i[::g], width[i[::g]]


def stiffen(A: PETSc.Mat, K: PETSc.Mat, idle: Bools) -> None:
    """Give A the diagonal of K at ``idle`` owned components ``(n_owned block,)`` (collective)."""
    diagonal = A.getDiagonal()
    diagonal.array[idle] = K.getDiagonal().array_r[idle]
    A.setDiagonal(diagonal)


def is_symmetric(A: PETSc.Mat, space: Nodes) -> bool:
    """Whether A, which acts on ``space``, is symmetric up to rounding (collective)."""
    return bool(reduced(A.comm.tompi4py(), rows_are_symmetric(A, space), op=MPI.LAND))


def rows_are_symmetric(A: PETSc.Mat, space: Nodes) -> bool:
    """Whether owned rows of A agree with its columns, compared by products with a random vector (collective).

    A acts on ``space``. The diagonal of other fields may be zero: it is then replaced by the row's largest entry over the root of the
    largest diagonal entry.
    """
    size = space.vector()
    one, other = size.duplicate(), size.duplicate()
    A.getDiagonal(size)
    root = np.sqrt(np.abs(size.array_r))
    if space.mixed:
        largest = float(np.sqrt(size.norm(PETSc.NormType.INFINITY))) or 1.0
        starts, _, values = A.getValuesCSR()
        # every line has a diagonal entry
        lines = np.maximum.reduceat(np.abs(values), starts[:-1]) if len(values) else values
        root = np.where(root > 0.0, root, lines / largest)
    with np.errstate(divide="ignore", invalid="ignore"):
        size.array[:] = np.random.default_rng(A.comm.rank).choice([-1.0, 1.0], len(root)) / root
        A.mult(size, one)
        A.multTranspose(size, other)
        # zero diagonal entries give NaN
        return bool((np.abs(one.array_r - other.array_r) <= SYMMETRIC * root).all() and root.all())
