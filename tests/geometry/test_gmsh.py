"""Gmsh files and models to meshes and tags: what arrives on the ranks, and what is refused on all of them alike.

Worth reading first: ``test_tags_are_where_they_were_drawn`` (each rank's entities, ghosts included, against a geometric search) and
``test_refusals``.
"""

from __future__ import annotations

import subprocess
import sys

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from helpers import environment, serial

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.geometry.gmsh import Tag, read_gmsh

PLATES = """
DefineConstant[ h = {0.4, Name "mesh size", Min 0.01}, w = 2, // length; x = 3
  order = 1 ];
/* DefineConstant[ nothing = 1 ]; */
Include "bodies.inc.geo";
Physical Curve("left") = {4, 14};
Physical Curve("target", 5) = {3};
Physical Curve("contactor") = {11};
Physical Curve("outline") = {1:4, 11:14};  // overlaps the others
Physical Curve("off the bodies") = {21};
Physical Curve(77) = {2};
Physical Surface("lower", 5) = {1};
Physical Surface("upper", 60) = {2};
Physical Point("corner") = {1};
Mesh.ElementOrder = order;
"""
BODIES = """
Point(1) = {0, 0, 0, h}; Point(2) = {w, 0, 0, h}; Point(3) = {w, 1, 0, h}; Point(4) = {0, 1, 0, h};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1:4}; Plane Surface(1) = {1};
Point(11) = {0, 1, 0, h}; Point(12) = {w, 1, 0, h}; Point(13) = {w, 3, 0, h}; Point(14) = {0, 3, 0, h};
Line(11) = {11, 12}; Line(12) = {12, 13}; Line(13) = {13, 14}; Line(14) = {14, 11};
Curve Loop(2) = {11:14}; Plane Surface(2) = {2};
Point(21) = {-5, 0, 0, h}; Point(22) = {-5, 1, 0, h}; Line(21) = {21, 22};
"""
BLOCK = """
DefineConstant[ hexahedra = 1, order = 1 ];
Point(1) = {0, 0, 0, 0.5}; Point(2) = {1, 0, 0, 0.5}; Point(3) = {1, 2, 0, 0.5}; Point(4) = {0, 2, 0, 0.5};
Line(1) = {1, 2}; Line(2) = {2, 3}; Line(3) = {3, 4}; Line(4) = {4, 1};
Curve Loop(1) = {1:4}; Plane Surface(1) = {1};
Transfinite Curve {1, 3} = 3; Transfinite Curve {2, 4} = 4; Transfinite Surface {1};
If (hexahedra)
  Recombine Surface {1};
  out[] = Extrude {0, 0, 3} { Surface{1}; Layers{3}; Recombine; };
Else
  out[] = Extrude {0, 0, 3} { Surface{1}; Layers{3}; };
EndIf
Physical Volume("body") = {out[1]};
Physical Surface("bottom") = {1};
Physical Surface("top") = {out[0]};
Physical Curve("edge") = {1};
Mesh.ElementOrder = order;
"""


@pytest.fixture
def write(comm, folder):
    """Write a file on rank 0 and tell all ranks its path."""

    def _write(name: str, text: str):
        if comm.rank == 0:
            (folder / name).write_text(text)
        comm.barrier()
        return folder / name

    return _write


@pytest.fixture
def plates(write):
    write("bodies.inc.geo", BODIES)
    return write("plates.geo", PLATES)


def size(mesh, tag: Tag) -> float:
    """Length, area or volume of a tag over all ranks."""
    one = fem.Constant(mesh, 1.0)
    if tag.dim < mesh.topology.dim:
        measure = forms.surface_measure(mesh, tag.entities)
    else:
        cells = forms.mesh_tags(mesh, tag.dim, tag.entities, 1)
        measure = ufl.Measure("dx", domain=mesh, subdomain_data=cells)(1)
    return forms.assemble_scalar(forms.form(one * measure), mesh.comm)


