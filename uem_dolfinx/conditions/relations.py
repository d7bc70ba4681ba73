"""Linear equations of users between nodes of rigid parts alone: rows of the motions of these parts, as of joints.

A point X of a part moves by ``t + D (X - m)``, with m the middle of the part. An equation ``sum_k c_k . u(X_k) = b`` is therefore

    sum over parts of (c . t + M : D) = b,    c = sum_k c_k,    M = sum_k c_k (X_k - m)'

whatever the number of its nodes. Of equations that follow from others by the rigidity of the parts alone, each is counted once.

Scalars of the motion of two rigid bodies, with derivatives: what joints prescribe and springs store energy in.

All vectors are of space; z holds the translations and rotations of body a and of body b about their middles, ``(t_a, r_a, t_b, r_b)``,
from their present placements. Rotations turn vectors by ``exp(r) v = v + r x v + r x (r x v) / 2``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.conditions.equation import GivenRows
from uem_dolfinx.conditions.independent_rows import sizes
from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
from uem_dolfinx.conditions.rigid_set import Placement, moments
from uem_dolfinx.conditions.united_rows import RightSides
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import agree

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


class Relation:
    """One equation between motions of rigid parts, which links them as a joint does.

    Args:
        ends: couplings of the parts.
        forms: c and M of each ``(n, gdim, 1 + gdim)``.
        sides: right-hand sides of all equations.
        value: the number of its own among them.
        name: in messages.
    """

    n_rows, known = 1, 0.0  # joints have these, too: the number of rows, and their coordinate

    def __init__(self, ends: list[RigidCoupling], forms: Array, sides: RightSides, value: int, name: str):
        self.ends, self.described = ends, name
        self._c, self._M, self._sides, self._value = forms[:, :, 0], forms[:, :, 1:], sides, value
        self._size = sum(np.linalg.norm(M) + np.linalg.norm(c) * one.nodes.radius for one, c, M in zip(ends, self._c, self._M))

    @property
    def wanted(self) -> Array:
        """Present right-hand side ``(1,)`` (collective)."""
        return self._sides.values()[self._value, None]

    @property
    def ramped(self) -> list[bool]:
        """Whether it is ramped with the Dirichlet values."""
        return [bool(self._sides.ramped[self._value])]

    def columns(self) -> list[tuple[RigidCoupling, slice]]:
        """Each coupling with the components of its motion among those of all."""
        n = self._c.shape[1] + (1 if self._c.shape[1] == 2 else 3)
        return [(one, slice(i * n, (i + 1) * n)) for i, one in enumerate(self.ends)]

    def value_at(self, at: dict[int, Placement]) -> float:
        """The left-hand side in placements by id of their coupling."""
        g, value = self._c.shape[1], 0.0
        for one, c, M in zip(self.ends, self._c, self._M):
            m, place = one.nodes.middle, at[id(one)]
            t, *D = place.displacement(np.concatenate([m[None], m + np.eye(g)]))
            value += float(c @ t + np.einsum("jg,gj->", np.array(D) - t, M))
        return value

    def rows(self, at: dict[int, Placement]) -> list[Scalar]:
        """The left-hand side, with its derivatives by motions."""
        g, columns = self._c.shape[1], self.columns()
        n = columns[-1][1].stop
        slope, bend, size = np.zeros(n), np.zeros((n, n)), 0.0
        for (one, z), c, M in zip(columns, self._c, self._M):
            # sum_k c_k r_k', with present arms r_k
            N = M @ at[id(one)].motion.Q.T
            turn = slice(z.start + g, z.stop)
            slope[z] = np.append(c, moments(np.eye(g), N.T).sum(axis=0))
            bend[turn, turn] = -np.trace(N) if g == 2 else 0.5 * (N + N.T) - np.trace(N) * np.eye(3)
            size += float(np.linalg.norm(slope[z] * one.nodes.scale)) * one.nodes.radius
        # no motion of the parts changes it here
        return [Scalar(self.value_at(at), slope if size > MOSTLY_PRESCRIBED * self._size else 0.0 * slope, bend)]

    def read(self, at: dict[int, Placement], forces: Array) -> None:
        """Nothing to read at the end of a step."""


def relations_of(
    config: Configuration, rows: GivenRows, item: Ints, sides: RightSides, couplings: Sequence[RigidCoupling], left: Bools
) -> tuple[Bools, list[Relation]]:
    """Equations that can eliminate nothing but components of rigid parts (collective).

    Args:
        config: configuration of the displacement.
        rows: of this rank, with values numbered as in ``sides``.
        item: number of the declaration of each ``(m,)``.
        sides: right-hand sides.
        couplings: that make nodes rigid.
        left: components that linear equations may eliminate ``(n_owned, gdim)``.

    Returns:
        The mask of these rows ``(m,)``, and the relations that they are, the same on all ranks.

    Raises:
        InputError: for components of other nodes in them, which are prescribed; and for large and small rotations in one equation.
    """
    g, n = config.gdim, len(couplings)
    known = np.zeros((config.n_owned, 1 + g))
    for i, one in enumerate(couplings):
        known[one.nodes.nodes] = np.column_stack([np.full(len(one.nodes.nodes), 1.0 + i), one.nodes.X - one.nodes.middle])
    there, able, largest = config.ask_owners(rows.node, known), np.zeros(len(rows), dtype=bool), np.zeros(len(rows))
    able[rows.row[(sizes(config, rows, left) > 0.0).any(axis=1)]] = True
    part, c = there[:, 0].astype(np.int64) - 1, rows.coefficients
    size = np.abs(c).max(axis=1, initial=0.0)
    np.maximum.at(largest, rows.row, size)
    counts = size > MOSTLY_PRESCRIBED * largest[rows.row]
    among = np.zeros(len(rows), dtype=bool)
    among[rows.row[counts & (part >= 0)]] = True
    among &= ~able
    held = counts & (part < 0) & among[rows.row]
    agree(config.comm, _mixed(int(item[rows.row[held]][0])) if held.any() else None)
    # forms (m, n, gdim, 1 + gdim) of the rows
    mine = among[rows.row] & (part >= 0)
    forms, place = np.zeros((int(among.sum()), n, g, 1 + g)), np.cumsum(among) - 1
    terms = np.concatenate([np.ones((len(c), 1)), there[:, 1:]], axis=1)
    np.add.at(forms, (place[rows.row[mine]], part[mine]), c[mine, :, None] * terms[mine, None])
    value = rows.value[among]
    lengths = np.append(1.0, np.full(g, config.size))
    kept = _independent(forms / lengths, value)
    gathered = config.comm.allgather((forms[kept], value[kept], item[among][kept]))
    forms, value, item = (np.concatenate(arrays) for arrays in zip(*gathered))
    found = []
    for i in _independent(forms / lengths, value):
        ends = [int(end) for end in np.flatnonzero(forms[i].reshape(n, -1).any(axis=1))]
        if len({couplings[e].nodes.large for e in ends}) > 1:
            raise InputError(
                f"equations[{item[i]}] has rigid parts of large and of small rotations: expected the same rotations= of all"
            )
        found.append(Relation([couplings[e] for e in ends], forms[i, ends], sides, int(value[i]), f"equations[{item[i]}]"))
    return among, found


def _mixed(item: int) -> InputError:
    return InputError(
        f"equations[{item}] has no components but those of rigid parts and prescribed ones of other nodes: expected rigid parts "
        "alone, with the prescribed values in b"
    )


def _independent(forms: Array, value: Ints) -> Ints:
    """The first of rows ``(m, ...)`` from which the others follow with the same values, ascending."""
    from scipy.linalg import qr

    if not len(forms):
        return np.zeros(0, dtype=np.int64)
    different, which = np.unique(value, return_inverse=True)
    A = np.concatenate([forms.reshape(len(forms), -1), np.eye(len(different))[which]], axis=1)
    _, R, order = qr((A / np.linalg.norm(A, axis=1, keepdims=True)).T, mode="economic", pivoting=True)
    return np.sort(order[: len(R)][np.abs(np.diag(R)) > MOSTLY_PRESCRIBED])
