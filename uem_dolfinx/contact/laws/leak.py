"""Fluid pressure between surfaces: it enters where they are open and connected with where it comes from."""

from __future__ import annotations

from collections.abc import Callable

from mpi4py import MPI

from uem_dolfinx import given
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.tags import Part
from uem_dolfinx.parallel import ask_together


class Leak(given.Sealed):
    """Fluid between contactors and target, which presses on both; pass it to ``Contact`` as ``leak``.

    The fluid reaches the contactors of ``inlet``, and from open contactors their neighbours. A contactor that it reaches and that is closed
    carries the fluid's pressure, and in addition a contact pressure that is not negative. It opens as soon as the fluid's pressure exceeds
    the pressure that closes the surfaces. ``contact.pressure`` is the part of the solids, :attr:`Contact.wet` shows where the fluid is.

    Args:
        pressure: of the fluid, a number that is not negative, or a function of the load factor, in dynamics of the time.
        inlet: source of the fluid: a part of the mesh whose nodes on the contactor surface it always reaches.

    Raises:
        InputError, InputTypeError: for a pressure that is negative or of another type.
    """

    def __init__(self, pressure: float | Callable[[float], float], inlet: Part):
        if not given.function(pressure):
            pressure = given.number("pressure", pressure, given.NOT_NEGATIVE)
        self.pressure, self.inlet = pressure, inlet

    def __repr__(self) -> str:
        """Its pressure."""
        return f"Leak({'a function' if callable(self.pressure) else self.pressure!r})"

    def at(self, comm: MPI.Comm, name: str, at: float) -> float:
        """Pressure at a load factor or time (collective).

        Raises:
            InputError, UserFunctionError: if a function raises, or returns no finite number that is not negative.
        """
        if not callable(self.pressure):
            return float(self.pressure)
        found = ask_together(comm, f"contact '{name}': leak, pressure", self.pressure, at)
        try:
            value = float(found)
        except (TypeError, ValueError):
            value = -1.0
        if not given.NOT_NEGATIVE.holds(value):
            raise InputError(
                f"contact '{name}': leak, pressure({at:.6g}) = {found!r}: expected a finite number that is not negative"
            )
        return value