def n_owned(mesh, tag: Tag) -> int:
    owned = mesh.topology.index_map(tag.dim).size_local
    return mesh.comm.allreduce(int(np.count_nonzero(tag.entities < owned)))


# -- what arrives ------------------------------------------------------------------------------------------------------


def test_names_numbers_and_sizes(plates, comm):
    mesh, tags = read_gmsh(plates, comm)
    assert mesh.geometry.dim == mesh.topology.dim == 2
    for name, dim, expected in [
        ("lower", 2, 2), ("upper", 2, 4), ("left", 1, 3), ("target", 1, 2), ("contactor", 1, 2), ("outline", 1, 14)
    ]:  # fmt: skip
        tag = tags[name]
        assert (tag.name, tag.dim, tag.mesh) == (name, dim, mesh)
        assert tag.entities.dtype == np.int32 and (np.diff(tag.entities) > 0).all()
        assert size(mesh, tag) == pytest.approx(expected, rel=1e-12)
    assert n_owned(mesh, tags["corner"]) == 1
    assert tags[77].name is None and size(mesh, tags[77]) == pytest.approx(1)
    assert tags[60] is tags["upper"] is tags[2, 60] is tags[2, "upper"] is tags[np.int64(60)]
    assert tags[1, 5] is tags["target"] and tags[2, 5] is tags["lower"]


def test_tags_are_where_they_were_drawn(plates, comm):
    """Each rank holds all its entities of a group, ghosts too, as a search by place finds them."""
    mesh, tags = read_gmsh(plates, comm, parameters={"h": 0.15})

    def between(lo, hi):
        return lambda x: (x[1] >= lo - 1e-9) & (x[1] <= hi + 1e-9)

    for name, dim, marker in [
        ("left", 1, lambda x: np.isclose(x[0], 0)), ("lower", 2, between(0, 1)), ("upper", 2, between(1, 3))
    ]:  # fmt: skip
        np.testing.assert_array_equal(tags[name].entities, np.sort(dmesh.locate_entities(mesh, dim, marker)))
    # equal places, different bodies: the two sides of the interface
    both = np.sort(dmesh.locate_entities(mesh, 1, lambda x: np.isclose(x[1], 1)))
    sides = np.concatenate([tags["target"].entities, tags["contactor"].entities])
    np.testing.assert_array_equal(np.sort(sides), both)
    inner = np.setdiff1d(tags["outline"].entities, tags["left"].entities)
    assert len(inner) + len(tags["left"].entities) == len(tags["outline"].entities)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("hexahedra", [0, 1])
def test_bodies_in_3d(write, comm, hexahedra, order):
    mesh, tags = read_gmsh(write("block.geo", BLOCK), comm, 3, {"hexahedra": hexahedra, "order": order})
    assert compat.cell_name(mesh) == ("hexahedron" if hexahedra else "tetrahedron")
    assert size(mesh, tags["body"]) == pytest.approx(6)
    assert size(mesh, tags["bottom"]) == pytest.approx(2) and size(mesh, tags["top"]) == pytest.approx(2)
    assert n_owned(mesh, tags["edge"]) == 2
    assert n_owned(mesh, tags["body"]) == 2 * 3 * 3 * (1 if hexahedra else 6)


@pytest.mark.parametrize("order", [1, 2])
def test_quadrilaterals(plates, write, comm, order):
    path = write("quads.geo", PLATES + "Transfinite Surface {1, 2};\nRecombine Surface {1, 2};\n")
    mesh, tags = read_gmsh(path, comm, parameters={"order": order})
    assert compat.cell_name(mesh) == "quadrilateral"
    assert size(mesh, tags["upper"]) == pytest.approx(4)
    assert size(mesh, tags["contactor"]) == pytest.approx(2)


