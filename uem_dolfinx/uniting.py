"""From projections to uniting equations: which contactors are active, what each of them is united to.

Fourth step on the data's way [UEM, 4.1-4.4]. A pair keeps a trial state that changes with every iteration and a committed one
that changes only after convergence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from uem_dolfinx.errors import ConflictError, PenetrationError, agree
from uem_dolfinx.restriction import MOSTLY_PRESCRIBED
from uem_dolfinx.search import FacetProjection, MeshTarget, Projection, Target, gap_hessians
from uem_dolfinx.shapes import closest_point

if TYPE_CHECKING:
    from uem_dolfinx.surfaces import Configuration

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

#: A contactor past an open end by more than this part of its facet has slid off.
SLID_OFF = 1e-6
#: Gaps below this part of the model's size are zero.
GAP_ROUNDING = 1e-13
#: A body touches at the start when its gap is below this part of the model's size.
TOUCHING = 1e-9
#: Contactors nearer than this many facets keep a row in the sparsity of P.
NEAR = 1.0
#: Normal return may change nodal forces by this part of the largest contact force.
GENTLE = 0.1
#: Facets whose slopes differ by less are one plane.
ON_PLANE = 1e-9
#: A contactor that changed facets to and fro this often in a step is held by averaged normals for the rest of it.
MOST_FLIPS = 4


@dataclass(frozen=True)
class UnitingEquations:
    """Scalar equations ``direction . (du_node - sum_a weights_a du_a) = -gap`` [UEM, 4.1 and 6.1].

    Attributes:
        node: local number of the owned node whose displacement is eliminated ``(m,)``.
        direction: unit vectors ``(m, gdim)``.
        targets: global block numbers of the nodes it follows ``(m, nn)``, -1 for none.
        weights: ``(m, nn)``.
        gap: lengths ``(m,)``.
        active: whether the equation holds ``(m,)``; one that does not only keeps its place in the sparsity of P, so that
            contactors can be activated and released without new symbolic work.
    """

    node: npt.NDArray[np.int32]
    direction: Array
    targets: Ints
    weights: Array
    gap: Array
    active: Bools

    def __len__(self) -> int:
        return len(self.node)

    @staticmethod
    def join(parts: list[UnitingEquations], gdim: int) -> UnitingEquations:
        """All equations of several pairs, padded to the same number of target nodes."""
        if not parts:
            return UnitingEquations(
                np.zeros(0, np.int32), np.zeros((0, gdim)), np.zeros((0, 0), np.int64), np.zeros((0, 0)), np.zeros(0),
                np.zeros(0, bool),
            )  # fmt: skip
        width = max(p.targets.shape[1] for p in parts)

        def pad(a: npt.NDArray[np.generic], fill: float) -> npt.NDArray[np.generic]:
            return np.pad(a, ((0, 0), (0, width - a.shape[1])), constant_values=fill)

        return UnitingEquations(
            np.concatenate([p.node for p in parts]),
            np.concatenate([p.direction for p in parts]),
            np.concatenate([pad(p.targets, -1) for p in parts]),
            np.concatenate([pad(p.weights, 0.0) for p in parts]),
            np.concatenate([p.gap for p in parts]),
            np.concatenate([p.active for p in parts]),
        )


@dataclass(frozen=True)
class PairState:
    """What a pair remembers of its contactors; frozen so that trial and committed never share an array by accident.

    Attributes:
        active: united to the target ``(n,)``.
        lam: contact force along the normal, positive in compression ``(n,)``.
        force: contact force on the contactor ``(n, gdim)``.
        facet: facet that the contactor is on ``(n,)``, -1 before the first projection.
        before: facet that it was on before ``(n,)``.
        held: second facet of a contactor that rests in a concave corner of the target, or -1 ``(n,)``.
        flips: how often in this step it came back to the facet it had left ``(n,)``.
    """

    active: Bools
    lam: Array
    force: Array
    facet: Ints
    before: Ints
    held: Ints
    flips: Ints


@dataclass(frozen=True)
class Corners:
    """Contactors held by the side that two target facets share.

    Attributes:
        which: their places among the pair's contactors ``(k,)``.
        normals: of the two facets ``(k, 2, gdim)``.
        rising: how far the second facet rises above the first one's plane, as a slope ``(k,)``; positive if concave.
        shared: whether the facets share a side at all ``(k,)``.
        nodes: global nodes of the first facet ``(k, nn)``.
        weights: shape functions at the closest point of the shared side ``(k, nn)``.
        foot: that point ``(k, gdim)``.
        x: positions of the nodes ``(k, nn, gdim)``.
        dN: derivatives of the weights along the side ``(k, nn, fdim - 1)``.
        ddN: second derivatives ``(k, nn, fdim - 1, fdim - 1)``.
    """

    which: Ints
    normals: Array
    rising: Array
    shared: Bools
    nodes: Ints
    weights: Array
    foot: Array
    x: Array
    dN: Array
    ddN: Array

    @property
    def axes(self) -> Array:
        """Orthonormal basis of the plane of the two normals, their bisector first ``(k, 2, gdim)``."""
        a = np.stack([self.normals[:, 0] + self.normals[:, 1], self.normals[:, 0] - self.normals[:, 1]], axis=1)
        return a / np.maximum(np.linalg.norm(a, axis=2, keepdims=True), np.finfo(float).tiny)


class ContactPair:
    """Contactor nodes against one target: projection, activation, release, uniting equations.

    Args:
        config: configuration of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        target: what they may touch.
        free: their components without Dirichlet condition ``(n, gdim)``.
        name: for messages.
        sliding: ``"finite"`` projects in every iteration, ``"small"`` at the start of every step, ``"fixed"`` once.
        max_penetration: bound on the initial penetration, a length.
    """

    def __init__(
        self,
        config: Configuration,
        nodes: npt.NDArray[np.int32],
        target: Target,
        *,
        free: Bools,
        name: str,
        sliding: str,
        max_penetration: float,
    ):
        self.config, self.nodes, self.target, self.name = config, nodes, target, name
        self.sliding, self.max_penetration = sliding, max_penetration
        n = len(nodes)
        self.free = free
        none = np.full(n, -1, dtype=np.int64)
        self.committed = PairState(
            np.zeros(n, bool), np.zeros(n), np.zeros((n, config.gdim)), none, none, none, np.zeros(n, np.int64)
        )
        self.trial = self.last_commit = self.committed
        self.projection: Projection
        #: Number of equations of the last call of ``equations``.
        self.n_equations = 0
        self._united: Ints = none
        self._reserved: Bools = np.zeros(n, dtype=bool)
        self._anchor: Projection | None = None
        self._corners: Corners | None = None

    # -- projection ------------------------------------------------------------------------------------------------

    @property
    def points(self) -> Array:
        """Current positions of the contactors ``(n, gdim)``."""
        return self.config.X[self.nodes] + self.config.displacement[self.nodes]

    def project(self) -> None:
        """Project the contactors onto the target where both are now (collective)."""
        if self.sliding == "finite":
            self.projection = self._in_corners(self.target.project(self.points))
        elif self._anchor is None:
            self._anchor = self.projection = self.target.project(self.points)
        else:
            self.projection = self.target.follow(self.points, self._anchor)

    @property
    def _has_corners(self) -> bool:
        """Whether facet normals jump under the contactors at all."""
        return self.sliding == "finite" and isinstance(self.target, MeshTarget) and not self.target.averaged

    def _in_corners(self, projection: Projection) -> Projection:
        """Replace the nearest facet by the held corner, or by averaged normals, where a contactor chatters."""
        if not self._has_corners:
            return projection
        assert isinstance(projection, FacetProjection)
        state = self.trial
        locked = state.flips >= MOST_FLIPS
        gap = np.einsum("ng,ng->n", projection.averaged, self.points - projection.foot)
        normal = np.where(locked[:, None], projection.averaged, projection.normal)
        projection = replace(projection, normal=normal, gap=np.where(locked, gap, projection.gap))
        # a corner is left when another facet has become the nearest
        near = (projection.facet == state.facet) | (projection.facet == state.held)
        held = np.where((state.held >= 0) & near, state.held, -1)
        self.trial = replace(state, held=held)
        self._corners = self._corner(np.flatnonzero(held >= 0), held)
        if self._corners is None:
            return projection
        c = self._corners
        updates: dict[str, npt.NDArray[np.generic]] = {}
        values = {
            "normal": c.axes[:, 0], "nodes": c.nodes, "weights": c.weights, "foot": c.foot, "facet": state.facet[c.which],
            "gap": np.einsum("kg,kg->k", c.axes[:, 0], self.points[c.which] - c.foot),
        }
        for field, value in values.items():
            full = np.array(getattr(projection, field))
            full[c.which] = value
            updates[field] = full
        return replace(projection, **updates)

    def _corner(self, which: Ints, other: Ints) -> Corners | None:
        """Geometry of the corners between ``facet`` and ``other`` at some contactors; None if no rank has any."""
        if not self.config.comm.allreduce(len(which)):
            return None
        assert isinstance(self.target, MeshTarget)
        points = self.points[which]
        first = self.target.project_on(points, self.trial.facet[which])
        second = self.target.project_on(points, other[which])
        k, nn = first.weights.shape
        d = self.target.shape.dim - 1
        weights, foot, shared = np.zeros((k, nn)), np.zeros_like(points), np.zeros(k, bool)
        dN, ddN = np.zeros((k, nn, d)), np.zeros((k, nn, d, d))
        common = (first.nodes[:, :, None] == second.nodes[:, None, :]).any(axis=2)
        for side, nodes, _, _ in self.target.shape.edges():
            i = np.flatnonzero(common[:, nodes].all(axis=1) & ~shared)
            x = first.x[i][:, nodes]
            s, _ = closest_point(side, x, points[i])
            tab = side.tabulate(s)
            weights[i[:, None], nodes], dN[i[:, None], nodes], ddN[i[:, None], nodes] = tab.N, tab.dN, tab.ddN
            foot[i] = np.einsum("ka,kag->kg", tab.N, x)
            shared[i] = True
        normals = np.stack([self.target.outward(first), self.target.outward(second)], axis=1)
        arm = second.x.mean(axis=1) - foot
        rising = np.einsum("kg,kg->k", arm, normals[:, 0]) / np.linalg.norm(arm, axis=1)
        return Corners(which, normals, rising, shared, first.nodes, weights, foot, first.x, dN, ddN)

    def refresh_corners(self) -> None:
        """Project again after contactors have entered or left corners (collective)."""
        if self._has_corners:
            self.project()

    def return_to_target(self, stiffness: Array) -> None:
        """Normal return [UEM, 4.2]: put the active contactors back onto the moved target.

        A return that would disturb the contact forces is left to the next linear solve, which moves the whole body with it.

        Args:
            stiffness: diagonal of K at the owned nodes ``(n_owned, gdim)``, a force per length.
        """
        i = np.flatnonzero(self.trial.active)
        p = self.projection
        correction = self._along(p.normal[i], p.gap[i], self.free[i])
        if self._corners is not None:
            c = self._corners
            at = np.zeros((len(self.nodes), self.config.gdim))
            at[i] = correction
            gap = np.einsum("kg,kg->k", c.axes[:, 1], self.points[c.which] - c.foot)
            at[c.which] += self.trial.active[c.which, None] * self._along(c.axes[:, 1], gap, self.free[c.which])
            correction = at[i]
        disturbance = np.abs(stiffness[self.nodes[i]] * correction).max(axis=1)
        correction[disturbance > GENTLE * max(self.config.comm.allgather(self.trial.lam.max(initial=0.0)))] = 0.0
        self.config.displacement[self.nodes[i]] += correction
        gap = np.array(p.gap)
        gap[i] += np.einsum("ng,ng->n", correction, p.normal[i])
        self.projection = replace(p, gap=gap)

    @staticmethod
    def _along(normal: Array, gap: Array, free: Bools) -> Array:
        """Displacement of the free components that closes a gap ``(k, gdim)``."""
        n = normal * free
        nn = np.einsum("kg,kg->k", n, n)
        return n * (-gap / np.where(nn > 0, nn, np.inf))[:, None]

    @property
    def n_active(self) -> int:
        """Number of active contactors over all ranks (collective)."""
        return int(self.config.comm.allreduce(int(self.trial.active.sum())))

    def largest_gap(self) -> float:
        """Largest gap of an active contactor over all ranks, a length (collective)."""
        here = np.abs(self.projection.gap[self.trial.active]).max(initial=0.0)
        return float(max(self.config.comm.allgather(here)))

    def check_initial(self) -> None:
        """Refuse an initial penetration beyond the bound (collective).

        Raises:
            PenetrationError: naming the deepest node of the first rank that has one.
        """
        gap = np.where(self.off, np.inf, self.projection.gap)
        error = None
        if len(gap) and gap.min() < -self.max_penetration:
            i = int(gap.argmin())
            error = PenetrationError(
                f"{self.name}: the contactor at {self.config.describe(int(self.nodes[i]))} starts {-gap[i]:.4g} inside the target, "
                f"more than max_penetration = {self.max_penetration:.4g}: move the bodies apart, restrict the surfaces to the parts "
                "that can touch, or raise max_penetration if this interference is meant"
            )
        agree(self.config.comm, error)

    @property
    def off(self) -> Bools:
        """Contactors that have slid past an open end of the target in a direction in which they can move ``(n,)``."""
        beyond = np.linalg.norm(self.projection.beyond * self.free, axis=1)
        if not isinstance(self.projection, FacetProjection):
            return beyond > 0
        x = self.projection.x
        return beyond > SLID_OFF * np.linalg.norm(x[:, 0] - x[:, 1], axis=1)

    # -- activation and release ------------------------------------------------------------------------------------

    @property
    def movable(self) -> Bools:
        """Contactors whose Dirichlet conditions leave them some motion along the normal ``(n,)``."""
        return np.linalg.norm(self.projection.normal * self.free, axis=1) > MOSTLY_PRESCRIBED

    def touch(self) -> None:
        """Start with the contactors that touch without force as active."""
        touching = np.abs(self.projection.gap) <= TOUCHING * self.config.size
        self.trial = replace(self.trial, active=self.trial.active | (touching & ~self.off & self.movable))

    def check_prescribed(self) -> None:
        """Refuse an equilibrium in which a contactor is held inside the target by its Dirichlet conditions (collective).

        Raises:
            ConflictError: naming the deepest such node of the first rank that has one.
        """
        inside = ~self.movable & ~self.off & (self.projection.gap < -TOUCHING * self.config.size)
        error = None
        if inside.any():
            i = int(np.argmin(np.where(inside, self.projection.gap, np.inf)))
            error = ConflictError(
                f"{self.name}: the contactor at {self.config.describe(int(self.nodes[i]))} is prescribed to be "
                f"{-self.projection.gap[i]:.4g} inside the target, where a Dirichlet condition fights the uniting equation: "
                "release the condition along the normal, or make the other surface the contactor"
            )
        agree(self.config.comm, error)

    def predict(self, ratio: float) -> None:
        """First active set of a step, extrapolated from the last one; call it projected at the extrapolated displacement.

        Args:
            ratio: this step's length over the last one's.
        """
        lam = self.committed.lam + ratio * (self.committed.lam - self.last_commit.lam)
        entering = (self.projection.gap < 0) & ~self.off & self.movable
        self.trial = replace(self.trial, active=np.where(self.committed.active, lam >= 0, entering))

    def decide(self, force_rounding: float, cautious: bool) -> bool:
        """Release contactors in tension, activate penetrating ones (collective).

        Args:
            force_rounding: forces below it are zero.
            cautious: change only the worst contactor, which ends a cycle of active sets.

        Returns:
            Whether any rank changed what its contactors are united to.
        """
        comm, state, off = self.config.comm, self.trial, self.off
        gap = self.projection.gap
        release = state.active & ((state.lam < -force_rounding) | off | ~self.movable)
        enter = ~state.active & ~off & self.movable & (gap < -GAP_ROUNDING * self.config.size)
        worst = [-np.min(gap[enter], initial=0.0), -np.min(state.lam[release], initial=0.0), float(state.active.any())]
        deepest, tension, touched = np.max(comm.allgather(worst), axis=0)
        if not touched:
            # a body that comes down on a paraboloid touches where the overlap exceeds half of the deepest
            enter &= gap <= -0.5 * deepest
        if cautious:
            enter &= gap <= -deepest
            release &= off | (state.lam <= -tension) if deepest == 0.0 else off
        active = (state.active | enter) & ~release
        self.trial = replace(state, active=active, lam=np.where(active, state.lam, 0.0))
        changed = bool(enter.any() or release.any())
        if self._has_corners:
            changed |= self._leave_corners()
            changed |= self._enter_corners()
        return bool(comm.allreduce(changed))

    def _leave_corners(self) -> bool:
        """Let go of the facet of a corner that would have to pull."""
        c = self._corners
        if c is None or not len(c.which):
            return False
        i, state = c.which, self.trial
        pull = np.einsum("kgr,kg->kr", np.linalg.pinv(c.normals), state.force[i])
        leaving = ~state.active[i] | (pull < 0).any(axis=1)
        facet, held = state.facet.copy(), state.held.copy()
        to_second = leaving & (pull[:, 0] < pull[:, 1])
        facet[i[to_second]] = held[i[to_second]]
        held[i[leaving]] = -1
        self.trial = replace(state, facet=facet, held=held)
        return bool(leaving.any())

    def _enter_corners(self) -> bool:
        """Notice contactors that flip between two facets, and hold those in a concave corner by both (collective)."""
        state, facet = self.trial, self.projection.facet
        free = state.held < 0
        moved = free & (facet != state.facet) & (state.facet >= 0)
        back = moved & state.active & (facet == state.before)
        other = state.facet
        self.trial = state = replace(
            state, facet=np.where(free, facet, state.facet), before=np.where(moved, state.facet, state.before)
        )
        c = self._corner(np.flatnonzero(back), other)
        if c is None:
            return False
        bent = np.abs(c.rising) > ON_PLANE
        hold = bent & c.shared & (c.rising > 0) & (state.flips[c.which] < MOST_FLIPS)
        flips, held = state.flips.copy(), state.held.copy()
        flips[c.which[bent]] += 1
        # what is no concave corner can only be calmed by a continuous normal
        flips[c.which[bent & ~hold]] = MOST_FLIPS
        held[c.which[hold]] = other[c.which[hold]]
        self.trial = replace(state, flips=flips, held=held)
        return bool(bent.any())

    # -- what the united system gets ---------------------------------------------------------------------------------

    def equations(self) -> UnitingEquations:
        """Uniting equations of the contactors that are or may become active; two for one held in a corner."""
        i = self._united = np.flatnonzero(self._near())
        p, active = self.projection, self.trial.active
        first = UnitingEquations(self.nodes[i], p.normal[i], p.nodes[i], p.weights[i], p.gap[i], active[i])
        self.n_equations = len(first)
        c = self._corners
        if c is None:
            return first
        self.n_equations += len(c.which)
        gap = np.einsum("kg,kg->k", c.axes[:, 1], self.points[c.which] - c.foot)
        second = UnitingEquations(self.nodes[c.which], c.axes[:, 1], c.nodes, c.weights, gap, active[c.which])
        return UnitingEquations.join([first, second], self.config.gdim)

    def _near(self) -> Bools:
        """Contactors with a row in P ``(n,)``: those about a facet from the target, looked for anew when an active one lacks."""
        p = self.projection
        if not isinstance(p, FacetProjection):
            return np.ones(len(self.nodes), dtype=bool)
        if (self.trial.active & ~self._reserved).any():
            near = p.gap < NEAR * np.linalg.norm(p.x[:, 0] - p.x[:, 1], axis=1)
            self._reserved = self.trial.active | (near & ~self.off)
        return self._reserved

    def read_forces(self, lam: Array) -> None:
        """Take the contact forces, in the order of ``equations``."""
        i = self._united
        full = np.zeros(len(self.nodes))
        full[i] = lam[: len(i)]
        force = full[:, None] * self.projection.normal
        c = self._corners
        if c is not None:
            force[c.which] += lam[len(i) :, None] * c.axes[:, 1]
        self.trial = replace(self.trial, lam=full, force=force)

    def curvature(self) -> tuple[Ints, Array]:
        """Blocks of ``-sum lambda grad^2 g``: global nodes ``(k, 1 + nn)`` and values ``(k, (1 + nn) g, (1 + nn) g)``."""
        state, p, c = self.trial, self.projection, self._corners
        i = np.flatnonzero(state.active & (state.lam > 0) & (state.held < 0))
        if self.sliding != "finite":
            i = i[:0]
        own, followed, blocks = self.nodes[i], p.nodes[i], -state.lam[i, None, None] * p.hessians(i)
        if c is not None and c.dN.shape[2]:
            # on a side the force may lean either way; it is the force's direction that stays
            j = np.flatnonzero(state.active[c.which])
            w = c.which[j]
            size = np.linalg.norm(state.force[w], axis=1)
            n = state.force[w] / np.where(size > 0, size, 1.0)[:, None]
            H = gap_hessians(n, np.zeros(len(j)), c.weights[j], c.dN[j], c.ddN[j], c.x[j], np.zeros((len(j), 1, n.shape[1])))
            own, followed = np.concatenate([own, self.nodes[w]]), np.concatenate([followed, c.nodes[j]])
            blocks = np.concatenate([blocks, -size[:, None, None] * H])
        return np.column_stack([self.config.to_global(own), followed]), blocks

    # -- trial and committed -----------------------------------------------------------------------------------------

    def commit(self) -> None:
        """Make the trial state the committed one."""
        self.last_commit, self.committed = self.committed, replace(self.trial, flips=np.zeros_like(self.trial.flips))
        self.trial = self.committed
        self._corners = None
        if self.sliding == "small":
            self._anchor = None

    def restore(self) -> None:
        """Go back to the committed state."""
        self.trial = self.committed
        self._corners = None
