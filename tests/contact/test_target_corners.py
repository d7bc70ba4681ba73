"""Convex corners of a target that enter the contactors' facets, where nodes do not see them: warnings with the place, and of no others.

Worth reading first: ``test_corners_that_are_warned_of`` and ``test_harmless_scenes``.
"""

from __future__ import annotations

import re

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import Body, at, blocks, box, clamp, linear, modulus, run, scene, slow
from pointed_scenes import ironing, neo_hooke, pressed, punch, slot, tooth, wedge

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.warnings import target_corners
from uem_dolfinx.contact.warnings.target_corners import corner_nodes

COMM = MPI.COMM_WORLD


def reported(caplog):
    """Warnings of corners on rank 0, on all ranks."""
    return COMM.bcast([r.getMessage() for r in caplog.records if "a convex corner of the target" in r.getMessage()])


def place(message):
    """The corner that a message names."""
    return [float(number) for number in re.search(r"at \((.*?)\)", message)[1].split(",")]


TOLD = [
    *(
        (wedge, {"slope": slope, "off": off, "law": neo_hooke})
        for slope, off in ((0.2, 0.5), (0.5, 0.25), (1.0, 0.3), (2.0, 0.5))
    ),
    (wedge, {"slope": 0.5, "degree": 2}),
    (wedge, {"slope": 0.5, "friction": 0.3, "sliding": "small", "size": 1e-3}),
    (wedge, {"slope": 0.7, "g": 3, "n": 6}),
    *((tooth, {"angle": angle, "law": neo_hooke}) for angle in (0.2, 0.6, 1.0)),
    (tooth, {"friction": 0.3, "size": 1e3}),
    (slot, {}),
    (slot, {"n": 13, "law": neo_hooke}),
    (punch, {"w": 0.495}),
    (punch, {"closed": False}),
]


@pytest.mark.parametrize("make, how", TOLD, ids=[f"{make.__name__}-{k}" for k, (make, _) in enumerate(TOLD)])
def test_corners_that_are_warned_of(make, how, caplog):
    """Once, with contact and place; not where they are the contactors'."""
    (problem, *_), tips = make(**how)
    run(problem, 2)
    (message,) = reported(caplog)
    assert message.startswith("pair: ") and "swap the two" in message and "mortar" in message
    assert min(abs(place(message)[0] - how.get("size", 1.0) * tip) for tip in tips) < 1e-5 * how.get("size", 1.0)
    if make is wedge and how["slope"] == 0.5:
        caplog.clear()
        (problem, *_), _ = make(**how, swap=True)
        run(problem, 2)
        assert not reported(caplog)


def test_corners_under_mortar_are_seen(caplog):
    (problem, contact, _), _ = wedge(coupling="mortar")
    run(problem, 2)
    assert contact.n_active and not reported(caplog)


def flat(swap, n, overhang=0.0):
    """Block on block, the lower as wide or wider."""
    b = blocks(COMM, "quadrilateral", *n, overhang=overhang)
    contact = uem.Contact(*((b.low, b.high) if swap else (b.high, b.low)))
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=(0.0, -0.05))]
    return uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact])


def roll(n, swap):
    """Half a disc on a block."""

    def bend(x):
        a = np.pi * (1 + x[:, 1])
        return np.column_stack([x[:, 0] * np.cos(a), 1 + x[:, 0] * np.sin(a)])

    low, disc = box("quadrilateral", [-1.0, -1.0], [1.0, 0.0], [17, 8]), box("quadrilateral", [0.3, 0.0], [1.0, 1.0], [4, n])
    round_ = (1, lambda x: np.abs(np.hypot(x[:, 0], x[:, 1] - 1) - 1) < 1e-9)
    led = (1, at(1, 1.0), [0.0, -0.02])
    return pressed([low, disc.mapped(bend)], ([round_], [(0, at(1, 0.0))]), led, (1.0, 1.0), swap=swap)[0]


HARMLESS = {
    "edges on a wider block": lambda: flat(False, (4, 5), 0.25),
    "finer edges on a wider block": lambda: flat(False, (3, 8), 0.25),
    "same width": lambda: flat(False, (4, 5)),
    "same width, coarser contactor": lambda: flat(True, (4, 5)),
    "same nodes": lambda: flat(True, (4, 4)),
    "disc": lambda: roll(40, False),
    "disc as target": lambda: roll(40, True),
}


