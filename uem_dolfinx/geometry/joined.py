"""Joint search on the surfaces of many targets, meshed or rigid, each point on its own surface."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array, Bools, Indices, Ints, pairs_of_equals, sums_of_rows
from uem_dolfinx.geometry.candidates import EQUALLY_NEAR, RankBoxes, candidate_pairs
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import FacetData, TargetFacets, spread_of
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.rigid import Motion, RigidProjection
from uem_dolfinx.geometry.search import ON_SIDE, Feet, MeshTarget
from uem_dolfinx.parallel import Exchange


class JoinedFacets(TargetFacets):
    """Facets of several surfaces, one surface after the other on each rank (collective).

    A facet of two surfaces occurs twice. Normals at nodes are averages over facets of one surface.
    """

    def __init__(self, config: Configuration, surfaces: Sequence[TargetFacets]):
        self.config, self.role, self.tag, self.shape = config, "target", surfaces[0].tag, surfaces[0].shape
        self.cells, self.sides = (np.concatenate([getattr(s, name) for s in surfaces]) for name in ("cells", "sides"))
        self.dofs, self.nodes = (np.concatenate([getattr(s, name) for s in surfaces]) for name in ("dofs", "nodes"))
        self.entities, self.sign, self.depth = (
            np.concatenate([getattr(s, name) for s in surfaces]) for name in ("entities", "sign", "depth")
        )
        self.open_sides = np.concatenate([s.open_sides for s in surfaces])
        self.open_nodes = np.concatenate([s.open_nodes for s in surfaces])
        sizes = np.array([len(s.dofs) for s in surfaces])
        self.surface: Ints = np.repeat(np.arange(len(surfaces)), sizes)  # number of the surface of each facet ``(m,)``
        every = np.empty((config.comm.size, len(surfaces)), dtype=sizes.dtype)
        config.comm.Allgather(sizes, every)
        #: First facet of every surface on every rank, and first numbers of each surface's own numbering.
        self._begin = np.cumsum(every, axis=1) - every
        self._alone = np.concatenate([np.zeros((1, len(surfaces)), int), np.cumsum(every, axis=0)])
        self._apart = self._without_common_nodes(len(surfaces))

    def _without_common_nodes(self, n: int) -> list[Bools]:
        """Facets in classes of surfaces without common nodes on any rank, ``(m,)`` each (collective)."""
        rows = np.unique(np.column_stack([self.nodes.ravel(), np.repeat(self.surface, self.nodes.shape[1])]), axis=0)
        node, surface = Exchange.to(self.config.comm, self.config.owner_of(rows[:, 0])).send(*rows.T)
        meet = np.zeros((n, n), dtype=bool)
        order = np.lexsort((surface, node))
        node, surface = node[order], surface[order]
        for step in range(1, n):
            # the number of passes is limited by the surfaces per node
            same = node[step:] == node[:-step]
            if not same.any():
                break
            meet[surface[step:][same], surface[:-step][same]] = True
        self.config.comm.Allreduce(MPI.IN_PLACE, meet, op=MPI.LOR)
        meet = (meet | meet.T) & ~np.eye(n, dtype=bool)
        number = np.zeros(n, dtype=int)
        for k in range(1, n):
            number[k] = np.setdiff1d(np.arange(n), number[:k][meet[k, :k]])[0]
        return [number[self.surface] == c for c in range(number.max(initial=0) + 1)]

    def _summed(self, vectors: Array) -> Array:
        """See ``TargetFacets``; sums over facets of one surface (collective)."""
        field, found = self._normal_field, np.empty(vectors.shape)
        nodal = field.x.array.reshape(-1, self.config.gdim)
        for own in self._apart:
            dofs = self.dofs[own, : vectors.shape[1]]
            nodal[:] = sums_of_rows(dofs.ravel().astype(np.int64), vectors[own].reshape(-1, self.config.gdim), len(nodal))
            forms.sum_ghosts(field)
            found[own] = nodal[dofs]
        return found

    def _of_one_normal(self, exchange: Exchange) -> tuple[Ints, Ints]:
        """See ``TargetFacets``; of one surface (collective)."""
        there, surface = exchange.send(self.nodes.ravel(), np.repeat(self.surface, self.nodes.shape[1]))
        return pairs_of_equals(there * self._begin.shape[1] + surface)

    def spread(self) -> Array:
        """See ``TargetFacets``; for facets of one surface (collective)."""
        parts, found = self._areas_beside(), np.empty(self.dofs.shape)
        for own in self._apart:
            rows, dofs = parts[own].reshape(-1, self.config.gdim + 1), self.dofs[own]
            found[own] = spread_of(np.column_stack([self.config.to_owners(dofs.ravel(), part) for part in rows.T])[dofs])
        return found

    def alone(self, facet: Ints, surface: int) -> Ints:
        """Numbers in a surface's own numbering of facets with joint numbers ``facet (...)``, -1 for -1."""
        return _renumbered(facet, self.first, self._begin[:, surface], self._alone[:, surface], 0 * self._begin[:, surface])

    def here(self, facet: Ints, surface: int) -> Ints:
        """Inverse of ``alone``."""
        return _renumbered(facet, self._alone[:, surface], 0 * self._begin[:, surface], self.first, self._begin[:, surface])


