"""Results read back from the files of a ``ResultsWriter`` or a ``HistoryWriter``, on any number of ranks."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar
from xml.etree import ElementTree

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import AnyArray, Array, Ints, is_whole
from uem_dolfinx.errors import InputError, MissingFileError, OutputError, SpaceError, UEMError
from uem_dolfinx.files import given_path, on_rank_0
from uem_dolfinx.output.xdmf import TOPOLOGIES, geometry_degree, numbering_of
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.restart.numbering import n_cells

T = TypeVar("T")

#: Cells by their name in XDMF, with the degree of their geometry.
OF_TOPOLOGY = {name: (cell, 1 if n == len(forms.reference_topology(cell)[0]) else 2) for (cell, n), name in TOPOLOGIES.items()}


class Results:
    """Results of a run: fields as Functions, histories as arrays, as ``read_results`` returns them.

    Attributes:
        comm: ranks that read them.
        mesh: of the fields; None for a history alone.
        times: load factor or time of every step ``(n_steps,)``.
        steps: their numbers in the run ``(n_steps,)``.
        names: of the fields.
        history: columns of ``PATH.csv`` by name ``(n_rows,)``, numbers, NaN where a row is empty.
        pairs: columns of ``PATH_pairs.csv`` by name, names of bodies as text; empty without general contact.
    """

    def __init__(self, path: Path, comm: MPI.Comm, mesh: Any, fields: bool):
        stem, self.comm = path.with_suffix("") if path.suffix in (".xdmf", ".csv") else path, comm
        xdmf, table, pairs = (stem.with_name(stem.name + end) for end in (".xdmf", ".csv", "_pairs.csv"))

        def read() -> tuple[Any, ...]:
            if not (xdmf.exists() or table.exists()):
                raise MissingFileError(f"there are no results {stem}: expected {xdmf} or {table}, as a ResultsWriter writes them")
            described = _read(_described, xdmf) if fields and xdmf.exists() else ([], None)
            return described, _read(_columns, table), _read(_columns, pairs)

        (steps, grid), self.history, self.pairs = on_rank_0(comm, f"the results {stem} cannot be read", read)
        self._path, self._steps, self._numbers = xdmf, [fields for _, _, fields in steps], stem.with_name(stem.name + ".bin")
        self.times: Array = np.array([time for time, _, _ in steps] or self.history.get("time", self.history.get("factor", [])))
        self.steps: Ints = np.array([n for _, n, _ in steps] or self.history.get("step", []), dtype=np.int64)
        self.names: tuple[str, ...] = tuple(self._steps[0]) if steps else ()
        self.mesh, self._made = mesh, mesh is None
        if grid is not None:
            if mesh is None:
                self.mesh = self._make_mesh(comm, *grid)
            else:
                self._check_mesh(*grid[1:])

    def _make_mesh(self, comm: MPI.Comm, name: str, cells: Item, nodes: Item) -> Any:
        """The mesh of the files (collective)."""
        cell, degree = OF_TOPOLOGY[name]

        def part(item: Item) -> AnyArray:
            return np.array(self._array(item)[item.rows * comm.rank // comm.size : item.rows * (comm.rank + 1) // comm.size])

        return compat.create_mesh(comm, compat.gmsh_nodes(cell, part(cells)), part(nodes), cell, degree)

    def _check_mesh(self, cells: Item, nodes: Item) -> None:
        """Refuse a mesh that is not that of the files (collective)."""
        S = compat.function_space(self.mesh, geometry_degree(self.mesh))
        known = S.dofmap.index_map.size_global, self.mesh.geometry.dim
        same = n_cells(self.mesh) == cells.rows and known == (nodes.rows, nodes.width)
        if same:
            place = self._rows_of(S)
            x = np.empty((S.dofmap.index_map.size_local + S.dofmap.index_map.num_ghosts, nodes.width))
            x[compat.cell_dofs(S)] = self.mesh.geometry.x[compat.geometry_dofs(self.mesh), : nodes.width]
            same = np.array_equal(x[: len(place)], self._array(nodes)[place])
        if not reduced(self.mesh.comm, bool(same), op=MPI.LAND):
            raise SpaceError(
                f"{self._path} is of another mesh, with {cells.rows} cells and {nodes.rows} nodes: leave mesh out, and it is made anew"
            )

    def _rows_of(self, V: Any) -> Ints:
        """Rows in the files of this rank's nodes of a space, of the geometry's degree or DG0 (collective)."""
        if not self._made:
            return numbering_of(V).place
        mesh, owned = self.mesh, V.dofmap.index_map.size_local
        place = np.empty(owned + V.dofmap.index_map.num_ghosts, dtype=np.int64)
        if (compat.element_family(V) or ("",))[0] == "Lagrange":
            place[compat.cell_dofs(V)] = np.asarray(mesh.geometry.input_global_indices)[compat.geometry_dofs(mesh)]
        else:
            place[compat.cell_dofs(V)[:, 0]] = forms.original_cells(mesh)
        return place[:owned]

    def __repr__(self) -> str:
        """The file, the number of steps, and the names of fields."""
        return f"Results('{self._path.with_suffix('')}', {len(self.times)} steps, fields: {', '.join(self.names) or 'none'})"

    def _array(self, item: Item) -> AnyArray:
        """Rows of a table in the file ``(rows, width)``, read where they are used; OutputError if the file has them not."""
        size = self._numbers.stat().st_size
        if not 0 <= item.seek <= size or not 0 <= 8 * item.rows * item.width <= size - item.seek:
            raise OutputError(
                f"{self._numbers} ends before the numbers that {self._path} describes: it was cut off, or is of another run"
            )
        return np.memmap(self._numbers, item.kind, "r", offset=item.seek, shape=(item.rows, item.width))

    def function(self, name: str, step: int = -1, shape: tuple[int, ...] | None = None) -> fem.Function:
        """A field at a step, as a new Function (collective).

        Nodal fields are of the degree of the mesh's geometry: 1 with straight cells. Cellwise ones are in ``("DG", 0)``.

        Args:
            name: one of ``names``.
            step: its index in ``times``, -1 the last.
            shape: of its values; None takes ``(gdim,)`` for vectors and ``(gdim, gdim)`` for tensors, 3 in place of gdim where other
                components are not zero. XDMF has three for all.

        Raises:
            InputError, InputTypeError: for an unknown name, step or shape.
        """
        if self.mesh is None or not self._steps:
            raise InputError(f"{self._path} does not exist, or has no step: expected the fields of a ResultsWriter")
        given.word("name", name, self.names)
        given.kind("step", step, is_whole(step), "a whole number")
        if not -len(self._steps) <= step < len(self._steps):
            raise InputError(
                given.sentence("step", step, f"one of {len(self._steps)} steps, counted from 0, or from -1 backwards")
            )
        comm, gdim, item = self.mesh.comm, self.mesh.geometry.dim, self._steps[step][name]
        rank = {1: 0, 3: 1, 9: 2}[item.width]
        element = geometry_degree(self.mesh) if item.nodal else ("DG", 0)
        place = self._rows_of(compat.function_space(self.mesh, element, (gdim,) * rank))
        rows = np.array(self._array(item)[place]).reshape(-1, *(3,) * rank)
        own = tuple(slice(gdim) for _ in range(rank))
        if shape is None:
            rest = np.array(rows)
            rest[(slice(None), *own)] = 0.0
            shape = ((3,) if reduced(comm, bool(rest.any()), op=MPI.LOR) else (gdim,)) * rank
        if len(shape) != rank or any(n not in (gdim, 3) for n in shape):
            raise InputError(given.sentence("shape", shape, f"{rank} numbers, each {gdim} or 3"))
        f = fem.Function(compat.function_space(self.mesh, element, shape), name=re.sub(r"\W+", "_", name))
        values = rows[(slice(None), *(slice(n) for n in shape))].reshape(len(rows), -1)
        f.x.array.reshape(-1, max(int(np.prod(shape)), 1))[: len(rows)] = values
        f.x.scatter_forward()
        return f


class Item:
    """A table in the file of numbers: rows, width, place in bytes, type, and whether its rows are nodes."""

    def __init__(self, element: Any, nodal: bool = True):
        self.rows, self.width = map(int, element.get("Dimensions").split())
        self.seek, self.nodal = int(element.get("Seek")), nodal
        self.kind = {"Little": "<", "Big": ">"}[element.get("Endian")] + {"Int": "i8", "Float": "f8"}[element.get("NumberType")]


def _read(read: Callable[[Path], T], path: Path) -> T:
    """What a function reads from a file; OutputError if it is damaged."""
    try:
        return read(path)
    except (ElementTree.ParseError, csv.Error, AttributeError, LookupError, TypeError, ValueError) as error:
        if isinstance(error, UEMError):
            raise
        raise OutputError(
            f"{path} cannot be read ({type(error).__name__}: {error}): expected a file as a ResultsWriter writes it; it is damaged, or of "
            "another program"
        ) from error


def _described(path: Path) -> tuple[list[tuple[float, int, dict[str, Item]]], tuple[str, Item, Item] | None]:
    """Times, numbers and fields of the steps of an XDMF file, and the type, cells and nodes of its mesh."""
    steps, grid = [], None
    for found in ElementTree.parse(path).iter("Grid"):
        if found.get("GridType"):
            continue
        time, number = (found.find(what).get("Value") for what in ("Time", "Information"))  # type: ignore[union-attr]
        topology, geometry = found.find("Topology"), found.find("Geometry")
        fields = {one.get("Name"): Item(one[0], one.get("Center") == "Node") for one in found.iter("Attribute")}
        steps.append((float(time), int(number), fields))  # type: ignore[arg-type]
        kind, cells, nodes = topology.get("TopologyType"), Item(topology[0]), Item(geometry[0])  # type: ignore[union-attr,index]
        for name, one in fields.items():
            if one.width not in (1, 3, 9) or one.rows != (nodes if one.nodal else cells).rows:
                raise ValueError(f"'{name}' has {one.rows} rows of {one.width} numbers")
        if kind not in OF_TOPOLOGY:
            raise ValueError(f"cells of type '{kind}'")
        grid = kind, cells, nodes
    if grid is not None and not (numbers := path.with_suffix(".bin")).exists():
        raise MissingFileError(f"{numbers} does not exist: expected it next to its .xdmf file, which describes it")
    return steps, grid  # type: ignore[return-value]


def _columns(path: Path) -> Mapping[str, AnyArray]:
    """Columns of a CSV file by name: numbers where all are, or empty; empty without a file."""
    if not path.exists():
        return {}
    with path.open(newline="", encoding="utf-8") as file:
        names, *rows = list(csv.reader(file)) or [[]]
    found: dict[str, AnyArray] = {}
    for n, row in enumerate(rows, 2):
        if len(row) != len(names):
            raise OutputError(
                f"line {n} of {path} has {len(row)} values: expected {len(names)}; remove the line if it was cut off"
            )
    for k, name in enumerate(names):
        if name in found:
            raise OutputError(f"{path} has two columns '{name}': expected names that differ; rename one in its first line")
        column = [row[k] for row in rows]
        try:
            found[name] = np.array([float(value) if value else np.nan for value in column])
        except ValueError:
            found[name] = np.array(column)
    return found


def read_results(path: str | Path, comm: MPI.Comm = MPI.COMM_WORLD, *, mesh: Any = None, fields: bool = True) -> Results:
    """Read results that a ``ResultsWriter`` or a ``HistoryWriter`` has written, on any number of ranks (collective).

        results = uem.read_results("out/run")
        u = results.function("displacement")              # at the last step
        plt.plot(results.times, results.history["force_y"])

    Args:
        path: as given to the writer, with or without its ending.
        comm: ranks on which the fields are read.
        mesh: of the run, to combine the fields with its Functions; None makes the mesh anew from the files.
        fields: False reads the history alone.

    Raises:
        MissingFileError: if there are neither fields nor a history.
        OutputError: for files that are damaged or of another program; also later, where numbers are missing.
        SpaceError: if the fields are of another mesh.
        InputError, InputTypeError: for an invalid path.
    """
    given.kind("comm", comm, isinstance(comm, MPI.Comm), "a communicator, as MPI.COMM_WORLD")
    with agreed(comm):
        known = mesh
        given.kind("mesh", known, known is None or hasattr(known, "topology"), "a mesh, or None")
        fields = given.flag("fields", fields)
    return Results(given_path("path", path, comm), comm, mesh, fields)
