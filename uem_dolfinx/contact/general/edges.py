"""Edges of a general contact: which edges of which bodies may meet, and the contacts at their crossings."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.edges.discretisation import Edges, EdgeTarget
from uem_dolfinx.contact.edges.placement import EdgeKinematics
from uem_dolfinx.contact.general.parts import BodiesContact
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.edge_crossings import Crossings, SharpLines
from uem_dolfinx.geometry.projection import Target
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.geometry.neighbours import Neighbours

#: How many crossings a node may have at once; two edges of a rod cross another one between two nodes.
#: [bound; crossings; -]
LISTS = 2


class EdgeContact(BodiesContact):
    """Part of a general contact: nodes on sharp edges, each with one crossing of its edge with another body's."""

    def __init__(self, neighbours: Neighbours, crossings: Crossings, number: int, **options: Any):
        super().__init__(neighbours.skin.tag, neighbours.skin.tag, coupling=Edges, **options)
        self._crossings, self._number, self._skin, self._order = crossings, number, neighbours.skin, neighbours.number

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


def crossings_of(neighbours: Neighbours, overlap: float) -> Crossings:
    """Crossings of the edges of different bodies, whose nodes follow the bodies later in the order (collective)."""
    skin, place, lines = neighbours.skin, neighbours.place, SharpLines(neighbours.skin)
    body = skin.body[lines.facet]
    sets = [facets[lines.facet] for _, a, _, b in neighbours.apart for facets in (a, b)]
    keys = np.column_stack([*sets, place[body], body]).astype(np.int64)

    def meet(one: Ints, other: Ints) -> Bools:
        may: Bools = one[:, -2] < other[:, -2]
        for k in range(0, one.shape[1] - 2, 2):
            a, b = (part[:, k : k + 2] > 0 for part in (one, other))
            may &= ~((a[:, 0] & b[:, 1]) | (a[:, 1] & b[:, 0]))
        return may

    return Crossings(lines, lines, (keys, keys), meet, overlap, LISTS)


def edge_contacts(neighbours: Neighbours, overlap: float, name: str, options: dict[str, Any]) -> Sequence[EdgeContact]:
    """Contacts at crossings of edges, one for each crossing that a node may have (collective); none unless two bodies have sharp edges."""
    crossings = crossings_of(neighbours, overlap)
    lines, skin = crossings.first, neighbours.skin
    with_edges = np.bincount(skin.body[lines.facet], minlength=skin.n_bodies) > 0
    if reduced(skin.config.comm, with_edges, op=MPI.LOR).sum() < 2:
        return []
    skin.crossings = crossings
    return [
        EdgeContact(neighbours, crossings, k, name=f"{name} at edges" + f" {k + 1}" * (k > 0), **options) for k in range(LISTS)
    ]
