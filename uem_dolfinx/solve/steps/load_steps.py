"""Load steps: the load factor increases from 0 to 1 in steps that are cut on failure; every converged step is committed."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from uem_dolfinx import given
from uem_dolfinx.errors import ConvergenceError, InputError, UEMError
from uem_dolfinx.log import progress as progress_bar
from uem_dolfinx.parallel import agreed, ask_together
from uem_dolfinx.solve import checks
from uem_dolfinx.solve.loading import words_of
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.stepping import LoadStep, begin_checkpoint, between_steps
from uem_dolfinx.solve.steps.by_load import ByLoad

if TYPE_CHECKING:
    from uem_dolfinx.restart.checkpoint import Checkpoint
    from uem_dolfinx.solve.steps.arc_length import AlongArc
    from uem_dolfinx.solve.steps.dissipation import Dissipation
    from uem_dolfinx.solve.steps.stages import Step


def load_steps(
    problem: UnitedProblem,
    steps: int | Sequence[Step] = 1,
    *,
    arc_length: bool | Dissipation = False,
    tolerance: float | None = None,
    estimate: Callable[[UnitedProblem], None] | None = None,
    checkpoint: Checkpoint | None = None,
) -> Iterator[LoadStep]:
    """Apply the load in steps, cut on failure and increased again after steps that converge quickly, up to the nominal length.

    Args:
        problem: problem to solve; its ``load`` is evaluated at factors from 0 to 1 and its Dirichlet values are ramped.
        steps: nominal number of equal steps; after a cut they end again at multiples of their length. Or a list of ``Step``, each with
            its own number, between which conditions, loads, contacts and coefficients change: the load factor runs from 0 to 1 in each.
        arc_length: prescribe the load of the first step only, and its length in displacement for all other steps. The load factor is an
            unknown, which increases up to limit points and decreases beyond them, until it is 1. Dirichlet values are not ramped.
            A ``Dissipation`` also controls the energy that damage dissipates in a step, to follow paths that snap back.
        tolerance: shorten steps until their change of the state differs by less than this part from two half steps, whose result is kept,
            and lengthen them where they allow it. So histories of friction and plasticity have about this error. None: no such test.
        estimate: called with the problem after every step, as ``ErrorLimit(0.05)``, which warns of errors by the mesh; or None.
        checkpoint: counts the steps, after the body of the loop, and stores the state; an existing file is resumed, here or earlier
            in ``checkpoint.begin(problem.state())``, which writers with ``resume=True`` need. On restart, calls of ``load_steps``
            that the checkpoint has already passed yield no steps.

    Returns:
        An iterator of converged steps.

    Raises:
        InputError, InputTypeError: if ``steps`` is neither a positive whole number nor a list of ``Step``, or if a step is not of this
            problem. With ``arc_length`` if no load moves the bodies, if Dirichlet values do, for a list of ``Step``, or with ``tolerance``.
            With ``tolerance`` while the problem is recorded. With dynamics.
        CheckpointError: see ``Checkpoint``.
        ConvergenceError, LinearSolveError, NotFiniteError, InvertedElementError, TunnellingError: if a step fails even at 1/1024 of its
            nominal length; the last converged state is kept.
        StepAccuracyError: if the error exceeds the tolerance even in the shortest step.
        KeyboardInterrupt, SystemExit: on all ranks, if any rank has received Ctrl-C or SIGTERM; the last converged state is kept.
    """
    check_steps(problem, checkpoint)
    if problem.dynamics is not None:
        raise InputError(
            "load_steps are for statics: leave dynamics out, or take time_steps and change loads in the loop over these; solve() finds an "
            "equilibrium before time steps"
        )
    several = isinstance(steps, Sequence) and not isinstance(steps, (str, bytes))
    with agreed(problem.comm):
        by = None
        if not isinstance(arc_length, bool):
            from uem_dolfinx.solve.steps.dissipation import Dissipation

            expected = "True, False or a Dissipation"
            by, arc_length = given.kind("arc_length", arc_length, isinstance(arc_length, Dissipation), expected), True
        if several and arc_length:
            raise InputError(
                "arc_length = True does not go with a list of Step: follow a path by load_steps(problem, n, arc_length=True)"
            )
        tolerance = None if tolerance is None else given.number("tolerance", tolerance, given.between(0.0, 1.0))
        if arc_length and tolerance is not None:
            raise InputError(
                "tolerance does not go with arc_length = True, where half a step ends elsewhere: leave one of them out"
            )
        if problem.history is not None and tolerance is not None:
            raise InputError("the problem is being recorded: leave tolerance out, and take as many steps as a run with it took")
        n = 0 if several else given.count("steps", steps, "or give a list of Step")
    given.kind("estimate", estimate, estimate is None or callable(estimate), "an ErrorLimit, or another function of the problem")
    given.alike(
        problem.comm, "load_steps", steps=n, arc_length=repr(by or arc_length), tolerance=tolerance, load=words_of(problem.load),
        estimate=type(estimate).__name__, checkpoint=type(checkpoint).__name__,
    )  # fmt: skip
    if isinstance(steps, Sequence):
        from uem_dolfinx.solve.steps.stages import check_stages

        check_stages(problem, steps)
    begin_checkpoint(checkpoint, problem.state, problem.config.functions()[problem.config.name])
    if isinstance(steps, Sequence):
        made, total = _in_stages(problem, steps, tolerance), sum(step.n for step in steps)
    else:
        way: ByLoad | AlongArc = _by_load(problem, tolerance)
        if arc_length:
            from uem_dolfinx.solve.steps.arc_length import AlongArc

            way = AlongArc(problem, by)
        made, total = _load_steps(problem, steps, way), steps
    if estimate is not None:
        made = _estimated(problem, made, estimate)
    return between_steps(
        problem.comm, problem.progress, progress_bar(made, "load steps", total=total), checkpoint, problem.declared
    )


def _estimated(
    problem: UnitedProblem, steps: Iterator[LoadStep], estimate: Callable[[UnitedProblem], None]
) -> Iterator[LoadStep]:
    """The steps, after each of which the error is estimated."""
    for step in steps:
        ask_together(problem.comm, "estimate", estimate, problem)
        yield step


def _in_stages(problem: UnitedProblem, steps: Sequence[Step], tolerance: float | None) -> Iterator[LoadStep]:
    """The load steps of several ``Step``, or, on restart, up to the load factor at which the earlier run has left them."""
    from uem_dolfinx.solve.steps.stages import Stage

    progress = problem.progress
    for step in steps:
        left, through = progress.left_at(), False
        stage = Stage(problem, step, 1.0 if left is None else left)
        try:
            for made in _load_steps(problem, step.n, _by_load(problem, tolerance)):
                yield replace(made, step=step.name, before=progress.ramp - 1)
            through = True
        finally:
            stage.leave()
            if not through:
                progress.left[progress.ramp] = progress.factor
        if left is not None:
            return


def _load_steps(problem: UnitedProblem, steps: int, way: ByLoad | AlongArc) -> Iterator[LoadStep]:
    """The steps of ``load_steps``."""
    progress = problem.progress
    if not progress.begin_ramp(problem.u.x.array, steps):
        return
    ramp = progress.ramp
    if progress.factor != 0.0:
        problem.set_load(progress.factor)
    unstable: float | None = None  # load factor of the last unstable equilibrium
    while progress.factor < 1.0:
        done = progress.factor
        if progress.control.number >= way.most * steps:
            raise ConvergenceError(
                f"the load factor is {done:.3g} after {progress.control.number} steps of the arc, and has not come to 1: the path does "
                "not lead there; look at the states that were yielded, or take longer steps"
            )
        try:
            factor, iterations = way.advance(done)
        except UEMError as error:
            if progress.control.shorten(way.tried, error, way.shorter):
                continue
            from uem_dolfinx.solve.memory import take_back
            from uem_dolfinx.solve.steps.limit_points import LimitPoint

            limit = LimitPoint(problem, arc=not isinstance(way, ByLoad))
            take_back(problem, done)
            limit.name(error, done, unstable)
            raise
        progress.factor = factor
        if problem.solver.indefinite:
            unstable = factor
        number, cuts = progress.control.done(iterations, way.longer)
        yield LoadStep(number, factor, iterations, cuts)
        if progress.ramp != ramp and factor < 1.0:
            raise InputError(
                f"another loop over load_steps of the problem has begun within this one, at its load factor {factor:.6g}: expected one "
                "loop after the other; repeat a step by problem.solve(), and leave a loop by break"
            )


def _by_load(problem: UnitedProblem, tolerance: float | None) -> ByLoad:
    """Steps of given load, with a tolerance for their error or without."""
    if tolerance is None:
        return ByLoad(problem)
    from uem_dolfinx.solve.steps.by_error import ByError

    return ByError(problem, tolerance)


def check_steps(problem: Any, checkpoint: Any) -> None:
    """Refuse arguments of step functions that are no problem or no checkpoint (collective if there is a problem).

    Raises InputTypeError for other objects.
    """
    given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
    with agreed(problem.comm):
        problem.config.refuse_moved()
        checks.check_checkpoint(checkpoint)
