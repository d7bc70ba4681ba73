"""Joint surface of many bodies: the body of each facet, sharp edges and smooth faces between them, and the order of the bodies."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

from mpi4py import MPI

import numpy as np

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Bools, Indices, Ints, pairs_of_equals, sums_of_rows
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.bodies import connected, find_bodies
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import FacetData, TargetFacets, spread_of, unit
from uem_dolfinx.geometry.sharp import SHARP_EDGE, sharp_edges
from uem_dolfinx.geometry.surfaces import Areas, surface_nodes
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import Exchange, reduced

#: Bodies whose facets differ less in size are equally fine; of these the smaller body follows.
#: [convention; ratio of sizes; test_skin.py::test_the_finer_follows]
ALIKE_IN_SIZE = 1.5
#: Bodies whose surfaces differ less are equally large; the order of the mesh's input then determines which body follows.
#: [convention; ratio of areas; test_skin.py::test_the_smaller_of_equally_fine_bodies_follows]
ALIKE_IN_AREA = 1.1


#: Two sets of facets that never touch each other, as local nodes and this rank's facets of both.
Apart = tuple[Bools, Bools, Bools, Bools]


class Skin(TargetFacets):
    """Facets of the surfaces of many bodies (collective).

    Args:
        tag: tag of all surfaces.

    Attributes:
        n_bodies: number of bodies of the mesh.
        body_of_node: body of each local node, numbered in the order of the bodies' first cells in the mesh's input ``(n_local,)``.
        body: body of each facet ``(m,)``.
        edges: neighbours and sharpness at each side of each facet.
        size: mean length of the sides of each body's facets, 0 for a body without facets ``(n_bodies,)``.
        area: sum over each body's facets of their mean side, in 3D its square ``(n_bodies,)``.
        extent: diagonal of each body's bounding box in the reference configuration ``(n_bodies,)``.
    """

    def __init__(self, config: Configuration, tag: Tag):
        super().__init__(config, tag, "surface")
        self._spread: Array | None = None  # spread of the facets at their last positions; None if it has not been computed there
        label, self.n_bodies = find_bodies(config)
        first = np.full(self.n_bodies, np.iinfo(np.int64).max)
        cells = compat.cell_dofs(config.V)
        np.minimum.at(first, label[cells[:, 0]], forms.original_cells(config.mesh)[: len(cells)])
        number = np.empty(self.n_bodies, np.int64)
        number[np.argsort(reduced(config.comm, first, op=MPI.MIN))] = np.arange(self.n_bodies)
        self.body_of_node: Ints = number[label]
        self.body: Ints = self.body_of_node[self.dofs[:, 0]]
        self.radius: Array = 0.5 * self._sides().max(axis=1, initial=0.0)  # half of the longest side of each facet ``(m,)``
        sums, side = np.zeros((self.n_bodies, 3)), self._sides().mean(axis=1)
        np.add.at(sums, self.body, np.column_stack([side, side ** (config.gdim - 1), np.ones(len(self.body))]))
        side_sum, self.area, count = reduced(config.comm, sums).T
        self.size: Array = side_sum / np.maximum(count, 1.0)
        g, ends = config.gdim, np.full((self.n_bodies, 2 * config.gdim), -np.inf)
        np.maximum.at(ends, self.body_of_node, np.column_stack([config.X, -config.X]))
        ends = reduced(config.comm, ends, op=MPI.MAX)
        self.extent: Array = np.linalg.norm(ends[:, :g] + ends[:, g:], axis=1)

    def _sides(self) -> Array:
        x, ends = self.config.X[self.dofs], np.array(self.shape.topology[1])
        return np.linalg.norm(x[:, ends[:, 1]] - x[:, ends[:, 0]], axis=2)

    def order(self, first: list[Tag], rigid: Bools | None = None) -> Ints:
        """Position of each body in the order; each body follows the later ones ``(n_bodies,)`` (collective).

        Edges of a small body lie on faces of a large one rather than the other way round. If the small body follows, its edge nodes
        do not follow in the opposite direction too, so that equations of its contactors form no rings.

        Args:
            first: parts of bodies that come first, in this order; the other bodies follow, finer ones first, then smaller ones.
            rigid: mask of nodes that move as rigid bodies ``(n_owned,)``, or None. Bodies with an entirely rigid surface come last:
                the equations of more than three contactors in 2D, or six in 3D, would be linearly dependent.
        """
        named = np.full(self.n_bodies, len(first))
        if rigid is not None:
            nodes = surface_nodes(self.config, self.tag)
            deformable = np.zeros(self.n_bodies, bool)
            deformable[self.body_of_node[nodes[~rigid[nodes]]]] = True
            named[~reduced(self.config.comm, deformable, op=MPI.LOR)] += 1
        for k, tag in reversed(list(enumerate(first))):
            named[self.bodies_of(tag)] = k
        with np.errstate(divide="ignore"):
            fine = np.round(np.log(self.size / self.size.max()) / np.log(ALIKE_IN_SIZE))
            small = np.round(np.log(self.area / self.area.max()) / np.log(ALIKE_IN_AREA))
        place = np.empty(self.n_bodies, np.int64)
        place[np.lexsort((np.arange(self.n_bodies), small, fine, named))] = np.arange(self.n_bodies)
        return place

    def bodies_of(self, tag: Tag) -> Bools:
        """Bodies to which a part of the mesh belongs ``(n_bodies,)`` (collective)."""
        found = np.zeros(self.n_bodies, bool)
        found[self.body_of_node[surface_nodes(self.config, tag)]] = True
        return np.asarray(reduced(self.config.comm, found, op=MPI.LOR))

    # -- sharp edges -----------------------------------------------------------------------------------------------------

    def _open_sides(self) -> Bools:
        """Sides that bound the surface or lie on a sharp convex edge ``(m, n_sides)``."""
        self.edges = sharp_edges(self)
        return (self.edges.across < 0) | self.edges.convex

    @cached_property
    def corners(self) -> Bools:
        """Owned nodes on sharp convex edges ``(n_owned,)`` (first time: collective)."""
        return self.on_sides(self.edges.convex)[: self.config.n_owned]

    @cached_property
    def _around(self) -> tuple[Ints, Ints, Exchange, Ints, Ints]:
        """Facets of one smooth face that meet at nodes on sharp edges (first time: collective).

        Returns facets and their nodes ``(k,)``, their exchange with the owners of the nodes, and pairs of received facets with
        similar reference normals; each facet also forms a pair with itself.
        """
        facet, node = np.nonzero(self.on_sides(self.edges.sharp)[self.dofs])
        exchange = Exchange.to(self.config.comm, self.config.owner_of(self.nodes[facet, node]))
        reference = unit(self._area_vectors(self.config.X[self.dofs]))[facet, node]
        there, normal = exchange.send(self.nodes[facet, node], reference)
        i, j = pairs_of_equals(there)
        alike = np.einsum("kg,kg->k", normal[i], normal[j]) > SHARP_EDGE
        return facet, node, exchange, i[alike], j[alike]

    def _of_one_face(self, vectors: Array) -> tuple[tuple[Ints, Ints], Array]:
        """Sums of ``vectors (m, nn, k)`` at nodes on sharp edges over the facets of one face: facets and nodes, and sums (collective)."""
        facet, node, exchange, i, j = self._around
        (arrived,) = exchange.send(vectors[facet, node])
        (sums,) = exchange.back(sums_of_rows(i, arrived[j], len(arrived)))
        return (facet[exchange.rows], node[exchange.rows]), sums

    def _of_one_normal(self, exchange: Exchange) -> tuple[Ints, Ints]:
        """See ``TargetFacets``; at sharp edges of one face (collective)."""
        reference = unit(self._area_vectors(self.config.X[self.dofs])).reshape(-1, self.config.gdim)
        there, sharp, normal = exchange.send(self.nodes.ravel(), self.on_sides(self.edges.sharp)[self.dofs].ravel(), reference)
        i, j = pairs_of_equals(there)
        together = ~sharp[i] | (np.einsum("kg,kg->k", normal[i], normal[j]) > SHARP_EDGE)
        return i[together], j[together]

    def _placed_at(self, x: Array) -> FacetData:
        """See ``TargetFacets``; at sharp edges, normals are averaged only over facets of one face (collective)."""
        data = super()._placed_at(x)
        normals = data.nodal_normals.copy()
        there, sums = self._of_one_face(data.area_vectors)
        normals[there] = unit(sums)
        self._spread = None
        return replace(data, nodal_normals=normals)

    def spread(self) -> Array:
        """See ``TargetFacets``; at sharp edges, only facets of one face count (collective)."""
        self.current()
        if self._spread is None:
            self._spread = super().spread()
            there, sums = self._of_one_face(self._areas_beside())
            self._spread[there] = spread_of(sums)
        return self._spread

    @cached_property
    def areas(self) -> Areas:
        """Areas of the whole surface."""
        return Areas(self.config, self.tag, self)

    def cones(self, nodes: Indices) -> Array:
        """Normals around owned nodes, now and in the reference configuration ``(n, k, 2, gdim)`` (collective).

        The first is the mean of the facets' normals, the others are the normals of the facets at the node, padded with zeros. A
        contact force in any direction between the normals is then within 60 degrees of one of them.
        """
        config, g = self.config, self.config.gdim
        normals = np.stack([self.normals(), unit(self._area_vectors(config.X[self.dofs]))], axis=2)
        there, arrived = config.send_to_owners(self.nodes.ravel(), normals.reshape(-1, 2 * g))
        order = np.argsort(there, kind="stable")
        there, arrived = there[order], arrived[order]
        place = np.arange(len(there)) - np.searchsorted(there, there)
        most = int(reduced(config.comm, int(place.max(initial=0)), op=MPI.MAX)) + 1
        cones = np.zeros((config.n_owned, most + 1, 2, g))
        cones[there, place + 1] = arrived.reshape(-1, 2, g)
        cones[:, 0] = unit(cones.sum(axis=1))
        return cones[nodes]


def names_of_bodies(parts: dict[str, Bools], n: int) -> list[str]:
    """Name of each body: the name of its part, or "body 1", "body 2", ... in the order of the mesh's input.

    Args:
        parts: for each name, the mask of bodies of this part ``(n,)``, the same on all ranks.
        n: number of bodies.

    Raises:
        SurfaceError: if a body has two names, or two bodies have one.
    """
    names: dict[int, str] = {}
    for name, part in parts.items():
        for body in np.flatnonzero(part).tolist():
            if body in names:
                raise SurfaceError(f"bodies: '{name}' and '{names[body]}' are one body: give each body one name")
            names[body] = name
    found: dict[str, int] = {}
    for body in range(n):
        name = names.setdefault(body, f"body {body + 1}")
        if (first := found.setdefault(name, body)) != body:
            raise SurfaceError(
                f"bodies: '{name}' is the name of two bodies, number {first + 1} and {body + 1} in the mesh's input: give each its own"
            )
    return [names[body] for body in range(n)]


def facets_by_class(skin: Skin, classes: Ints, count: int, which: Bools) -> list[Tag]:
    """Surfaces of some of this rank's facets ``(m,)``, one for each nonempty class of ``classes (m,)`` (collective)."""
    some = reduced(skin.config.comm, np.bincount(classes[which], minlength=count)) > 0
    return [surface_of(skin, which & (classes == k)) for k in np.flatnonzero(some)]


