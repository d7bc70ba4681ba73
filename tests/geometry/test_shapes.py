"""The closest point of one facet, of any kind, against sampling, SciPy and formulas."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize

from uem_dolfinx.geometry.shapes import closest_point, facet_shape, nodal_area_vectors, tangents, unit_normals

KINDS = [("interval", 1), ("interval", 2), ("triangle", 1), ("triangle", 2), ("quadrilateral", 1), ("quadrilateral", 2)]


def loop_closest(shape, x, p):
    """Distance of one point to one facet: dense sampling, then SciPy from the best sample."""

    def d2(xi):
        return float(((shape.tabulate(np.atleast_2d(xi)).N[0] @ x - p) ** 2).sum())

    grid = np.stack(np.meshgrid(*[np.linspace(0, 1, 31)] * shape.dim), axis=-1).reshape(-1, shape.dim)
    grid = grid[shape.contains(grid)]
    start = grid[np.argmin(((shape.tabulate(grid).N @ x - p) ** 2).sum(axis=1))]
    below = [{"type": "ineq", "fun": lambda xi: 1 - xi.sum()}] if shape.cell == "triangle" else []
    best = minimize(
        d2, start, bounds=[(0, 1)] * shape.dim, constraints=below, method="SLSQP", options={"ftol": 1e-16, "maxiter": 100}
    )
    return min(best.fun, d2(start)) ** 0.5


def random_facets(shape, n, rng, bend):
    """Facets with corners near the reference cell's and middle nodes off the straight sides."""
    g = shape.dim + 1
    flat = np.column_stack([shape.nodes, np.zeros(len(shape.nodes))])
    return flat + bend * rng.uniform(-1, 1, (n, len(flat), g))


@pytest.mark.parametrize("cell,degree", KINDS)
def test_closest_point_of_one_facet(cell, degree):
    shape, rng = facet_shape(cell, degree), np.random.default_rng(7)
    x = random_facets(shape, 60, rng, 0.3 if degree == 1 else 0.08)
    # near the facet, past its sides, and past its corners
    p = rng.uniform(-0.6, 1.6, (60, shape.dim + 1))
    p[:, -1] = rng.uniform(-0.4, 0.4, 60)
    xi, d2 = closest_point(shape, x, p)
    foot = np.einsum("na,nag->ng", shape.tabulate(xi).N, x)
    assert shape.contains(xi).all()
    assert np.allclose(np.linalg.norm(foot - p, axis=1), np.sqrt(d2), atol=1e-13)
    expected = [loop_closest(shape, x[i], p[i]) for i in range(60)]
    # SciPy's distance is that of some point of the facet, so it may exceed the exact one only by its own tolerance
    assert np.abs(np.sqrt(d2) - expected).max() < 1e-7


@pytest.mark.parametrize("cell,degree", KINDS)
def test_closest_points_of_collapsed_facets(cell, degree):
    """A facet in one point, as an attempt may leave it, has its distance; all others are found as without it."""
    shape, rng = facet_shape(cell, degree), np.random.default_rng(5)
    x, p = random_facets(shape, 6, rng, 0.05), rng.uniform(-0.5, 1.5, (6, shape.dim + 1))
    alone = closest_point(shape, x[1:], p[1:])
    x[0] = [0.25, 0.5, -1.0][: shape.dim + 1]
    xi, d2 = closest_point(shape, x, p)
    assert shape.contains(xi).all() and d2[0] == pytest.approx(((p[0] - x[0, 0]) ** 2).sum(), rel=1e-13)
    assert np.abs(xi[1:] - alone[0]).max() < 1e-13 and np.abs(d2[1:] - alone[1]).max() < 1e-13


