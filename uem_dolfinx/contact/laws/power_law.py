"""Power law of soft contact of rough surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.laws.constants import checked, described, value

#: Bodies that nothing else holds are put onto a surface of a power law with this overlap, over h: at gap 0 it has no stiffness.
#: [convention; h; test_soft_contact.py::test_a_block_that_rests_on_a_power_law]
SUNK = 1e-2
EXPONENT = given.Range("a number of at least 1", lambda m: (m >= 1) & np.isfinite(m))


@dataclass(frozen=True, repr=False)
class PowerLaw:
    """``p = p0 (-g / h)^m`` for g < 0, else 0, the closure of rough surfaces.

    Greenwood, Williamson, Proceedings of the Royal Society A 295 (1966) 300-319, with the power law of Back, Burdekin, Cowley (1973)
    for machined joints. An ``offset`` of the contact is the height at which asperities touch first.

    Args:
        p0: pressure at an overlap h.
        h: an overlap, a positive length.
        m: exponent, at least 1. All three are numbers or Constants.

    Raises:
        InputError, InputTypeError: for numbers out of their range.
    """

    p0: float | fem.Constant
    h: float | fem.Constant
    m: float | fem.Constant
    __repr__ = described

    def __post_init__(self) -> None:
        for name, within in (("p0", given.POSITIVE), ("h", given.POSITIVE), ("m", EXPONENT)):
            object.__setattr__(self, name, checked(name, getattr(self, name), within))

    @property
    def rest(self) -> float:
        """See ``PressureLaw``."""
        return -SUNK * value(self.h)

    def pressure(self, gap: Array) -> tuple[Array, Array]:
        """See ``PressureLaw``."""
        p0, h, m = value(self.p0), value(self.h), value(self.m)
        x = np.maximum(-gap / h, 0.0)
        return p0 * x**m, np.where(gap <= 0.0, -p0 * m / h * x ** (m - 1.0), 0.0)
