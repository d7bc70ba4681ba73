"""Node to surface: each contactor node is constrained to the point of the target below it, the paper's coupling [UEM, 4.1-4.3].

Targets may be meshed or rigid. For meshed targets with discontinuous normals, ``concave_edges`` determines the facets of a
contactor.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import TYPE_CHECKING, Any, cast

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.seam.base import OnTarget, PlacedOnTarget
from uem_dolfinx.contact.seam.ends import END_HOLDS, Ends, slide_off
from uem_dolfinx.contact.seam.placement import Along, ContactRows, GapRows, Traction, Traits
from uem_dolfinx.contact.seam.pressure_map import PressureMap
from uem_dolfinx.contact.seam.relative_motion import Ties
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.errors import OrientationError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import facets_of, unit
from uem_dolfinx.geometry.projection import FacetProjection, Projection, Target
from uem_dolfinx.geometry.search import ON_SIDE, MeshTarget
from uem_dolfinx.geometry.sharp import SHARP_EDGE
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.nodes.concave_edges import ConcaveEdges
    from uem_dolfinx.contact.seam.corners import Corners


class NodeToSurface(OnTarget):
    """Implements ``Discretisation``: contactor nodes against the surface of one target; arguments as for ``OnTarget``.

    Args:
        chords: trial rows with the weights of the straight pieces between a curved target's nodes [UEM, 4.5].
    """

    traits = Traits(at_feet=True, pointwise=True, chained=False, two_pass=True)
    #: Whether an end of the target holds contactors that first touch there, for all or for each ``(n,)``.
    ends_hold: bool | Bools = True
    _edges: Any = None  # ``ConcaveEdges``, once they are needed, or another object, see ``follow_by``

    def __init__(self, config: Configuration, nodes: Indices, target: Target, *, chords: bool = False, **how: Any):
        super().__init__(config, nodes, target, **how)
        self.chords = chords

    @classmethod
    def like(cls, other: OnTarget) -> NodeToSurface:
        """The same contactors and target with nodal gaps, for methods with nodal contact forces."""
        how: dict[str, Any] = {"sliding": other.sliding, "thickness": other.thickness}
        return cls(other.config, other.nodes, other.target, free=other.setting.free, **how)

    @property
    def concave_edges(self) -> ConcaveEdges | None:
        """Tracking of contactors from facet to facet; None for targets with continuous normals."""
        if self.sliding != "finite" or not self.target.faceted:
            return None
        if self._edges is None:
            from uem_dolfinx.contact.nodes.concave_edges import ConcaveEdges

            self._edges = ConcaveEdges(self)
        return self._edges

    def follow_by(self, edges: Any) -> None:
        """Track contactors by another object than ``ConcaveEdges``, with its methods; ends hold all of them."""
        self._edges, self.ends_hold = edges, True

    def set(self, **changed: Any) -> None:
        """See ``OnTarget`` (collective)."""
        super().set(**changed)
        #: Followed nodes of the last call ``(n, nt)``, and their free components ``(n, nt, gdim)``.
        self._followed, self._may_move = np.zeros((0, 0), np.int64), np.zeros((0, 0, 0))

    def leave(self, which: Callable[[FacetProjection], Bools], order: int, *, ends_hold: bool | None = None) -> None:
        """See ``OnTarget``; ``ends_hold`` replaces that of the nodes unless it is None."""
        super().leave(which, order)
        self.ends_hold = self.ends_hold if ends_hold is None else ends_hold

    def place(self, points: Array, state: PairState) -> NodalKinematics:
        """Project contactors (collective); see ``Discretisation``."""
        self.in_reach = self._asks(state)
        if not self.in_reach:
            return self.nowhere(points)
        corners = None
        if self.sliding == "finite":
            nearest = projection = self._stuck(self._continued_at_end(self.on_target(points), state), points, state)
            if (edges := self.concave_edges) is not None:
                projection, corners = edges.place(nearest, points, state)
        else:
            if self.anchor is None:
                nearest = projection = self.take_feet(points)
            else:
                nearest = projection = self.on_target(points, self.anchor)
        moves = self._target_moves(projection) if self.setting.prescribed else None
        out = self.left(nearest)
        if not self.setting.on.all():
            off = ~self.setting.on[self.setting.label]
            out = off if out is None else out | off
        return self.measured(NodalKinematics(self, points, projection, nearest, projection.gap, corners, moves, out=out), state)

    def _asks(self, state: PairState) -> bool:
        """Whether any contactor on any rank may be near the target (collective)."""
        return not all(self.setting.far)

    def nowhere(self, points: Array) -> NodalKinematics:
        """Kinematics of contactors at ``points (n, gdim)`` that are far from the target on all ranks, without a search."""
        p = self.target.nowhere(points) if isinstance(self.target, MeshTarget) else self.target.project(points)
        return NodalKinematics(self, points, p, p, p.gap, None, None)

    def measured(self, kinematics: NodalKinematics, state: PairState) -> NodalKinematics:
        """The kinematics with deciding gaps (collective)."""
        return kinematics

    def _continued_at_end(self, nearest: Projection, state: PairState) -> Projection:
        """Continue closest points of contactors held by an end to below these, so that force and reaction are collinear."""
        # those that press by their gap are never active
        held = state.at_end & (state.active if self._edges is None else ~state.passed)
        i = np.flatnonzero(held & (nearest.beyond != 0).any(axis=1))
        return self.target.continued(nearest, i, nearest.foot[i] + nearest.beyond[i]) if len(i) else nearest

    def overhanging(self, projection: Projection, which: Bools) -> Bools:
        """Which contactors ``(n,)`` past an end of the target have a facet over it ``(n,)`` (collective)."""
        if not isinstance(projection, FacetProjection) or self.contactor is None or self.contactor.dim == 0:
            return np.zeros(len(self.nodes), dtype=bool)
        return overhanging(self.config, self.nodes, self.contactor, projection, which)

    def _stuck(self, nearest: Projection, points: Array, state: PairState) -> Projection:
        """Set the closest points of sticking contactors to their anchors, so that edges between facets have no effect (collective)."""
        f = state.friction
        if f is None or not isinstance(self.target, MeshTarget) or not isinstance(nearest, FacetProjection):
            return nearest
        i = (f.stick & state.active & ~state.in_corner & (f.facet >= 0)).nonzero()[0]
        if not reduced(self.config.comm, len(i)):
            return nearest
        own = self.raised(self.target.at(points[i], f.facet[i], f.xi[i]), i)
        return nearest.with_those(i, replace(own, beyond=np.zeros_like(own.beyond)))

    def _target_moves(self, p: Projection) -> Bools | None:
        """Whether the target can move along the normal, per contactor (collective)."""
        if not p.nodes.shape[1]:
            return None
        nodes = np.maximum(p.nodes, 0)
        if reduced(self.config.comm, int(not np.array_equal(nodes, self._followed))):
            self._followed, shape = nodes, (*nodes.shape, self.config.gdim)
            self._may_move = self.config.ask_owners(nodes.ravel(), self.setting.free.astype(float)).reshape(shape)
        free = self._may_move
        return np.abs(p.weights[:, :, None] * p.normal[:, None] * free).max(axis=(1, 2)) > MOSTLY_PRESCRIBED


@dataclass(frozen=True)
class NodalKinematics(PlacedOnTarget):
    """Implements ``Kinematics``: nodes on the surface of one target."""

    of: NodeToSurface
    corners: Corners | None  # of the target that hold contactors; None if no rank has such a corner
    target_moves: Bools | None  # whether the target can move along the normal ``(n,)``; None if no contactor is prescribed
    out: Bools | None = None  # contactors that are left to other equations ``(n,)``, or None

    @cached_property
    def movable(self) -> Bools:
        """Contactors that can move along the normal, or whose target can ``(n,)``."""
        own = np.linalg.norm(self.projection.normal * self.of.free, axis=1) > MOSTLY_PRESCRIBED
        return own if self.target_moves is None else own | self.target_moves

    @cached_property
    def ties(self) -> Ties:
        """Weights are the shape functions at the closest points; see ``Kinematics``."""
        return self.of.ties(self.weights(), self._share)

    def weights(self) -> tuple[Ints, Ints, Array]:
        """Indices of contactors, followed global nodes and weights, ``(k,)`` each."""
        p = self.projection
        row, a = np.nonzero(p.nodes >= 0)
        return row.astype(np.int64), p.nodes[row, a], p.weights[row, a]

    @property
    def _share(self) -> Array:
        """Forces over multipliers ``(n,)``: one."""
        return np.ones(len(self.points))

    @cached_property
    def cone(self) -> Array:
        """Sum of facet forces over the force along the contactor's normal, above 1 on an edge ``(n,)`` (first time: collective)."""
        cone, target, p = np.ones(len(self.points)), self.of.target, self.projection
        if (
            self.of.setting.cones is not None
            and target.faceted
            and isinstance(target, MeshTarget)
            and isinstance(p, FacetProjection)
        ):
            averaged = (p.facet >= 0) & (p.averaged == p.normal).all(axis=1)
            if reduced(self.of.config.comm, bool(averaged.any()), op=MPI.LOR):
                cone = np.where(averaged, target.spread(p), 1.0)
        if self.corners is not None:
            cone[self.corners.which] = np.linalg.norm(self.corners.summing, axis=1)
        return cone

    # -- the same contactors in another state ----------------------------------------------------------------------------

    def follow(self, state: PairState, off: Bools) -> tuple[NodalKinematics, PairState]:
        """Release contactors, follow others across edges, and place those that enter or leave a corner (collective)."""
        edges, moved, state = self.of.concave_edges, bool((state.active & off).any()), slide_off(state, off)
        if edges is None:
            return self, state
        state, left = edges.leave(self.corners, state)
        state, entered = edges.follow(self.nearest, left, self.points, state)
        if not reduced(self.of.config.comm, moved or bool(left.any()) or entered, op=MPI.LOR):
            return self, state
        nearest, projection, corners = edges.place_again(self.nearest, left, self.points, state)
        there = replace(self, projection=projection, nearest=nearest, gap=projection.gap, corners=corners)
        return self.of.measured(there, state), state

    # -- deciding quantities ---------------------------------------------------------------------------------------------

    @cached_property
    def ends(self) -> Ends:
        """Open ends, which can hold contactors, except with two-pass contact, where the end itself touches; see ``Kinematics``."""
        s = self.of.setting
        holds = np.logical_and(self.of.ends_hold, ~s.mutual[s.label])
        return Ends(self.projection, self.of.thickness, holds, None, self.out, partial(self.of.overhanging, self.projection))

    # -- equations and forces --------------------------------------------------------------------------------------------

    @cached_property
    def gap_rows(self) -> GapRows:
        """One row along the normal for each contactor, followed by rows along further axes of corners."""
        p, c, of = self.projection, self.corners, self.of
        found = GapRows.along_normals(of.config, self._normal_rows(p.normal, p.weights), np.ones(len(self.points)), of.free)
        if of.chords or self.leans:
            weights = np.array(of.target.chords(p)) if of.chords else p.weights
            if c is not None:
                weights[c.which] = p.weights[c.which]
            found = replace(found, moved=self._normal_rows(self.closing, weights))
        if c is None:
            return found
        gaps, more, contactors, kinds = c.gaps(self.points[c.which]), [], [found.contactor], [found.kind]
        for r in range(1, of.config.gdim):
            j = (r < c.count).nonzero()[0]
            w, none = c.which[j], np.zeros(len(j), bool)
            more.append(UnitingEquations.along(of.nodes[w], c.axes[j, r], c.nodes[j], c.weights[j], gaps[j, r], none))
            contactors.append(w)
            kinds.append(np.full(len(w), r))
        lists = (
            None if rows is None else UnitingEquations.join([rows, *more], of.config.gdim)
            for rows in (found.equations, found.moved)
        )
        equations, moved = lists
        assert equations is not None
        return GapRows(of.config, equations, found.scale, of.free, np.concatenate(contactors), np.concatenate(kinds), moved)

    @property
    def leans(self) -> bool:
        """Whether forces act along averaged normals, and gaps close along those of the facets."""
        return self.of.target.averaged and self.of.sliding == "finite"

    @cached_property
    def closing(self) -> Array:
        """Derivatives of the nodes' gaps by their positions ``(n, gdim)``."""
        if not self.leans:
            return self.projection.normal
        from uem_dolfinx.contact.nodes.averaged import closing

        return closing(cast("MeshTarget", self.of.target), cast("FacetProjection", self.projection), self.of.free)

    def _normal_rows(self, normal: Array, weights: Array) -> UnitingEquations:
        """Equations of all contactors along ``normal (n, gdim)``, with these weights of the target's nodes ``(n, nn)``."""
        p, none = self.projection, np.zeros(len(self.points), bool)
        return UnitingEquations.along(self.of.nodes, normal, p.nodes, weights, self.gap, none)

    def forces(
        self, state: PairState, rows: ContactRows, multipliers: Array, friction: Callable[[Array], Array] | None = None
    ) -> Traction:
        """Contact forces, normal ones summed over the facets of a corner (collective)."""
        lam = np.zeros(len(self.points))
        lam[rows.contactor[rows.normal]] = multipliers[rows.normal]
        (lam, nodal), c = self._nodal(state, lam), self.corners
        force = nodal[:, None] * self.projection.normal
        for r in range(1, self.of.config.gdim):
            j = (rows.kind == r).nonzero()[0]
            force[rows.contactor[j]] += multipliers[j, None] * rows.rows.direction[j]
        lam = lam * self.cone
        if c is not None:
            lam[c.which] = np.einsum("kg,kg->k", force[c.which], c.summing)
        found = Traction(lam, nodal, force)
        return found if friction is None else found.with_friction(tau := friction(lam), self.ties, self._nodal_friction(tau))

    def _nodal(self, state: PairState, multipliers: Array) -> tuple[Array, Array]:
        """Deciding and nodal normal forces from the multipliers of all contactors, each ``(n,)`` (collective)."""
        return multipliers, multipliers

    def _nodal_friction(self, tau: Array) -> Array:
        """Forces at the contactors from multipliers of tangential rows, both ``(n, gdim)`` (collective)."""
        return tau

    def nodal_forces(self, state: PairState) -> tuple[Ints, Array]:
        """The force on each contactor, and the opposite force on the target's nodes with the weights of the closest point."""
        p, i, config = self.projection, (state.force != 0).any(axis=1).nonzero()[0], self.of.config
        nodes = np.concatenate([config.to_global(self.of.nodes[i])[:, None], p.nodes[i]], axis=1)
        share = np.concatenate([np.ones((len(i), 1)), -p.weights[i]], axis=1)
        return nodes.ravel(), (share[..., None] * state.force[i, None, :]).reshape(-1, config.gdim)

    def curvature(self, state: PairState, along: Along | None = None) -> list[tuple[Ints, Array]]:
        """Derivatives of the rows of contactors with force; contactors in corners remain on the edge, and their friction does not turn."""
        p, c, nodes = self.projection, self.corners, self.of.nodes
        if self.leans:
            from uem_dolfinx.contact.nodes.averaged import turning

            tau = np.zeros(self.points.shape)
            if along is not None:
                tau[along.which] = along.tau
            i = ((((state.lam > 0) | ~state.active) & (state.nodal != 0)) | tau.any(axis=1)).nonzero()[0]
            found = cast("FacetProjection", p).take(i)
            return turning(cast("MeshTarget", self.of.target), self.of.config.to_global(nodes[i]), found, state.nodal[i], tau[i])
        i = (((state.lam > 0) | ~state.active) & (state.nodal != 0) & ~state.in_corner).nonzero()[0]
        own, followed, blocks = nodes[i], p.nodes[i], -state.nodal[i, None, None] * p.hessians(i)
        if c is not None:
            own = np.concatenate([own, nodes[c.which]])
            followed = np.concatenate([followed, c.nodes])
            blocks = np.concatenate([blocks, -c.hessians(state.force[c.which])])
        parts = [(np.column_stack([self.of.config.to_global(own), followed]), blocks)]
        if along is None:
            return parts
        plain = ~state.in_corner[along.which]
        i = along.which[plain]
        turned = np.column_stack([self.of.config.to_global(nodes[i]), p.nodes[i]])
        return [*parts, (turned, -p.turnings(i, along.tau[plain]))]

    def pressure_map(self, current: bool) -> PressureMap:
        """Map of nodal forces, which are integrals of the pressure times the node's shape function."""
        return PressureMap(self.cone)

    def means(self) -> tuple[tuple[Ints, Ints, Array], tuple[Ints, Ints, Array]]:
        """Values at the nodes, and at their closest points."""
        n = len(self.points)
        return (np.arange(n), self.of.config.to_global(self.of.nodes), np.ones(n)), NodalKinematics.weights(self)


