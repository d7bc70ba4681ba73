"""A parameter of a law of friction that follows the temperature of what touches, as users declare it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array


class OfTemperature(given.Sealed):
    """A coefficient of friction, or another law's first parameter, that is a function of the temperature at the contactors.

    The temperature that counts is the mean of the contactor's and of that which it faces on the target; against a rigid surface the mean
    with the ``temperature`` of the contact's ``heat``, or the contactor's own where there is none. It is that of the same iteration as
    the positions of the contactors: once a step has converged, friction is that of its temperatures.

    Args:
        f: function of the reference places ``(3, n)``, the load factor, in dynamics the time, and the temperatures ``(n,)``, which returns
            ``(n,)`` numbers, 0 or positive, or one for all. Temperatures on the way to equilibrium may be far off.
        field: number of the part of the mixed space that is the temperature, scalar Lagrange of the displacement's degree or less.

    Raises:
        InputTypeError: if ``f`` is no function, or ``field`` no whole number.
    """

    def __init__(self, f: Callable[[Array, float, Array], npt.ArrayLike], *, field: int):
        self.f = given.kind("f", f, callable(f), "a function of places, load factor and temperatures, f(x, t, T)")
        self.field = given.part_number("field", field, "the temperature")

    def __call__(self, x: Array, t: float, T: Array) -> Any:
        """Its values ``(n,)``."""
        return self.f(x, t, T)

    def at(self, t: float) -> OfTemperature:
        """Its value at a load factor or time, from then on."""
        return OfTemperature(lambda x, _, T: self.f(x, t, T), field=self.field)
