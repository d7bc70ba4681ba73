"""Meshes of other programs, by meshio: the same bodies and surfaces as in the file. Read first: ``test_an_abaqus_deck``."""

from __future__ import annotations

import sys

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem

import uem_dolfinx as uem
from uem_dolfinx.errors import MeshError
from uem_dolfinx.parallel import reduced

COMM = MPI.COMM_WORLD

#: Two squares of 2 x 2 cells side by side with a gap of 1, numbered from 1, with sets of elements and of nodes.
DECK = """*HEADING
two squares
*NODE
{nodes}
*ELEMENT, TYPE=CPS4, ELSET=left
1, 1, 2, 5, 4
2, 2, 3, 6, 5
3, 4, 5, 8, 7
4, 5, 6, 9, 8
*ELEMENT, TYPE=CPS4, ELSET=right
5, 11, 12, 15, 14
6, 12, 13, 16, 15
7, 14, 15, 18, 17
8, 15, 16, 19, 18
*NSET, NSET=foot
1, 2, 3, 11, 12, 13
*NSET, NSET=middle
5, 15
"""


def volume(mesh, dx=None):
    return uem.integrate(fem.Constant(mesh, 1.0) * (ufl.dx(domain=mesh) if dx is None else dx))


def size(tag):
    """Number of entities over all ranks, ghosts aside."""
    owned = tag.mesh.topology.index_map(tag.dim).size_local
    return reduced(COMM, int((tag.entities < owned).sum()))


def test_an_abaqus_deck(folder):
    nodes = [(1 + 3 * j + i + 10 * b, 0.5 * i + 2 * b, 0.5 * j) for b in (0, 1) for j in range(3) for i in range(3)]
    if COMM.rank == 0:
        text = DECK.format(nodes="\n".join(f"{n}, {x}, {y}, 0.0" for n, x, y in nodes))
        (folder / "squares.inp").write_text(text, encoding="utf-8")
    COMM.barrier()
    mesh, tags = uem.read_mesh(folder / "squares.inp", COMM)
    assert mesh.geometry.dim == 2 and volume(mesh) == pytest.approx(2.0, rel=1e-12)
    assert {name: tags[name].dim for name in ("left", "right", "foot", "middle")} == {
        "left": 2,
        "right": 2,
        "foot": 1,
        "middle": 0,
    }
    assert [size(tags[name]) for name in ("left", "right", "foot", "middle")] == [4, 4, 4, 2]
    assert volume(mesh, uem.ds(tags["foot"])) == pytest.approx(2.0, rel=1e-12)
    assert volume(mesh, uem.dx(tags["right"])) == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize(("gdim", "recombine"), [(2, 0), (2, 1), (3, 0), (3, 1)])
def test_curved_cells_keep_their_places(folder, gdim, recombine):
    """Cells of degree 2 of a quarter of a ring, or of a cylinder, have the volume that Gmsh's own file gives."""
    meshio = pytest.importorskip("meshio")
    text = "SetFactory('OpenCASCADE');\nPoint(1) = {1, 0, 0}; Point(2) = {2, 0, 0}; Line(1) = {1, 2};\n".replace("'", '"')
    text += "Transfinite Curve {1} = 3;\n"
    text += "a() = Extrude {{0, 0, 1}, {0, 0, 0}, Pi / 2} { Curve{1}; Layers{3}; " + ("Recombine; " if recombine else "") + "};\n"
    if gdim == 3:
        text += "b() = Extrude {0, 0, 1} { Surface{1}; Layers{2}; " + ("Recombine; " if recombine else "") + "};\n"
    text += "Mesh.ElementOrder = 2;\n"
    if COMM.rank == 0:
        (folder / "ring.geo").write_text(text, encoding="utf-8")
        import gmsh

        gmsh.initialize(["gmsh"], False)
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.open(str(folder / "ring.geo"))
        gmsh.model.mesh.generate(gdim)
        gmsh.write(str(folder / "ring.msh"))
        gmsh.finalize()
        found = meshio.read(folder / "ring.msh")
        meshio.write(folder / "ring.vtu", meshio.Mesh(found.points, [b for b in found.cells if b.dim == gdim]))
    COMM.barrier()
    expected, _ = uem.read_gmsh(folder / "ring.msh", COMM, gdim=gdim)
    mesh, _ = uem.read_mesh(folder / "ring.vtu", COMM)
    assert mesh.geometry.dim == gdim
    assert volume(mesh) == pytest.approx(volume(expected), rel=1e-12) == pytest.approx(0.75 * np.pi, rel=1e-3)


