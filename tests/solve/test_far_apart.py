"""Contacts that are far apart are not looked at, and nothing else depends on that.

Two tests to read first: ``test_what_is_far_apart`` and ``test_a_step_from_afar``.
"""

from __future__ import annotations

import numpy as np
import pytest
from body_scenes import COMM, Discs, close
from falling_scenes import Falling
from helpers import at, blocks, box, clamp, highest, linear, modulus, run
from hypothesis import given
from hypothesis import strategies as some

import uem_dolfinx as uem
from uem_dolfinx.solve.bodies import far_apart
from uem_dolfinx.solve.bodies.far_apart import Boxes, FarApart


def pressed(cell, gap, way, rigid=False, degree=1, **how):
    """A block above another one or above a rigid plane, led down by ``way`` with rollers at its sides."""
    b = blocks(COMM, cell, 2, 4, gap=gap, degree=degree)
    target = uem.RigidPlane(np.zeros(b.gdim), np.eye(b.gdim)[-1]) if rigid else b.low
    F = linear(b.u, modulus(b.scene, 1.0, 1.0))
    return b, uem.UnitedProblem(F, b.u, bcs=b.oedometer(way), contacts=[uem.Contact(b.high, target)], rtol=1e-11, **how)


def far(problem):
    return [pair.far for pair in problem.pairs]


def always_looking(monkeypatch):
    monkeypatch.setattr(far_apart, "_may_be_far", lambda pair: False)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
@pytest.mark.parametrize("degree", [1, 2])
def test_what_is_far_apart(cell, degree):
    """Surfaces are far apart beyond the longest facet of the target; their gap is known all the same."""
    g = 2 if cell == "triangle" else 3
    longest = 0.5 * np.sqrt(g - 1)
    for part, apart in ((0.5, False), (1.5, True)):
        gap = part * longest
        b, problem = pressed(cell, gap, 0.0, degree=degree)
        problem.solve()
        assert far(problem) == [apart]
        (contact,) = problem.contacts
        reported = contact.gap.x.array[contact.gap.x.array > 0]
        assert COMM.allreduce(len(reported)) > 0 and highest(COMM, np.abs(reported - gap)) <= 1e-14


def test_rigid_surfaces_are_far_by_their_distance():
    """What the box around a body is away from a plane counts; a paraboloid's gap is no distance, and it is always looked at."""
    _, problem = pressed("quadrilateral", 0.6, 0.0, rigid=True)
    problem.solve()
    assert far(problem) == [True]
    b, problem = pressed("quadrilateral", 0.4, 0.0, rigid=True)
    problem.solve()
    assert far(problem) == [False]
    b = blocks(COMM, "quadrilateral", 2, 4, gap=9.0)
    bowl = uem.RigidParaboloid((0.5, 0.0), (0.0, -1.0), 1.0)
    problem = uem.UnitedProblem(
        linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(0.1), contacts=[uem.Contact(b.high, bowl)]
    )
    problem.solve()
    assert far(problem) == [False]


@pytest.mark.parametrize("rigid", [False, True])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_a_step_from_afar(cell, rigid, monkeypatch):
    """One step leads a block over three facets into contact: every iteration and displacement is that of contacts always looked at."""
    found = []
    for always in (False, True):
        if always:
            always_looking(monkeypatch)
        b, problem = pressed(cell, 3.0, 3.05, rigid)
        began, begin = [], problem.system.floating.begin_step
        monkeypatch.setattr(
            problem.system.floating, "begin_step", lambda *a: began.append(begin(*a)) or began.append(far(problem))
        )
        (step,) = run(problem)
        assert began[1] == [not always]
        found.append((b.scene.gather(b.u), step.newton_iterations, problem.contacts[0].n_active))
    (u, *one), (v, *other) = found
    assert one == other and one[-1] > 0 and np.abs(u - v).max() <= 1e-12


