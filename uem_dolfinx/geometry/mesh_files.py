"""Conversion of a mesh file of another program to a distributed mesh with its sets as tags."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from io import StringIO
from pathlib import Path
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Bools, Ints
from uem_dolfinx.errors import MeshError, MissingBackendError, MissingFileError
from uem_dolfinx.geometry.cuts import Group, RawMesh, cut_along
from uem_dolfinx.geometry.found import KINDS, Found, from_meshio
from uem_dolfinx.geometry.gmsh import checked, distributed, read_gmsh
from uem_dolfinx.geometry.simplices import completed
from uem_dolfinx.geometry.tags import Tags
from uem_dolfinx.log import logger

#: Cells of meshio: name of the cell and degree of its geometry.
MESHIO_CELLS = {
    "triangle": ("triangle", 1), "quad": ("quadrilateral", 1), "tetra": ("tetrahedron", 1), "hexahedron": ("hexahedron", 1),
    "triangle6": ("triangle", 2), "quad9": ("quadrilateral", 2), "tetra10": ("tetrahedron", 2), "hexahedron27": ("hexahedron", 2),
}  # fmt: skip

#: Numbers of vertices of surface entities.
MESHIO_VERTICES = {"vertex": 1, "line": 2, "triangle": 3, "quad": 4}


def read_mesh(
    path: str | Path,
    comm: MPI.Comm,
    gdim: int | None = None,
    *,
    cells: str | None = None,
    cut: str | Sequence[str] = (),
    nodes: Sequence[int] = (),
) -> tuple[Any, Tags]:
    """Read a mesh file and its sets (collective).

    Files of Gmsh, ``.geo`` and ``.msh``, are read as ``read_gmsh`` does; input files ``.inp`` of Abaqus and CalculiX with their sets and
    surfaces; all others by meshio: Exodus ``.e`` and ``.exo``, ``.vtu``, Nastran ``.bdf``, XDMF and more. Sets of cells and of facets
    become tags by their names, and so does every value of whole numbers that cells have, as ``"material 2"``. A set of nodes
    becomes a tag of exterior facets if it has all nodes of these and no others. Otherwise it becomes a tag of points with
    exactly its nodes, also in the middle of edges, faces and cells.

    Serendipity cells (``C3D20``, ``CPS8``, HEX20, QUAD8) are made complete: nodes are added in the middle of quadrilaterals and
    hexahedra, where the cells' own map takes these, so that they keep their shape.

    Args:
        path: of the file.
        comm: communicator of the mesh; rank 0 does the reading.
        gdim: geometric dimension, 2 or 3; by default that of the cells. The coordinate ``z`` is dropped in 2D.
        cells: ``"simplices"`` divides quadrilaterals into triangles, and hexahedra, prisms and pyramids into tetrahedra, of the same
            order, as meshes of several kinds of cells need; None leaves them.
        cut: names of plane surfaces inside bodies along which these are cut, see ``read_gmsh``.
        nodes: numbers of nodes in an input file that become tags of a point each, ``"node 14"``.

    Returns:
        The mesh and its tags.

    Raises:
        InputTypeError: no communicator, or no path.
        InputError: another word for ``cells``.
        MissingBackendError: meshio cannot be imported.
        MissingFileError: there is no such file.
        MeshError: the file cannot be read, or it has no cells that this package can use.
    """
    given.kind("path", path, isinstance(path, (str, Path)), "the path of a mesh file")
    listed = isinstance(nodes, Sequence) and all(isinstance(node, int) and node > 0 for node in nodes)
    given.kind("nodes", nodes, listed, "numbers of nodes, as (14, 20)")
    if cells is not None:
        cells = given.word("cells", cells, ("simplices",))
    file = Path(path).expanduser().absolute()
    if file.suffix in (".geo", ".msh") and cells is None:
        if len(nodes):
            raise MeshError(f"nodes = {nodes!r} of {path}: expected an input file .inp, or physical points in Gmsh; leave it out")
        return read_gmsh(path, comm, gdim, cut=cut)
    return distributed(comm, lambda: cut_along(_read(file, gdim, cells is not None, nodes), cut), path)


# ---------------------------------------------------------------------------------------------- on rank 0


def _read(path: Path, gdim: int | None, simplices: bool, nodes: Sequence[int]) -> RawMesh:
    """The whole mesh of a file."""
    if path.suffix == ".geo":
        raise MeshError(f"cells = 'simplices' is for meshes, and {path} is not meshed: leave it out, and recombine nothing")
    if not path.is_file():
        raise MissingFileError(f"mesh file {path} does not exist")
    return raw_of(_found(path, nodes), path, gdim, simplices)


def raw_of(found: Found, path: Path, gdim: int | None = None, simplices: bool = False) -> RawMesh:
    """The whole mesh of the contents of a file, with numbers for all nodes that belong to cells."""
    found, added = completed(found)
    if added:
        logger.info(
            "%s: serendipity cells are made complete by %d nodes in the middle of quadrilaterals and hexahedra", path, added
        )
    if simplices:
        from uem_dolfinx.geometry.simplices import divided

        found, before = divided(found, str(path))
        counts = ", ".join(f"{n} {kind}" for kind, n in before.items())
        logger.info("%s: %s are divided into %d simplices", path, counts, sum(len(block.data) for block in found.bodies))
    dim, kinds = found.dim, sorted({block.type for block in found.bodies})
    if len(kinds) != 1 or kinds[0] not in MESHIO_CELLS:
        remedy = (
            "; read it with cells='simplices', which divides them" if {block.base for block in found.bodies} <= set(KINDS) else ""
        )
        raise MeshError(
            f"the cells of {path} are {', '.join(kinds) or 'none'}: they must all be one kind of triangle, quadrilateral, tetrahedron or "
            f"hexahedron, of order 1 or 2{remedy if kinds else ''}"
        )
    if gdim not in (None, dim):
        raise MeshError(f"{path} has cells of dimension {dim}, not {gdim}: read it with gdim={dim}")
    cell, degree = MESHIO_CELLS[kinds[0]]
    data = np.concatenate([block.data for block in found.bodies])
    nodes, numbered = np.unique(data, return_inverse=True)
    points = np.zeros((len(nodes), 3))
    points[:, : found.points.shape[1]] = found.points[nodes]
    place = np.full(len(found.points), -1)
    place[nodes] = np.arange(len(nodes))
    numbered = compat.gmsh_nodes(cell, numbered.reshape(data.shape).astype(np.int64))
    known = [block.numbers for block in found.bodies if block.numbers is not None]
    numbers = np.concatenate(known) if len(known) == len(found.bodies) else None
    raw = checked(cell, degree, points, numbered, str(path), numbers)
    sets = [
        *_sets_of_cells(found, place),
        *_surfaces(found, place),
        *_sets_of_nodes(found, place, raw, nodes < len(found.points) - added),
    ]
    raw.groups.extend(replace(group, number=number) for number, group in enumerate(sets, 1))
    return replace(raw, of_file=nodes)


def _found(path: Path, nodes: Sequence[int]) -> Found:
    """Content of the file, with ``nodes`` as sets of their own."""
    if path.suffix.lower() == ".inp":
        from uem_dolfinx.geometry.decks import read_found

        return read_found(path, nodes)
    if len(nodes):
        raise MeshError(f"nodes = {nodes!r}: only input files .inp of Abaqus and CalculiX number their nodes; leave it out")
    try:
        import meshio
    except ImportError as error:
        raise MissingBackendError(f"reading {path.name} needs meshio ({error}): pip install meshio") from error
    said = StringIO()
    try:
        with redirect_stdout(said), redirect_stderr(said):
            return from_meshio(meshio.read(path), path.suffix == ".msh")
    # for files that it cannot read, meshio raises various exceptions, or SystemExit without a reader
    except (Exception, SystemExit) as error:
        reason = " ".join(said.getvalue().split()) or str(error)
        raise MeshError(f"meshio cannot read {path}: {reason}") from error


def _sets_of_cells(found: Found, place: Ints) -> Iterator[Group]:
    """Sets of cells and of surface entities, without their numbers."""
    sets, dim = dict(found.cell_sets), found.dim
    for name, values in found.cell_data.items():
        for value in np.unique(np.concatenate(values)).tolist():
            sets[f"{name} {value}"] = [np.flatnonzero(v == value) for v in values]
    first = np.cumsum([0, *(len(block.data) if block.dim == dim else 0 for block in found.cells)])
    for name, members in sets.items():
        rows: dict[int, list[Ints]] = {}
        for block, start, which in zip(found.cells, first, members):
            if not len(which):
                continue
            if block.dim == dim:
                rows.setdefault(dim, []).append(start + which)
            else:
                # vertices come first
                rows.setdefault(block.dim, []).append(_in_bodies(block.data[which, : MESHIO_VERTICES[block.base]], place))
        for of_dim, parts in rows.items():
            yield Group(name, 0, of_dim, np.concatenate(parts))


def _in_bodies(rows: Ints, place: Ints) -> Ints:
    """Entities by the indices of their vertices, ascending, without entities off the cells."""
    vertices = np.sort(place[rows], axis=1)
    return vertices[(vertices >= 0).all(axis=1)]


def _surfaces(found: Found, place: Ints) -> Iterator[Group]:
    """Surfaces given by sides of cells."""
    for name, sides in found.sides.items():
        parts = [_in_bodies(rows, place) for rows in sides]
        yield Group(name, 0, found.dim - 1, np.concatenate(parts) if parts else np.zeros((0, found.dim), np.int64))


def _sets_of_nodes(found: Found, place: Ints, raw: RawMesh, of_file: Bools) -> Iterator[Group]:
    """Sets of nodes.

    A set becomes a set of facets if all its nodes lie on exterior facets with all nodes in the set, otherwise a set of points. This
    criterion ignores nodes added to serendipity cells: ``of_file`` are all other nodes.
    """
    nodes, topology = compat.from_gmsh(raw.cell, raw.cells), forms.reference_topology(raw.cell)
    # of every facet its vertices first
    of_side = forms.create_lagrange_element(raw.cell, raw.degree).entity_closure_dofs[-2]
    is_vertex: Bools = np.zeros(len(raw.points), dtype=bool)
    is_vertex[nodes[:, : len(topology[0])]] = True
    for name, members in found.point_sets.items():
        inside: Bools = np.zeros(len(raw.points), dtype=bool)
        own = place[members]
        inside[own[own >= 0]] = True
        sides = np.concatenate([nodes[inside[nodes[:, side]].all(axis=1)][:, side] for side in of_side])
        corners = np.sort(sides[:, : len(topology[-2][0])], axis=1)
        rows, first, count = np.unique(corners, axis=0, return_index=True, return_counts=True)
        off = inside & of_file
        off[sides[first[count == 1]]] = False
        if (count == 1).any() and not off.any() and name not in found.as_points:
            yield Group(name, 0, found.dim - 1, rows[count == 1])
        else:
            yield Group(name, 0, 0, np.flatnonzero(inside & is_vertex)[:, None], np.flatnonzero(inside & ~is_vertex))
