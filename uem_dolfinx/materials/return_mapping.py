"""Return mapping to the von Mises yield surface, vectorised over points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array

#: A stress outside the yield surface by no more than this part of the yield stress is on it.
#: [convention; yield stress; test_thresholds_motion.py::test_on_the_yield_surface]
ON_SURFACE = 1e-10
#: Returns that iterate, in plane stress, to saturating curves and around a back stress in finite strain, end with a Newton step below this
#: part of their unknown; the next one would be its square. [bound; consistency parameter; -]
RETURNED = 1e-10
#: Those steps; they are quadratic, and random states took 7 at most, with a back stress and elastic strains of one half 18.
#: [bound; steps; -]
MAX_STEPS = 50


@dataclass(frozen=True)
class Returned:
    """Stress, history and tangent after a return, at n points.

    Vectors hold the k components (11, 22, sqrt(2) 12) in plane stress, (11, 22, 33, sqrt(2) 12) in plane strain and axisymmetry, and
    (11, 22, 33, sqrt(2) 23, sqrt(2) 13, sqrt(2) 12) in 3D. Their dot product then equals the tensors' inner product.

    Attributes:
        a, c, m: the tangent ``a I + c 1 x 1 - sum of m x m``, with the unit tensor 1 of the normal components and vectors m side by
            side, ``(n,)``, ``(n,)``, ``(n, k)`` or a multiple of k.
    """

    stress: Array  # the stress in plane stress, otherwise its deviator, ``(n, k)``
    plastic_strain: Array  # ``(n, k)``
    peeq: Array  # equivalent plastic strain ``(n,)``
    a: Array
    c: Array
    m: Array
    energy: Array  # stored by ``stress`` and by the back stress, per volume ``(n,)``

    @property
    def tangent(self) -> Array:
        """Derivative of ``stress`` by the strain ``(n, k, k)``."""
        n, k = self.stress.shape
        m = self.m.reshape(n, self.m.shape[1] // k, k)
        one = (np.arange(k) < (2 if k == 3 else 3)).astype(float)
        plain = self.a[:, None, None] * np.eye(k) + self.c[:, None, None] * np.outer(one, one)
        return plain - m.transpose(0, 2, 1) @ m


def radial_return(
    strain: Array, plastic_strain: Array, peeq: Array, mu: Array, yield_stress: Array, hardening: Array, modulus: Array
) -> Returned:
    """Return of the deviator along its own direction, except in plane stress (Simo and Hughes, Computational Inelasticity, box 3.1).

    Strains ``(n, k)``, with committed ``plastic_strain`` and ``peeq (n,)``, have components as in ``Returned``, here k = 4 or 6.
    Parameters are ``(n,)``: shear modulus, initial ``yield_stress``, infinite at elastic points, ``hardening``, its slope over
    ``peeq``, and ``modulus``, 3/2 of the back stress over the plastic strain. The tangent is the derivative of the deviator.
    """
    s = strain - plastic_strain
    s[:, :3] -= s[:, :3].mean(axis=1, keepdims=True)
    s *= 2 * mu[:, None]
    moves = modulus.any()
    over = s - 2 / 3 * modulus[:, None] * plastic_strain if moves else s
    q = np.sqrt(1.5) * np.linalg.norm(over, axis=1)
    flow = yield_stress + hardening * peeq
    plastic_strain, peeq, a, m = plastic_strain.copy(), peeq.copy(), 2 * mu, np.zeros_like(s)
    i = np.flatnonzero(q > (1 + ON_SURFACE) * flow)
    harder = hardening[i] + modulus[i]
    stiff = 3 * mu[i] + harder
    dp = (q[i] - flow[i]) / stiff
    direction = over[i] / q[i, None]
    # 1 - 3 mu dp / q without cancellation
    kept = (flow[i] + harder * dp) / q[i]
    peeq[i] += dp
    plastic_strain[i] += 1.5 * dp[:, None] * direction
    s[i] = s[i] - over[i] + kept[:, None] * over[i]
    a[i] *= kept
    m[i] = np.sqrt(9 * mu[i] ** 2 / stiff * flow[i] / q[i])[:, None] * direction
    energy = _squares(s) / (4 * mu)
    if moves:
        energy += modulus / 3 * _squares(plastic_strain)
    return Returned(s, plastic_strain, peeq, a, -a / 3, m, energy)


def plane_stress_return(
    strain: Array, plastic_strain: Array, peeq: Array, E: Array, nu: Array, yield_stress: Array, hardening: Array, modulus: Array
) -> Returned:
    """Return in plane stress (Simo and Taylor, Int. J. Numer. Meth. Engng 22 (1986) 649-670).

    Elasticity, back stress and yield surface have the eigenmodes s11 + s22, s11 - s22 and s12. Differences from the back stress are
    multiplied by 1 / (1 + (r + k) x) and 1 / (1 + (1 + k) x) with r = (1 + nu) / (1 - nu) / 3 and k = modulus / (3 mu); x is the
    consistency parameter times 2 mu and the root of

        h(x) = flow / q(x) + 2 H x / (6 mu) - 1.

    1 / q is the harmonic-like mean ``(y1^-2 + y2^-2)^(-1/2)`` of linear functions of x, so h is concave and increasing: Newton's method
    from x = 0 approaches the root from the left and needs no safeguard. Arguments as in ``radial_return``, with vectors of 3
    components, and Young's modulus and Poisson's ratio ``(n,)`` in place of mu.
    """
    shear, area = E / (1 + nu), E / (1 - nu)
    of_normal = np.array([[3.0], [1.0], [1.0]])
    modes = MODES @ (strain - plastic_strain).T * np.stack([area, shear, shear])
    moves, flow = modulus.any(), yield_stress + hardening * peeq
    over = modes - of_normal * (MODES @ plastic_strain.T) * (2 / 3 * modulus) if moves else modes
    i = np.flatnonzero(plane_mises(over[0] ** 2, over[1] ** 2 + over[2] ** 2) > (1 + ON_SURFACE) * flow)
    b, flow, H, K, r = shear[i], flow[i], hardening[i], modulus[i], (area / shear)[i] / 3
    ss, dd = over[0, i] ** 2, over[1, i] ** 2 + over[2, i] ** 2
    slope, k, x = 2 * H / (3 * b), 2 * K / (3 * b), np.zeros(len(i))
    for _ in range(MAX_STEPS):
        y, z = 1 / (1 + (r + k) * x), 1 / (1 + (1 + k) * x)
        q = plane_mises(ss * y**2, dd * z**2)
        falls = flow / q**3 * (0.5 * (r + k) * ss * y**3 + 1.5 * (1 + k) * dd * z**3)
        step = (1 - slope * x - flow / q) / (falls + slope)
        x += step
        if (np.abs(step) <= RETURNED * (1 + x)).all():
            break
    y, z, moved = 1 / (1 + (r + k) * x), 1 / (1 + (1 + k) * x), 1 + k * x
    before = over[:, i]
    left = before * np.stack([y, z, z])
    q = plane_mises(left[0] ** 2, left[1] ** 2 + left[2] ** 2)
    plastic_strain, peeq, m = plastic_strain.copy(), peeq.copy(), np.zeros_like(strain)
    normal = left / of_normal
    plastic_strain[i] += (MODES.T @ (normal * x / b)).T
    peeq[i] += x / b * q / 1.5
    modes[:, i] = modes[:, i] - before + moved * left
    area[i] *= moved * y
    shear[i] *= moved * z
    pushed = normal * np.stack([area[i], shear[i], shear[i]])
    resisted = 4 / 9 * q**2 * moved * (K + moved * H * q / flow)
    m[i] = (MODES.T @ (pushed / np.sqrt((normal * pushed).sum(axis=0) + resisted))).T
    energy = ((1 - nu) * modes[0] ** 2 + (1 + nu) * (modes[1] ** 2 + modes[2] ** 2)) / (2 * E)
    if moves:
        energy += modulus / 3 * (_squares(plastic_strain) + (plastic_strain[:, 0] + plastic_strain[:, 1]) ** 2)
    return Returned((MODES.T @ modes).T, plastic_strain, peeq, shear, (area - shear) / 2, m, energy)


#: From (11, 22, sqrt(2) 12) to the modes of plane stress, an orthogonal map. [format; components; -]
MODES = np.array([[0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [0.0, 0.0, 0.5**0.5]]) * 2**0.5


def _squares(v: Array) -> Array:
    """Squared norms of vectors ``(n, k)``."""
    return np.asarray(np.einsum("nk,nk->n", v, v), dtype=np.float64)


def plane_mises(ss: Array, dd: Array) -> Array:
    """Von Mises stress from the squares of the modes."""
    return np.sqrt(0.5 * ss + 1.5 * dd)
