"""From a Gmsh model or file to a distributed mesh with its physical groups as tags."""

from __future__ import annotations

import re
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Array, Indices, Ints
from uem_dolfinx.errors import MeshError, MissingBackendError, MissingFileError
from uem_dolfinx.geometry.cells import check_edges, check_nodes, check_volumes
from uem_dolfinx.geometry.cuts import Group, RawMesh, cut_along
from uem_dolfinx.geometry.tags import Tag, Tags
from uem_dolfinx.log import logger, timed
from uem_dolfinx.parallel import agreed

if TYPE_CHECKING:
    from uem_dolfinx.geometry.mesh_sizes import MeshSizes

CELLS = {
    2: ("triangle", 1), 3: ("quadrilateral", 1), 4: ("tetrahedron", 1), 5: ("hexahedron", 1),
    9: ("triangle", 2), 10: ("quadrilateral", 2), 11: ("tetrahedron", 2), 12: ("hexahedron", 2),
}  # fmt: skip
"""Gmsh's element types that make a body: name of the cell and degree of its geometry."""

N_VERTICES = {1: 2, 2: 3, 3: 4, 4: 4, 5: 8, 8: 2, 9: 3, 10: 4, 11: 4, 12: 8, 15: 1}
"""Vertices of Gmsh's element types, which always come first among an element's nodes."""

#: Files that a .geo file names relative to its own folder.
INCLUDED = r'\b((?:Include|Merge|ShapeFromFile)\s*\(?\s*)"([^"\n]+)"'

#: A 2D body whose z varies by less than this is plane.
#: [convention; size of the model; test_gmsh.py::test_how_plane_a_body_must_be]
FLAT = 1e-10


#: Where the parametric files of the demos are, which come with the package.
EXAMPLES = Path(__file__).resolve().parent.parent / "meshes"


def example_mesh(name: str) -> Path:
    """Path of a parametric Gmsh file of the demos, for ``read_gmsh``.

    Args:
        name: without ending, as ``"hertz_cylinder"``.

    Raises:
        InputError, InputTypeError: for another name, with all valid names.
    """
    return EXAMPLES / f"{given.word('name', name, sorted(path.stem for path in EXAMPLES.glob('*.geo')))}.geo"


def read_gmsh(
    source: Any,
    comm: MPI.Comm,
    gdim: int | None = None,
    parameters: Mapping[str, float] | None = None,
    size: MeshSizes | None = None,
    *,
    cut: str | Sequence[str] = (),
) -> tuple[Any, Tags]:
    """Read a mesh and its physical groups from Gmsh (collective).

    A ``.geo`` file is meshed; its ``DefineConstant`` values can be set from here. Cells come from the physical groups
    of dimension ``gdim``, or are all the cells of that dimension where there is no such group. Groups may overlap, and
    may be of any dimension.

    Args:
        source: path of a ``.geo`` or ``.msh`` file, or the live ``gmsh.model`` (meshed; rank 0 only, anything elsewhere).
        comm: communicator of the mesh; rank 0 does the reading.
        gdim: geometric dimension, 2 or 3; by default that of the model. The coordinate ``z`` is dropped in 2D.
        parameters: numbers for the ``.geo`` file's ``DefineConstant``.
        size: sizes of cells instead of those of the ``.geo`` file, as ``adapt`` passes them to its ``make``; None keeps the file's.
        cut: name of a plane group of facets that divides a body, or several. Nodes are doubled there, the group is one face, and
            ``"name back"`` is the other one, as a section of a bolt needs.

    Returns:
        The mesh and its tags.

    Raises:
        InputError, InputTypeError: no communicator, or parameters that are no numbers by name.
        MissingBackendError: Gmsh cannot be imported.
        MissingFileError: there is no such file.
        MeshError: Gmsh refuses the file, a parameter is unknown, or the model has no cells this package can use.
    """

    def read() -> RawMesh:
        known = parameters is None or isinstance(parameters, Mapping)
        given.kind("parameters", parameters, known, "numbers by name, as {'h': 0.1}, or None")
        for name, value in (parameters or {}).items():
            given.number(f"parameters[{name!r}]", value, given.Range("a finite number", lambda x: True))
        given.kind("size", size, size is None or hasattr(size, "within"), "what adapt passes to make, or None")
        return cut_along(_read(source, gdim, dict(parameters or {}), size), cut)

    return distributed(comm, read, source if isinstance(source, (str, Path)) else "gmsh model")


