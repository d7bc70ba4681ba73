"""Linear soft contact: a stiffness per area where surfaces overlap."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from dolfinx import fem

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.laws.constants import described, value


@dataclass(frozen=True, repr=False)
class Linear:
    """``p = -k g`` for g <= 0, else 0.

    Args:
        k: stiffness per area, a pressure over a length, a number or a Constant.
    """

    k: float | fem.Constant
    rest = 0.0
    __repr__ = described

    def pressure(self, gap: Array) -> tuple[Array, Array]:
        """See ``PressureLaw``."""
        k = value(self.k)
        return k * np.maximum(-gap, 0.0), np.where(gap <= 0.0, -k, 0.0)
