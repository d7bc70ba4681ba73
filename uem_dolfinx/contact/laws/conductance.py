"""User input of thermal contact conductance: power per area and temperature difference."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from inspect import signature
from typing import Any, TypeAlias

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.errors import InputError
from uem_dolfinx.parallel import agreed, ask_together

#: A number, or a function of pressures and gaps, or of these and both temperatures, ``(n,)`` each, that returns conductances ``(n,)``.
OfState: TypeAlias = float | Callable[..., npt.ArrayLike]

CONDUCTANCE = given.Range("0 or a positive number, infinity, or a function of pressures and gaps", lambda x: x >= 0)
PART = given.Range("a number from 0 to 1", lambda x: (x >= 0) & (x <= 1))
SHARE = given.Range(f"{PART.words}, or None for no heat of friction", PART.holds)


class Conductance(given.Sealed):
    """Heat through a contact: the power ``h (T - T_target)`` per area leaves the contactor and enters the target.

    Args:
        h: conductance, a power per area and temperature difference. A number applies where surfaces touch, and open gaps conduct no
            heat; infinity makes temperatures equal where surfaces touch. A function ``h(p, g)`` is called with the contact
            pressures and gaps of all contactors, ``(n,)`` each, both 0 or positive and one of them 0, and returns ``(n,)`` numbers. In
            a soft contact it gets both at once, gaps negative where surfaces overlap, and a number applies under pressure.
            A function ``h(p, g, T, T_target)`` of four arguments also gets the temperatures of both sides, ``(n,)`` each.
        field: number of the part of the mixed space that is the temperature, scalar Lagrange of the displacement's degree or less.
        temperature: of a rigid target, a number or a Constant; None for a meshed target, which has its own.
        friction_share: part of the frictional heat that enters the contactor; the rest enters the target. None ignores frictional heat.
        dt: duration of a step, a number or the Constant in the residual, to convert frictional work of a step to power. In time steps
            another duration is refused; shortened steps have their own, see ``load``.
        of_field: number of the part whose values ``h`` gets as T and T_target; None is ``field``. An electric conductance may so
            depend on the temperature.
        joule: number of the part that is an electric potential. The power of its current through this contact becomes heat; the
            contact has a conductance of that part, too. None is no such heat.
        joule_share: part of this heat that enters the contactor; the rest enters the target.

    Raises:
        InputError, InputTypeError: for a value out of its range.
    """

    def __init__(
        self,
        h: OfState,
        *,
        field: int,
        temperature: float | fem.Constant | None = None,
        friction_share: float | None = None,
        dt: float | fem.Constant = 1.0,
        of_field: int | None = None,
        joule: int | None = None,
        joule_share: float = 0.5,
    ):
        from uem_dolfinx.contact.laws.soft import checked

        self.h = h if given.function(h) else given.number("h", h, CONDUCTANCE)
        self.field = given.part_number("field", field, "the temperature")
        self.temperature = temperature if temperature is None else checked("temperature", temperature, given.FINITE)
        self.friction_share = friction_share if friction_share is None else given.number("friction_share", friction_share, SHARE)
        self.dt = checked("dt", dt, given.POSITIVE)
        self.joule = None if joule is None else given.part_number("joule", joule, "the electric potential")
        self.joule_share = given.number("joule_share", joule_share, PART)
        self.of_field = None if of_field is None else given.part_number("of_field", of_field, "what h is a function of")
        if self.joule == self.field:
            raise InputError(f"joule = {joule} is the heated field itself: expected the number of the electric potential's part")
        if of_field is not None and not self.of_temperatures:
            raise InputError("of_field is of no use, since h is no function h(p, g, T, T_target): leave it out")

    @property
    def of_temperatures(self) -> bool:
        """Whether h is a function of four arguments, pressures, gaps and both temperatures."""
        return callable(self.h) and _n_needed(self.h) == 4

    @property
    def field_of_h(self) -> int:
        """Number of the part whose values h gets."""
        return self.field if self.of_field is None else self.of_field

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

    def conductances(self, comm: MPI.Comm, name: str, state: tuple[Array, ...], closed: Bools) -> Array:
        """Conductances at contactors ``(n,)``, of which some are ``closed`` (collective).

        Args:
            comm: of the contact.
            name: of the contact.
            state: pressures and gaps ``(n,)``, and the temperatures of both sides if h is a function of these.
            closed: contactors that are united with the target ``(n,)``.

        Raises:
            InputError, UserFunctionError: if the function raises, or does not return n numbers, 0 or positive.
        """
        if not callable(self.h):
            return np.where(closed, self.h, 0.0)
        values, n = ask_together(comm, f"contact '{name}': heat, h", self.h, *state), len(closed)
        words = f"contact '{name}': heat, {'h(p, g, T, T_target)' if len(state) == 4 else 'h(p, g)'}"
        expected = f"{n} numbers, {given.NOT_NEGATIVE.words}"
        with agreed(comm):
            h = given.returned(words, values, expected)
            if (h.ndim and h.shape != (n,)) or not given.NOT_NEGATIVE.holds(h).all():
                found = given.fault(h if h.ndim else np.full(n, h), (n,), given.NOT_NEGATIVE)
                raise InputError(f"{words} {found}: expected {expected}")
        return np.broadcast_to(h, (n,))


def conductances_of(heat: Any) -> tuple[Conductance, ...]:
    """Conductances of a contact, given as one, as a list, or as None.

    Raises InputTypeError for anything else, and InputError for two of one field that both are infinite, or that both include the
    same heat of friction or of a current.
    """
    some = () if heat is None else (heat,) if hasattr(heat, "conductances") else heat
    fits = isinstance(some, list | tuple) and all(hasattr(one, "conductances") for one in some)
    given.kind("heat", heat, fits, "a Conductance, a list of them, or None")
    for words, wrong in (
        ("h = inf", [one.field for one in some if one.perfect]),
        ("joule", [one.field for one in some if one.joule is not None]),
        ("a friction_share", [one.field for one in some if one.friction_share is not None]),
    ):
        twice = sorted({field for field in wrong if wrong.count(field) > 1})
        if twice:
            raise InputError(f"heat: {wrong.count(twice[0])} conductances of field {twice[0]} have {words}: expected one at most")
    for one in some:
        if one.joule is not None and all(other.field != one.joule for other in some):
            raise InputError(
                f"heat: joule = {one.joule}, and the contact has no conductance of that field: add Conductance(..., field={one.joule})"
            )
    return tuple(some)


def one_of_fields(name: str, laws: Sequence[Conductance], field: Any) -> int:
    """A field of a contact's conductances; InputError for any other."""
    fields = sorted({law.field for law in laws})
    if field not in fields:
        expected = f"one of {fields}" if fields else "a contact with heat=..."
        raise InputError(f"contact '{name}': no conductance is of field {given.shown(field)}: expected {expected}")
    return int(field)


def _n_needed(h: Callable[..., Any]) -> int:
    """Number of arguments without default; 2 for functions that do not say."""
    try:
        known = signature(h).parameters.values()
    except (TypeError, ValueError):
        return 2
    return sum(one.default is one.empty and one.kind in (one.POSITIONAL_ONLY, one.POSITIONAL_OR_KEYWORD) for one in known)
