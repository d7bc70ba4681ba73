"""Record of stick-slip exchanges of a linearised problem, and data of the last step's end."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.seam.placement import Kinematics
    from uem_dolfinx.contact.seam.relative_motion import Ties
    from uem_dolfinx.geometry.configuration import Configuration
    from uem_dolfinx.geometry.rigid import Motion


@dataclass(frozen=True)
class Pivot:
    """Record of the exchanges of one linearised problem, and data of slip directions, ``(n,)`` unless stated.

    Attributes:
        released: contactors that have been released.
        turned: contactors whose slip has been reversed.
        begun: contactors that have begun to slip.
        stiffness: stiffness c.
        q: forces that define the slip directions ``(n, gdim)``.
        tau: force part of ``q`` ``(n, gdim)``.
    """

    released: Bools
    turned: Bools
    begun: Bools
    stiffness: Array
    q: Array
    tau: Array

    @classmethod
    def begin(cls, stiffness: Array, q: Array, tau: Array) -> Pivot:
        """The record before the first exchange."""
        none = np.zeros(len(stiffness), dtype=bool)
        return cls(none, none, none, stiffness, q, tau)


@dataclass(frozen=True)
class LastStep:
    """Data of the last step's end, for contactors that follow other nodes in a mean.

    Attributes:
        kinematics: of the contactors, with the weights of followed nodes.
        x: positions of the owned nodes ``(n_owned, gdim)``.
        motion: of a rigid target; None if it had not moved.
    """

    kinematics: Kinematics
    x: Array
    motion: Motion | None

    @property
    def ties(self) -> Ties:
        """Weights of followed nodes."""
        return self.kinematics.ties

    def renewed(self, config: Configuration, discretisation: Any) -> bool:
        """Whether nothing has moved since, so that small sliding may have renewed its rows (collective)."""
        if discretisation.traits.sliding != "small":
            return False
        still = self.motion is discretisation.target.motion and np.array_equal(self.x, config.x[: config.n_owned])
        return bool(reduced(config.comm, still, op=MPI.LAND))
