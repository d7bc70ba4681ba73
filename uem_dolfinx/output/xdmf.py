"""Time series of fields in XDMF: ``NAME.xdmf`` describes the contents of ``NAME.bin``, which has numbers in binary format.

All data follow the input order of the mesh, so that any number of ranks writes the same files and can resume them. A step is added to
the XDMF file after all of its numbers have been written: a killed run leaves complete steps only.
"""

from __future__ import annotations

import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import AnyArray
from uem_dolfinx.errors import CheckpointError, OutputError, UEMError
from uem_dolfinx.files import REMEDY, OwnFile, Trouble, begin_file, on_rank_0, open_together
from uem_dolfinx.restart.numbering import Numbering, n_cells, node_numbering

#: XDMF's names of cells, by name and number of nodes.
TOPOLOGIES = {
    ("triangle", 3): "Triangle", ("triangle", 6): "Triangle_6",
    ("quadrilateral", 4): "Quadrilateral", ("quadrilateral", 9): "Quadrilateral_9",
    ("tetrahedron", 4): "Tetrahedron", ("tetrahedron", 10): "Tetrahedron_10",
    ("hexahedron", 8): "Hexahedron", ("hexahedron", 27): "Hexahedron_27",
}  # fmt: skip
#: Beginning of every file.
HEAD_OF_FILE = (
    '<?xml version="1.0"?>\n<Xdmf Version="3.0">\n<Domain>\n<Grid Name="steps" GridType="Collection" CollectionType="Temporal">\n'
)
#: End of every file.
TAIL = "</Grid>\n</Domain>\n</Xdmf>\n"
#: Characters that XML escapes.
ESCAPED = str.maketrans({"&": "&amp;", "<": "&lt;", ">": "&gt;", '"': "&quot;"})
#: A step, with its time and number.
STEP = re.compile(
    r'<Grid Name="mesh">\n<Time Value="([^"]+)"/>\n<Information Name="step" Value="(\d+)"/>\n.*?</Grid>\n', re.DOTALL
)


@dataclass(frozen=True)
class Table:
    """Rows of numbers at nodes or cells, in the order of the mesh's input."""

    rows: Callable[[], AnyArray]  # of this rank, in its own order ``(n, width)``
    width: int
    numbering: Numbering  # their positions in the file

    @property
    def size(self) -> int:
        """Bytes of all rows."""
        return 8 * self.width * self.numbering.total


