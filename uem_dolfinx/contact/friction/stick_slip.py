"""Friction by elimination: stick, slip and slip directions of contactors. Pure functions of arrays, without mesh or communication.

A sticking contactor follows its anchor, a point of the target, in all components of trial and test rows. A contactor that slips in
the direction s moves as without friction. If its limit is ``b + mu lambda``, b is a known force along -s, and the rest is along ``n
- mu s``: its test row is rotated,

    trial  n . (du_i - sum_a N_a du_a) = -g,        test  (n - mu s) . (dv_i - sum_a N_a dv_a) = 0,

so that the contact force ``lambda (n - mu s)`` does no work on the virtual motions Q. In 3D the direction follows the motion. With
the tangential force tau and the slip w since the last step, ``q = c w - tau`` has the direction ``s = q / |q|`` wherever
``tau = -mu lambda s`` and w is along s, whatever the stiffness c is (semismooth Newton: Alart and Curnier, 1991,
doi:10.1016/0045-7825(91)90022-X; Hüeber, Stadler and Wohlmuth, 2008, doi:10.1137/060671061).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints, cross_products, replace
from uem_dolfinx.contact.seam.active_set import Violations
from uem_dolfinx.contact.seam.state import FrictionState
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.seam.placement import Kinematics
    from uem_dolfinx.contact.seam.relative_motion import Ties
    from uem_dolfinx.geometry.configuration import Configuration
    from uem_dolfinx.geometry.rigid import Motion


@dataclass(frozen=True)
class Pivot:
    """Record of the exchanges of one linearised problem, and data of slip directions, ``(n,)`` unless stated."""

    released: Bools  # contactors that have been released
    turned: Bools  # contactors whose slip has been reversed
    begun: Bools  # contactors that have begun to slip
    stiffness: Array  # stiffness c
    q: Array  # forces that define the slip directions ``(n, gdim)``
    tau: Array  # force part of ``q`` ``(n, gdim)``

    @classmethod
    def begin(cls, stiffness: Array, q: Array, tau: Array) -> Pivot:
        """The record before the first exchange."""
        none = np.zeros(len(stiffness), dtype=bool)
        return cls(none, none, none, stiffness, q, tau)


@dataclass(frozen=True)
class LastStep:
    """Data of the last step's end, for contactors that follow other nodes in a mean."""

    kinematics: Kinematics  # of the contactors, with the weights of followed nodes
    x: Array  # positions of the owned nodes ``(n_owned, gdim)``
    motion: Motion | None  # of a rigid target; None if it had not moved

    @property
    def ties(self) -> Ties:
        """Weights of followed nodes."""
        return self.kinematics.ties

    def renewed(self, config: Configuration, discretisation: Any) -> bool:
        """Whether nothing has moved since, so that small sliding may have renewed its rows (collective)."""
        if discretisation.traits.sliding != "small":
            return False
        still = self.motion is discretisation.target.motion and np.array_equal(self.x, config.x[: config.n_owned])
        return bool(reduced(config.comm, still, op=MPI.LAND))


#: A tangential direction of which prescribed components leave less than this part is prescribed.
#: [convention; a unit vector; test_friction_states.py::test_tangents_in_free_components]
PRESCRIBED = 1e-6
#: Slip with a smaller part along free components is along prescribed ones.
#: [convention; a unit vector; test_prescribed_to_and_fro.py::test_slip_along_conditions_continues]
ALONG_CONDITIONS = 0.5
#: The stiffness c of a contactor that slips in space, as part of that of both bodies: from 1 on directions of slip go in circles.
#: [heuristic; the diagonal of K; test_friction_moving_targets.py::test_a_slender_block_on_a_turntable]
SLIP_STIFFNESS = 0.2
#: A contactor on the edge of its cone, where the direction could not turn at all, turns as one with this part of the force.
#: [heuristic; the force q; test_friction_moving_targets.py::test_a_slender_block_on_a_turntable]
LEAST_TURN = 0.999


@dataclass(frozen=True)
class Seen:
    """Forces and slips that decide on stick and slip, current or predicted."""

    lam: Array  # normal force ``(n,)``
    tau: Array  # tangential force ``(n, gdim)``
    bound: Array  # limit of the tangential force ``(n,)``
    slip: Array  # relative motion along the target since the last step ``(n, gdim)``
    forced: Array  # prescribed part of the slip, a length ``(n,)``


