"""Soft contact by a table of gaps and pressures."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError, InputTypeError


@dataclass(frozen=True)
class PressureTable:
    """Pressures between the points of a table are linear; below its first gap they continue with its first slope, above its last one 0.

    Attributes:
        gaps: ascending.
        values: pressures, not increasing, the last one 0.
    """

    gaps: tuple[float, ...]
    values: tuple[float, ...]

    @classmethod
    def of(cls, table: Any) -> PressureTable:
        """The table of pairs ``(gap, pressure)``.

        Raises:
            InputTypeError: if it consists of no pairs of numbers.
            InputError: for gaps that do not ascend, or pressures that increase, are negative, or are not 0 at the last gap.
        """
        words = "two or more pairs (gap, pressure), gaps in ascending order, pressures that do not increase and end with 0"
        try:
            a = given.numbers(table)
        except (TypeError, ValueError):
            raise InputTypeError(given.sentence("p", table, words)) from None
        fits = a.ndim == 2 and a.shape[1:] == (2,) and len(a) > 1 and bool(np.isfinite(a).all())
        if not fits or not (np.diff(a[:, 0]) > 0).all() or (np.diff(a[:, 1]) > 0).any() or a[-1, 1] != 0.0 or a[0, 1] <= 0.0:
            raise InputError(given.sentence("p", table, words))
        return cls(*map(tuple, a.T.tolist()))

    @property
    def rest(self) -> float:
        """See ``PressureLaw``."""
        return self.gaps[self.values.index(0.0)]

    def pressure(self, gap: Array) -> tuple[Array, Array]:
        """See ``PressureLaw``."""
        g, p = np.array(self.gaps), np.array(self.values)
        # a point belongs to the piece before it
        i = np.maximum(np.searchsorted(g, gap) - 1, 0)
        slopes = np.append(np.diff(p) / np.diff(g), 0.0)
        return p[i] + slopes[i] * (gap - g[i]), slopes[i]
