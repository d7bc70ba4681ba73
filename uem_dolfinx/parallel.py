"""Communication between ranks: exchange of rows of arrays with replies, reductions, and errors raised on all ranks."""

from __future__ import annotations

import pickle
import signal
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from itertools import pairwise
from operator import itemgetter
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar, cast

from mpi4py import MPI  # before dolfinx and petsc4py: in the PyPI wheel it loads the MPI library

import numpy as np

from uem_dolfinx import arrays
from uem_dolfinx.arrays import AnyArray, Ints, copied, numbers_only, plain
from uem_dolfinx.errors import UEMError, UserFunctionError

T = TypeVar("T")

#: Exit status of a run that Ctrl-C to one rank has ended between what is collective, as shells have it.
#: [format; exit status; test_signals.py::test_one_rank_is_interrupted_before_the_steps]
INTERRUPTED = 128 + signal.SIGINT
#: How often a rank looks whether the others have come. [bound; seconds; -]
POLLED = 1e-3


def agree(comm: MPI.Comm, error: BaseException | None) -> None:
    """Raise on every rank the error of the first rank that has one (collective).

    If a single rank raised an error, the others would wait for ever in the next collective call.

    Args:
        comm: the communicator whose ranks have to agree.
        error: error of this rank, or None.

    Raises:
        BaseException: the same error on all ranks, if any rank has one, including SystemExit and KeyboardInterrupt; a RuntimeError
            with its text if it cannot be pickled.
    """
    if comm.size > 1 and reduced(comm, error is not None, op=MPI.LOR):
        errors = comm.allgather(_sendable(error))
        first = next(rank for rank, e in enumerate(errors) if e is not None)
        if first != comm.rank or errors[first].__class__ is not error.__class__:
            raise mark_as_agreed(errors[first]) from error
    if error is not None:
        raise mark_as_agreed(error)


def mark_as_agreed(error: BaseException) -> BaseException:
    """The error, marked as raised on all ranks."""
    error.of_all_ranks = True  # type: ignore[attr-defined]
    return error


def is_agreed(error: BaseException | None) -> bool:
    """Whether all ranks raise this error."""
    return getattr(error, "of_all_ranks", False)


