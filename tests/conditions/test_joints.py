"""Joints and springs between rigid parts.

Two tests to read first: ``test_torsional_spring``, equilibrium and quadratic convergence at a finite angle, and ``test_derivatives``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import clamp, highest, linear, refused, slow, st_venant
from rigid_boxes import RigidBoxes, quadratic

import uem_dolfinx as uem
from uem_dolfinx.conditions.joints import across
from uem_dolfinx.conditions.relations import RA, RB, TA, TB, Body, angle, distance, projected
from uem_dolfinx.geometry.rigid import rotation_matrix

COMM = MPI.COMM_WORLD


class Row(RigidBoxes):
    """Rigid boxes with their middles as points."""

    def __init__(self, cell="quadrilateral", n=2):
        super().__init__(cell, n, height=0.5)
        self.k = 1 if self.g == 2 else 3

    def held(self, i=0, **how):
        return self.part(i, motion=[0.0] * (self.g + self.k), **how)

    def problem(self, *couplings, law=st_venant, **how):
        return uem.UnitedProblem(law(self.u, 1.0), self.u, couplings=list(couplings), rtol=1e-13, **how)

    def vector(self, x, y, z=0.0):
        return np.array([x, y, z])[: self.g]


# -- scalars of two bodies -------------------------------------------------------------------------------------------------


def moved(bodies, z):
    """Bodies a and b after translations and rotations z."""
    return [Body(rotation_matrix(z[r]) @ one.Q, one.middle + z[t], one.about) for one, t, r in zip(bodies, (TA, TB), (RA, RB))]


def scalars(rng):
    x, y, of_a, of_b = rng.normal(size=(4, 3))
    axis, point = np.array([0.0, 0.6, 0.8]), rng.normal(size=3)
    yield lambda a, b: projected(a, b, x, y, None)
    yield lambda a, b: projected(a, b, x, y, point)
    yield lambda a, b: angle(a, b, *across(axis))

    class Length:
        def __init__(self, a, b):
            D, slopes, _, _ = distance(a, b, of_a, of_b)
            self.value, self.slope = np.linalg.norm(D), D @ slopes / np.linalg.norm(D)

    yield Length


@pytest.mark.parametrize("which", range(4))
def test_derivatives(which):
    """Slopes and second derivatives agree with differences, in any placement."""
    rng = np.random.default_rng(4)
    bodies = [Body(rotation_matrix(rng.normal(size=3) * 0.4), *rng.normal(size=(2, 3))) for _ in "ab"]
    f, e = list(scalars(rng))[which], 1e-5
    at = f(*bodies)
    steps = e * np.eye(12)
    slope = [(f(*moved(bodies, d)).value - f(*moved(bodies, -d)).value) / (2.0 * e) for d in steps]
    assert np.abs(at.slope - slope).max() <= 1e-8
    if hasattr(at, "bend"):

        def twice(d, h):
            return (f(*moved(bodies, d + h)).value - f(*moved(bodies, d - h)).value) / 2.0

        e = 1e-4
        steps = e * np.eye(12)
        bend = [[(twice(d, h) - twice(-d, h)) / (2.0 * e**2) for h in steps] for d in steps]
        assert np.abs(at.bend - bend).max() <= 1e-6


# -- hinges and balls ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", slow("hexahedron")])
def test_torsional_spring(cell):
    """A weight turns an arm about a hinge far: k phi = F L cos phi, the bearing carries the weight, Newton's method is quadratic."""
    r = Row(cell)
    arm = r.part(1, force=r.vector(0.0, -1.0))
    hinge = uem.Hinge(base := r.held(), arm, r.at(2.25), *([] if r.g == 2 else [(0.0, 0.0, 2.0)]), stiffness=2.0)
    problem = r.problem(base, arm, hinge)
    iterations = problem.solve()
    assert 2.0 * hinge.angle == pytest.approx(-1.25 * np.cos(hinge.angle), rel=1e-11) and hinge.angle < -0.5
    assert np.allclose(hinge.force, r.vector(0.0, 1.0), atol=1e-10)
    assert np.abs(hinge.moment).max() <= 1e-10
    lever = 1.25 + 1.25 * np.cos(hinge.angle)
    force, moment = base.reaction
    assert np.allclose(force, r.vector(0.0, 1.0), atol=1e-10) and np.ravel(moment)[-1] == pytest.approx(lever, rel=1e-10)
    assert quadratic(iterations)
    tip = r.at(2.25) + (rotation_matrix(np.array([0.0, 0.0, hinge.angle]))[: r.g, : r.g] @ r.vector(1.25, 0.0))
    assert np.allclose(arm.displacement, tip - r.at(3.5), atol=1e-12)


