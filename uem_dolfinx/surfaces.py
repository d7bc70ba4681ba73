"""Contact surfaces of a function space: the contactor's nodes and the target's facets, in the current configuration.

Second step on the data's way: tags become nodes, facets, outward normals and tributary areas, each rank for its own part.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from uem_dolfinx import compat
from uem_dolfinx.errors import OrientationError, SpaceError, SurfaceError, TagError, UEMError, agree
from uem_dolfinx.shapes import FacetShape, facet_shape, unit_normals

if TYPE_CHECKING:
    from mpi4py import MPI

    from uem_dolfinx.mesh import Tag

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

FACET_OF = {"triangle": "interval", "quadrilateral": "interval", "tetrahedron": "triangle", "hexahedron": "quadrilateral"}


class Configuration:
    """Nodes of a vector Lagrange space and where they are now: ``x = X + u``.

    Args:
        u: displacement, in a blocked Lagrange space with one component per coordinate.

    Raises:
        SpaceError: if ``u`` is not such a displacement.
    """

    def __init__(self, u: fem.Function):
        V = u.function_space
        self.u, self.V, self.mesh = u, V, V.mesh
        self.comm = V.mesh.comm
        self.gdim: int = V.mesh.geometry.dim
        self.tdim: int = V.mesh.topology.dim
        degree = compat.lagrange_degree(V)
        if self.tdim != self.gdim:
            raise SpaceError(
                f"a body of dimension {self.tdim} in {self.gdim}D space has no inside: use a mesh with gdim = {self.tdim}"
            )
        if V.dofmap.index_map_bs != self.gdim or degree is None:
            raise SpaceError(
                f"the displacement has {V.dofmap.index_map_bs} component(s) in {self.gdim}D: "
                f"use a vector Lagrange space of size {self.gdim}"
            )
        self.degree: int = degree
        if degree > 2:
            raise SpaceError(f"contact surfaces of degree {degree} are not supported: use degree 1 or 2")
        self.index_map = V.dofmap.index_map
        self.n_owned: int = self.index_map.size_local
        self.n_local: int = self.n_owned + self.index_map.num_ghosts
        # every rank takes a node's position from its owner, to the last bit
        X = fem.Function(V)
        X.x.array[:] = V.tabulate_dof_coordinates()[: self.n_local, : self.gdim].ravel()
        X.x.scatter_forward()
        self.X: Array = np.array(X.x.array.reshape(-1, self.gdim))

    @cached_property
    def bodies(self) -> tuple[Ints, int]:
        """Body of each local node ``(n_local,)``, and their number (collective)."""
        return find_bodies(self)

    @property
    def displacement(self) -> Array:
        """Displacement of the local nodes ``(n_local, gdim)``, ghosts included (a view)."""
        return self.u.x.array.reshape(-1, self.gdim)

    @property
    def x(self) -> Array:
        """Current positions of the local nodes ``(n_local, gdim)``, ghosts included."""
        return self.X + self.displacement

    def to_global(self, nodes: npt.NDArray[np.integer]) -> Ints:
        """Global block numbers of local nodes."""
        flat = np.ascontiguousarray(nodes, dtype=np.int32).ravel()
        return np.asarray(self.index_map.local_to_global(flat), dtype=np.int64).reshape(nodes.shape)

    @cached_property
    def _courier(self) -> fem.Function:
        return fem.Function(self.V)

    def from_owners(self, nodes: npt.NDArray[np.integer], values: Array, wanted: npt.NDArray[np.integer]) -> Array:
        """Values that owners have at their ``nodes (n, k)``, at local nodes ``wanted (m, k)``, ghosts or not (collective)."""
        out = np.empty((len(wanted), values.shape[1]))
        carried = self._courier.x.array.reshape(-1, self.gdim)
        for first in range(0, values.shape[1], self.gdim):
            part = values[:, first : first + self.gdim]
            carried[nodes, : part.shape[1]] = part
            self._courier.x.scatter_forward()
            out[:, first : first + self.gdim] = carried[wanted, : part.shape[1]]
        return out

    def to_owners(self, nodes: npt.NDArray[np.integer], values: Array) -> Array:
        """Sums of values at local ``nodes (m,)``, ghosts or not, at every local node ``(n_local,)`` (collective)."""
        carried = self._courier.x.array.reshape(-1, self.gdim)
        carried[:] = 0.0
        np.add.at(carried[:, 0], nodes, values)
        compat.sum_ghosts(self._courier)
        return np.array(carried[:, 0])

    @cached_property
    def _first_nodes(self) -> Ints:
        """First global node of every rank, and one past the last."""
        return np.array([*self.comm.allgather(self.index_map.local_range[0]), self.index_map.size_global], dtype=np.int64)

    def owner_of(self, nodes: npt.NDArray[np.integer]) -> Ints:
        """Ranks that own global nodes."""
        return np.searchsorted(self._first_nodes, nodes, side="right") - 1

    def tell_owners(self, nodes: Ints) -> Ints:
        """Owned local nodes that any rank names by their global number (collective)."""
        owner = self.owner_of(nodes)
        told = self.comm.alltoall([nodes[owner == r] for r in range(self.comm.size)])
        return np.unique(np.concatenate(told)) - self._first_nodes[self.comm.rank]

    def ask_owners(self, nodes: Ints, values: Array) -> Array:
        """Values ``(n_owned, k)`` of the nodes' owners at global ``nodes (m,)``: ``(m, k)`` (collective)."""
        owner = self.owner_of(nodes)
        asked = self.comm.alltoall([nodes[owner == r] for r in range(self.comm.size)])
        answers = self.comm.alltoall([values[a - self._first_nodes[self.comm.rank]] for a in asked])
        out = np.empty((len(nodes), values.shape[1]))
        for r, answer in enumerate(answers):
            out[owner == r] = answer
        return out

    @cached_property
    def size(self) -> float:
        """Diagonal of the reference bounding box of the whole model, the length that tolerances scale with."""
        lo = -np.max(-self.X, axis=0, initial=-np.inf)
        hi = np.max(self.X, axis=0, initial=-np.inf)
        bounds = np.max(self.comm.allgather(np.concatenate([-lo, hi])), axis=0)
        return float(np.linalg.norm(bounds[self.gdim :] + bounds[: self.gdim]))

    def describe(self, node: int) -> str:
        """Where a local node is, for error messages."""
        return "(" + ", ".join(f"{c:.6g}" for c in self.X[node]) + ")"


