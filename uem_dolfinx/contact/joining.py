"""Set-up of the contacts of a problem, and joint treatment of those that differ only in surfaces and values."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, Any

from uem_dolfinx.arrays import Bools
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.coulomb import Coulomb
from uem_dolfinx.contact.laws.thermal import OfTemperature
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.shared_pressures import refuse_shared_pressures
from uem_dolfinx.geometry.configuration import Configuration

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.sliding import Sliding


def attached(contacts: Sequence[Contact], config: Configuration, free: Bools, clock: dict[str, Any]) -> list[Contact]:
    """Attach contacts, see ``Contact.attach``; returns these, followed by the second parts of contacts with corners (collective)."""
    for contact in contacts:
        contact.attach(config, free, **clock)
    refuse_shared_pressures(config, contacts)
    if not any(contact.corners for contact in contacts):
        return list(contacts)
    from uem_dolfinx.contact.corner_contact import with_corners

    return with_corners(contacts, config, free, clock)


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

            whole = JoinedInterface([contact.pair for contact in alike])
            for contact, member in zip(alike, whole.make_members()):
                contact.take_pair(member)


def part(contacts: Sequence[Contact]) -> list[tuple[Interface, list[Interface]]]:
    """Separate joined contacts into their own interfaces again (collective).

    Returns:
        The joint interfaces, with the separate interfaces of each.
    """
    wholes = {id(contact.pair.whole): contact.pair.whole for contact in contacts}
    parted = [(whole, whole.part()) for whole in wholes.values() if len(whole.members) > 1]
    own = {id(member): pair for whole, pairs in parted for member, pair in zip(whole.members, pairs)}
    for contact in contacts:
        if id(contact.pair) in own:
            contact.take_pair(own[id(contact.pair)])
    for _, pairs in parted:
        for pair in pairs:
            pair.project()
    return parted


def _kind(contact: Contact) -> Hashable:
    """Common properties of contacts that can be joined; None for other contacts."""
    from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
    from uem_dolfinx.geometry.rigid import RigidSurface
    from uem_dolfinx.geometry.search import MeshTarget

    pair = contact.pair
    rigid = isinstance(contact.target, RigidSurface)
    if not rigid and not (type(contact) is Contact and type(pair.target) is MeshTarget):
        return None
    nodal = (type(pair), type(pair.discretisation)) == (Interface, NodeToSurface)
    if not nodal or contact.at_corners is not None or pair.sliding != "finite" or pair.tie is not None or pair.heats:
        return None
    if pair.friction is not None and not _joins(pair.friction):
        return None
    return rigid, pair.frictional, pair.target.averaged, pair.thickness


def _joins(friction: Sliding) -> bool:
    """Whether friction is Coulomb's law, independent of temperature, and without wear."""
    law = friction.limits.law
    return type(law) is Coulomb and not isinstance(law.field, OfTemperature) and friction.wear is None
