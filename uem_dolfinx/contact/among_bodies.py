"""Nodes to the surfaces of many bodies: the discretisation of general contact, and what it is where nothing is near."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.bernstein import Bernstein
from uem_dolfinx.contact.kinematics import Constraints, Traction
from uem_dolfinx.contact.node_to_surface import NodalKinematics, NodeToSurface
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.neighbours import Neighbour
from uem_dolfinx.parallel import reduced


class AmongBodies(NodeToSurface):
    """Implements ``Discretisation``: nodes against the facets that they may touch, of any bodies."""

    target: Neighbour

    def __init__(self, config: Configuration, nodes: Indices, target: Neighbour, **how: Any):
        super().__init__(config, nodes, target, **how)
        self.ordered_by = target.neighbours.number
        # of two edges that meet, the one that is over the other's facet follows it
        self.ends_hold = ~target.neighbours.skin.corners[nodes]

    def place(self, points: Array, state: PairState) -> NodalKinematics:
        """Project contactors (collective); see ``Discretisation``."""
        self.target.hold(np.where(state.active, state.facet, -1))
        if self.target.nothing_near() and not reduced(self.config.comm, bool(state.active.any()), op=MPI.LOR):
            p = self.target.nowhere(points)
            return NothingNear(self, points, p, p, p.gap, None, None)
        return super().place(points, state)

    def look_farther(self) -> bool:
        """Reach four times as far: whether that is not beyond the whole model yet."""
        return self.target.number == 0 and self.target.neighbours.look_farther()

    def commit(self) -> None:
        """Nodes are in front of facets from where they are now."""
        super().commit()
        self.target.neighbours.commit()


class AmongQuadraticBodies(AmongBodies, Bernstein):
    """The same with control gaps, of degree 2."""


class NothingNear(NodalKinematics):
    """Implements ``Kinematics`` where no contactor of any rank has anything near, at no price."""

    @property
    def idle(self) -> bool:
        """Yes: nothing is near."""
        return True

    @property
    def movable(self) -> Bools:  # type: ignore[override]
        """None can close its gap ``(n,)``."""
        return np.zeros(len(self.gap), bool)

    @property
    def cone(self) -> Array:  # type: ignore[override]
        """There are no facets to push ``(n,)``."""
        return np.ones(len(self.gap))

    def placed_again(self, state: PairState) -> NodalKinematics:
        """They stay where they are."""
        return self

    def predicted(self, du: Array) -> Array:
        """The gap to nothing, as large as the model ``(n,)``."""
        return self.gap

    def off(self, state: PairState) -> Bools:
        """None is past an end ``(n,)``."""
        return np.zeros(len(self.gap), bool)

    def at_end(self, state: PairState) -> Bools:
        """None is held by an end ``(n,)``."""
        return np.zeros(len(self.gap), bool)

    def return_vectors(self, state: PairState) -> Array:
        """None is moved ``(n, gdim)``."""
        return np.zeros(self.points.shape)

    def forces(self, state: PairState, equations: Constraints, multipliers: Array) -> Traction:
        """There are none."""
        none = np.zeros(len(self.gap))
        return Traction(none, none, np.zeros(self.points.shape))

    def curvature(self, state: PairState) -> list[tuple[Ints, Array]]:
        """Nothing turns."""
        return []
