"""Files written by all ranks together, or by rank 0 for all: an error on one rank is raised on all."""

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

#: Bytes that are written or read in one call: Linux transfers less than 2 GiB. [format; bytes; -]
PIECE = 2**30
#: Remedy if a file cannot be written.
REMEDY = "check the folder, its rights and its free space"


class Trouble:
    """The first error on this rank: collective operations continue, and all ranks raise it at their end.

    Args:
        comm: communicator of the ranks that have to agree.
        what: sentence about the failed operation.
        remedy: remedy, in words.
        kind: class of the errors raised for files; other errors of the package are kept.
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
        """Whether there is no error on this rank yet."""
        return self._error is None

    def agree(self) -> None:
        """Raise the error of the first rank that has one (collective)."""
        agree(self.comm, self._error)


def given_path(what: str, value: Any, comm: MPI.Comm) -> Path:
    """A path, the same on all ranks; InputTypeError or InputError if it is no path (collective)."""
    with agreed(comm):
        given.kind(what, value, isinstance(value, (str, os.PathLike)), "the path of a file", "None is none")
        if not Path(value).name or "\0" in str(value):
            raise InputError(given.sentence(what, str(value), "the path of a file, with a name at its end"))
        try:
            odd = (path := Path(value)).exists() and not (path.is_file() or path.is_dir())
        except OSError as error:
            raise InputError(
                given.sentence(what, str(value), "the path of a file", f"the system says: {error.strerror}")
            ) from None
        if odd:
            raise InputError(
                given.sentence(what, str(value), "the path of a file", "a device or a pipe would be replaced by one")
            )
    given.alike(comm, "files", **{what: str(value)})
    return Path(value)


def given_resume(resume: Any, comm: MPI.Comm) -> bool:
    """True or False, the same on all ranks; InputTypeError or InputError for anything else (collective)."""
    with agreed(comm):
        resume = given.flag("resume", resume)
    given.alike(comm, "files", resume=resume)
    return bool(resume)


def on_rank_0(comm: MPI.Comm, what: str, action: Callable[[], T]) -> T:
    """Call a function that uses files on rank 0, and send its result or error to all ranks (collective).

    Args:
        comm: communicator.
        what: sentence about the failed operation, for errors of the operating system.
        action: called on rank 0.

    Returns:
        The result of the action, on all ranks.

    Raises:
        OutputError: for errors of the operating system.
        BaseException: any other error of the action.
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


def flush(path: Path) -> None:
    """Wait until a file or folder is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


class OwnFile:
    """A file that only one run writes, from opening to closing, even if another run moves it to a folder of earlier results.

    A lock excludes other runs and ends with the process. On file systems without locks, changes by another run are detected by the
    file's size.

    Args:
        path: name of the file, which must exist unless ``new``.
        new: create the file, which must not exist.
        locked: lock it; one rank does this for all.

    Raises:
        OutputError: if another run has not closed it.
        OSError: if it cannot be opened or made.
    """

    def __init__(self, path: Path, *, new: bool = False, locked: bool = True):
        self.path = path
        self._descriptor = os.open(path, os.O_RDWR | (os.O_CREAT | os.O_EXCL if new else 0), 0o666)
        #: Closes the file, once; also when the object is collected as garbage.
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
        """OutputError if the file was removed or, if ``sized``, its size was changed by another program."""
        gone, size = not os.fstat(self._descriptor).st_nlink, self.size
        if gone or (sized and size != self._size):
            what = "has been removed or replaced" if gone else f"has been changed, from {self._size} to {size} bytes,"
            raise OutputError(
                f"{self.path} {what} since this run wrote to it last: give each run a name of its own for its results"
            )

    def read(self) -> bytes:
        """All bytes of the file."""
        return os.pread(self._descriptor, self.size, 0)

    def read_at(self, offset: int, array: AnyArray) -> None:
        """Read a contiguous array from an offset in bytes, up to the end of the file."""
        data, done = as_bytes(array).data, 0
        while done < len(data) and (n := os.preadv(self._descriptor, [data[done : done + PIECE]], offset + done)):
            done += n

    def write_at(self, offset: int, array: AnyArray) -> None:
        """Write an array at an offset in bytes."""
        _write_all(self._descriptor, offset, as_bytes(np.ascontiguousarray(array)).data)

    def hand_over(self) -> None:
        """Flush written data to a network file system, as closing a file does, so that other machines see it."""
        os.close(os.dup(self._descriptor))

    def replace_end(self, offset: int, data: bytes) -> None:
        """Replace all bytes from an offset on; if writing fails, the previous bytes are restored.

        Raises:
            OSError: if not all bytes can be written.
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
        """Cut the file to a size in bytes."""
        os.truncate(self._descriptor, size)


def open_together(path: Path, trouble: Trouble, new: bool = False) -> OwnFile:
    """A file that all ranks write, not locked; rank 0 makes a ``new`` one (collective)."""
    file: Any = None
    for first in (True, False):
        with trouble:
            if (trouble.comm.rank == 0) == first:
                file = OwnFile(path, new=new and first, locked=False)
        trouble.agree()
    return file


def _lock(descriptor: int) -> bool:
    """Lock an open file: whether no other run holds it."""
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        # other errors come from file systems without locks
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
    """A new empty file, which replaces an unused file."""
    path.unlink(missing_ok=True)
    return OwnFile(path, new=True)


def _write_all(descriptor: int, offset: int, data: memoryview) -> None:
    while data:
        n = os.pwrite(descriptor, data[:PIECE], offset)
        data, offset = data[n:], offset + n


def aside(stem: Path, ending: str = "") -> Path:
    """An unused name in the same folder: the stem with the next free number, and an ending."""
    k = 1
    while (free := stem.with_name(f"{stem.name}.{k}{ending}")).exists():
        k += 1
    return free


def new_folder(stem: Path) -> Path:
    """Make a folder whose name is the stem with the next free number."""
    while True:
        folder = aside(stem)
        try:
            folder.mkdir()
        except FileExistsError:
            # another run has created it meanwhile
            continue
        return folder


def keep_aside(stem: Path, names: Iterable[Path]) -> None:
    """Move existing results to a new folder, with a warning; a run that still writes them continues there.

    Args:
        stem: the folder's name without its number.
        names: files and folders to move; they keep their names, so that references between them stay valid.

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