def check_tag(config: Configuration, tag: Tag, role: str) -> None:
    """Refuse tags that are not facets of this mesh, nor points of it that a contactor may be (collective)."""
    error: UEMError | None = None
    if tag.mesh is not config.mesh:
        error = SpaceError(f"{role} '{tag.name}' belongs to another mesh than the displacement: read both from one mesh")
    elif tag.dim != config.tdim - 1 and (tag.dim != 0 or role == "target"):
        points = "" if role == "target" else ", or points, dimension 0"
        error = TagError(f"{role} '{tag.name}' has dimension {tag.dim}: expected facets, dimension {config.tdim - 1}{points}")
    agree(config.comm, error)
    if config.comm.allreduce(len(tag.entities)) == 0:
        what = "facets" if tag.dim else "points"
        raise TagError(f"{role} '{tag.name}' holds no {what}: check the physical group in the gmsh model")


def surface_nodes(config: Configuration, tag: Tag) -> npt.NDArray[np.int32]:
    """Owned nodes on the closure of a tag's facets, or at its points, sorted (collective)."""
    config.mesh.topology.create_connectivity(tag.dim, config.tdim)
    nodes = fem.locate_dofs_topological(config.V, tag.dim, tag.entities, True)
    return np.unique(nodes[nodes < config.n_owned]).astype(np.int32)


def tributary_areas(config: Configuration, tag: Tag) -> Array:
    """Integral of each shape function over the reference surface, per local node; zero for points ``(n_local,)`` (collective)."""
    if tag.dim == 0:
        return np.zeros(config.n_local)
    S = compat.function_space(config.mesh, config.degree)
    v = ufl.TestFunction(S)
    b = compat.create_vector(S)
    compat.assemble_vector(b, compat.form(v * compat.surface_measure(config.mesh, tag.entities)))
    areas = np.array(b.array_r)
    b.destroy()
    return areas


@dataclass(frozen=True)
class FacetData:
    """Target facets of one rank in the current configuration.

    Attributes:
        x: node positions ``(m, nn, gdim)``.
        nodes: global block numbers ``(m, nn)``.
        nodal_normals: averaged outward normals at the nodes ``(m, nn, gdim)``.
    """

    x: Array
    nodes: Ints
    nodal_normals: Array