@pytest.mark.parametrize("cell", ["interval", "triangle"])
def test_straight_facets_by_formula(cell):
    """Barycentric formulas of a segment and of a triangle's inside."""
    shape, rng = facet_shape(cell, 1), np.random.default_rng(11)
    x = random_facets(shape, 300, rng, 0.4)
    p = rng.uniform(-0.5, 1.5, (300, shape.dim + 1))
    xi, _ = closest_point(shape, x, p)
    A, r = x[:, 1:] - x[:, :1], p - x[:, 0]
    for k in range(300):
        exact = np.linalg.lstsq(A[k].T, r[k], rcond=None)[0]
        if cell == "interval":
            assert np.allclose(xi[k], np.clip(exact, 0, 1), atol=1e-13)
        elif (exact >= 0).all() and exact.sum() <= 1:
            assert np.allclose(xi[k], exact, atol=1e-13)
        else:
            ends = [(0, 1), (0, 2), (1, 2)]
            s = [np.clip((p[k] - x[k, a]) @ (x[k, b] - x[k, a]) / ((x[k, b] - x[k, a]) ** 2).sum(), 0, 1) for a, b in ends]
            feet = [x[k, a] + t * (x[k, b] - x[k, a]) for (a, b), t in zip(ends, s)]
            nearest = min(feet, key=lambda f: np.linalg.norm(f - p[k]))
            assert np.allclose(x[k, 0] + xi[k] @ A[k], nearest, atol=1e-13)


coordinates = st.floats(-2, 2, allow_nan=False, width=32)


@settings(max_examples=40, deadline=None, derandomize=True)
@given(st.sampled_from(KINDS), st.integers(0, 10**6), coordinates, coordinates, coordinates)
def test_no_sampled_point_is_nearer(kind, seed, a, b, c):
    """Whatever the facet and the point, warped quadrilaterals and far points included."""
    shape, rng = facet_shape(*kind), np.random.default_rng(seed)
    x = random_facets(shape, 1, rng, 0.25 if kind[1] == 1 else 0.05)
    p = np.array([[a, b, c]])[:, : shape.dim + 1]
    _, d2 = closest_point(shape, x, p)
    samples = rng.random((400, shape.dim))
    samples = np.concatenate([samples[shape.contains(samples)], shape.nodes])
    nearest = np.linalg.norm(shape.tabulate(samples).N @ x[0] - p, axis=1).min()
    assert np.sqrt(d2[0]) <= nearest + 1e-12


@pytest.mark.parametrize("cell,degree", KINDS)
def test_point_on_a_curved_facet_is_its_own_foot(cell, degree):
    shape, rng = facet_shape(cell, degree), np.random.default_rng(5)
    x = random_facets(shape, 200, rng, 0.1 if degree == 1 else 0.05)
    xi = rng.dirichlet(np.ones(shape.dim + 1), 200)[:, : shape.dim]
    tab = shape.tabulate(xi)
    on = np.einsum("na,nag->ng", tab.N, x)
    for height in (0.0, 0.05, -0.05):
        found, d2 = closest_point(shape, x, on + height * unit_normals(tab, x))
        assert np.sqrt(d2).max() < abs(height) + 1e-14
        # above a strongly bent facet another of its points may be nearer, on it none
        same = np.sqrt(d2) > abs(height) - 1e-12
        assert same.mean() > 0.9 and (same.all() or height)
        assert np.abs(found - xi)[same].max() < 1e-12


@pytest.mark.parametrize("cell,degree", KINDS)
def test_vectors_and_angles_at_the_nodes(cell, degree):
    """At all nodes at once the area vectors are those found point by point; corner angles are those between straight sides."""
    shape = facet_shape(cell, degree)
    x = random_facets(shape, 4, np.random.default_rng(3), 0.1)
    vectors = nodal_area_vectors(shape, x)
    for a, xi in enumerate(shape.nodes):
        t = tangents(shape.tabulate(np.tile(xi, (len(x), 1))), x)
        across = np.stack([t[:, 0, 1], -t[:, 0, 0]], axis=1) if shape.dim == 1 else np.cross(t[:, 0], t[:, 1])
        assert np.abs(vectors[:, a] - across).max() < 1e-13 * np.abs(across).max()
    if shape.dim == 2 and degree == 1:
        angles = shape.corner_angles(x)
        for i, corner in enumerate(shape.ring):
            arms = x[:, [shape.ring[i - 1], shape.ring[(i + 1) % len(shape.ring)]]] - x[:, [corner]]
            arms /= np.linalg.norm(arms, axis=2, keepdims=True)
            np.testing.assert_allclose(np.cos(angles[:, corner]), (arms[:, 0] * arms[:, 1]).sum(axis=1), rtol=1e-12)
