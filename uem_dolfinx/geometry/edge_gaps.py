"""Closest points of two lines through nodes, the gap between them along their common normal, and its derivatives. Pure geometry.

A line runs through the nodes of an edge as a cubic in every piece between two neighbours, whose slope at a node is that of the parabola
through this node and its neighbours. So it has no kinks where forces bend the edge. Its points are sums of four nodes, ``x(s) =
sum_a N_a(s) x_a``. At the closest points ``x(s)`` and ``y(t)`` both tangents are perpendicular to ``x - y = g n``, and the gap changes
by ``n . (dx - dy)`` with s and t fixed.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints, cross_products

#: Newton's iterations for the closest points of two lines. [bound; iterations; -]
LINE_ITERATIONS = 12
#: They end with steps below this one. [bound; reference coordinates; -]
LINE_ROUNDING = 1e-15
#: Steps of these iterations are shorter. [bound; reference coordinates; -]
LONGEST_STEP = 1.0


def cubics(before: Array, length: Array, after: Array) -> Array:
    """Coefficients of ``1, s, s^2, s^3`` in the weights of four nodes ``(k, 4, 4)``, with ``s = 0`` and ``1`` at the middle ones.

    The three lengths ``(k,)`` are those between them; the first or the last is infinite if the line ends at a middle node.
    """
    k = len(length)
    # slopes over the length of the piece at its ends
    slopes = np.zeros((k, 2, 4))
    for end, (spacing, sign) in enumerate(((before, 1.0), (after, -1.0))):
        here, there, out = (1, 2, 0) if end == 0 else (2, 1, 3)
        last = ~np.isfinite(spacing)
        h = np.where(last, 1.0, spacing)
        own = np.where(last, 1.0, h / (h + length))
        other = np.where(last, 0.0, length**2 / (h * (h + length)))
        slopes[:, end, there] = sign * own
        slopes[:, end, here] = sign * (other - own)
        slopes[:, end, out] = -sign * other
    ends = np.zeros((k, 2, 4))
    ends[:, 0, 1] = ends[:, 1, 2] = 1.0
    (p, q), (a, b) = ends.transpose(1, 0, 2), slopes.transpose(1, 0, 2)
    return np.stack([p, a, -3.0 * p - 2.0 * a + 3.0 * q - b, 2.0 * p + a - 2.0 * q + b], axis=1)


def weights_at(cubic: Array, s: Array) -> tuple[Array, Array, Array]:
    """Weights of the nodes at ``s (k,)``, and their first and second derivatives ``(k, 4)``, from ``cubics (k, 4, 4)``."""
    one, none = np.ones_like(s), np.zeros_like(s)
    powers = [[one, s, s**2, s**3], [none, one, 2.0 * s, 3.0 * s**2], [none, none, 2.0 * one, 6.0 * s]]
    N, dN, ddN = (np.einsum("pk,kpa->ka", np.array(p), cubic) for p in powers)
    return N, dN, ddN


def _points(cubic: Array, s: Array, x: Array) -> tuple[Array, Array, Array]:
    """Points of lines through ``x (k, 4, 3)`` at ``s (k,)``, first and second derivatives ``(k, 3)``."""
    place, along, bend = (np.einsum("ka,kag->kg", w, x) for w in weights_at(cubic, s))
    return place, along, bend


def _dot(a: Array, b: Array) -> Array:
    return np.asarray(np.einsum("kg,kg->k", a, b))


def closest_points(cubics: tuple[Array, Array], x: Array, y: Array) -> tuple[Array, Array]:
    """Coordinates ``(k,)`` of the closest points of lines through ``x`` and ``y (k, 4, 3)``, which may lie past their pieces' ends.

    The lines must not be parallel. Newton's method starts with the chords.
    """
    p, q = x[:, 1], y[:, 1]
    a, b = x[:, 2] - p, y[:, 2] - q
    s, t = _step(p - q, a, b, 0.0 * a, 0.0 * b)
    todo = np.arange(len(s))
    for _ in range(LINE_ITERATIONS):
        now = [np.clip(xi[todo], -LONGEST_STEP, 1.0 + LONGEST_STEP) for xi in (s, t)]
        (p, a, da), (q, b, db) = (_points(of[todo], xi, z[todo]) for of, xi, z in zip(cubics, now, (x, y)))
        more = np.clip(_step(p - q, a, b, da, db), -LONGEST_STEP, LONGEST_STEP)
        s[todo], t[todo] = now + more
        todo = todo[np.abs(more).max(axis=0, initial=0.0) > LINE_ROUNDING]
        if not len(todo):
            break
    return s, t


def may_cross(x: Array, y: Array, sine: float) -> Bools:
    """Whether lines through ``x`` and ``y (k, 4, 3)``, which bend little, may cross with this sine of their angle at least ``(k,)``."""
    p, q = x[:, 1], y[:, 1]
    a, b = x[:, 2] - p, y[:, 2] - q
    across = _dot(a, a) * _dot(b, b)
    steep = np.flatnonzero(across - _dot(a, b) ** 2 > (0.5 * sine) ** 2 * across)
    p, q, a, b = (part[steep] for part in (p, q, a, b))
    found = np.zeros(len(x), bool)
    found[steep] = (np.abs(np.stack(_step(p - q, a, b, 0.0 * a, 0.0 * b)) - 0.5) <= 0.5 + LONGEST_STEP).all(axis=0)
    return found


def _step(away: Array, a: Array, b: Array, da: Array, db: Array) -> tuple[Array, Array]:
    """Newton's step to the closest points of two lines ``away`` from each other, with these derivatives ``(k, 3)``: ``(k,)`` each."""
    aa, bb, ab = _dot(a, a) + _dot(away, da), _dot(b, b) - _dot(away, db), _dot(a, b)
    ra, rb, over = -_dot(a, away), _dot(b, away), aa * bb - ab**2
    over = np.where(over != 0.0, over, 1.0)
    return (ra * bb + rb * ab) / over, (ra * ab + rb * aa) / over


