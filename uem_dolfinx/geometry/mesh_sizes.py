"""Sizes of cells for Gmsh, given on the cells of another mesh of the same bodies."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.geometry.cells import FILLED_BY

#: Sizes grow by at most this part of the way from one cell to the next, so that cells have good shapes.
#: [convention; size over distance; test_mesh_sizes.py::test_sizes_grow_slowly]
GROWTH = 0.5
#: Digits of sizes, relative, by which these do not depend on the number of ranks. [bound; digits; test_adapt.py::test_partitions]
DIGITS = 6
#: Options of Gmsh by which other sizes would count, and values by which they do not.
OTHERS = {
    "Mesh.MeshSizeExtendFromBoundary": 0.0, "Mesh.MeshSizeFromPoints": 0.0, "Mesh.MeshSizeFromCurvature": 0.0, "Mesh.MeshSizeMin": 0.0,
    "Mesh.MeshSizeMax": 1e22, "Mesh.MeshSizeFactor": 1.0,
}  # fmt: skip
#: Gmsh gives sizes to triangles and tetrahedra; quadrilaterals and hexahedra that these are subdivided into are so much smaller.
#: [convention; size; test_mesh_sizes.py::test_subdivided_cells_have_their_sizes]
SUBDIVIDED = 2.5

#: Copies of simplices at the boundary are so many times as large, so that they reach to arcs of 90 degrees along a side.
#: [bound; size of a cell; test_mesh_sizes.py::test_arcs_outside_coarse_cells]
ENLARGED = 2.0


class MeshSizes:
    """Lengths of edges that Gmsh is to give cells, linear in the cells of an earlier mesh (collective).

    Args:
        mesh: the earlier mesh.
        sizes: at its owned cells ``(n,)``, lengths.

    Attributes:
        cell: name of the earlier mesh's cells.
        points: their vertices on rank 0 ``(m, n_vertices, gdim)``; empty on other ranks.
        values: sizes there ``(m, n_vertices)``.
        body: number of the body of each cell ``(m,)``: cells with common vertices.
    """

    def __init__(self, mesh: Any, sizes: Array):
        self.cell = compat.cell_name(mesh)
        n, n_vertices = len(sizes), len(forms.reference_topology(self.cell)[0])
        local = compat.geometry_dofs(mesh)[:n, :n_vertices]
        number = mesh.geometry.index_map().local_to_global(local.ravel()).reshape(local.shape)
        x = mesh.geometry.x[local][:, :, : mesh.geometry.dim]
        found = [mesh.comm.gather(part) for part in (number, x, sizes)]
        numbers, self.points, sizes = (
            np.concatenate(parts) if parts else part[:0] for parts, part in zip(found, (number, x, sizes))
        )
        self.values: Array = np.zeros((0, n_vertices))
        self.body: Ints = np.zeros(0, np.int64)
        if mesh.comm.rank == 0:
            from scipy.sparse import coo_matrix
            from scipy.sparse.csgraph import connected_components

            # the same order and the same digits on any ranks, since Gmsh makes other meshes of sizes that differ by rounding
            order = np.lexsort(self.points.reshape(len(sizes), -1).T)
            numbers, self.points, sizes = numbers[order], self.points[order], sizes[order]
            known, vertices = np.unique(numbers, return_inverse=True)
            vertices, count = vertices.reshape(numbers.shape), len(known)
            self.values = np.exp(np.round(np.log(graded(vertices, count, self.points, sizes)), DIGITS))
            edges = vertices[:, [0] * (n_vertices - 1)].ravel(), vertices[:, 1:].ravel()
            of_vertices = connected_components(coo_matrix((np.ones(len(edges[0])), edges), shape=(count, count)))[1]
            self.body = of_vertices[vertices[:, 0]].astype(np.int64)

    @contextmanager
    def within(self, gmsh: Any) -> Iterator[None]:
        """Mesh with these sizes, on rank 0."""
        before = {name: gmsh.option.getNumber(name) for name in OTHERS}
        field, fields = gmsh.model.mesh.field, []
        views: list[int] = []
        for b, entities in enumerate(self._entities(gmsh) if self.body.any() else [[]]):
            of_body = self._of_body(gmsh, self.body == b, views)
            fields.append(field.add("Restrict") if entities else of_body)
            if entities:
                field.setNumber(fields[-1], "InField", of_body)
            for name, tags in zip(("CurvesList", "SurfacesList", "VolumesList"), entities):
                field.setNumbers(fields[-1], name, tags)
        both = field.add("Min")
        field.setNumbers(both, "FieldsList", fields)
        field.setAsBackgroundMesh(both)
        try:
            for name, value in OTHERS.items():
                gmsh.option.setNumber(name, value)
            if gmsh.option.getNumber("Mesh.SubdivisionAlgorithm"):
                gmsh.option.setNumber("Mesh.MeshSizeFactor", SUBDIVIDED)
            yield
        finally:
            for name, value in before.items():
                gmsh.option.setNumber(name, value)
            for view in views:
                gmsh.view.remove(view)

    def _of_body(self, gmsh: Any, here: Bools, views: list[int]) -> int:
        """A field of Gmsh with the sizes of a body's cells; ``views`` are those that it made so far."""
        corners, field = np.array(FILLED_BY[self.cell]), gmsh.model.mesh.field
        gdim, k = self.points.shape[2], corners.shape[1]
        points, values = self.points[here][:, corners].reshape(-1, k, gdim), self.values[here][:, corners].reshape(-1, k)
        fields = []
        for x, at in ((points, values), _beyond(points, values)):
            lists = np.zeros((len(x), 3, k))
            lists[:, :gdim] = x.transpose(0, 2, 1)
            views.append(gmsh.view.add("sizes"))
            data = np.concatenate([lists.reshape(len(x), -1), at], axis=1)
            gmsh.view.addListData(views[-1], "ST" if k == 3 else "SS", len(x), data.ravel().tolist())
            fields.append(field.add("PostView"))
            field.setNumber(fields[-1], "ViewTag", views[-1])
            if compat.gmsh_takes_closest(gmsh):
                field.setNumber(fields[-1], "UseClosest", 0)
        # Gmsh finds any of the simplices that hold a point, and a huge size without one: copies count outside the body alone
        both, none = field.add("MathEval"), 2 * values.max()
        body, copies = (f"F{tag}" for tag in fields)
        field.setString(both, "F", f"{body} * step({none} - {body}) + {copies} * step({body} - {none})")
        return int(both)

    def _entities(self, gmsh: Any) -> list[list[list[int]]]:
        """Curves, surfaces and volumes of Gmsh's geometry in each body: where they touch, these differ though points are the same.

        A surface in the plane, or a volume, belongs to the body whose cells are nearest to most cells that Gmsh gives it by itself.
        """
        from scipy.spatial import cKDTree

        dim = len(FILLED_BY[self.cell][0]) - 1
        found: list[list[list[int]]] = [[[], [], []] for _ in range(self.body.max() + 1)]
        left = {d: {tag for _, tag in gmsh.model.getEntities(d)} for d in (1, 2, 3)}
        middles = cKDTree(self.points.mean(axis=1))
        gmsh.model.mesh.generate(dim)
        for entity in gmsh.model.getEntities(dim):
            parts = [
                gmsh.model.mesh.getBarycenters(kind, entity[1], False, True) for kind in gmsh.model.mesh.getElementTypes(*entity)
            ]
            points = np.concatenate([*parts, np.zeros(0)]).reshape(-1, 3)[:, : self.points.shape[2]]
            nearest = int(np.bincount(self.body[middles.query(points)[1]], minlength=1).argmax())
            surfaces = [entity] if dim == 2 else gmsh.model.getBoundary([entity], oriented=False)
            curves = gmsh.model.getBoundary(surfaces, combined=False, oriented=False)
            for d, tag in {entity, *surfaces, *curves}:
                found[nearest][d - 1].append(tag)
                left[d].discard(tag)
        gmsh.model.mesh.clear()
        # curves within a surface, and others that bound nothing
        return [[[*tags, *left[d]] for d, tags in enumerate(of_body, start=1)] for of_body in found]


