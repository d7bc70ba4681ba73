"""Data of a converged time step, and which contacts have closed or opened in it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.stepping import ConvergedStep
from uem_dolfinx.solve.united.newton import Iteration


@dataclass(frozen=True, repr=False)
class TimeStep(ConvergedStep):
    """A converged time step.

    Attributes:
        number: counted from 1.
        time: reached.
        dt: length of the step.
        iterations: history of the Newton loop.
        cuts: number of times that the step was shortened.
        touched: names of the contacts that had no active contactor before the step, and have one after it.
        left: names of the contacts that had an active contactor before the step, and have no active contactor after it.
    """

    number: int
    time: float
    dt: float
    iterations: list[Iteration]
    cuts: int
    touched: tuple[str, ...]
    left: tuple[str, ...]

    def __str__(self) -> str:
        """Its number and time, and the contacts that have closed or opened in it."""
        events = [f"{word} {', '.join(names)}" for word, names in (("touched:", self.touched), ("left:", self.left)) if names]
        return ", ".join([f"time step {self.number}, time {self.time:.6g}", *events])

    @property
    def start(self) -> float:
        """Time at which the step began; with ``event_tolerance`` the instant of the touches and departures in it."""
        return self.time - self.dt


def touching(problem: Any) -> list[bool]:
    """Whether each contact has active contactors (collective)."""
    if not problem.contacts:
        return []
    active = np.array([any(part.pair.united.any() for part in one.all_parts) for one in problem.contacts])
    return list(map(bool, reduced(problem.comm, active, op=MPI.LOR)))


def events(problem: Any, before: list[bool], after: list[bool]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names of the contacts that have closed, and of those that have opened, by whether each had active contactors."""
    # further parts come last
    names = [contact.name for contact in problem.contacts if not contact.is_further_part]
    touched = tuple(name for name, was, now in zip(names, before, after) if now and not was)
    return touched, tuple(name for name, was, now in zip(names, before, after) if was and not now)
