"""Bodies without displacement control: they fall until contact holds them, and stay where they are along neutral motions.

Two tests to read first: ``test_block_falls_on_block`` (the closed form, across any gap) and ``test_tilted_block_comes_to_rest_flat``
(a body that touches with one corner turns until a second contactor touches).
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from falling_scenes import LAWS, Falling, arc, half_disc
from helpers import CELLS, at, box, clamp, highest, lawful, modulus, raised, rotation

import uem_dolfinx as uem
from uem_dolfinx import forms

COMM = MPI.COMM_WORLD


def shortening(stress, law):
    """How much of its height a free bar of unit modulus loses under a dead stress, for nu = 0."""
    if law == "linear":
        return stress
    # s = e (1 - e)(2 - e) / 2
    return float(min(r.real for r in np.roots([0.5, -1.5, 1.0, -stress]) if abs(r.imag) < 1e-12))


def falling(cell, law="linear", *, gap=0.25, stress=0.02, E=(1.0, 2.0), n=(2, 4), nu=0.0, comm=COMM, traction=None, **how):
    """A unit block above a unit block, pressed down by a traction on its top; nothing else acts on it."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    lower = box(cell, [0.0] * (g - 1) + [-1.0], [1.0] * (g - 1) + [0.0], [n[0]] * g)
    upper = box(cell, [0.0] * (g - 1) + [gap], [1.0] * (g - 1) + [1.0 + gap], [n[1]] * g)
    f = Falling(cell, [lower, upper], law, E, nu, comm, **how)
    down = [0.0] * (g - 1) + [-stress] if traction is None else traction
    f.pull(f.s.tag("top", 1, at(g - 1, 1.0 + gap)), down)
    f.base = f.s.tag("base", 0, at(g - 1, -1.0))
    f.high, f.low = f.s.tag("high", 1, at(g - 1, gap)), f.s.tag("low", 0, at(g - 1, 0.0))
    return f


# -- closed forms ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("cell", CELLS)
def test_block_falls_on_block(cell, law):
    """Between rollers, across a gap that is no part of the answer: force, uniform stress, every displacement of the closed form."""
    for gap in (0.3, 0.1, 0.0):
        f = falling(cell, law, gap=gap)
        bcs = clamp(f.V, f.base)
        for c in range(f.g - 1):
            for body, end in product((0, 1), (0.0, 1.0)):
                bcs += clamp(f.V, f.s.tag("side", body, at(c, end)), c)
        contact = uem.Contact(f.high, f.low)
        f.problem(bcs, [contact], rtol=1e-12).solve()
        low, high = (shortening(0.02 / E, law) for E in (1.0, 2.0))
        z = f.s.drawing[:, -1]
        exact = np.zeros((len(z), f.g))
        exact[:, -1] = np.where(f.bodies == 0, -low * (z + 1), -gap - low - high * (z - gap))
        assert np.abs(f.moved() - exact).max() < 1e-12
        force = contact.resultant().force
        assert force[-1] == pytest.approx(0.02, rel=1e-10) and np.abs(force[:-1]).max() < 1e-12
        assert highest(COMM, np.abs(contact.pressures / 0.02 - 1)) < 1e-8
        assert contact.max_gap() <= 1e-13
        lawful(contact)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("cell", CELLS)
