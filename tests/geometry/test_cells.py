"""Cells that enclose nothing are refused as they are read, from input files and from Gmsh alike; slender ones are not.

The tests to read first: ``test_cells_of_decks_that_are_none`` and ``test_how_thin_a_cell_may_be``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from deck_scenes import UNIT, deck, two_cells
from helpers import refused, rotation

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.cells import FLAT_CELL, flat_cells
from uem_dolfinx.geometry.found import Block, Found
from uem_dolfinx.geometry.simplices import completed

COMM = MPI.COMM_WORLD
KINDS = [(kind, order) for kind in UNIT for order in (1, 2)]
#: Gmsh's numbers of elements of each kind, of order 1 and 2, and DOLFINx's names.
OF_GMSH = {
    "triangle": ((2, 9), "triangle"), "quad": ((3, 10), "quadrilateral"), "tetra": ((4, 11), "tetrahedron"),
    "hexahedron": ((5, 12), "hexahedron"),
}  # fmt: skip


def faulty(kind, order):
    """What is wrong, words of the message, and places and cells of two cells, of which the second is wrong."""
    points, name, cells = two_cells(kind, order)
    own = np.setdiff1d(cells[1], cells[0])
    twice = cells.copy()
    # the last node is one of those of an edge where there are any
    twice[1, -1] = twice[1, -2]
    yield "twice", ("1 of 2 cells have a node twice", "the first is"), points, name, twice
    for value in (np.nan, np.inf, -np.inf):
        nowhere = points.copy()
        nowhere[own[-1], -1] = value
        yield str(value), ("1 of 2 cells have a node whose coordinates are not finite", str(value)), nowhere, name, cells
    flat = points.copy()
    # sheared onto the plane x = 1, with all nodes at places of their own
    flat[own, 1] += 0.3 * (flat[own, 0] - 1.0)
    flat[own, 0] = 1.0
    yield "flat", ("1 of 2 cells have no", "flat"), flat, name, cells
    again = cells.copy()
    # likewise of order 2, whose other nodes are of the second cell alone
    again[1, : len(UNIT[kind])] = np.roll(cells[0, : len(UNIT[kind])], 1)
    yield "again", ("1 of 2 cells have the vertices of another cell",), points, name, again
    if order == 2:
        hanging = cells.copy()
        hanging[1, -1] = np.setdiff1d(cells[0, : len(UNIT[kind])], cells[1])[0]
        yield "hanging", ("1 of 2 cells have the vertex of another cell in the middle of an edge",), points, name, hanging


@pytest.mark.parametrize("kind", UNIT)
def test_edges_with_two_middles(folder, kind):
    """Two cells that have an edge in common, but not the node in its middle; two edges that have one node in common there."""
    points, name, cells = two_cells(kind, 2)
    g, n = points.shape[1], len(UNIT[kind])
    # the other side of the first cell's edge from its first to its second vertex, with all others at places of their own
    mirrored = np.vstack([points, points * np.where(np.arange(g) == 1, -1.0, 1.0) - 0.01 * (np.arange(g) == 1)])
    other = cells[0] + len(points)
    other[:2] = cells[0, :2]
    for what, middle, words in (
        ("two", other[n], "edge with another node in the middle than in a neighbour"),
        ("one", cells[0, n + 1], "node in the middle of an edge that another edge has, too"),
    ):
        rows = np.array([cells[0], other])
        rows[1, n if what == "two" else n + 1] = middle
        if what == "one":
            rows[1, n] = cells[0, n]
        path = deck(folder, f"{what}.inp", mirrored, {name: rows})
        refused(uem.MeshError, (words, "element 20"), lambda path=path: uem.read_mesh(path, COMM))
    rows[1, n + 1] = other[n + 1]
    mesh, _ = uem.read_mesh(deck(folder, "good.inp", mirrored, {name: rows}), COMM)
    assert mesh.topology.index_map(g).size_global == 2


@pytest.mark.parametrize("kind, order", KINDS)
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e3])
def test_cells_of_decks_that_are_none(folder, kind, order, scale):
    """In any unit the cells themselves are read, and the second one is refused by its number once it is wrong."""
    points, name, cells = two_cells(kind, order)
    mesh, _ = uem.read_mesh(deck(folder, "good.inp", scale * points, {name: cells}), COMM)
    assert mesh.topology.index_map(mesh.topology.dim).size_global == 2
    for what, words, x, _, rows in faulty(kind, order):
        path = deck(folder, f"{what}.inp", scale * x, {name: rows})
        refused(uem.MeshError, (*words, "element 20", str(path)), lambda path=path: uem.read_mesh(path, COMM))


def gmsh_file(folder, name, kind, order, points, cells):
    """A file of Gmsh, of version 2.2, with cells whose nodes are in VTK's order, complete for order 2."""
    number, cell = OF_GMSH[kind][0][order - 1], OF_GMSH[kind][1]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$Nodes", str(len(points))]
    lines += [f"{n} " + " ".join(f"{x:.17g}" for x in [*p, 0.0][:3]) for n, p in enumerate(points, 1)]
    lines += ["$EndNodes", "$Elements", str(len(cells))]
    rows = compat.gmsh_nodes(cell, np.asarray(cells, dtype=np.int64)) + 1
    lines += [f"{n} {number} 2 1 1 " + " ".join(map(str, row)) for n, row in enumerate(rows, 1)]
    if COMM.rank == 0:
        (folder / name).write_text("\n".join([*lines, "$EndElements", ""]), encoding="utf-8")
    COMM.barrier()
    return folder / name


