"""Time steps, shortened on failure, if contacts would add energy to the bodies, and at instants of contact [UEM, 5].

Every converged step is committed, so that a failed run keeps its last converged state.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from itertools import compress
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.dynamics.inertia import Dynamics
from uem_dolfinx.dynamics.scheme import is_explicit
from uem_dolfinx.errors import InputError, NotFiniteError, PrecisionError, SpaceError, StepAccuracyError, UEMError
from uem_dolfinx.log import logger, progress, say
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.solve.loading import words_of
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.step_control import MENDABLE, REMAINDER, SHORTEST_LENGTH
from uem_dolfinx.solve.stepping import TimeStep, begin_checkpoint, between_steps, events, touching
from uem_dolfinx.solve.steps.explicit_steps import explicit_steps
from uem_dolfinx.solve.steps.load_steps import check_steps
from uem_dolfinx.solve.united.newton import Iteration
from uem_dolfinx.solve.united.starting import accelerate
from uem_dolfinx.solve.united.system import CLOSED

if TYPE_CHECKING:
    from uem_dolfinx.restart.checkpoint import Checkpoint

#: Rounding of a time, a few units in its last place.
#: [derived; largest time; test_thresholds_motion.py::test_steps_lost_in_rounding]
TIME_ROUNDING = 4 * np.finfo(float).eps
#: During a step the longest accurate step grows by at most this multiple of its length and of the root of the tolerance. So it doubles in
#: half a period of the vibration that it resolves, and does not grow where this turns, whose speed the estimate does not see.
#: [convention; length times root of tolerance; test_accuracy_in_time.py::test_steps_are_doubled_in_time]
GROWS = 1.0


def time_steps(
    problem: UnitedProblem,
    dt: float | None = None,
    end: float | None = None,
    *,
    tolerance: float | None = None,
    event_tolerance: float | None = None,
    checkpoint: Checkpoint | None = None,
) -> Iterator[TimeStep]:
    """Step through time, with steps that end at multiples of ``dt`` after the start, with a progress bar on a terminal.

    A step is halved when it does not converge, when a contactor would pass through a target, or when contacts would add energy
    to the bodies. After easy steps it is increased again.

    Args:
        problem: with ``dynamics``; its ``load`` is called with the time.
        dt: nominal length of the steps; with ``CentralDifferences`` None chooses the longest ones that are safe.
        end: time to reach.
        tolerance: shorten steps to dt/2, dt/4, ... until the local error of a step is below this part of the distance that the
            bodies cover in it at their largest speed so far. They are lengthened again up to ``dt`` where the error is much smaller; see
            ``Dynamics.rate_error``. The period of a vibration has about this error. None: steps have the length ``dt``.
        event_tolerance: find the instants at which a contact closes or opens to this part of ``dt``. The step is divided there, so
            that a step begins at the instant, unless rounding exceeds the forces of such short steps. None: steps are not divided.
        checkpoint: counts the steps, after the body of the loop, and stores the state; an existing file is resumed, here or earlier
            in ``checkpoint.begin(problem.state())``, which writers with ``resume=True`` need.

    Returns:
        An iterator of converged steps.

    Raises:
        InputError, InputTypeError: if ``dt`` is not positive, too long for an explicit scheme, or smaller than the
            rounding error of the time. If ``end`` is before the start or not finite, or ``event_tolerance`` not between 0 and 1.
        SpaceError: if the problem has no dynamics.
        CheckpointError: see ``Checkpoint``.
        TunnellingError: if a contactor passes through a target even in the shortest step.
        EnergyGivenError: if impact adds energy to the bodies even in the shortest step.
        StepAccuracyError: if the error exceeds the tolerance even in the shortest step.
        ConvergenceError: if a step fails even at 1/1024 of its nominal length; the last converged state is kept.
        LinearSolveError, NotFiniteError, InvertedElementError: if a step fails even at 1/1024 of its nominal length.
        KeyboardInterrupt, SystemExit: on all ranks, if any rank has received Ctrl-C or SIGTERM; the last converged state is kept.
    """
    check_steps(problem, checkpoint)
    dynamics = problem.dynamics
    if dynamics is None:
        raise SpaceError("time steps need inertia: give the problem dynamics=Dynamics(mass), or use load_steps for statics")
    _check_velocity(dynamics)
    chosen = is_explicit(dynamics) and dt is None
    with agreed(problem.comm):
        dt = dt if chosen else given.number("dt", dt, given.POSITIVE)
        later = given.Range(f"a time that is not before the start, {dynamics.start:.6g}", lambda t: dynamics.start <= t < np.inf)
        end = given.number("end", end, later)
        if is_explicit(dynamics) and event_tolerance is not None:
            raise InputError("event_tolerance is for implicit schemes: leave it out, since explicit steps are short")
        if is_explicit(dynamics) and tolerance is not None:
            raise InputError("tolerance is for implicit schemes: leave it out, since explicit steps are short")
        tolerance = None if tolerance is None else given.number("tolerance", tolerance, given.between(0.0, 1.0))
        if event_tolerance is not None:
            event_tolerance = given.number("event_tolerance", event_tolerance, given.between(0.0, 1.0))
    given.alike(
        problem.comm, "time_steps", dt=dt, end=end, tolerance=tolerance, event_tolerance=event_tolerance,
        load=words_of(problem.load), checkpoint=type(checkpoint).__name__,
    )  # fmt: skip
    if dt is not None:
        _check_length(dynamics, dt, end)
    begin_checkpoint(checkpoint, problem.state, problem.config.functions()["displacement"])
    steps, total = explicit_steps(problem, dt, end), None
    if not is_explicit(dynamics):
        assert dt is not None
        steps = _time_steps(problem, dynamics, dt, end, event_tolerance and event_tolerance * dt, tolerance)
        total = max(0, round((end - dynamics.time) / dt))
    shown = progress(steps, "time steps", total=total)
    return between_steps(problem.comm, problem.progress, shown, checkpoint, problem.declared)


def _check_velocity(dynamics: Dynamics) -> None:
    """NotFiniteError for a velocity that is not finite, as users may set it (collective)."""
    # PETSc keeps norms, and does not see what NumPy writes
    if not reduced(dynamics.config.comm, bool(np.isfinite(dynamics.velocity.x.array).all()), op=MPI.LAND):
        raise NotFiniteError(f"the velocity at time {dynamics.time:.6g} contains NaN or infinity: set finite numbers")


def _check_length(dynamics: Dynamics, dt: float, end: float) -> None:
    """Refuse steps whose length is lost in rounding."""
    with np.errstate(all="ignore"):
        squares = np.array([dt, SHORTEST_LENGTH * dt]) ** 2
        countable = np.isfinite(squares).all() and np.isfinite(1.0 / squares).all()
    if not countable:
        raise InputError(f"dt = {dt}: its square, or that of a step that is cut, is no number; take other units of time")
    if _rounding(dynamics, dt, end) > SHORTEST_LENGTH * dt:
        raise InputError(
            f"dt = {dt}: below the rounding error of the times from {dynamics.start:.6g} to {end:.6g}; count time from 0, or "
            "take longer steps"
        )


def _time_steps(
    problem: UnitedProblem, dynamics: Dynamics, dt: float, end: float, tolerance: float | None, accuracy: float | None
) -> Iterator[TimeStep]:
    """The steps of ``time_steps``, with instants of contact to a tolerance, and of an accuracy."""
    control = problem.step_control
    control.begin(dt)
    problem.set_load(dynamics.time)
    first = not dynamics.accelerated
    accelerate(problem)
    if first and problem.history is not None:
        problem.history.note_start()
    before, rounding = touching(problem), _rounding(dynamics, dt, end)
    while (remainder := end - dynamics.time) > rounding:
        # to the next multiple of dt; whole steps, and steps of a half and so on, have equal lengths to the last bit: K does not change
        passed = (dynamics.time - dynamics.start) / dt
        rest = min((np.floor(passed + rounding / dt) + 1.0 - passed) * dt, remainder)
        shortest = SHORTEST_LENGTH * dt
        parts = np.round(rest / shortest)
        length = min(control.longest, float(parts * shortest) if abs(rest - parts * shortest) <= rounding else rest)
        try:
            forces = _contact_forces(problem, before)
            length, iterations = _step(problem, length, before, tolerance)
            after = touching(problem)
            _refuse_given_energy(problem, dynamics, length, forces, after)
            longer = 2.0 if accuracy is None or _accurate(problem, dynamics, length, accuracy) else 1.0
        except UEMError as error:
            dynamics.restore()
            problem.set_load(dynamics.time)
            problem.restore()
            if control.shorten(length, error):
                continue
            raise
        problem.commit()
        nearest = dynamics.start + np.round((dynamics.time - dynamics.start) / dt) * dt
        if abs(dynamics.time - nearest) <= rounding:
            dynamics.time = float(nearest)
        number, cuts = control.done(iterations, longer)
        yield TimeStep(number, dynamics.time, length, iterations, cuts, *events(problem, before, after))
        # the caller may have repeated the step
        before = touching(problem)


def _step(problem: UnitedProblem, length: float, before: list[bool], tolerance: float | None) -> tuple[float, list[Iteration]]:
    """Attempt a step, or its part before the first contact closes or opens; returns its length and history (collective)."""
    iterations = _attempt(problem, length)
    if tolerance is None or length <= tolerance or touching(problem) == before:
        return length, iterations
    # the first trial checks whether the step begins at the instant
    low, high, trial, reached = 0.0, length, tolerance, 0.0
    while high - low > tolerance:
        problem.restore()
        try:
            _attempt(problem, trial)
            same = touching(problem) == before
            reached = trial if same else reached
        except MENDABLE:
            same = False
        except PrecisionError:
            # the step is so short that rounding exceeds its forces: the instant is later
            same = True
        low, high = (trial, high) if same else (low, trial)
        trial = 0.5 * (low + high)
    problem.restore()
    length = reached or length
    return length, _attempt(problem, length)


def _attempt(problem: UnitedProblem, length: float) -> list[Iteration]:
    """Find the state at the end of a step of this length (collective)."""
    assert problem.dynamics is not None
    if problem.verbose:
        say(f"time step {problem.step_control.number + 1}, to time {problem.dynamics.time + length:.6g}")
    problem.set_load(problem.dynamics.time + length)
    problem.dynamics.begin(length)
    return problem.attempt()


def _accurate(problem: UnitedProblem, dynamics: Dynamics, length: float, accuracy: float) -> bool:
    """Whether a step of twice the length would be accurate, too; refuse one that is not accurate itself (collective)."""
    control = problem.step_control
    error, speed = dynamics.rate_error()
    control.largest_speed = max(control.largest_speed, speed)
    found = error / control.largest_speed if control.largest_speed else 0.0
    if found > accuracy:
        raise StepAccuracyError(
            f"the error of a step of {length:.3g} is {found:.3g} of the displacement at the largest speed, above the tolerance {accuracy:g}"
        )
    # the error over the length is of second order in it
    longest = length * float(np.sqrt(accuracy / found)) if found else np.inf
    control.accurate = min(longest, control.accurate + GROWS * float(np.sqrt(accuracy)) * length)
    return 2.0 * length <= control.accurate


def _contact_forces(problem: UnitedProblem, touches: list[bool]) -> list[Array]:
    """Contact forces on both bodies, at this rank's nodes, of each contact that ``touches`` and should do no work (collective)."""
    closed = compress(problem.contacts, touches)
    own = slice(problem.config.gdim * problem.config.n_owned)
    idle = [
        c for c in closed if not (c.pair.trial.has_law or c.pair.target.motion or (c.pair.tie is not None and c.pair.tie.works))
    ]
    return [np.array(c.force.x.array[own]) for c in idle]


