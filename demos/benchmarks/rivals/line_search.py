"""A line search for contact forces that come from a potential: continue until the energy no longer decreases."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from collections.abc import Callable

#: The slope may be left with this part of what it was.
FLAT = 0.3
#: Forces that are left with this part of their norm are small enough.
SMALLER = 0.9
#: Shortest step.
SHORTEST = 2.0**-20
#: So many slopes are looked at.
MOST_LOOKS = 24


def flat_length(look: Callable[[float], tuple[float, float]], start: tuple[float, float], longest: float = 1.0) -> float:
    """Length of a step at which the forces are smaller or the potential has stopped falling (collective if ``look`` is).

    Args:
        look: derivative of the potential along the step, and norm of the forces, at a length; infinite where there is no potential.
        start: both at length 0; the slope is negative.
        longest: bound.
    """
    low, high, length = 0.0, longest, longest
    for _ in range(MOST_LOOKS):
        slope, norm = look(length)
        if norm <= SMALLER * start[1]:
            return length
        if slope > -FLAT * start[0]:
            high = length
        elif slope < FLAT * start[0] and length < longest:
            low = length
        else:
            return length
        length = 0.5 * (low + high)
        if length < SHORTEST:
            break
    return length
