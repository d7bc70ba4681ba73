"""Norms of forces in the Newton loop: one for a displacement, or one for each field of a mixed problem, because of their units."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from uem_dolfinx.arrays import Array

#: A norm of forces; in mixed problems one for each field, with the displacement's first ``(n_fields,)``.
Norm: TypeAlias = float | Array


def first(norm: Norm) -> float:
    """The displacement's part of a norm."""
    return float(np.ravel(norm)[0])


def ratio(norm: Norm, scale: Norm) -> float:
    """The largest ratio of a norm to a scale over all fields; 0 for a zero scale."""
    return float(np.max(np.divide(norm, scale, out=np.zeros(np.shape(norm)), where=np.asarray(scale) > 0)))


def worst(norm: Norm, rounding: Norm, real: Norm) -> tuple[float, float, float]:
    """Residual, rounding and forces of the field with the largest residual relative to its forces."""
    every = [np.atleast_1d(a) for a in np.broadcast_arrays(norm, rounding, real)]
    k = int(np.argmax(every[0] / np.where(every[2] > 0.0, every[2], np.inf)))
    return float(every[0][k]), float(every[1][k]), float(every[2][k])
