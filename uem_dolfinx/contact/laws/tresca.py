"""Tresca's law: friction up to a stress that does not depend on the pressure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from uem_dolfinx.arrays import Array


@dataclass(frozen=True)
class Tresca:
    """A contactor in contact slips if the tangential force reaches ``tau A``.

    The matrix of the constrained system is symmetric, since test rows are the rows of P.

    Args:
        field: the stress tau, a force per reference area: a number, or a function of reference positions ``(3, n)`` that returns
            ``(n,)``.
    """

    field: float | Callable[[Array], npt.ArrayLike]
    per_area = True

    def limit(self, value: Array, lam: Array, area: Array) -> tuple[Array, Array]:
        """``tau A`` and 0; see ``FrictionLaw``."""
        return value * area, np.zeros_like(value)
