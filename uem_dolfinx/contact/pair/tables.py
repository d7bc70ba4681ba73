"""Contactors of an interface by their contacts: numbers, names, and the rows of one contact; and how they slide."""

from __future__ import annotations

from itertools import takewhile
from typing import TYPE_CHECKING

import numpy as np

from uem_dolfinx.arrays import Bools, Ints

if TYPE_CHECKING:
    from uem_dolfinx.contact.pair.interface import Interface


def table_of(pair: Interface) -> tuple[Interface, slice]:
    """The interface in use that contains the contactors of a contact's, and their rows in it."""
    whole = pair.whole
    first = sum(len(one.nodes) for one in takewhile(lambda one: one is not pair, whole.members))
    return whole, slice(first, first + len(pair.nodes))


def label_of(pair: Interface) -> Ints:
    """Number of the contact of each contactor ``(n,)``."""
    return pair.discretisation.setting.label


def contacts_with(pair: Interface, which: Bools) -> Bools:
    """Contacts that have some of these contactors ``(n,)`` on this rank ``(n_contacts,)``."""
    return np.asarray(np.bincount(label_of(pair)[which], minlength=len(pair.members)) > 0)


def name_at(pair: Interface, i: int) -> str:
    """Name of the contact of a contactor."""
    return str(pair.members[label_of(pair)[i]].name)


def slides(pair: Interface) -> bool:
    """Whether sliding is finite, so that contactors find their closest points at every placement."""
    return pair.discretisation.traits.sliding == "finite"
