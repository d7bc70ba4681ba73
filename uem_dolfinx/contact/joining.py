"""Set-up of the contacts of a problem, and joint treatment of those that differ only in surfaces and values."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from itertools import count
from typing import TYPE_CHECKING, Any

from uem_dolfinx.arrays import Bools
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.coulomb import Coulomb
from uem_dolfinx.contact.laws.law import as_law
from uem_dolfinx.contact.laws.thermal import OfTemperature
from uem_dolfinx.contact.shared_pressures import refuse_shared_pressures
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.configuration import Configuration

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.sliding import Sliding
    from uem_dolfinx.contact.further.part import FurtherPart

_orders = count(start=1)


def attached(contacts: Sequence[Contact], config: Configuration, free: Bools, clock: dict[str, Any]) -> list[Contact]:
    """Attach contacts, see ``Contact.attach``; returns these, followed by their further parts (collective)."""
    for contact in contacts:
        contact.attach(config, free, **clock)
    refuse_shared_pressures(config, contacts)
    return [*contacts, *(part for contact in contacts for part in _further_parts(contact, config, free, clock))]


def _further_parts(contact: Contact, config: Configuration, free: Bools, clock: dict[str, Any]) -> Sequence[FurtherPart]:
    """Attached further parts of a contact, at corners and edges (collective).

    Raises:
        InputError: for a contact that cannot have what it is given.
    """
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
        from uem_dolfinx.contact.further.corners import corners_of

        found += corners_of(contact, config, order)
    if contact.edges:
        from uem_dolfinx.contact.further.edges import edges_of

        found += edges_of(contact, config, order)
    contact.further = found
    for part in found:
        part.attach(config, free, **clock)
        part.share()
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


def join_alike(contacts: Sequence[Contact]) -> None:
    """Join similar contacts during the set-up of a problem (collective).

    These are node-to-surface contacts of meshes, or with rigid surfaces, with finite sliding, at degree 1, with the same normals and
    target thickness, without friction or with Coulomb's law, without ties, wear and heat.
    """
    groups: dict[Hashable, list[Contact]] = {}
    for contact in contacts:
        kind = _kind(contact)
        if kind is not None:
            groups.setdefault(kind, []).append(contact)
    for alike in groups.values():
        if len(alike) > 1:
            from uem_dolfinx.contact.pair.joined import JoinedInterface

            own = [contact.pair for contact in alike]
            for contact, member in zip(alike, JoinedInterface(own).make_members(own)):
                contact.take_pair(member)


def _kind(contact: Contact) -> Hashable:
    """Common properties of contacts that can be joined; None for other contacts."""
    from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
    from uem_dolfinx.geometry.rigid import RigidSurface
    from uem_dolfinx.geometry.search import MeshTarget

    pair = contact.pair
    rigid = isinstance(contact.target, RigidSurface)
    if not rigid and not (type(contact) is Contact and type(pair.target) is MeshTarget):
        return None
    if type(pair.discretisation) is not NodeToSurface or contact.further or contact.sliding != "finite" or not _plain(contact):
        return None
    if pair.friction is not None and not _joins(pair.friction):
        return None
    return rigid, pair.friction is not None, pair.target.averaged, contact.thickness


def _joins(friction: Sliding) -> bool:
    """Whether friction is Coulomb's law, independent of temperature."""
    law = friction.limits.law
    return type(law) is Coulomb and not isinstance(law.field, OfTemperature)