def _beyond(points: Array, values: Array) -> tuple[Array, Array]:
    """Copies of simplices ``(m, k, gdim)`` at the boundary and of their values ``(m, k)``, which reach to curved boundaries outside.

    Gmsh 4.8 knows no size where there is no simplex, and meshes such boundaries much coarser.
    """
    m, k = values.shape
    vertex = np.unique(points.reshape(m * k, -1), axis=0, return_inverse=True)[1].reshape(m, k)
    facets = np.sort(np.concatenate([np.delete(vertex, i, axis=1) for i in range(k)]), axis=1)
    alone, times = np.unique(facets, axis=0, return_counts=True)
    outside = np.isin(vertex, alone[times == 1]).any(axis=1)
    middle, mean = points[outside].mean(axis=1, keepdims=True), values[outside].mean(axis=1, keepdims=True)
    there = np.maximum(mean + ENLARGED * (values[outside] - mean), values[outside].min(axis=1, keepdims=True))
    return middle + ENLARGED * (points[outside] - middle), there


def graded(vertices: Ints, count: int, points: Array, sizes: Array) -> Array:
    """Sizes at the vertices of cells ``(m, k)``, from those of cells ``(m,)``, which grow slowly from the smallest ones."""
    k = vertices.shape[1]
    logs = np.bincount(vertices.ravel(), np.repeat(np.log(sizes), k), count)
    at = np.exp(logs / np.bincount(vertices.ravel(), minlength=count))
    ways = np.linalg.norm(points[:, :, None] - points[:, None, :], axis=3) * GROWTH
    while True:
        most = at[vertices][:, :, None] + ways
        less = at.copy()
        np.minimum.at(less, np.broadcast_to(vertices[:, None, :], most.shape).ravel(), most.ravel())
        if (less >= at * (1 - GROWTH * np.finfo(float).eps)).all():
            return np.asarray(at[vertices])
        at = less
