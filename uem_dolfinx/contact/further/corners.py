"""Nodes at pointed edges of a contact's target, as contactors against the contact's own contactor: a further part of it."""

from __future__ import annotations

import numpy as np

from uem_dolfinx.arrays import Indices
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.further.part import FurtherPart
from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
from uem_dolfinx.contact.seam.ends import END_HOLDS
from uem_dolfinx.errors import OrientationError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.pointed import AT_CORNER, AlongEdges, AtEdges, PointedFacets, pointed_sides, sizes_at
from uem_dolfinx.geometry.projection import Target
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import reduced


class CornerContact(FurtherPart):
    """Part of a contact: nodes of its target.

    Args:
        of: the contact, attached to a problem.
        order: see ``FurtherPart``.
        nodes: owned nodes of its target ``(n,)``.
        facets: of its contactor.
    """

    swaps = True

    def __init__(self, of: Contact, order: int, nodes: Indices, facets: PointedFacets):
        super().__init__(of, "corners of the target", order, contactor=of.target, target=of.contactor)
        self._nodes, self._facets = nodes, facets

    def _sides(self, config: Configuration) -> tuple[Indices, Target]:
        return self._nodes, MeshTarget(self._facets, averaged=self.normals == "averaged")

    def share(self) -> None:
        """See ``FurtherPart``: where an edge lies on a contactor, or on an edge of the contactor, one follows the other."""
        own, theirs, facets, order = self._contact.pair.discretisation, self.pair.discretisation, self._facets, self._order
        assert isinstance(own, NodeToSurface) and isinstance(theirs, NodeToSurface)
        target = own.target
        assert isinstance(target, MeshTarget) and isinstance(theirs.target, MeshTarget)
        sides, at = pointed_sides(target.facets), target.facets
        stay = facets.on_sides(facets.open_sides)[own.nodes]
        within = np.where(stay, 0.0, AT_CORNER * sizes_at(facets, own.nodes))
        own.leave(AtEdges(target, sides, within), order)
        ends = [nodes[:2] for _, nodes, _, _ in target.shape.edges] if self.config.gdim == 3 else []
        edges = np.concatenate([np.zeros((0, 2), np.int32), *(at.dofs[sides[:, s]][:, two] for s, two in enumerate(ends))])
        theirs.leave(
            AlongEdges(self.config, theirs.target, facets.open_sides, END_HOLDS, self._nodes, edges), order, ends_hold=False
        )


def corners_of(contact: Contact, config: Configuration, order: int) -> list[FurtherPart]:
    """The part at corners; none without pointed edges, or for a contactor inside a body, which has no outer side (collective)."""
    target = contact.pair.target
    assert isinstance(target, MeshTarget)
    sides = pointed_sides(target.facets)
    nodes = np.flatnonzero(target.facets.on_sides(sides)[: config.n_owned]).astype(np.int32)
    if not reduced(config.comm, len(nodes)):
        return []
    try:
        return [CornerContact(contact, order, nodes, PointedFacets(config, contact.contactor, "contactor"))]
    except OrientationError:
        return []
