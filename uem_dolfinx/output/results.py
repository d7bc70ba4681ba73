"""Results to keep: files for ParaView and a history in CSV."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, forms, given
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.log import timed
from uem_dolfinx.output.tables import Closing, CsvTable, given_path
from uem_dolfinx.parallel import agreed
from uem_dolfinx.solve.load_steps import LoadStep
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.time_steps import TimeStep


class HistoryWriter(Closing):
    """CSV file with one row per load step or time step, complete after every row.

    Columns: ``factor`` or ``time``, ``newton_iterations``, and for every contact ``active``, ``max_gap``, the resultant
    ``force_x`` ... on the contactor's body and its ``moment`` about the origin, each followed by the contact's name where there
    are several.

    Args:
        path: name of the file; its folder is made.
        problem: what the rows are read from.
        resume: keep what a file that is there says about the time up to now, and go on after it.
    """

    def __init__(self, path: str | Path, problem: UnitedProblem, *, resume: bool = False):
        given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
        self.problem, dynamics = problem, problem.dynamics
        axes, turns = list("xyz")[: problem.config.gdim], list("xyz") if problem.config.gdim == 3 else ["z"]
        columns = ["factor" if dynamics is None else "time", "newton_iterations"]
        for suffix in contact_suffixes(problem.contacts):
            columns += [f"active{suffix}", f"max_gap{suffix}"]
            columns += [f"force_{a}{suffix}" for a in axes] + [f"moment_{a}{suffix}" for a in turns]
        self.table = CsvTable(path, problem.comm, columns, dynamics if resume else None)

    def write(self, step: LoadStep | TimeStep | float) -> None:
        """Append a row (collective).

        Args:
            step: a converged step; or its factor or time alone, which leaves the number of iterations empty.
        """
        row: list[object] = [clock(step), step.newton_iterations if isinstance(step, (LoadStep, TimeStep)) else ""]
        for contact in self.problem.contacts:
            resultant = contact.resultant()
            row += [contact.n_active, contact.max_gap(), *resultant.force, *resultant.moment]
        self.table.write(row)

    def close(self) -> None:
        """Close the file."""
        self.table.close()


class ResultsWriter(Closing):
    """Time series of everything there is to see: fields for ParaView and the history.

    Writes ``PATH.xdmf`` on every DOLFINx, ``PATH_vectors.bp`` and ``PATH_scalars.bp`` where it has ADIOS2, and
    ``PATH.csv``. Fields: displacement; for every contact its pressure, gap, status and force; and whatever ``fields``
    names. XDMF holds nodal values at the nodes of the mesh only: a displacement of degree 2 is interpolated.

    Args:
        path: name of the files without ending; its folder is made.
        problem: what is written.
        fields: further UFL expressions by name, scalar, vector or tensor; one value per cell, in XDMF only.
        vtx: whether to write VTX; None does where DOLFINx can.

    Raises:
        InputError, InputTypeError: for no path, no problem, or fields that are no UFL expressions by name.
        MissingBackendError: if VTX is asked for and DOLFINx was built without ADIOS2.
    """

    def __init__(
        self, path: str | Path, problem: UnitedProblem, *, fields: Mapping[str, Any] | None = None, vtx: bool | None = None
    ):
        given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
        self.problem, comm, mesh = problem, problem.comm, problem.config.mesh
        stem = given_path("path", path, comm)
        with agreed(comm):
            _check_fields(fields)
            vtx = None if vtx is None else given.flag("vtx", vtx)
        if comm.rank == 0:
            stem.parent.mkdir(parents=True, exist_ok=True)
        comm.barrier()
        self._expressions = dict(fields or {})
        spaces = {name: compat.function_space(mesh, ("DG", 0), e.ufl_shape) for name, e in self._expressions.items()}
        self._cellwise = {name: fem.Function(space, name=name) for name, space in spaces.items()}
        n_vertices = {"triangle": 3, "quadrilateral": 4, "tetrahedron": 4, "hexahedron": 8}[compat.cell_name(mesh)]
        degree = 1 if compat.geometry_dofs(mesh).shape[1] == n_vertices else 2
        self._nodal = {
            n: fem.Function(compat.function_space(mesh, degree, u.ufl_shape), name=n) for n, u in self._sources().items()
        }
        self.history = HistoryWriter(stem.with_name(stem.name + ".csv"), problem)
        self._xdmf = forms.open_xdmf(comm, stem.with_name(stem.name + ".xdmf"), mesh)
        self._vtx = []
        if compat.has_vtx() if vtx is None else vtx:
            for rank, kind in enumerate(("scalars", "vectors")):
                functions = [u for u in self._sources().values() if len(u.ufl_shape) == rank]
                if functions:
                    self._vtx.append(compat.open_vtx(comm, stem.with_name(f"{stem.name}_{kind}.bp"), functions))

    def _sources(self) -> dict[str, fem.Function]:
        """Functions of the problem by name, up to date (collective)."""
        found = {"displacement": self.problem.u}
        for contact, suffix in zip(self.problem.contacts, contact_suffixes(self.problem.contacts)):
            found |= {f"contact_pressure{suffix}": contact.pressure, f"gap{suffix}": contact.gap}
            found |= {f"active{suffix}": contact.active, f"contact_force{suffix}": contact.force}
        return found

    def write(self, step: LoadStep | TimeStep | float) -> None:
        """Append the present state (collective).

        Args:
            step: a converged step, or a load factor or time; it becomes the time in the files.
        """
        time = clock(step)
        with timed("write fields"):
            for name, u in self._sources().items():
                out = self._nodal[name]
                out.interpolate(u)
                out.x.scatter_forward()
                self._xdmf.write_function(out, time)
            for name, out in self._cellwise.items():
                compat.interpolate_expression(out, self._expressions[name])
                self._xdmf.write_function(out, time)
            for writer in self._vtx:
                writer.write(time)
        self.history.write(step)

    def close(self) -> None:
        """Close all files (collective)."""
        self.history.close()
        self._xdmf.close()
        for writer in self._vtx:
            writer.close()
        self._vtx = []


def _check_fields(fields: Any) -> None:
    """Refuse fields that are no UFL expressions by name.

    Raises:
        InputTypeError, InputError: naming the first bad one.
    """
    given.kind("fields", fields, fields is None or isinstance(fields, Mapping), "UFL expressions by name, as a dict, or None")
    for name, field in (fields or {}).items():
        given.name("the name of a field", name, "write _ for a blank")
        given.kind(f"fields[{name!r}]", field, hasattr(field, "ufl_shape"), "a UFL expression")


def clock(step: LoadStep | TimeStep | float) -> float:
    """Load factor or time of a step; InputTypeError for what has none."""
    known = isinstance(step, (TimeStep, LoadStep, int, float, np.number))
    given.kind("step", step, known, "a step of load_steps or time_steps, or its factor or time")
    return float(step.time if isinstance(step, TimeStep) else step.factor if isinstance(step, LoadStep) else step)


def contact_suffixes(contacts: Sequence[Contact]) -> list[str]:
    """What tells the contacts apart in names of fields and columns; nothing where there is but one."""
    if len(contacts) == 1:
        return [""]
    names = ["_" + re.sub(r"\W+", "_", contact.name).strip("_") for contact in contacts]
    return [name if names.count(name) == 1 else f"{name}_{i}" for i, name in enumerate(names)]
