"""Equations with friction: tangential equations of sticking contactors, and what tilts the rows of slipping contactors in Q."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, cross_products
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
    first, m, node = len(contactor), len(own) + (g - 1) * len(contactor), own.rows.node[: len(contactor)]
    place = np.full(len(normal), -1, dtype=np.int64)
    place[contactor] = np.arange(first)

    def along(t: Array, ties: Ties, active: Bools, gap: Array | None = None) -> UnitingEquations:
        there = place[ties.row] >= 0
        row, weight = place[ties.row[there]], ties.weight[there, None]
        gap = np.zeros(first) if gap is None else gap
        return UnitingEquations(node, t, gap, active, row, ties.followed[there], weight * t[row])

    T, of_friction, stick = frame.free_tangents[contactor], of_friction[contactor], stick[contactor]
    away = np.einsum("nrg,ng->nr", T, frame.away[contactor])
    resisted = [of_friction & T[:, r].any(axis=1) for r in range(g - 1)]

    def with_those_along(rows: UnitingEquations, ties: Ties) -> UnitingEquations:
        return UnitingEquations.join([rows, *(along(T[:, r], ties, resisted[r] & stick, away[:, r]) for r in range(g - 1))], g)

    rows, slipping, s = with_those_along(own.rows, frame.ties), of_friction & ~stick, directions[contactor]
    turned, moved, tilt = np.where(slipping[:, None], -slope[contactor, None] * s, 0.0), None, None
    slips = reduced(comm, bool(turned.any()), op=MPI.LOR)
    # rows of sticking contactors are the same in P and Q if they have the current weights
    if own.moved is not None or not (pointwise or (keeps_ties and not slips)):
        moved = with_those_along(own.P, frame.ties if pointwise else frame.way)
    if slips:
        tilt = UnitingEquations.join([along(turned, frame.ties, slipping), without_terms(rows.select(np.arange(m) >= first))], g)
    return ContactRows(
        rows,
        np.concatenate([own.contactor, *[contactor] * (g - 1)]),
        np.concatenate([own.kind, np.full(m - len(own), NORMAL)]),
        np.concatenate([own.tangent, *(np.full(first, r) for r in range(g - 1))]),
        moved,
        tilt,
        np.concatenate([own.rows.active, *resisted]),
        along(cross_products(normal[contactor], s), frame.ties, slipping) if g == 3 else None,
    )