def test_small_rotations():
    """In small strain all of it is linear: k phi = F L in one step, and half the load turns it half as far."""
    r = Row()
    P = fem.Constant(r.scene.mesh, (0.0, -0.1))
    base, arm = r.held(), r.part(1, force=P)
    hinge = uem.Hinge(base, arm, r.at(2.25), stiffness=2.0)
    problem = r.problem(base, arm, hinge, law=linear, load={P: (0.0, -0.1)})
    for step in uem.load_steps(problem, 2):
        assert hinge.angle == pytest.approx(-0.1 * 1.25 / 2.0 * step.factor, rel=1e-11)
        assert np.allclose(hinge.force, (0.0, 0.1 * step.factor), atol=1e-13)
    assert len(step.iterations) == 2


def test_a_tilted_axis():
    """A hinge in space turns about its axis alone, whichever its parts: moments across it are the bearing's."""
    r = Row("hexahedron")
    axis = np.array([0.6, 0.0, 0.8])
    arm = r.part(1, moment=(0.3, 0.2, 0.5))
    hinge = uem.Hinge(base := r.held(), arm, r.at(2.25), axis, stiffness=0.7)
    r.problem(base, arm, hinge).solve()
    moment = np.array([0.3, 0.2, 0.5])
    assert 0.7 * hinge.angle == pytest.approx(moment @ axis, rel=1e-10)
    assert np.allclose(arm.rotation, hinge.angle * axis, atol=1e-11)
    assert np.allclose(hinge.moment, (moment @ axis) * axis - moment, atol=1e-10)
    assert np.abs(hinge.force).max() <= 1e-10


def test_a_moving_axis():
    """The axis moves with the first part: after a quarter turn of it the second part rotates about the axis there."""
    r = Row("hexahedron")
    quarter = 0.5 * np.pi
    base = r.part(0, motion=[0.0, 0.0, 0.0, lambda factor: quarter * factor, 0.0, 0.0])
    arm = r.part(1, force=(0.0, 0.0, -0.3))
    hinge = uem.Hinge(base, arm, r.at(2.25), (0.0, 0.0, 1.0), stiffness=2.0)
    for _ in uem.load_steps(r.problem(base, arm, hinge), 4):
        pass
    # the axis z has become -y, about which the weight turns the arm
    assert 2.0 * hinge.angle == pytest.approx(-0.3 * 1.25 * np.cos(hinge.angle), rel=1e-10)
    assert arm.displacement == pytest.approx([1.25 * (np.cos(hinge.angle) - 1.0), 0.0, 1.25 * np.sin(hinge.angle)], abs=1e-10)


@pytest.mark.parametrize("bearing", ["hinged", "held"])
def test_a_linkage_of_four_bars(bearing):
    """Three bars and the ground in space: equations that closed chains have too many are left out, and the rocker is where it must be."""
    r = Row("hexahedron", 3)
    pivots = [r.at(x, y) for x, y in ((0.0, 0.0), (0.0, 2.0), (4.75, 3.0), (6.25, 0.0))]
    first = [None, None, None, None, None] if bearing == "hinged" else [0.0, 0.0, 0.0, None, None]
    crank = uem.RigidCoupling(r.tags[0], pivots[0], motion=[*first, lambda factor: 0.6 * factor])
    parts = [None, crank, r.part(1), r.part(2), None]
    joints = [uem.Hinge(a, b, p, (0.0, 0.0, 1.0)) for a, b, p in zip(parts, parts[1:], pivots)]
    problem = r.problem(*parts[1:-1], *joints)
    for step in uem.load_steps(problem, 2):
        R = rotation_matrix(np.array([0.6 * step.factor]))
        a, o = R @ (pivots[1] - pivots[0])[:2], pivots[3][:2]
        coupler, rocker = np.linalg.norm(pivots[2] - pivots[1]), np.linalg.norm(pivots[3] - pivots[2])
        d = np.linalg.norm(o - a)
        along = (coupler**2 - rocker**2 + d**2) / (2.0 * d)
        e = (o - a) / d
        b = a + along * e + np.sqrt(coupler**2 - along**2) * np.array([-e[1], e[0]])
        turn = np.arctan2(*(b - o)[::-1]) - np.arctan2(*(pivots[2] - pivots[3])[1::-1])
        assert parts[3].rotation == pytest.approx([0.0, 0.0, turn], abs=1e-12)
        assert joints[3].angle == pytest.approx(-turn, abs=1e-12) and joints[0].angle == pytest.approx(
            0.6 * step.factor, abs=1e-12
        )


