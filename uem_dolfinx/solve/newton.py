"""The united Newton loop [UEM, 4.4 and Fig. A.1]: place, residual, unite, solve, until equilibrium and contact hold.

The loop speaks to a ``UnitedSystem`` only, so it serves statics and dynamics alike.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Protocol

from petsc4py import PETSc

from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.errors import ConvergenceError, InvertedElementError, NotFiniteError, PrecisionError
from uem_dolfinx.log import logger, say

#: A residual that keeps this part of its norm twice has met its rounding.
#: [heuristic; norm of the residual; -]
STALLED = 0.5
#: Shortest step of the line search.
#: [bound; halvings of a step; -]
SHORTEST_SEARCH = 1.0 / 64
#: Longest step where forces drive the bodies on.
#: [bound; doublings of a step; -]
LONGEST_SEARCH = 64.0
#: The line search accepts a step that leaves less than this part of the residual's work or of its norm.
#: [convention; work or norm of the residual; test_newton_loop.py::test_what_the_line_search_accepts]
ENOUGH_DECREASE = 0.9
#: An iterative solve leaves this part of its right-hand side while the active set or the tangent is still to change.
#: [heuristic; right-hand side; -]
ACCURACY_ON_THE_WAY = 1e-4
#: One that asks which contactors are wrong leaves this part of its right-hand side, and goes on where it sees none.
#: [heuristic; right-hand side; -]
ACCURACY_OF_EXCHANGES = 1e-3
#: Newton's method leaves this part of the residual times the relative residual; where bodies are linear, and iterations cheap, up to all.
#: [heuristic; relative residual; -]
NEWTON_LEAVES = 1e-2
#: One that may be the last leaves this part of what convergence asks for, and of its right-hand side at most.
#: [heuristic; right-hand side; -]
ACCURACY_AT_THE_END = 0.1
#: A residual below this part of the forces at work is an equilibrium in which contact forces can be read from the bodies.
#: [heuristic; norm of the forces; -]
IN_EQUILIBRIUM = 1e-6
#: A residual above this part of the forces that are told from rounding is no rounding, however far a loose body has flown.
#: [heuristic; norm of the forces; -]
LARGEST_ROUNDING = 1e-4


#: Whether a residual of this norm, beside forces of this norm, with this rounding, is an equilibrium.
InEquilibrium = Callable[[float, float, float], bool]


@dataclass(frozen=True)
class Iteration:
    """One line of the history.

    Attributes:
        residual: norm of ``Q'r`` over the forces at work.
        gap: largest gap of an active contactor, a length.
        active: number of active contactors over all ranks with which the bodies moved on.
        changed: whether contactors were activated or released, or entered or left a corner.
        linear_iterations: of the solves that followed; 0 if the step had converged.
        step_length: of the line search in the step that led here.
        exchanges: further solves with the same tangent, each with another active set.
    """

    residual: float
    gap: float
    active: int
    changed: bool
    linear_iterations: int
    step_length: float
    exchanges: int = 0


@dataclass(frozen=True)
class IterationState:
    """A state of the united system as the loop sees it.

    Attributes:
        trial: P and c, by which the bodies move.
        test: Q, by which forces are handed on; the same object as P unless a coupling tells trial from test rows.
        residual: ``Q'F``, the out-of-balance forces.
        norm: its norm.
        scale: norm of the forces at work.
        rounding: norm below which a force is rounding of the displacement.
        strain_rounding: norm that rounding of the deformation gradient alone can make, in laws that start from it.
        gap: largest gap of an active contactor, a length.
        active: number of active contactors over all ranks.
        changed: whether contactors have changed what they are united to because of where they are.
        right: whether no contactor breaks the conditions of contact, as far as the present forces tell.
        closed: whether gaps and Dirichlet conditions are met.
    """

    trial: Restriction
    test: Restriction
    residual: PETSc.Vec
    norm: float
    scale: float
    rounding: float
    strain_rounding: float
    gap: float
    active: int
    changed: bool
    right: bool
    closed: bool


class UnitedSystem(Protocol):
    """Bodies in contact as loop and problem see them; every method is collective.

    ``system.BodySystem`` eliminates the contactors; another method of contact implements the same.
    """

    def begin_step(self) -> None:
        """Begin a step, before the loop."""

    def end_step(self) -> None:
        """End a step in which the loop has converged; may refuse it."""

    def accelerate(self) -> None:
        """Find the acceleration that the bodies start with, in dynamics."""

    def forget(self) -> None:
        """Let the next step assemble and factorise anew, as the first of a run does."""

    @property
    def linear(self) -> bool:
        """Whether the bodies' forces are linear in the displacement, so that a full step always fits them."""

    @property
    def tolerant(self) -> bool:
        """Whether an iteration follows that makes up for what a solve leaves, so that none need be exact."""

    @property
    def convex(self) -> bool:
        """Whether the tangent leaves out what could make it indefinite, so that steps are no longer than forces drive the bodies."""

    @property
    def in_contact(self) -> bool:
        """Whether there are contacts at all."""

    @property
    def frictional(self) -> bool:
        """Whether there is friction."""

    def place(self, returning: bool) -> None:
        """Project the contactors; when returning, put the active ones back onto the moved target [UEM, 4.2]."""

    def assemble_residual(self) -> bool:
        """Residual at the present displacement; whether it is finite."""

    def unite(self, in_equilibrium: InEquilibrium) -> IterationState:
        """Where the contactors belong, the equations that follow, and, in equilibrium, the contact forces."""

    def differentiate(self, first: bool) -> None:
        """Tangent of bodies and contact at the present displacement."""

    def linearise(self, state: IterationState) -> PETSc.Vec:
        """United matrix ``Q'KP`` of a state; returns the right-hand side ``Q'(r - K c)``."""

    def forces_above_rounding(self) -> float:
        """Norm of the forces at those nodes where they are told from rounding."""

    def exchange(self, state: IterationState, du: PETSc.Vec, driving: float, accuracy: float) -> IterationState | None:
        """The state in which contactors that ``du`` shows on the wrong side have changed sides; None if none is to change.

        ``du`` solves the linearised problem, but for this ``accuracy`` of a right-hand side of norm ``driving``. A ConvergenceError bounds
        the number of states.
        """

    @property
    def inexact(self) -> bool:
        """Whether solves are no more accurate than they are asked to be."""

    def solve(self, rhs: PETSc.Vec, accuracy: float, near: PETSc.Vec | None = None) -> tuple[PETSc.Vec, int]:
        """Unknowns dq, whose residual need be no less than this part of ``rhs``, and the number of linear iterations.

        They are looked for from ``near`` on, those of the state before, if it is given; the others alone need change then that contact
        asks for. A system that leads the load adds to ``rhs`` what its change contributes.
        """

    def complete(self, dq: PETSc.Vec) -> PETSc.Vec:
        """All unknowns of the last solve, if it was of some."""

    def move(self, state: IterationState, dq: PETSc.Vec) -> PETSc.Vec:
        """``du = P dq + c``."""

    def displacement(self) -> PETSc.Vec:
        """Copy of the present displacement."""

    def displace(self, start: PETSc.Vec, du: PETSc.Vec, length: float) -> None:
        """Set the displacement to ``start + length du``."""

    def inverted(self) -> str | None:
        """Where a cell is inside out, if one is."""

    def reduced_residual(self, state: IterationState) -> PETSc.Vec:
        """``Q'F`` at the present displacement, with the active set of ``state``."""


