"""Contact with friction of one linearisation, as a problem of arrays: relative motions w, and the forces in their slots.

A contactor has a slot along the normal and slots along the target; all other unknowns are condensed. The normal force lambda, the
friction force tau and the total slip v that satisfy

    lambda >= 0,  gap + w_n >= 0,  one of them zero,        |tau| <= limit = rest + slope lambda,  tau = -limit v / |v| in slip,

are the zeros of ``lambda - max(0, lambda - c (gap + w_n))`` and of ``tau - y min(1, limit / |y|)``, ``y = tau - c v``, for any c > 0
(Alart and Curnier, 1991, doi:10.1016/0045-7825(91)90022-X). A step of Newton's method prescribes w in the normal slots of closed
contactors and the tangential slots of sticking ones: after a full step, the last one, their gaps and slips vanish exactly.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from uem_dolfinx.algebra.blocks import SYMMETRIC
from uem_dolfinx.arrays import Array, Bools, Ints

#: Conditions hold if no force violates them by more than this part of the terms of ``stiffness @ w + load``.
#: [convention; the largest sum of terms; test_slots.py::test_solved_to_rounding]
HOLDS = 3e-14
#: Forces are not known if rounding, by ``HOLDS``, is a larger part of them: a body that nothing holds moves without end.
#: [convention; the largest force; test_slots.py::test_a_body_that_nothing_holds]
KNOWN = 1e-6
#: The stiffness c along the target: bodies that slide as a whole are softer than the diagonal of the stiffness.
#: [convention; the diagonal of the stiffness; test_slots.py::test_solves_of_random_problems]
SOFTER = 0.1
#: Dense solves in all, steps of Newton's method from one start, line searches among them that find no smaller residual, halvings of each.
#: [bound; counts; -]
MOST_SLOT_SOLVES, STEPS_OF_A_START, FAILED_SEARCHES, HALVINGS_OF_A_STEP = 300, 60, 4, 7


@dataclass(frozen=True)
class SlotProblem:
    """``force = stiffness @ w + load`` in k slots of n contactors, and the laws of contact and friction."""

    stiffness: Array  # ``(k, k)``, may be unsymmetric
    load: Array  # forces at w = 0 ``(k,)``
    normal: Ints  # slot of the gap of each contactor ``(n,)``
    tangents: Ints  # slots along the target, -1 for prescribed directions ``(n, gdim - 1)``
    gap: Array  # at w = 0 ``(n,)``
    slip: Array  # of the step at w = 0, zero in prescribed directions ``(n, gdim - 1)``
    slope: Array  # limit of friction over the normal force ``(n,)``
    rest: Array  # limit of friction of an active contactor at zero normal force ``(n,)``


@dataclass(frozen=True)
class SlotState:
    """A solution of a ``SlotProblem``."""

    active: Bools  # closed contactors ``(n,)``
    stick: Bools  # active contactors with friction that stick ``(n,)``
    #: of slip, without slip opposite to the friction force, of the other active contactors with friction ``(n, gdim - 1)``.
    direction: Array
    w: Array  # relative motions ``(k,)``
    force: Array  # in the slots ``(k,)``
    solves: int  # number of dense solves
    negative: bool  # whether the matrix of the slots that are not held has a negative determinant
    indefinite: bool  # whether it is symmetric, and has negative eigenvalues


@dataclass(frozen=True)
class _Point:
    """Relative motions, forces, states of the projection: ``along`` is ``y / |y|``, ``part`` is ``min(1, limit / |y|)``.

    ``negative`` is the sign of the determinant in the step that has led to it.
    """

    w: Array
    force: Array
    closed: Bools
    stick: Bools
    along: Array
    part: Array
    residual: Array
    negative: bool = False


class _Newton:
    """Newton's method on the projection, for one problem."""

    def __init__(self, problem: SlotProblem):
        self.problem, self.solves = problem, 0
        self.there = problem.tangents >= 0
        self.frictional = (problem.slope > 0) | (problem.rest > 0)
        self.size = np.abs(problem.stiffness)
        self.diagonal = np.diagonal(self.size)
        own = np.where(self.there, self.diagonal[problem.tangents], 0.0).sum(axis=1)
        self.c_n, self.c = self.diagonal[problem.normal], SOFTER * own / np.maximum(self.there.sum(axis=1), 1)

    def at(self, w: Array, force: Array | None = None) -> _Point:
        """States and residual of relative motions."""
        p = self.problem
        force = p.stiffness @ w + p.load if force is None else force
        opening, tau = p.gap + w[p.normal], np.where(self.there, force[p.tangents], 0.0)
        pressed = force[p.normal] - self.c_n * opening
        closed = pressed > 0
        limit = np.where(closed & self.frictional, np.maximum(p.rest + p.slope * pressed, 0.0), 0.0)
        y = np.where(self.there, tau - self.c[:, None] * (p.slip + w[p.tangents]), 0.0)
        size = np.linalg.norm(y, axis=1)
        stick = (size <= limit) & (limit > 0)
        part = np.where(stick, 1.0, limit / np.where(size > 0, size, 1.0))
        residual = np.column_stack([np.where(closed, self.c_n * opening, force[p.normal]), tau - part[:, None] * y])
        return _Point(w, force, closed, stick, y / np.where(size > 0, size, 1.0)[:, None], part, residual)

    def step(self, now: _Point) -> _Point | None:
        """Solution of the conditions linearised at a point, or None if there is none."""
        from scipy.linalg.lapack import dgesv

        p, S, (w, free), negative = self.problem, self.problem.stiffness, self.held(now), False
        i, needed = np.flatnonzero(now.closed & self.frictional & ~now.stick), free.copy()
        needed[p.normal[i]] = True
        # forces by free slots, and in the last column by held ones
        rows, place = np.zeros((len(S), free.sum() + 1)), np.cumsum(free) - 1
        rows[needed, :-1], rows[:, -1] = S[np.ix_(needed, free)], p.load + S @ w
        if len(i):
            # tau - part (y across along) - limit along, with y = tau - c v
            e, slots, there, c = now.along[i], p.tangents[i], self.there[i], self.c[i]
            turn = now.part[i, None, None] * (np.eye(e.shape[1]) - e[:, :, None] * e[:, None, :])
            tau = np.where(there[:, :, None], rows[slots], 0.0)
            tau = tau - turn @ tau - (p.slope[i, None] * e)[:, :, None] * rows[p.normal[i], None]
            m, a, b = np.nonzero(there[:, :, None] & there[:, None])
            tau[m, a, place[slots[m, b]]] += turn[m, a, b] * c[m]
            tau[:, :, -1] += c[:, None] * (turn @ p.slip[i][:, :, None])[:, :, 0] - e * p.rest[i, None]
            rows[slots[there]] = tau[there]
        if free.any():
            self.solves += 1
            factors, pivots, w[free], info = dgesv(rows[free, :-1], -rows[free, -1])
            if info or not np.isfinite(w).all():
                return None
            swaps = np.count_nonzero(pivots != np.arange(len(pivots)))
            negative = bool((swaps + np.count_nonzero(np.diag(factors) < 0.0)) % 2)
        return replace(self.at(w), negative=negative)

    def held(self, now: _Point) -> tuple[Array, Bools]:
        """Motions of held slots, zero in others, and the mask of these others ``(k,)``."""
        p, stuck = self.problem, now.stick[:, None] & self.there
        w, free = np.zeros_like(p.load), np.ones(len(p.load), dtype=bool)
        for held, to in ((p.normal[now.closed], p.gap[now.closed]), (p.tangents[stuck], p.slip[stuck])):
            w[held], free[held] = -to, False
        return w, free

    def indefinite(self, now: _Point) -> bool:
        """Whether the stiffness of the slots that are not held is symmetric and has negative eigenvalues."""
        from scipy.linalg.lapack import dpotrf

        free = self.held(now)[1]
        S = self.problem.stiffness[np.ix_(free, free)]
        root = np.sqrt(np.abs(np.diag(S)))
        return bool(len(S) and (np.abs(S - S.T) <= SYMMETRIC * root[:, None] * root).all() and dpotrf(S)[1])

    def rounding(self, now: _Point) -> float:
        """Violations that count as zero, a force; negative if forces are not known."""
        size = np.abs(self.problem.load)
        rounding = HOLDS * float((self.size @ np.abs(now.w) + size).max(initial=0.0))
        return rounding if rounding <= KNOWN * np.maximum(size, np.abs(now.force)).max(initial=0.0) else -1.0

    def run(self, w: Array) -> _Point | None:
        """A solution from a start, in the state of the last step, or None."""
        now, failed = self.at(w), 0
        for _ in range(STEPS_OF_A_START):
            if failed > FAILED_SEARCHES or (end := self.step(now)) is None:
                return None
            if np.abs(end.residual).max(initial=0.0) <= self.rounding(end):
                return replace(end, closed=now.closed, stick=now.stick)
            norm, new, part = np.linalg.norm(now.residual), end, 1.0
            while (grows := np.linalg.norm(new.residual) >= norm) and part > 0.5**HALVINGS_OF_A_STEP:
                part /= 2
                new = self.at(now.w + part * (end.w - now.w), now.force + part * (end.force - now.force))
            now, failed = new, failed + int(grows)
        return None

    def pivot(self) -> _Point | None:
        """Without friction: all wrong contactors change sides; once a state recurs only the first, until fewer are wrong than ever.

        If the stiffness is positive definite this ends with the solution (Murty, 1974, doi:10.1007/BF01580244).
        """
        start, alone, seen = self.at(np.zeros_like(self.problem.load)), False, set[bytes]()
        closed, fewest = start.closed, len(start.closed) + 1
        while (now := self.step(replace(start, closed=closed))) is not None:
            wrong = (now.closed != closed) & (np.abs(now.residual[:, 0]) > self.rounding(now))
            if not wrong.any():
                return replace(now, closed=closed) if self.rounding(now) >= 0 else None
            if wrong.sum() < fewest:
                fewest, alone, seen = int(wrong.sum()), False, set()
            again = closed.tobytes() in seen
            if again and alone:
                return None
            alone, seen = alone or again, {closed.tobytes()} | (set() if again else seen)
            closed = closed ^ (wrong & (np.cumsum(wrong) == 1) if alone else wrong)
        return None

    def starts(self, w: Array) -> Iterator[Array]:
        """Motions w, then motions with dampers in all slots: implicit steps in time, longer as long as they succeed."""
        p, damping = self.problem, 1.0
        yield w
        while damping > KNOWN and self.solves < MOST_SLOT_SOLVES:
            d = damping * self.diagonal
            damped = _Newton(replace(p, stiffness=p.stiffness + np.diag(d), load=p.load - d * w))
            found = damped.run(w)
            self.solves += damped.solves
            damping *= 4.0 if found is None else 0.25
            if found is not None:
                yield (w := found.w)


def solve(problem: SlotProblem, near: Array | None = None) -> SlotState | None:
    """A state in which the conditions of contact and friction hold, or None if none is found; ``near (k,)`` are motions to start from."""
    newton, near = _Newton(problem), np.zeros_like(problem.load) if near is None else near
    found = None if newton.frictional.any() else newton.pivot()
    if (found := found or next(filter(None, map(newton.run, newton.starts(near))), None)) is None:
        return None
    slips = found.closed & ~found.stick & newton.frictional
    direction = np.where(slips[:, None], -found.along, 0.0)
    indefinite = not slips.any() and newton.indefinite(found)
    return SlotState(found.closed, found.stick, direction, found.w, found.force, newton.solves, found.negative, indefinite)