def test_a_ball():
    """A ball carries no moment: its socket bears the force alone, wherever the arm has turned."""
    r = Row("hexahedron")
    turn = np.array([0.2, -0.3, 0.4])
    arm = r.part(1, motion=[None, None, None, *turn], force=(0.1, 0.2, -0.3))
    ball = uem.Ball(base := r.held(), arm, r.at(2.25))
    r.problem(base, arm, ball).solve()
    lever = rotation_matrix(turn) @ r.vector(1.25, 0.0)
    assert np.allclose(r.at(3.5) + arm.displacement, r.at(2.25) + lever, atol=1e-12)
    assert np.allclose(ball.force, (-0.1, -0.2, 0.3), atol=1e-11) and np.abs(ball.moment).max() <= 1e-11
    assert np.allclose(arm.reaction[1], -np.cross(lever, (0.1, 0.2, -0.3)), atol=1e-11)
    assert np.allclose(base.reaction[0], (-0.1, -0.2, 0.3), atol=1e-11)


# -- sliders ---------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", slow("hexahedron")])
def test_a_slider(cell):
    """Along its axis a slider gives way to its spring, across it bears force and moment; the axis turns with the first part."""
    r = Row(cell)
    axis, turn = r.vector(0.6, 0.8), 0.7
    base = r.part(0, motion=[*[0.0] * r.g, *[0.0] * (r.k - 1), lambda factor: turn * factor])
    force = np.array([0.2, -0.5, 0.1])[: r.g]
    slide = r.part(1, force=force)
    slider = uem.Slider(base, slide, r.at(2.25), axis, stiffness=0.8)
    for _ in uem.load_steps(r.problem(base, slide, slider), 2):
        pass
    R = rotation_matrix(np.array([turn] if r.g == 2 else [0.0, 0.0, turn]))
    assert slider.displacement == pytest.approx(force @ R @ axis / 0.8, rel=1e-10)
    at = r.at(1.0) + R @ (r.at(3.5) - r.at(1.0) + slider.displacement * axis)
    assert np.allclose(r.at(3.5) + slide.displacement, at, atol=1e-12)
    assert np.ravel(slide.rotation)[-1] == pytest.approx(turn, abs=1e-12)
    across = force - force @ R @ axis * R @ axis
    assert np.allclose(slider.force, -across, atol=1e-11)
    arm = np.append(R @ r.vector(1.25, 0.0), np.zeros(3 - r.g))
    full = np.append(force, np.zeros(3 - r.g))
    assert np.allclose(np.ravel(slider.moment), -np.cross(arm, full)[-r.k :], atol=1e-11)


@pytest.mark.parametrize("cell", ["quadrilateral", slow("hexahedron")])
def test_a_crank(cell):
    """A crank of 1 and a rod of 3 drive a piston against a force, all the way round: its place, and the torque by virtual work."""
    r = Row(cell, n=3)
    z, led = ([] if r.g == 2 else [(0.0, 0.0, 1.0)]), [None] * (r.g + r.k - 1)
    o, pin, end = r.at(0.0, 0.0), r.at(1.0, 0.0), r.at(4.0, 0.0)
    crank = uem.RigidCoupling(r.tags[0], o, motion=[*led, lambda factor: 2.0 * np.pi * factor])
    rod, piston = r.part(1), uem.RigidCoupling(r.tags[2], end, force=r.vector(0.5, 0.0))
    joints = [uem.Hinge(None, crank, o, *z), uem.Hinge(crank, rod, pin, *z), uem.Hinge(rod, piston, end, *z)]
    slider = uem.Slider(None, piston, end, r.vector(1.0, 0.0))
    for step in uem.load_steps(r.problem(crank, rod, piston, *joints, slider), 8):
        t = 2.0 * np.pi * step.factor
        reach = np.sqrt(9.0 - np.sin(t) ** 2)
        assert slider.displacement == pytest.approx(np.cos(t) + reach - 4.0, abs=1e-12)
        torque = 0.5 * np.sin(t) * (1.0 + np.cos(t) / reach)
        assert np.ravel(crank.reaction[1])[-1] == pytest.approx(torque, abs=1e-9)
        # near a full turn rounding turns the axis of the rotation vector in space
        assert joints[0].angle == pytest.approx(t, abs=1e-11 if r.g == 2 else 1e-7)
        assert joints[2].force[:1] == pytest.approx([-0.5], abs=1e-9)


