"""The displacement of a mesh at the nodes of another mesh of the same bodies, with which Newton's method begins there."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.bodies import bodies_in_order
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.rank_boxes import RankBoxes
from uem_dolfinx.parallel import Exchange, agreed, reduced
from uem_dolfinx.solve.checks import depends_on_path
from uem_dolfinx.solve.problem import UnitedProblem

#: Cells around a point, by their centres, of which the one is taken that the point is in or next to.
#: [bound; cells; test_first_guess.py::test_polynomials]
CANDIDATES = 16
#: Steps of Newton's method for the position of a point in a curved cell.
#: [bound; iterations; -]
INVERTED_IN = 5


def refuse_first_guess(problem: UnitedProblem) -> None:
    """Refuse problems whose solution depends on the path to it."""
    if what := depends_on_path(problem):
        raise InputError(f"solve_again: the problem has {what}, so that its solution depends on the path: leave solve_again out")


def carry_over(before: UnitedProblem, after: UnitedProblem) -> None:
    """Set the displacement of ``after`` to that of ``before``, interpolated in the cells of the same body (collective)."""
    old, new = before.config, after.config
    comm, g = new.comm, new.gdim
    n = old.mesh.topology.index_map(old.tdim).size_local
    cells = _Cells(old, n)
    body, count = bodies_in_order(old)
    of_cells = body[compat.cell_dofs(old.V)[:n, 0]]
    body, new_count = bodies_in_order(new)
    with agreed(comm):
        if count != new_count:
            raise InputError(f"solve_again: expected the same bodies on all meshes, found {count} and then {new_count}")
    points, of_points = new.X[: new.n_owned], body[: new.n_owned]
    # a point in a cell is nearer to its centre than the cell is wide
    within = np.full(len(points), reduced(comm, cells.width, op=MPI.MAX))
    boxes = RankBoxes(comm, cells.centres, kind=of_cells, n_kinds=count)
    exchange = Exchange(comm, boxes.near(points, within, kind=of_points))
    asked, kind = exchange.send(points, of_points)
    distance, values = np.full(len(asked), np.inf), np.zeros((len(asked), g))
    for k in range(count):
        rows, here = np.flatnonzero(kind == k), np.flatnonzero(of_cells == k)
        if len(rows) and len(here):
            distance[rows], values[rows] = cells.at(asked[rows], here)
    distance, values = exchange.back(distance, values)
    order = np.lexsort((distance, exchange.rows))
    row, first = np.unique(exchange.rows[order], return_index=True)
    new.u.x.array.reshape(-1, g)[row] = values[order[first]]
    new.u.x.scatter_forward()


class _Cells:
    """This rank's cells of a mesh with a displacement.

    Attributes:
        centres: of their vertices ``(n, gdim)``.
        width: largest distance of a node from one of these, at most.
    """

    def __init__(self, config: Configuration, n: int):
        self._cell, nodes = compat.cell_name(config.mesh), compat.geometry_dofs(config.mesh)[:n]
        self._X = config.mesh.geometry.x[nodes][:, :, : config.gdim]
        self._u = config.u.x.array.reshape(-1, config.gdim)[compat.cell_dofs(config.V)[:n]]
        self._vertices = len(forms.reference_topology(self._cell)[0])
        # degree of the cells, by the number of their nodes
        linear = nodes.shape[1] == self._vertices
        self._of_geometry = forms.create_lagrange_element(self._cell, 1 if linear else 2)
        self._of_displacement = forms.create_lagrange_element(self._cell, config.degree)
        self.centres = self._X[:, : self._vertices].mean(axis=1)
        self.width = float(np.ptp(self._X, axis=1).max(initial=0.0)) * np.sqrt(config.gdim)

    def at(self, points: Array, cells: Ints) -> tuple[Array, Array]:
        """Distances of points from the nearest of some cells ``(k,)``, and displacements at their closest points ``(k, gdim)``."""
        from scipy.spatial import cKDTree

        count = min(CANDIDATES, len(cells))
        near = cells[cKDTree(self.centres[cells]).query(points, count)[1].reshape(-1, count)]
        x, X = np.repeat(points, count, axis=0), self._X[near.ravel()]
        xi = self._inside(np.full(x.shape, 1.0 / self._vertices if self._simplex else 0.5))
        for _ in range(INVERTED_IN):
            table = self._of_geometry.tabulate(1, xi)[:, :, :, 0]
            away = x - np.einsum("km,kmg->kg", table[0], X)
            xi = self._inside(xi + np.linalg.solve(np.einsum("dkm,kmg->kgd", table[1:], X), away[:, :, None])[:, :, 0])
        N = self._of_geometry.tabulate(0, xi)[0, :, :, 0]
        distance = np.linalg.norm(x - np.einsum("km,kmg->kg", N, X), axis=1).reshape(near.shape)
        best = distance.argmin(axis=1)
        picked = np.arange(len(points)) * count + best
        N = self._of_displacement.tabulate(0, xi[picked])[0, :, :, 0]
        return distance.ravel()[picked], np.einsum("kn,kng->kg", N, self._u[near.ravel()[picked]])

    @property
    def _simplex(self) -> bool:
        return self._cell in ("triangle", "tetrahedron")

    def _inside(self, xi: Array) -> Array:
        """Points of the reference cell near others ``(k, tdim)``."""
        xi = np.clip(xi, 0.0, 1.0)
        return xi / np.maximum(xi.sum(axis=1, keepdims=True), 1.0) if self._simplex else xi
