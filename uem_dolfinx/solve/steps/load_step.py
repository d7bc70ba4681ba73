"""Data of a converged load step."""

from __future__ import annotations

from dataclasses import dataclass

from uem_dolfinx.solve.stepping import ConvergedStep
from uem_dolfinx.solve.united.newton import Iteration


@dataclass(frozen=True, repr=False)
class LoadStep(ConvergedStep):
    """A converged load step.

    Attributes:
        number: counted from 1.
        factor: load factor reached, 1 at the end.
        iterations: history of the Newton loop.
        cuts: number of times that the step was shortened.
        step: name of its ``Step``, or empty.
        before: number of ``Step`` before it.
    """

    number: int
    factor: float
    iterations: list[Iteration]
    cuts: int
    step: str = ""
    before: int = 0

    @property
    def time(self) -> float:
        """Number of completed ``Step`` plus the load factor in the present one, which increases from step to step."""
        return self.before + self.factor

    def __str__(self) -> str:
        """Its number and load factor."""
        return f"{f'{self.step}, ' if self.step else ''}load step {self.number}, factor {self.factor:.6g}"
