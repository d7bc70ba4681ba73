"""The united Newton loop [UEM, 4.4 and Fig. A.1]: project, residual, constraints, solve, until equilibrium and contact hold.

The loop uses the bodies and a ``ContactMethod`` only, so that it serves statics, dynamics and any method to impose contact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple, Protocol

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.errors import ConvergenceError
from uem_dolfinx.log import logger, say
from uem_dolfinx.solve.bodies.bodies import Bodies
from uem_dolfinx.solve.bodies.field_scales import Norm, driving, first, ratio, worst
from uem_dolfinx.solve.bodies.tangent import not_finite
from uem_dolfinx.solve.rigid.unheld import no_precision, unheld
from uem_dolfinx.solve.united.equilibrium import Equilibrium, InEquilibrium, IterationState

#: Shortest step of the line search. [bound; halvings of a step; -]
SHORTEST_SEARCH = 1.0 / 64
#: Longest step where forces drive the bodies on. [bound; doublings of a step; -]
LONGEST_SEARCH = 64.0
#: The line search accepts a step that leaves less than this part of the residual's work or of its norm.
#: [convention; work or norm of the residual; test_newton_loop.py::test_what_the_line_search_accepts]
ENOUGH_DECREASE = 0.9
#: A solve that another iteration follows leaves this part of its right-hand side, times the relative residual [Eisenstat and Walker,
#: SIAM Journal on Scientific Computing 17 (1996) 16-32]. A solve that only finds contactors in a wrong state leaves this part as it is.
#: [heuristic; right-hand side; test_newton.py::test_a_solve_that_another_follows_is_coarse]
FORCING = 1e-4
#: A solve that may be the last leaves this part of the residual that convergence requires, and of its right-hand side at most.
#: [convention; norm of the residual; test_newton.py::test_the_last_solve_is_as_accurate_as_convergence_asks]
ACCURACY_AT_THE_END = 0.1


@dataclass(frozen=True)
class Iteration:
    """One line of the history."""

    residual: float  # norm of ``Q'r`` over the forces at work
    gap: float  # largest gap of an active contactor, a length
    active: int  # number of active contactors over all ranks in the step that the bodies took
    changed: bool  # whether contactors were activated or released, or entered or left a corner
    linear_iterations: int  # of the solves that followed; 0 if the step had converged
    step_length: float  # of the line search in the step to this iteration
    exchanges: int = 0  # further solves with the same tangent, each with another active set


class LinearisedProblem(NamedTuple):
    """``Q'KP dq = rhs`` for one active set, and how it is solved."""

    state: IterationState  # with P and Q
    rhs: PETSc.Vec  # right-hand side ``Q'(r - K c)``
    exact: bool  # whether solves must be accurate to rounding, since no further iteration corrects them
    iterative: bool  # whether solves stop at their tolerance, and can start from the solution of another active set
    passing: bool  # whether another iteration follows in any case
    fits: bool  # whether a full step needs no line search
    #: whether terms that could make the tangent indefinite are neglected, so that the line search may also lengthen steps.
    convex: bool
    softens: bool = False  # whether forces may grow on the way down, so that the line search takes steps that forces drive on


class Increment(NamedTuple):
    """Solution of a linearised problem."""

    dq: PETSc.Vec  # unknowns
    du: PETSc.Vec  # ``P dq + c``
    rhs: PETSc.Vec  # right-hand side of dq; methods that control the load, such as arc length, add to it
    linear_iterations: int  # number of linear iterations
    left: float  # tolerance, relative to the right-hand side
    longest: float = 1.0  # upper bound of the step length; 1 unless the method sets it


class ContactMethod(Protocol):
    """How contact is imposed on bodies; every method is collective.

    ``system.BodySystem`` eliminates the contactors; another method implements the same.
    """

    def begin_step(self) -> None:
        """Begin a step, before the loop."""

    def place(self) -> None:
        """Project the contactors at the present positions of bodies and targets."""

    def return_to_targets(self, bound: float) -> bool:
        """Normal return [UEM, 4.2]: move active contactors back onto the moved targets, unless the resulting forces exceed ``bound``.

        Returns whether any contactor has been moved by more than rounding of positions; contactors are then projected again.
        """

    def assemble_constraints(self, in_equilibrium: InEquilibrium) -> IterationState:
        """The targets of the contactors, their equations, and, in equilibrium, the contact forces."""

    def linearise(self, state: IterationState, iteration: int | None) -> LinearisedProblem:
        """The constrained matrix ``Q'KP`` and right-hand side of a state.

        Args:
            state: with P and Q.
            iteration: number of the iteration that starts with it; None for another active set in the same iteration, which keeps K.
        """

    def solve(self, problem: LinearisedProblem, accuracy: float, near: PETSc.Vec | None) -> Increment:
        """Solve a linearised problem, at least for the unknowns that contact needs; ``complete`` adds the others.

        Args:
            problem: the last one.
            accuracy: tolerance, relative to the right-hand side.
            near: initial guess, from another active set or accuracy, or None.
        """

    def exchange(self, problem: LinearisedProblem, step: Increment) -> IterationState | None:
        """The state with an active set changed where ``step`` violates the contact conditions; None if nothing changes.

        Bodies and residual are unchanged since the beginning of the iteration. A ConvergenceError bounds the number of states.
        """

    def complete(self, problem: LinearisedProblem, step: Increment) -> Increment:
        """The increment in all unknowns, if the last solve computed only some."""

    def reduced_residual(self, state: IterationState) -> PETSc.Vec:
        """``Q'F`` of the last projection and the last assembled residual, with the active set of ``state``."""

    def end_step(self) -> None:
        """End a step in which the loop has converged; may refuse it."""

    def accelerate(self) -> None:
        """Find the initial acceleration of the bodies, in dynamics."""

    def forget(self) -> None:
        """Let the next step assemble and factorise anew, like the first step of a run."""