def test_curved_cells(write, comm):
    """A disc of quadratic triangles has its area to a fourth order error."""
    disc = """
    DefineConstant[ order = 1 ];
    SetFactory("OpenCASCADE"); Disk(1) = {0, 0, 0, 1}; Mesh.MeshSizeMax = 0.3; Mesh.ElementOrder = order;
    Physical Surface("disc") = {1}; Physical Curve("rim") = {1};
    """
    path = write("disc.geo", disc.replace("Mesh.MeshSizeMax", "Mesh.CharacteristicLengthMax"))
    errors = []
    for order in (1, 2):
        mesh, tags = read_gmsh(path, comm, parameters={"order": order})
        errors.append(abs(size(mesh, tags["disc"]) / np.pi - 1))
        assert size(mesh, tags["rim"]) == pytest.approx(2 * np.pi, rel=0.02 if order == 1 else 1e-4)
    assert errors[0] > 5e-3 and errors[1] < 1e-4


def test_parameters_change_the_mesh_and_leave_no_trace(plates, comm):
    def cells(**parameters):
        mesh, tags = read_gmsh(plates, comm, parameters=parameters)
        return mesh.topology.index_map(2).size_global, size(mesh, tags["target"])

    n, length = cells()
    fine, _ = cells(h=0.1)
    _, longer = cells(w=3)
    assert fine > 3 * n and length == pytest.approx(2) and longer == pytest.approx(3)
    assert cells() == (n, pytest.approx(length))


def test_without_groups_all_cells_are_taken(write, comm):
    mesh, tags = read_gmsh(write("plain.geo", "h = 0.5; w = 2;" + BODIES), comm)
    assert len(tags) == 0
    one = fem.Constant(mesh, 1.0)
    assert forms.assemble_scalar(forms.form(one * ufl.dx(domain=mesh)), comm) == pytest.approx(6)
    with pytest.raises(uem.TagError, match="no physical group"):
        tags["body"]


# -- the ways in -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("end", ["", " ", "\n", " // the end", " // the end\n"])
@pytest.mark.parametrize("included", [False, True])
def test_last_line_without_end(write, comm, included, end):
    """All statements of a last line are read, however the file ends, and so are those of files that it includes from its own folder."""
    last = 'Physical Curve("left") = {4}; Physical Curve("right") = {2}; Physical Surface("body") = {1};' + end
    write("bodies.inc.geo", "h = 0.5; w = 2;\n" + BODIES + (last if included else ""))
    path = write("last.geo", 'Include "bodies.inc.geo";\n' + ('Physical Curve("top") = {3};' + end if included else last))
    mesh, tags = read_gmsh(path, comm)
    assert [size(mesh, tags[name]) for name in ("left", "right", "body")] == pytest.approx([1, 1, 2], rel=1e-12)
    assert not included or size(mesh, tags["top"]) == pytest.approx(2)
    wrong = write("wrong.geo", "h = 1;\nPoint(1) = {0, 0, unknown, h};" + end)
    with pytest.raises(uem.MeshError, match=r"wrong.geo.*\bwrong.geo', line 2: Unknown variable 'unknown'"):
        read_gmsh(wrong, comm)


def test_live_model_and_msh_file(plates, comm, folder):
    """A live model is read where it is, in the user's session, which stays as it was."""
    model = None
    if comm.rank == 0:
        import gmsh

        gmsh.initialize(["gmsh"], False)
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.open(str(plates))
        gmsh.model.mesh.generate(2)
        gmsh.write(str(folder / "plates.msh"))
        model = gmsh.model
    try:
        mesh, tags = read_gmsh(model, comm, gdim=2)
        live = {key: size(mesh, tags[key]) for key in tags if tags[key].dim > 0}
        mesh, tags = read_gmsh(folder / "plates.msh", comm)  # within the user's session
        from_file = {key: size(mesh, tags[key]) for key in tags if tags[key].dim > 0}
        assert live == pytest.approx(from_file) and live["upper"] == pytest.approx(4)
        if comm.rank == 0:
            assert gmsh.model.getCurrent() == "plates" and len(gmsh.model.mesh.getElements(2)[0])
            assert gmsh.option.getNumber("General.Terminal") == 0
    finally:
        if comm.rank == 0:
            gmsh.finalize()
    mesh, tags = read_gmsh(str(folder / "plates.msh"), comm)  # in a session of its own
    assert size(mesh, tags["upper"]) == pytest.approx(4)
    with pytest.raises(uem.MeshError, match="not initialised"):
        read_gmsh(model if comm.rank == 0 else None, comm)


