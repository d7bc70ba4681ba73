"""Which contactors are active: who is released, who is activated. Pure functions of arrays, without mesh and without communication.

The conditions are ``gap >= 0, force >= 0``, one of them zero [UEM, 4.4]. They are settled on the linearised problem, before anything
moves: its solution foretells gaps and forces, contactors that it shows on the wrong side are exchanged, and it is solved again
(block pivoting; Judice and Pires, 1994, doi:10.1016/0305-0548(94)90106-6). A caller with several ranks reduces ``Wrong.count`` and
``Wrong.worst`` over them between ``find_wrong`` and ``exchange``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.errors import ConvergenceError

#: Contactors whose gap is smaller, as part of the model's size, touch without force.
#: [convention; the model's size; test_active_set.py::test_what_touches_at_the_start]
TOUCHING = 1e-9
#: Gaps below this part of the model's size are zero.
#: [convention; the model's size; test_active_set.py::test_gaps_below_rounding_do_not_activate]
GAP_ROUNDING = 1e-13
#: Where more contactors enter than touch, only those deeper than this part of the deepest do, or deeper still in the plane: a
#: paraboloid that comes down on something elastic touches where it would overlap by more than half of the most (Hertz).
#: [derived; the deepest overlap; test_active_set.py::test_first_touch_of_a_paraboloid]
DEEP_ENOUGH = 0.5
#: Contactors as wrong as the worst, but for this part, are exchanged with it: rounding does not choose between equals.
#: [convention; the worst violation; test_active_set.py::test_equals_are_exchanged_together]
TIED = 1e-6
#: So many exchanges in a row may bring no fewer wrong contactors before the worst is exchanged alone.
#: [convention; exchanges; test_active_set.py::test_when_the_worst_goes_alone]
PATIENCE = 3


@dataclass(frozen=True)
class Wrong:
    """Contactors that break the conditions of contact, each ``(n,)``.

    Attributes:
        enter: open ones whose gap is negative.
        release: closed ones whose force is tension, or that can no longer be held.
        violation: how far, as a force: the tension, or the overlap times the contactor's stiffness; zero where nothing is wrong.
    """

    enter: Bools
    release: Bools
    violation: Array

    @property
    def count(self) -> int:
        """Number of wrong contactors."""
        return int(self.enter.sum() + self.release.sum())

    @property
    def worst(self) -> float:
        """Largest violation, a force."""
        return float(self.violation.max(initial=0.0))

    def among_the_worst(self, worst: float) -> Wrong:
        """Those alone whose violation equals the ``worst`` of all."""
        kept = self.violation >= (1.0 - TIED) * worst
        return Wrong(self.enter & kept, self.release & kept, self.violation)

    def on_first_touch(self, gap: Array, depth: float) -> Wrong:
        """Those alone that enter by so much at least, a length, besides all that are released; ``gap (n,)`` decides on contact."""
        return Wrong(self.enter & (gap <= -depth), self.release, self.violation)


def deep_enough(span: float, gdim: int) -> float:
    """Part of the deepest overlap from which contactors touch at first, of those that would overlap if nothing gave way.

    In the plane a cylinder touches within a half width ``a`` where bodies of size L have given way by
    ``a^2 / (2 R) (log(4 L / a) - 1/2)`` (Johnson, Contact Mechanics, 1985, 5.6): the smaller the contact, the less of the overlap.
    The overlap is some twice as wide. Taken are a quarter of the model's size for L, which is a body's radius, and for a a third of
    the width of the overlap: a quarter would be right for whole bodies, a half for those cut at a plane of symmetry.

    Args:
        span: width of the overlap over the model's size; zero where a single contactor overlaps.
        gdim: dimension of space.
    """
    if gdim == 3 or span == 0.0:
        return DEEP_ENOUGH
    return max(DEEP_ENOUGH, 1.0 - 1.0 / (np.log(3.0 / min(span, 1.0)) - 0.5))


def find_wrong(
    state: PairState,
    gap: Array,
    lam: Array,
    off: Bools,
    movable: Bools,
    stiffness: Array,
    *,
    force_rounding: Array | float,
    gap_rounding: float,
) -> Wrong:
    """Find the contactors that break the conditions.

    Args:
        state: of the contactors.
        gap: that decides on contact, here or foreseen ``(n,)``.
        lam: contact force along the normal, here or foreseen ``(n,)``.
        off: contactors past the target's end, or that may not enter for another reason ``(n,)``.
        movable: contactors whose gap can be closed ``(n,)``.
        stiffness: of the contactors along the normal, a force per length ``(n,)``.
        force_rounding: forces below it are zero, of all or of each contactor ``(n,)``.
        gap_rounding: gaps below it are zero.
    """
    release = state.active & ((lam < -force_rounding) | ~movable)
    enter = ~state.active & ~off & movable & (gap < -gap_rounding)
    violation = np.where(enter, -gap * stiffness, np.where(release, np.where(movable, -lam, np.inf), 0.0))
    return Wrong(enter, release, violation)


def exchange(state: PairState, wrong: Wrong) -> PairState:
    """The state in which the wrong contactors have changed sides; forces stay until they are read anew."""
    active = (state.active | wrong.enter) & ~wrong.release
    return replace(state, active=active, passed=state.passed & ~active)


def slide_off(state: PairState, off: Bools) -> PairState:
    """The state in which active contactors past the target's end have been let go.

    Args:
        state: of the contactors.
        off: those past the end ``(n,)``.
    """
    gone = state.active & off
    active = state.active & ~off
    return replace(state, active=active, slips=state.slips + gone, passed=(state.passed | gone) & ~active)


class Pivoting:
    """Whether all wrong contactors are exchanged, or the worst alone, from exchange to exchange of one linearised problem.

    All at once is fast but may go in circles; the worst alone does not, as a rule.
    """

    def __init__(self) -> None:
        self._fewest: float = np.inf
        self._tries = PATIENCE
        self._again = False
        self._seen: set[tuple[int, ...]] = set()
        #: How often each has come since fewer were wrong than ever before.
        self._times: dict[tuple[int, ...], int] = {}

    @property
    def ahead(self) -> bool:
        """Whether others that are not wrong yet may be exchanged with the worst: in a pattern that it went alone in before they may not."""
        return self._tries < 0 and not self._again

    def start_again(self) -> None:
        """Exchange all wrong contactors again, after others have been exchanged with them."""
        self._fewest, self._tries = np.inf, PATIENCE

    def all_at_once(self, count: int) -> bool:
        """Whether all ``count`` wrong contactors are exchanged."""
        if count < self._fewest:
            self._fewest, self._tries, self._times = count, PATIENCE, {}
            return True
        self._tries -= 1
        return self._tries >= 0

    def repeats(self, pattern: Sequence[int], told: bool = False) -> bool:
        """Whether the worst has been exchanged alone among such contactors before.

        Args:
            pattern: what tells the contactors' states, a number of each rank.
            told: whether they tell all there is, so that what has come three times will come for ever.

        Raises:
            ConvergenceError: if it will.
        """
        key = tuple(pattern)
        self._times[key] = self._times.get(key, 0) + 1
        if told and self._times[key] > 2:
            raise ConvergenceError("the active set goes in a circle: take smaller load steps, or a target of finer facets")
        again = key in self._seen
        self._seen.add(key)
        self._again = self._again or again
        return again


def touching(state: PairState, gap: Array, size: float, allowed: Bools) -> PairState:
    """The state in which contactors that touch without force are active as well.

    Args:
        state: of the contactors.
        gap: that decides on contact ``(n,)``.
        size: the model's, a length.
        allowed: contactors that may be active ``(n,)``.
    """
    return replace(state, active=state.active | ((np.abs(gap) <= TOUCHING * size) & allowed))
