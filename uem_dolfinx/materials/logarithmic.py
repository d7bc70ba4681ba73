"""Return of stresses in finite strain: the radial return in the principal axes of the logarithmic elastic strain, at many points at once.

[Simo, Computer Methods in Applied Mechanics and Engineering 99 (1992) 61-112; Cuitino and Ortiz, Engineering Computations 9 (1992)
437-451; de Souza Neto, Peric, Owen, Computational Methods for Plasticity, ch. 14]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.materials.hardening import YieldCurve
from uem_dolfinx.materials.return_mapping import ON_SURFACE

#: Rows and columns of the components of a symmetric tensor, in the order of ``Returned``, by their number.
SYMMETRIC_COMPONENTS = {6: ([0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]), 4: ([0, 1, 2, 0], [0, 1, 2, 1])}


@dataclass(frozen=True)
class Flowed:
    """Stress, history and tangent after a return, at n points; NaN where F cannot be inverted or is not finite.

    Symmetric tensors have k = 4 or 6 components in the order of ``Returned``.
    """

    stress: Array  # deviator of the Kirchhoff stress ``(n, k)``
    first_piola: Array  # the first Piola-Kirchhoff stress that belongs to it, components ``(n, c)``
    tangent: Callable[[], Array]  # finds its derivative by the same components of F ``(n, c, c)``, symmetric
    plastic_strain: Array  # ``(1 - C_p^-1) / 2``, C_p the plastic right Cauchy-Green tensor ``(n, k)``
    peeq: Array  # equivalent plastic strain ``(n,)``
    energy: Array  # stored by the deviator, per reference volume ``(n,)``


def logarithmic_return(
    gradient: Array, plastic_strain: Array, peeq: Array, mu: Array, curve: YieldCurve, components: Sequence[Ints]
) -> Flowed:
    """Return along the deviator of ``log(V_e)``, V_e the elastic stretch that would be there without further flow.

    With the exponential map the principal axes stay and their logarithmic strains obey the equations of small strains; the flow keeps
    the volume exactly.

    Args:
        gradient: of the displacement ``(n, 3, 3)``.
        plastic_strain: committed ``(n, k)``, as in ``Flowed``.
        peeq: committed ``(n,)``.
        mu: shear modulus ``(n,)``.
        curve: yield stress over ``peeq``.
        components: rows and columns of F that may vary, each ``(c,)``.
    """
    one, size, plastic = np.eye(3), plastic_strain.shape[1], to_tensors(plastic_strain)
    F = gradient + one
    # from the strains themselves, so that small ones are not lost in rounding
    b = gradient + gradient.transpose(0, 2, 1) + gradient @ gradient.transpose(0, 2, 1)
    b -= 2 * F @ plastic @ F.transpose(0, 2, 1)
    lost = ~(np.isfinite(b).all(axis=(1, 2)) & (np.linalg.det(F) > 0))
    F[lost], b[lost] = one, 0.0
    change, axes = np.linalg.eigh(b)
    pulled = np.linalg.solve(F, axes)
    trial = np.log1p(change) / 2
    d = trial - trial.mean(axis=1, keepdims=True)
    q = np.sqrt(6.0) * mu * np.linalg.norm(d, axis=1)
    new, dp, a, c = peeq.copy(), np.zeros_like(q), 2 * mu, np.zeros_like(q)
    i = np.flatnonzero(q > (1 + ON_SURFACE) * curve.at(peeq, np.arange(len(q)))[0])
    dp[i] = curve.increment(q[i], peeq[i], 3 * mu[i], i)
    new[i] += dp[i]
    flow, slope = curve.at(new[i], i)
    a[i] *= flow / q[i]
    c[i] = (2 * mu[i] / q[i]) ** 2 * (9 * mu[i] ** 2) * (1 / (3 * mu[i] + slope) - dp[i] / q[i])
    s = a[:, None] * d
    # plastic strain grows along the axes by the exponential map, pulled back to the drawing
    shrunk = (1 + change[i]) * np.expm1(-6 * (mu[i] * dp[i] / q[i])[:, None] * d[i])
    plastic[i] -= (pulled[i] * shrunk[:, None, :]) @ pulled[i].transpose(0, 2, 1) / 2
    stress = to_components((axes * s[:, None, :]) @ axes.transpose(0, 2, 1), size)
    piola = ((axes * s[:, None, :]) @ pulled.transpose(0, 2, 1))[:, components[0], components[1]]
    for values in (stress, piola):
        values[lost] = np.nan

    def tangent() -> Array:
        # components of n_a x F^-1 n_b, points last as there are many of them
        along, back = (np.ascontiguousarray(A.transpose(2, 1, 0)) for A in (axes, pulled))
        basis = along[:, None, components[0]] * back[None, :, components[1]]
        found = np.einsum("abin,abjn->ijn", basis, _principal_tangent(change.T, d.T, s.T, a, c, basis)).transpose(2, 0, 1)
        found[lost] = np.nan
        return np.asarray(found)

    return Flowed(stress, piola, tangent, to_components(plastic, size), new, (s**2).sum(axis=1) / (4 * mu))


def _principal_tangent(change: Array, d: Array, s: Array, a: Array, c: Array, basis: Array) -> Array:
    """Derivative of the stress ``s F^-T F'`` by the velocity gradient in principal axes, times a basis ``(3, 3, n_components, n)``.

    Normal components are those of small strains, ``a (I - 1 x 1 / 3) - c d x d``, minus s. For shear components, with b the squares of
    the trial stretches and ``t = (s_i - s_j) / (b_i - b_j)``, component ij is ``t b_j`` by ij and ``t b_i - s_i`` by ji. ``change``,
    ``d`` and ``s`` are ``(3, n)``.
    """
    out = np.empty_like(basis)
    own = basis[[0, 1, 2], [0, 1, 2]]
    out[[0, 1, 2], [0, 1, 2]] = (
        (a - s)[:, None] * own - a / 3 * own.sum(axis=0) - d[:, None] * (c * np.einsum("an,ain->in", d, own))
    )
    for i, j in ((0, 1), (0, 2), (1, 2)):
        by_j, by_i = (a / 2 * logarithm_slope((change[k] - change[m]) / (1 + change[m])) for k, m in ((i, j), (j, i)))
        out[i, j] = by_j * basis[i, j] + (by_i - s[i]) * basis[j, i]
        out[j, i] = by_i * basis[j, i] + (by_i - s[i]) * basis[i, j]
    return out


def logarithm_slope(r: Array) -> Array:
    """``log(1 + r) / r``, 1 at 0, for a ratio 1 + r, without cancellation."""
    same = r == 0
    return np.where(same, 1.0, np.log1p(r) / np.where(same, 1.0, r))


def to_components(A: Array, size: int) -> Array:
    """Components of symmetric tensors ``(n, 3, 3)`` in the order of ``Returned``, ``(n, size)``."""
    rows, columns = SYMMETRIC_COMPONENTS[size]
    return A[:, rows, columns] * np.where(np.equal(rows, columns), 1.0, 2**0.5)


def to_tensors(v: Array) -> Array:
    """The tensors ``(n, 3, 3)`` of components ``(n, size)``."""
    rows, columns = SYMMETRIC_COMPONENTS[v.shape[1]]
    A = np.zeros((len(v), 3, 3))
    A[:, rows, columns] = A[:, columns, rows] = v / np.where(np.equal(rows, columns), 1.0, 2**0.5)
    return A
