"""Solves by the factorisation of an earlier united matrix, where little has changed since.

While contactors slide, P and the curvature of the contact change by little and near the contact only, and so does the tangent of bodies
that are hardly strained any more: a Krylov method that has the old factorisation as its preconditioner takes a few of its solves, a new
one as long as some ten. No united matrix is made for it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Bools
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import reduced

#: A factorisation that has not done after so many solves is made anew, which takes about as long.
#: [convention; solves; test_kept_factor.py::test_a_factor_that_does_not_serve]
MOST_SOLVES = 8
#: Solves with a factorisation in which so many unknowns more, or fewer, are used than in the matrix it serves take some more.
#: [convention; unknowns; test_kept_factor.py::test_a_factor_serves_few_changes]
FEW_CHANGES = 4
#: A factorisation serves for bodies whose stiffness has changed by no more than this part anywhere.
#: [convention; diagonal of K; test_kept_factor.py::test_a_factor_serves_few_changes]
ALIKE = 0.02
#: Solves leave no more than this part of their right-hand side, however little is asked for: another digit is cheaper than another
#: Newton iteration.
#: [convention; right-hand side; test_kept_factor.py::test_a_factor_leaves_little]
LEAST_ACCURATE = 1e-3


class KeptFactor:
    """The last factorisation of ``P'KP``, and what it was made with.

    Args:
        space: the space that K acts on.
    """

    def __init__(self, space: Nodes):
        self.space = space
        self._pc: Any = None
        #: Which columns of P were used, and the diagonal of K.
        self._made_with: Any = None

    def keep(self, pc: PETSc.PC, P: Restriction, K: PETSc.Mat) -> None:
        """Take a factorisation that has just been made; with other fields none, since what is left of a force may be all of a heat."""
        if self.space.mixed:
            return
        self._pc, self._made_with = pc, (P.used, K.getDiagonal())

    def drop(self) -> None:
        """Let the next united matrix be factorised."""
        self._pc = self._made_with = None

    def serves(self, P: Restriction, K: PETSc.Mat) -> bool:
        """Whether K is nearly the same, and so are the unknowns but for a few (collective)."""
        changed: float = np.inf
        if self._made_with is not None:
            used, diagonal = self._made_with
            there = diagonal.array_r
            if (np.abs(K.getDiagonal().array_r - there) <= ALIKE * np.abs(there)).all():
                changed = float(np.count_nonzero(used != P.used))
        return bool(reduced(self.space.comm, changed) <= FEW_CHANGES)

    def solve(
        self, P: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None, rhs: PETSc.Vec, accuracy: float
    ) -> tuple[PETSc.Vec, int] | None:
        """Unknowns that leave no more than the part ``accuracy`` of ``rhs``, and how many solves; None after too many (collective)."""
        if self._pc is None:
            return None
        ksp = PETSc.KSP().create(self.space.comm)
        A = PETSc.Mat().createPython(K.getSizes(), _United(P, K, curvature), comm=self.space.comm)
        ksp.setOperators(A)
        ksp.setType("fgmres")
        ksp.setGMRESRestart(MOST_SOLVES)
        ksp.setTolerances(rtol=min(accuracy, LEAST_ACCURATE), max_it=MOST_SOLVES)
        pc = ksp.getPC()
        pc.setType("python")
        pc.setPythonContext(_Solves(self._pc, ~P.used.ravel()))
        dq = rhs.duplicate()
        dq.set(0.0)
        with timed("linear solve"):
            ksp.solve(rhs, dq)
        found = (dq, int(ksp.getIterationNumber())) if ksp.getConvergedReason() > 0 else None
        # P would live on with them
        ksp.reset()
        ksp.destroy()
        A.destroy()
        return found


class _United:
    """``P'(K + G)P`` as a map, of unknowns that are zero where columns of P are idle."""

    def __init__(self, P: Restriction, K: PETSc.Mat, G: PETSc.Mat | None):
        self.P, self.K, self.G = P, K, G

    def mult(self, _: PETSc.Mat, q: PETSc.Vec, y: PETSc.Vec) -> None:
        """``y = P'(K + G)P q``."""
        du = self.P.expand(q)
        self.P.transpose(forms.product(self.K, du, self.G)).copy(y)


class _Solves:
    """Solves by a factorisation that is not to be made anew; unknowns that are not used ``(n_owned block,)`` stay zero."""

    def __init__(self, pc: PETSc.PC, idle: Bools):
        self.pc, self.idle = pc, idle

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """One solve."""
        self.pc.apply(x, y)
        y.array[self.idle] = 0.0
