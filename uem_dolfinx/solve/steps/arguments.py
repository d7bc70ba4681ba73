"""Checks of the arguments of functions that step through load or time."""

from __future__ import annotations

from typing import Any

from uem_dolfinx import given
from uem_dolfinx.parallel import agreed
from uem_dolfinx.solve.checks import check_checkpoint
from uem_dolfinx.solve.problem import UnitedProblem


def check_steps(problem: Any, checkpoint: Any) -> None:
    """Refuse arguments of step functions that are no problem or no checkpoint (collective if there is a problem).

    Raises:
        InputTypeError: for other objects.
    """
    given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
    with agreed(problem.comm):
        check_checkpoint(checkpoint)
