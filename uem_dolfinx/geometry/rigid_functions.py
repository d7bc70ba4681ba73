"""Functions of users' rigid surfaces, with arguments ``(3, n)`` as in DOLFINx, or ``(n, gdim)``.

The package always calls them with points ``(n, gdim)``. The shape returned by ``distance`` decides which kind they are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, cast

import numpy as np

from uem_dolfinx.arrays import Array, numbers_only

#: Functions are called with at least so many points: more than there are coordinates, so that shapes identify the axis of points.
#: [format; points; test_rigid.py::test_functions_of_places]
LEAST_POINTS = 5


class OfPoints:
    """Converts functions of ``(3, n)`` or ``(n, gdim)`` of a surface, all of one kind, to functions of points ``(n, gdim)``."""

    def __init__(self, distance: Callable[[Array], Any]):
        self._distance = distance
        #: Whether their argument has the shape ``(3, n)``; None before the first call of the distance.
        self._of_places: bool | None = None

    def of(self, f: Callable[[Array], Any]) -> Callable[[Array], Any]:
        """The same function for points ``(n, gdim)``, with one row per point in the result."""

        def evaluated(points: Array) -> Any:
            n, g = points.shape
            if n and self._takes_places(points):
                x = _places(points)
                return _rows(np.asarray(f(x), dtype=float), x.shape[1], g)[:n]
            values = f(points)
            if n and f is self._distance and np.shape(values) == (n,):
                self._of_places = False
            return values

        return evaluated

    def _takes_places(self, points: Array) -> bool:
        if self._of_places is None:
            x = _places(points)
            try:
                with np.errstate(all="ignore"):
                    takes_rows = np.shape(self._distance(x)) == (x.shape[1],)
            except Exception:  # of a function of points, or one that raises for these as well
                takes_rows = False
            if not takes_rows:
                return False
            self._of_places = True
        return self._of_places


def _places(points: Array) -> Array:
    """Points ``(n, gdim)`` as an array ``(3, n)``; few points are padded with copies of the last."""
    n, g = points.shape
    x = np.zeros((3, max(n, LEAST_POINTS)))
    x[:g, :n] = points.T
    x[:, n:] = x[:, n - 1 : n]
    return cast(Array, numbers_only(x))


def _rows(values: Array, n: int, g: int) -> Array:
    """Values at n points with one row per point and g components; other shapes are unchanged."""
    if values.shape[-1:] != (n,):
        return values
    return np.moveaxis(values[(slice(g),) * (values.ndim - 1)], -1, 0)