def solve_united(
    system: UnitedSystem,
    *,
    rtol: float,
    max_iterations: int,
    line_search: bool,
    verbose: bool,
    forces_before: float = 0.0,
    check_signals: Callable[[], None] | None = None,
) -> list[Iteration]:
    """Iterate until ``Q'r`` vanishes against the forces at work and every contact condition holds.

    Args:
        system: the problem.
        rtol: bound on the norm of ``Q'r`` relative to the forces at work.
        max_iterations: bound on the number of iterations.
        line_search: shorten steps that invert cells or increase the work of the residual.
        verbose: print a line per iteration.
        forces_before: norm of the largest forces of earlier steps, against which those of a step that unloads may be rounding.
        check_signals: called on all ranks after every linear solve; what it raises ends the loop.

    Returns:
        The history; its last entry is the converged state.

    Raises:
        ConvergenceError: after ``max_iterations``, or where an active set does not settle, with the history.
        PrecisionError: if rounding hides whether the forces are in equilibrium.
        NotFiniteError: if the residual is NaN or infinite at the start of the step.
        InvertedElementError: if even the shortest step turns a cell inside out.
    """
    history: list[Iteration] = []
    start, length, norm, stalled, left = 0.0, 1.0, 0.0, 0, 0.0

    def in_equilibrium(norm: float, scale: float, rounding: float) -> bool:
        return norm <= max(max(IN_EQUILIBRIUM, rtol) * max(scale, start), rounding, left)

    system.place(returning=False)
    if not system.assemble_residual():
        raise NotFiniteError(
            "the residual is not finite at the start of the step: "
            "check loads, material parameters and the initial displacement for NaN and division by zero"
        )
    for k in range(max_iterations + 1):
        with _told(history):
            state = system.unite(in_equilibrium)
        if k == 0:
            # a displacement that comes back to nothing keeps the rounding of what it was
            start, left = state.norm, min(state.rounding, rtol * forces_before)
        forces = max(state.scale, start)
        steady = state.right and not state.changed
        stalled = stalled + 1 if k > 0 and state.norm > STALLED * norm and steady else 0
        norm = state.norm
        rounding = max(state.rounding if stalled < 2 else max(state.rounding, state.strain_rounding), left)
        small = rtol * forces
        if small < norm <= rounding:
            # rounding excuses a residual that is small beside real forces, or where there are none
            real = max(system.forces_above_rounding(), forces_before)
            small = min(rounding, LARGEST_ROUNDING * real) if real > 0 else rounding
        converged = steady and state.closed and norm <= small
        hidden = stalled >= 2 and small < norm <= rounding
        if converged or hidden or k == max_iterations:
            history.append(Iteration(_ratio(norm, forces), state.gap, state.active, state.changed, 0, length))
            _report(history, verbose)
            if converged:
                return history
            if hidden:
                raise _no_precision(norm, rounding, real)
            break
        system.differentiate(first=k == 0)
        passing = not system.linear or state.changed or (k == 0 and system.in_contact)
        if system.inexact:
            wanted, left_anyway = rtol * forces, ACCURACY_ON_THE_WAY if passing else 0.0
        elif system.tolerant:
            newton = _ratio(norm, forces) * (1.0 if system.linear else NEWTON_LEAVES)
            wanted, left_anyway = rtol * forces, newton if k > 0 else ACCURACY_ON_THE_WAY
        else:
            wanted = left_anyway = 0.0
        with _told(history):
            step = _solve_linearised(system, state, wanted, left_anyway, check_signals)
        residual = _ratio(step.driving, max(forces, step.driving if k == 0 else 0.0))
        changed = state.changed or step.exchanges > 0
        history.append(Iteration(residual, state.gap, step.state.active, changed, step.linear_iterations, length, step.exchanges))
        _report(history, verbose)
        length = _advance(system, step.state, step.rhs, step.dq, step.du, line_search)
    last = history[-1]
    raise ConvergenceError(
        f"no convergence in {max_iterations} iterations: relative residual {last.residual:.3g} (wanted {rtol:.3g}), gap {last.gap:.3g}, "
        f"{last.active} active contactors{', still changing' if last.changed else ''}; take smaller load steps, or raise max_iterations",
        history,
    )


