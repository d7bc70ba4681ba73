"""Facets of a surface in the current configuration, oriented outwards, distributed over the ranks."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import AnyArray, Array, Bools, Indices, Ints, pairs_of_equals, sums_of_rows
from uem_dolfinx.errors import OrientationError, SurfaceError
from uem_dolfinx.geometry.cells import FLAT_CELL
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import described
from uem_dolfinx.geometry.shapes import FacetShape, area_vectors, facet_shape, nodal_area_slopes, nodal_area_vectors, unit_normals
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import Exchange, agree, count_keys, gathered, reduced

FACET_OF = {"triangle": "interval", "quadrilateral": "interval", "tetrahedron": "triangle", "hexahedron": "quadrilateral"}


@dataclass(frozen=True)
class FacetData:
    """Target facets of one rank in the current configuration."""

    x: Array  # current positions of their nodes ``(m, nn, gdim)``
    nodes: Ints  # global block numbers of the nodes ``(m, nn)``
    area_vectors: Array  # outward, with the facet's area as length, at the nodes ``(m, nn, gdim)``
    nodal_normals: Array  # averaged outward unit normals there ``(m, nn, gdim)``
    #: sums of the outward unit normals of the facets around each corner, weighted with the angle of the facet
    #: there ``(m, n_corners, gdim)``. If the closest point is a corner, they decide whether the point is outside (Baerentzen
    #: and Aanaes, 2005, doi:10.1109/TVCG.2005.49). None if they have not been computed.
    corner_normals: Array | None = None


class TargetFacets:
    """Facets of a surface on this rank, oriented outwards (collective).

    Args:
        role: of the surface, for messages.

    Raises:
        OrientationError: if a facet lies between two cells, so that the outward direction is undefined.
        SurfaceError: if a facet is degenerate, so that it has no normal.
    """

    _placed: FacetData | None = None  # the facets at their last positions; None before the first call of ``current``

    def __init__(self, config: Configuration, tag: Tag, role: str = "target"):
        self.config, self.tag, self.role = config, tag, role
        cell_dofs, of = compat.cell_dofs(config.V), nodes_of_facets(config, tag)
        self.cells, self.sides, self.dofs = of.cells, of.sides, of.dofs
        self.shape: FacetShape = _shape_of(config)
        self.nodes = config.to_global(self.dofs)
        self._refuse_inner()
        self.entities: Indices = tag.entities[of.own]  # local numbers of the facets in the mesh ``(m,)``
        self._orient(cell_dofs)
        self.open_sides = self._open_sides()
        #: Nodes of each facet on a side, of any facet, that bounds the surface ``(m, nn)``.
        self.open_nodes = self.on_sides(self.open_sides)[self.dofs]

    @cached_property
    def keys(self) -> Ints:
        """Key of each facet, independent of the partition: from its cell in the mesh's input and its side of the cell ``(m,)``."""
        n_sides = len(forms.reference_topology(compat.cell_name(self.config.mesh))[self.config.tdim - 1])
        return forms.original_cells(self.config.mesh)[self.cells] * n_sides + self.sides

    @cached_property
    def first(self) -> Ints:
        """Number over all ranks of the first facet of each rank, and one past the last (first time: collective)."""
        return np.append(0, np.cumsum(gathered(self.config.comm, len(self.dofs))))

    def owners(self, facet: Ints) -> Exchange:
        """Exchange with the ranks that hold the facets numbered ``facet (n,)``; -1 is no facet (collective)."""
        return Exchange.to(self.config.comm, np.searchsorted(self.first, facet, side="right") - 1)

    def values_at(self, facet: Ints, values: AnyArray) -> Any:
        """Values ``(m, ...)`` of ranks' own facets at the facets numbered ``facet (n,)``: ``(n, ...)``, -1 for -1 (collective)."""
        exchange = self.owners(facet)
        (received,) = exchange.send(facet)
        found = np.full((len(facet), *values.shape[1:]), -1, dtype=values.dtype)
        (found[exchange.rows],) = exchange.back(values[received - self.first[self.config.comm.rank]])
        return found

    def _orient(self, cell_dofs: Indices) -> None:
        """Find the sign that makes the parametrisation's normal point outwards, away from the cell's middle."""
        X, x = self.config.X[cell_dofs[self.cells]], self.config.X[self.dofs]
        tab = self.shape.at_middle(len(x))
        inward = X - np.einsum("na,nag->ng", tab.N, x)[:, None]
        self._refuse_flat(x, np.linalg.norm(area_vectors(tab, x), axis=1), np.linalg.norm(np.ptp(X, axis=1), axis=1))
        height = np.einsum("ng,nkg->nk", unit_normals(tab, x), inward)
        self.sign = np.where(height.mean(axis=1) > 0, -1.0, 1.0)
        self.depth: Array = np.abs(height).max(axis=1)  # depth of the cell behind each facet, a length ``(m,)``

    def _refuse_flat(self, x: Array, area: Array, size: Array) -> None:
        """SurfaceError for facets at ``x (m, nn, gdim)`` without ``area (m,)``, next to cells of these sizes ``(m,)`` (collective)."""
        flat, error = np.flatnonzero(area <= FLAT_CELL * size**self.shape.dim), None
        if len(flat):
            what = "length" if self.shape.dim == 1 else "area"
            error = SurfaceError(
                f"{self.role} '{self.tag.name}' has a facet without {what} (it is degenerate) at {described(x[flat[0]].mean(axis=0))}, "
                "where it has no normal: mend the mesh, or leave this facet out of the surface"
            )
        agree(self.config.comm, error)

    def _refuse_inner(self) -> None:
        """Raise on facets that lie between two cells, on any rank."""
        corners = len(self.shape.topology[0])
        inner = np.flatnonzero(count_keys(self.config.comm, np.sort(self.nodes[:, :corners], axis=1)) > 1)
        error = None
        if len(inner):
            where = np.round(self.config.X[self.dofs[inner[0], :corners]].mean(axis=0), 6)
            error = OrientationError(
                f"{self.role} '{self.tag.name}' has a facet between two cells at {where}, where outward has no meaning: "
                f"a {self.role} must lie on the outside of a body, so mesh the bodies apart"
            )
        agree(self.config.comm, error)

    def side_keys(self) -> Ints:
        """Key of each side of each facet, equal on both facets that share it ``(m n_sides, k)``."""
        corners = 1 if self.shape.dim == 1 else 2
        sides = [np.sort(self.nodes[:, nodes[:corners]], axis=1) for _, nodes, _, _ in self.shape.edges]
        return np.stack(sides, axis=1).reshape(-1, corners)

    def _open_sides(self) -> npt.NDArray[np.bool_]:
        """Sides of each facet that bound the surface ``(m, n_sides)``: they belong to one target facet only."""
        return (count_keys(self.config.comm, self.side_keys()) == 1).reshape(len(self.nodes), len(self.shape.edges))

    def on_sides(self, which: Bools) -> Bools:
        """Local nodes on the sides ``which (m, n_sides)`` of facets of any rank ``(n_local,)`` (collective)."""
        sides = enumerate(self.shape.edges)
        dofs = np.concatenate([self.dofs[which[:, s]][:, nodes].ravel() for s, (_, nodes, _, _) in sides])
        return self.config.to_owners(dofs, np.ones(len(dofs))) > 0

    @cached_property
    def _normal_field(self) -> fem.Function:
        return fem.Function(self.config.V)

    @property
    def x(self) -> Array:
        """Current positions of the facets' nodes ``(m, nn, gdim)``."""
        return self.config.here(self.dofs)

    def normals(self, drawn: bool = False) -> Array:
        """Outward unit normals of each facet at its nodes, current or, if ``drawn``, in the reference configuration ``(m, nn, gdim)``."""
        return unit(self._area_vectors(self.config.X[self.dofs] if drawn else self.x))

    def middles(self, x: Array) -> tuple[Array, Array]:
        """Midpoints and outward unit normals there of the facets with nodes at ``x (m, nn, gdim)``, ``(m, gdim)`` each."""
        tab = self.shape.at_middle(len(x))
        return np.einsum("na,nag->ng", tab.N, x), unit_normals(tab, x) * self.sign[:, None]

    def _area_vectors(self, x: Array) -> Array:
        """Outward area vectors at the nodes ``(m, nn, gdim)`` of facets ``x (m, nn, gdim)``; their length is the facet's area."""
        return self.sign[:, None, None] * nodal_area_vectors(self.shape, x)

    def current(self, corners: bool = False) -> FacetData:
        """Facets in the current configuration, with ``corner_normals`` if ``corners`` is True (collective).

        The result is kept while no node moves, since each placement calls this several times.
        """
        x = self.x
        if self._placed is None or reduced(self.config.comm, not np.array_equal(x, self._placed.x), op=MPI.LOR):
            self._placed = self._placed_at(x)
        if corners and self._placed.corner_normals is None:
            angles = self.shape.corner_angles(x)
            unit_vectors = unit(self._placed.area_vectors[:, : angles.shape[1]])
            self._placed = replace(self._placed, corner_normals=self._summed(angles[:, :, None] * unit_vectors))
        return self._placed

    def _placed_at(self, x: Array) -> FacetData:
        """Facets with nodes at ``x (m, nn, gdim)``; nodal normals are averages weighted with areas, without angles (collective)."""
        vectors = self._area_vectors(x)
        return FacetData(x, self.nodes, vectors, unit(self._summed(vectors)))

    def _summed(self, vectors: Array) -> Array:
        """Nodal sums over all facets of ``vectors (m, k, gdim)`` at the facets' first k nodes, returned for each facet (collective)."""
        field, dofs = self._normal_field, self.dofs[:, : vectors.shape[1]].astype(np.int64)
        nodal = field.x.array.reshape(-1, self.config.gdim)
        nodal[:] = sums_of_rows(dofs.ravel(), vectors.reshape(-1, self.config.gdim), len(nodal))
        forms.sum_ghosts(field)
        return np.asarray(nodal[dofs])

    def turning(self, facet: Ints) -> tuple[Ints, Array]:
        """Derivatives of the averaged normals at the nodes of facets ``facet (k,)``, numbered over all ranks (collective).

        Returns:
            Global nodes of the facets around each node, -1 for none ``(k, nn, p, nn)``, and derivatives by their positions
            ``(k, nn, p, nn, gdim, gdim)``.
        """
        exchange, i, j, place = self._meeting
        x, (m, nn), g = self.x, self.nodes.shape, self.config.gdim
        slopes = self.sign[:, None, None, None, None] * nodal_area_slopes(self.shape, x)
        nodes, vectors, slopes = exchange.send(
            np.repeat(self.nodes, nn, axis=0), self._area_vectors(x).reshape(m * nn, g), slopes.reshape(m * nn, nn, g, g)
        )
        sums = sums_of_rows(i, vectors[j], len(vectors))
        length, normal = np.linalg.norm(sums, axis=1), unit(sums)
        across = (np.eye(g) - normal[:, :, None] * normal[:, None]) / np.where(length > 0, length, np.inf)[:, None, None]
        most = int(reduced(self.config.comm, int(place.max(initial=0)), op=MPI.MAX)) + 1
        around, turned = np.full((len(sums), most, nn), -1), np.zeros((len(sums), most, nn, g, g))
        around[i, place], turned[i, place] = nodes[j], np.einsum("kgh,kahi->kagi", across[i], slopes[j])
        found = np.empty((m * nn, most, nn), np.int64), np.empty((m * nn, most, nn, g, g))
        found[0][exchange.rows], found[1][exchange.rows] = exchange.back(around, turned)
        around, turned = (of_all.reshape(m, nn, *of_all.shape[1:]) for of_all in found)
        return self.values_at(facet, around), self.values_at(facet, turned)

    @cached_property
    def _meeting(self) -> tuple[Exchange, Ints, Ints, Ints]:
        """Exchange of the nodes of facets with their owners, and pairs of received ones that have one normal (first time: collective).

        The third array is the place of each pair among those of its first node.
        """
        exchange = Exchange.to(self.config.comm, self.config.owner_of(self.nodes.ravel()))
        i, j = self._of_one_normal(exchange)
        order = np.argsort(i, kind="stable")
        i, j = i[order], j[order]
        return exchange, i, j, np.arange(len(i)) - np.searchsorted(i, i)

    def _of_one_normal(self, exchange: Exchange) -> tuple[Ints, Ints]:
        """Pairs of received nodes of facets whose area vectors are summed (collective)."""
        (there,) = exchange.send(self.nodes.ravel())
        return pairs_of_equals(there)

    def spread(self) -> Array:
        """Sum of the areas around each node over the length of the sum of area vectors: 1 if flat ``(m, nn)`` (collective)."""
        parts = self._areas_beside().reshape(-1, self.config.gdim + 1)
        return spread_of(np.column_stack([self.config.to_owners(self.dofs.ravel(), part) for part in parts.T])[self.dofs])

    def _areas_beside(self) -> Array:
        """Outward area vectors at the nodes, and in the last column their lengths ``(m, nn, gdim + 1)``."""
        vectors = self._area_vectors(self.x)
        return np.concatenate([vectors, np.linalg.norm(vectors, axis=2, keepdims=True)], axis=2)


