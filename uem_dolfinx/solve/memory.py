"""Copies of the committed state of a ``UnitedProblem``, so that a step can be repeated from its initial state."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.dynamics.scheme import is_explicit
from uem_dolfinx.errors import InputError, UEMError, UserFunctionError
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.parallel import agreed
from uem_dolfinx.solve.loading import bring_load, forget_load
from uem_dolfinx.solve.united.newton import Iteration


@dataclass(frozen=True)
class Memory:
    """The committed state of a problem, from which its next step begins."""

    displacement: Array  # ``(n_local incl. ghosts,)``
    largest_forces: float  # norm of the largest forces so far
    motions: list[Motion | None]  # of the pairs' rigid targets
    pairs: list[PairState]  # state of each pair
    of_users: Any  # multipliers and rotations of equations of users; None without
    histories: list[dict[str, Array]]  # of the materials, values by name; empty for explicit steps, which are not repeated
    #: diagonal of K ``(n_owned, block)``, which contacts use for directions before K is assembled again; None at first.
    stiffness: Array | None
    dynamics: Any  # state of the dynamics; None in statics, and for explicit steps

    @classmethod
    def of(cls, problem: Any) -> Memory:
        """The last committed state of the problem."""
        repeated = not is_explicit(problem.dynamics)
        return cls(
            displacement=problem.committed,
            largest_forces=problem.largest_forces,
            motions=problem.motions,
            pairs=[pair.committed for pair in problem.interfaces],
            of_users=None if problem.linear is None else problem.linear.memory(),
            histories=[{name: np.array(f.x.array) for name, f in m.history.items()} for m in problem.materials if repeated],
            stiffness=problem.bodies.stiffness_at_start,
            dynamics=problem.dynamics.memory() if problem.dynamics is not None and repeated else None,
        )

    def put_back(self, problem: Any) -> None:
        """Restore it as the problem's committed and present state (collective)."""
        problem.committed, problem.largest_forces, problem.motions = self.displacement, self.largest_forces, self.motions
        move_targets(problem, self.motions)
        for material, kept in zip(problem.materials, self.histories):
            for name, values in kept.items():
                material.history[name].x.array[:] = values
        problem.bodies.stiffness_at_start = self.stiffness
        if problem.dynamics is not None:
            problem.dynamics.remember(self.dynamics)
        for pair, own in zip(problem.interfaces, self.pairs):
            pair.remember(own)
        if problem.linear is not None:
            problem.linear.remember(self.of_users)
        problem.restore()


def move_targets(problem: Any, motions: list[Motion | None]) -> None:
    """Set the motions of the pairs' rigid targets."""
    for pair, motion in zip(problem.interfaces, motions):
        if pair.target.motion is not motion:
            pair.target.motion = motion


def take_back(problem: Any, at: float) -> None:
    """Return to the committed state after a failed step, with the loads of its load factor or time (collective)."""
    # where it is the load's function that fails, it may fail here, too
    with suppress(UserFunctionError):
        bring_load(problem, at)
    forget_load(problem)
    # the targets that the load moves are back, too
    problem.restore()


def take_alone(problem: Any, start: Array | None, fraction: float) -> list[Iteration]:
    """Take one step with these arguments of ``UnitedProblem.attempt``, under loads of the factor or the present time (collective).

    Loads are unchanged if the ramp has a given start, or if they have been set since the last step.
    """
    progress, dynamics = problem.progress, problem.dynamics
    with agreed(problem.comm):
        if is_explicit(dynamics):
            raise InputError(
                "solve() does not go with CentralDifferences: take time_steps, or leave dynamics out for an equilibrium"
            )
        if problem.impacts is not None:
            problem.impacts.refuse_statics()
        fraction = given.number("fraction", fraction, given.Range("a number from 0 to 1", lambda x: 0 <= x <= 1))
    before, now = (progress.factor, fraction) if dynamics is None else (dynamics.time, dynamics.time)
    known = getattr(problem.load, "at", None) if problem.set_at is None else problem.set_at
    own = start is None and known is None
    try:
        if own:
            bring_load(problem, now)
        history: list[Iteration] = problem.attempt(start=start, fraction=fraction)
    except UEMError:
        if own:
            take_back(problem, before)
        raise
    if dynamics is None and start is None:
        progress.factor = now if known is None else known
    problem.commit()
    return history


def take_again(problem: Any, before: Memory, led: tuple[Array | None, float, bool]) -> list[Iteration]:
    """Repeat the last step of a problem, and replace its result (collective).

    Args:
        problem: inside a loop over steps.
        before: initial state of the step.
        led: start and fraction of the ramp of Dirichlet values, and whether the load was controlled, e.g. by arc length.

    Raises:
        UEMError: as in ``UnitedProblem.attempt``, after the previous result has been restored.
    """
    start, fraction, arc = led
    if is_explicit(problem.dynamics):
        raise InputError("explicit steps are not repeated: leave solve() out of the loop over time_steps")
    dynamics, now, moved, found = problem.dynamics, Memory.of(problem), problem.rigid_motions(), np.array(problem.u.x.array)
    before.put_back(problem)
    move_targets(problem, moved)
    if arc:
        # beyond a limit point load control would leave the path
        problem.u.x.array[:] = found
    if dynamics is not None:
        dynamics.begin(dynamics.dt)
    try:
        history: list[Iteration] = problem.attempt(start=start, fraction=fraction)
    except UEMError:
        now.put_back(problem)
        raise
    finally:
        problem.led = led
    problem.keep()
    if dynamics is not None:
        # the time may have been rounded to a multiple of the step
        dynamics.time = now.dynamics[0]
    return history
