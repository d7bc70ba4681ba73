"""Checks of the cells of a file or model before a mesh is created: degenerate and duplicate cells are errors."""

from __future__ import annotations

import numpy as np

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array, Bools, Ints, cross_products
from uem_dolfinx.errors import MeshError
from uem_dolfinx.geometry.nodes import described

#: Simplices that fill a cell, by its vertices in DOLFINx's order.
FILLED_BY = {
    "triangle": [[0, 1, 2]], "quadrilateral": [[0, 1, 3], [0, 3, 2]], "tetrahedron": [[0, 1, 2, 3]],
    "hexahedron": [[0, 1, 3, 7], [0, 1, 5, 7], [0, 2, 3, 7], [0, 2, 6, 7], [0, 4, 5, 7], [0, 4, 6, 7]],
}  # fmt: skip
#: A cell whose thickness is less than this is flat. [convention; size of the cell; test_cells.py::test_how_thin_a_cell_may_be]
FLAT_CELL = 1e-10
#: Cells whose volumes are computed at a time, which bounds the memory and changes no result. [bound; number; -]
VOLUMES_AT_ONCE = 20_000


def check_nodes(cell: str, cells: Ints, points: Array, label: str, numbers: Ints | None = None) -> None:
    """Refuse cells with invalid nodes.

    Args:
        cell: name of the cell, e.g. ``"triangle"``.
        cells: nodes of each cell ``(n, m)``, vertices first, rows of ``points``.
        points: positions of nodes ``(n_nodes, 2 or 3)``.
        label: of the file or the model, for messages.
        numbers: of the cells in the file ``(n,)``; None: messages count the cells.

    Raises:
        MeshError: for a cell with a repeated node, a node without finite coordinates, all vertices of another cell, or the vertex
            of another cell between its own vertices.
    """
    ordered, n_vertices = np.sort(cells, axis=1), len(forms.reference_topology(cell)[0])
    _refuse("a node twice", ordered[:, 1:], np.equal(ordered[:, 1:], ordered[:, :-1]), points, label, numbers)
    lost = ~np.asarray(np.isfinite(points).all(axis=1), dtype=bool)
    _refuse("a node whose coordinates are not finite", cells, lost[cells], points, label, numbers)
    vertices = np.sort(cells[:, :n_vertices], axis=1)
    order = np.lexsort(vertices.T)
    again: Bools = np.zeros(cells.shape, dtype=bool)
    again[order[1:], 0] = (vertices[order[1:]] == vertices[order[:-1]]).all(axis=1)
    _refuse("the vertices of another cell", cells, again, points, label, numbers)
    hanging = np.isin(cells[:, n_vertices:], vertices)
    what = "the vertex of another cell in the middle of an edge"
    _refuse(what, cells[:, n_vertices:], hanging, points, label, numbers)


def check_edges(cell: str, cells: Ints, points: Array, label: str, numbers: Ints | None = None) -> None:
    """MeshError for an edge of degree 2 with two middle nodes or that of another edge, in DOLFINx's order; as ``check_nodes``."""
    topology = forms.reference_topology(cell)
    n_vertices, edges = len(topology[0]), np.array(topology[1])
    if cells.shape[1] == n_vertices:
        return
    middles = cells[:, n_vertices : n_vertices + len(edges)]
    ends, middle = np.sort(cells[:, edges], axis=2).reshape(-1, 2), middles.ravel()
    for what, same, differ in (
        ("an edge with another node in the middle than in a neighbour", ends, middle[:, None]),
        ("a node in the middle of an edge that another edge has, too", middle[:, None], ends),
    ):
        order = np.lexsort((*differ.T, *same.T))
        one, next_one = order[:-1], order[1:]
        bad = (same[one] == same[next_one]).all(axis=1) & (differ[one] != differ[next_one]).any(axis=1)
        at: Bools = np.zeros(middle.shape, dtype=bool)
        at[next_one[bad]] = True
        _refuse(what, middles, at.reshape(middles.shape), points, label, numbers)


def check_volumes(cell: str, degree: int, cells: Ints, points: Array, label: str, numbers: Ints | None = None) -> None:
    """MeshError for a cell, in DOLFINx's order, whose volume is zero relative to its size; other arguments as in ``check_nodes``."""
    flat: Bools = np.zeros(cells.shape, dtype=bool)
    flat[:, 0] = flat_cells(cell, degree, cells, points)
    what = "no area" if len(forms.reference_topology(cell)) == 3 else "no volume"
    _refuse(f"{what} (they are flat)", cells, flat, points, label, numbers)


def _refuse(what: str, nodes: Ints, bad: Bools, points: Array, label: str, numbers: Ints | None) -> None:
    """Raise MeshError if any of the ``nodes (n, k)`` of cells is ``bad (n, k)``."""
    if not bad.any():
        return
    rows = np.asarray(bad.any(axis=1), dtype=bool)
    first = int(rows.argmax())
    name = f"cell {first + 1} of the bodies" if numbers is None else f"element {numbers[first]}"
    place = described(points[nodes[first, bad[first].argmax()]])
    raise MeshError(
        f"{label}: {int(rows.sum())} of {len(rows)} cells have {what}; the first is {name}, at the node {place}: mend the mesh"
    )


def flat_cells(cell: str, degree: int, cells: Ints, points: Array) -> Bools:
    """Which cells have no volume, with the arguments of ``check_volumes`` ``(n,)``.

    The thickness of a cell is its volume over the product of its extents ``s_1 >= s_2 (>= s_3)`` except the smallest. ``s_i`` is
    the rms distance of its nodes from their mean along a principal axis, so that slender cells do not count as thin.
    """
    dim = len(forms.reference_topology(cell)) - 1
    flat: Bools = np.zeros(len(cells), dtype=bool)
    tables, weights = _map(cell, degree, dim)
    for first in range(0, len(cells), VOLUMES_AT_ONCE):
        x = points[cells[first : first + VOLUMES_AT_ONCE], :dim]
        volume = np.abs(_volumes(x, tables, weights))
        # extents do not exceed the size of the cell, so that they are needed for few cells only
        few = np.flatnonzero(volume <= FLAT_CELL * np.linalg.norm(np.ptp(x, axis=1), axis=1) ** dim)
        if len(few):
            own = x[few] - x[few].mean(axis=1, keepdims=True)
            extent = np.linalg.svd(own, compute_uv=False) / np.sqrt(x.shape[1])
            flat[first + few] = volume[few] <= FLAT_CELL * extent[:, 0] * extent[:, :-1].prod(axis=1)
    return flat


def _map(cell: str, degree: int, dim: int) -> tuple[Array, Array]:
    """Derivatives of the shape functions at the points of a quadrature rule exact for volumes ``(dim, n_points, m)``, and its weights."""
    products = cell in ("quadrilateral", "hexahedron")
    points, weights = forms.quadrature_rule(cell, dim * degree - 1 if products else dim * (degree - 1))
    return np.ascontiguousarray(forms.create_lagrange_element(cell, degree).tabulate(1, points)[1:, :, :, 0]), weights


def _volumes(x: Array, tables: Array, weights: Array) -> Array:
    """Integrals of the Jacobian determinant of cells with nodes ``x (n, m, dim)``, negative for inverted cells ``(n,)``."""
    J = np.einsum("dqm,nmg->dnqg", tables, x, optimize=True)
    if len(J) == 2:
        det = J[0, ..., 0] * J[1, ..., 1] - J[0, ..., 1] * J[1, ..., 0]
    else:
        det = np.einsum("nqg,nqg->nq", J[0], cross_products(J[1], J[2]))
    return det @ weights
