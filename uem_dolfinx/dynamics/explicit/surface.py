"""Equilibrium of the surface with the contacts as they are, by a matrix of the surface alone that is factorised once.

The Newton loop of the united system then has nothing left to do but to check forces and gaps, unless the contact changes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import compat
from uem_dolfinx.algebra.products import UnitedMatrix
from uem_dolfinx.arrays import Ints
from uem_dolfinx.log import timed

#: Solves with the kept matrix in one step, before Newton's method goes on with its own.
#: [bound; solves; -]
MOST_SURFACE_SOLVES = 4
#: The kept matrix serves as long as Newton's method needs no more iterations after it.
#: [bound; iterations; -]
ITERATIONS_OF_KEPT = 1


class SurfaceSolver:
    """Solves for the surface of a problem with the equations of its last state (collective).

    Args:
        problem: a ``UnitedProblem``, whose nodes with mass are held while it is used.

    Attributes:
        kept: whether the factorisation is of the present contact, and good enough.
    """

    def __init__(self, problem: Any):
        self.problem, self.kept = problem, False
        self._pc: Any = None

    def learn(self, history: Any) -> None:
        """Take note of how much the Newton loop has had to do in a step."""
        self.kept = self.kept and len(history) <= ITERATIONS_OF_KEPT + 1 and not any(one.changed for one in history)

    def predict(self, start: Any) -> None:
        """Move nodes with mass to ``start (n,)``, ghosts included, and the surface from there into equilibrium with the last contact."""
        problem, bodies, system = self.problem, self.problem.bodies, self.problem.system
        if system.rows is None:
            return
        if not self.kept:
            self._factorise()
        u = np.array(start)
        compat.set_bc_values(u, bodies.bcs)
        bodies.u.x.array[:] = u
        bodies.u.x.scatter_forward()
        fine, before = bodies.assemble_once(), np.inf
        for _ in range(MOST_SURFACE_SOLVES):
            F = self._Q.transpose(system.residual())
            norm = F.norm()
            if not fine or norm >= before or norm <= problem.rtol * bodies.residual.norm():
                break
            with timed("linear solve"):
                self._rhs.array[:] = F.array_r[self._at]
                self._pc.apply(self._rhs, self._dq)
            F.array[:] = 0.0
            F.array[self._at] = -self._dq.array_r
            fine, before = bodies.move(self._P.expand(F)), norm
        if not fine:
            # Newton's method has a line search
            bodies.u.x.array[:] = problem.committed

    def _factorise(self) -> None:
        """Factorise ``Q'KP`` of the surface's unknowns."""
        system, bodies = self.problem.system, self.problem.bodies
        self._P, self._Q = system.rows.frictionless, system.rows.test
        space, P = bodies.unknowns, self._P
        A = UnitedMatrix(space, False).update(P, self._Q, bodies.update_tangent(), None)
        self._at: Ints = np.flatnonzero(P.used)
        own = PETSc.IS().createGeneral((self._at + space.block * space.first).astype(PETSc.IntType), comm=space.comm)
        self._A = A.createSubMatrix(own, own)
        self._rhs, self._dq = self._A.createVecs()
        self._pc, self.kept = factorised(self._A, P is self._Q), True


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
