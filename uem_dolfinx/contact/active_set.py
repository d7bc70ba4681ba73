"""Which contactors are active: who is released, who is activated. Pure functions of arrays, without mesh and without communication.

The conditions are ``gap >= 0, force >= 0``, one of them zero [UEM, 4.4]. A caller with several ranks reduces ``Extremes`` over them
between ``find_wrong`` and ``exchange``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.state import PairState

#: Contactors whose gap is smaller, as part of the model's size, touch without force.
#: [convention; the model's size; test_active_set.py::test_what_touches_at_the_start]
TOUCHING = 1e-9
#: Gaps below this part of the model's size are zero.
#: [convention; the model's size; test_active_set.py::test_gaps_below_rounding_do_not_activate]
GAP_ROUNDING = 1e-13
#: Where more contactors enter than touch, only those deeper than this part of the deepest do.
#: [heuristic; the deepest overlap; -]
DEEP_ENOUGH = 0.5


@dataclass(frozen=True)
class Wrong:
    """Contactors that break the conditions of contact, each ``(n,)``.

    Attributes:
        enter: open ones whose gap is negative.
        release: closed ones whose force is tension, or that can no longer be held.
    """

    enter: Bools
    release: Bools


@dataclass(frozen=True)
class Extremes:
    """What the choice among wrong contactors needs to know of all of them.

    Attributes:
        deepest: largest overlap of those that enter, a length.
        tension: largest tension of those that are released, a force.
        entering: number of those that enter.
        touching: number of active ones.
    """

    deepest: float
    tension: float
    entering: int
    touching: int


def find_wrong(
    state: PairState, gap: Array, off: Bools, movable: Bools, *, force_rounding: float, gap_rounding: float, swept: bool
) -> Wrong:
    """Find the contactors that break the conditions.

    Args:
        state: of the contactors.
        gap: that decides on contact ``(n,)``.
        off: contactors past the target's end ``(n,)``.
        movable: contactors whose gap can be closed ``(n,)``.
        force_rounding: forces below it are zero.
        gap_rounding: gaps below it are zero.
        swept: leave out those that have slid off a thin target, which sweeps past them on the way to equilibrium.
    """
    release = state.active & ((state.lam < -force_rounding) | off | ~movable)
    enter = ~state.active & ~off & movable & (gap < -gap_rounding)
    return Wrong(enter & (state.slips == 0) if swept else enter, release)


def extremes(state: PairState, wrong: Wrong, gap: Array) -> Extremes:
    """What the contactors of one rank contribute."""
    return Extremes(
        float(-np.min(gap[wrong.enter], initial=0.0)),
        float(-np.min(state.lam[wrong.release], initial=0.0)),
        int(wrong.enter.sum()),
        int(state.active.sum()),
    )


def exchange(
    state: PairState, wrong: Wrong, gap: Array, off: Bools, of_all: Extremes, *, cautious: bool, settled: bool
) -> tuple[PairState, bool]:
    """Activate and release.

    Args:
        state: of the contactors.
        wrong: those that break the conditions.
        gap: that decides on contact ``(n,)``.
        off: contactors past the target's end ``(n,)``.
        of_all: extremes over all ranks.
        cautious: change only the worst contactor, and release none before equilibrium: this ends a cycle of active sets.
        settled: whether the bodies are in equilibrium with the present active set.

    Returns:
        The new state, and whether any of these contactors changed. Nodal forces stay until they are read anew: the next iteration is
        no better without the curvature of what is released.
    """
    enter, release = wrong.enter, wrong.release
    if of_all.entering > of_all.touching:
        # a body that comes down on a paraboloid touches where the overlap exceeds half of the deepest
        enter = enter & (gap <= -DEEP_ENOUGH * of_all.deepest)
    if cautious:
        enter = enter & ((gap <= -of_all.deepest) | (state.slips > 1))
        worst = off | (state.lam <= -of_all.tension) if settled and of_all.deepest == 0.0 else off
        release = release & worst
    active = (state.active | enter) & ~release
    slips = state.slips + (release & off)
    passed = (state.passed | (release & off)) & ~active
    new = replace(state, active=active, lam=np.where(active, state.lam, 0.0), slips=slips, passed=passed)
    return new, bool(enter.any() or release.any())


def touching(state: PairState, gap: Array, size: float, allowed: Bools) -> PairState:
    """The state in which contactors that touch without force are active as well.

    Args:
        state: of the contactors.
        gap: that decides on contact ``(n,)``.
        size: the model's, a length.
        allowed: contactors that may be active ``(n,)``.
    """
    return replace(state, active=state.active | ((np.abs(gap) <= TOUCHING * size) & allowed))


def extrapolate(committed: PairState, last: PairState, trial: PairState, ratio: float, gap: Array, allowed: Bools) -> PairState:
    """First active set of a step: active ones whose extrapolated force is no tension, open ones whose extrapolated gap is negative.

    Args:
        committed: state of the last step.
        last: state of the step before.
        trial: the state that gets the active set.
        ratio: this step's length over the last one's.
        gap: at the extrapolated displacement ``(n,)``.
        allowed: contactors that may enter ``(n,)``.
    """
    lam = committed.lam + ratio * (committed.lam - last.lam)
    return replace(trial, active=np.where(committed.active, lam >= 0, (gap < 0) & allowed))
