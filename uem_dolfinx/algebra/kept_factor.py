"""Solves with the factorisation of an earlier matrix as preconditioner; return of solvers to their last accepted step.

While contactors slide, P and the curvature of the contact change little and near the contact only, and so does the tangent of bodies
whose strains hardly change. A Krylov method preconditioned by the old factorisation takes a few solves; a new factorisation takes as long
as ten, in 3D as up to a hundred. The constrained matrix is not assembled. ``Q'KP`` with Q different from P has the factorisation of
another such matrix.

The determinants of both matrices have the same sign if none of the real eigenvalues of ``Q'KP`` times the old inverse is negative. The
Krylov method approximates those that are far from one; a factorisation that leaves a negative one does not serve.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra import mumps
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Bools
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import reduced


class Returning:
    """An object whose attributes ``commit`` keeps and ``restore`` brings back.

    A PETSc object that ``commit`` has kept is neither changed nor destroyed until another is kept: memory holds both, if a step makes
    another one, until it is accepted or refused.
    """

    made: ClassVar[str] = ""  # name of the attribute with a PETSc object; empty without one
    #: Names of attributes that are of the same kind, and of those that ``restore`` does not bring back.
    parts: ClassVar[tuple[str, ...]] = ()
    stays: ClassVar[tuple[str, ...]] = ()
    _last: dict[str, Any] | None = None  # attributes at the end of the last accepted step

    def commit(self) -> None:
        """Keep the present attributes (collective)."""
        last, self._last = self._last, None
        if self.made and last is not None and last[self.made] is not self.__dict__[self.made]:
            _destroy(last[self.made])
        self._last = {name: value for name, value in self.__dict__.items() if name not in self.stays}
        del self._last["_last"]
        for part in self.parts:
            self.__dict__[part].commit()

    def restore(self) -> None:
        """Bring back the attributes that ``commit`` has kept (collective)."""
        assert self._last is not None
        self.lose()
        self.__dict__.update(self._last)
        for part in self.parts:
            self.__dict__[part].restore()

    @property
    def keeps(self) -> bool:
        """Whether the present PETSc object is that of the last accepted step."""
        return self._last is not None and self._last[self.made] is self.__dict__[self.made]

    def lose(self) -> None:
        """Destroy the present PETSc object, unless it is kept (collective)."""
        if self.made and not self.keeps:
            _destroy(self.__dict__.get(self.made))


def _destroy(made: Any) -> None:
    if made is not None:
        # garbage would keep factors until the next iteration
        made.destroy()


#: A factorisation that has not done after so many solves is made anew, unless its counted cost allows more.
#: [convention; solves; test_kept_factor.py::test_a_factor_that_does_not_serve]
MOST_SOLVES = 8
#: A solve takes as long, for every entry of L and U, as so many operations of the factorisation: it waits for memory.
#: [convention; operations; test_kept_factor.py::test_a_factor_may_take_as_long_as_another]
OF_AN_ENTRY = 20
#: Unknowns that are used more, or fewer, than in the factorised matrix take so many times the root of their number of solves.
#: [convention; solves; test_kept_factor.py::test_a_factor_serves_few_changes]
OF_CHANGES = 4.0
#: A factorisation serves for bodies whose stiffness has changed by no more than this part anywhere.
#: [convention; diagonal of K; test_kept_factor.py::test_a_factor_serves_few_changes]
ALIKE = 0.02
#: Solves leave no more than this part of their right-hand side, however loose the tolerance is: another digit is cheaper than another
#: Newton iteration. [convention; right-hand side; test_kept_factor.py::test_a_factor_leaves_little]
LEAST_ACCURATE = 1e-3


class KeptFactor(Returning):
    """The last factorisation of ``Q'KP`` in a space, with data of its matrix."""

    def __init__(self, space: Nodes):
        self.space = space
        self._pc: Any = None
        self._most = MOST_SOLVES
        self.cheap = True  # whether the last solve was much cheaper than a factorisation may be
        self._made_with: Any = None  # mask of the used columns of P, the diagonal of K, and whether Q is P

    def keep(self, pc: PETSc.PC, P: Restriction, K: PETSc.Mat, Q: Restriction) -> None:
        """Keep a new factorisation; not in mixed problems, where one tolerance does not fit residuals with different units."""
        if self.space.mixed:
            return
        self._pc, self._made_with, self._most = pc, (P.used, K.getDiagonal(), Q is P), most_solves(pc)

    def drop(self) -> None:
        """Drop the factorisation, so that the next matrix is factorised."""
        self._pc = self._made_with = None

    def serves(self, P: Restriction, K: PETSc.Mat, Q: Restriction) -> bool:
        """Whether K is nearly unchanged, and all but a few of the used unknowns are the same (collective)."""
        changed: float = np.inf
        if self._made_with is not None:
            used, diagonal, alike = self._made_with
            there = diagonal.array_r
            if alike == (Q is P) and (np.abs(K.getDiagonal().array_r - there) <= ALIKE * np.abs(there)).all():
                changed = float(np.count_nonzero(used != P.used))
        return bool(OF_CHANGES * np.sqrt(reduced(self.space.comm, changed)) <= self._most)

    def solve(
        self, P: Restriction, K: PETSc.Mat, curvature: PETSc.Mat | None, Q: Restriction, rhs: PETSc.Vec, accuracy: float
    ) -> tuple[PETSc.Vec, int] | None:
        """Unknowns with a relative residual of at most ``accuracy``, and the number of solves; None after too many (collective)."""
        if self._pc is None:
            return None
        ksp = PETSc.KSP().create(self.space.comm)
        A = PETSc.Mat().createPython(K.getSizes(), _United(P, K, curvature, Q), comm=self.space.comm)
        ksp.setOperators(A)
        ksp.setType("fgmres")
        ksp.setComputeEigenvalues(Q is not P)
        ksp.setGMRESRestart(self._most)
        ksp.setTolerances(rtol=min(accuracy, LEAST_ACCURATE), max_it=self._most)
        pc = ksp.getPC()
        pc.setType("python")
        pc.setPythonContext(_Solves(self._pc, ~P.used.ravel()))
        dq = rhs.duplicate()
        dq.set(0.0)
        with timed("linear solve"):
            ksp.solve(rhs, dq)
        solves = int(ksp.getIterationNumber())
        self.cheap, found = solves <= MOST_SOLVES, (dq, solves) if ksp.getConvergedReason() > 0 else None
        if found is not None and Q is not P and (ksp.computeEigenvalues().real < 0.0).any():
            found = None
        # otherwise P would be kept alive
        ksp.reset()
        ksp.destroy()
        A.destroy()
        return found