def solve_united(
    bodies: Bodies,
    method: ContactMethod,
    *,
    rtol: float,
    max_iterations: int,
    line_search: bool,
    verbose: bool,
    forces_before: Norm = 0.0,
    check_signals: Callable[[], None] | None = None,
) -> list[Iteration]:
    """Iterate until ``Q'r`` is negligible relative to the forces at work and every contact condition holds.

    Args:
        bodies: without contact.
        method: how contact is imposed on them.
        rtol: bound on the norm of ``Q'r`` relative to the forces at work.
        max_iterations: bound on the number of iterations.
        line_search: shorten steps that invert cells or increase the work of the residual.
        verbose: print a line per iteration.
        forces_before: norm of the largest forces of earlier steps, relative to which the forces after unloading may be rounding.
        check_signals: called on all ranks after every linear solve; an exception in it ends the loop.

    Returns:
        The history; its last entry is the converged state.

    Raises:
        FloatingBodyError: if the residual stagnates while its rounding grows above it, since nothing holds a body or a field.
        ConvergenceError: after ``max_iterations``, if the residual diverges, or if the active set cycles, with the history.
        PrecisionError: if the residual is below rounding, but too large relative to the forces.
        NotFiniteError: if the residual is NaN or infinite at the start of the step.
        InvertedElementError: if even the shortest step turns a cell inside out.
    """
    history: list[Iteration] = []
    equilibrium, norms, length = Equilibrium(bodies, rtol, forces_before), bodies.unknowns.norms, 1.0
    method.place()
    if not bodies.assemble():
        remedy = "check loads, material parameters and the initial displacement for NaN and division by zero"
        raise not_finite(bodies, "at the start of the step", remedy)
    try:
        for k in range(max_iterations + 1):
            state = method.assemble_constraints(equilibrium.holds)
            steady = state.right and not state.changed
            if k > 0 and steady and method.return_to_targets(rtol * first(equilibrium.forces(state.scale))):
                bodies.assemble()
                state = method.assemble_constraints(equilibrium.holds)
            verdict = equilibrium.judge(state)
            if verdict.ends or k == max_iterations:
                history.append(Iteration(ratio(state.norm, verdict.forces), state.gap, state.active, state.changed, 0, length))
                _report(history, verbose)
                if verdict.converged:
                    return history
                if verdict.hidden:
                    raise no_precision(*worst(state.norm, verdict.rounding, verdict.real))
                if verdict.flown.any():
                    error = unheld(bodies, int(verdict.flown.argmax()), history[-1].residual)
                    # a shorter step may keep bodies in contact
                    raise ConvergenceError(str(error), history) if state.in_contact and bodies.config.moves else error
                break
            # the residual at the beginning of a step does not include prescribed increments and gaps
            relative = ratio(state.norm, verdict.forces) if k > 0 else 1.0
            wanted = rtol * first(verdict.forces)
            problem, step, solves, exchanges = _solve_linearised(method, state, k, wanted, relative, check_signals)
            driving = np.maximum(norms(problem.rhs), norms(step.rhs))
            equilibrium.drive(driving)
            residual = ratio(driving, np.maximum(verdict.forces, driving if k == 0 else 0.0))
            changed = state.changed or exchanges > 0
            history.append(Iteration(residual, state.gap, problem.state.active, changed, solves, length, exchanges))
            _report(history, verbose)
            length = _advance(bodies, method, problem, step, line_search)
    except ConvergenceError as error:
        error.history = list(history)
        raise
    last = history[-1]
    raise ConvergenceError(
        f"no convergence in {k} iterations: relative residual {last.residual:.3g} (wanted {rtol:.3g}), gap {last.gap:.3g}, "
        f"{last.active} active contactors{', still changing' if last.changed else ''}; take smaller load steps, or raise max_iterations",
        history,
    )