def test_a_slider_that_turns():
    """A piston that may turn follows a moment about its axis alone; the rest is the cylinder's."""
    r = Row("hexahedron")
    base, piston = r.held(), r.part(1, motion=[0.4, None, None, 0.9, None, None], moment=(0.0, 0.2, 0.1))
    slider = uem.Slider(base, piston, r.at(2.25), (1.0, 0.0, 0.0), turns=True)
    r.problem(base, piston, slider).solve()
    assert np.allclose(piston.rotation, (0.9, 0.0, 0.0), atol=1e-12) and np.allclose(
        piston.displacement, (0.4, 0.0, 0.0), atol=1e-12
    )
    assert slider.displacement == pytest.approx(0.4, rel=1e-12)
    assert np.allclose(slider.moment, (0.0, -0.2, -0.1), atol=1e-11)


# -- springs ---------------------------------------------------------------------------------------------------------------


def test_springs_in_line():
    """Bodies in line between springs: stretches by the force, and the energy is half the work in small strain."""
    r = Row(n=3)
    parts = [r.held(), *(r.part(i, force=(0.1, 0.0), motion=[None, 0.0, 0.0]) for i in (1, 2))]
    springs = [uem.Spring(parts[0], parts[1], 2.0), uem.Spring(parts[1], parts[2], 0.5)]
    problem = r.problem(*parts, *springs, law=linear)
    problem.solve()
    assert [one.displacement[0] for one in parts] == pytest.approx([0.0, 0.1, 0.3], abs=1e-12)
    assert springs[0].force == pytest.approx([-0.2, 0.0], abs=1e-13) and springs[1].length == pytest.approx(2.7, rel=1e-12)
    assert problem.bodies.tangent.points.energy() == pytest.approx(0.5 * (0.1 * 0.1 + 0.1 * 0.3), rel=1e-12)


@pytest.mark.parametrize("cell", ["quadrilateral", slow("hexahedron")])
def test_a_guyed_arm(cell):
    """An arm on a hinge is held by a spring aslant: moments balance at a large angle, and Newton's method is quadratic."""
    r = Row(cell)
    arm = r.part(1, force=r.vector(0.05, -0.4))
    hinge = uem.Hinge(None, arm, o := r.at(2.25), *([] if r.g == 2 else [(0.0, 0.0, 1.0)]))
    mast, tip = r.at(2.0, 3.0), r.at(4.5, 1.0)
    spring = uem.Spring(None, arm, 0.5, points=(mast, tip), free_length=2.0)
    iterations = r.problem(arm, hinge, spring).solve()
    R = np.eye(r.g)
    R[:2, :2] = rotation_matrix(np.array([hinge.angle]))
    end, middle = o + R @ (tip - o), R @ r.vector(1.25, 0.0)
    D = end - mast
    assert spring.length == pytest.approx(np.linalg.norm(D), rel=1e-12)
    tension = 0.5 * (spring.length - 2.0)
    assert np.allclose(spring.force, -tension * D / spring.length, atol=1e-12)
    load = r.vector(0.05, -0.4)
    turning = np.linalg.det([(end - o)[:2], spring.force[:2]]) + np.linalg.det([middle[:2], load[:2]])
    assert abs(turning) <= 1e-11 and abs(hinge.angle) > 0.1
    assert np.allclose(hinge.force, -spring.force - load, atol=1e-10)
    assert quadratic(iterations)


