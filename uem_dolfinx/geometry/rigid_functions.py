"""Functions of users' rigid surfaces: of places ``(3, n)``, as all of DOLFINx's and friction's are, or of points ``(n, gdim)``.

Inside the package they are functions of points, whichever of the two they were written for: the shape of a distance tells.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array

#: Functions are asked about so many points at least: more than there are coordinates, so that shapes tell which axis is that of points.
#: [format; points; test_rigid.py::test_functions_of_places]
LEAST_POINTS = 5


class OfPoints:
    """Makes functions of points ``(n, gdim)`` of a surface's distance, gradient and hessian, which are all of one kind.

    Args:
        distance: of places ``(3, n)`` or points ``(n, gdim)``; returns ``(n,)``.
    """

    def __init__(self, distance: Callable[[Array], Any]):
        self._distance = distance
        #: Whether they are of places; None until the distance has been asked.
        self._of_places: bool | None = None

    def of(self, f: Callable[[Array], Any]) -> Callable[[Array], Any]:
        """A function of points ``(n, gdim)``: what it returns for these has one row for each point."""

        def asked(points: Array) -> Any:
            n, g = points.shape
            if n and self._takes_places(points):
                x = _places(points)
                return _rows(np.asarray(f(x), dtype=float), x.shape[1], g)[:n]
            values = f(points)
            if n and f is self._distance and np.shape(values) == (n,):
                self._of_places = False
            return values

        return asked

    def _takes_places(self, points: Array) -> bool:
        if self._of_places is None:
            x = _places(points)
            try:
                with np.errstate(all="ignore"):
                    told = np.shape(self._distance(x)) == (x.shape[1],)
            except Exception:  # of a function of points, or one that raises for these as well
                told = False
            if not told:
                return False
            self._of_places = True
        return self._of_places


def _places(points: Array) -> Array:
    """Points ``(n, gdim)`` as places ``(3, n)``, the last one again where they are few."""
    n, g = points.shape
    x = np.zeros((3, max(n, LEAST_POINTS)))
    x[:g, :n] = points.T
    x[:, n:] = x[:, n - 1 : n]
    return x


def _rows(values: Array, n: int, g: int) -> Array:
    """Values of n places with one row for each, of the coordinates that there are; others as they are."""
    if values.shape[-1:] != (n,):
        return values
    return np.moveaxis(values[(slice(g),) * (values.ndim - 1)], -1, 0)