@dataclass(frozen=True)
class FrictionViolations(Violations):
    """Contactors that violate the conditions of contact or of friction, each ``(n,)``."""

    slide: Bools  # sticking contactors whose force exceeds the limit
    hold: Bools  # slipping contactors that move against their slip direction
    driven: Bools  # contactors with prescribed slip
    seen: Seen  # forces and slips for this decision

    @property
    def count(self) -> int:
        """Number of violated contactors."""
        return super().count + int(self.slide.sum() + self.hold.sum())

    @property
    def which(self) -> Bools:
        """All violated contactors ``(n,)``."""
        return super().which | self.slide | self.hold

    def among(self, kept: Bools) -> FrictionViolations:
        """The violations of ``kept (n,)`` contactors."""
        own = super().among(kept)
        return replace(self, **vars(own), slide=self.slide & kept, hold=self.hold & kept)

    def of_contact(self) -> FrictionViolations:
        """The violations of the contact conditions: contactors that enter or are released."""
        return self.among(self.enter | self.release)

    def on_first_touch(self, gap: Array, depth: float) -> FrictionViolations:
        """See ``Violations``; violations of friction are kept."""
        return replace(self, **vars(super().on_first_touch(gap, depth)))


def tangents(normals: Array, free: Bools) -> Array:
    """Orthonormal directions perpendicular to all normals ``(n, k, gdim)`` in the components ``free (n, gdim)``, padded with zeros.

    Returns ``(n, gdim - 1, gdim)``.
    """
    first, g = normals[:, 0], normals.shape[2]
    if g == 2:
        found = np.stack([-first[:, 1], first[:, 0]], axis=1)[:, None]
    else:
        # the first is perpendicular to the axis with the largest angle to the normal
        across = cross_products(first, np.eye(3)[np.abs(first).round(1).argmin(axis=1)])
        found = np.stack([across, cross_products(first, across)], axis=1)
    size = np.linalg.norm(found, axis=2, keepdims=True)
    found /= np.where(size > 0, size, 1.0)
    if normals.shape[1] == 1 and free.all():
        return found
    more = np.flatnonzero(normals[:, 1:].any(axis=(1, 2)) | ~free.all(axis=1))
    if len(more):
        found[more] = _left_by(normals[more], free[more])
    return found


def _left_by(normals: Array, free: Bools) -> Array:
    """``tangents`` for several normals or prescribed components."""
    fixed = np.where(free, 0.0, 1.0)[:, :, None] * np.eye(normals.shape[2])
    _, size, axes = np.linalg.svd(np.concatenate([normals, fixed], axis=1))
    # the last axes are perpendicular to normals and prescribed components
    return np.where((size[:, 1:] < PRESCRIBED)[:, :, None] & free[:, None], axes[:, 1:], 0.0)


def along(directions: Array, vectors: Array) -> Array:
    """Parts of ``vectors (n, gdim)`` in the span of orthonormal ``directions (n, k, gdim)``: ``(n, gdim)``."""
    return np.asarray(((directions * vectors[:, None]).sum(axis=2, keepdims=True) * directions).sum(axis=1))


def find_violations(
    violated: Violations,
    state: FrictionState,
    frictional: Bools,
    seen: Seen,
    *,
    force_rounding: Array | float,
    gap_rounding: float,
) -> FrictionViolations:
    """Add violations of the friction conditions to violations of the contact conditions.

    Args:
        violated: violations of the contact conditions.
        state: of the contactors.
        frictional: active contactors with friction ``(n,)``.
        seen: forces and slips.
        force_rounding: smaller forces count as zero, for all or for each contactor ``(n,)``.
        gap_rounding: smaller lengths count as zero.
    """
    staying = frictional & ~violated.release
    excess = np.linalg.norm(seen.tau, axis=1) - seen.bound
    driven = seen.forced > gap_rounding
    slide = staying & state.stick & ((excess > force_rounding) | driven)
    forward = np.einsum("ng,ng->n", seen.slip, state.direction)
    hold = staying & ~state.stick & ((forward < -gap_rounding) | ~state.direction.any(axis=1))
    return FrictionViolations(violated.enter, violated.release, slide, hold, driven, seen)


