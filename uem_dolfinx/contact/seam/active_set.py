"""Which contactors are active: which are released, which activated. Pure functions of arrays, without mesh and without communication.

The conditions are ``gap >= 0, force >= 0``, one of them zero [UEM, 4.4]. They are settled on the linearised problem, before anything
moves: its solution predicts gaps and forces, contactors that it shows on the wrong side are exchanged, and it is solved again
(block pivoting; Judice and Pires, 1994, doi:10.1016/0305-0548(94)90106-6). A caller with several ranks reduces ``Violations.count`` and
``Violations.worst`` over them between ``find_violations`` and ``exchange``.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass, replace

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.seam.state import PairState

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
#: Size of the bodies that give way about a contact in the plane.
#: [convention; the model's size; test_active_set.py::test_first_touch_of_a_paraboloid]
GIVING_WAY = 0.25
#: Half of what touches at first in the plane: a quarter would be right for whole bodies, a half for those cut at a plane of symmetry.
#: [convention; width of the overlap; test_active_set.py::test_first_touch_of_a_paraboloid]
HALF_WIDTH = 1 / 3
#: Contactors as wrong as the worst, but for this part, are exchanged with it: rounding does not choose between equals.
#: [convention; the worst violation; test_active_set.py::test_equals_are_exchanged_together]
TIED = 1e-6
#: So many exchanges in a row may bring no fewer wrong contactors, and no state again, before the worst is exchanged alone, and as many
#: of the worst before the first.
#: [convention; exchanges; test_active_set.py::test_when_the_worst_goes_alone]
PATIENCE = 30


@dataclass(frozen=True)
class Violations:
    """Contactors that break the conditions of contact, each ``(n,)``.

    Attributes:
        enter: open ones whose gap is negative.
        release: closed ones whose force is tension, or that can no longer be held.
        violation: how far, as a force: the tension, or the overlap times the contactor's stiffness; zero where nothing is wrong.
    """

    enter: Bools
    release: Bools
    violation: Array

    @classmethod
    def none(cls, n: int) -> Violations:
        """Nothing is wrong with n contactors."""
        right = np.zeros(n, dtype=bool)
        return cls(right, right, np.zeros(n))

    @property
    def count(self) -> int:
        """Number of wrong contactors."""
        return int(self.enter.sum() + self.release.sum())

    @property
    def worst(self) -> float:
        """Largest violation, a force."""
        return float(self.violation.max(initial=0.0))

    @property
    def which(self) -> Bools:
        """All of them ``(n,)``."""
        return self.enter | self.release

    def among(self, kept: Bools) -> Violations:
        """Those alone that are ``kept (n,)``."""
        return Violations(self.enter & kept, self.release & kept, np.where(kept, self.violation, 0.0))

    def among_the_worst(self, worst: float) -> Violations:
        """Those alone whose violation equals the ``worst`` of all."""
        return self.among(self.violation >= (1.0 - TIED) * worst)

    def of_contact(self) -> Violations:
        """Those alone that break the conditions of contact."""
        return self

    def on_first_touch(self, gap: Array, depth: float) -> Violations:
        """Those alone that enter by so much at least, a length, and all that are released; ``gap (n,)`` decides on contact."""
        return Violations(self.enter & (gap <= -depth), self.release, self.violation)


def deep_enough(span: float, gdim: int) -> float:
    """Part of the deepest overlap from which contactors touch at first, of those that would overlap if nothing gave way.

    In the plane a cylinder touches within a half width ``a`` where bodies of size L have given way by
    ``a^2 / (2 R) (log(4 L / a) - 1/2)`` (Johnson, Contact Mechanics, 1985, 5.6): the smaller the contact, the less of the overlap.
    The overlap is some twice as wide. Taken are ``GIVING_WAY`` for L, which is a body's radius, and ``HALF_WIDTH`` for a.

    Args:
        span: width of the overlap over the model's size; zero where a single contactor overlaps.
        gdim: dimension of space.
    """
    if gdim == 3 or span == 0.0:
        return DEEP_ENOUGH
    return max(DEEP_ENOUGH, 1.0 - 1.0 / (np.log(4.0 * GIVING_WAY / (HALF_WIDTH * min(span, 1.0))) - 0.5))


def find_violations(
    state: PairState,
    gap: Array,
    lam: Array,
    off: Bools,
    movable: Bools,
    stiffness: Array,
    *,
    force_rounding: Array | float,
    gap_rounding: float,
) -> Violations:
    """Find the contactors that break the conditions.

    Args:
        state: of the contactors.
        gap: that decides on contact, here or predicted ``(n,)``.
        lam: contact force along the normal, here or predicted ``(n,)``.
        off: contactors past the target's end, or that may not enter for another reason ``(n,)``.
        movable: contactors whose gap can be closed ``(n,)``.
        stiffness: of the contactors along the normal, a force per length ``(n,)``.
        force_rounding: forces below it are zero, of all or of each contactor ``(n,)``.
        gap_rounding: gaps below it are zero.
    """
    release = state.active & ((lam < -force_rounding) | ~movable)
    enter = ~state.active & ~off & movable & (gap < -gap_rounding)
    violation = np.where(enter, -gap * stiffness, np.where(release, np.where(movable, -lam, np.inf), 0.0))
    return Violations(enter, release, violation)


def exchange(state: PairState, violated: Violations) -> PairState:
    """The state in which the wrong contactors have changed sides; forces stay until they are read anew."""
    active = (state.active | violated.enter) & ~violated.release
    return replace(state, active=active, passed=state.passed & ~active)


class Rule:
    """Which of the wrong contactors are exchanged, from fast to sure."""

    #: All of them: fast, but it may go in circles.
    ALL = 0
    #: The worst alone, with those that tie with it: seldom goes in circles.
    WORST = 1
    #: The first alone in an order that stays: never does where gaps and forces belong together (a P-matrix; Murty, 1974,
    #: doi:10.1007/BF01580244).
    FIRST = 2
    #: None: even so a state has come again.
    NONE = 3


class Pivoting:
    """Which wrong contactors are exchanged, from exchange to exchange of one linearised problem.

    A rule that leads to a state that it has been in already would lead there for ever: the next one takes over, until fewer are wrong
    than ever before, which cannot go on without end either.
    """

    def __init__(self) -> None:
        self._fewest: float = np.inf
        self._tries = PATIENCE
        self._rule = Rule.ALL
        self._seen: set[Hashable] = set()
        #: States in which the worst has been exchanged alone, and whether it has been twice in one.
        self._alone: set[Hashable] = set()
        self._again = False

    @property
    def ahead(self) -> bool:
        """Whether others that are not wrong yet may be exchanged with the worst: not in a state that it went alone in before."""
        return self._rule == Rule.WORST and not self._again

    def start_again(self) -> None:
        """Exchange all wrong contactors again, after others have been exchanged with them."""
        self._fewest = np.inf

    def choose(self, count: int, state: Hashable) -> int:
        """The rule for the next exchange.

        Args:
            count: number of wrong contactors.
            state: what tells this state of all contactors from others.
        """
        if count < self._fewest:
            self._fewest, self._tries, self._rule, self._seen = count, PATIENCE, Rule.ALL, set()
        elif self._rule < Rule.FIRST:
            self._tries -= 1
        if self._rule < Rule.NONE and (state in self._seen or self._tries < 0):
            self._rule, self._tries, self._seen = self._rule + 1, PATIENCE, set()
        self._seen.add(state)
        if self._rule == Rule.WORST:
            self._again = self._again or state in self._alone
            self._alone.add(state)
        return self._rule


def touching(state: PairState, gap: Array, size: float, allowed: Bools) -> PairState:
    """The state in which contactors that touch without force are active as well.

    Args:
        state: of the contactors.
        gap: that decides on contact ``(n,)``.
        size: the model's, a length.
        allowed: contactors that may be active ``(n,)``.
    """
    return replace(state, active=state.active | ((np.abs(gap) <= TOUCHING * size) & allowed))
