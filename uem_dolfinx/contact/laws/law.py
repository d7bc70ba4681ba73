"""What a law of friction says, and how a law in one file is handed to a contact.

A contactor that sticks bears any force along the target up to a limit; one that slips bears the limit against its way. The law is this
limit and its derivative with the force along the normal, from which test rows are rotated. ``coulomb`` and ``tresca`` are examples of a
file each: a law of the user's own is a class with the same attributes, and is given to ``Contact`` as ``friction``.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Protocol, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.contact.laws.coulomb import Coulomb
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import agreed, ask_together, reduced

#: A number, or a function of place that is given reference points ``(3, n)`` and returns ``(n,)``.
Field: TypeAlias = float | Callable[[Array], npt.ArrayLike]


class FrictionLaw(Protocol):
    """A law of friction."""

    @property
    def field(self) -> Field:
        """Its one parameter by place, 0 where there is no friction."""

    @property
    def per_area(self) -> bool:
        """Whether its limit needs the contactors' areas."""

    def limit(self, value: Array, lam: Array, area: Array) -> tuple[Array, Array]:
        """The largest force along the target, and its derivative with the force along the normal.

        Args:
            value: of ``field`` at the contactors ``(n,)``.
            lam: forces along the normal, 0 or positive ``(n,)``.
            area: of the reference surface that these are integrals over ``(n,)``; zeros unless ``per_area``.

        Returns:
            A force and a number for each contactor ``(n,)``.
        """


def as_law(friction: Any) -> FrictionLaw:
    """The law that a contact was given: Coulomb's where it is a number or a function; refuse all else."""
    if hasattr(friction, "limit"):
        return cast(FrictionLaw, friction)
    return Coulomb(friction if callable(friction) else given.number("friction", friction, given.NOT_NEGATIVE))


def given_friction(friction: Any) -> Field | FrictionLaw:
    """Friction that was given, a number, a function or a law; refuse all else."""
    law = as_law(friction)
    if not callable(law.field):
        given.number("friction", law.field, given.NOT_NEGATIVE)
    return law if hasattr(friction, "limit") else law.field


def given_field(what: str, value: Any) -> Field:
    """A number or a function of place that was given; refuse all else."""
    return cast(Field, value) if callable(value) else given.number(what, value)


def parameters(law: FrictionLaw) -> list[Any]:
    """What a law was made with, ``field`` first; what was left out aside."""
    others = [value for name, value in getattr(law, "__dict__", {}).items() if name != "field" and value is not None]
    return [law.field, *others]


def values_at(law: FrictionLaw, config: Configuration, nodes: Indices, name: str, areas: bool) -> Array | None:
    """Parameters of a law at contactors ``nodes (n,)`` of the contact of this name ``(n,)``; None if all are zero (collective).

    Raises:
        InputError, UserFunctionError: if the law needs areas and the contactors have none, or if a function of place is no good.
    """
    if law.per_area and not areas:
        raise InputError(f"contact '{name}': {type(law).__name__} needs areas, and points have none: give facets")
    if not callable(law.field):
        return np.full(len(nodes), law.field) if law.field > 0 else None
    value = asked_at(config, nodes, f"contact '{name}': friction", law.field, given.NOT_NEGATIVE)
    return value if reduced(config.comm, int((value > 0).any())) else None


def asked_at(
    config: Configuration, nodes: Indices, words: str, f: Callable[[Array], npt.ArrayLike], within: given.Range
) -> Array:
    """What a function of place, which ``words`` name, returns at the reference places of ``nodes (n,)``: ``(n,)`` (collective).

    Raises:
        InputError, UserFunctionError: if it returns anything else than so many numbers of the range, or raises.
    """
    places = np.zeros((3, len(nodes)))
    places[: config.gdim] = config.X[nodes].T
    value = np.array(ask_together(config.comm, words, f, places), dtype=float)
    with agreed(config.comm):
        if value.shape != (len(nodes),) or not within.holds(value).all():
            raise InputError(
                f"{words}(x) has shape {value.shape}: expected {len(nodes)} numbers, {within.words.replace('a ', '')}"
            )
    return value
