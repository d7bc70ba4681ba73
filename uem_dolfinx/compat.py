"""The only module that depends on DOLFINx versions: 0.5 (Debian 12), 0.9 (Debian 13) and 0.11 (PyPI wheel, Debian sid).

The package, its demos and its tests call DOLFINx, UFL and Gmsh through these functions wherever versions differ.
"""

from __future__ import annotations

import ctypes
import logging
import re
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

from mpi4py import MPI  # before dolfinx and petsc4py: in the PyPI wheel it loads the MPI library

import basix
import dolfinx.common
import numpy as np
import ufl
from dolfinx import cpp, fem, io, la, mesh
from petsc4py import PETSc

from uem_dolfinx.arrays import is_whole
from uem_dolfinx.compiled import forget_logging_of_ffcx, kept
from uem_dolfinx.errors import InputError, MissingBackendError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    import numpy.typing as npt

DOLFINX_VERSION: tuple[int, int] = tuple(int(part) for part in dolfinx.__version__.split(".")[:2])  # type: ignore[assignment]

if DOLFINX_VERSION < (0, 6):
    # the compiler's set-up logs every command to the root logger; newer FFCx keeps them off the terminal in the same way
    logging.getLogger().addFilter(lambda record: record.levelno > logging.INFO or "distutils" not in record.pathname)
    forget_logging_of_ffcx()

# ---------------------------------------------------------------------------------------------- backends


def has_vtx() -> bool:
    """Whether DOLFINx can write VTX files (needs ADIOS2, which Debian 12 leaves out)."""
    return hasattr(io, "VTXWriter")


# ---------------------------------------------------------------------------------------------- meshes


def create_mesh(comm: MPI.Comm, cells: npt.NDArray[np.int64], x: npt.NDArray[np.float64], cell: str, degree: int) -> Any:
    """Mesh of this rank's ``cells (n, n_nodes)``, numbers of nodes in Gmsh's order, and of its part ``x (k, gdim)`` of the nodes."""
    gdim = x.shape[1]
    cells = np.ascontiguousarray(from_gmsh(cell, cells), dtype=np.int64)
    x = np.ascontiguousarray(x, dtype=np.float64)
    if DOLFINX_VERSION < (0, 7):
        scalar = ufl.FiniteElement("Lagrange", ufl.Cell(cell, geometric_dimension=gdim), degree, variant="equispaced")
        return mesh.create_mesh(comm, cells, x, ufl.Mesh(ufl.VectorElement(scalar)))
    from basix.ufl import element as basix_element

    element = basix_element("Lagrange", cell, degree, basix.LagrangeVariant.equispaced, shape=(gdim,))
    return mesh.create_mesh(comm, cells=cells, x=x, e=ufl.Mesh(element))