def most_solves(pc: PETSc.PC) -> int:
    """Number of solves that take as long as the factorisation, by MUMPS' counts of both; for other packages ``MOST_SOLVES``."""
    cost = mumps.made(pc)
    if cost is None:
        return MOST_SOLVES
    # symmetric factors are L alone, which a solve reads twice
    entries = cost.entries * (2 if pc.getType() == "cholesky" else 1)
    return max(MOST_SOLVES, int(cost.flops / (OF_AN_ENTRY * max(entries, 1.0))))


class _United:
    """``Q'(K + G)P`` as a map, for unknowns that are zero at idle columns of P."""

    def __init__(self, P: Restriction, K: PETSc.Mat, G: PETSc.Mat | None, Q: Restriction):
        self.P, self.K, self.G, self.Q = P, K, G, Q

    def mult(self, _: PETSc.Mat, q: PETSc.Vec, y: PETSc.Vec) -> None:
        """``y = Q'(K + G)P q``."""
        du = self.P.expand(q)
        self.Q.transpose(forms.product(self.K, du, self.G)).copy(y)


class _Solves:
    """Solves by an unchanged factorisation; idle unknowns ``(n_owned block,)`` are set to zero."""

    def __init__(self, pc: PETSc.PC, idle: Bools):
        self.pc, self.idle = pc, idle

    def apply(self, _: PETSc.PC, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """One solve."""
        self.pc.apply(x, y)
        y.array[self.idle] = 0.0
