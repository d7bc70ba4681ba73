"""Thresholds of the search from both sides, and bounds of curved facets against samples of them."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from dolfinx.mesh import locate_entities_boundary
from helpers import at, box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry import candidates
from uem_dolfinx.geometry.candidates import candidate_pairs
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.search import MeshTarget, _nearest
from uem_dolfinx.geometry.shapes import facet_shape


def roof(depth, averaged=False):
    """Target of two facets that rise by ``depth`` over a width of 1 to a ridge at the origin, on this rank alone."""
    x = np.array([[0.0, 0.0], [-1.0, -depth], [0.0, -2.0], [1.0, -depth]])
    mesh = compat.create_mesh(MPI.COMM_SELF, np.array([[0, 1, 2], [0, 2, 3]]), x, "triangle", 1)
    config = Configuration(fem.Function(compat.function_space(mesh, 1, (2,))))
    top = locate_entities_boundary(mesh, 1, lambda x: np.abs(x[1] + depth * np.abs(x[0])) < 1e-9)
    assert len(top) == 2
    return MeshTarget(TargetFacets(config, uem.Tag("roof", 1, 1, mesh, np.sort(top))), averaged)


@pytest.mark.parametrize("distance, on_side", [(3e-11, True), (3e-10, False)])
def test_points_on_a_side(distance, on_side):
    """At the ridge the normal is the mean of two; apart from it along a facet, or above it, it is a facet's own."""
    target, length = roof(1.0), np.sqrt(2.0)
    along, mean = np.array([1.0, -1.0]) / length, np.array([0.0, 1.0])
    for point in (distance * length * along, distance * length * mean):
        normal = target.project(point[None]).normal[0]
        assert np.allclose(normal, mean if on_side else [np.copysign(1 / length, normal[0]), 1 / length], atol=1e-6)


@pytest.mark.parametrize("lean, along_normal", [(0.3, True), (0.033, False)])
def test_gap_along_a_leaning_normal(lean, along_normal):
    """Over a sharp ridge the gap along the averaged normal is the distance; over a knife's edge that from the facet's plane."""
    target = roof(np.sqrt(1 / lean**2 - 1), averaged=True)
    p = target.project(np.array([[0.0, 0.01]]))
    assert np.allclose(p.normal, [[0.0, 1.0]], atol=1e-12)
    assert p.gap[0] == pytest.approx(0.01 if along_normal else 0.01 * lean, rel=1e-9)


@pytest.mark.parametrize("apart, alike", [(3e-10, True), (3e-9, False)])
def test_facets_equally_near(apart, alike):
    """Of facets equally near the one over which the point is higher counts, of equal heights the first."""
    pair, number = np.zeros(2, np.int64), np.arange(2)
    for distance in (1e-3, 1.0, 1e3):
        far = distance * np.array([1.0, 1.0 + apart])
        assert _nearest(pair, far, distance * np.array([0.1, 0.5]), number, 0.0)[0] == (1 if alike else 0)
        high = distance * np.array([0.5, 0.5 + apart])
        assert _nearest(pair, np.full(2, distance), high, number, 0.0)[0] == (0 if alike else 1)


@pytest.mark.parametrize("height, reported", [(0.2, True), (0.05, False)])
def test_points_past_an_end(height, reported):
    """Below a fold and past its end, the plane that is farther counts; where it is past the end rather than below, neither does."""
    upward = set()
    for side in (-1, 1):

        def fold(x, side=side):
            return x + np.outer(np.maximum(side * (x[:, 0] - 1), 0.0), [0.0, 0.0, 1.0])

        s = scene(MPI.COMM_SELF, "tetrahedron", [box("tetrahedron", [0.0, 0.0, -1.0], [2.0, 1.0, 0.0], [2, 1, 1])], pose=fold)
        config = Configuration(fem.Function(compat.function_space(s.mesh, 1, (3,))))
        target = MeshTarget(TargetFacets(config, s.tag("top", 0, at(2, 0.0))))
        p = target.project(np.array([[1.0, -0.01, -0.01 * height]]))
        assert np.allclose(p.foot, [[1.0, 0.0, 0.0]], atol=1e-12)
        upward.add(round(float(target.outward(p)[0, 2]), 9))
    assert (upward == {1.0}) == reported


def inside(cell, n=60):
    """Reference points of a facet, its nodes' Lebesgue function among them where it is largest."""
    s = np.linspace(0.0, 1.0, n + 1)
    if cell == "interval":
        return s[:, None]
    xi = np.stack(np.meshgrid(s, s), axis=-1).reshape(-1, 2)
    return xi[xi.sum(axis=1) <= 1 + 1e-12] if cell == "triangle" else xi


@pytest.mark.parametrize("cell", ["interval", "triangle", "quadrilateral"])
@pytest.mark.parametrize("degree", [1, 2])
def test_curved_facets_are_within_their_bounds(cell, degree):
    """The largest sum of shape functions' sizes is what bounds boxes and discs around curved facets; no facet leaves them."""
    shape = facet_shape(cell, degree)
    N = shape.tabulate(inside(cell)).N
    assert np.abs(N).sum(axis=1).max() == pytest.approx(shape.lebesgue, rel=1e-12)
    values = np.random.default_rng(0).uniform(size=(N.shape[1], 1000))
    out = 0.5 * (shape.lebesgue - 1) * np.ptp(values, axis=0)
    assert (N @ values >= values.min(axis=0) - out - 1e-12).all() and (N @ values <= values.max(axis=0) + out + 1e-12).all()
    # the worst of all reaches the bound
    worst = np.where(N[np.abs(N).sum(axis=1).argmax()] > 0, 1.0, 0.0)
    assert (N @ worst).max() == pytest.approx(1 + 0.5 * (shape.lebesgue - 1))


@pytest.mark.parametrize("at_once", [0, candidates.ALL_PAIRS])
@pytest.mark.parametrize("cell", ["interval", "triangle", "quadrilateral"])
def test_no_facet_is_forgotten(cell, at_once, monkeypatch):
    """Facets as wild as they can be: the candidates of a point hold the facet that is nearest by samples, of many and of few."""
    monkeypatch.setattr(candidates, "ALL_PAIRS", at_once)
    shape, rng = facet_shape(cell, 2), np.random.default_rng(1)
    x = rng.normal(size=(40, 1, shape.dim + 1)) + 0.7 * rng.normal(size=(40, len(shape.nodes), shape.dim + 1))
    points = 2.0 * rng.normal(size=(200, shape.dim + 1))
    y = np.einsum("sa,mag->msg", shape.tabulate(inside(cell, 12)).N, x)
    nearest = np.linalg.norm(points[:, None, None] - y, axis=3).min(axis=2).argmin(axis=1)
    pairs, facets = candidate_pairs(shape, x, points)
    assert set(zip(range(200), nearest)) <= set(zip(pairs, facets))