def _renumbered(facet: Ints, first: Ints, begin: Ints, other_first: Ints, other_begin: Ints) -> Ints:
    """Convert numbers that begin on each rank at ``first + begin`` to numbers that begin at ``other_first + other_begin``."""
    rank = np.searchsorted(first, facet, side="right") - 1
    there = np.maximum(rank, 0)
    return np.asarray(np.where(facet < 0, -1, facet - first[there] - begin[there] + other_first[there] + other_begin[there]))


class JoinedTarget(MeshTarget):
    """Targets of many contacts: each contactor is projected onto its own target (collective).

    Args:
        facets: of all targets.
        averaged: see ``MeshTarget``.
        surface: number of the surface that each contactor may touch ``(n,)``.

    Attributes:
        projected: contactors that are projected ``(n,)``; others get the projection ``nowhere``.
    """

    facets: JoinedFacets

    def __init__(self, facets: JoinedFacets, averaged: bool, surface: Ints):
        super().__init__(facets, averaged)
        self._surface, self.projected = surface, np.ones(len(surface), dtype=bool)

    def project(self, points: Array, which: Ints | None = None) -> FacetProjection:
        """Closest points of contactors on their own targets; ``nowhere`` for contactors that are skipped (collective)."""
        chosen = self.projected if which is None else self.projected[which]
        surface = (self._surface if which is None else self._surface[which])[chosen]
        nearest = self.project_onto(points[chosen], surface)
        if chosen.all():
            return nearest
        return self.nowhere(points).with_those(np.flatnonzero(chosen), nearest)

    def project_onto(self, points: Array, surface: Ints) -> FacetProjection:
        """Closest points of ``points (k, gdim)`` on the surfaces numbered ``surface (k,)`` (collective)."""
        data = self.facets.current(corners=True)
        if self.comm.size == 1:
            return self._evaluate(points, self._nearest_here(points, surface, data))
        boxes = self._boxes(data.x)
        first = boxes.nearest(points, surface)
        exchange = Exchange.to(self.comm, first)
        found = self._answers(exchange, points, surface, data)
        nearest, feet = self._nearest_foot(points, exchange.rows, found)
        bound = np.linalg.norm(points - nearest.foot, axis=1) * (1 + EQUALLY_NEAR) + ON_SIDE * self.stride
        exchange = Exchange(self.comm, boxes.near(points, bound, surface, but=first))
        more = self._answers(exchange, points, surface, data)
        rows = np.append(exchange.rows, np.arange(len(points)))
        return self._nearest_foot(points, rows, Feet._make(map(np.concatenate, zip(more, feet))))[0]

    def _answers(self, exchange: Exchange, points: Array, surface: Ints, data: FacetData) -> Feet:
        """Closest points on the facets of the ranks of an exchange, in the order of its rows (collective)."""
        p, wanted = exchange.send(points, surface)
        return Feet._make(exchange.back(*self._nearest_here(p, wanted, data)))

    def _nearest_here(self, points: Array, surface: Ints, data: FacetData) -> Feet:
        """Closest points on this rank's facets of each point's surface."""
        return self._on_nearest(points, data, *candidate_pairs(self.shape, data.x, points, surface, self.facets.surface))

    def _boxes(self, x: Array) -> RankBoxes:
        """Boxes around each rank's facets of each surface, from nodes ``(m, nn, gdim)`` (collective)."""
        kind = np.repeat(self.facets.surface, x.shape[1])
        return RankBoxes(self.comm, x.reshape(-1, x.shape[2]), 0.5 * (self.shape.lebesgue - 1), kind, self.facets._begin.shape[1])


