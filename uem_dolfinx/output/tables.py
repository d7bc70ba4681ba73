"""Tables in CSV files: one row per step, complete after every row, and continued if a run is resumed; of histories and of bodies."""

from __future__ import annotations

import csv
import io
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self
from weakref import WeakValueDictionary

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.results import ManyContacts
from uem_dolfinx.errors import CheckpointError, InputError, OutputError, UEMError
from uem_dolfinx.files import OwnFile, begin_file, given_path, in_use, keep_aside, new_folder, on_rank_0
from uem_dolfinx.log import logger, timed_as
from uem_dolfinx.parallel import agreed, ask_together
from uem_dolfinx.solve.problem import UnitedProblem

if TYPE_CHECKING:
    from uem_dolfinx.dynamics.inertia import Dynamics
    from uem_dolfinx.solve.stepping import Progress


class Closing(ABC):
    """Base of objects that are closed at the end of their ``with`` block."""

    @abstractmethod
    def close(self) -> None:
        """Close the files."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *error: object) -> None:
        self.close()


#: Tables of this run by the path of their file.
_open: WeakValueDictionary[Path, CsvTable] = WeakValueDictionary()


def refuse_shared(path: Path, comm: MPI.Comm, whose: str) -> None:
    """Raise OutputError if an open writer of another kind in this run has this file as its table (collective)."""
    other = _open.get(path.absolute())
    with agreed(comm):
        if other is not None and not other._closed and other.whose != whose:
            raise OutputError(
                f"{path} is the table of {other.whose} of this run: give {whose} another name; a ResultsWriter 'NAME' writes NAME.csv, "
                "as a HistoryWriter 'NAME.csv' does"
            )


class CsvTable(Closing):
    """CSV file that rank 0 writes; errors there are raised on all ranks.

    A resumed file is unchanged until the first row is written. An existing file is moved to a folder ``NAME.1``, or the next number, if
    it has rows or another run still writes it; that run continues there. A resumed file that would lose rows although no checkpoint was
    read is copied there first.

    Args:
        path: name of the file; its folder is made.
        comm: communicator of the run.
        columns: their names.
        resume_at: keep the rows of an existing file up to this value of the column ``key``, or up to the present time of a clock, and
            append to them. None starts a new file.
        key: column that does not decrease from row to row, by default the first.
        words: columns that contain no numbers.
        whose: the writer of the table in messages.

    Raises:
        OutputError: of rank 0, on all ranks, if the file cannot be written, or if another run writes the file to resume.
        ValueError, CheckpointError: on all ranks, if the file to resume contains invalid numbers, or has other columns.
    """

    def __init__(
        self,
        path: str | Path,
        comm: MPI.Comm,
        columns: Sequence[str],
        resume_at: float | Progress | Dynamics | None = None,
        *,
        key: str | None = None,
        words: Sequence[str] = (),
        whose: str = "a table",
    ):
        self.columns, self.comm, self.path = list(columns), comm, given_path("path", path, comm)
        if twice := [name for k, name in enumerate(self.columns) if name in self.columns[:k]]:
            raise InputError(f"the table {self.path} has two columns '{twice[0]}': choose another name for that of columns=")
        refuse_shared(self.path, comm, whose)
        self.whose = whose
        self._key = 0 if key is None else self.columns.index(key)
        self._clock = None if resume_at is None or isinstance(resume_at, (int, float)) else resume_at
        self._resumed = 0 if self._clock is None else self._clock.resumed
        until: Any = resume_at if self._clock is None else self._clock.time
        self._closed = False
        self._file: OwnFile | None = None  # on rank 0
        #: End of the kept rows in the file, and whether later rows follow, which would be lost.
        self._end, self._later = 0, False
        kept = self._on_rank_0(lambda: self._begin(until))
        numbers = [{name: float(value) for name, value in zip(self.columns, row) if value and name not in words} for row in kept]
        _open[self.path.absolute()] = self
        #: First and last row kept, by column, as numbers; empty in a new file.
        self.first: dict[str, float] = numbers[0] if kept else {}
        self.last: dict[str, float] = numbers[-1] if kept else {}

    def _on_rank_0(self, action: Any) -> Any:
        return on_rank_0(self.comm, f"the table {self.path} cannot be written", action)

    def _begin(self, until: float | None) -> list[list[str]]:
        """First and last row of a file to resume; without one, start a new file."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        if until is not None and self.path.exists():
            self._file = OwnFile(self.path)
            try:
                kept = self._read(io.StringIO(self._file.read().decode(), newline=""), until)
            except (UEMError, ValueError):
                self.close()
                raise
            return [*kept[:1], *kept[-1:]]
        if self.path.is_file() and (self.path.read_bytes().count(b"\n") > 1 or in_use(self.path)):
            keep_aside(self.path.with_suffix(""), [self.path])
        self._file = begin_file(self.path)
        self._put(self.columns)
        return []

    def _read(self, file: Any, until: float) -> list[list[str]]:
        """Rows of the file up to a value of the key; stores their end."""
        kept: list[list[str]] = []
        head, end = file.readline(), 0
        if head.endswith("\n"):
            if next(csv.reader([head])) != self.columns:
                raise CheckpointError(
                    f"the table {self.path} belongs to another run: expected the columns {', '.join(self.columns)}, found "
                    f"{head.strip()}; choose another name, or remove it to start anew"
                )
            end = len(head.encode())
        while line := file.readline():
            row = next(csv.reader([line]), [])
            # a killed run may have left half a row
            if not line.endswith("\n") or len(row) != len(self.columns):
                break
            if float(row[self._key]) > until:
                self._later = True
                break
            kept.append(row)
            end += len(line.encode())
        self._end = end
        return kept

    def _put(self, *rows: Sequence[Any]) -> None:
        """Write rows behind the rows kept, all at once."""
        text = io.StringIO(newline="")
        csv.writer(text).writerows([[repr(float(v)) if isinstance(v, float) else v for v in row] for row in rows])
        data = text.getvalue().encode()
        assert self._file is not None
        self._file.replace_end(self._end, data)
        self._end += len(data)

    def check(self) -> None:
        """Raise an InputError after ``close``, a CheckpointError if a checkpoint was read after the table had been made to resume."""
        if self._closed:
            raise InputError(f"the table {self.path} is closed: write before close(), inside of its with block")
        if self._clock is not None and self._clock.resumed != self._resumed:
            raise CheckpointError(
                f"the table {self.path} with resume=True was opened before the checkpoint was read, and would lose the rows up to there: "
                "call checkpoint.begin(problem.state()) before you make what writes with resume=True"
            )

    @timed_as("write table")
    def write(self, *rows: Sequence[Any]) -> None:
        """Append a row, or several at once; floats are written to the last bit (collective).

        Raises as the table itself; also if it is closed (ValueError), or if a checkpoint was read after it had been made to resume its
        file, which is then unchanged (CheckpointError).
        """
        self.check()

        def append() -> None:
            if self._later and self._clock is not None and self._resumed == 0:
                assert self._file is not None
                folder = new_folder(self.path.with_suffix(""))
                (folder / self.path.name).write_bytes(self._file.read())
                logger.warning("%s: rows of an earlier run are kept in %s", self.path, folder)
            self._later = False
            if self._end == 0:
                self._put(self.columns)
            self._put(*rows)

        self._on_rank_0(append)

    def close(self) -> None:
        """Close the file."""
        self._closed = True
        if self._file is not None:
            self._file.close()


