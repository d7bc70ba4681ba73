"""A contact pair with Coulomb friction: anchors, rows along the target, tilted test rows; ``friction`` decides who sticks and slips."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, cast

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints, sums_of_rows
from uem_dolfinx.contact import friction
from uem_dolfinx.contact.active_set import Wrong
from uem_dolfinx.contact.checks import check_driven
from uem_dolfinx.contact.corners import Corners, friction_in
from uem_dolfinx.contact.coupling import NORMAL, LabelledEquations
from uem_dolfinx.contact.pair import ContactPair
from uem_dolfinx.contact.slip_front import Front
from uem_dolfinx.contact.state import FrictionState, PairState
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.geometry.search import MeshTarget


class FrictionalPair(ContactPair):
    """Contactors against one target, with friction; other arguments as those of ``ContactPair``.

    Args:
        mu: coefficients of friction of the contactors ``(n,)``.
        free: components of the contactors without Dirichlet condition ``(n, gdim)``.
    """

    rough = True

    def __init__(self, *args: Any, mu: Array, free: Bools, **how: Any):
        super().__init__(*args, **how)
        self.mu, self.free = mu, free
        self.coupling.rub(mu)
        n, g = len(self.nodes), self.config.gdim
        self.trial = self.committed = replace(self.trial, friction=FrictionState.initial(n, g))
        #: Where the anchors are ``(n, gdim)``.
        self._anchors: Array = np.zeros((n, g))
        #: The last normals that directions along the target were made for, and these ``(n, gdim - 1, gdim)``.
        self._tangents: tuple[Array | None, Array] = None, np.zeros((n, g - 1, g))
        #: What contactors follow in a mean kept since the last step: weights, positions of the owned nodes, motion of a rigid target,
        #: shares; None where they are to be kept next; and how far contactors have moved since ``(n, gdim)``.
        self._kept: tuple[tuple[Ints, Ints, Array], Array, Motion | None, Array] | None = None
        self._moved: Array = np.zeros((n, g))
        #: In the present linearised problem: contactors that have been let go of, that slip the other way, and that slip ahead of the
        #: last that were to ``(n,)``; where these were and how far others go along.
        self._released, self._reversed, self._taken = np.zeros((3, n), dtype=bool)
        self._front = Front(self.config.comm)
        #: What that problem foretells: forces and slips.
        self._foreseen = np.zeros((n, g)), np.zeros((n, g))
        #: Friction that belongs to the forces last read or foreseen ``(n, gdim)``.
        self._told: Array = np.zeros((n, g))
        #: Forces q and stiffnesses c that the directions of slip come from ``(n, gdim)``, ``(n,)``, and the forces tau ``(n, gdim)``.
        self._q, self._c, self._tau = np.zeros((n, g)), np.zeros(n), np.zeros((n, g))

    # -- where the contactors stand --------------------------------------------------------------------------------------

    def project(self) -> None:
        """Project the contactors and find their anchors where both are now (collective); see ``ContactPair``."""
        super().project()
        f, target = self._rub(), self.target
        if not self.coupling.nodal:
            if self._kept is None:
                here = self.config.x[: self.config.n_owned].copy()
                self._kept = self.coupling.weights(self.placement), here, target.motion, self._shares
            weights, before, motion, _ = self._kept
            self._moved = self._relative(self._way_since(before, motion), weights)
            return
        if target.n_nodes:
            self._anchors = cast("MeshTarget", target).places(f.facet, f.xi) + f.anchor
        else:
            self._anchors = f.anchor if target.motion is None else target.motion.carry(f.anchor)

    def _way_since(self, before: Array, motion: Motion | None) -> Array:
        """Way of the owned nodes ``(n_owned, gdim)`` since they were at ``before``; of contactors less that of a rigid target."""
        way = self.config.x[: self.config.n_owned] - before
        now = self.target.motion
        if now is not motion:
            still = Motion.none(self.config.gdim)
            start = before[self.nodes]
            way[self.nodes] -= (now or still).carry((motion or still).back(start)) - start
        return way

    def _relative(self, du: Array, weights: tuple[Ints, Ints, Array]) -> Array:
        """How an increment ``(n_owned, gdim)`` moves contactors relative to what they follow ``(n, gdim)`` (collective)."""
        row, followed, weight = weights
        return du[self.nodes] - sums_of_rows(row, weight[:, None] * self.config.ask_owners(followed, du), len(self.nodes))

    @property
    def _off_anchor(self) -> Array:
        """How far contactors are from their anchors, or have moved since the last step ``(n, gdim)``."""
        return self.points - self._anchors if self.coupling.nodal else self._moved

    def _rub(self) -> FrictionState:
        assert self.trial.friction is not None
        return self.trial.friction

    @property
    def rubbing(self) -> Bools:
        """Active contactors that friction acts on ``(n,)``."""
        return self.trial.active & (self.mu > 0)

    @property
    def _corners(self) -> Corners | None:
        """Corners that hold contactors, along whose edges alone they rub; None if no rank has any."""
        return getattr(self.placement.details, "corners", None)

    @property
    def _cornered(self) -> Bools:
        """Contactors that a corner holds ``(n,)``."""
        held = np.zeros(len(self.nodes), dtype=bool)
        if self._corners is not None:
            held[self._corners.which] = True
        return held

    @property
    def slipping(self) -> Bools:
        """Contactors that slip ``(n,)``."""
        return self.rubbing & ~self._rub().stick

    @property
    def tangents(self) -> Array:
        """Directions along the target in free components ``(n, gdim - 1, gdim)`` (collective)."""
        normal = self.coupling.normals(self.placement, self.trial)
        if self._tangents[0] is not normal:
            normals, c = normal[:, None], self._corners
            if c is not None:
                more = np.zeros((len(self.nodes), *c.axes.shape[1:]))
                more[c.which] = np.where((np.arange(c.axes.shape[1]) < c.count[:, None])[:, :, None], c.axes, 0.0)
                normals = np.concatenate([normals, more], axis=1)
            self._tangents = normal, friction.tangents(normals, self.free)
        return self._tangents[1]

    @property
    def _shares(self) -> Array:
        return self.coupling.shares(self.placement, self.trial)

    @property
    def slip(self) -> Array:
        """Motion along the target since the last step; of a contactor that sticks, how far it is off its anchor ``(n, gdim)``."""
        return friction.along(self.tangents, self._off_anchor)

    @property
    def directions(self) -> Array:
        """Directions of slip, which turn with the surface ``(n, gdim)``; zero for contactors that do not slip."""
        s = friction.along(self.tangents, self._rub().direction)
        size = np.linalg.norm(s, axis=1, keepdims=True)
        return s / np.where(size > 0, size, 1.0)

    def tangential(self, force: Array) -> Array:
        """Parts of forces ``(n, gdim)`` along the target."""
        return friction.along(self.tangents, force)

    @property
    def pattern(self) -> bytes:
        """What tells one distribution of contactors that are open, stick and slip from others, and where to they slip."""
        rub = self._rub()
        return super().pattern + rub.stick.tobytes() + np.sign(rub.direction).astype(np.int8).tobytes()

    def largest_gap(self) -> float:
        """Largest gap of an active contactor, or distance from the anchor that it sticks to, a length (collective)."""
        off = np.linalg.norm(self.slip[self.rubbing & self._rub().stick & ~self.redundant], axis=1).max(initial=0.0)
        return max(super().largest_gap(), float(self.config.comm.allreduce(float(off), op=MPI.MAX)))

    def _return_vectors(self) -> Array:
        stuck = self.rubbing & self._rub().stick & self.coupling.nodal
        return super()._return_vectors() - np.where(stuck[:, None], self.slip, 0.0)

    # -- activation and release ------------------------------------------------------------------------------------------

    def _set_active(self, state: PairState) -> None:
        assert state.friction is not None
        rub = friction.come_and_go(state.friction, self.trial.active, state.active, self.mu > 0)
        super()._set_active(replace(state, friction=rub))

    def activate_touching(self) -> None:
        """Start with the contactors that touch without force as active, where they stick (collective)."""
        anchored = self._anchored()
        super().activate_touching()
        stick = self._rub().stick
        self.trial = self.committed = replace(self.trial, friction=replace(anchored, stick=stick))
        self.project()

    def _with_friction(
        self, wrong: Wrong, lam: Array, stiffness: Array, force_rounding: Array, gap_rounding: float, du: Array | None
    ) -> Wrong:
        """Contactors that break the conditions of contact or friction; see ``ContactPair`` (collective)."""
        slip, tau = self.slip, self._rub().tau
        if du is not None:
            slip = slip + friction.along(self.tangents, self._relative(du, self.coupling.weights(self.placement)))
            tau = self._told
            self._foreseen = tau, slip
        return friction.find_wrong(
            wrong,
            replace(self._rub(), direction=self.directions),
            self.rubbing,
            self.mu,
            lam,
            self.tangential(tau),
            slip,
            stiffness,
            force_rounding=force_rounding,
            gap_rounding=gap_rounding,
        )

    def exchange(self, wrong: Wrong, ahead: bool) -> bool:
        """Let wrong contactors change sides, or between stick and slip; see ``ContactPair`` (collective)."""
        assert isinstance(wrong, friction.FrictionWrong)
        tau, slip = self._foreseen
        if ahead:
            self._taken, tau = self._next_in_line(wrong, tau)
        slide = wrong.slide | self._taken if ahead else wrong.slide
        # one whose slip turns slips the other way first: where a surface turns back they would else follow one after the other; bodies
        # that slide without end are held
        size = np.linalg.norm(slip, axis=1)
        turns = wrong.hold & ~self._reversed & (size > 0) & (size < self.config.size)
        # one that has touched before and comes back slips: stuck it might pull, and be let go of for ever
        back = turns | (wrong.enter & (self.committed.active | self._released) & (size > 0))
        changed = replace(wrong, slide=slide, hold=wrong.hold & ~turns)
        self.trial = replace(self.trial, friction=friction.exchange(self._rub(), changed, tau))
        super().exchange(wrong, ahead)
        self.trial = replace(self.trial, friction=friction.turned(self._rub(), back, slip))
        self._released, self._reversed = self._released | wrong.release, self._reversed | turns
        # where they begin to slip the linearised problem has taken the forces to
        tau = tau / self._shares[:, None]
        self._q[slide], self._tau[slide] = -tau[slide], tau[slide]
        self._q[back], self._tau[back] = slip[back] * self._c[back, None], 0.0
        return ahead and bool(self.config.comm.allreduce(self._taken.any(), op=MPI.LOR))

    def _next_in_line(self, wrong: friction.FrictionWrong, tau: Array) -> tuple[Bools, Array]:
        """Contactors that are to slip with those that begin to ``(n,)``, and forces that have theirs along (collective)."""
        stick, begin = self.rubbing & self._rub().stick, wrong.slide
        near, force = self._front.move(self.points[begin], tau[begin], bool((self._taken & stick).any()), self.points)
        near &= stick & ~begin & ~wrong.release
        return near, np.where(near[:, None], self.tangential(force), tau)

    def turn(self, stiffness: Array) -> None:
        """Take the directions of slip from where the contactors are and from the forces last foreseen; see ``ContactPair``."""
        self._released, self._reversed, self._taken = np.zeros((3, len(self.nodes)), dtype=bool)
        self._front = Front(self.config.comm)
        if self.config.gdim == 2:
            return
        self._c = friction.SLIP_STIFFNESS * np.abs(stiffness).mean(axis=1)
        self._tau = self.tangential(self._rub().tau) / self._shares[:, None]
        self._q = self._c[:, None] * self.slip - self._tau
        self.trial = replace(self.trial, friction=friction.turned(self._rub(), self.slipping, self._q))

    def check(self) -> None:
        """Refuse contactors that are driven over the target by Dirichlet conditions, which friction cannot act on (collective).

        Raises:
            FrictionError: naming the first such contactor of the first rank that has one.
        """
        if self._kept is None:
            way = np.where(self.free, 0.0, self._off_anchor)
        else:
            way = self.coupling.driven(self.placement, self._way_since(*self._kept[1:3]))
        normal = self.coupling.normals(self.placement, self.trial)
        along = friction.along(friction.tangents(normal[:, None], np.ones_like(self.free)), way)
        check_driven(self, along, self.rubbing & (self.trial.lam > 0) & ~self._cornered)

    # -- what the united system gets -------------------------------------------------------------------------------------

    def equations(self) -> LabelledEquations:
        """Uniting equations with those along the target, and tilted test rows where contactors slip (collective)."""
        own, g, f = super().equations(), self.config.gdim, self._rub()
        normal = np.flatnonzero(own.kind == NORMAL)
        who, test = own.contactor[normal], own.test
        place = np.full(len(self.nodes), -1, dtype=np.int64)
        place[who] = np.arange(len(who))
        row, followed, weight = self.coupling.weights(self.placement)
        there = place[row] >= 0
        row, followed, weight = place[row[there]], followed[there], weight[there, None]

        def along(t: Array, gap: Array, active: Bools) -> UnitingEquations:
            return UnitingEquations(test.node[normal], t, gap, active, row, followed, weight * t[row])

        T, rubbing, slipping = self.tangents[who], self.rubbing[who], self.slipping[who]
        off = np.einsum("nrg,ng->nr", T, self._off_anchor[who])
        resisted = [rubbing & T[:, r].any(axis=1) for r in range(g - 1)]
        parts = [along(T[:, r], off[:, r], resisted[r] & f.stick[who]) for r in range(g - 1)]
        untilted = tilted = UnitingEquations.join([test, *parts], g)
        trial = untilted if own.trial is test else UnitingEquations.join([own.trial, *parts], g)
        if self.config.comm.allreduce(int(slipping.any())):
            size = (self.mu * self.coupling.tilts(self.placement, self.trial))[who, None]
            tilt = np.where(slipping[:, None], -size * self.directions[who], 0.0)
            direction = untilted.direction.copy()
            direction[normal] += tilt
            tilted = replace(
                untilted,
                direction=direction,
                row=np.concatenate([untilted.row, normal[row]]),
                followed=np.concatenate([untilted.followed, followed]),
                coefficients=np.concatenate([untilted.coefficients, weight * tilt[row]]),
            )
        turning = trial
        if g == 3:
            across = np.cross(self.coupling.normals(self.placement, self.trial)[who], self.directions[who])
            turning = UnitingEquations.join([trial, along(across, np.zeros(len(who)), slipping)], g)
        return LabelledEquations(
            trial,
            tilted,
            np.concatenate([own.contactor, *[who] * (g - 1)]),
            np.concatenate([own.kind, *(np.full(len(who), -r) for r in range(1, g))]),
            untilted,
            replace(trial, active=np.concatenate([own.trial.active, *resisted])),
            turning,
        )

    def forces(self, equations: LabelledEquations, multipliers: Array, du: Array | None = None) -> tuple[Array, Array, Array]:
        """Contact forces along the normals, and of friction; see ``ContactPair`` (collective)."""
        plain = equations.kind >= NORMAL
        rows = equations.upright.select(plain)
        own = LabelledEquations(rows, rows, equations.contactor[plain], equations.kind[plain])
        lam, nodal, force = super().forces(own, multipliers[plain])
        share = self._shares
        tau = np.where(self.slipping[:, None], -(self.mu * lam / share)[:, None] * self.directions, 0.0)
        held = np.flatnonzero(~plain)
        np.add.at(tau, equations.contactor[held], multipliers[held, None] * equations.test.direction[held])
        if du is not None and self.config.gdim == 3:
            across, stiffness, part = self._turning()
            i = np.flatnonzero(self.slipping)
            move = self._relative(du, self.coupling.weights(self.placement))[i]
            taken = stiffness[:, None] * move + part[:, None] * self._tau[i]
            tau[i] -= np.einsum("kgh,kh->kg", across, taken)
        self._told = tau * share[:, None]
        return lam, nodal, force + self._at_contactors(tau)

    def _at_contactors(self, tau: Array) -> Array:
        """Forces at contactors of multipliers ``tau (n, gdim)`` along the target ``(n, gdim)`` (collective)."""
        if self.coupling.nodal:
            return tau
        return np.asarray(self.config.add_at_owners(*self._handed_on(tau))[self.nodes])

    def _handed_on(self, tau: Array) -> tuple[Ints, Array]:
        """Global nodes ``(k,)`` and forces ``(k, gdim)`` of multipliers ``tau (n, gdim)`` along the target, on both bodies."""
        row, followed, weight = self.coupling.weights(self.placement)
        nodes = np.concatenate([self.config.to_global(self.nodes), followed])
        return nodes, np.concatenate([tau, -weight[:, None] * tau[row]])

    def with_forces(self, lam: Array, nodal: Array, force: Array) -> PairState:
        """The trial state with contact forces and the friction that was read or foreseen with them; see ``ContactPair``."""
        return replace(super().with_forces(lam, nodal, force), friction=replace(self._rub(), tau=self._told))

    @property
    def _multipliers(self) -> Array:
        """Multipliers along the normals ``(n,)``."""
        return np.asarray(self.trial.lam / self._shares)

    def _turning(self) -> tuple[Array, Array, Array]:
        """Of contactors that slip: projectors across their directions ``(k, g, g)``, and what ``turn_stiffness`` returns."""
        i = np.flatnonzero(self.slipping)
        T, s = self.tangents[i], self.directions[i]
        across = np.einsum("krg,krh->kgh", T, T) - s[:, :, None] * s[:, None, :]
        size = np.linalg.norm(self._q[i], axis=1)
        return across, *friction.turn_stiffness(size, self.mu[i] * np.maximum(self._multipliers[i], 0.0), self._c[i])

    def slip_terms(self) -> tuple[Ints, Array, Array] | None:
        """What holds the directions of slip back in space; see ``ContactPair``."""
        if self.config.gdim == 2:
            return None
        i = np.flatnonzero(self.slipping)
        across, stiffness, part = self._turning()
        nodes, share = self._table(i)
        k, m, g = *share.shape, self.config.gdim
        blocks = np.einsum("k,ka,kb,kgh->kagbh", stiffness, share, share, across).reshape(k, m * g, m * g)
        forces = np.einsum("k,ka,kgh,kh->kag", part, share, across, self._tau[i]).reshape(k, m * g)
        return nodes, blocks, forces

    def _table(self, which: Ints) -> tuple[Ints, Array]:
        """Of contactors ``which (k,)``: global nodes that move them relative to the target, -1 for none, and by how much ``(k, m)``."""
        row, followed, weight = self.coupling.weights(self.placement)
        order = np.argsort(row, kind="stable")
        first = np.searchsorted(row[order], np.arange(len(self.nodes)))
        column = np.arange(len(row)) - first[row[order]]
        nodes = np.full((len(self.nodes), int(column.max(initial=-1)) + 2), -1, dtype=np.int64)
        share = np.zeros(nodes.shape)
        nodes[:, 0], share[:, 0] = self.config.to_global(self.nodes), 1.0
        nodes[row[order], column + 1], share[row[order], column + 1] = followed[order], -weight[order]
        return nodes[which], share[which]

    def curvature(self) -> list[tuple[Ints, Array]]:
        """Blocks of ``-sum lambda d(row)/du``, the rows of contactors that slip tilted; see ``ContactPair`` (collective)."""
        parts = super().curvature()
        which = np.flatnonzero(self.slipping & (self.trial.lam > 0))
        if not self.config.comm.allreduce(len(which)):
            return parts
        tau = -(self.mu * self._multipliers)[which, None] * self.directions[which]
        turned = self.coupling.turning(self.placement, self.trial, which, tau)
        return parts + [(nodes, -blocks) for nodes, blocks in turned]

    # -- trial and committed ---------------------------------------------------------------------------------------------

    def _anchored(self) -> FrictionState:
        """The state in which contactors that do not stick are anchored where they are."""
        f, p, x = self._rub(), self.projection, self.points
        if not self.coupling.nodal:
            return f
        loose = ~f.stick | ~self.rubbing | self._cornered
        below = x - p.gap[:, None] * p.normal
        if not self.target.n_nodes:
            motion: Motion | None = self.target.motion
            here = below if motion is None else motion.back(below)
            return replace(f, anchor=np.where(loose[:, None], here, f.anchor))
        nearest = self.placement.details.nearest
        # a foot that a contact with small sliding keeps is left behind
        left = below - nearest.foot if self.sliding != "finite" else np.zeros_like(x)
        return replace(
            f,
            facet=np.where(loose, nearest.facet, f.facet),
            xi=np.where(loose[:, None], nearest.xi, f.xi),
            anchor=np.where(loose[:, None], left, f.anchor),
        )

    def _ways(self) -> tuple[Array, Array]:
        """Ways past the target since the last step, for a unit of friction at its start and one at its end ``(n, gdim)`` (collective)."""
        if self._kept is None:
            return (self._off_anchor / self._shares[:, None],) * 2
        _, before, motion, share = self._kept
        now = self._relative(self._way_since(before, motion), self.coupling.weights(self.placement))
        return self._moved / share[:, None], now / self._shares[:, None]

    def commit(self) -> None:
        """Make the trial state the committed one, with new anchors for those that do not stick; see ``ContactPair``."""
        assert self.committed.friction is not None
        share, f, held = self._shares[:, None], self._anchored(), self._cornered
        f = replace(
            f, tau=np.where(held[:, None], friction_in(self._corners, self.trial, self.committed.facet, self.mu) * share, f.tau)
        )
        # a contactor that changes facets slides over both
        start, end = self._ways()
        slipped = f.slipped + np.where(held[:, None], end, np.where(self.slipping[:, None], self.slip / share, 0.0))
        taken = friction.work(self.committed.friction.tau, f.tau, start, end, held)
        f = replace(f, direction=self.directions, slipped=slipped, work=f.work + taken)
        self.trial, self._kept = replace(self.trial, friction=f), None
        super().commit()

    def from_checkpoint(self, kept: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from what ``to_checkpoint`` returned; see ``ContactPair`` (collective)."""
        super().from_checkpoint(kept)
        self._kept = None
