"""What is told of a converged load step."""

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
        cuts: how often the step had to be shortened.
        step: name of the ``Step`` that it is of; empty without.
        before: number of ``Step`` before that.
    """

    number: int
    factor: float
    iterations: list[Iteration]
    cuts: int
    step: str = ""
    before: int = 0

    @property
    def time(self) -> float:
        """Number of ``Step`` that are done and the load factor in the present one, which grows from step to step."""
        return self.before + self.factor

    def __str__(self) -> str:
        """Which step it is, and its load factor."""
        return f"{f'{self.step}, ' if self.step else ''}load step {self.number}, factor {self.factor:.6g}"
