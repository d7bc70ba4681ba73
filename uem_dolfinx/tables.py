"""Tables in CSV files: one row per step, complete after every row, and continued where a run is resumed.

A part of the tenth step on the data's way.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

from uem_dolfinx.errors import CheckpointError
from uem_dolfinx.log import timed

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from types import TracebackType
    from typing import IO

    from mpi4py import MPI


class CsvTable:
    """CSV file that rank 0 writes; what goes wrong there is raised on all ranks.

    Args:
        path: name of the file; its folder is made.
        comm: communicator of the run.
        columns: their names; the first is a load factor or a time that grows.
        resume_at: keep the rows of a file that is there up to this value of the first column, and go on after them; None
            begins a new file.

    Raises:
        OSError: of rank 0, on all ranks, if the file cannot be written.
        ValueError: likewise, if the file to go on with holds what is no number.
        CheckpointError: likewise, if it has other columns.
    """

    def __init__(self, path: str | Path, comm: MPI.Comm, columns: Sequence[str], resume_at: float | None = None):
        self.columns, self.comm, self.path = list(columns), comm, Path(path)
        #: First and last row kept, by column, as numbers; empty in a new file.
        self.first: dict[str, float] = {}
        self.last: dict[str, float] = {}
        self._file: IO[str] | None = None
        kept: list[list[str]] = []

        def begin() -> None:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            if resume_at is not None and self.path.exists():
                kept.extend(self._cut(resume_at))
            self._file = self.path.open("a" if kept else "w", newline="", encoding="utf-8")
            if not kept:
                csv.writer(self._file).writerow(self.columns)
            self._file.flush()

        self._on_rank_0(begin)
        kept = comm.bcast([*kept[:1], *kept[-1:]])
        if kept:
            self.first, self.last = (
                {name: float(value) for name, value in zip(self.columns, row) if value} for row in (kept[0], kept[-1])
            )

    def _cut(self, resume_at: float) -> list[list[str]]:
        """Cut the file behind its last row up to a value of the first column; returns the rows left."""
        kept: list[list[str]] = []
        with self.path.open("r+", newline="", encoding="utf-8") as file:
            head, end = file.readline(), 0
            if head.endswith("\n") and next(csv.reader([head])) != self.columns:
                raise CheckpointError(
                    f"the table {self.path} belongs to another run: expected the columns {', '.join(self.columns)}, found "
                    f"{head.strip()}; choose another name, or remove it to start anew"
                )
            while line := file.readline():
                row = next(csv.reader([line]), [])
                # a killed run may have left half a row
                if not line.endswith("\n") or len(row) != len(self.columns) or float(row[0]) > resume_at:
                    break
                kept.append(row)
                end = file.tell()
            file.seek(end)
            file.truncate()
        return kept

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
        """Append a row; floats are written to the last bit (collective)."""

        def append() -> None:
            if self._file is None:
                raise ValueError(f"the table {self.path} is closed: write before close(), inside of its with block")
            csv.writer(self._file).writerow([repr(float(v)) if isinstance(v, float) else v for v in row])
            self._file.flush()

        self._on_rank_0(append)

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> CsvTable:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
