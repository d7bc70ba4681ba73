"""Exponential soft contact of rough surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.laws.constants import checked, described, value


@dataclass(frozen=True, repr=False)
class Exponential:
    """``p = p0 exp(-g / h)``, the closure of rough surfaces with exponentially distributed heights.

    Greenwood, Williamson, Proceedings of the Royal Society A 295 (1966) 300-319. Beyond ``REACH`` times h the pressure is zero.

    Args:
        p0: pressure at gap 0, a number or a Constant.
        h: length over which the pressure changes by a factor e, a number or a Constant.

    Raises:
        InputError, InputTypeError: for numbers that are not positive.
    """

    p0: float | fem.Constant
    h: float | fem.Constant
    rest = 0.0
    __repr__ = described
    #: Gap, over h, beyond which the pressure is rounding of p0; and overlap, over h, beyond which it grows linearly: below overflow.
    #: [derived; h; test_soft_laws.py::test_an_exponential_law_far_out]
    REACH: ClassVar[float] = float(-np.log(np.finfo(float).eps))

    def __post_init__(self) -> None:
        for name in ("p0", "h"):
            object.__setattr__(self, name, checked(name, getattr(self, name), given.POSITIVE))

    def pressure(self, gap: Array) -> tuple[Array, Array]:
        """See ``PressureLaw``."""
        p0, h = value(self.p0), value(self.h)
        x = gap / h
        e = p0 * np.exp(-np.maximum(x, -self.REACH)) * (x < self.REACH)
        return e * (1.0 + np.maximum(-self.REACH - x, 0.0)), -e / h
