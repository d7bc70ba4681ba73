"""User input of thermal contact conductance: power per area and temperature difference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from typing import Any, TypeAlias

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.errors import InputError
from uem_dolfinx.parallel import agreed, ask_together

#: A number, or a function of pressures and gaps ``(n,)`` that returns conductances ``(n,)``.
OfPressureAndGap: TypeAlias = float | Callable[[Array, Array], npt.ArrayLike]

CONDUCTANCE = given.Range("0 or a positive number, infinity, or a function of pressures and gaps", lambda x: x >= 0)
SHARE = given.Range("a number from 0 to 1, or None for no heat of friction", lambda x: (x >= 0) & (x <= 1))


class Conductance(given.Sealed):
    """Heat through a contact: the power ``h (T - T_target)`` per area leaves the contactor and enters the target.

    Args:
        h: conductance, a power per area and temperature difference. A number applies where surfaces touch, and open gaps conduct no
            heat; infinity makes temperatures equal where surfaces touch. A function ``h(p, g)`` is called with the contact
            pressures and gaps of all contactors, ``(n,)`` each, both 0 or positive and one of them 0, and returns ``(n,)`` numbers.
        field: number of the part of the mixed space that is the temperature, scalar Lagrange of the displacement's degree or less.
        temperature: of a rigid target, a number or a Constant; None for a meshed target, which has its own.
        friction_share: part of the frictional heat that enters the contactor; the rest enters the target. None ignores frictional heat.
        dt: duration of a step, a number or the Constant in the residual, to convert frictional work of a step to power.

    Raises:
        InputError, InputTypeError: for a value out of its range.
    """

    def __init__(
        self,
        h: OfPressureAndGap,
        *,
        field: int,
        temperature: float | fem.Constant | None = None,
        friction_share: float | None = None,
        dt: float | fem.Constant = 1.0,
    ):
        self.h = h if callable(h) else given.number("h", h, CONDUCTANCE)
        self.field = given.part_number("field", field, "the temperature")
        self.temperature = temperature if temperature is None else _number("temperature", temperature, given.FINITE)
        self.friction_share = friction_share if friction_share is None else given.number("friction_share", friction_share, SHARE)
        self.dt = _number("dt", dt, given.POSITIVE)

    @property
    def perfect(self) -> bool:
        """Whether temperatures are equal where surfaces touch."""
        return self.h == np.inf

    def without_temperature(self) -> Conductance:
        """The same conductance for a target with its own temperature."""
        other = copy(self)
        other.temperature = None
        return other

    @property
    def parameters(self) -> dict[str, Any]:
        """Its parameters, by name."""
        return dict(vars(self))

    def conductances(self, comm: MPI.Comm, name: str, p: Array, g: Array, closed: Bools) -> Array:
        """Conductances at contactors ``(n,)`` with pressures p and gaps g ``(n,)``, of which some are ``closed`` (collective).

        Raises:
            InputError, UserFunctionError: if the function raises, or does not return n numbers, 0 or positive.
        """
        if not callable(self.h):
            return np.where(closed, self.h, 0.0)
        h = np.array(ask_together(comm, f"contact '{name}': heat, h", self.h, p, g), dtype=float)
        with agreed(comm):
            if (h.ndim and h.shape != p.shape) or not given.NOT_NEGATIVE.holds(h).all():
                raise InputError(
                    f"contact '{name}': heat, h(p, g) has shape {h.shape}: expected {len(p)} numbers, {given.NOT_NEGATIVE.words}"
                )
        return np.broadcast_to(h, p.shape)


def conductances_of(heat: Any) -> tuple[Conductance, ...]:
    """Conductances of a contact, given as one, as a list, or as None.

    Raises:
        InputTypeError: for anything else.
        InputError: for two of one field that both are infinite, or that both include frictional heat.
    """
    some = () if heat is None else (heat,) if hasattr(heat, "conductances") else heat
    fits = isinstance(some, list | tuple) and all(hasattr(one, "conductances") for one in some)
    given.kind("heat", heat, fits, "a Conductance, a list of them, or None")
    for words, wrong in (
        ("h = inf", [one.field for one in some if one.perfect]),
        ("a friction_share", [one.field for one in some if one.friction_share is not None]),
    ):
        twice = sorted({field for field in wrong if wrong.count(field) > 1})
        if twice:
            raise InputError(f"heat: {wrong.count(twice[0])} conductances of field {twice[0]} have {words}: expected one at most")
    return tuple(some)


def one_of_fields(name: str, laws: Sequence[Conductance], field: Any) -> int:
    """A field of a contact's conductances; InputError for any other."""
    fields = sorted({law.field for law in laws})
    if field not in fields:
        expected = f"one of {fields}" if fields else "a contact with heat=..."
        raise InputError(f"contact '{name}': no conductance is of field {given.shown(field)}: expected {expected}")
    return int(field)


def value(number: float | fem.Constant) -> float:
    """The present value of a number or a Constant."""
    return float(number.value) if isinstance(number, fem.Constant) else number


def _number(what: str, number: Any, within: given.Range) -> float | fem.Constant:
    if isinstance(number, fem.Constant):
        given.number(what, number.value, within)
        return number
    return given.number(what, number, within)
