"""Quadrature points of some cells: values of expressions, Functions of point values, sums and means.

Laws with history use arrays with one row per point.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.errors import InputError, SpaceError
from uem_dolfinx.geometry.axisymmetry import circumference, is_axisymmetric
from uem_dolfinx.geometry.tags import Part, as_tag
from uem_dolfinx.log import compiling
from uem_dolfinx.parallel import agree, reduced

#: How far the points that stand for the centre of a reference cell are from it in each coordinate; it enters results squared.
#: [convention; reference cell; test_thresholds_motion.py::test_points_beside_the_centre]
BESIDE_CENTRE = 1e-4
#: Directions of these points by dimension: sums of coordinates, and in 3D of products of two different ones, vanish.
DIRECTIONS = {2: [[1, 1], [-1, -1]], 3: [[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]}


def owned_cells(domain: Any, part: Part | None) -> Indices:
    """Owned local cells ``(n_cells,)``, ascending, of a part, see ``as_tag``, or of the whole mesh for None (collective)."""
    tdim = domain.topology.dim
    owned = domain.topology.index_map(tdim).size_local
    if part is None:
        return np.arange(owned, dtype=np.int32)
    entities = as_tag(part, domain, (tdim,), "the part of the material").entities
    return np.unique(entities[entities < owned]).astype(np.int32)


class QuadraturePoints:
    """Points of one quadrature rule in some owned cells; all methods use these cells only.

    Args:
        cells: local indices of owned cells ``(n_cells,)``.
        degree: of the rule; 0 is the cells' centre, for use together with other rules. It is replaced by points close to the centre:
            with a single point, FFCx treats gradients and Jacobians as constant in the cell, also at points of other rules.
    """

    def __init__(self, domain: Any, cells: Indices, degree: int):
        self.mesh, self.cells, self.degree = domain, cells, degree
        #: Function spaces by size of values, with the indices of the points in them.
        self._spaces: dict[int, tuple[fem.FunctionSpace, Indices]] = {}
        metadata: dict[str, Any] = {"quadrature_degree": degree}
        self.points, weights = forms.quadrature_rule(compat.cell_name(domain), degree)
        if degree == 0:
            #: on the reference cell, ``(n_points, tdim)``.
            self.points = self.points + BESIDE_CENTRE * np.array(DIRECTIONS[domain.topology.dim])
            weights = np.full(len(self.points), weights[0] / len(self.points))
            points = {"quadrature_points": self.points.tolist(), "quadrature_weights": weights.tolist()}
            metadata = {"quadrature_rule": "custom", **points}
        #: UFL measure over *all* cells by this rule; Functions of this rule are zero outside of ``cells`` unless written elsewhere.
        self.dx = ufl.dx(domain=domain, metadata=metadata)
        jacobian = self.evaluate(self.compile(ufl.JacobianDeterminant(domain)))
        #: of the points, of whole circles if the mesh is axisymmetric, ``(n_cells, n_points)``.
        self.volumes: Array = np.abs(jacobian.reshape(len(cells), len(weights))) * weights
        if is_axisymmetric(domain):
            self.volumes *= self.evaluate(self.compile(circumference(domain))).reshape(self.volumes.shape)

    def compile(self, expression: Any) -> fem.Expression:
        """Compile a scalar or vector UFL expression for ``evaluate``; to be done once."""
        with compiling("stresses at the quadrature points"):
            return compat.compile_expression(expression, self.points)

    def evaluate(self, compiled: fem.Expression) -> Array:
        """Present values ``(n_cells * n_points, size)``."""
        values = compat.evaluate(compiled, self.mesh, self.cells)
        return values.reshape(-1, values.shape[2])

    def create_function(self, name: str, size: int = 1) -> fem.Function:
        """A scalar or vector Function that is known at the points only, zero at first."""
        if size not in self._spaces:
            V = compat.quadrature_space(self.mesh, self.degree, () if size == 1 else (size,))
            self._spaces[size] = V, compat.cell_dofs(V)[self.cells].ravel()
        return fem.Function(self._spaces[size][0], name=name)

    def _rows(self, f: fem.Function) -> tuple[Array, Indices]:
        """All local values of a Function ``(n, size)``, a view, and the rows of the points."""
        size = f.function_space.dofmap.index_map_bs
        return f.x.array.reshape(-1, size), self._spaces[size][1]

    def read(self, f: fem.Function) -> Array:
        """Values of a Function ``(n_cells * n_points, size)``, a copy."""
        values, rows = self._rows(f)
        return np.asarray(values[rows])

    def write(self, f: fem.Function, new: Array) -> None:
        """Set the values of a Function; ghosts are left as they are."""
        values, rows = self._rows(f)
        values[rows] = new.reshape(len(rows), values.shape[1])

    def integrate(self, values: Array) -> float:
        """Integral of values ``(n_cells * n_points,)`` over the cells of all ranks (collective)."""
        return float(reduced(self.mesh.comm, values @ self.volumes.ravel()))

    def average(self, values: Array, f: fem.Function) -> None:
        """Fill a DG0 Function with the means over each cell of values ``(n_cells * n_points, size)`` (collective)."""
        means = np.einsum("cp,cps->cs", self.volumes, values.reshape(*self.volumes.shape, values.shape[1]))
        rows = compat.cell_dofs(f.function_space)[self.cells, 0]
        f.x.array.reshape(-1, means.shape[1])[rows] = means / self.volumes.sum(axis=1, keepdims=True)
        f.x.scatter_forward()

    def where(self, point: int) -> str:
        """Middle of the cell that holds a point, for error messages."""
        nodes = compat.geometry_dofs(self.mesh)[self.cells[point // len(self.points)]]
        return "(" + ", ".join(f"{x:.6g}" for x in self.mesh.geometry.x[nodes].mean(axis=0)[: self.mesh.geometry.dim]) + ")"

    def spread_from(self, others: QuadraturePoints) -> Array:
        """Values at these points of what other points of the cells give as a constant or (multi)linear: rows sum to 1."""
        if others.degree == 0:
            # the points around a centre count as one
            count = len(others.points)
            return np.full((len(self.points), count), 1.0 / count)
        linear = forms.create_lagrange_element(compat.cell_name(self.mesh), 1)
        at, known = (linear.tabulate(0, rule.points)[0].reshape(len(rule.points), -1) for rule in (self, others))
        spread = at @ np.linalg.pinv(known)
        return np.asarray(spread / spread.sum(axis=1, keepdims=True))

    def of_cells(self, name: str, value: Any, within: given.Range) -> Array:
        """Values of a parameter in the cells, refused on all ranks if they are out of range on any (collective)."""
        if not isinstance(value, fem.Function):
            number = np.asarray(value.value)[()] if isinstance(value, fem.Constant) else value
            return np.full(len(self.cells), given.number(name, number, within))
        V = value.function_space
        dofs = compat.cell_dofs(V)
        if V.mesh is not self.mesh or dofs.shape[1] != 1 or V.dofmap.index_map_bs != 1:
            expected = "expected a number, or a scalar DG0 Function of the displacement's mesh"
            raise SpaceError(f"{name} is a Function of {V}: {expected}")
        values = np.array(value.x.array[dofs[self.cells, 0]])
        bad, found = np.flatnonzero(~within.holds(values)), None
        if len(bad):
            where = self.where(bad[0] * len(self.points))
            found = InputError(f"{name} = {values[bad[0]]:.6g} in the cell at {where}: expected {within.words}")
        agree(self.mesh.comm, found)
        return values
