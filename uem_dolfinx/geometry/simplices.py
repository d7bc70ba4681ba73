"""Division of cells of several kinds into simplices of the same order, which gives a conforming mesh with one kind of cell.

The simplices of a cell join its vertex of lowest number with the sides that do not contain it; quadrilaterals among these sides are divided
from their own vertex of lowest number. Cells that share a quadrilateral therefore divide it by the same diagonal [Dompierre, Labbé, Vallet
and Camarero, How to subdivide pyramids, prisms and hexahedra into tetrahedra, 1999]. No node is added: in cells of order 2 the middle node
of a quadrilateral or hexahedron is the node of its diagonals.

Completion of serendipity cells: nodes are added in the middle of quadrilaterals and hexahedra.

The map of a serendipity cell is a polynomial of the complete cell, too. New nodes are the images of the middles under this map, so
that the complete cell has exactly the same shape:

    x_quad = (2 sum of edges - sum of vertices) / 4        x_hexahedron = (sum of edges - sum of vertices) / 4
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.errors import MeshError
from uem_dolfinx.geometry.found import KINDS, Block, Found, Kind

#: Simplices by the dimension of their cells, and the number of nodes of those of order 2.
SIMPLICES = {2: ("triangle", "triangle6"), 3: ("tetra", "tetra10")}


def divided(found: Found, label: str) -> tuple[Found, dict[str, int]]:
    """The mesh with simplices only, with its sets and surfaces, and the number of divided cells of each kind.

    Args:
        found: with complete cells.
        label: of the mesh, for messages.

    Raises:
        MeshError: for cells of other kinds, of several orders, or so distorted that their simplices overlap.
    """
    before: dict[str, int] = {}
    cells, origin, orders = [], [], set()
    for block in found.cells:
        if block.dim < 2:
            cells.append(block)
            origin.append(np.arange(len(block.data)))
            continue
        order = _order(block, label)
        if block.dim == found.dim:
            orders.add(order)
        if block.base not in ("triangle", "tetra"):
            before[block.base] = before.get(block.base, 0) + len(block.data)
        data, of = _simplices(block, order)
        if block.dim == found.dim and len(data) > len(block.data):
            _check(found.points, data, of, found.dim, label)
        cells.append(Block(SIMPLICES[block.dim][order - 1], data, None if block.numbers is None else block.numbers[of]))
        origin.append(of)
    if len(orders) > 1:
        raise MeshError(
            f"the cells of {label} are of order 1 and of order 2: expected one order, which the mesh generator can give"
        )

    def members(which: Sequence[Ints]) -> list[Ints]:
        return [np.flatnonzero(np.isin(of, some)) for of, some in zip(origin, which)]

    sets = {name: members(which) for name, which in found.cell_sets.items()}
    numbers = {name: [values[of] for values, of in zip(every, origin)] for name, every in found.cell_data.items()}
    sides = {
        name: [np.concatenate([_triangles(rows) for rows in parts])] if found.dim == 3 and parts else parts
        for name, parts in found.sides.items()
    }
    return replace(found, cells=cells, cell_sets=sets, cell_data=numbers, sides=sides), before


def _order(block: Block, label: str) -> int:
    """Order of cells, 1 or 2."""
    kind, n = KINDS.get(block.base), block.data.shape[1]
    if kind is None or n not in (kind.vertices, kind.complete):
        raise MeshError(f"{label} has cells {block.type}, which cannot be divided: expected {', '.join(KINDS)}, of order 1 or 2")
    return 1 if n == kind.vertices else 2


def _simplices(block: Block, order: int) -> tuple[Ints, Ints]:
    """Nodes of the simplices of all cells, and the cell of each simplex."""
    kind = KINDS[block.base]
    lowest = block.data[:, : kind.vertices].argmin(axis=1)
    parts, of = [], []
    for apex in range(kind.vertices):
        which = np.flatnonzero(lowest == apex)
        for side in kind.sides:
            if apex in side or not len(which):
                continue
            for rows, local in _divisions(block.data[which], side):
                parts.append(_nodes(kind, block.data[which[rows]], (*local, apex), order))
                of.append(which[rows])
    data, cell = np.concatenate(parts), np.concatenate(of)
    # collapsed cells contain a vertex twice
    corners = np.sort(data[:, : block.dim + 1], axis=1)
    whole = (np.diff(corners, axis=1) > 0).all(axis=1)
    order_of = np.argsort(cell[whole], kind="stable")
    return data[whole][order_of], cell[whole][order_of]


def _divisions(data: Ints, side: tuple[int, ...]) -> Iterator[tuple[Ints, tuple[int, ...]]]:
    """Simplices of one side of cells: rows of cells, and local vertices; quadrilaterals are divided from their smallest vertex."""
    if len(side) < 4:
        yield np.arange(len(data)), side
        return
    lowest = data[:, side].argmin(axis=1)
    for k in range(4):
        rows = np.flatnonzero(lowest == k)
        a, b, c, d = (side[(k + i) % 4] for i in range(4))
        yield rows, (a, b, c)
        yield rows, (a, c, d)


def _nodes(kind: Kind, data: Ints, local: tuple[int, ...], order: int) -> Ints:
    """Nodes of simplices with these local vertices, in VTK's order."""
    if order == 1:
        return data[:, local]
    ends = KINDS["tetra" if len(local) == 4 else "triangle"].edges
    return data[:, [*local, *(_middle(kind, {local[i], local[j]}) for i, j in ends)]]


