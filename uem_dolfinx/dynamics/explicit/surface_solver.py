"""Solves for a surface without mass, whose unknowns alone are free in an explicit step."""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.blocks import Blocks, blocks_of_matrix, product, rows_at, together
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Ints
from uem_dolfinx.dynamics.explicit.part_solver import PartSolver
from uem_dolfinx.geometry.nodes import Nodes


class SurfaceSolver(PartSolver):
    """Solver of ``Q'(K + G)P`` at the nodes with free components alone: the rows of K at other nodes are not read."""

    def __init__(self, space: Nodes, prefix: str):
        super().__init__(space, prefix)
        #: Free components, K and the state of its values that the rows of K have been read for.
        self._read_for: tuple[bytes, PETSc.Mat, int] | None = None

    def _unite(self, P: Restriction, Q: Restriction, K: PETSc.Mat, G: PETSc.Mat | None) -> None:
        """Factorise the united matrix at the free nodes (collective)."""
        space, g = self.space, self.space.block
        nodes = np.flatnonzero(P.free.any(axis=1))
        key = P.free.tobytes(), K, K.stateGet()
        if space.comm.allreduce(int(self._read_for != key)):
            self._read_for, own = key, (g * nodes[:, None] + np.arange(g)).ravel()
            columns = numbers(space, np.arange(g * space.n_owned))
            rows = blocks_of_matrix(space, K.createSubMatrix(numbers(space, own), columns))
            self._rows = Blocks(nodes[rows.row - space.first] + space.first, rows.column, rows.value)
            self._diagonal = np.array(K.getDiagonal().array_r[own])
        stiffness = self._rows if G is None else together(self._rows, blocks_of_matrix(space, G))
        trial = P.rows_of(nodes)
        test = trial if P is Q else Q.rows_of(nodes)
        forces = product(stiffness, rows_at(space, trial, np.unique(stiffness.column)))
        # a tangent may be unsymmetric
        self._factorise(nodes, product(test.transposed, forces), self._diagonal, False)


def numbers(space: Nodes, own: Ints) -> PETSc.IS:
    """Global numbers of owned unknowns ``(n,)``."""
    return PETSc.IS().createGeneral((own + space.block * space.first).astype(PETSc.IntType), comm=space.comm)
