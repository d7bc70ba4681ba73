"""Checkpoints: what a long run goes on from, in one file that any number of ranks can write and read.

The file is in the order of the mesh's input; every rank writes and reads its own part of it through MPI-IO, as the bytes that numbers
have in memory.
"""

from __future__ import annotations

import json
import os
import re
import signal
import threading
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path
from types import FrameType, TracebackType
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import AnyArray
from uem_dolfinx.errors import CheckpointError
from uem_dolfinx.log import logger, timed
from uem_dolfinx.parallel import agree
from uem_dolfinx.restart.numbering import DIGEST, as_bytes, fingerprint, hashes
from uem_dolfinx.restart.state import State

#: Version of the file's layout and of the names in it.
#: [format; -; test_checkpoint_refused.py::test_another_format]
FORMAT = 3
#: What a checkpoint begins with.
MAGIC = "uem_dolfinx checkpoint"
#: Bytes before the first table.
#: [format; bytes; test_checkpoint_refused.py::test_damaged_files]
HEAD = 128
#: Bytes that MPI-IO gets at once, because it counts them in C's int.
#: [format; bytes; -]
PIECE = 2**30
#: Exit status of a run that has ended on SIGTERM, as shells have it.
#: [format; exit status; test_checkpoint_in_steps.py::test_terminated]
TERMINATED = 128 + signal.SIGTERM


class _Trouble:
    """First thing that went wrong on this rank: what is collective goes on, and all ranks raise at its end."""

    def __init__(self, comm: MPI.Comm, what: str, remedy: str):
        self.comm, self.what, self.remedy = comm, what, remedy
        self._error: CheckpointError | None = None

    def __enter__(self) -> _Trouble:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> bool:
        if self._error is None and isinstance(error, CheckpointError):
            self._error = error
        elif self._error is None and isinstance(error, (OSError, MPI.Exception)):
            self._error = CheckpointError(f"{self.what} ({error}): {self.remedy}")
        return isinstance(error, (OSError, MPI.Exception))

    @property
    def none(self) -> bool:
        """Whether nothing went wrong here yet."""
        return self._error is None

    def agree(self) -> None:
        """Raise the error of the first rank that has one (collective)."""
        agree(self.comm, self._error)


def write_checkpoint(path: str | Path, state: State) -> None:
    """Write a state so that the file is complete or not there, whenever the run is killed (collective).

    It is written beside the file, to ``PATH.part``, and takes the file's place when it is on the disk.

    Args:
        path: name of the file; its folder is made.
        state: what is written.

    Raises:
        CheckpointError: if the disk or the system refuses, or the state holds what a checkpoint cannot; an earlier file stays.
    """
    path, comm = Path(path), state.comm
    for hook in state.collect:
        hook()
    with timed("write checkpoint"):
        described, beside = state.describe(), _beside(path)
        trouble = _Trouble(comm, f"the checkpoint {path} cannot be written", "check the folder, its rights and its free space")
        with trouble:
            if comm.rank == 0:
                path.parent.mkdir(parents=True, exist_ok=True)
                beside.unlink(missing_ok=True)
        trouble.agree()
        with trouble:
            file = MPI.File.Open(comm, str(beside), MPI.MODE_CREATE | MPI.MODE_WRONLY)
        trouble.agree()
        end, tables = HEAD, []
        for entry in state.entries:
            part = entry.numbering.to_table(entry.to_checkpoint())
            width = part.dtype.itemsize * int(np.prod(part.shape[1:]))
            tables.append(hashes(part))
            with trouble:
                _write(file, end + width * entry.numbering.first, part)
            end += width * entry.numbering.total
        content = {"state": described, "data": fingerprint(comm, tables), "motions": state.motions(), "numbers": state.numbers}
        with trouble:
            if comm.rank == 0:
                text = _text(content)
                for offset, data in ((end, text), (0, _head(end, text))):
                    _write(file, offset, np.frombuffer(data, dtype=np.uint8))
        for end_of_writing in (file.Sync, file.Close):
            with trouble:
                end_of_writing()
        complete = all(comm.allgather(trouble.none))
        with trouble:
            if comm.rank == 0 and complete:
                _flush(beside)
                os.replace(beside, path)
                _flush(path.parent)
            elif comm.rank == 0:
                beside.unlink(missing_ok=True)
        trouble.agree()


