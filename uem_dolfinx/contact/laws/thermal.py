"""User input of a friction parameter that depends on the temperature of the surfaces in contact."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array


class OfTemperature(given.Sealed):
    """A coefficient of friction, or another law's first parameter, that is a function of the temperature at the contactors.

    This temperature is the mean of the contactor and of the opposite point of the target. On a rigid surface it is the mean with
    the ``temperature`` of the contact's ``heat``, or without it the contactor's temperature. It belongs to the same iteration as
    the positions, so that friction of a converged step is consistent with its temperatures.

    Args:
        f: function of the reference positions ``(3, n)``, the load factor, in dynamics the time, and the temperatures ``(n,)``,
            which returns ``(n,)`` numbers, 0 or positive, or one for all. During iterations T may be far off.
        field: number of the part of the mixed space that is the temperature, scalar Lagrange of the displacement's degree or less.

    Raises:
        InputTypeError: if ``f`` is not a function, or ``field`` not an integer.
    """

    def __init__(self, f: Callable[[Array, float, Array], npt.ArrayLike], *, field: int):
        self.f = given.kind("f", f, given.function(f), "a function of places, load factor and temperatures, f(x, t, T)")
        self.field = given.part_number("field", field, "the temperature")

    def __call__(self, x: Array, t: float, T: Array) -> Any:
        """Its values ``(n,)``."""
        return self.f(x, t, T)

    def at(self, t: float) -> OfTemperature:
        """The same function with a fixed load factor or time."""
        return OfTemperature(lambda x, _, T: self.f(x, t, T), field=self.field)
