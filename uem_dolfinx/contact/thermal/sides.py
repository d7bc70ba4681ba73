"""Means of a field over both sides of a contact, for the current placement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from uem_dolfinx.arrays import Array, Indices, Ints
from uem_dolfinx.contact.laws.soft import value
from uem_dolfinx.contact.seam.placement import Kinematics
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.fields import ConfigurationAmongFields, nodal_field
from uem_dolfinx.geometry.nodes import Halo
from uem_dolfinx.geometry.projection import Projection


class Placed(Protocol):
    """Members of an interface that are needed here."""

    config: Configuration
    kinematics: Kinematics


@dataclass(frozen=True)
class Sides:
    """Both sides of contactors at one placement."""

    projection: Projection
    halo: Halo  # of the nodes in all terms
    node: Ints  # global node of each term ``(k,)``
    row: Ints  # index of the contactor of each term ``(k,)``
    own: Array  # weights of the contactor's mean, zero in terms of the target ``(k,)``
    theirs: Array  # weights of the target's mean ``(k,)``

    def sum(self, terms: Array) -> Array:
        """Sum of each contactor's terms ``(k,)``: ``(n,)``."""
        return np.asarray(np.bincount(self.row, terms, minlength=len(self.projection.gap)), dtype=float)

    def means(self, weights: Array, nodal: Array) -> Array:
        """Means of values at owned nodes ``(n_owned,)``, with the terms' weights: ``(n,)`` (collective)."""
        return self.sum(weights * self.halo.take(nodal[:, None].__getitem__)[:, 0])

    def hand_on(self, weights: Array, amounts: Array) -> Array:
        """Transpose of ``means``: distribute amounts of contactors ``(n,)`` to owned nodes ``(n_owned,)`` (collective)."""
        return np.asarray(self.halo.add((weights * amounts[self.row])[:, None])[:, 0])


def sides_of(pair: Placed) -> Sides:
    """Both sides of contactors in their current placement (collective)."""
    k = pair.kinematics
    (row, node, weight), (their_row, their_node, their_weight) = k.means()
    none, others, every = np.zeros(len(row)), np.zeros(len(their_row)), np.concatenate([node, their_node])
    return Sides(
        k.projection,
        Halo(pair.config, every),
        every,
        np.concatenate([row, their_row]),
        np.concatenate([weight, others]),
        np.concatenate([none, their_weight]),
    )


def mean_temperatures(config: Configuration, nodes: Indices, field: int, name: str, pair: Any, heats: Any) -> Array:
    """Mean of the temperatures of contactors and of the opposite surface ``(n,)`` (collective).

    Args:
        config: of a displacement among other fields.
        nodes: contactors ``(n,)``.
        field: number of the part that is the temperature.
        name: of the contact.
        pair: interface; before the first placement, or for None, only the contactors' temperatures count.
        heats: conductances; one of this field may contain a rigid target's temperature.

    Raises:
        InputError, SpaceError: if there is no such temperature.
    """
    words = f"contact '{name}': friction"
    if not isinstance(config, ConfigurationAmongFields):
        raise InputError(
            f"{words} follows a temperature, and there is none among the unknowns: expected a mixed Function with displacement= its "
            "displacement's part"
        )
    T = nodal_field(config, field, words).values
    if not hasattr(pair, "kinematics"):
        return np.asarray(T[nodes])
    at = sides_of(pair)
    both = at.own + at.theirs
    # contactors on rigid surfaces, and without a body nearby, have no opposite nodes
    mean = at.means(both, T) / at.sum(both)
    known = [value(one.temperature) for one in heats if one.field == field and one.temperature is not None]
    return np.asarray(0.5 * (mean + known[0]) if known else mean)
