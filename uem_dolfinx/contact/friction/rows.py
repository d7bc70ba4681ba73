"""Equations with friction: tangential equations of sticking contactors, and rotated test rows of slipping contactors."""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints, cross_products
from uem_dolfinx.contact.friction.frame import Frame
from uem_dolfinx.contact.seam.placement import NORMAL, Constraints
from uem_dolfinx.contact.seam.relative_motion import Ties
from uem_dolfinx.parallel import reduced


def with_friction(
    own: Constraints,
    frame: Frame,
    *,
    of_friction: Bools,
    stick: Bools,
    directions: Array,
    slope: Array,
    normal: Array,
    pointwise: bool,
    keeps_ties: bool,
) -> Constraints:
    """Add tangential equations of sticking contactors, and rotate test rows of slipping contactors (collective).

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
    across = np.flatnonzero(own.kind == NORMAL)
    contactor, test = own.contactor[across], own.test
    place = np.full(len(normal), -1, dtype=np.int64)
    place[contactor] = np.arange(len(contactor))

    def along(t: Array, gap: Array, active: Bools, ties: Ties) -> UnitingEquations:
        there = place[ties.row] >= 0
        row, weight = place[ties.row[there]], ties.weight[there, None]
        return UnitingEquations(test.node[across], t, gap, active, row, ties.followed[there], weight * t[row])

    T, of_friction, stick = frame.free_tangents[contactor], of_friction[contactor], stick[contactor]
    away = np.einsum("nrg,ng->nr", T, frame.away[contactor])
    resisted = [of_friction & T[:, r].any(axis=1) for r in range(g - 1)]

    def with_those_along(rows: UnitingEquations, ties: Ties) -> UnitingEquations:
        return UnitingEquations.join([rows, *(along(T[:, r], away[:, r], resisted[r] & stick, ties) for r in range(g - 1))], g)

    frictionless = rotated = trial = with_those_along(test, frame.ties)
    slipping = of_friction & ~stick
    tilt = np.where(slipping[:, None], -slope[contactor, None] * directions[contactor], 0.0)
    slips = reduced(comm, bool(tilt.any()), op=MPI.LOR)
    # trial and test rows of sticking contactors are equal if they have the current weights
    if own.trial is not test or not (pointwise or (keeps_ties and not slips)):
        trial = with_those_along(own.trial, frame.ties if pointwise else frame.way)
    if slips:
        rotated = _rotated(frictionless, across, tilt, place, frame.ties)
    stopping = trial
    if g == 3:
        crosswise = along(
            cross_products(normal[contactor], directions[contactor]), np.zeros(len(contactor)), slipping, frame.ties
        )
        stopping = UnitingEquations.join([trial, crosswise], g)
    return Constraints(
        trial,
        rotated,
        frictionless,
        replace(trial, active=np.concatenate([own.trial.active, *resisted])),
        stopping,
        np.concatenate([own.contactor, *[contactor] * (g - 1)]),
        np.concatenate([own.kind, *[np.full(len(contactor), NORMAL)] * (g - 1)]),
        np.concatenate([own.tangent, *(np.full(len(contactor), r) for r in range(g - 1))]),
    )


def _rotated(equations: UnitingEquations, which: Ints, tilt: Array, place: Ints, ties: Ties) -> UnitingEquations:
    """Equations ``which (k,)`` of which have ``tilt (k, gdim)`` added; ``place (n,)`` of contactors among these, -1 for none."""
    there = place[ties.row] >= 0
    row, direction = place[ties.row[there]], equations.direction.copy()
    direction[which] += tilt
    return replace(
        equations,
        direction=direction,
        row=np.concatenate([equations.row, which[row]]),
        followed=np.concatenate([equations.followed, ties.followed[there]]),
        coefficients=np.concatenate([equations.coefficients, ties.weight[there, None] * tilt[row]]),
    )
