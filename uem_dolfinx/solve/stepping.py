"""Common parts of load steps and time steps: progress of a problem, and actions between steps, on signals and for checkpoints."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial
from itertools import count
from typing import TYPE_CHECKING, Any, NoReturn, TypeVar

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced
from uem_dolfinx.restart.interruption import InterruptedStepError, Interruption, end_run
from uem_dolfinx.solve.loading import Taken
from uem_dolfinx.solve.step_control import StepControl
from uem_dolfinx.solve.united.newton import Iteration

if TYPE_CHECKING:
    from uem_dolfinx.contact.general.general import GeneralContact
    from uem_dolfinx.restart.checkpoint import Checkpoint
    from uem_dolfinx.restart.state import State

S = TypeVar("S", bound="ConvergedStep")


class ConvergedStep:
    """Base of converged steps, with numbers from their Newton iterations."""

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

    def __repr__(self) -> str:
        """Attributes that differ from their defaults, and the numbers of iterations and active-set changes."""
        shown = {
            name: value
            for name, value in vars(self).items()
            if name != "iterations" and not name.startswith("_") and value != getattr(type(self), name, None)
        }
        shown |= {"newton_iterations": self.newton_iterations, "exchanges": self.exchanges}
        return f"{type(self).__name__}({', '.join(f'{name}={value!r}' for name, value in shown.items())})"

    def summary(self, contacts: Sequence[Contact | GeneralContact]) -> str:
        """A line for the log of a run, with the active contactors and the force of every contact (collective)."""
        cut = f", cut {self.cuts} times" if self.cuts else ""
        words = [f"{self}: {self.newton_iterations} iterations, {self.exchanges} exchanges{cut}"]
        for contact in contacts:
            force = ", ".join(f"{f:.6g}" for f in contact.resultant().force)
            words.append(f"{contact.name}: {contact.n_active} active, force ({force})")
        return "; ".join(words)


@dataclass
class Progress:
    """Progress of a problem in steps and in load."""

    steps: int = 0  # number of converged and committed steps
    resumed: int = 0  # number of checkpoints that have been read
    ramp: int = 0  # number of the present call of ``load_steps``, counted from 1; 0 before the first
    factor: float = 0.0  # load factor reached in it
    #: displacement at its beginning ``(n_local incl. ghosts,)``; with arc lengths at the beginning of its last step.
    start: Array = field(default_factory=lambda: np.zeros(0))
    reach: float = 0.0  # arc length of the whole call, extrapolated from its first step; 0 without arc lengths
    dissipating: float = 0.0  # dissipated part of the energy of the last step, see ``Dissipation``
    control: StepControl = field(default_factory=StepControl)  # length of its steps
    interruption: Interruption | None = None  # signals that are noted during steps
    #: ends the run on a signal of a given number, once the problem is in its last converged state.
    end: Callable[[int], NoReturn] = lambda number: end_run(number, "the problem is in its last converged state")
    inside: bool = False  # whether the caller works on a step, in the body of the loop
    step: str = ""  # name of the ``Step`` of this call
    loads: list[Any] = field(default_factory=list)  # values of its Constants at its beginning
    carried: Array | None = None  # released forces at all unknowns at its beginning, ghosts included ``(n,)``; None if zero
    #: multipliers of equations of users at their eliminated components, from a checkpoint ``(n_local, gdim)``.
    of_equations: Array = field(default_factory=lambda: np.zeros((0, 0)))
    taken: Taken = field(default_factory=Taken)  # shares of the committed state, see ``solve.loading``
    began: Taken = field(default_factory=Taken)  # shares at the beginning of the call
    #: load factors at which lists of several ``Step`` were left before their end, by the number of the call that the ``Step``
    #: counts as.
    left: dict[int, float] = field(default_factory=dict)
    #: identifies the problem in this script; its steps have it as ``_of_problem``.
    number: int = field(default_factory=partial(next, count(1)))
    _calls: int = 0

    @property
    def time(self) -> float:
        """Number of steps, as clock of tables that are ordered by steps."""
        return self.steps

    @property
    def ahead(self) -> int:
        """Number of the next call of ``load_steps`` relative to the problem's present call; negative if that is a later one."""
        return self._calls + 1 - self.ramp

    def left_at(self) -> float | None:
        """Load factor at which the next call, with its list of steps, was left before a checkpoint of a later call; else None.

        The entry of a call that is begun or continued is removed.
        """
        number = self._calls + 1
        if number < self.ramp:
            return self.left.get(number)
        self.left.pop(number, None)
        return None

    def begin_ramp(self, displacement: Array, steps: int) -> bool:
        """Begin a call of ``load_steps`` with a number of steps, or continue the call in which a checkpoint was written.

        Returns whether the call has steps to take; False if the checkpoint was written in a later call.
        """
        self._calls += 1
        if self._calls > self.ramp:
            self.ramp, self.factor, self.start = self._calls, 0.0, np.array(displacement)
            self.reach, self.dissipating, self.began = 0.0, 0.0, self.taken.now()
            self.control = StepControl()
        if self._calls == self.ramp:
            self.control.begin(1.0 / steps)
        return self._calls == self.ramp

    def take_shares(self, began: Taken, taken: Taken) -> None:
        """Set the shares at the beginning of the call, and the present ones, from earlier steps."""
        self.began, self.taken = began, taken

    def check_signals(self, comm: MPI.Comm) -> None:
        """Raise ``InterruptedStepError`` on all ranks if any rank has received a signal during stepping (collective)."""
        if self.interruption is not None:
            self.interruption.check_signals(comm)

    @contextmanager
    def checking_signals(self, comm: MPI.Comm) -> Iterator[None]:
        """A block in which a signal to any rank ends the run on all, once the problem is in its last converged state (collective)."""
        outer, own = self.interruption, self.interruption or Interruption()
        self.interruption = own
        try:
            with own:
                yield
                if outer is None:
                    self.check_signals(comm)
        except InterruptedStepError as interrupted:
            if outer is not None and not self.inside:
                raise
            self.end(interrupted.number)
        finally:
            self.interruption = outer

    def to_checkpoint(self, ramped: bool) -> dict[str, Any]:
        """Numbers for a checkpoint, by name; with the numbers of load steps if ``ramped``."""
        load: dict[str, Any] = {}
        if ramped:
            ramp = [self.ramp, *map(list, self.left.items())] if self.left else self.ramp
            load = {"load ramp": ramp, "load factor": self.factor, "arc length": self.reach}
            load |= {"dissipating": self.dissipating}
            load |= {
                "name of the step": self.step,
                "loads at its beginning": self.loads,
                "releases forces": self.carried is not None,
            }
        return {"steps committed": self.steps} | load | (self.control.to_checkpoint() if ramped else {})

    def from_checkpoint(self, kept: dict[str, Any], start: Array | None, carried: Array | None) -> None:
        """Restore numbers from ``to_checkpoint``; for load steps also the initial displacement and the released forces."""
        self.steps = kept["steps committed"]
        self.resumed += 1
        if start is not None:
            ramp, self.factor, self.reach = kept["load ramp"], kept["load factor"], kept["arc length"]
            # files of earlier versions lack it
            self.dissipating = kept.get("dissipating", 0.0)
            self.ramp, *left = ramp if isinstance(ramp, list) else [ramp]
            self.left = dict(left)
            self.start, self.step, self.loads = np.array(start), kept["name of the step"], kept["loads at its beginning"]
            self.carried = carried if kept["releases forces"] else None
            self.control.from_checkpoint(kept)
            # a restarted script makes this call of load_steps again
            self._calls = max(0, min(self._calls, self.ramp - 1))


