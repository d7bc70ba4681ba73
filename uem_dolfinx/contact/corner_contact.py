"""Nodes at pointed edges of a contact's target, as contactors against the contact's own contactor: its second part."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import count
from typing import Any
from weakref import ref

import numpy as np

from uem_dolfinx.arrays import Bools, Indices
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.law import as_law
from uem_dolfinx.contact.laws.thermal import OfTemperature
from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
from uem_dolfinx.contact.seam.ends import END_HOLDS
from uem_dolfinx.errors import InputError, OrientationError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.pointed import AT_CORNER, AlongEdges, AtEdges, PointedFacets, pointed_sides, sizes_at
from uem_dolfinx.geometry.projection import Target
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import reduced

_orders = count(start=1)


def _of_contact(name: str) -> property:
    """An attribute that is always that of the contact; values set on its part have no effect."""
    return property(lambda part: getattr(part._contact, name), lambda part, value: None)


class CornerContact(Contact):
    """Part of a contact: nodes of its target; the contact tells its results.

    Args:
        of: the contact, attached to a problem.
        nodes: owned nodes of its target ``(n,)``.
        facets: of its contactor.
    """

    is_second_part = True
    #: Corners are contactors here, and pass ends regularly.
    sees_corners = watches_ends = False

    def __init__(self, of: Contact, nodes: Indices, facets: PointedFacets):
        same = {name: getattr(of, name) for name in ("sliding", "normals", "max_penetration", "friction", "offset", "measure")}
        # the contact refers to its part
        self._of, self._nodes, self._facets = ref(of), nodes, facets
        super().__init__(of.target, of.contactor, name=f"{of.name}, corners of the target", corners=False, **same)

    @property
    def _contact(self) -> Contact:
        of = self._of()
        assert of is not None
        return of

    _friction: Any = _of_contact("_friction")
    _offset: Any = _of_contact("_offset")

    def _sides(self, config: Configuration) -> tuple[Indices, Target]:
        return self._nodes, MeshTarget(self._facets, averaged=self.normals == "averaged")

    def edges_that_meet(self) -> None:
        """None, since the contact itself looks at them."""


def with_corners(contacts: Sequence[Contact], config: Configuration, free: Bools, clock: dict[str, Any]) -> list[Contact]:
    """Attached contacts, followed by the second parts of those with ``corners`` whose targets have pointed edges (collective).

    Raises:
        InputError: for a contact with ``corners`` that cannot have a second part.
    """
    for contact in contacts:
        if contact.corners and not _takes_corners(contact):
            raise InputError(
                f"contact '{contact.name}': corners = True goes with hard node-to-surface contact of two meshes, without tied, adjust, "
                "wear, heat, cohesion, leak and friction by area or temperature: leave corners out, or these"
            )
        contact.at_corners = _part_of(contact, config, free, clock) if contact.corners else None
    return [*contacts, *(contact.at_corners for contact in contacts if contact.at_corners is not None)]


def _takes_corners(contact: Contact) -> bool:
    """Whether nodes of its target could be contactors, too."""
    law = as_law(contact.friction)
    plain = not (
        contact.tied or contact.adjust or contact.wears or contact.heats or contact.normal or contact.cohesion or contact.leak
    )
    nodal = isinstance(contact.pair.discretisation, NodeToSurface) and contact.coupling == "node_to_surface"
    meshed = isinstance(contact.pair.target, MeshTarget) and contact.contactor.dim == contact.config.tdim - 1
    return plain and nodal and meshed and not (law.per_area or isinstance(law.field, OfTemperature))


def _part_of(contact: Contact, config: Configuration, free: Bools, clock: dict[str, Any]) -> CornerContact | None:
    """The second part, attached; None without pointed edges, or for a contactor inside a body, which has no outer side (collective)."""
    target = contact.pair.target
    assert isinstance(target, MeshTarget)
    sides = pointed_sides(target.facets)
    nodes = np.flatnonzero(target.facets.on_sides(sides)[: config.n_owned]).astype(np.int32)
    if not reduced(config.comm, len(nodes)):
        return None
    try:
        facets = PointedFacets(config, contact.contactor, "contactor")
    except OrientationError:
        return None
    part = CornerContact(contact, nodes, facets)
    part.attach(config, free, **clock)
    own, theirs = contact.pair.discretisation, part.pair.discretisation
    assert isinstance(own, NodeToSurface) and isinstance(theirs, NodeToSurface) and isinstance(theirs.target, MeshTarget)
    # where an edge lies on a contactor, or on an edge of the contactor, one follows the other
    stay = facets.on_sides(facets.open_sides)[own.nodes]
    within = np.where(stay, 0.0, AT_CORNER * sizes_at(facets, own.nodes))
    order = -1 - next(_orders)
    own.leave(AtEdges(target, sides, within), order)
    at, ends = target.facets, [nodes[:2] for _, nodes, _, _ in target.shape.edges] if config.gdim == 3 else []
    edges = np.concatenate([np.zeros((0, 2), np.int32), *(at.dofs[sides[:, s]][:, two] for s, two in enumerate(ends))])
    theirs.leave(AlongEdges(config, theirs.target, facets.open_sides, END_HOLDS, nodes, edges), order, ends_hold=False)
    return part
