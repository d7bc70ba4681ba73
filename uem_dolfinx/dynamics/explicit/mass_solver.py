"""Solves with the united system of masses, which couples only the nodes of active equations and the nodes that they follow."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.blocks import Blocks, blocks_of_matrix, product, rows_at, together
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array
from uem_dolfinx.dynamics.explicit.part_solver import PartSolver


class MassSolver(PartSolver):
    """Solver of ``Q'(M + G)P`` for diagonal masses M: a small factorisation, and a division at all other unknowns.

    G are terms of friction at active contactors.
    """

    #: State of the values of M.
    _state = -1

    def _unite(self, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None) -> None:
        """Factorise the united matrix at the coupled nodes (collective)."""
        if self._state != K.stateGet():
            self._state, self._mass = K.stateGet(), np.array(K.getDiagonal().array_r)
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
        idle = self._mass.reshape(-1, g)[nodes].ravel()
        self._factorise(nodes, product(test.transposed, forces), idle, P is Q and G is None)

    def _uncoupled(self, rhs: PETSc.Vec) -> Array:
        """Forces over masses."""
        return np.where(self._used, rhs.array_r / self._mass, 0.0)
