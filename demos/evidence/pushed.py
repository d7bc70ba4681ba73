"""What methods have in common that push bodies apart instead of uniting them: P holds the Dirichlet conditions alone."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.solve.system import BodySystem

if TYPE_CHECKING:
    from uem_dolfinx.solve.newton import United
    from uem_dolfinx.contact.pair import ContactPair


class PushedSystem(BodySystem):
    """Contact by forces; arguments as those of ``BodySystem``."""

    def add_pairs(self, pairs: list[ContactPair]) -> None:
        """Take in the contact pairs (collective); nothing holds what floats."""
        super().add_pairs(pairs)
        self.floating, self.contestable = None, False

    def place(self, returning: bool) -> None:
        """Project the contactors; none is put back."""
        super().place(returning=False)

    def _restrict(self, chords: bool = False) -> tuple[Restriction, None]:
        """P of the Dirichlet conditions alone."""
        n = self.config.n_owned
        prescribed = np.where(self.free, 0.0, self.wanted - self.config.displacement)[:n]
        return Restriction(self.config, UnitingEquations.join([], self.config.gdim), self.free[:n], prescribed, False), None

    def _prescribed_is_met(self) -> bool:
        """Whether the Dirichlet values are there (collective)."""
        short = np.abs(self.wanted - self.config.displacement)[~self.free].max(initial=0.0)
        largest = np.abs(self.wanted[~self.free]).max(initial=0.0)
        short, largest = np.max(self.comm.allgather([short, largest]), axis=0)
        return bool(short <= 4 * np.finfo(float).eps * largest)

    def _right_hand_side(self, state: United, A: PETSc.Mat) -> PETSc.Vec:
        """``-P'(R + A c)`` with the tangent A of bodies and forces."""
        rhs = state.restriction.reduce(A * state.restriction.c)
        rhs.axpy(1.0, state.residual)
        rhs.scale(-1.0)
        return rhs
