"""The united matrix ``Q'(K + G)P`` from its changes: K's values in a pattern that lasts, and products near the contact only.

P and Q are the identity in free components but for the rows of eliminated nodes, P_E and Q_E. With K_E, the rows of these nodes, and Z,
which crosses out their components and those that are prescribed,

    Q'KP = ZKZ + ZK P_E + Q_E'K_E (Z + P_E)

so that only blocks of these nodes and their neighbours are multiplied, by each rank its own rows, and all that grows with the bodies is a
copy of values. K without prescribed components, with its diagonal where these are, is kept as well: its entries go line by line to where
the matrix has them, in one piece between lines that have more.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.blocks import Blocks, blocks_of_matrix, product, summed, to_owners, together
from uem_dolfinx.algebra.entries import Entries, blocks_of, entries_of
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import Exchange, gathered, reduced

#: Places of earlier products are kept while there are no more than this times as many of them as of the present one's.
#: [convention; number of entries that K lacks; test_linear_solver.py::test_places_of_earlier_products]
KEPT_PLACES = 2.0


def made_of(P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, roughly: bool) -> tuple[Any, ...] | None:
    """K and numbers that tell ``Q'(K + G)P`` from others; None where it is taken for a new one in any case (collective).

    Args:
        P: trial rows.
        Q: test rows.
        K: the tangent, told by the state of its values.
        G: the curvature.
        roughly: whether coefficients of P and Q, and values of G, do not count.
    """
    if not roughly and (G is not None or Q is not P):
        return None
    parts = (K.stateGet(), G is None, Q is P, P.fingerprint(values=not roughly))
    return K, *gathered(P.space.comm, np.array(parts, dtype=np.int64)).ravel().tolist()


class UnitedMatrix:
    """``Q'(K + G)P`` of one K after the other, in the same matrix while its entries keep their places.

    Args:
        space: the space that K acts on.
        reserving: whether equations that do not hold have their places too.
    """

    def __init__(self, space: Nodes, reserving: bool):
        self.space, self.reserving = space, reserving
        self._first, self._n = space.block * space.first, space.block * space.n_owned
        self._size = space.n_global
        #: K and the free components that the matrix was made for, and the state of K's values that it holds.
        self._made_for: tuple[Any, ...] = ()
        self._state = -1
        #: Z K Z with the diagonal of K, where it is crossed out, and the matrix.
        self._K: Any = None
        self._crossed: Ints = np.zeros(0, np.int64)
        #: Places in it of prescribed components' diagonal.
        self._held: Ints = np.zeros(0, np.int64)
        self._A: Any = None
        #: Keys of the blocks that K lacks, line of nodes times their number plus column, sorted.
        self._filled: Ints = np.zeros(0, np.int64)
        #: Whether a step begins.
        self._begins = False
        #: Places where the last update changed what is K's, and what was there.
        self._changed: tuple[Ints, Array] | None = None

    def begin_step(self) -> None:
        """Let no place depend on the steps before this one: a run that goes on from a checkpoint takes the same."""
        self._begins = True

    def update(self, P: Restriction, Q: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None) -> PETSc.Mat:
        """Give the matrix its values for this P and Q, with the diagonal of K in idle columns (collective)."""
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
        """Bring K's values and the products into the matrix (collective)."""
        changes, adding = self._changes(trial, test, G)
        begins = self._A is None or self._begins
        places, there = self._find(self._K if begins else self._A, changes)
        if begins or reduced(self.space.comm, int(not there.all())):
            self._make_places(begins, changes, P, Q, G)
            places, _ = self._find(self._A, changes)
        values = self._A.values
        if self._changed is None:
            for to, here in self._runs:
                values[to] = self._K.values[here]
            values[self._moved[1]] = self._K.values[self._moved[0]]
            values[self._empty] = 0.0
        else:
            values[self._changed[0]] = self._changed[1]
        g, nodes = self.space.block, P.united
        idle = (g * nodes[:, None] + np.arange(g))[~P.used[nodes]].astype(np.int64)
        held, own = (entries.find(idle, idle + self._first)[0] for entries in (self._A, self._K))
        at = np.concatenate([places.ravel(), held])
        self._changed = at, values[at]
        values[places] = np.where(adding[:, None, None], values[places], 0.0) + changes.value
        values[held] = self._stiff(own)
        self._A.mat.assemble()

    def _stiff(self, places: Ints) -> Array:
        """Entries of K at ``places (k,)`` of its diagonal, a large one where there is none, as in bodies that are rigid ``(k,)``."""
        own = self._K.values[places]
        return own if own.all() else np.where(own != 0.0, own, np.abs(self._K.values).max(initial=0.0) or 1.0)

    def _changes(self, trial: Blocks, test: Blocks, G: Blocks | None) -> tuple[Blocks, Bools]:
        """Blocks of the products in owned rows, each place once, and which of them are added to what K has there ``(k,)`` (collective).

        Args:
            trial: rows of P at this rank's eliminated nodes; each has a block of its own.
            test: rows of Q there.
            G: curvature in owned rows, if any.
        """
        space, first, last = self.space, self.space.first, self.space.first + self.space.n_owned
        own = np.unique(trial.row)
        eliminated = np.zeros(last - first, dtype=bool)
        eliminated[own - first] = True
        # K and G have blocks on both sides: a node with a column in an eliminated node's row has that node in a row of its own
        rows = together(self._inside(own - first), self._outside(np.isin(self._beyond.row, own)))
        coupled = rows if G is None else together(rows, G.some(eliminated[G.row - first]))
        trial = self._handed_on(trial, coupled)
        seen = np.unique(trial.row)
        inside = (rows.column >= first) & (rows.column < last)
        near = self._inside(np.setdiff1d(rows.column[inside], own) - first, eliminated)
        others = self._outside(np.isin(self._beyond.column, seen) & ~eliminated[self._beyond.row - first])
        left = together(rows, near, others, *([] if G is None else [G]))
        on = np.isin(left.column, seen)
        X = together(left.some(~on), product(left.some(on), trial))
        at = eliminated[X.row - first]
        changes = summed(together(X.some(~at), to_owners(space, product(test.transposed, X.some(at)))))
        return changes, ~(eliminated[changes.row - first] | np.isin(changes.column, seen))

    def _handed_on(self, trial: Blocks, coupled: Blocks) -> Blocks:
        """Rows of P at eliminated nodes of this rank, and at those of others that are ``coupled`` with nodes here (collective)."""
        comm = self.space.comm
        if comm.size == 1:
            return trial
        pairs = np.unique(np.column_stack([self.space.owner_of(coupled.column), coupled.row]), axis=0)
        lists = [np.flatnonzero(np.isin(trial.row, pairs[pairs[:, 0] == rank, 1])) for rank in range(comm.size)]
        lists[comm.rank] = np.arange(len(trial.row))
        return Blocks(*Exchange(comm, lists).send(*trial))

    # -- blocks of K and of curvature --------------------------------------------------------------------------------------

    def _inside(self, nodes: Ints, columns: Bools | None = None) -> Blocks:
        """Blocks of K in rows and columns of owned nodes, in rows ``nodes (k,)``, and in some ``columns (n_owned,)`` alone if told."""
        g, first = self.space.block, self.space.first
        places, i, width = blocks_of(nodes, self._K.indptr, g)
        column = self._K.columns[places] // g
        if columns is not None:
            kept = columns[column - first]
            places, i, width, column = places[kept], i[kept], width[kept], column[kept]
        return Blocks(nodes[i] + first, column.astype(np.int64), self._values(places, width))

    def _outside(self, which: Bools) -> Blocks:
        """Some of the blocks of K in owned rows and other ranks' columns, of which ``_beyond`` has the places."""
        there = self._beyond.some(which)
        return there._replace(value=self._values(*there.value.T.astype(np.int64)))

    def _values(self, places: Ints, width: Ints) -> Array:
        """Values of blocks of K from the places where they begin, and the number of entries in their lines."""
        k = np.arange(self.space.block)
        return self._K.values[places[:, None, None] + width[:, None, None] * k[:, None] + k]

    def _crossed_out(self, G: PETSc.Mat, free: Bools) -> Blocks:
        """Blocks of G in owned rows without prescribed components (collective)."""
        row, column, value = blocks_of_matrix(self.space, G)
        asked, at = np.unique(column, return_inverse=True)
        there = self.space.ask_owners(asked, free.astype(float))[at]
        return Blocks(row, column, value * free[row - self.space.first][:, :, None] * there[:, None, :])

    def _find(self, entries: Entries, blocks: Blocks) -> tuple[Ints, Bools]:
        """Places of blocks in owned rows ``(k, g, g)``, and whether they are there ``(k,)``."""
        g = self.space.block
        inside = self.space.owner_of(blocks.column) == self.space.comm.rank
        line = g * blocks.row - self._first + np.where(inside, 0, self._n)
        column = np.repeat(g * blocks.column, g)
        places, there = entries.find((line[:, None] + np.arange(g)).ravel(), column)
        return places.reshape(-1, g, 1) + np.arange(g), np.asarray(there.reshape(-1, g).all(axis=1))

    def _know(self, P: Restriction, K: PETSc.Mat) -> bool:
        """Take K's places if they are new; whether its values are (collective)."""
        same = bool(self._made_for) and self._made_for[0] == K and np.array_equal(self._made_for[1], P.free)
        fresh, changed = reduced(self.space.comm, np.array([not same, not same or self._state != K.stateGet()], dtype=np.int64))
        if fresh:
            self._made_for, self._K, self._A = (K, P.free), Entries.as_in(K), None
            # where Z crosses out, but for the diagonal
            free = self.space.vector(P.free)
            self._K.values[:] = 1.0
            self._K.mat.diagonalScale(free, free)
            held = np.flatnonzero(~P.free)
            self._held = self._K.find(held, held + self._first)[0]
            self._K.values[self._held] = 1.0
            self._crossed = np.flatnonzero(self._K.values == 0.0)
            self._beyond = self._places_beyond()
        return bool(changed)

    def _take(self, K: PETSc.Mat) -> None:
        """Take the values of K (collective)."""
        K.copy(self._K.mat, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._K.values[self._crossed] = 0.0
        self._K.values[self._held] = self._stiff(self._held)
        self._state, self._changed = K.stateGet(), None

    def _places_beyond(self) -> Blocks:
        """Blocks of K in owned rows and other ranks' columns; as values, where they begin and how many entries their lines have."""
        g, n = self.space.block, self.space.n_owned
        lines = np.arange(n, n + n if self.space.comm.size > 1 else n)
        places, i, width = blocks_of(lines, self._K.indptr, g)
        row, column = lines[i] - n + self._first // g, self._K.columns[places] // g
        return Blocks(row, column.astype(np.int64), np.column_stack([places, width]))

    def _make_places(self, begins: bool, changes: Blocks, P: Restriction, Q: Restriction, G: Blocks | None) -> None:
        """Make the matrix anew where it lacks places, or has those of earlier steps when a step begins (collective)."""
        comm = self.space.comm
        wanted = self._missing(changes)
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
            few = reduced(comm, len(both)) <= KEPT_PLACES * reduced(comm, len(wanted))
            self._filled = both if few else wanted
        self._create()

    def _missing(self, blocks: Blocks) -> Ints:
        """Keys of those blocks that K lacks."""
        _, there = self._find(self._K, blocks)
        new = blocks.some(~there)
        first = self.space.first
        line = new.row - first + np.where(self.space.owner_of(new.column) == self.space.comm.rank, 0, self.space.n_owned)
        return np.unique(line * self._size + new.column)

    def _create(self) -> None:
        """Make the matrix, with the entries of K and those that were filled (collective)."""
        K, g = self._K, self.space.block
        k = np.arange(g)
        line, column = np.divmod(self._filled, self._size)
        shape = (len(line), g, g)
        new = np.broadcast_to((g * line[:, None] + k)[:, :, None], shape).ravel()
        columns = np.broadcast_to((g * column[:, None] + k)[:, None, :], shape).ravel()
        counts = np.bincount(new, minlength=len(K.indptr) - 1)
        shift, grown = np.append(0, np.cumsum(counts)), counts > 0
        starts = (K.indptr + shift).astype(K.indptr.dtype)
        old, line = K.of(grown)
        all_columns = np.empty(starts[-1], K.columns.dtype)
        merged = np.append(K.columns[old], columns)
        at, order = entries_of(np.flatnonzero(grown), starts)[0], np.lexsort((merged, np.append(line, new)))
        place = np.empty_like(at)
        place[order] = at
        all_columns[place] = merged
        #: Where the entries of lines that have more come from, and where they went to.
        self._moved = old, place[: len(old)]
        #: Where the lines between those that have grown went to, and where they come from.
        self._runs = []
        ends = np.flatnonzero(grown)
        begins, ends = np.append(0, ends + 1), np.append(ends, len(counts))
        for a, b, by in zip(K.indptr[begins], K.indptr[ends], shift[begins]):
            if a < b:
                self._runs.append((slice(a + by, b + by), slice(a, b)))
        for there, here in self._runs:
            all_columns[there] = K.columns[here]
        self._A, self._changed = Entries(starts, all_columns, K.mat), None
        #: Where K has no entry.
        self._empty = place[len(old) :]