def _refuse_given_energy(
    problem: UnitedProblem, dynamics: Dynamics, length: float, before: list[Array], touches: list[bool]
) -> None:
    """EnergyGivenError for a step in which contacts have added energy beyond the limit (collective).

    In the trapezoidal rule, contactors that are released or slide round a bend do work with half of their initial force; it decreases
    with the step length. A contactor that has sunk past the target's end and is put back causes an impact in any step, and is ignored
    from the next attempt on. With methods other than elimination, contactors with mass gain energy in steps of any length.
    """
    control = problem.step_control
    if problem.impacts is not None:
        # contact acts for the whole step, with twice its mean force at the end
        before = []
    elif dynamics.contactors == "massy":
        return
    if not (forces := before + _contact_forces(problem, touches)):
        return
    config = problem.config
    way = config.of(problem.u.x.array - problem.committed)[: config.n_owned].ravel()
    given = reduced(problem.comm, 0.5 * float(sum(f @ way for f in forces)))
    words = control.too_much(given, length, dynamics.kinetic_energy, lambda: _held_by(problem, forces))
    if words is None:
        return
    barred = [_bar_returned(pair) for pair in problem.pairs]
    for pair, count in zip(problem.pairs, barred):
        if count:
            logger.warning(
                "%s: %d contactors that had slid past the end of the target and sunk come back inside it at time %.6g; to put them "
                "back onto it would be a blow, so they are left out until they are in front of it again",
                pair.name,
                count,
                dynamics.time,
            )
    control.refuse_energy(words, length, any(barred))