def close_to_ends(p: FacetProjection, which: Bools) -> Bools:
    """Contactors of ``which (n,)`` that are past an end by at most ``END_HOLDS`` of the target's facet ``(n,)``."""
    return np.asarray(which & (p.way_beyond > ON_SIDE * p.facet_size) & (p.way_beyond <= END_HOLDS * p.facet_size))


def overhanging(config: Configuration, nodes: Indices, contactor: Tag, p: FacetProjection, which: Bools) -> Bools:
    """Contactors past an end by at most ``END_HOLDS`` of one of their own facets, which faces the target and is over it ``(n,)``.

    Collective.

    Args:
        config: configuration of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        contactor: facets of the contactors.
        p: projection of the contactors.
        which: contactors that are looked at ``(n,)``.
    """
    g, near = config.gdim, close_to_ends(p, which)
    if not reduced(config.comm, bool(near.any()), op=MPI.LOR):
        return near
    try:
        own = facets_of(config, contactor, "contactor")
    except OrientationError:
        # a surface inside a body faces nothing
        return np.zeros(len(nodes), dtype=bool)
    at_nodes = np.zeros((config.n_owned, 2 * g))
    at_nodes[nodes[near]] = np.column_stack([unit(p.beyond), p.normal])[near]
    x, of_facets = own.x, own.nodes.ravel()
    there = config.ask_owners(of_facets, at_nodes).reshape(*own.nodes.shape, 2 * g)
    # along the way beyond the end, how far the facets' other nodes are behind each of their nodes
    along = np.einsum("mag,mbg->mab", there[..., :g], x)
    back = np.einsum("maa->ma", along) - along.min(axis=2, initial=np.inf)
    facing = np.einsum("mag,mg->ma", there[..., g:], own.middles(x)[1]) < -SHARP_EDGE
    node, back = config.send_to_owners(of_facets, np.where(facing, back, 0.0).ravel())
    reach = np.zeros(config.n_owned)
    np.maximum.at(reach, node, back)
    return np.asarray(near & (p.way_beyond <= END_HOLDS * reach[nodes]))
