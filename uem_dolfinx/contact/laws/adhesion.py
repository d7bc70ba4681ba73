"""Adhesion: surfaces attract each other over a short range, reversibly, and take an energy per area to be separated."""

from __future__ import annotations

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array


class Adhesion(given.Sealed):
    """Attraction of surfaces by their gap, ``strength (1 - g / range)`` up to the ``range = 2 energy / strength``.

    Where surfaces touch, contact is hard; they separate at the strength, and adhere again when they touch. A large strength is the
    limit of Johnson, Kendall and Roberts (JKR), in which a sphere of radius R is pulled off by ``1.5 pi energy R``.

    Args:
        energy: of adhesion, an energy per area.
        strength: largest attraction, a force per area. The zone of attraction around a contact is of the length
            ``energy E* / strength^2``, which cells must resolve.

    Raises:
        InputError, InputTypeError: for numbers that are not positive.
    """

    #: Whether surfaces are bonded point to point.
    bonds = False

    def __init__(self, energy: float, strength: float):
        self.energy = given.number("energy", energy, given.POSITIVE)
        self.strength = given.number("strength", strength, given.POSITIVE)

    def __repr__(self) -> str:
        """With its numbers."""
        return f"Adhesion({self.energy:g}, {self.strength:g})"

    def attraction(self, gap: Array) -> tuple[Array, Array]:
        """Attractions, and their derivatives by the gap, at gaps ``(n,)``; constant below zero, where contact closes the gap."""
        reach = 2.0 * self.energy / self.strength
        within = (gap > 0.0) & (gap < reach)
        t = self.strength * np.clip(1.0 - gap / reach, 0.0, 1.0)
        return t, np.where(within, -self.strength / reach, 0.0)
