"""Where moving points cross moving facets, against many instants of the motion."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from uem_dolfinx.geometry.crossings import find_crossings


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