def read_checkpoint(path: str | Path, state: State) -> None:
    """Put everything back into a state that was made like the one written (collective).

    Nothing is changed unless the whole file is sound and belongs to this mesh, these functions, contacts and numbers.

    Args:
        path: name of the file.
        state: what is overwritten.

    Raises:
        CheckpointError: naming the file, what was expected of it, what was found and what to do.
    """
    path, comm = Path(path), state.comm
    for hook in state.collect:
        hook()
    with timed("read checkpoint"):
        trouble = _Trouble(comm, f"the checkpoint {path} cannot be read", "check its rights, or go on from another one")
        content: dict[str, Any] = {}
        with trouble:
            content = _content(path) if comm.rank == 0 else {}
        trouble.agree()
        content = comm.bcast(content)
        _compare(path, content["state"], state.describe())
        with trouble:
            file = MPI.File.Open(comm, str(path), MPI.MODE_RDONLY)
        trouble.agree()
        # the first time for the hash alone: a damaged file must not leave half of itself behind
        found = fingerprint(comm, [hashes(part) for part in _parts(file, state, trouble)])
        with trouble:
            if trouble.none and found != content["data"]:
                raise _damaged(path, f"data with the hash {content['data']}", f"the hash {found}")
        if not any(comm.allgather(not trouble.none)):
            for entry, part in zip(state.entries, _parts(file, state, trouble)):
                entry.from_checkpoint(entry.numbering.from_table(part))
        with trouble:
            file.Close()
        trouble.agree()
    state.numbers.clear()
    state.numbers.update(content["numbers"])
    state.move(content["motions"])
    for contact in state.contacts:
        contact.pair.project()
    for hook in state.restore:
        hook()


def _beside(path: Path) -> Path:
    """Where a checkpoint is written before it takes its place."""
    return path.with_name(path.name + ".part")


def _flush(path: Path) -> None:
    """Wait until a file or folder is on the disk."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def _write(file: MPI.File, offset: int, array: AnyArray) -> None:
    """Write an array at an offset in bytes."""
    data = as_bytes(np.ascontiguousarray(array))
    for i in range(0, len(data), PIECE):
        piece, status = data[i : i + PIECE], MPI.Status()
        file.Write_at(offset + i, [piece, MPI.BYTE], status)
        if status.Get_count(MPI.BYTE) != len(piece):
            raise OSError(f"{status.Get_count(MPI.BYTE)} of {len(piece)} bytes written")


def _parts(file: MPI.File, state: State, trouble: _Trouble) -> Iterator[AnyArray]:
    """This rank's parts of the tables, one after the other (collective)."""
    end = HEAD
    for entry in state.entries:
        rows = entry.to_checkpoint()
        part = np.zeros((entry.numbering.count, *rows.shape[1:]), dtype=rows.dtype)
        width, data = part.dtype.itemsize * int(np.prod(part.shape[1:])), as_bytes(part)
        with trouble:
            for i in range(0, len(data), PIECE):
                file.Read_at(end + width * entry.numbering.first + i, [data[i : i + PIECE], MPI.BYTE])
        end += width * entry.numbering.total
        yield part


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays for JSON."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} {value!r}")


def _text(content: dict[str, Any]) -> bytes:
    """Content in JSON; a CheckpointError names the number that is none."""
    for name, value in content["numbers"].items():
        try:
            json.dumps(value, default=_plain)
        except (TypeError, ValueError) as error:
            raise CheckpointError(
                f"number '{name}' cannot be kept in a checkpoint ({error}): expected numbers, words, lists and dictionaries; "
                "keep fields as Functions"
            ) from error
    return json.dumps(content, default=_plain).encode()


def _head(end: int, text: bytes) -> bytes:
    """What the file begins with: where the tables end and the content follows, and the content's hash."""
    line = f"{MAGIC}\nformat {FORMAT}\ncontent {end} {len(text)} {blake2b(text, digest_size=DIGEST).hexdigest()}\n"
    return line.encode().ljust(HEAD - 1) + b"\n"


def _damaged(path: Path, expected: str, found: str) -> CheckpointError:
    remedy = "remove it, and go on from a copy or start anew"
    return CheckpointError(f"the checkpoint {path} is damaged: expected {expected}, found {found}; {remedy}")


def _content(path: Path) -> dict[str, Any]:
    """Content of a checkpoint; a CheckpointError tells what is not whole, the tables aside."""
    try:
        with path.open("rb") as file:
            head, size = file.read(HEAD), path.stat().st_size
            words = re.match(rf"{MAGIC}\nformat (\d+)\n(?:content (\d+) (\d+) )?".encode(), head)
            if words is None and size < HEAD and MAGIC.encode().startswith(head[: len(MAGIC)]):
                raise _damaged(path, f"at least {HEAD} bytes", f"{size}")
            if words is None:
                raise CheckpointError(
                    f"{path} is not a checkpoint: expected a file that begins with '{MAGIC}', found {head[: len(MAGIC)]!r}; "
                    "check the name, or move the file away to start anew"
                )
            if int(words[1]) != FORMAT:
                raise CheckpointError(
                    f"the checkpoint {path} has format {int(words[1])}: expected format {FORMAT}; read it with the version of "
                    "uem_dolfinx that wrote it, or remove it to start anew"
                )
            end, length = int(words[2] or 0), int(words[3] or 0)
            if size != end + length:
                raise _damaged(path, f"{end + length} bytes", f"{size}")
            file.seek(end)
            text = file.read(length)
    except FileNotFoundError as error:
        raise CheckpointError(f"there is no file {path}: expected a checkpoint; check the name, or start anew") from error
    if _head(end, text) != head:
        raise _damaged(path, "a content that its hash belongs to", "another")
    return dict(json.loads(text))


