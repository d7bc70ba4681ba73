"""Contacts that are narrower than a few facets, of which estimates see too little."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import facets_of
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.problem import UnitedProblem


class FewFacets(NamedTuple):
    """A contact that begins and ends within a few facets.

    Attributes:
        name: of the contact.
        closed: number of facets of all whose contactors are active.
        few: the least number with which estimates are trusted.
    """

    name: str
    closed: int
    few: int


def of_facets(config: Configuration, contact: Contact, values: Array) -> Array:
    """Values at the owned nodes ``(n_owned, k)``, at those of the contactor's facets on this rank ``(m, nn, k)`` (collective)."""
    dofs = facets_of(config, contact.contactor, "contactor").dofs
    return np.asarray(config.from_owners(np.arange(config.n_owned), values, dofs.ravel()).reshape(*dofs.shape, values.shape[1]))


def narrow_contacts(problem: UnitedProblem, few: int) -> list[FewFacets]:
    """Contacts with fewer than ``few`` facets along each direction; where all facets touch, the ends are known (collective)."""
    config, found = problem.config, []
    for contact in problem.contacts:
        if not contact.on or contact.tied:
            continue
        state = np.zeros((config.n_owned, 1))
        state[contact.pair.nodes, 0] = contact.pair.trial.active
        active = of_facets(config, contact, state)[:, :, 0] > 0
        touched, closed, count = reduced(config.comm, np.array([active.any(axis=1).sum(), active.all(axis=1).sum(), len(active)]))
        least = few ** (config.tdim - 1)
        if touched and closed < min(least, count):
            found.append(FewFacets(contact.name, int(closed), least))
    return found


def warn_of_few_facets(narrow: list[FewFacets], estimate: str) -> None:
    """Warn of contacts of which an estimate, with what may be wrong with it, sees too little."""
    for one in narrow:
        logger.warning(
            "contact '%s': %d facets are in contact, expected %d at least: %s; refine the contactor there", *one, estimate
        )
