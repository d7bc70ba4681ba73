"""What a general contact is given and cannot take: laws that act beyond its search, and edges where crossings have no equations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from inspect import signature
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.conductance import Conductance
from uem_dolfinx.contact.laws.law import FrictionLaw
from uem_dolfinx.errors import InputError, InputTypeError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.skin import Skin
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.laws.soft import SoftContact


def refuse_words_of_contact(others: Mapping[str, Any]) -> None:
    """Refuse arguments of a ``Contact`` that a general contact has not, unless they have the value of a contact without them.

    Raises:
        InputTypeError: for such an argument, with the remedy.
        TypeError: for an argument that a ``Contact`` has not, either.
    """
    known = signature(Contact).parameters
    for word, value in others.items():
        if word not in known or word in ("contactor", "target"):
            raise TypeError(f"GeneralContact.__init__() got an unexpected keyword argument '{word}'")
        usual = known[word].default
        if value is not usual and not (np.ndim(value) == 0 and value == usual):
            raise InputTypeError(
                f"{word} = {given.shown(value)} is for single contacts: declare a Contact of the two surfaces with it, and the general "
                "contact leaves them to it"
            )


def given_edges(edges: bool | None, normal: SoftContact | None, heats: Sequence[Conductance], law: FrictionLaw) -> bool:
    """Whether edges that cross are held apart.

    Raises:
        InputError, InputTypeError: if that does not go with the other arguments, or for another value.
    """
    others: dict[str, Any] = {"normal": normal}
    others |= {"heat": heats or None, "friction": law if law.per_area else None}
    wrong = {word: value for word, value in others.items() if value is not None}
    if edges is None:
        return not wrong
    if given.flag("edges", edges) and wrong:
        word, value = next(iter(wrong.items()))
        raise InputError(f"edges = True does not go with {word} = {value!r}, since crossings of edges have no area: leave it out")
    return edges


def refuse_open_conductance(config: Configuration, name: str, heats: Sequence[Conductance], bound: float) -> None:
    """Raise InputError for heat flow through gaps, since only facets within reach are searched (collective).

    Args:
        config: configuration of the displacement.
        name: of the general contact.
        heats: conductances.
        bound: on the initial penetration, a length.
    """
    gaps, some = bound * np.array([1.0, 1e-2, 1e-4]), np.array([1.0, 1e2, 1e4])
    for law in heats:
        state = (np.zeros(3), gaps, some, 0.5 * some)[: 4 if law.of_temperatures else 2]
        open_ = law.conductances(config.comm, name, state, np.zeros(3, bool))
        if open_.any():
            raise InputError(
                f"{name}: heat, h(0, g) is {open_.max():.6g} at gaps g: a general contact conducts where surfaces touch alone: "
                "expected 0 for g > 0, or a Contact between the two surfaces that conduct through their gap"
            )


def refuse_distant_pressures(config: Configuration, name: str, normal: SoftContact | None, skin: Skin) -> None:
    """Raise InputError for pressures at gaps beyond the reach of the search, half a facet (collective)."""
    if normal is not None:
        from uem_dolfinx.geometry.neighbours import AHEAD_AT_REST

        smallest = float(np.min(skin.size, where=skin.size > 0, initial=np.inf))
        far = AHEAD_AT_REST * reduced(config.comm, smallest, op=MPI.MIN)
        p = normal.pressures(config.comm, name, np.array([far]), far)[0]
        if p[0] > 0.0:
            raise InputError(f"{name}: normal, p is {p[0]:.6g} at a gap of half a facet, {far:.6g}: expected 0 from there on")
