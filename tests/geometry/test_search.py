"""The vectorised, distributed projection against ten-line loops that look at every facet.

Two tests to read first: ``test_projection_is_the_nearest_of_all_facets`` compares the whole search with the loop, on any number of
ranks, and ``test_ranks_see_what_one_rank_sees`` compares the distributed search with a serial one.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, box, highest, scene
from hypothesis import given, settings
from hypothesis import strategies as st

from uem_dolfinx import compat
from uem_dolfinx.geometry.candidates import candidate_pairs
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.shapes import closest_point, unit_normals

COMM = MPI.COMM_WORLD
EPS = np.finfo(float).eps


# -- a surface -------------------------------------------------------------------------------------------------------------


def bump(x):
    """Curve the top of a unit box, the more the higher."""
    y = x.copy()
    y[:, -1] += 0.2 * x[:, -1] * np.sin(3 * x[:, 0]) * np.cos(2 * x[:, -2 if x.shape[1] == 3 else 0])
    return y


def grade(x):
    """Concentrate the nodes at x = 0: the longest facet is thousands of times the shortest."""
    y = x.copy()
    y[:, 0] = x[:, 0] ** 4
    return y


def surface(cell, comm=COMM, degree=1, n=6, pose=bump, averaged=False):
    """Top of a box as a target, and its configuration."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    s = scene(comm, cell, [box(cell, [0.0] * g, [1.0] * g, [n] * g)], pose=pose)
    u = fem.Function(compat.function_space(s.mesh, degree, (g,)))
    config = Configuration(u)
    return s, config, MeshTarget(TargetFacets(config, s.tag("top", 0, at(g - 1, 1.0))), averaged=averaged)


def all_facets(target):
    """Node positions, global nodes and outward normals at the middle of every facet of the surface, in the order of their numbers."""
    f = target.facets
    x = f.config.x[f.dofs]
    tab = f.shape.tabulate(np.tile(f.shape.middle, (len(x), 1)))
    parts = target.comm.allgather((x, f.nodes, unit_normals(tab, x) * f.sign[:, None] if len(x) else np.zeros(x.shape[::2])))
    return (np.concatenate([p[k] for p in parts]) for k in range(3))


def points_about(g, n, seed):
    """Points above, below and at the side of the unit box's top; each rank has its own."""
    rng = np.random.default_rng(seed + 100 * COMM.rank)
    return rng.uniform(-0.3, 1.3, (n + 3 * COMM.rank, g))


SURFACES = [("triangle", 1), ("quadrilateral", 2), ("tetrahedron", 1), ("hexahedron", 1), ("tetrahedron", 2), ("hexahedron", 2)]


@pytest.mark.parametrize("cell,degree", SURFACES)
def test_projection_is_the_nearest_of_all_facets(cell, degree):
    _, config, target = surface(cell, degree=degree, n=4)
    points = points_about(config.gdim, 40, 1)
    p = target.project(points)
    x, nodes, _ = all_facets(target)
    for i, point in enumerate(points):
        d2 = closest_point(target.shape, x, np.tile(point, (len(x), 1)))[1]
        assert np.linalg.norm(p.foot[i] - point) == pytest.approx(np.sqrt(d2.min()), abs=1e-14)
        assert np.sqrt(d2[p.facet[i]]) == pytest.approx(np.sqrt(d2.min()), abs=1e-14)
        assert np.array_equal(p.nodes[i], nodes[p.facet[i]])
        assert np.allclose(p.weights[i] @ x[p.facet[i]], p.foot[i], atol=1e-15)
    assert np.abs(p.weights.sum(axis=1) - 1).max() < 1e-14


