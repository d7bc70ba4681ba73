"""Contacts of the same surfaces share the contact force, so that a law of the pressure in one of them would miss a part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Bools, Indices
from uem_dolfinx.errors import ConflictError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.tags import Tag

if TYPE_CHECKING:
    from uem_dolfinx.contact.contact import Contact


def refuse_shared_pressures(config: Configuration, contacts: Sequence[Contact]) -> None:
    """Refuse contacts on the same facets of both sides of which one has a law of the pressure (collective).

    Friction and wear are such laws if both contacts have the same contactor; a conductance that depends on the pressure also if the sides
    are swapped.

    Args:
        config: configuration of the displacement.
        contacts: all its contacts.

    Raises:
        ConflictError: naming two such contacts.
    """
    facets = config.tdim - 1
    single = [one for one in contacts if not one.of_all_surfaces and one.tied is not True and one.contactor.dim == facets]
    laws = [one.normal is not None or one.cohesion is not None for one in single]
    conducts = np.array([law or any(callable(heat.h) for heat in one.heats) for law, one in zip(laws, single)], dtype=bool)
    slides = np.array([one.pair.friction is not None for one in single], dtype=bool)
    if len(single) < 2 or not (conducts | slides).any():
        return
    own, theirs = _tables([one.contactor for one in single], [one.target for one in single])
    common = np.stack([(one @ other.T).toarray() > 0 for one, other in ((own, own), (theirs, theirs), (own, theirs))])
    config.comm.Allreduce(MPI.IN_PLACE, common, op=MPI.LOR)
    contactors, targets, swapped = common
    rigid = np.array([id(one.target) for one in single])
    targets |= rigid[:, None] == rigid
    law = conducts | slides
    np.fill_diagonal(contactors, False)
    twice: Bools = contactors & targets & (law[:, None] | law)
    both_ways: Bools = swapped & swapped.T & (conducts[:, None] | conducts)
    for i, j in np.argwhere(np.triu(twice | both_ways)):
        one, other = single[i], single[j]
        which = "surfaces" if twice[i, j] else "surfaces with the sides swapped"
        remedy = "declare one contact with all friction, wear and conductances, heat=[...]"
        raise ConflictError(
            f"contact '{one.name}' and contact '{other.name}' have the same {which}, and share the pressure: friction, wear, p(g) or "
            f"h(p, g) of a part of it would be wrong: {remedy if twice[i, j] else 'keep one of the two'}"
        )


def _tables(*sides: Sequence[object]) -> list[Any]:
    """Sparse masks of this rank's facets in the tags of each side, without facets for rigid surfaces."""
    from scipy.sparse import csr_matrix

    none: Indices = np.zeros(0, np.int32)
    lists = [[tag.entities if isinstance(tag, Tag) else none for tag in tags] for tags in sides]
    n = 1 + max(int(entities.max(initial=0)) for side in lists for entities in side)
    found = []
    for side in lists:
        every, starts = np.concatenate(side), np.cumsum([0, *(len(entities) for entities in side)])
        found.append(csr_matrix((np.ones(len(every)), every, starts), shape=(len(side), n)))
    return found
