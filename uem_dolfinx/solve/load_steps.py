"""Load steps: the load grows from 0 to 1 in steps that are cut where they fail; every one that converges is committed."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.errors import UEMError
from uem_dolfinx.parallel import agreed
from uem_dolfinx.solve.newton import Iteration
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.step_control import REMAINDER, StepControl


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
        """Number of linear solves."""
        return len(self.iterations) - 1


def load_steps(problem: UnitedProblem, steps: int = 1) -> Iterator[LoadStep]:
    """Apply the load in steps, cut on failure and grown again on ease, up to the nominal length.

    Args:
        problem: what to load; its ``load`` follows the factor from 0 to 1 and its Dirichlet values are ramped.
        steps: nominal number of equal steps.

    Yields:
        Every converged step.

    Raises:
        InputError, InputTypeError: if ``steps`` is no whole number, 1 or more.
        ConvergenceError: if a step fails even at 1/1024 of its nominal length; the last converged state is kept.
        LinearSolveError, NotFiniteError, InvertedElementError: likewise.
    """
    with agreed(problem.comm):
        steps = given.count("steps", steps)
    given.alike(problem.comm, "load_steps", steps=steps)
    control, done, last = StepControl(1.0 / steps), 0.0, 0.0
    start = np.array(problem.u.x.array)
    ramped = isinstance(problem.load, fem.Constant) or problem.load is None
    while done < 1.0:
        factor = min(done + control.length, 1.0)
        if 1.0 - factor < REMAINDER:
            factor = 1.0
        problem.set_load(factor)
        try:
            iterations = problem.solve(
                start=start, fraction=factor if ramped else 1.0, ratio=(factor - done) / last if last else 0.0
            )
        except UEMError as error:
            # the last step may have been shorter than was meant
            if control.shorten(factor - done, error):
                continue
            problem.set_load(done)
            # the targets that the load moves are back, too
            problem.restore()
            raise
        last, done = factor - done, factor
        number, cuts = control.done(iterations)
        yield LoadStep(number, factor, iterations, cuts)