class JoinedMotion:
    """Motions of several rigid surfaces, None if not moved, with the methods of ``Motion`` for their points, the ``rows`` of each."""

    def __init__(self, each: Sequence[Motion | None], rows: Sequence[slice]):
        self.each, self._rows = list(each), rows

    def carry(self, X: Array) -> Array:
        """See ``Motion`` ``(n, gdim)``."""
        return self._moved("carry", X)

    def back(self, x: Array) -> Array:
        """See ``Motion`` ``(n, gdim)``."""
        return self._moved("back", x)

    def turn(self, v: Array) -> Array:
        """See ``Motion`` ``(n, gdim)``."""
        return self._moved("turn", v)

    def since(self, before: JoinedMotion, part: float) -> JoinedMotion:
        """See ``Motion``; of each surface."""

        def moved(now: Motion | None, then: Motion | None) -> Motion | None:
            if now is then:
                return None
            still = Motion.none(len((now or then).about))  # type: ignore[union-attr]
            return (now or still).since(then or still, part)

        return JoinedMotion([moved(*both) for both in zip(self.each, before.each)], self._rows)

    def _moved(self, how: str, points: Array) -> Array:
        found = points
        for motion, own in zip(self.each, self._rows):
            if motion is not None:
                found = found.copy() if found is points else found
                found[own] = getattr(motion, how)(points[own])
        return found


class JoinedRigid:
    """Implements ``Target``: rigid surfaces of many contacts, each met by its own contactors, the ``rows`` of each."""

    n_nodes, averaged, faceted = 0, False, False
    dofs: Indices = np.zeros((0, 0), np.int32)
    keys: Ints = np.zeros(0, np.int64)

    def __init__(self, targets: Sequence[Any], rows: Sequence[slice]):
        self._targets, self._rows = targets, rows
        self.measures = all(getattr(target, "measures", False) for target in targets)
        self._motion = JoinedMotion([None] * len(rows), rows)

    @property
    def stride(self) -> float:
        """The smallest of the surfaces, a length."""
        return min(target.stride for target in self._targets)

    @property
    def motion(self) -> JoinedMotion:
        """Present motions of the surfaces; the same object as long as none has moved."""
        each = [target.motion for target in self._targets]
        if any(now is not then for now, then in zip(each, self._motion.each)):
            self._motion = JoinedMotion(each, self._rows)
        return self._motion

    @motion.setter
    def motion(self, motion: JoinedMotion) -> None:
        for target, own in zip(self._targets, motion.each):
            target.motion = own

    def project(self, points: Array) -> RigidProjection:
        """Each point onto its own surface (collective)."""
        parts = [target.project(points[own]) for target, own in zip(self._targets, self._rows)]
        names = ("gap", "normal", "nodes", "weights", "facet", "beyond", "points", "shape_operator")
        arrays: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
        return RigidProjection(**arrays, motion=self.motion)  # type: ignore[arg-type]

    def alone(self, facet: Ints, surface: int) -> Ints:
        """Rigid surfaces have no facets to number."""
        return facet

    here = alone