@pytest.mark.parametrize("name", HARMLESS)
def test_harmless_scenes(name, caplog):
    problem = HARMLESS[name]()
    run(problem)
    assert problem.contacts[0].n_active and not reported(caplog)


@pytest.mark.long
def test_a_corner_that_is_dragged(caplog):
    """Without friction the drag vanishes; the slab's nodes leave some, and a warning says why. The die's nodes, with mortar, do not."""
    assert np.abs(ironing(1)).max() > 0.08 and len(reported(caplog)) == 1
    caplog.clear()
    assert np.abs(ironing(1, swap=True, coupling="mortar")).max() < 0.03 and not reported(caplog)


def shallow(press, swap):
    """Shallow ironing on coarse meshes (after Fischer and Wriggers, 2006): a die with slanting sides in a slab, without friction."""
    w, x0 = 0.6, 2.013

    def slant(x):
        return np.column_stack([x[:, 0] * (1 + 1.33 * x[:, 1] / w) + x0, x[:, 1]])

    slab = box("quadrilateral", [0.0, -3.0], [12.0, 0.0], [24, 6])
    die = box("quadrilateral", [-w, 0.0], [w, 0.75], [4, 3]).mapped(slant)

    def face(x):
        return (np.abs(x[:, 1]) < 1e-9) | (np.abs(np.abs(x[:, 0] - x0) - w - 1.33 * x[:, 1]) < 1e-9)

    led = (1, at(1, 0.75), [0.0, -press])
    how = {"law": neo_hooke, "swap": swap, "coupling": "mortar"}
    return pressed([slab, die], ([(0, at(1, 0.0))], [(1, face)]), led, (1.0, 10.0), **how)


@pytest.mark.slow
@pytest.mark.parametrize("press, swap, drag, steps", [(0.6, True, 0.4, 4), (1.0, True, 0.4, 4), (1.0, False, 1.0, 10)])
def test_shallow_ironing(press, swap, drag, steps):
    """Corners that jump from facet to facet, at limit points of the path, and dual functions at the target's end: no step is cut."""
    problem, contact, prescribed = shallow(press, swap)
    run(problem, 5)
    prescribed.value[:] = (drag, -press)
    made = [(step.cuts, len(step.iterations) - 1, contact.resultant().force) for step in uem.load_steps(problem, steps)]
    assert not any(cuts for cuts, _, _ in made) and np.mean([k for _, k, _ in made]) <= 10
    # the drag of a frictionless surface vanishes in the mean
    assert abs(np.mean([force[0] / force[1] for _, _, force in made])) < 0.15


def test_errors_name_the_corner():
    """Where steps are cut to the end, with place and remedy, and without the advice of smaller steps."""
    for (make, how), corner in (((wedge, {}), True), ((wedge, {"swap": True}), False)):
        (problem, _, prescribed), _ = make(**how, law=neo_hooke)
        run(problem, 2)
        problem.max_iterations = 1
        prescribed.value[:] = (0.3, -0.15)
        with pytest.raises(uem.ConvergenceError, match=r"no convergence in 1 iterations") as caught:
            run(problem)
        assert ("a convex corner of the target, at (0.0625, " in str(caught.value)) is corner
        assert "take smaller" not in str(caught.value) and "shorter steps, down to 0.000977, are no better" in str(caught.value)
        assert len(set(COMM.allgather(str(caught.value)))) == 1


@pytest.mark.parametrize(
    "text, left",
    [
        ("it fails: take smaller load steps", "it fails"),
        ("it fails; take smaller load steps, or raise it", "it fails; raise it"),
        ("it fails: take smaller load steps or a finer mesh", "it fails: take a finer mesh"),
        ("look at it, or take smaller load steps", "look at it"),
        ("look at it", "look at it"),
    ],
)
def test_advice_that_does_not_help(text, left):
    error = uem.ConvergenceError(text)
    error.amend("more")
    assert str(error) == f"{left}; more"


