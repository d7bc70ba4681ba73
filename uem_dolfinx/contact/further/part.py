"""Further parts of a contact, with contactors and equations of their own: corners of its target, and edges that cross."""

from __future__ import annotations

from functools import partial
from typing import Any
from weakref import ref

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.edges.discretisation import EdgeKinematics, Edges, EdgeTarget
from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
from uem_dolfinx.contact.seam.base import OnTarget
from uem_dolfinx.contact.seam.ends import END_HOLDS
from uem_dolfinx.errors import InputError, OrientationError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.edge_crossings import Crossings, SharpLines
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.pointed import AT_CORNER, AlongEdges, AtEdges, PointedFacets, pointed_sides, sizes_at, with_outside
from uem_dolfinx.geometry.projection import FacetProjection, Target
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import reduced


def _of_contact(name: str) -> property:
    """An attribute that is always that of the contact; values set on its part have no effect."""
    return property(lambda part: getattr(part._contact, name), lambda part, value: None)


class FurtherPart(Contact):
    """Part of a contact, with arguments of its own in place of the contact's; ``order`` as in ``Traits``. Its results are the contact's."""

    is_further_part = True
    sees_corners = watches_ends = False  # corners are contactors themselves, and contactors pass ends regularly

    def __init__(self, of: Contact, what: str, order: int, **how: Any):
        same = {name: getattr(of, name) for name in ("sliding", "normals", "max_penetration", "friction", "offset", "measure")}
        # the contact refers to its part
        self._of, self._order = ref(of), order
        sides = {"contactor": of.contactor, "target": of.target}
        super().__init__(**(sides | same | how), name=f"{of.name}, {what}", corners=False, edges=False)

    @property
    def _contact(self) -> Contact:
        of = self._of()
        assert of is not None
        return of

    _friction: Any = _of_contact("_friction")
    _offset: Any = _of_contact("_offset")

    def edges_that_meet(self) -> None:
        """None, since the contact itself looks at them."""

    def share(self) -> None:
        """Decide which nodes of the other parts are left to this one (collective)."""
        raise NotImplementedError


class CornerContact(FurtherPart):
    """Part of a contact: owned nodes of its target ``(n,)``, against facets of its contactor."""

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


#: How many crossings a node may have at once; two edges of a rod cross another one between two nodes. [bound; crossings; -]
LISTS = 2


class OfCrossings(Contact):
    """Nodes on sharp edges, each with one crossing of its edge with another body's."""

    #: Its discretisation.
    kind = Edges
    _crossings: Crossings
    _number: int
    _order: int  # see ``Traits``

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

    InputError for other than finite sliding, OrientationError for a surface inside a body.
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
