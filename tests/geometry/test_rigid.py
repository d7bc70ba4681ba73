"""Rigid targets that move: motions against moved bodies, closed forms of force and moment, and load steps that fail.

Two tests to read first: ``test_moving_the_tool_is_moving_the_body`` and ``test_a_failing_step_leaves_the_tool_to_load``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, box, clamp, complementary, highest, linear, modulus, run, scene, st_venant
from hypothesis import given
from hypothesis import strategies as st

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.rigid import Motion, rotation_matrix

COMM = MPI.COMM_WORLD
NU = 0.3
#: Oedometric modulus over Young's modulus.
M = (1 - NU) / ((1 + NU) * (1 - 2 * NU))
CELLS = ("triangle", "hexahedron")


def slab(cell, target, *, n=4, law=linear, rollers=False, held=None, path=None, motion=None, **options):
    """Unit block with its top below a rigid target; ``motion(factor)`` moves the target, ``path(factor)`` the block's base."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    s = scene(COMM, cell, [box(cell, [0.0] * g, [1.0] * g, [n] * g)])
    V = compat.function_space(s.mesh, 1, (g,))
    u, base = fem.Function(V), fem.Function(V)
    bottom = s.tag("bottom", 0, at(g - 1, 0.0))
    bcs = clamp(V, bottom, g - 1) if rollers else []
    for c in range(g - 1) if rollers else ():
        bcs += [bc for end in (0.0, 1.0) for bc in clamp(V, s.tag("side", 0, at(c, end)), c)]
    if not rollers:
        bcs = [fem.dirichletbc(base, fem.locate_dofs_topological(V, g - 1, bottom.entities))]

    def load(factor):
        if path is not None:
            base.x.array.reshape(-1, g)[:] = path(factor)
        if motion is not None:
            target.move(**motion(factor))

    contact = uem.Contact(s.tag("top", 0, at(g - 1, 1.0)), target, **(held or {}))
    problem = uem.UnitedProblem(law(u, modulus(s, 1.0)), u, bcs=bcs, contacts=[contact], load=load, **options)
    return s, contact, problem


# -- the motion itself -------------------------------------------------------------------------------------------------


def surfaces(g):
    """Every ready-made surface, and one of functions."""
    c, up = np.array([0.1, -0.2, 0.3][:g]), np.arange(1.0, g + 1)
    made = {
        "plane": uem.RigidPlane(c, up),
        "sphere": uem.RigidSphere(c, 0.8),
        "hollow sphere": uem.RigidSphere(c, 3.0, inside=True),
        "paraboloid": uem.RigidParaboloid(c, up, 0.7),
        "wave": uem.RigidSurface(
            lambda x: x[:, -1] - 0.1 * np.sin(3 * x[:, 0]),
            lambda x: np.column_stack([-0.3 * np.cos(3 * x[:, 0]), *[0 * x[:, 0]] * (g - 2), np.ones(len(x))]),
        ),
    }
    if g == 3:
        made["cylinder"] = uem.RigidCylinder(c, up, 0.5)
        made["hollow cylinder"] = uem.RigidCylinder(c, up, 2.0, inside=True)
    return made


NAMES = [(g, name) for g in (2, 3) for name in surfaces(g)]
TURN = {2: 0.7, 3: [0.5, -0.3, 0.9]}


def onto(surface, points):
    """Points moved onto a rigid surface."""
    for _ in range(80):
        p = surface.project(points)
        points = points - p.gap[:, None] * p.normal
    return points


@pytest.mark.parametrize("g,name", NAMES)
def test_moved_surface_against_moved_points(g, name):
    """A moved surface sees moved points as the unmoved one sees them at home; moving is from the drawing, not on top."""
    surface, points = surfaces(g)[name], np.random.default_rng(1).uniform(-1, 1, (20, g))
    still = surface.project(points)
    surface.move(np.ones(g), TURN[g]).move(np.arange(g) - 0.4, TURN[g], about=np.ones(g))
    Q, moved = surface.motion.Q, surface.project(surface.motion.carry(points))
    assert np.allclose(Q @ Q.T, np.eye(g), atol=1e-15) and np.linalg.det(Q) == pytest.approx(1.0)
    assert np.allclose(surface.motion.back(surface.motion.carry(points)), points, atol=1e-14)
    assert np.allclose(moved.gap, still.gap, atol=1e-13) and np.allclose(moved.normal, still.normal @ Q.T, atol=1e-13)
    which = np.arange(20)
    assert np.allclose(moved.hessians(which), Q @ still.hessians(which) @ Q.T, atol=1e-8)