def _no_precision(norm: float, rounding: float, real: float) -> PrecisionError:
    return PrecisionError(
        f"rounding hides the equilibrium: the residual stays at {norm:.3g}, which is {_ratio(norm, real):.1g} of the forces at work, "
        f"while rounding of the stiffest parts alone makes {rounding:.3g}: their stiffness times displacement is too large beside the "
        "forces; model them as rigid, give them less stiffness or less far to go, or raise rtol if that is accurate enough"
    )


@contextmanager
def _told(history: list[Iteration]) -> Iterator[None]:
    """Give the history to errors that do not know it."""
    try:
        yield
    except ConvergenceError as error:
        error.history = list(history)
        raise


@dataclass(frozen=True)
class _Step:
    """Solution of a linearised problem.

    Attributes:
        state: with the active set that its solution agrees with.
        rhs: right-hand side of the last solve.
        dq: its unknowns.
        du: its increment.
        driving: norm of ``rhs``.
        linear_iterations: of all solves.
        exchanges: number of solves after the first.
    """

    state: IterationState
    rhs: PETSc.Vec
    dq: PETSc.Vec
    du: PETSc.Vec
    driving: float
    linear_iterations: int
    exchanges: int


def _solve_linearised(
    system: UnitedSystem, state: IterationState, wanted: float, left_anyway: float, check_signals: Callable[[], None] | None
) -> _Step:
    """Solve the linearised problem together with the conditions of contact; nothing moves.

    Args:
        system: the problem.
        state: to begin with.
        wanted: norm of the residual that convergence asks for; zero where solves are to be exact.
        left_anyway: part of the right-hand side that solves may leave, since another iteration follows in any case.
        check_signals: see ``solve_united``.
    """
    iterations, exchanges, du = 0, 0, None
    while True:
        rhs = system.linearise(state)
        driving = rhs.norm()
        needed = ACCURACY_AT_THE_END * wanted / driving if driving > 0 else 0.0
        needed = min(max(needed, left_anyway), ACCURACY_AT_THE_END)
        # who is wrong by far is told long before the solution is accurate
        first = ACCURACY_OF_EXCHANGES if system.inexact and system.in_contact else needed
        near = None if du is None else state.trial.reduce(du)
        for accuracy in (first, needed) if first > needed else (needed,):
            dq, solves = system.solve(rhs, accuracy, near)
            iterations += solves
            if check_signals is not None:
                check_signals()
            driving = max(driving, rhs.norm())
            du, near = system.move(state, dq), dq
            better = system.exchange(state, du, driving, accuracy)
            if better is not None:
                break
        if better is None:
            whole = system.complete(dq)
            if whole is not dq:
                dq, du = whole, system.move(state, whole)
            return _Step(state, rhs, dq, du, driving, iterations, exchanges)
        state, exchanges = better, exchanges + 1


