"""How much force along the target contactors bear: a law of friction where contactors are, by their forces, areas and speeds of slip."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.laws.law import FrictionLaw, of_rate, slides_otherwise
from uem_dolfinx.contact.seam.placement import Kinematics

#: What is left of a limit that is proportional to the force along the normal, below this part of it, is rounding.
#: [bound; limit of friction; -]
ROUNDING = 1e-14


class Limits:
    """Limits of friction of the contactors of one interface.

    Args:
        areas: of the contactors' reference surface towards what they touch ``(n,)``, of normals ``(n, gdim)``, asked for by laws that
            need them; before contactors have been placed, for None, all of it (collective).
        duration: length of the present step, a time; None in statics.

    Attributes:
        law: of friction.
        value: of its parameter at the contactors ``(n,)``.
        area: that ``lam`` is an integral of the pressure over ``(n,)``; zeros unless the law needs it.
        speed: of slip in the present step ``(n,)``; zeros unless the law needs it.
    """

    law: FrictionLaw
    value: Array

    def __init__(self, areas: Callable[[Array | None], Array], duration: Callable[[], float] | None):
        self.areas_of, self.duration = areas, duration
        #: Forces along the normal that limits stay with while these change ``(n,)``.
        self._held: Array | None = None

    def set(self, law: FrictionLaw, value: Array) -> Array:
        """Take a law, and the values of its parameter ``(n,)``: the slopes of the cones of contactors that do not press (collective)."""
        self.law = law
        self.area = self.areas_of(None) if law.per_area else np.zeros(len(value))
        self.speed = np.zeros(len(value))
        return self.change(value)

    def change(self, value: Array) -> Array:
        """Take other values of the parameter ``(n,)``; returns as ``set`` does."""
        self.value = value
        return self.law.limit(value, np.zeros(len(value)), self.area)[1]

    def grow(self, kinematics: Kinematics) -> None:
        """Take the areas where contactors are now (collective)."""
        if self.law.per_area:
            self.area = kinematics.pressure_map(False).areas(self.areas_of(kinematics.projection.normal))

    def see(self, way: Array) -> None:
        """Take how far contactors have slipped in the present step ``(n,)``."""
        dt = 0.0 if self.duration is None else self.duration()
        if of_rate(self.law) and dt > 0.0:
            self.speed = way / dt

    def hold(self, lam: Array | None) -> Array:
        """Let limits be those of forces ``lam (n,)`` along the normal whatever these become, as in Tresca's law; None lets them follow.

        Returns:
            By how much a limit that was held has changed at most, and the largest one, on this rank ``(2,)``.
        """
        before, self._held = self._held, None if lam is None else np.maximum(lam, 0.0)
        if self._held is None:
            return np.zeros(2)
        now = self._stuck(self._held)[0]
        change = now if before is None else np.abs(now - self._stuck(before)[0])
        return np.array([change.max(initial=0.0), now.max(initial=0.0)])

    def of(self, lam: Array, slips: Bools) -> tuple[Array, Array, Array]:
        """Limits at forces ``lam (n,)`` along the normal of contactors of which some slip, and derivatives with ``lam`` and the slip."""
        lam = np.maximum(lam, 0.0) if self._held is None else self._held
        limit, slope = self._stuck(lam)
        rate = np.zeros_like(limit)
        if slides_otherwise(self.law):
            sliding = self.law.sliding(self.value, lam, self.area, self.speed)
            limit, slope, rate = (np.where(slips, new, old) for new, old in zip(sliding, (limit, slope, rate)))
            dt = 0.0 if self.duration is None else self.duration()
            rate = rate / dt if dt > 0.0 else np.zeros_like(rate)
        return limit, slope if self._held is None else np.zeros_like(slope), rate

    def cone(self, lam: Array, slips: Bools) -> tuple[Array, Array]:
        """Limits as linear functions of the force along the normal, about ``lam (n,)``: their values at 0 and slopes ``(n,)``."""
        limit, slope, _ = self.of(lam, slips)
        rest = limit - slope * np.maximum(lam, 0.0)
        return np.where(np.abs(rest) > ROUNDING * limit, rest, 0.0), slope

    def _stuck(self, lam: Array) -> tuple[Array, Array]:
        return self.law.limit(self.value, lam, self.area)
