"""The united matrix ``Q'(K + G)P`` from its changes: K's values in a pattern that lasts, and products near the contact only.

P and Q are the identity but for the rows of eliminated nodes and for prescribed components, which Z crosses out. With H, the rows of
K that have an entry at an eliminated node,

    Q'(K + G)P = Z(K - H)Z + Q'(H + G)P

so that only a thin matrix is multiplied, and all that grows with the bodies is a copy of values.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Bools, Indices, Ints
from uem_dolfinx.geometry.configuration import Configuration

#: Places of earlier products are kept while there are no more than this times as many of them as of the present one's.
#: [convention; number of entries that K lacks; test_thresholds_algebra.py::test_places_of_earlier_products]
KEPT_PLACES = 2.0


class UnitedMatrix:
    """``Q'(K + G)P`` of one K after the other, in the same matrix while its entries keep their places.

    Args:
        config: the space that K acts on.
        reserving: whether equations that do not hold have their places too.

    Attributes:
        A: the matrix; None before the first ``update``.
    """

    def __init__(self, config: Configuration, reserving: bool):
        self.config, self.reserving = config, reserving
        self.A: Any = None
        self._first = config.gdim * int(config.index_map.local_range[0])
        #: K, and the free components that the matrix was made for.
        self._made_for: tuple[Any, ...] = ()
        #: Keys of the entries that K lacks, row times size plus column, sorted.
        self._filled: Ints = np.zeros(0, np.int64)
        #: Keys of the last product's entries, and of those of H.
        self._last: tuple[Ints, Ints] | None = None
        #: Whether a step begins, and the keys that the matrix was made for when the last one did; None if it has grown since.
        self._begins = False
        self._made_from: Ints | None = None

    def begin_step(self) -> None:
        """Let no place depend on the steps before this one: a run that goes on from a checkpoint takes the same."""
        self._begins = True

    def update(self, P: Restriction, Q: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None) -> PETSc.Mat:
        """Give the matrix its values for this P and Q, with the diagonal of K in idle columns (collective)."""
        comm = self.config.comm
        same = bool(self._made_for) and self._made_for[0] == K and np.array_equal(self._made_for[1], P.free)
        csr = indptr, columns, values = K.getValuesCSR()
        if comm.allreduce(int(same)) < comm.size:
            self._made_for, self.A, self._made_from = (K, P.free), None, None
            self._look(P.free, indptr, columns)
        taken, H = self._near(csr, P.united, K, curvature)
        product = _product(H, P.P, Q.P)
        *pattern, changes = product.getValuesCSR()
        keys = self._keys(*pattern), taken
        if self.A is None or self._begins or not self._fit(keys):
            wanted = np.union1d(*keys)
            if self.reserving:
                reserved = P.reserved
                more = _product(self._near(csr, P.nodes, K, curvature)[1], reserved, reserved if Q is P else Q.reserved)
                wanted = np.union1d(wanted, self._keys(*more.getValuesCSR()[:2]))
            begins = self.A is None or self._begins
            same = begins and self._made_from is not None and np.array_equal(self._made_from, wanted)
            if comm.allreduce(int(same)) < comm.size:
                if begins:
                    self._filled = np.zeros(0, np.int64)
                self._create(wanted, K, indptr, columns)
                self._made_from = wanted if begins else None
                self._last = None
            self._begins = False
        if self._last is None or not all(map(np.array_equal, keys, self._last)):
            self._last = keys
            self._places, self._taken = (self._key_places[np.searchsorted(self._sorted, k)] for k in keys)
        own = self._own
        self._values[self._kept] = values if own is None else np.concatenate([values[own], values[~own]])
        self._values[self._emptied] = 0.0
        self._values[self._taken] = 0.0
        self._values[self._places] += changes
        idle = ~P.used.ravel()
        self._values[self._diagonal[idle]] = values[self._diagonal_of_K[idle]]
        self.A.assemble()
        return self.A

    def _look(self, free: Bools, indptr: Ints, columns: Ints) -> None:
        """Find the entries of K in rows and columns that are not free, and those of its diagonal (collective)."""
        g, lengths = self.config.gdim, np.diff(indptr)
        own = (columns >= self._first) & (columns < self._first + free.size)
        ghosts, ghost = np.unique(columns[~own], return_inverse=True)
        there = self.config.ask_owners(ghosts.astype(np.int64) // g, free.astype(float)) > 0
        crossed = np.repeat(~free.ravel(), lengths)
        crossed[own] |= ~free.ravel()[columns[own] - self._first]
        crossed[~own] |= ~there[np.arange(len(ghosts)), ghosts % g][ghost]
        self._crossed = np.flatnonzero(crossed)
        self._diagonal_of_K = np.flatnonzero(columns == np.repeat(np.arange(free.size) + self._first, lengths))

    def _near(self, csr: Any, nodes: Indices, K: PETSc.Mat, curvature: PETSc.Mat | None) -> tuple[Ints, PETSc.Mat]:
        """Keys of the entries of H, the rows of K that have an entry at ``nodes``, and ``H + G`` (collective)."""
        indptr, columns, values = csr
        g, lengths = self.config.gdim, np.diff(indptr)
        united = np.zeros(len(lengths), dtype=bool)
        united.reshape(-1, g)[nodes] = True
        # K's pattern is symmetric
        touched = np.unique(columns[_entries(united, indptr)] // g)
        near = np.zeros_like(united)
        near.reshape(-1, g)[self.config.gather_owned(touched.astype(np.int64))] = True
        at, starts = _entries(near, indptr), np.append(0, np.cumsum(lengths * near)).astype(PETSc.IntType)
        rows = starts, columns[at], values[at]
        H = PETSc.Mat().createAIJ(K.getSizes(), bsize=g, csr=rows, comm=K.comm)
        if curvature is not None:
            H.axpy(1.0, curvature, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        return self._keys(starts, columns[at]), H

    def _keys(self, indptr: Ints, columns: Ints) -> Ints:
        """What tells entries apart."""
        return np.repeat(np.arange(len(indptr) - 1), np.diff(indptr)) * self._size + columns

    @property
    def _size(self) -> int:
        return int(self.config.gdim * self.config.index_map.size_global)

    def _fit(self, keys: tuple[Ints, Ints]) -> bool:
        """Whether there are places for entries of these keys (collective)."""
        same = self._last is not None and all(map(np.array_equal, keys, self._last))
        fits = same or all(map(self._known, keys))
        return bool(self.config.comm.allreduce(int(fits)) == self.config.comm.size)

    def _known(self, keys: Ints) -> bool:
        """Whether all keys are among the sorted ones."""
        at = np.searchsorted(self._sorted, keys)
        return bool((at < len(self._sorted)).all()) and np.array_equal(self._sorted[at], keys)

    def _create(self, keys: Ints, K: PETSc.Mat, indptr: Ints, columns: Ints) -> None:
        """Make the matrix, with the entries of K and those of ``keys`` (collective)."""
        g, size, n, lengths = self.config.gdim, self._size, len(indptr) - 1, np.diff(indptr)
        rows = np.zeros(n, dtype=bool)
        rows[np.append(keys, self._filled) // size] = True
        at = _entries(rows, indptr)
        there = np.repeat(np.arange(n), lengths * rows) * size + columns[at]
        fresh = np.setdiff1d(keys, there)
        new = np.union1d(fresh, self._filled)
        if self.config.comm.allreduce(len(new)) > KEPT_PLACES * self.config.comm.allreduce(len(fresh)):
            new = fresh
        self._filled = new
        # each goes before the entry of its row that follows it, or to the end of the row
        before = np.minimum(np.append(at, indptr[-1])[np.searchsorted(there, new)], indptr[new // size + 1])
        kept = np.ones(len(columns) + len(new), dtype=bool)
        kept[before + np.arange(len(new))] = False
        all_columns = np.insert(columns, before, (new % size).astype(columns.dtype))
        starts = indptr + np.append(0, np.cumsum(np.bincount(new // size, minlength=n))).astype(indptr.dtype)
        own = (all_columns >= self._first) & (all_columns < self._first + n)
        alone = self.config.comm.size == 1
        place = np.arange(len(own)) if alone else np.where(own, np.cumsum(own) - 1, own.sum() + np.cumsum(~own) - 1)
        self._own = None if alone else own[kept]
        crossed, diagonal = (place[k + np.searchsorted(before, k, side="right")] for k in (self._crossed, self._diagonal_of_K))
        self._emptied, self._diagonal = np.append(crossed, place[~kept]), diagonal
        self._sorted, self._key_places = np.union1d(there, new), place[_entries(rows, starts)]
        self._kept = np.empty_like(kept)
        self._kept[place] = kept
        self._values = np.zeros(len(own))
        arrays: Any = starts, all_columns, self._values
        if not alone:
            inside = np.append(0, np.cumsum(own))[starts].astype(PETSc.IntType)
            local = (all_columns[own] - self._first).astype(PETSc.IntType)
            arrays = (inside, local, self._values[: len(local)]), (starts - inside, all_columns[~own], self._values[len(local) :])
        self.A = PETSc.Mat().createAIJWithArrays(K.getSizes(), arrays, bsize=g, comm=K.comm)
        # multigrid looks for it, and petsc4py 3.18 forgets it
        self.A.setBlockSize(g)


def _product(H: PETSc.Mat, P: PETSc.Mat, Q: PETSc.Mat) -> PETSc.Mat:
    """``Q'HP``."""
    return H.PtAP(P) if P is Q else Q.transposeMatMult(H.matMult(P))


def _entries(rows: Bools, indptr: Ints) -> Ints:
    """Places of the entries in some of the rows."""
    which = np.flatnonzero(rows)
    lengths = indptr[which + 1] - indptr[which]
    return np.arange(lengths.sum()) + np.repeat(indptr[which] - np.cumsum(lengths) + lengths, lengths)
