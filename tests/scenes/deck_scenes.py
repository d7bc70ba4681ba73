"""Input files of Abaqus and CalculiX that tests write."""

from __future__ import annotations

from itertools import permutations, product

from mpi4py import MPI

import numpy as np

from uem_dolfinx.geometry.found import KINDS

COMM = MPI.COMM_WORLD
#: Types of CalculiX' elements by kinds.
TYPES = {
    "quad": "CPS4", "triangle": "CPS3", "quad8": "CPE8R", "triangle6": "CPS6", "hexahedron": "C3D8I", "wedge": "C3D6", "pyramid": "C3D5",
    "tetra": "C3D4", "hexahedron20": "C3D20R", "wedge15": "C3D15", "pyramid13": "C3D13", "tetra10": "C3D10",
}  # fmt: skip


def deck(folder, name, points, blocks, more=""):
    """An input file of blocks, each of a kind and its cells; numbers of nodes and elements are ten times those from 1."""
    lines, count = ["*HEADING", "cells", "*NODE, NSET=all"], 0
    lines += [", ".join([str(10 * n), *(f"{x:.17g}" for x in p)]) for n, p in enumerate(points, 1)]
    for kind, cells in blocks.items():
        lines.append(f"*Element, type={TYPES[kind]}, ELSET={kind}")
        for cell in np.atleast_2d(cells):
            count += 1
            numbers = [str(10 * (n + 1)) for n in cell]
            lines += [", ".join([str(10 * count), *numbers[:10]]) + ("," if numbers[10:] else "")]
            lines += [", ".join(numbers[10:])] if numbers[10:] else []
    if COMM.rank == 0:
        (folder / name).write_text("\n".join(lines) + "\n" + more, encoding="utf-8")
    COMM.barrier()
    return folder / name


def with_middles(points, blocks):
    """The same cells with nodes in the middle of edges."""
    edges = {}
    x, found = list(points), {}
    for kind, cells in blocks.items():
        rows = []
        for cell in cells:
            middles = []
            for edge in KINDS[kind].edges:
                ends = tuple(sorted(cell[i] for i in edge))
                if ends not in edges:
                    edges[ends] = len(x)
                    x.append((x[ends[0]] + x[ends[1]]) / 2)
                middles.append(edges[ends])
            rows.append([*cell, *middles])
        found[f"{kind}{len(rows[0])}"] = rows
    return np.array(x), found


#: Vertices of the unit cell of each kind, in VTK's order.
UNIT = {
    "triangle": [[0, 0], [1, 0], [0, 1]],
    "quad": [[0, 0], [1, 0], [1, 1], [0, 1]],
    "tetra": [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]],
    "hexahedron": [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]],
}


def two_cells(kind, order):
    """Places of nodes, and two cells of one kind that have a vertex in common: the unit cell, and the same beside it, along x."""
    first = np.array(UNIT[kind], dtype=float)
    both = np.vstack([first, first + np.eye(first.shape[1])[0]])
    points, number = np.unique(both, axis=0, return_inverse=True)
    blocks = {kind: number.reshape(2, -1).tolist()}
    points, blocks = with_middles(points, blocks) if order == 2 else (points, blocks)
    ((name, cells),) = blocks.items()
    return points, name, np.array(cells)


def grid(kind, order, n=2):
    """Nodes, name and cells of a unit square or cube of ``n`` cells along each axis, each of them divided for simplices."""
    g = len(UNIT[kind][0])
    corners = np.array(UNIT["quad" if g == 2 else "hexahedron"])
    if kind in ("quad", "hexahedron"):
        parts = corners[None]
    else:
        # Kuhn's: along the axes in every order
        parts = np.array([np.vstack([np.zeros((1, g)), np.cumsum(np.eye(g)[list(p)], axis=0)]) for p in permutations(range(g))])
    cells = [(part + at).astype(int) @ (n + 1) ** np.arange(g) for at in product(range(n), repeat=g) for part in parts]
    points = np.array(list(product(range(n + 1), repeat=g)), dtype=float)[:, ::-1] / n
    points, blocks = with_middles(points, {kind: np.array(cells).tolist()}) if order == 2 else (points, {kind: cells})
    ((name, rows),) = blocks.items()
    return points, name, np.array(rows)


def node_sets(sets):
    """Text of sets of nodes ``{name: nodes}``, which ``deck`` numbers."""
    return "".join(f"*NSET, NSET={name}\n" + "".join(f"{10 * (n + 1)}\n" for n in nodes) for name, nodes in sets.items())
