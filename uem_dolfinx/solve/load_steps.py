"""Load steps: the load grows from 0 to 1 in steps that are cut where they fail; every one that converges is committed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.errors import UEMError
from uem_dolfinx.parallel import agreed
from uem_dolfinx.restart.checkpoint import Checkpoint
from uem_dolfinx.solve.newton import Iteration
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.step_control import REMAINDER
from uem_dolfinx.solve.stepping import between_steps


@dataclass(frozen=True)
class LoadStep:
    """A converged load step.

    Attributes:
        number: counted from 1.
        factor: load factor reached, 1 at the end.
        iterations: history of the Newton loop.
        cuts: how often the step had to be shortened.
    """

    number: int
    factor: float
    iterations: list[Iteration]
    cuts: int

    @property
    def newton_iterations(self) -> int:
        """Number of iterations, each with a tangent and at least one linear solve."""
        return len(self.iterations) - 1

    @property
    def exchanges(self) -> int:
        """Number of further linear solves with the same tangents, each with another active set."""
        return sum(i.exchanges for i in self.iterations)


def load_steps(problem: UnitedProblem, steps: int = 1, *, checkpoint: Checkpoint | None = None) -> Iterator[LoadStep]:
    """Apply the load in steps, cut on failure and grown again on ease, up to the nominal length.

    Args:
        problem: what to load; its ``load`` follows the factor from 0 to 1 and its Dirichlet values are ramped.
        steps: nominal number of equal steps.
        checkpoint: counts the steps, once the caller is done with each, and keeps the state; a file that is there is gone on from,
            either here or, for writers that are to resume, already by ``checkpoint.begin(problem.state())``. Of several calls of
            ``load_steps`` in a script those that the file is beyond yield nothing.

    Returns:
        An iterator of converged steps.

    Raises:
        InputError, InputTypeError: if ``steps`` is no whole number, 1 or more.
        CheckpointError: see ``Checkpoint``.
        ConvergenceError: if a step fails even at 1/1024 of its nominal length; the last converged state is kept.
        LinearSolveError, NotFiniteError, InvertedElementError, TunnellingError: likewise.
        KeyboardInterrupt, SystemExit: on all ranks, if any has got Ctrl-C or SIGTERM; the last converged state is kept.
    """
    with agreed(problem.comm):
        steps = given.count("steps", steps)
    given.alike(problem.comm, "load_steps", steps=steps)
    if checkpoint is not None and not checkpoint.begun:
        checkpoint.begin(problem.state())
    return between_steps(problem.comm, problem.progress, _load_steps(problem, steps), checkpoint)


def _load_steps(problem: UnitedProblem, steps: int) -> Iterator[LoadStep]:
    """The steps of ``load_steps``."""
    progress = problem.progress
    if not progress.begin_ramp(problem.u.x.array, steps):
        return
    control = progress.control
    ramped = isinstance(problem.load, fem.Constant) or problem.load is None
    if progress.factor > 0.0:
        problem.set_load(progress.factor)
    while progress.factor < 1.0:
        done = progress.factor
        factor = min(done + control.length, 1.0)
        if 1.0 - factor < REMAINDER:
            factor = 1.0
        problem.set_load(factor)
        try:
            iterations = problem.solve(start=progress.start, fraction=factor if ramped else 1.0)
        except UEMError as error:
            # the last step may have been shorter than was meant
            if control.shorten(factor - done, error):
                continue
            problem.set_load(done)
            # the targets that the load moves are back, too
            problem.restore()
            raise
        progress.factor = factor
        number, cuts = control.done(iterations)
        yield LoadStep(number, factor, iterations, cuts)
