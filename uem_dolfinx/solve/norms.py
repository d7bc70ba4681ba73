"""Norms of forces as the Newton loop compares them: one of a displacement's, or one for each field, since a force is not a heat."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

from uem_dolfinx.arrays import Array

#: A norm of forces; where the displacement is one of several fields, one for each of them, its own first ``(n_fields,)``.
Norm: TypeAlias = float | Array


def first(norm: Norm) -> float:
    """The displacement's part of a norm."""
    return float(np.ravel(norm)[0])


def ratio(norm: Norm, scale: Norm) -> float:
    """A norm over a scale, in the field where it is largest; 0 where there is no scale."""
    return float(np.max(np.divide(norm, scale, out=np.zeros(np.shape(norm)), where=np.asarray(scale) > 0)))


def worst(norm: Norm, rounding: Norm, real: Norm) -> tuple[float, float, float]:
    """Residual, rounding and forces of the field in which the residual is the largest part of the forces."""
    every = [np.atleast_1d(a) for a in np.broadcast_arrays(norm, rounding, real)]
    k = int(np.argmax(every[0] / np.where(every[2] > 0.0, every[2], np.inf)))
    return float(every[0][k]), float(every[1][k]), float(every[2][k])