def waves(g, hessian, name):
    """One surface by functions of places ``(3, n)`` in several ways to write them, or of points ``(n, gdim)``."""
    up, along = np.eye(g)[-1], np.eye(g)[0]

    def height(x):
        return x[g - 1] - 0.1 * np.sin(3 * x[0])

    def slope(x):
        return np.stack([-0.3 * np.cos(3 * x[0]), *[0 * x[0]] * (g - 2), np.ones(x.shape[1])])

    def bend(x):
        return np.einsum("i,j,n->ijn", along, along, 0.9 * np.sin(3 * x[0]))

    def padded(f):
        return lambda x: np.pad(v := f(x), [(0, 3 - g)] * (v.ndim - 1) + [(0, 0)])

    kinds = {
        "places": (height, slope, bend),
        "three components": (height, padded(slope), padded(bend)),
        "rows of places": (height, lambda x: slope(x).T, lambda x: np.moveaxis(bend(x), -1, 0)),
        "points": (lambda x: height(x.T), lambda x: slope(x.T).T, lambda x: np.moveaxis(bend(x.T), -1, 0)),
        "elementwise": (
            lambda x: (x @ up) - 0.1 * np.sin(3 * x @ along),
            lambda x: slope(x.T).T,
            lambda x: np.moveaxis(bend(x.T), -1, 0),
        ),
    }
    return uem.RigidSurface(*kinds[name][: 3 if hessian else 2])


@pytest.mark.parametrize("name", ["places", "three components", "rows of places", "points", "elementwise"])
@pytest.mark.parametrize("hessian", [True, False])
def test_functions_of_places(name, hessian):
    """As friction's they get x of shape ``(3, n)``, however many places there are; they are distinguished from points ``(n, gdim)``."""
    for g in (2, 3):
        for n in (4, 3, 2, 1, 7):
            points = np.random.default_rng(n).uniform(-1, 1, (n, g))
            one, other = (waves(g, hessian, kind).move(np.ones(g), TURN[g]) for kind in (name, "points"))
            assert np.array_equal(one.distance_of(points), other.distance_of(points))
            found, known = one.project(points), other.project(points)
            assert np.array_equal(found.gap, known.gap) and np.array_equal(found.normal, known.normal)
            assert np.allclose(found.shape_operator, known.shape_operator, atol=1e-14)
            assert one.project(points[:0]).gap.shape == (0,)


def test_functions_of_places_in_a_problem():
    """The same block under a floor of places and one of points, at every size."""
    for size in (1.0, 1e-9, 1e3):
        ends = []
        for of_places in (True, False):
            distance = (lambda x: 1.05 * size - x[1]) if of_places else (lambda x: 1.05 * size - x[:, 1])
            down = (
                (lambda x: np.tile([[0.0], [-1.0]], x.shape[1])) if of_places else (lambda x: np.tile([0.0, -1.0], (len(x), 1)))
            )
            s = scene(COMM, "triangle", [box("triangle", [0.0, 0.0], [size, size], [3, 3])])
            V = compat.function_space(s.mesh, 1, (2,))
            u = fem.Function(V)
            bcs = clamp(V, s.tag("bottom", 0, at(1, 0.0)), value=(0.0, 0.1 * size))
            contact = uem.Contact(s.tag("top", 0, at(1, size)), uem.RigidSurface(distance, down))
            problem = uem.UnitedProblem(linear(u, modulus(s, 1.0)), u, bcs=bcs, contacts=[contact])
            run(problem)
            ends.append(contact.resultant().force[1] / size)
        assert ends[0] == ends[1] != 0.0


@pytest.mark.parametrize("g,name", NAMES)
def test_hessian_of_a_moved_surface(g, name):
    """Normal and curvature of a moved surface are the first and second differences of its gap."""
    surface, h = surfaces(g)[name].move(np.arange(g) - 0.4, TURN[g], about=np.ones(g)), 1e-5
    points = onto(surface, np.random.default_rng(2).uniform(-1, 1, (20, g)))
    p = surface.project(points)
    assert np.abs(p.gap).max() < 1e-13
    H, tangent = p.hessians(np.arange(20)), np.eye(g) - p.normal[:, :, None] * p.normal[:, None, :]
    for e in np.eye(g):
        slope = (surface.project(points + h * e).gap - surface.project(points - h * e).gap) / (2 * h)
        assert np.abs(slope - p.normal @ e).max() < 1e-8
        step = tangent @ e * h
        bend = (surface.project(points + step).normal - surface.project(points - step).normal) / (2 * h)
        assert np.abs(bend - H @ e).max() < 1e-7


