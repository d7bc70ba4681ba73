"""Curvature of contacts in the space of one degree more, where contactors slide over their targets.

Normals turn with targets, and closest points move along these. So contact forces turn with a function w of that space, and the stiffness
of the bodies is that of a contact with these forces,

    K(v, w) + integral of lam d/dw [ (n - mu s) . (v_c - v_t) ]

with the multipliers lam of the solution's tractions. Contactors that stick keep their anchors, where forces do not turn.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from scipy.sparse import bsr_matrix, csr_matrix

from uem_dolfinx.arrays import Array, Ints

#: Points whose second derivatives are made at once, in the memory that these take.
#: [bound; points; -]
POINTS_AT_ONCE = 1000


class Side(NamedTuple):
    """The enriched space on facets of one side of a contact, at points of contactors.

    Attributes:
        node: global nodes ``(n, nn)``.
        value: their functions ``(n, nn)``.
        free: 1 for their free components ``(n, nn, gdim)``.
        x: their positions ``(n, nn, gdim)``.
    """

    node: Ints
    value: Array
    free: Array
    x: Array


def curvature(
    projection: Any, lam: Array, rubbing: Array, contactor: Side, target: Side | None, shape: Any
) -> tuple[Ints, Ints, Array]:
    """Entries of the stiffness that sliding contacts add.

    Args:
        projection: of the points, onto the target.
        lam: multipliers at the points, with their part of the area ``(n,)``: negative in contact, zero where they do not slide.
        rubbing: mu s in the tangent plane ``(n, gdim)``.
        contactor: its functions.
        target: functions of the target; None for a rigid one.
        shape: of the target's facets in the enriched space.

    Returns:
        Global components of rows and of columns, and values ``(k,)``.
    """
    gdim, sides = projection.normal.shape[1], [contactor] if target is None else [contactor, target]
    found = np.concatenate([side.node for side in sides], axis=1)
    components, local = np.unique(found[:, :, None] * gdim + np.arange(gdim), return_inverse=True)
    local = local.reshape(*found.shape, gdim)
    total = csr_matrix((len(components),) * 2)
    slides = np.flatnonzero(lam)
    for i in np.split(slides, np.arange(POINTS_AT_ONCE, len(slides), POINTS_AT_ONCE)):
        p, which, every = projection, i, np.arange(len(i))
        if target is not None:
            tab, which = shape.tabulate(p.xi[i]), every
            p = replace(p.take(i), nodes=target.node[i], weights=tab.N, dN=tab.dN, ddN=tab.ddN, x=target.x[i])
        blocks = lam[i, None, None] * (p.hessians(which) - p.turnings(which, rubbing[i]))
        # motion of the contactor and of the target's nodes, by the components of the space
        size = blocks.shape[1]
        first = np.broadcast_to(size * every[:, None, None] + np.arange(gdim), contactor.free[i].shape)
        rows, values = [first], [contactor.value[i, :, None] * contactor.free[i]]
        if target is not None:
            rows.append(size * every[:, None, None] + np.arange(gdim, size).reshape(-1, gdim))
            values.append(target.free[i])
        row, value = (np.concatenate(one, axis=1).ravel() for one in (rows, values))
        motion = csr_matrix((value, (row, local[i].ravel())), shape=(size * len(i), len(components)))
        total = total + motion.T @ (bsr_matrix((blocks, every, np.arange(len(i) + 1)), shape=(size * len(i),) * 2) @ motion)
    whole = total.tocoo()
    return components[whole.row], components[whole.col], whole.data
