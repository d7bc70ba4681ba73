"""From a mesh file of another program to a distributed mesh with its sets as tags, by meshio."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Bools, Ints
from uem_dolfinx.errors import MeshError, MissingBackendError, MissingFileError
from uem_dolfinx.geometry.gmsh import Group, RawMesh, distributed, points_of, read_gmsh
from uem_dolfinx.geometry.tags import Tags

#: Cells of meshio: name of the cell and degree of its geometry.
MESHIO_CELLS = {
    "triangle": ("triangle", 1), "quad": ("quadrilateral", 1), "tetra": ("tetrahedron", 1), "hexahedron": ("hexahedron", 1),
    "triangle6": ("triangle", 2), "quad9": ("quadrilateral", 2), "tetra10": ("tetrahedron", 2), "hexahedron27": ("hexahedron", 2),
}  # fmt: skip

#: Vertices of what surfaces consist of.
MESHIO_VERTICES = {"vertex": 1, "line": 2, "triangle": 3, "quad": 4}


def read_mesh(path: str | Path, comm: MPI.Comm, gdim: int | None = None) -> tuple[Any, Tags]:
    """Read a mesh file and its sets (collective).

    Files of Gmsh, ``.geo`` and ``.msh``, are read as ``read_gmsh`` does, all others by meshio: Abaqus ``.inp``, Exodus ``.e`` and
    ``.exo``, ``.vtu``, Nastran ``.bdf``, XDMF and more. Sets of cells and of facets become tags by their names, and so does every value
    of whole numbers that cells have, as ``"material 2"``. A set of nodes becomes a tag of the exterior facets between them, or one of
    points where it has a node on none of these. Surfaces that Abaqus makes of sides of elements are not read.

    Args:
        path: of the file.
        comm: communicator of the mesh; rank 0 does the reading.
        gdim: geometric dimension, 2 or 3; by default that of the cells. The coordinate ``z`` is dropped in 2D.

    Returns:
        The mesh and its tags.

    Raises:
        InputTypeError: no communicator, or no path.
        MissingBackendError: meshio cannot be imported.
        MissingFileError: there is no such file.
        MeshError: meshio cannot read the file, or it has no cells that this package can use.
    """
    given.kind("path", path, isinstance(path, (str, Path)), "the path of a mesh file")
    file = Path(path).expanduser().absolute()
    if file.suffix in (".geo", ".msh"):
        return read_gmsh(path, comm, gdim)
    return distributed(comm, lambda: _read(file, gdim), path)


# ---------------------------------------------------------------------------------------------- on rank 0


def _read(path: Path, gdim: int | None) -> RawMesh:
    """The whole mesh, with its nodes numbered as far as cells have them."""
    try:
        import meshio
    except ImportError as error:
        raise MissingBackendError(f"reading {path.name} needs meshio ({error}): pip install meshio") from error
    if not path.is_file():
        raise MissingFileError(f"mesh file {path} does not exist")
    said = StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said):
            found = meshio.read(path)
    # meshio raises whatever a file that it does not understand leads to, and leaves the process where it knows no reader
    except (Exception, SystemExit) as error:
        told = " ".join(said.getvalue().split()) or str(error)
        raise MeshError(f"meshio cannot read {path}: {told}") from error
    dim = max((block.dim for block in found.cells), default=0)
    kinds = sorted({block.type for block in found.cells if block.dim == dim})
    if len(kinds) != 1 or kinds[0] not in MESHIO_CELLS:
        raise MeshError(
            f"the cells of {path} are {', '.join(kinds) or 'none'}: they must all be one kind of triangle, quadrilateral, tetrahedron or "
            "hexahedron, of order 1 or 2, with nodes in the middle of facets and cells, too (quad9, hexahedron27)"
        )
    if gdim not in (None, dim):
        raise MeshError(f"{path} has cells of dimension {dim}, not {gdim}: read it with gdim={dim}")
    cell, degree = MESHIO_CELLS[kinds[0]]
    data = np.concatenate([block.data for block in found.cells if block.dim == dim])
    nodes, cells = np.unique(data, return_inverse=True)
    points = np.zeros((len(nodes), 3))
    points[:, : found.points.shape[1]] = found.points[nodes]
    place = np.full(len(found.points), -1)
    place[nodes] = np.arange(len(nodes))
    cells = compat.gmsh_nodes(cell, cells.reshape(data.shape).astype(np.int64))
    raw = RawMesh(cell, degree, points_of(points, dim, str(path)), cells, [])
    sets = [*_sets_of_cells(found, dim, place), *_sets_of_nodes(found, dim, place, raw)]
    for number, (name, of_dim, rows) in enumerate(sets, 1):
        raw.groups.append(Group(name, number, of_dim, rows.astype(np.int64)))
    return raw


def _sets_of_cells(found: Any, dim: int, place: Ints) -> Iterator[tuple[str, int, Ints]]:
    """Names, dimensions and rows, as of ``Group``, of sets of cells and of what is on their surfaces."""
    sets: dict[str, list[Any]] = dict(found.cell_sets)
    for name, values in found.cell_data.items():
        if all(np.issubdtype(np.asarray(v).dtype, np.integer) and np.ndim(v) == 1 for v in values):
            every = np.concatenate(values)
            kinds = np.unique(every)
            # as many values as cells are numbers of cells
            for value in kinds.tolist() if len(kinds) < len(every) else ():
                sets[f"{name} {value}"] = [np.flatnonzero(np.asarray(v) == value) for v in values]
    first = np.cumsum([0, *(len(block.data) if block.dim == dim else 0 for block in found.cells)])
    for name, members in sets.items():
        rows: dict[int, list[Ints]] = {}
        for block, start, which in zip(found.cells, first, members):
            which = np.zeros(0, np.int64) if which is None else np.asarray(which, dtype=np.int64)
            if not len(which):
                continue
            if block.dim == dim:
                rows.setdefault(dim, []).append(start + which)
            else:
                # vertices come first
                vertices = np.sort(place[block.data[which, : MESHIO_VERTICES[block.type.rstrip("0123456789")]]], axis=1)
                rows.setdefault(block.dim, []).append(vertices[(vertices >= 0).all(axis=1)])
        for of_dim, parts in rows.items():
            yield name, of_dim, np.concatenate(parts)


def _sets_of_nodes(found: Any, dim: int, place: Ints, raw: RawMesh) -> Iterator[tuple[str, int, Ints]]:
    """Names, dimensions and rows, as of ``Group``, of sets of nodes: of facets if all vertices among them are on some."""
    topology = forms.reference_topology(raw.cell)
    vertices = compat.from_gmsh(raw.cell, raw.cells)[:, : len(topology[0])]
    is_vertex: Bools = np.zeros(len(raw.points), dtype=bool)
    is_vertex[vertices] = True
    for name, nodes in found.point_sets.items():
        inside: Bools = np.zeros(len(raw.points), dtype=bool)
        own = place[np.asarray(nodes, dtype=np.int64)]
        inside[own[own >= 0]] = True
        inside &= is_vertex
        sides = [vertices[:, side] for side in topology[dim - 1]]
        rows, count = np.unique(
            np.concatenate([np.sort(side[inside[side].all(axis=1)], axis=1) for side in sides]), axis=0, return_counts=True
        )
        rows = rows[count == 1]
        if len(rows) and inside.sum() == len(np.unique(rows)):
            yield name, dim - 1, rows
        else:
            yield name, 0, np.flatnonzero(inside)[:, None]
