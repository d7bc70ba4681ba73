"""Friction of a general contact by pairs of surfaces: each contactor's value depends on the touched surface."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.laws.law import FrictionLaw, as_law, given_friction, is_read_again, parameters, values_at
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.skin import Skin

#: Local nodes and this rank's facets of a part.
Place = tuple[Bools, Bools]


class FrictionOfPairs:
    """User input of friction by pairs: one law, with a value for each pair and one for all others.

    Args:
        friction: ``{(one, other): value, ..., None: value of all others}``; names of bodies, parts, and one of each pair may be a rigid
            surface.

    Raises:
        InputError, InputTypeError: for a key that is not a pair, invalid values, or values of different laws.
    """

    def __init__(self, friction: dict[Any, Any]):
        #: Friction of pairs that are not listed, zero by default.
        self.others = as_law(given_friction(friction.get(None, 0.0)))
        self.pairs = [(*self._pair(key), as_law(given_friction(value))) for key, value in friction.items() if key is not None]
        laws = [law for *_, law in self.pairs] + [self.others] * (None in friction)
        self.law = (laws or [self.others])[0]
        expected = (
            f"values for one law, as {type(self.law).__name__}, that differ in its first parameter alone, numbers or functions "
            "of position"
        )
        for law in laws:
            alike = type(law) is type(self.law) and parameters(law)[1:] == parameters(self.law)[1:]
            given.kind("friction by pairs", law, alike and not is_read_again(law), expected)

    @staticmethod
    def _pair(key: Any) -> tuple[Any, Any]:
        if not (isinstance(key, tuple) and len(key) == 2) or all(hasattr(one, "project") for one in key):
            expected = (
                "a pair (one, other) of bodies' names or parts, one of which may be a rigid surface, or None for all others"
            )
            raise InputError(given.sentence("a key of friction", key, expected))
        # a rigid surface comes last
        return (key[1], key[0]) if hasattr(key[0], "project") else key

    def against(self, target: Any) -> list[tuple[Any, Any, FrictionLaw]]:
        """The pairs with this rigid surface; for None, the pairs without rigid surface."""
        return [p for p in self.pairs if (p[1] is target if target is not None else not hasattr(p[1], "project"))]


class ValuesOfPairs:
    """Values of the law's parameter at the contactors of one contact, by the touched surface (collective).

    Args:
        skin: surfaces of the bodies.
        friction: user input by pairs.
        where: function that returns nodes and facets of a part.
        target: a rigid surface; None for the bodies.
        name: of the contact.
    """

    def __init__(self, skin: Skin, friction: FrictionOfPairs, where: Callable[[Any], Place], target: Any, name: str):
        self.config, self.skin, self.law, self._others, self._name = skin.config, skin, friction.law, friction.others, name
        self._laws = [law for *_, law in friction.against(target)]
        firsts = [where(one) for one, _, _ in friction.against(target)]
        seconds = [where(other) for _, other, _ in friction.against(target)] if target is None else []
        none = np.zeros((self.config.n_local, 0), bool), np.zeros((len(skin.dofs), 0), bool)
        #: Nodes of each pair's first part, then of its second ``(n_local, 2 k)``, and facets of the opposite parts ``(m, 2 k)``;
        #: for a rigid surface only the first.
        self._nodes = np.column_stack([none[0], *(nodes for nodes, _ in (*firsts, *seconds))])
        self._facets = np.column_stack([none[1], *(facets for _, facets in (*seconds, *firsts))])
        self._rigid = target is not None

    def at(self, nodes: Indices) -> Array:
        """Values of each pair, and in the last column of all others, at the contactors ``(n, k + 1)``; stored for ``now`` (collective)."""
        columns = []
        for law in (*self._laws, self._others):
            value = values_at(law, self.config, nodes, self._name, True, 0.0)
            columns.append(np.zeros(len(nodes)) if value is None else value)
        self.values, self._own = np.column_stack(columns), self._nodes[nodes]
        return self.values

    def now(self, facet: Ints) -> Array:
        """Values ``(n,)`` of contactors on facets with these global numbers ``(n,)``, -1 for no facet (collective)."""
        k, meets = len(self._laws), self._own
        if not self._rigid:
            both = meets & (self.skin.values_at(facet, self._facets.astype(np.int64)) > 0)
            meets = both[:, :k] | both[:, k:]
        value = self.values[:, -1].copy()
        # the first matching pair is used
        for j in reversed(range(k)):
            value[meets[:, j]] = self.values[meets[:, j], j]
        return value
