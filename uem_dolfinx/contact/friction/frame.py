"""Tangential directions, anchors, relative motions and equations of frictional contactors, and sliding distances times forces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints, cross_products, replace
from uem_dolfinx.contact.friction import stick_slip
from uem_dolfinx.contact.seam.corners import first_over
from uem_dolfinx.contact.seam.placement import NORMAL, ContactRows, Kinematics, without_terms
from uem_dolfinx.contact.seam.relative_motion import Ties
from uem_dolfinx.contact.seam.state import FrictionState, PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import FacetProjection, Target
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import reduced


@dataclass(frozen=True)
class Frame:
    """Data of one placement for friction; immutable."""

    ties: Ties  # weights by which contactors follow other nodes and transmit friction to them
    way: Ties  # weights of ``away``
    away: Array  # vectors from the anchors to the contactors, or relative motions since the last step ``(n, gdim)``
    tangents: Array  # tangential directions ``(n, gdim - 1, gdim)``
    free_tangents: Array  # tangential directions in which the relative motion is not prescribed ``(n, gdim - 1, gdim)``
    #: normals of other rigid surfaces that hold the contactors, or zero ``(n, k, gdim)``; k is 0 if none holds any.
    other_normals: Array
    prescribed: bool  # whether any contactor has a Dirichlet condition
    cornered: Bools  # contactors held in a corner, with friction only along its edge ``(n,)``

    @classmethod
    def of(cls, kinematics: Kinematics, away: Array, way: Ties | None, other_normals: Array, prescribed: bool) -> Frame:
        """The frame for relative motions ``away (n, gdim)``; ``way`` is None for the present ``ties``; arguments as the attributes."""
        normals, ties, c = kinematics.normal[:, None], kinematics.ties, kinematics.corners
        n, g = away.shape
        cornered = np.zeros(n, dtype=bool)
        if c is not None:
            normals = np.concatenate([normals, c.axes_of(n)], axis=1)
            cornered[c.which] = True
        free = np.ones((n, g), dtype=bool)
        every = free_tangents = stick_slip.tangents(normals, free)
        if prescribed or other_normals.shape[1]:
            moves = ties.moves if prescribed else free
            free_tangents = stick_slip.tangents(np.concatenate([normals, other_normals], axis=1), moves)
        return cls(ties, way or ties, away, every, free_tangents, other_normals, prescribed, cornered)

    def along(self, way: Array) -> Array:
        """Tangential parts of relative motions ``(n, gdim)``; prescribed components contribute only their own motion."""
        if not self.prescribed:
            return stick_slip.along(self.tangents, way)
        moving = stick_slip.along(self.free_tangents, way) + stick_slip.along(self.tangents, np.where(self.ties.moves, 0.0, way))
        return np.where(np.abs(self.other_normals).sum(axis=(1, 2))[:, None] > 0, stick_slip.along(self.tangents, way), moving)

    @cached_property
    def slip(self) -> Array:
        """Tangential motion since the last step; for a sticking contactor, its offset from the anchor ``(n, gdim)``."""
        return self.along(self.away)

    def directions(self, vectors: Array) -> Array:
        """Tangential unit vectors of ``vectors (n, gdim)``, zero for zero."""
        s = self.along(vectors)
        size = np.linalg.norm(s, axis=1, keepdims=True)
        return s / np.where(size > 0, size, 1.0)

    def tangential(self, force: Array) -> Array:
        """Tangential parts of forces ``(n, gdim)``."""
        return stick_slip.along(self.tangents, force)

    def forced(self, away: Array, left_out: Bools) -> Array:
        """Length of the slip prescribed by conditions and other surfaces ``(n,)``, without tangents with redundant equations."""
        if not (self.prescribed or self.other_normals.shape[1]):
            return np.zeros(len(away))
        along = stick_slip.along(self.tangents, away) - stick_slip.along(self.free_tangents, away)
        length = np.where(self.other_normals.any(axis=(1, 2)), np.linalg.norm(along, axis=1), 0.0)
        if not self.prescribed:
            return length
        lost = np.where(left_out[:, :, None], self.free_tangents, 0.0)
        parts = (self.tangents, np.where(self.ties.moves, 0.0, away)), (lost, away)
        return length + sum(np.linalg.norm(stick_slip.along(T, way), axis=1) for T, way in parts)


def force_times_way(
    frame: Frame, at: Kinematics, states: tuple[PairState, PairState], tau: Array, ways: tuple[Array, Array]
) -> tuple[Array, Array]:
    """Normal force times sliding distance of a step, with the force at its start and at its end, ``(n,)`` each.

    Args:
        frame: tangential directions at the end of the step.
        at: kinematics at the end of the step.
        states: states at the start and at the end.
        tau: friction at the end ``(n, gdim)``.
        ways: relative motion in the step, per unit of force at its start and at its end ``(n, gdim)`` each.
    """
    begin, end = states
    assert begin.friction is not None
    return _one(frame, at, states, begin, begin.friction.tau, ways[0]), _one(frame, at, states, end, tau, ways[1])


def _one(frame: Frame, at: Kinematics, states: tuple[PairState, PairState], of: PairState, tau: Array, way: Array) -> Array:
    """The product with the forces of one of the states."""
    # a contactor that leaves a corner slides over one facet, which carries the force along its normal
    push = np.where(of.in_corner, np.einsum("ng,ng->n", at.normal, of.force - tau), of.lam)
    rubbed, c = push * np.linalg.norm(frame.along(way), axis=1), at.corners
    if c is not None:
        i, first = c.which, first_over(c, states[1], states[0].facet, way)
        cornered, alone = of.in_corner[i, None], of.lam[i, None] * c.normals[np.arange(len(i)), first]
        rubbed[i] = c.rubbing(np.where(cornered, of.force[i], alone), np.where(cornered, tau[i], 0.0), way[i], first)
    return np.asarray(rubbed)


def anchored(
    f: FrictionState, kinematics: Kinematics, target: Target, points: Array, loose: Bools, kept_feet: bool
) -> FrictionState:
    """The state in which contactors that do not stick get anchors at their current position.

    Args:
        f: state of friction.
        kinematics: of the contactors.
        target: that they are anchored to.
        points: positions of the contactors ``(n, gdim)``.
        loose: contactors that do not stick ``(n,)``.
        kept_feet: whether closest points are constant during the step, so that contactors move away from them.
    """
    p = kinematics.projection
    below = points - p.height[:, None] * p.normal
    if not target.n_nodes:
        motion: Motion | None = target.motion
        here = below if motion is None else motion.back(below)
        return replace(f, anchor=np.where(loose[:, None], here, f.anchor))
    nearest = kinematics.nearest
    assert isinstance(nearest, FacetProjection)
    left = below - nearest.foot if kept_feet else np.zeros_like(points)
    return replace(
        f,
        facet=np.where(loose, nearest.facet, f.facet),
        xi=np.where(loose[:, None], nearest.xi, f.xi),
        anchor=np.where(loose[:, None], left, f.anchor),
    )


def anchors_of(f: FrictionState, target: Target, terms: bool) -> tuple[Array, tuple[Ints, Ints, Array] | None]:
    """Current positions of the anchors ``(n, gdim)``, and contactors, global nodes and weights ``(k,)`` if ``terms`` (collective)."""
    if isinstance(target, MeshTarget):
        N, facets = target.shape.tabulate(f.xi).N, target.facets
        here = np.einsum("na,nag->ng", N, target.of_facets(f.facet, facets.x)) + f.anchor
        if not terms:
            return here, None
        nodes = target.of_facets(f.facet, facets.nodes)
        row, a = np.nonzero(nodes >= 0)
        return here, (row.astype(np.int64), nodes[row, a], N[row, a])
    motion: Motion | None = target.motion
    return f.anchor if motion is None else motion.carry(f.anchor), None


def way_since(config: Configuration, nodes: Indices, before: Array, motion: Motion | None, now: Motion | None) -> Array:
    """Displacement of the owned nodes ``(n_owned, gdim)`` since ``before``; for contactors relative to a rigid target.

    Args:
        config: configuration of the displacement.
        nodes: contactors ``(n,)``.
        before: positions ``(n_owned, gdim)``.
        motion: motion of the target then; None if it had not moved.
        now: its motion now.
    """
    way = config.x[: config.n_owned] - before
    if now is not motion:
        still = Motion.none(config.gdim)
        start = before[nodes]
        way[nodes] -= (now or still).carry((motion or still).back(start)) - start
    return way


def with_friction(
    own: ContactRows,
    frame: Frame,
    *,
    of_friction: Bools,
    stick: Bools,
    directions: Array,
    slope: Array,
    normal: Array,
    pointwise: bool,
    keeps_ties: bool,
) -> ContactRows:
    """Add tangential equations of sticking contactors, and tilt the rows of slipping contactors in Q (collective).

    Args:
        own: normal equations.
        frame: tangential directions and relative motions.
        of_friction: active contactors with friction ``(n,)``.
        stick: contactors that stick if they are frictional ``(n,)``.
        directions: of slip ``(n, gdim)``.
        slope: derivative of the friction limit by the normal multiplier ``(n,)``.
        normal: of the contactors ``(n, gdim)``.
        pointwise: whether sticking contactors are at their anchors, so that both have the same weights.
        keeps_ties: whether the weights of sticking contactors are unchanged since the last step.
    """
    comm, g = frame.ties.config.comm, normal.shape[1]
    contactor = own.contactor[own.kind == NORMAL]
    none, place = np.zeros(m := len(contactor)), np.full(len(normal), -1, dtype=np.int64)
    place[contactor] = np.arange(m)
    T, of_friction, stick, s = (of_all[contactor] for of_all in (frame.free_tangents, of_friction, stick, directions))
    slipping, away = of_friction & ~stick, np.einsum("nrg,ng->rn", T, frame.away[contactor])
    turned = np.where(slipping[:, None], -slope[contactor, None] * s, 0.0)
    slips = reduced(comm, bool(turned.any()), op=MPI.LOR)
    # rows of sticking contactors are the same in P and Q if they have the current weights
    apart = not pointwise and (own.moved is not None or slips or not keeps_ties)

    def along(node: Ints, t: Array, gap: Array, active: Bools, ties: Ties, k: int = 1) -> UnitingEquations:
        there = place[ties.row] >= 0
        row = (place[ties.row[there]] + m * np.arange(k)[:, None]).ravel()
        followed, weight = (np.concatenate([of_term[there]] * k) for of_term in (ties.followed, ties.weight))
        return UnitingEquations(node, t, gap, active, row, followed, weight[:, None] * t[row])

    # all rows along the first tangents, then along the second ones
    node: Any = own.rows.node[:m]
    k = g - 1
    t = np.concatenate([T[:, r] for r in range(k)])
    nodes, contactors, rubs, sticks = (np.concatenate([of_all] * k) for of_all in (node, contactor, of_friction, stick))
    resisted = rubs & t.any(axis=1)
    how = nodes, t, away.ravel(), resisted & sticks
    numbers = contactors, np.full(k * m, NORMAL), np.repeat(np.arange(k), m)
    moved = along(*how, frame.way, k) if apart else None
    tangential = ContactRows(along(*how, frame.ties, k), *numbers, moved, None, resisted)
    tilt = crosswise = None
    if slips:
        rest = without_terms(own.rows.select(np.arange(len(own)) >= m))
        tilt = UnitingEquations.join([along(node, turned, none, slipping, frame.ties), rest], g)
    if g == 3:
        crosswise = along(node, cross_products(normal[contactor], s), none, slipping, frame.ties)
    return ContactRows.join([replace(own, tilt=tilt, crosswise=crosswise), tangential], [], g)