def _solve_linearised(
    method: ContactMethod,
    state: IterationState,
    iteration: int,
    wanted: float,
    relative: float,
    check_signals: Callable[[], None] | None,
) -> tuple[LinearisedProblem, Increment, int, int]:
    """Solve the linearised problem together with the conditions of contact, from this state; nothing moves.

    Returns:
        The problem whose active set agrees with its solution, the solution, and the numbers of linear iterations and of exchanges.
    """
    solves, exchanges = 0, 0
    problem, near = method.linearise(state, iteration), None
    while True:
        accuracy = _accuracy(problem, iteration, wanted, relative)
        # a coarse solution already shows which contactors clearly violate their conditions
        loose = problem.iterative and problem.state.in_contact and accuracy < FORCING
        for left in (FORCING, accuracy) if loose else (accuracy,):
            step = method.solve(problem, left, near)
            solves, near = solves + step.linear_iterations, step.dq
            if check_signals is not None:
                check_signals()
            better = method.exchange(problem, step)
            if better is not None:
                break
        if better is None:
            return problem, method.complete(problem, step), solves, exchanges
        problem, near, exchanges = method.linearise(better, None), better.trial.unknowns(step.du), exchanges + 1


def _accuracy(problem: LinearisedProblem, iteration: int, wanted: float, relative: float) -> float:
    """Tolerance of a solve, relative to the right-hand side."""
    if problem.exact:
        return 0.0
    state, driving = problem.state, problem.rhs.norm()
    last = ACCURACY_AT_THE_END * wanted / driving if driving > 0 else 0.0
    passing = problem.passing or state.changed or (iteration == 0 and state.in_contact)
    return min(max(last, FORCING * min(relative, 1.0) if passing else 0.0), ACCURACY_AT_THE_END)


def _advance(bodies: Bodies, method: ContactMethod, problem: LinearisedProblem, step: Increment, line_search: bool) -> float:
    """Take the step with a line search on the displacement's forces; returns the step length."""
    start, state, dq = bodies.displacement(), problem.state, step.dq
    work_of, norms = bodies.unknowns.work, bodies.unknowns.norms
    # the residual is the negative right-hand side at first
    work, length = -work_of(dq, step.rhs), step.longest
    while True:
        last = not line_search or length <= SHORTEST_SEARCH
        if _moved(bodies, method, start, step, length):
            if last or problem.fits:
                return length
            residual = method.reduced_residual(state)
            along, least = work_of(dq, residual), first(state.rounding) * first(norms(dq))
            enough = min(bodies.most_past, ENOUGH_DECREASE) if along * work < 0.0 else ENOUGH_DECREASE
            less_work = abs(along) <= max(enough * abs(work), least)
            downhill = (problem.convex or problem.softens) and along < 0.0
            # forces of a contact that falls off evenly drive on at twice the step
            evenly = problem.softens and abs(along) > max(abs(work) - abs(along), least)
            if problem.convex and downhill and (evenly or not less_work) and length == 1.0:
                return _downhill(bodies, method, state, start, step)
            if less_work or downhill or first(norms(residual)) <= enough * driving(bodies, state.test, step.rhs, step.du):
                return length
        elif last:
            raise not_finite(bodies, "even after the shortest step", "take smaller load steps")
        length *= 0.5


def _moved(bodies: Bodies, method: ContactMethod, start: PETSc.Vec, step: Increment, length: float) -> bool:
    """Displace the bodies, project the contactors and assemble; whether the residual is finite and no cell is inverted."""
    bodies.displace(start, step.du, length)
    if bodies.inverted() is not None:
        return False
    method.place()
    return bodies.assemble()


def _downhill(bodies: Bodies, method: ContactMethod, state: IterationState, start: PETSc.Vec, step: Increment) -> float:
    """Lengthen a full step while forces drive the bodies further in its direction; returns the length, of 1, 2, 4 ... up to a bound."""
    length, along = 1.0, partial(bodies.unknowns.work, step.dq)
    while length < LONGEST_SEARCH:
        if not _moved(bodies, method, start, step, 2.0 * length) or along(method.reduced_residual(state)) >= 0.0:
            break
        length *= 2.0
    _moved(bodies, method, start, step, length)
    return length


def _report(history: list[Iteration], verbose: bool) -> None:
    i = history[-1]
    line = (
        f"  {len(history) - 1:3d}  residual {i.residual:.3e}  gap {i.gap:.1e}  active {i.active:5d}{'*' if i.changed else ' '}  "
        f"exchanges {i.exchanges:2d}  linear {i.linear_iterations:3d}  step {i.step_length:g}"
    )
    if verbose:
        say(line)
    else:
        logger.debug(line)
