"""Return mapping in finite strain with kinematic hardening, with a back stress that is elastic in the plastic strain.

[Ortiz and Stainier, Computer Methods in Applied Mechanics and Engineering 171 (1999) 419-444, for the incremental potential; Bhatia,
Positive Definite Matrices, ch. 6, for the geometry]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.materials.hardening import Linear, YieldCurve
from uem_dolfinx.materials.logarithmic import (
    SYMMETRIC_COMPONENTS,
    Flowed,
    logarithm_slope,
    logarithmic_return,
    to_components,
    to_tensors,
)
from uem_dolfinx.materials.return_mapping import MAX_STEPS, ON_SURFACE, RETURNED


def kinematic_return(
    gradient: Array, plastic_strain: Array, peeq: Array, mu: Array, curve: YieldCurve, modulus: Array, components: Sequence[Ints]
) -> Flowed:
    """Return to the yield surface around the back stress ``2/3 modulus ln(V_p)``, V_p the plastic stretch.

    The plastic strain minimises

        mu |dev ln(V_e)|^2 + 1/3 modulus |ln(V_p)|^2 + integral of the yield stress over peeq

    With ``C_p = F_p^T F_p`` these terms are distances of C_p from C, from 1 and from its committed value in the geometry of positive
    tensors, in which such a sum is convex. The sum depends on C and C_p only, so not on rotations of the body or of F_p. If all
    principal axes agree, this is the radial return.

    Arguments as in ``logarithmic_return``, and ``modulus (n,)``, the increase of the back stress in uniaxial tension per plastic strain.
    Returns the same, with NaN also at points without convergence; ``energy`` includes the part of the back stress.
    """
    F, one = gradient + np.eye(3), np.eye(3)
    C, committed = F.transpose(0, 2, 1) @ F, one - 2 * to_tensors(plastic_strain)
    i = np.flatnonzero(np.isfinite(C).all(axis=(1, 2)))
    i = i[np.linalg.det(F[i]) > 0]
    points = Points(i, C[i], committed[i], mu[i], modulus[i], peeq[i])
    # F_p^-1 up to a rotation, which has no effect
    L = np.linalg.cholesky(committed[i])
    driving = points.driving(L)
    q = np.sqrt(1.5) * np.linalg.norm(driving, axis=(1, 2))
    beyond = np.flatnonzero(q > (1 + ON_SURFACE) * curve.at(points.peeq, i)[0])
    points, q = points.some(beyond), q[beyond]
    dp = curve.increment(q, points.peeq, 3 * points.mu + points.modulus, points.i)
    L = _minimised(points, curve, L[beyond] @ _exponential(-1.5 * (dp / q)[:, None, None] * driving[beyond]))
    plastic, new, i = plastic_strain.copy(), peeq.copy(), points.i
    plastic[i] = to_components((one - L @ L.transpose(0, 2, 1)) / 2, plastic.shape[1])
    found = np.flatnonzero(np.isfinite(L).all(axis=(1, 2)))
    points, i, L = points.some(found), i[found], L[found]
    step = points.step(L, curve)
    new[i] = step.peeq
    flowed = logarithmic_return(gradient, plastic, new, mu, Linear(np.full(len(mu), np.inf), np.zeros(len(mu))), components)
    strains = np.log1p(-2 * np.linalg.eigvalsh(to_tensors(np.where(np.isfinite(plastic), plastic, 0.0)))) / 2

    def tangent() -> Array:
        found, mixed = flowed.tangent(), points.mixed(L, F[i], components)
        found[i] -= mixed.transpose(0, 2, 1) @ np.linalg.solve(step.hessian, mixed)
        return found

    return replace(flowed, tangent=tangent, energy=flowed.energy + modulus / 3 * (strains**2).sum(axis=1))


def _minimised(points: Points, curve: YieldCurve, L: Array) -> Array:
    """Factors of ``C_p^-1`` at the minimum of the potential, by Newton's method; NaN without convergence ``(m, 3, 3)``.

    The iteration ends with steps below a part of the strains, or at rounding: small steps that no longer decrease.
    """
    L, left, last = L.copy(), np.arange(len(L)), np.full(len(L), np.inf)
    for _ in range(MAX_STEPS):
        if not len(left):
            break
        step = points.some(left).step(L[left], curve)
        S = -np.asarray(np.linalg.solve(step.hessian, step.slope[:, :, None])[:, :, 0], dtype=np.float64)
        L[left] = L[left] @ _exponential(-to_tensors(S))
        length, lost = np.linalg.norm(S, axis=1), ~np.isfinite(L[left]).all(axis=(1, 2))
        L[left[lost]] = np.nan
        rounding = (length >= last[left]) & (length <= RETURNED**0.5 * step.size)
        last[left] = length
        left = left[~((length <= RETURNED * step.size) | rounding | lost)]
    L[left] = np.nan
    return L


@dataclass(frozen=True)
class _Step:
    """Derivatives of the potential of a step at m points: by further flow ``(m, 6)`` and ``(m, 6, 6)``, with a term for the volume.

    With elastic and plastic strains ``(m, 6)``, the flow of length 1 and its length, the yield stress and its slope.
    """

    slope: Array
    hessian: Array
    peeq: Array
    elastic: Array
    plastic: Array
    flow: tuple[Array, Array]
    curve: tuple[Array, Array]

    @property
    def size(self) -> Array:
        """Norm of the elastic strain and of the flow ``(m,)``."""
        return np.asarray(np.linalg.norm(self.elastic, axis=1) + self.flow[1])


@dataclass(frozen=True)
class Points:
    """The potential of a step at m points as a function of a factor L of ``C_p^-1 = L L^T``.

    Flow by a deviator S changes L to ``L exp(-S)``. It changes the elastic strain ``E = ln(L^T C L) / 2`` by ``-K(E) S``, the plastic
    strain ``A = ln(V_p)`` by ``K(A) S`` and the plastic strain of the step, D, by ``K(D) S``. In the principal axes of a strain e,
    component ij of ``K(e) S`` is ``h coth(h) S_ij`` with ``h = e_i - e_j``.

    Attributes:
        mu, modulus, peeq: ``(m,)``, with the committed peeq.
    """

    i: Ints  # numbers of the points in the yield curve ``(m,)``
    C: Array  # right Cauchy-Green tensor ``(m, 3, 3)``
    committed: Array  # ``C_p^-1`` ``(m, 3, 3)``
    mu: Array
    modulus: Array
    peeq: Array

    def some(self, k: Ints) -> Points:
        """The points with these numbers."""
        return Points(*(getattr(self, field.name)[k] for field in fields(self)))

    def _elastic(self, L: Array) -> _Strain:
        return _Strain.of(L.transpose(0, 2, 1) @ self.C @ L)

    def _plastic(self, L: Array, since: Array) -> _Strain:
        """Plastic strain since a state with ``C_p^-1 = since``."""
        back = np.asarray(np.linalg.inv(L), dtype=np.float64)
        return _Strain.of(back @ since @ back.transpose(0, 2, 1))

    def flowed(self, L: Array) -> _Strain:
        """Plastic strain of the step."""
        return self._plastic(L, self.committed)

    def driving(self, L: Array) -> Array:
        """Deviator of the stress minus the back stress ``(m, 3, 3)``."""
        E, A = self._elastic(L).tensor, self._plastic(L, np.eye(3)).tensor
        deviator = E - np.trace(E, axis1=1, axis2=2)[:, None, None] / 3 * np.eye(3)
        return 2 * self.mu[:, None, None] * deviator - 2 / 3 * self.modulus[:, None, None] * A

    def step(self, L: Array, curve: YieldCurve) -> _Step:
        """Derivatives of the potential by flow from L."""
        E, A, D = self._elastic(L), self._plastic(L, np.eye(3)), self.flowed(L)
        elastic, plastic, flow = (to_components(strain.tensor, 6) for strain in (E, A, D))
        length = np.linalg.norm(flow, axis=1)
        peeq = self.peeq + np.sqrt(2 / 3) * length
        stress, hardening = curve.at(peeq, self.i)
        along, force = flow / length[:, None], np.sqrt(2 / 3) * stress
        stiff, back_stiff = 2 * self.mu, 2 / 3 * self.modulus
        slope = NO_VOLUME @ (back_stiff[:, None] * plastic - stiff[:, None] * elastic + force[:, None] * along).T
        line = along[:, :, None] * along[:, None, :]
        hessian = stiff[:, None, None] * (NO_VOLUME @ E.curvature @ NO_VOLUME + _VOLUME)
        hessian += back_stiff[:, None, None] * A.curvature + (force / length)[:, None, None] * (D.curvature - line)
        hessian += (2 / 3 * hardening)[:, None, None] * line
        return _Step(slope.T, hessian, peeq, elastic, plastic, (along, length), (stress, hardening))

    def mixed(self, L: Array, F: Array, components: Sequence[Ints]) -> Array:
        """Derivative of the slope by components of F ``(m, 6, c)``."""
        E, (rows, columns) = self._elastic(L), components
        turned = L @ E.axes
        # Q^T dE Q with the change dE of the elastic strain, for each component
        there, here = (F @ turned)[:, rows].transpose(1, 0, 2), turned[:, columns].transpose(1, 0, 2)
        change = there[..., :, None] * here[..., None, :]
        change = E.divided * (change + change.swapaxes(-1, -2)) / 2
        change = E.axes @ change @ E.axes.transpose(0, 2, 1)
        by = to_components(change.reshape(-1, 3, 3), 6).reshape(len(components[0]), -1, 6)
        return -2 * self.mu[:, None, None] * (NO_VOLUME @ by.transpose(1, 2, 0))


@dataclass(frozen=True)
class _Strain:
    """Half the logarithm of positive tensors: their eigenvalues ``(m, 3)``, its eigenvalues ``(m, 3)``, and axes ``(m, 3, 3)``."""

    squares: Array
    values: Array
    axes: Array

    @staticmethod
    def of(A: Array) -> _Strain:
        """The strain of tensors ``(m, 3, 3)``."""
        squares, axes = np.linalg.eigh(A)
        return _Strain(squares, np.log(squares) / 2, axes)

    @property
    def tensor(self) -> Array:
        """The strain tensors ``(m, 3, 3)``."""
        return (self.axes * self.values[:, None, :]) @ self.axes.transpose(0, 2, 1)

    @property
    def divided(self) -> Array:
        """Divided differences ``(ln b_i - ln b_j) / (b_i - b_j)`` of the tensor's eigenvalues ``(m, 3, 3)``."""
        of, by = self.squares[:, :, None], self.squares[:, None, :]
        return logarithm_slope((of - by) / by) / by

    @property
    def curvature(self) -> Array:
        """K, see ``Points`` ``(m, 6, 6)``."""
        rows, columns = SYMMETRIC_COMPONENTS[6]
        h = self.values[:, rows] - self.values[:, columns]
        weights = np.where(h == 0, 1.0, h / np.tanh(np.where(h == 0, 1.0, h)))
        pairs = self.axes[:, :, rows].transpose(2, 0, 1)[..., :, None] * self.axes[:, :, columns].transpose(2, 0, 1)[..., None, :]
        pairs = (pairs + pairs.swapaxes(-1, -2)) / np.where(np.equal(rows, columns), 2.0, 2**0.5)[:, None, None, None]
        basis = to_components(pairs.reshape(-1, 3, 3), 6).reshape(6, -1, 6).transpose(1, 2, 0)
        return (basis * weights[:, None, :]) @ basis.transpose(0, 2, 1)


#: Projections of the components of symmetric tensors onto the volumetric part and onto deviators. [format; components; -]
_VOLUME = np.outer([1, 1, 1, 0, 0, 0], [1, 1, 1, 0, 0, 0]) / 3
NO_VOLUME = np.eye(6) - _VOLUME


def _exponential(A: Array) -> Array:
    """Exponential of symmetric tensors ``(m, 3, 3)``; NaN if they are not finite."""
    sound = np.isfinite(A).all(axis=(1, 2), keepdims=True)
    values, axes = np.linalg.eigh(np.where(sound, A, 0.0))
    return np.where(sound, (axes * np.exp(values)[:, None, :]) @ axes.transpose(0, 2, 1), np.nan)