@pytest.mark.parametrize("cell,degree", SURFACES)
@pytest.mark.parametrize("averaged", [False, True])
def test_ranks_see_what_one_rank_sees(cell, degree, averaged):
    points = points_about(2 if cell in ("triangle", "quadrilateral") else 3, 400, 2)
    _, _, target = surface(cell, degree=degree, averaged=averaged)
    _, _, serial = surface(cell, MPI.COMM_SELF, degree=degree, averaged=averaged)
    p, q = target.project(points), serial.project(points)
    for field in ("gap", "normal", "foot", "averaged", "beyond"):
        assert highest(COMM, np.abs(getattr(p, field) - getattr(q, field))) < 1e-12, field


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "tetrahedron", "hexahedron"])
def test_normals_point_out_and_gaps_have_a_sign(cell):
    _, _, target = surface(cell)
    x, _, normals = all_facets(target)
    middle = np.einsum("a,nag->ng", target.shape.tabulate(target.shape.middle[None]).N[0], x)
    assert (normals[:, -1] > 0).all()
    for height in (0.01, 0.0, -0.01):
        p = target.project(middle + height * normals)
        assert np.abs(p.gap - height).max() < 1e-13
        assert np.abs(p.normal - normals).max() < 1e-10


@pytest.mark.parametrize("cell", ["triangle", "tetrahedron", "hexahedron"])
def test_points_on_vertices_and_sides(cell):
    """Exactly on a shared vertex or side the gap is zero to the last bits and the normal that of all facets around."""
    _, config, target = surface(cell)
    x, nodes, _ = all_facets(target)
    corners = x.reshape(-1, config.gdim)
    p = target.project(corners)
    assert np.abs(p.gap).max() <= 4 * EPS
    assert np.linalg.norm(p.foot - corners, axis=1).max() <= 4 * EPS
    # the corners of a facet, each with its two neighbours on the rim
    rim = {"triangle": [(0, 1), (1, 0)], "tetrahedron": [(0, 1, 2), (1, 2, 0), (2, 0, 1)]}.get(
        cell, [(0, 1, 2), (1, 3, 0), (2, 0, 3), (3, 2, 1)]
    )
    for k in np.unique(nodes):
        total = np.zeros(config.gdim)
        for f in np.flatnonzero((nodes == k).any(axis=1)):
            edges = [x[f, i] - x[f, r[0]] for r in rim if nodes[f, r[0]] == k for i in r[1:]]
            normal = np.array([edges[0][1], -edges[0][0]]) if config.gdim == 2 else np.cross(*edges)
            total += normal * np.sign(normal[-1])
        here = np.flatnonzero(nodes.reshape(-1) == k)
        assert np.abs(p.normal[here] - total / np.linalg.norm(total)).max() < 1e-13
    # equal places have equal answers, whichever facet they came from
    for k in np.unique(nodes):
        same = np.flatnonzero(nodes.reshape(-1) == k)
        assert np.ptp(p.normal[same], axis=0).max() == 0.0
        assert np.ptp(p.facet[same]) == 0
    if config.gdim == 3:
        on = 0.5 * (x[:, 0] + x[:, 1])
        p = target.project(on)
        assert np.abs(p.gap).max() <= 4 * EPS
        assert np.linalg.norm(p.foot - on, axis=1).max() <= 4 * EPS


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_averaged_normals_are_continuous(cell):
    """Across a facet's side the facet's normal jumps, the averaged one does not; on a sphere it is nearly radial."""
    _, config, target = surface(cell, averaged=True)
    _, _, plain = surface(cell)
    x, _, _ = all_facets(target)
    g = config.gdim
    inner = x[:, 0][(np.abs(x[:, 0, 0] - 0.5) < 0.3)]
    if g == 3:
        inner = inner[np.abs(inner[:, 1] - 0.5) < 0.3]
    step = np.eye(g)[0] * 1e-7
    jump = np.linalg.norm(target.project(inner + step).normal - target.project(inner - step).normal, axis=1)
    assert jump.max() < 1e-5
    assert np.linalg.norm(plain.project(inner + step).normal - plain.project(inner - step).normal, axis=1).max() > 1e-2


