"""What exchanges of a linearised problem have done to stick and slip, and what a step's end is to the next step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from uem_dolfinx.arrays import Array, Bools

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.slip_front import Front
    from uem_dolfinx.contact.seam.relative_motion import Ties
    from uem_dolfinx.geometry.rigid import Motion


@dataclass(frozen=True)
class Pivot:
    """What the exchanges of one linearised problem have done, and what directions of slip come from, ``(n,)`` each or as told.

    Attributes:
        released: contactors that have been let go of.
        turned: those whose slip has been turned back.
        begun: those that have begun to slip.
        taken: those that slip ahead of others.
        stiffness: c.
        q: forces that the directions of slip have ``(n, gdim)``.
        tau: of these the part that is force ``(n, gdim)``.
        front: where contactors begin to slip.
    """

    released: Bools
    turned: Bools
    begun: Bools
    taken: Bools
    stiffness: Array
    q: Array
    tau: Array
    front: Front

    @classmethod
    def begin(cls, front: Front, stiffness: Array, q: Array, tau: Array) -> Pivot:
        """Nothing is done yet."""
        none = np.zeros(len(stiffness), dtype=bool)
        return cls(none, none, none, none, stiffness, q, tau, front)


@dataclass(frozen=True)
class LastStep:
    """What contactors that follow others in a mean did at the end of the last step.

    Attributes:
        ties: by what they followed.
        x: positions of the owned nodes ``(n_owned, gdim)``.
        motion: of a rigid target; None if it had not moved.
        force_per_multiplier: see ``Kinematics``.
    """

    ties: Ties
    x: Array
    motion: Motion | None
    force_per_multiplier: Array
