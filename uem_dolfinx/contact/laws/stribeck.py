"""Friction that depends on the slip speed (Stribeck, viscous films) or falls with the pressure (Thirion)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.laws.law import given_field


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


@dataclass(frozen=True, init=False)
class Thirion:
    """A contactor slips if the tangential force reaches ``mu(p) lam``, with ``1 / mu(p) = 1 / mu + p / stress`` at the pressure p.

    Coulomb's law at low pressures, and Tresca's at high ones: the friction stress tends to ``stress``, as the true area of contact does
    to the apparent one. Thirion, Les coefficients d'adherence du caoutchouc, Revue generale du caoutchouc 23 (1946) 101-106.

    Args:
        field: the coefficient mu at low pressure, a number, or a function as for ``Contact``.
        stress: the friction stress at high pressure, a force per reference area.

    Raises:
        InputError, InputTypeError: if ``stress`` is not a positive number.
    """

    field: float | Callable[..., npt.ArrayLike]
    stress: float
    per_area = True

    def __init__(self, field: float | Callable[..., npt.ArrayLike], stress: float):
        object.__setattr__(self, "field", field)
        object.__setattr__(self, "stress", given.number("stress", stress, given.POSITIVE))

    def limit(self, value: Array, lam: Array, area: Array) -> tuple[Array, Array]:
        """``mu(p) lam`` and its derivative; see ``FrictionLaw``."""
        most = self.stress * area
        share = np.where(area > 0.0, most / np.where(area > 0.0, most + value * lam, 1.0), 0.0)
        return share * value * lam, share**2 * value


@dataclass(frozen=True, init=False)
class ViscousFriction:
    """Where surfaces touch, slip with the speed v is opposed by the traction ``eta v``, per reference area, without sticking.

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
        object.__setattr__(self, "field", given_field("eta", eta, given.NOT_NEGATIVE))
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
