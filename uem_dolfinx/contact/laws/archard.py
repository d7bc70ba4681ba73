"""Archard's law of wear, as a function of arrays: the volume worn is proportional to the force along the normal and to the way of slip."""

from __future__ import annotations

import numpy as np

from uem_dolfinx.arrays import Array


def worn_volume(k: Array, start: Array, end: Array) -> Array:
    """Volume worn in a step: k times the mean, of its start and end, of force times way ``(n,)``.

    Args:
        k: coefficient of wear over hardness, one over a pressure ``(n,)``.
        start: force along the normal at the start of the step times the way that it acts on, an energy; tension wears nothing ``(n,)``.
        end: the same of the force at its end ``(n,)``.
    """
    return np.asarray(0.5 * k * (np.maximum(start, 0.0) + np.maximum(end, 0.0)))