@pytest.mark.parametrize("g,name", NAMES)
def test_following_planes_move_with_the_surface(g, name):
    """Small sliding: points that ride along keep their gap, and others leave it along the turned normal."""
    surface, points = surfaces(g)[name], np.random.default_rng(3).uniform(-1, 1, (10, g))
    old = surface.project(points)
    surface.move(np.arange(g) - 0.4, TURN[g])
    x = surface.motion.carry(points)
    assert np.allclose(surface.follow(x, old).gap, old.gap, atol=1e-13)
    assert np.allclose(surface.follow(x, old).normal, old.normal @ surface.motion.Q.T, atol=1e-14)
    away = surface.follow(x + 0.1 * surface.follow(x, old).normal, old)
    assert np.allclose(away.gap, old.gap + 0.1, atol=1e-13)


@pytest.mark.parametrize(
    "what,motion",
    [
        ("translation", {"translation": (0.0, np.nan)}),
        ("rotation", {"translation": (0.0, 0.0), "rotation": np.inf}),
        ("about", {"translation": (0.0, 0.0), "about": (np.nan, 0.0)}),
        ("translation", {"translation": (0.0, 0.0, 1.0)}),
        ("rotation", {"translation": (0.0, 0.0), "rotation": (0.0, 0.0, 1.0)}),
        ("about", {"translation": (0.0, 0.0), "about": 1.0}),
    ],
)
def test_motion_that_is_none(what, motion):
    with pytest.raises(ValueError, match=f"rigid plane: {what} .*(finite|expected)"):
        uem.RigidPlane((0.0, 0.0), (0.0, 1.0)).move(**motion)


def test_reference_and_about_must_be_finite():
    with pytest.raises(ValueError, match=r"rigid sphere: center .* is not finite"):
        uem.RigidSphere((0.0, np.inf), 1.0)
    _, contact, _ = slab("triangle", uem.RigidPlane((0.0, 1.0), (0.0, -1.0)))
    with pytest.raises(ValueError, match="about .* is not finite"):
        contact.resultant(about=(0.0, np.nan))
    with pytest.raises(ValueError, match="on = 'tool': expected one of 'contactor' or 'target'"):
        contact.resultant(on="tool")


def test_surface_moved_in_another_dimension():
    surface = surfaces(3)["wave"].move((0.0, 0.0, 1.0))
    with pytest.raises(ValueError, match="was moved in 3D but is met by points in 2D"):
        surface.project(np.zeros((1, 2)))


# -- bodies under moving tools -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("sliding", ["finite", "small"])
@pytest.mark.parametrize("cell", CELLS)
def test_moving_the_tool_is_moving_the_body(cell, sliding):
    """A tool moved by t presses the body that stays as the tool that stays presses the body moved by -t."""
    g = 2 if cell == "triangle" else 3
    t = np.array([0.15, *[0.05] * (g - 2), -0.08])
    forces = []
    for tool_moves in (True, False):
        ball = uem.RigidSphere([*[0.45] * (g - 1), 2.0], 1.0)
        how = {"motion": lambda f: {"translation": f * t}} if tool_moves else {"path": lambda f: -f * t}
        _, contact, problem = slab(cell, ball, law=st_venant, held={"sliding": sliding}, rtol=1e-11, **how)
        history = []
        for step in uem.load_steps(problem, 3):
            tool, body = contact.resultant(on="target"), contact.resultant()
            assert np.allclose(tool.force, -body.force, atol=1e-15)
            # about the ball's middle, where it is now, the normal forces of finite sliding have no moment
            assert sliding == "small" or np.abs(tool.moment).max() < 1e-13
            history.append(tool.force)
        forces.append(history)
    a, b = np.array(forces)
    assert a[-1, g - 1] > 0.01 and np.abs(a - b).max() < 1e-9 * a[-1, g - 1]


