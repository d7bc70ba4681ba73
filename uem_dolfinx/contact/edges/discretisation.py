"""Edge to edge: the gap between the closest points of two sharp edges of 3D bodies, along their common normal, is zero.

The equation eliminates the normal component of the edge's node nearer to the crossing, the contactor. A crossing has a force and no
area.

Gaps of edges that cross, with their equations, forces and derivatives: ``Kinematics`` from pairs of edges.

With weights ``N_a`` of the nodes of the contactor's edge and ``M_b`` of the opposite one, the gap changes by
``n . (sum_a N_a du_a - sum_b M_b du_b)``; the equation is divided by the weight of the contactor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.seam.base import OnTarget, PlacedOnTarget
from uem_dolfinx.contact.seam.ends import Ends, slide_off
from uem_dolfinx.contact.seam.placement import Along, ContactRows, GapRows, Traction, Traits
from uem_dolfinx.contact.seam.pressure_map import PressureMap
from uem_dolfinx.contact.seam.relative_motion import Ties
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.edge_crossings import Crossings, Opposite
from uem_dolfinx.geometry.edge_gaps import EdgeGaps
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import reduced


@dataclass(frozen=True)
class EdgeKinematics(PlacedOnTarget):
    """Implements ``Kinematics``: nodes of edges that cross others."""

    of: OnTarget
    which: Ints  # contactors with a crossing, ascending ``(k,)``
    at: Opposite  # their crossings
    gaps: EdgeGaps  # of these
    share: Array  # weight of each contactor in its gap, 1 without crossing ``(n,)``
    movable: Bools  # contactors whose gap can be closed ``(n,)``

    @classmethod
    def of_crossings(cls, of: OnTarget, points: Array, which: Ints, at: Opposite) -> EdgeKinematics:
        """The kinematics of ``nodes`` at ``points (n, gdim)``, of which the contactors ``which (k,)`` have crossings (collective)."""
        n, target, gaps = len(points), of.target, at.gaps
        assert isinstance(target, MeshTarget)
        share, places = np.ones(n), points.copy()
        share[which] = gaps.weights[0][np.arange(len(which)), at.own]
        places[which] = gaps.points
        tab = target.shape.tabulate(at.xi)
        crossing: dict[str, Any] = {
            "gap": gaps.gap, "normal": gaps.normal, "averaged": gaps.normal, "foot": gaps.feet, "facet": at.facet, "xi": at.xi,
            "nodes": at.facet_nodes, "weights": tab.N, "dN": tab.dN, "ddN": tab.ddN, "x": at.facet_x,
        }  # fmt: skip
        projection = of.raised(target.nowhere(points).with_rows(which, crossing))
        movable = np.ones(n, bool)
        if of.setting.prescribed:
            parts = _moves_along(of, np.concatenate([at.nodes, at.followed], axis=1), gaps.normal)
            weights = np.abs(np.concatenate(gaps.weights, axis=1))
            movable[which] = (weights * parts).max(axis=1, initial=0.0) > MOSTLY_PRESCRIBED
        return cls(of, places, projection, projection, projection.gap, which, at, gaps, share, movable)

    @property
    def corners(self) -> None:
        """None, since crossings are no corners."""
        return None

    @cached_property
    def _terms(self) -> tuple[Ints, Ints, Array]:
        """Contactors, followed nodes and weights, of sum 1 for each contactor ``(m,)``."""
        at, (own, theirs) = self.at, self.gaps.weights
        k = len(self.which)
        # where a line ends, the outer node has no weight
        mine, other = (np.column_stack([~e[:, 0], np.ones((k, 2), bool), ~e[:, 1]]) for e in (at.ends[:, :2], at.ends[:, 2:]))
        mine[np.arange(k), at.own] = False
        (i, a), (j, b) = np.nonzero(mine), np.nonzero(other)
        row = self.which[np.concatenate([i, j])]
        node = np.concatenate([at.nodes[i, a], at.followed[j, b]])
        weight = np.concatenate([-own[i, a], theirs[j, b]]) / self.share[row]
        return row, node, weight

    @cached_property
    def ties(self) -> Ties:
        """Weights of the other nodes of both edges; multipliers are forces times the contactor's weight."""
        return self.of.ties(self._terms, np.asarray(1.0 / self.share))

    # -- the same contactors in another state ----------------------------------------------------------------------------

    def follow(self, state: PairState, off: Bools) -> tuple[EdgeKinematics, PairState]:
        """Note the facets of the crossings that hold contactors; their equations change smoothly."""
        state = slide_off(state, off)
        return self, replace(state, facet=np.where(state.active, self.projection.facet, state.facet))

    # -- deciding quantities ---------------------------------------------------------------------------------------------

    @cached_property
    def ends(self) -> Ends:
        """Contactors without a crossing, or with one that another node has the equation of, are out."""
        out = np.ones(len(self.points), bool)
        out[self.which] = ~self.at.leads
        return Ends(self.projection, np.inf, out=out)

    # -- equations and forces --------------------------------------------------------------------------------------------

    @cached_property
    def gap_rows(self) -> GapRows:
        """One row for each contactor, divided by its weight."""
        of, n = self.of, len(self.points)
        row, node, weight = self._terms
        normal = self.projection.normal
        equations = UnitingEquations(
            of.nodes, normal, self.gap / self.share, np.zeros(n, bool), row, node, weight[:, None] * normal[row]
        )
        return GapRows.along_normals(of.config, equations, self.share, of.free)

    def forces(
        self, state: PairState, rows: ContactRows, multipliers: Array, friction: Callable[[Array], Array] | None = None
    ) -> Traction:
        """Forces at the crossings."""
        lam = np.zeros(len(self.points))
        lam[rows.contactor[rows.normal]] = multipliers[rows.normal]
        lam = lam / self.share
        found = Traction(lam, lam, lam[:, None] * self.projection.normal)
        return found if friction is None else found.with_friction(tau := friction(lam), self.ties, tau / self.share[:, None])

    def curvature(self, state: PairState, along: Along | None = None) -> list[tuple[Ints, Array]]:
        """Second derivatives of the gaps of contactors with force; friction at a crossing moves along both edges, and turns."""
        lam = state.lam[self.which]
        k = np.flatnonzero(((lam > 0) | ~state.active[self.which]) & (lam != 0))
        parts = [(self._nodes[k], -lam[k, None, None] * self.gaps.take(k).hessians())]
        if along is None:
            return parts
        place = np.searchsorted(self.which, along.which)
        known = np.append(self.which, -1)[place] == along.which
        k, tau = place[known], along.tau[known] / self.share[along.which[known], None]
        return [*parts, (self._nodes[k], -self.gaps.take(k).turnings(tau))]

    @property
    def _nodes(self) -> Ints:
        """Global nodes of both edges ``(k, 8)``."""
        return np.concatenate([self.at.nodes, self.at.followed], axis=1)

    def pressure_map(self, current: bool) -> PressureMap:
        """Multipliers are forces times the contactors' weights."""
        return PressureMap(1.0 / self.share)

    def means(self) -> tuple[tuple[Ints, Ints, Array], tuple[Ints, Ints, Array]]:
        """Values at the crossing on both edges; at the node itself without a crossing."""
        own, theirs = self.gaps.weights
        alone = np.setdiff1d(np.arange(len(self.points)), self.which)
        row = np.repeat(self.which, own.shape[1])
        nodes = np.concatenate([self.at.nodes.ravel(), self.of.config.to_global(self.of.nodes[alone])])
        both = np.concatenate([row, alone]), nodes, np.concatenate([own.ravel(), np.ones(len(alone))])
        return both, (row, self.at.followed.ravel(), theirs.ravel())


