"""Nodes of a scalar field that is the only unknown, such as a temperature: one unknown each, and fixed positions."""

from __future__ import annotations

from typing import Any

from uem_dolfinx import compat
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import SpaceError
from uem_dolfinx.geometry.axisymmetry import is_axisymmetric
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Nodes


class ScalarConfiguration(Configuration):
    """Nodes of a scalar Lagrange space; arrays of its values have one component, ``(n, 1)``, where others have gdim.

    Raises:
        SpaceError: if ``u`` is in no Lagrange space of degree 1 or 2, or on a surface in space.
    """

    moves, name = False, "field"

    def _take(self, V: Any) -> None:
        degree, self.tdim = compat.lagrange_degree(V), V.mesh.topology.dim
        if degree not in (1, 2) or self.tdim != V.mesh.geometry.dim:
            raise SpaceError(
                f"u is a scalar field of a space {V.ufl_element()} on cells of dimension {self.tdim} in {V.mesh.geometry.dim}D: expected "
                "a Lagrange space of degree 1 or 2 on cells of the dimension of their space"
            )
        self.degree: int = degree
        Nodes.__init__(self, V)
        self.axisymmetric = is_axisymmetric(V.mesh)

    def place_of(self, unknown: int) -> str:
        """Position of the node of a local unknown, for error messages."""
        return f"the value at {self.describe(unknown)}"

    @property
    def x(self) -> Array:
        """Positions of the local nodes ``(n_local, gdim)``: the reference positions."""
        return self.X

    def modes(self, centred: bool = False) -> Array:
        """The constant field, which conduction does not resist ``(n_owned, 1, 1)``."""
        return Nodes.modes(self, centred)

    def of_circles(self, vectors: Array) -> Array:
        """The unchanged vectors: sums of scalars around an axis do not cancel."""
        return vectors