class PairTables(Closing):
    """CSV files next to a history, ``NAME_pairs.csv``, one for each general contact (collective).

    Columns: ``factor`` or ``time``, ``step``, the names ``first`` and ``second`` of bodies in contact, or of a body and a rigid surface,
    the number ``active`` of contactors, and ``force_x`` ... on the first with its ``moment`` about the origin. Steps without contact
    have no rows.

    Args:
        path: of the history.
        problem: source of the rows.
        suffixes: of all its declared contacts.
        clock: name of the first column.
        resultant: names of the columns of forces and moments.
        resume: see ``HistoryWriter``.

    Raises:
        OutputError, CheckpointError, ValueError: see ``CsvTable``.
    """

    def __init__(self, path: Path, problem: UnitedProblem, suffixes: list[str], clock: str, resultant: list[str], resume: bool):
        self._general = [contact for contact in problem.declared if isinstance(contact, ManyContacts)]
        names = ["first", "second"]
        columns, resume_at = [clock, "step", *names, "active", *resultant], problem.progress if resume else None
        self._tables: list[CsvTable] = []
        for contact, suffix in zip(problem.declared, suffixes):
            if isinstance(contact, ManyContacts):
                name = path.with_name(f"{path.stem}_pairs{suffix}{path.suffix}")
                try:
                    self._tables.append(CsvTable(name, problem.comm, columns, resume_at, key="step", words=names))
                except Exception:
                    self.close()
                    raise

    def write(self, clock: float, step: int) -> None:
        """Append the rows of a step (collective)."""
        for table, contact in zip(self._tables, self._general):
            pairs = contact.forces_of_pairs()
            table.write(*[[clock, step, t.first, t.second, t.n_active, *t.force, *moment] for t, moment in pairs])

    def close(self) -> None:
        """Close the files."""
        for table in self._tables:
            table.close()