@dataclass(frozen=True)
class EdgeGaps:
    """Gaps between pairs of lines at given points."""

    cubics: tuple[Array, Array]  # of both lines, see ``cubics`` ``(k, 4, 4)``
    s: Array  # coordinates on the first lines ``(k,)``
    t: Array  # coordinates on the second lines
    x: Array  # nodes of the first lines ``(k, 4, 3)``
    y: Array  # nodes of the second lines
    normal: Array  # unit vectors from the second lines to the first ``(k, 3)``, perpendicular to both

    @classmethod
    def between(cls, cubics: tuple[Array, Array], x: Array, y: Array, outward: Array) -> EdgeGaps:
        """Gaps between the closest points of lines through ``x`` and ``y (k, 4, 3)``; normals lean towards ``outward (k, 3)``."""
        s, t = closest_points(cubics, x, y)
        across = cross_products(_points(cubics[0], s, x)[1], _points(cubics[1], t, y)[1])
        length = np.linalg.norm(across, axis=1, keepdims=True)
        n = across / np.where(length > 0.0, length, 1.0)
        return cls(cubics, s, t, x, y, n * np.where(_dot(n, outward) < 0.0, -1.0, 1.0)[:, None])

    def take(self, which: Ints) -> EdgeGaps:
        """Some of the pairs ``(m,)``."""
        rest = (part[which] for part in (self.s, self.t, self.x, self.y, self.normal))
        return EdgeGaps((self.cubics[0][which], self.cubics[1][which]), *rest)

    @cached_property
    def weights(self) -> tuple[Array, Array]:
        """Weights of the nodes at both points ``(k, 4)``."""
        return weights_at(self.cubics[0], self.s)[0], weights_at(self.cubics[1], self.t)[0]

    @cached_property
    def _first(self) -> tuple[Array, Array, Array]:
        return _points(self.cubics[0], self.s, self.x)

    @cached_property
    def _second(self) -> tuple[Array, Array, Array]:
        return _points(self.cubics[1], self.t, self.y)

    @property
    def points(self) -> Array:
        """Points of the first lines ``(k, 3)``."""
        return self._first[0]

    @property
    def feet(self) -> Array:
        """Points of the second lines ``(k, 3)``."""
        return self._second[0]

    @property
    def gap(self) -> Array:
        """Distances along the normal ``(k,)``, negative inside."""
        return _dot(self.normal, self.points - self.feet)

    @property
    def sine(self) -> Array:
        """Sines of the angles between the lines ``(k,)``."""
        a, b = self._first[1], self._second[1]
        length = np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1)
        return np.asarray(np.linalg.norm(cross_products(a, b), axis=1) / np.where(length > 0.0, length, 1.0))

    @cached_property
    def _slopes(self) -> tuple[Array, Array, Array, Array]:
        """Derivatives by the nodes of both lines, the first's first: ``m = 24`` columns.

        Returns both coordinates ``(k, 2, m)``; the normal's products with the lines' slopes at fixed coordinates, of the second
        line negative ``(k, 2, m)``; curvatures of both lines along the normal ``(k, 2)``; the normal ``(k, 3, m)``.
        """
        n, g, k = self.normal, self.gap, len(self.s)
        (_, a, da), (_, b, db) = self._first, self._second
        bend = np.stack([_dot(n, da), _dot(n, db)], axis=1)
        by_nodes, of_slopes = np.zeros((k, 3, 2, 4, 3)), np.zeros((k, 2, 2, 4, 3))
        for side, (xi, sign) in enumerate(((self.s, 1.0), (self.t, -1.0))):
            N, dN, _ = weights_at(self.cubics[side], xi)
            for c in range(3):
                by_nodes[:, c, side, :, c] = sign * N
            of_slopes[:, side, side] = sign * dN[..., None] * n[:, None]
        moved, slope = by_nodes.reshape(k, 3, 24), of_slopes.reshape(k, 2, 24)
        aa, bb, ab = _dot(a, a), _dot(b, b), _dot(a, b)
        # a . (dx - dy + a ds - b dt) = -g (slope + bend ds), and likewise with b and the slope of the second line
        A, metric = np.empty((2, k, 2, 2))
        A[:, 0, 0], A[:, 0, 1], A[:, 1, 0], A[:, 1, 1] = aa + g * bend[:, 0], -ab, ab, g * bend[:, 1] - bb
        metric[:, 0, 0], metric[:, 0, 1], metric[:, 1, 0], metric[:, 1, 1] = aa, ab, ab, bb
        along = -np.einsum("fkg,kgm->kfm", np.stack([a, b]), moved)
        D = np.linalg.solve(A, along - g[:, None, None] * slope * np.array([1.0, -1.0])[:, None])
        # the normal turns by its products with both tangents, in the dual basis
        turns = np.stack([-(slope[:, 0] + bend[:, 0, None] * D[:, 0]), slope[:, 1] - bend[:, 1, None] * D[:, 1]], axis=1)
        dn = np.einsum("fkg,kfm->kgm", np.stack([a, b]), np.linalg.solve(metric, turns))
        return D, slope, bend, dn

    def hessians(self) -> Array:
        """Second derivatives of the gaps by the nodes of both lines ``(k, 24, 24)``."""
        D, slope, bend, dn = self._slopes
        H = np.einsum("kfi,kfj->kij", slope, D)
        H = H + H.transpose(0, 2, 1)
        H += np.einsum("kf,kfi,kfj->kij", bend * np.array([1.0, -1.0]), D, D)
        return H + self.gap[:, None, None] * np.einsum("kgi,kgj->kij", dn, dn)

    def turnings(self, tau: Array) -> Array:
        """Derivatives of nodal forces of tangential forces ``tau (k, 3)``, which turn with the normal ``(k, 24, 24)``."""
        D, _, _, dn = self._slopes
        turned = -np.einsum("kg,kh,khm->kgm", self.normal, tau, dn)
        blocks = np.zeros((len(tau), 2, 4, 3, 24))
        for side, (xi, sign) in enumerate(((self.s, 1.0), (self.t, -1.0))):
            N, dN, _ = weights_at(self.cubics[side], xi)
            blocks[:, side] = sign * (np.einsum("ka,kg,km->kagm", dN, tau, D[:, side]) + np.einsum("ka,kgm->kagm", N, turned))
        return blocks.reshape(len(tau), 24, 24)
