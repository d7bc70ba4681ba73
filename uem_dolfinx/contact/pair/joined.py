"""Many contacts as one interface, with joint placement, active set and equations.

Users access each of the contacts through its ``Member``.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from typing import Any

from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.joined_nodes import JoinedNodes, JoinedSliding
from uem_dolfinx.contact.pair.kinds import PartsOfPair
from uem_dolfinx.contact.pair.member import Member
from uem_dolfinx.contact.seam.state import FACETS, OF_FRICTION, FrictionState, PairState


class JoinedInterface(Interface):
    """Several contacts as one interface (collective).

    Args:
        own: what the interfaces of the contacts are made of, equal except for surfaces, friction values and penetration bounds.

    Attributes:
        members: access to each of the contacts.
    """

    discretisation: JoinedNodes

    def __init__(self, own: Sequence[PartsOfPair]):
        first, nodal = own[0], JoinedNodes([parts.discretisation for parts in own])
        sliding = [parts.friction for parts in own if parts.friction is not None]
        friction = JoinedSliding(sliding, nodal) if sliding else None
        super().__init__(nodal.config, nodal.nodes, nodal, friction, name=first.name, max_penetration=first.max_penetration)
        self._members: list[weakref.ref[Member]] = []

    @property
    def members(self) -> Sequence[Interface]:
        """Members of the contacts."""
        return [one for member in self._members if (one := member()) is not None]

    def make_members(self, own: Sequence[PartsOfPair]) -> list[Member]:
        """Make the members; the caller keeps references to them, and they keep this interface."""
        members = [Member(self, k, parts) for k, parts in enumerate(own)]
        self._members = list(map(weakref.ref, members))
        return members

    def state_of(self, k: int, state: PairState) -> PairState:
        """A contact's part of a state, with its own numbers of facets."""
        numbers, surface = self.discretisation.numbers, self.discretisation.surface_of[k]
        own = self.discretisation.rows_of[k]
        return _each(lambda name, a: numbers.alone(a[own], surface) if name in FACETS else a[own], state)

    def with_state_of(self, k: int, state: PairState, part: PairState) -> PairState:
        """The state with a contact's part."""
        numbers, surface = self.discretisation.numbers, self.discretisation.surface_of[k]
        return _with_rows(state, self.discretisation.rows_of[k], _renumbered(part, lambda facet: numbers.here(facet, surface)))

    def commit(self) -> None:
        """Make the trial state the committed one, except for skipped contacts; call ``project`` afterwards."""
        before, s = self.committed, self.discretisation.setting
        skipped = (s.far | ~s.on)[s.label]
        super().commit()
        if skipped.any():
            self.trial = self.committed = _with_rows(self.committed, skipped, _rows(before, skipped))


def _each(change: Callable[..., Any], *states: PairState) -> PairState:
    """The state whose arrays are made by ``change(name, *arrays)``, of arrays that all ``states`` have."""
    parts: list[Any] = [vars(state) for state in states]
    found = {
        name: change(name, *[part[name] for part in parts])
        for name, value in parts[0].items()
        if name != "friction" and value is not None
    }
    if states[0].friction is not None:
        parts = [vars(state.friction) for state in states]
        found["friction"] = FrictionState(
            **{name: change(OF_FRICTION + name, *[part[name] for part in parts]) for name in parts[0]}
        )
    return PairState(**found)


def _rows(state: PairState, which: Any) -> PairState:
    """The state of some contactors, by a slice or numbers ``(k,)``."""
    return _each(lambda _, a: a[which], state)


def _with_rows(state: PairState, which: Any, other: PairState) -> PairState:
    """The state with some contactors, by a slice, numbers or a mask, replaced by another state of these."""

    def changed(_: str, a: Any, b: Any) -> Any:
        a = a.copy()
        a[which] = b
        return a

    return _each(changed, state, other)


def _renumbered(state: PairState, number: Callable[[Any], Any]) -> PairState:
    """The state with facets renumbered by ``number (...)``."""
    return _each(lambda name, a: number(a) if name in FACETS else a, state)
