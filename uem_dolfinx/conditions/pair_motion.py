"""Scalars of the motion of two rigid bodies, with derivatives: what joints prescribe and springs store energy in.

All vectors are of space; z holds the translations and rotations of body a and of body b about their middles, ``(t_a, r_a, t_b, r_b)``,
from their present placements. Rotations turn vectors by ``exp(r) v = v + r x v + r x (r x v) / 2``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.conditions.rigid_set import Placement

#: Translations and rotations of a and b in z.
TA, RA, TB, RB = (slice(i, i + 3) for i in (0, 3, 6, 9))


@dataclass(frozen=True)
class Scalar:
    """A scalar, its gradient ``(12,)`` and its second derivatives ``(12, 12)`` by z."""

    value: float
    slope: Array
    bend: Array


@dataclass(frozen=True)
class Body:
    """Present placement of a body, or of the ground: rotation ``Q (3, 3)`` and position of its middle ``(3,)``, first ``about``."""

    Q: Array
    middle: Array
    about: Array

    @staticmethod
    def of(at: Placement | None) -> Body:
        """The body of a placement in any dimension; None is the ground."""
        Q, middle, about = np.eye(3), np.zeros(3), np.zeros(3)
        if at is not None:
            g = len(at.motion.about)
            Q[:g, :g], about[:g] = at.motion.Q, at.motion.about
            middle[:g] = at.motion.about + at.motion.translation
        return Body(Q, middle, about)

    def arm(self, point: Array) -> Array:
        """Present arm from the middle to a point of the body with a reference position ``(3,)``."""
        return np.asarray(self.Q @ (point - self.about))


def skew(v: Array) -> Array:
    """The matrix of ``v x``."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def turning(v: Array, w: Array) -> Array:
    """Second derivatives of ``v . exp(r) w`` by r ``(3, 3)``."""
    return np.asarray(0.5 * (np.outer(v, w) + np.outer(w, v)) - (v @ w) * np.eye(3))


def projected(a: Body, b: Body, along: Array, of_b: Array, point: Array | None) -> Scalar:
    """``v . w`` with v a direction of a, ``along`` in the reference configuration, and w either of two vectors.

    Args:
        a: body of v.
        b: body of w.
        along: v in the reference configuration.
        of_b: w in the reference configuration, a direction of b; not used with a point.
        point: reference position of a point of both; w is then the vector from the point of a to the point of b.
    """
    v, s, off = a.Q @ along, 0.0, 0.0
    w = arm = b.Q @ of_b
    if point is not None:
        s, arm = 1.0, b.arm(point)
        w, off = b.middle + arm - a.middle, float(v @ a.arm(point))
    slope, bend = np.zeros(12), np.zeros((12, 12))
    slope[TA], slope[RA], slope[TB], slope[RB] = -s * v, np.cross(v, w), s * v, np.cross(arm, v)
    bend[RA, RA], bend[RB, RB] = turning(v, w), turning(v, arm)
    bend[RA, RB] = (v @ arm) * np.eye(3) - np.outer(arm, v)
    bend[RA, TA], bend[RA, TB] = -s * skew(v), s * skew(v)
    for i, j in ((RA, RB), (RA, TA), (RA, TB)):
        bend[j, i] = bend[i, j].T
    return Scalar(float(v @ w) - off, slope, bend)


def angle(a: Body, b: Body, x: Array, y: Array) -> Scalar:
    """Angle from the direction x of a to the direction x of b, positive towards y, both ``(3,)`` in the reference configuration."""
    c, s = projected(a, b, x, x, None), projected(a, b, y, x, None)
    rho = c.value**2 + s.value**2
    by_c, by_s = -s.value / rho, c.value / rho
    double, cross = 2.0 * c.value * s.value / rho**2, (s.value**2 - c.value**2) / rho**2
    bend = by_c * c.bend + by_s * s.bend + double * (np.outer(c.slope, c.slope) - np.outer(s.slope, s.slope))
    bend += cross * (np.outer(c.slope, s.slope) + np.outer(s.slope, c.slope))
    return Scalar(float(np.arctan2(s.value, c.value)), by_c * c.slope + by_s * s.slope, bend)


def distance(a: Body, b: Body, of_a: Array, of_b: Array) -> tuple[Array, Array, Array, Array]:
    """Vector from a point of a to a point of b, with reference positions ``(3,)``, its slopes ``(3, 12)``, and both arms."""
    from_a, from_b = a.arm(of_a), b.arm(of_b)
    slopes = np.concatenate([-np.eye(3), skew(from_a), np.eye(3), -skew(from_b)], axis=1)
    return b.middle + from_b - a.middle - from_a, slopes, from_a, from_b