def vtk_nodes(cell: str, nodes: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Nodes of cells ``(n, n_nodes)``, reordered from DOLFINx to VTK and XDMF."""
    out = np.empty_like(nodes)
    out[:, cpp.io.perm_vtk(getattr(mesh.CellType, cell), nodes.shape[1])] = nodes
    return out


def from_gmsh(cell: str, nodes: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Nodes of cells from Gmsh's order into DOLFINx's."""
    return nodes[:, cpp.io.perm_gmsh(getattr(mesh.CellType, cell), nodes.shape[1])]


def gmsh_nodes(cell: str, nodes: npt.NDArray[np.int64]) -> npt.NDArray[np.int64]:
    """Nodes of cells from VTK's order into Gmsh's."""
    kind, n = getattr(mesh.CellType, cell), nodes.shape[1]
    out = np.empty_like(nodes)
    out[:, cpp.io.perm_gmsh(kind, n)] = nodes[:, cpp.io.perm_vtk(kind, n)]
    return out


def cell_name(domain: Any) -> str:
    """UFL's name of the cells, e.g. ``"triangle"``."""
    name = domain.ufl_cell().cellname
    return str(name() if callable(name) else name)


def geometry_dofs(domain: Any) -> npt.NDArray[np.int32]:
    """Local geometry nodes of every cell in DOLFINx's order, vertices first ``(n_cells incl. ghosts, n_nodes)``."""
    geometry = domain.geometry
    dofmap = geometry.dofmaps[0] if DOLFINX_VERSION >= (0, 11) else geometry.dofmap
    return dofmap if isinstance(dofmap, np.ndarray) else cell_table(dofmap, geometry.cmap.create_dof_layout().num_dofs)


def belongs_to(meshtags: Any, domain: Any) -> bool:
    """Whether MeshTags are of a mesh, and not of another one."""
    topology = getattr(meshtags, "mesh", meshtags).topology
    return getattr(topology, "_cpp_object", topology) is getattr(domain.topology, "_cpp_object", domain.topology)


def communicator_of(meshtags: Any) -> MPI.Comm | None:
    """Communicator of the mesh of MeshTags, None if unknown."""
    return getattr(meshtags.mesh if hasattr(meshtags, "mesh") else meshtags.topology, "comm", None)


def shared_by_ranks(index_map: Any, indices: npt.NDArray[np.int32]) -> npt.NDArray[np.int32]:
    """Local indices, ghosts included, of all that any rank names by its own local index, ascending (collective)."""
    named = la.vector(index_map)
    named.array[indices] = 1.0
    named.scatter_reverse((la.InsertMode if hasattr(la, "InsertMode") else la.ScatterMode).add)
    named.scatter_forward()
    return np.flatnonzero(named.array).astype(np.int32)


# ---------------------------------------------------------------------------------------------- spaces and functions


def function_space(domain: Any, element: int | Sequence[Any], shape: Sequence[int] = ()) -> Any:
    """Space of functions on a mesh: ``function_space(mesh, 1, (2,))`` or ``function_space(mesh, ("Lagrange", 1, (2,)))``.

    Args:
        domain: the mesh.
        element: degree of a continuous Lagrange space, or ``(family, degree)`` or ``(family, degree, shape)``, as ``("DG", 0)`` or
            ``("Quadrature", 2)`` at points of integration; several in a list make a mixed space, ``[("Lagrange", 2, (2,)), 1]``.
        shape: shape of the value: ``()`` scalar, ``(2,)`` vector, ``(2, 2)`` tensor.

    Raises:
        InputError: for another element.
    """
    if isinstance(element, list) and len(element) > 1 and not isinstance(element[0], str):
        return _mixed_space(domain, [function_space(domain, part).ufl_element() for part in element])
    given = ("Lagrange", element) if is_whole(element) else element
    if (
        not isinstance(given, (tuple, list))
        or len(given) not in (2, 3)
        or not isinstance(given[0], str)
        or not is_whole(given[1])
    ):
        raise InputError(f"element = {element!r}: expected a degree, (family, degree) or (family, degree, shape)")
    if not hasattr(domain, "topology"):
        raise InputError(f"domain = {domain!r}: expected a mesh, as that of read_gmsh")
    shape = given[2] if len(given) == 3 else shape
    if not isinstance(shape, (tuple, list)) or not all(is_whole(n) and n >= 1 for n in shape):
        raise InputError(f"shape = {shape!r}: expected whole numbers, 1 or more, in brackets, as (2,)")
    try:
        if given[0] == "Quadrature":
            return quadrature_space(domain, int(given[1]), tuple(shape))
        return _space(domain, given[0], int(given[1]), tuple(shape))
    except Exception as error:  # of which class depends on the version of UFL
        raise InputError(f"element = {element!r} ({error}): expected a family and a degree of DOLFINx") from error


@kept()
def _mixed_space(domain: Any, elements: list[Any]) -> Any:
    if DOLFINX_VERSION < (0, 7):
        return space_of(domain, ufl.MixedElement(elements))
    from basix.ufl import mixed_element

    return space_of(domain, mixed_element(elements))


def space_of(domain: Any, element: Any) -> Any:
    """Space of functions of an element, by UFL or as a tuple."""
    return getattr(fem, "functionspace", fem.FunctionSpace)(domain, element)


@kept()
def _space(domain: Any, family: str, degree: int, shape: tuple[int, ...]) -> Any:
    if DOLFINX_VERSION < (0, 7) and family == "DG" and degree and cell_name(domain) in ("quadrilateral", "hexahedron"):
        # UFL would warn that it takes this one
        family = "DQ"
    if hasattr(fem, "functionspace") or shape == ():
        return space_of(domain, (family, degree, shape) if shape else (family, degree))
    if len(shape) == 1:
        return fem.VectorFunctionSpace(domain, (family, degree), dim=shape[0])
    return fem.TensorFunctionSpace(domain, (family, degree), shape=shape)


def quadrature_space(domain: Any, degree: int, shape: Sequence[int] = ()) -> Any:
    """Space of functions known at the points of :func:`forms.quadrature_rule`, in their order; ``shape`` as in ``function_space``."""
    if DOLFINX_VERSION >= (0, 7):
        from basix.ufl import quadrature_element

        return space_of(domain, quadrature_element(cell_name(domain), value_shape=tuple(shape), scheme="default", degree=degree))
    kind, more = (
        (ufl.FiniteElement, {}) if not shape else (ufl.VectorElement, {"dim": shape[0]}) if len(shape) == 1
        else (ufl.TensorElement, {"shape": tuple(shape)})
    )  # fmt: skip
    return space_of(domain, kind("Quadrature", domain.ufl_cell(), degree, quad_scheme="default", **more))


def evaluate(compiled: fem.Expression, domain: Any, cells: npt.NDArray[np.int32]) -> npt.NDArray[np.float64]:
    """Values of a compiled scalar or vector expression at its points of local ``cells (n,)``: ``(n, n_points, size)``."""
    values = compiled.eval(cells) if DOLFINX_VERSION < (0, 7) else compiled.eval(domain, cells)
    return values.reshape(len(cells), len(compiled.X()), int(np.prod(compiled.ufl_expression.ufl_shape)))


def cell_dofs(V: Any) -> npt.NDArray[np.int32]:
    """Local blocked d.o.f. of every cell ``(n_cells incl. ghosts, n_blocks)``."""
    return cell_table(V.dofmap.list, V.dofmap.dof_layout.num_dofs)


def cell_table(rows: Any, width: int) -> npt.NDArray[np.int32]:
    """Rows of so many numbers, one for each cell, from an array or an adjacency list; also where a rank has no cell."""
    return np.asarray(getattr(rows, "array", rows), dtype=np.int32).reshape(-1, width)


def is_mixed(V: Any) -> bool:
    """Whether a space is of a mixed element, whose parts are spaces of their own."""
    return bool(V.num_sub_spaces > 1 and V.dofmap.index_map_bs == 1)


def part_dofs(V: Any, i: int) -> npt.NDArray[np.int32]:
    """Local d.o.f. of a mixed space that its part i has in every cell ``(n_cells incl. ghosts, n)``, components next to each other."""
    cells, part = V.mesh.topology.index_map(V.mesh.topology.dim), V.sub(i).dofmap
    n_cells = cells.size_local + cells.num_ghosts
    rows = np.asarray(getattr(part.list, "array", part.list), dtype=np.int32)
    return rows.reshape(n_cells, -1) if n_cells else rows.reshape(0, 1)


def lagrange_degree(V: Any) -> int | None:
    """Degree of a continuous Lagrange space, None for any other."""
    family, degree = element_family(V) or ("", 0)
    return degree if family == "Lagrange" else None


def highest_degree(V: Any) -> int:
    """Degree of a continuous Lagrange space, or the highest among the parts of a mixed one; 0 for any other."""
    parts = getattr(V.ufl_element(), "sub_elements", ())
    elements = [V.ufl_element(), *(parts() if callable(parts) else parts)]
    found = [family for family in map(_family_of, elements) if family is not None]
    return max((degree for family, degree in found if family == "Lagrange"), default=0)


def element_family(V: Any) -> tuple[str, int] | None:
    """``"Lagrange"``, ``"Discontinuous Lagrange"`` or ``"Quadrature"``, and the degree; None for any other space."""
    return _family_of(V.ufl_element())


def _family_of(element: Any) -> tuple[str, int] | None:
    if callable(getattr(element, "family", None)):
        family = "Lagrange" if element.family() in ("CG", "Q", "P") else str(element.family())
        family = "Discontinuous Lagrange" if family == "DQ" else family
        return (family, int(element.degree())) if family in ("Lagrange", "Discontinuous Lagrange", "Quadrature") else None
    try:
        if element.has_custom_quadrature:
            return "Quadrature", int(element.embedded_superdegree)
        if element.element_family != basix.ElementFamily.P:
            return None
        return "Discontinuous Lagrange" if element.discontinuous else "Lagrange", int(element.degree)
    except (AttributeError, NotImplementedError, ValueError):
        return None


def petsc_vector(u: Any) -> PETSc.Vec:
    """Ghosted PETSc vector that shares its memory with ``u.x.array``."""
    return u.x.petsc_vec if hasattr(u.x, "petsc_vec") else u.vector


@contextmanager
def named_for_code(*expressions: Any) -> Iterator[None]:
    """Within this block Functions in UFL expressions and forms have names that are valid in code, into which FFCx 0.5 writes them."""
    functions = {f for e in expressions for f in ufl.algorithms.extract_coefficients(e) if isinstance(f, fem.Function)}
    names = {f: f.name for f in functions if re.search(r"\W", f.name)}
    for f, name in names.items():
        f.name = re.sub(r"\W+", "_", name)
    try:
        yield
    finally:
        for f, name in names.items():
            f.name = name


def compile_expression(expression: Any, points: npt.NDArray[np.float64]) -> fem.Expression:
    """A UFL expression compiled for its values at points ``(n, tdim)`` of the reference cell."""
    with named_for_code(expression):
        return fem.Expression(expression, points)


def interpolation_points(V: Any) -> npt.NDArray[np.float64]:
    """Points of the reference cell ``(n, tdim)`` whose values determine a Function of a Lagrange or DG space."""
    points = V.element.interpolation_points
    return np.asarray(points() if callable(points) else points)


def interpolate_compiled(u: Any, compiled: fem.Expression) -> None:
    """Interpolate an expression, compiled for the points of its space, into a Function of a Lagrange or DG space."""
    if DOLFINX_VERSION >= (0, 6) and hasattr(compiled, "_cpp_object"):
        u.interpolate(compiled)
    else:
        u._cpp_object.interpolate(compiled._cpp_object, all_cells(u.function_space.mesh))


def all_cells(domain: Any) -> npt.NDArray[np.int32]:
    """Local numbers of all cells, ghosts included."""
    cells = domain.topology.index_map(domain.topology.dim)
    return np.arange(cells.size_local + cells.num_ghosts, dtype=np.int32)


# ---------------------------------------------------------------------------------------------- forms, matrices, vectors


def petsc_option_used(name: str) -> bool | None:
    """Whether PETSc has used an option of its database; None if unknown, since petsc4py has no such function."""
    used = ctypes.c_int(0)
    try:
        ctypes.CDLL(PETSc.__file__).PetscOptionsUsed(None, name.encode(), ctypes.byref(used))
    except (OSError, AttributeError):
        return None
    return bool(used.value)


def arrays_of(A: PETSc.Mat) -> tuple[npt.NDArray[Any], npt.NDArray[Any], npt.NDArray[Any]] | None:
    """Views of PETSc's arrays of a matrix on one rank, valid while its sparsity is: row starts, columns, values; or None."""
    rows, columns, values = found = [ctypes.c_void_p() for _ in range(3)]
    if A.getType() != "seqaij":
        return None
    try:
        ask = ctypes.CDLL(PETSc.__file__).MatSeqAIJGetCSRAndMemType
    except (OSError, AttributeError):
        return None
    if ask(ctypes.c_void_p(A.handle), *map(ctypes.byref, found), None) or not all(found):
        return None

    def there(at: ctypes.c_void_p, kind: Any, n: int) -> npt.NDArray[Any]:
        return np.frombuffer((ctypes.c_char * (n * np.dtype(kind).itemsize)).from_address(at.value or 0), kind)

    starts = there(rows, PETSc.IntType, A.getSize()[0] + 1)
    return starts, there(columns, PETSc.IntType, int(starts[-1])), there(values, PETSc.ScalarType, int(starts[-1]))


def petsc_forms() -> Any:
    """``dolfinx.fem.petsc``, which is heavy on some versions."""
    import dolfinx.fem.petsc

    return dolfinx.fem.petsc


def create_vector(V: Any) -> PETSc.Vec:
    """Ghosted zero vector with the layout of a function space."""
    if DOLFINX_VERSION >= (0, 10):
        b = petsc_forms().create_vector(V)
    else:
        b = la.create_petsc_vector(V.dofmap.index_map, V.dofmap.index_map_bs)
    with b.localForm() as local:
        local.set(0.0)
    return b


def dirichletbc(value: Any, dofs: Any, V: Any) -> Any:
    """DOLFINx's Dirichlet condition of a value at d.o.f. of a space or of a part of it."""
    # DOLFINx 0.5 tries the space itself first, and prints all d.o.f. into the error that it then catches: most of the call's time
    return fem.dirichletbc(value, dofs, V._cpp_object if DOLFINX_VERSION < (0, 6) else V)


def is_dirichlet(bc: Any) -> bool:
    """Whether this is a Dirichlet condition."""
    return hasattr(bc, "dof_indices") and hasattr(bc, "function_space")


def is_condition_of(bc: Any, V: Any) -> bool:
    """Whether a Dirichlet condition belongs to a space or to a part of it, and not to a collapsed or another one."""
    return bool(V._cpp_object.contains(getattr(bc.function_space, "_cpp_object", bc.function_space)))


def is_on(V: Any, domain: Any) -> bool:
    """Whether a space, possibly of DOLFINx's C++ layer, is on a mesh."""
    topologies = [getattr(m.topology, "_cpp_object", m.topology) for m in (V.mesh, domain)]
    return topologies[0] is topologies[1]


def bc_dofs(bc: Any) -> tuple[npt.NDArray[np.int32], int]:
    """Local unrolled d.o.f. in the parent space that a Dirichlet condition constrains, ascending, ghosts last, and the number owned."""
    dofs = np.sort(np.array(bc.dof_indices()[0], dtype=np.int32))
    dofmap = bc.function_space.dofmap
    # counted here: the number that DOLFINx up to 0.9 returns takes blocked ghosts for owned
    return dofs, int(np.searchsorted(dofs, dofmap.index_map.size_local * dofmap.index_map_bs))


def set_bc_values(x: npt.NDArray[np.float64], bcs: Sequence[Any]) -> None:
    """Write Dirichlet values into a local array with ghosts at their d.o.f., ghosts included, and nowhere else."""
    if DOLFINX_VERSION < (0, 9):
        cpp.fem.set_bc(x, list(bcs), 1.0)
    else:
        for bc in bcs:
            bc.set(x, None, 1.0)


# ---------------------------------------------------------------------------------------------- files


def require_vtx(path: str | Path) -> None:
    """Raise a MissingBackendError where DOLFINx cannot write VTX files."""
    if not has_vtx():
        raise MissingBackendError(
            f"VTX output of {path} needs ADIOS2, which DOLFINx {dolfinx.__version__} was built without; write XDMF instead."
        )


def open_vtx(comm: MPI.Comm, path: str | Path, functions: Sequence[Any]) -> Any:
    """VTX writer with ``write(t)``, a context manager, for Functions of one element; refused without ADIOS2 (collective)."""
    require_vtx(path)
    return io.VTXWriter(comm, str(path), list(functions))


# ---------------------------------------------------------------------------------------------- timers


def timing(task: str) -> tuple[int, float]:
    """How often DOLFINx's timers have counted a task on this rank so far, and its wall time in seconds."""
    try:
        calls, elapsed = dolfinx.common.timing(task)[:2]
    except RuntimeError:
        return 0, 0.0
    return int(calls), float(elapsed.total_seconds() if hasattr(elapsed, "total_seconds") else elapsed)


# ---------------------------------------------------------------------------------------------- Gmsh


def gmsh_is_initialized(gmsh: Any) -> bool:
    """Whether ``gmsh.initialize`` was called and not yet finalised.

    Gmsh 4.8 has no function for it. From then to then its list of models, a C++ vector, has storage; to call Gmsh before would read
    from memory that is not set whether errors end the process.
    """
    if hasattr(gmsh, "isInitialized"):
        return bool(gmsh.isInitialized())
    return ctypes.c_void_p.in_dll(gmsh.lib, "_ZN6GModel4listE").value is not None


def gmsh_takes_closest(gmsh: Any) -> bool:
    """Whether fields of views take the closest value where a point has none, unless ``UseClosest`` is 0: 4.8 does not, 4.13 does."""
    return bool((gmsh.GMSH_API_VERSION_MAJOR, gmsh.GMSH_API_VERSION_MINOR) >= (4, 13))
