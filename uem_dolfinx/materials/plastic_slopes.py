"""How load steps of a law with history depend on the history that they began with, and on the law's parameters; backwards alone.

Derivatives by fields at quadrature points are densities: per volume that belongs to the point.
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
    """Derivatives through the steps of one law, handed back from the last to the first (making one is collective).

    Args:
        law: which knows what its return ``begins_with``, and the parameters it was ``handed``.
        points: quadrature points of its stress.
        stress, bulk: Functions that stand for its stress, and for its bulk modulus, in forms.
        along: makes of a displacement the strain along it, an expression with the components of ``Returned``.
        a: of the adjoint problem, a Function that strains are taken along.
        test: test function of the displacement.

    Attributes:
        stress, bulk: likewise.
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
        #: Derivatives by plastic strain and peeq, of the step's end, then of its beginning.
        self._by_history = np.zeros((n, size)), np.zeros(n)
        self._state: tuple[Array, ...] = ()

    def begin(self, by_stress: Array | None) -> None:
        """Take the step that the law has been brought to the end of.

        Args:
            by_stress: derivative of a functional by the owned values of ``stress``; None where it holds none.
        """
        self._state = self._law.begins_with()
        self._by_stress = np.zeros_like(self._by_stress)
        if by_stress is not None:
            values = self._points.create_function("by stress", self._by_stress.shape[1])
            values.x.array[: len(by_stress)] = by_stress
            self._by_stress = self._points.read(values) / self._points.volumes.reshape(-1, 1)

    def load(self) -> Array:
        """Derivative through stress and history at the step's end by the owned displacement there ``(n,)`` (collective)."""
        self._points.write(self._pulled, self._back(*self._state, self._by_stress, *self._by_history).strain)
        return forms.assemble_array(self._V, self._load)

    def pass_back(self) -> ByReturn:
        """Take derivatives by the history that the step began with, with a of the adjoint problem; returns all (collective)."""
        stress = self._by_stress - self._points.evaluate(self._along_a)
        by = self._back(*self._state, stress, *self._by_history)
        self._by_history = by.plastic_strain, by.peeq
        return by

    def is_made_of(self, m: Any) -> bool:
        """Whether a control is a parameter of the law."""
        return any(m is value for value in self._law.handed.values())

    def by_parameter(self, m: fem.Constant | fem.Function, by: ByReturn, by_bulk: fem.Function) -> Array | fem.Function:
        """Derivative by a parameter, of its kind (collective).

        Args:
            m: as it was handed to the law.
            by: as ``pass_back`` returned it.
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
