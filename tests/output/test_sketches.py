"""Sketches of what problems declare: what is gathered for them is known in numbers, on any number of ranks, and is what is drawn.

Worth reading first: ``test_two_blocks`` and ``test_loads_of_a_bar``.
"""

from __future__ import annotations

import ast
import inspect
import re
import subprocess
import sys
from pathlib import Path

from mpi4py import MPI

import common
import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import MESHES, at, blocks, box, clamp, environment, linear, refused, scene, serial, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.output.declared import Declarations
from uem_dolfinx.output.sketches import PAIRS, Look, Sketch, thinned

pytest.importorskip("matplotlib")
COMM, DEMOS = MPI.COMM_WORLD, Path(common.__file__).parent


def declared(problem, at=1.0):
    """What is declared, on rank 0 (collective)."""
    found = Declarations(problem, at, True).found
    assert (found is None) == (COMM.rank > 0)
    return found


def acting(found, kind):
    return [one for one in found.acting if one.kind == kind]


def measure(corners):
    """Lengths, or areas of plane polygons ``(m,)``."""
    if corners.shape[1] == 2:
        return np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    a = np.concatenate([corners, np.zeros((*corners.shape[:2], 3 - corners.shape[2]))], axis=2)
    return 0.5 * np.linalg.norm(sum(np.cross(a[:, i] - a[:, 0], a[:, i + 1] - a[:, 0]) for i in range(1, a.shape[1] - 1)), axis=1)


