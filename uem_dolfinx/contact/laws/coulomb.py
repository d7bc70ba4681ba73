"""Friction up to a coefficient times the normal force (Coulomb), or up to a stress that does not depend on the pressure (Tresca)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError


@dataclass(frozen=True, init=False)
class Coulomb:
    """A contactor slips if the tangential force reaches ``mu lam``, or ``limit A`` or ``force`` if these are smaller.

    Args:
        field: the coefficient mu, a number, or a function of reference positions ``(3, n)`` that returns ``(n,)``.
        limit: the largest friction stress, a force per reference area, such as the shear yield stress of the softer body; None for
            no limit.
        force: the largest friction force on each contactor, for contactors given as points; None for no limit.

    Raises:
        InputError, InputTypeError: if ``limit`` or ``force`` is not a positive number, or both are given.
    """

    field: float | Callable[..., npt.ArrayLike]
    most: float | None
    force: float | None

    def __init__(self, field: float | Callable[..., npt.ArrayLike], limit: float | None = None, *, force: float | None = None):
        object.__setattr__(self, "field", field)
        object.__setattr__(self, "most", None if limit is None else given.number("limit", limit, given.POSITIVE))
        object.__setattr__(self, "force", None if force is None else given.number("force", force, given.POSITIVE))
        if self.most is not None and self.force is not None:
            raise InputError(
                f"limit = {limit}, force = {force}: a limit is a stress on facets or a force on points: give one of them"
            )

    @property
    def per_area(self) -> bool:
        """Whether there is a limit of stress."""
        return self.most is not None

    @property
    def per_point(self) -> bool:
        """Whether there is a limit of force."""
        return self.force is not None

    def limit(self, value: Array, lam: Array, area: Array) -> tuple[Array, Array]:
        """The minimum of ``mu lam`` and the limit, and mu or 0; see ``FrictionLaw``."""
        if self.most is None and self.force is None:
            return value * lam, value
        most = np.full_like(lam, self.force) if self.most is None else self.most * area
        below = value * lam < most
        return np.where(below, value * lam, most), np.where(below, value, 0.0)


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
