"""The front door: all that a script imports is ``uem_dolfinx``, whatever names surfaces and supports, on any number of ranks.

Worth reading first: ``test_readme`` and ``test_whatever_names_a_surface``.
"""

from __future__ import annotations

import ast
import re
import shutil
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx import mesh as dmesh
from helpers import at, blocks, clamp, linear, modulus, outside_mpi, raised, refused, serial
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import forms

COMM = MPI.COMM_WORLD
REPO = Path(__file__).resolve().parents[2]
README = (REPO / "README.md").read_text(encoding="utf-8").partition("```python\n")[2].partition("```")[0]


def owned(mesh, tag):
    """The facets of a tag that this rank owns, in an order of its own."""
    return tag.entities[tag.entities < mesh.topology.index_map(tag.dim).size_local][::-1]


# -- the script of the README ------------------------------------------------------------------------------------------


def test_readme(folder, monkeypatch, capsys):
    if COMM.rank == 0:
        (folder / "meshes").symlink_to(REPO / "meshes")
    COMM.barrier()
    monkeypatch.chdir(folder)
    known = {}
    exec(compile(README, "README.md", "exec"), known)
    assert 2 * known["force"][1] == pytest.approx(1086.3, rel=2e-3) and known["p_max"] == pytest.approx(7900, rel=0.02)
    if COMM.rank == 0:
        assert "largest pressure" in capsys.readouterr().out
        assert all((folder / "results" / name).exists() for name in ("scene.png", "hertz.csv"))


@pytest.mark.slow
def test_tutorial(folder, monkeypatch):
    """The geometry and the script of the tutorial run as they stand there, and their figures are those of the text."""
    page = (REPO / "demos" / "site" / "tutorial.md").read_text(encoding="utf-8")
    if COMM.rank == 0:
        (folder / "roller.geo").write_text(re.search(r"```c\n(.*?)```", page, re.DOTALL)[1], encoding="utf-8")
    COMM.barrier()
    monkeypatch.chdir(folder)
    known = {}
    exec(compile("".join(re.findall(r"```python\n(.*?)```", page, re.DOTALL)), "tutorial.md", "exec"), known)
    assert known["pressure"] == pytest.approx(1.03 * known["hertz"], rel=0.01)
    assert max(known["balance"].force, known["balance"].moment) < 1e-14


@pytest.mark.slow
def test_viscoelastic_page():
    """A spring parallel to a spring and a dashpot, squeezed steadily: the force to the first order of the steps' length."""
    page = (REPO / "demos" / "site" / "howto" / "own_residuals.md").read_text(encoding="utf-8")
    errors = []
    for n in (40, 80):
        known = {}
        script = re.findall(r"```python\n(.*?)```", page, re.DOTALL)[1].replace("0.02, 80", f"0.02, {n}")
        exec(compile(script, "own_residuals.md", "exec"), known)
        E, E1, tau, end, squeeze = (known[name] for name in ("E", "E1", "tau", "end", "squeeze"))
        t = end * np.arange(1, n + 1) / n
        force = squeeze / end * (E * t + E1 * tau * (1 - np.exp(-t / tau)))
        errors.append(np.abs(known["forces"] - force).max() / force.max())
    assert errors[1] < 3.5e-3 and errors[0] == pytest.approx(2 * errors[1], rel=0.05)


def test_readme_is_short_and_needs_no_inner_module():
    assert len(README.splitlines()) <= 20
    sources = {"README.md": README} | {p.name: p.read_text(encoding="utf-8") for p in (REPO / "demos").glob("*.py")}
    for name, source in sources.items():
        for node in ast.walk(ast.parse(source)):
            if isinstance(node, ast.ImportFrom):
                assert not str(node.module).startswith("uem_dolfinx"), f"{name} imports from {node.module}"
            elif isinstance(node, ast.Import):
                assert all(a.name == "uem_dolfinx" for a in node.names if "uem_dolfinx" in a.name), name


def test_links_of_the_readmes():
    """Files that READMEs link to are there, and modules that the package's docstring names."""
    assert len((REPO / "README.md").read_text(encoding="utf-8").splitlines()) <= 150
    for path in [REPO / "README.md", REPO / "demos" / "README.md", *(REPO / "uem_dolfinx").glob("README.md")]:
        for link in re.findall(r"\]\(([\w/.-]+)", path.read_text(encoding="utf-8")):
            assert link.startswith("http") or (path.parent / link).exists(), f"{path.name}: {link}"
    for module in re.findall(r"``([a-z_.]+)``", uem.__doc__):
        assert find_spec(f"uem_dolfinx.{module}"), module