def bar(degree=1):
    """A bar of 2 by 1 in 4 by 2 squares with its ends."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [2.0, 1.0], [4, 2])])
    V = compat.function_space(s.mesh, degree, (2,))
    return s, V, fem.Function(V, name="u"), s.tag("left", 0, at(0, 0.0)), s.tag("right", 0, at(0, 2.0))


@pytest.mark.parametrize(("cell", "degree"), [("triangle", 2), ("quadrilateral", 1), ("hexahedron", 1), ("tetrahedron", 1)])
def test_two_blocks(cell, degree):
    """One pressed upon the other: each body once, both sides of the contact with their facets, and which components are held where."""
    b = blocks(COMM, cell, 2, 4, degree=degree)
    g = b.gdim
    contact = uem.Contact(b.high, b.low)
    found = declared(uem.UnitedProblem(st_venant(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[contact]))
    if found is None:
        return
    size = measure(found.cells)
    height = found.cells[:, :, -1].mean(axis=1)
    assert [size[found.body == k].sum() for k in (0, 1)] == pytest.approx([1.0 if g == 2 else 6.0] * 2)
    apart = np.abs(height) > 0.01
    np.testing.assert_array_equal(found.body[apart], height[apart] > 0)
    assert measure(found.outside).sum() == pytest.approx(8.0 if g == 2 else 12.0)
    high, low = found.surfaces
    parts = 2 if cell == "tetrahedron" else 1
    assert [(s.name, s.side, s.pair, len(s.corners)) for s in found.surfaces] == [
        ("high: contactor", "contactor", 0, parts * 4 ** (g - 1)), ("low: target", "target", 0, parts * 2 ** (g - 1)),
    ]  # fmt: skip
    for surface, out in ((high, -1.0), (low, 1.0)):
        assert measure(surface.corners).sum() == pytest.approx(1.0) and np.abs(surface.corners[:, :, -1]).max() < 1e-14
        np.testing.assert_allclose(surface.normals, np.tile(out * np.eye(g)[-1], (len(surface.normals), 1)), atol=1e-14)
    # pressed at the top alone, downwards by what the condition says; sideways held where the sides are, upwards at the bottom
    (pressed,) = acting(found, "prescribed")
    assert len(pressed.at) == 5 ** (g - 1) and np.allclose(pressed.at[:, -1], 1.0) and (pressed.outward[:, -1] > 0.4).all()
    np.testing.assert_allclose(pressed.vectors, np.tile(-0.1 * np.eye(g)[-1], (len(pressed.at), 1)))
    held = acting(found, "held")
    places, ones = (np.concatenate([getattr(one, name) for one in held]) for name in ("at", "vectors"))
    assert (ones.sum(axis=1) == 1).all() and not len(found.clamped[0])
    component = ones.argmax(axis=1)
    np.testing.assert_allclose(places[component == g - 1, -1], -1.0)
    assert (component == g - 1).sum() == 3 ** (g - 1)
    for c in range(g - 1):
        where = places[component == c, c]
        assert set(np.abs(where.round(14))) == {0.0, 1.0} and len(where) == 2 * (3 ** (g - 1) + 5 ** (g - 1))


@pytest.mark.parametrize("degree", [1, 2])
def test_loads_of_a_bar(degree):
    """The end that is clamped, traction and weight of the residual at the full load, and everything as it was after that."""
    s, V, u, left, right = bar(degree)
    v, traction, weight = ufl.TestFunction(V), fem.Constant(s.mesh, (0.0, 0.0)), fem.Constant(s.mesh, (0.0, -3.0))
    F = (
        st_venant(u, 1.0)
        - ufl.dot(traction, v) * uem.ds(right)
        - ufl.dot(weight, v) * ufl.dx
        + 5.0 * ufl.dot(u, v) * uem.ds(left)
    )
    problem = uem.UnitedProblem(F, u, bcs=clamp(V, left), load={traction: (0.3, -0.4)})
    u.x.array[:] = 0.01 * np.random.default_rng(COMM.rank).random(len(u.x.array))
    before = np.array(u.x.array)
    found = declared(problem)
    np.testing.assert_array_equal(u.x.array, before)
    assert not np.any(traction.value)
    quiet = declared(problem, None)
    if found is None:
        return
    corners, normals = found.clamped
    assert measure(corners).sum() == pytest.approx(1.0) and np.abs(corners[:, :, 0]).max() < 1e-14
    np.testing.assert_allclose(normals, np.tile([-1.0, 0.0], (2, 1)), atol=1e-14)
    # held there, and nowhere else
    assert not acting(found, "held")
    (load,), (body,) = acting(found, "load"), acting(found, "body load")
    assert load.name == "load on a surface" and len(load.at) == 1 + 2 * degree
    np.testing.assert_allclose(load.at[:, 0], 2.0)
    np.testing.assert_allclose(load.vectors, np.tile([0.6, -0.8], (len(load.at), 1)), atol=1e-12)
    assert (load.outward[:, 0] > 0.5).all()
    assert body.at.shape == (1, 2) and body.at[0] == pytest.approx([1.0, 0.5])
    np.testing.assert_allclose(body.vectors, [[0.0, -6.0]], atol=1e-12)
    assert not acting(quiet, "load") and len(acting(quiet, "body load")) == 1


def test_rigid_surfaces_that_move():
    """Where they are drawn and where the full load takes them; Dirichlet values that a load sets are those of it."""
    s, V, u, left, right = bar()
    ball, place = uem.RigidSphere((1.0, 2.0), 1.0), fem.Constant(s.mesh, 0.25)

    def load(factor):
        ball.move((0.0, -0.2 * factor))
        place.value = 0.1 * factor

    bcs = [*clamp(V, left), uem.dirichlet(V, right, 0, place)]
    contact = uem.Contact(s.tag("top", 0, at(1, 1.0)), ball, name="press")
    problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact], load=load)
    found = declared(problem)
    assert ball.motion is None and place.value == 0.0
    if found is None:
        return
    (rigid,), (pulled,) = found.rigid, acting(found, "prescribed")
    assert rigid.name == "rigid sphere: target" and rigid.pair == 0 and rigid.at == pytest.approx([1.0, 1.0])
    np.testing.assert_allclose(rigid.way, [0.0, -0.2])
    assert rigid.shape.height(np.array([[1.0, 0.5]]))[0] == pytest.approx(0.5)
    np.testing.assert_allclose(pulled.vectors, np.tile([0.1, 0.0], (3, 1)))


def test_what_acts_at_points():
    """Forces, springs, equations, periodic surfaces and rigid parts, each where it was declared."""
    s, V, u, left, right = bar()
    bottom, top = s.tag("bottom", 0, at(1, 0.0)), s.tag("top", 0, at(1, 1.0))
    points = [uem.PointLoad((2.0, 1.0), (0.0, -3.0)), uem.PointSpring((0.0, 0.0), (0.0, 4.0))]
    equations = [uem.periodic(top, bottom), uem.Equation([((0.0, 0.5), (1.0, 0.0)), ((1.0, 0.5), (-1.0, 0.0))])]
    wheel = uem.RigidCoupling(right, (2.5, 0.5), force=(0.0, 2.0), motion=(0.0, None, 0.3))
    problem = uem.UnitedProblem(linear(u, 1.0), u, points=points, equations=equations[1:], couplings=[wheel])
    found = declared(problem)
    w = fem.Function(V)
    around = declared(uem.UnitedProblem(linear(w, 1.0), w, bcs=clamp(V, left), equations=equations[:1]))
    if found is None:
        return
    by_name = {one.name: one for one in found.acting}
    assert sorted(by_name) == sorted(
        ["point load", "spring", "linear equation", "right: rigid", "force", "held", "prescribed rotation"]
    )
    np.testing.assert_allclose(by_name["point load"].at, [[2.0, 1.0]])
    np.testing.assert_allclose(by_name["point load"].vectors, [[0.0, -3.0]])
    np.testing.assert_allclose(by_name["spring"].vectors, [[0.0, 4.0]])
    arms = by_name["right: rigid"]
    np.testing.assert_allclose(arms.at + arms.vectors, np.tile([2.5, 0.5], (3, 1)))
    np.testing.assert_allclose(by_name["force"].vectors, [[0.0, 2.0]])
    np.testing.assert_allclose(by_name["held"].vectors, [[1.0, 0.0]])
    np.testing.assert_allclose(by_name["prescribed rotation"].vectors, [[0.3]])
    assert [(one.name, len(one.corners)) for one in around.surfaces] == [("top: follows", 4), ("bottom: is followed", 4)]
    assert [len(one.at) for one in found.acting if one.kind == "equation"] == [1, 1]


def test_velocities():
    """A body that flies as a whole has one arrow, one that turns has many."""
    b = blocks(COMM, "quadrilateral", gap=0.5)
    velocity = fem.Function(b.V)
    velocity.interpolate(
        lambda x: np.where(x[1] > 0.25, np.stack([0.0 * x[0], 0.0 * x[0] - 2.0]), np.stack([-x[1] - 0.5, x[0] - 0.5]))
    )
    dynamics = uem.Dynamics(uem.lumped_mass(b.V, 1.0), velocity=velocity, gravity=(0.0, -9.81))
    problem = uem.UnitedProblem(
        linear(b.u, 1.0), b.u, contacts=[uem.GeneralContact(rigid=uem.RigidPlane((0, -2), (0, 1)))], dynamics=dynamics
    )
    found = declared(problem, None)
    if found is None:
        return
    one, many = acting(found, "velocity")
    np.testing.assert_allclose(one.at, [[0.5, 1.0]])
    np.testing.assert_allclose(one.vectors, [[0.0, -2.0]])
    # all but the middle of nine nodes
    assert len(many.at) == 8 and np.allclose(many.vectors, np.stack([-many.at[:, 1] - 0.5, many.at[:, 0] - 0.5], axis=1))
    (weight,) = acting(found, "body load")
    assert weight.name == "gravity" and len(weight.at) == 2
    (surface,), (rigid,) = found.surfaces, found.rigid
    assert surface.name == "general contact: all surfaces" and measure(surface.corners).sum() == pytest.approx(8.0)
    assert rigid.pair == surface.pair == 0 and not np.any(rigid.way)


def test_temperatures_and_ties():
    """A scalar field has no arrows: its prescribed values are places, and its ties are drawn as those of displacements."""
    domain, tags = uem.read_gmsh(MESHES / "blocks.geo", COMM, gdim=2, parameters={"dim": 2, "n_1": 2, "n_2": 3})
    V = uem.function_space(domain, 1)
    T, v = fem.Function(V), ufl.TestFunction(V)
    tie = uem.Contact(tags["bottom_2"], tags["top_1"], tied=True)
    problem = uem.UnitedProblem(
        ufl.inner(ufl.grad(T), ufl.grad(v)) * ufl.dx, T, bcs=[uem.dirichlet(V, tags["bottom_1"], value=2.0)], contacts=[tie]
    )
    found = declared(problem)
    if found is None:
        return
    (value,) = found.acting
    assert value.kind == "value" and value.vectors.tolist() == [[2.0]] * len(value.at)
    assert [one.name.split(": ")[1] for one in found.surfaces] == ["tied", "tied to"]


def test_bodies_of_revolution():
    """The axis is named, and forces on a body are those on all of it."""
    s, V, u, left, right = bar()
    uem.axisymmetric(s.mesh)
    v = ufl.TestFunction(V)
    F = uem.LinearElastic(1.0, 0.3, kind="axisymmetric").residual(u, v) * ufl.dx - ufl.dot(ufl.as_vector((2.0, -3.0)), v) * ufl.dx
    found = declared(uem.UnitedProblem(F, u, bcs=clamp(V, left, 0)))
    if found is not None:
        (body,) = acting(found, "body load")
        assert found.axis and np.allclose(body.vectors, [[0.0, -3.0 * 4.0 * np.pi]])


def test_sections_that_carry_a_force():
    """Both parts of a bolt are drawn to each other."""
    b = blocks(COMM, "quadrilateral")
    bolt = uem.Preload(b.high, b.low, force=0.02)
    found = declared(uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.0), contacts=[bolt]))
    if found is not None:
        assert [one.name for one in found.surfaces] == ["high: preloaded", "low: preloaded"]
        down, up = acting(found, "load")
        np.testing.assert_allclose(down.at, [[0.5, 0.0]], atol=1e-14)
        np.testing.assert_allclose([down.vectors[0], up.vectors[0]], [[0.0, -1.0], [0.0, 1.0]], atol=1e-14)


def test_other_fields():
    """Where a pressure is prescribed, and what of the displacement."""
    s, _, _, left, right = bar()
    W = uem.function_space(s.mesh, [("Lagrange", 1, (2,)), 1])
    w, (v, q) = fem.Function(W), ufl.TestFunctions(W)
    u, p = ufl.split(w)
    F = (ufl.inner(ufl.sym(ufl.grad(u)), ufl.sym(ufl.grad(v))) + ufl.inner(ufl.grad(p), ufl.grad(q))) * ufl.dx
    bcs = [uem.dirichlet(W.sub(0), left, c) for c in range(2)] + [uem.dirichlet(W.sub(1), right, value=3.0)]
    found = declared(uem.UnitedProblem(F, w, displacement=0, bcs=bcs))
    if found is not None:
        (value,) = found.acting
        assert value.name == "prescribed value of field 1" and len(value.at) == 3 and np.allclose(value.at[:, 0], 2.0)
        assert measure(found.clamped[0]).sum() == pytest.approx(1.0)


def test_names_of_many_contacts():
    """Those of contacts tell surfaces apart that several of them have, and beyond so many there is one pair of colours."""
    for count in (2, 7):
        b = blocks(COMM, "quadrilateral", gap=0.2)
        floors = [uem.RigidPlane((0.0, -2.0 - k), (0.0, 1.0)) for k in range(count)]
        contacts = [uem.Contact(b.low, floor, name=f"floor {k}", max_penetration=9.0) for k, floor in enumerate(floors)]
        found = declared(uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=contacts))
        if found is None:
            continue
        assert [one.name for one in found.surfaces] == [f"low: contactor (floor {k})" for k in range(count)]
        assert [one.layer for one in found.surfaces] == list(range(count))
        assert found.rigid[1].name == "rigid plane: target (floor 1)"
        sketch = Sketch(found, Look([], False, None, np.ones(3), True, True, 1600))
        assert {sketch.name_surface(one) for one in found.surfaces} == {PAIRS[k][0] for k in range(2 if count == 2 else 1)}
        assert len({name for kind, name in sketch.names if kind == "surface"}) == (2 if count == 2 else 1)


def test_rounding_is_not_prescribed():
    """Components that a Function prescribes as rounding are held, those that are a little larger are moved."""
    for size, held in ((3e-10, 1), (3e-9, 0)):
        s, V, u, left, right = bar()
        value = fem.Function(V)
        value.interpolate(lambda x, size=size: np.stack([0.0 * x[0] + 2.0, 0.0 * x[0] + 2.0 * size]))
        found = declared(uem.UnitedProblem(linear(u, 1.0), u, bcs=[*clamp(V, left), uem.dirichlet(V, right, None, value)]))
        if found is not None:
            assert len(acting(found, "held")) == held and len(acting(found, "prescribed")) == 1


def test_thinned():
    """No two are nearer than the spacing, all others are near one, whatever their order."""
    points = np.random.default_rng(1).random((300, 2))
    some = thinned(points, 0.1)
    order = np.random.default_rng(2).permutation(300)
    again = thinned(points[order], 0.1)
    distance = np.linalg.norm(points[:, None] - points[some][None], axis=2)
    assert (distance[some] + np.eye(len(some)) > 0.1).all() and distance.min(axis=1).max() <= 0.1
    assert {tuple(p) for p in points[some]} == {tuple(p) for p in points[order][again]}


def test_drawn_in_the_plane(folder):
    """Colours, symbols and names are those of what is declared; what presses ends at the surface."""
    b = blocks(COMM, "quadrilateral", gap=0.2)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(st_venant(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[contact])
    found = declared(problem)
    with uem.figure(folder / "setup.png", COMM) as (panel,):
        uem.plot_setup(problem, panel, arrows=[((0.5, 0.0), (1.0, 0.0), "drag")])
        if panel is not None and found is not None:
            names = [text.get_text() for text in panel.get_legend().get_texts()]
            assert names == ["high: contactor", "low: target", "held component", "prescribed displacement", "drag"]
            look = Look([], False, None, np.ones(3), True, True, 1600)
            ((_, tails, ways),) = Sketch(found, look).arrows
            np.testing.assert_allclose((tails + ways)[:, 1], 1.2)
            assert (ways[:, 1] < 0).all() and 2 <= len(ways) <= 5
            lines = {tuple(np.round(c.get_colors()[0][:3], 2)) for c in panel.collections if hasattr(c, "get_segments")}
            for colour in PAIRS[0]:
                assert tuple(np.round([int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)], 2)) in lines
    picture = uem.plot_setup(problem, legend=False)
    assert picture is not None and (picture.png[:4] == b"\x89PNG" or COMM.rank > 0)
    refused(uem.InputError, "view", lambda: uem.plot_setup(problem, folder / "a.png", view="iso"))
    refused(uem.InputError, "window", lambda: uem.plot_setup(problem, folder / "a.png", window=(1, 0, 0, 1)))
    refused(uem.InputTypeError, "arrows", lambda: uem.plot_setup(problem, folder / "a.png", arrows=[(1, 2)]))


@pytest.mark.slow
def test_drawn_in_space(folder):
    """Both contact surfaces are seen through the bodies, in their colours."""
    pytest.importorskip("pyvista")
    b = blocks(COMM, "hexahedron", gap=0.2)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[uem.Contact(b.high, b.low)])
    with uem.figure(folder / "setup.png", COMM) as (panel,):
        uem.plot_setup(problem, panel, view=(1.0, 1.0, 0.1))
        if panel is not None:
            image = np.asarray(panel.get_images()[0].get_array(), dtype=float)
            r, g, blue = image[..., 0], image[..., 1], image[..., 2]
            assert ((r > g + 60) & (r > blue + 60)).mean() > 0.01 and ((blue > r + 40) & (blue > g)).mean() > 0.01


# -- of the demos ----------------------------------------------------------------------------------------------------------


def test_demos_have_sketches():
    """Each of the gallery has one, of few bytes, unless the list says None; all arguments in the list exist."""
    names = re.findall(r"^### \[(\w+)\.py\]", (DEMOS / "README.md").read_text(encoding="utf-8"), re.MULTILINE)
    lines = (DEMOS / "sketches.txt").read_text(encoding="utf-8").splitlines()
    reported = {name: ast.literal_eval(how) for name, how in (line.split(": ", 1) for line in lines if not line.startswith("#"))}
    drawn = {path.stem.removesuffix("_setup"): path for path in (DEMOS / "pictures").glob("*_setup.png")}
    assert reported.keys() <= set(names) and drawn.keys() == set(names) - {name for name, how in reported.items() if how is None}
    assert max(path.stat().st_size for path in drawn.values()) <= 25_000
    known = set(inspect.signature(uem.plot_setup).parameters) | {"problem", "small"}
    assert all(how.keys() <= known for how in reported.values() if how is not None)


@serial
@pytest.mark.slow
def test_a_demo_draws_its_scene_and_ends(folder):
    """Before it solves anything."""
    command = [
        sys.executable,
        str(DEMOS / "two_blocks.py"),
        "--setup",
        str(folder / "scene.png"),
        "--json",
        str(folder / "a.json"),
    ]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=120)
    assert done.returncode == 0 and (folder / "scene.png").stat().st_size > 5000, done.stderr
    assert not (folder / "a.json").exists()
