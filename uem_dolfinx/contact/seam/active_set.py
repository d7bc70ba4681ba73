"""Active set: release and activation of contactors. Pure functions of arrays, without mesh and without communication.

The conditions are ``gap >= 0, force >= 0``, one of them zero [UEM, 4.4]. They are solved on the linearised problem, before any node
moves: its solution predicts gaps and forces, violated contactors are exchanged, and it is solved again (block pivoting; Judice and
Pires, 1994, doi:10.1016/0305-0548(94)90106-6). A caller with several ranks reduces ``Violations.count`` over them between
``find_violations`` and ``exchange``.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Bools, replace
from uem_dolfinx.contact.seam.state import PairState

#: Contactors whose gap is smaller, as part of the model's size, touch without force.
#: [convention; the model's size; test_active_set.py::test_what_touches_at_the_start]
TOUCHING = 1e-9
#: Gaps below this part of the model's size are zero.
#: [convention; the model's size; test_active_set.py::test_gaps_below_rounding_do_not_activate]
GAP_ROUNDING = 1e-13
#: Where more contactors enter than touch, only those deeper than this part of the deepest do, or deeper still in the plane. A
#: paraboloid that comes down on something elastic touches where it would overlap by more than half of the most (Hertz).
#: [derived; the deepest overlap; test_active_set.py::test_first_touch_of_a_paraboloid]
DEEP_ENOUGH = 0.5
#: Size of the bodies that give way about a contact in the plane.
#: [convention; the model's size; test_active_set.py::test_first_touch_of_a_paraboloid]
GIVING_WAY = 0.25
#: Half of what touches at first in the plane: a quarter would be right for whole bodies, a half for those cut at a plane of symmetry.
#: [convention; width of the overlap; test_active_set.py::test_first_touch_of_a_paraboloid]
HALF_WIDTH = 1 / 3
#: So many exchanges in a row may bring no fewer wrong contactors, and no state again, before the first is exchanged alone.
#: [convention; exchanges; test_active_set.py::test_when_only_the_first_is_released]
PATIENCE = 30


@dataclass(frozen=True)
class Violations:
    """Contactors that violate the contact conditions, each ``(n,)``."""

    enter: Bools  # open contactors with negative gap
    release: Bools  # closed contactors in tension, or whose gap can no longer be closed

    @classmethod
    def none(cls, n: int) -> Violations:
        """No violation at n contactors."""
        right = np.zeros(n, dtype=bool)
        return cls(right, right)

    @property
    def count(self) -> int:
        """Number of violated contactors."""
        return int(self.enter.sum() + self.release.sum())

    @property
    def which(self) -> Bools:
        """All violated contactors ``(n,)``."""
        return self.enter | self.release

    def among(self, kept: Bools) -> Violations:
        """The violations of ``kept (n,)`` contactors."""
        return Violations(self.enter & kept, self.release & kept)

    def of_contact(self) -> Violations:
        """The violations of the contact conditions."""
        return self

    def on_first_touch(self, gap: Array, depth: float) -> Violations:
        """Entering contactors of at least this ``depth``, a length, and all released ones; ``gap (n,)`` are deciding gaps."""
        return Violations(self.enter & (gap <= -depth), self.release)


def deep_enough(span: float, gdim: int) -> float:
    """Smallest depth, as part of the deepest overlap, of contactors activated at first touch.

    In 2D, a cylinder has the contact half width ``a`` for an approach of ``a^2 / (2 R) (log(4 L / a) - 1/2)``, with bodies of size
    L (Johnson, Contact Mechanics, 1985, 5.6). The contact is smaller than the overlap of undeformed bodies, about half as wide.
    ``GIVING_WAY`` is used for L, a body's radius, and ``HALF_WIDTH`` for a.

    Args:
        span: width of the overlap over the model's size; zero for a single contactor.
        gdim: dimension of space.
    """
    if gdim == 3 or span == 0.0:
        return DEEP_ENOUGH
    return max(DEEP_ENOUGH, 1.0 - 1.0 / (np.log(4.0 * GIVING_WAY / (HALF_WIDTH * min(span, 1.0))) - 0.5))


def find_violations(
    state: PairState, gap: Array, lam: Array, off: Bools, movable: Bools, *, force_rounding: Array | float, gap_rounding: float
) -> Violations:
    """Find the contactors that violate the contact conditions.

    Args:
        state: of the contactors.
        gap: deciding gaps, current or predicted ``(n,)``.
        lam: normal contact force, current or predicted ``(n,)``.
        off: contactors past the target's end, or excluded for another reason ``(n,)``.
        movable: contactors whose gap can be closed ``(n,)``.
        force_rounding: smaller forces count as zero, for all or for each contactor ``(n,)``.
        gap_rounding: smaller gaps count as zero.
    """
    release = state.active & ((lam < -force_rounding) | ~movable)
    enter = ~state.active & ~off & movable & (gap < -gap_rounding)
    return Violations(enter, release)


def exchange(state: PairState, violated: Violations) -> PairState:
    """The state after exchange of the violated contactors; forces are unchanged until the next solution."""
    active = (state.active | violated.enter) & ~violated.release
    return replace(state, active=active, passed=state.passed & ~active)


class Rule:
    """Rules for the exchange of violated contactors, from fast to safe."""

    ALL = 0  # all of them: fast, but it may cycle
    #: Only the first in a fixed order: never cycles if the matrix between gaps and forces is a P-matrix (Murty, 1974,
    #: doi:10.1007/BF01580244).
    FIRST = 1
    NONE = 2  # no exchange: even the last rule has cycled


class Pivoting:
    """Choice of the exchange rule within one linearised problem.

    A rule that returns to an earlier state would cycle, so the next rule is used until the number of violations is lower than ever
    before. This ends, since the number cannot decrease without end.
    """

    def __init__(self) -> None:
        self._fewest: float = np.inf
        self._tries = PATIENCE
        self._rule = Rule.ALL
        self._seen: set[Hashable] = set()

    def choose(self, count: int, state: Hashable) -> int:
        """The rule for the next exchange of ``count`` violated contactors; ``state`` identifies the state of all contactors."""
        if count < self._fewest:
            self._fewest, self._tries, self._rule, self._seen = count, PATIENCE, Rule.ALL, set()
        elif self._rule < Rule.FIRST:
            self._tries -= 1
        if self._rule < Rule.NONE and (state in self._seen or self._tries < 0):
            self._rule, self._tries, self._seen = self._rule + 1, PATIENCE, set()
        self._seen.add(state)
        return self._rule


def touching(state: PairState, gap: Array, size: float, allowed: Bools) -> PairState:
    """The state in which contactors that touch without force are also active.

    Args:
        state: of the contactors.
        gap: that decides on contact ``(n,)``.
        size: the model's size, a length.
        allowed: contactors that may be active ``(n,)``.
    """
    return replace(state, active=state.active | ((np.abs(gap) <= TOUCHING * size) & allowed))
