"""Friction laws: protocol, and conversion of user input, which may depend on the temperature of the surfaces in contact.

The tangential force of a sticking contactor is at most the limit. For a slipping contactor it equals the limit, or with a rate law
a function of the slip speed, and opposes slip. A law consists of the limit and its derivatives by the normal force, which rotate
the test rows, and by the speed. ``coulomb``, ``tresca`` and ``stribeck`` are examples, one file each. A user's own law is a class
with the same attributes, passed to ``Contact`` as ``friction``.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from inspect import signature
from typing import Any, Protocol, TypeAlias, TypeGuard, cast

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.contact.laws.coulomb import Coulomb
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import agreed, ask_together, reduced


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


#: A number, or a function of position, called with reference points ``(3, n)``, that returns ``(n,)``. Or a function of position
#: and of load factor or time that returns ``(n,)`` or a number; or a scalar ``fem.Function`` of the displacement's nodes; or an
#: ``OfTemperature``.
Field: TypeAlias = float | Callable[..., npt.ArrayLike]


class FrictionLaw(Protocol):
    """A law of friction."""

    @property
    def field(self) -> Field:
        """Its parameter as a field, 0 where there is no friction."""

    @property
    def per_area(self) -> bool:
        """Whether its limit needs the contactors' areas."""

    def limit(self, value: Array, lam: Array, area: Array) -> tuple[Array, Array]:
        """The largest tangential force, and its derivative by the normal force.

        Args:
            value: of ``field`` at the contactors ``(n,)``.
            lam: normal forces, 0 or positive ``(n,)``.
            area: reference areas of the contactors ``(n,)``; zeros unless ``per_area``.

        Returns:
            A force and a number for each contactor ``(n,)``.
        """


class RateLaw(FrictionLaw, Protocol):
    """A friction law in which the force while slipping differs from the limit of sticking."""

    @property
    def timed(self) -> bool:
        """Whether the law depends on the slip speed, which statics does not have."""

    def sliding(self, value: Array, lam: Array, area: Array, speed: Array) -> tuple[Array, Array, Array]:
        """Tangential force of slipping contactors, and its derivatives by the normal force and by the speed.

        Args:
            value: see ``limit``.
            lam: see ``limit``.
            area: see ``limit``.
            speed: of slip, 0 or positive ``(n,)``; zeros unless ``timed``.

        Returns:
            A force, a number and a force per speed for each contactor ``(n,)``.
        """


def slides_otherwise(law: FrictionLaw) -> TypeGuard[RateLaw]:
    """Whether the force while slipping differs from the limit of sticking."""
    return hasattr(law, "sliding")


def of_rate(law: FrictionLaw) -> bool:
    """Whether the law depends on the slip speed."""
    return slides_otherwise(law) and law.timed


def is_of_users(law: FrictionLaw) -> bool:
    """Whether a law is a class of users, whose methods may return anything."""
    return not type(law).__module__.startswith(given.PACKAGE)


def as_law(friction: Any) -> FrictionLaw:
    """The friction law of user input: Coulomb's law for a number or a function; refuse other types."""
    if hasattr(friction, "limit"):
        given.kind("friction", friction, True, "a number, a function or a law")
        return cast(FrictionLaw, friction)
    return Coulomb(given_field("friction", friction, given.NOT_NEGATIVE))


def given_friction(friction: Any) -> Field | FrictionLaw:
    """Checked user input for friction: a number, a function or a law with all that ``FrictionLaw`` and ``RateLaw`` have."""
    law = as_law(friction)
    for what in ("field", "per_area", *(("timed",) if slides_otherwise(law) else ())):
        expected = f"a law with {what}, and limit(value, lam, area)"
        given.kind("friction", friction, hasattr(law, what), expected, f"give the class an attribute {what}, see FrictionLaw")
    given_field("friction", law.field, given.NOT_NEGATIVE)
    return law if hasattr(friction, "limit") else law.field


def given_normal(normal: Any, friction: Any, wear: Any, heats: Sequence[Any], tied: Any) -> Any:
    """Checked user input for the normal contact: a ``SoftContact``, or None for hard contact.

    Raises InputTypeError for another type, and InputError for a soft contact with friction, wear, perfect conductance, heat of
    currents, or a tie.
    """
    given.kind("normal", normal, normal is None or hasattr(normal, "pressures"), "a SoftContact, or None for hard contact")
    slides = isinstance(friction, dict) or as_law(friction).field != 0.0
    others = (
        ("friction", slides),
        ("wear", callable(wear) or wear),
        ("heat with h = inf", any(one.perfect for one in heats)),
        ("heat with joule", any(one.joule is not None for one in heats)),
        ("tied", tied),
    )
    for what, there in others:
        if normal is not None and there:
            raise InputError(
                f"{what} does not go with normal = {normal!r}, whose contactors are not constrained to the target: leave it out"
            )
    return normal