def distributed(comm: MPI.Comm, read: Callable[[], RawMesh], label: Any) -> tuple[Any, Tags]:
    """The mesh that rank 0 reads, on all ranks, and its groups as tags; ``label`` is for the log (collective)."""
    given.kind("comm", comm, isinstance(comm, MPI.Comm), "an MPI communicator", "as MPI.COMM_WORLD")
    with timed("read mesh"):
        raw = None
        with agreed(comm):
            if comm.rank == 0:
                raw = read()
        header = None if raw is None else (raw.cell, raw.degree, raw.points.shape[1], raw.cells.shape[1], raw.groups)
        cell, degree, gdim, nodes_per_cell, groups = comm.bcast(header, root=0)
        cells = np.empty((0, nodes_per_cell), dtype=np.int64) if raw is None else raw.cells
        points = np.empty((0, gdim)) if raw is None else raw.points
        mesh = compat.create_mesh(comm, cells, points, cell, degree)
        tags = [Tag(g.name, g.number, g.dim, mesh, _local_entities(mesh, g), _insides(mesh, cell, degree, g)) for g in groups]
        sizes = np.array([tag.size for tag in tags], dtype=np.int64)
        result = Tags(tags, comm.allreduce(sizes))
    logger.info("%s: %d %s cells of degree %d, %r", label, comm.allreduce(len(cells)), cell, degree, result)
    # what locating d.o.f. of tags needs, and newer DOLFINx no longer builds by itself
    tdim = mesh.topology.dim
    for dim in sorted({tdim - 1, *(group.dim for group in groups)} - {tdim}):
        mesh.topology.create_connectivity(dim, tdim)
    return mesh, result


# ---------------------------------------------------------------------------------------------- on rank 0


def _read(source: Any, gdim: int | None, parameters: dict[str, float], size: MeshSizes | None = None) -> RawMesh:
    """Read a file or a live model; Gmsh is left as it was found."""
    if gdim not in (None, 2, 3):
        raise MeshError(f"gdim is {gdim!r}: a body is of dimension 2 or 3")
    if source is None:
        raise MeshError("the source is None on rank 0: give the path of a .geo or .msh file, or gmsh.model")
    gmsh = import_gmsh()
    if not isinstance(source, (str, Path)):
        if parameters or size is not None:
            raise MeshError("parameters and sizes belong to a .geo file: a live gmsh.model is already built")
        if not compat.gmsh_is_initialized(gmsh):
            raise MeshError("gmsh is not initialised on rank 0: call gmsh.initialize() and build the model first")
        return _extract(source, gdim, "the live gmsh.model")
    path = Path(source).expanduser().absolute()
    if path.suffix not in (".geo", ".msh"):
        raise MeshError(f"{source} is neither a .geo nor a .msh file: uem.read_mesh reads files of other programs")
    if not path.is_file():
        raise MissingFileError(f"mesh file {source} does not exist (looked for {path})")
    if path.suffix == ".msh" and (parameters or size is not None):
        what = ", ".join([*parameters, *(["size"] if size is not None else [])])
        raise MeshError(f"{source} is already meshed and takes no parameters ({what}): read a .geo file")
    known = _constants(path) if parameters else []
    for name, value in parameters.items():
        if name not in known:
            raise MeshError(f"{source} has no constant {name!r}: DefineConstant declares {', '.join(known) or 'nothing'}")
        if not np.isfinite(value):
            raise MeshError(f"parameter {name!r} of {source} is {value!r}: give a finite number")
    return _open(gmsh, path, gdim, parameters, size)


def _constants(path: Path) -> list[str]:
    """Names that DefineConstant declares in a .geo file and the files it includes."""
    text = re.sub(r"//[^\n]*", "", re.sub(r"/\*.*?\*/", "", path.read_text(errors="replace"), flags=re.S))
    names: list[str] = []
    for block in re.findall(r"DefineConstant\s*\[(.*?)\]\s*;", text, flags=re.S):
        block = re.sub(r'"[^"]*"', "", block)
        while "{" in block and (inner := re.sub(r"\{[^{}]*\}", "", block)) != block:
            block = inner
        names += re.findall(r"(\w+)\s*=", block) or re.findall(r"\w+", block)
    for included in re.findall(r'Include\s+"([^"]+)"', text):
        if (path.parent / included).is_file():
            names += _constants(path.parent / included)
    return list(dict.fromkeys(names))


