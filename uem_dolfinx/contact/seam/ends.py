"""Open ends of targets: which contactors they hold, which are past them, and when these are taken back."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uem_dolfinx.arrays import Array, Bools
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
    """Where contactors stand relative to the open ends of their target, and the one rule of which of them take no part in contact.

    ========================================  ====================  =========================================================
    a contactor                               is remembered as      and is out
    ========================================  ====================  =========================================================
    slides to an end                                                past the end to rounding (``ON_SIDE``)
    came to the end, or was drawn there       ``at_end``            past it by ``END_HOLDS`` of a facet: a blow is spared
    has slid off in this step                 ``at_end, passed``    past the end to rounding; under mortar until
                                                                    ``COVERED_AGAIN`` of its share is covered
    had slid off before, is behind the plane  ``passed``            past the end to rounding
    the same, deeper than a thin target       ``passed``            always: behind the body no gap is an overlap
    came back inside with a blow              ``barred``            until a step ends in which it is in front
    is covered by the target under mortar                           never, but for the third case
    is not to meet the target                 (``out``)             unless the target covers it
    ========================================  ====================  =========================================================

    ``passed`` is forgotten by what is active, and by what is in front of the target when a step ends.

    Attributes:
        projection: on the nearest facets.
        thickness: of the target's body, a length.
        holds: which contactors an end can hold, one or each ``(n,)``; what is covered of facets fades away there.
        share: that the target covers of each contactor's facets ``(n,)``, negative where it does not count; None of nodes.
        out: contactors that are not to meet the target ``(n,)``; None for none.
    """

    projection: Projection
    thickness: float
    holds: bool | Bools = False
    share: Array | None = None
    out: Bools | None = None

    def past(self, state: PairState) -> Bools:
        """Contactors past an end, or that may not meet the target for another reason, those aside that came back with a blow ``(n,)``."""
        p = self.projection
        limit = np.where(state.at_end & ~state.passed, END_HOLDS, ON_SIDE)
        past = (state.passed & (p.gap < -self.thickness)) | (p.way_beyond > limit * p.facet_size)
        if self.share is not None:
            past = np.where(self.share >= 0.0, state.at_end & (self.share < COVERED_AGAIN), past)
        return past if self.out is None else past | self.out

    def held(self, state: PairState) -> Bools:
        """Contactors that an end holds in the next step ``(n,)``: those that come to the target there, until they slide away from it.

        One that let go of the target as soon as it is the least bit past the end would sink into it, and come back with a blow.
        """
        near = (self.projection.from_end <= END_HOLDS) & ~self.past(state) & self.holds
        return np.asarray(near & (state.at_end | ~(state.active | state.passed)))

    def near(self, state: PairState) -> Bools:
        """Contactors that are active, or not past an end and nearer to the target than one of its facets is long ``(n,)``."""
        return state.active | ((self.projection.gap < self.projection.facet_size) & ~self.past(state))


def slide_off(state: PairState, off: Bools) -> PairState:
    """The state in which active contactors that are ``off (n,)`` the target have been let go."""
    gone = state.active & off
    active = state.active & ~off
    return replace(state, active=active, at_end=state.at_end | gone, passed=(state.passed | gone) & ~active)