def test_reference():
    assert sorted(uem.__all__, key=str.lower) == sorted(set(uem.__all__), key=str.lower)
    assert all(getattr(uem, name).__doc__ for name in uem.__all__)
    assert [name for name in dir(uem) if not name.startswith("__")] == sorted(uem.__all__)


# -- the first run -----------------------------------------------------------------------------------------------------


def first_run(folder, ranks, **environment):
    """A script with an empty cache of compiled forms, without this MPI."""
    script = folder / "script.py"
    script.write_text(
        README.replace('"h": 0.01', '"h": 0.1').partition("contact =")[0] + "uem.integrate(u[0] * uem.ds(tags['disc_top']))"
    )
    (folder / "meshes").symlink_to(REPO / "meshes")
    env = outside_mpi() | {"XDG_CACHE_HOME": str(folder / "cache"), "OMP_NUM_THREADS": "1", "PYTHONPATH": str(REPO)} | environment
    mpiexec = shutil.which("mpiexec", path=str(Path(sys.executable).parent)) or shutil.which("mpiexec")
    command = [sys.executable, str(script)]
    command = command if ranks == 1 else [str(mpiexec), "-n", str(ranks), *command]
    return subprocess.run(command, cwd=folder, env=env, capture_output=True, text=True)


@serial
@pytest.mark.slow
@pytest.mark.parametrize("ranks", [1, 2])
def test_first_run_prints_nothing_of_the_compiler(tmp_path, ranks):
    done = first_run(tmp_path, ranks)
    assert done.returncode == 0, done.stderr
    assert list((tmp_path / "cache").rglob("*.so")), "nothing was compiled"
    assert done.stdout == "" and not re.search("gcc|build_ext|libffcx", done.stderr), done.stderr


@serial
def test_errors_of_the_compiler_are_shown(tmp_path):
    done = first_run(tmp_path, 1, CC=shutil.which("false"))
    assert done.returncode != 0 and "Error" in done.stderr and "false" in done.stderr


# -- spaces ------------------------------------------------------------------------------------------------------------


def test_spaces():
    mesh = blocks(COMM, "triangle").scene.mesh
    for ours, theirs in (
        (uem.function_space(mesh, 1, (2,)), uem.function_space(mesh, ("Lagrange", 1, (2,)))),
        (uem.function_space(mesh, 2), uem.function_space(mesh, ("Lagrange", 2))),
        (uem.function_space(mesh, ("DG", 0), (2, 2)), uem.function_space(mesh, ["DG", 0, (2, 2)])),
    ):
        assert ours.ufl_element() == theirs.ufl_element()
    for element in (
        "Lagrange",
        ("Lagrange",),
        (1, "Lagrange"),
        1.5,
        True,
        ("Lagrange", True),
        ("Lagrange", 1.5),
        ("Lagrange", "1"),
    ):
        with pytest.raises(ValueError, match="expected a degree"):
            uem.function_space(mesh, element)
    refused(uem.InputError, "shape = (True,)", lambda: uem.function_space(mesh, 1, (True,)))


def test_true_is_no_number():
    """Python counts True among the numbers; here it is refused by name, alone and in vectors."""
    b = blocks(COMM, "triangle")
    V, low, high = b.u.function_space, b.low, b.high
    place = (0.0, 0.0)
    for words, call in (
        ("force = (True, 0.0)", lambda: uem.PointLoad(place, (True, 0.0))),
        ("b = True", lambda: uem.Equation([(place, (0, 1))], b=np.True_)),
        ("the vector of terms[0]", lambda: uem.Equation([(place, (0, True))])),
        ("jump = [True, 0.0]", lambda: uem.periodic(high, low, jump=[True, 0.0])),
        ("the value of a Dirichlet condition", lambda: uem.dirichlet(V, b.bottom, value=(True, 1.0))),
    ):
        refused(uem.InputTypeError, words, call)
    refused(uem.InputError, "component = True", lambda: uem.dirichlet(V, b.bottom, True))
    refused(uem.MassError, "density True", lambda: uem.lumped_mass(V, True))
    refused(uem.InputError, "adjust = inf", lambda: uem.Contact(high, low, adjust=np.inf))


# -- surfaces ----------------------------------------------------------------------------------------------------------


