"""Equations with friction: tangential equations of sticking contactors, and what tilts the rows of slipping contactors in Q."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints, cross_products, replace
from uem_dolfinx.contact.friction.frame import Frame
from uem_dolfinx.contact.seam.placement import NORMAL, ContactRows, without_terms
from uem_dolfinx.contact.seam.relative_motion import Ties
from uem_dolfinx.parallel import reduced


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
