"""What is told of a converged load step."""

from __future__ import annotations

from dataclasses import dataclass

from uem_dolfinx.solve.newton import Iteration
from uem_dolfinx.solve.stepping import Step


@dataclass(frozen=True, repr=False)
class LoadStep(Step):
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

    def __str__(self) -> str:
        """Which step it is, and its load factor."""
        return f"load step {self.number}, factor {self.factor:.6g}"