def named(b, tag, how):
    """The same facets by another name."""
    mesh, t = b.scene.mesh, tag.dim
    half = tag.entities[dmesh.compute_midpoints(mesh, t, tag.entities)[:, 0] < 0.5] if hasattr(dmesh, "compute_midpoints") else []
    other = np.setdiff1d(tag.entities, half)
    values = np.where(np.isin(tag.entities, half), 3, 7)
    n = mesh.topology.index_map(t).size_local + mesh.topology.index_map(t).num_ghosts
    rest = np.setdiff1d(np.arange(n), tag.entities)
    return {
        "tag": tag,
        "list of tags": [uem.Tag("a", 1, t, mesh, np.array(half, np.int32)), uem.Tag("b", 2, t, mesh, other.astype(np.int32))],
        "MeshTags": (forms.mesh_tags(mesh, t, tag.entities, 5), 5),
        "MeshTags, several values": (
            forms.mesh_tags(mesh, t, np.concatenate([tag.entities, rest]), np.concatenate([values, 0 * rest])), [3, 7],
        ),
        "MeshTags without ghosts": (forms.mesh_tags(mesh, t, owned(mesh, tag), 5), 5),
        "array": tag.entities,
        "array without ghosts": owned(mesh, tag),
        "list of numbers": owned(mesh, tag).tolist(),
        "list of everything": [owned(mesh, tag).tolist(), (forms.mesh_tags(mesh, t, tag.entities, 5), 5), tag, tag.entities],
    }[how]  # fmt: skip


@pytest.mark.parametrize(
    "how",
    ["list of tags", "MeshTags", "MeshTags, several values", "MeshTags without ghosts", "array", "array without ghosts",
     "list of numbers", "list of everything"],
)  # fmt: skip
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_whatever_names_a_surface(cell, how):
    b = blocks(COMM, cell, 2, 3)
    mesh, g, u, v = b.scene.mesh, b.gdim, b.u, ufl.TestFunction(b.V)
    found = []
    for name in ("tag", how):
        u.x.array[:] = 0.0
        bottom, low, high, top = (named(b, tag, name) for tag in (b.bottom, b.low, b.high, b.top))
        F = linear(u, modulus(b.scene, 1.0, 2.0)) + 0.1 * v[g - 1] * uem.ds(top, mesh)
        bcs = [uem.dirichlet(b.V, bottom)] + [uem.dirichlet(b.V, top, i) for i in range(g - 1)]
        contact = uem.Contact(high, low)
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
        problem.solve()
        found.append((contact.resultant().force, problem.reaction(bottom), contact.max_pressure(), u.x.array.copy()))
        assert contact.name and isinstance(contact.contactor, uem.Tag)
    for ours, theirs in zip(*found):
        np.testing.assert_allclose(ours, theirs, rtol=1e-10, atol=1e-12)
    assert found[0][0][g - 1] == pytest.approx(0.1) and found[0][1][g - 1] == pytest.approx(0.1)


@pytest.mark.parametrize("how", ["tag", "MeshTags without ghosts", "array without ghosts"])
def test_a_target_inside_a_body_is_refused_whatever_names_it(how):
    """Its facets must be known to both ranks that have them, also where the user's array has owned ones only."""
    b = blocks(COMM, "triangle", 4, 4)
    inside = named(b, b.scene.tag("inside", 0, at(1, -0.5)), how)
    with pytest.raises(uem.OrientationError, match="between two cells"):
        uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, contacts=[uem.Contact(b.high, inside)])


def test_cells_of_a_material():
    b = blocks(COMM, "quadrilateral")
    cells = np.flatnonzero(b.scene.body == 0)
    n = b.scene.mesh.topology.index_map(2).size_local
    law = [
        uem.VonMises(b.u, 1.0, 0.3, 1.0, kind="plane_strain", cells=given)
        for given in (
            uem.Tag("lower", 1, 2, b.scene.mesh, cells),
            cells[cells < n],
            (forms.mesh_tags(b.scene.mesh, 2, cells, 4), 4),
        )
    ]
    assert all(np.array_equal(law[0].cells, other.cells) for other in law[1:]) and COMM.allreduce(len(law[0].cells)) == 4