def complete(points, name, cells):
    """Places and cells with the nodes that serendipity cells lack."""
    with np.errstate(invalid="ignore"):
        found, _ = completed(Found(points, [Block(name, cells)]))
    return found.points, found.cells[0].data


@pytest.mark.parametrize("kind, order", KINDS)
def test_cells_of_gmsh_that_are_none(folder, kind, order):
    """Likewise, by ``read_gmsh`` and by ``read_mesh``."""
    points, name, cells = two_cells(kind, order)
    good = gmsh_file(folder, "good.msh", kind, order, *complete(points, name, cells))
    mesh, _ = uem.read_gmsh(good, COMM)
    assert mesh.topology.index_map(mesh.topology.dim).size_global == 2
    for what, words, x, _, rows in faulty(kind, order):
        x, rows = complete(x, name, rows)
        path = gmsh_file(folder, f"{what}.msh", kind, order, x, rows)
        for read in (uem.read_gmsh, uem.read_mesh):
            refused(uem.MeshError, (*words, str(path)), lambda path=path, read=read: read(path, COMM))


def flat(kind, x):
    """Whether the cell of order 1 with nodes ``x``, in VTK's order, is flat."""
    cell = OF_GMSH[kind][1]
    data = compat.from_gmsh(cell, compat.gmsh_nodes(cell, np.arange(len(x))[None]))
    return bool(flat_cells(cell, 1, data, x)[0])


@pytest.mark.parametrize("kind", UNIT)
@pytest.mark.parametrize("size", [1e-9, 1.0, 1e3])
def test_how_thin_a_cell_may_be(kind, size):
    """The volume over the larger extents, by the largest one, measures how thin a cell is, at any rotation and size."""
    assert 100 * np.finfo(float).eps < FLAT_CELL
    x = np.array(UNIT[kind], dtype=float)
    g = x.shape[1]
    # extents of the unit cell's side, or of its face, of which there are two equal ones along the sides of a square
    face = x[x[:, -1] == 0.0][:, :-1]
    extents = np.linalg.svd(face - face.mean(axis=0), compute_uv=False) / np.sqrt(len(face))
    volume = {"triangle": 1 / 2, "quad": 1.0, "tetra": 1 / 6, "hexahedron": 1.0}[kind]
    # of quadrilaterals and hexahedra, whose other side has the same extents, this is exact; simplices have a vertex there
    thin = 1e-10 * extents[0] * extents.prod() / volume
    R = rotation(g, 0.7)
    for factor, expected in ((0.3, True), (3.0, False)):
        scales = np.ones(g)
        scales[-1] = factor * thin
        assert flat(kind, size * (x * scales) @ R.T) == expected
        # a needle that is thin along all axes but one
        scales[1:] = 1e-6
        assert not flat(kind, size * (x * scales) @ R.T)


def test_cells_that_cross_themselves():
    """A quadrilateral or a hexahedron whose parts cancel has no volume, though its nodes are far apart; a curved one has some."""
    assert flat("quad", np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]]))
    x = np.array(UNIT["hexahedron"], dtype=float)
    assert flat("hexahedron", x[[0, 2, 1, 3, 4, 6, 5, 7]])
    curved = np.array([[0.0, 0.0], [2.0, 0.0], [1.0, 0.0], [1.0, 0.0], [1.5, 0.1], [0.5, 0.1]])
    assert not flat_cells("triangle", 2, np.array([[0, 1, 2, 4, 5, 3]]), curved)[0]
