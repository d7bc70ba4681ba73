"""Solves with a united system of explicit steps, of which only the unknowns of some nodes are coupled: these are factorised."""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra.blocks import Blocks, in_rows, to_owners
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.products import made_of
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.errors import LinearSolveError
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed


class PartSolver(UnitedSolver):
    """Solver of ``Q'(K + G)P`` by a factorisation of a few unknowns; methods are those of ``UnitedSolver``.

    Args:
        space: the space that K acts on.
        prefix: of PETSc's options.
    """

    cheap = True
    tells_sign = False

    def __init__(self, space: Nodes, prefix: str):
        super().__init__(space, prefix, {"ksp_type": "preonly", "pc_type": "lu"})
        self.lasting = True
        self._pc: PETSc.PC | None = None
        self._at: Ints = np.zeros(0, np.int64)
        #: Columns of P in use, and fingerprint of the matrix without coefficients of P.
        self._used: Bools = np.zeros(0, bool)
        self._alike: tuple[Any, ...] | None = None

    def set_operator(
        self, restriction: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, test: Restriction | None = None, roughly: bool = False
    ) -> None:
        """Set ``Q'(K + G)P``, and factorise its coupled part; without slip and ``roughly``, not where P's coefficients alone change.

        Collective.
        """
        P, Q = restriction, test or restriction
        made = made_of(P, Q, K, G, False)
        if made is not None and made == self._made_of:
            return
        alike = made_of(P, Q, K, G, True)
        if roughly and made is not None and alike == self._alike:
            return
        self._made_of, self._alike, self._used = made, alike, P.used.ravel()
        with timed("united matrix of explicit steps"):
            self._unite(P, Q, K, G)

    def take(self, solved: Any, P: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, Q: Restriction) -> None:
        """As ``set_operator``: a factorisation costs no more than it saves (collective)."""
        self.set_operator(P, K, G, Q)

    def _unite(self, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None) -> None:
        """Factorise the united matrix at the coupled nodes (collective)."""
        raise NotImplementedError

    def _factorise(self, nodes: Ints, A: Blocks, idle: Array, symmetric: bool) -> None:
        """Factorise a matrix of owned ``nodes (k,)``, with entries ``idle (k block,)`` on the diagonal of idle unknowns (collective)."""
        space, g = self.space, self.space.block
        self._at, self._pc = (g * nodes[:, None] + np.arange(g)).ravel(), None
        size = space.comm.allreduce(len(nodes))
        if not size:
            return
        first = int(space.comm.scan(len(nodes))) - len(nodes)
        numbers = np.zeros((space.n_owned, 1), dtype=np.int64)
        numbers[nodes, 0] = first + np.arange(len(nodes))
        A = to_owners(space, A)
        found, place = np.unique(A.column, return_inverse=True)
        columns = space.ask_owners(found, numbers)[place, 0]
        diagonal = np.where(self._used[self._at], 0.0, idle).reshape(-1, g, 1) * np.eye(g)
        i = np.concatenate([numbers[A.row - space.first, 0] - first, np.arange(len(nodes))])
        j, value = np.concatenate([columns, first + np.arange(len(nodes))]), np.concatenate([A.value, diagonal])
        matrix = PETSc.Mat().createAIJ(
            ((g * len(nodes), None), (g * len(nodes), None)), csr=_lines(i, j, value, len(nodes), size), comm=space.comm
        )
        self._rhs, self._dq = matrix.createVecs()
        self._pc = factorised(matrix, symmetric)

    def _uncoupled(self, rhs: PETSc.Vec) -> Array:
        """Solution at all unknowns that are not coupled ``(n,)``, zero where idle."""
        return np.zeros(self._used.size)

    def solve(self, rhs: PETSc.Vec, accuracy: float = 0.0, near: PETSc.Vec | None = None) -> tuple[PETSc.Vec, int]:
        """Solve for dq, and 1 for the number of linear iterations (collective).

        Raises:
            LinearSolveError: if the matrix is singular.
        """
        with timed("linear solve"):
            dq = self.space.vector(self._uncoupled(rhs))
            if self._pc is not None:
                used = self._used[self._at]
                self._rhs.array[:] = np.where(used, rhs.array_r[self._at], 0.0)
                self._pc.apply(self._rhs, self._dq)
                dq.array[self._at] = np.where(used, self._dq.array_r, 0.0)
        if np.isfinite(dq.norm()):
            return dq, 1
        raise LinearSolveError(
            "the united system of an explicit step is singular: equations conflict, a surface without mass is loose, or friction leaves "
            "no solution"
        )

    def forces(self, K: PETSc.Mat, du: PETSc.Vec) -> PETSc.Vec:
        """``K du`` (collective)."""
        return forms.product(K, du)


def factorised(A: PETSc.Mat, symmetric: bool) -> PETSc.PC:
    """A matrix, factorised (collective)."""
    A.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
    pc = PETSc.PC().create(A.comm)
    pc.setType("cholesky" if symmetric else "lu")
    if A.comm.size > 1:
        pc.setFactorSolverType("mumps")
    pc.setOperators(A)
    with timed("factorisation or preconditioner set-up"):
        pc.setUp()
    return pc


def _lines(row: Ints, column: Ints, value: Array, n: int, size: int) -> tuple[Array, Array, Array]:
    """Compressed lines of n rows of blocks, from the local row and the column of each block ``(k, g, g)``; repeated ones add."""
    from scipy.sparse import bsr_matrix

    g = value.shape[1]
    A = bsr_matrix(in_rows(row, column, value, n), shape=(g * n, g * size)).tocsr()
    A.sum_duplicates()
    return A.indptr.astype(PETSc.IntType), A.indices.astype(PETSc.IntType), A.data
