"""Normal forces of contactors times sliding distances, for wear."""

from __future__ import annotations

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.friction.frame import Frame
from uem_dolfinx.contact.seam.corners import first_over
from uem_dolfinx.contact.seam.placement import Kinematics
from uem_dolfinx.contact.seam.state import PairState


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
