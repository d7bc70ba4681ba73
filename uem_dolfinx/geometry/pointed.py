"""Pointed edges of surfaces: convex ones at which facets turn by more than those of a coarse round surface do."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets, nodes_of_facets, unit
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.sharp import SHARP_EDGE, sharp_edges
from uem_dolfinx.geometry.surfaces import exterior_facets
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import reduced

#: Convex edges whose facets' normals have a smaller cosine are pointed; a circle of twelve chords or more has none.
#: [convention; cosine; test_corner_contact.py::test_which_edges_are_pointed]
POINTED = 0.86
#: A contactor so near to a pointed edge of its target, and to the facet, is left to the equations of the edge's nodes.
#: [convention; size of the contactor's own facets; test_corner_contact.py::test_edges_without_corner_contact]
AT_CORNER = 0.05


class PointedFacets(TargetFacets):
    """Facets of a surface that ends at its pointed edges: no contactor is held there, or follows round them."""

    def _open_sides(self) -> Bools:
        return np.asarray(super()._open_sides() | sharp_edges(self, POINTED).convex)


def pointed_sides(facets: TargetFacets) -> Bools:
    """Sides of a surface's facets on pointed edges of its body, also where the surface ends there ``(m, n_sides)`` (collective)."""
    convex, (whole, _) = sharp_edges(facets, POINTED).convex, with_outside(facets)
    if whole is facets:
        return convex
    on = whole.on_sides(sharp_edges(whole, POINTED).convex)
    ends = np.stack([on[facets.dofs[:, nodes]].all(axis=1) for _, nodes, _, _ in facets.shape.edges], axis=1)
    return np.asarray(convex | (facets.open_sides & ends))


def sizes_at(facets: TargetFacets, nodes: Indices) -> Array:
    """Mean size of the facets around owned nodes, a length ``(n,)`` (collective)."""
    config, dofs = facets.config, facets.dofs
    size = np.ptp(config.X[dofs], axis=1).max(axis=1, initial=0.0)
    sums = [config.to_owners(dofs.ravel(), np.repeat(values, dofs.shape[1]))[nodes] for values in (size, np.ones(len(size)))]
    return np.asarray(sums[0] / np.maximum(sums[1], 1.0))


def with_outside(facets: TargetFacets) -> tuple[TargetFacets, Bools]:
    """A surface with the facets of the body's outside next to its ends, and which of these are its own ``(m,)`` (collective)."""
    config = facets.config
    if not reduced(config.comm, bool(facets.open_sides.any()), op=MPI.LOR):
        return facets, np.ones(len(facets.dofs), bool)
    outside = exterior_facets(config)
    of = nodes_of_facets(config, outside)
    at_open_sides = facets.on_sides(facets.open_sides)[of.dofs].any(axis=1)
    entities = np.union1d(facets.entities, outside.entities[of.own][at_open_sides]).astype(np.int32)
    whole = TargetFacets(config, Tag(facets.tag.name, 0, config.tdim - 1, config.mesh, entities))
    return whole, np.isin(whole.entities, facets.entities)


class AtEdges:
    """Contactors at edges of a surface that are left to the nodes of the edge, which are contactors of the other surface.

    Args:
        target: of the contactors.
        sides: sides of its facets on these edges ``(m, n_sides)``.
        within: distance from an edge, a length ``(n,)``; 0 for contactors that are never left out.
    """

    def __init__(self, target: MeshTarget, sides: Bools, within: Array):
        self._target, self._sides, self._within = target, sides, within

    def __call__(self, p: FacetProjection) -> Bools:
        """Contactors that are left out ``(n,)`` (collective)."""
        return np.asarray(self._near(p, self._within).any(axis=1) & (np.abs(p.gap) <= self._within))

    def _near(self, p: FacetProjection, within: Array) -> Bools:
        """Sides of the nearest facets so near to contactors ``(n, n_sides)`` (collective)."""
        on = self._target.of_facets(p.facet, self._sides.astype(np.int64)) > 0
        away = self._target.shape.side_distances(p.xi) * p.facet_size[:, None]
        return np.asarray(on & (away <= within[:, None]) & (within > 0.0)[:, None])


class AlongEdges(AtEdges):
    """Nodes of edges that lie along an edge of the surface that they touch: its nodes follow them, as they do without.

    Args:
        target: of the nodes.
        sides: sides of its facets on edges ``(m, n_sides)``.
        part: distance from an edge, as part of the facet.
        nodes: owned nodes ``(n,)``.
        edges: pairs of local nodes that are the edges on this rank ``(k, 2)``; empty in 2D.
    """

    def __init__(self, config: Configuration, target: MeshTarget, sides: Bools, part: float, nodes: Indices, edges: Indices):
        super().__init__(target, sides, np.zeros(len(nodes)))
        self._config, self._part = config, part
        both = np.concatenate([edges, edges[:, ::-1]])
        there, other = config.send_to_owners(config.to_global(both[:, 0]), config.to_global(both[:, 1]).astype(float))
        row = np.full(config.n_owned, -1)
        row[nodes] = np.arange(len(nodes))
        #: Index of a node and the global number of the other end, for each edge at it ``(j,)``.
        self._row, self._other = row[there], other.astype(np.int64)
        self._nodes = nodes

    def __call__(self, p: FacetProjection) -> Bools:
        """Nodes that are left out ``(n,)``: in 3D those all of whose edges in the plane of the facet are along its sides (collective)."""
        config, near = self._config, self._near(p, self._part * p.facet_size)
        out: Bools = np.asarray(near.any(axis=1))
        if config.gdim == 2:
            return out
        at_ends = self._target.of_facets(p.facet, self._target.facets.open_nodes.astype(np.int64)) > 0
        at_node = (at_ends & (p.weights >= 1.0 - self._part)).any(axis=1)
        x = config.x[: config.n_owned]
        r, ends = self._row, np.array([[nodes[0], nodes[1]] for _, nodes, _, _ in self._target.shape.edges])
        along = unit(config.ask_owners(self._other, x) - x[self._nodes[r]])
        sides = unit(p.x[r][:, ends[:, 1]] - p.x[r][:, ends[:, 0]])
        parallel = (np.abs(np.einsum("kg,ksg->ks", along, sides)) > SHARP_EDGE) & near[r]
        across = ~parallel.any(axis=1) & (np.abs(np.einsum("kg,kg->k", along, p.normal[r])) < SHARP_EDGE)
        out[r[across]] = False
        return np.asarray(out | at_node)