def test_free_block_falls_on_the_ground(cell, law):
    """Nothing at its sides: uniaxial stress, free to grow wider, and not moved along the motions that nothing loads."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    nu, stress = (0.0 if law == "finite" else 0.3), 0.02
    f = Falling(cell, [box(cell, [0.0] * (g - 1) + [0.3], [1.0] * (g - 1) + [1.3], [3] * g)], law, E=(1.0,), nu=nu)
    f.pull(f.s.tag("top", 0, at(g - 1, 1.3)), [0.0] * (g - 1) + [-stress])
    ground = uem.RigidPlane([0.0] * g, np.eye(g)[-1])
    contact = uem.Contact(f.s.tag("bottom", 0, at(g - 1, 0.3)), ground)
    f.problem((), [contact], rtol=1e-12).solve()
    lawful(contact)
    # plane strain in 2D
    up, across = (1 - nu**2, nu * (1 + nu)) if g == 2 else (1.0, nu)
    x = f.s.drawing - np.array([0.5] * (g - 1) + [0.3])
    exact = np.column_stack([across * stress * x[:, :-1], -0.3 - up * shortening(stress, law) * x[:, -1]])
    error = np.abs(f.moved() - exact)
    assert error[:, -1].max() < 1e-11
    # what is left across is a turn about the vertical, which nothing resists
    assert error.max() < (1e-11 if g == 2 else 1e-6)
    there = contact.resultant(on="target")
    assert there.force[-1] == pytest.approx(-stress, rel=1e-10)
    # through the middle of the block
    about = contact.resultant(about=[0.5] * (g - 1) + [0.0])
    assert np.abs(about.moment).max() < 1e-11


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_tilted_block_comes_to_rest_flat(cell, law):
    """It touches the plane with one corner (edge), turns until it lies flat, and then carries its load uniformly."""
    g, angle, stress = (2 if cell == "quadrilateral" else 3), (0.1 if law == "finite" else 1e-3), 0.02
    R = rotation(g, angle)
    f = Falling(cell, [box(cell, [0.0] * g, [1.0] * g, [3] * g)], law, E=(1.0,), pose=lambda x: x @ R.T + 0.05 * np.eye(g)[-1])
    f.pull(f.s.tag("top", 0, at(g - 1, 1.0)), [0.0] * (g - 1) + [-stress])
    contact = uem.Contact(f.s.tag("bottom", 0, at(g - 1, 0.0)), uem.RigidPlane([0.0] * g, np.eye(g)[-1]))
    f.problem((), [contact], rtol=1e-12).solve()
    lawful(contact)
    assert contact.n_active == 4 ** (g - 1)
    assert contact.resultant().force[-1] == pytest.approx(stress, rel=1e-9)
    x = f.s.drawing @ R.T + 0.05 * np.eye(g)[-1] + f.moved()
    if law == "finite":
        assert np.abs(x[:, -1] - (1 - shortening(stress, law)) * f.s.drawing[:, -1]).max() < 1e-10
        # as wide as it was drawn; what is left is a turn about the vertical, which nothing resists
        across = x[:, :-1] - f.s.drawing[:, :-1]
        assert np.abs(across - across.mean(axis=0)).max() < 1e-5
    else:
        # a linear body measures its strain in the pose that it was drawn in
        assert np.abs(x[:, -1] - (1 - stress) * f.s.drawing[:, -1]).max() < 5 * stress * angle + 2 * angle**2


@pytest.mark.parametrize("tilt", [0.0, 0.2])
def test_half_disc_rights_itself(tilt):
    """Its weight acts below the middle of its arc: it rolls until its flat side is level, to an element of the polygon."""
    R, n, weight = rotation(2, tilt), 6, 1e-3
    f = Falling("quadrilateral", [half_disc(n)], "finite", E=(1.0,), nu=0.3, pose=lambda x: (x - [0, 1]) @ R.T + [0.0, 1.02])
    f.weigh(weight)
    contact = uem.Contact(f.s.tag("arc", 0, arc()), uem.RigidPlane([0.0, 0.0], [0.0, 1.0]))
    f.problem((), [contact], rtol=1e-10).solve()
    lawful(contact)
    area = forms.assemble_scalar(forms.form(fem.Constant(f.s.mesh, 1.0) * ufl.dx), COMM)
    assert contact.resultant().force[1] == pytest.approx(weight * area, rel=1e-8)
    flat = np.abs(f.s.drawing[:, 1] - 1.0) < 1e-9
    x = ((f.s.drawing - [0, 1]) @ R.T + [0.0, 1.02] + f.moved())[flat]
    slope = np.polyfit(x[:, 0], x[:, 1], 1)[0]
    assert abs(slope) < np.pi / (4 * n)
    # the weight's moment about the origin is the contact's
    assert contact.n_active >= 1


def groove(width, base, slope=0.5):
    """A body with a V-shaped groove all along its top, the bottom of which is the origin."""
    body = box("quadrilateral", [-width, -base], [width, 0.0], [6, 2])
    return body.mapped(lambda x: x + np.outer((x[:, 1] / base + 1) * slope * np.abs(x[:, 0]), [0.0, 1.0]))


def in_groove(slope=0.5, bottom=0.0):
    """Predicate of the nodes on a groove."""
    return lambda x: np.abs(x[:, 1] - bottom - slope * np.abs(x[:, 0])) < 1e-9


def test_two_fall_on_a_third():
    """A half disc with a groove in its top falls into a groove, and a smaller half disc into its own: each carries what is above."""

    def grooved(x):
        low = 1 - np.sqrt(np.maximum(0.0, 1 - x[:, 0] ** 2))
        part = np.where(low < 1 - 1e-9, (x[:, 1] - low) / np.maximum(1 - low, 1e-9), 1.0)
        return x + np.outer(0.5 * part * (np.abs(x[:, 0]) - 1) + 0.5, [0.0, 1.0])

    middle = half_disc(4).mapped(grooved)
    on_arc = np.abs(np.linalg.norm(half_disc(4).x - [0.0, 1.0], axis=1) - 1) < 1e-9
    lower = {tuple(np.round(x, 9)) for x in middle.x[on_arc]}
    f = Falling("quadrilateral", [groove(1.5, 1.5), middle, half_disc(3, (0.0, 2.2), 0.5)], "finite", E=(1.0, 2.0, 4.0), nu=0.3)
    f.weigh(0.0, 1e-3, 2e-3)
    contacts = [
        uem.Contact(
            f.s.tag("arc", 1, lambda x: np.array([tuple(np.round(y, 9)) in lower for y in x])), f.s.tag("0", 0, in_groove())
        ),
        uem.Contact(f.s.tag("small arc", 2, arc((0.0, 2.2), 0.5)), f.s.tag("1", 1, in_groove(bottom=1.0))),
    ]
    f.problem(clamp(f.V, f.s.tag("base", 0, at(1, -1.5))), contacts, rtol=1e-11).solve()
    areas = (forms.assemble_scalar(forms.form(modulus(f.s, *d) * ufl.dx), COMM) for d in ((0.0, 1e-3, 2e-3), (0.0, 0.0, 2e-3)))
    for contact, weight in zip(contacts, areas):
        lawful(contact)
        force = contact.resultant().force
        assert force[1] == pytest.approx(weight, rel=1e-8) and abs(force[0]) < 1e-8 * weight
        # both sides of the groove
        assert contact.n_active >= 2


@pytest.mark.long
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_middle_block_between_two(cell):
    """Held by nothing but its neighbours, it carries their force: three springs in series."""
    g, d = (2 if cell == "quadrilateral" else 3), 0.03
    bodies = [box(cell, [0.0] * (g - 1) + [float(k)], [1.0] * (g - 1) + [k + 1.0], [n] * g) for k, n in enumerate((1, 2, 4))]
    f = Falling(cell, bodies, "finite", E=(1.0, 2.0, 4.0))
    contacts = [uem.Contact(f.s.tag(f"low {k}", k, at(g - 1, k)), f.s.tag(f"high {k}", k - 1, at(g - 1, k))) for k in (1, 2)]
    bcs = clamp(f.V, f.s.tag("base", 0, at(g - 1, 0.0)))
    bcs += clamp(f.V, f.s.tag("lid", 2, at(g - 1, 3.0)), value=[0.0] * (g - 1) + [-d])
    f.problem(bcs, contacts, rtol=1e-12).solve()
    forces = [c.resultant().force[-1] for c in contacts]
    assert forces[0] == pytest.approx(forces[1], rel=1e-9)
    assert sum(shortening(forces[0] / E, "finite") for E in (1.0, 2.0, 4.0)) == pytest.approx(d, rel=1e-9)
    for contact in contacts:
        lawful(contact)


# -- what the answer does not depend on --------------------------------------------------------------------------------------


def dropped(comm=COMM, angle=0.0, length=1.0, E=1.0, law="finite", shuffle=None):
    """A half disc, drawn askew, that drops into a groove next to its bottom; the answer in the drawing's frame and units."""
    R, middle = rotation(2, angle), np.array([0.05, 1.4])
    tilt = rotation(2, 0.1)

    def pose(x):
        # what is above the groove is the disc
        disc = x[:, 1] > 0.5 * np.abs(x[:, 0]) + 1e-3
        return length * np.where(disc[:, None], (x - middle) @ tilt.T + middle, x) @ R.T

    f = Falling("quadrilateral", [groove(1.5, 1.5), half_disc(4, middle)], law, (E, 2 * E), 0.3, comm, pose=pose, shuffle=shuffle)
    f.weigh(0.0, 0.01 * E / length, way=R[:, -1])
    contact = uem.Contact(f.s.tag("arc", 1, arc(middle)), f.s.tag("groove", 0, in_groove()), max_penetration=0.2 * length)
    history = f.problem(clamp(f.V, f.s.tag("base", 0, at(1, -1.5))), [contact], rtol=1e-10).solve()
    lawful(contact, length, E * length)
    order = np.lexsort(np.round(f.s.drawing, 9).T)
    return {
        "u": f.s.gather(f.u)[order] @ R / length,
        "force": contact.resultant().force @ R / (E * length),
        "active": f.s.gather(contact.active)[order],
        "iterations": len(history),
    }


