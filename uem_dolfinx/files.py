"""Files that ranks write together, or rank 0 for all: what goes wrong on one rank is the same named error on all."""

from __future__ import annotations

import errno
import fcntl
import os
import weakref
from collections.abc import Callable, Iterable
from pathlib import Path
from types import TracebackType
from typing import Any, TypeVar

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import AnyArray
from uem_dolfinx.errors import InputError, OutputError, UEMError
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import agree, agreed

T = TypeVar("T")

#: Bytes that MPI-IO gets at once, because it counts them in C's int.
#: [format; bytes; -]
PIECE = 2**30
#: Longest path as given: Open MPI's MPI-IO overruns a buffer of 256 bytes, in which endings are appended to it.
#: [format; bytes; -]
LONGEST_PATH = 200
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


def given_path(what: str, value: Any, comm: MPI.Comm) -> Path:
    """A path, the same on all ranks; InputTypeError or InputError if it is none or too long (collective)."""
    with agreed(comm):
        given.kind(what, value, isinstance(value, (str, os.PathLike)), "the path of a file", "None is none")
        if not Path(value).name:
            raise InputError(given.sentence(what, str(value), "the path of a file, with a name at its end"))
        if (n := len(os.fsencode(value))) > LONGEST_PATH:
            raise InputError(
                f"{what} has {n} bytes, and MPI-IO takes at most {LONGEST_PATH}: give a shorter one, relative to the "
                f"working folder, not {value}"
            )
    given.alike(comm, "files", **{what: str(value)})
    return Path(value)


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
        BaseException: what else the action raises.
    """
    found: BaseException | None = None
    result: T | None = None
    if comm.rank == 0:
        try:
            result = action()
        except UEMError as error:
            found = error
        except OSError as error:
            found = OutputError(f"{what} ({error}): {REMEDY}")
        except BaseException as error:
            found = error
    agree(comm, found)
    return comm.bcast(result)  # type: ignore[return-value]


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


class OwnFile:
    """A file that one run alone writes from its opening to its closing; it stays this run's when another moves it aside.

    The lock that keeps others from going on with it ends with the process; where a file system has none, a file that another run has
    written to is known by its size.

    Args:
        path: name of the file, which must be there unless it is ``new``.
        new: make it, where none may be.
        locked: lock it; one rank does it for all.

    Raises:
        OutputError: if another run has not closed it.
        OSError: if it cannot be opened or made.
    """

    def __init__(self, path: Path, *, new: bool = False, locked: bool = True):
        self.path = path
        self._descriptor = os.open(path, os.O_RDWR | (os.O_CREAT | os.O_EXCL if new else 0), 0o666)
        #: Closes the file, once; also if no other object refers to it.
        self.close = weakref.finalize(self, os.close, self._descriptor)
        self._size = self.size
        if locked and not _lock(self._descriptor):
            self.close()
            raise OutputError(
                f"{path} is being written by another run, or by a writer that was not closed: let it end, or choose another name"
            )

    @property
    def size(self) -> int:
        """Number of bytes."""
        return os.fstat(self._descriptor).st_size

    def check(self, sized: bool = True) -> None:
        """Refuse to write to a file that is no longer there, or if ``sized`` has become longer or shorter by itself.

        Raises:
            OutputError: if it is so.
        """
        gone, size = not os.fstat(self._descriptor).st_nlink, self.size
        if gone or (sized and size != self._size):
            what = "has been removed or replaced" if gone else f"has been changed, from {self._size} to {size} bytes,"
            raise OutputError(
                f"{self.path} {what} since this run wrote to it last: give each run a name of its own for its results"
            )

    def read(self) -> bytes:
        """All that is in it."""
        return os.pread(self._descriptor, self.size, 0)

    def read_at(self, offset: int, array: AnyArray) -> None:
        """Read a contiguous array from an offset in bytes, as far as there is one."""
        data, done = as_bytes(array).data, 0
        while done < len(data) and (n := os.preadv(self._descriptor, [data[done : done + PIECE]], offset + done)):
            done += n

    def write_at(self, offset: int, array: AnyArray) -> None:
        """Write an array at an offset in bytes."""
        _write_all(self._descriptor, offset, as_bytes(np.ascontiguousarray(array)).data)

    def hand_over(self) -> None:
        """Give what was written to the file system, so that others see it, as closing a file does where it is another machine's."""
        os.close(os.dup(self._descriptor))

    def replace_end(self, offset: int, data: bytes) -> None:
        """Put other bytes in place of all from an offset on; if the disk refuses, those that were there come back.

        Raises:
            OSError: if not all can be written.
            OutputError: see ``check``.
        """
        self.check()
        before = os.pread(self._descriptor, max(0, self._size - offset), offset)
        try:
            _write_all(self._descriptor, offset, memoryview(data))
            os.truncate(self._descriptor, offset + len(data))
        except OSError:
            _write_all(self._descriptor, offset, memoryview(before))
            os.truncate(self._descriptor, self._size)
            raise
        self._size = offset + len(data)

    def truncate(self, size: int) -> None:
        """Cut what is behind a size in bytes."""
        os.truncate(self._descriptor, size)


def _lock(descriptor: int) -> bool:
    """Lock an open file: whether no other run holds it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        # other errors are those of file systems without locks
        return error.errno not in (errno.EWOULDBLOCK, errno.EACCES)
    return True


def in_use(path: Path) -> bool:
    """Whether a run has the file open as its own."""
    try:
        descriptor = os.open(path, os.O_RDWR)
    except OSError:
        return False
    try:
        return not _lock(descriptor)
    finally:
        os.close(descriptor)


def begin_file(path: Path) -> OwnFile:
    """A new empty file of one's own, in place of an unused one."""
    path.unlink(missing_ok=True)
    return OwnFile(path, new=True)


def _write_all(descriptor: int, offset: int, data: memoryview) -> None:
    while data:
        n = os.pwrite(descriptor, data[:PIECE], offset)
        data, offset = data[n:], offset + n


def aside(stem: Path, ending: str = "") -> Path:
    """A name beside others that is not taken yet: the stem's with the next free number, and an ending."""
    k = 1
    while (free := stem.with_name(f"{stem.name}.{k}{ending}")).exists():
        k += 1
    return free


def new_folder(stem: Path) -> Path:
    """Make a folder beside others: the stem's name with the next free number."""
    while True:
        folder = aside(stem)
        try:
            folder.mkdir()
        except FileExistsError:
            # another run was faster
            continue
        return folder


def keep_aside(stem: Path, names: Iterable[Path]) -> None:
    """Move what there is of earlier results to a folder of their own, and say so; a run that still writes them goes on there.

    Args:
        stem: the folder's name but for its number.
        names: files and folders to move, which keep their names, so that what refers to another one still finds it.

    Raises:
        OSError: if they cannot be moved.
    """
    there = [name for name in names if name.exists()]
    if not there:
        return
    whose = "another run, which still writes them," if any(map(in_use, there)) else "an earlier run"
    folder = new_folder(stem)
    for name in there:
        name.rename(folder / name.name)
    logger.warning("%s: results of %s are kept in %s", there[0], whose, folder)
