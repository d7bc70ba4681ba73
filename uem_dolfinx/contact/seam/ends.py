"""Open ends of targets: which contactors they hold, and which are past them."""

from __future__ import annotations

import numpy as np

from uem_dolfinx.arrays import Bools
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.projection import Projection
from uem_dolfinx.geometry.search import ON_SIDE

#: A contactor that came to the target at its end, or back after it had slid off, is held there up to this part of the facet beyond it.
#: [convention; length of the facet; test_large_sliding.py::test_an_end_holds_what_was_drawn_there]
END_HOLDS = 0.1


def past_end(p: Projection, state: PairState, thickness: float) -> Bools:
    """Contactors that are past an open end of the target in a direction in which they can move ``(n,)``.

    The end holds those that came to it there; one that has slid off is out until it is in front of the target again. Round the end of a
    target of this ``thickness`` they come behind it, where a negative gap is no penetration.
    """
    limit = np.where(state.at_end & ~state.passed, END_HOLDS, ON_SIDE)
    behind = state.passed & (p.gap < -thickness)
    return behind | (p.way_beyond > limit * p.facet_size)


def near_target(p: Projection, state: PairState, off: Bools) -> Bools:
    """Contactors that are active or nearer to the target than one of its facets is long, unless they are ``off (n,)`` it: ``(n,)``."""
    return state.active | ((p.gap < p.facet_size) & ~off)