def test_past_an_open_end():
    """Past the end of a flat surface ``beyond`` is the tangential distance; above it, zero."""
    _, config, target = surface("triangle", pose=lambda x: x)
    p = target.project(np.array([[1.3, 1.2], [-0.2, 0.9], [0.4, 1.5]]))
    assert np.allclose(p.beyond, [[0.3, 0.0], [-0.2, 0.0], [0.0, 0.0]], atol=1e-15)
    assert np.allclose(p.gap, [0.2, -0.1, 0.5], atol=1e-15)
    assert np.allclose(p.foot, [[1.0, 1.0], [0.0, 1.0], [0.4, 1.0]], atol=1e-15)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_on_a_named_facet(cell):
    """``project_on`` stays on the given facet, however far that is."""
    _, config, target = surface(cell)
    x, nodes, _ = all_facets(target)
    points = points_about(config.gdim, 20, 4)
    facet = np.random.default_rng(5 + COMM.rank).integers(0, len(x), len(points))
    p = target.project_on(points, facet)
    assert np.array_equal(p.facet, facet)
    assert np.array_equal(p.nodes, nodes[facet])
    for i, f in enumerate(facet):
        _, d2 = closest_point(target.shape, x[f : f + 1], points[i : i + 1])
        assert np.linalg.norm(p.foot[i] - points[i]) == pytest.approx(np.sqrt(d2[0]), abs=1e-14)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_following_keeps_foot_and_normal(cell):
    """Small sliding: the old weights of the moved nodes, the old normal."""
    _, config, target = surface(cell)
    points = points_about(config.gdim, 20, 6)
    old = target.project(points)
    config.displacement[:] = 0.1 * np.sin(5 * config.X)
    moved = points + 0.03
    x, _, _ = all_facets(target)
    p = target.follow(moved, old)
    foot = np.einsum("na,nag->ng", old.weights, x[old.facet])
    assert np.abs(p.foot - foot).max() < 1e-15
    assert np.array_equal(p.normal, old.normal)
    assert np.abs(p.gap - np.einsum("ng,ng->n", old.normal, moved - foot)).max() < 1e-15
    assert np.abs(p.weights - old.weights).max() < 1e-15


def test_current_configuration():
    """The search sees where the target is now, not where it was."""
    _, config, target = surface("hexahedron", pose=lambda x: x)
    config.displacement[:] = [0.25, 0.0, -0.5]
    p = target.project(np.array([[0.5, 0.5, 1.0]]))
    assert np.allclose(p.foot, [[0.5, 0.5, 0.5]], atol=1e-15) and p.gap[0] == pytest.approx(0.5, abs=1e-15)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_graded_surface(cell):
    """Facets of very different sizes: still the nearest, and not by trying them all."""
    n = 60 if cell == "triangle" else 16
    _, config, target = surface(cell, MPI.COMM_SELF, n=n, pose=grade)
    x, _, _ = all_facets(target)
    rng = np.random.default_rng(8)
    points = rng.random((400, config.gdim))
    points[:, 0] **= 4
    points[:, -1] = 1 + 0.01 * points[:, -1] * points[:, 0]
    pairs, facets = candidate_pairs(target.shape, x, points)
    assert len(pairs) < 0.3 * len(points) * len(x)
    p = target.project(points)
    for i in range(0, 400, 9):
        _, d2 = closest_point(target.shape, x, np.tile(points[i], (len(x), 1)))
        assert np.linalg.norm(p.foot[i] - points[i]) == pytest.approx(np.sqrt(d2.min()), abs=1e-15)
        assert d2[facets[pairs == i]].min() == d2.min()


@settings(max_examples=15, deadline=None, derandomize=True)
@given(st.integers(0, 10**6), st.sampled_from(["triangle", "hexahedron"]))
def test_any_cloud_on_any_number_of_ranks(seed, cell):
    """Random clouds, one of them far away, one rank without points."""
    _, config, target = surface(cell, n=3)
    g = config.gdim
    rng = np.random.default_rng(seed)
    cloud = rng.normal(size=(3 * COMM.size, g)) * 10.0 ** rng.integers(-2, 3)
    mine = cloud[COMM.rank :: COMM.size] if COMM.rank else cloud[:0]
    p = target.project(mine)
    x, _, _ = all_facets(target)
    for i, point in enumerate(mine):
        _, d2 = closest_point(target.shape, x, np.tile(point, (len(x), 1)))
        assert np.linalg.norm(p.foot[i] - point) == pytest.approx(np.sqrt(d2.min()), rel=1e-13, abs=1e-14)


def test_empty_request():
    """No rank has a point."""
    _, config, target = surface("tetrahedron", n=2)
    p = target.project(np.zeros((0, 3)))
    assert p.gap.shape == (0,) and p.nodes.shape == (0, 3)
    p.hessians(np.zeros(0, np.int64))
    target.follow(np.zeros((0, 3)), p)
