"""Set-up of the contacts of a problem, and joint treatment of those that differ only in surfaces and values."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Bools, Indices
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.coulomb import Coulomb
from uem_dolfinx.contact.laws.law import FrictionLaw, OfTemperature, as_law
from uem_dolfinx.errors import ConflictError, InputError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.tags import Tag

if TYPE_CHECKING:
    from uem_dolfinx.contact.further.part import FurtherPart
    from uem_dolfinx.contact.pair.interface import Interface
    from uem_dolfinx.contact.pair.kinds import PartsOfPair

_orders = count(start=1)


def attached(
    contacts: Sequence[Contact], config: Configuration, free: Bools, clock: dict[str, Any], together: bool
) -> list[Contact]:
    """Attach contacts, see ``Contact.attach``, and make their pairs, of alike ones ``together`` or not.

    Returns these contacts, followed by their further parts (collective).
    """
    made = [contact.attach(config, free, **clock) for contact in contacts]
    for contact, pair in zip(contacts, _pairs_of(contacts, made, together)):
        contact.take_pair(pair)
    refuse_shared_pressures(config, contacts)
    return [*contacts, *(part for contact in contacts for part in _further_parts(contact, config, free, clock))]


def _further_parts(contact: Contact, config: Configuration, free: Bools, clock: dict[str, Any]) -> Sequence[FurtherPart]:
    """Attached further parts of a contact, at corners and edges; InputError if it cannot have what it is given (collective)."""
    wanted = [word for word in ("corners", "edges") if getattr(contact, word)]
    found: list[FurtherPart] = []
    if wanted and not _takes_parts(contact):
        nodal = "node-to-surface " * contact.corners
        raise InputError(
            f"contact '{contact.name}': {wanted[0]} = True goes with hard {nodal}contact of two meshes, without tied, "
            f"adjust, wear, heat, cohesion, leak and friction by area or temperature: leave {wanted[0]} out, or these"
        )
    order = -1 - next(_orders) if wanted else -1
    if contact.corners:
        from uem_dolfinx.contact.further.part import corners_of

        found += corners_of(contact, config, order)
    if contact.edges:
        from uem_dolfinx.contact.further.part import edges_of

        found += edges_of(contact, config, order)
    for part in found:
        part.take_pair(part.attach(config, free, **clock).alone())
    contact.take_further(found)
    return found


def _takes_parts(contact: Contact) -> bool:
    """Whether other nodes or edges could have equations, too."""
    from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
    from uem_dolfinx.geometry.search import MeshTarget

    law = as_law(contact.friction)
    plain = _plain(contact) and not contact.adjust
    nodal = isinstance(contact.pair.discretisation, NodeToSurface) and contact.coupling == "node_to_surface"
    nodal |= contact.coupling == "mortar" and not contact.corners
    meshed = isinstance(contact.pair.target, MeshTarget) and contact.contactor.dim == contact.config.tdim - 1
    return plain and nodal and meshed and not (law.per_area or isinstance(law.field, OfTemperature))


def _plain(contact: Contact) -> bool:
    """Whether contact is hard, without tie, wear, heat and a fluid."""
    return not (contact.tied or contact.wears or contact.heats or contact.normal or contact.cohesion or contact.leak)


def _pairs_of(contacts: Sequence[Contact], made: Sequence[PartsOfPair], together: bool) -> list[Interface]:
    """Interfaces of contacts; one with a ``Member`` for each of those that are alike, if these are treated ``together`` (collective).

    Alike are node-to-surface contacts of meshes, or with rigid surfaces, with finite sliding, at degree 1, with the same normals and
    target thickness. They have no friction or Coulomb's law, and no further parts, ties, wear or heat.
    """
    groups: dict[Hashable, list[int]] = {}
    for k, (contact, own) in enumerate(zip(contacts, made)):
        kind = _kind(contact, own) if together else None
        groups.setdefault(k if kind is None else kind, []).append(k)
    found: dict[int, Interface] = {}
    for alike in groups.values():
        if len(alike) == 1:
            found[alike[0]] = made[alike[0]].alone()
        else:
            from uem_dolfinx.contact.pair.joined_nodes import JoinedInterface

            parts = [made[k] for k in alike]
            found |= zip(alike, JoinedInterface(parts).make_members(parts))
    return [found[k] for k in range(len(contacts))]


def _kind(contact: Contact, made: PartsOfPair) -> Hashable:
    """Common properties of contacts that can be treated together; None for other contacts."""
    from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
    from uem_dolfinx.geometry.rigid import RigidSurface
    from uem_dolfinx.geometry.search import MeshTarget

    target, friction = made.discretisation.target, made.friction
    rigid = isinstance(contact.target, RigidSurface)
    if not rigid and not (type(contact) is Contact and type(target) is MeshTarget):
        return None
    parted = contact.corners or contact.edges
    if type(made.discretisation) is not NodeToSurface or parted or contact.sliding != "finite" or not _plain(contact):
        return None
    if friction is not None and not _joins(friction.limits.law):
        return None
    return rigid, friction is not None, target.averaged, contact.thickness


def _joins(law: FrictionLaw) -> bool:
    """Whether a law is Coulomb's, independent of temperature."""
    return type(law) is Coulomb and not isinstance(law.field, OfTemperature)


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
