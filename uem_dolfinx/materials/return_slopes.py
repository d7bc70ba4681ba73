"""Derivatives of the return to the von Mises yield surface by its initial values, in reverse mode and in closed form.

The derivatives of a functional by strain, history and parameters follow from those by stress s, plastic strain and peeq after a return,
``(n, k)``, ``(n, k)`` and ``(n,)``. Yielding points are kept.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.materials.return_mapping import MODES, ON_SURFACE, plane_mises, plane_stress_return


@dataclass(frozen=True)
class ByReturn:
    """Derivatives by the initial values of a return, at n points.

    Attributes:
        strain, plastic_strain: ``(n, k)``, with the committed plastic strain.
        peeq: committed ``(n,)``.
        shear, area: by the logarithms of E / (1 + nu), and in plane stress of E / (1 - nu) ``(n,)``.
        yield_stress, hardening: ``(n,)``.
    """

    strain: Array
    plastic_strain: Array
    peeq: Array
    shear: Array
    area: Array
    yield_stress: Array
    hardening: Array


def radial_back(
    strain: Array, plastic_strain: Array, peeq: Array, mu: Array, yield_stress: Array, hardening: Array,
    by_stress: Array, by_plastic_strain: Array, by_peeq: Array,
) -> ByReturn:  # fmt: skip
    """Derivatives of ``radial_return``, whose arguments come first.

    With the trial deviator t, ``q = |t| sqrt(3/2)``, ``N = t / q`` and ``dp = (q - flow) / (3 mu + H)`` a yielding point has

        s = t - 3 mu dp N,    E_p + 3/2 dp N,    peeq + dp
    """
    t = strain - plastic_strain
    t[:, :3] -= t[:, :3].mean(axis=1, keepdims=True)
    t *= 2 * mu[:, None]
    q = np.sqrt(1.5) * np.linalg.norm(t, axis=1)
    flow = yield_stress + hardening * peeq
    i = np.flatnonzero(q > (1 + ON_SURFACE) * flow)
    by_t, of_dp = by_stress.copy(), np.zeros_like(q)
    stiff, N = 3 * mu[i] + hardening[i], t[i] / q[i, None]
    dp = (q[i] - flow[i]) / stiff
    by_flow = 1.5 * by_plastic_strain[i] - 3 * mu[i, None] * by_stress[i]
    along = (by_flow * N).sum(axis=1)
    of_dp[i] = along + by_peeq[i]
    turned = (dp / q[i])[:, None] * (by_flow - 1.5 * along[:, None] * N)
    by_t[i] += (1.5 * of_dp[i] / stiff)[:, None] * N + turned
    by_shear = (by_t * t).sum(axis=1)
    by_shear[i] -= 3 * mu[i] * dp * ((by_stress[i] * N).sum(axis=1) + of_dp[i] / stiff)
    by_t[:, :3] -= by_t[:, :3].mean(axis=1, keepdims=True)
    by_strain = 2 * mu[:, None] * by_t
    by_yield, by_hardening = np.zeros_like(q), np.zeros_like(q)
    by_yield[i] = -of_dp[i] / stiff
    by_hardening[i] = by_yield[i] * (peeq[i] + dp)
    return ByReturn(
        by_strain, by_plastic_strain - by_strain, by_peeq + hardening * by_yield, by_shear, 0.0 * q, by_yield, by_hardening
    )


def plane_stress_back(
    strain: Array, plastic_strain: Array, peeq: Array, E: Array, nu: Array, yield_stress: Array, hardening: Array,
    by_stress: Array, by_plastic_strain: Array, by_peeq: Array,
) -> ByReturn:  # fmt: skip
    """Of ``plane_stress_return``, whose arguments come first, with its modes m, its unknown x and ``h(x) = 0`` differentiated."""
    shear, area = E / (1 + nu), E / (1 - nu)
    C = np.stack([area, shear, shear])
    m = MODES @ (strain - plastic_strain).T * C
    flow = yield_stress + hardening * peeq
    i = np.flatnonzero(plane_mises(m[0] ** 2, m[1] ** 2 + m[2] ** 2) > (1 + ON_SURFACE) * flow)
    by_m = MODES @ by_stress.T
    by_yield, by_hardening = np.zeros_like(E), np.zeros_like(E)
    b, H, r, third = shear[i], hardening[i], (area / shear)[i] / 3, np.array([[3.0], [1.0], [1.0]])
    after = plane_stress_return(strain, plastic_strain, peeq, E, nu, yield_stress, hardening, np.zeros_like(E))
    t, e = MODES @ after.stress[i].T, MODES @ by_plastic_strain[i].T
    q = plane_mises(t[0] ** 2, t[1] ** 2 + t[2] ** 2)
    x = 1.5 * b * (after.peeq[i] - peeq[i]) / q
    y, z = 1 / (1 + r * x), 1 / (1 + x)
    shrunk, slope = np.stack([y, z, z]), 2 * H / (3 * b)
    of_q = np.stack([0.5 * t[0], 1.5 * t[1], 1.5 * t[2]]) / q
    flowed = (t / third * e).sum(axis=0) / b
    by_t = by_m[:, i] + x / b * e / third + by_peeq[i] * x / (1.5 * b) * of_q
    t_x = -np.stack([r * y, z, z]) * t
    by_x = flowed + by_peeq[i] * q / (1.5 * b) + (by_t * t_x).sum(axis=0)
    h_x = slope - flow[i] / q**2 * (of_q * t_x).sum(axis=0)
    root = by_x / h_x
    by_t = by_t + root * flow[i] / q**2 * of_q
    by_m[:, i] = shrunk * by_t
    by_yield[i] = -root / q
    by_hardening[i] = by_yield[i] * peeq[i] - root * 2 * x / (3 * b)
    by_area, by_shear = by_m[0] * m[0], (by_m[1:] * m[1:]).sum(axis=0)
    of_ratio = -r * x * y * t[0] * by_t[0]
    by_area[i] += of_ratio
    by_shear[i] += root * slope * x - x * flowed - by_peeq[i] * x * q / (1.5 * b) - of_ratio
    by_strain = (MODES.T @ (C * by_m)).T
    return ByReturn(
        by_strain, by_plastic_strain - by_strain, by_peeq + hardening * by_yield, by_shear, by_area, by_yield, by_hardening
    )