class FacetNodes(NamedTuple):
    """Nodes of the facets of a surface behind which this rank owns the cell."""

    own: Bools  # whether the cell at each side of each facet is owned by this rank, in the order of sides ``(n,)``
    cells: Indices  # cells behind the facets ``(m,)``
    sides: Indices  # local number of each facet in its cell ``(m,)``
    dofs: Indices  # local nodes, in the numbering of the facet's own element ``(m, nn)``


def nodes_of_facets(config: Configuration, tag: Tag) -> FacetNodes:
    """Nodes of the facets of a surface whose cells this rank owns."""
    cells, sides = forms.cells_of_facets(config.mesh, tag.entities)
    own = cells < config.mesh.topology.index_map(config.tdim).size_local
    cells, sides = cells[own], sides[own]
    dofs = compat.cell_dofs(config.V)[cells[:, None], _facet_closure(config, _shape_of(config))[sides]]
    return FacetNodes(own, cells, sides, dofs)


def _shape_of(config: Configuration) -> FacetShape:
    return facet_shape(FACET_OF[compat.cell_name(config.mesh)], config.degree)


def facets_of(config: Configuration, tag: Tag, role: str = "target") -> TargetFacets:
    """Facets of a surface, shared by all users of the tag; arguments as for ``TargetFacets`` (collective)."""
    # facets keep a reference to their tag, so that its ``id`` remains unique
    found: TargetFacets | None = config.surfaces.get(id(tag))
    if found is None:
        config.surfaces[id(tag)] = found = TargetFacets(config, tag, role)
    return found