@pytest.mark.parametrize("sliding", ["finite", "small", "fixed"])
@pytest.mark.parametrize("cell", CELLS)
def test_oedometer_under_a_moving_plane(cell, sliding):
    """F = M E d on a unit area, in every step, down and up again; its moment is that of a force in the middle."""
    g = 2 if cell == "triangle" else 3
    start, e = [*[0.0] * (g - 1), 1.0], np.eye(g)[-1]
    plane = uem.RigidPlane(start, -e)

    def depth(factor):
        return 0.1 * np.sin(np.pi * factor)

    _, contact, problem = slab(
        cell, plane, rollers=True, held={"sliding": sliding}, motion=lambda f: {"translation": -depth(f) * e}
    )
    for step in uem.load_steps(problem, 4):
        d, tool = depth(step.factor), contact.resultant(on="target")
        assert tool.force == pytest.approx(M * d * e, abs=1e-12)
        # the plane's point, a corner of the block, has come down with it
        moment = [0.5 * M * d] if g == 2 else [0.5 * M * d, -0.5 * M * d, 0.0]
        assert tool.moment == pytest.approx(moment, abs=1e-12)
        middle = [*[0.5] * (g - 1), 3.0]
        assert np.abs(contact.resultant(about=middle, on="target").moment).max() < 1e-12
        body = contact.resultant()
        assert body.force == pytest.approx(-tool.force, abs=1e-15) and body.moment == pytest.approx(-tool.moment, abs=1e-12)
        assert np.abs(contact.resultant(about=start).moment - body.moment).max() < 1e-12 + abs(body.force[0])


@pytest.mark.parametrize("cell", CELLS)
def test_turned_plane_is_a_plane(cell):
    """A plane turned about a point presses as one drawn so, with the same force and the same moment about the same point."""
    g = 2 if cell == "triangle" else 3
    pivot, angle, d = np.array([*[0.5] * (g - 1), 1.0]), 0.1, 0.06
    e, turn = np.eye(g)[-1], angle if g == 2 else [0.0, -angle, 0.0]
    drop = -d * e
    turned = uem.RigidPlane([*[0.0] * (g - 1), 1.0], -e)
    drawn = uem.RigidPlane(pivot + drop, [-np.sin(-angle), *[0.0] * (g - 2), -np.cos(angle)])
    found = []
    for plane, motion in ((turned, lambda f: {"translation": drop, "rotation": turn, "about": pivot}), (drawn, None)):
        _, contact, problem = slab(cell, plane, law=st_venant, held={"max_penetration": 0.2}, motion=motion, rtol=1e-11)
        run(problem)
        complementary(contact, 1e-13, 1e-12)
        r = contact.resultant(on="target")
        found.append([*r.force, *r.moment])
    assert found[0] == pytest.approx(found[1], abs=1e-9)
    # pushed askew: a force along the slope and a moment about the pivot
    assert abs(found[0][0]) > 0.05 * found[0][g - 1] and np.abs(found[0][g:]).max() > 1e-4
    p = turned.project(np.array([pivot]))
    assert p.normal[0] == pytest.approx(drawn.project(np.array([pivot])).normal[0], abs=1e-15)


def test_turning_tool_without_friction():
    """A ball that spins in its place in steps does nothing to the slab, and its motion counts from the drawing."""
    ball = uem.RigidSphere((0.5, 0.5, 1.95), 1.0)
    _, contact, problem = slab(
        "hexahedron",
        ball,
        held={"max_penetration": 0.2},
        motion=lambda f: {"translation": (0, 0, 0), "rotation": (f, 2 * f, 3 * f)},
    )
    forces = [contact.resultant(on="target").force[2] for _ in uem.load_steps(problem, 3)]
    assert forces[0] > 0 and np.ptp(forces) < 1e-9 * forces[0]


@pytest.mark.slow
def test_a_failing_step_leaves_the_tool_to_load():
    """A step beyond all measure is cut until it works, with the tool where ``load`` puts it; one that fails for good restores."""
    places = []

    def motion(factor):
        places.append(-0.25 * factor)
        return {"translation": (0.0, -0.25 * factor)}

    ball = uem.RigidSphere((0.5, 1.5), 0.5)
    _, contact, problem = slab("triangle", ball, law=st_venant, motion=motion, max_iterations=3)
    steps = run(problem, 1)
    assert sum(s.cuts for s in steps) > 0 and steps[-1].factor == 1.0
    assert places[-1] == -0.25 and ball.reference(2)[1] == pytest.approx(1.25)
    complementary(contact, 1e-12, 1e-10)

    # uncut small steps from the start arrive at the same state
    other = uem.RigidSphere((0.5, 1.5), 0.5)
    _, twin, smooth = slab("triangle", other, law=st_venant, motion=lambda f: {"translation": (0.0, -0.25 * f)})
    run(smooth, 16)
    assert contact.resultant().force == pytest.approx(twin.resultant().force, rel=1e-6, abs=1e-9)

    u, before, active = problem.u.x.array.copy(), contact.resultant(), contact.pair.committed.active.copy()
    ball.move((0.0, -0.9))
    with pytest.raises((uem.ConvergenceError, uem.InvertedElementError)):
        problem.solve()
    assert highest(COMM, np.abs(problem.u.x.array - u)) == 0.0
    assert ball.reference(2)[1] == pytest.approx(0.6)
    assert (contact.pair.trial.active == active).all()
    assert np.array_equal(contact.resultant().force, before.force)
    # back where it was, the next step starts from the committed state and finds it
    problem.load(1.0)
    assert len(problem.solve()) == 1
    assert contact.resultant().force == pytest.approx(before.force, rel=1e-12)
    complementary(contact, 1e-12, 1e-10)