@pytest.mark.slow
def test_several_kinds_of_gmsh(folder):
    """Hexahedra and prisms of degree 2 in a file of Gmsh: refused, and divided with their groups."""
    pytest.importorskip("meshio")
    if COMM.rank == 0:
        import gmsh

        gmsh.initialize(["gmsh"], False)
        gmsh.option.setNumber("General.Terminal", 0)
        squares = [gmsh.model.occ.addRectangle(x, 0.0, 0.0, 1.0, 1.0) for x in (0.0, 1.0)]
        gmsh.model.occ.fragment([(2, squares[0])], [(2, squares[1])])
        gmsh.model.occ.extrude([(2, s) for s in squares], 0.0, 0.0, 1.0, [1], recombine=True)
        gmsh.model.occ.synchronize()
        gmsh.model.mesh.setRecombine(2, squares[0])
        for number, name in enumerate(("left", "right"), 1):
            gmsh.model.setPhysicalName(3, gmsh.model.addPhysicalGroup(3, [number], number), name)
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.5)
        gmsh.option.setNumber("Mesh.ElementOrder", 2)
        gmsh.model.mesh.generate(3)
        gmsh.write(str(folder / "two.msh"))
        gmsh.finalize()
    COMM.barrier()
    with pytest.raises(uem.MeshError, match="Prism.*cells='simplices'"):
        uem.read_mesh(folder / "two.msh", COMM)
    mesh, tags = uem.read_mesh(folder / "two.msh", COMM, cells="simplices")
    assert volume(mesh, ufl.ds(domain=mesh)) == pytest.approx(10.0, rel=1e-12)
    assert [volume(mesh, uem.dx(tags[name])) for name in ("left", "right")] == pytest.approx([1.0, 1.0], rel=1e-12)


def test_values_of_cells_are_tags(folder):
    """Whole numbers that cells share tell them apart; numbers of cells do not."""
    meshio = pytest.importorskip("meshio")
    if COMM.rank == 0:
        points = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [2.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0], [2.0, 1.0, 0.0]])
        cells = [("quad", np.array([[0, 1, 4, 3], [1, 2, 5, 4]])), ("line", np.array([[0, 1], [1, 2], [3, 4]]))]
        data = {"material": [np.array([7, 8]), np.array([1, 1, 2])], "id": [np.array([1, 2]), np.array([3, 4, 5])]}
        meshio.write(folder / "a.vtu", meshio.Mesh(points, cells, cell_data=data))
    COMM.barrier()
    mesh, tags = uem.read_mesh(folder / "a.vtu", COMM)
    assert [volume(mesh, uem.dx(tags[f"material {k}"])) for k in (7, 8)] == pytest.approx([1.0, 1.0])
    assert [volume(mesh, uem.ds(tags[f"material {k}"])) for k in (1, 2)] == pytest.approx([2.0, 1.0])
    with pytest.raises(uem.TagError):
        tags["id 1"]


def test_named_errors(folder, monkeypatch):
    meshio = pytest.importorskip("meshio")
    if COMM.rank == 0:
        points = np.random.default_rng(0).random((8, 3))
        meshio.write(folder / "mixed.vtu", meshio.Mesh(points, [("triangle", [[0, 1, 2]]), ("quad", [[3, 4, 5, 6]])]))
        meshio.write(folder / "prism.vtu", meshio.Mesh(points, [("wedge", [list(range(6))])]))
        (folder / "nonsense.inp").write_text("nothing of any use", encoding="utf-8")
        (folder / "shells.inp").write_text(DECK.format(nodes="1, 0, 0, 0").replace("CPS4", "NO4"), encoding="utf-8")
        (folder / "a.unknown").write_text("nothing of any use", encoding="utf-8")
    COMM.barrier()
    for name, error, words in (
        ("mixed.vtu", uem.MeshError, "quad, triangle.*cells='simplices'"),
        ("prism.vtu", uem.MeshError, "wedge: they must all be one kind.*cells='simplices'"),
        ("nonsense.inp", uem.MeshError, "nonsense.inp has no .ELEMENT"),
        ("shells.inp", uem.MeshError, "shells.inp: cannot read .ELEMENT.*element type NO4 is not known"),
        ("a.unknown", uem.MeshError, "meshio cannot read"),
        ("missing.vtu", uem.MissingFileError, "does not exist"),
    ):
        with pytest.raises(error, match=words):
            uem.read_mesh(folder / name, COMM)
    with pytest.raises(uem.MeshError, match="uem.read_mesh"):
        uem.read_gmsh(folder / "mixed.vtu", COMM)
    monkeypatch.setitem(sys.modules, "meshio", None)
    with pytest.raises(uem.MissingBackendError, match="pip install meshio"):
        uem.read_mesh(folder / "mixed.vtu", COMM)


@pytest.mark.parametrize("rest, words", [("3,1,2,3\n", "vertices of another cell"), ("3,1,2,2\n", "node twice")])
def test_a_deck_with_cells_that_are_none(tmp_path, rest, words):
    """The named error of a deck, the same on all ranks."""
    path = tmp_path / "m.inp"
    path.write_text("*NODE\n1,0,0\n2,1,0\n3,0,1\n4,1,1\n*ELEMENT,TYPE=CPE3\n1,1,2,3\n2,2,4,3\n" + rest)
    with pytest.raises(MeshError, match=words):
        uem.read_mesh(path, COMM)