def given_cohesion(cohesion: Any, sliding: str, normal: Any, friction: Any, wear: Any, heats: Sequence[Any], tied: Any) -> Any:
    """Checked user input for the cohesion of a contact: a ``Cohesive``, or None.

    Raises:
        InputTypeError: for another type.
        InputError: for cohesion with a soft contact, friction by temperature, wear, heat or a tie; adhesion with friction; plastic
            unloading with ``sliding = "finite"``, as permanent openings do not turn with the bodies.
    """
    given.kind("cohesion", cohesion, cohesion is None or hasattr(cohesion, "bonds"), "a Cohesive, an Adhesion, or None")
    hot = isinstance(as_law(friction).field, OfTemperature)
    others = (
        ("normal", normal),
        ("friction by temperature", hot),
        ("wear", callable(wear) or wear),
        ("heat", heats),
        ("tied", tied),
    )
    for what, there in others:
        if cohesion is not None and there:
            raise InputError(f"{what} does not go with cohesion: leave it out")
    if cohesion is not None and not cohesion.bonds and (isinstance(friction, dict) or as_law(friction).field != 0.0):
        raise InputError(f"friction does not go with cohesion = {cohesion!r}: leave it out")
    if getattr(cohesion, "unloading", None) == "plastic" and sliding == "finite":
        raise InputError("unloading = 'plastic' does not go with sliding = 'finite': take 'small' or 'fixed'")
    return cohesion


def given_leak(leak: Any, normal: Any, cohesion: Any, tied: Any) -> Any:
    """Checked user input for the fluid of a contact: a ``Leak``, or None.

    Raises InputTypeError for another type, and InputError for a fluid with a soft contact, cohesion or a tie.
    """
    given.kind("leak", leak, leak is None or hasattr(leak, "inlet"), "a Leak, or None")
    for what, there in (("normal", normal), ("cohesion", cohesion), ("tied", tied)):
        if leak is not None and there:
            raise InputError(f"{what} does not go with leak: leave it out")
    return leak


def given_joint(
    cohesion: Any, leak: Any, sliding: str, normal: Any, friction: Any, wear: Any, heats: Sequence[Any], tied: Any, offset: Any
) -> tuple[Any, Any]:
    """Checked user input for what is between the surfaces: cohesion and a fluid; see ``given_cohesion``, ``given_leak``, ``check_tied``."""
    check_tied(tied, offset, wear, friction)
    return given_cohesion(cohesion, sliding, normal, friction, wear, heats, tied), given_leak(leak, normal, cohesion, tied)


def given_together(contact: Any, friction: Any, offset: Any) -> tuple[Any, Any]:
    """Friction and offset that a contact is given later, checked with what it was made with as if they had been given then."""
    given_normal(contact.normal, friction, contact._wear, contact.heats, contact.tied)
    cohesion, leak, of = contact.cohesion, contact.leak, (contact.sliding, contact.normal)
    given_joint(cohesion, leak, *of, friction, contact._wear, contact.heats, contact.tied, offset)
    return friction, offset


def check_tied(tied: Any, offset: Any, wear: Any, friction: Any) -> None:
    """Refuse what does not go with ``tied = True``; InputError for an offset, wear or friction."""
    if tied is not True:
        return
    if offset != 0.0:
        raise InputError("offset does not go with tied = True, which keeps the gaps that there are: leave one of them out")
    for what, there in (("wear", wear != 0.0), ("friction", as_law(friction).field != 0.0)):
        if there:
            raise InputError(f"{what} does not go with tied = True, which never slips: leave it out, or take tied = 'after'")


def given_field(what: str, value: Any, within: given.Range = given.FINITE) -> Field:
    """Checked user input: a number of a range, a function of position or a Function."""
    return cast(Field, value) if isinstance(value, fem.Function) or given.function(value) else given.number(what, value, within)


def parameters(law: FrictionLaw) -> list[Any]:
    """The arguments of a law, ``field`` first, without arguments that are None."""
    others = [value for name, value in getattr(law, "__dict__", {}).items() if name != "field" and value is not None]
    return [law.field, *others]


