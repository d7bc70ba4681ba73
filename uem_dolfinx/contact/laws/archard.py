"""Archard's law of wear for arrays: the worn volume is proportional to the normal force and to the slip."""

from __future__ import annotations

import numpy as np

from uem_dolfinx.arrays import Array


def worn_volume(k: Array, start: Array, end: Array) -> Array:
    """Worn volume of a step ``(n,)``: k times the mean of normal force times slip, with the forces at the start and at the end.

    Args:
        k: wear coefficient over hardness, one over a pressure ``(n,)``.
        start: normal force at the start of the step times the slip, an energy; tension causes no wear ``(n,)``.
        end: normal force at the end times the slip ``(n,)``.
    """
    return np.asarray(0.5 * k * (np.maximum(start, 0.0) + np.maximum(end, 0.0)))