def test_what_springs_resist():
    """A free body on springs is held by any number of directions in which they resist it, however soft; a missing one is named."""
    for soft in (1.0, 1e-8):
        r = Row()
        force = np.array([0.01, 0.02]) * soft
        arm = r.part(1, force=force, moment=0.01 * soft)
        hook = [uem.Spring(None, arm, k, points=(p, p), free_length=0.0) for k, p in ((1.0, r.at(2.5)), (soft, r.at(4.5)))]
        r.problem(arm, *hook, law=linear).solve()
        assert np.allclose(sum(h.force for h in hook), -force, rtol=1e-6)
    r = Row()
    arm = r.part(1, force=(0.0, -0.1))
    line = uem.Spring(None, arm, 1.0, points=(r.at(2.25), r.at(2.5)))
    problem = r.problem(arm, line, law=linear)
    refused(uem.FloatingBodyError, ("moves",), problem.solve)


# -- with contact ----------------------------------------------------------------------------------------------------------


def test_a_chain_on_the_floor():
    """Two bars of a chain sag until both ends rest on the floor, whose forces balance the weights about both hinges."""
    r = Row(n=3)
    a, b = r.part(1, force=(0.0, -0.1)), r.part(2, force=(0.0, -0.2))
    pivots = r.at(2.25), r.at(4.75)
    hinges = [uem.Hinge(None, a, pivots[0]), uem.Hinge(a, b, pivots[1])]
    floor = uem.RigidPlane((0.0, -0.1), (0.0, 1.0))
    ends = [r.scene.tag(f"end {i}", i, lambda x, end=end: np.isclose(x[:, 0], end)) for i, end in ((1, 4.5), (2, 7.0))]
    contacts = [uem.Contact(contactor=tag, target=floor) for tag in ends]
    problem = r.problem(r.held(), a, b, *hinges, contacts=contacts)
    problem.solve()

    def at(part, X):
        R = rotation_matrix(np.array([part.rotation]))
        return part.point + part.displacement + R @ (np.asarray(X) - part.point)

    tips = [at(a, (4.5, 0.0)), at(b, (7.0, 0.0))]
    assert np.allclose([tip[1] for tip in tips], -0.1, atol=1e-12)
    forces = [contact.resultant().force for contact in contacts]
    first, second = at(a, pivots[0]), at(b, pivots[1])
    assert np.allclose(second, at(a, pivots[1]), atol=1e-12)
    push = [np.abs(force[1]) for force in forces]
    assert push[1] == pytest.approx(0.2 * (at(b, b.point)[0] - second[0]) / (tips[1][0] - second[0]), rel=1e-9)
    carried = 0.2 - push[1]
    moment = 0.1 * (at(a, a.point)[0] - first[0]) + carried * (second[0] - first[0])
    assert push[0] == pytest.approx(moment / (tips[0][0] - first[0]), rel=1e-9)
    assert hinges[1].force == pytest.approx([0.0, carried], abs=1e-10)
    assert hinges[0].force == pytest.approx([0.0, 0.1 + carried - push[0]], abs=1e-10)


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_dragging_arm(way):
    """Under an arm on a hinge the floor is drawn along: friction presses its tip down or lifts it, as the moments about the hinge say."""
    r = Row()
    arm = r.part(1, force=(0.0, -0.1))
    hinge = uem.Hinge(None, arm, r.at(2.25, 0.7))
    floor = uem.RigidPlane((0.0, -0.1), (0.0, 1.0))
    end = r.scene.tag("end", 1, lambda x: np.isclose(x[:, 0], 4.5))
    contact = uem.Contact(contactor=end, target=floor, friction=0.3)
    problem = r.problem(r.held(), arm, hinge, contacts=[contact])
    problem.solve()
    for _ in range(3):
        floor.move((0.1 * way, 0.0))
        problem.solve()
    R = rotation_matrix(np.array([arm.rotation]))
    lever, tip = (R @ (np.array(X) - r.at(2.25, 0.7)) for X in (r.at(3.5), (4.5, 0.0)))
    push, rub = contact.resultant().force[[1, 0]]
    assert rub == pytest.approx(0.3 * way * push, rel=1e-9)
    assert push == pytest.approx(0.1 * lever[0] / (tip[0] - 0.3 * way * tip[1]), rel=1e-9)
    assert hinge.force == pytest.approx([-rub, 0.1 - push], abs=1e-10)


