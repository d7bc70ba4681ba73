"""Ctrl-C and SIGTERM: noted when they come, on whichever rank, and acted on where all ranks have come to the same place."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable
from functools import wraps
from types import FrameType
from typing import Any, NoReturn, ParamSpec, Self, TypeVar

from mpi4py import MPI

from uem_dolfinx.errors import UEMError
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import mark_as_agreed, reduced

P = ParamSpec("P")
T = TypeVar("T")

#: Exit status of a run that has ended on SIGTERM, as shells have it.
#: [format; exit status; test_checkpoint_in_steps.py::test_terminated]
TERMINATED = 128 + signal.SIGTERM
#: What is noted, unless it is ignored.
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class InterruptedStepError(UEMError):
    """A signal has come within a step; never leaves the load and time stepping.

    Attributes:
        number: of the signal.
    """

    def __init__(self, number: int):
        super().__init__(f"interrupted by {signal.Signals(number).name}")
        self.number = number


class Interruption:
    """Signals that ask a run to end, noted within its ``with`` block; Ctrl-C after one does at once what it would have done outside.

    Blocks may stand within each other. Python allows handlers in the main thread only; elsewhere nothing is noted.

    Args:
        finishing: whether the script's steps within the block are finished first: blocks within it leave signals to it.
    """

    def __init__(self, finishing: bool = False) -> None:
        self._asked, self._depth, self._finishing = 0, 0, finishing
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        self._depth += 1
        if self._depth == 1 and threading.current_thread() is threading.main_thread():
            # what is ignored stays so, and what C code handles cannot be put back
            before = {number: signal.getsignal(number) for number in SIGNALS}
            kept = {number for number, was in before.items() if was in (signal.SIG_IGN, None) or _finishes(was)}
            self._before = {number: was for number, was in before.items() if number not in kept}
            for number in self._before:
                signal.signal(number, self._note)
        return self

    def __exit__(self, *error: object) -> None:
        self._depth -= 1
        if self._depth:
            return
        for number, before in self._before.items():
            # someone else may have come since
            if signal.getsignal(number) == self._note:
                signal.signal(number, before)
        asked, self._asked = self._asked, 0
        if asked:
            # no rank has acted on it
            signal.raise_signal(asked)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._depth and not self._asked:
            self._asked = number
            logger.warning("%s: the run ends after this iteration or step; Ctrl-C ends it at once", signal.Signals(number).name)
            return
        if self._depth and number == signal.SIGTERM:
            # some senders tell both the process and its group
            return
        self._asked, before = 0, self._before[number]
        if callable(before):
            before(number, frame)
        else:
            signal.signal(number, before)
            signal.raise_signal(number)

    def agreed(self, comm: MPI.Comm) -> int:
        """Number of a signal that any rank has got since it was asked last, 0 without one (collective)."""
        number = int(reduced(comm, self._asked, op=MPI.MAX))
        if number:
            self._asked = 0
        return number

    def check_signals(self, comm: MPI.Comm) -> None:
        """Raise ``InterruptedStepError`` on all ranks if any has got a signal (collective)."""
        number = self.agreed(comm)
        if number:
            raise InterruptedStepError(number)


def _finishes(handler: Any) -> bool:
    """Whether a handler is that of a block whose steps are finished first."""
    block = getattr(handler, "__self__", None)
    return isinstance(block, Interruption) and block._finishing


def end_run(number: int, kept: str) -> NoReturn:
    """End a run on a signal that all ranks know of, with a word about what is kept: KeyboardInterrupt, or SystemExit with status 143."""
    logger.warning("ended by %s; %s", signal.Signals(number).name, kept)
    raise mark_as_agreed(KeyboardInterrupt() if number == signal.SIGINT else SystemExit(TERMINATED)) from None


def end_together(comm_of: Callable[..., MPI.Comm | None]) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorate what is collective and takes long, so that a signal to any rank within ends the run on all at its end.

    Args:
        comm_of: the communicator, from the same arguments; None if they are not what they should be.
    """

    def decorate(f: Callable[P, T]) -> Callable[P, T]:
        @wraps(f)
        def decorated(*args: P.args, **kwargs: P.kwargs) -> T:
            try:
                comm = comm_of(*args, **kwargs)
            except TypeError:
                comm = None
            if comm is None:
                return f(*args, **kwargs)
            with Interruption() as noted:
                result = f(*args, **kwargs)
                number = noted.agreed(comm)
            if number:
                end_run(number, "no step has been made")
            return result

        return decorated

    return decorate
