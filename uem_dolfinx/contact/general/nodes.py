"""Node-to-surface discretisation of general contact between many bodies."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.contact.nodes.bernstein import Bernstein
from uem_dolfinx.contact.nodes.node_to_surface import NodalKinematics, NodeToSurface
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.neighbours import Neighbour
from uem_dolfinx.parallel import reduced


class AmongBodies(NodeToSurface):
    """Implements ``Discretisation``: nodes with the listed facets of any bodies."""

    target: Neighbour

    def __init__(self, config: Configuration, nodes: Indices, target: Neighbour, **how: Any):
        super().__init__(config, nodes, target, **how)
        self.traits = self.traits._replace(order=target.neighbours.number)
        # of two edges in contact, the node above a facet of the other body follows it
        self.ends_hold = ~target.neighbours.skin.corners[nodes]

    def place(self, points: Array, state: PairState) -> NodalKinematics:
        """Project contactors (collective); see ``Discretisation``."""
        self.target.hold(np.where(state.active, state.facet, -1))
        return super().place(points, state)

    def _asks(self, state: PairState) -> bool:
        """Whether the list has a pair, or a contactor is active, on any rank (collective)."""
        return not self.target.nothing_near() or reduced(self.config.comm, bool(state.active.any()), op=MPI.LOR)

    def begin_step(self) -> None:
        """Begin or repeat a step with the lists of its beginning."""
        super().begin_step()
        self.target.neighbours.begin_step()

    def commit(self) -> None:
        """Accept a step: current positions decide which side of facets nodes are on."""
        super().commit()
        self.target.neighbours.commit()


class AmongQuadraticBodies(AmongBodies, Bernstein):
    """The same with control gaps, for degree 2."""
