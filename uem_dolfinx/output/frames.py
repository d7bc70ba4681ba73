"""Data of drawings, gathered to rank 0: vertices, facets, a field and contact forces; sections through solids, rigid surfaces."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Array, Indices, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.results import ManyContacts
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.cells import FILLED_BY
from uem_dolfinx.geometry.rigid import Motion, RigidSurface
from uem_dolfinx.geometry.tags import Part, as_tag
from uem_dolfinx.parallel import agreed
from uem_dolfinx.solve.problem import UnitedProblem

#: VTK's types of solid cells.
SOLIDS = {"tetrahedron": 10, "hexahedron": 12}


@dataclass(frozen=True)
class Shape:
    """A rigid surface where it was when a frame was taken."""

    surface: RigidSurface
    motion: Motion | None

    def height(self, points: Array) -> Array:
        """Its function of ``points (n, gdim)``, zero on the surface and negative behind it ``(n,)``."""
        X = points if self.motion is None else self.motion.back(points)
        with np.errstate(all="ignore"):
            return np.asarray(self.surface.distance(X), dtype=float)


def rigid_shapes(contacts: Sequence[Contact]) -> list[Shape]:
    """Rigid targets of contacts, each once, where they are now."""
    found = {id(c.target): c.target for c in contacts if isinstance(c.target, RigidSurface)}
    return [Shape(surface, surface.motion) for surface in found.values()]


def grid(box: Array, cells: int) -> tuple[list[Array], Array]:
    """Coordinates along each axis of a box ``(gdim, 2)``, so many cells along its longest side, and all points ``(n, gdim)``, x last."""
    sides = np.diff(box, axis=1)[:, 0]
    axes = [np.linspace(ends[0], ends[1], 2 + int(cells * side / sides.max())) for ends, side in zip(box, sides)]
    all_axes = np.meshgrid(*axes[::-1], indexing="ij")[::-1]
    return axes, np.column_stack([a.ravel() for a in all_axes])


def solid_cells(mesh: Any) -> dict[int, Ints]:
    """Owned cells by d.o.f. of the P1 space, as VTK numbers their vertices, by their type there ``{type: (n, n_vertices)}``."""
    cell = compat.cell_name(mesh)
    dofs = compat.cell_dofs(compat.function_space(mesh, 1))[: mesh.topology.index_map(3).size_local]
    return {SOLIDS[cell]: compat.vtk_nodes(cell, dofs.astype(np.int64))}


def sections(x: Array, values: Array, cells: dict[int, Ints], planes: Sequence[tuple[int, float]]) -> tuple[Array, Array]:
    """Where planes ``x[axis] = bound`` cut solid cells, by PyVista.

    Args:
        x: their vertices ``(n, 3)``.
        values: a field there ``(n,)``.
        cells: as returned by ``solid_cells``.
        planes: axis and bound of each.

    Returns:
        Triangles of the sections ``(k, 3, 3)`` and the field at their corners ``(k, 3)``.
    """
    points, found = [np.zeros((0, 3, 3))], [np.zeros((0, 3))]
    if planes and any(len(some) for some in cells.values()):
        import pyvista

        solid = pyvista.UnstructuredGrid(cells, x)
        solid.point_data["field"] = values
        for axis, bound in planes:
            normal = np.eye(3)[axis]
            cut = solid.slice(normal=normal, origin=bound * normal).triangulate()
            if cut.n_points:
                corners = cut.faces.reshape(-1, 4)[:, 1:]
                points.append(np.asarray(cut.points, dtype=float)[corners])
                found.append(np.asarray(cut.point_data["field"], dtype=float)[corners])
    return np.concatenate(points), np.concatenate(found)


#: Vertices in their order around a facet or a 2D cell, by their number.
AROUND = {2: [0, 1], 3: [0, 1, 2], 4: [0, 1, 3, 2]}


@dataclass(frozen=True)
class Pieces:
    """Coloured polygons, on rank 0: triangles of cells in 2D, surface facets in 3D."""

    faces: Ints  # vertices of each ``(n, 3)``, in 3D also ``(n, 4)``, as numbers in ``Frame.x``
    edges: Ints  # vertices around each cell of a 2D scene, closed ``(n_cells, 4 or 5)``; empty in 3D


@dataclass(frozen=True)
class Frame:
    """A state of the scene, on rank 0."""

    x: Array  # displaced vertices ``(n, gdim)``
    values: Array  # of the field there ``(n,)``
    forces: list[tuple[Array, Array, Array]]  # positions, forces and pressures of the contactors, one for each contact
    state: tuple[str, float]  # label of the state, a word and a number
    #: triangles ``(k, 3, 3)`` of sections of the bodies by the window, in 3D, and the field at their corners ``(k, 3)``.
    cuts: tuple[Array, Array]
    rigid: list[Shape]  # rigid targets at their present positions


class Gathering:
    """Collects frames of a problem (the constructor is collective).

    Args:
        field: for the colours, see ``vertex_values``.
        scale: magnification of the displacement.
        arrows: whether to collect contact forces.
        surface: facets to collect in 3D; None collects the whole surface.
        window: bounds of the visible part ``(gdim, 2)``, where bodies are cut in 3D; None cuts nothing.
        rigid: whether to collect rigid targets.
    """

    def __init__(
        self,
        problem: UnitedProblem,
        field: Any,
        scale: float,
        arrows: bool,
        surface: Part | None,
        window: Array | None,
        rigid: bool,
    ):
        self.problem, self.field, self.scale, self.arrows, self.rigid = problem, field, scale, arrows, rigid
        mesh = problem.config.mesh
        solid = problem.config.gdim == 3 and surface is None and window is not None
        #: Planes of sections, and the cells of the bodies.
        self._planes = (
            [(axis, bound) for axis, ends in enumerate(window) for bound in ends] if solid and window is not None else []
        )
        self._cells = solid_cells(mesh) if solid else {}
        faces, edges = boundary(mesh, surface) if problem.config.gdim == 3 else None, np.zeros((0, 4), np.int64)
        if faces is None:
            faces, edges = vertex_cells(mesh)
        #: Vertices of this rank that are drawn.
        self._used = np.unique(faces)
        parts = problem.comm.gather((len(self._used), np.searchsorted(self._used, faces), np.searchsorted(self._used, edges)))
        self.pieces: Pieces | None = None  # on rank 0
        if parts is not None:
            starts = np.cumsum([0, *(n for n, _, _ in parts)])
            self.pieces = Pieces(*(np.concatenate([p[k] + start for p, start in zip(parts, starts)]) for k in (1, 2)))

    def take(self, state: tuple[str, float] = ("", 0.0)) -> Frame | None:
        """The present state on rank 0, None elsewhere (collective)."""
        comm, used = self.problem.comm, self._used
        x, values = vertex_positions(self.problem, self.scale), vertex_values(self.problem, self.field)
        parts = comm.gather((x[used], values[used], *sections(x, values, self._cells, self._planes)))
        forces = [gather_contactors(contact, self.scale) for contact in self.problem.contacts] if self.arrows else []
        if parts is None:
            return None
        x, values, *cut = (np.concatenate(part) for part in zip(*parts))
        return Frame(x, values, forces, state, (cut[0], cut[1]), rigid_shapes(self.problem.contacts) if self.rigid else [])


def vertex_values(problem: UnitedProblem, field: Any) -> Array:
    """A field at the d.o.f. of the mesh's P1 space ``(n_local incl. ghosts,)`` (collective).

    Args:
        problem: the problem.
        field: None for the magnitude of the displacement, or for a scalar u; a contact or several for their pressure; a scalar Lagrange
            Function. Or any other scalar UFL expression, which is averaged over the cells around a vertex.
    """
    mesh = problem.config.mesh
    if field is None and not problem.config.moves:
        field = problem.u
    if field is None:
        moved = vertex_positions(problem, 1.0) - vertex_positions(problem, 0.0)
        return np.asarray(np.linalg.norm(moved, axis=1))
    if isinstance(field, Sequence):
        return np.asarray(sum(vertex_values(problem, contact) for contact in field))
    if isinstance(field, Contact | ManyContacts):
        contact: Any = field
        field = contact.pressure
    if isinstance(field, fem.Function) and compat.lagrange_degree(field.function_space):
        return at_vertices(field)
    return nodal_average(field, mesh)


def at_vertices(field: fem.Function) -> Array:
    """A Lagrange Function at the d.o.f. of the mesh's P1 space ``(n_local incl. ghosts, ...)`` (collective)."""
    linear = fem.Function(compat.function_space(field.function_space.mesh, 1, field.ufl_shape))
    linear.interpolate(field)
    linear.x.scatter_forward()
    return np.array(linear.x.array).reshape(-1, *field.ufl_shape)


