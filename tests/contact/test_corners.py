"""Corners of faceted targets: which facets are one plane, against facets bent by known angles."""

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, blocks, box, clamp, highest, linear, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.contact.nodes.concave_edges import find_corners
from uem_dolfinx.contact.seam.corners import Corners

COMM = MPI.COMM_WORLD


def corner_of_two_facets(slope):
    """The corner that the two facets of a block's top form, one of them rising at a slope."""
    b = blocks(COMM, "triangle", 2, 2, pose=lambda x: x + np.stack([0 * x[:, 0], slope * np.maximum(x[:, 0] - 0.5, 0.0)], axis=1))
    contact = uem.Contact(b.high, b.low, max_penetration=1.0)
    uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])
    target = contact.pair.target
    numbers = np.concatenate(COMM.allgather(target.first[COMM.rank] + np.arange(len(target.dofs))))
    middles = np.concatenate(COMM.allgather(target.facets.config.X[target.dofs].mean(axis=1)))
    left, right = numbers[np.argsort(middles[:, 0])]
    here = np.zeros(1 if COMM.rank == 0 else 0, np.int64)
    points = np.tile([0.5, 0.1], (len(here), 1))
    return find_corners(COMM, target, points, here, np.tile([left, right], (len(here), 1)))


def on_rank_0(value):
    return COMM.bcast(value[0].item() if COMM.rank == 0 else None)


@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_facets_in_one_plane(sign):
    """A bend of 3e-10 is rounding of a plane, one of 3e-9 is a bend, concave or convex."""
    flat, bent = corner_of_two_facets(sign * 3e-10), corner_of_two_facets(sign * 3e-9)
    assert on_rank_0(flat.flat) and not on_rank_0(flat.concave)
    assert not on_rank_0(bent.flat) and on_rank_0(bent.concave) == (sign > 0)


@pytest.mark.parametrize("slope", [0.1, 0.7])
def test_a_corner_is_held_along_both_normals(slope):
    """Pulls are the coefficients of the facets' normals in a force; gaps along the axes vanish at the corner."""
    c = corner_of_two_facets(slope)
    a, b = 2.0, 3.0
    force = a * c.normals[:, 0] + b * c.normals[:, 1]
    assert np.allclose(c.pulls(force), [a, b])
    assert np.allclose(c.gaps(c.foot), 0.0)
    assert on_rank_0(c.rising) == pytest.approx(np.sin(np.arctan(slope)), rel=1e-9)


def vertex_of_three_facets(rise):
    """Three facets that rise from a vertex alike, a third of a turn apart."""
    angle = np.arange(3) * 2 * np.pi / 3
    out = np.column_stack([np.cos(angle), np.sin(angle)])
    away = np.column_stack([out, np.full(3, rise)]) / np.hypot(1.0, rise)
    normals = np.column_stack([-rise * out, np.ones(3)]) / np.hypot(1.0, rise)
    some, nowhere = np.ones(1, bool), np.zeros((1, 3, 0))
    return Corners(
        np.zeros(1, int), np.full(1, 3), some, np.full(1, rise), normals[None], away[None], np.eye(3)[None], np.zeros((1, 3), int),
        np.ones((1, 3)) / 3, np.zeros((1, 3)), np.zeros((1, 3)), np.zeros((1, 3, 3)), nowhere, np.zeros((1, 3, 0, 0)),
    )  # fmt: skip


@pytest.mark.parametrize("slope", [0.1, 0.7])
def test_friction_in_an_edge(slope):
    """The facet that a contactor came over bears what its cone holds; beyond it friction is at its limit on both."""
    c, mu = corner_of_two_facets(slope), np.array([0.3] * (COMM.rank == 0))
    first = np.zeros(len(mu), np.int64)
    (a, b), (t, s) = c.normals.transpose(1, 0, 2)[:2], c.away.transpose(1, 0, 2)[:2]
    for push in (-0.3, -0.1, 0.2, 0.3):
        assert np.allclose(c.friction(2 * a + 2 * push * t, mu, first), 2 * push * t, atol=1e-14)
    # driven over the first facet, which leads away from the corner to the rear
    tau = 0.3 * (2 * t - 3 * s)
    assert np.allclose(c.friction(2 * a + 3 * b + tau, mu, first), tau)
    # and over the other one
    assert np.allclose(c.friction(2 * b + 0.6 * s, mu, first + 1), 0.6 * s)


def test_friction_in_a_vertex():
    """Of three facets those bear that must: the first alone within its cone, two or all beyond it."""
    c, mu, first = vertex_of_three_facets(0.2), np.array([0.3]), np.array([0])
    n, away = c.normals[0], c.away[0]
    leaning = 0.3 * np.array([[0.0, 1.0, 0.0]])
    assert np.allclose(c.friction(n[:1] + leaning, mu, first), leaning)
    for second, third in ((1.0, 0.0), (1.0, 0.7)):
        force = 2 * n[0] + 0.6 * away[0] + second * (n[1] - 0.3 * away[1]) + third * (n[2] - 0.3 * away[2])
        tau = c.friction(force[None], mu, first)[0]
        pressed = np.linalg.solve(n.T, force - tau)
        assert (pressed >= -1e-12).all() and tau @ away[0] > 0
        # what the others have none of is in the first facet's plane, and at its limit
        rest = tau + 0.3 * (pressed[1] * away[1] + pressed[2] * away[2])
        assert np.linalg.norm(rest) == pytest.approx(0.3 * pressed[0]) and abs(rest @ n[0]) <= 1e-14


