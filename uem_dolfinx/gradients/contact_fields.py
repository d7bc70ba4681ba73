"""Derivatives by Functions that are the friction or the offset of contacts, each with one value at a contactor."""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx import fem

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.law import as_law
from uem_dolfinx.contact.nodes.bernstein import Bernstein
from uem_dolfinx.contact.pair.tables import table_of
from uem_dolfinx.errors import InputError
from uem_dolfinx.gradients.parameters import contactors_of, keeps_distance, rubbed, rubbed_along, thickened
from uem_dolfinx.solve.problem import UnitedProblem


def fields_of(problem: UnitedProblem) -> list[Any]:
    """Functions that are the friction or the offset of contacts."""
    return [f for c in problem.contacts for f in (as_law(c.friction).field, c.offset) if isinstance(f, fem.Function)]


def check_field(problem: UnitedProblem, what: str, m: fem.Function) -> None:
    """Refuse a Function of contacts by which there are no derivatives (to be agreed on).

    Raises:
        InputError: names the contact.
    """
    for contact in problem.contacts:
        called, pair = f"{what}, '{m.name}', of contact '{contact.name}'", contact.pair
        rubs, thickens = as_law(contact.friction).field is m, contact.offset is m
        if (rubs or thickens) and contact.further_parts_touch():
            raise InputError(f"{called}: its target's corners or edges touch: expected corners=False, edges=False")
        if thickens and (not pair.discretisation.traits.pointwise or isinstance(pair.discretisation, Bernstein)):
            raise InputError(
                f"{called}, is an offset: there is no derivative by its values with mortar or degree 2, whose gaps are of several nodes: "
                "expected coupling='node_to_surface' and degree 1, or ContactParameter(contact, 'offset')"
            )
        if thickens and not keeps_distance(contact):
            raise InputError(f"{called}, is an offset from a rigid surface: expected a plane, a sphere or a cylinder, or a mesh")


def by_contacts(at: Any, m: fem.Function, by_gaps: Array, a: Array) -> tuple[Ints, Array]:
    """Derivatives of a functional by the values of a Function through contacts (collective).

    Args:
        at: the linearised problem, a ``Linearised``.
        m: a Function.
        by_gaps: derivative of the functional by the gaps of all equations ``(m,)``.
        a: adjoint displacement of the owned nodes ``(n_owned, gdim)``.

    Returns:
        Local degrees of freedom of m, and their derivatives, both ``(k,)``.
    """
    entries, found = [np.zeros(0, np.int64)], [np.zeros(0)]
    for contact in at.problem.contacts:
        for own, values in _slopes(at, contact, m, by_gaps, a):
            entries.append(_entries(at, m, contact)[own])
            found.append(values)
    return np.concatenate(entries), np.concatenate(found)


def _slopes(at: Any, contact: Contact, m: fem.Function, by_gaps: Array, a: Array) -> list[tuple[Ints, Array]]:
    """Contactors of one contact, and derivatives by their values."""
    found: list[tuple[Ints, Array]] = []
    if as_law(contact.friction).field is m and contact.pair.friction is not None:
        found.append((np.arange(len(contact.pair.nodes)), -rubbed_along(contact.pair, a)))
    if contact.offset is m:
        own, which = at.equations_of(contact, "its offset")
        opened, worked = thickened(contact.pair, own, at.multipliers[which], a)
        mine, (_, rows) = contactors_of(own, contact.pair), table_of(contact.pair)
        found.append((own.contactor[mine] - rows.start, (by_gaps[which] * opened - worked)[mine]))
    return found


def along_field(at: Any, m: fem.Function, change: Array) -> tuple[Array, Array]:
    """Changes of gaps ``(m,)`` and residual ``(n_owned, gdim)`` along changes of a Function's local values (collective)."""
    gaps, pushed = np.zeros_like(at.multipliers), np.zeros((at.config.n_owned, at.config.gdim))
    for contact in at.problem.contacts:
        if as_law(contact.friction).field is m and contact.pair.friction is not None:
            pushed = pushed + rubbed(contact.pair, change[_entries(at, m, contact)])
        if contact.offset is m:
            own, which = at.equations_of(contact, "its offset")
            whole, rows = table_of(contact.pair)
            more = np.zeros(len(whole.nodes))
            more[rows] = change[_entries(at, m, contact)]
            more = more[own.contactor]
            opened, forces = thickened(contact.pair, own, at.multipliers[which] * more)
            gaps[which] += opened * more
            pushed = pushed + forces
    return gaps, pushed


def _entries(at: Any, m: fem.Function, contact: Contact) -> Ints:
    """Local degrees of freedom of m at the contactors ``(n,)``."""
    entries = at.config.entries_in(m.function_space)
    assert entries is not None
    return np.asarray(entries[contact.pair.nodes], dtype=np.int64)