class TargetFacets:
    """Facets of a target surface that this rank holds, oriented outwards.

    Args:
        config: configuration of the displacement.
        tag: the target's facets.

    Raises:
        OrientationError: if a facet lies between two cells, so that outward has no meaning.
    """

    def __init__(self, config: Configuration, tag: Tag):
        self.config, self.tag = config, tag
        mesh, tdim = config.mesh, config.tdim
        fdim = tdim - 1
        mesh.topology.create_connectivity(fdim, tdim)
        mesh.topology.create_connectivity(tdim, fdim)
        f2c, c2f = mesh.topology.connectivity(fdim, tdim), mesh.topology.connectivity(tdim, fdim)
        n_cells = mesh.topology.index_map(tdim).size_local
        sides = [(c, int(np.flatnonzero(c2f.links(c) == f)[0])) for f in tag.entities for c in f2c.links(f) if c < n_cells]
        self.cells, self.sides = np.array(sides, dtype=np.int32).reshape(-1, 2).T
        self.shape: FacetShape = facet_shape(FACET_OF[compat.cell_name(mesh)], config.degree)
        cell_dofs = compat.cell_dofs(config.V)
        table = _facet_closure(config, self.shape)
        self.dofs = cell_dofs[self.cells[:, None], table[self.sides]]
        self.nodes = config.to_global(self.dofs)
        self._refuse_inner()
        self._orient(cell_dofs)
        self.open_sides = self._open_sides()
        self.open_nodes = self._open_nodes()

    @cached_property
    def keys(self) -> Ints:
        """What tells each facet from all others in any partition, its cell in the mesh's input and its side of it ``(m,)``."""
        n_sides = len(compat.reference_topology(compat.cell_name(self.config.mesh))[self.config.tdim - 1])
        return compat.original_cells(self.config.mesh)[self.cells] * n_sides + self.sides

    def _orient(self, cell_dofs: npt.NDArray[np.int32]) -> None:
        """Sign that turns the parametrisation's normal outwards, away from the cell's middle."""
        X = self.config.X
        middle = np.tile(self.shape.middle, (len(self.dofs), 1))
        tab = self.shape.tabulate(middle)
        x = X[self.dofs]
        inward = X[cell_dofs[self.cells]] - np.einsum("na,nag->ng", tab.N, x)[:, None]
        height = np.einsum("ng,nkg->nk", unit_normals(tab, x), inward)
        self.sign = np.where(height.mean(axis=1) > 0, -1.0, 1.0)
        #: How deep the cell behind each facet is, a length ``(m,)``.
        self.depth: Array = np.abs(height).max(axis=1)

    def _refuse_inner(self) -> None:
        """Raise on facets that lie between two cells, wherever those cells live."""
        corners = len(self.shape.topology[0])
        inner = np.flatnonzero(count_keys(self.config.comm, np.sort(self.nodes[:, :corners], axis=1)) > 1)
        error = None
        if len(inner):
            where = np.round(self.config.X[self.dofs[inner[0], :corners]].mean(axis=0), 6)
            error = OrientationError(
                f"target '{self.tag.name}' has a facet between two cells at {where}, where outward has no meaning: "
                "a target must lie on the outside of a body, so mesh the bodies apart"
            )
        agree(self.config.comm, error)

    def _open_sides(self) -> npt.NDArray[np.bool_]:
        """Which sides of each facet bound the surface ``(m, n_sides)``: they belong to one target facet only."""
        corners = 1 if self.shape.dim == 1 else 2
        sides = [np.sort(self.nodes[:, nodes[:corners]], axis=1) for _, nodes, _, _ in self.shape.edges()]
        keys = np.stack(sides, axis=1).reshape(-1, corners)
        return (count_keys(self.config.comm, keys) == 1).reshape(len(self.nodes), len(sides))

    def _open_nodes(self) -> npt.NDArray[np.bool_]:
        """Which nodes of each facet lie on a side that bounds the surface, also of another facet ``(m, nn)`` (collective)."""
        mark = fem.Function(self.config.V)
        marks = mark.x.array.reshape(-1, self.config.gdim)
        for s, (_, nodes, _, _) in enumerate(self.shape.edges()):
            marks[self.dofs[self.open_sides[:, s]][:, nodes].ravel()] = 1.0
        compat.sum_ghosts(mark)
        return marks[self.dofs, 0] > 0

    @cached_property
    def _normal_field(self) -> fem.Function:
        return fem.Function(self.config.V)

    @property
    def x(self) -> Array:
        """Nodes of the facets where they are now ``(m, nn, gdim)``."""
        return self.config.X[self.dofs] + self.config.displacement[self.dofs]

    def current(self) -> FacetData:
        """Facets where they are now (collective: the nodal normals are summed over ranks)."""
        gdim, x = self.config.gdim, self.x
        # every node sees its facet under the angle-free area weight
        field = self._normal_field
        field.x.array[:] = 0.0
        nodal = field.x.array.reshape(-1, gdim)
        for a in range(self.dofs.shape[1]):
            np.add.at(nodal, self.dofs[:, a], self._area_vector(x, a))
        compat.sum_ghosts(field)
        normals = nodal[self.dofs]
        length = np.linalg.norm(normals, axis=2, keepdims=True)
        return FacetData(x, self.nodes, normals / np.where(length > 0, length, 1.0))

    def _area_vector(self, x: Array, node: int) -> Array:
        """Outward normal of each facet at one of its nodes, weighted by the facet's size ``(m, gdim)``."""
        xi = np.tile(self.shape.nodes[node], (len(x), 1))
        tab = self.shape.tabulate(xi)
        t = np.einsum("naf,nag->nfg", tab.dN, x)
        n = np.stack([t[:, 0, 1], -t[:, 0, 0]], axis=1) if t.shape[1] == 1 else np.cross(t[:, 0], t[:, 1])
        return self.sign[:, None] * n