def test_what_names_no_surface():
    b, other = blocks(COMM, "triangle"), blocks(COMM, "triangle")
    mesh = b.scene.mesh
    tags = forms.mesh_tags(mesh, 1, b.low.entities, 5)
    last = COMM.rank == COMM.size - 1
    for error, match, part in (
        (uem.TagError, "holds no facets", np.zeros(0, np.int32)),
        (uem.TagError, "holds no facets", []),
        (uem.TagError, "holds no facets", (tags, 6)),
        (uem.TagError, r"the measure ds = 'low'.*expected a tag.*give tags\['low'\]", "low"),
        (uem.TagError, "measure ds = None.*expected a tag", None),
        (uem.TagError, "expected a tag", np.ones(3)),
        (uem.TagError, "expected a tag", b.low.entities if not last else np.zeros((2, 2), int)),
        (uem.TagError, "indices.*expected local ones", b.low.entities if not last else [-1, 3]),
        (uem.TagError, "indices.*expected local ones", b.low.entities if not last else [10**6]),
        (uem.TagError, "dimension 2", (forms.mesh_tags(mesh, 2, np.arange(1), 1), 1)),
        (uem.SpaceError, "another mesh", other.low),
        (uem.SpaceError, "another mesh", (forms.mesh_tags(other.scene.mesh, 1, other.low.entities, 5), 5)),
    ):
        raised(error, match, lambda part=part: uem.ds(part, mesh))
    point = uem.Tag("A", 1, 0, mesh, np.zeros(1, np.int32))
    raised(uem.TagError, "'low and A' is of several dimensions", lambda: uem.dirichlet(b.V, [b.low, point]))
    with pytest.raises(ValueError, match="needs the mesh"):
        uem.ds((tags, 5))


# -- measures and integrals --------------------------------------------------------------------------------------------


def test_measures():
    """Areas of overlapping surfaces, alone, together in one form, and with measures over everything and of the user's."""
    b = blocks(COMM, "triangle", 2, 4, gap=0.5)
    mesh, one = b.scene.mesh, fem.Constant(b.scene.mesh, PETSc.ScalarType(1.0))
    both, low, high, left = [b.low, b.high], b.low, b.high, b.scene.tag("left", 0, at(0, 0.0))
    everything, mine = (
        ufl.ds(domain=mesh),
        ufl.Measure("ds", domain=mesh, subdomain_data=forms.mesh_tags(mesh, 1, low.entities, 8)),
    )
    for form, exact in (
        (one * uem.ds(low), 1.0),
        (one * uem.ds(both) + one * uem.ds(low), 3.0),
        (2 * one * uem.ds(both) + 10 * one * uem.ds(low) + 100 * one * uem.ds(left) + 1000 * one * uem.ds(high), 1114.0),
        (
            one * uem.ds(both) + 10 * one * everything + 100 * one * mine(8) + 1000 * one * mine(9) + 1000 * one * mine,
            2 + 80 + 100 + 8000,
        ),
        (one * uem.ds(left) + one * uem.dx(np.flatnonzero(b.scene.body == 0), mesh) + one * ufl.dx(domain=mesh), 4.0),
    ):
        assert uem.integrate(form) == pytest.approx(exact, rel=1e-12)
    x = ufl.SpatialCoordinate(mesh)
    assert uem.integrate(fem.form(x[0] ** 2 * uem.ds(low, quadrature_degree=2))) == pytest.approx(1 / 3, rel=1e-12)
    assert abs(uem.integrate(x[0] ** 2 * uem.ds(low, quadrature_degree=1)) - 1 / 3) > 1e-3


def test_loads_on_several_surfaces():
    """Each load of a residual acts on its own surface, whatever else the form holds."""
    b = blocks(COMM, "triangle", 2, 2)
    v, right = ufl.TestFunction(b.V), [b.scene.tag("right", k, at(0, 1.0)) for k in (0, 1)]
    F = linear(b.u, modulus(b.scene, 1.0, 1.0)) - 0.025 * v[0] * uem.ds(right) + (0.25 + 0.5 * b.u[1]) * v[1] * uem.ds(b.top)
    bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.high, 0)]
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[uem.Contact(b.high, b.low)])
    problem.solve()
    spring, held = uem.integrate(0.5 * b.u[1] * uem.ds(b.top)), problem.reaction(b.bottom)
    assert held[1] == pytest.approx(0.25 + spring, rel=1e-6) and spring < -0.01
    assert held[0] + problem.reaction(b.high)[0] == pytest.approx(-0.05, rel=1e-6)


