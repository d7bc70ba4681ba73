"""Yield curves: yield stress over the equivalent plastic strain at many points, and plastic increments of trial stresses."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.errors import InputError, InputTypeError
from uem_dolfinx.materials.return_mapping import MAX_STEPS, RETURNED


@dataclass(frozen=True)
class Voce:
    """Hardening that saturates: ``increase (1 - exp(-peeq / strain)) + slope peeq`` [Voce, Metallurgia 51 (1955) 219-226].

    Attributes:
        increase: total increase of the yield stress at saturation, a stress.
        strain: equivalent plastic strain at 63 % of this increase.
        slope: linear hardening in addition, a stress.

    Raises:
        InputError, InputTypeError: for an argument that is no number, not positive, or a negative slope.
    """

    increase: float
    strain: float
    slope: float = 0.0

    def __post_init__(self) -> None:
        given.number("increase", self.increase, given.POSITIVE)
        given.number("strain", self.strain, given.POSITIVE)
        given.number("slope", self.slope, given.NOT_NEGATIVE)


class YieldCurve(Protocol):
    """Yield stress over the equivalent plastic strain at n points; ``i (m,)`` are numbers of some points."""

    @property
    def parameters(self) -> dict[str, Array]:
        """Its parameters by name."""

    def at(self, peeq: Array, i: Ints) -> tuple[Array, Array]:
        """Yield stress and its slope at ``peeq (m,)``."""

    def increment(self, q: Array, peeq: Array, stiff: Array, i: Ints) -> Array:
        """Root ``dp (m,)`` of ``q - stiff dp = yield stress at (peeq + dp)``, for q above the yield stress at ``peeq``."""

    def work(self, peeq: Array) -> Array:
        """Integral of the yield stress from 0 to ``peeq (n,)``, zero without plastic flow."""


@dataclass(frozen=True)
class Linear:
    """``yield_stress + slope peeq``, both ``(n,)``; an infinite yield stress is elastic."""

    yield_stress: Array
    slope: Array

    @property
    def parameters(self) -> dict[str, Array]:
        """What it is made of, by name."""
        return {"yield_stress": self.yield_stress, "hardening": self.slope}

    def at(self, peeq: Array, i: Ints) -> tuple[Array, Array]:
        """Yield stress and its slope."""
        return self.yield_stress[i] + self.slope[i] * peeq, self.slope[i]

    def increment(self, q: Array, peeq: Array, stiff: Array, i: Ints) -> Array:
        """Both sides are linear."""
        return (q - self.at(peeq, i)[0]) / (stiff + self.slope[i])

    def work(self, peeq: Array) -> Array:
        """Integral of the yield stress."""
        return (np.where(peeq > 0, self.yield_stress, 0.0) + self.slope * peeq / 2) * peeq


@dataclass(frozen=True)
class Saturating:
    """Hardening by ``law`` from ``yield_stress (n,)``."""

    yield_stress: Array
    law: Voce

    @property
    def parameters(self) -> dict[str, Array]:
        """What it is made of, by name."""
        return {"yield_stress": self.yield_stress, "hardening": np.array([self.law.increase, self.law.strain, self.law.slope])}

    def at(self, peeq: Array, i: Ints) -> tuple[Array, Array]:
        """Yield stress and its slope."""
        law, rest = self.law, np.exp(-peeq / self.law.strain)
        stress = self.yield_stress[i] - law.increase * np.expm1(-peeq / law.strain) + law.slope * peeq
        return stress, law.increase / law.strain * rest + law.slope

    def increment(self, q: Array, peeq: Array, stiff: Array, i: Ints) -> Array:
        """The curve is concave: Newton's method from 0 approaches the root from the left."""
        dp = np.zeros_like(q)
        for _ in range(MAX_STEPS):
            stress, slope = self.at(peeq + dp, i)
            step = (q - stiff * dp - stress) / (stiff + slope)
            dp += step
            if (np.abs(step) <= RETURNED * dp).all():
                break
        return dp

    def work(self, peeq: Array) -> Array:
        """Integral of the yield stress."""
        law = self.law
        linear = (np.where(peeq > 0, self.yield_stress, 0.0) + law.slope * peeq / 2) * peeq
        return linear + law.increase * (peeq + law.strain * np.expm1(-peeq / law.strain))


