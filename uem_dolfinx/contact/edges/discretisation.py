"""Edge to edge: the gap between the closest points of two sharp edges of 3D bodies, along their common normal, is zero.

The equation eliminates the normal component of the edge's node nearer to the crossing, the contactor. A crossing has a force and no
area.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.contact.edges.placement import EdgeKinematics
from uem_dolfinx.contact.seam.base import OnTarget
from uem_dolfinx.contact.seam.placement import Traits
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.edge_crossings import Crossings
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import reduced

#: Ways of contactors that count as too short to pass through an edge.
#: [bound; the model's size; -]
NO_WAY = 1e6


class EdgeTarget(MeshTarget):
    """The edges of a surface, as the target of one list of crossings.

    Args:
        crossings: all lists.
        number: of the list.
    """

    #: Crossings are found from lists, not by bounding boxes.
    measures = False

    def __init__(self, crossings: Crossings, number: int):
        super().__init__(crossings.second.facets)
        self.crossings, self.number = crossings, number
        # a node does not pass through an edge, whatever its way
        self.stride = NO_WAY * crossings.second.facets.config.size


class Edges(OnTarget):
    """Implements ``Discretisation``: nodes on edges with the edges that cross theirs; arguments as for ``OnTarget``.

    Args:
        order: see ``Traits``.
    """

    traits = Traits(at_feet=False, pointwise=False, chained=True, two_pass=True)
    target: EdgeTarget

    def __init__(self, config: Configuration, nodes: Indices, target: EdgeTarget, *, order: int = -1, **how: Any):
        super().__init__(config, nodes, target, **how)
        self.traits = self.traits._replace(order=order)

    def place(self, points: Array, state: PairState) -> EdgeKinematics:
        """Find the crossings (collective); see ``Discretisation``."""
        crossings, k = self.target.crossings, self.target.number
        crossings.held[k] = np.where(state.active, state.facet, -1)
        crossings.update()
        which, found = crossings.lists[k]
        near = bool(len(which) or state.active.any())
        self.asked = bool(reduced(self.config.comm, near, op=MPI.LOR))
        return EdgeKinematics.of_crossings(self, points, which, found)

    def commit(self) -> None:
        """Accept a step: current positions decide which edges face each other."""
        super().commit()
        self.target.crossings.commit()
