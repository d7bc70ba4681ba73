"""What a scene does not need is not done: counted by the timers, and by what Python has imported.

The two tests worth reading are ``test_nothing_near`` and ``test_linear_bodies_in_small_sliding``.
"""

from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
import ufl
from counting import CONDENSED, CROSSED, FACTORISATION, HISTORY, MASS, OUTPUT, PRODUCT, PROJECTION, SEARCH, TANGENT, P, counted
from dolfinx import fem
from helpers import at, blocks, box, clamp, environment, linear, lowest, run, scene, serial, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat, form_checks, forms
from uem_dolfinx.geometry import bodies
from uem_dolfinx.geometry.facets import TargetFacets


def block_over(comm, target_of, *, height=1.0, law=linear, **how):
    """Unit block that hangs ``height`` above a target, held at its top; ``target_of`` makes the target of the contact."""
    s = scene(comm, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [4, 4])], pose=lambda x: x + [0.0, height])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V, name="u")
    top, bottom = s.tag("top", 0, at(1, 1.0)), s.tag("bottom", 0, at(1, 0.0))
    contact = uem.Contact(bottom, target_of())
    return u, top, contact, law(u, 1000.0)


def floor() -> uem.RigidSurface:
    return uem.RigidPlane([0.0, 0.0], [0.0, 1.0])


# -- contact ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", [linear, st_venant])
@pytest.mark.parametrize("rigid", [False, True])
def test_nothing_near(comm, law, rigid):
    """Surfaces that stay far apart: neither P nor a product with it, in any iteration; near ones need both."""
    counts = {}
    for height in (1.0, 0.0):
        if rigid:
            u, top, contact, F = block_over(comm, floor, height=height, law=law)
            bcs = [*clamp(u.function_space, top, 0), *clamp(u.function_space, top, 1, value=-0.05)]
        else:
            b = blocks(comm, "quadrilateral", gap=height)
            u, F, bcs = b.u, law(b.u, 1000.0), b.oedometer(0.05)
            contact = uem.Contact(b.high, b.low)
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
        with counted() as counts[height]:
            run(problem, 3)
        assert (contact.n_active > 0) == (height == 0.0)
    far, near = counts[1.0], counts[0.0]
    assert far[P] == far[PRODUCT] == far[CONDENSED] == 0 < far[PROJECTION]
    assert far[CROSSED] > 0
    assert near[P] >= near[PRODUCT] + near[CONDENSED] > 0 == near[CROSSED]


def test_nothing_near_in_motion(comm):
    """A block that flies over a rigid floor and a meshed one: no P, not even for the acceleration that it starts with."""
    b = blocks(comm, "quadrilateral", gap=1.0)
    dynamics = uem.Dynamics(uem.lumped_mass(b.V, 1.0), velocity=[0.0, 1.0])
    problem = uem.UnitedProblem(
        linear(b.u, 1000.0), b.u, contacts=[uem.Contact(b.high, b.low)], bcs=clamp(b.V, b.bottom), dynamics=dynamics
    )
    with counted() as calls:
        steps = list(uem.time_steps(problem, 0.01, 0.03))
    assert len(steps) == 3
    assert calls[P] == calls[PRODUCT] == 0
    assert calls["first acceleration"] == 1


def test_left_behind(comm):
    """After a block has been lifted off its floor P goes as well; set down again, it comes back."""
    u, top, contact, F = block_over(comm, floor, height=0.0)
    V, lift = u.function_space, fem.Constant(u.function_space.mesh, 0.0)
    dofs = fem.locate_dofs_topological(V, top.dim, top.entities)
    where = fem.Function(V)
    bcs = [fem.dirichletbc(where, dofs)]
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
    found = []
    for settlement in (0.05, -0.5, -0.6, 0.05):
        where.x.array.reshape(-1, 2)[:, 1] = -settlement
        lift.value = settlement
        with counted() as calls:
            problem.solve()
        found.append((contact.n_active > 0, calls[P] > 0, calls[PRODUCT] + calls[CONDENSED] > 0))
    # the step that lifts the block begins in contact
    assert found == [(True,) * 3, (False, True, True), (False,) * 3, (True,) * 3]


def test_no_contact(comm):
    """Bodies without contacts: no search, no projection, no P."""
    b = blocks(comm, "triangle", gap=0.5)
    problem = uem.UnitedProblem(linear(b.u, 1000.0), b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=(0.0, 0.1))])
    with counted() as calls:
        run(problem, 3)
    assert calls[SEARCH] == calls[PROJECTION] == calls[P] == calls[PRODUCT] == 0
    assert calls[TANGENT] == calls[FACTORISATION] == 1