def nodal_average(expression: Any, mesh: Any) -> Array:
    """Scalar UFL expression averaged over the cells around each d.o.f. of the mesh's P1 space ``(n_local incl. ghosts,)`` (collective)."""
    S = compat.function_space(mesh, 1)
    v, total = ufl.TestFunction(S), fem.Function(S)
    cells = fem.Function(compat.function_space(mesh, ("DG", 0)))
    forms.interpolation(cells, expression)()
    sums = []
    for weight in (cells, fem.Constant(mesh, 1.0)):
        own = forms.assemble_array(S, forms.form(weight * v * ufl.dx))
        total.x.array[: len(own)] = own
        total.x.scatter_forward()
        sums.append(np.array(total.x.array))
    return np.divide(sums[0], sums[1], out=np.zeros_like(sums[0]), where=sums[1] != 0)


def vertex_positions(problem: UnitedProblem, scale: float) -> Array:
    """Displaced positions of the d.o.f. of the mesh's P1 space ``(n_local incl. ghosts, gdim)``."""
    config = problem.config
    X = np.array(compat.function_space(config.mesh, 1).tabulate_dof_coordinates()[:, : config.gdim])
    return X + scale * at_vertices(config.functions()["displacement"]) if config.moves else X


def vertex_cells(mesh: Any) -> tuple[Ints, Ints]:
    """Owned cells by d.o.f. of the P1 space: their triangles ``(n, 3)`` and outlines ``(n_cells, n_nodes + 1)``."""
    name, owned = compat.cell_name(mesh), mesh.topology.index_map(2).size_local
    dofs = compat.cell_dofs(compat.function_space(mesh, 1))[:owned].astype(np.int64)
    around = AROUND[dofs.shape[1]]
    return np.concatenate([dofs[:, t] for t in FILLED_BY[name]]), dofs[:, [*around, around[0]]]