def count_keys(comm: MPI.Comm, keys: Ints) -> Ints:
    """How often each row of ``keys (n, k)`` occurs over all ranks ``(n,)`` (collective; rows meet on a home rank)."""
    home = keys[:, 0] % comm.size
    received = comm.alltoall([keys[home == r] for r in range(comm.size)])
    _, inverse, counts = np.unique(np.concatenate(received), axis=0, return_inverse=True, return_counts=True)
    ends = np.cumsum([len(k) for k in received])[:-1]
    answers = comm.alltoall(np.split(counts[inverse.ravel()], ends))
    total = np.empty(len(keys), dtype=np.int64)
    for r in range(comm.size):
        total[home == r] = answers[r]
    return total


def _facet_closure(config: Configuration, shape: FacetShape) -> npt.NDArray[np.int32]:
    """Cell dofs of each local facet, in the numbering of the facet's own element ``(n_facets, nn)``."""
    layout = config.V.dofmap.dof_layout
    topology = compat.reference_topology(compat.cell_name(config.mesh))
    rows = []
    for vertices in topology[config.tdim - 1]:
        row: list[int] = []
        for dim, entities in enumerate(shape.topology):
            for local in entities:
                wanted = sorted(vertices[v] for v in local)
                i = [sorted(e) for e in topology[dim]].index(wanted)
                row += list(layout.entity_dofs(dim, i))
        rows.append(row)
    return np.array(rows, dtype=np.int32)


def rigid_velocities(arm: Array) -> Array:
    """Velocities of points at ``arm (n, gdim)`` from a pole in the modes of a rigid body ``(n, n_modes, gdim)``.

    Translations first, then the linearised rotations in the planes xy, xz and yz.
    """
    n, g = arm.shape
    shifts = np.broadcast_to(np.eye(g), (n, g, g))
    turns = []
    for i in range(g):
        for j in range(i + 1, g):
            v = np.zeros_like(arm)
            v[:, i], v[:, j] = -arm[:, j], arm[:, i]
            turns.append(v)
    return np.concatenate([shifts, np.stack(turns, axis=1)], axis=1)


def find_bodies(config: Configuration) -> tuple[Ints, int]:
    """Bodies as the cells connect them: the body of each local node ``(n_local,)`` and their number (collective).

    Every rank labels its own pieces; only the list of pieces that share nodes across ranks is known to all.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    comm, cells = config.comm, compat.cell_dofs(config.V)
    pairs = np.column_stack([cells[:, :-1].ravel(), cells[:, 1:].ravel()])
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(config.n_local,) * 2)
    n_pieces, piece = connected_components(graph, directed=False)
    sizes = comm.allgather(n_pieces)
    mine = piece + sum(sizes[: comm.rank])
    label = fem.Function(config.V)
    view = label.x.array.reshape(-1, config.gdim)
    view[:, 0] = mine
    label.x.scatter_forward()
    links = np.unique(np.column_stack([mine, view[:, 0].astype(np.int64)]), axis=0)
    links = np.concatenate(comm.allgather(links))
    total = sum(sizes)
    count, body = connected_components(coo_matrix((np.ones(len(links)), links.T), shape=(total, total)), directed=False)
    return body[mine].astype(np.int64), int(count)


def followed_nodes(config: Configuration, targets: list[TargetFacets]) -> npt.NDArray[np.bool_]:
    """Which local nodes lie on any of the targets ``(n_local,)`` (collective)."""
    mark = fem.Function(config.V)
    for target in targets:
        mark.x.array.reshape(-1, config.gdim)[target.dofs.ravel()] = 1.0
    compat.sum_ghosts(mark)
    return mark.x.array.reshape(-1, config.gdim)[:, 0] > 0


def check_distinct(config: Configuration, contactor: npt.NDArray[np.int32], target: TargetFacets, names: tuple[str, str]) -> None:
    """Refuse a contactor that is part of its own target (collective).

    Raises:
        SurfaceError: naming the first shared node.
    """
    shared = contactor[followed_nodes(config, [target])[contactor]]
    error = None
    if len(shared):
        error = SurfaceError(
            f"contactor '{names[0]}' and target '{names[1]}' share the node at {config.describe(int(shared[0]))}: "
            "give each body its own nodes and its own surface"
        )
    agree(config.comm, error)
