"""Sizes of cells for Gmsh."""

from __future__ import annotations

import logging

from mpi4py import MPI

import basix
import numpy as np
import pytest
from helpers import slow

import uem_dolfinx as uem
from uem_dolfinx.accuracy.adapt import cell_sizes
from uem_dolfinx.geometry.mesh_sizes import FILLED_BY, SUBDIVIDED, MeshSizes, graded

COMM = MPI.COMM_WORLD


def test_sizes_grow_slowly():
    """From the smallest cell of a row of lines, sizes grow by half of the way; large ones stay."""
    vertices = np.column_stack([np.arange(10), np.arange(1, 11)])
    points = vertices[:, :, None].astype(float)
    sizes = np.full(10, 3.0)
    sizes[:2] = 0.1
    at = graded(vertices, 11, points, sizes)
    assert np.allclose(at[:2, 0], 0.1)
    assert at[1, 1] == pytest.approx(np.sqrt(0.1 * 3.0))
    assert np.allclose(np.diff(at[1:6, 1]), 0.5)
    assert at[-1, 1] == pytest.approx(3.0)


@pytest.mark.parametrize("cell", list(FILLED_BY))
def test_simplices_fill_cells(cell):
    """Their volumes sum up to that of the cell, and none is empty."""
    x = basix.geometry(getattr(basix.CellType, cell))[np.array(FILLED_BY[cell])]
    volumes = np.abs(np.linalg.det(x[:, 1:] - x[:, :1])) / (2.0 if x.shape[2] == 2 else 6.0)
    whole = {"triangle": 1 / 2, "quadrilateral": 1.0, "tetrahedron": 1 / 6, "hexahedron": 1.0}[cell]
    assert volumes.min() > 0 and np.isclose(volumes.sum(), whole)


@pytest.mark.parametrize("name, gdim", [("adapt_punch", 2), ("hertz_sphere", 3)])
def test_gmsh_follows(name, gdim):
    """Cells of a new mesh have the sizes, whatever the partition of the first."""
    options = {"h": 0.5} if gdim == 2 else {}
    mesh, _ = uem.read_gmsh(uem.example_mesh(name), COMM, gdim=gdim, parameters=options)
    sizes = cell_sizes(mesh)
    usual = COMM.allreduce(sizes.sum()) / COMM.allreduce(len(sizes))
    number = []
    for factor in (1.0, 0.5):
        finer, _ = uem.read_gmsh(
            uem.example_mesh(name), COMM, gdim=gdim, parameters=options, size=MeshSizes(mesh, np.full(len(sizes), factor * usual))
        )
        own = cell_sizes(finer)
        number.append(COMM.allreduce(len(own)))
        assert 0.7 < COMM.allreduce(own.sum()) / number[-1] / (factor * usual) < 1.5
    assert 0.6 * 2**gdim < number[1] / number[0] < 1.5 * 2**gdim


@pytest.mark.parametrize("h", [slow(0.75), slow(1.5), 3.0])
@pytest.mark.parametrize("quads", [False, True])
def test_arcs_outside_coarse_cells(quads, h, tmp_path):
    """Along an arc cells have the disc's sizes, not the block's that it touches, though first sides of the radius run far inside."""
    path, radius, disc, block = COMM.bcast(tmp_path) / "disc.geo", 3.0, 0.05, 0.1
    if COMM.rank == 0:
        subdivided = "\nRecombine Surface {1, 2};\nMesh.SubdivisionAlgorithm = 1;\n" * quads
        path.write_text(uem.example_mesh("adapt_hertz").read_text() + subdivided)
    COMM.barrier()
    mesh, tags = uem.read_gmsh(path, COMM, gdim=2, parameters={"h": h})
    sizes = np.full(len(cell_sizes(mesh)), block)
    owned = tags["disc"].entities
    sizes[owned[owned < len(sizes)]] = disc
    finer, _ = uem.read_gmsh(path, COMM, gdim=2, parameters={"h": h}, size=MeshSizes(mesh, sizes))
    x, y = finer.geometry.x[:, 0], radius - finer.geometry.x[:, 1]
    there = np.isclose(np.hypot(x, y), radius, rtol=1e-9) & (y > -1e-9)
    angles = np.sort(np.concatenate(COMM.allgather(np.arctan2(x, y)[there])))
    sides = radius * np.diff(angles[angles > 0.1])
    # on lines of quadrilaterals Gmsh's sizes are larger, and halved
    wanted = disc * (SUBDIVIDED / 2 if quads else 1.0)
    sides = sides[sides > 1e-6 * wanted] / wanted
    assert sides.min() > 0.9 and sides.max() < 1.1 and np.isclose(sides.sum() * wanted, radius * (np.pi / 2 - 0.1), rtol=0.02)