def _bar_returned(pair: Interface) -> int:
    """Exclude contactors that had sunk past the target's end and re-entered in this step; return their number (collective)."""
    came = pair.trial.active & ~pair.committed.active & pair.committed.passed
    count = int(reduced(pair.config.comm, int(came.sum())))
    if count:
        pair.remember(replace(pair.committed, barred=pair.committed.barred | came))
    return count


def _held_by(problem: UnitedProblem, forces: list[Array]) -> float:
    """Strain energy of contact forces ``(n_owned * gdim,)`` in adjacent cells, mean of a step's start and end (collective).

    For bodies at rest it is the reference for the work of these forces, since their kinetic energy is only rounding.
    """
    K = problem.bodies.stiffness
    if K is None:
        return 0.0
    compliance = np.where(K > 0.0, 1.0 / np.where(K > 0.0, K, 1.0), 0.0).ravel()
    held = sum(0.25 * float(f @ (compliance * f)) for f in forces)
    # plus the energy of gaps that count as closed, due to rounding
    open_still = CLOSED * problem.config.size
    pressed = np.logical_or.reduce([f != 0.0 for f in forces])
    held += 0.5 * float(K.ravel()[pressed].sum()) * open_still**2
    return float(reduced(problem.comm, held))


def _rounding(dynamics: Dynamics, dt: float, end: float) -> float:
    """Difference of times that counts as rounding."""
    return max(REMAINDER * dt, TIME_ROUNDING * max(abs(dynamics.start), abs(end)))
