"""The united matrix ``Q'(K + G)P`` from its changes: K's values in a pattern that lasts, and products near the contact only.

P and Q are the identity but for the rows of eliminated nodes and for prescribed components, which Z crosses out. With H, the rows of
K that have an entry at an eliminated node,

    Q'(K + G)P = Z(K - H)Z + Q'(H + G)P

so that only a thin matrix is multiplied, and all that grows with the bodies is a copy of values. ZKZ, with the diagonal of K where Z
crosses out, is kept as well: its entries go line by line to where the matrix has them, in one piece between lines that have more.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.entries import Entries, entries_of
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.geometry.configuration import Configuration

#: Places of earlier products are kept while there are no more than this times as many of them as of the present one's.
#: [convention; number of entries that K lacks; test_thresholds_algebra.py::test_places_of_earlier_products]
KEPT_PLACES = 2.0


class UnitedMatrix:
    """``Q'(K + G)P`` of one K after the other, in the same matrix while its entries keep their places.

    Args:
        config: the space that K acts on.
        reserving: whether equations that do not hold have their places too.
    """

    def __init__(self, config: Configuration, reserving: bool):
        self.config, self.reserving = config, reserving
        self._first, self._n = config.gdim * int(config.index_map.local_range[0]), config.gdim * config.n_owned
        self._size = int(config.gdim * config.index_map.size_global)
        #: K and the free components that the matrix was made for, and the state of K's values that it holds.
        self._made_for: tuple[Any, ...] = ()
        self._state = -1
        #: Z K Z with the diagonal of K, and the matrix.
        self._K: Any = None
        self._A: Any = None
        #: Keys of the entries that K lacks, line times size plus column, sorted.
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
        self._take(P, K)
        near, H = self._near(P.united, curvature)
        lines, columns, changes = self._entries(_product(H, P.P, Q.P))
        begins = self._A is None or self._begins
        places, there = (lines, np.zeros(0, dtype=bool)) if begins else self._A.find(lines, columns)
        if begins or self.config.comm.allreduce(int(not there.all())):
            self._make_room(begins, lines, columns, P, Q, curvature)
            places, _ = self._A.find(lines, columns)
        taken = self._place(*near)
        idle = np.flatnonzero(~P.used)
        own, _ = self._K.find(idle, idle + self._first)
        diagonal = self._place(own, idle)
        values = self._A.values
        if self._changed is None:
            for to, here in self._runs:
                values[to] = self._K.values[here]
            values[self._moved[1]] = self._K.values[self._moved[0]]
            values[self._empty] = 0.0
        else:
            values[self._changed[0]] = self._changed[1]
        at = np.concatenate([taken, places, diagonal])
        self._changed = at, values[at]
        values[taken] = 0.0
        values[places] += changes
        values[diagonal] = self._K.values[own]
        self._A.mat.assemble()
        return self._A.mat

    def _take(self, P: Restriction, K: PETSc.Mat) -> None:
        """Take the values of K, and its places if they are new (collective)."""
        same = bool(self._made_for) and self._made_for[0] == K and np.array_equal(self._made_for[1], P.free)
        fresh, changed = self.config.comm.allreduce(np.array([not same, not same or self._state != K.stateGet()], dtype=np.int64))
        if fresh:
            self._made_for, self._K, self._A = (K, P.free), Entries.as_in(K), None
        if changed:
            K.copy(self._K.mat, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
            self._state, self._changed = K.stateGet(), None
            held = np.flatnonzero(~P.free)
            own, _ = self._K.find(held, held + self._first)
            diagonal, free = self._K.values[own], P.vector(P.free.astype(float))
            self._K.mat.diagonalScale(free, free)
            self._K.values[own] = diagonal

    def _lines(self, components: Bools) -> Bools:
        """Lines of owned components ``(n_owned, gdim)``."""
        return np.tile(components.ravel(), 1 if self.config.comm.size == 1 else 2)

    def _neighbours(self, nodes: Indices) -> Bools:
        """Lines of the owned nodes that have an entry of K at ``nodes`` of any rank (collective)."""
        g = self.config.gdim
        here = np.zeros((self.config.n_owned, g), dtype=bool)
        # components of a node have the same neighbours
        here[nodes, 0] = True
        at, line = self._K.of(self._lines(here))
        # K's pattern is symmetric
        touched, k = self._K.columns[at] // g, np.count_nonzero(line < self._n)
        near = np.zeros_like(here)
        near[touched[:k] - self._first // g] = True
        near[self.config.gather_owned(np.unique(touched[k:]).astype(np.int64))] = True
        return self._lines(near)

    def _near(self, nodes: Indices, curvature: PETSc.Mat | None) -> tuple[tuple[Ints, Ints], PETSc.Mat]:
        """Places and lines of the entries of H, the rows of K that have an entry at ``nodes``, and ``H + G`` (collective)."""
        near = self._neighbours(nodes)
        at, line = self._K.of(near)
        lengths = np.diff(self._K.indptr) * near
        H = Entries(np.append(0, np.cumsum(lengths)).astype(PETSc.IntType), self._K.columns[at], self._K.mat)
        H.values[:] = self._K.values[at]
        if curvature is not None:
            H.mat.axpy(1.0, curvature, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        return (at, line), H.mat

    def _entries(self, product: PETSc.Mat) -> tuple[Ints, Ints, Array]:
        """Lines, columns and values of the entries of a matrix."""
        indptr, columns, values = product.getValuesCSR()
        rows = np.repeat(np.arange(len(indptr) - 1), np.diff(indptr))
        return np.where((columns >= self._first) & (columns < self._first + self._n), rows, rows + self._n), columns, values

    def _make_room(
        self, begins: bool, lines: Ints, columns: Ints, P: Restriction, Q: Restriction, curvature: PETSc.Mat | None
    ) -> None:
        """Make the matrix anew where it lacks places, or has those of earlier steps when a step begins (collective)."""
        comm = self.config.comm
        wanted = self._missing(lines, columns)
        if self.reserving:
            reserved = P.reserved
            more = _product(self._near(P.nodes, curvature)[1], reserved, reserved if Q is P else Q.reserved)
            wanted = np.union1d(wanted, self._missing(*self._entries(more)[:2]))
        self._begins = False
        if begins:
            same = self._A is not None and np.array_equal(wanted, self._filled)
            if comm.allreduce(int(same)) == comm.size:
                return
            self._filled = wanted
        else:
            both = np.union1d(wanted, self._filled)
            few = comm.allreduce(len(both)) <= KEPT_PLACES * comm.allreduce(len(wanted))
            self._filled = both if few else wanted
        self._create()

    def _missing(self, lines: Ints, columns: Ints) -> Ints:
        """Keys of those entries that K lacks."""
        _, there = self._K.find(lines, columns)
        return np.unique(lines[~there] * self._size + columns[~there])

    def _create(self) -> None:
        """Make the matrix, with the entries of K and those that were filled (collective)."""
        K = self._K
        new, columns = np.divmod(self._filled, self._size)
        counts = np.bincount(new, minlength=len(K.indptr) - 1)
        #: How far the entries of each line have moved, and which lines have more.
        self._shift = np.append(0, np.cumsum(counts))
        self._grown = counts > 0
        starts = (K.indptr + self._shift).astype(K.indptr.dtype)
        old, line = K.of(self._grown)
        all_columns = np.empty(starts[-1], K.columns.dtype)
        merged = np.append(K.columns[old], columns)
        at, order = entries_of(self._grown, starts)[0], np.lexsort((merged, np.append(line, new)))
        place = np.empty_like(at)
        place[order] = at
        all_columns[place] = merged
        self._moved = old, place[: len(old)]
        #: Where the lines between those that have grown went to, and where they come from.
        self._runs = []
        ends = np.flatnonzero(self._grown)
        begins, ends = np.append(0, ends + 1), np.append(ends, len(counts))
        for a, b, by in zip(K.indptr[begins], K.indptr[ends], self._shift[begins]):
            if a < b:
                self._runs.append((slice(a + by, b + by), slice(a, b)))
        for there, here in self._runs:
            all_columns[there] = K.columns[here]
        self._A, self._changed = Entries(starts, all_columns, K.mat), None
        #: Where K has no entry.
        self._empty = place[len(old) :]

    def _place(self, at: Ints, line: Ints) -> Ints:
        """Where the matrix has entries of K ``at`` these places of K, in these lines."""
        place, moved = at + self._shift[line], self._grown[line]
        place[moved] = self._moved[1][np.searchsorted(self._moved[0], at[moved])]
        return place


def _product(H: PETSc.Mat, P: PETSc.Mat, Q: PETSc.Mat) -> PETSc.Mat:
    """``Q'HP``."""
    return H.PtAP(P) if P is Q else Q.transposeMatMult(H.matMult(P))
