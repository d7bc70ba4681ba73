"""The interface of one contact: contactors, their discretisation and friction. It places contactors, updates the active set and commits.

The trial state changes in every iteration, the committed state only after convergence.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints, replace
from uem_dolfinx.contact.laws.law import FrictionLaw
from uem_dolfinx.contact.seam import active_set
from uem_dolfinx.contact.seam.placement import ContactRows, Discretisation, Kinematics, Traction
from uem_dolfinx.contact.seam.state import FrictionState, PairState
from uem_dolfinx.errors import NotFiniteError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import Target
from uem_dolfinx.log import timed_as
from uem_dolfinx.parallel import agree, reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.sliding import Sliding
    from uem_dolfinx.contact.friction.stick_slip import Pivot
    from uem_dolfinx.contact.thermal.heat import Heat
    from uem_dolfinx.contact.ties.tie import Tie
    from uem_dolfinx.geometry.rigid import Motion


class Interface:
    """Contactors against one target.

    Args:
        nodes: owned contactor nodes ``(n,)``.
        discretisation: relates them to their target.
        friction: tangential part; None without friction.
        tie: permanent tie of contactors, in addition to contact; None without a tie.
        name: for messages.
        max_penetration: bound on the initial penetration, a length.
        heats: function of the interface that makes its heat flows, one for each conductance; None without.

    Attributes:
        trial: state of the present iteration.
        committed: state of the last step.
        kinematics: of the contactors, for the trial state; available after ``project``.
    """

    kinematics: Kinematics

    def __init__(
        self,
        config: Configuration,
        nodes: Indices,
        discretisation: Discretisation,
        friction: Sliding | None = None,
        tie: Tie | None = None,
        *,
        name: str,
        max_penetration: float,
        heats: Callable[[Any], list[Heat]] | None = None,
    ):
        self.config, self.nodes, self.discretisation, self.friction, self.tie = config, nodes, discretisation, friction, tie
        self.name, self.max_penetration = name, max_penetration
        state = PairState.initial(n := len(nodes), g := config.gdim)
        along, bond = FrictionState.initial(n, g) if friction else None, np.zeros((n, g)) if tie else None
        self.heats = [] if heats is None else heats(self)
        united = sum(heat.law.perfect for heat in self.heats)
        self.trial = self.committed = replace(state, friction=along, bond=bond, heat=np.zeros((n, united)) if united else None)

    # -- placement of contactors -----------------------------------------------------------------------------------------

    @timed_as("projection")
    def project(self) -> None:
        """Project the contactors onto the target in the current configuration (collective).

        Raises NotFiniteError if the target's functions return values that are not finite.
        """
        if (self.far and not self.in_reach) or (self.tie is not None and not self.tie.begin_placement()):
            return
        known = hasattr(self, "kinematics")
        self.kinematics = self.discretisation.place(self.points, self.trial)
        if known and not self.in_reach:
            none, united = np.zeros(len(self.nodes)), sum(heat.law.perfect for heat in self.heats)
            heat = np.zeros((len(none), united)) if united else None
            self.set_forces(Traction(none, none, np.zeros(self.points.shape), heat=heat))
            return
        p = self.kinematics.projection
        finite, error = np.isfinite(p.gap) & np.isfinite(p.normal).all(axis=1), None
        if not finite.all():
            i = int(np.argmin(finite))
            name = self.members[self.discretisation.setting.label[i]].name
            error = NotFiniteError(
                f"{name}: gap {p.gap[i]}, normal {p.normal[i]} at {self.config.describe(int(self.nodes[i]))}: "
                "distance and gradient of the target must be finite, and the gradient must not vanish, near the contactors"
            )
        agree(self.config.comm, error)
        if self.friction is not None:
            self.friction.place(self.kinematics, self.trial)

    def search(self) -> None:
        """Search for all contactors from the next placement on, far apart or not (collective)."""
        far = self.discretisation.setting.far
        if far.any():
            self.discretisation.set(far=np.zeros_like(far))

    # -- activation and release ------------------------------------------------------------------------------------------

    def set_friction(self, law: FrictionLaw, value: Array, known: bool = False) -> None:
        """Set a friction law and values of its parameter ``(n,)``, between two steps (collective).

        ``known``: whether the committed state belongs to them; otherwise contactors that become frictional stick where they are.
        """
        assert self.friction is not None
        if known:
            self.friction.set(law, value)
        else:
            self.trial = self.committed = self.friction.other_law(self.committed, law, value)

    def take(self, state: PairState, pivot: Pivot | None = None) -> None:
        """Set the trial state, with its ``pivot`` of friction; friction begins anew where the active set alone is another."""
        if self.friction is not None:
            self.friction.pivot = pivot or self.friction.pivot
            if state.friction is self.trial.friction and state.active is not self.trial.active:
                state = self.friction.come_and_go(state, self.trial.active)
        self.trial = state

    def activate_touching(self, which: Bools | bool = True) -> None:
        """Activate contactors, or ``which (n,)``, that initially touch without force; with friction they stick (collective)."""
        anchored = self.friction.anchored(self.trial, self.kinematics) if self.friction is not None else None
        k = self.kinematics
        state = active_set.touching(self.trial, k.gap, self.config.size, which & ~self.off & k.movable)
        self.take(replace(state, at_end=k.ends.drawn(self.trial)))
        if anchored is not None and self.trial.friction is not None:
            self.trial = replace(self.trial, friction=replace(anchored, stick=self.trial.friction.stick))
        # a first step that fails and is cut starts again from this state
        self.committed = self.trial
        if anchored is not None:
            self.project()

    def follow(self) -> bool:
        """Release contactors past an end, follow the others from facet to facet (collective): whether an equation changes on this rank."""
        off, before = self.off, self.kinematics
        gone = bool((self.trial.active & off).any())
        self.kinematics, state = before.follow(self.trial, off)
        self.take(state)
        moved = self.kinematics is not before
        if moved and self.friction is not None:
            self.friction.replace(self.kinematics)
        return gone or moved

    def violated(
        self, gap: Array, seen: Traction, force_rounding: Array, gap_rounding: float, swept: bool, du: Array | None = None
    ) -> active_set.Violations:
        """Contactors whose gaps and forces violate the contact conditions (collective).

        Args:
            gap: deciding gaps ``(n,)``.
            seen: contact forces, current or predicted.
            force_rounding: smaller forces count as zero ``(n,)``.
            gap_rounding: smaller gaps count as zero, as do gaps below the rounding of positions.
            swept: skip contactors that have slid off a thin target, since it may sweep past them during the iteration.
            du: increment of the owned nodes used for the prediction ``(n_owned, gdim)``; None for the current configuration.
        """
        off = self.off
        if swept and self.kinematics.ends.thickness < np.inf:
            off = off | (self.trial.at_end & self.trial.passed)
        # a contactor is open if its equation was dropped as redundant and its gap is positive
        apart = self.trial.redundant & (gap > max(gap_rounding, active_set.TOUCHING * self.config.size))
        # ``follow`` releases the facets of a corner one by one
        pulled = np.where(self.trial.in_corner, 0.0, seen.lam)
        rounding = max(gap_rounding, active_set.GAP_ROUNDING * self.config.size)
        violated = active_set.find_violations(
            self.trial, gap, pulled, off, self.kinematics.movable & ~apart, force_rounding=force_rounding, gap_rounding=rounding
        )
        if self.friction is None:
            return violated
        return self.friction.violated(violated, self.trial, seen, (force_rounding, rounding), du)

    def exchange(self, violated: active_set.Violations) -> None:
        """Change the status of violated contactors (collective)."""

        def enter(state: PairState) -> PairState:
            self.trial = state
            self.take(active_set.exchange(state, violated))
            return self.trial

        if self.friction is None:
            enter(self.trial)
        else:
            self.trial = self.friction.exchange(violated, self.trial, self.committed, self.kinematics, enter)

    @property
    def approach(self) -> tuple[Ints, UnitingEquations]:
        """Inactive contactors in front of the target, and their normal equations; negative numbers where no activation is needed."""
        ahead = (~self.trial.active & ~self.off & self.kinematics.movable).nonzero()[0]
        rows = self.kinematics.gap_rows.select(ahead, np.ones(len(self.nodes), bool))
        return ahead, rows.rows.select(rows.normal)

    # -- equations and forces --------------------------------------------------------------------------------------------

    def equations(self) -> ContactRows:
        """Equations of the contactors that are or may become active, then of tied contactors (collective).

        Contactors near the target have rows; this set is renewed when an active contactor has no row. At first touch, it is the active set.
        """
        active, reserved = self.trial.active, self.trial.reserved
        lacks, known = reduced(self.config.comm, np.array([(active > reserved).sum(), reserved.sum()]))
        if lacks:
            near = self.kinematics.ends.near(self.trial, self.max_penetration)
            self.trial = replace(self.trial, reserved=near & ~self.tied if known else active)
        own = self.kinematics.gap_rows.select(self.trial.reserved.nonzero()[0], active)
        if self.friction is not None:
            own = self.friction.equations(own, self.trial, self.kinematics)
        return own if self.tie is None else self.tie.join(own)

    def set_redundant(self, equations: ContactRows, redundant: Bools) -> None:
        """Set which of the equations ``(m,)`` are redundant and were dropped."""
        if self.tie is not None:
            self.tie.set_redundant(equations, redundant)
        along = np.zeros(len(self.nodes), dtype=bool)
        along[equations.contactor[equations.normal]] = redundant[equations.normal]
        if (along != self.trial.redundant).any():
            self.trial = replace(self.trial, redundant=along)
        if self.friction is not None:
            self.friction.set_redundant(equations, redundant)

    def forces(self, equations: ContactRows, multipliers: Array, du: Array | None = None) -> Traction:
        """Contact forces from the multipliers of the equations ``(m,)`` (collective).

        ``du (n_owned, gdim)`` is the increment used for the prediction; None for the current configuration.
        """
        if self.friction is None:
            found = self.kinematics.forces(self.trial, equations, multipliers)
        else:
            found = self.friction.forces(equations, multipliers, self.trial, self.kinematics, du)
        return found if self.tie is None else self.tie.with_forces(found, equations, multipliers)

    def nodal_forces(self, state: PairState) -> tuple[Ints, Array]:
        """The contact forces of a state at nodes of both bodies; see ``Kinematics.nodal_forces``."""
        own = self.kinematics.nodal_forces
        return own(state) if self.tie is None else self.tie.nodal_forces(state, own)

    def with_forces(self, found: Traction) -> PairState:
        """The trial state with computed or predicted contact forces."""
        state = replace(self.trial, lam=found.lam, nodal=found.nodal, force=found.force, heat=found.heat, bond=found.bond)
        if state.friction is None or found.tau is None:
            return state
        return replace(state, friction=replace(state.friction, tau=found.tau))

    def set_forces(self, found: Traction, active: Bools | None = None) -> None:
        """Set contact forces of the trial state, and the active set ``(n,)`` if a method other than elimination decides on it."""
        state = self.with_forces(found)
        self.trial = state if active is None else replace(state, active=active)

    def curvature(self, state: PairState | None = None) -> list[tuple[Ints, Array]]:
        """Blocks of ``-sum lambda d(row)/du``: lists of global nodes ``(k, m)`` and values ``(k, m g, m g)`` (collective).

        With the forces of a ``state``; None is the trial state.
        """
        state, k = state or self.trial, self.kinematics
        along = None if self.friction is None else self.friction.along(state, k)
        parts = k.curvature(state) if along is None else k.curvature(state, along)
        return parts if self.tie is None else parts + self.tie.curvature(state)

    def slip_terms(self, convex: bool = False) -> tuple[Ints, Array, Array] | None:
        """Terms of sliding friction in tangent and residual: nodes and blocks as in ``curvature``, forces ``(k, (1 + nn) gdim)``."""
        return None if self.friction is None else self.friction.slip_terms(self.trial, self.kinematics)

    # -- trial and committed ---------------------------------------------------------------------------------------------

    def unite(self, which: Bools | None = None) -> None:
        """Tie contactors to the target permanently, between two steps, see ``Tie``; call ``project`` afterwards (collective)."""
        assert self.tie is not None
        self.committed = self.tie.unite(
            self.committed, self.kinematics.projection, self.kinematics.ends.excluded(self.trial), which
        )
        self.restore()

    def commit(self) -> None:
        """Make the trial state the committed one; call ``project`` afterwards."""
        if self.far:
            return
        if self.friction is not None:
            if not self.in_reach:
                self.friction.place(self.kinematics, self.trial)
            self.trial = self.friction.commit(self.trial, self.committed, self.kinematics)
        inside, ends = self.kinematics.projection.gap < 0, self.kinematics.ends
        self.trial = replace(self.trial, barred=self.trial.barred & inside, at_end=ends.reached(self.trial))
        passed = self.off | (self.trial.passed & inside)
        reserved = self.trial.reserved & bool(self.trial.active.any())
        fresh = replace(self.trial, changes=np.zeros_like(self.trial.changes), passed=passed, reserved=reserved)
        self.committed = replace(fresh, at_end=ends.held(fresh))
        self.restore()
        self.discretisation.commit()

    def restore(self) -> None:
        """Go back to the committed state; call ``project`` afterwards."""
        self.trial = self.committed
        if self.tie is not None:
            self.tie.lose()
        if self.friction is not None and self.friction.wear is not None:
            assert self.committed.friction is not None
            self.friction.wear.apply(self.committed.friction.worn)

    def remember(self, state: PairState) -> None:
        """Return to a committed state; call ``project`` afterwards, with bodies and target at their positions of that time."""
        # contactors that have been tied since then remain tied
        self.committed = state if self.tie is None else self.tie.untouched(state)
        # an earlier state may bring the surfaces together
        self.search()
        self.discretisation.commit()
        if self.friction is not None:
            self.friction.forget()
        self.restore()

    def from_checkpoint(self, kept: Mapping[str, npt.NDArray[Any]]) -> None:
        """Restore a state from ``to_checkpoint``; call ``project`` afterwards (collective)."""
        if self.tie is not None:
            self.tie.from_checkpoint(kept, self.kinematics.ends.excluded(self.trial))
        self.remember(PairState.from_checkpoint(kept, self.target.facets_of))

    # -- read access --------------------------------------------------------------------------------------------------------

    @property
    def members(self) -> Sequence[Any]:
        """Interfaces of the single contacts: itself, unless several are treated together."""
        return [self]

    @property
    def whole(self) -> Any:
        """The joint interface that contains it: itself, unless several are treated together."""
        return self

    @property
    def in_reach(self) -> bool:
        """Whether any contactor on any rank was near the target in the last placement."""
        return self.discretisation.in_reach

    @property
    def far(self) -> bool:
        """Whether it is skipped, since the surfaces are separated."""
        return all(self.discretisation.setting.far)

    def set_offset(self, offset: Array | None) -> None:
        """Set offsets ``(n,)``; contactors must be placed again (collective)."""
        self.discretisation.set(offset=offset)

    @property
    def target(self) -> Target:
        """Target of the contactors."""
        return self.discretisation.target

    @property
    def points(self) -> Array:
        """Current positions of the contactors ``(n, gdim)``."""
        return self.config.here(self.nodes)

    @property
    def off(self) -> Bools:
        """Contactors past an end of the target, barred, or tied ``(n,)``."""
        out = self.kinematics.ends.excluded(self.trial)
        return out if self.tie is None else out | self.tie.excluded

    @property
    def traction(self) -> Traction:
        """Contact forces of the trial state."""
        t = self.trial
        return Traction(t.lam, t.nodal, t.force, None if t.friction is None else t.friction.tau, bond=t.bond)

    def largest_gap_here(self) -> float:
        """Largest gap of an active contactor of this rank, or distance from its anchor or tied position, a length."""
        here = float(np.abs(self.kinematics.gap[self.trial.active & ~self.trial.redundant]).max(initial=0.0))
        if self.friction is not None:
            here = max(here, float(self.friction.distances(self.trial).max(initial=0.0)))
        return here if self.tie is None else max(here, self.tie.largest_gap_here())

    @property
    def tied(self) -> Bools:
        """Contactors tied permanently to the target in all components ``(n,)``."""
        return np.zeros(len(self.nodes), dtype=bool) if self.tie is None else self.tie.tied

    @property
    def united(self) -> Bools:
        """Contactors that are active or tied ``(n,)``."""
        return self.trial.active if self.tie is None else self.trial.active | self.tie.tied

    def displaced(self) -> float:
        """Norm of the forces that gaps would make by a displacement of the size of positions; 0 without stiffness (collective)."""
        return 0.0

    def pressing(self) -> tuple[Array, Array]:
        """Normal ``(n,)`` and tangential forces ``(n, gdim)`` that belong to ``areas`` (collective)."""
        t = self.trial
        tau = 0.0 * t.force if t.friction is None else t.friction.tau
        return (t.lam, tau) if self.tie is None else self.tie.pressing(t, self.kinematics.projection.normal, t.lam, tau)

    def applied_forces(self) -> tuple[Ints, Array] | None:
        """Loads that belong to the interface: global nodes ``(k,)`` and forces ``(k, gdim)``; None without loads (collective)."""
        return None if self.tie is None else self.tie.applied_forces()

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays ``(n, ...)`` for checkpoints, with facets as keys independent of the partition (collective)."""
        kept = self.committed.to_checkpoint(self.target.keys_of)
        return kept if self.tie is None else kept | self.tie.to_checkpoint()


def in_question(pairs: Sequence[Interface]) -> list[Interface]:
    """Pairs with a contactor near the target on any rank; in an iteration, the other pairs are only placed."""
    return [pair for pair in pairs if pair.in_reach]


def motions_of(pairs: Sequence[Interface]) -> list[Motion | None]:
    """Present motions of the pairs' rigid targets; None for targets that have not moved, and for meshes."""
    return [pair.target.motion for pair in pairs]
