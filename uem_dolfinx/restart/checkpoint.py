"""Checkpoints, from which long runs are restarted: one file, written and read by any number of ranks.

The file follows the input order of the mesh. Every rank writes and reads its own part, in the binary format of numbers in memory.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path
from types import TracebackType
from typing import Any, NoReturn

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import AnyArray
from uem_dolfinx.errors import CheckpointError, UEMError
from uem_dolfinx.files import REMEDY, Trouble, flush, given_path, open_together
from uem_dolfinx.log import logger, timed
from uem_dolfinx.parallel import agreed, all_come, ask_together, is_agreed, prepare_meeting
from uem_dolfinx.restart.interruption import Interruption, end_run
from uem_dolfinx.restart.numbering import DIGEST, fingerprint, hashes
from uem_dolfinx.restart.state import State

#: Version of the file's layout and of the names in it. [format; -; test_checkpoint_refused.py::test_another_format]
FORMAT = 8
#: First word of a checkpoint.
MAGIC = "uem_dolfinx checkpoint"
#: Bytes before the first table. [format; bytes; test_checkpoint_refused.py::test_damaged_files]
HEAD = 128
#: How long a rank that leaves a loop waits for the others before it continues without writing.
#: [bound; seconds; test_left_early.py::test_left_by_one_rank]
LEAVING = 30.0


def write_checkpoint(path: str | Path, state: State) -> None:
    """Write a state; the file is either complete or absent, even if the run is killed (collective).

    It is written to ``PATH.part``, which replaces the file when it is complete on the disk.

    Args:
        path: name of the file; its folder is made.
        state: state to write.

    Raises:
        CheckpointError: if writing fails, or the state contains objects that a checkpoint cannot hold; an earlier file stays.
    """
    path, comm = _of_state(path, state)
    for hook in state.collect:
        ask_together(comm, "a function in State.collect", hook)
    with timed("write checkpoint"):
        described, incomplete = state.describe(), _incomplete(path)
        trouble = _trouble(comm, f"the checkpoint {path} cannot be written", REMEDY)
        with trouble:
            if comm.rank == 0:
                path.parent.mkdir(parents=True, exist_ok=True)
                incomplete.unlink(missing_ok=True)
        file = open_together(incomplete, trouble, new=True)
        end, tables = HEAD, []
        for entry in state.entries:
            part = entry.numbering.to_table(entry.to_checkpoint())
            width = part.dtype.itemsize * int(np.prod(part.shape[1:]))
            tables.append(hashes(part))
            with trouble:
                file.write_at(end + width * entry.numbering.first, part)
            end += width * entry.numbering.total
        content = {
            "state": described, "data": fingerprint(comm, tables), "motions": state.motions(), "numbers": state.numbers,
            "steps": state.steps, "settings": state.settings,
        }  # fmt: skip
        with trouble:
            if comm.rank == 0:
                text = _text(content)
                for offset, data in ((end, text), (0, _head(end, text))):
                    file.write_at(offset, np.frombuffer(data, dtype=np.uint8))
        file.close()
        with trouble:
            flush(incomplete)
        complete = all(comm.allgather(trouble.none))
        with trouble:
            if comm.rank == 0 and complete:
                os.replace(incomplete, path)
                flush(path.parent)
            elif comm.rank == 0:
                incomplete.unlink(missing_ok=True)
        trouble.agree()


def read_checkpoint(path: str | Path, state: State) -> None:
    """Read a checkpoint into a state that was made like the one written (collective).

    Nothing is changed unless the whole file is intact and belongs to this mesh, these functions, contacts and numbers.

    Args:
        path: name of the file.
        state: state to overwrite.

    Raises:
        CheckpointError: with the file, the expected and the found contents, and a remedy.
    """
    path, comm = _of_state(path, state)
    for hook in state.collect:
        ask_together(comm, "a function in State.collect", hook)
    with timed("read checkpoint"):
        trouble = _trouble(comm, f"the checkpoint {path} cannot be read", "check its permissions, or continue from another one")
        content: dict[str, Any] = {}
        with trouble:
            content = _content(path) if comm.rank == 0 else {}
        trouble.agree()
        content = comm.bcast(content)
        _compare(path, content["state"], state.describe())
        _compare_settings(path, content["settings"], state)
        # the first pass computes the hash only, so that a damaged file changes nothing
        found = fingerprint(comm, [hashes(part) for part in _parts(path, state, trouble)])
        with trouble:
            if trouble.none and found != content["data"]:
                raise _damaged(path, f"data with the hash {content['data']}", f"the hash {found}")
        if not any(comm.allgather(not trouble.none)):
            for entry, part in zip(state.entries, _parts(path, state, trouble)):
                entry.from_checkpoint(entry.numbering.from_table(part))
        trouble.agree()
    state.numbers.clear()
    state.numbers.update(content["numbers"])
    state.steps = content["steps"]
    state.move(content["motions"])
    for pair in {id(contact.pair.whole): contact.pair.whole for contact in state.contacts}.values():
        pair.project()
    for hook in state.restore:
        ask_together(comm, "a function in State.restore", hook)


def _of_state(path: Any, state: Any) -> tuple[Path, MPI.Comm]:
    """The path of a checkpoint, and its state's communicator; InputTypeError or InputError if they are invalid (collective)."""
    given.kind("state", state, isinstance(state, State), "a State, as problem.state()")
    with agreed(state.comm):
        for name, f in state.functions.items():
            given.kind(f"functions[{name!r}]", f, isinstance(f, fem.Function), "a Function", "numbers belong to numbers")
    return given_path("path", path, state.comm), state.comm


