"""What a general contact is given: friction by pairs of surfaces, each contactor's by the touched one; and laws that it refuses."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.conductance import Conductance
from uem_dolfinx.contact.laws.law import FrictionLaw, as_law, given_friction, is_read_again, parameters, values_at
from uem_dolfinx.errors import InputError, InputTypeError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.skin import Skin
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.laws.soft import SoftContact

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
        self.others = as_law(given_friction(friction.get(None, 0.0)))  # friction of pairs that are not listed, zero by default
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
        friction: user input by pairs.
        where: function that returns nodes and facets of a part.
        target: a rigid surface; None for the bodies.
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


def refuse_words_of_contact(others: Mapping[str, Any]) -> None:
    """Refuse arguments of a ``Contact`` that a general contact has not, unless they have the value of a contact without them.

    Raises InputTypeError for such an argument, with the remedy, and TypeError for an argument that a ``Contact`` has not, either.
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
    """Whether edges that cross are held apart; InputError or InputTypeError if that does not go with the other arguments."""
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
    """InputError for heat flow through gaps, since only facets within reach are searched (collective)."""
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
