"""Advance a problem by steps of given load."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uem_dolfinx.log import say
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.step_control import REMAINDER, StepControl
from uem_dolfinx.solve.united.newton import Iteration


class ByLoad:
    """Advances a problem by steps of given load.

    Attributes:
        tried: intended load increment of the last step.
        most: largest number of steps relative to the nominal one, here unlimited.
        longer: by how much the next step may be longer if this one was easy.
        shorter: part to which this step is cut if it failed.
    """

    def __init__(self, problem: UnitedProblem):
        self._problem, self.tried, self.most, self.longer, self.shorter = problem, 0.0, np.inf, 2.0, 0.5
        self._ramped = not callable(problem.load) and (problem.stage is None or problem.stage.step.ramp)

    def advance(self, done: float) -> tuple[float, list[Iteration]]:
        """Take a step from the committed load factor ``done`` and commit it: the new factor, and the Newton loop's history (collective)."""
        factor = _next_factor(done, self._problem.progress.control)
        # it may be shorter than the controlled length
        self.tried = factor - done
        return factor, self._step(done, factor)

    def _step(self, done: float, factor: float) -> list[Iteration]:
        """Reach a load factor from another, and commit it (collective)."""
        return self._reach(factor, self._problem.solve)

    def _reach(self, factor: float, solve: Callable[..., list[Iteration]]) -> list[Iteration]:
        """Reach a load factor by ``solve`` or ``attempt`` of the problem (collective)."""
        progress = self._problem.progress
        if self._problem.verbose:
            say(f"load step {progress.control.number + 1}, to load factor {factor:.6g}")
        self._problem.set_load(factor)
        return solve(start=progress.start, fraction=factor if self._ramped else 1.0)


def _next_factor(done: float, control: StepControl) -> float:
    """Load factor at the end of the next step, at most the next multiple of the nominal length."""
    nominal = control.nominal
    goal = min((np.floor(done / nominal + REMAINDER) + 1.0) * nominal, 1.0)
    factor = min(done + control.length, goal)
    if goal - factor < REMAINDER * nominal:
        factor = goal
    return 1.0 if 1.0 - factor < REMAINDER else float(factor)
