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
    """Places of nodes, and two cells of one kind that have a vertex in common: the unit cell, and the same next to it, along x."""
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


def columns(parts, kind="C3D8"):
    """Text of columns of cells upon each other, each from one height to another in some cells, one cell wide, from 1 to 2 in 2D.

    Nodes of level l of column k are 100 k + 10 l + 1, 2 ...; sets are ``body k``, ``foot k`` and ``head k``, surfaces ``under k`` and
    ``over k``.
    """
    flat, square = not kind.startswith("C3D"), [(0, 0), (1, 0), (1, 1), (0, 1)]
    across = [(1.0, None), (2.0, None)] if flat else square
    nodes, cells, sets = [], [], []
    for k, (low, high, n) in enumerate(parts, 1):
        for level in range(n + 1):
            z = low + (high - low) * level / n
            places = [(x, z) if flat else (x, y, z) for x, y in across]
            nodes += [f"{100 * k + 10 * level + i}, {', '.join(map(str, p))}" for i, p in enumerate(places, 1)]
        for level in range(n):
            below, above = ([100 * k + 10 * at + i for i in range(1, len(across) + 1)] for at in (level, level + 1))
            cells.append((k, 10 * k + level, [*below, *(above[::-1] if flat else above)]))
        ends = [", ".join(str(100 * k + 10 * level + i) for i in range(1, len(across) + 1)) for level in (0, n)]
        sides = ("S1", "S3") if flat else ("S1", "S2")
        sets += [f"*NSET, NSET=foot {k}", ends[0], f"*NSET, NSET=head {k}", ends[1]]
        sets += [
            f"*SURFACE, NAME=under {k}",
            f"{10 * k}, {sides[0]}",
            f"*SURFACE, NAME=over {k}",
            f"{10 * k + n - 1}, {sides[1]}",
        ]
    lines = ["*NODE, NSET=all", *nodes]
    for k in range(1, len(parts) + 1):
        own = [f"{number}, {', '.join(map(str, at))}" for of, number, at in cells if of == k]
        lines += [f"*ELEMENT, TYPE={kind}, ELSET=body {k}", *own]
    return "\n".join([*lines, *sets]) + "\n"


def written(folder, text, name="deck.inp"):
    """The path of a file with this text."""
    if COMM.rank == 0:
        (folder / name).write_text(text, encoding="utf-8")
    COMM.barrier()
    return folder / name
