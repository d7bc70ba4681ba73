"""Least squares with unknowns that are not negative: motions that overlap nothing, forces that do not pull."""

from __future__ import annotations

from contextlib import suppress

import numpy as np

from uem_dolfinx.arrays import Array


def least_squares(E: Array, e: Array, quick: bool = True) -> Array:
    """``x >= 0 (n,)`` that minimises ``|E x - e|``, ``E (m, n)``: ``quick`` is not accurate to rounding in every SciPy."""
    from scipy.optimize import lsq_linear, nnls

    most = 30 * E.shape[1]
    if quick:
        # nnls raises after too many iterations
        with suppress(RuntimeError):
            return np.asarray(nnls(E, e, maxiter=most)[0])
    # its bounds hold to rounding
    return np.maximum(lsq_linear(E, e, (0.0, np.inf), "bvls", 1e-15, max_iter=most).x, 0.0)
