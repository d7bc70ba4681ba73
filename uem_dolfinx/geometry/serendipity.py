"""Completion of serendipity cells: nodes are added in the middle of quadrilaterals and hexahedra.

The map of a serendipity cell is a polynomial of the complete cell, too. New nodes are the images of the middles under this map, so
that the complete cell has exactly the same shape:

    x_quad = (2 sum of edges - sum of vertices) / 4        x_hexahedron = (sum of edges - sum of vertices) / 4
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uem_dolfinx.arrays import Bools, Ints
from uem_dolfinx.geometry.found import KINDS, Block, Found

#: Cells of meshio with nodes on edges only, except cells without quadrilaterals.
SERENDIPITY = {"quad8": "quad9", "hexahedron20": "hexahedron27", "wedge15": "wedge18", "pyramid13": "pyramid14"}


def completed(found: Found) -> tuple[Found, int]:
    """The mesh with complete cells in place of serendipity cells, and the number of added nodes.

    Cells that share a quadrilateral share its new node. Sets with all nodes of a quadrilateral or hexahedron get its new node.
    """
    asked = [block for block in found.cells if block.type in SERENDIPITY]
    if not asked:
        return found, 0
    # nodes of all distinct quadrilaterals, by their vertices
    parts = [_quads(block) for block in asked]
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
    sets = {name: _with_new(nodes, count, around) for name, nodes in found.point_sets.items()}
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