def _advance(
    system: UnitedSystem, state: IterationState, rhs: PETSc.Vec, dq: PETSc.Vec, du: PETSc.Vec, line_search: bool
) -> float:
    """Take the step, shortened where it must be, and assemble the residual there: the length taken."""
    start = system.displacement()
    work, norm = abs(dq.dot(rhs)), rhs.norm()
    length = 1.0
    while True:
        last = not line_search or length <= SHORTEST_SEARCH
        system.displace(start, du, length)
        where = system.inverted()
        if where is not None:
            if last:
                raise InvertedElementError(
                    f"the cell at {where} is turned inside out: take smaller load steps or a finer mesh there"
                )
        elif not line_search or system.linear:
            break
        # the bodies are asked before the normal return, which has its own reasons to move a contactor
        elif system.assemble_residual():
            residual = system.reduced_residual(state)
            less_work = abs(dq.dot(residual)) <= max(ENOUGH_DECREASE * work, state.rounding * dq.norm())
            downhill = system.convex and dq.dot(residual) < 0.0
            if downhill and not less_work and length == 1.0:
                length = _downhill(system, state, start, dq, du)
            if last or less_work or downhill or residual.norm() <= ENOUGH_DECREASE * norm:
                break
        elif last:
            break
        length *= 0.5
    system.place(returning=length == 1.0)
    if not system.assemble_residual():
        raise NotFiniteError("the residual is not finite even after the shortest step: take smaller load steps")
    return length


def _downhill(system: UnitedSystem, state: IterationState, start: PETSc.Vec, dq: PETSc.Vec, du: PETSc.Vec) -> float:
    """Go on as long as forces still drive the bodies that way, and displace them: the length taken, of 1, 2, 4 ... up to a bound."""
    length = 1.0
    while length < LONGEST_SEARCH:
        system.displace(start, du, 2.0 * length)
        if system.inverted() is not None or not system.assemble_residual() or dq.dot(system.reduced_residual(state)) >= 0.0:
            break
        length *= 2.0
    system.displace(start, du, length)
    return length


def _ratio(norm: float, scale: float) -> float:
    return norm / scale if scale > 0 else 0.0


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
