"""Derivatives of load steps of a law with history by the initial history and by the law's parameters; in reverse mode only.

Derivatives by fields at quadrature points are densities: per volume of the point.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.materials.quadrature_points import QuadraturePoints
from uem_dolfinx.materials.return_slopes import ByReturn, plane_stress_back, radial_back
from uem_dolfinx.parallel import reduced


class PlasticSlopes:
    """Derivatives through the steps of one law, from the last to the first (the constructor is collective).

    Args:
        law: the law, with the initial values ``begins_with`` of its return and its parameters ``handed``.
        points: quadrature points of its stress.
        stress, bulk: Functions of its stress, and of its bulk modulus, in forms.
        along: returns the strain along a displacement, an expression with the components of ``Returned``.
        a: adjoint displacement, a Function.
        test: test function of the displacement.

    Attributes:
        stress, bulk: as given.
    """

    def __init__(
        self, law: Any, points: QuadraturePoints, stress: fem.Function, bulk: fem.Function, along: Callable[[Any], Any],
        a: fem.Function, test: Any,
    ):  # fmt: skip
        self.stress, self.bulk, self._law, self._points = stress, bulk, law, points
        self._back: Callable[..., ByReturn] = plane_stress_back if law.kind == "plane_stress" else radial_back
        self._along_a = points.compile(along(a))
        size = stress.function_space.dofmap.index_map_bs
        self._pulled = points.create_function("pulled", size)
        self._V, self._load = a.function_space, forms.form(ufl.dot(self._pulled, along(test)) * points.dx)
        n = points.volumes.size
        self._by_stress = np.zeros((n, size))
        #: Derivatives by plastic strain and peeq at the end of the step, after ``pass_back`` at its beginning.
        self._by_history = np.zeros((n, size)), np.zeros(n)
        self._state: tuple[Array, ...] = ()

    def begin(self, by_stress: Array | None) -> None:
        """Begin a step, with the law set to its end.

        Args:
            by_stress: derivative of a functional by the owned values of ``stress``, or None.
        """
        self._state = self._law.begins_with()
        self._by_stress = np.zeros_like(self._by_stress)
        if by_stress is not None:
            values = self._points.create_function("by stress", self._by_stress.shape[1])
            values.x.array[: len(by_stress)] = by_stress
            self._by_stress = self._points.read(values) / self._points.volumes.reshape(-1, 1)

    def load(self) -> Array:
        """Derivative by the owned displacement at the step's end ``(n,)``, through stress and history there (collective)."""
        self._points.write(self._pulled, self._back(*self._state, self._by_stress, *self._by_history).strain)
        return forms.assemble_array(self._V, self._load)

    def pass_back(self) -> ByReturn:
        """Compute derivatives by the initial history of the step, with the adjoint displacement a; returns all (collective)."""
        stress = self._by_stress - self._points.evaluate(self._along_a)
        by = self._back(*self._state, stress, *self._by_history)
        self._by_history = by.plastic_strain, by.peeq
        return by

    def is_made_of(self, m: Any) -> bool:
        """Whether a control is a parameter of the law."""
        return any(m is value for value in self._law.handed.values())

    def by_parameter(self, m: fem.Constant | fem.Function, by: ByReturn, by_bulk: fem.Function) -> Array | fem.Function:
        """Derivative by a parameter, of its type (collective).

        Args:
            m: the parameter as passed to the law.
            by: as returned by ``pass_back``.
            by_bulk: derivative by the values of ``bulk``.
        """
        points, known = self._points, self._law.parameters
        volumes, of_cells, E, nu = self._points.volumes, np.zeros(len(points.cells)), known["E"], known["nu"]
        at_points = {
            "E": (by.shear + by.area) / E,
            "nu": by.area / (1 - nu) - by.shear / (1 + nu),
            "yield_stress": by.yield_stress,
            "hardening": by.hardening,
        }
        # of the bulk modulus, E / 3 / (1 - 2 nu)
        rates = {"E": 1 / E, "nu": 2 / (1 - 2 * nu)}
        at = compat.cell_dofs(by_bulk.function_space)[points.cells, 0]
        of_bulk = by_bulk.x.array[at] * self.bulk.x.array[at]
        for name, value in self._law.handed.items():
            if value is m:
                of_cells += (at_points[name].reshape(volumes.shape) * volumes).sum(axis=1)
                of_cells += of_bulk * (rates[name].reshape(volumes.shape)[:, 0] if name in rates else 0.0)
        if isinstance(m, fem.Constant):
            return np.asarray(reduced(points.mesh.comm, float(of_cells.sum())))
        found = fem.Function(m.function_space)
        found.x.array[compat.cell_dofs(m.function_space)[points.cells, 0]] = of_cells
        found.x.scatter_forward()
        return found
