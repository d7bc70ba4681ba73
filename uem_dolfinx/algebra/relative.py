"""A linearised problem in relative coordinates: gaps and slips of contactors in slots of their own, everything else condensed.

Each equation of a contactor defines a relative motion ``w = direction . du_i - sum_j C_ij . du_j``. Solved for the contactor's own
components, these are a change of variables ``du = T y + c``: y contains w in the slots of the eliminated components, and the unknowns of
P elsewhere. T is P with all of these equations active, and their lifts in the columns of the slots, so that P and c of every state are
columns of T. With ``K_U = T'(K + G)T`` condensed onto the slots,

    force = S w + f

are the multipliers of all equations, whichever contactors are open, stick or slip. Motions w give those of the bodies without another
factorisation.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra import mumps
from uem_dolfinx.algebra.blocks import is_symmetric, stiffen
from uem_dolfinx.algebra.products import UnitedMatrix
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Bools, Ints
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import on_root


class RelativeCoordinates:
    """T for some equations, and their slots.

    Args:
        restriction: of equations that are active, those of slots with zero gaps.
        of_slots: mask of the equations with slots ``(m,)``.

    Attributes:
        slot: local component of each equation's slot, -1 without a slot ``(m,)``.
    """

    def __init__(self, restriction: Restriction, of_slots: Bools):
        R, eq = restriction, restriction.equations
        self.T, self.slot = R, np.full(len(eq), -1, dtype=np.int64)
        frames, lift = R.frames.copy(), R.lift
        for at, rows in eq.by_node():
            place = np.searchsorted(R.nodes, at)
            # as many columns are idle as equations eliminate components
            idle = R.free[at] & ~(R.frames[place] != 0).any(axis=1)
            column = np.argsort(~idle, axis=1, kind="stable")[:, : rows.shape[1]]
            k, r = np.nonzero(of_slots[rows])
            frames[place[k], :, column[k, r]] = lift[rows[k, r]]
            self.slot[rows[k, r]] = R.space.block * at[k] + column[k, r]
        R.frames = frames
        R.used[R.nodes] = (frames != 0).any(axis=1)


class Condensation:
    """``T'(K + G)T`` condensed onto the slots.

    Args:
        space: the space that K acts on.
        trial: T of the motion.
        test: T of the forces; the same object if both have the same weights.
        G: the curvature, or None.

    Attributes:
        stiffness: S on rank 0, in the order of the ranks' slots, else empty; None if MUMPS fails.
        negative: whether the matrix without the slots has a negative determinant.
        indefinite: whether it is symmetric, and has negative eigenvalues.
    """

    def __init__(self, space: Nodes, trial: RelativeCoordinates, test: RelativeCoordinates, K: PETSc.Mat, G: PETSc.Mat | None):
        self.space, self.trial, self.test, self._K, self._G = space, trial, test, K, G
        self._at: Ints = np.sort(trial.slot[trial.slot >= 0])
        self.A = UnitedMatrix(space, False).update(trial.T, test.T, K, G)
        symmetric = is_symmetric(self.A, space)
        self.A.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        self._pc = PETSc.PC().create(space.comm)
        self._pc.setType("cholesky" if symmetric else "lu")
        self._pc.setOperators(self.A)
        self.stiffness: Any
        with timed("factorisation or preconditioner set-up"):
            self.stiffness = mumps.schur_complement(self._pc, self._at + space.block * space.first)
            self.negative, self.indefinite = mumps.is_negative(self._pc), mumps.is_indefinite(self._pc)
            if self.stiffness is not None and not mumps.solves_with_schur_complement(space.comm):
                self.stiffness = self.stiffness if self._factorise_inside() else None

    def _factorise_inside(self) -> bool:
        """Factorise without the slots, since the factorisation with a Schur complement cannot solve; whether it succeeds (collective)."""
        inside, used = self.A.copy(), self.trial.T.used.ravel().copy()
        used[self._at] = False
        inner = self.space.vector(used)
        inside.diagonalScale(inner, inner)
        stiffen(inside, self._K, ~used)
        self._pc.reset()
        self._pc.setOperators(inside)
        self._pc.setUp()
        return bool(self._pc.getFailedReason() == PETSc.PC.FailedReason.NOERROR)

    def load(self, F: PETSc.Vec) -> Any:
        """Forces in the slots without relative motion under forces F of the bodies, on rank 0; an empty array elsewhere (collective)."""
        self._y = self.test.T.transpose(F + forms.product(self._K, self.trial.T.c, self._G))
        left = self._y + self.A * self._moved(self._y)
        return on_root(self.space.comm, left.array_r[self._at])

    def _moved(self, y: PETSc.Vec) -> PETSc.Vec:
        """Unknowns in equilibrium with forces ``y`` on them, zero in slots (collective)."""
        inside, moved = -y, y.duplicate()
        inside.array[self._at] = 0.0
        inside.array[~self.trial.T.used.ravel()] = 0.0
        self._pc.apply(inside, moved)
        moved.array[self._at] = 0.0
        return moved

    def moved(self, w: Any) -> PETSc.Vec:
        """Increment du with relative motions w, on rank 0 ``(k,)``, under the forces of the last ``load`` (collective)."""
        comm, slots = self.space.comm, self._y.duplicate()
        counts = np.cumsum(comm.allgather(len(self._at)))
        slots.array[:] = 0.0
        slots.array[self._at] = comm.scatter(np.split(w, counts[:-1]) if comm.rank == 0 else None)
        du = self.trial.T.expand(slots + self._moved(self._y + self.A * slots))
        return du + self.trial.T.c

    def numbers(self, which: Ints) -> Ints:
        """Positions in S of the slots of some equations ``(...)``, -1 for -1 (collective)."""
        counts = self.space.comm.allgather(len(self._at))
        first = sum(counts[: self.space.comm.rank])
        return np.where(which >= 0, first + np.searchsorted(self._at, self.trial.slot[which]), -1)

    def destroy(self) -> None:
        """Free the factors (collective)."""
        self._pc.destroy()
