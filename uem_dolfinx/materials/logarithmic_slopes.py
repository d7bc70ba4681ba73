"""Derivatives of the return in logarithmic strain by its initial values, in reverse mode and in closed form.

With ``b = F (1 - 2 E_p) F^T``, its principal axes n_a and logarithmic strains t_a, the deviator d of these, and the flow dp,

    P = tau F^-T,    tau = sum_a a d_a n_a x n_a,                    a = 2 mu (1 - w),    w = 3 mu dp / q,    q = sqrt(6) mu |d|
    1 - 2 E_p' = F^-1 B F^-T,    B = sum_a exp(2 t_a - 2 w d_a) n_a x n_a,                q - 3 mu dp = yield stress at peeq + dp

Derivatives of tau and B by b are those of isotropic functions: divided differences apart from the diagonal. Yielding points are kept.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.materials.hardening import YieldCurve
from uem_dolfinx.materials.logarithmic import logarithm_slope, to_components, to_tensors
from uem_dolfinx.materials.return_mapping import ON_SURFACE
from uem_dolfinx.materials.return_slopes import ByReturn


def logarithmic_back(
    gradient: Array, plastic_strain: Array, peeq: Array, mu: Array, curve: YieldCurve, components: Sequence[Ints],
    by_stress: Array, by_plastic_strain: Array, by_peeq: Array,
) -> ByReturn:  # fmt: skip
    """Derivatives of ``logarithmic_return``, whose arguments come first, from those by its first Piola-Kirchhoff stress and history.

    ``strain`` of the result is by the components of the gradient, ``hardening`` by the slope of a linear curve.
    """
    size, n = plastic_strain.shape[1], len(mu)
    F, C = gradient + np.eye(3), np.eye(3) - 2 * to_tensors(plastic_strain)
    G = np.asarray(np.linalg.inv(F), dtype=np.float64)
    squares, axes = np.linalg.eigh(F @ C @ F.transpose(0, 2, 1))
    t = np.log(squares) / 2
    d = t - t.mean(axis=1, keepdims=True)
    q, dp, slope = np.sqrt(6.0) * mu * np.linalg.norm(d, axis=1), np.zeros(n), np.zeros(n)
    i = np.flatnonzero(q > (1 + ON_SURFACE) * curve.at(peeq, np.arange(n))[0])
    dp[i] = curve.increment(q[i], peeq[i], 3 * mu[i], i)
    slope[i] = curve.at(peeq[i] + dp[i], i)[1]
    yields = np.isin(np.arange(n), i)
    over = np.where(q > 0, q, 1.0)
    w = 3 * mu * dp / over
    a, kept = 2 * mu * (1 - w), np.exp(2 * t - 2 * w[:, None] * d)

    # by tau and B, in principal axes
    P = np.zeros((n, 3, 3))
    P[:, components[0], components[1]] = by_stress
    M = -to_tensors(by_plastic_strain) / 2
    by_tau, of_plastic = _in_axes(axes, P @ G), _in_axes(axes, G.transpose(0, 2, 1) @ M @ G)
    pushed, pulled = (np.einsum("naa->na", by) for by in (by_tau, of_plastic))

    # by the strains along the axes
    by_w = -2 * (kept * d * pulled).sum(axis=1) - 2 * mu * (d * pushed).sum(axis=1)
    by_mu = 2 * (1 - w) * (d * pushed).sum(axis=1) + 3 * dp / over * by_w
    of_dp = np.where(yields, 3 * mu / over * by_w + by_peeq, 0.0)
    root = of_dp / (3 * mu + slope)
    by_q = np.where(yields, root - w / over * by_w, 0.0)
    by_mu = by_mu - 3 * dp * root + q / mu * by_q
    by_d = a[:, None] * pushed - 2 * w[:, None] * kept * pulled + (6 * mu**2 * by_q / over)[:, None] * d
    by_t = by_d - by_d.mean(axis=1, keepdims=True) + 2 * kept * pulled

    # by b: divided differences of tau and B by the squares
    ratio = squares[:, :, None] / squares[:, None, :]
    divided = logarithm_slope(ratio - 1.0) / squares[:, None, :] / 2
    far = np.log(ratio)
    same = far == 0.0
    grown = np.where(same, (1 - w)[:, None, None], np.expm1((1 - w)[:, None, None] * far) / np.where(same, 1.0, np.expm1(far)))
    by_b = a[:, None, None] * divided * by_tau + (kept / squares)[:, None, :] * grown * of_plastic
    by_b[:, range(3), range(3)] = by_t / (2 * squares)
    by_b = axes @ by_b @ axes.transpose(0, 2, 1)

    # by F: through b, and through its inverse
    tau, B = ((axes * values[:, None, :]) @ axes.transpose(0, 2, 1) for values in (a[:, None] * d, kept))
    of_inverse = P.transpose(0, 2, 1) @ tau + 2 * M @ G @ B
    of_gradient = 2 * by_b @ F @ C - G.transpose(0, 2, 1) @ of_inverse @ G.transpose(0, 2, 1)
    of_metric = F.transpose(0, 2, 1) @ by_b @ F
    flow = np.where(yields, -root, 0.0)
    return ByReturn(
        of_gradient[:, components[0], components[1]], to_components(-2 * of_metric, size), by_peeq + slope * flow, by_mu * mu, 0.0 * mu,
        flow, flow * (peeq + dp),
    )  # fmt: skip


def _in_axes(axes: Array, A: Array) -> Array:
    """The symmetric part of tensors in principal axes, ``(n, 3, 3)``."""
    return np.asarray(axes.transpose(0, 2, 1) @ (A + A.transpose(0, 2, 1)) @ axes / 2)
