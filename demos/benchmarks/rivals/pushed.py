"""What methods have in common that push bodies apart instead of uniting them: P holds the Dirichlet conditions alone."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.contact.checks import check_initial, check_prescribed
from uem_dolfinx.solve.newton import IterationState, InEquilibrium

if TYPE_CHECKING:
    from uem_dolfinx.algebra.linear_solver import UnitedSolver
    from uem_dolfinx.contact.interface import Interface
    from uem_dolfinx.solve.body_forces import BodyForces


class PushedSystem(ABC):
    """Contact by forces; implements ``UnitedSystem``, arguments as those of ``solve.system.BodySystem``."""

    def __init__(
        self,
        forces: BodyForces,
        pairs: list[Interface],
        solver: UnitedSolver,
        *,
        newton: str = "full",
        consistent_tangent: bool = True,
    ):
        self.forces, self.pairs, self.solver = forces, pairs, solver
        self.config, self.comm = forces.config, forces.comm
        self.newton, self.consistent_tangent = newton, consistent_tangent
        self.made_of: object = None
        self.first = True
        self.place(returning=False)
        for pair in self.pairs:
            check_initial(pair)
            pair.activate_touching()

    # -- what a method has to say ------------------------------------------------------------------------------------------

    @abstractmethod
    def unite(self, settled: InEquilibrium) -> IterationState:
        """Contact forces at the present displacement."""

    @abstractmethod
    def linearise(self, state: IterationState) -> PETSc.Vec:
        """Tangent of bodies and contact forces; returns the right-hand side."""

    def differentiate(self, first: bool) -> None:
        """Note whether this is the step's first iteration: the tangent is made with the matrix."""
        self.first = first

    def forces_above_rounding(self) -> float:
        """Norm of the forces at those nodes where they are told from rounding of displacements and positions (collective)."""
        return self.forces.above_rounding(bool(self.pairs))

    def exchange(self, state: IterationState, du: PETSc.Vec, driving: float, accuracy: float) -> None:
        """Contactors are pushed by forces, none changes sides."""

    # -- what all of them do alike -----------------------------------------------------------------------------------------

    def begin_step(self) -> None:
        """Nothing holds what floats."""

    def end_step(self) -> None:
        """Refuse contactors that are prescribed inside the target (collective)."""
        for pair in self.pairs:
            check_prescribed(pair)

    def accelerate(self) -> None:
        """Find the acceleration that the bodies start with (collective)."""
        dynamics = self.forces.dynamics
        if dynamics is not None and not dynamics.accelerated:
            self.place(returning=False)
            self.forces.assemble()
            dynamics.accelerate(self.restriction(), self.forces.residual)

    def forget(self) -> None:
        """Let the next step factorise anew."""
        self.made_of = None
        self.solver.forget()

    def place(self, returning: bool) -> None:
        """Project the contactors; none is put back."""
        if self.pairs:
            self.forces.check_displacement()
            for pair in self.pairs:
                pair.project()

    def assemble_residual(self) -> bool:
        """Residual of the bodies; whether it is finite."""
        return self.forces.assemble()

    def restriction(self) -> Restriction:
        """P of the Dirichlet conditions alone."""
        n = self.config.n_owned
        none = UnitingEquations.join([], self.config.gdim)
        return Restriction(self.config, none, self.forces.free[:n], self.forces.prescribed, False)

    def rounding(self) -> float:
        """Norm of the forces that rounding of the displacement, and of the pushed contactors' positions, can make (collective)."""
        active = [pair.nodes[pair.trial.active] for pair in self.pairs]
        return self.forces.rounding(np.concatenate([np.zeros(0, np.int32), *active]))

    def right_hand_side(self, state: IterationState, A: PETSc.Mat) -> PETSc.Vec:
        """``-P'(R + A c)`` with the tangent A of bodies and forces."""
        rhs = state.trial.reduce(A * state.trial.c)
        rhs.axpy(1.0, state.residual)
        rhs.scale(-1.0)
        return rhs

    @property
    def inexact(self) -> bool:
        """No solve asks which contactors change sides."""
        return False

    def solve(self, rhs: PETSc.Vec, accuracy: float, near: PETSc.Vec | None = None) -> tuple[PETSc.Vec, int]:
        """Unknowns dq, and the number of linear iterations."""
        return self.solver.solve(rhs, accuracy, near)

    def complete(self, dq: PETSc.Vec) -> PETSc.Vec:
        """Every solve is of all unknowns."""
        return dq

    def move(self, state: IterationState, dq: PETSc.Vec) -> PETSc.Vec:
        """``du = P dq + c``."""
        du = state.trial.expand(dq)
        du.axpy(1.0, state.trial.c)
        return du

    def displacement(self) -> PETSc.Vec:
        """Copy of the present displacement."""
        return self.forces.displacement()

    def displace(self, start: PETSc.Vec, du: PETSc.Vec, length: float) -> None:
        """Set the displacement to ``start + length du``."""
        self.forces.displace(start, du, length)

    def inverted(self) -> str | None:
        """Where a cell is inside out, if one is (collective)."""
        return self.forces.inverted()

    def reduced_residual(self, state: IterationState) -> PETSc.Vec:
        """Out-of-balance forces of the bodies at the present displacement (collective)."""
        self.place(returning=False)
        return state.test.reduce(self.forces.residual)

    @property
    def linear(self) -> bool:
        """Whether the bodies' forces are linear in the displacement."""
        return self.forces.linear

    @property
    def convex(self) -> bool:
        """There is no curvature of contact."""
        return False

    @property
    def tolerant(self) -> bool:
        """Who is pushed changes with the displacement: solutions are exact."""
        return False

    @property
    def frictional(self) -> bool:
        """Whether there is friction."""
        return any(pair.frictional for pair in self.pairs)

    @property
    def in_contact(self) -> bool:
        """Whether there are contacts at all."""
        return bool(self.pairs)
