"""Which facets of a target lie opposite to a facet: their normals, and all pairs of two surfaces."""

from __future__ import annotations

from types import SimpleNamespace

from mpi4py import MPI

import numpy as np
import pytest
from body_scenes import all_facets
from dolfinx import fem
from helpers import at, box, scene

from uem_dolfinx import compat
from uem_dolfinx.geometry import opposite
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.opposite import find_opposite, thickness
from uem_dolfinx.geometry.overlaps import Planes, overlap
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.shapes import facet_shape


@pytest.mark.parametrize(("angle", "faces"), [(0.0, True), (52.0, True), (54.0, False), (95.0, False), (180.0, False)])
def test_facets_that_face_each_other(angle, faces):
    """A facet is opposite to another if their normals are less than 53 degrees from antiparallel, and it is in reach."""
    s = scene(MPI.COMM_SELF, "quadrilateral", [box("quadrilateral", [0.0, -1.0], [1.0, 0.0], [1, 1])])
    config = Configuration(fem.Function(compat.function_space(s.mesh, 1, (2,))))
    target = MeshTarget(TargetFacets(config, s.tag("top", 0, at(1, 0.0))))
    a = np.deg2rad(angle)
    x = np.array([0.5, 0.1]) + np.outer([-0.5, 0.5], [np.cos(a), np.sin(a)])
    planes = Planes.of(target.shape, x[None], np.array([1.0]))
    assert planes.normal[0, 1] == pytest.approx(-np.cos(a))
    assert (len(find_opposite(target, planes, x[None], np.array([0.2])).facet) > 0) == faces
    assert not len(find_opposite(target, planes, x[None] + [0.0, 3.0], np.array([0.2])).facet)


@pytest.mark.parametrize(("angle", "faces"), [(54.0, True), (78.0, True), (79.0, False), (120.0, False)])
def test_facets_that_have_faced_each_other(angle, faces):
    """They do so until their normals are 78 degrees from antiparallel; others than those named do not."""
    s = scene(MPI.COMM_SELF, "quadrilateral", [box("quadrilateral", [0.0, -1.0], [1.0, 0.0], [1, 1])])
    config = Configuration(fem.Function(compat.function_space(s.mesh, 1, (2,))))
    target = MeshTarget(TargetFacets(config, s.tag("top", 0, at(1, 0.0))))
    a = np.deg2rad(angle)
    x = np.array([0.5, 0.1]) + np.outer([-0.5, 0.5], [np.cos(a), np.sin(a)])
    planes, key = Planes.of(target.shape, x[None], np.array([1.0])), int(target.keys[0])
    for pairs, seen in (([[7, key]], faces), ([[8, key]], False), ([[7, key + 1]], False)):
        found = find_opposite(target, planes, x[None], np.array([0.2]), (np.array([7]), np.array(pairs)))
        assert (len(found.facet) > 0) == seen


@pytest.mark.long
@pytest.mark.parametrize(
    "gap", [0.0, pytest.param(0.05, marks=pytest.mark.slow), pytest.param(2.0, marks=pytest.mark.slow), 50.0]
)
@pytest.mark.parametrize("angle", [0.0, 0.7])
def test_candidates_against_all_pairs(monkeypatch, gap, angle):
    """As far away as the target may be: every facet that lies upon another is found, and at most 50 are looked at for one."""
    rng, (ct, st) = np.random.default_rng(1), (np.cos(angle), np.sin(angle))
    turn = np.array([[1.0, 0.0, 0.0], [0.0, ct, -st], [0.0, st, ct]])

    def surface(n, height):
        corner = np.stack(np.meshgrid(np.arange(n + 1), np.arange(n + 1), indexing="ij"), axis=-1) / n
        corner[1:-1, 1:-1] += rng.uniform(-0.2, 0.2, (n - 1, n - 1, 2)) / n
        x = np.dstack([corner, np.full((n + 1, n + 1), height)])
        a, b, c, d = x[:-1, :-1], x[1:, :-1], x[:-1, 1:], x[1:, 1:]
        return np.concatenate([np.stack(t, axis=2).reshape(-1, 3, 3) for t in ((a, b, c), (b, d, c))]) @ turn.T

    shape, x, y = facet_shape("triangle", 1), surface(24, gap), surface(17, 0.0)
    planes = Planes.of(shape, x, -np.ones(len(x)))
    target = SimpleNamespace(shape=shape, facets=SimpleNamespace(sign=np.ones(len(y))))
    middle, looked_at = x.mean(axis=1), []
    balls = opposite.balls_that_meet
    monkeypatch.setattr(opposite, "balls_that_meet", lambda *a: looked_at.append(balls(*a)) or looked_at[-1])
    radius = np.linalg.norm(x - middle[:, None], axis=2).max(axis=1)
    i, f = opposite._candidates(target, y, middle, radius, np.full(len(x), 1.5 * gap + 0.1), planes.normal)
    assert len(looked_at[0][0]) <= 50 * len(x)
    every = [a.ravel() for a in np.meshgrid(np.arange(len(x)), np.arange(len(y)), indexing="ij")]
    s = overlap(planes, (shape, x), (shape, y[every[1]]), -np.ones(len(x)), every[0])
    upon = np.unique(s.pair)
    assert len(upon) > len(x) and set(zip(*(a[upon] for a in every))) <= set(zip(i, f))


@pytest.mark.parametrize("cell", ["triangle", pytest.param("hexahedron", marks=pytest.mark.slow)])
@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e3])
def test_how_thick_a_plate_is(cell, unit):
    """Whatever it is cut into, and no more than that; what is in front of facets, as another plate, counts for nothing."""
    t, g = 0.01, 2 if cell == "triangle" else 3
    body = [box(cell, [0.0] * (g - 1) + [z], [1.0] * (g - 1) + [z + t], [3] * (g - 1) + [2]) for z in (0.0, 1.5 * t)]
    s = scene(MPI.COMM_WORLD, cell, body, pose=lambda x: unit * x)
    config = Configuration(fem.Function(compat.function_space(s.mesh, 1, (g,))))
    target = MeshTarget(TargetFacets(config, all_facets(s.mesh)))
    ends = np.ptp(target.facets.x[:, :, -1], axis=1) > 1e-6 * t * unit
    for most in (0.5 * t, 5 * t):
        np.testing.assert_allclose(thickness(target, most * unit) / unit, np.where(ends, most, min(most, t)), rtol=1e-9)