@dataclass(frozen=True)
class Tabulated:
    """Straight lines between points ``(strains, stresses)``, each ``(m,)``, and ``slope`` beyond the last; the same everywhere."""

    strains: Array
    stresses: Array
    slope: float

    @property
    def parameters(self) -> dict[str, Array]:
        """What it is made of, by name."""
        return {"strains": self.strains, "yield_stress": self.stresses, "hardening": np.array([self.slope])}

    @property
    def _slopes(self) -> Array:
        """Behind each point."""
        return np.append(np.diff(self.stresses) / np.diff(self.strains), self.slope)

    def at(self, peeq: Array, i: Ints) -> tuple[Array, Array]:
        """Yield stress and its slope."""
        j = np.maximum(np.searchsorted(self.strains, peeq, side="right") - 1, 0)
        slope = self._slopes[j]
        return self.stresses[j] + slope * (peeq - self.strains[j]), slope

    def increment(self, q: Array, peeq: Array, stiff: Array, i: Ints) -> Array:
        """Both sides are monotone: the root lies behind the last point of the table at which ``q`` is not yet used up."""
        left = q[:, None] - self.stresses - stiff[:, None] * (self.strains - peeq[:, None])
        j = np.maximum((left >= 0).sum(axis=1) - 1, 0)
        slope = self._slopes[j]
        return self.strains[j] - peeq + np.take_along_axis(left, j[:, None], axis=1)[:, 0] / (stiff + slope)

    def work(self, peeq: Array) -> Array:
        """Integral of the yield stress."""
        until = np.append(0.0, np.cumsum(np.diff(self.strains) * (self.stresses[1:] + self.stresses[:-1]) / 2))
        j = np.maximum(np.searchsorted(self.strains, peeq, side="right") - 1, 0)
        beyond = peeq - self.strains[j]
        return until[j] + (self.stresses[j] + self._slopes[j] * beyond / 2) * beyond


def is_table(value: Any) -> bool:
    """Whether a parameter is given by points, and not as a number, a Function or a word."""
    return isinstance(value, (Sequence, np.ndarray)) and not isinstance(value, (str, bytes))


def read_pairs(what: str, points: Any, expected: str) -> tuple[Array, Array]:
    """Plastic strains from 0 upwards and stresses that do not fall, each ``(m,)``.

    Raises InputTypeError or InputError for other objects, with the expected form.
    """
    words = given.sentence(what, points, expected)
    try:
        table = given.numbers(points)
    except (TypeError, ValueError):
        raise InputTypeError(words) from None
    if table.ndim != 2 or table.shape[1:] != (2,) or not len(table) or not np.isfinite(table).all():
        raise InputError(words)
    strains, stresses = table.T
    if strains[0] != 0.0 or (np.diff(strains) <= 0).any() or (np.diff(stresses) < 0).any():
        raise InputError(words)
    return strains, stresses


def read_table(points: Any, slope: Any) -> Tabulated:
    """A table of equivalent plastic strain against yield stress, and the slope behind its last point.

    Raises InputTypeError or InputError for other objects, with the expected form.
    """
    expected = "pairs (plastic strain, yield stress), strains from 0 upwards, stresses positive and not falling"
    strains, stresses = read_pairs("yield_stress", points, expected)
    if stresses[0] <= 0:
        raise InputError(given.sentence("yield_stress", points, expected))
    return Tabulated(strains, stresses, given.number("hardening", slope, given.NOT_NEGATIVE))
