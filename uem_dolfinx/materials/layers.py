"""Tabulated kinematic hardening: parallel, perfectly plastic layers with the same strain and different yield stresses at every point.

[Besseling, Journal of Applied Mechanics 25 (1958) 529-536; Owen, Prakash and Zienkiewicz, Computers and Structures 4 (1974) 1251-1267]
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.errors import InputError
from uem_dolfinx.materials.hardening import Linear, read_pairs
from uem_dolfinx.materials.logarithmic import Flowed, logarithmic_return
from uem_dolfinx.materials.return_mapping import MAX_STEPS, RETURNED, Returned, radial_return

if TYPE_CHECKING:
    from uem_dolfinx.materials.return_slopes import ByReturn

#: Slopes of a table that differ by less than this part are one straight line.
#: [convention; slope; test_tabulated_back_stress.py::test_points_on_a_straight_line]
SAME_SLOPE = 1e-9
#: Components in the plane, of those in plane strain. [format; components; -]
OF_PLANE = [0, 1, 3]


@dataclass(frozen=True)
class BackTable:
    """Back stress over the plastic strain in uniaxial tension, both ``(j,)`` from 0: linear between points, constant after the last."""

    strains: Array
    stresses: Array

    @property
    def slopes(self) -> Array:
        """Slopes after each point ``(j,)``, which decrease."""
        return np.append(np.diff(self.stresses) / np.diff(self.strains), 0.0)

    @staticmethod
    def read(points: Any) -> BackTable:
        """The table of pairs (plastic strain, back stress), without intermediate points on straight lines.

        Raises InputTypeError or InputError for other objects, with the expected form.
        """
        expected = "pairs (plastic strain, back stress) from (0, 0), strains rising, stresses not falling, slopes not rising"
        strains, stresses = read_pairs("kinematic_hardening", points, expected)
        if len(strains) < 2 or stresses[0] != 0:
            remedy = "the back stress starts at 0; the initial yield stress is yield_stress"
            raise InputError(given.sentence("kinematic_hardening", points, expected, remedy))
        table = BackTable(strains, stresses)
        before, after = table.slopes[:-1], table.slopes[1:]
        rising = np.flatnonzero(after > (1 + SAME_SLOPE) * before)
        if len(rising):
            i = rising[0]
            why = f"beyond the plastic strain {strains[i + 1]:g} the slope rises from {before[i]:g} to {after[i]:g}"
            remedy = f"{why}: leave points out, or put that part of the hardening into a table as yield_stress"
            raise InputError(given.sentence("kinematic_hardening", points, expected, remedy))
        kept = np.append(True, after < (1 - SAME_SLOPE) * before)
        return BackTable(strains[kept], stresses[kept])


@dataclass(frozen=True)
class Layers:
    """j layers at each of n points. Arrays of layers have n j rows, with the layers of one point one after another.

    Layers have the elasticity of the body and, since flow is isochoric, its pressure. Their deviators in uniaxial tension are parallel.
    With the yield stress Y layer i yields at the deviatoric strain ``p_i + (Y + X_i) / (3 mu)`` of the i-th bend of the tabulated curve
    ``Y + X(p)``. The slope over this strain is ``3 mu`` times the weights of all layers that are still elastic, so that

        yield stress i = Y + X_i + 3 mu p_i,    sum of the weights up to i = 3 mu / (3 mu + slope after i).
    """

    weights: Array  # fractions of the body, of sum 1 ``(n, j)``
    curve: Linear  # yield stresses ``(n j,)``
    strains: Array  # plastic strains of the table ``(j,)``

    @staticmethod
    def of(table: BackTable, yield_stress: Array, mu: Array) -> Layers:
        """Layers with the uniaxial curve of ``yield_stress (n,)`` and the table; ``mu (n,)`` is the shear modulus."""
        stiff = 3 * mu[:, None]
        parts = stiff / (stiff + table.slopes)
        stresses = (yield_stress[:, None] + table.stresses + stiff * table.strains).ravel()
        return Layers(np.diff(parts, axis=1, prepend=0.0), Linear(stresses, np.zeros_like(stresses)), table.strains)

    @property
    def count(self) -> int:
        """Number of layers at each point, j."""
        return self.weights.shape[1]

    def repeat(self, values: Array) -> Array:
        """Values of points ``(n, ...)``, repeated for each layer ``(n j, ...)``."""
        return np.repeat(values, self.count, axis=0)

    def mean(self, values: Array) -> Array:
        """Weighted mean ``(n, ...)`` of values of layers ``(n j, ...)``."""
        each = values.reshape(*self.weights.shape, *values.shape[1:])
        return np.einsum("nj,nj...->n...", self.weights, each)

    def logarithmic_return(
        self, gradient: Array, plastic_strain: Array, peeq: Array, mu: Array, components: Sequence[Ints]
    ) -> Flowed:
        """Return of all layers in finite strain: their history ``(n j, k)`` and ``(n j,)``, and means for the body."""
        mu, gradient = self.repeat(mu), self.repeat(gradient)
        each = logarithmic_return(gradient, plastic_strain, peeq, mu, self.curve, components)
        stress, piola, energy = (self.mean(values) for values in (each.stress, each.first_piola, each.energy))
        return Flowed(stress, piola, lambda: self.mean(each.tangent()), each.plastic_strain, each.peeq, energy)

    def radial_return(self, strain: Array, plastic_strain: Array, peeq: Array, mu: Array) -> Returned:
        """Return of all layers: their history ``(n j, k)`` and ``(n j,)``, j vectors m, and means for the body."""
        mu, none = self.repeat(mu), np.zeros_like(peeq)
        each = radial_return(self.repeat(strain), plastic_strain, peeq, mu, self.curve.yield_stress, none, none)
        m = (np.sqrt(self.weights).reshape(-1, 1) * each.m).reshape(len(strain), self.count * strain.shape[1])
        stress, a, c, energy = (self.mean(values) for values in (each.stress, each.a, each.c, each.energy))
        return Returned(stress, each.plastic_strain, each.peeq, a, c, m, energy)

    def radial_back(self, strain: Array, plastic_strain: Array, peeq: Array, mu: Array, *by: Array) -> ByReturn:
        """Derivatives of ``radial_return``, whose arguments come first, as of ``return_slopes.radial_back``."""
        from uem_dolfinx.materials.return_slopes import radial_back

        none = np.zeros_like(peeq)
        begin = self.repeat(strain), plastic_strain, peeq, self.repeat(mu), self.curve.yield_stress, none, none
        return self._summed(radial_return(*begin).stress, partial(radial_back, *begin), mu, *by)

    def logarithmic_back(
        self, gradient: Array, plastic_strain: Array, peeq: Array, mu: Array, components: Sequence[Ints], *by: Array
    ) -> ByReturn:
        """Derivatives of ``logarithmic_return``, whose arguments come first, as of ``logarithmic_slopes.logarithmic_back``."""
        from uem_dolfinx.materials.return_slopes import logarithmic_back

        begin = self.repeat(gradient), plastic_strain, peeq, self.repeat(mu), self.curve, components
        return self._summed(logarithmic_return(*begin).first_piola, partial(logarithmic_back, *begin), mu, *by)

    def _summed(self, stress: Array, back: Callable[..., ByReturn], mu: Array, by_stress: Array, *by_history: Array) -> ByReturn:
        """Derivatives for the body from those of layers; their weights and yield stresses depend on mu, too."""
        from uem_dolfinx.materials.return_slopes import ByReturn

        each = back(self.weights.reshape(-1, 1) * self.repeat(by_stress), *by_history)
        n, j = self.weights.shape
        strain, shear, flow = (values.reshape(n, j, *values.shape[1:]) for values in (each.strain, each.shear, each.yield_stress))
        work = np.einsum("njk,nk->nj", stress.reshape(n, j, by_stress.shape[1]), by_stress)
        parts = np.cumsum(self.weights, axis=1)
        grown = np.diff(parts * (1 - parts), axis=1, prepend=0.0)
        none, by_shear = 0.0 * mu, (shear + grown * work).sum(axis=1) + 3 * mu * (flow @ self.strains)
        return ByReturn(strain.sum(axis=1), each.plastic_strain, each.peeq, by_shear, none, flow.sum(axis=1), none, none)

    def plane_stress_return(self, strain: Array, plastic_strain: Array, peeq: Array, E: Array, nu: Array) -> Returned:
        """Return of all layers with the same out-of-plane strain, for which the body's out-of-plane stress is zero.

        Args:
            strain: in the plane ``(n, 3)``.
            plastic_strain: committed, of layers, with the out-of-plane component, as in plane strain ``(n j, 4)``.
            peeq: committed, of layers ``(n j,)``.
            E: Young's modulus ``(n,)``.
            nu: Poisson's ratio ``(n,)``.

        Returns:
            Stress of the body in the plane, NaN without convergence; history of layers; j + 1 vectors m.
        """
        mu, bulk = E / (2 * (1 + nu)), E / (3 * (1 - 2 * nu))
        full, each, stiff, converged = self._free_across(strain, plastic_strain, peeq, mu, bulk)
        pressure, c, m = bulk * full[:, :3].sum(axis=1), each.c + bulk, each.m.reshape(len(full), self.count, 4)
        one = np.array([1.0, 1.0, 0.0])
        stress = each.stress[:, OF_PLANE] + pressure[:, None] * one
        stress[~converged] = np.nan
        # condensation of the out-of-plane strain: derivative of the stress in the plane by it
        mixed = c[:, None] * one - np.einsum("nj,njk->nk", m[:, :, 2], m[:, :, OF_PLANE])
        last = mixed / np.sqrt(stiff)[:, None]
        vectors = np.concatenate([m[:, :, OF_PLANE].reshape(len(full), 3 * self.count), last], axis=1)
        return Returned(stress, each.plastic_strain, each.peeq, each.a, c, vectors, each.energy + pressure**2 / (2 * bulk))

    def _free_across(
        self, strain: Array, plastic_strain: Array, peeq: Array, mu: Array, bulk: Array
    ) -> tuple[Array, Returned, Array, Bools]:
        """Strains ``(n, 4)`` without stress out of the plane, their return, that stress's slope ``(n,)``, and which are found ``(n,)``.

        The stress increases with the strain: Newton's method, safeguarded by lower and upper bounds of the strain.
        """
        full = np.insert(strain, 2, 0.0, axis=1)
        low, high = np.full(len(strain), -np.inf), np.full(len(strain), np.inf)
        # initial guess: elastic step
        step = 2 * mu * self.mean(plastic_strain)[:, 2] - (bulk - 2 / 3 * mu) * strain[:, :2].sum(axis=1)
        step /= bulk + 4 / 3 * mu
        for _ in range(MAX_STEPS):
            full[:, 2] += step
            each = self.radial_return(full, plastic_strain, peeq, mu)
            stiff = each.a + each.c + bulk - (each.m.reshape(len(full), self.count, 4)[:, :, 2] ** 2).sum(axis=1)
            converged = np.abs(step) <= RETURNED * np.linalg.norm(full, axis=1)
            if converged.all():
                break
            across, now = each.stress[:, 2] + bulk * full[:, :3].sum(axis=1), full[:, 2]
            low, high = np.where(across < 0, now, low), np.where(across > 0, now, high)
            step = -across / stiff
            i = np.flatnonzero((now + step < low) | (now + step > high))
            step[i] = (low[i] + high[i]) / 2 - now[i]
        return full, each, stiff, converged

    def plane_stress_back(
        self, strain: Array, plastic_strain: Array, peeq: Array, E: Array, nu: Array, by_stress: Array, *by_history: Array
    ) -> ByReturn:
        """Derivatives of ``plane_stress_return``, whose arguments come first: those of ``radial_return`` at the strain that it finds.

        The stress across, which vanishes, has the multiplier that makes the derivative by the strain across zero.
        """
        mu, bulk = E / (2 * (1 + nu)), E / (3 * (1 - 2 * nu))
        full, _, stiff, _ = self._free_across(strain, plastic_strain, peeq, mu, bulk)
        of_deviator, of_pressure = np.insert(by_stress, 2, 0.0, axis=1), by_stress[:, :2].sum(axis=1)
        back = partial(self.radial_back, full, plastic_strain, peeq, mu)
        of_deviator[:, 2] = -(back(of_deviator, *by_history).strain[:, 2] + bulk * of_pressure) / stiff
        by, pressed = back(of_deviator, *by_history), bulk * (of_pressure + of_deviator[:, 2])
        by.strain[:, :2] += pressed[:, None]
        # the bulk modulus is 2 area shear / 3 (3 shear - area)
        of_bulk, area, shear = pressed * full[:, :3].sum(axis=1), E / (1 - nu), E / (1 + nu)
        part = of_bulk / (3 * shear - area)
        return replace(by, strain=by.strain[:, OF_PLANE], shear=by.shear - area * part, area=3 * shear * part)