def _incomplete(path: Path) -> Path:
    """Temporary file of a checkpoint, which replaces the file when complete."""
    return path.with_name(path.name + ".part")


def _trouble(comm: MPI.Comm, what: str, remedy: str) -> Trouble:
    return Trouble(comm, what, remedy, CheckpointError)


def _parts(path: Path, state: State, trouble: Trouble) -> Iterator[AnyArray]:
    """This rank's parts of the tables, one after the other (collective)."""
    end = HEAD
    for entry in state.entries:
        rows = entry.to_checkpoint()
        part = np.zeros((entry.numbering.count, *rows.shape[1:]), dtype=rows.dtype)
        width = part.dtype.itemsize * int(np.prod(part.shape[1:]))
        with trouble:
            found = np.fromfile(path, part.dtype, part.size, offset=end + width * entry.numbering.first)
            part.reshape(-1)[: len(found)] = found
        end += width * entry.numbering.total
        yield part


def _plain(value: Any) -> Any:
    """NumPy's numbers and arrays for JSON."""
    if isinstance(value, (np.generic, np.ndarray)):
        return value.tolist()
    raise TypeError(f"{type(value).__name__} {value!r}")


def _text(content: dict[str, Any]) -> bytes:
    """Content in JSON; a CheckpointError names the entry that JSON cannot hold."""
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
    """Head of the file: the end of the tables, where the content begins, its length and its hash."""
    line = f"{MAGIC}\nformat {FORMAT}\ncontent {end} {len(text)} {blake2b(text, digest_size=DIGEST).hexdigest()}\n"
    return line.encode().ljust(HEAD - 1) + b"\n"


def _damaged(path: Path, expected: str, found: str) -> CheckpointError:
    remedy = "remove it, and continue from a copy or start anew"
    return CheckpointError(f"the checkpoint {path} is damaged: expected {expected}, found {found}; {remedy}")


def _content(path: Path) -> dict[str, Any]:
    """Content of a checkpoint; a CheckpointError describes any damage outside the tables."""
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
    """Refuse a checkpoint of another state by a CheckpointError that names the first difference."""
    for name in [*expected, *found]:
        if found.get(name) != expected.get(name):
            raise CheckpointError(
                f"the checkpoint {path} belongs to another run: for {name} expected {expected.get(name, 'nothing')}, found "
                f"{found.get(name, 'nothing')}; continue with the script and mesh that wrote it, or remove it to start anew"
            )


def _compare_settings(path: Path, found: dict[str, str], state: State) -> None:
    """Refuse a checkpoint of a run with other settings by a CheckpointError that lists all differences.

    A setting that is missing in the file, e.g. because it was added later, is taken to have had its default value.
    """
    expected = state.settings
    others = [
        f"{name} (now {expected.get(name, 'nothing')}, then {found.get(name, 'nothing')})"
        for name in [*expected, *found]
        if found.get(name) != expected.get(name) and not (name in state.by_default and name not in found)
    ]
    if found and expected and others:
        raise CheckpointError(
            f"the checkpoint {path} belongs to a run with other settings: {'; '.join(dict.fromkeys(others))}; continue with those that "
            "it was written with, or remove it to start anew; to change them on purpose, clear the settings of problem.state()"
        )


