"""The constrained matrix ``Q'(K + G)P`` by updates: K's values in a persistent pattern, and products near the contact only.

P and Q are the identity in free components except for the rows of eliminated nodes, P_E and Q_E. With K_E, the rows of these nodes, and
Z, which crosses out their components and prescribed components,

    Q'KP = ZKZ + ZK P_E + Q_E'K_E (Z + P_E)

so that only blocks of these nodes and their neighbours are multiplied, by each rank for its own rows. Only a copy of values grows with the
size of the bodies. Entries of K are copied in contiguous pieces between lines with additional entries; prescribed components are crossed
out afterwards, except for the diagonal.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.blocks import (
    Blocks,
    Entries,
    blocks_of,
    blocks_of_matrix,
    places_of,
    product,
    summed,
    to_owners,
    together,
)
from uem_dolfinx.algebra.kept_factor import Returning
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools, Ints, among
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import Exchange, gathered, reduced

#: Places of earlier products are kept while there are no more than this times as many of them as of the present one's.
#: [convention; number of entries that K lacks; test_linear_solver.py::test_places_of_earlier_products]
KEPT_PLACES = 2.0


def made_of(P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, roughly: bool) -> tuple[Any, ...] | None:
    """Fingerprint of ``Q'(K + G)P``: K and numbers; None if the matrix counts as new in any case (collective).

    Args:
        P: trial rows.
        Q: test rows.
        K: the tangent, identified by the state of its values.
        G: the curvature.
        roughly: whether coefficients of P and Q, and values of G, are ignored.
    """
    if not roughly and (G is not None or Q is not P):
        return None
    parts = (K.stateGet(), G is None, Q is P, P.fingerprint(values=not roughly))
    return K, *gathered(P.space.comm, np.array(parts, dtype=np.int64)).ravel().tolist()


class UnitedMatrix(Returning):
    """``Q'(K + G)P`` for successive K, in the same matrix as long as its sparsity is unchanged.

    Args:
        reserving: whether the sparsity includes inactive equations.
    """

    def __init__(self, space: Nodes, reserving: bool):
        self.space, self.reserving = space, reserving
        self._first, self._n = space.block * space.first, space.block * space.n_owned
        self._size = space.n_global
        #: K and the free components that the matrix was made for, and the state of K's values in it.
        self._made_for: tuple[Any, ...] = ()
        self._state = -1
        #: Entries of K, or of a copy of K, and of the matrix.
        self._K: Any = None
        self._A: Any = None
        #: Sorted keys of the additional blocks that K does not have: line of nodes times their number plus column.
        self._filled: Ints = np.zeros(0, np.int64)
        self._begins = False  # whether a step begins
        #: Entries of K changed by the last update: blocks, positions of their lines, positions of single entries in matrix and K.
        self._changed: tuple[Blocks, Ints, Ints, Ints] | None = None

    def restore(self) -> None:
        """Bring back the matrix of the last accepted step, which preconditioners hold; its values are computed anew (collective)."""
        super().restore()
        self._changed, self._state = None, -1

    def begin_step(self) -> None:
        """Make the sparsity independent of earlier steps, so that a run restarted from a checkpoint has the same."""
        self._begins = True

    def update(self, P: Restriction, Q: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None) -> PETSc.Mat:
        """Compute the matrix for this P and Q, with the diagonal of K in idle columns (collective)."""
        with timed("restriction matrix P"):
            trial = P.rows()
            test = trial if P is Q else Q.rows()
        with timed("united matrix P'KP" if P is Q else "united matrix Q'KP"):
            if self._know(P, K):
                self._take(K)
            G = None if curvature is None else self._crossed_out(curvature, P.free)
            self._fill(P, Q, trial, test, G)
            return self._A.mat

    def _fill(self, P: Restriction, Q: Restriction, trial: Blocks, test: Blocks, G: Blocks | None) -> None:
        """Copy K's values and the products into the matrix (collective)."""
        changes, adding = self._changes(trial, test, G)
        begins = self._A is None or self._begins
        lines, there = self._find(self._K if begins else self._A, changes)
        if begins or reduced(self.space.comm, int(not there.all())):
            self._make_places(begins, changes, there if begins else None, P, Q, G)
            lines, _ = self._find(self._A, changes)
        self._bring_values()
        values, g, nodes = self._A.values, self.space.block, P.united
        idle = (g * nodes[:, None] + np.arange(g))[~P.used[nodes]].astype(np.int64)
        held, own = [entries.find(idle, idle + self._first)[0] for entries in (self._A, self._K)]
        self._changed = changes._replace(value=np.zeros(0)), lines, held, own
        changes.value[adding] += values[_along(lines[adding], g)]
        values[_along(lines, g)] = changes.value
        values[held] = self._stiff(own)
        self._A.mat.assemble()

    def _bring_values(self) -> None:
        """Copy or restore the values of ZKZ in the matrix, with the diagonal of K in crossed-out components (collective)."""
        values, g = self._A.values, self.space.block
        if self._changed is None:
            for to, here in self._runs:
                values[to] = self._K.values[here]
            old, new = self._moved
            values[_along(new, g)] = self._K.values[_along(old, g)]
            values[_along(self._empty, g)] = 0.0
        else:
            blocks, lines, held, own = self._changed
            old, there = self._find(self._K, blocks)
            values[_along(lines[there], g)] = self._K.values[_along(old[there], g)]
            values[_along(lines[~there], g)] = 0.0
            values[held] = self._K.values[own]
        free, (own, held) = self.space.vector(self._made_for[1]), self._held
        self._A.mat.diagonalScale(free, free)
        values[held] = self._stiff(own)

    def _stiff(self, places: Ints) -> Array:
        """Diagonal entries of K at ``places (k,)``; zeros, as in rigid bodies, are replaced by a large value ``(k,)``."""
        own = self._K.values[places]
        return own if own.all() else np.where(own != 0.0, own, np.abs(self._K.values).max(initial=0.0) or 1.0)

    def _changes(self, trial: Blocks, test: Blocks, G: Blocks | None) -> tuple[Blocks, Bools]:
        """Blocks of the products in owned rows, without duplicates, and the mask of blocks to add to K's values ``(k,)`` (collective)."""
        space, first, last = self.space, self.space.first, self.space.first + self.space.n_owned
        own = np.unique(trial.row)
        eliminated = np.zeros(last - first, dtype=bool)
        eliminated[own - first] = True
        # K and G have blocks on both sides: a node with a column in an eliminated node's row has that node in a row of its own
        rows = together(self._inside(own - first), self._outside(among(self._beyond.row, own)))
        coupled = rows if G is None else together(rows, G.some(eliminated[G.row - first]))
        trial = self._handed_on(trial, coupled)
        seen = np.unique(trial.row)
        inside = (rows.column >= first) & (rows.column < last)
        near = self._inside(np.setdiff1d(rows.column[inside], own) - first, eliminated)
        others = self._outside(among(self._beyond.column, seen) & ~eliminated[self._beyond.row - first])
        left = together(rows, near, others, *([] if G is None else [G]))
        # rows and columns that are not eliminated stay as they are
        trial = together(trial, _ones(np.setdiff1d(left.column, seen), space.block))
        test = together(test.transposed, _ones(np.setdiff1d(left.row, own), space.block))
        changes = product(test, left, trial)
        if space.comm.size > 1:
            changes = summed(to_owners(space, changes))
        return changes, ~(eliminated[changes.row - first] | among(changes.column, seen))

    def _handed_on(self, trial: Blocks, coupled: Blocks) -> Blocks:
        """Rows of P at eliminated nodes of this rank, and at eliminated nodes of other ranks ``coupled`` with owned nodes (collective)."""
        comm = self.space.comm
        if comm.size == 1:
            return trial
        rank, row = np.unique(np.column_stack([self.space.owner_of(coupled.column), coupled.row]), axis=0).T
        places, counts = places_of(trial, row)
        lists = np.split(places, np.searchsorted(np.repeat(rank, counts), np.arange(1, comm.size)))
        lists[comm.rank] = np.arange(len(trial.row))
        return Blocks(*Exchange(comm, lists).send(*trial))

    # -- blocks of K and of curvature --------------------------------------------------------------------------------------

    def _inside(self, nodes: Ints, columns: Bools | None = None) -> Blocks:
        """Blocks of ZKZ in rows and columns of owned nodes: rows ``nodes (k,)``, optionally only in a mask ``columns (n_owned,)``."""
        g, first = self.space.block, self.space.first
        places, i, width = blocks_of(nodes, self._K.indptr, g)
        column = self._K.columns[places] // g
        if columns is not None:
            kept = columns[column - first]
            places, i, width, column = places[kept], i[kept], width[kept], column[kept]
        free = self._made_for[1]
        return Blocks(
            nodes[i] + first, column.astype(np.int64), self._values(places, width, free[nodes[i]], free[column - first])
        )

    def _outside(self, which: Bools) -> Blocks:
        """Blocks of ZKZ in owned rows and other ranks' columns, for a mask of the blocks in ``_beyond``."""
        there = self._beyond.some(which)
        free = self._made_for[1][there.row - self.space.first]
        return there._replace(value=self._values(*there.value.T.astype(np.int64), free, self._free_beyond[which]))

    def _values(self, places: Ints, width: Ints, *free: Bools) -> Array:
        """Values of blocks of ZKZ, from their positions in K, the lengths of their lines, and ``free (k, g)`` rows and columns."""
        there = self._K.values[_along(_lines(places, width, self.space.block), self.space.block)]
        return np.asarray(there * free[0][:, :, None] * free[1][:, None, :])

    def _crossed_out(self, G: PETSc.Mat, free: Bools) -> Blocks:
        """Blocks of G in owned rows without prescribed components (collective)."""
        crossed, kept = G.copy(), self.space.vector(free)
        crossed.diagonalScale(kept, kept)
        return blocks_of_matrix(self.space, crossed)

    def _find(self, entries: Entries, blocks: Blocks) -> tuple[Ints, Bools]:
        """Positions of the lines of blocks in owned rows ``(k, g)``, and whether the blocks exist ``(k,)``."""
        g = self.space.block
        inside = self.space.owner_of(blocks.column) == self.space.comm.rank
        line = g * blocks.row - self._first + np.where(inside, 0, self._n)
        places, there = entries.find(line, g * blocks.column)
        return _lines(places, entries.indptr[line + 1] - entries.indptr[line], g), there

    def _know(self, P: Restriction, K: PETSc.Mat) -> bool:
        """Set the sparsity of K if it is new; whether its values are new (collective)."""
        same = bool(self._made_for) and self._made_for[0] == K and np.array_equal(self._made_for[1], P.free)
        fresh, changed = reduced(self.space.comm, np.array([not same, not same or self._state != K.stateGet()], dtype=np.int64))
        if fresh:
            self._made_for, self._A = (K, P.free), None
            self._K = Entries.within(K) or Entries.as_in(K)
            self._beyond = self._places_beyond()
            self._free_beyond = self.space.ask_owners(self._beyond.column, P.free.astype(float)) > 0.0
        return bool(changed)

    def _take(self, K: PETSc.Mat) -> None:
        """Copy the values of K (collective)."""
        if self._K.mat == K:
            # an assembly may have reallocated them
            self._K = Entries.within(K)
        else:
            K.copy(self._K.mat, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._state, self._changed = K.stateGet(), None

    def _places_beyond(self) -> Blocks:
        """Blocks of K in owned rows and other ranks' columns, with their positions and the lengths of their lines as values."""
        g, n = self.space.block, self.space.n_owned
        lines = np.arange(n, n + n if self.space.comm.size > 1 else n)
        places, i, width = blocks_of(lines, self._K.indptr, g)
        row, column = lines[i] - n + self._first // g, self._K.columns[places] // g
        return Blocks(row, column.astype(np.int64), np.column_stack([places, width]))

    def _make_places(
        self, begins: bool, changes: Blocks, there: Bools | None, P: Restriction, Q: Restriction, G: Blocks | None
    ) -> None:
        """Make the matrix anew if it lacks blocks, or if it has blocks of earlier steps when a step begins (collective).

        ``there (k,)`` is the mask of changes that K has, if known.
        """
        comm = self.space.comm
        wanted = self._missing(changes, there)
        if self.reserving:
            trial = P.reserved()
            more, _ = self._changes(trial, trial if Q is P else Q.reserved(), G)
            wanted = np.union1d(wanted, self._missing(more))
        self._begins = False
        if begins:
            same = self._A is not None and np.array_equal(wanted, self._filled)
            if reduced(comm, int(same)) == comm.size:
                return
            self._filled = wanted
        else:
            both = np.union1d(wanted, self._filled)
            every, needed = reduced(comm, np.array([len(both), len(wanted)]))
            self._filled = both if every <= KEPT_PLACES * needed else wanted
        self._create()

    def _missing(self, blocks: Blocks, there: Bools | None = None) -> Ints:
        """Keys of the blocks that K does not have; ``there (k,)`` is the mask of blocks that it has, if known."""
        there = self._find(self._K, blocks)[1] if there is None else there
        new = blocks.some(~there)
        first = self.space.first
        line = new.row - first + np.where(self.space.owner_of(new.column) == self.space.comm.rank, 0, self.space.n_owned)
        return np.unique(line * self._size + new.column)

    def _create(self) -> None:
        """Make the matrix, with the entries of K and the additional blocks (collective)."""
        K, g = self._K, self.space.block
        # lines of nodes, each of g lines of components with the same columns
        line, column = np.divmod(self._filled, self._size)
        counts = np.bincount(line, minlength=(len(K.indptr) - 1) // g)
        widths = np.diff(K.indptr)[::g] + g * counts
        starts = np.append(0, np.cumsum(np.repeat(widths, g))).astype(K.indptr.dtype)
        values, all_columns = np.zeros(starts[-1]), np.empty(starts[-1], K.columns.dtype)
        grown = np.flatnonzero(counts)
        places, i, width = blocks_of(grown, K.indptr, g)
        lines, columns = np.append(grown[i], line), np.append(K.columns[places] // g, column).astype(K.columns.dtype)
        order = np.lexsort((columns, lines))
        lines, sorted_columns = lines[order], columns[order]
        before = np.arange(len(order)) - np.searchsorted(lines, lines)
        there = np.empty((len(order), g), K.indptr.dtype)
        there[order] = _lines(starts[g * lines] + g * before, widths[lines], g)
        all_columns[_along(there[order], g)] = (g * sorted_columns[:, None] + np.arange(g, dtype=K.columns.dtype))[:, None]
        #: Lines of K's blocks in lines with additional blocks: positions in K and in the matrix.
        self._moved = _lines(places, width, g), there[: len(places)]
        self._empty = there[len(places) :]  # lines of the additional blocks
        #: Contiguous pieces between lines with additional blocks: in the matrix and in K.
        self._runs = []
        begins, ends = np.append(0, g * (grown + 1)), np.append(g * grown, len(K.indptr) - 1)
        for a, b, c in zip(K.indptr[begins], K.indptr[ends], starts[begins]):
            if a < b:
                self._runs.append((slice(c, c + b - a), slice(a, b)))
        for to, here in self._runs:
            all_columns[to] = K.columns[here]
        self._A, self._changed = Entries.of_arrays(starts, all_columns, values, K.mat), None
        held = np.flatnonzero(~self._made_for[1])
        #: Positions of the diagonal entries of prescribed components, in K and in the matrix.
        self._held = tuple(entries.find(held, held + self._first)[0] for entries in (K, self._A))


def _ones(nodes: Ints, g: int) -> Blocks:
    """Rows of the identity at ``nodes (k,)``."""
    return Blocks(nodes, nodes, np.broadcast_to(np.eye(g), (len(nodes), g, g)))


def _lines(places: Ints, width: Ints, g: int) -> Ints:
    """Positions of the lines of blocks ``(k, g)``, from the first line's position and the number of entries per line ``(k,)``."""
    return places[:, None] + width[:, None] * np.arange(g, dtype=width.dtype)


def _along(lines: Ints, g: int) -> Ints:
    """Positions of the entries of blocks ``(k, g, g)`` from the positions of their lines ``(k, g)``."""
    return lines[:, :, None] + np.arange(g, dtype=lines.dtype)