def _text(path: Path) -> str:
    """A file's text; bytes that are not UTF-8 are preserved when it is written again."""
    return path.read_text(encoding="utf-8", errors="surrogateescape")


def _included(path: Path, known: tuple[Path, ...] = ()) -> list[Path]:
    """A .geo file and the files that it includes, each as often as it is included, without recursive includes."""
    files = [path]
    for how, name in re.findall(INCLUDED, _text(path)):
        file = path.parent / name
        if how.startswith("Include") and file.is_file() and file not in (path, *known):
            files += _included(file, (path, *known))
    return files


def _whole(path: Path, folder: Path, copies: dict[Path, Path]) -> Path:
    """A copy in ``folder`` of a .geo file and of those it includes whose last lines end: Gmsh loses statements on lines that do not."""
    if path in copies:
        return copies[path]
    copies[path] = folder / f"{len(copies)} {path.name}"

    def place(found: re.Match[str]) -> str:
        file = path.parent / found[2]
        if found[1].startswith("Include") and file.is_file():
            file = _whole(file, folder, copies)
        return f'{found[1]}"{file}"'

    text = re.sub(r"\bCurrentDir(ectory)?\b", lambda _: f'"{path.parent}/"', re.sub(INCLUDED, place, _text(path)))
    copies[path].write_text(text + "\n", encoding="utf-8", errors="surrogateescape")
    return copies[path]


def _open(gmsh: Any, path: Path, gdim: int | None, parameters: dict[str, float], size: MeshSizes | None) -> RawMesh:
    """Open and mesh a file in a session of our own, or in a model of our own in the user's session."""
    with _session(gmsh) as errors, tempfile.TemporaryDirectory() as folder:
        # constants set before the file is included win over its DefineConstant, in this model only
        wrapper, source, copies = Path(folder) / f"{path.stem}.geo", path, dict[Path, Path]()
        if path.suffix == ".geo" and not all(_text(file).endswith("\n") for file in _included(path)):
            source = _whole(path, Path(folder), copies)
        lines = [f"{name} = {float(value)!r};" for name, value in parameters.items()]
        wrapper.write_text("\n".join([*lines, f'Include "{source}";', ""]))
        try:
            gmsh.open(str(wrapper if parameters else source))
            dim = gdim or (3 if gmsh.model.getDimension() == 3 else 2)
            if not errors() and not len(gmsh.model.mesh.getElements(dim)[0]):
                with nullcontext() if size is None else size.within(gmsh):
                    gmsh.model.mesh.generate(dim)
            found = errors()
        except Exception as error:  # Gmsh raises bare Exceptions
            found = [*errors(), str(error)]
        if found:
            values = ", ".join(f"{name} = {value}" for name, value in parameters.items())
            for file, copy in copies.items():
                found[0] = found[0].replace(str(copy), str(file))
            raise MeshError(f"Gmsh cannot read or mesh {path}{' with ' + values if values else ''}: {found[0]}")
        raw = _extract(gmsh.model, gdim, str(path))
        if size is not None and raw.degree == 1 and (curved := _curved(gmsh.model, dim - 1)):
            logger.info(
                "%s: straight cells along %s: estimates do not include that error: set Mesh.ElementOrder = 2",
                path,
                ", ".join(curved),
            )
        return raw


def _curved(model: Any, dim: int) -> list[str]:
    """Curved curves or surfaces of a model, by their kinds and numbers."""
    named = [(model.getType(dim, number), number) for _, number in model.getEntities(dim)]
    return [f"{kind} {number}" for kind, number in named if not kind.startswith(("Line", "Plane", "Discrete"))]


@contextmanager
def _session(gmsh: Any) -> Iterator[Callable[[], list[str]]]:
    """Work in a Gmsh session that is left as it was found; yields the errors that Gmsh has logged in it."""
    found_running = compat.gmsh_is_initialized(gmsh)
    if not found_running:
        gmsh.initialize(["gmsh"], False)
    names = ("General.Terminal", "General.AbortOnError")
    options = [(name, gmsh.option.getNumber(name)) for name in names]
    current, n_models, n_messages = gmsh.model.getCurrent(), len(gmsh.model.list()), len(gmsh.logger.get())
    # an error that aborted the parser would make it stumble over the next file, even in another session
    for name in names:
        gmsh.option.setNumber(name, 0)
    gmsh.logger.start()
    try:
        yield lambda: [m.split(":", 1)[1].strip() for m in gmsh.logger.get()[n_messages:] if m.startswith("Error")]
    finally:
        if n_messages == 0:
            gmsh.logger.stop()
        if not found_running:
            gmsh.finalize()
        else:
            if len(gmsh.model.list()) > n_models:
                gmsh.model.remove()
            gmsh.model.setCurrent(current)
            for name, value in options:
                gmsh.option.setNumber(name, value)


