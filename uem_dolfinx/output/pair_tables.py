"""Tables of the bodies that touch in general contacts: in every step one row for each pair."""

from __future__ import annotations

from pathlib import Path

from uem_dolfinx.contact.general.general import GeneralContact
from uem_dolfinx.output.tables import Closing, CsvTable
from uem_dolfinx.solve.problem import UnitedProblem


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
        self._general = [contact for contact in problem.declared if isinstance(contact, GeneralContact)]
        names = ["first", "second"]
        columns, resume_at = [clock, "step", *names, "active", *resultant], problem.progress if resume else None
        self._tables: list[CsvTable] = []
        for contact, suffix in zip(problem.declared, suffixes):
            if isinstance(contact, GeneralContact):
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
