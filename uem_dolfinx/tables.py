"""Tables in CSV files: one row per step, complete after every row, and continued where a run is resumed.

A part of the tenth step on the data's way.
"""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Sequence
    from types import TracebackType
    from typing import IO

    from mpi4py import MPI


class CsvTable:
    """CSV file that rank 0 writes.

    Args:
        path: name of the file; its folder is made.
        comm: communicator of the run.
        columns: their names; the first is a load factor or a time that grows.
        resume_at: keep the rows of a file that is there up to this value of the first column, and go on after them; None
            begins a new file.
    """

    def __init__(self, path: str | Path, comm: MPI.Comm, columns: Sequence[str], resume_at: float | None = None):
        self.columns = list(columns)
        #: Last row kept, by column, as numbers; empty in a new file.
        self.last: dict[str, float] = {}
        self._file: IO[str] | None = None
        kept: list[list[str]] = []
        if comm.rank == 0:
            Path(path).parent.mkdir(parents=True, exist_ok=True)
            if resume_at is not None and Path(path).exists():
                with Path(path).open(newline="", encoding="utf-8") as old:
                    head, *rows = list(csv.reader(old)) or [[]]
                # a killed run may have left half a row
                rows = [row for row in rows if len(row) == len(self.columns)]
                kept = [row for row in rows if head == self.columns and float(row[0]) <= resume_at]
            self._file = Path(path).open("w", newline="", encoding="utf-8")  # noqa: SIM115  stays open between rows
            csv.writer(self._file).writerows([self.columns, *kept])
            self._file.flush()
        last = comm.bcast(kept[-1] if kept else None)
        if last:
            self.last = {name: float(value) for name, value in zip(self.columns, last) if value}

    def write(self, row: Sequence[Any]) -> None:
        """Append a row; floats are written to the last bit."""
        if self._file is not None:
            csv.writer(self._file).writerow([repr(float(v)) if isinstance(v, float) else v for v in row])
            self._file.flush()

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()
            self._file = None

    def __enter__(self) -> CsvTable:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None) -> None:
        self.close()