@pytest.mark.parametrize("degree", [1, pytest.param(2, marks=pytest.mark.slow)])
def test_discs_in_motion(degree, monkeypatch):
    """Discs that fall and collide move as if all pairs were looked at, of which most are not."""
    found, d = [], Discs(1, 5, degree=degree)
    for always in (False, True):
        if always:
            always_looking(monkeypatch)
        problem = d.problem(d.contacts(False))
        steps = [(s.newton_iterations, sum(c.n_active for c in problem.contacts)) for s in uem.time_steps(problem, 0.02, 0.12)]
        found.append((problem.u, steps))
        assert sum(far(problem)) == (0 if always else 6)
    (u, one), (v, other) = found
    assert one == other and any(n for _, n in one)
    close(u, v)


def test_a_fall_onto_what_is_far_away(monkeypatch):
    """A body falls by twenty facets onto another, and past a third, in as many steps as if all were looked at."""
    found = []
    for always in (False, True):
        if always:
            always_looking(monkeypatch)
        bodies = [box("quadrilateral", [0, -1], [1, 0], [2, 2]), box("quadrilateral", [0.1, 10], [0.9, 11], [2, 2])]
        f = Falling("quadrilateral", [*bodies, box("quadrilateral", [4, 4], [5, 5], [2, 2])], E=(1.0, 1.0, 1.0))
        f.weigh(0.0, 1e-3, 0.0)
        tag = f.s.tag
        falling, below = tag("falling", 1, at(1, 10.0)), tag("below", 0, at(1, 0.0))
        side, next_to = tag("side", 1, at(0, 0.9)), tag("beside", 2, at(0, 4.0))
        bcs = [bc for body, y in ((0, -1.0), (2, 4.0)) for c in range(2) for bc in clamp(f.V, tag("foot", body, at(1, y)), c)]
        problem = f.problem(bcs, [uem.Contact(falling, below), uem.Contact(side, next_to)])
        (step,) = run(problem)
        found.append((f.moved(), step.newton_iterations))
        assert problem.contacts[0].resultant().force[1] == pytest.approx(0.8e-3, rel=1e-9)
    (u, one), (v, other) = found
    assert one == other and np.abs(u - v).max() <= 1e-11


def test_contacts_that_are_always_looked_at():
    """Ties, small sliding, mortar and heat need what they see from the start."""
    b = blocks(COMM, "quadrilateral", gap=5.0)
    for how in ({"sliding": "small"}, {"coupling": "mortar"}, {"tied": "after"}):
        contact = uem.Contact(b.high, b.low, **how)
        problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(0.0), contacts=[contact])
        assert not FarApart(problem.config, problem.pairs)._pairs


numbers = some.lists(some.floats(-3, 3), min_size=12, max_size=12)


@given(numbers, some.lists(some.floats(0.0, 1.0), min_size=2, max_size=2))
def test_no_way_is_nearer_than_the_bound(numbers, at):
    """Points of two boxes, and of a box and a circle about the origin, are nowhere nearer on straight paths than the returned distance."""
    x = np.array(numbers).reshape(2, 3, 2)  # before and after: two contactors, one target node
    t, a = at
    low, high = x[:, :2].min(axis=1), x[:, :2].max(axis=1)
    reported = []
    for k in range(2):
        between = np.concatenate([x[k, 2] - high[k], low[k] - x[k, 2]])[None]
        middle = 0.5 * (low[k] + high[k])
        radius = 0.5 * np.linalg.norm(high[k] - low[k])
        reported.append(Boxes(between, middle[None], np.array([radius]), np.array([np.linalg.norm(middle) - 1.0])))
    meshed, rigid = reported[0].apart_until(reported[1])
    contactor = (1 - t) * (x[0, 0] + a * (x[0, 1] - x[0, 0])) + t * (x[1, 0] + a * (x[1, 1] - x[1, 0]))
    target = (1 - t) * x[0, 2] + t * x[1, 2]
    assert np.linalg.norm(contactor - target) >= meshed - 1e-12
    assert np.linalg.norm(contactor) - 1.0 >= rigid - 1e-12
    assert (reported[0].apart <= [np.linalg.norm(x[0, 0] - x[0, 2]) + 1e-12, np.linalg.norm(x[0, 0]) - 1.0 + 1e-12]).all()