def test_rigid_surfaces_need_no_search(comm):
    """A rigid surface is projected onto at once; a meshed one has to be searched."""
    u, top, contact, F = block_over(comm, floor, height=0.0)
    with counted() as rigid:
        run(uem.UnitedProblem(F, u, bcs=clamp(u.function_space, top, value=(0.0, -0.05)), contacts=[contact]))
    assert rigid[SEARCH] == 0 < rigid[PROJECTION]
    b = blocks(comm, "quadrilateral")
    with counted() as meshed:
        run(uem.UnitedProblem(linear(b.u, 1000.0), b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)]))
    assert meshed[SEARCH] > 0 and meshed[PROJECTION] > 0


# -- linear bodies ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sliding", ["small", "fixed"])
def test_linear_bodies_in_small_sliding(comm, sliding):
    """K once for all load steps, and one factorisation while the active set and the feet stay; no search after a step's first."""
    b = blocks(comm, "quadrilateral")
    problem = uem.UnitedProblem(
        linear(b.u, 1000.0), b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low, sliding=sliding)]
    )
    with counted() as calls:
        steps = run(problem, 4)
    assert len(steps) == 4 and sum(step.newton_iterations for step in steps) >= 4
    assert calls[TANGENT] == 1
    assert calls[P] == calls[PRODUCT] + calls[CONDENSED] == calls[FACTORISATION] == 1
    # the first step's feet are known, and none are found for a step that may never come;
    # ranks search twice, the second time for what others may have nearer
    searches = 3 * min(comm.size, 2)
    assert calls[SEARCH] == (searches if sliding == "small" else 0) < calls[PROJECTION]


def test_active_set_that_changes(comm):
    """Where contactors are released K stays, and so does its factorisation: each active set is a dense problem of the contact alone."""
    b = blocks(comm, "quadrilateral", overhang=1.0)
    g = b.gdim
    # bent upwards at one end, the upper block comes off the lower one
    tilt = fem.Function(b.V)
    tilt.interpolate(lambda x: np.stack([0 * x[0], -0.01 + 0.05 * x[0]]))
    bcs = [*clamp(b.V, b.bottom), fem.dirichletbc(tilt, fem.locate_dofs_topological(b.V, g - 1, b.top.entities))]
    contact = uem.Contact(b.high, b.low, sliding="fixed")
    problem = uem.UnitedProblem(linear(b.u, 1000.0), b.u, bcs=bcs, contacts=[contact])
    touching = contact.n_active
    with counted() as calls:
        run(problem)
    assert 0 < contact.n_active < touching
    assert calls[TANGENT] == calls[FACTORISATION] == 1 < calls[CONDENSED]


def test_nonlinear_bodies_assemble(comm):
    """Bodies of St Venant and Kirchhoff need a new K in every iteration of the full Newton method."""
    b = blocks(comm, "quadrilateral")
    problem = uem.UnitedProblem(st_venant(b.u, 1000.0), b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)])
    with counted() as calls:
        steps = run(problem, 4)
    assert calls[TANGENT] >= sum(step.newton_iterations for step in steps) >= 4


# -- mass, history, output -------------------------------------------------------------------------------------------------


def test_statics_needs_no_mass(comm):
    """No mass is assembled or multiplied in statics; with inertia there is one matrix, and forces in every residual."""
    b = blocks(comm, "quadrilateral")
    problem = uem.UnitedProblem(linear(b.u, 1000.0), b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)])
    with counted() as calls:
        run(problem, 2)
    assert calls.of(MASS) == 0
    b = blocks(comm, "quadrilateral")
    with counted() as calls:
        dynamics = uem.Dynamics(uem.lumped_mass(b.V, 1.0))
        problem = uem.UnitedProblem(
            linear(b.u, 1000.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[uem.Contact(b.high, b.low)], dynamics=dynamics
        )
        assert len(list(uem.time_steps(problem, 0.01, 0.02))) == 2
    assert calls["assemble mass"] == calls["redistribute mass"] == calls["first acceleration"] == 1
    assert calls["inertia forces"] >= 2


def test_elastic_bodies_have_no_history(comm):
    """No return mapping and no commit of history in elastic bodies; a plastic law has both."""
    b = blocks(comm, "quadrilateral")
    problem = uem.UnitedProblem(st_venant(b.u, 1000.0), b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)])
    with counted() as calls:
        run(problem, 2)
    assert calls.of(HISTORY) == 0
    b = blocks(comm, "quadrilateral")
    steel = uem.VonMises(b.u, E=1000.0, nu=0.3, yield_stress=5.0, kind="plane_strain")
    F = steel.residual(ufl.TestFunction(b.V))
    problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)], materials=[steel])
    with counted() as calls:
        run(problem, 2)
    assert calls["commit history"] == 2 < calls["return mapping"]


