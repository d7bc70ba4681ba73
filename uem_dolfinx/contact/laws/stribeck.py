"""Friction that depends on the slip speed, with static and kinetic coefficients and a transition between them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array


@dataclass(frozen=True, init=False)
class Stribeck:
    """A contactor begins to slip at ``static lam``, and slips at ``mu(v) lam`` with the speed v of its slip.

        mu(v) = kinetic + (static - kinetic) exp(-v / velocity) + viscous v

    With ``velocity=0`` mu falls to ``kinetic`` at once (stiction). The speed is that of the present time step, the slip over its
    length: the law is implicit, with a consistent tangent, and of first order in the step. If friction decreases with the speed so
    fast that ``-mu' lam / dt > k``, with the stiffness k of the surface, a step has several solutions, as with stiction; the one
    that is found continues to slip.

    Args:
        field: the static coefficient, a number, or a function as for ``Contact``; no friction where it is 0.
        kinetic: coefficient at high speed.
        velocity: speed at which the difference has decreased to ``1/e``, or 0.
        viscous: growth with the speed, one over a speed.

    Raises:
        InputError, InputTypeError: if a number is negative.
    """

    field: float | Callable[..., npt.ArrayLike]
    kinetic: float
    velocity: float
    viscous: float
    per_area = False

    def __init__(
        self, static: float | Callable[..., npt.ArrayLike], kinetic: float, velocity: float = 0.0, *, viscous: float = 0.0
    ):
        object.__setattr__(self, "field", static)
        for name, value in (("kinetic", kinetic), ("velocity", velocity), ("viscous", viscous)):
            object.__setattr__(self, name, given.number(name, value, given.NOT_NEGATIVE))

    @property
    def timed(self) -> bool:
        """Whether mu depends on the slip speed, not only on stick or slip."""
        return self.velocity > 0.0 or self.viscous > 0.0

    def limit(self, value: Array, lam: Array, area: Array) -> tuple[Array, Array]:
        """``static lam`` and static; see ``FrictionLaw``."""
        return value * lam, value

    def sliding(self, value: Array, lam: Array, area: Array, speed: Array) -> tuple[Array, Array, Array]:
        """``mu lam``, mu and ``mu' lam``; see ``RateLaw``."""
        above, slope = np.zeros_like(value), np.full_like(value, self.viscous)
        if self.velocity > 0.0:
            above = (value - self.kinetic) * np.exp(-speed / self.velocity)
            slope = slope - above / self.velocity
        mu = self.kinetic + above + self.viscous * speed
        return mu * lam, mu, slope * lam
