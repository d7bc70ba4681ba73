"""Derivatives of load steps of a law with history by the initial history and by the law's parameters, in both modes.

Derivatives by fields at quadrature points are densities: per volume of the point.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.materials.quadrature_points import QuadraturePoints
from uem_dolfinx.materials.return_slopes import ByReturn
from uem_dolfinx.parallel import reduced


class PlasticSlopes:
    """Derivatives through the steps of one law, from the last to the first (the constructor is collective).

    Args:
        law: the law, with the initial values ``begins_with`` of its return and its parameters ``handed``.
        points: quadrature points of its stress.
        stress, bulk: Functions of its stress, and of its bulk modulus, in forms.
        along: returns the strain along a displacement, an expression with the components of the stress.
        back: derivatives of the return, see ``return_slopes``.
        a: adjoint displacement, a Function.
        test: test function of the displacement.

    Attributes:
        stress, bulk: as given.
    """

    def __init__(
        self, law: Any, points: QuadraturePoints, stress: fem.Function, bulk: fem.Function, along: Callable[[Any], Any],
        back: Callable[..., ByReturn], a: fem.Function, test: Any,
    ):  # fmt: skip
        self.stress, self.bulk, self._law, self._points, self._back = stress, bulk, law, points, back
        self._along_a = points.compile(along(a))
        size = stress.function_space.dofmap.index_map_bs
        self._pulled = points.create_function("pulled", size)
        self._V, self._load = a.function_space, forms.form(ufl.dot(self._pulled, along(test)) * points.dx)
        n = points.volumes.size
        self._by_stress = np.zeros((n, size))
        #: Derivatives by plastic strain and peeq at the end of the step, after ``pass_back`` at its beginning; forwards their changes.
        self._by_history = np.zeros((n, law.plastic_strain.function_space.dofmap.index_map_bs)), np.zeros(n)
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


class PlasticChanges(PlasticSlopes):
    """Changes through the steps of one law along a direction, from the first to the last; arguments as of ``PlasticSlopes``.

    The derivatives of a return in reverse mode, for each of its results in turn, are the rows of its Jacobian.
    """

    def begin_along(self, direction: Sequence[tuple[Any, Any]]) -> tuple[Array, fem.Function]:
        """Begin a step, with the law set to its end, along changes of parameters as passed to the law (collective).

        Returns:
            Changes at the same displacement, of the residual by the stress ``(n,)``, and of ``bulk``.
        """
        self._state = self._law.begins_with()
        n, k = self._by_stress.shape
        m = k + self._by_history[0].shape[1] + 1
        units = np.broadcast_to(np.eye(m)[:, None], (m, n, m))
        self._rows = [self._back(*self._state, unit[:, :k], unit[:, k:-1], unit[:, -1]) for unit in units]
        changes, known = {name: np.zeros(n) for name in self._law.handed}, self._law.parameters
        for name, value in self._law.handed.items():
            for m, change in direction:
                if m is value:
                    changes[name] += self._at_points(m, change)
        E, nu = changes["E"] / known["E"], changes["nu"]
        # of the logarithms of E / (1 + nu), E / (1 - nu) and E / 3 / (1 - 2 nu)
        logs = E - nu / (1 + known["nu"]), E + nu / (1 - known["nu"]), E + 2 * nu / (1 - 2 * known["nu"])
        self._explicit = np.stack(
            [
                row.shear * logs[0] + row.area * logs[1] + row.yield_stress * changes["yield_stress"] + row.hardening * changes["hardening"]
                for row in self._rows
            ]
        )  # fmt: skip
        self._points.write(self._pulled, self._after(np.zeros((n, k)))[:, :k])
        bulk = fem.Function(self.bulk.function_space)
        at = compat.cell_dofs(bulk.function_space)[self._points.cells, 0]
        bulk.x.array[at] = self.bulk.x.array[at] * logs[2].reshape(self._points.volumes.shape)[:, 0]
        bulk.x.scatter_forward()
        return forms.assemble_array(self._V, self._load), bulk

    def end(self) -> None:
        """End the step, with a, the change of the displacement (collective)."""
        found, k = self._after(self._points.evaluate(self._along_a)), self._by_stress.shape[1]
        self._by_history = found[:, k:-1], found[:, -1]

    def _after(self, strain: Array) -> Array:
        """Changes of stress, plastic strain and peeq after the return, with a change of the strain, side by side."""
        plastic, peeq = self._by_history
        parts = [(row.strain * strain + row.plastic_strain * plastic).sum(axis=1) + row.peeq * peeq for row in self._rows]
        return np.asarray((np.stack(parts) + self._explicit).T)

    def _at_points(self, m: Any, change: Any) -> Array:
        """Change of a parameter at the points ``(n,)``."""
        shape = self._points.volumes.shape
        if isinstance(m, fem.Constant):
            return np.full(shape[0] * shape[1], float(change))
        return np.repeat(change.x.array[compat.cell_dofs(change.function_space)[self._points.cells, 0]], shape[1])
