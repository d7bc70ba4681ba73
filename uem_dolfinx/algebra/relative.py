"""A linearised problem in relative coordinates: gaps and slips of contactors in slots of their own, everything else condensed.

Each equation of a contactor defines a relative motion ``w = direction . du_i - sum_j C_ij . du_j``. Solved for the contactor's own
components, these are a change of variables ``du = T y + c``: y contains w in the slots of the eliminated components, and the unknowns of
P elsewhere. T is P with all of these equations active, and their lifts in the columns of the slots, so that P and c of every state are
columns of T. With ``K_U = T'(K + G)T`` condensed onto the slots,

    force = S w + f

are the multipliers of all equations, whichever contactors are open, stick or slip. Motions w give those of the bodies without another
factorisation. Where the bodies are linear, T changes little while contactors slide: the factorisation and S then serve other T, with
the forces that T itself leaves, in a few passes.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra import mumps
from uem_dolfinx.algebra.blocks import is_symmetric, stiffen
from uem_dolfinx.algebra.kept_factor import Returning
from uem_dolfinx.algebra.products import UnitedMatrix
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Bools, Ints
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import on_root, reduced

#: Solutions leave this part of the forces: what is below comes near to rounding.
#: [convention; norm of the forces; test_settle.py::test_a_condensation_serves_other_coordinates]
BALANCED = 1e-10


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
        nodes: mask of owned nodes with slots ``(n_owned,)``.
        moved_on: whether the present coordinates are others than those of the factorisation.
    """

    def __init__(self, space: Nodes, trial: RelativeCoordinates, test: RelativeCoordinates, K: PETSc.Mat, G: PETSc.Mat | None):
        self.space, self.trial, self.test, self._K, self._G = space, trial, test, K, G
        self._at, self.moved_on, self.left = _slots(trial), False, 0.0
        self.nodes: Bools = np.zeros(space.n_owned, dtype=bool)
        self.nodes[self._at // space.block] = True
        A = UnitedMatrix(space, False).update(trial.T, test.T, K, G)
        symmetric = is_symmetric(A, space)
        A.setOption(PETSc.Mat.Option.SYMMETRIC, symmetric)
        self._pc = PETSc.PC().create(space.comm)
        self._pc.setType("cholesky" if symmetric else "lu")
        self._pc.setOperators(A)
        self.stiffness: Any
        with timed("factorisation or preconditioner set-up"):
            self.stiffness = mumps.schur_complement(self._pc, self._at + space.block * space.first)
            self.negative, self.indefinite = mumps.is_negative(self._pc), mumps.is_indefinite(self._pc)
            if self.stiffness is not None and not mumps.solves_with_schur_complement(space.comm):
                self.stiffness = self.stiffness if self._factorise_inside(A) else None

    def _factorise_inside(self, A: PETSc.Mat) -> bool:
        """Factorise without the slots, since the factorisation with a Schur complement cannot solve; whether it succeeds (collective)."""
        inside, inner = A.copy(), self.space.vector(~self._held)
        inside.diagonalScale(inner, inner)
        stiffen(inside, self._K, self._held)
        self._pc.reset()
        self._pc.setOperators(inside)
        self._pc.setUp()
        return bool(self._pc.getFailedReason() == PETSc.PC.FailedReason.NOERROR)

    def serves(self, trial: RelativeCoordinates) -> bool:
        """Whether other coordinates have the same slots (collective)."""
        same = np.array_equal(_slots(trial), self._at) and np.array_equal(trial.T.used, self.trial.T.used)
        return not reduced(self.space.comm, int(not same))

    def use(self, trial: RelativeCoordinates, test: RelativeCoordinates, K: PETSc.Mat, G: PETSc.Mat | None) -> None:
        """Solve in other coordinates with the same slots; arguments as of the class."""
        self.trial, self.test, self._K, self._G, self.moved_on = trial, test, K, G, True

    def begin(self, F: PETSc.Vec) -> None:
        """Begin without relative motion, under forces F of the bodies (collective)."""
        self._left = self.test.T.transpose(F + forms.product(self._K, self.trial.T.c, self._G))
        self._y = self._left.duplicate()
        self._y.set(0.0)
        self._driving = self._inside().norm()

    def forces(self) -> Any:
        """Forces in the slots once the bodies have followed their motions, on rank 0; an empty array elsewhere (collective)."""
        moved = self._left.duplicate()
        self._pc.apply(-self._inside(), moved)
        moved.array[self._at] = 0.0
        self._move(moved)
        return on_root(self.space.comm, self._left.array_r[self._at])

    def balanced(self, force: Any, left: float) -> bool:
        """Whether ``force``, on rank 0, and the forces in the slots agree, and no others are left (collective).

        ``left`` is the part of the first forces outside the slots that may be left; the attribute is the part that is.
        """
        there = on_root(self.space.comm, self._left.array_r[self._at])
        apart = np.linalg.norm(there - force) if self.space.comm.rank == 0 else 0.0
        apart = self._inside().norm() + self.space.comm.bcast(apart)
        self.left = apart / self._driving if self._driving > 0 else 0.0
        return bool(apart <= max(BALANCED * self._left.norm(), left * self._driving))

    def _inside(self) -> PETSc.Vec:
        """Forces outside the slots."""
        inside = self._left.copy()
        inside.array[self._held] = 0.0
        return inside

    def move(self, way: Any) -> None:
        """Move the contactors further by relative motions, on rank 0 ``(k,)`` (collective)."""
        comm, slots = self.space.comm, self._y.duplicate()
        counts = np.cumsum(comm.allgather(len(self._at)))
        slots.set(0.0)
        slots.array[self._at] = comm.scatter(np.split(way, counts[:-1]) if comm.rank == 0 else None)
        self._move(slots)

    def _move(self, y: PETSc.Vec) -> None:
        self._y += y
        self._left += self.test.T.transpose(forms.product(self._K, self.trial.T.expand(y), self._G))

    @property
    def _held(self) -> Bools:
        """Mask of slots and unused unknowns."""
        held = ~self.trial.T.used.ravel()
        held[self._at] = True
        return held

    def moved(self) -> PETSc.Vec:
        """The increment du (collective)."""
        return self.trial.T.expand(self._y) + self.trial.T.c

    def numbers(self, which: Ints) -> Ints:
        """Positions in S of the slots of some equations ``(...)``, -1 for -1 (collective)."""
        counts = self.space.comm.allgather(len(self._at))
        first = sum(counts[: self.space.comm.rank])
        return np.where(which >= 0, first + np.searchsorted(self._at, self.trial.slot[which]), -1)

    def destroy(self) -> None:
        """Free the factors (collective)."""
        self._pc.destroy()


class KeptCondensation(Returning):
    """The last condensation, which bodies whose K is constant use for other coordinates."""

    made = "now"

    def __init__(self) -> None:
        self.now: Condensation | None = None

    def drop(self) -> None:
        """Forget it (collective)."""
        self.lose()
        self.now = None

    def make(self, *of: Any) -> Condensation | None:
        """A new one, see ``Condensation``; None if MUMPS fails (collective)."""
        self.drop()
        self.now = Condensation(*of)
        if reduced(self.now.space.comm, int(self.now.stiffness is None)):
            self.drop()
        return self.now


def _slots(coordinates: RelativeCoordinates) -> Ints:
    """Local components that are slots, sorted."""
    return np.sort(coordinates.slot[coordinates.slot >= 0])