def same(a, b, tol):
    assert np.array_equal(a["active"], b["active"])
    assert np.abs(a["u"] - b["u"]).max() < tol
    assert np.abs(a["force"] - b["force"]).max() < tol


@pytest.fixture(scope="module")
def reference():
    """Answers in the drawing's own frame and units."""
    answers = {law: dropped(law=law) for law in LAWS}
    for r in answers.values():
        assert r["force"][1] > 0.014 and r["active"].sum() >= 2
    return answers


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_units(reference, law):
    """Nanometres and kilometres, soft and stiff: the same answer in the same iterations."""
    for length, E in ((1e-9, 2.1e11), (1e3, 1e-3)):
        scaled = dropped(law=law, length=length, E=E)
        same(scaled, reference[law], 1e-8)
        assert scaled["iterations"] == reference[law]["iterations"]


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_pose_and_numbering(reference, law):
    """The whole scene turned with its load, and its nodes shuffled."""
    for angle in (0.4, np.pi / 2, -2.5):
        same(dropped(law=law, angle=angle), reference[law], 1e-8)
    same(dropped(law=law, shuffle=1), reference[law], 1e-8)


@pytest.mark.parametrize("law", LAWS)
def test_ranks(reference, law):
    """Every rank drops the disc alone, and finds what all of them found together."""
    alone = dropped(law=law, comm=MPI.COMM_SELF)
    same(alone, reference[law], 1e-8)
    assert alone["iterations"] == reference[law]["iterations"]