def boundary(mesh: Any, surface: Part | None = None) -> Ints:
    """Owned exterior facets, or those of a part, by d.o.f. of the P1 space, in order around each ``(n, n_vertices)`` (collective)."""
    return boundary_and_cells(mesh, surface)[0]


def boundary_and_cells(mesh: Any, surface: Part | None = None) -> tuple[Ints, Indices]:
    """As ``boundary``, and the cells behind the facets ``(n,)`` (collective)."""
    topology, tdim = mesh.topology, mesh.topology.dim
    topology.create_connectivity(tdim - 1, tdim)
    facets = np.asarray(exterior_facet_indices(topology))
    if surface is not None:
        facets = np.intersect1d(facets, as_tag(surface, mesh, (tdim - 1,), "surface").entities)
    corners = np.array(forms.reference_topology(compat.cell_name(mesh))[tdim - 1])
    cells, sides = forms.cells_of_facets(mesh, facets)
    dofs = compat.cell_dofs(compat.function_space(mesh, 1)).astype(np.int64)
    return np.asarray(dofs[cells[:, None], corners[sides][:, AROUND[corners.shape[1]]]]), cells


def outline(problem: UnitedProblem, scale: float = 1.0) -> Array | None:
    """Deformed boundary of the bodies in 2D: segments ``(n, 2, 2)`` on rank 0, None elsewhere (collective).

    Args:
        problem: the problem.
        scale: magnification of the displacement.

    Raises:
        InputTypeError: for an object that is no problem, or a scale that is no number.
        InputError: in 3D.
    """
    given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
    with agreed(problem.comm):
        scale = given.number("scale", scale)
        if problem.config.gdim == 3:
            raise InputError("outline: the outside of a 3D scene has no outline: expected a 2D one; draw it by plot_scene")
    parts = problem.comm.gather(vertex_positions(problem, scale)[boundary(problem.config.mesh)])
    return None if parts is None else np.concatenate(parts)


def gather_contactors(contact: Contact, scale: float) -> tuple[Array, Array, Array]:
    """Positions, displaced by ``scale`` times the displacement, forces and pressures of all contactors on rank 0 (collective)."""
    config, nodes = contact.config, contact.pair.nodes
    at = config.X[nodes] + scale * config.displacement[nodes]
    # points have no area: forces instead of pressures
    size = contact.pressures if contact.contactor.dim else contact.pair.trial.nodal
    parts = config.comm.gather((at, contact.pair.trial.force, size)) or [(at[:0], at[:0], np.zeros(0))]
    return tuple(np.concatenate(columns) for columns in zip(*parts))  # type: ignore[return-value]
