"""Solves with the united system of masses, which couples only the nodes of active equations and the nodes that they follow."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra.blocks import Blocks, blocks_of_matrix, in_rows, product, rows_at, to_owners, together
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.products import made_of
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.dynamics.explicit.surface import factorised
from uem_dolfinx.errors import LinearSolveError
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed


class MassSolver(UnitedSolver):
    """Solver of ``Q'(M + G)P`` for diagonal masses M: a small factorisation, and a division at all other unknowns.

    G are terms of friction at active contactors. Methods are those of ``UnitedSolver``.

    Args:
        space: the space that M acts on.
        prefix: of PETSc's options.
    """

    cheap = True
    tells_sign = False

    def __init__(self, space: Nodes, prefix: str):
        super().__init__(space, prefix, {"ksp_type": "preonly", "pc_type": "lu"})
        #: State of the values of M.
        self._state = -1

    def set_operator(
        self, restriction: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, test: Restriction | None = None, roughly: bool = False
    ) -> None:
        """Set ``Q'(K + G)P`` of diagonal K, and factorise its part of the coupled nodes (collective)."""
        P, Q = restriction, test or restriction
        before, self._made_of = self._made_of, made_of(P, Q, K, G, False)
        if before is not None and before == self._made_of:
            return
        if self._state != K.stateGet():
            self._state, self._mass = K.stateGet(), np.array(K.getDiagonal().array_r)
        self._used: Bools = P.used.ravel()
        with timed("united matrix P'MP"):
            self._unite(P, Q, G)

    def _unite(self, P: Restriction, Q: Restriction, G: PETSc.Mat | None) -> None:
        """Factorise the united matrix at the coupled nodes (collective)."""
        space, g = self.space, self.space.block
        more = None if G is None else blocks_of_matrix(space, G)
        coupled = np.zeros(space.n_owned, dtype=bool)
        for R in (P, Q):
            coupled[R.united] = coupled[R.followed_here] = True
        if more is not None:
            coupled[more.row - space.first] = True
        nodes = np.flatnonzero(coupled)
        trial = P.rows_of(nodes)
        test = trial if P is Q else Q.rows_of(nodes)
        forces = Blocks(trial.row, trial.column, self._mass.reshape(-1, g)[trial.row - space.first][:, :, None] * trial.value)
        if more is not None:
            forces = together(forces, product(more, rows_at(space, trial, np.unique(more.column))))
        A = product(test.transposed, forces)
        self._at: Ints = (g * nodes[:, None] + np.arange(g)).ravel()
        self._pc: PETSc.PC | None = None
        size = space.comm.allreduce(len(nodes))
        if not size:
            return
        first = int(space.comm.scan(len(nodes))) - len(nodes)
        numbers = np.zeros((space.n_owned, 1), dtype=np.int64)
        numbers[nodes, 0] = first + np.arange(len(nodes))
        A = to_owners(space, A)
        found, place = np.unique(A.column, return_inverse=True)
        columns = space.ask_owners(found, numbers)[place, 0]
        # idle unknowns have their mass on the diagonal
        idle = np.where(self._used[self._at], 0.0, self._mass[self._at]).reshape(-1, g, 1) * np.eye(g)
        i = np.concatenate([numbers[A.row - space.first, 0] - first, np.arange(len(nodes))])
        j, value = np.concatenate([columns, first + np.arange(len(nodes))]), np.concatenate([A.value, idle])
        matrix = PETSc.Mat().createAIJ(
            ((g * len(nodes), None), (g * len(nodes), None)), csr=_lines(i, j, value, len(nodes), size), comm=space.comm
        )
        self._rhs, self._dq = matrix.createVecs()
        self._pc = factorised(matrix, P is Q and G is None)

    def solve(self, rhs: PETSc.Vec, accuracy: float = 0.0, near: PETSc.Vec | None = None) -> tuple[PETSc.Vec, int]:
        """Solve for dq, and 1 for the number of linear iterations (collective).

        Raises:
            LinearSolveError: if the matrix is singular.
        """
        with timed("linear solve"):
            dq = self.space.vector(np.where(self._used, rhs.array_r / self._mass, 0.0))
            if self._pc is not None:
                self._rhs.array[:] = np.where(self._used, rhs.array_r, 0.0)[self._at]
                self._pc.apply(self._rhs, self._dq)
                dq.array[self._at] = np.where(self._used[self._at], self._dq.array_r, 0.0)
        if np.isfinite(dq.norm()):
            return dq, 1
        raise LinearSolveError(
            "the united system of masses is singular: equations conflict, or friction and mass leave no solution"
        )

    def forces(self, K: PETSc.Mat, du: PETSc.Vec) -> PETSc.Vec:
        """``M du`` (collective)."""
        return forms.product(K, du)


def _lines(row: Ints, column: Ints, value: Array, n: int, size: int) -> tuple[Array, Array, Array]:
    """Compressed lines of n rows of blocks, from the local row and the column of each block ``(k, g, g)``; repeated ones add."""
    from scipy.sparse import bsr_matrix

    g = value.shape[1]
    A = bsr_matrix(in_rows(row, column, value, n), shape=(g * n, g * size)).tocsr()
    A.sum_duplicates()
    return A.indptr.astype(PETSc.IntType), A.indices.astype(PETSc.IntType), A.data
