"""Harmonics of cyclic parts: vibrations of a whole ring, of a nodal diameter k, by one of its N sectors.

The displacement ``u = a + i b`` of a sector goes over into that of the next one by the rotation R and the phase ``t = 2 pi k / N``, so
that nodes of the cut that follows have ``u = e^(it) R u(leader)`` instead of ``R u(leader)``. With P for the phase 0, and its rows D P of
these nodes,

    Z = (1 - D) P + e^(it) D P        Z*KZ = A + i B        [[A, -B], [B, A]] for (a, b)

in real numbers, where every eigenvalue is found twice, as in the ring: its modes may be turned.
"""

from __future__ import annotations

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools


class Harmonic:
    """One harmonic of a sector (collective).

    Args:
        P: restriction for the phase 0.
        follower: owned nodes of the cut that follows, which no other equations contain ``(n_owned,)``.
        diameter: k.
        n: N.

    Attributes:
        used: unknowns in use, of both copies where there are two.
    """

    def __init__(self, P: Restriction, follower: Bools, diameter: int, n: int):
        self._P = P
        self._own = P.space.vector(np.repeat(follower, P.space.block).astype(float))
        phase = 2.0 * np.pi * diameter / n
        self._c, self._s = float(np.cos(phase)), float(np.sin(phase)) if 0 < 2 * diameter < n else 0.0
        one = P.used.ravel()
        self.used: Bools = np.concatenate([one, one]) if self._s else one

    def united(self, K: PETSc.Mat) -> tuple[PETSc.Mat, PETSc.Mat]:
        """The real matrix of both copies, and its symmetric block A (collective)."""
        inner, follower = self._P.P.copy(), self._P.P.copy()
        follower.diagonalScale(self._own)
        inner.axpy(-1.0, follower, structure=PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
        if not self._s:
            inner.axpy(self._c, follower, structure=PETSc.Mat.Structure.SUBSET_NONZERO_PATTERN)
            A = K.PtAP(inner)
            return A, A
        across = inner.transposeMatMult(K.matMult(follower))
        back = across.transpose(PETSc.Mat())
        A = K.PtAP(inner) + K.PtAP(follower) + self._c * (across + back)
        B = self._s * (across - back)
        whole = PETSc.Mat().createNest([[A, -1.0 * B], [B, A]], comm=A.comm)
        whole.assemble()
        return whole.convert("aij"), A

    def expand(self, q: Array) -> PETSc.Vec:
        """The real part of the displacement (collective)."""
        n = len(q) // 2 if self._s else len(q)
        a, b = (self._P.expand(self._P.space.vector(part)) for part in (q[:n], q[-n:]))
        shift = (self._c - 1.0) * a - self._s * b
        shift.pointwiseMult(shift, self._own)
        return a + shift
