"""Input files of Abaqus and CalculiX: sets and surfaces, serendipity cells, meshes of several kinds of cells.

The tests to read first: ``test_serendipity_cells_keep_their_shape`` and ``test_several_kinds_in_space``.
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from deck_scenes import deck, with_middles
from dolfinx import fem
from helpers import refused

import uem_dolfinx as uem
from uem_dolfinx.geometry.found import KINDS, Block, Found
from uem_dolfinx.geometry.simplices import completed, divided
from uem_dolfinx.parallel import reduced

COMM = MPI.COMM_WORLD


def measure(mesh, dx):
    return uem.integrate(fem.Constant(mesh, 1.0) * dx)


def outside(mesh):
    """Volume, and measure of all exterior facets, which holds those that do not fit each other."""
    return measure(mesh, ufl.dx(domain=mesh)), measure(mesh, ufl.ds(domain=mesh))


def serendipity_volume(x):
    """Volume of a serendipity cell with nodes ``x (8 or 20, gdim)``, by quadrature of its own map."""
    g = x.shape[1]
    kind = KINDS["quad" if g == 2 else "hexahedron"]
    corners = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]]) if g == 2 else None
    if g == 3:
        square = [[-1, -1], [1, -1], [1, 1], [-1, 1]]
        corners = np.array([[*p, z] for z in (-1, 1) for p in square])
    places = np.vstack([corners, [corners[list(edge)].mean(axis=0) for edge in kind.edges]])

    def at(xi):
        N = []
        for a in places:
            if np.all(a != 0):
                N.append(np.prod(1 + a * xi) * (a @ xi - (g - 1)) / 2**g)
            else:
                along = int(np.flatnonzero(a == 0)[0])
                rest = [i for i in range(g) if i != along]
                N.append((1 - xi[along] ** 2) * np.prod(1 + a[rest] * xi[rest]) / 2 ** (g - 1))
        return np.array(N) @ x

    points, weights = np.polynomial.legendre.leggauss(4)
    total = 0.0
    for which in product(range(4), repeat=g):
        xi = points[list(which)]
        # quadratic along each coordinate, of which central differences are exact
        J = np.array([(at(xi + e) - at(xi - e)) / 2 for e in np.eye(g)])
        total += np.prod(weights[list(which)]) * np.linalg.det(J)
    return total


@pytest.mark.parametrize("gdim", [2, 3])
def test_serendipity_cells_keep_their_shape(folder, gdim, caplog):
    """Two crooked cells that share a side have the volume that their own map gives, and the shared node once."""
    caplog.set_level("INFO", logger="uem_dolfinx")
    kind = "quad" if gdim == 2 else "hexahedron"
    square = [[0, 0], [1, 0], [1, 1], [0, 1]]
    first = np.array(square if gdim == 2 else [[*p, z] for z in (0, 1) for p in square], dtype=float)
    second = first + np.eye(gdim)[0]
    points = np.unique(np.vstack([first, second]), axis=0)
    cells = [[int(np.flatnonzero((points == p).all(axis=1))[0]) for p in cell] for cell in (first, second)]
    x, blocks = with_middles(points, {kind: cells})
    x = x + 0.05 * np.random.default_rng(3).standard_normal(x.shape)
    ((name, rows),) = blocks.items()
    mesh, tags = uem.read_mesh(deck(folder, f"{gdim}.inp", x, blocks), COMM)
    expected = sum(serendipity_volume(x[row]) for row in rows)
    degree = {"quadrature_degree": 6}
    assert abs(measure(mesh, ufl.dx(domain=mesh, metadata=degree)) / expected - 1) < 1e-12
    assert mesh.geometry.index_map().size_global == len(x) + (2 if gdim == 2 else 13)
    assert COMM.rank > 0 or f"complete by {2 if gdim == 2 else 13} nodes" in caplog.text


SURFACES = """*ELSET, ELSET=BOTH, GENERATE
10, 20, 10
*NSET, NSET=left
10, 30
 50,70