@pytest.mark.parametrize(
    "name, order, curved", [("adapt_hertz", 1, True), ("adapt_hertz", 2, False), ("adapt_punch", None, False)]
)
def test_straight_cells_along_curves(name, order, curved, caplog):
    """A line says that estimates do not see them, on meshes that follow sizes alone."""
    options = {} if order is None else {"order": order}
    mesh, _ = uem.read_gmsh(uem.example_mesh(name), COMM, gdim=2, parameters=options)
    with caplog.at_level(logging.INFO, logger="uem_dolfinx"):
        uem.read_gmsh(uem.example_mesh(name), COMM, gdim=2, parameters=options, size=MeshSizes(mesh, cell_sizes(mesh)))
    lines = [record.getMessage() for record in caplog.records if "straight cells along Circle" in record.getMessage()]
    assert len(lines) == (curved and COMM.rank == 0)


@pytest.mark.parametrize("dim", [2, 3])
def test_subdivided_cells_have_their_sizes(dim, tmp_path):
    """Quadrilaterals and hexahedra that Gmsh makes of triangles and tetrahedra, within 20 %, as the others."""
    path = COMM.bcast(tmp_path) / "unit.geo"
    body = "Rectangle(1) = {0, 0, 0, 1, 1};" if dim == 2 else "Box(1) = {0, 0, 0, 1, 1, 1};"
    if COMM.rank == 0:
        path.write_text(f'SetFactory("OpenCASCADE");\n{body}\nMesh.SubdivisionAlgorithm = {dim - 1};\nMesh.MeshSizeMax = 0.6;\n')
    COMM.barrier()
    mesh, _ = uem.read_gmsh(path, COMM, gdim=dim)
    size = (0.04, 0.14)[dim - 2]
    finer, _ = uem.read_gmsh(path, COMM, gdim=dim, size=MeshSizes(mesh, np.full(len(cell_sizes(mesh)), size)))
    own = cell_sizes(finer)
    mean = COMM.allreduce(own.sum()) / COMM.allreduce(len(own))
    assert finer.topology.dim == dim and 0.8 < mean / size < 1.2


#: Dimension and Gmsh's commands for two bodies.
TOUCHING = {
    "blocks": (2, "Rectangle(1) = {0, 0, 0, 1, 1}; Rectangle(2) = {0, 1, 0, 1, 1};"),
    "quadrilaterals": (2, "Rectangle(1) = {0, 0, 0, 1, 1}; Rectangle(2) = {0, 1, 0, 1, 1}; Mesh.SubdivisionAlgorithm = 1;"),
    "ring": (
        2,
        "Disk(1) = {0, 0, 0, 1}; Disk(2) = {0, 0, 0, 1.6}; Disk(3) = {0, 0, 0, 1};\n"
        "BooleanDifference{ Surface{2}; Delete; }{ Surface{3}; Delete; }",
    ),
    "plates": (2, "Rectangle(1) = {0, 0, 0, 1, 0.1}; Rectangle(2) = {0, 0.1, 0, 1, 0.1};"),
    "boxes": (3, "Box(1) = {0, 0, 0, 1, 1, 1}; Box(2) = {0.2, 0.2, 1, 1, 1, 1};"),
}


@pytest.mark.parametrize("scene", ["blocks", *(slow(name) for name in TOUCHING if name != "blocks")])
def test_sizes_where_bodies_touch(scene, tmp_path):
    """Along their common surface each of two bodies has its own sizes, though points of the two are the same."""
    dim, text = TOUCHING[scene]
    path = COMM.bcast(tmp_path) / "touching.geo"
    if COMM.rank == 0:
        physical = "".join(
            f'Physical {("Surface", "Volume")[dim - 2]}("{name}") = {{{tag}}};\n' for tag, name in ((1, "one"), (2, "two"))
        )
        path.write_text(f'SetFactory("OpenCASCADE");\n{text}\nMesh.MeshSizeMax = 0.3;\n{physical}')
    COMM.barrier()
    mesh, tags = uem.read_gmsh(path, COMM, gdim=dim)
    for wanted in ((0.05, 0.2), (0.2, 0.05)):
        sizes = np.zeros(len(cell_sizes(mesh)))
        for name, size in zip(("one", "two"), wanted):
            owned = tags[name].entities
            sizes[owned[owned < len(sizes)]] = size
        finer, of_finer = uem.read_gmsh(path, COMM, gdim=dim, size=MeshSizes(mesh, sizes))
        found = cell_sizes(finer)
        for name, size in zip(("one", "two"), wanted):
            owned = of_finer[name].entities
            part = found[owned[owned < len(found)]] / size
            least, most = COMM.allreduce(part.min(initial=np.inf), MPI.MIN), COMM.allreduce(part.max(initial=0.0), MPI.MAX)
            assert least > 0.5 and most < 1.8
