"""Limits of friction at contactors from a law, by normal forces, areas and slip speeds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

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
        areas: function of target normals ``(n, gdim)`` that returns reference areas facing the target ``(n,)``, for laws that need
            them; for None, before the first placement, total areas (collective).
        duration: length of the present step, a time; None in statics.

    Attributes:
        value: parameter of the law at the contactors ``(n,)``.
        area: area of ``lam`` as an integral of the pressure ``(n,)``; zeros unless the law needs it.
        speed: slip speed in the present step ``(n,)``; zeros unless the law needs it.
    """

    law: FrictionLaw
    value: Array

    def __init__(self, areas: Callable[[Array | None], Array], duration: Callable[[], float] | None):
        self.areas_of, self.duration = areas, duration
        self.whole = False  # whether friction acts for whole steps with its force at the end

    def set(self, law: FrictionLaw, value: Array) -> None:
        """Set a law and the values of its parameter ``(n,)`` (collective)."""
        self.law, self.value = law, value
        self.area = self.areas_of(None) if law.per_area else np.zeros(len(value))
        self.speed = np.zeros(len(value))

    def act_whole_steps(self) -> None:
        """From now on friction acts for whole steps, with its force at the end."""
        self.whole = True

    def change(self, value: Array) -> None:
        """Set other values of the parameter ``(n,)``."""
        self.value = value

    def cones(self, lam: Array) -> Array:
        """Slopes of the cones that contain all forces which stick at normal forces ``lam (n,)``."""
        limit, slope = self._stuck(lam)
        return np.where(lam > 0, limit / np.where(lam > 0, lam, 1.0), slope)

    @property
    def given(self) -> tuple[Any, ...]:
        """What ``cone`` depends on in addition to its arguments; arrays are replaced, never changed."""
        return self.law, self.value, self.area, self.speed

    def grow(self, kinematics: Kinematics) -> None:
        """Update the areas to the current placement (collective)."""
        if self.law.per_area:
            self.area = kinematics.pressure_map(False).areas(self.areas_of(kinematics.projection.normal))

    def see(self, way: Array) -> None:
        """Set the slip of contactors in the present step ``(n,)``, for the speed."""
        dt = 0.0 if self.duration is None else self.duration()
        if of_rate(self.law) and dt > 0.0:
            self.speed = way / dt

    def of(self, lam: Array, slips: Bools) -> tuple[Array, Array, Array]:
        """Limits at normal forces ``lam (n,)``, of which some contactors slip, and derivatives by ``lam`` and the slip."""
        lam = np.maximum(lam, 0.0)
        limit, slope = self._stuck(lam)
        rate = none = np.zeros(len(limit))
        if slides_otherwise(self.law):
            sliding = self.law.sliding(self.value, lam, self.area, self.speed)
            limit, slope, rate = (np.where(slips, new, old) for new, old in zip(sliding, (limit, slope, rate)))
            dt = 0.0 if self.duration is None else self.duration()
            rate = rate / dt if dt > 0.0 else none
        return limit, slope, rate

    def cone(self, lam: Array, slips: Bools) -> tuple[Array, Array]:
        """Limits as linear functions of the normal force, about ``lam (n,)``: values at 0 and slopes ``(n,)``."""
        limit, slope, _ = self.of(lam, slips)
        rest = limit - slope * np.maximum(lam, 0.0)
        return np.where(np.abs(rest) > ROUNDING * limit, rest, 0.0), slope

    def _stuck(self, lam: Array) -> tuple[Array, Array]:
        return self.law.limit(self.value, lam, self.area)
