"""What ranks tell each other: one error for all."""

from __future__ import annotations

import pickle
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from collections.abc import Callable

    from mpi4py import MPI

Ints = npt.NDArray[np.int64]


def agree(comm: MPI.Comm, error: Exception | None) -> None:
    """Raise on every rank the error of the first rank that has one (collective).

    Ranks that each look at their own part of the mesh must not raise alone: the others would wait for ever
    in the next collective call.

    Args:
        comm: the communicator whose ranks have to agree.
        error: what this rank found wrong, or None.

    Raises:
        Exception: the same error on all ranks, if any rank had one.
    """
    if comm.size > 1:
        errors = comm.allgather(error)
        error = next((e for e in errors if e is not None), None)
    if error is not None:
        raise error


def agree_on_call(comm: MPI.Comm, f: Callable[..., object], *args: Any) -> None:
    """Call a function on every rank; what it raises on one is raised on all (collective).

    Args:
        comm: the communicator whose ranks have to agree.
        f: called with ``args``.
        args: of the function.

    Raises:
        Exception: the function's own error, on several ranks a RuntimeError with its words if it cannot be sent as it is.
    """
    found: Exception | None = None
    try:
        f(*args)
    except Exception as error:
        found = error
        if comm.size > 1:
            try:
                pickle.loads(pickle.dumps(error))
            except Exception:
                found = RuntimeError(f"{type(error).__name__}: {error}")
    agree(comm, found)


def count_keys(comm: MPI.Comm, keys: Ints) -> Ints:
    """How often each row of ``keys (n, k)`` occurs over all ranks ``(n,)`` (collective; rows meet on a home rank)."""
    home = keys[:, 0] % comm.size
    received = comm.alltoall([keys[home == r] for r in range(comm.size)])
    _, inverse, counts = np.unique(np.concatenate(received), axis=0, return_inverse=True, return_counts=True)
    ends = np.cumsum([len(k) for k in received])[:-1]
    answers = comm.alltoall(np.split(counts[inverse.ravel()], ends))
    total = np.empty(len(keys), dtype=np.int64)
    for r in range(comm.size):
        total[home == r] = answers[r]
    return total
