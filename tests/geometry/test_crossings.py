"""Where moving points cross moving facets, against many instants of the motion."""

from __future__ import annotations

import numpy as np
import pytest
from body_scenes import skin_of
from helpers import box, rotation
from hypothesis import given
from hypothesis import strategies as st

from uem_dolfinx.geometry.bodies import carried_along
from uem_dolfinx.geometry.crossings import find_crossings


@pytest.mark.slow
@given(seed=st.integers(0, 10**6), g=st.sampled_from([2, 3]), size=st.sampled_from([1e-9, 1.0, 1e6]))
def test_crossings_are_those_of_a_slow_search(seed, g, size):
    """Times, senses and normals against signs of the height at many instants."""
    rng = np.random.default_rng(seed)
    p0, p1 = size * rng.normal(size=(2, 6, g))
    x0, x1 = size * rng.normal(size=(2, 5, g, g))
    sign = rng.choice([-1.0, 1.0], 5)
    found = find_crossings((p0, x0), (p1, x1), sign, 0.0)
    t = np.linspace(0.0, 1.0, 2001)
    expected = []
    for i in range(6):
        p = p0[i] + t[:, None] * (p1[i] - p0[i])
        for f in range(5):
            x = x0[f] + t[:, None, None] * (x1[f] - x0[f])
            # p = sum b_a x_a + h n with sum b_a = 1
            e = x[:, 1:] - x[:, :1]
            n = np.stack([e[:, 0, 1], -e[:, 0, 0]], axis=1) if g == 2 else np.cross(e[:, 0], e[:, 1])
            n *= sign[f] / np.linalg.norm(n, axis=1, keepdims=True)
            A = np.concatenate([e, n[:, None]], axis=1).transpose(0, 2, 1)
            b = np.linalg.solve(A, (p - x[:, 0])[..., None])[..., 0]
            for k in np.flatnonzero(np.diff(b[:, -1] >= 0)):
                inner = b[k : k + 2, :-1]
                margin = min(inner.min(), (1 - inner.sum(axis=1)).min())
                if margin > 0.02:
                    expected.append((i, t[k], b[k, -1] >= 0, n[k]))
    assert len(found.point) >= len(expected)
    for i, time, inwards, normal in expected:
        match = (found.point == i) & (found.inwards == inwards) & (np.abs(found.time - time) < 1e-3)
        assert match.any() and np.abs(found.normal[match] - normal).max(axis=1).min() < 0.1


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
@pytest.mark.parametrize(("height", "crosses"), [(1e-16, False), (-1e-16, False), (1e-12, False), (1e-9, True)])
def test_points_that_ride_on_facets(height, crosses, size):
    """A point that moves with a facet's corner crosses no facet by rounding; one that comes from clearly above it does."""
    x0 = size * np.array([[[0.0, 0.0], [1.0, 0.0]], [[0.0, -1.0], [0.0, 0.0]]])
    for angle in (0.5, 1.5, 2.8):
        x1, reach = x0 @ rotation(2, angle).T, 0.1 * size
        point = size * np.array([[0.5, height]])
        end = size * np.array([[0.5, -height]]) @ rotation(2, angle).T
        found = find_crossings((point, x0), (end, x1), np.ones(2), reach)
        assert ((found.point == 0) & (found.facet == 0)).any() == crosses


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
@pytest.mark.parametrize("g", [2, 3])
def test_ways_as_seen_from_facets(g, size):
    """What moves rigidly by any angle crosses nothing; what else moves crosses the same facets if all turns by up to a right angle."""
    rng = np.random.default_rng(0)
    p, x, sign = rng.normal(size=(40, g)), rng.normal(size=(30, g, g)), rng.choice([-1.0, 1.0], 30)
    q = p + rng.normal(size=p.shape)
    still = find_crossings((size * p, size * x), (size * q, size * x), sign, 0.0)
    key = np.lexsort((still.facet, still.point))
    assert len(key) > 20 and np.allclose(still.way, size * np.linalg.norm(q - p, axis=1)[still.point], rtol=1e-12)
    for angle in (0.0, 0.5, 1.5, np.pi, 5.0):
        turned = [size * (a @ rotation(g, angle).T) for a in (p, q, x)]
        start = size * p, size * x
        assert len(find_crossings(start, (turned[0], turned[2]), sign, 0.0, turning=True).point) == 0
        if angle > 1.5:
            continue
        found = find_crossings(start, (turned[1], turned[2]), sign, 0.0, turning=True)
        order = np.lexsort((found.facet, found.point))
        for name in ("point", "facet", "inwards"):
            assert (getattr(found, name)[order] == getattr(still, name)[key]).all()
        assert np.allclose(found.time[order], still.time[key], atol=1e-9)
        assert np.allclose(found.normal[order], still.normal[key] @ rotation(g, angle).T, atol=1e-9)


def test_each_body_is_carried_along():
    """Bodies that turn by angles of their own come where they are; one that is stretched too keeps its middle and its angle."""
    bodies = [box("triangle", [x, 0.0], [x + 1.0, 0.5], [4, 2]) for x in (0.0, 2.0)]
    _, skin = skin_of("triangle", bodies)
    config, body, angles = skin.config, skin.body_of_node, (3.0, -1.0)
    turns = np.stack([rotation(2, angle) for angle in angles])[body]
    X = config.X
    now = np.einsum("nij,nj->ni", turns, X) + 1.0
    assert np.abs(carried_along(config, body, 2, X, now) - now).max() < 1e-13
    stretched = np.einsum("nij,nj->ni", turns, X * [1.5, 1.0])
    middle = np.array([[0.5, 0.25], [2.5, 0.25]])[body]
    expected = np.einsum("nij,nj->ni", turns, X - middle + middle * [1.5, 1.0])
    assert np.abs(carried_along(config, body, 2, X, stretched) - expected).max() < 1e-13