def _extract(model: Any, gdim: int | None, label: str) -> RawMesh:
    """Take nodes, cells and physical groups out of a meshed model."""
    groups = [(int(dim), int(number)) for dim, number in model.getPhysicalGroups()]
    dims = [dim for dim in (3, 2) if len(model.mesh.getElements(dim)[0])]
    if not dims:
        raise MeshError(f"{label} has no cells of dimension 2 or 3: mesh it first, e.g. gmsh.model.mesh.generate()")
    tdim = dims[0]
    if gdim is not None and gdim != tdim:
        raise MeshError(f"{label} has cells of dimension {tdim}, not {gdim}: read it with gdim={tdim}")
    bodies = {number: model.getEntitiesForPhysicalGroup(tdim, number) for dim, number in groups if dim == tdim}
    entities = sorted({int(e) for es in bodies.values() for e in es}) or [int(e) for _, e in model.getEntities(tdim)]
    blocks = {e: _elements(model, tdim, e) for e in entities}
    kinds = {kind for block in blocks.values() for kind in block}
    if len(kinds) != 1 or not kinds <= CELLS.keys():
        names = ", ".join(model.mesh.getElementProperties(kind)[0] for kind in sorted(kinds)) or "none"
        raise MeshError(
            f"the cells of {label} are {names}: they must all be one kind of triangle, quadrilateral, tetrahedron or "
            "hexahedron, of order 1 or 2; those of a .msh file are divided by uem.read_mesh(path, comm, cells='simplices')"
        )
    kind = kinds.pop()
    cell, degree = CELLS[kind]
    nodes_of = {e: block.get(kind, np.empty((0, 1), dtype=np.int64)) for e, block in blocks.items()}
    filled = [rows for rows in nodes_of.values() if len(rows)]
    node_tags, cells = np.unique(np.concatenate(filled), return_inverse=True)
    cells = cells.reshape(-1, filled[0].shape[1])
    first = dict(zip(entities, np.cumsum([0, *(len(nodes_of[e]) for e in entities)])))
    numbering = {e: np.arange(first[e], first[e] + len(nodes_of[e])) for e in entities}
    result = []
    for dim, number in groups:
        name = model.getPhysicalName(dim, number) or None
        members = [int(e) for e in model.getEntitiesForPhysicalGroup(dim, number)]
        if dim == tdim:
            rows = np.concatenate([np.empty(0, dtype=np.int64), *(numbering[e] for e in members)])
        else:
            rows = _vertex_rows(model, dim, members, node_tags)
        result.append(Group(name, number, dim, rows.astype(np.int64)))
    raw = checked(cell, degree, _points(model, node_tags), cells.astype(np.int64), label)
    raw.groups.extend(result)
    return raw


def _elements(model: Any, dim: int, entity: int) -> dict[int, npt.NDArray[np.int64]]:
    """Node tags of an entity's elements by element type, each of shape ``(n, n_nodes)``."""
    kinds, tags, nodes = model.mesh.getElements(dim, entity)
    return {int(k): np.asarray(n, dtype=np.int64).reshape(len(t), -1) for k, t, n in zip(kinds, tags, nodes) if len(t)}


