"""The united matrix ``Q'(K + G)P`` from its changes: K's values in a pattern that lasts, and products near the contact only.

P and Q are the identity but for the rows of eliminated nodes and for prescribed components, which Z crosses out. With H, the entries
of K between a part of the nodes, which has all that are coupled with an eliminated one,

    Q'(K + G)P = Z(K - H)Z + Q'(H + G)P

so that only matrices of that part are multiplied, and all that grows with the bodies is a copy of values. ZKZ, with the diagonal of K
where Z crosses out, is kept as well: its entries go line by line to where the matrix has them, in one piece between lines that have more.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.entries import Entries, entries_of
from uem_dolfinx.algebra.parts import Part
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed

#: Places of earlier products are kept while there are no more than this times as many of them as of the present one's.
#: [convention; number of entries that K lacks; test_linear_solver.py::test_places_of_earlier_products]
KEPT_PLACES = 2.0


class UnitedMatrix:
    """``Q'(K + G)P`` of one K after the other, in the same matrix while its entries keep their places.

    Args:
        space: the space that K acts on.
        reserving: whether equations that do not hold have their places too.
    """

    def __init__(self, space: Nodes, reserving: bool):
        self.space, self.reserving = space, reserving
        self._first, self._n = space.block * int(space.index_map.local_range[0]), space.block * space.n_owned
        self._size = int(space.block * space.index_map.size_global)
        #: K and the free components that the matrix was made for, and the state of K's values that it holds.
        self._made_for: tuple[Any, ...] = ()
        self._state = -1
        #: Z K Z with the diagonal of K, where it is crossed out, and the matrix.
        self._K: Any = None
        self._crossed: Ints = np.zeros(0, np.int64)
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
        with timed("restriction matrix P"):
            changed = self._know(P, K)
            part = self._part(P, P.united, P.equations.active, curvature)
            rows, test = P.matrix(part), None if P is Q else Q.matrix(part)
        with timed("united matrix P'KP" if P is Q else "united matrix Q'KP"):
            if changed:
                self._take(K)
            self._fill(P, Q, part, curvature, rows, test)
            return self._A.mat

    def _fill(self, P: Restriction, Q: Restriction, part: Part, curvature: PETSc.Mat | None, trial: Any, test: Any) -> None:
        """Bring K's values and the product of the part into the matrix (collective)."""
        H = part.of(self._made_for[0])
        diagonal = H.getDiagonal().array_r
        lines, columns, product = self._entries(_product(_sum(H, curvature, part), trial, test), part)
        begins = self._A is None or self._begins
        places, there = (lines, np.zeros(0, dtype=bool)) if begins else self._A.find(lines, columns)
        if begins or self.space.comm.allreduce(int(not there.all())):
            self._make_room(begins, lines, columns, P, Q, curvature)
            places, _ = self._A.find(lines, columns)
        taken, _ = self._A.of(self._lines(part.components))
        taken = taken[part.has(self._A.columns[taken])]
        idle = np.flatnonzero(~P.used.ravel()[part.components])
        own = part.components[idle]
        held, _ = self._A.find(own, own + self._first)
        values = self._A.values
        if self._changed is None:
            for to, here in self._runs:
                values[to] = self._K.values[here]
            values[self._moved[1]] = self._K.values[self._moved[0]]
            values[self._empty] = 0.0
        else:
            values[self._changed[0]] = self._changed[1]
        at = np.concatenate([taken, places])
        self._changed = at, values[at]
        values[taken] = 0.0
        values[places] = product
        values[held] = diagonal[idle]
        self._A.mat.assemble()

    def _know(self, P: Restriction, K: PETSc.Mat) -> bool:
        """Take K's places if they are new; whether its values are (collective)."""
        same = bool(self._made_for) and self._made_for[0] == K and np.array_equal(self._made_for[1], P.free)
        fresh, changed = self.space.comm.allreduce(np.array([not same, not same or self._state != K.stateGet()], dtype=np.int64))
        if fresh:
            self._made_for, self._K, self._A = (K, P.free), Entries.as_in(K), None
            # where Z crosses out, but for the diagonal
            free = P.vector(P.free.astype(float))
            self._K.values[:] = 1.0
            self._K.mat.diagonalScale(free, free)
            held = np.flatnonzero(~P.free)
            self._K.values[self._K.find(held, held + self._first)[0]] = 1.0
            self._crossed = np.flatnonzero(self._K.values == 0.0)
        return bool(changed)

    def _take(self, K: PETSc.Mat) -> None:
        """Take the values of K (collective)."""
        K.copy(self._K.mat, PETSc.Mat.Structure.SAME_NONZERO_PATTERN)
        self._K.values[self._crossed] = 0.0
        self._state, self._changed = K.stateGet(), None

    def _part(self, P: Restriction, nodes: Indices, which: Bools, curvature: PETSc.Mat | None) -> Part:
        """The nodes that have an entry of K at ``nodes`` of any rank, those that ``which`` equations follow, and the curvature's."""
        g, n = self.space.block, self.space.n_owned
        first = self._first // g
        # components of a node have the same neighbours, and K's pattern is symmetric
        at, _ = self._K.of(self._lines(g * nodes.astype(np.int64)))
        touched = np.union1d(self._K.columns[at] // g, P.followed(which)).astype(np.int64)
        near = np.zeros(n, dtype=bool)
        own = (touched >= first) & (touched < first + n)
        near[touched[own] - first] = True
        near[self.space.gather_owned(touched[~own])] = True
        if curvature is not None:
            # a node with a row of it is coupled with itself
            near |= np.diff(curvature.getDiagonalBlock().getRowIJ()[0]).reshape(n, g).any(axis=1)
        return Part(self.space, near)

    def _lines(self, components: Ints) -> Bools:
        """Which lines have entries of owned components."""
        lines = np.zeros(len(self._K.indptr) - 1, dtype=bool)
        lines[components] = True
        if self.space.comm.size > 1:
            lines[components + self._n] = True
        return lines

    def _entries(self, A: PETSc.Mat, part: Part) -> tuple[Ints, Ints, Array]:
        """Lines, columns and values of the entries of a part's matrix, in the whole (collective)."""
        indptr, columns, values = A.getValuesCSR()
        rows, columns = np.repeat(part.components, np.diff(indptr)), part.in_whole(columns)
        return np.where((columns >= self._first) & (columns < self._first + self._n), rows, rows + self._n), columns, values

    def _make_room(
        self, begins: bool, lines: Ints, columns: Ints, P: Restriction, Q: Restriction, curvature: PETSc.Mat | None
    ) -> None:
        """Make the matrix anew where it lacks places, or has those of earlier steps when a step begins (collective)."""
        comm = self.space.comm
        wanted = self._missing(lines, columns)
        if self.reserving:
            part = self._part(P, P.nodes, np.ones_like(P.equations.active), curvature)
            H = _sum(part.of(self._made_for[0]), curvature, part)
            more = _product(H, P.reserved(part), None if Q is P else Q.reserved(part))
            wanted = np.union1d(wanted, self._missing(*self._entries(more, part)[:2]))
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


def _sum(H: PETSc.Mat, curvature: PETSc.Mat | None, part: Part) -> PETSc.Mat:
    """H with the curvature of a part of the nodes."""
    if curvature is not None:
        H.axpy(1.0, part.of(curvature), PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
    return H


def _product(H: PETSc.Mat, P: PETSc.Mat, Q: PETSc.Mat | None) -> PETSc.Mat:
    """``Q'HP``, with P in place of Q if that is None."""
    return H.PtAP(P) if Q is None else Q.transposeMatMult(H.matMult(P))
