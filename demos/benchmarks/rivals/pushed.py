"""What methods have in common that push bodies apart instead of uniting them: P holds the Dirichlet conditions alone."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.contact.warnings.checks import check_initial, check_prescribed
from uem_dolfinx.errors import InputError
from uem_dolfinx.solve.united.equilibrium import InEquilibrium, IterationState
from uem_dolfinx.solve.united.newton import Increment, LinearisedProblem

if TYPE_CHECKING:
    from uem_dolfinx.algebra.linear_solver import UnitedSolver
    from uem_dolfinx.conditions.user_rows import UserRows
    from uem_dolfinx.contact.pair.interface import Interface
    from uem_dolfinx.solve.bodies.bodies import Bodies


class PushedSystem(ABC):
    """Contact by forces; implements ``ContactMethod``, arguments as those of ``solve.system.BodySystem``.

    Raises:
        InputError: if there are equations of users.
    """

    def __init__(
        self,
        bodies: Bodies,
        pairs: list[Interface],
        solver: UnitedSolver,
        *,
        newton: str = "full",
        consistent_tangent: bool = True,
        linear: UserRows | None = None,
    ):
        if linear is not None:
            raise InputError(
                "linear equations and rigid couplings, with the masses at their points, are met by elimination alone: leave method out, "
                "or equations and couplings"
            )
        self.bodies, self.pairs, self.solver = bodies, pairs, solver
        self.config, self.comm = bodies.config, bodies.comm
        self.newton, self.consistent_tangent = newton, consistent_tangent
        self.made_of: object = None
        self.place()
        self.overlaps: dict[int, float] = {}
        for pair in self.pairs:
            self.overlaps |= check_initial(pair)
            pair.activate_touching()

    # -- what a method has to say ------------------------------------------------------------------------------------------

    @abstractmethod
    def assemble_constraints(self, in_equilibrium: InEquilibrium) -> IterationState:
        """Contact forces at the present displacement."""

    @abstractmethod
    def tangent(self, state: IterationState, first: bool) -> PETSc.Mat:
        """Tangent of bodies and contact forces, which the solver has got; ``first`` in the step's first iteration (collective)."""

    def longest(self, state: IterationState, dq: PETSc.Vec, du: PETSc.Vec) -> float:
        """Part of an increment that a method takes at most."""
        return 1.0

    #: Whether ``longest`` finds the length of steps, so that the loop need not.
    fits = False

    # -- what all of them do alike -----------------------------------------------------------------------------------------

    def begin_step(self) -> None:
        """Contacts begin theirs; nothing holds what floats."""
        for pair in self.pairs:
            pair.discretisation.begin_step()

    def end_step(self) -> None:
        """Refuse contactors that are prescribed inside the target (collective)."""
        for pair in self.pairs:
            check_prescribed(pair)

    def accelerate(self) -> None:
        """Find the acceleration that the bodies start with (collective)."""
        dynamics = self.bodies.dynamics
        if dynamics is not None and not dynamics.accelerated:
            self.place()
            self.bodies.assemble()
            dynamics.accelerate(self.restriction(), self.bodies.residual)

    def forget(self) -> None:
        """Let the next step factorise anew."""
        self.made_of = None
        self.solver.forget()

    def place(self) -> None:
        """Project the contactors."""
        if self.pairs:
            self.bodies.check_displacement(min(pair.target.stride for pair in self.pairs))
            for pair in self.pairs:
                pair.project()

    def return_to_targets(self, bound: float) -> bool:
        """None is put back."""
        return False

    def restriction(self) -> Restriction:
        """P of the Dirichlet conditions alone."""
        n = self.config.n_owned
        none = UnitingEquations.join([], self.config.gdim)
        return Restriction(self.config, none, self.bodies.free[:n], self.bodies.prescribed, False)

    def rounding(self) -> float:
        """Norm of the forces that rounding of the displacement, and of the pushed contactors' positions, can make (collective)."""
        active = [pair.nodes[pair.trial.active] for pair in self.pairs]
        return self.bodies.rounding(np.concatenate([np.zeros(0, np.int32), *active]))

    def linearise(self, state: IterationState, iteration: int | None) -> LinearisedProblem:
        """``P'AP dq = -P'(R + A c)`` with the tangent A of bodies and forces (collective)."""
        forms.free_petsc_garbage(self.comm)
        rhs = state.trial.reduce(self.tangent(state, iteration == 0) * state.trial.c)
        rhs.axpy(1.0, state.residual)
        rhs.scale(-1.0)
        fits = self.fits or self.bodies.linear
        return LinearisedProblem(state, rhs, exact=True, iterative=False, passing=False, fits=fits, convex=False)

    def solve(self, problem: LinearisedProblem, accuracy: float, near: PETSc.Vec | None) -> Increment:
        """Unknowns dq, ``P dq + c``, and how much of it the method takes (collective)."""
        state = problem.state
        dq, iterations = self.solver.solve(problem.rhs, accuracy, near)
        du = state.trial.expand(dq)
        du.axpy(1.0, state.trial.c)
        return Increment(dq, du, problem.rhs, iterations, 0.0, self.longest(state, dq, du))

    def exchange(self, problem: LinearisedProblem, step: Increment) -> None:
        """Contactors are pushed by forces, none changes sides."""

    def complete(self, problem: LinearisedProblem, step: Increment) -> Increment:
        """Every solve is of all unknowns."""
        return step

    def reduced_residual(self, state: IterationState) -> PETSc.Vec:
        """Out-of-balance forces of the bodies at the present displacement (collective)."""
        return state.test.reduce(self.bodies.residual)
