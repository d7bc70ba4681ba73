"""From projections to uniting equations: which contactors are active, what each of them is united to.

Fourth step on the data's way [UEM, 4.1-4.4]. A pair keeps a trial state that changes with every iteration and a committed one
that changes only after convergence.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations
from uem_dolfinx.contact.bernstein import ControlGaps
from uem_dolfinx.contact.checks import TOUCHING, check_finite
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.contact.valleys import FacetChanges
from uem_dolfinx.geometry.projection import FacetProjection, Projection, Target
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.log import timed

if TYPE_CHECKING:
    from collections.abc import Mapping

    from uem_dolfinx.contact.corners import Corners
    from uem_dolfinx.geometry.configuration import Configuration

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

#: A contactor past an open end by more than this part of its facet has slid off.
SLID_OFF = 1e-6
#: A contactor that came back after it had slid off is held at the end of the target, up to this part of the facet beyond it.
END_HOLDS = 0.1
#: Gaps below this part of the model's size are zero.
GAP_ROUNDING = 1e-13
#: Contactors nearer than this many facets keep a row in the sparsity of P.
NEAR = 1.0
#: Normal return may change nodal forces by this part of the largest contact force.
GENTLE = 0.1


class ContactPair:
    """Contactor nodes against one target: projection, activation, release, uniting equations.

    Args:
        config: configuration of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        target: what they may touch.
        free: components without Dirichlet condition of all owned nodes ``(n_owned, gdim)``.
        name: for messages.
        sliding: ``"finite"`` projects in every iteration, ``"small"`` at the start of every step, ``"fixed"`` once.
        max_penetration: bound on the initial penetration, a length.
        thickness: of the target's body, a length: what has passed its end and is deeper than this lies behind it.
        chords: approximate curved facets by straight pieces in P, and there alone.
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
        thickness: float = np.inf,
        chords: bool = False,
    ):
        self.config, self.nodes, self.target, self.name = config, nodes, target, name
        self.sliding, self.max_penetration, self.thickness, self.chords = sliding, max_penetration, thickness, chords
        #: Depth of the deepest contactor inside the target before the first step, a length.
        self.initial_overlap = 0.0
        n = len(nodes)
        self.free, self._free = free[nodes], free
        #: Whether any contactor on any rank is prescribed in some direction.
        self.prescribed = bool(config.comm.allreduce(int(not self.free.all())))
        self.trial = self.last_commit = self.committed = PairState.initial(n, config.gdim)
        self.projection: Projection
        #: Gaps that decide on contact ``(n,)``: nodal gaps, or control gaps on a degree-2 surface.
        self.gap: Array = np.zeros(n)
        self.control = ControlGaps(config, nodes) if config.degree == 2 else None
        #: Whether a pair that follows these contactors has contactors that this pair follows (two-pass); found by the system.
        self.mutual = False
        #: Active contactors whose equations depend on others and were left out ``(n,)``.
        self.redundant: Bools = np.zeros(n, dtype=bool)
        #: Number of equations of the last call of ``equations``.
        self.n_equations = 0
        self._united: Ints = np.zeros(0, dtype=np.int64)
        self._reserved: Bools = np.zeros(n, dtype=bool)
        self._anchor: Projection | None = None
        #: Positions of contactors and target of the last search, and what it found.
        self._searched: tuple[Array, Array, Projection] | None = None
        self._target_moves: Bools | None = None
        self._facet_changes: FacetChanges | None = None
        if sliding == "finite" and isinstance(target, MeshTarget) and not target.averaged:
            # normals jump from facet to facet
            self._facet_changes = FacetChanges(config, target, self.free)

    # -- projection ------------------------------------------------------------------------------------------------

    @property
    def points(self) -> Array:
        """Current positions of the contactors ``(n, gdim)``."""
        return self.config.X[self.nodes] + self.config.displacement[self.nodes]

    @timed("projection")
    def project(self) -> None:
        """Project the contactors onto the target where both are now (collective)."""
        if self.sliding == "finite":
            self.projection = self._held_at_end(self._nearest())
            if self._facet_changes is not None:
                self.projection = self._facet_changes.place(self.projection, self.trial, self.points)
        elif self._anchor is None:
            self._anchor = self.projection = self.target.project(self.points)
        else:
            self.projection = self.target.follow(self.points, self._anchor)
        check_finite(self)
        if self.prescribed:
            self._ask_target()
        self._measure()

    def _measure(self) -> None:
        """Gaps of the present projection (collective)."""
        self.gap = self.projection.gap
        if self.control is not None:
            self.control.look(self.projection, ~self.off & (self.trial.held < 0).all(axis=1))
            self._update_control()

    def _update_control(self) -> None:
        """Control gaps of the present active set (collective)."""
        if self.control is not None:
            self.control.follow(self.trial.active)
            self.gap = self.control.gaps(self.projection.gap)

    def _held_at_end(self, nearest: Projection) -> Projection:
        """Move the feet of contactors that the target's end holds out to where they are: force and reaction stay on one line."""
        if not isinstance(nearest, FacetProjection):
            return nearest
        assert isinstance(self.target, MeshTarget)
        i = np.flatnonzero(self.trial.active & (self.trial.slips > 1) & (nearest.beyond * self.free != 0).any(axis=1))
        return nearest.reaching_out(i, self.target.shape) if len(i) else nearest

    def _nearest(self) -> Projection:
        """The contactors on the nearest places of the target; nothing is searched again where nothing has moved (collective)."""
        if not isinstance(self.target, MeshTarget):
            return self.target.project(self.points)
        points, x = self.points, self.target.facets.x
        same = self._searched is not None and np.array_equal(points, self._searched[0]) and np.array_equal(x, self._searched[1])
        if self._searched is None or not self.config.comm.allreduce(same, op=MPI.LAND):
            self._searched = points, x, self.target.project(points)
        return self._searched[2]

    @property
    def _corners(self) -> Corners | None:
        """Corners of the target that hold contactors, None if no rank has any."""
        return self._facet_changes.corners if self._facet_changes is not None else None

    def refresh_corners(self) -> None:
        """Put contactors that have entered or left a corner where they now belong (collective)."""
        if self._facet_changes is not None:
            self.projection = self._facet_changes.place_again(self.trial, self.points)
            self._measure()

    def return_to_target(self, stiffness: Array) -> None:
        """Normal return [UEM, 4.2]: put the active contactors back onto the moved target.

        A return that would disturb the contact forces is left to the next linear solve, which moves the whole body with it.

        Args:
            stiffness: diagonal of K at the owned nodes ``(n_owned, gdim)``, a force per length.
        """
        i = np.flatnonzero(self.trial.active)
        p = self.projection
        correction = self._along(p.normal[i], self.gap[i], self.free[i])
        if self._corners is not None:
            c = self._corners
            at = np.zeros((len(self.nodes), self.config.gdim))
            at[i] = correction
            gaps = c.gaps(self.points[c.which])
            for r in range(1, self.config.gdim):
                here = self.trial.active[c.which] & (r < c.count)
                at[c.which] += here[:, None] * self._along(c.axes[:, r], gaps[:, r], self.free[c.which])
            correction = at[i]
        disturbance = np.abs(stiffness[self.nodes[i]] * correction).max(axis=1)
        correction[disturbance > GENTLE * max(self.config.comm.allgather(self.trial.lam.max(initial=0.0)))] = 0.0
        self.config.displacement[self.nodes[i]] += correction
        gap = np.array(p.gap)
        gap[i] += np.einsum("ng,ng->n", correction, p.normal[i])
        if isinstance(self.target, MeshTarget) and self.target.averaged:
            # the foot moves when the way leans
            self.project()
        else:
            self.projection = p.with_gap(gap)
            self._measure()

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
        here = np.abs(self.gap[self.trial.active & ~self.redundant]).max(initial=0.0)
        return float(max(self.config.comm.allgather(here)))

    @property
    def off(self) -> Bools:
        """Contactors that have slid past an open end of the target in a direction in which they can move ``(n,)``.

        Round the end of a thin target they come behind it, where a negative gap is no penetration.
        """
        beyond = np.linalg.norm(self.projection.beyond * self.free, axis=1)
        if not isinstance(self.projection, FacetProjection):
            return beyond > 0
        x = self.projection.x
        limit = np.where(self.trial.slips > 1, END_HOLDS, SLID_OFF)
        behind = self.trial.passed & (self.projection.gap < -self.thickness)
        return behind | (beyond > limit * np.linalg.norm(x[:, 0] - x[:, 1], axis=1))

    # -- activation and release ------------------------------------------------------------------------------------

    @property
    def movable(self) -> Bools:
        """Contactors that can move along the normal, or whose target can, for all the Dirichlet conditions ``(n,)``."""
        own = np.linalg.norm(self.projection.normal * self.free, axis=1) > MOSTLY_PRESCRIBED
        return own if self._target_moves is None else own | self._target_moves

    def _ask_target(self) -> None:
        """Find out which targets can move along the normal (collective)."""
        p = self.projection
        if p.nodes.shape[1]:
            moves = self.config.ask_owners(p.nodes.ravel(), self._free.astype(float)).reshape(*p.nodes.shape, self.config.gdim)
            moves = np.abs(p.weights[:, :, None] * p.normal[:, None] * moves).max(axis=(1, 2))
            self._target_moves = moves > MOSTLY_PRESCRIBED

    def touch(self) -> None:
        """Start with the contactors that touch without force as active."""
        touching = np.abs(self.gap) <= TOUCHING * self.config.size
        self.trial = replace(self.trial, active=self.trial.active | (touching & ~self.off & self.movable))
        # a first step that fails and is cut starts from here again
        self.committed = self.last_commit = self.trial
        self._update_control()

    @property
    def _ahead(self) -> Ints:
        """Contactors in front of the target that are not active."""
        return np.flatnonzero(~self.trial.active & ~self.off & self.movable)

    @property
    def approach(self) -> UnitingEquations:
        """The equations that all contactors in front of the target would have, of those that are not active."""
        p, i = self.projection, self._ahead
        return UnitingEquations.along(self.nodes[i], p.normal[i], p.nodes[i], p.weights[i], p.gap[i], np.ones(len(i), bool))

    def land(self, closing: Bools) -> bool:
        """Activate the contactors among those of ``approach`` that close and touch (collective): whether there are any."""
        i = self._ahead
        touching = i[closing & (self.projection.gap[i] <= TOUCHING * self.config.size)]
        active = self.trial.active.copy()
        active[touching] = True
        self.trial = replace(self.trial, active=active)
        self._update_control()
        return bool(self.config.comm.allreduce(len(touching)))

    def predict(self, ratio: float) -> None:
        """First active set of a step, extrapolated from the last one; call it projected at the extrapolated displacement.

        Args:
            ratio: this step's length over the last one's.
        """
        lam = self.committed.lam + ratio * (self.committed.lam - self.last_commit.lam)
        entering = (self.gap < 0) & ~self.off & self.movable
        self.trial = replace(self.trial, active=np.where(self.committed.active, lam >= 0, entering))
        self._update_control()

    def decide(self, force_rounding: float, cautious: bool, settled: bool) -> bool:
        """Release contactors in tension, activate penetrating ones (collective).

        Args:
            force_rounding: forces below it are zero.
            cautious: change only the worst contactor, and release none before equilibrium: this ends a cycle of active sets.
            settled: whether the bodies are in equilibrium with the present active set.

        Returns:
            Whether any rank changed what its contactors are united to.
        """
        comm, state, off = self.config.comm, self.trial, self.off
        gap = self.gap
        release = state.active & ((state.lam < -force_rounding) | off | ~self.movable)
        enter = ~state.active & ~off & self.movable & (gap < -GAP_ROUNDING * self.config.size)
        if self.thickness < np.inf and not settled:
            # on the way to equilibrium a thin target sweeps past what has slid off it
            enter &= state.slips == 0
        worst = [-np.min(gap[enter], initial=0.0), -np.min(state.lam[release], initial=0.0)]
        deepest, tension = np.max(comm.allgather(worst), axis=0)
        entering, touching = comm.allreduce(np.array([enter.sum(), state.active.sum()]))
        if entering > touching:
            # a body that comes down on a paraboloid touches where the overlap exceeds half of the deepest
            enter &= gap <= -0.5 * deepest
        if cautious:
            enter &= (gap <= -deepest) | (state.slips > 1)
            release &= off | (state.lam <= -tension) if settled and deepest == 0.0 else off
        active = (state.active | enter) & ~release
        slips = state.slips + (release & off)
        passed = (state.passed | (release & off)) & ~active
        # nodal forces stay until they are read anew: the next iteration is no better without the curvature of what is released
        self.trial = replace(state, active=active, lam=np.where(active, state.lam, 0.0), slips=slips, passed=passed)
        changed = bool(enter.any() or release.any())
        if self._facet_changes is not None:
            self.trial, left = self._facet_changes.leave(self.trial, settled or not cautious)
            self.trial, entered = self._facet_changes.follow(self.trial, self.points)
            changed |= left or entered
        self._update_control()
        return bool(comm.allreduce(changed))

    # -- what the united system gets ---------------------------------------------------------------------------------

    def equations(self, chords: bool = False) -> UnitingEquations:
        """Uniting equations of the contactors that are or may become active; two for one held in a corner.

        Args:
            chords: take the weights of the straight pieces between the target's nodes, if this pair is to.
        """
        i = self._united = np.flatnonzero(self._near())
        p, active, weights = self.projection, self.trial.active, self.projection.weights[i]
        if chords and self.chords and isinstance(p, FacetProjection):
            plain: Bools = np.all(self.trial.held[i] < 0, axis=1)
            assert isinstance(self.target, MeshTarget)
            weights = np.where(plain[:, None], self.target.shape.chords(p.xi[i]), weights)
        first = UnitingEquations.along(self.nodes[i], p.normal[i], p.nodes[i], weights, self.gap[i], active[i])
        if self.control is not None:
            first = self.control.extend(first, i, active)
        self.n_equations = len(first)
        c = self._corners
        if c is None:
            return first
        parts, gaps = [first], c.gaps(self.points[c.which])
        for r in range(1, self.config.gdim):
            j = np.flatnonzero(r < c.count)
            w = c.which[j]
            parts.append(UnitingEquations.along(self.nodes[w], c.axes[j, r], c.nodes[j], c.weights[j], gaps[j, r], active[w]))
        self.n_equations = sum(len(part) for part in parts)
        return UnitingEquations.join(parts, self.config.gdim)

    def _near(self) -> Bools:
        """Contactors with a row in P ``(n,)``: those about a facet from the target, looked for anew when an active one lacks.

        Where nothing touches at the start of a step, none has one until something does.
        """
        p = self.projection
        if (self.trial.active & ~self._reserved).any():
            # a rigid surface has no facets to measure by
            self._reserved = np.ones_like(self._reserved)
            if isinstance(p, FacetProjection):
                near = p.gap < NEAR * np.linalg.norm(p.x[:, 0] - p.x[:, 1], axis=1)
                self._reserved = self.trial.active | (near & ~self.off)
        return self._reserved

    def read_forces(self, lam: Array, redundant: Bools) -> None:
        """Take the contact forces, and which equations were left out, in the order of ``equations``."""
        i = self._united
        self.redundant = np.zeros(len(self.nodes), dtype=bool)
        self.redundant[i] = redundant[: len(i)]
        full = np.zeros(len(self.nodes))
        full[i] = lam[: len(i)]
        nodal = full
        if self.control is not None:
            full, nodal = self.control.forces(full, self.trial.active)
        force = nodal[:, None] * self.projection.normal
        c = self._corners
        if c is not None:
            start = len(i)
            for r in range(1, self.config.gdim):
                j = np.flatnonzero(r < c.count)
                force[c.which[j]] += lam[start : start + len(j), None] * c.axes[j, r]
                start += len(j)
        self.trial = replace(self.trial, lam=full, nodal=nodal, force=force)

    def curvature(self) -> tuple[Ints, Array]:
        """Blocks of ``-sum lambda grad^2 g``: global nodes ``(k, 1 + nn)`` and values ``(k, (1 + nn) g, (1 + nn) g)``."""
        state, p, c = self.trial, self.projection, self._corners
        plain = ((state.lam > 0) | ~state.active) & (state.nodal != 0) & (state.held < 0).all(axis=1)
        i = np.flatnonzero(plain) if self.sliding == "finite" else np.zeros(0, np.int64)
        own, followed, blocks = self.nodes[i], p.nodes[i], -state.nodal[i, None, None] * p.hessians(i)
        if c is not None:
            own = np.concatenate([own, self.nodes[c.which]])
            followed = np.concatenate([followed, c.nodes])
            blocks = np.concatenate([blocks, -c.hessians(state.force[c.which])])
        return np.column_stack([self.config.to_global(own), followed]), blocks

    # -- trial and committed -----------------------------------------------------------------------------------------

    def commit(self) -> None:
        """Make the trial state the committed one."""
        slips = np.where(self.trial.active, self.trial.slips, 0)
        passed = self.off | (self.trial.passed & (self.projection.gap < 0))
        fresh = replace(self.trial, changes=np.zeros_like(slips), slips=slips, passed=passed)
        self.last_commit, self.committed = self.committed, fresh
        self.restore()
        if self.sliding == "small":
            self._anchor = None
        if not self.trial.active.any():
            self._reserved = np.zeros_like(self._reserved)

    def restore(self) -> None:
        """Go back to the committed state."""
        self.trial = self.committed
        if self._facet_changes is not None:
            self._facet_changes.corners = None

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays ``(n, ...)`` that a run goes on from, facets by what tells them in any partition (collective)."""
        kept: dict[str, npt.NDArray[Any]] = {"reserved": self._reserved, "redundant": self.redundant}
        for when, state in (("committed", self.committed), ("last", self.last_commit)):
            kept |= {f"{when}_{name}": array for name, array in state.to_checkpoint(self.target).items()}
        return kept

    def from_checkpoint(self, kept: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from what ``to_checkpoint`` returned, to be followed by ``project`` (collective)."""

        def state(when: str) -> PairState:
            return PairState.from_checkpoint({f.name: kept[f"{when}_{f.name}"] for f in fields(PairState)}, self.target)

        self._reserved, self.redundant = np.array(kept["reserved"]), np.array(kept["redundant"])
        self.committed, self.last_commit = state("committed"), state("last")
        if self.sliding == "small":
            self._anchor = None
        self.restore()
