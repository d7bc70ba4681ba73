"""PETSc's field split among other fields: which rows are whose, what multigrid is told of the displacement's, and what residuals weigh.

A force, a volume and a heat cannot be added: iterations would end where the field with the largest numbers has converged. So the rows and
columns of each field beside the displacement are multiplied by a number s, as of a pressure with ``S = C + B A^-1 B'``,

    s^2 mean(diag S) = mean(diag A),    diag S = |diag C| + B^2 / mean(diag A),

whatever units it has.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.deflation import near_null_space
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.parallel import reduced


class SolverOfFields(UnitedSolver):
    """KSP of a displacement among other fields; options may ask for a preconditioner of type fieldsplit."""

    #: By what rows and columns are multiplied, and what the preconditioner is made of.
    _scales: PETSc.Vec
    _scaled: PETSc.Mat

    @property
    def _splits(self) -> bool:
        return bool(self.pc.getType() == "fieldsplit")

    def _set_symmetric(self, restriction: Restriction, K: PETSc.Mat, G: PETSc.Mat | None) -> None:
        super()._set_symmetric(restriction, K, G)
        if self._splits:
            if self._new:
                self._scales = scales(self.space, self._A, restriction)
                begin(self.pc, self.space, self._A, restriction)
            self._scaled = scaled(self._A, self._scales)
            self.ksp.setOperators(self._scaled)

    def _set_unsymmetric(self, P: Restriction, Q: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None) -> None:
        super()._set_unsymmetric(P, Q, K, curvature)
        if self._splits:
            self.ksp.setOperators(scaled(self.ksp.getOperators()[0], self._scales), self._scaled)

    def solve(self, rhs: PETSc.Vec, accuracy: float = 0.0, near: PETSc.Vec | None = None) -> tuple[PETSc.Vec, int]:
        """Solve for dq; see ``UnitedSolver`` (collective)."""
        if not self._splits:
            return super().solve(rhs, accuracy, near)
        start = None if near is None else near.copy()
        if start is not None:
            start.pointwiseDivide(start, self._scales)
        weighed = rhs.copy()
        weighed.pointwiseMult(rhs, self._scales)
        dq, iterations = super().solve(weighed, accuracy, start)
        dq.pointwiseMult(dq, self._scales)
        return dq, iterations


def begin(pc: PETSc.PC, unknowns: Any, A: PETSc.Mat, restriction: Restriction) -> None:
    """Let a preconditioner forget the matrix before, and name the rows of fields to it (collective).

    Those of the displacement are ``u``, with its rigid-body modes, those of others have the number of their part of the mixed space.

    Args:
        pc: of type fieldsplit.
        unknowns: of the mixed space.
        A: united matrix.
        restriction: P.
    """
    rows = _rows(unknowns)
    rows[0].setBlockSize(unknowns.block)
    rows[0].compose("nearnullspace", near_null_space(unknowns, A, restriction))
    pc.reset()
    pc.setFieldSplitIS(*zip(unknowns.names, rows))


def scales(unknowns: Any, A: PETSc.Mat, restriction: Restriction) -> PETSc.Vec:
    """Numbers s by which rows and columns are to be multiplied, 1 of the displacement (collective); arguments as of ``begin``."""
    rows, used, field = _rows(unknowns), restriction.used.ravel(), unknowns.field
    diagonal, s = np.abs(A.getDiagonal().array_r), unknowns.vector(np.ones(len(field)))
    own = np.array([(diagonal[used & (field == f)].sum(), (used & (field == f)).sum()) for f in range(unknowns.n_fields)])
    total, count = np.asarray(reduced(unknowns.comm, own)).T
    stiffness = total[0] / max(count[0], 1.0)
    for f in range(1, unknowns.n_fields):
        B = A.createSubMatrix(rows[f], rows[0])
        schur = total[f] + (B.norm(PETSc.NormType.FROBENIUS) ** 2 / stiffness if stiffness > 0.0 else 0.0)
        if schur > 0.0 and stiffness > 0.0:
            s.array[field == f] = np.sqrt(stiffness * count[f] / schur)
        B.destroy()
    return s


def scaled(A: PETSc.Mat, s: PETSc.Vec) -> PETSc.Mat:
    """A copy of A whose rows and columns are multiplied (collective)."""
    out = A.copy()
    out.diagonalScale(s, s)
    return out


def _rows(unknowns: Any) -> list[PETSc.IS]:
    """Of each field; components that fill up the last row belong to the last field (collective)."""
    first = unknowns.block * unknowns.first
    field = np.where(unknowns.field < 0, unknowns.n_fields - 1, unknowns.field)
    owned = (np.flatnonzero(field == f) + first for f in range(unknowns.n_fields))
    return [PETSc.IS().createGeneral(rows.astype(PETSc.IntType), comm=unknowns.comm) for rows in owned]
