"""Archard's law of wear, as a function of arrays: the volume worn is proportional to the force along the normal and to the way of slip."""

from __future__ import annotations

import numpy as np

from uem_dolfinx.arrays import Array


def worn_volume(k: Array, start: Array, end: Array, way_from: Array, way_to: Array) -> Array:
    """Volume worn in a step: k times the mean, of its start and end, of force times way ``(n,)``.

    Args:
        k: coefficient of wear over hardness, one over a pressure ``(n,)``.
        start: force along the normal at the start of the step; tension wears nothing ``(n,)``.
        end: at its end ``(n,)``.
        way_from: length of the slip of the step past what the force at its start acts on ``(n,)``.
        way_to: past what the force at its end acts on ``(n,)``.
    """
    return np.asarray(0.5 * k * (np.maximum(start, 0.0) * way_from + np.maximum(end, 0.0) * way_to))
