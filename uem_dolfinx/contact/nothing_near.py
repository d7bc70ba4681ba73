"""What contact is where nothing is near any contactor of any rank: no gap, no equation, no force, at no price."""

from __future__ import annotations

from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.kinematics import Constraints, Traction
from uem_dolfinx.contact.node_to_surface import NodalKinematics
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.geometry.search import MeshTarget


class NothingNear(NodalKinematics):
    """Implements ``Kinematics`` where no contactor of any rank has anything near, at no price."""

    @classmethod
    def at(cls, of: Any, points: Array) -> NothingNear:
        """Of the contactors of a ``NodeToSurface`` at ``points (n, gdim)``."""
        p = of.target.nowhere(points) if isinstance(of.target, MeshTarget) else of.target.project(points)
        return cls(of, points, p, p, p.gap, None, None)

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
