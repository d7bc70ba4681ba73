"""Coulomb's law: friction up to a coefficient times the force along the normal, and up to a stress if one is given."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array


@dataclass(frozen=True, init=False)
class Coulomb:
    """A contactor slips where the force along the target reaches ``mu lam``, or ``limit A`` if that is less.

    Args:
        field: the coefficient mu, a number, or a function of place that is given reference points ``(3, n)`` and returns ``(n,)``.
        limit: the largest stress that friction bears, a force per reference area, such as the yield stress in shear of the softer
            body; None for no limit.

    Raises:
        InputError, InputTypeError: if ``limit`` is no positive number.
    """

    field: float | Callable[[Array], npt.ArrayLike]
    most: float | None

    def __init__(self, field: float | Callable[[Array], npt.ArrayLike], limit: float | None = None):
        object.__setattr__(self, "field", field)
        object.__setattr__(self, "most", None if limit is None else given.number("limit", limit, given.POSITIVE))

    @property
    def per_area(self) -> bool:
        """Whether there is a limit."""
        return self.most is not None

    def limit(self, value: Array, lam: Array, area: Array) -> tuple[Array, Array]:
        """The less of ``mu lam`` and the limit's ``limit A``, and mu or 0; see ``FrictionLaw``."""
        if self.most is None:
            return value * lam, value
        below = value * lam < self.most * area
        return np.where(below, value * lam, self.most * area), np.where(below, value, 0.0)
