"""Some of the nodes with numbers of their own, and the matrices of these nodes alone: they cost what contact is large, not the bodies."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.arrays import Bools, Ints
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import Exchange


class Part:
    """Components of some nodes, numbered rank by rank in the order of the whole (collective).

    Args:
        space: the space.
        nodes: which owned nodes belong to it ``(n_owned,)``.

    Attributes:
        nodes: owned nodes ``(k,)``.
        components: their owned components ``(k block,)``.
        sizes: own and global number of components, as PETSc takes them.
        first: number of the first own component in the part.
    """

    def __init__(self, space: Nodes, nodes: Bools):
        g, self.comm = space.block, space.comm
        self._space, self._has = space, nodes
        self.nodes = np.flatnonzero(nodes)
        self.components: Ints = (g * self.nodes[:, None] + np.arange(g)).ravel()
        self._starts = np.cumsum([0, *self.comm.allgather(len(self.components))])
        self.first = int(self._starts[self.comm.rank])
        self.sizes = ((len(self.components), int(self._starts[-1])),) * 2
        self._in_whole = self.components + g * int(space.index_map.local_range[0])
        self._is = PETSc.IS().createGeneral(self._in_whole.astype(PETSc.IntType), comm=self.comm)

    def of(self, A: PETSc.Mat) -> PETSc.Mat:
        """Rows and columns of the part (collective)."""
        return A.createSubMatrix(self._is, self._is)

    def in_whole(self, columns: Ints) -> Ints:
        """Global numbers that columns of the part's matrices have in the whole, the same shape (collective)."""
        if self.comm.size == 1:
            return np.asarray(self._in_whole[columns])
        asked, place = np.unique(columns, return_inverse=True)
        exchange = Exchange.to(self.comm, np.searchsorted(self._starts, asked, side="right") - 1)
        (arrived,) = exchange.send(asked.astype(np.int64))
        told = np.empty(len(asked), dtype=np.int64)
        (told[exchange.rows],) = exchange.back(self._in_whole[arrived - self.first])
        return np.asarray(told[place])

    def has(self, columns: Ints) -> Bools:
        """Whether global components ``(m,)`` of any rank belong to it (collective)."""
        g, n = self._space.block, len(self._has)
        nodes = columns // g - self._space.index_map.local_range[0]
        own = (nodes >= 0) & (nodes < n)
        found = np.zeros(len(columns), dtype=bool)
        found[own] = self._has[nodes[own]]
        asked, place = np.unique(columns[~own] // g, return_inverse=True)
        found[~own] = self._space.ask_owners(asked.astype(np.int64), self._has[:, None].astype(float))[place, 0] > 0
        return found
