"""Viscous friction: the shear traction of a film between the surfaces, by the slip speed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array


@dataclass(frozen=True, init=False)
class ViscousFriction:
    """Where surfaces touch, slip with the speed v is opposed by the traction ``eta v``, per reference area; nothing sticks.

        tau = min(eta v, mu p)

    The speed is that of the present time step, the slip over its length: the law is implicit, with a consistent tangent, and of first
    order in the step.

    Args:
        field: eta, the viscosity of a film over its thickness: a stress per speed, a number or a function as for ``Contact``.
        mu: coefficient of the largest traction, by the contact pressure p; infinite for none.

    Raises:
        InputError, InputTypeError: if a number is negative.
    """

    field: float | Callable[..., npt.ArrayLike]
    mu: float
    per_area = True
    timed = True

    def __init__(self, eta: float | Callable[..., npt.ArrayLike], *, mu: float = np.inf):
        object.__setattr__(self, "field", eta if given.function(eta) else given.number("eta", eta, given.NOT_NEGATIVE))
        object.__setattr__(self, "mu", given.number("mu", mu, given.POSITIVE_OR_INFINITE))

    def limit(self, value: Array, lam: Array, area: Array) -> tuple[Array, Array]:
        """Zero; see ``FrictionLaw``."""
        return 0.0 * lam, 0.0 * lam

    def sliding(self, value: Array, lam: Array, area: Array, speed: Array) -> tuple[Array, Array, Array]:
        """``min(eta A v, mu lam)`` and its derivatives; see ``RateLaw``."""
        viscous, rate, none = value * area * speed, value * area, np.zeros_like(lam)
        if np.isinf(self.mu):
            return viscous, none, rate
        full = viscous > self.mu * lam
        return np.where(full, self.mu * lam, viscous), np.where(full, self.mu, none), np.where(full, none, rate)