def begin_checkpoint(checkpoint: Checkpoint | None, state: Callable[[], State], u: Any) -> None:
    """Begin a checkpoint, unless the caller has begun it with a state of this displacement (collective).

    Raises CheckpointError as in ``Checkpoint.begin``, or if it has begun with the state of another problem.
    """
    if checkpoint is None:
        return
    if checkpoint.begun:
        checkpoint.check(u)
    else:
        checkpoint.begin(state())


def between_steps(
    comm: MPI.Comm,
    progress: Progress,
    steps: Iterable[S],
    checkpoint: Checkpoint | None,
    contacts: Sequence[Contact | GeneralContact],
) -> Iterator[S]:
    """Steps, between which the checkpoint is written when due, and on a signal to any rank, which ends the run on all ranks.

    Each step is logged in one line at level INFO, if the application enables this level.

    Args:
        comm: communicator of the problem.
        progress: of the problem, for signals within a step, too.
        contacts: of the problem, as declared.
        steps: each brings the problem from one committed state to the next; on errors the last state is restored.
        checkpoint: which has begun, or None.

    Yields:
        The steps.

    Raises:
        KeyboardInterrupt: after Ctrl-C, with the last committed state in the problem and in the checkpoint.
        SystemExit: with status 143 after SIGTERM, with the same states.
        CheckpointError: if the checkpoint cannot be written. On any other error, and if the caller leaves the loop, the last
            committed state is written, too.
    """
    logs = comm.bcast(logger.isEnabledFor(logging.INFO))
    outer = progress.interruption, progress.end
    progress.interruption = Interruption() if checkpoint is None else checkpoint.interruption
    loop = object()  # this loop, for the checkpoint
    if checkpoint is not None:
        progress.end = checkpoint.end
    try:
        with progress.interruption:
            try:
                for step in steps:
                    if logs:
                        logger.info("%s", step.summary(contacts))
                    # steps are frozen, except for this attribute
                    object.__setattr__(step, "_of_problem", progress.number)
                    progress.inside = True
                    if checkpoint is not None:
                        checkpoint.hand_out(loop)
                    yield step
                    progress.inside = False
                    if checkpoint is None:
                        progress.check_signals(comm)
                    else:
                        checkpoint.step()
                if checkpoint is not None:
                    checkpoint.finish()
            except InterruptedStepError as interrupted:
                progress.end(interrupted.number)
    except BaseException as error:
        if checkpoint is not None:
            checkpoint.leave(error, loop)
        raise
    finally:
        (progress.interruption, progress.end), progress.inside = outer, False


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
