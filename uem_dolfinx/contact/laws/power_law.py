"""Power law of soft contact of rough surfaces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array

#: Bodies that nothing else holds are put onto a surface of a power law with this overlap, over h: at gap 0 it has no stiffness.
#: [convention; h; test_soft_contact.py::test_a_block_that_rests_on_a_power_law]
SUNK = 1e-2
EXPONENT = given.Range("a number of at least 1", lambda m: (m >= 1) & np.isfinite(m))


@dataclass(frozen=True)
class PowerLaw:
    """``p = p0 (-g / h)^m`` for g < 0, else 0, the closure of rough surfaces.

    Greenwood, Williamson, Proceedings of the Royal Society A 295 (1966) 300-319, with the power law of Back, Burdekin, Cowley (1973)
    for machined joints. An ``offset`` of the contact is the height at which asperities touch first.

    Args:
        p0: pressure at an overlap h.
        h: an overlap, a positive length.
        m: exponent, at least 1.

    Raises:
        InputError, InputTypeError: for numbers out of their range.
    """

    p0: float
    h: float
    m: float

    def __post_init__(self) -> None:
        for name, within in (("p0", given.POSITIVE), ("h", given.POSITIVE), ("m", EXPONENT)):
            object.__setattr__(self, name, given.number(name, getattr(self, name), within))

    @property
    def rest(self) -> float:
        """See ``PressureLaw``."""
        return -SUNK * self.h

    def pressure(self, gap: Array) -> tuple[Array, Array]:
        """See ``PressureLaw``."""
        x = np.maximum(-gap / self.h, 0.0)
        return self.p0 * x**self.m, np.where(gap <= 0.0, -self.p0 * self.m / self.h * x ** (self.m - 1.0), 0.0)
