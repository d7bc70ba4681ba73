"""Tables in CSV files: one row per step, complete after every row, and continued where a run is resumed."""

from __future__ import annotations

import csv
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from os import PathLike
from pathlib import Path
from typing import IO, Any, Protocol, Self

from mpi4py import MPI

from uem_dolfinx import given
from uem_dolfinx.errors import CheckpointError, InputError
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import agreed


def given_path(what: str, value: Any, comm: MPI.Comm) -> Path:
    """A path, the same on all ranks; InputTypeError or InputError if it is none (collective)."""
    with agreed(comm):
        given.kind(what, value, isinstance(value, (str, PathLike)), "the path of a file", "None is none")
        if not Path(value).name:
            raise InputError(given.sentence(what, str(value), "the path of a file, with a name at its end"))
    given.alike(comm, "files", **{what: str(value)})
    return Path(value)


class Clock(Protocol):
    """Something that tells the time, and how often a checkpoint has put it forward."""

    time: float
    resumed: int


class Closing(ABC):
    """Base of what is closed at the end of its ``with`` block."""

    @abstractmethod
    def close(self) -> None:
        """Close the files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


class CsvTable(Closing):
    """CSV file that rank 0 writes; what goes wrong there is raised on all ranks.

    A file that is gone on with stays as it is until the first row is written.

    Args:
        path: name of the file; its folder is made.
        comm: communicator of the run.
        columns: their names; the first is a load factor or a time that grows.
        resume_at: keep the rows of a file that is there up to this value of the first column, and go on after them; of a clock, up
            to its present time. None begins a new file.

    Raises:
        OSError: of rank 0, on all ranks, if the file cannot be written.
        ValueError, CheckpointError: likewise, if the file to go on with holds what is no number, or has other columns.
    """

    def __init__(self, path: str | Path, comm: MPI.Comm, columns: Sequence[str], resume_at: float | Clock | None = None):
        self.columns, self.comm, self.path = list(columns), comm, given_path("path", path, comm)
        #: First and last row kept, by column, as numbers; empty in a new file.
        self.first: dict[str, float] = {}
        self.last: dict[str, float] = {}
        self._file: IO[str] | None = None
        self._clock = None if resume_at is None or isinstance(resume_at, (int, float)) else resume_at
        self._resumed = 0 if self._clock is None else self._clock.resumed
        until: Any = resume_at if self._clock is None else self._clock.time
        #: Where in the file the rows kept end, 0 without any; None once it has been cut there.
        self._end: int | None = None
        kept: list[list[str]] = []

        def begin() -> None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if until is not None and self.path.exists():
                self._file = self.path.open("r+", newline="", encoding="utf-8")
                try:
                    kept.extend(self._read(until))
                except (OSError, ValueError):
                    self.close()
                    raise
            else:
                self._file, self._end = self.path.open("w", newline="", encoding="utf-8"), 0
                self._cut()

        self._on_rank_0(begin)
        kept = comm.bcast([*kept[:1], *kept[-1:]])
        if kept:
            numbers = [{name: float(value) for name, value in zip(self.columns, row) if value} for row in kept]
            self.first, self.last = numbers[0], numbers[-1]

    def _read(self, until: float) -> list[list[str]]:
        """Rows of the file up to a value of the first column; finds where they end."""
        assert self._file is not None
        kept: list[list[str]] = []
        file, end = self._file, 0
        head = file.readline()
        if head.endswith("\n") and next(csv.reader([head])) != self.columns:
            raise CheckpointError(
                f"the table {self.path} belongs to another run: expected the columns {', '.join(self.columns)}, found "
                f"{head.strip()}; choose another name, or remove it to start anew"
            )
        while line := file.readline():
            row = next(csv.reader([line]), [])
            # a killed run may have left half a row
            if not line.endswith("\n") or len(row) != len(self.columns) or float(row[0]) > until:
                break
            kept.append(row)
            end = file.tell()
        self._end = end
        return kept

    def _cut(self) -> None:
        """Cut the file behind the rows kept, once; without any it begins with the names of the columns."""
        if self._file is None or self._end is None:
            return
        self._file.seek(self._end)
        self._file.truncate()
        if self._end == 0:
            csv.writer(self._file).writerow(self.columns)
        self._file.flush()
        self._end = None

    def _on_rank_0(self, action: Callable[[], None]) -> None:
        """Do something on rank 0; what it raises about the file is raised on all ranks (collective)."""
        error = None
        if self.comm.rank == 0:
            try:
                action()
            except (OSError, ValueError) as found:
                error = found
        error = self.comm.bcast(error)
        if error is not None:
            raise error

    @timed("write table")
    def write(self, row: Sequence[Any]) -> None:
        """Append a row; floats are written to the last bit (collective).

        Raises as the table itself, and if it is closed (ValueError) or a checkpoint was read after it had been made to go on with its
        file, which stays as it was (CheckpointError).
        """
        if self._clock is not None and self._clock.resumed != self._resumed:
            raise CheckpointError(
                f"the table {self.path} was made to go on with before the checkpoint was read, and would lose the rows up to there: "
                "call checkpoint.begin(problem.state()) before you make what writes tables with resume=True"
            )

        def append() -> None:
            if self._file is None:
                raise ValueError(f"the table {self.path} is closed: write before close(), inside of its with block")
            self._cut()
            csv.writer(self._file).writerow([repr(float(v)) if isinstance(v, float) else v for v in row])
            self._file.flush()

        self._on_rank_0(append)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None
