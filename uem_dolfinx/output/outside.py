"""The surface of the undeformed bodies, by the vertices of this rank, and its gathering for drawings."""

from __future__ import annotations

from typing import Any

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.geometry.tags import Part
from uem_dolfinx.output.frames import boundary_and_cells, vertex_positions
from uem_dolfinx.solve.problem import UnitedProblem


class Outside:
    """Vertices and exterior facets (the constructor is collective).

    Args:
        problem: the problem.

    Attributes:
        X: positions of the d.o.f. of the mesh's P1 space ``(n_local, gdim)``.
        owned: mask of owned ones ``(n_local,)``.
        faces: d.o.f. around each owned exterior facet ``(m, k)``.
        cells: the cells behind them ``(m,)``.
        normals: outward unit normals at vertices, zero inside ``(n_local, gdim)``.
    """

    def __init__(self, problem: UnitedProblem):
        self.config, self.comm = problem.config, problem.comm
        self.mesh, self.gdim = problem.config.mesh, problem.config.gdim
        self.X = vertex_positions(problem, 0.0)
        self.owned: Bools = np.arange(len(self.X)) < compat.function_space(self.mesh, 1).dofmap.index_map.size_local
        self.faces, self.cells = boundary_and_cells(self.mesh)
        self.normals = self._outward()

    def gather(self, *arrays: Any) -> list[Any] | None:
        """Arrays of all ranks, one after the other, on rank 0 (collective)."""
        parts = self.comm.gather(arrays)
        return None if parts is None else [np.concatenate(column) for column in zip(*parts)]

    def facets(self, which: Any = slice(None), part: Part | None = None) -> tuple[Array, Array]:
        """Corners ``(m, k, gdim)`` and outward normals ``(m, gdim)`` of owned exterior facets, some or of a part (collective)."""
        faces, cells = (self.faces, self.cells) if part is None else boundary_and_cells(self.mesh, part)
        vectors = _area_vectors(self.X, faces[which], compat.cell_dofs(compat.function_space(self.mesh, 1))[cells[which]])
        return self.X[faces[which]], vectors / np.linalg.norm(vectors, axis=1, keepdims=True)

    def _outward(self) -> Array:
        """Outward unit normals at the vertices, zero inside ``(n_local, gdim)`` (collective)."""
        field = fem.Function(compat.function_space(self.mesh, 1, (self.gdim,)))
        n = field.x.array.reshape(-1, self.gdim)
        behind = compat.cell_dofs(compat.function_space(self.mesh, 1))[self.cells]
        vectors = _area_vectors(self.X, self.faces, behind)
        for k in range(self.faces.shape[1]):
            np.add.at(n, self.faces[:, k], vectors)
        forms.sum_ghosts(field)
        length = np.linalg.norm(n, axis=1, keepdims=True)
        return np.divide(n, length, out=np.zeros_like(n), where=length > 0)

    def at_vertices(self, values: Array) -> Array:
        """Values at vertices ``(n_local of P1, k)``, from values at nodes ``(n_local, k)`` (collective)."""
        config, shape = self.config, (values.shape[1],) if values.shape[1] > 1 else ()
        field = fem.Function(compat.function_space(self.mesh, config.degree, shape))
        linear = fem.Function(compat.function_space(self.mesh, 1, shape))
        field.x.array[:] = values.ravel()
        linear.interpolate(field)
        linear.x.scatter_forward()
        return np.array(linear.x.array.reshape(-1, values.shape[1]))

    def touched(self, which: Bools) -> Bools:
        """Mask of vertices ``(n_local,)`` of owned facets in a mask, including facets of other ranks (collective)."""
        field = fem.Function(compat.function_space(self.mesh, 1))
        field.x.array[self.faces[which].ravel()] = 1.0
        forms.sum_ghosts(field)
        return np.asarray(field.x.array > 0)

    def body_of_cells(self) -> tuple[Ints, Ints]:
        """Body of each local cell, and the cell's number in the mesh's input ``(n_cells,)`` (collective)."""
        label, _ = find_bodies(self.config)
        first = compat.cell_dofs(self.config.V)[:, 0]
        return label[first], forms.original_cells(self.mesh)[: len(first)]


def _area_vectors(X: Array, faces: Ints, behind: Indices) -> Array:
    """Outward normals of facets, proportional to their areas ``(m, gdim)``; ``behind`` are vertices of the cells behind them."""
    corners = X[faces]
    a = corners[:, 1] - corners[:, 0]
    n = np.column_stack([a[:, 1], -a[:, 0]]) if X.shape[1] == 2 else np.cross(a, corners[:, 2] - corners[:, 0])
    inward = X[behind].mean(axis=1) - corners.mean(axis=1)
    return np.asarray(-np.sign(np.einsum("mg,mg->m", n, inward))[:, None] * n)
