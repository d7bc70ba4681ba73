"""Edges of a contact's contactor and of its target that cross: a further part of the contact, with one equation at each crossing."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.edges.discretisation import Edges, EdgeTarget
from uem_dolfinx.contact.edges.placement import EdgeKinematics
from uem_dolfinx.contact.further.part import FurtherPart
from uem_dolfinx.contact.seam.base import OnTarget
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.edge_crossings import Crossings, SharpLines
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.pointed import with_outside
from uem_dolfinx.geometry.projection import FacetProjection, Target

#: How many crossings a node may have at once; two edges of a rod cross another one between two nodes.
#: [bound; crossings; -]
LISTS = 2


class OfCrossings(Contact):
    """Nodes on sharp edges, each with one crossing of its edge with another body's."""

    #: Its discretisation.
    kind = Edges
    _crossings: Crossings
    _number: int
    #: See ``Traits``.
    _order: int

    def _sides(self, config: Configuration) -> tuple[Indices, Target]:
        return self._crossings.nodes.astype(np.int32), EdgeTarget(self._crossings, self._number)

    def _discretised(self, nodes: Indices, target: Any, **how: Any) -> tuple[Edges, None]:
        """Edges in the order of the bodies."""
        return Edges(self.config, nodes, target, order=self._order, **how), None

    def acting_at(self) -> Array:
        """Crossings."""
        kinematics = self.pair.kinematics
        assert isinstance(kinematics, EdgeKinematics)
        return kinematics.points

    def edges_that_meet(self) -> None:
        """None: the contacts of nodes look for edges that cross."""
        return None


class EdgeContact(OfCrossings, FurtherPart):
    """Part of a contact: crossings of edges of its contactor with those of its target."""

    def __init__(self, of: Contact, order: int, crossings: Crossings, number: int):
        super().__init__(of, "edges" + f" {number + 1}" * (number > 0), order, coupling=Edges)
        self._crossings, self._number = crossings, number

    def share(self) -> None:
        """See ``FurtherPart``: nodes at crossings follow these alone."""
        if self._number == 0:
            for part in (self._contact, *(one for one in self._contact.further if one.swaps)):
                own = part.pair.discretisation
                assert isinstance(own, OnTarget)
                own.leave(partial(self._at_crossings, own.nodes, 0 if part.swaps else 1), self._order)

    def _at_crossings(self, nodes: Indices, side: int, _: FacetProjection) -> Bools:
        """Which owned ``nodes (n,)`` are at crossings with edges of one side, 0 for the contactor (collective)."""
        return self._crossings.hold(nodes, np.full(len(nodes), side), 2)


def edges_of(contact: Contact, config: Configuration, order: int) -> list[EdgeContact]:
    """Parts with the crossings, one for each that a node may have; none in 2D, and unless both surfaces have sharp edges (collective).

    Raises:
        InputError: for other than finite sliding.
        OrientationError: for a surface inside a body.
    """
    if contact.sliding != "finite":
        raise InputError(f"contact '{contact.name}': edges = True goes with sliding = 'finite': leave one of them out")
    if config.gdim < 3:
        return []
    own = SharpLines(*with_outside(TargetFacets(config, contact.contactor, "contactor")))
    theirs = SharpLines(*with_outside(TargetFacets(config, contact.target)))
    if not (own.total and theirs.total):
        return []
    keys, overlap = (np.zeros((len(own.keys), 1), int), np.ones((len(theirs.keys), 1), int)), contact.pair.max_penetration
    crossings = Crossings(own, theirs, keys, lambda one, _: np.ones(len(one), bool), overlap, LISTS, contact.coupling == "mortar")
    return [EdgeContact(contact, order, crossings, number) for number in range(LISTS)]