# -- at rest, or lost --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("gap", [0.25, 0.0])
def test_body_without_load_stays(gap, law):
    """Nothing pushes it, and it does not move by a single bit; neither does anything else."""
    f = falling("triangle", law, gap=gap, stress=0.0)
    contact = uem.Contact(f.high, f.low)
    for _ in uem.load_steps(f.problem(clamp(f.V, f.base), [contact]), 2):
        assert np.abs(f.moved()).max() == 0.0
        assert np.abs(contact.resultant().force).max() == 0.0


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_pulled_away(cell, law):
    g = 2 if cell == "triangle" else 3
    f = falling(cell, law, traction=[0.0] * (g - 1) + [0.02])
    problem = f.problem(clamp(f.V, f.base), [uem.Contact(f.high, f.low)])
    words = r"the body with its middle at \(.*0\.75\) moves along \(.*, 1\) under its loads"
    message = str(raised(uem.FloatingBodyError, words, problem.solve))
    assert "turns" not in message and "Dirichlet" in message
    assert np.abs(f.moved()).max() == 0.0


def test_pulled_off_what_it_rests_on():
    """A body that touches at the start is let go by its load, and nothing is below it any more."""
    f = falling("triangle", gap=0.0, traction=[0.0, 0.02])
    problem = f.problem(clamp(f.V, f.base), [uem.Contact(f.high, f.low)])
    raised(uem.FloatingBodyError, r"the body with.* moves along \(.*, 1\)", problem.solve)
    assert np.abs(f.moved()).max() == 0.0