def _middle(kind: Kind, ends: set[int]) -> int:
    """Local node between two vertices: of an edge, of a quadrilateral whose diagonal it is, or of the whole cell."""
    for k, edge in enumerate(kind.edges):
        if ends == set(edge):
            return kind.vertices + k
    for k, quad in enumerate(kind.quads):
        if ends <= set(quad):
            return kind.vertices + len(kind.edges) + k
    return kind.complete - 1


def _triangles(rows: Ints) -> Ints:
    """Facets by their vertices; quadrilaterals are divided in the same way as by cells."""
    if rows.shape[1] == 3:
        return rows
    return np.concatenate([rows[which][:, local] for which, local in _divisions(rows, (0, 1, 2, 3))])


def _check(points: Array, data: Ints, cell: Ints, dim: int, label: str) -> None:
    """Refuse simplices ``data`` that are inside out, as a whole or at a vertex, relative to the volumes of their cells."""
    x = points[data, :dim]
    volume = np.linalg.det(x[:, 1 : dim + 1] - x[:, :1])
    wrong = volume * np.bincount(cell, volume)[cell] <= 0.0
    ends = [set(edge) for edge in KINDS["tetra" if dim == 3 else "triangle"].edges]
    for k in range(dim + 1) if data.shape[1] > dim + 1 else ():
        # tangents at a vertex of edges that are curved by their middle nodes
        others = [j for j in range(dim + 1) if j != k]
        middle = [dim + 1 + ends.index({j, k}) for j in others]
        corner = np.linalg.det(4.0 * x[:, middle] - 3.0 * x[:, k, None] - x[:, others])
        wrong |= corner * volume * (-1.0) ** k < 0.0
    bad = np.flatnonzero(wrong)
    if len(bad):
        place = ", ".join(f"{v:.6g}" for v in x[bad[0], : dim + 1].mean(axis=0))
        raise MeshError(
            f"{len(bad)} of the simplices that cells of {label} are divided into are inside out, the first at ({place}): the cells there "
            "are too distorted"
        )


#: Cells of meshio with nodes on edges only, except cells without quadrilaterals.
SERENDIPITY = {"quad8": "quad9", "hexahedron20": "hexahedron27", "wedge15": "wedge18", "pyramid13": "pyramid14"}


def completed(found: Found) -> tuple[Found, int]:
    """The mesh with complete cells in place of serendipity cells, and the number of added nodes.

    Cells that share a quadrilateral share its new node. Sets with all nodes of a quadrilateral or hexahedron get its new node, but for
    sets of single points.
    """
    incomplete = [block for block in found.cells if block.type in SERENDIPITY]
    if not incomplete:
        return found, 0
    # nodes of all distinct quadrilaterals, by their vertices
    parts = [_quads(block) for block in incomplete]
    corners, edges = (np.concatenate([part[i].reshape(-1, 4) for part in parts]) for i in (0, 1))
    _, first, number = np.unique(np.sort(corners, axis=1), axis=0, return_index=True, return_inverse=True)
    x = found.points
    middles = (2.0 * x[edges[first]].sum(axis=1) - x[corners[first]].sum(axis=1)) / 4.0
    points, count, start, cells = [x, middles], len(x) + len(middles), 0, []
    around = [(len(x) + np.arange(len(middles)), np.concatenate([corners[first], edges[first]], axis=1))]
    for block in found.cells:
        if block.type in SERENDIPITY:
            kind, n = KINDS[block.base], len(block.data)
            k = n * len(kind.quads)
            data = [block.data, len(x) + number.ravel()[start : start + k].reshape(n, -1)]
            start += k
            if kind.centre:
                own = block.data
                points.append((x[own[:, kind.vertices :]].sum(axis=1) - x[own[:, : kind.vertices]].sum(axis=1)) / 4.0)
                data.append(count + np.arange(n)[:, None])
                around.append((count + np.arange(n), own))
                count += n
            block = replace(block, type=SERENDIPITY[block.type], data=np.concatenate(data, axis=1))
        cells.append(block)
    sets = {
        name: nodes if name in found.as_points else _with_new(nodes, count, around) for name, nodes in found.point_sets.items()
    }
    return replace(found, points=np.concatenate(points), cells=cells, point_sets=sets), count - len(x)


def _with_new(nodes: Ints, count: int, around: list[tuple[Ints, Ints]]) -> Ints:
    """Nodes of a set with new nodes ``(n,)`` whose surrounding nodes ``(n, k)`` all belong to it; ``count`` is the number of nodes."""
    listed: Bools = np.zeros(count, dtype=bool)
    listed[nodes] = True
    return np.concatenate([nodes, *(new[listed[old].all(axis=1)] for new, old in around)])


def _quads(block: Block) -> tuple[Ints, Ints]:
    """Vertices of the quadrilaterals of all cells, and the nodes on their edges ``(n, n_quads, 4)`` each."""
    kind = KINDS[block.base]
    on = [[kind.vertices + k for k, edge in enumerate(kind.edges) if set(edge) <= set(quad)] for quad in kind.quads]
    return block.data[:, np.array(kind.quads)], block.data[:, np.array(on)]
