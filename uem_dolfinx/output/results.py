"""Result files: fields for ParaView and a history in CSV."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, forms, given
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.errors import InputError
from uem_dolfinx.files import aside, given_path, given_resume, in_use, keep_aside, on_rank_0
from uem_dolfinx.form_checks import check_values
from uem_dolfinx.log import logger, timed
from uem_dolfinx.output.tables import Closing, Columns, CsvTable, PairTables, refuse_shared
from uem_dolfinx.parallel import agreed
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.stepping import LoadStep, TimeStep

#: Names of contact fields in the files of a ``ResultsWriter``, where they differ.
CALLED = {"pressure": "contact_pressure", "force": "contact_force"}
#: Endings of VTX files, by the rank of the tensors in them.
ENDINGS = ("scalars", "vectors")


class HistoryWriter(Closing, given.Sealed):
    """CSV file with one row per load step or time step, complete after every row.

    Columns: ``factor`` or ``time``, ``step`` (the number of steps of the problem so far), ``newton_iterations``, and for every contact
    ``active``, ``max_gap``, the resultant ``force_x`` ... on the contactor's body and its ``moment`` about the origin. If there are
    several contacts, their names follow these. Further columns come last, in the order of ``columns``::

        uem.HistoryWriter("out/run.csv", problem, reaction=tags["foot"], columns={"heat": lambda: uem.integrate(q * ufl.dx)})

    For a ``GeneralContact`` the pairs of bodies in contact, with the forces between them, are written to ``run_pairs.csv``, a row
    for each pair.

    Args:
        path: name of the file; its folder is made.
        problem: source of the rows.
        reaction: part of the mesh whose reaction is written, ``reaction_x`` ..., as in ``UnitedProblem.reaction``; or several parts
            by name, ``reaction_NAME_x`` ...
        columns: functions without arguments by column name, called on all ranks once here and after every step. They return a
            number, or a vector, whose columns are ``NAME_x`` ... if it has as many components as the displacement, else
            ``NAME_0`` ...
        resume: keep the rows of an existing file up to the present step, and append to them; False moves the file to a folder
            ``NAME.1``, or the next number, and starts a new file.

    Raises:
        OutputError, CheckpointError, ValueError: see ``CsvTable``.
        InputError, InputTypeError, UserFunctionError: if a column cannot be computed.
    """

    _whose = "a HistoryWriter"  # owner of the table in messages

    def __init__(
        self,
        path: str | Path,
        problem: UnitedProblem,
        *,
        reaction: Any = None,
        columns: Mapping[str, Callable[[], Any]] | None = None,
        resume: bool = False,
    ):
        given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
        until = problem.progress if given_resume(resume, problem.comm) else None
        self.problem, dynamics = problem, problem.dynamics
        axes, turns = list("xyz")[: problem.config.gdim], list("xyz") if problem.config.gdim == 3 else ["z"]
        names = ["factor" if dynamics is None else "time", "step", "newton_iterations"]
        suffixes, resultant = contact_suffixes(problem.declared), [f"force_{a}" for a in axes] + [f"moment_{a}" for a in turns]
        for suffix in suffixes:
            names += [f"{name}{suffix}" for name in ("active", "max_gap", *resultant)]
        self._progress, self._further = problem.progress, Columns(problem, reaction, columns)
        self.table = CsvTable(path, problem.comm, names + self._further.names, until, key="step", whose=self._whose)
        self.path = Path(path)
        try:
            self._pairs = PairTables(self.table.path, problem, suffixes, names[0], resultant, resume)
        except Exception:
            self.table.close()
            raise
        self._last = self.table.last.get(names[0], -np.inf)  # time of the last row
        #: Last step contained in a resumed file, -1 for a new file.
        self._known = problem.progress.steps if self.table.last else -1

    def write(self, step: LoadStep | TimeStep | float) -> None:
        """Append a row, unless a resumed file has it (collective).

        Args:
            step: a converged step; or only its factor or time, so that the number of iterations is empty.
        """
        self.append(step, self.clock(step))

    def clock(self, step: LoadStep | TimeStep | float) -> float:
        """Factor or time of a step to write (collective).

        Raises:
            InputError, InputTypeError: if it is missing, not finite, different on the ranks, or a time before the last one.
            ValueError, CheckpointError: see ``CsvTable.check``.
        """
        self.table.check()
        what = self.table.columns[0]
        with agreed(self.problem.comm):
            refuse_others(step, self.problem)
            time = given.number(what, clock(step))
        given.alike(self.problem.comm, "write", **{what: time})
        if self._progress.steps > self._known and time < self._last:
            words = f"{what} = {time:.6g} is written after {self._last:.6g}"
            if self.problem.dynamics is not None:
                raise InputError(f"{words}: expected times that do not fall; write each step once, in the order of time")
            if not isinstance(step, LoadStep):
                logger.warning("%s: pictures over time need times that do not fall", words)
        return time

    def append(self, step: LoadStep | TimeStep | float, time: float) -> None:
        """Append the row of a step, unless a resumed file has it (collective)."""
        if self._progress.steps <= self._known:
            return
        self._last = time
        iterations = step.newton_iterations if isinstance(step, (LoadStep, TimeStep)) else ""
        row: list[object] = [time, self._progress.steps, iterations]
        for contact in self.problem.declared:
            resultant = contact.resultant()
            row += [contact.n_active, contact.max_gap(), *resultant.force, *resultant.moment]
        self.table.write(row + self._further.row())
        self._pairs.write(time, self._progress.steps)

    def close(self) -> None:
        """Close the files."""
        self.table.close()
        self._pairs.close()


class TableOfResults(HistoryWriter):
    """The table of a ``ResultsWriter``."""

    _whose = "a ResultsWriter"


class ResultsWriter(Closing, given.Sealed):
    """Time series of results: fields for ParaView and the history.

    Writes ``PATH.xdmf`` with its numbers in ``PATH.bin``, ``PATH.csv`` and ``PATH_pairs.csv`` as in ``HistoryWriter``, and, if DOLFINx
    has ADIOS2, ``PATH_vectors.bp`` and ``PATH_scalars.bp``. Fields: displacement; other parts of a mixed space, e.g. ``field_1``; for
    every contact its pressure, gap, active contactors and force, with friction also status, traction and slip, further damage, wear
    and heat flux; and ``fields``. XDMF has nodal values at the nodes of the mesh only,
    so that a displacement of degree 2 is interpolated. VTX has the fields of the displacement's degree.

    After every step XDMF and CSV are complete. Existing results are never overwritten: they are moved to the folder ``PATH.1``, or the
    next number, with a warning, unless a run restarts from a checkpoint with ``resume=True``. A run that still writes them continues
    there, and other runs cannot resume them until it has closed them or ended::

        with uem.Checkpoint("out/run.uem") as checkpoint:
            checkpoint.begin(problem.state())
            with uem.ResultsWriter("out/run", problem, resume=True) as writer:
                for step in uem.load_steps(problem, 20, checkpoint=checkpoint):
                    writer.write(step)

    Args:
        path: name of the files without ending; its folder is made.
        problem: problem whose results are written.
        fields: further UFL expressions by name, scalar, vector or tensor; one value per cell, in XDMF only.
        reaction: see ``HistoryWriter``.
        columns: see ``HistoryWriter``.
        vtx: whether to write VTX; None writes it if DOLFINx can.
        resume: append to existing XDMF and CSV files: the steps up to the checkpoint are kept, later ones are replaced. VTX files
            cannot be resumed: new steps are written to ``PATH_vectors.1.bp``, or the next number. Without files, or if no
            checkpoint was read, new files are started.

    Raises:
        InputError, InputTypeError: for an invalid path or problem, or fields that are no UFL expressions by name.
        MissingBackendError: if ``vtx`` is True and DOLFINx was built without ADIOS2.
        OutputError: if the files cannot be written (previous steps are kept), or if another run is still writing the files to
            resume.
        CheckpointError: if the files to resume are of another run.
    """

    def __init__(
        self,
        path: str | Path,
        problem: UnitedProblem,
        *,
        fields: Mapping[str, Any] | None = None,
        reaction: Any = None,
        columns: Mapping[str, Callable[[], Any]] | None = None,
        vtx: bool | None = None,
        resume: bool = False,
    ):
        given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
        self.problem, comm, mesh = problem, problem.comm, problem.config.mesh
        self.path, resume = given_path("path", path, comm), given_resume(resume, comm)
        self._stem = self.path
        with agreed(comm):
            _check_fields(fields, mesh)
            vtx = None if vtx is None else given.flag("vtx", vtx)
        if vtx:
            compat.require_vtx(path)
        self._expressions = dict(fields or {})
        spaces = {name: compat.function_space(mesh, ("DG", 0), e.ufl_shape) for name, e in self._expressions.items()}
        self._cellwise = {name: fem.Function(space, name=name) for name, space in spaces.items()}
        self._interpolations = [forms.interpolation(out, self._expressions[name]) for name, out in self._cellwise.items()]
        from uem_dolfinx.output.xdmf import geometry_degree

        degree, sources = geometry_degree(mesh), self._sources()
        with agreed(comm):
            for name in self._expressions:
                if name in sources:
                    raise InputError(f"fields[{name!r}]: the problem's own field has this name in the files: give it another one")
        shapes = {u.ufl_shape: compat.function_space(mesh, degree, u.ufl_shape) for u in sources.values()}
        self._nodal = {name: fem.Function(shapes[u.ufl_shape], name=name) for name, u in sources.items()}
        refuse_shared(self._name(".csv"), comm, TableOfResults._whose)
        self._history = partial(TableOfResults, self._name(".csv"), problem, reaction=reaction, columns=columns)
        self._wants_vtx = compat.has_vtx() if vtx is None else vtx
        #: Whether it is still open if a checkpoint is read; without one, there is nothing to resume at the first step.
        self._undecided = resume and not (problem.progress.resumed or problem.progress.steps)
        if not resume:
            self._make_way()
        self._open(resume)

    def _name(self, ending: str) -> Path:
        return self._stem.with_name(self._stem.name + ending)

    def _make_way(self) -> None:
        """Move results of another run to a folder (collective)."""

        def move() -> None:
            self._stem.parent.mkdir(parents=True, exist_ok=True)
            own = [self._name(ending) for ending in (".xdmf", ".bin", ".h5", ".csv")]
            begin = tuple(f"{self._stem.name}_{ending}." for ending in ENDINGS)
            own += [f for f in sorted(self._stem.parent.iterdir()) if f.name.startswith(begin) and f.suffix == ".bp"]
            own += [self._name(f"_pairs{suffix}.csv") for suffix in contact_suffixes(self.problem.declared)]
            xdmf, csv = self._name(".xdmf"), self._name(".csv")
            written = (xdmf.is_file() and b"<Time " in xdmf.read_bytes()) or (csv.is_file() and csv.read_bytes().count(b"\n") > 1)
            if written or in_use(xdmf) or in_use(csv):
                keep_aside(self._stem, own)

        on_rank_0(self.problem.comm, f"the results {self._stem} cannot be written", move)

    def _open(self, resume: bool) -> None:
        """Start new files, or resume existing ones (collective)."""
        progress = self.problem.progress
        self.history = self._history(resume=resume)
        nodal, cellwise = list(self._nodal.values()), list(self._cellwise.values())
        until = progress.steps if resume else None
        try:
            from uem_dolfinx.output.xdmf import XdmfSeries

            self._xdmf = XdmfSeries(self._name(".xdmf"), self.problem.config.mesh, nodal, cellwise, until)
        except Exception:
            self.history.close()
            raise
        self._known = progress.steps if self._xdmf.n_steps else -1
        self._vtx: list[Any] | None = None

    def _open_vtx(self) -> list[Any]:
        """New VTX files, with names that are not in use (collective)."""
        opened, comm, degree = [], self.problem.comm, self.problem.config.degree
        # a file holds Functions of one element; their names are those in XDMF
        alike = [
            fem.Function(u.function_space, u.x, name=name)
            for name, u in self._sources().items()
            if compat.lagrange_degree(u.function_space) == degree
        ]
        for rank, ending in enumerate(ENDINGS):
            functions = [u for u in alike if len(u.ufl_shape) == rank]
            if self._wants_vtx and functions:
                stem = self._name(f"_{ending}")
                first = stem.with_name(f"{stem.name}.bp")

                def free(first: Path = first) -> Path:
                    return aside(first.with_suffix(""), ".bp") if first.exists() else first

                path = on_rank_0(comm, f"the results {first} cannot be written", free)
                opened.append(compat.open_vtx(comm, path, functions))
        return opened

    def _sources(self) -> dict[str, fem.Function]:
        """Functions of the problem by name, up to date (collective)."""
        found = self.problem.config.functions()
        for contact, suffix in zip(self.problem.declared, contact_suffixes(self.problem.declared)):
            found |= {f"{CALLED.get(name, name)}{suffix}": u for name, u in contact_fields(contact).items()}
        return found

    def write(self, step: LoadStep | TimeStep | float) -> None:
        """Append the present state, unless resumed files have it (collective).

        Args:
            step: a converged step, or a load factor or time; it becomes the time in the files.

        Raises:
            OutputError: if it cannot be written.
            InputError, InputTypeError: if the time of ``step`` is missing, not finite, different on the ranks, or before the last one.
            CheckpointError: if a checkpoint was read after the writer had been made with ``resume=True``.
            ValueError: after ``close``.
        """
        time = self.history.clock(step)
        if self._undecided:
            self._undecided = False
            self.history.close()
            self._xdmf.close()
            self._make_way()
            self._open(False)
        if self._vtx is None:
            self._vtx = self._open_vtx()
        steps = self.problem.progress.steps
        if steps > self._known:
            with timed("write fields"):
                for name, u in self._sources().items():
                    out = self._nodal[name]
                    out.interpolate(u)
                    out.x.scatter_forward()
                for interpolate in self._interpolations:
                    interpolate()
                self._xdmf.write(time, steps)
                for writer in self._vtx:
                    writer.write(time)
        self.history.append(step, time)

    def close(self) -> None:
        """Close all files (collective with VTX files)."""
        self.history.close()
        self._xdmf.close()
        for writer in self._vtx or []:
            writer.close()
        self._vtx = []


def refuse_others(step: Any, problem: UnitedProblem) -> None:
    """Raise InputError for a step of another problem."""
    number = getattr(step, "_of_problem", 0)
    if number and number != problem.progress.number:
        raise InputError(
            f"{step} is a step of another problem: expected one of the problem whose state is written; make a writer for each problem"
        )


def _check_fields(fields: Any, mesh: Any) -> None:
    """InputTypeError, InputError or SpaceError for the first of the fields that is no UFL expression by name, on a mesh."""
    given.kind("fields", fields, fields is None or isinstance(fields, Mapping), "UFL expressions by name, as a dict, or None")
    for name, field in (fields or {}).items():
        given.name("the name of a field", name, "write _ for a blank")
        given.kind(f"fields[{name!r}]", field, hasattr(field, "ufl_shape"), "a UFL expression")
        if len(field.ufl_shape) > 2 or any(n > 3 for n in field.ufl_shape):
            raise InputError(
                f"fields[{name!r}] has the shape {field.ufl_shape}: expected a scalar, a vector of up to 3 components or a tensor of up to "
                "(3, 3), as files of results hold; write its components as fields of their own"
            )
        check_values(f"fields[{name!r}]", field, mesh.ufl_domain(), "the displacement's mesh")


def clock(step: LoadStep | TimeStep | float) -> float:
    """Load factor or time of a step; InputTypeError for objects without one."""
    known = isinstance(step, (TimeStep, LoadStep, int, float, np.number))
    given.kind("step", step, known, "a step of load_steps or time_steps, or its factor or time")
    return float(step.time if isinstance(step, TimeStep | LoadStep) else step)


def contact_fields(contact: Any) -> dict[str, fem.Function]:
    """Fields on the contactors of a contact by name, of friction, ties, bonds, wear and heat only where there are any (collective)."""
    parts = [contact] if isinstance(contact, Contact) else contact.parts
    found = {name: getattr(contact, name) for name in ("pressure", "gap", "active", "force")}
    rubs = any(part.pair.friction is not None for part in parts)
    if rubs or any(part.pair.tie is not None for part in parts):
        found |= {name: getattr(contact, name) for name in ("status", "traction")}
    if rubs:
        found["slip"] = contact.slip
    if isinstance(contact, Contact) and contact.wears:
        found["wear"] = contact.wear
    if isinstance(contact, Contact) and contact.cohesion is not None:
        found["damage"] = contact.damage
    if isinstance(contact, Contact) and contact.leak is not None:
        found["wet"] = contact.wet
    for k, field in enumerate(dict.fromkeys(law.field for law in contact.heats)):
        found[f"heat_flux{f'_of_field_{field}' if k else ''}"] = contact.heat_flux_of(field)
    return found


def contact_suffixes(contacts: Sequence[Any]) -> list[str]:
    """Suffixes of the contacts in names of fields and columns; empty for a single contact."""
    if len(contacts) == 1:
        return [""]
    names = ["_" + re.sub(r"\W+", "_", contact.name).strip("_") for contact in contacts]
    return [name if names.count(name) == 1 else f"{name}_{i}" for i, name in enumerate(names)]
