"""Friction of an interface: tangential equations of sticking contactors, rotated rows and forces of slipping ones.

``stick_slip`` contains the decision between stick and slip, on arrays, by a law's limit.
"""

from __future__ import annotations

from collections.abc import Callable
from operator import is_not
from typing import TYPE_CHECKING, Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints, replace
from uem_dolfinx.contact.friction import stick_slip
from uem_dolfinx.contact.friction.frame import Frame, anchored, anchors_of, force_times_way, way_since, with_friction
from uem_dolfinx.contact.friction.limits import Limits
from uem_dolfinx.contact.friction.stick_slip import LastStep, Pivot
from uem_dolfinx.contact.laws.law import FrictionLaw, of_rate
from uem_dolfinx.contact.seam.active_set import GAP_ROUNDING, Violations
from uem_dolfinx.contact.seam.corners import friction_in
from uem_dolfinx.contact.seam.placement import Along, ContactRows, Discretisation, Kinematics, Traction
from uem_dolfinx.contact.seam.relative_motion import Ties
from uem_dolfinx.contact.seam.state import FrictionState, PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.wear import Wear


class Sliding:
    """Friction of the contactors of one interface.

    Args:
        nodes: owned contactor nodes ``(n,)``.
        discretisation: relates them to their target.
        value: parameter of the law at the contactors ``(n,)``.
        limits: limits of the friction forces.
        keeps_feet: whether closest points are constant during the step.
        value_now: function that returns the parameter ``(n,)`` after a placement, or None if unchanged (collective).
        wear: of the contactors; None without wear.

    Attributes:
        frame: tangential directions and relative motions of the last placement.
        pivot: record of the exchanges in the present linearised problem.
        left_out: tangents whose equations are redundant and were dropped ``(n, gdim - 1)``.
        last: the last step's end, for contactors that follow other nodes in a mean; None before a placement.
    """

    frame: Frame

    def __init__(
        self,
        config: Configuration,
        nodes: Indices,
        discretisation: Discretisation,
        *,
        law: FrictionLaw,
        value: Array,
        limits: Limits,
        keeps_feet: bool,
        value_now: Callable[[Kinematics], Array | None],
        wear: Wear | None = None,
    ):
        self.config, self.nodes, self.discretisation, self.keeps_feet, self.wear = config, nodes, discretisation, keeps_feet, wear
        n, g, self.limits, self._value_now = len(nodes), config.gdim, limits, value_now
        self.set(law, value)
        self.left_out: Bools = np.zeros((n, g - 1), dtype=bool)
        self._other_normals: Array = np.zeros((n, 0, g))
        self._anchors: Array = np.zeros((n, g))
        self._held_by: tuple[Ints, Ints, Array] | None = None
        #: The last slip directions, with the frame and the vectors that they are made of.
        self._directed: tuple[Frame, Array, Array] | None = None
        self.last: LastStep | None = None
        self.pivot = Pivot.begin(np.zeros(n), *np.zeros((2, n, g)))
        #: The last state and what its limits depend on, and these limits.
        self._cones: tuple[tuple[Any, ...], tuple[Array, Array]] = (None,) * 6, (np.zeros(n), np.zeros(n))

    def set(self, law: FrictionLaw, value: Array) -> None:
        """Set the law and the values of its parameter ``(n,)``."""
        self.limits.set(law, value)
        self.discretisation.set(cones=self.limits.cones)

    @property
    def value(self) -> Array:
        """Parameter of the law at the contactors ``(n,)``, 0 without friction."""
        return self.limits.value

    # -- placement of contactors -----------------------------------------------------------------------------------------

    def place(self, kinematics: Kinematics, state: PairState) -> None:
        """Find the anchors, or the relative motions of contactors, in the current configuration (collective)."""
        if self.discretisation.traits.pointwise:
            self._anchors, self._held_by = anchors_of(_of(state), self.discretisation.target, self.config.gdim == 3)
        elif self.last is None or self.last.renewed(self.config, self.discretisation):
            self.last = LastStep(kinematics, self.config.x[: self.config.n_owned].copy(), self.discretisation.target.motion)
        self.limits.grow(kinematics)
        if (value := self._value_now(kinematics)) is not None:
            self.limits.change(value)
        self.replace(kinematics)

    def replace(self, kinematics: Kinematics) -> None:
        """Replace the kinematics at the same displacement (collective)."""
        if self.discretisation.traits.pointwise:
            way = None if self._held_by is None else Ties.of(self.config, self.nodes, self._held_by, None, True)
            away = self.config.here(self.nodes) - self._anchors
        else:
            assert self.last is not None
            way = self.last.ties
            away = way.relative(self.since(self.last))
        self.frame = Frame.of(kinematics, away, way, self._other_normals, self.discretisation.setting.prescribed)
        if of_rate(self.limits.law):
            self.limits.see(np.linalg.norm(self.frame.slip, axis=1) / kinematics.ties.share)

    def since(self, last: LastStep) -> Array:
        """Displacement of the owned nodes since, of contactors relative to a rigid target ``(n_owned, gdim)``."""
        return way_since(self.config, self.nodes, last.x, last.motion, self.discretisation.target.motion)

    def meet(self, kinematics: Kinematics, normals: Array) -> None:
        """Set the normals of other rigid surfaces that hold contactors ``(n, k, gdim)``, along which no slip is possible (collective)."""
        before, some = self._other_normals, bool(normals.any())
        other = some if not before.shape[1] else not np.array_equal(normals, before)
        other, some = reduced(self.config.comm, np.array([other, some])) > 0
        if other:
            self._other_normals = normals if some else normals[:, :0]
            self.replace(kinematics)

    def active(self, state: PairState) -> Bools:
        """Active contactors with friction ``(n,)``."""
        return state.active & (self.value > 0)

    def slipping(self, state: PairState) -> Bools:
        """Contactors that slip ``(n,)``."""
        return self.active(state) & ~_of(state).stick

    def directions(self, state: PairState) -> Array:
        """Slip directions in the current tangent plane ``(n, gdim)``; zero for contactors that do not slip."""
        found, of = self._directed, (self.frame, _of(state).direction)
        if found is None or found[0] is not of[0] or found[1] is not of[1]:
            self._directed = found = *of, self.frame.directions(of[1])
        return found[2]

    def distances(self, state: PairState) -> Array:
        """Distances of sticking contactors from their anchors, zero for others, lengths ``(n,)``."""
        held = np.where(self.left_out[:, :, None], 0.0, self.frame.free_tangents)
        away = np.linalg.norm(stick_slip.along(held, self.frame.away), axis=1)
        return np.where(self.active(state) & _of(state).stick & ~state.redundant, away, 0.0)

    def return_vectors(self, state: PairState) -> Array:
        """Tangential displacements that return sticking contactors to their anchors ``(n, gdim)``."""
        return -np.where(self._at_anchors(state)[:, None], stick_slip.along(self.frame.free_tangents, self.frame.away), 0.0)

    def _at_anchors(self, state: PairState) -> Bools:
        """Contactors that stick to a point of the target and can follow it ``(n,)``."""
        stuck = self.active(state) & _of(state).stick & self.discretisation.traits.pointwise
        return stuck & (self.discretisation.setting.free[self.nodes] | ~self.frame.ties.moves).all(axis=1)

    def bound(self, state: PairState, lam: Array | None = None) -> Array:
        """Limit of the tangential force in a state, or with other normal forces ``lam (n,)``: ``(n,)``."""
        return self.limits.of(state.lam if lam is None else lam, self.slipping(state))[0]

    def _cone(self, state: PairState) -> tuple[Array, Array]:
        if any(map(is_not, of := (state, *self.limits.given), self._cones[0])):
            self._cones = of, self.limits.cone(state.lam, self.slipping(state))
        return self._cones[1]

    def _limit(self, state: PairState, lam: Array) -> Array:
        rest, slope = self._cone(state)
        return rest + slope * lam

    # -- stick and slip --------------------------------------------------------------------------------------------------

    def come_and_go(self, state: PairState, before: Bools) -> PairState:
        """The state in which contactors that were not active ``before (n,)`` stick, and released ones are reset."""
        return replace(state, friction=stick_slip.come_and_go(_of(state), before, state.active, self.value > 0))

    def other_law(self, state: PairState, law: FrictionLaw, value: Array) -> PairState:
        """The state with another law and parameter values ``(n,)``; contactors that become frictional stick at their position."""
        was = state.active & (self.value > 0)
        self.set(law, value)
        now = stick_slip.come_and_go(_of(state), was, state.active & (value > 0), value > 0)
        return replace(state, friction=now)

    def violated(
        self, violated: Violations, state: PairState, seen: Traction, rounding: tuple[Array, float], du: Array | None
    ) -> stick_slip.FrictionViolations:
        """Add violations of the friction conditions (collective).

        Args:
            violated: violations of the contact conditions.
            state: of the interface.
            seen: contact forces, current or predicted.
            rounding: forces ``(n,)`` and a length; smaller values count as zero.
            du: increment of the owned nodes used for the prediction ``(n_owned, gdim)``; None for the current configuration.
        """
        away, tau = self.frame.away, _of(state).tau
        if du is not None and seen.tau is not None:
            away, tau = away + self.frame.way.relative(du), seen.tau
        lam, forced = seen.lam, self.frame.forced(away, self._lost)
        by = stick_slip.Seen(lam, self.frame.tangential(tau), self.bound(state, lam), self.frame.along(away), forced)
        self.limits.agree(self.config.comm)
        turned = replace(_of(state), direction=self.directions(state))
        (forces, lengths), active = rounding, self.active(state)
        return stick_slip.find_violations(violated, turned, active, by, force_rounding=forces, gap_rounding=lengths)

    def forced(self, du: Array | None = None) -> Bools:
        """Contactors that slip along prescribed components in this step, with an increment ``du (n_owned, gdim)`` or None (collective)."""
        away = self.frame.away
        if du is not None and (self.frame.prescribed or self.frame.other_normals.shape[1]):
            away = away + self.frame.way.relative(du)
        return np.asarray(self.frame.forced(away, self._lost) > GAP_ROUNDING * self.config.size)

    @property
    def _lost(self) -> Bools:
        return self.left_out & ~self.discretisation.setting.free[self.nodes].all(axis=1, keepdims=True)

    def exchange(
        self,
        violated: Violations,
        state: PairState,
        committed: PairState,
        kinematics: Kinematics,
        enter: Callable[[PairState], PairState],
    ) -> PairState:
        """The state with violated contactors exchanged between stick and slip; ``enter`` activates and releases contactors (collective)."""
        assert isinstance(violated, stick_slip.FrictionViolations)
        seen, pivot, share = violated.seen, self.pivot, kinematics.ties.share[:, None]
        tau, slip, lam, forced = seen.tau, seen.slip, seen.lam, violated.driven
        space, size = self.config.gdim == 3 and self.discretisation.traits.pointwise, np.linalg.norm(seen.slip, axis=1)
        # a contactor whose slip reverses first slips the other way, since contactors would otherwise reverse one by one; at the
        # second reversal it sticks, since soft bodies would reverse for ever. Nodes in 3D that begin to slip change direction while
        # the force q is outside the cone; unrestrained bodies (slip above the model's size) stick
        q, beyond = pivot.stiffness[:, None] * slip - tau / share, ~pivot.turned
        if space:
            beyond = (beyond | pivot.begun) & (np.linalg.norm(q, axis=1) > self.bound(state, lam) / share[:, 0])
        turns = violated.hold & (size > 0) & (forced | (beyond & (size < self.config.size)))
        # a contactor that touched before and re-enters slips: sticking could cause tension and endless release
        back = (violated.enter & (committed.active | pivot.released | forced) | violated.slide & forced) & (size > 0)
        slide, changed = violated.slide, replace(violated, hold=violated.hold & ~turns)
        state = enter(replace(state, friction=stick_slip.exchange(_of(state), changed, tau)))
        led_by = pivot.stiffness[:, None] * slip if self.config.gdim == 3 else slip
        way = np.where((turns & ~forced)[:, None] & space, q, led_by)
        state = replace(state, friction=stick_slip.turned(_of(state), back | turns, way))
        # the slip of a moving target under these contactors now contributes c w to the forces in q
        q, of_q, led = pivot.q.copy(), pivot.tau.copy(), slide | back | turns
        q[slide], q[back | turns] = -tau[slide] / share[slide], way[back | turns]
        of_q[led] = (pivot.stiffness[:, None] * self.frame.slip)[led]
        released, turned, begun = pivot.released | violated.release, pivot.turned | turns, pivot.begun | slide
        self.pivot = replace(pivot, released=released, turned=turned, begun=begun, q=q, tau=of_q)
        return state

    def turn(self, state: PairState, kinematics: Kinematics, stiffness: Array) -> PairState:
        """Begin another linearised problem: slip directions from current positions and the last predicted forces."""
        frame, none = self.frame, np.zeros((len(self.nodes), self.config.gdim))
        if self.config.gdim == 2:
            self.pivot = Pivot.begin(np.zeros(len(none)), none, none)
            return state
        k, ties = np.abs(stiffness).mean(axis=1, keepdims=True), frame.ties
        c = stick_slip.slip_stiffness(k[self.nodes, 0], ties.row, ties.weight, self.config.ask_owners(ties.followed, k)[:, 0])
        T, tau = frame.free_tangents, frame.tangential(_of(state).tau) / kinematics.ties.share[:, None]
        # prescribed components at rest carry no friction; if all are prescribed, only the moving ones do
        partly = (frame.tangents != 0).any(axis=2).sum(axis=1) > (T != 0).any(axis=2).sum(axis=1)
        slides = self.forced() | stick_slip.continues(_of(state).direction, T, frame.away, GAP_ROUNDING * self.config.size)
        tau = np.where((partly & (slides == ~T.any(axis=(1, 2))))[:, None], stick_slip.along(T, tau), tau)
        q = c[:, None] * frame.slip - tau
        self.pivot = Pivot.begin(c, q, tau)
        return replace(state, friction=stick_slip.turned(_of(state), self.slipping(state), q))

    # -- equations and forces --------------------------------------------------------------------------------------------

    def equations(self, own: ContactRows, state: PairState, kinematics: Kinematics) -> ContactRows:
        """Equations with tangential ones for sticking contactors, and rotated test rows for slipping contactors (collective)."""
        return with_friction(
            own,
            self.frame,
            of_friction=self.active(state),
            stick=_of(state).stick,
            directions=self.directions(state),
            slope=self._cone(state)[1] * kinematics.pressure_map(False).force / kinematics.ties.share,
            normal=kinematics.normal,
            pointwise=self.discretisation.traits.pointwise,
            keeps_ties=self.keeps_feet or self.discretisation.traits.at_feet,
        )

    def set_redundant(self, equations: ContactRows, redundant: Bools) -> None:
        """Set which tangential equations were dropped; ``redundant (m,)`` refers to all equations."""
        which = equations.tangent >= 0
        self.left_out = np.zeros_like(self.left_out)
        self.left_out[equations.contactor[which], equations.tangent[which]] = redundant[which]

    def forces(
        self, equations: ContactRows, multipliers: Array, state: PairState, kinematics: Kinematics, du: Array | None
    ) -> Traction:
        """Normal and tangential forces from the multipliers of equations ``(m,)``; see ``Interface.forces`` (collective)."""

        def friction(lam: Array) -> Array:
            limit, i = self._limit(state, lam) / kinematics.ties.share, (equations.tangent >= 0).nonzero()[0]
            tau = np.where(self.slipping(state)[:, None], -limit[:, None] * self.directions(state), 0.0)
            np.add.at(tau, equations.contactor[i], multipliers[i, None] * equations.rows.direction[i])
            if du is not None and self._follows_slip:
                sideways, part, stiffness = self.turning(state, kinematics)
                i = self.slipping(state).nonzero()[0]
                taken = np.einsum("kgh,kh->kg", stiffness, self.frame.way.relative(du)[i])
                tau[i] -= taken + part[:, None] * np.einsum("kgh,kh->kg", sideways, self.pivot.tau[i])
            return tau

        return kinematics.forces(state, equations, multipliers, friction)

    def has_known_forces(self, state: PairState) -> bool:
        """Whether friction of any contactor of this rank may be independent of the normal force."""
        return bool(self._cone(state)[0].any())

    def known_forces(self, state: PairState, kinematics: Kinematics) -> tuple[Ints, Array]:
        """Friction forces independent of the normal force: nodes and forces (collective)."""
        rest, _ = self._cone(state)
        size = np.where(self.slipping(state), rest / kinematics.ties.share, 0.0)
        return self.frame.ties.handed_on(-size[:, None] * self.directions(state))

    @property
    def _follows_slip(self) -> bool:
        """Whether friction depends on the slip of slipping contactors: in 3D by its direction, with rate laws by its size."""
        return self.config.gdim == 3 or of_rate(self.limits.law)

    def turning(self, state: PairState, kinematics: Kinematics) -> tuple[Array, Array, Array]:
        """Derivatives of friction by the slip of slipping contactors.

        Returns projectors across the slip directions ``(k, g, g)``, the removed part of the force across them ``(k,)``, and
        stiffnesses across and, with rate laws, along them ``(k, g, g)``.
        """
        i = self.slipping(state).nonzero()[0]
        T, s = self.frame.tangents[i], self.directions(state)[i]
        forwards = s[:, :, None] * s[:, None, :]
        sideways = np.einsum("krg,krh->kgh", T, T) - forwards
        sideways[~self.frame.free_tangents[i].any(axis=(1, 2))] = 0.0
        share = kinematics.ties.share
        bound, _, rate = self.limits.of(state.lam, self.slipping(state))
        size = np.linalg.norm(self.pivot.q[i], axis=1)
        stiffness, part = stick_slip.turn_stiffness(size, (bound / share)[i], self.pivot.stiffness[i])
        along = (rate / share**2)[i]
        return sideways, part, stiffness[:, None, None] * sideways + along[:, None, None] * forwards

    def slip_terms(self, state: PairState, kinematics: Kinematics) -> tuple[Ints, Array, Array] | None:
        """Terms of slip in tangent and residual: change of direction, and rate dependence."""
        if not self._follows_slip:
            return None
        i = self.slipping(state).nonzero()[0]
        sideways, part, stiffness = self.turning(state, kinematics)
        nodes, share, moved = self.frame.ties.tables(self.frame.way, i)
        (k, m), g = share.shape, self.config.gdim
        blocks = np.einsum("ka,kb,kgh->kagbh", share, moved, stiffness).reshape(k, m * g, m * g)
        forces = np.einsum("k,ka,kgh,kh->kag", part, share, sideways, self.pivot.tau[i]).reshape(k, m * g)
        return nodes, blocks, forces

    def along(self, state: PairState, kinematics: Kinematics) -> Along | None:
        """Friction whose tangential rows turn; None if no rank has any (collective).

        Rows of contactors that stick at points do not, since all components follow the same point.
        """
        slips = self.slipping(state) & (state.lam > 0)
        held = self.active(state) & _of(state).stick & (not self.discretisation.traits.at_feet)
        which = (slips | held).nonzero()[0]
        if not reduced(self.config.comm, len(which)):
            return None
        force = np.where(slips[:, None], -self._limit(state, state.lam)[:, None] * self.directions(state), _of(state).tau)
        return Along(which, (force / kinematics.ties.share[:, None])[which], held[which])

    # -- from step to step -----------------------------------------------------------------------------------------------

    def anchored(self, state: PairState, kinematics: Kinematics) -> FrictionState:
        """The state in which contactors that do not stick get anchors at their current position."""
        f = _of(state)
        if not self.discretisation.traits.pointwise:
            return f
        loose = ~f.stick | ~self.active(state) | self.frame.cornered
        return anchored(f, kinematics, self.discretisation.target, self.config.here(self.nodes), loose, self.keeps_feet)

    def commit(self, state: PairState, committed: PairState, kinematics: Kinematics) -> PairState:
        """The state to be committed, with slips, work and new anchors (collective)."""
        share, f, held = kinematics.ties.share[:, None], self.anchored(state, kinematics), self.frame.cornered
        tau, start, end, taken = self.step(state, committed, kinematics)
        slips = self.slipping(state) if self.wear is None else state.active & ~f.stick
        slipped = f.slipped + np.where(held[:, None], end, np.where(slips[:, None], self.frame.slip / share, 0.0))
        self.last, worn = None, f.worn if self.wear is None else self._worn(state, committed, kinematics, tau, (start, end))
        now = replace(f, tau=tau, direction=self.directions(state), slipped=slipped, work=f.work + taken, worn=worn)
        return replace(state, friction=now)

    def worn(self, state: PairState, committed: PairState, kinematics: Kinematics) -> Array:
        """Wear depths at the end of the step, with the forces at its start and of the present state ``(n,)`` (collective)."""
        tau, start, end, _ = self.step(state, committed, kinematics)
        return self._worn(state, committed, kinematics, tau, (start, end))

    def _worn(
        self, state: PairState, committed: PairState, kinematics: Kinematics, tau: Array, ways: tuple[Array, Array]
    ) -> Array:
        assert self.wear is not None
        return _of(committed).worn + self.wear.depths(*force_times_way(self.frame, kinematics, (committed, state), tau, ways))

    def forget(self) -> None:
        """Discard the reference of slip."""
        self.last = None

    def step(self, state: PairState, committed: PairState, kinematics: Kinematics) -> tuple[Array, Array, Array, Array]:
        """Friction at a step's end, slips per unit of friction at start and end ``(n, gdim)``, and dissipation ``(n,)`` (collective)."""
        share, held = kinematics.ties.share[:, None], self.frame.cornered[:, None]
        # a contactor that stuck throughout the step is at its anchor, up to rounding
        stuck = (self._at_anchors(state) & self._at_anchors(committed))[:, None]
        start, end = (np.where(stuck, 0.0, way) for way in self._ways(kinematics))
        # in a corner, friction is the part within the cones of its facets
        slopes = self.limits.cones(np.linalg.norm(state.force, axis=1))
        self.limits.agree(self.config.comm)
        tau = np.where(held, friction_in(kinematics.corners, state, committed.facet, slopes, end) * share, _of(state).tau)
        first, last = (0.0 * start, 2.0 * end) if self.limits.whole else (start, end)
        return tau, start, end, stick_slip.work(_of(committed).tau, tau, first, last, self.frame.cornered)

    def _ways(self, kinematics: Kinematics) -> tuple[Array, Array]:
        """Relative motions since the last step, per unit of friction at its start and at its end ``(n, gdim)`` (collective)."""
        share = kinematics.ties.share[:, None]
        if self.last is None:
            return (self.frame.away / share,) * 2
        now = kinematics.ties.relative(self.since(self.last))
        return self.frame.away / self.last.ties.share[:, None], now / share


def _of(state: PairState) -> FrictionState:
    assert state.friction is not None
    return state.friction