def _moves_along(of: OnTarget, nodes: Ints, normal: Array) -> Array:
    """Lengths of the free parts of ``normal (k, gdim)`` at global ``nodes (k, m)``: ``(k, m)`` (collective)."""
    free = of.config.ask_owners(nodes.ravel(), of.setting.free.astype(float)).reshape(*nodes.shape, of.config.gdim)
    return np.asarray(np.linalg.norm(free * normal[:, None], axis=2))


#: Ways of contactors that count as too short to pass through an edge. [bound; the model's size; -]
NO_WAY = 1e6


class EdgeTarget(MeshTarget):
    """The edges of a surface, as the target of one list of crossings, by its number."""

    measures = False  # crossings are found from lists, not by bounding boxes

    def __init__(self, crossings: Crossings, number: int):
        super().__init__(crossings.second.facets)
        self.crossings, self.number = crossings, number
        # a node does not pass through an edge, whatever its way
        self.stride = NO_WAY * crossings.second.facets.config.size


class Edges(OnTarget):
    """Implements ``Discretisation``: nodes on edges with the edges that cross theirs; as ``OnTarget``, ``order`` as in ``Traits``."""

    traits = Traits(at_feet=False, pointwise=False, chained=True, two_pass=True)
    target: EdgeTarget

    def __init__(self, config: Configuration, nodes: Indices, target: EdgeTarget, *, order: int = -1, **how: Any):
        super().__init__(config, nodes, target, **how)
        self.traits = self.traits._replace(order=order)

    def place(self, points: Array, state: PairState) -> EdgeKinematics:
        """Find the crossings (collective); see ``Discretisation``."""
        crossings, k = self.target.crossings, self.target.number
        crossings.held[k] = np.where(state.active, state.facet, -1)
        crossings.update()
        which, found = crossings.lists[k]
        near = bool(len(which) or state.active.any())
        self.in_reach = bool(reduced(self.config.comm, near, op=MPI.LOR))
        return EdgeKinematics.of_crossings(self, points, which, found)

    def commit(self) -> None:
        """Accept a step: current positions decide which edges face each other."""
        super().commit()
        self.target.crossings.commit()
