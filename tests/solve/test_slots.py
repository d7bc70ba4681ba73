"""The frictional problem of a linearisation on arrays. The test to read first is ``test_random_problems``."""

from __future__ import annotations

import numpy as np
import pytest

from uem_dolfinx.solve.slots import coulomb
from uem_dolfinx.solve.slots.coulomb import SlotProblem


def compliance(rng, n, d):
    """Relative motions of n contactors at random places by forces of each other, which decay with distance."""
    x = rng.random((n, 2))
    far = np.linalg.norm(x[:, None] - x, axis=2)
    decay = 1 / (far + 0.3 / np.sqrt(n))
    W = np.kron(decay, np.eye(d))
    W[::d, 1::d] += 0.24 * (x[:, None, 0] - x[:, 0]) / (far + 0.1) * decay
    W = (W + W.T) / 2
    return W + max(0.0, 1e-2 - np.linalg.eigvalsh(W)[0]) * np.eye(n * d)


def problem(W, free, gap, mu, rest=0.0):
    """Of the motions ``free (n, d)`` without contact; slots of a contactor follow each other."""
    n, d = free.shape
    S = np.linalg.inv(W)
    slots, S = np.arange(n * d).reshape(n, d), (S + S.T) / 2
    return SlotProblem(
        S, -S @ free.ravel(), slots[:, 0], slots[:, 1:], gap, np.zeros((n, d - 1)), np.full(n, mu), np.full(n, rest)
    )


def plain(rng, n, d, mu):
    free = rng.standard_normal((n, d))
    free[:, 0] -= 0.8
    return problem(compliance(rng, n, d), free, 0.2 * rng.random(n), mu)


def hard(rng, n, d, mu):
    """Compliances over four decades, a tangential motion that is nearly free, half of the gaps zero."""
    size = 10.0 ** rng.uniform(-1, 1, n)
    W = np.repeat(size, d)[:, None] * compliance(rng, n, d) * np.repeat(size, d)
    along = np.tile(np.eye(d)[1:], n)
    free = rng.standard_normal((n, d)) * size[:, None]
    free[:, 0] -= 0.8 * size
    return problem(W + 1e3 * along.T @ along, free, np.where(rng.random(n) < 0.5, 0.0, 0.2 * rng.random(n)), mu)


def error(p, s):
    """Largest violation of the conditions, of the largest force and relative motion."""
    there = p.tangents >= 0
    force = p.stiffness @ s.w + p.load
    lam, tau = force[p.normal], np.where(there, force[p.tangents], 0.0)
    opening, v = p.gap + s.w[p.normal], p.slip + np.where(there, s.w[p.tangents], 0.0)
    limit = np.where(s.active, p.rest + p.slope * np.maximum(lam, 0.0), 0.0)
    held = s.stick[:, None]
    assert not (s.stick & ~s.active).any() and not s.direction[~s.active | s.stick].any()
    forces = np.abs(s.force - force).max(), -lam.min(), np.abs(lam[~s.active]).max(initial=0.0), (
        np.abs(np.where(held, 0.0, tau + limit[:, None] * s.direction)).max()
    ), (np.linalg.norm(tau, axis=1) - limit).max()  # fmt: skip
    frictional = s.direction.any(axis=1)
    size = np.linalg.norm(v, axis=1)[:, None]
    motions = -opening.min(), np.abs(opening[s.active]).max(initial=0.0), np.abs(np.where(held, v, 0.0)).max(), (
        np.abs(v - size * s.direction)[frictional].max(initial=0.0)
    )  # fmt: skip
    return max(max(forces) / np.abs(force).max(), max(motions) / np.abs(s.w).max())


@pytest.mark.parametrize("kind", [plain, hard])
@pytest.mark.parametrize("d", [2, 3])
@pytest.mark.parametrize("mu", [0.1, 0.4, 1.2])
def test_random_problems(kind, d, mu):
    """All conditions hold, of forces and of relative motions, and closed gaps vanish exactly."""
    for seed in range(8):
        rng = np.random.default_rng([seed, d])
        p = kind(rng, rng.integers(5, 40), d, mu)
        s = coulomb.solve(p)
        assert error(p, s) <= 1e-9
        assert np.abs(p.gap + s.w[p.normal])[s.active].max() == 0.0