# -- what is refused ---------------------------------------------------------------------------------------------------


def test_tags_named_wrongly(plates, comm):
    _, tags = read_gmsh(plates, comm)
    with pytest.raises(uem.TagError, match=r"'contacter', did you mean 'contactor'.*'lower' \(dimension 2\)"):
        tags["contacter"]
    for key in (99, (1, "lower"), (2, "target"), (3, 5), "", None):
        with pytest.raises(uem.TagError, match="no physical group"):
            tags[key]
        assert key not in tags
    with pytest.raises(uem.TagError, match=r"ambiguous: ask for \(1, 5\) or \(2, 5\)"):
        tags[5]
    with pytest.raises(uem.TagError, match="off the bodies.*no entity"):
        tags["off the bodies"]
    assert "off the bodies" not in tags and "off the bodies" not in list(tags)
    assert len(tags) == len(list(tags)) == 8
    with pytest.raises(KeyError):
        tags["contacter"]


@pytest.mark.parametrize(
    "name, text, options, error, message",
    [
        ("absent.geo", None, {}, uem.MissingFileError, "absent.geo does not exist"),
        ("absent.msh", None, {}, FileNotFoundError, "absent.msh does not exist"),
        ("mesh.xdmf", "", {}, uem.MeshError, "neither a .geo nor a .msh"),
        ("ok.geo", "DefineConstant[ h = 1 ];", {"parameters": {"H": 1.0}}, uem.MeshError, "no constant 'H'.*declares h"),
        ("ok.geo", "", {"parameters": {"h": 1.0}}, uem.MeshError, "declares nothing"),
        ("ok.geo", "DefineConstant[ h = 1 ];", {"parameters": {"h": np.nan}}, uem.MeshError, "finite"),
        ("ok.msh", "", {"parameters": {"h": 1.0}}, uem.MeshError, "takes no parameters"),
        ("bad.geo", "Point(1) = {unknown, 0, 0};", {}, uem.MeshError, "cannot read or mesh.*bad.geo"),
        ("bad.geo", "h = 1;\nPoint(1) = {;\n", {}, uem.MeshError, "cannot read or mesh.*bad.geo"),
        ("empty.geo", "Point(1) = {0, 0, 0};", {}, uem.MeshError, "no cells"),
        ("plates.geo", "h = 1; w = 2;" + BODIES, {"gdim": 3}, uem.MeshError, "dimension 2, not 3.*gdim=2"),
        ("block.geo", BLOCK, {"gdim": 4}, uem.MeshError, "gdim is 4"),
        ("shell.geo", "h = 1; w = 2;" + BODIES.replace("{w, 1, 0, h}; Point(4)", "{w, 1, 1, h}; Point(4)"), {}, uem.MeshError, "plane"),
        ("mixed.geo", "h = 1; w = 2;" + BODIES + "Recombine Surface {1}; Transfinite Surface {1};", {}, uem.MeshError, "one kind"),
    ],
)  # fmt: skip
def test_refusals(write, folder, comm, name, text, options, error, message):
    """Whatever rank 0 finds wrong, all ranks say; afterwards Gmsh works again."""
    path = folder / name if text is None else write(name, text)
    with pytest.raises(error, match=message):
        read_gmsh(path, comm, **options)
    with pytest.raises(uem.UEMError, match=message):
        read_gmsh(str(path), comm, **options)
    mesh, _ = read_gmsh(write("good.geo", "h = 1; w = 2;" + BODIES), comm)
    assert mesh.topology.index_map(2).size_global > 0


