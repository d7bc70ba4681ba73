"""Files that ranks write together, or rank 0 for all: what goes wrong on one rank is the same named error on all."""

from __future__ import annotations

import errno
import os
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import TypeVar

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import AnyArray
from uem_dolfinx.errors import OutputError, UEMError
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import agree

T = TypeVar("T")

#: Bytes that MPI-IO gets at once, because it counts them in C's int.
#: [format; bytes; -]
PIECE = 2**30
#: What helps where a file cannot be written.
REMEDY = "check the folder, its rights and its free space"


class Trouble:
    """First thing that went wrong on this rank: what is collective goes on, and all ranks raise at its end.

    Args:
        comm: communicator of the ranks that have to agree.
        what: cannot be done, in words.
        remedy: what helps.
        kind: class of the error that files raise; others of the package stay what they are.
    """

    def __init__(self, comm: MPI.Comm, what: str, remedy: str = REMEDY, kind: type[UEMError] = OutputError):
        self.comm, self.what, self.remedy, self.kind = comm, what, remedy, kind
        self._error: UEMError | None = None

    def __enter__(self) -> Trouble:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> bool:
        if self._error is None and isinstance(error, self.kind):
            self._error = error
        elif self._error is None and isinstance(error, (OSError, MPI.Exception)):
            self._error = self.kind(f"{self.what} ({' '.join(str(error).split())}): {self.remedy}")
        return isinstance(error, (OSError, MPI.Exception))

    @property
    def none(self) -> bool:
        """Whether nothing went wrong here yet."""
        return self._error is None

    def agree(self) -> None:
        """Raise the error of the first rank that has one (collective)."""
        agree(self.comm, self._error)


def on_rank_0(comm: MPI.Comm, what: str, action: Callable[[], T]) -> T:
    """Do something with files on rank 0, and tell all ranks what came of it (collective).

    Args:
        comm: communicator.
        what: cannot be done if the system refuses, in words.
        action: called on rank 0.

    Returns:
        What the action returns.

    Raises:
        OutputError: if the system refuses.
        UEMError, ValueError: of the action.
    """
    found: Exception | None = None
    result: T | None = None
    if comm.rank == 0:
        try:
            result = action()
        except (UEMError, ValueError) as error:
            found = error
        except OSError as error:
            found = OutputError(f"{what} ({error}): {REMEDY}")
    found, result = comm.bcast((found, result))
    if found is not None:
        raise found
    return result  # type: ignore[return-value]


def as_bytes(array: AnyArray) -> AnyArray:
    """The bytes of a contiguous array, in place."""
    return array.reshape(-1).view(np.uint8)


def write_at(file: MPI.File, offset: int, array: AnyArray) -> None:
    """Write an array at an offset in bytes."""
    data = as_bytes(np.ascontiguousarray(array))
    for i in range(0, len(data), PIECE):
        piece, status = data[i : i + PIECE], MPI.Status()
        file.Write_at(offset + i, [piece, MPI.BYTE], status)
        if status.Get_count(MPI.BYTE) != len(piece):
            reason = f"{os.strerror(errno.ENOSPC)}, {status.Get_count(MPI.BYTE)} of {len(piece)} bytes written"
            raise OSError(errno.ENOSPC, reason)


def read_at(file: MPI.File, offset: int, array: AnyArray) -> None:
    """Read a contiguous array from an offset in bytes."""
    data = as_bytes(array)
    for i in range(0, len(data), PIECE):
        file.Read_at(offset + i, [data[i : i + PIECE], MPI.BYTE])


def flush(path: Path) -> None:
    """Wait until a file or folder is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def replace_end(path: Path, offset: int, data: bytes) -> None:
    """Put other bytes in place of all from an offset on; if the disk refuses, those that were there come back.

    Raises:
        OSError: if not all can be written.
    """
    with path.open("r+b", buffering=0) as file:
        size = os.fstat(file.fileno()).st_size
        before = os.pread(file.fileno(), max(0, size - offset), offset)
        try:
            _write_all(file.fileno(), offset, data)
            file.truncate(offset + len(data))
        except OSError:
            _write_all(file.fileno(), offset, before)
            file.truncate(size)
            raise


def _write_all(descriptor: int, offset: int, data: bytes) -> None:
    while data:
        n = os.pwrite(descriptor, data, offset)
        data, offset = data[n:], offset + n


def aside(stem: Path, ending: str = "") -> Path:
    """A name beside others that is not taken yet: the stem's with the next free number, and an ending."""
    k = 1
    while (free := stem.with_name(f"{stem.name}.{k}{ending}")).exists():
        k += 1
    return free


def keep_aside(stem: Path, names: Iterable[Path]) -> None:
    """Move what there is of earlier results to a folder of their own, and say so.

    Args:
        stem: the folder's name but for its number.
        names: files and folders to move, which keep their names, so that what refers to another one still finds it.

    Raises:
        OSError: if they cannot be moved.
    """
    there = [name for name in names if name.exists()]
    if not there:
        return
    folder = aside(stem)
    folder.mkdir()
    for name in there:
        name.rename(folder / name.name)
    logger.warning("%s: results of an earlier run are kept in %s", there[0], folder)
