"""Linear soft contact: a stiffness per area where surfaces overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array


@dataclass(frozen=True)
class Linear:
    """``p = -k g`` for g <= 0, else 0.

    Args:
        k: stiffness per area, a pressure over a length.
    """

    k: float
    rest = 0.0

    def pressure(self, gap: Array) -> tuple[Array, Array]:
        """See ``PressureLaw``."""
        return self.k * np.maximum(-gap, 0.0), np.where(gap <= 0.0, -self.k, 0.0)