def _compare(path: Path, found: dict[str, str], expected: dict[str, str]) -> None:
    """Refuse a checkpoint of another state by a CheckpointError that names the first thing that differs."""
    for name in [*expected, *found]:
        if found.get(name) != expected.get(name):
            raise CheckpointError(
                f"the checkpoint {path} belongs to another run: for {name} expected {expected.get(name, 'nothing')}, found "
                f"{found.get(name, 'nothing')}; go on with the script and mesh that wrote it, or remove it to start anew"
            )


class Checkpoint:
    """Keeps a run's state in a file, so that the same script goes on where it was killed.

    As a context manager it also takes care of SIGTERM, which batch systems send before they kill: the step is finished, the state
    written, and the run ends with exit status 143. Between steps it costs one number sent around.

        with uem.Checkpoint("out/run.uem", every=50) as checkpoint:
            for step in uem.time_steps(problem, dt, end, checkpoint=checkpoint):
                ...

    Other loops call ``begin(state)`` before the first step, ``step()`` after each, and ``finish()`` at the end.

    Args:
        path: name of the file.
        every: number of steps from one writing to the next.

    Raises:
        ValueError: if ``every`` is no positive number of steps.
    """

    def __init__(self, path: str | Path, *, every: int = 100):
        if every != int(every) or every < 1:
            raise ValueError(f"every = {every}: expected a number of steps, 1 or more")
        self.path, self.every = Path(path), int(every)
        self._steps, self._asked_to_end, self._handles = 0, False, False
        self._state: State | None = None
        self._before: Any = None

    def begin(self, state: State) -> bool:
        """Go on from the file if there is one, and remove what a killed run has left of another (collective).

        Returns:
            Whether the state is that of the file now.

        Raises:
            CheckpointError: if there is a file that is damaged or belongs to another run.
        """
        self._state, comm, found = state, state.comm, False
        trouble = _Trouble(comm, f"what a killed run left beside {self.path} cannot be removed", "check the rights of the folder")
        with trouble:
            if comm.rank == 0:
                _beside(self.path).unlink(missing_ok=True)
                found = self.path.exists()
        trouble.agree()
        if not comm.bcast(found):
            return False
        read_checkpoint(self.path, state)
        logger.warning("going on from the checkpoint %s; remove it to start anew", self.path)
        return True

    @property
    def begun(self) -> bool:
        """Whether there is a state to keep."""
        return self._state is not None

    def step(self) -> None:
        """Count a step that is done, and write the state when it is time (collective).

        Raises:
            CheckpointError: if it cannot be written; an earlier file stays.
            SystemExit: with status 143, after writing, if any rank has got SIGTERM.
        """
        if self._state is None:
            raise CheckpointError(f"{self.path}: there is no state to keep yet; call begin(state) before the first step")
        self._steps += 1
        end = bool(self._state.comm.allreduce(int(self._asked_to_end)))
        if end or self._steps % self.every == 0:
            write_checkpoint(self.path, self._state)
        if end:
            self._end()

    def finish(self) -> None:
        """Write the end state, from which the same script goes on if it is given a later end (collective).

        Raises:
            CheckpointError: if it cannot be written; an earlier file stays.
            SystemExit: with status 143, after writing, if any rank has got SIGTERM.
        """
        if self._state is not None:
            write_checkpoint(self.path, self._state)
            if self._state.comm.allreduce(int(self._asked_to_end)):
                self._end()

    def _end(self) -> None:
        self._asked_to_end = False
        logger.warning("ended by SIGTERM; the checkpoint %s holds the last step", self.path)
        raise SystemExit(TERMINATED)

    def _on_sigterm(self, number: int, frame: FrameType | None) -> None:
        self._asked_to_end = True

    def __enter__(self) -> Checkpoint:
        # elsewhere Python does not allow it
        self._handles = threading.current_thread() is threading.main_thread()
        if self._handles:
            self._before = signal.signal(signal.SIGTERM, self._on_sigterm)
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        if self._handles:
            signal.signal(signal.SIGTERM, signal.SIG_DFL if self._before is None else self._before)
        if self._asked_to_end:
            # nobody has acted on it
            self._asked_to_end = False
            signal.raise_signal(signal.SIGTERM)