class Columns:
    """Numbers by name, evaluated after every step (the constructor is collective).

    Args:
        problem: for the reactions.
        reaction: part of the mesh with Dirichlet conditions, as in ``UnitedProblem.reaction``, or several parts by name; or None.
        quantities: functions without arguments by name that return a number or a vector, the same on all ranks; or None.

    Raises:
        InputError, InputTypeError: for arguments of another form, and for duplicate names.
    """

    def __init__(self, problem: UnitedProblem, reaction: Any, quantities: Mapping[str, Callable[[], Any]] | None):
        self._comm, self._axes = problem.comm, "xyz"[: problem.config.gdim]
        self._quantities: dict[str, Callable[[], Any]] = {}
        with agreed(self._comm):
            expected = "functions without arguments that return numbers, by the names of their columns"
            given.kind("columns", quantities, quantities is None or isinstance(quantities, Mapping), expected)
            supports = dict(reaction) if isinstance(reaction, Mapping) else {} if reaction is None else {"": reaction}
            for name, support in supports.items():
                suffix = f"_{given.name('the name of a reaction', name)}" if isinstance(reaction, Mapping) else ""
                self._quantities[f"reaction{suffix}"] = partial(problem.reaction, support)
            for name, quantity in (quantities or {}).items():
                given.name("the name of a column", name)
                given.kind(
                    f"columns[{name!r}]", quantity, given.function(quantity), "a function without arguments that returns numbers"
                )
                if name in self._quantities:
                    raise InputError(f"columns[{name!r}]: a reaction has this name: choose another")
                self._quantities[name] = quantity
        self._sizes = {name: value.shape for name, value in self._values().items()}
        self.names = [column for name, shape in self._sizes.items() for column in self._columns(name, shape)]  # of the columns

    def _columns(self, name: str, shape: tuple[int, ...]) -> list[str]:
        """Names of the columns of a number ``()`` or a vector ``(n,)``."""
        if not shape:
            return [name]
        return [f"{name}_{a}" for a in (self._axes if shape[0] == len(self._axes) else range(shape[0]))]

    def _values(self) -> dict[str, Array]:
        """Present values of the functions (collective)."""
        found = {name: ask_together(self._comm, f"columns[{name!r}]", ask) for name, ask in self._quantities.items()}
        with agreed(self._comm):
            for name, value in found.items():
                what = f"columns[{name!r}]"
                found[name] = (
                    np.array(given.number(what, value)) if np.ndim(value) == 0 else given.vector(what, value, len(value))
                )
        given.alike(self._comm, "columns", **{name: value.tolist() for name, value in found.items()})
        return found

    def row(self) -> list[float]:
        """The present numbers of all columns (collective if there are columns).

        Raises InputError or InputTypeError if a function returns numbers that are not finite, differ between ranks, or changed in
        number, and UserFunctionError if a function raises an error.
        """
        if not self._quantities:
            return []
        values = self._values()
        with agreed(self._comm):
            for name, value in values.items():
                if value.shape != self._sizes[name]:
                    words = "a number" if not self._sizes[name] else f"{self._sizes[name][0]} numbers"
                    raise InputError(given.sentence(f"columns[{name!r}]", value, f"{words}, as at first"))
        return [float(x) for value in values.values() for x in value.ravel()]
