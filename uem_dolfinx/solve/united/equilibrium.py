"""Equilibrium of a step: residuals against the forces at work, and against the rounding of the displacement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.solve.bodies.bodies import FORCE_ROUNDING, Bodies
from uem_dolfinx.solve.bodies.field_scales import Norm

#: A residual that keeps this part of its norm twice has met its rounding.
#: [heuristic; norm of the residual; test_trust.py::test_converged_means_converged]
STALLED = 0.5
#: A residual above this part of the forces that exceed rounding is no rounding, however far a loose body has flown.
#: [bound; norm of the forces; test_trust.py::test_converged_means_converged]
LARGEST_ROUNDING = 1e-4


#: Whether the norm of a residual, relative to a norm of forces and to its rounding, is an equilibrium.
InEquilibrium = Callable[[Norm, Norm, Norm], bool]


@dataclass(frozen=True)
class IterationState:
    """A state of the united system as the loop sees it."""

    trial: Restriction  # P and c, by which the bodies move
    test: Restriction  # Q, which transfers forces; the same object as P unless trial and test rows of a coupling differ
    residual: PETSc.Vec  # ``Q'F``, the out-of-balance forces
    norm: Norm  # its norm
    scale: Norm  # norm of the forces at work
    rounding: Norm  # norm below which a force is rounding of the displacement
    gap: float  # largest gap of an active contactor, a length
    active: int  # number of active contactors over all ranks
    changed: bool  # whether contactors have changed their constraints because of their positions
    right: bool  # whether all contactors satisfy the contact conditions with the present forces
    closed: bool  # whether gaps and Dirichlet conditions are met
    in_contact: bool  # whether there are contacts at all


class Verdict(NamedTuple):
    """What the residual of a state means for the loop."""

    forces: Norm  # norm of the forces at work, of this state or of the first one
    converged: bool  # the residual is negligible, and every contact condition holds
    hidden: bool  # rounding hides the equilibrium: no iteration improves a residual that is large relative to the forces
    flown: Array  # fields that nothing holds, whose rounding grows above a stagnating residual ``(n_fields,)``
    rounding: Norm  # norm below which the residual may be rounding
    real: Norm  # norm of the forces that exceed rounding

    @property
    def ends(self) -> bool:
        """Whether no further iteration is of use."""
        return self.converged or self.hidden or bool(self.flown.any())


class Equilibrium:
    """Judge of the residuals of one step, in the order of the iterations (collective).

    Rounding counts as equilibrium only where it is small relative to real forces. It grows with the displacement, so that it is bounded by
    the forces, by its value at the start of the step, and by rounding of displacements of the model's size.

    Args:
        bodies: without contact.
        rtol: bound on the norm of the residual relative to the forces at work.
        forces_before: norm of the largest forces of earlier steps.
    """

    def __init__(self, bodies: Bodies, rtol: float, forces_before: Norm):
        self._bodies, self._rtol, self._before = bodies, rtol, forces_before
        self._start: Norm = 0.0
        self._norm: Norm = 0.0
        self._left: Norm = 0.0
        self._within: Norm = np.inf
        self._stalled: int | Ints = 0
        self._iterations = 0

    def forces(self, scale: Norm) -> Norm:
        """The forces at work in a state with this scale: at least the residual at the start of the step."""
        return np.maximum(scale, self._start)

    def holds(self, norm: Norm, scale: Norm, rounding: Norm) -> bool:
        """Whether the norm of a residual, relative to a norm of forces and to its rounding, is an equilibrium."""
        forces = self.forces(scale)
        return bool(np.all(norm <= np.maximum(self._rtol * forces, self._bounded(self._rounding(rounding, 1), forces))))

    def judge(self, state: IterationState) -> Verdict:
        """The verdict on the state of the next iteration."""
        norm, rounding, steady = state.norm, state.rounding, state.right and not state.changed
        solved = self._iterations > 0
        if not solved:
            # a displacement that returns to zero keeps the rounding of its former size
            self._start, self._left, self._within = norm, np.minimum(rounding, self._rtol * self._before), rounding
        forces = self.forces(state.scale)
        self._stalled = np.where(norm > STALLED * self._norm, self._stalled + 1, 0) if solved and not state.changed else 0
        self._norm, self._iterations = norm, self._iterations + 1
        rounding, small, real = self._rounding(rounding, 2), self._rtol * forces, forces
        if np.any((small < norm) & (norm <= rounding)) and (solved or np.any(np.greater(self._before, 0.0))):
            # rounding is accepted if the residual is small relative to real forces, or without forces: only after the first solve
            real = np.maximum(self._bodies.above_rounding(state.in_contact), self._before)
            excused = np.where(real > 0, np.minimum(rounding, LARGEST_ROUNDING * real), self._bounded(rounding, forces))
            small = np.where((small < norm) & (norm <= rounding), excused, small)
        converged = steady and state.closed and bool(np.all(norm <= small))
        stuck = self._stalled >= 2
        hidden = steady and np.all(norm <= np.maximum(small, rounding)) and np.any(stuck & (small < norm))
        flown = np.atleast_1d(stuck & (np.maximum(small, self._bounded(rounding, forces)) < norm) & (norm <= rounding))
        return Verdict(forces, converged, bool(hidden), flown, rounding, real)

    def drive(self, driving: Norm) -> None:
        """Let the rounding at the start be that of the forces that drive the first iteration, with prescribed increments and gaps."""
        if self._iterations == 1:
            self._within = np.maximum(self._within, LARGEST_ROUNDING * driving)

    def _rounding(self, rounding: Norm, times: int) -> Norm:
        # a stagnating residual is at the rounding level of laws that use the deformation gradient
        stalled = self._stalled >= times
        more = np.where(stalled, self._bodies.strain_rounding(), 0.0) if np.any(stalled) else 0.0
        return np.maximum(np.maximum(rounding, self._left), more)

    def _bounded(self, rounding: Norm, forces: Norm) -> Norm:
        if not np.any(rounding > self._within):
            return rounding
        of_model = FORCE_ROUNDING / np.finfo(float).eps * self._bodies.strain_rounding()
        return np.minimum(rounding, np.maximum(np.maximum(self._within, LARGEST_ROUNDING * forces), of_model))