def test_output_only_where_wanted(comm, folder):
    """Nothing is written unless a writer is made."""
    b = blocks(comm, "quadrilateral")
    problem = uem.UnitedProblem(linear(b.u, 1000.0), b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)])
    with counted() as calls:
        run(problem, 2)
    assert calls.of(OUTPUT) == 0
    with counted() as calls, uem.ResultsWriter(folder / "blocks", problem) as writer:
        writer.write(1.0)
    uem.write_checkpoint(folder / "state", problem.state())
    assert calls["write fields"] == calls["write table"] == 1


# -- the same mesh again, and the same place -----------------------------------------------------------------------------------


def calls_of(monkeypatch, where, name):
    """Arguments of all calls of a function from now on."""
    made, original = [], getattr(where, name)
    monkeypatch.setattr(where, name, lambda *args, **how: made.append(args) or original(*args, **how))
    return made


@pytest.mark.long
def test_a_second_problem_on_a_mesh(comm, monkeypatch):
    """Forms alike are neither expanded nor checked again, and which cells are connected is known, in spaces of any degree."""
    b = blocks(comm, "triangle")
    expanded = calls_of(monkeypatch, forms, "expanded")
    checked = calls_of(monkeypatch, form_checks, "check_form_arity")
    connected = calls_of(monkeypatch, bodies, "connected")
    for k, degree in enumerate((1, 1, 2)):
        V = compat.function_space(b.scene.mesh, degree, (2,))
        u, E = fem.Function(V), fem.Constant(b.scene.mesh, 1000.0)
        traction = ufl.inner(ufl.as_vector((0.0, 1.0)), ufl.TestFunction(V)) * uem.ds(b.top)
        bcs, contact = clamp(V, b.bottom), uem.Contact(b.high, b.low)
        problem = uem.UnitedProblem(linear(u, E) + traction, u, bcs=[*bcs, *clamp(V, b.top, 0)], contacts=[contact])
        if k != 1:
            assert expanded and checked
        else:
            assert not (expanded or checked)
        assert len(connected) == (k == 0)
        label, count = bodies.find_bodies(problem.config)
        assert count == 2 and len(label) == problem.config.n_local
        run(problem)
        assert contact.resultant().force[1] == pytest.approx(1.0, rel=1e-8)
        # the tangent knows of which Constants it is made
        E.value *= 2.0
        sunk = lowest(comm, problem.config.displacement[:, 1])
        problem.solve()
        assert lowest(comm, problem.config.displacement[:, 1]) == pytest.approx(0.5 * sunk, rel=1e-3)
        for made in (expanded, checked, connected):
            made.clear()


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_facets_are_placed_once_where_they_are(comm, cell, monkeypatch):
    """Normals of a target that has not moved since are those that it had, whichever function uses them; after a motion they are others."""
    b = blocks(comm, cell)
    problem = uem.UnitedProblem(linear(b.u, 1000.0), b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)])
    target, points = problem.contacts[0].pair.target, problem.contacts[0].pair.points
    first, made = target.facets.current(corners=True), calls_of(monkeypatch, TargetFacets, "_summed")
    for _ in range(3):
        target.project_on(points, target.project(points).facet)
    assert not made and target.facets.current() is first
    b.u.x.array.reshape(-1, b.gdim)[:] = 0.3 * problem.config.X[:, ::-1] ** 2
    now = target.facets.current(corners=True)
    assert len(made) == 2
    anew = TargetFacets(problem.config, b.low).current(corners=True)
    for name in ("x", "nodal_normals", "corner_normals"):
        assert np.array_equal(getattr(now, name), getattr(anew, name))
    # on several ranks one whose facets stay takes part in what the others do
    made.clear()
    if comm.rank == 0:
        b.u.x.array[:] = 0.0
    target.facets.current()
    assert len(made) == 1


def test_surface_that_no_corner_comes_near(comm, monkeypatch):
    """Facets of contactors are not oriented for corners of the target that are next to a contactor, or far away."""
    made = calls_of(monkeypatch, TargetFacets, "__init__")
    for overhang in (0.0, 0.5):
        b = blocks(comm, "quadrilateral", overhang=overhang)
        problem = uem.UnitedProblem(linear(b.u, 1000.0), b.u, bcs=b.oedometer(0.05), contacts=[uem.Contact(b.high, b.low)])
        run(problem)
    # the outside of confined bodies is oriented for another warning
    assert [tag.name for _, _, tag, *_ in made if tag.name in ("low", "high")] == ["low", "low"]


