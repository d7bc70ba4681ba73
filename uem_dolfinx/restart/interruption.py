"""Ctrl-C and SIGTERM: noted when they arrive, on any rank, and acted on when all ranks have reached the same point."""

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
#: Signals that are noted, unless they are ignored.
SIGNALS = (signal.SIGINT, signal.SIGTERM)


class InterruptedStepError(UEMError):
    """A signal, by its ``number``, has arrived within a step; always caught by the load and time stepping."""

    def __init__(self, number: int):
        super().__init__(f"interrupted by {signal.Signals(number).name}")
        self.number = number


class Interruption:
    """Signals to end a run, noted within its ``with`` block; a further Ctrl-C has its usual effect at once.

    Blocks may be nested. Python allows signal handlers in the main thread only; in other threads no signal is noted.

    Args:
        finishing: whether the script's steps within the block are finished first; nested blocks then do not handle signals.
    """

    def __init__(self, finishing: bool = False) -> None:
        self._received, self._depth, self._finishing = 0, 0, finishing
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        self._depth += 1
        if self._depth == 1 and threading.current_thread() is threading.main_thread():
            # ignored signals stay ignored, and handlers of C code could not be restored
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
            # other code may have set its own handler since
            if signal.getsignal(number) == self._note:
                signal.signal(number, before)
        received, self._received = self._received, 0
        if received:
            # the signal has not been acted on
            signal.raise_signal(received)

    def _note(self, number: int, frame: FrameType | None) -> None:
        if self._depth and not self._received:
            self._received = number
            logger.warning("%s: the run ends after this iteration or step; Ctrl-C ends it at once", signal.Signals(number).name)
            return
        if self._depth and number == signal.SIGTERM:
            # some senders signal both the process and its group
            return
        self._received, before = 0, self._before[number]
        if callable(before):
            before(number, frame)
        else:
            signal.signal(number, before)
            signal.raise_signal(number)

    def agreed(self, comm: MPI.Comm) -> int:
        """Number of a signal that any rank has received since the last call, 0 without one (collective)."""
        number = int(reduced(comm, self._received, op=MPI.MAX))
        if number:
            self._received = 0
        return number

    def check_signals(self, comm: MPI.Comm) -> None:
        """Raise ``InterruptedStepError`` on all ranks if any rank has received a signal (collective)."""
        number = self.agreed(comm)
        if number:
            raise InterruptedStepError(number)


def _finishes(handler: Any) -> bool:
    """Whether a handler belongs to a block that finishes its steps first."""
    block = getattr(handler, "__self__", None)
    return isinstance(block, Interruption) and block._finishing


def end_run(number: int, kept: str) -> NoReturn:
    """End a run on a signal known to all ranks, and log the saved results: KeyboardInterrupt, or SystemExit with status 143."""
    logger.warning("ended by %s; %s", signal.Signals(number).name, kept)
    raise mark_as_agreed(KeyboardInterrupt() if number == signal.SIGINT else SystemExit(TERMINATED)) from None


def end_together(comm_of: Callable[..., MPI.Comm | None]) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorate a long collective function, so that a signal to any rank during the call ends the run on all ranks after it.

    Args:
        comm_of: returns the communicator from the same arguments; None if they are invalid.
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