def test_interpolation_and_timing():
    b = blocks(COMM, "triangle")
    x, f = ufl.SpatialCoordinate(b.scene.mesh), fem.Function(uem.function_space(b.scene.mesh, 1))
    before = uem.timing("compile forms")
    uem.interpolate(f, x[0] + 2 * x[1])
    assert uem.integrate(f * ufl.dx) == pytest.approx(1.0, abs=1e-12)
    uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=clamp(b.V, b.bottom) + clamp(b.V, b.top))
    after = uem.timing("compile forms")
    assert after[0] > before[0] and after[1] >= before[1]
    assert uem.timings()["compile forms"] == after
    rows = [line.split() for line in str(uem.timings()).splitlines()]
    seconds = [float(row[0]) for row in rows[1:]]
    assert rows[0][:2] == ["seconds", "times"] and seconds == sorted(seconds, reverse=True) and len(seconds) == len(uem.timings())


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_interpolation_into_every_space(cell):
    """A cubic polynomial is exact where its degree is, or at the points of a rule; integrals by the points are those of the form."""
    mesh = blocks(COMM, cell).scene.mesh
    x = ufl.SpatialCoordinate(mesh)
    p, n = 1 + x[0] ** 2 * x[1], 7
    exact = uem.integrate(p * ufl.dx)
    for space in (("Lagrange", 3), ("DG", 3)):
        f = fem.Function(uem.function_space(mesh, space))
        uem.interpolate(f, p)
        assert uem.integrate((f - p) ** 2 * ufl.dx) == pytest.approx(0.0, abs=1e-25)
    for shape, expression in (((), p), ((n,), ufl.as_vector([k * p for k in range(n)])), ((2, 2), p * ufl.Identity(2))):
        f = fem.Function(uem.function_space(mesh, ("Quadrature", 4), shape))
        uem.interpolate(f, expression)
        rule = {"quadrature_degree": 4, "quadrature_scheme": "default"}
        found = {0: lambda f: f, 1: lambda f: f[n - 1] / (n - 1), 2: lambda f: f[1, 1] + 3 * f[0, 1]}[len(shape)](f)
        assert uem.integrate(found * ufl.dx(metadata=rule)) == pytest.approx(exact, rel=1e-13)
    other = fem.Function(uem.function_space(mesh, ("RT" if cell == "triangle" else "RTCF", 1)))
    refused(uem.SpaceError, "Lagrange, DG or quadrature", lambda: uem.interpolate(other, ufl.as_vector([p, p])))


# -- what scripts and logs see -----------------------------------------------------------------------------------------


def test_objects_tell_what_they_are():
    """On any one rank: the size of the problem, how far it is, and what a contact is made of."""
    b = blocks(COMM, "quadrilateral", 2, 5)
    contact = uem.Contact(b.high, b.low, friction=uem.Tresca(0.1), coupling="mortar")
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top)], contacts=[contact])
    assert repr(contact) == "Contact('high on low', coupling='mortar', sliding='finite', friction=Tresca(0.1))"
    problem.solve()
    assert repr(problem) == "UnitedProblem(90 unknowns in 2D, statics, contacts: 'high on low', steps committed: 1)"
    plane = uem.RigidPlane((0, 1), (0, 1))
    assert repr(plane.move((0.0, 0.5))) == "RigidPlane('rigid plane' at (0, 1.5))"
    assert repr(uem.RigidSurface(lambda x: x[:, 0], lambda x: x)) == "RigidSurface('rigid surface')"
    assert repr(uem.Contact(b.high, plane, friction=0)).endswith("sliding='finite')")


def test_a_line_a_step(caplog):
    """At level INFO the log of a batch run has a line for each step, with the contacts' forces; at WARNING it has none."""
    b = blocks(COMM, "quadrilateral", 2, 5)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(0.02), contacts=[contact])
    forces = []
    with caplog.at_level("INFO", logger="uem_dolfinx"):
        for step in uem.load_steps(problem, 2):
            forces.append(contact.resultant().force[1])
            assert repr(step).startswith(f"LoadStep(number={step.number}, factor={step.factor}, cuts=0, newton_iterations=")
    lines = [record.getMessage() for record in caplog.records if record.getMessage().startswith("load step")]
    if COMM.rank == 0:
        assert [line.partition(":")[0] for line in lines] == ["load step 1, factor 0.5", "load step 2, factor 1"]
        assert all(line.endswith(f"{force:.6g})") and "high on low: 6 active" in line for line, force in zip(lines, forces))
    caplog.clear()
    with caplog.at_level("WARNING", logger="uem_dolfinx"):
        list(uem.load_steps(problem, 1))
    assert not caplog.records


@serial
def test_versions_agree():
    import tomllib

    assert vars(uem)["__version__"] == tomllib.loads((REPO / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
