"""Thirion's law: a coefficient of friction that falls with the pressure, as of rubber and polymers."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array


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