def surface_of(skin: Skin, which: Bools) -> Tag:
    """Some of this rank's facets ``(m,)`` as a surface."""
    return replace(skin.tag, entities=np.sort(skin.entities[which]))


def classes_of_facets(skin: Skin) -> tuple[Ints, int]:
    """A class for each facet of this rank ``(m,)``, and the number of classes (collective).

    Facets at a smooth edge belong to one class, two faces at a sharp edge to different classes. Faces get, one by one in the order
    of facet keys, the first class that no neighbouring face has. Only the list of faces that meet at sharp edges is known to all
    ranks. A face that meets itself at a sharp edge belongs to a single class nevertheless.
    """
    face, count = _faces(skin)
    first = np.full(count, np.iinfo(np.int64).max)
    np.minimum.at(first, face, skin.keys)
    first = reduced(skin.config.comm, first, op=MPI.MIN)
    facet, side = np.nonzero(skin.edges.sharp & (skin.edges.across >= 0))
    meeting = np.unique(np.column_stack([face[facet], skin.values_at(skin.edges.across[facet, side], face)]), axis=0)
    meeting = np.concatenate(skin.config.comm.allgather(meeting))
    adjacent: list[set[int]] = [set() for _ in range(count)]
    for a, b in meeting[meeting[:, 0] != meeting[:, 1]].tolist():
        adjacent[a].add(b)
    given = np.full(count, -1)
    for one in np.argsort(first).tolist():
        taken = {int(given[other]) for other in adjacent[one]}
        given[one] = next(k for k in range(count) if k not in taken)
    return given[face], int(given.max(initial=0)) + 1


def _faces(skin: Skin) -> tuple[Ints, int]:
    """The smooth face of each facet of this rank ``(m,)``, numbered equally on all ranks, and their number (collective)."""
    n, begin = len(skin.dofs), skin.first[skin.config.comm.rank]
    facet, side = np.nonzero(~skin.edges.sharp & (skin.edges.across >= 0))
    other = skin.edges.across[facet, side]
    here = (other >= begin) & (other < begin + n)

    def shared(mine: Ints) -> Ints:
        """Numbers of the pieces of neighbouring facets on their ranks."""
        return np.column_stack([mine[facet], skin.values_at(other, mine)])

    return connected(skin.config.comm, n, np.column_stack([facet[here], other[here] - begin]), shared)