def _vertex_rows(model: Any, dim: int, entities: list[int], node_tags: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Vertices of a group's elements as ascending input node index; elements off the bodies are left out."""
    rows = []
    for entity in entities:
        for kind, nodes in _elements(model, dim, entity).items():
            vertices = nodes[:, : N_VERTICES[kind]]
            rows.append(np.sort(np.searchsorted(node_tags, vertices[np.isin(vertices, node_tags).all(axis=1)]), axis=1))
    return np.concatenate(rows) if rows else np.empty((0, dim + 1), dtype=np.int64)


def _points(model: Any, node_tags: npt.NDArray[np.int64]) -> npt.NDArray[np.float64]:
    """Coordinates of the nodes used, shape ``(n_nodes, 3)``."""
    tags, x, _ = model.mesh.getNodes()
    order = np.argsort(tags)
    return np.asarray(x).reshape(-1, 3)[order][np.searchsorted(np.asarray(tags)[order], node_tags)]


def checked(cell: str, degree: int, points: Array, cells: Ints, label: str, numbers: Ints | None = None) -> RawMesh:
    """The mesh of cells, still without groups.

    Args:
        cell: name of the cell.
        degree: of the geometry.
        points: places of all nodes ``(n_nodes, 3)``; those of a 2D body must be in a plane ``z = constant``.
        cells: nodes of each cell in Gmsh's order ``(n, m)``.
        label: of the file or the model, for messages.
        numbers: of the cells in the file ``(n,)``.

    Raises:
        MeshError: for cells that are none (``check_nodes``, ``check_edges``, ``check_volumes``), or a surface that is not plane.
    """
    check_nodes(cell, cells, points, label, numbers)
    tdim = len(forms.reference_topology(cell)) - 1
    if tdim == 2 and np.ptp(points[:, 2]) > FLAT * np.ptp(points[:, :2], axis=0).max():
        raise MeshError(f"{label} is a surface that leaves the plane z = constant: a 2D body must be plane")
    ordered = compat.from_gmsh(cell, cells)
    check_edges(cell, ordered, points, label, numbers)
    check_volumes(cell, degree, ordered, points, label, numbers)
    return RawMesh(cell, degree, np.ascontiguousarray(points[:, :tdim]), cells, [])


# ---------------------------------------------------------------------------------------------- on every rank


def _local_entities(mesh: Any, group: Group) -> Indices:
    """Local index of a group's entities on this rank, ghosts included, ascending."""
    topology = mesh.topology
    if group.dim == topology.dim:
        original = np.asarray(topology.original_cell_index)
        return np.flatnonzero(np.isin(original, group.rows)).astype(np.int32)
    topology.create_entities(group.dim)
    index_map = topology.index_map(group.dim)
    n_entities = index_map.size_local + index_map.num_ghosts
    if n_entities == 0 or len(group.rows) == 0:
        return np.empty(0, dtype=np.int32)
    nodes = np.asarray(mesh.geometry.input_global_indices, dtype=np.int64)[forms.vertex_nodes(mesh)]
    if group.dim == 0:
        vertices = np.arange(n_entities).reshape(-1, 1)
    else:
        topology.create_connectivity(group.dim, 0)
        vertices = np.asarray(topology.connectivity(group.dim, 0).array).reshape(n_entities, -1)
    if vertices.shape[1] != group.rows.shape[1]:
        return np.empty(0, dtype=np.int32)
    near = np.flatnonzero(np.isin(nodes, group.rows)[vertices].all(axis=1))
    rows = np.sort(nodes[vertices[near]], axis=1)
    number = np.unique(np.concatenate([group.rows, rows]), axis=0, return_inverse=True)[1].reshape(-1)
    return near[np.isin(number[len(group.rows) :], number[: len(group.rows)])].astype(np.int32)


def _insides(mesh: Any, cell: str, degree: int, group: Group) -> tuple[Indices, ...]:
    """Local edges, faces and cells, ghosts included, in whose middle a set of nodes has one; nothing of groups without any."""
    if not len(group.middles):
        return ()
    topology, tdim = mesh.topology, mesh.topology.dim
    listed = np.isin(np.asarray(mesh.geometry.input_global_indices)[compat.geometry_dofs(mesh)], group.middles)
    found = []
    for dim, inner in enumerate(forms.create_lagrange_element(cell, degree).entity_dofs[1:], 1):
        topology.create_entities(dim)
        topology.create_connectivity(tdim, dim)
        entities = np.arange(len(listed), dtype=np.int32)[:, None]
        if dim < tdim:
            entities = compat.cell_table(topology.connectivity(tdim, dim), len(inner))
        rows = [entities[listed[:, nodes].all(axis=1), i] for i, nodes in enumerate(inner) if nodes]
        found.append(np.unique(np.concatenate([*rows, entities[:0, 0]])))
    return tuple(found)


def import_gmsh() -> Any:
    """Gmsh's Python module; raises MissingBackendError if it cannot be imported."""
    try:
        import gmsh
    except (ImportError, OSError) as error:
        raise MissingBackendError(
            f"Reading a Gmsh model needs Gmsh's Python module ({error}): install the package python3-gmsh, "
            "or the PyPI package gmsh."
        ) from error
    return gmsh