def heights(points: Array, facet: Ints, planes: tuple[Array, Array]) -> Array:
    """Height of ``points (k, gdim)`` over the planes of facets, ``planes`` from ``TargetFacets.middles`` ``(k,)``."""
    middle, normal = planes
    return np.asarray(np.einsum("kg,kg->k", points - middle[facet], normal[facet]))


def spread_of(sums: Array) -> Array:
    """Sums of lengths over lengths of vector sums, from sums of vectors and of lengths ``(..., gdim + 1)``; 1 for zero vectors."""
    length = np.linalg.norm(sums[..., :-1], axis=-1)
    return np.asarray(np.where(length > 0, sums[..., -1] / np.where(length > 0, length, 1.0), 1.0))


def unit(vectors: Array) -> Array:
    """Normalise the vectors ``(..., gdim)``; zero vectors remain zero."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.where(length > 0, length, 1.0))


def _facet_closure(config: Configuration, shape: FacetShape) -> Indices:
    """Cell dofs of each local facet, in the numbering of the facet's own element ``(n_facets, nn)``."""
    layout = config.V.dofmap.dof_layout
    topology = forms.reference_topology(compat.cell_name(config.mesh))
    number = [{tuple(sorted(entity)): i for i, entity in enumerate(entities)} for entities in topology]
    rows = []
    for vertices in topology[config.tdim - 1]:
        row: list[int] = []
        for dim, entities in enumerate(shape.topology):
            for local in entities:
                row += list(layout.entity_dofs(dim, number[dim][tuple(sorted(vertices[v] for v in local))]))
        rows.append(row)
    return np.array(rows, dtype=np.int32)