class XdmfSeries:
    """Fields over time on one mesh, with the nodes of a Lagrange space of the geometry's degree (the constructor is collective).

    Args:
        path: of the XDMF file, in an existing folder.
        nodal: scalar or vector Functions of that Lagrange space, with names.
        cellwise: scalar, vector or tensor DG0 Functions, with names.
        resume_at: keep the steps of existing files up to this number, and append to them; the files are unchanged until the first
            step is written. None starts new files.

    Raises:
        OutputError: if the files cannot be written, or if another run writes the files to resume.
        CheckpointError: if the files to resume have other fields or another mesh.
    """

    def __init__(
        self, path: Path, mesh: Any, nodal: Sequence[fem.Function], cellwise: Sequence[fem.Function], resume_at: int | None = None
    ):
        self.path, self.comm, self._mesh = path, mesh.comm, mesh
        self._numbers = path.with_suffix(".bin")
        #: The XDMF file on rank 0, and the file of numbers on every rank.
        self._text: OwnFile | None = None
        self._bin: OwnFile | None = None
        S = compat.function_space(mesh, geometry_degree(mesh))
        known: dict[int, Numbering] = {}
        self._fields: list[tuple[fem.Function, str, Table]] = []
        for centre, functions in (("Node", nodal), ("Cell", cellwise)):
            for u in functions:
                V = u.function_space
                if id(V) not in known:
                    known[id(V)] = numbering_of(V)
                self._fields.append((u, centre, self._field(u, known[id(V)])))
        self._cells, self._nodes = self._mesh_tables(S)
        self.n_steps = 0  # number of steps in the files
        self._end, self._more = 0, False  # end of the last kept step in the XDMF file, and whether the files contain more
        try:
            if resume_at is None or not on_rank_0(self.comm, self._trouble, path.exists):
                self._begin()
            else:
                self._go_on(resume_at)
        except Exception:
            self.close()
            raise

    def close(self) -> None:
        """Close the files; other runs may then resume them."""
        for file in (self._text, self._bin):
            if file is not None:
                file.close()

    @property
    def _trouble(self) -> str:
        return f"the results {self.path} cannot be written"

    # -- tables --------------------------------------------------------------------------------------------------------

    @staticmethod
    def _field(u: fem.Function, numbering: Numbering) -> Table:
        """Rows of a Function; vectors and tensors have three components in each direction, as XDMF requires."""
        shape, n = tuple(u.ufl_shape), u.function_space.dofmap.index_map.size_local

        def rows() -> AnyArray:
            padded = np.zeros((n, *(3 for _ in shape)))
            padded[(slice(None), *map(slice, shape))] = u.x.array.reshape(-1, *shape)[:n]
            return padded.reshape(n, 3 ** len(shape))

        return Table(rows, 3 ** len(shape), numbering)

    def _mesh_tables(self, S: Any) -> tuple[Table, Table]:
        """Nodes of every cell in VTK's order, and coordinates of the nodes."""
        numbering, place = numbering_of(S), fem.Function(S)
        owned, gdim = len(numbering.place), self._mesh.geometry.dim
        place.x.array[:owned] = numbering.place
        place.x.scatter_forward()
        n, keys = _cell_keys(self._mesh)
        cells = compat.vtk_nodes(compat.cell_name(self._mesh), place.x.array[compat.cell_dofs(S)[:n]].astype(np.int64))
        # coordinates as read: tabulated ones are rounded in one of the adjacent cells, which depends on the partition
        x = np.empty((place.x.array.size, gdim))
        x[compat.cell_dofs(S)] = self._mesh.geometry.x[compat.geometry_dofs(self._mesh), :gdim]
        x = x[:owned]
        order = Numbering(self.comm, keys, n_cells(self._mesh))
        return Table(lambda: cells, cells.shape[1], order), Table(lambda: x, gdim, numbering)

    # -- text of the XDMF file -----------------------------------------------------------------------------------------

    def _item(self, table: Table, seek: int, kind: str = "Float") -> str:
        return (
            f'<DataItem Dimensions="{table.numbering.total} {table.width}" NumberType="{kind}" Precision="8" Format="Binary" '
            f'Endian="{sys.byteorder.capitalize()}" Seek="{seek}">{self._numbers.name.translate(ESCAPED)}</DataItem>'
        )

    def _describe(self, k: int, time: float, step: int) -> str:
        """Text of the k-th step in the files."""
        cells, nodes, name = self._cells, self._nodes, compat.cell_name(self._mesh)
        short = f"{time:g}"
        lines = [
            '<Grid Name="mesh">',
            f'<Time Value="{short if float(short) == time else repr(float(time))}"/>',
            f'<Information Name="step" Value="{step}"/>',
            f'<Topology TopologyType="{TOPOLOGIES[name, cells.width]}" NumberOfElements="{cells.numbering.total}">',
            f"{self._item(cells, 0, 'Int')}</Topology>",
            f'<Geometry GeometryType="{"XY" if nodes.width == 2 else "XYZ"}">{self._item(nodes, cells.size)}</Geometry>',
        ]
        seek = self._start(k)
        for u, centre, table in self._fields:
            kind = ("Scalar", "Vector", "Tensor")[len(u.ufl_shape)]
            head = f'<Attribute Name="{u.name.translate(ESCAPED)}" AttributeType="{kind}" Center="{centre}">'
            lines.append(f"{head}{self._item(table, seek)}</Attribute>")
            seek += table.size
        return "\n".join([*lines, "</Grid>\n"])

    def _start(self, k: int) -> int:
        """Beginning of the k-th step in the file of numbers."""
        return self._cells.size + self._nodes.size + k * sum(table.size for _, _, table in self._fields)

    # -- writing and resuming ------------------------------------------------------------------------------------------

    def _open(self, kind: type[UEMError] = OutputError, *, begin: bool = False) -> None:
        """Open the file of numbers on every rank, a new file under a temporary name (collective)."""
        path = self._numbers.with_name(f".{self._numbers.name}.{self.comm.bcast(os.getpid())}") if begin else self._numbers
        self._bin = open_together(path, Trouble(self.comm, self._trouble, REMEDY, kind), begin)

    def _begin(self) -> None:
        """Begin new files with the mesh (collective)."""
        self._open(begin=True)

        def begin() -> None:
            os.replace(self._bin.path, self._numbers)  # type: ignore[union-attr]
            self._text = begin_file(self.path)
            self._text.replace_end(0, (HEAD_OF_FILE + TAIL).encode())

        on_rank_0(self.comm, self._trouble, begin)
        self._end = len(HEAD_OF_FILE.encode())
        self._write(0, [self._cells, self._nodes])

    def _write(self, offset: int, tables: Sequence[Table]) -> None:
        """Write tables one after the other (collective)."""
        assert self._bin is not None
        trouble = Trouble(self.comm, self._trouble)
        for table in tables:
            part = table.numbering.to_table(table.rows())
            with trouble:
                self._bin.write_at(offset + 8 * table.width * table.numbering.first, part)
            offset += table.size
        with trouble:
            self._bin.hand_over()
        trouble.agree()

    def _go_on(self, last: int) -> None:
        """Find the steps to keep, and check that they are of this mesh and these fields (collective)."""
        other = f"the results {self.path} belong to another run"
        remedy = "choose another name, or move them away to start anew"

        def read() -> tuple[int, int, bool]:
            self._text = OwnFile(self.path)
            text = self._text.read().decode()
            steps = list(STEP.finditer(text))
            kept = [s for s in steps if int(s[2]) <= last]
            if not text.startswith(HEAD_OF_FILE) or any(
                s[0] != self._describe(k, float(s[1]), int(s[2])) for k, s in enumerate(kept)
            ):
                names = ", ".join(u.name for u, _, _ in self._fields)
                whole = f"{self._cells.numbering.total} cells and {self._nodes.numbering.total} nodes"
                raise CheckpointError(f"{other}: expected the fields {names} on {whole}; {remedy}")
            size = self._numbers.stat().st_size
            if size < self._start(len(kept)):
                raise CheckpointError(
                    f"{self._numbers} is damaged: expected {self._start(len(kept))} bytes, found {size}; {remedy}"
                )
            known = text[: kept[-1].end()] if kept else HEAD_OF_FILE
            return len(kept), len(known.encode()), text != known + TAIL

        self.n_steps, self._end, self._more = on_rank_0(self.comm, f"the results {self.path} cannot be gone on with", read)
        self._open(CheckpointError)
        assert self._bin is not None
        trouble = Trouble(self.comm, f"the results {self.path} cannot be read", REMEDY, CheckpointError)
        offset = 0
        for table in (self._cells, self._nodes):
            part = table.numbering.to_table(table.rows())
            found = np.zeros_like(part)
            with trouble:
                self._bin.read_at(offset + 8 * table.width * table.numbering.first, found)
                if not np.array_equal(part, found):
                    raise CheckpointError(f"{other}: expected the mesh of this one, found another; {remedy}")
            offset += table.size
        trouble.agree()

    def _make_ready(self) -> None:
        """Check, on rank 0, that the files still belong to this run, and cut them after the kept steps."""
        assert self._text is not None and self._bin is not None
        self._text.check()
        self._bin.check(sized=False)
        if self._more:
            self._text.replace_end(self._end, TAIL.encode())
            self._bin.truncate(self._start(self.n_steps))

    def write(self, time: float, step: int) -> None:
        """Append the present values (collective).

        Args:
            time: of the step in the files.
            step: its number, for ``resume_at``.

        Raises:
            OutputError: if they cannot be written; previous steps are kept.
        """
        k = self.n_steps
        on_rank_0(self.comm, self._trouble, self._make_ready)
        self._more = False
        self._write(self._start(k), [table for _, _, table in self._fields])
        text = self._describe(k, time, step).encode()
        on_rank_0(self.comm, self._trouble, lambda: self._text.replace_end(self._end, text + TAIL.encode()))  # type: ignore[union-attr]
        self._end += len(text)
        self.n_steps += 1


def geometry_degree(mesh: Any) -> int:
    """Degree of a mesh's geometry, 1 or 2."""
    return 1 if compat.geometry_dofs(mesh).shape[1] == len(forms.reference_topology(compat.cell_name(mesh))[0]) else 2


def _cell_keys(mesh: Any) -> tuple[int, AnyArray]:
    """Number of this rank's cells, and their numbers in the input, or their global numbers in meshes made from other meshes."""
    cells = mesh.topology.index_map(mesh.topology.dim)
    n, given = cells.size_local, forms.original_cells(mesh)
    if all(mesh.comm.allgather(len(given) == n + cells.num_ghosts)):
        return n, given[:n]
    return n, np.arange(*cells.local_range, dtype=np.int64)


def numbering_of(V: Any) -> Numbering:
    """Order of a space's nodes in the files: the input order if the mesh has it (collective)."""
    mesh = V.mesh
    cells = mesh.topology.index_map(mesh.topology.dim)
    if all(mesh.comm.allgather(len(forms.original_cells(mesh)) == cells.size_local + cells.num_ghosts)):
        return node_numbering(V)
    nodes = V.dofmap.index_map
    return Numbering(mesh.comm, np.arange(*nodes.local_range, dtype=np.int64), nodes.size_global)