@pytest.mark.parametrize("slope", [1e-6, 0.1, 0.7])
def test_rubbing_into_a_corner(slope):
    """A contactor came over one facet with all that pushes it along that facet's normal, friction aside."""
    c = corner_of_two_facets(slope)
    none = np.zeros((len(c.which), 2))
    for first, other in ((0, 1), (1, 0)):
        n, way = c.normals[:, first], -0.3 * c.away[:, first]
        force = 2.0 * n + 3.0 * c.normals[:, other]
        place = np.full(len(c.which), first)
        expected = 0.3 * (2.0 + 3.0 * np.cos(np.arctan(slope)))
        assert np.allclose(c.rubbing(force, none, way, place), expected, rtol=1e-12)
        assert np.allclose(c.rubbing(force - 0.4 * way, -0.4 * way, way, place), expected, rtol=1e-12)
        # a way into the other facet is none along the first
        assert np.allclose(c.rubbing(force, none, way - 0.1 * n, place), expected, rtol=1e-12)
        assert np.allclose(c.rubbing(-force, none, way, place), 0.0)


def test_rubbing_along_edges():
    """Along an edge both facets that meet there are slid over; a third one, met at its end, is not."""
    walls = vertex_of_three_facets(np.sqrt(2.0))
    n = walls.normals[0]
    assert np.allclose(n @ n.T, np.eye(3))
    force, none, first = (2 * n[0] + 3 * n[1] + 5 * n[2])[None], np.zeros((1, 3)), np.array([0])
    assert walls.rubbing(force, none, -0.1 * n[2:], first)[0] == pytest.approx(0.1 * (2 + 3))
    assert walls.rubbing(force, none, -0.1 * n[1:2], first)[0] == pytest.approx(0.1 * (2 + 5))
    # over the first facet alone, not along an edge: the other two have a part of the way each
    way = -0.1 * (n[1] + n[2])[None]
    assert walls.rubbing(force, none, way, first)[0] == pytest.approx(2 * 0.1 * np.sqrt(2) + 0.1 * (3 + 5))


def test_which_facet_a_contactor_came_over():
    """The one that it was on; from farther away the one that leads there."""
    c = corner_of_two_facets(0.7)
    facets = np.tile([4, 7], (len(c.which), 1))
    for first in (0, 1):
        way = -c.away[:, first]
        for before, expected in ((4, 0), (7, 1), (9, first), (-1, first)):
            assert (c.slid_over(np.full(len(way), before), facets, way) == expected).all()


@pytest.mark.long
@pytest.mark.parametrize("degree, friction", [(1, 0.0), (1, 0.2), pytest.param(2, 0.0, marks=pytest.mark.slow)])
def test_a_concave_edge_that_ends_with_its_target(degree, friction):
    """A ridge is pushed along a groove and out of it: contactors that have passed its end carry nothing, moments balance."""
    low, high = (box("hexahedron", [0, 0, z], [1, 1, z + 1.0], [n, 2, 2]) for z, n in ((-1.0, 5), (0.0, 4)))

    def pose(x):
        return x + np.outer(0.4 * np.abs(x[:, 1] - 0.5) * (1 - np.abs(x[:, 2])), [0.0, 0.0, 1.0])

    s = scene(COMM, "hexahedron", [low, high], pose=pose)
    V = compat.function_space(s.mesh, degree, (3,))
    u = fem.Function(V)
    bcs = [*clamp(V, s.tag("bottom", 0, at(2, -1.0))), *clamp(V, s.tag("top", 1, at(2, 1.0)), value=[0.45, 0, -1e-2])]
    contact = uem.Contact(s.tag("high", 1, at(2, 0.0)), s.tag("low", 0, at(2, 0.0)), friction=friction)
    problem, held, steps = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact]), [], 12
    for _ in uem.load_steps(problem, steps):
        held.append(COMM.allreduce(int(contact.pair.trial.in_corner.sum())))
        x = problem.config.x[contact.pair.nodes, 0]
        assert highest(COMM, x[contact.pair.trial.active]) <= 1.0 + 0.1 / 5 + 1e-3
        balance = contact.balance()
        assert balance.force <= 1e-14 and balance.moment <= 1e-10
    assert len(held) == steps and held[0] > held[-1] > 0


@pytest.mark.slow
def test_blocks_of_equal_width_pushed_aside():
    """Contactors past the end, between two facets whose ends bulge, are held where they stand: the moment is zero to rounding."""
    b = blocks(COMM, "hexahedron", 4, 5, degree=2)
    contact = uem.Contact(b.high, b.low)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[1e-3, 0.0, -1e-2])]
    uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact]).solve()
    assert contact.balance().moment <= 1e-13
