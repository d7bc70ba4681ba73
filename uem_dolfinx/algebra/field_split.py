"""PETSc's field split for mixed problems: rows of each field, near-null space of the displacement, and scaling of residuals.

Residuals of fields with different units cannot be added: iterations would end as soon as the field with the largest numbers has converged.
So rows and columns of each field other than the displacement are multiplied by a number s; for a pressure with ``S = C + B A^-1 B'``,

    s^2 mean(diag S) = mean(diag A),    diag S = |diag C| + B^2 / mean(diag A),

independent of its units.
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
    """KSP of a mixed problem; options may select a preconditioner of type fieldsplit."""

    #: Factors of rows and columns, and the scaled matrix of the preconditioner.
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
    """Reset a preconditioner, and set the rows of its fields (collective).

    The displacement's field is named ``u`` and has the rigid-body modes; other fields are named by their number in the mixed space.

    Args:
        pc: of type fieldsplit.
        unknowns: of the mixed space.
        A: constrained matrix.
        restriction: P.
    """
    rows = _rows(unknowns)
    rows[0].setBlockSize(unknowns.block)
    rows[0].compose("nearnullspace", near_null_space(unknowns, A, restriction))
    pc.reset()
    pc.setFieldSplitIS(*zip(unknowns.names, rows))


def scales(unknowns: Any, A: PETSc.Mat, restriction: Restriction) -> PETSc.Vec:
    """Factors s of rows and columns, 1 for the displacement (collective); arguments as in ``begin``."""
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
    """A copy of A with rows and columns multiplied by s (collective)."""
    out = A.copy()
    out.diagonalScale(s, s)
    return out


def _rows(unknowns: Any) -> list[PETSc.IS]:
    """Rows of each field; padding components of the last row belong to the last field (collective)."""
    first = unknowns.block * unknowns.first
    field = np.where(unknowns.field < 0, unknowns.n_fields - 1, unknowns.field)
    owned = (np.flatnonzero(field == f) + first for f in range(unknowns.n_fields))
    return [PETSc.IS().createGeneral(rows.astype(PETSc.IntType), comm=unknowns.comm) for rows in owned]