@pytest.mark.parametrize("slope, cosine, expected", [(0.5, None, 1), (0.5, 0.1, 0), (0.05, None, 0), (0.05, 0.9995, 1)])
def test_what_is_a_corner(slope, cosine, expected, monkeypatch):
    """The wedge's tip, besides the ends of its surface; smooth surfaces have none."""
    monkeypatch.setattr(target_corners, "CORNER", cosine or target_corners.CORNER)
    (problem, contact, _), _ = wedge(slope=slope)
    nodes = corner_nodes(problem.config, contact.pair.target.facets)
    assert COMM.allreduce(len(nodes)) == 2 + expected
    assert COMM.allreduce(int((np.abs(problem.config.X[nodes, 0] - 0.0625) < 1e-9).sum())) == expected


@pytest.mark.parametrize(
    "name, how, moved",
    [
        ("LACKING", {"w": 0.495}, {1: 1, 10: 0}),
        ("LACKING", {"w": 0.472, "n": 32}, {1: 0, 0.1: 1}),
        ("ON_FACET", {"w": 0.495, "push": 5e-9}, {1: 1, 10: 0}),
        ("ON_FACET", {"w": 0.495, "push": 1e-9}, {1: 0, 0.1: 1}),
    ],
)
def test_what_a_warning_of_corners_contains(name, how, moved, monkeypatch):
    """Corners that are deep enough in their facet, and by which enough of the force is lacking."""
    (problem, contact, _), _ = punch(**how)
    run(problem)
    value = getattr(target_corners, name)
    for factor, expected in moved.items():
        monkeypatch.setattr(target_corners, name, factor * value)
        assert len(problem.watch.corners_inside([contact], problem.bodies.stiffness)) == expected


@pytest.mark.parametrize("both", [False, True])
def test_corners_on_both_sides_are_not_swapped(both):
    """Where the contactor has corners in contact, too, the other side does not see them either: mortar alone is advised."""
    words = str(target_corners.CornerInside("(0, 0)", 0.1, 0.2, 0.3, both))
    assert ("swap the two" in words) != both and "take coupling = 'mortar'" in words


def turning_plug(m, springs, swap):
    """A plug of m facets in a hole with vertices opposite its own, larger by a hundredth; the plug is the target if swapped."""

    def ring(low, high, n):
        b = box("quadrilateral", [low, 0.0], [high, 2.0 * np.pi], [n, m])
        x = np.column_stack([b.x[:, 0] * np.cos(b.x[:, 1]), b.x[:, 0] * np.sin(b.x[:, 1])])
        _, first, inverse = np.unique(np.round(x, 9), axis=0, return_index=True, return_inverse=True)
        return Body(x[first], inverse.ravel()[b.cells])

    s = scene(COMM, "quadrilateral", [ring(1.0, 2.0, 4), ring(0.5, 1.01, 2)])
    u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
    own, hole = (
        s.tag(name, b, lambda x, r=r: np.abs(np.hypot(*x.T) - r) < 1e-6) for name, b, r in (("plug", 1, 1.01), ("hole", 0, 1.0))
    )
    contact = uem.Contact(*((hole, own) if swap else (own, hole)), max_penetration=0.2)
    F = neo_hooke(u, 1.0) + springs * ufl.dot(u, ufl.TestFunction(u.function_space)) * ufl.dx
    return uem.UnitedProblem(F, u, contacts=[contact]), contact


@pytest.mark.parametrize(
    "m, swap, factor, expected",
    [(24, True, 1, 1), (24, False, 1, 0), slow(48, True, 1, 1), slow(24, True, 10, 1), slow(24, True, 100, 0)],
)
def test_a_polygon_that_turns_in_its_hole(m, swap, factor, expected, caplog, monkeypatch):
    """As target it turns until its vertices meet middles of facets, almost free of force, which is named; as contactor it does not."""
    monkeypatch.setattr(target_corners, "LACKING_AT_VERTICES", factor * target_corners.LACKING_AT_VERTICES)
    problem, _ = turning_plug(m, 1e-4, swap)
    run(problem)
    assert len(reported(caplog)) == expected
    assert all("swap the two" in message and "corners = True" not in message for message in reported(caplog))
