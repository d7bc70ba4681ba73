"""Contact with friction of one linearisation, as a problem of arrays: relative motions w, and forces in the same slots.

A contactor has a slot along the normal and slots along the target; all other unknowns are condensed, so that ``force = S w + load``.
With the normal force lambda, the friction force tau and the total slip v, each solution of

    lambda >= 0,  gap + w_n >= 0,  one of them zero,        |tau| <= limit = rest + slope lambda,  tau = -limit v / |v| in slip,

is a zero of ``lambda - max(0, lambda - c (gap + w_n))`` and of ``tau - y min(1, limit / |y|)``, ``y = tau - c v``, for any stiffness
c > 0 (Alart and Curnier, 1991, doi:10.1016/0045-7825(91)90022-X). In a step of Newton's method on them the relative motions of closed
normal slots and of sticking tangential slots are known; it solves for all others, and its last step is full. So gaps of closed
contactors and slips of sticking ones vanish exactly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints

#: A problem is solved when no condition is violated by more than this part of the largest force.
#: [convention; terms of S w + load; test_slots.py::test_random_problems]
CONDITIONS_HOLD = 1e-12
#: Limits of friction that have changed by less than this part of the largest in a round of fixed limits are near those of Coulomb.
#: [bound; the largest limit; -]
NEAR_LIMITS = 0.1
#: Steps of Newton's method with one start.
#: [bound; solves; -]
MOST_SOLVES_OF_A_START = 60
#: A line search halves a step so often.
#: [bound; halvings; -]
LINE_HALVINGS = 7
#: Rounds of fixed limits.
#: [bound; rounds; -]
MOST_ROUNDS_OF_LIMITS = 40


@dataclass(frozen=True)
class SlotProblem:
    """``force = stiffness @ w + load``: forces in the slots by relative motions w of n contactors in k slots.

    Attributes:
        stiffness: ``(k, k)``, may be unsymmetric.
        load: forces at w = 0 ``(k,)``.
        normal: slot of the gap of each contactor ``(n,)``.
        tangents: slots along the target, -1 for prescribed directions ``(n, gdim - 1)``.
        gap: at w = 0 ``(n,)``.
        slip: of the step at w = 0, zero in prescribed directions ``(n, gdim - 1)``.
        slope: limit of friction over the normal force, zero without friction ``(n,)``.
        rest: limit of friction of an active contactor at zero normal force ``(n,)``.
    """

    stiffness: Array
    load: Array
    normal: Ints
    tangents: Ints
    gap: Array
    slip: Array
    slope: Array
    rest: Array

    @property
    def frictional(self) -> Bools:
        """Contactors with friction ``(n,)``."""
        return (self.slope > 0) | (self.rest > 0)


@dataclass(frozen=True)
class SlotState:
    """A solution.

    Attributes:
        active: closed contactors ``(n,)``.
        stick: those of them that stick ``(n,)``.
        direction: of slip, or opposite to the friction force without slip; zero for all but active slipping contactors with friction
            ``(n, gdim - 1)``.
        w: relative motions ``(k,)``.
        force: in the slots ``(k,)``.
        solves: number of dense solves.
    """

    active: Bools
    stick: Bools
    direction: Array
    w: Array
    force: Array
    solves: int


@dataclass(frozen=True)
class _Point:
    """Relative motions, their forces, and the states that the projection gives contactors.

    Attributes:
        w: ``(k,)``.
        force: ``(k,)``.
        closed: ``(n,)``.
        stick: ``(n,)``.
        along: unit vector of the force y of slipping contactors with friction ``(n, gdim - 1)``.
        part: limit over ``|y|`` ``(n,)``.
        residual: violation of the conditions, forces ``(n, gdim)``.
    """

    w: Array
    force: Array
    closed: Bools
    stick: Bools
    along: Array
    part: Array
    residual: Array

    @property
    def norm(self) -> float:
        return float(np.linalg.norm(self.residual))


class _Newton:
    """Newton's method on the projection, and what it needs of a problem."""

    def __init__(self, problem: SlotProblem):
        self.problem = problem
        self.there = problem.tangents >= 0
        diagonal = np.abs(np.diagonal(problem.stiffness))
        diagonal = np.where(diagonal > 0, diagonal, diagonal.max(initial=0.0))
        self.c_n = diagonal[problem.normal]
        count = self.there.sum(axis=1)
        self.c_t = np.where(self.there, diagonal[problem.tangents], 0.0).sum(axis=1) / np.maximum(count, 1)
        self.solves = 0

    def forces(self, w: Array) -> Array:
        return self.problem.stiffness @ w + self.problem.load

    def at(self, w: Array, force: Array, limits: Array | None = None) -> _Point:
        """States and residual of relative motions, with fixed ``limits (n,)`` or those of the law."""
        p = self.problem
        opening = p.gap + w[p.normal]
        pressed = force[p.normal] - self.c_n * opening
        closed = pressed > 0
        limit = np.where(closed, np.maximum(p.rest + p.slope * pressed, 0.0), 0.0) if limits is None else limits
        tau = np.where(self.there, force[p.tangents], 0.0)
        y = np.where(self.there, tau - self.c_t[:, None] * (p.slip + w[p.tangents]), 0.0)
        size = np.linalg.norm(y, axis=1)
        stick = (size <= limit) & (limit > 0)
        part = np.where(stick, 1.0, limit / np.where(size > limit, size, 1.0))
        along = np.where(
            (~stick & (size > 0) & self.problem.frictional)[:, None], y / np.where(size > 0, size, 1.0)[:, None], 0.0
        )
        normal = np.where(closed, self.c_n * opening, force[p.normal])
        return _Point(w, force, closed, stick, along, part, np.column_stack([normal, tau - part[:, None] * y]))

    def step(self, at: _Point, limits: Array | None = None) -> Array | None:
        """Relative motions that solve the conditions linearised at a point, or None where there are none."""
        from scipy.linalg.lapack import dgesv

        p, S = self.problem, self.problem.stiffness
        w, free = np.zeros_like(p.load), np.ones(len(p.load), dtype=bool)
        held = p.normal[at.closed]
        w[held], free[held] = -p.gap[at.closed], False
        stuck = at.stick[:, None] & self.there
        w[p.tangents[stuck]], free[p.tangents[stuck]] = -p.slip[stuck], False
        load, A = p.load + S[:, ~free] @ w[~free], S
        i = np.flatnonzero((at.closed if limits is None else limits > 0) & ~at.stick & at.along.any(axis=1))
        if len(i):
            # tau = limit along + part (y across along), with y = tau - c v
            e, slots, there = at.along[i], p.tangents[i], self.there[i]
            rows = np.where(there[:, :, None], S[slots], 0.0)
            known = np.where(there, load[slots], 0.0)
            turn = at.part[i, None, None] * (np.eye(e.shape[1]) - e[:, :, None] * e[:, None, :])
            new = rows - turn @ rows
            right = known - (turn @ (known - self.c_t[i, None] * p.slip[i])[:, :, None])[:, :, 0]
            if limits is None:
                new -= (p.slope[i, None] * e)[:, :, None] * S[p.normal[i]][:, None]
                right -= e * (p.rest[i] + p.slope[i] * load[p.normal[i]])[:, None]
            else:
                right -= e * limits[i, None]
            for b in range(e.shape[1]):
                m, a = np.nonzero(there & there[:, [b]])
                new[m, a, slots[m, b]] += turn[m, a, b] * self.c_t[i[m]]
            A, load = S.copy(), load.copy()
            A[slots[there]], load[slots[there]] = new[there], right[there]
        if free.any():
            self.solves += 1
            _, _, w[free], info = dgesv(A[np.ix_(free, free)], -load[free])
            if info or not np.isfinite(w).all():
                return None
        return w

    def rounding(self, w: Array) -> float:
        """Violations that count as none, a force."""
        p = self.problem
        return CONDITIONS_HOLD * float((np.abs(p.stiffness) @ np.abs(w) + np.abs(p.load)).max(initial=0.0))

    def run(self, w: Array, limits: Array | None = None) -> tuple[_Point, bool]:
        """The point at which the search from w has ended, and whether all conditions hold there."""
        now, full = self.at(w, self.forces(w), limits), False
        for _ in range(MOST_SOLVES_OF_A_START):
            if full and np.abs(now.residual).max(initial=0.0) <= self.rounding(now.w):
                return now, True
            end = self.step(now, limits)
            if end is None:
                break
            force, part = self.forces(end), 1.0
            new = self.at(end, force, limits)
            for _ in range(LINE_HALVINGS):
                if new.norm < now.norm:
                    break
                part /= 2
                new = self.at(now.w + part * (end - now.w), now.force + part * (force - now.force), limits)
            now, full = new, part == 1.0
        return now, False

    def fixed_limits(self, w: Array) -> Iterator[Array]:
        """Starts from which the limits of friction hardly change: solutions with fixed limits, those of the solution before."""
        limits = self.limits(self.forces(w))
        for _ in range(MOST_ROUNDS_OF_LIMITS):
            found, done = self.run(w, limits)
            if not done:
                return
            w, last, limits = found.w, limits, self.limits(found.force)
            if np.abs(limits - last).max() <= NEAR_LIMITS * limits.max():
                yield w

    def limits(self, force: Array) -> Array:
        """Limits of friction at these forces in the slots ``(n,)``."""
        p, lam = self.problem, force[self.problem.normal]
        return np.where(lam > 0, np.maximum(p.rest + p.slope * lam, 0.0), 0.0)


def solve(problem: SlotProblem) -> SlotState | None:
    """A state in which the conditions of contact and friction hold, or None if none has been found."""
    newton = _Newton(problem)
    found, done = newton.run(np.zeros_like(problem.load))
    starts = newton.fixed_limits(found.w)
    while not done and (start := next(starts, None)) is not None:
        found, done = newton.run(start)
    if not done:
        return None
    active, stick = found.closed, found.closed & found.stick
    direction = np.where(active[:, None], -found.along, 0.0)
    return SlotState(active, stick, direction, found.w, found.force, newton.solves)
