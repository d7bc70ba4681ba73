"""Open ends of targets: contactors held by an end, contactors past an end, and their return."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Bools, replace
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.projection import Projection
from uem_dolfinx.geometry.search import ON_SIDE

#: A contactor that came to the target at its end, or back after it had slid off, is held there up to this part of the facet beyond it.
#: [convention; length of the facet; test_large_sliding.py::test_an_end_holds_what_was_drawn_there]
END_HOLDS = 0.1
#: A contactor that has lost its cover in a step is taken back within it where so much of its share is covered again.
#: [convention; part of its share of the facets; test_ends.py::test_which_are_out]
COVERED_AGAIN = 0.5


@dataclass(frozen=True)
class Ends:
    """Position of contactors relative to open ends of the target, and the rule that excludes contactors from contact.

    ========================================  ====================  =========================================================
    a contactor                               is remembered as      and is out
    ========================================  ====================  =========================================================
    slides to an end                                                past the end to rounding (``ON_SIDE``)
    came to the end, or was pulled there      ``at_end``            past it by ``END_HOLDS`` of a facet: no impact is added
    was pulled, or came in front, past it,    ``at_end``            the same: no other contactor is there
    with a facet over the target
    has slid off in this step                 ``at_end, passed``    past the end to rounding; under mortar until
                                                                    ``COVERED_AGAIN`` of its share is covered
    had slid off before, is behind the plane  ``passed``            past the end to rounding
    the same, deeper than a thin target       ``passed``            always: behind the body no gap is an overlap
    came back inside with a blow              ``barred``            until a step ends in which it is in front
    is covered by the target under mortar                           never, but for the third case
    is not to meet the target                 (``out``)             unless the target covers it
    ========================================  ====================  =========================================================

    ``passed`` is reset for active contactors, and for contactors in front of the target at the end of a step.
    """

    projection: Projection  # onto the nearest facets
    thickness: float  # of the target's body, a length
    #: whether an end can hold contactors, for all or for each ``(n,)``; not with mortar, whose covered areas vanish there.
    holds: bool | Bools = False
    #: covered part of each contactor's facets ``(n,)``, negative if irrelevant; None for nodal equations.
    share: Array | None = None
    out: Bools | None = None  # contactors that must not touch the target ``(n,)``, or None
    #: finds which of some contactors ``(n,)`` past an end have a facet over the target ``(n,)`` (collective), or None.
    overhanging: Callable[[Bools], Bools] | None = None

    def past(self, state: PairState) -> Bools:
        """Contactors past an end, or excluded for another reason except ``barred`` ``(n,)``."""
        p = self.projection
        limit = np.where(state.at_end & ~state.passed, END_HOLDS, ON_SIDE)
        past = (state.passed & (p.gap < -self.thickness)) | (p.way_beyond > limit * p.facet_size)
        if self.share is not None:
            past = np.where(self.share >= 0.0, state.at_end & (self.share < COVERED_AGAIN), past)
        return past if self.out is None else past | self.out

    def excluded(self, state: PairState) -> Bools:
        """Contactors past an end, or excluded for another reason ``(n,)``."""
        return self.past(state) | state.barred

    def held(self, state: PairState) -> Bools:
        """Contactors held by an end in the next step ``(n,)``: they first touch there, and have not slid away from it.

        If released immediately past the end, a contactor would sink below the target and later re-enter it with an impact.
        """
        near = (self.projection.from_end <= END_HOLDS) & ~self.past(state) & self.holds
        return np.asarray(near & (state.at_end | ~(state.active | state.passed)))

    def drawn(self, state: PairState) -> Bools:
        """Contactors held by an end in the first step ``(n,)``, also if drawn past it with a facet over the target (collective)."""
        return self.held(replace(state, at_end=state.at_end | self._over(state)))

    def reached(self, state: PairState) -> Bools:
        """``at_end`` with contactors that have come past an end in front of the target, with a facet over it ``(n,)`` (collective)."""
        return state.at_end | (self._over(state) & (self.projection.gap >= 0.0))

    def _over(self, state: PairState) -> Bools:
        """Contactors past an end with a facet over the target, except for those that have slid off in this step (collective)."""
        if self.overhanging is None:
            return np.zeros(len(state.active), dtype=bool)
        return self.overhanging(self.holds & ~state.active & ~(state.at_end & state.passed))

    def near(self, state: PairState, reach: float) -> Bools:
        """Contactors that are active, or not past an end and within one facet of the target, or ``reach`` of a rigid one ``(n,)``."""
        size = self.projection.facet_size
        within = self.projection.gap < np.where(np.isfinite(size), size, reach)
        return state.active | (within & ~self.past(state))


def slide_off(state: PairState, off: Bools) -> PairState:
    """The state after release of active contactors that are ``off (n,)`` the target."""
    if not (state.active & (off | state.passed)).any():
        return state
    gone = state.active & off
    active = state.active & ~off
    return replace(state, active=active, at_end=state.at_end | gone, passed=(state.passed | gone) & ~active)