*SURFACE, NAME=top, TYPE=ELEMENT
Both, S2
*SURFACE, NAME=skin
both,
*SURFACE, NAME=ends
20, S4
10, S6
*SURFACE, NAME=nodes, TYPE=NODE
left
*STEP
*STATIC
*CLOAD
left, 1, 2.0
*END STEP
"""


def test_surfaces_of_sides(folder):
    """Of two hexahedra: sides by name, all that is free, nodes, sets of sets; what stands in a file that is included is read there."""
    points = np.array([[i, j, k] for k in (0, 1) for j in (0, 1) for i in (0, 1, 2)], dtype=float) * [1.0, 2.0, 3.0]
    cells = [[0, 1, 4, 3, 6, 7, 10, 9], [1, 2, 5, 4, 7, 8, 11, 10]]
    text = SURFACES.replace("10, 30\n 50,70", "10, 40\n 70,100")
    inner = deck(folder, "inner.inp", points, {"hexahedron": cells}, text)
    if COMM.rank == 0:
        (folder / "outer.inp").write_text(
            f"** a comment\n*include, input={inner.name}\n*MASS, ELSET=none\n1.0\n", encoding="utf-8"
        )
    COMM.barrier()
    mesh, tags = uem.read_mesh(folder / "outer.inp", COMM)
    areas = {name: measure(mesh, uem.ds(tags[name])) for name in ("top", "skin", "ends", "nodes", "left")}
    assert areas == pytest.approx({"top": 4.0, "skin": 8.0 + 12.0 + 12.0, "ends": 12.0, "nodes": 6.0, "left": 6.0})
    assert measure(mesh, uem.dx(tags["BOTH"])) == pytest.approx(12.0)
    simplices, tags = uem.read_mesh(folder / "outer.inp", COMM, cells="simplices")
    assert {name: measure(simplices, uem.ds(tags[name])) for name in areas} == pytest.approx(areas)
    assert measure(simplices, uem.dx(tags["hexahedron"])) == pytest.approx(12.0)


@pytest.mark.parametrize("order", [1, 2])
def test_several_kinds_in_the_plane(folder, order):
    """Quadrilaterals and triangles: refused as they are, divided they fit each other."""
    points = np.array([[i, j] for j in (0, 1, 2) for i in (0, 1, 2)], dtype=float)
    blocks = {"quad": [[0, 1, 4, 3], [4, 5, 8, 7]], "triangle": [[1, 2, 4], [2, 5, 4], [3, 4, 7], [3, 7, 6]]}
    if order == 2:
        points, blocks = with_middles(points, blocks)
    path = deck(folder, f"plane{order}.inp", points, blocks)
    refused(uem.MeshError, ("quad", "triangle", "cells='simplices'"), lambda: uem.read_mesh(path, COMM))
    mesh, tags = uem.read_mesh(path, COMM, cells="simplices")
    assert outside(mesh) == pytest.approx((4.0, 8.0), rel=1e-12)
    assert [measure(mesh, uem.dx(tags[name])) for name in blocks] == pytest.approx([2.0, 2.0], rel=1e-12)


def several_kinds(seed):
    """Cubes of which two are two prisms each, and one six pyramids, with nodes in any order."""
    grid = np.array([[i, j, k] for k in range(3) for j in range(3) for i in range(3)], dtype=float)
    points = np.vstack([grid, [[1.5, 0.5, 0.5]]])
    number = np.random.default_rng(seed).permutation(len(points))
    blocks = {"hexahedron": [], "wedge": [], "pyramid": []}
    for i, j, k in product((0, 1), repeat=3):
        corner = [i + x + 3 * (j + y) + 9 * (k + z) for z in (0, 1) for x, y in ((0, 0), (1, 0), (1, 1), (0, 1))]
        cell = number[corner].tolist()
        if (i, j, k) == (1, 0, 0):
            blocks["pyramid"] += [[*(cell[a] for a in side[::-1]), int(number[-1])] for side in KINDS["hexahedron"].faces]
        elif (i, j) == (0, 1):
            blocks["wedge"] += [[cell[a] for a in rows] for rows in ((0, 1, 2, 4, 5, 6), (0, 2, 3, 4, 6, 7))]
        else:
            blocks["hexahedron"].append(cell)
    x = np.empty_like(points)
    x[number] = points
    return x, blocks


def test_several_kinds_in_space(folder):
    """Hexahedra, prisms and pyramids of order 2: divided they fill the same space, and fit each other."""
    x, blocks = with_middles(*several_kinds(5))
    mesh, tags = uem.read_mesh(deck(folder, "space.inp", x, blocks), COMM, cells="simplices")
    assert outside(mesh) == pytest.approx((8.0, 24.0), rel=1e-12)
    assert [measure(mesh, uem.dx(tags[name])) for name in blocks] == pytest.approx([5.0, 2.0, 1.0], rel=1e-12)


@pytest.mark.parametrize("seed", range(20))
def test_any_numbers_of_nodes(seed):
    """Every triangle between two tetrahedra is of both, and all others lie on the outside."""
    x, blocks = several_kinds(seed)
    found = Found(x, [Block(kind, np.array(cells)) for kind, cells in blocks.items()])
    data = np.concatenate([block.data for block in divided(completed(found)[0], "cubes")[0].cells])
    p = x[data]
    assert np.abs(np.linalg.det(p[:, 1:] - p[:, :1])).sum() / 6 == pytest.approx(8.0, rel=1e-12)
    triangles = np.concatenate([np.delete(data, i, axis=1) for i in range(4)])
    rows, count = np.unique(np.sort(triangles, axis=1), axis=0, return_counts=True)
    assert count.max() == 2
    once = x[rows[count == 1]]
    flat = (np.ptp(once, axis=1) == 0.0) & np.isin(once[:, 0], (0.0, 2.0))
    assert flat.any(axis=1).all()
    area = np.linalg.norm(np.cross(once[:, 1] - once[:, 0], once[:, 2] - once[:, 0]), axis=1).sum() / 2
    assert area == pytest.approx(24.0, rel=1e-12)


def test_refused(folder):
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0], [0.2, 0.1]])
    quad = {"quad": [[0, 1, 2, 3]]}
    for text, words in (
        ("*SURFACE, NAME=a\n10, S5\n", ("surface 'a'", "S1 to S4")),
        ("*ELSET, ELSET=a\nnobody\n", ("ELSET", "no set 'nobody'")),
        ("*NSET, NSET=a\n999\n", ("no node 999", "set of nodes 'a'")),
        ("*NSET, NSET=a, GENERATE\n10, 60, 10\n", ("no node 60", "set of nodes 'a'")),
        ("*ELEMENT, TYPE=CPS3\n20, 10, 20, 999\n", ("no node 999", "element 20")),
        ("*ELSET, ELSET=a\n10, 99\n", ("no element 99", "set of elements 'a'")),
        ("*ELSET, ELSET=a, GENERATE\n10, 30, 10\n", ("no element 20", "set of elements 'a'")),
        ("*ELSET, ELSET=a, GENERATE\n20, 10, 10\n", ("ELSET=a", "GENERATE from 20 to 10")),
        ("*NSET, NSET=a, GENERATE\n10, 20, 0\n", ("NSET=a", "GENERATE from 10 to 20 by 0")),
        ("*SURFACE, NAME=a\n99, S1\n", ("no element 99", "surface 'a'")),
        ("*SURFACE, NAME=a\n99,\n", ("no element 99", "surface 'a'")),
        ("*SURFACE, NAME=a, TYPE=NODE\n999\n", ("no node 999", "surface 'a'")),
        ("*NODE\n10, 5.0, 5.0\n", "two nodes 10"),
        ("*NGEN\n1, 2\n", ("NGEN", "write them out")),
        ("*PART, NAME=a\n*PART, NAME=b\n", "one flat input file"),
        ("*INSTANCE, NAME=a-1, PART=a\n1.0, 0.0, 0.0\n", "one flat input file"),
        ("*INCLUDE, INPUT=nowhere.inp\n", "nowhere.inp"),
        ("*INCLUDE, INPUT=bad.inp\n", "includes 'bad.inp', which it is included by"),
    ):
        refused(uem.MeshError, words, lambda text=text: uem.read_mesh(deck(folder, "bad.inp", points, quad, text), COMM))
    crooked = deck(folder, "crooked.inp", points[[1, 4, 3, 0]], {"quad": [[3, 0, 1, 2]]})
    refused(uem.MeshError, ("inside out", "too distorted"), lambda: uem.read_mesh(crooked, COMM, cells="simplices"))
    refused(uem.InputError, "simplices", lambda: uem.read_mesh(crooked, COMM, cells="tetrahedra"))
    text = "*ELEMENT, TYPE=SPRINGA, ELSET=s\n90, 10, 20\n*ELEMENT, TYPE=U1, ELSET=user\n91, 10, 20,\n10, 30\n"
    text += "*ELSET, ELSET=every\ns, user, 10\n*SURFACE, NAME=side\nevery, S1\n"
    text += "*PART, NAME=a\n*INSTANCE, NAME=a-1, PART=a\n*END INSTANCE\n"
    mesh, tags = uem.read_mesh(deck(folder, "beside.inp", points, quad, text), COMM)
    assert reduced(COMM, mesh.topology.index_map(2).size_local) == 1
    assert measure(mesh, uem.dx(tags["every"])) == pytest.approx(1.0) == measure(mesh, uem.ds(tags["side"]))
    assert "user" not in tags


def test_single_nodes_as_tags(folder):
    """Nodes by their numbers are tags of a point each; others than there are, and files without numbers, are refused."""
    points = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])
    path = deck(folder, "one.inp", points, {"quad": [[0, 1, 2, 3]]})
    mesh, tags = uem.read_mesh(path, COMM, nodes=(30,))
    V = uem.function_space(mesh, 1, (2,))
    x = V.tabulate_dof_coordinates()[uem.compat.bc_dofs(uem.dirichlet(V, tags["node 30"], 0))[0] // 2]
    assert all(np.allclose(one[:2], (1.0, 1.0)) for one in x) and reduced(COMM, len(x)) >= 1
    refused(uem.MeshError, "no node 7", lambda: uem.read_mesh(path, COMM, nodes=(7,)))
    refused(uem.MeshError, "nodes = (1,)", lambda: uem.read_mesh(folder / "one.msh", COMM, nodes=(1,)))
    refused(uem.InputTypeError, "nodes = 'a'", lambda: uem.read_mesh(path, COMM, nodes="a"))