class Checkpoint(given.Sealed):
    """Stores a run's state in a file, so that the same script resumes where it was killed.

    As a context manager, and during load or time steps, it handles Ctrl-C and SIGTERM, which batch systems send before they kill a run.
    If any rank receives a signal, all ranks finish the step, or the present iteration of load and time steps, and write the last state.
    Then they raise KeyboardInterrupt or end with exit status 143. The cost is one reduction per step.

        with uem.Checkpoint("out/run.uem", every=50) as checkpoint:
            for step in uem.time_steps(problem, dt, end, checkpoint=checkpoint):
                ...

    If all ranks leave the loop or the block before its end, by ``break``, ``return``, an error of the script or a failed step, the last
    converged step is written. A second Ctrl-C ends the run at once, with the previous file.

    Other loops call ``begin(state)`` before the first step, ``step()`` after each, and ``finish()`` at the end.

    Args:
        path: name of the file.
        every: number of steps between writes.

    Raises:
        InputError, InputTypeError: if ``every`` is no positive number of steps.
    """

    def __init__(self, path: str | Path, *, every: int = 100):
        given.kind("path", path, isinstance(path, (str, os.PathLike)), "the path of a file")
        self.path, self.every = Path(path), given.count("every", every)
        self._state: State | None = None
        #: Whether steps have been made since the last write, and the loop whose caller still works on a step.
        self._unwritten, self._loop = False, None  # type: bool, object
        self.interruption = Interruption(finishing=True)  #: Signals to end the run.

    def begin(self, state: State) -> bool:
        """Resume from the file if it exists, and remove the incomplete file of a killed run (collective).

        Returns:
            Whether the state has been read from the file.

        Raises:
            InputError: if its arguments differ between ranks.
            CheckpointError: if the file is damaged or belongs to another run, or if the checkpoint has begun with the state of
                another problem.
        """
        given.kind("state", state, isinstance(state, State), "a State, as problem.state()")
        given.alike(state.comm, "Checkpoint", path=str(self.path), every=self.every)
        if self._state is not None:
            self.check(*state.functions.values())
        self._state, comm, found = state, state.comm, False
        prepare_meeting(state.mesh.comm)
        trouble = _trouble(
            comm, f"what a killed run left next to {self.path} cannot be removed", "check the rights of the folder"
        )
        with trouble:
            if comm.rank == 0:
                _incomplete(self.path).unlink(missing_ok=True)
                found = self.path.exists()
        trouble.agree()
        if not comm.bcast(found):
            return False
        read_checkpoint(self.path, state)
        logger.warning("continuing from the checkpoint %s; remove it to start anew", self.path)
        return True

    def check(self, *functions: Any) -> None:
        """Raise a CheckpointError if none of the Functions belongs to the state, since they are of another problem."""
        kept = [] if self._state is None else list(self._state.functions.values())
        if functions and not any(f is known for f in functions for known in kept):
            raise CheckpointError(
                f"{self.path} keeps the state of another problem: make one Checkpoint, with a name of its own, for each problem"
            )

    @property
    def begun(self) -> bool:
        """Whether the checkpoint has a state."""
        return self._state is not None

    def step(self) -> None:
        """Count a completed step, and write the state after every ``every`` steps (collective).

        Raises:
            CheckpointError: if it cannot be written; an earlier file stays.
            KeyboardInterrupt, SystemExit: after writing, if any rank has received Ctrl-C or SIGTERM.
        """
        if self._state is None:
            raise CheckpointError(f"{self.path}: there is no state to keep yet; call begin(state) before the first step")
        self._state.steps += 1
        self._unwritten, self._loop = True, None
        number = self.interruption.agreed(self._state.comm)
        if number:
            self.end(number)
        if self._state.steps % self.every == 0:
            self._write()

    def finish(self) -> None:
        """Write the final state, from which the same script continues with a later end (collective).

        Raises:
            CheckpointError: if it cannot be written; an earlier file stays.
            KeyboardInterrupt, SystemExit: after writing, if any rank has received Ctrl-C or SIGTERM.
        """
        if self._state is not None:
            number = self.interruption.agreed(self._state.comm)
            if number:
                self.end(number)
            self._write()

    def end(self, number: int) -> NoReturn:
        """Write the state and end the run on a signal of this number (collective)."""
        self._write()
        end_run(number, f"the checkpoint {self.path} holds the last step")

    def hand_out(self, loop: object) -> None:
        """Note that a loop's caller has a converged step, until ``step()`` counts it."""
        self._loop = loop

    def leave(self, error: BaseException | None, loop: object = None) -> None:
        """Write the last completed step when all ranks leave a loop or the ``with`` block before its end (collective).

        Args:
            error: exception that ends the block, or None.
            loop: the loop of steps that is left, or None; nothing is written if another loop has begun since.

        Raises:
            CheckpointError: if there is no other error and it cannot be written; an earlier file stays.
        """
        state, inside = self._state, self._loop is not None
        at_once = isinstance(error, CheckpointError) or (isinstance(error, KeyboardInterrupt) and not is_agreed(error))
        if state is None or not (self._unwritten or inside) or (inside and loop not in (None, self._loop)) or at_once:
            return
        torn = error is not None and not inside
        if (torn and not state.back) or sys.is_finalizing():
            return
        if not is_agreed(error) and not all_come(state.mesh.comm, LEAVING):
            logger.warning("%s: rank %d leaves the steps without the others; nothing is written", self.path, state.comm.rank)
            return
        self._unwritten, self._loop = True, None
        try:
            for hook in state.back if torn else []:
                hook()
            state.steps += inside
            self._write()
        except UEMError as refused:
            if error is None:
                raise
            logger.warning("where the steps end by %s: %s", type(error).__name__, refused)

    def _write(self) -> None:
        """Write the state (collective)."""
        if self._state is not None:
            write_checkpoint(self.path, self._state)
        self._unwritten, self._loop = False, None

    def __enter__(self) -> Checkpoint:
        self.interruption.__enter__()
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        try:
            self.leave(error)
        finally:
            self.interruption.__exit__(kind, error, trace)
