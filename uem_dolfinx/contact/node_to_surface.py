"""Node to surface: each contactor node is united to the point of the target below it, the paper's coupling [UEM, 4.1-4.3].

Targets may be meshed or rigid. Where the normals of a meshed target jump from facet to facet, ``valleys`` says which facets hold a
contactor.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, cast

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints, sums_of_rows
from uem_dolfinx.contact.corners import Corners
from uem_dolfinx.contact.coupling import NORMAL, LabelledEquations, Placement
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.contact.valleys import create_valleys
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import Projection, Target
from uem_dolfinx.geometry.search import MeshTarget

#: A contactor past an open end by more than this part of its facet has slid off.
#: [heuristic; length of the facet; -]
SLID_OFF = 1e-6
#: A contactor that came to the target at its end, or back after it had slid off, is held there up to this part of the facet beyond it.
#: [heuristic; length of the facet; -]
END_HOLDS = 0.1
#: Contactors nearer than this many facets keep a row in the sparsity of P.
#: [heuristic; length of the facet; -]
NEAR = 1.0


@dataclass(frozen=True)
class Feet:
    """What a placement of nodes on a surface holds besides their projection.

    Attributes:
        nearest: the contactors on their nearest facets.
        corners: of the target that hold contactors; None if no rank has any.
        left: contactors that have just left a corner ``(n,)``.
    """

    nearest: Projection
    corners: Corners | None
    left: Bools


class NodeToSurface:
    """Implements ``Coupling``: contactor nodes against the surface of one target.

    Args:
        config: configuration of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        target: what they may touch.
        free: components without Dirichlet condition of all owned nodes ``(n_owned, gdim)``.
        sliding: ``"finite"`` projects at every placement, ``"small"`` once per step, ``"fixed"`` once.
        thickness: of the target's body, a length: what has passed its end and is deeper than this lies behind it.
        chords: trial rows with the weights of the straight pieces between a curved target's nodes [UEM, 4.5].
    """

    chained, two_pass = False, True
    nodal = at_feet = True

    def __init__(
        self,
        config: Configuration,
        nodes: Indices,
        target: Target,
        *,
        free: Bools,
        sliding: str,
        thickness: float,
        chords: bool,
    ):
        self.config, self.nodes, self.target = config, nodes, target
        self.sliding, self.thickness, self.chords = sliding, thickness, chords
        self.free, self._free_of_owned = free[nodes], free
        self.prescribed = bool(config.comm.allreduce(int(not self.free.all())))
        self._valleys = create_valleys(config, target, self.free) if sliding == "finite" else None
        #: Projection whose feet, normals and weights a contact with small or fixed sliding keeps.
        self._anchor: Projection | None = None
        #: Positions of contactors and target when they were last projected, the feet that were kept, and what came of it.
        self._projected: tuple[Array, Array, Projection | None, Projection] | None = None

    def with_nodal_gaps(self) -> NodeToSurface:
        """The same contactors and target, with nodal gaps."""
        return NodeToSurface(
            self.config,
            self.nodes,
            self.target,
            free=self._free_of_owned,
            sliding=self.sliding,
            thickness=self.thickness,
            chords=self.chords,
        )

    def rub(self, mu: Array) -> None:
        """Take the contactors' coefficients of friction ``(n,)``, with which they leave corners."""
        if self._valleys is not None:
            self._valleys.mu = mu

    @property
    def followed(self) -> Indices:
        """Local nodes of the target."""
        return self.target.dofs.ravel()

    # -- placement -------------------------------------------------------------------------------------------------------

    def place(self, points: Array, state: PairState) -> Placement:
        """Project contactors (collective); see ``Coupling``."""
        corners = None
        if self.sliding == "finite":
            nearest = projection = self._stuck(self._continued_at_end(self._on_target(points), state), points, state)
            if self._valleys is not None:
                projection, corners = self._valleys.place(nearest, points, state)
        else:
            if self._anchor is None:
                nearest = projection = self._anchor = self.target.project(points)
            else:
                nearest = projection = self._on_target(points, self._anchor)
        moves = self._target_moves(projection) if self.prescribed else None
        return self._measured(projection, moves, Feet(nearest, corners, np.zeros(len(points), bool)), state)

    def place_again(self, placement: Placement, points: Array, state: PairState) -> Placement:
        """Put contactors that have entered or left a corner where they now belong (collective)."""
        if self._valleys is None:
            return placement
        feet: Feet = placement.details
        nearest, projection, corners = self._valleys.place_again(feet.nearest, feet.left, points, state)
        return self._measured(projection, placement.target_moves, replace(feet, nearest=nearest, corners=corners), state)

    def with_active(self, placement: Placement, state: PairState) -> Placement:
        """Nodal gaps do not depend on the active set."""
        return placement

    def returned(self, placement: Placement, points: Array, state: PairState, gap: Array) -> Placement:
        """The placement after the normal return (collective)."""
        if self.target.averaged:
            # the foot moves when the way leans
            return self.place(points, state)
        return self._measured(placement.projection.with_gap(gap), placement.target_moves, placement.details, state)

    def _measured(self, projection: Projection, moves: Bools | None, feet: Feet, state: PairState) -> Placement:
        """The placement with the gaps that decide on contact (collective)."""
        return Placement(projection, projection.gap, moves, feet)

    def _on_target(self, points: Array, anchor: Projection | None = None) -> Projection:
        """The contactors on the nearest places of the target, or with the feet of ``anchor``; as before if nothing moved (collective)."""
        if not self.target.n_nodes:
            return self.target.project(points) if anchor is None else self.target.follow(points, anchor)
        x, last = self.config.x[self.target.dofs], self._projected
        same = last is not None and last[2] is anchor and np.array_equal(points, last[0]) and np.array_equal(x, last[1])
        if last is None or not self.config.comm.allreduce(same, op=MPI.LAND):
            found = self.target.project(points) if anchor is None else self.target.follow(points, anchor)
            self._projected = last = points, x, anchor, found
        return last[3]

    def _continued_at_end(self, nearest: Projection, state: PairState) -> Projection:
        """Move the feet of contactors that the target's end holds out to where they are: force and reaction stay on one line."""
        i = np.flatnonzero(state.active & _held_at_end(state) & (nearest.beyond != 0).any(axis=1))
        return self.target.continued(nearest, i) if len(i) else nearest

    def _stuck(self, nearest: Projection, points: Array, state: PairState) -> Projection:
        """Put the feet of contactors that friction holds where they stick, so that no bend leads them astray (collective)."""
        f = state.friction
        if f is None or not self.target.n_nodes:
            return nearest
        i = np.flatnonzero(f.stick & state.active & ~state.in_corner & (f.facet >= 0))
        own: Any = cast("MeshTarget", self.target).at(points[i], f.facet[i], f.xi[i])
        held: Any = nearest
        return held.with_rows(i, {x.name: getattr(own, x.name) for x in fields(own)} | {"beyond": 0.0})

    def _target_moves(self, p: Projection) -> Bools | None:
        """Which targets can move along the normal (collective)."""
        if not p.nodes.shape[1]:
            return None
        free = self.config.ask_owners(p.nodes.ravel(), self._free_of_owned.astype(float)).reshape(
            *p.nodes.shape, self.config.gdim
        )
        return np.abs(p.weights[:, :, None] * p.normal[:, None] * free).max(axis=(1, 2)) > MOSTLY_PRESCRIBED

    # -- what decides on contact -----------------------------------------------------------------------------------------

    def foreseen(self, placement: Placement, du: Array) -> Array:
        """Nodal gaps after an increment (collective)."""
        p = placement.projection
        move = du[self.nodes]
        if p.nodes.shape[1]:
            followed = self.config.ask_owners(np.maximum(p.nodes, 0).ravel(), du).reshape(*p.nodes.shape, self.config.gdim)
            move = move - np.einsum("na,nag->ng", np.where(p.nodes >= 0, p.weights, 0.0), followed)
        return np.asarray(p.gap + np.einsum("ng,ng->n", p.normal, move))

    def weights(self, placement: Placement) -> tuple[Ints, Ints, Array]:
        """The shape functions at the feet; see ``Coupling``."""
        return self._beneath(placement)

    def _beneath(self, placement: Placement) -> tuple[Ints, Ints, Array]:
        """The shape functions at the feet: places of contactors, global nodes and weights."""
        p = placement.projection
        row, a = np.nonzero(p.nodes >= 0)
        return row.astype(np.int64), p.nodes[row, a], p.weights[row, a]

    def driven(self, placement: Placement, way: Array) -> Array:
        """How far prescribed components go over the feet; see ``Coupling``.

        Where most of what is there is prescribed as well, as on a plane of symmetry, it counts alone: with mortar the feet are a little off
        the plane, where nodes move.
        """
        row, followed, weight = self._beneath(placement)
        held = weight[:, None] * (1.0 - self.config.ask_owners(followed, self._free_of_owned.astype(float)))
        moved = self.config.ask_owners(followed, way)
        parts = held, held * moved, weight[:, None] * moved
        share, by_held, by_all = (sums_of_rows(row, part, len(self.nodes)) for part in parts)
        most = share > 0.5
        over = np.where(most, by_held / np.where(most, share, 1.0), by_all)
        return np.asarray(np.where(self.free, 0.0, way[self.nodes] - over))

    def shares(self, placement: Placement, state: PairState) -> Array:
        """The whole multiplier."""
        return np.ones(len(self.nodes))

    def tilts(self, placement: Placement, state: PairState) -> Array:
        """Friction is mu times the multipliers of the equations."""
        return np.ones(len(self.nodes))

    def normals(self, placement: Placement, state: PairState) -> Array:
        """The normals at the feet."""
        return placement.projection.normal

    def off(self, placement: Placement, state: PairState) -> Bools:
        """Contactors that have slid past an open end of the target in a direction in which they can move.

        Round the end of a thin target they come behind it, where a negative gap is no penetration.
        """
        p = placement.projection
        limit = np.where(_held_at_end(state), END_HOLDS, SLID_OFF)
        behind = state.passed & (p.gap < -self.thickness)
        return behind | (np.linalg.norm(p.beyond, axis=1) > limit * p.facet_size)

    def at_end(self, placement: Placement, state: PairState) -> Bools:
        """Contactors that come to the target at its end, where edges coincide, are held there until they slide away from it.

        One that let go of the target as soon as it is the least bit past the end would sink into it, and come back with a blow.
        """
        near = (placement.projection.from_end <= END_HOLDS) & ~self.off(placement, state)
        return np.asarray(near & (state.at_end | ~(state.active | state.passed)))

    def movable(self, placement: Placement) -> Bools:
        """Contactors that can move along the normal, or whose target can."""
        own = np.linalg.norm(placement.projection.normal * self.free, axis=1) > MOSTLY_PRESCRIBED
        return own if placement.target_moves is None else own | placement.target_moves

    def change_facets(self, placement: Placement, points: Array, state: PairState) -> tuple[Placement, PairState, bool]:
        """Follow contactors across bends, into corners and out of them (collective)."""
        if self._valleys is None:
            return placement, state, False
        feet: Feet = placement.details
        state, left = self._valleys.leave(feet.corners, state)
        state, entered = self._valleys.follow(feet.nearest, left, points, state)
        return replace(placement, details=replace(feet, left=left)), state, bool(left.any()) or entered

    def return_vectors(self, placement: Placement, points: Array, state: PairState) -> Array:
        """Displacements along the normal, and along the axes of a corner, that close the gaps of active contactors."""
        p, c = placement.projection, placement.details.corners
        correction = np.zeros(points.shape)
        i = np.flatnonzero(state.active)
        correction[i] = _closing(p.normal[i], placement.gap[i], self.free[i])
        if c is not None:
            gaps = c.gaps(points[c.which])
            for r in range(1, self.config.gdim):
                here = state.active[c.which] & (r < c.count)
                correction[c.which] += here[:, None] * _closing(c.axes[:, r], gaps[:, r], self.free[c.which])
        return correction

    def near(self, placement: Placement, state: PairState) -> Bools:
        """Contactors about a facet from the target; a rigid surface has no facets to measure by, and takes all."""
        p = placement.projection
        return state.active | ((p.gap < NEAR * p.facet_size) & ~self.off(placement, state))

    # -- equations and forces --------------------------------------------------------------------------------------------

    def approach(self, placement: Placement, which: Ints) -> UnitingEquations:
        """The equations that the contactors ``which (k,)`` would have if they were active."""
        p = placement.projection
        return self._along_normals(p, which, p.weights[which], p.gap[which], np.ones(len(which), bool))

    def _along_normals(self, p: Projection, which: Ints, weights: Array, gap: Array, active: Bools) -> UnitingEquations:
        return UnitingEquations.along(self.nodes[which], p.normal[which], p.nodes[which], weights, gap, active)

    def equations(self, placement: Placement, points: Array, state: PairState, which: Ints) -> LabelledEquations:
        """One equation along the normal for each contactor, and one along each further axis of a corner that holds it."""
        p, active = placement.projection, state.active
        test = trial = self._normal_rows(placement, state, which, p.weights[which])
        if self.chords:
            plain = ~state.in_corner[which]
            chords = np.where(plain[:, None], self.target.chords(p)[which], p.weights[which])
            trial = self._normal_rows(placement, state, which, chords)
        c: Corners | None = placement.details.corners
        contactor, kind = which, np.full(len(which), NORMAL)
        if c is None:
            return LabelledEquations(trial, test, contactor, kind)
        contactors, kinds, more, gaps = [contactor], [kind], [], c.gaps(points[c.which])
        for r in range(1, self.config.gdim):
            j = np.flatnonzero(r < c.count)
            w = c.which[j]
            more.append(UnitingEquations.along(self.nodes[w], c.axes[j, r], c.nodes[j], c.weights[j], gaps[j, r], active[w]))
            contactors.append(w)
            kinds.append(np.full(len(w), r))
        joined = UnitingEquations.join([test, *more], self.config.gdim)
        return LabelledEquations(
            joined if trial is test else UnitingEquations.join([trial, *more], self.config.gdim),
            joined,
            np.concatenate(contactors),
            np.concatenate(kinds),
        )

    def _normal_rows(self, placement: Placement, state: PairState, which: Ints, weights: Array) -> UnitingEquations:
        """Equations along the normals with these weights of the target's nodes ``(k, nn)``."""
        return self._along_normals(placement.projection, which, weights, placement.gap[which], state.active[which])

    def forces(
        self, placement: Placement, state: PairState, equations: LabelledEquations, multipliers: Array
    ) -> tuple[Array, Array, Array]:
        """Contact forces along the normals, and those of corners along their axes (collective)."""
        lam = np.zeros(len(self.nodes))
        normal = equations.kind == NORMAL
        lam[equations.contactor[normal]] = multipliers[normal]
        lam, nodal = self._nodal(placement, state, lam)
        force = nodal[:, None] * placement.projection.normal
        for r in range(1, self.config.gdim):
            j = np.flatnonzero(equations.kind == r)
            force[equations.contactor[j]] += multipliers[j, None] * equations.test.direction[j]
        return lam, nodal, force

    def _nodal(self, placement: Placement, state: PairState, multipliers: Array) -> tuple[Array, Array]:
        """Deciding and nodal forces along the normals from the multipliers of all contactors, each ``(n,)`` (collective)."""
        return multipliers, multipliers

    def nodal_forces(self, placement: Placement, state: PairState) -> tuple[Ints, Array]:
        """On each contactor its force, on the target's nodes the opposite with the weights of the foot."""
        p, i = placement.projection, np.flatnonzero((state.force != 0).any(axis=1))
        nodes = np.concatenate([self.config.to_global(self.nodes[i])[:, None], p.nodes[i]], axis=1)
        share = np.concatenate([np.ones((len(i), 1)), -p.weights[i]], axis=1)
        return nodes.ravel(), (share[..., None] * state.force[i, None, :]).reshape(-1, self.config.gdim)

    def curvature(self, placement: Placement, state: PairState) -> tuple[Ints, Array]:
        """Second derivatives of the gaps of contactors that push; those in a corner keep to its edge."""
        p, c = placement.projection, placement.details.corners
        i = np.flatnonzero(((state.lam > 0) | ~state.active) & (state.nodal != 0) & ~state.in_corner)
        own, followed, blocks = self.nodes[i], p.nodes[i], -state.nodal[i, None, None] * p.hessians(i)
        if c is not None:
            own = np.concatenate([own, self.nodes[c.which]])
            followed = np.concatenate([followed, c.nodes])
            blocks = np.concatenate([blocks, -c.hessians(state.force[c.which])])
        return np.column_stack([self.config.to_global(own), followed]), blocks

    def turning(self, placement: Placement, state: PairState, which: Ints, tau: Array) -> list[tuple[Ints, Array]]:
        """Derivatives of the rows along forces of friction, of contactors that no corner holds."""
        plain = ~state.in_corner[which]
        i, p = which[plain], placement.projection
        return [(np.column_stack([self.config.to_global(self.nodes[i]), p.nodes[i]]), p.turnings(i, tau[plain]))]

    def areas(self, placement: Placement, areas: Array) -> Array:
        """A nodal force is the integral of the pressure over the node's shape function."""
        return areas

    def commit(self) -> None:
        """Small sliding finds its feet anew in every step."""
        if self.sliding == "small":
            self._anchor = None


def _held_at_end(state: PairState) -> Bools:
    return np.asarray(state.at_end | (state.slips > 1))


def _closing(normal: Array, gap: Array, free: Bools) -> Array:
    """Displacement of the free components that closes a gap ``(k, gdim)``."""
    n = normal * free
    nn = np.einsum("kg,kg->k", n, n)
    return n * (-gap / np.where(nn > 0, nn, np.inf))[:, None]
