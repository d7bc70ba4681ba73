"""The interface of one contact: contactors, what ties them to their target, and the law they follow. It places, decides and commits.

It keeps a trial state that changes with every iteration and a committed one that changes only after convergence.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.laws.law import FrictionLaw
from uem_dolfinx.contact.pair.told import Told
from uem_dolfinx.contact.seam import active_set
from uem_dolfinx.contact.seam.ends import slide_off
from uem_dolfinx.contact.seam.placement import NORMAL, Constraints, Discretisation, Kinematics, Traction
from uem_dolfinx.contact.seam.state import FrictionState, PairState
from uem_dolfinx.errors import NotFiniteError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import agree, reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.sliding import Sliding
    from uem_dolfinx.contact.thermal.heat import Heat
    from uem_dolfinx.contact.ties.tie import Tie

#: Contactors this part of the model's size from where they belong are there.
#: [derived; the model's size; test_system.py::test_the_normal_return]
POSITION_ROUNDING = 4.0 * np.finfo(float).eps


class Interface(Told):
    """Contactors against one target.

    Args:
        config: configuration of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        discretisation: what ties them to their target.
        friction: what it adds along the target; None without.
        tie: what ties contactors for good, beside contact; None without.
        name: for messages.
        sliding: ``"finite"``, ``"small"`` or ``"fixed"``.
        max_penetration: bound on the initial penetration, a length.
        thickness: of the target's body, a length.

    Attributes:
        trial: state of the present iteration.
        committed: state of the last step.
        kinematics: of the contactors, for the trial state; known after ``project``.
        initial_overlap: depth of the deepest contactor inside the target before the first step, a length.
        redundant: active contactors whose equations depend on others and were left out ``(n,)``.
        reserved: contactors that have rows in the sparsity of P ``(n,)``.
        mutual: whether contactor and target follow each other (two-pass).
        heats: what passes through, one of every conductance.
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
        sliding: str,
        max_penetration: float,
        thickness: float = np.inf,
    ):
        self.config, self.nodes, self.discretisation, self.friction, self.tie = config, nodes, discretisation, friction, tie
        self.name, self.sliding, self.max_penetration, self.thickness = name, sliding, max_penetration, thickness
        state = PairState.initial(n := len(nodes), g := config.gdim)
        along, bond = FrictionState.initial(n, g) if friction else None, np.zeros((n, g)) if tie else None
        self.trial = self.committed = replace(state, friction=along, bond=bond)
        self.heats: list[Heat] = []
        none: Bools = np.zeros(n, dtype=bool)
        self.redundant = self.reserved = self._redundant = self._reserved = none
        self.initial_overlap, self.mutual = 0.0, False

    # -- where the contactors stand --------------------------------------------------------------------------------------

    def project(self) -> None:
        """Project the contactors onto the target where both are now (collective).

        Raises:
            NotFiniteError: if the target's functions return what is not finite.
        """
        if self.asked or not self.far:
            self._project()

    @timed("projection")
    def _project(self) -> None:
        if self.tie is not None and not self.tie.begin_placement():
            return
        known = hasattr(self, "kinematics")
        self.kinematics = self.discretisation.place(self.points, self.trial)
        if known and not self.asked:
            none, united = np.zeros(len(self.nodes)), sum(heat.law.perfect for heat in self.heats)
            heat = np.zeros((len(none), united)) if united else None
            self.set_forces(Traction(none, none, np.zeros(self.points.shape), heat=heat))
            return
        p = self.projection
        bad = np.flatnonzero(~(np.isfinite(p.gap) & np.isfinite(p.normal).all(axis=1)))
        error = None
        if len(bad):
            i = int(bad[0])
            error = NotFiniteError(
                f"{self.name_at(i)}: gap {p.gap[i]}, normal {p.normal[i]} at {self.config.describe(int(self.nodes[i]))}: "
                "distance and gradient of the target must be finite, and the gradient must not vanish, near the contactors"
            )
        agree(self.config.comm, error)
        self._place_friction()

    def _place_friction(self) -> None:
        if self.friction is not None:
            assert self.trial.friction is not None
            self.friction.place(self.kinematics, self.trial.friction)

    def _replace(self, kinematics: Kinematics) -> None:
        """Take other kinematics at the same displacement (collective)."""
        # values that are the same on one rank are so on all
        if kinematics is not self.kinematics:
            self.kinematics = kinematics
            if self.friction is not None:
                self.friction.replace(kinematics)

    def look(self) -> None:
        """Place contactors that were not looked at since the surfaces are far apart (collective)."""
        if self.far:
            self.far = False
            self.project()

    def return_vectors(self) -> Array:
        """Displacements of the normal return [UEM, 4.2], zero where active contactors are on the target to rounding ``(n, gdim)``."""
        correction = np.zeros(self.points.shape)
        if self.discretisation.at_feet:
            correction = self.kinematics.gap_rows.normal_return(self.trial.active)
        if self.friction is not None:
            correction = correction + self.friction.return_vectors(self.trial)
        # surfaces that follow each other would both make up for the same gap
        correction[(np.linalg.norm(correction, axis=1) <= POSITION_ROUNDING * self.config.size) | self.mutual] = 0.0
        return correction

    # -- activation and release ------------------------------------------------------------------------------------------

    def set_friction(self, law: FrictionLaw, value: Array) -> None:
        """Take a law of friction, and other values of its parameter ``(n,)``, between two steps (collective)."""
        assert self.friction is not None
        self.trial = self.committed = self.friction.other_law(self.committed, law, value)

    def _set_active(self, state: PairState) -> None:
        """Take over a state with another active set."""
        self.trial = state if self.friction is None else self.friction.come_and_go(state, self.trial.active)

    def activate_touching(self) -> None:
        """Start with the contactors that touch without force as active, where they stick (collective)."""
        anchored = self.friction.anchored(self.trial, self.kinematics) if self.friction is not None else None
        state = active_set.touching(self.trial, self.gap, self.config.size, ~self.off & self.movable)
        self._set_active(replace(state, at_end=self._at_end(self.trial)))
        if anchored is not None and self.trial.friction is not None:
            self.trial = replace(self.trial, friction=replace(anchored, stick=self.trial.friction.stick))
        # a first step that fails and is cut starts from here again
        self.committed = self.trial
        if anchored is not None:
            self.project()

    def bar_returned(self) -> int:
        """Leave out contactors that had passed the end of the target, sunk, and are taken back in this step: how many (collective)."""
        came = self.trial.active & ~self.committed.active & self.committed.passed
        self.committed = replace(self.committed, barred=self.committed.barred | came)
        return int(reduced(self.config.comm, int(came.sum())))

    def _at_end(self, state: PairState) -> Bools:
        """Contactors that an end of the target holds in the next step ``(n,)``: where surfaces follow each other, the end touches."""
        return self.kinematics.ends.held(state) & np.logical_not(self.mutual)

    def follow(self) -> bool:
        """Let go of contactors past an end, follow the others from facet to facet (collective): whether any equation changes here."""
        off = self.off
        gone = bool((self.trial.active & off).any())
        self.kinematics, state, moved = self.kinematics.follow(slide_off(self.trial, off))
        self._set_active(state)
        return gone or moved

    def predicted(self, du: Array) -> Array:
        """Gaps that decide on contact, to first order in an increment of the owned nodes ``(n_owned, gdim)``: ``(n,)`` (collective)."""
        return self.kinematics.gap_rows.gaps(du)

    def violated(
        self,
        gap: Array,
        seen: Traction,
        stiffness: Array,
        force_rounding: Array,
        gap_rounding: float,
        swept: bool,
        du: Array | None = None,
    ) -> active_set.Violations:
        """Contactors that break the conditions of contact with such gaps and forces (collective).

        Args:
            gap: that decides on contact ``(n,)``.
            seen: contact forces, here or predicted.
            stiffness: of the contactors along the normal ``(n,)``.
            force_rounding: forces below it are zero ``(n,)``.
            gap_rounding: gaps below it are zero, and below rounding of positions.
            swept: leave out those that have slid off a thin target, which sweeps past them on the way to equilibrium.
            du: increment of the owned nodes with which they are predicted ``(n_owned, gdim)``; None where the bodies are now.
        """
        off = self.off
        if swept and self.thickness < np.inf:
            off = off | (self.trial.at_end & self.trial.passed)
        # an equation that was left out as dependent and does not hold is no contact
        apart = self.redundant & (gap > max(gap_rounding, active_set.TOUCHING * self.config.size))
        # the facets of a corner are let go of one by one, which ``follow`` does
        pulled = np.where(self.trial.in_corner, 0.0, seen.lam)
        rounding = max(gap_rounding, active_set.GAP_ROUNDING * self.config.size)
        violated = active_set.find_violations(
            self.trial, gap, pulled, off, self.movable & ~apart, stiffness, force_rounding=force_rounding, gap_rounding=rounding
        )
        if self.friction is None:
            return violated
        return self.friction.violated(violated, self.trial, seen, stiffness, (force_rounding, rounding), du)

    def exchange(self, violated: active_set.Violations, ahead: bool) -> bool:
        """Let wrong contactors change sides, and those that are to follow them if ``ahead`` (collective): whether there are any."""

        def enter(state: PairState) -> PairState:
            self.trial = state
            self._set_active(active_set.exchange(state, violated))
            return self.trial

        if self.friction is None:
            enter(self.trial)
            return False
        self.trial, led = self.friction.exchange(violated, self.trial, self.committed, self.kinematics, ahead, enter)
        return led

    def calm(self, which: Bools) -> bool:
        """Give those of contactors ``which (n,)`` that bends lead to and fro averaged normals in this step: whether any gets them."""
        from uem_dolfinx.contact.nodes.concave_edges import HOLD_AFTER, MOST_CHANGES

        changes = self.trial.changes
        some = which & self.trial.active & (changes >= HOLD_AFTER) & (changes < MOST_CHANGES)
        self.trial = replace(self.trial, changes=np.where(some, MOST_CHANGES, changes))
        return bool(some.any())

    def meet(self, others: Sequence[Interface]) -> None:
        """Take what other contacts with rigid surfaces do to the same contactors (collective)."""
        if self.friction is None:
            return
        normals = np.zeros((len(self.nodes), len(others), self.config.gdim))
        for k, other in enumerate(others):
            _, own, theirs = np.intersect1d(self.nodes, other.nodes, return_indices=True)
            normals[own, k] = np.where(other.trial.active[theirs, None], other.projection.normal[theirs], 0.0)
        self.friction.meet(self.kinematics, normals)

    def place_again(self) -> None:
        """Put contactors whose equations have changed where they now belong (collective)."""
        self._replace(self.kinematics.placed_again(self.trial))

    # -- bodies that only contact holds ----------------------------------------------------------------------------------

    @property
    def _ahead(self) -> Ints:
        """Contactors in front of the target that are not active."""
        return np.flatnonzero(~self.trial.active & ~self.off & self.movable)

    @property
    def approach(self) -> UnitingEquations:
        """The equations that inactive contactors in front of the target would have if they were active."""
        rows = self.kinematics.gap_rows.select(self._ahead, np.ones(len(self.nodes), bool))
        return rows.test.select(rows.kind == NORMAL)

    def activate_closing(self, closing: Bools) -> bool:
        """Activate the contactors among those of ``approach`` that close and touch (collective): whether there are any."""
        i = self._ahead
        now = i[closing & (self.gap[i] <= active_set.TOUCHING * self.config.size)]
        active = self.trial.active.copy()
        active[now] = True
        self._set_active(replace(self.trial, active=active))
        return bool(reduced(self.config.comm, len(now)))

    def release_apart(self) -> None:
        """Release contactors without friction that rigid motions have taken off their target (collective)."""
        if not self.frictional:
            apart = self.trial.active & (self.gap > active_set.TOUCHING * self.config.size)
            self._set_active(replace(self.trial, active=self.trial.active & ~apart))

    # -- what the united system gets -------------------------------------------------------------------------------------

    def equations(self) -> Constraints:
        """Uniting equations of the contactors that are or may become active, then of those that are tied (collective).

        Those near the target have rows, found anew when an active one lacks its own; those that touch first alone until others follow.
        """
        lacks, known = reduced(self.config.comm, np.array([(self.trial.active > self.reserved).sum(), self.reserved.sum()]))
        if lacks:
            self.reserved = self.kinematics.ends.near(self.trial) & ~self.tied if known else self.trial.active.copy()
        own = self.kinematics.gap_rows.select(np.flatnonzero(self.reserved), self.trial.active)
        if self.friction is not None:
            own = self.friction.equations(own, self.trial, self.kinematics)
        return own if self.tie is None else self.tie.join(own)

    def set_redundant(self, equations: Constraints, redundant: Bools) -> None:
        """Take which of the equations ``(m,)`` depend on others and were left out."""
        if self.tie is not None:
            self.tie.set_redundant(equations, redundant)
        equations, redundant = equations.contact, redundant[: len(equations.contact)]
        normal = (equations.kind == NORMAL) & (equations.tangent < 0)
        self.redundant = np.zeros(len(self.nodes), dtype=bool)
        self.redundant[equations.contactor[normal]] = redundant[normal]
        if self.friction is not None:
            self.friction.set_redundant(equations, redundant)

    def forces(self, equations: Constraints, multipliers: Array, du: Array | None = None) -> Traction:
        """Contact forces from the multipliers of the equations ``(m,)`` (collective).

        ``du (n_owned, gdim)`` is the increment that they are predicted with; None where the bodies are now.
        """
        contact = equations.contact
        of, trial, kinematics = multipliers[: len(contact)], self.trial, self.kinematics
        if self.friction is None:
            found = kinematics.forces(trial, contact, of)
        else:
            found = self.friction.forces(contact, of, trial, kinematics, du)
        return found if self.tie is None else self.tie.with_forces(found, equations, multipliers)

    def nodal_forces(self, state: PairState) -> tuple[Ints, Array]:
        """The contact forces of a state at nodes of both bodies; see ``Kinematics.nodal_forces``."""
        own = self.kinematics.nodal_forces
        return own(state) if self.tie is None else self.tie.nodal_forces(state, own)

    def with_forces(self, found: Traction) -> PairState:
        """The trial state with contact forces that were read or predicted."""
        state = replace(self.trial, lam=found.lam, nodal=found.nodal, force=found.force, heat=found.heat, bond=found.bond)
        if state.friction is None or found.tau is None:
            return state
        return replace(state, friction=replace(state.friction, tau=found.tau))

    def set_forces(self, found: Traction, active: Bools | None = None) -> None:
        """Give the trial state contact forces, and an active set ``(n,)`` if another method than elimination decides on it."""
        state = self.with_forces(found)
        self.trial = state if active is None else replace(state, active=active)

    @property
    def has_known_forces(self) -> bool:
        """Whether friction of contactors of this rank may not grow with the force along the normal."""
        return self.friction is not None and self.friction.has_known_forces(self.trial)

    def known_forces(self) -> tuple[Ints, Array]:
        """Forces of friction that do not grow with the force along the normal: nodes ``(k,)``, forces ``(k, gdim)`` (collective)."""
        assert self.friction is not None
        return self.friction.known_forces(self.trial, self.kinematics)

    def curvature(self) -> list[tuple[Ints, Array]]:
        """Blocks of ``-sum lambda d(row)/du``: lists of global nodes ``(k, m)`` and values ``(k, m g, m g)`` (collective)."""
        parts = self.kinematics.curvature(self.trial)
        if self.friction is not None:
            parts = parts + self.friction.curvature(self.trial, self.kinematics)
        return parts if self.tie is None else parts + self.tie.curvature(self.trial)

    def turn(self, stiffness: Array) -> None:
        """Take the directions of friction from where the contactors are; ``stiffness (n_owned, gdim)``: diagonal of K (collective)."""
        if self.friction is not None:
            self.trial = self.friction.turn(self.trial, self.kinematics, stiffness)

    def slip_terms(self) -> tuple[Ints, Array, Array] | None:
        """What sliding friction adds to tangent and residual: nodes and blocks as in ``curvature``, forces ``(k, (1 + nn) gdim)``."""
        return None if self.friction is None else self.friction.slip_terms(self.trial, self.kinematics)

    # -- trial and committed ---------------------------------------------------------------------------------------------

    def unite(self, which: Bools | None = None) -> None:
        """Tie contactors to the target for good, between two steps, as of ``Tie``; to be followed by ``project`` (collective)."""
        assert self.tie is not None
        self.committed = self.tie.unite(self.committed, self.projection, self._past_end, which)
        self._reserved, self._redundant = self.reserved & ~self.tied, self.redundant
        self.restore()

    def commit(self) -> None:
        """Make the trial state the committed one; to be followed by ``project``."""
        if self.far:
            return
        if self.friction is not None:
            if not self.asked:
                self._place_friction()
            self.trial = self.friction.commit(self.trial, self.committed, self.kinematics)
        inside = self.projection.gap < 0
        self.trial = replace(self.trial, barred=self.trial.barred & inside)
        passed = self.off | (self.trial.passed & inside)
        fresh = replace(self.trial, changes=np.zeros_like(self.trial.changes), passed=passed)
        self.committed = replace(fresh, at_end=self._at_end(fresh))
        self.reserved = self.reserved & bool(fresh.active.any())
        self._reserved, self._redundant = self.reserved, self.redundant
        self.restore()
        self.discretisation.commit()
        self._wear()

    def _wear(self) -> None:
        """Let gaps be larger by what the committed state has worn (collective)."""
        if self.friction is not None and self.friction.wear is not None:
            self.friction.wear.apply(self.committed)

    def restore(self) -> None:
        """Go back to the committed state; to be followed by ``project``."""
        self.trial = self.committed
        self.reserved, self.redundant = self._reserved, self._redundant
        if self.tie is not None:
            self.tie.lose()

    def memory(self) -> tuple[PairState, Bools, Bools]:
        """What the next step begins with, the displacement aside."""
        return self.committed, self.reserved, self.redundant

    def remember(self, memory: tuple[PairState, Bools, Bools]) -> None:
        """Go on from what ``memory`` returned, to be followed by ``project`` where bodies and target were then."""
        self.committed, self.reserved, self.redundant = memory
        if self.tie is not None:
            # what has been tied since then stays so
            self.committed, self.reserved = self.tie.untouched(self.committed), self.reserved & ~self.tied
        self._reserved, self._redundant = self.reserved, self.redundant
        self.discretisation.commit()
        if self.friction is not None:
            self.friction.forget()
        self.restore()
        self._wear()

    def from_checkpoint(self, kept: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from what ``to_checkpoint`` returned, to be followed by ``project`` (collective)."""
        if self.tie is not None:
            self.tie.from_checkpoint(kept, self._past_end)
        reserved, redundant = (np.array(kept[name]) for name in ("reserved", "redundant"))
        self.remember((PairState.from_checkpoint(kept, self.target.facets_of), reserved, redundant))


def in_question(pairs: Sequence[Interface]) -> list[Interface]:
    """Pairs of which any rank has a contactor in question; the others have no part in an iteration, but for their placement."""
    return [pair for pair in pairs if pair.asked]