def exchange(state: FrictionState, violated: FrictionViolations, tau: Array) -> FrictionState:
    """The state after exchange of violated contactors between stick and slip, which begins against the force ``tau (n, gdim)``."""
    size = np.linalg.norm(tau, axis=1, keepdims=True)
    direction = np.where(violated.slide[:, None], -tau / np.where(size > 0, size, 1.0), state.direction)
    direction[violated.hold] = 0.0
    return replace(state, stick=(state.stick | violated.hold) & ~violated.slide, direction=direction)


def come_and_go(state: FrictionState, before: Bools, now: Bools, frictional: Bools) -> FrictionState:
    """The state in another active set, masks ``(n,)``: new frictional contactors stick, released ones are reset."""
    stick = (state.stick & now) | (now & ~before & frictional)
    return replace(state, stick=stick, direction=np.where((now & ~stick)[:, None], state.direction, 0.0))


def turned(state: FrictionState, which: Bools, q: Array) -> FrictionState:
    """The state with slip of contactors ``which (n,)`` along ``q (n, gdim)``."""
    size = np.linalg.norm(q, axis=1)
    i = which & (size > 0)
    direction = np.where(i[:, None], q / np.where(i, size, 1.0)[:, None], state.direction)
    return replace(state, direction=direction, stick=state.stick & ~i)


def continues(direction: Array, free: Array, away: Array, rounding: float) -> Bools:
    """Contactors that have not moved in this step, and whose slip in the last one was along prescribed components ``(n,)``.

    Their slip is assumed to continue. Otherwise their friction would begin along free components, where only rounding is left of it,
    and a body all of whose contactors have prescribed motions would slide across them.

    Args:
        direction: of slip, zero for contactors that do not slip ``(n, gdim)``.
        free: tangential directions without prescribed components ``(n, gdim - 1, gdim)``.
        away: relative motion in this step ``(n, gdim)``.
        rounding: a length; shorter motions are none.
    """
    part = np.linalg.norm(along(free, direction), axis=1)
    return (np.linalg.norm(away, axis=1) <= rounding) & direction.any(axis=1) & (part < ALONG_CONDITIONS)


def slip_stiffness(own: Array, row: Ints, weight: Array, followed: Array) -> Array:
    """Stiffness c of slipping contactors in 3D ``(n,)``.

    The contactor and the followed nodes are springs in series: ``1 / k = 1 / k_i + sum_a N_a^2 / k_a``, with the diagonal of K as
    stiffness of each node. The stiffness of a much stiffer contactor alone would underestimate the rotation of the slip direction.

    Args:
        own: diagonal of K at the contactors ``(n,)``.
        row: contactor of each term ``(k,)``.
        weight: weight of the followed node ``(k,)``.
        followed: diagonal of K there ``(k,)``; zero if not known.
    """
    seen = (followed > 0) & (own[row] > 0)
    there = np.bincount(row[seen], weight[seen] ** 2 * own[row[seen]] / followed[seen], len(own))
    return SLIP_STIFFNESS * own / (1.0 + there)


def turn_stiffness(size: Array, bound: Array, c: Array) -> tuple[Array, Array]:
    """Linearisation of the slip direction: a stiffness across it, and the part of the force across it that is removed ``(k,)``.

    With ``a = bound / |q|`` these are ``c a / (1 - a)`` and ``a / (1 - a)``.

    Args:
        size: ``|q|`` ``(k,)``.
        bound: limit of friction ``(k,)``.
        c: stiffness c ``(k,)``.
    """
    a = np.clip(bound / np.where(size > 0, size, np.inf), 0.0, LEAST_TURN)
    return c * a / (1.0 - a), a / (1.0 - a)


def work(before: Array, now: Array, start: Array, end: Array, cornered: Bools) -> Array:
    """Frictional dissipation of a step ``(n,)``: mean of the friction forces at start and end times the slip.

    A contactor slides into a corner before it is held there; work of a force that would push it further does not count as friction.

    Args:
        before: friction at the start of the step ``(n, gdim)``.
        now: at its end ``(n, gdim)``.
        start: relative motion in the step, for the weights at its start ``(n, gdim)``.
        end: the same for the weights at its end ``(n, gdim)``.
        cornered: contactors held in a corner at the end ``(n,)``.
    """
    first, last = (-0.5 * np.einsum("ng,ng->n", tau, way) for tau, way in ((before, start), (now, end)))
    return np.asarray(first + np.where(cornered, np.maximum(last, 0.0), last))
