"""Coulomb's law: friction up to a coefficient times the force along the normal."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy.typing as npt

from uem_dolfinx.arrays import Array


@dataclass(frozen=True)
class Coulomb:
    """A contactor slips where the force along the target reaches ``mu lam``.

    Args:
        field: the coefficient mu, a number, or a function of place that is given reference points ``(3, n)`` and returns ``(n,)``.
    """

    field: float | Callable[[Array], npt.ArrayLike]
    per_area = False

    def limit(self, value: Array, lam: Array, area: Array) -> tuple[Array, Array]:
        """``mu lam`` and ``mu``; see ``FrictionLaw``."""
        return value * lam, value