def is_of_position(field: Field) -> bool:
    """Whether a field is a function of position, whose values at nodes change where these are moved; a Function moves with its nodes."""
    return callable(field) and not isinstance(field, fem.Function)


def is_read_again(law: FrictionLaw) -> bool:
    """Whether the law's parameter is read at every step: it follows the load, or is a Function, whose values may have changed."""
    return isinstance(law.field, fem.Function) or follows_load(law)


def follows_load(law: FrictionLaw) -> bool:
    """Whether the law's parameter is a function of position and load factor or time, or also of temperature."""
    if not callable(law.field) or isinstance(law.field, OfTemperature):
        return callable(law.field)
    try:
        arguments = signature(law.field).parameters.values()
    except (TypeError, ValueError):
        # a C function without signature
        return False
    required = [a for a in arguments if a.default is a.empty and a.kind in (a.POSITIONAL_ONLY, a.POSITIONAL_OR_KEYWORD)]
    return len(required) == 2


def values_at(
    law: FrictionLaw, config: Configuration, nodes: Indices, name: str, areas: bool, at: float, T: Array | None = None
) -> Array | None:
    """Parameter of a law at contactors ``nodes (n,)`` of a contact: ``(n,)`` (collective).

    Args:
        law: of friction.
        config: configuration of the displacement.
        nodes: contactors ``(n,)``.
        name: of the contact.
        areas: whether the contactors have areas.
        at: load factor or time.
        T: temperatures at the contactors ``(n,)``, for a law that depends on them.

    Returns:
        The values; None if all are zero and constant.

    Raises:
        InputError, UserFunctionError: if the law needs areas and the contactors have none, or if a function is invalid.
    """
    if law.per_area and not areas:
        raise InputError(f"contact '{name}': {type(law).__name__} needs areas, and points have none: give facets")
    if getattr(law, "per_point", False) and areas:
        raise InputError(
            f"contact '{name}': a limit of the force on each contactor depends on the mesh where contactors are nodes of facets: give a "
            "limit of the stress, or points"
        )
    n = len(nodes)
    if not callable(law.field):
        return np.full(n, law.field) if law.field > 0 else None
    words, more = f"contact '{name}': friction", ((at,) if T is None else (at, T)) if follows_load(law) else ()
    value = evaluated_at(config, nodes, words, law.field, given.NOT_NEGATIVE, *more)
    return value if more or isinstance(law.field, fem.Function) or reduced(config.comm, int((value > 0).any())) else None


def evaluated_at(
    config: Configuration, nodes: Indices, words: str, f: Callable[..., npt.ArrayLike], within: given.Range, *more: Any
) -> Array:
    """Values of a field, named by ``words``, at ``nodes (n,)``: ``(n,)`` (collective).

    Args:
        config: configuration of the displacement.
        nodes: owned nodes ``(n,)``.
        words: for messages.
        f: a Function, or a function of position, which is given the reference positions.
        within: allowed values.
        more: further arguments, load factor or time, and temperatures ``(n,)``; the function may then return one number.

    Raises:
        InputError, UserFunctionError: if it does not return n numbers in the range, or raises; for a Function of other nodes.
    """
    if isinstance(f, fem.Function):
        with agreed(config.comm):
            entries = config.entries_in(f.function_space)
            expected = "a scalar Function with the displacement's nodes, of its degree and on its mesh"
            given.kind(words, f, entries is not None, expected)
            assert entries is not None
            value = np.array(f.x.array[entries[nodes]])
            if not within.holds(value).all():
                raise InputError(f"{words}, the Function '{f.name}', has values that are not {within.words.replace('a ', '')}")
        return value
    n = len(nodes)
    places = np.zeros((3, n))
    places[: config.gdim] = config.X[nodes].T
    found = ask_together(config.comm, words, f, places, *more)
    with agreed(config.comm):
        value = given.returned(f"{words}(x)", found, f"{n} numbers")
    if more and value.ndim == 0:
        value = np.full(n, value)
    with agreed(config.comm):
        if value.shape != (n,) or not within.holds(value).all():
            called = f"{words}({', '.join(['x', *('T' if np.ndim(one) else f'{one:.6g}' for one in more)])})"
            wrong = given.fault(value, (n,), within, places[: config.gdim])
            raise InputError(f"{called} {wrong}: expected {n} numbers, each {within.words}")
    return value