@pytest.mark.parametrize("law", LAWS)
def test_target_missed_sideways(law):
    """The target ends before the body comes down on it."""
    bodies = [box("quadrilateral", [0.0, -1.0], [1.0, 0.0], [2, 2]), box("quadrilateral", [3.0, 0.5], [4.0, 1.5], [2, 2])]
    f = Falling("quadrilateral", bodies, law)
    f.weigh(0.0, 0.01)
    contact = uem.Contact(f.s.tag("high", 1, at(1, 0.5)), f.s.tag("low", 0, at(1, 0.0)))
    problem = f.problem(clamp(f.V, f.s.tag("base", 0, at(1, -1.0))), [contact])
    raised(uem.FloatingBodyError, r"the body with.* moves along \(.*, -1\)", problem.solve)
    assert np.abs(f.moved()).max() == 0.0


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_sliding_down_a_slope(cell):
    """A rigid slope without friction lets a body slide without end: the message has the direction."""
    g, slope = (2 if cell == "quadrilateral" else 3), 0.5
    n = rotation(g, -slope)[:, -1]
    f = Falling(cell, [box(cell, [0.0] * g, [1.0] * g, [2] * g)], "finite", E=(1.0,), pose=lambda x: x @ rotation(g, -slope).T)
    f.weigh(0.01)
    contact = uem.Contact(f.s.tag("bottom", 0, at(g - 1, 0.0)), uem.RigidPlane([0.0] * g, n))
    message = str(raised(uem.FloatingBodyError, "the body with.* moves along", f.problem((), [contact]).solve))
    way = np.array([float(c) for c in message.split("moves along (")[1].split(")")[0].split(",")])
    # down the slope, of slope 0.5 to the right
    assert way @ (rotation(g, -slope)[:, 0]) == pytest.approx(1.0, abs=0.01)


def test_ball_on_a_slope():
    """A polygon of a ball comes to rest on no side of it."""
    f = Falling("quadrilateral", [half_disc(4)], "finite", E=(1.0,), nu=0.3, pose=lambda x: x + [0.0, 0.1])
    f.weigh(1e-3)
    slope = 0.3
    contact = uem.Contact(f.s.tag("arc", 0, arc()), uem.RigidPlane([0.0, 0.0], [np.sin(slope), np.cos(slope)]))
    raised(uem.FloatingBodyError, "the body with.* moves along", f.problem((), [contact]).solve)
    assert np.abs(f.moved()).max() == 0.0


def test_supports_carry_nothing():
    """A state of statics in which supports carry more than rounding is refused, and the bodies are where they were."""
    f = falling("triangle", traction=[0.0, -0.02])
    problem = f.problem(clamp(f.V, f.base), [uem.Contact(f.high, f.low)])
    end_step = problem.system.floating.end_step
    for carried in (3e-6, 3e-7):

        def carry(carried=carried):
            # a drag holds all bodies meanwhile
            if problem.system.floating.motions is not None:
                problem.system.floating.motions.share = carried
            end_step()

        problem.system.floating.end_step = carry
        if carried > 1e-6:
            raised(uem.FloatingBodyError, "driven sideways by 3e-06 of the forces", problem.solve)
            assert np.abs(f.moved()).max() == 0.0
        else:
            problem.solve()


def test_error_restores_the_committed_state():
    """Pressed in the first step and pulled away in the second: the state is that of the first, and the third can follow it."""
    f = Falling("quadrilateral", [groove(1.5, 1.5), half_disc(4, (0.0, 1.4))], "finite", nu=0.3)
    f.weigh(0.0, 1e-3)
    contact = uem.Contact(f.s.tag("arc", 1, arc((0.0, 1.4))), f.s.tag("groove", 0, in_groove()))
    problem = f.problem(clamp(f.V, f.s.tag("base", 0, at(1, -1.5))), [contact], rtol=1e-10)
    problem.solve()
    first = contact.resultant().force[1]
    before = f.u.x.array.copy(), contact.pair.trial, contact.resultant().force, contact.pressure.x.array.copy()
    f.load.value[1] = 1.0
    raised(uem.FloatingBodyError, "the body with its middle", problem.solve)
    assert np.array_equal(f.u.x.array, before[0])
    assert np.array_equal(contact.pair.trial.lam, before[1].lam) and np.array_equal(contact.pair.trial.active, before[1].active)
    assert np.array_equal(contact.resultant().force, before[2])
    assert np.array_equal(contact.pressure.x.array, before[3])
    f.load.value[1] = -0.5
    problem.solve()
    assert contact.resultant().force[1] == pytest.approx(first / 2, rel=1e-8)
    lawful(contact)