def _end_all_ranks(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Print an error that ends the script; after Ctrl-C on one rank, abort the others, which would wait for ever."""
    _tell(kind, error, trace)
    if isinstance(error, KeyboardInterrupt) and not is_agreed(error) and not MPI.Is_finalized():
        sys.stderr.flush()
        MPI.COMM_WORLD.Abort(INTERRUPTED)


_tell = sys.excepthook
if MPI.COMM_WORLD.size > 1:
    sys.excepthook = _end_all_ranks


def _sendable(error: BaseException | None) -> Any:
    """The error, or a RuntimeError with its text if it cannot be pickled."""
    try:
        return error if type(pickle.loads(pickle.dumps(error))) is type(error) else RuntimeError(str(error))
    except Exception:
        return RuntimeError(f"{type(error).__name__}: {error}")


@contextmanager
def agreed(comm: MPI.Comm) -> Iterator[None]:
    """Raise an error of this block on one rank at its end on all ranks; the block itself must not be collective (collective)."""
    error: BaseException | None = None
    try:
        yield
    except BaseException as found:
        error = found
    agree(comm, error)


def ask(what: str, f: Callable[..., T], *args: Any) -> T:
    """The return value of a function of the user.

    Args:
        what: name of the function in messages.
        f: called with ``args``.
        args: of the function, which gets copies of arrays: what it writes into them changes nothing.

    Raises:
        UserFunctionError: with the function's name, its error and line; also for GeneratorExit, which would silently end the steps.
            Errors of the package, SystemExit, KeyboardInterrupt and others that are no Exception are not changed.
    """
    try:
        return cast(T, plain(f(*(numbers_only(copied(one)) for one in args))))
    except UEMError:
        raise
    except (Exception, GeneratorExit) as error:
        frames = traceback.extract_tb(error.__traceback__)
        not_theirs = arrays.__file__, "<__array_function__ internals>"
        last = next((one for one in reversed(frames) if one.filename not in not_theirs), frames[-1])
        raise UserFunctionError(
            f"{what} raised {type(error).__name__}: {error} ({Path(last.filename).name}, line {last.lineno}); mend the function"
        ) from error


def ask_together(comm: MPI.Comm, what: str, f: Callable[..., T], *args: Any) -> T:
    """``ask`` on every rank; an error on one rank is raised on all (collective)."""
    with agreed(comm):
        return ask(what, f, *args)
    raise AssertionError("an error that no rank raised")


class _Meeting:
    """A duplicate of a communicator for barriers with a time limit, until ranks have missed one."""

    def __init__(self, comm: MPI.Comm):
        self.comm, self.missed = comm.Dup(), False


def _free(comm: MPI.Comm, key: int, meeting: _Meeting) -> None:
    """Free the communicator of a meeting together with the original communicator."""
    meeting.comm.Free()


#: Attribute key of a communicator's meeting.
_MEETING = MPI.Comm.Create_keyval(delete_fn=_free)


def prepare_meeting(comm: MPI.Comm) -> None:
    """Prepare ``all_come``, once for each communicator (collective)."""
    if comm.size > 1 and comm.Get_attr(_MEETING) is None:
        comm.Set_attr(_MEETING, _Meeting(comm))


def all_come(comm: MPI.Comm, seconds: float) -> bool:
    """Barrier with a time limit: whether all ranks arrive within so many seconds; the same result on all ranks that arrive.

    It may be called by some ranks only, at any time after ``prepare_meeting``, without interfering with messages of other calls. After
    one missed barrier the result is always False.
    """
    if comm.size == 1:
        return True
    meeting: _Meeting = comm.Get_attr(_MEETING)
    # a second barrier, for ranks that arrive just when others give up
    for _ in range(2):
        if meeting.missed:
            return False
        request, end = meeting.comm.Ibarrier(), time.monotonic() + seconds
        while not request.Test():
            if time.monotonic() > end:
                meeting.missed = True
                break
            time.sleep(POLLED)
    return not meeting.missed


class Exchange:
    """Rows of arrays sent to other ranks, and replies sent back (the constructor is collective).

    Arrays may have any type except objects, and rows of any shape, both the same on all ranks. All arrays of a call are sent in one
    message of bytes for each pair of ranks. On one rank nothing is sent, and rows in order are not copied.

    Args:
        rows: for each rank the indices of this rank's rows that are sent to it; a row may go to several ranks, or to no rank.

    Attributes:
        rows: indices of the rows sent, rank by rank ``(n_sent,)``; a row occurs as often as it is sent.
    """

    def __init__(self, comm: MPI.Comm, rows: Sequence[Ints]):
        self.comm, self.rows = comm, rows[0] if comm.size == 1 else np.concatenate(rows)
        self._sent = self._received = np.array([len(r) for r in rows], dtype=np.int32)
        if comm.size > 1:
            self._received = np.empty_like(self._sent)
            comm.Alltoall(self._sent, self._received)
        in_order = comm.size == 1 and bool((self.rows == np.arange(len(self.rows))).all())
        self._pick = itemgetter(slice(len(self.rows)) if in_order else self.rows)

    @classmethod
    def to(cls, comm: MPI.Comm, rank: Ints) -> Exchange:
        """Exchange of rows that go to one ``rank (n,)`` each, -1 for no rank."""
        if comm.size == 1:
            return cls(comm, [(rank >= 0).nonzero()[0]])
        order = np.argsort(rank, kind="stable")
        ends = np.searchsorted(rank[order], np.arange(comm.size + 1))
        return cls(comm, [order[a:b] for a, b in pairwise(ends)])

    @property
    def origins(self) -> Ints:
        """Sending ranks of the received rows ``(n_received,)``."""
        return np.repeat(np.arange(self.comm.size), self._received)

    def send(self, *arrays: AnyArray) -> list[AnyArray]:
        """Rows of ``arrays (n, ...)`` that other ranks and this one send here ``(n_received, ...)``, in their order (collective)."""
        rows = list(map(self._pick, arrays))
        return rows if self.comm.size == 1 else self._exchange(rows, self._sent, self._received)

    def back(self, *arrays: AnyArray) -> list[AnyArray]:
        """Replies ``(n_sent, ...)`` for ``rows``, from ``arrays (n_received, ...)`` with replies to the received rows (collective)."""
        return list(arrays) if self.comm.size == 1 else self._exchange(list(arrays), self._received, self._sent)

    def _exchange(self, arrays: list[AnyArray], sent: AnyArray, received: AnyArray) -> list[AnyArray]:
        row = np.dtype([(str(i), a.dtype, a.shape[1:]) for i, a in enumerate(arrays)])
        out, into = np.empty(sent.sum(), row), np.empty(received.sum(), row)
        for i, a in enumerate(arrays):
            out[str(i)] = a
        if row.itemsize:
            starts = [np.concatenate([[0], np.cumsum(counts)[:-1]]) for counts in (sent, received)]
            unit = MPI.BYTE.Create_contiguous(row.itemsize).Commit()
            self.comm.Alltoallv([out.view(np.uint8), (sent, starts[0]), unit], [into.view(np.uint8), (received, starts[1]), unit])
            unit.Free()
        return [into[str(i)].copy() for i in range(len(arrays))]


def count_keys(comm: MPI.Comm, keys: Ints) -> Ints:
    """Number of occurrences of each row of ``keys (n, k)`` on all ranks ``(n,)`` (collective)."""
    return sums_by_keys(comm, keys, np.ones((len(keys), 1), np.int64))[:, 0]


def sums_by_keys(comm: MPI.Comm, keys: Ints, values: AnyArray) -> AnyArray:
    """Sums of the rows of ``values (n, k)`` with equal ``keys (n, l)`` over all ranks, for every row ``(n, k)`` (collective).

    Equal rows are summed on one rank.
    """
    meeting = Exchange.to(comm, keys[:, 0] % comm.size)
    met, their = meeting.send(keys, values)
    _, inverse = np.unique(met, axis=0, return_inverse=True)
    inverse = inverse.ravel()
    sums = np.zeros((inverse.max(initial=-1) + 1, values.shape[1]), values.dtype)
    np.add.at(sums, inverse, their)
    total = np.empty(values.shape, values.dtype)
    (total[meeting.rows],) = meeting.back(sums[inverse])
    return total


def gathered(comm: MPI.Comm, value: Any) -> AnyArray:
    """Numbers, or arrays ``(...)`` of the same shape, of all ranks ``(n_ranks, ...)``, in one call (collective)."""
    own = np.ascontiguousarray(value)
    if comm.size == 1:
        return own.reshape(1, *np.shape(value))
    every = np.empty((comm.size, *np.shape(value)), own.dtype)
    comm.Allgather(own, every)
    return every


def on_root(comm: MPI.Comm, values: AnyArray) -> Any:
    """Arrays of all ranks, one after the other, on rank 0; an empty array on the other ranks (collective)."""
    parts = comm.gather(values)
    return np.concatenate(parts) if parts is not None else np.zeros(0)


def reduced(comm: MPI.Comm, value: Any, op: MPI.Op = MPI.SUM) -> Any:
    """Sum, or another reduction, of a number or an array ``(...)`` over all ranks, of the same type (collective)."""
    if comm.size == 1:
        return value
    own = np.asarray(value)
    if own.dtype == bool and op == MPI.SUM:
        own = own.astype(np.int64)
    out = np.empty_like(own, order="C")
    comm.Allreduce(np.ascontiguousarray(own), out, op)
    return out if out.ndim else out.item()
