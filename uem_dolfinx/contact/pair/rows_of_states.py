"""States of some of the contactors of an interface: taken out of a state of all, put back, and put together."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from uem_dolfinx.contact.seam.state import FACETS, OF_FRICTION, FrictionState, PairState


def each(change: Callable[..., Any], *states: PairState) -> PairState:
    """The state whose arrays are made by ``change(name, *arrays)``, of arrays that all ``states`` have."""
    first = states[0]
    found = {
        f.name: change(f.name, *(getattr(s, f.name) for s in states))
        for f in fields(PairState)
        if f.name != "friction" and getattr(first, f.name) is not None
    }
    if first.friction is not None:
        of = [s.friction for s in states]
        found["friction"] = FrictionState(
            **{f.name: change(OF_FRICTION + f.name, *(getattr(o, f.name) for o in of)) for f in fields(FrictionState)}
        )
    return PairState(**found)


def rows(state: PairState, which: Any) -> PairState:
    """The state of some contactors, by a slice or numbers ``(k,)``."""
    return each(lambda _, a: a[which], state)


def with_rows(state: PairState, which: Any, other: PairState) -> PairState:
    """The state with some contactors, by a slice, numbers or a mask, replaced by another state of these."""

    def changed(_: str, a: Any, b: Any) -> Any:
        a = a.copy()
        a[which] = b
        return a

    return each(changed, state, other)


def joined(states: Sequence[PairState]) -> PairState:
    """The concatenation of several states."""
    return each(lambda _, *a: np.concatenate(a), *states)


def renumbered(state: PairState, number: Callable[[Any], Any]) -> PairState:
    """The state with facets renumbered by ``number (...)``."""
    return each(lambda name, a: number(a) if name in FACETS else a, state)