def test_how_plane_a_body_must_be(write, comm):
    """Two bodies, 3 high: a corner may be off their plane by rounding, not by three times 1e-10 of that."""
    warped = "h = 1; w = 2;" + BODIES.replace("{w, 1, 0, h}; Point(4)", "{w, 1, %s, h}; Point(4)")
    mesh, _ = read_gmsh(write("plane.geo", warped % "1e-10"), comm)
    assert mesh.geometry.dim == 2
    with pytest.raises(uem.MeshError, match="leaves the plane"):
        read_gmsh(write("warped.geo", warped % "9e-10"), comm)


def test_nothing_to_read(comm):
    with pytest.raises(uem.MeshError, match="None on rank 0"):
        read_gmsh(None, comm)


def test_unmeshed_model(comm):
    model = None
    if comm.rank == 0:
        import gmsh

        gmsh.initialize(["gmsh"], False)
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
        gmsh.model.occ.synchronize()
        model = gmsh.model
    try:
        with pytest.raises(uem.MeshError, match="mesh it first"):
            read_gmsh(model, comm)
        with pytest.raises(uem.MeshError, match="live gmsh.model is already built"):
            read_gmsh(model if comm.rank == 0 else "", comm, parameters={"h": 1.0})
    finally:
        if comm.rank == 0:
            gmsh.finalize()


def test_gmsh_missing(plates, comm, monkeypatch):
    if comm.rank == 0:
        monkeypatch.setitem(sys.modules, "gmsh", None)
    with pytest.raises(uem.MissingBackendError, match="python3-gmsh"):
        read_gmsh(plates, comm)


def test_communicator_of_one_rank(plates):
    """Each rank may read for itself."""
    mesh, tags = read_gmsh(plates, MPI.COMM_SELF)
    assert mesh.comm.size == 1 and size(mesh, tags["lower"]) == pytest.approx(2)


def test_examples_come_with_the_package():
    assert uem.example_mesh("hertz_cylinder").read_text(encoding="utf-8").count("Physical") > 3
    with pytest.raises(uem.InputError, match="'hertz_cylinder'.*did you mean 'hertz_sphere'"):
        uem.example_mesh("hertz_spher")


def test_regular_cells_of_the_examples(comm):
    """All versions of Gmsh make the same cells of volumes by rows, and quadrilaterals alone from an odd number of rows."""
    rods = {"n_1": 8, "n_2": 6, "m": 2}
    for name, gdim, sizes, cell, cells in [
        ("blocks", 3, {"dim": 3, "n_1": 2, "n_2": 3}, "tetrahedron", 6 * (8 + 27)),
        ("blocks", 3, {"dim": 3, "n_1": 2, "n_2": 3, "quads": 1}, "hexahedron", 8 + 27),
        ("crossed_rods", 3, rods, "hexahedron", 4 * (8 + 6)),
        ("hertz_cylinder", 2, {"h": 1 / 30, "quads": 1}, "quadrilateral", None),
    ]:
        mesh, _ = read_gmsh(uem.example_mesh(name), comm, gdim, sizes)
        assert compat.cell_name(mesh) == cell
        assert cells in (None, mesh.topology.index_map(gdim).size_global)


@serial
def test_gmsh_is_not_called_before_it_is_initialised():
    """Gmsh 4.8 would read there whether errors end the process, from memory that is not set: one in some hundred scripts ended silently."""
    script = """
import gmsh
from uem_dolfinx import compat

def called(*a):
    raise SystemExit("called")

kept, gmsh.model.list = gmsh.model.list, called
assert not compat.gmsh_is_initialized(gmsh)
gmsh.model.list = kept
gmsh.initialize(["gmsh"], False)
assert compat.gmsh_is_initialized(gmsh)
gmsh.finalize()
assert not compat.gmsh_is_initialized(gmsh)
"""
    done = subprocess.run([sys.executable, "-c", script], env=environment(), capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
