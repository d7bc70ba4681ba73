"""Time integration: relations between displacement, velocity and acceleration of a time step.

Central differences for nodes with mass; massless nodes follow in static equilibrium.

The massless surface of Doyen, Ern and Piperno, SIAM J. Sci. Comput. 33 (2011) 223-249.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError

#: Contacts may give the bodies this part of the energies at work in a step: of the largest kinetic energy and of what contact forces hold
#: in the surfaces that they press. [convention; energies at work; test_thresholds_motion.py::test_energy_given]
MOST_GIVEN = 2e-3
#: Steps in which contacts give energy are cut down to this part of the nominal length, and then accepted with a warning.
#: [convention; nominal length; test_thresholds_motion.py::test_energy_given]
SHORTEST_GIVEN = 1.0 / 128


@dataclass(frozen=True)
class Scheme:
    """Relations between displacement, velocity and acceleration of a time step.

    With G the static residual without contact forces, a step from n to n + 1 of length dt satisfies

        (1 - alpha_f) G(n+1) + alpha_f G(n) + M ((1 - alpha_m) a(n+1) + alpha_m a(n)) = contact forces, averaged as G
        u(n+1) = u(n) + dt v(n) + dt^2 ((1/2 - beta) a(n) + beta a(n+1))
        v(n+1) = v(n) + dt ((1 - gamma) a(n) + gamma a(n+1))

    Contact conditions hold at n + 1.

    Raises:
        InputError, InputTypeError: if beta is not positive, gamma below 1/2, or not ``alpha_m <= alpha_f <= 1/2``.
    """

    beta: float
    gamma: float
    alpha_m: float = 0.0
    alpha_f: float = 0.0
    explicit: ClassVar[bool] = False

    def __post_init__(self) -> None:
        for name in ("beta", "gamma", "alpha_m", "alpha_f"):
            given.number(name, getattr(self, name))
        if not (self.beta > 0.0 and self.gamma >= 0.5):
            raise InputError(
                f"beta = {self.beta:g}, gamma = {self.gamma:g}: expected a positive beta, since contact needs an implicit method, and a "
                "gamma of at least 1/2, since smaller values amplify all motions"
            )
        if not self.alpha_m <= self.alpha_f <= 0.5:
            raise InputError(
                f"alpha_m = {self.alpha_m:g}, alpha_f = {self.alpha_f:g}: expected alpha_m <= alpha_f <= 1/2, since other values amplify "
                "motions; generalised_alpha(rho_inf) computes suitable values"
            )

    def factor(self, dt: float) -> float:
        """Factor of M in the tangent of a step of length ``dt``."""
        return (1.0 - self.alpha_m) / (1.0 - self.alpha_f) * (1.0 / (self.beta * dt**2))

    @property
    def lasting(self) -> float:
        """Factor of ``M^-1 f`` in a(n+1) for forces f that are not averaged but act with their final values."""
        return (1.0 - self.alpha_f) / (1.0 - self.alpha_m)

    @property
    def impulse(self) -> float:
        """Impulse of such forces over f and the length of the step."""
        return self.gamma * self.lasting

    def ending(self, v: Array, a: Array, dt: float) -> tuple[float, Array, float, Array]:
        """Coefficients for the end of a step of length ``dt`` from velocity v and acceleration a.

        Returns:
            Rate and past, with ``a(n+1) = rate (u(n+1) - u(n)) + past``, and the same two for ``v(n+1)``. Differences of displacements
            reduce rounding.
        """
        a_rate = 1.0 / (self.beta * dt**2)
        a_past = -v / (self.beta * dt) - (0.5 / self.beta - 1.0) * a
        return a_rate, a_past, self.gamma * dt * a_rate, v + dt * ((1.0 - self.gamma) * a + self.gamma * a_past)


def newmark(beta: float = 0.25, gamma: float = 0.5) -> Scheme:
    """Newmark's method; by default the trapezoidal rule, which conserves the energy of linear bodies [UEM, 5].

    Args:
        beta: weight of the new acceleration in the displacement.
        gamma: weight of the new acceleration in the velocity; values above 1/2 add damping, but reduce the order to 1.

    Raises:
        InputError, InputTypeError: if beta is not positive or gamma below 1/2.
    """
    return Scheme(beta, gamma)


def generalised_alpha(rho_inf: float) -> Scheme:
    """Second-order method that damps unresolved high frequencies (Chung and Hulbert, J. Appl. Mech. 60, 1993, 371-375).

    Args:
        rho_inf: spectral radius at infinite frequency, from 0 to 1 (no damping).

    Raises:
        InputError, InputTypeError: if ``rho_inf`` is not between 0 and 1.
    """
    kept = given.Range("a spectral radius from 0 to 1", lambda part: 0.0 <= part <= 1.0)
    rho_inf = given.number("rho_inf", rho_inf, kept)
    alpha_m, alpha_f = (2 * rho_inf - 1) / (rho_inf + 1), rho_inf / (rho_inf + 1)
    return Scheme((1 - alpha_m + alpha_f) ** 2 / 4, 0.5 - alpha_m + alpha_f, alpha_m, alpha_f)


@dataclass(frozen=True)
class CentralDifferences:
    """Explicit time integration, without penalty and without coefficient of restitution; pass it to ``Dynamics`` as ``scheme``.

    With lumped masses M of the nodes I, and S the nodes without mass, contactors and target surfaces among them,

        v(n+1/2) = v(n) + dt/2 a(n)            u_I(n+1) = u_I(n) + dt v(n+1/2)
        F_S(u_I(n+1), u_S(n+1)) = contact forces, closed gaps and friction within its cones, as in statics
        a(n+1) = -M^-1 F_I(u(n+1))             v(n+1) = v(n+1/2) + dt/2 a(n+1)

    A step of bodies with linear elasticity multiplies by K instead of assembling the residual, unless their loads change. Where contact
    changes, and at first, the stiffness of the surface alone is factorised. With ``Dynamics(..., contactors="massy")`` all nodes move by
    their masses, and contact corrects them by the united system P'MP. Impacts of the surface's own mass are then plastic, and general
    contact and thin walls are supported. Source: Doyen, Ern, Piperno, SIAM J. Sci. Comput. 33 (2011) 223-249,
    https://doi.org/10.1137/100791440.

    Damping forms are those of the velocity in the middle of the step.

    Args:
        safety: steps that ``time_steps`` chooses are this part of the critical one, between 0 and 1.

    Raises:
        InputError, InputTypeError: if ``safety`` is not between 0 and 1.
    """

    safety: float = 0.9

    #: Weights of the beginning of a step in the equation of motion.
    alpha_m: ClassVar[float] = 0.0
    alpha_f: ClassVar[float] = 0.0
    explicit: ClassVar[bool] = True

    def __post_init__(self) -> None:
        given.number("safety", self.safety, given.between(0.0, 1.0))

    def factor(self, dt: float) -> float:
        """Factor of M in the tangent: the surface has no mass."""
        return 0.0

    def ending(self, v: Array, a: Array, dt: float) -> tuple[float, Array, float, Array]:
        """Coefficients of the rates of the surface at the end of a step, see ``Scheme.ending``: no acceleration, the mean velocity."""
        return 0.0, 0.0 * a, 1.0 / dt, 0.0 * v


def is_explicit(dynamics: Any) -> bool:
    """Whether these dynamics, or None, take explicit steps."""
    return dynamics is not None and bool(dynamics.scheme.explicit)