def test_lifted_tool_lets_go():
    """Down, up and down again: no force while the tool is away, and the same force when it is back."""
    ball = uem.RigidSphere((0.5, 1.5), 0.5)
    depths = [0.02, 0.05, -0.1, 0.02, 0.05]
    _, contact, problem = slab("triangle", ball, law=st_venant, rtol=1e-11)
    forces = []
    for d in depths:
        ball.move((0.0, -d))
        problem.solve()
        forces.append(contact.resultant(on="target").force[1])
    assert forces[2] == 0.0 and min(forces[0], forces[1]) > 0.0
    assert forces[3:] == pytest.approx(forces[:2], rel=1e-8)


def test_rigid_surfaces_by_formula():
    x = np.array([[0.0, 0.0, 3.0], [1.0, 2.0, 2.0], [3.0, 4.0, -1.0]])
    plane = uem.RigidPlane((0, 0, 1), (0, 0, 5)).project(x)
    assert np.allclose(plane.gap, [2, 1, -2]) and np.allclose(plane.normal, [0, 0, 1])
    sphere = uem.RigidSphere((0, 0, 0), 2.0).project(x)
    assert np.allclose(sphere.gap, [1, 1, np.sqrt(26) - 2]) and np.allclose(sphere.normal, x / np.linalg.norm(x, axis=1)[:, None])
    hollow = uem.RigidSphere((0, 0, 0), 4.0, inside=True).project(x)
    assert np.allclose(hollow.gap, [1, 1, 4 - np.sqrt(26)]) and np.allclose(hollow.normal, -sphere.normal)
    cylinder = uem.RigidCylinder((0, 0, 7), (0, 0, 2), 1.0).project(x[1:])
    assert np.allclose(cylinder.gap, [np.sqrt(5) - 1, 4]) and np.allclose(cylinder.normal[1], [0.6, 0.8, 0])
    # the gap of a paraboloid is exact where it is zero, and has the sign of the side everywhere
    paraboloid = uem.RigidParaboloid((0, 0, 0), (0, 0, 1), 0.5)
    on = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 1.0], [0.6, 0.8, 1.0]])
    assert np.allclose(paraboloid.project(on).gap, 0, atol=1e-15)
    assert paraboloid.project(np.array([[0.0, 0.0, -0.1]])).gap[0] == pytest.approx(0.1)
    near = paraboloid.project(on + 1e-6 * paraboloid.project(on).normal)
    assert np.allclose(near.gap, 1e-6, rtol=1e-5)
    assert np.allclose(near.normal[1], np.array([2, 0, -1]) / np.sqrt(5), atol=1e-5)


@given(seed=st.integers(0, 10**6), g=st.sampled_from([2, 3]))
def test_the_rest_of_a_motion(seed, g):
    """The whole of it leads from the old place to the new one, none of it nowhere, and every part is rigid."""
    rng = np.random.default_rng(seed)

    def motion():
        return Motion(rng.normal(size=g), rotation_matrix(rng.uniform(-1.5, 1.5, 1 if g == 2 else 3)), rng.normal(size=g))

    before, now, X = motion(), motion(), rng.normal(size=(4, g))
    assert np.allclose(now.since(before, 1.0).carry(before.carry(X)), now.carry(X), atol=1e-12)
    assert np.allclose(now.since(before, 0.0).carry(X), X, atol=1e-12)
    part = now.since(before, rng.uniform())
    assert np.allclose(part.Q @ part.Q.T, np.eye(g), atol=1e-12)