# -- what is refused -------------------------------------------------------------------------------------------------------


def test_what_is_refused():
    r, s = Row(), Row("hexahedron")
    a, b, c = r.part(0), r.part(1), s.part(0)
    p, z = (2.25, 0.5), (0.0, 0.0, 1.0)
    refused(uem.InputTypeError, ("a = 1", "RigidCoupling"), lambda: uem.Ball(1, b, p))
    refused(uem.InputError, ("same RigidCoupling", "body 0"), lambda: uem.Ball(a, a, p))
    refused(uem.InputError, ("the ground on both sides",), lambda: uem.Ball(None, None, p))
    refused(uem.InputError, ("point",), lambda: uem.Ball(a, b, (0.0, 0.0, 0.0)))
    refused(uem.InputError, ("2D and 3D",), lambda: uem.Ball(a, c, p))
    refused(uem.InputError, ("axis", "plane"), lambda: uem.Hinge(a, b, p, z))
    refused(uem.InputError, ("axis", "space"), lambda: uem.Hinge(c, None, (0.0, 0.0, 0.0)))
    refused(uem.InputError, ("axis", "non-zero"), lambda: uem.Hinge(c, None, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)))
    refused(uem.InputError, ("axis", "non-zero"), lambda: uem.Slider(a, b, p, (0.0, 0.0)))
    refused(uem.InputError, ("stiffness = -1",), lambda: uem.Hinge(a, b, p, stiffness=-1.0))
    refused(uem.InputError, ("stiffness = 0",), lambda: uem.Spring(a, b, 0.0))
    refused(uem.InputError, ("points", "ground"), lambda: uem.Spring(a, None, 1.0))
    refused(uem.InputError, ("free_length", "one point"), lambda: uem.Spring(a, b, 1.0, points=(p, p), free_length=1.0))
    shared = uem.RigidCoupling(r.tags[1], (3.5, 0.5), distribute=True)
    refused(uem.InputError, ("distribute",), lambda: uem.Ball(a, shared, p))
    refused(uem.InputError, ("body 1", "not in the problem"), lambda: r.problem(a, uem.Ball(a, b, p)))
    r = Row()
    a, b = r.part(0, rotations="small"), r.part(1, rotations="large")
    refused(uem.InputError, ("large and of small rotations",), lambda: r.problem(a, b, uem.Ball(a, b, p)))
    r = Row()
    a, b = r.held(), r.part(1)
    ball = uem.Ball(a, b, p)
    r.problem(a, b, ball)
    refused(uem.SpaceError, ("RigidCoupling", "another problem"), lambda: r.problem(a, b, ball))
    refused(uem.InputTypeError, ("couplings[1]",), lambda: r.problem(r.part(0), 3.0))


def test_explicit_steps_have_none():
    """Explicit steps with massless contactors name couplings."""
    r = Row()
    parts = r.held(), r.part(1)
    ball, mass = uem.Ball(*parts, r.at(2.25)), uem.lumped_mass(r.V, 1.0)
    explicit = uem.Dynamics(mass, scheme=uem.CentralDifferences())
    refused(uem.InputError, "couplings need nodes with mass to go with", lambda: r.problem(*parts, ball, dynamics=explicit))


def test_joints_that_contradict_conditions():
    """Two parts that are led apart cannot stay joined, and the joint is named."""
    r = Row()
    a, b = r.held(), r.part(1, motion=[0.1, 0.0, 0.0])
    problem = r.problem(a, b, uem.Ball(a, b, r.at(2.25)))
    refused(uem.ConflictError, ("the Ball of 'body 0' and 'body 1'", "missed by"), problem.solve)


def test_a_joint_of_clamped_parts():
    """A part held by Dirichlet conditions bears a joint as one held by its coupling."""
    r = Row()
    left = r.scene.tag("left", 0, lambda x: np.isclose(x[:, 0], 0.0))
    base, arm = r.part(0), r.part(1, force=(0.0, -1.0))
    hinge = uem.Hinge(base, arm, r.at(2.25), stiffness=2.0)
    r.problem(base, arm, hinge, bcs=clamp(r.V, left)).solve()
    assert 2.0 * hinge.angle == pytest.approx(-1.25 * np.cos(hinge.angle), rel=1e-10)
    assert highest(COMM, np.abs(base.displacement)) <= 1e-14
