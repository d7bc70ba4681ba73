"""Curves of histories and of energies over time, from writers or from their files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import fields
from io import BytesIO
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import AnyArray
from uem_dolfinx.errors import InputError
from uem_dolfinx.output.energy import Energies, EnergyBook, draw_energies
from uem_dolfinx.output.pictures import Picture, panel_of
from uem_dolfinx.output.reading import Results, read_results
from uem_dolfinx.output.results import HistoryWriter, ResultsWriter
from uem_dolfinx.parallel import agreed

SOURCES = "a HistoryWriter, a ResultsWriter, an EnergyBook, what read_results returns, or the path of a CSV file"


def plot_history(
    source: Any,
    picture: str | Path | Any = ...,
    *,
    columns: str | Sequence[str] | None = None,
    over: str | None = None,
    label: str | None = None,
    over_label: str | None = None,
) -> Picture | None:
    """Plot columns of a history over the load factor, the time, or another column (collective).

        uem.plot_history("out/run.csv", "forces.png", columns=["force_y", "reaction_y"])
        uem.plot_history(history, columns="force_y", over="way")

    Args:
        source: a ``HistoryWriter``, ``ResultsWriter`` or ``EnergyBook``, the result of ``read_results``, or the path of a CSV file.
        picture: name of the picture, or a panel of :func:`figure`. By default the picture is returned, and Jupyter shows it.
        columns: their names, see the head of the file; None takes all nonzero forces and reactions, or if there are none all
            nonzero columns, as the energies of an ``EnergyBook``.
        over: the column on the other axis; None is ``time`` or ``factor``.
        label: of the axis of values; None is the name of a single column.
        over_label: of the other axis; None is ``over``.

    Returns:
        The picture if it has neither name nor panel.

    Raises:
        InputError, InputTypeError: for another source, or an unknown column.
        MissingFileError: if there is no such file.
        MissingBackendError: if matplotlib cannot be imported.
    """
    comm, known = _columns_of(source)
    with agreed(comm):
        numbers = {name: values for name, values in known.items() if values.dtype.kind == "f"}
        if not numbers:
            raise InputError("source has no column of numbers: expected the table of a run with steps")
        over = next((name for name in ("time", "factor") if name in numbers), None) if over is None else over
        given.word("over", over, list(numbers))
        columns = [columns] if isinstance(columns, str) else columns
        if columns is None:
            moved = [n for n, v in numbers.items() if n != over and np.abs(v).max(initial=0.0) > 0]
            columns = [n for n in moved if n.startswith(("force_", "reaction_"))] or moved
        wanted = given.items("columns", columns, lambda one: isinstance(one, str), "the name of a column")
        for name in wanted:
            given.word("columns", name, list(numbers))
        if not wanted:
            raise InputError("columns = []: expected the name of a column at least")
    file = BytesIO()
    with panel_of(file if picture is ... else picture, comm) as ax:
        if ax is not None:
            for name in wanted:
                ax.plot(numbers[str(over)], numbers[name], ".-" if len(numbers[name]) < 50 else "-", label=name)
            ax.set(xlabel=over_label or over, ylabel=label or (wanted[0] if len(wanted) == 1 else ""))
            ax.grid(alpha=0.25)
            if len(wanted) > 1:
                ax.legend(frameon=False)
    return Picture(file.getvalue()) if picture is ... else None


def plot_energies(source: Any, picture: str | Path | Any = ...) -> Picture | None:
    """Plot the energy balance over time: kinetic, stored, dissipated, works, and the sum that is constant (collective).

        uem.plot_energies(book, "energy.png")

    Args:
        source: an ``EnergyBook``, or the path of its CSV file.
        picture: as in :func:`plot_history`.

    Returns:
        The picture if it has neither name nor panel.

    Raises:
        InputError, InputTypeError: for another source, or a history without energies.
        MissingFileError: if there is no such file.
        MissingBackendError: if matplotlib cannot be imported.
    """
    comm, known = _columns_of(source)
    with agreed(comm):
        if missing := [one.name for one in fields(Energies) if one.name not in known]:
            raise InputError(f"source has no column '{missing[0]}': expected the table of an EnergyBook")
    file = BytesIO()
    with panel_of(file if picture is ... else picture, comm) as ax:
        if ax is not None:
            draw_energies(ax, known)
    return Picture(file.getvalue()) if picture is ... else None


def _columns_of(source: Any) -> tuple[MPI.Comm, Mapping[str, AnyArray]]:
    """Communicator and columns of a history (collective)."""
    source = source.history if isinstance(source, ResultsWriter) else source
    if isinstance(source, EnergyBook):
        return source.problem.comm, source.columns()
    if isinstance(source, HistoryWriter):
        return source.problem.comm, read_results(source.table.path, source.problem.comm, fields=False).history
    if not isinstance(source, Results):
        given.kind("source", source, isinstance(source, (str, Path)), SOURCES)
        source = read_results(source, fields=False)
    return source.comm, source.history
