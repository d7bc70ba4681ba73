"""Central differences for nodes with mass; massless nodes follow in static equilibrium.

The massless surface of Doyen, Ern and Piperno, SIAM J. Sci. Comput. 33 (2011) 223-249.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from uem_dolfinx import given
from uem_dolfinx.arrays import Array


@dataclass(frozen=True)
class CentralDifferences:
    """Explicit time integration, without penalty and without coefficient of restitution; pass it to ``Dynamics`` as ``scheme``.

    With lumped masses M of the nodes I, and S the nodes without mass, contactors and target surfaces among them,

        v(n+1/2) = v(n) + dt/2 a(n)            u_I(n+1) = u_I(n) + dt v(n+1/2)
        F_S(u_I(n+1), u_S(n+1)) = contact forces, gaps closed and cones of friction met, as in statics
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

    def __post_init__(self) -> None:
        given.number("safety", self.safety, given.between(0.0, 1.0))

    def factor(self, dt: float) -> float:
        """Factor of M in the tangent: the surface has no mass."""
        return 0.0

    def ending(self, v: Array, a: Array, dt: float) -> tuple[float, Array, float, Array]:
        """Coefficients of the rates of the surface at the end of a step, see ``Scheme.ending``: no acceleration, the mean velocity."""
        return 0.0, 0.0 * a, 1.0 / dt, 0.0 * v