# -- imports ---------------------------------------------------------------------------------------------------------------

#: What only some scenes need.
HEAVY = ("gmsh", "matplotlib", "pyvista", "scipy", "tqdm", "vtk")


def python(script: str, *options: str, **more: str) -> str:
    """Output of a script in a process of its own."""
    command = [sys.executable, *options, "-c", script]
    done = subprocess.run(command, env=environment(**more), capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    return done.stdout


@serial
@pytest.mark.slow
def test_imports_nothing_heavy():
    """``import uem_dolfinx`` brings in nothing that only some scenes need and DOLFINx alone does not bring in."""
    script = "import mpi4py.MPI, {}; import json, sys; print(json.dumps(sorted(sys.modules)))"
    alone, ours = (json.loads(python(script.format(name))) for name in ("dolfinx", "uem_dolfinx"))
    assert "uem_dolfinx.solve.problem" in ours
    extra = {name.partition(".")[0] for name in set(ours) - set(alone)}
    assert not extra & set(HEAVY)


#: A scene on DOLFINx's own mesh where modules are missing; the last line is what it needed of them.
SCENE = """
import sys

class Missing:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {missing}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Missing())
from mpi4py import MPI
import numpy as np, ufl
from dolfinx import fem, mesh
import uem_dolfinx as uem
from uem_dolfinx import compat

domain = mesh.create_unit_square(MPI.COMM_WORLD, 4, 4)
V = compat.function_space(domain, 1, (2,))
u, v = fem.Function(V), ufl.TestFunction(V)
facets = [mesh.locate_entities_boundary(domain, 1, lambda x, y=y: np.isclose(x[1], y)) for y in (0.0, 1.0)]
bottom, top = (uem.Tag(n, i, 1, domain, f) for i, (n, f) in enumerate(zip(("bottom", "top"), facets), 1))
down = fem.Function(V)
down.x.array[1::2] = -0.05
bcs = [fem.dirichletbc(down, fem.locate_dofs_topological(V, 1, top.entities))]
contact = uem.Contact(bottom, uem.RigidPlane([0.0, 0.0], [0.0, 1.0]))
F = uem.LinearElastic(1000.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
list(uem.load_steps(problem, 2))
assert contact.n_active == 5 and contact.resultant().force[1] > 0
{then}
"""
#: What needs them.
READS = """
try:
    uem.read_gmsh("none.msh", MPI.COMM_WORLD)
except uem.UEMError as error:
    print(type(error).__name__, error)
"""
DRAWS = """
try:
    uem.plot_scene(problem, "none.png")
except uem.UEMError as error:
    print(type(error).__name__, error)
"""


@serial
@pytest.mark.slow
def test_scene_without_gmsh_matplotlib_pyvista():
    """A scene that needs none of them runs where all are missing; what does need one says which."""
    optional = ["gmsh", "matplotlib", "pyvista", "vtk", "tqdm"]
    assert python(SCENE.format(missing=optional, then="print('done')")).split() == ["done"]
    reported = python(SCENE.format(missing=optional, then=DRAWS))
    assert reported.startswith("MissingBackendError") and "matplotlib" in reported


@pytest.mark.long
@serial
def test_what_is_missing_is_missing():
    """The test above does take modules away."""
    with pytest.raises(AssertionError, match="No module named"):
        python(SCENE.format(missing=["scipy"], then="import scipy"))


# -- what the import takes -------------------------------------------------------------------------------------------------

#: Bound on the calls of functions in ``import uem_dolfinx`` over those in ``import dolfinx``.
IMPORT_RATIO = 1.1
#: Calls of functions, Python's and C's, that an import makes: as many on every run, however busy the machine is.
COUNTED = """
import mpi4py.MPI, sys
calls = 0

def count(frame, event, arg):
    global calls
    calls += event in ("call", "c_call")

sys.setprofile(count)
import {}
sys.setprofile(None)
print(calls)
"""


@serial
@pytest.mark.slow
def test_import_takes_little_more_than_that_of_dolfinx(folder):
    """``import uem_dolfinx`` makes at most 1.1 times the calls of ``import dolfinx``, both compiled before."""
    cache = {"PYTHONPYCACHEPREFIX": str(folder), "PYTHONDONTWRITEBYTECODE": ""}
    alone, ours = ([int(python(COUNTED.format(name), **cache)) for _ in range(2)][1] for name in ("dolfinx", "uem_dolfinx"))
    assert alone < ours <= IMPORT_RATIO * alone
