"""The return to the yield surface against a general root finder, and its tangent against differences.

The test to read first is ``test_return_solves_the_equations_of_plasticity``.
"""

from __future__ import annotations

import numpy as np
import pytest
from plastic_scenes import FY, MU, NU, E, H
from scipy.optimize import root

from uem_dolfinx.materials import von_mises as plasticity

KINDS = {3: "plane_stress", 4: "plane_strain", 6: "3d"}
#: Of the yield stress and of the back stress.
HARDENING = [(0.0, 0.0), (0.5 * H, 0.5 * H), (H, 0.0)]
ONE = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])


# -- kernels -----------------------------------------------------------------------------------------------------------


def kernel(k: int):
    """The return of vectors with k components, of strain and committed history."""
    law = plasticity.plane_stress_return if k == 3 else plasticity.radial_return
    elastic = (E, NU) if k == 3 else (MU,)

    def returned(strain, plastic_strain, peeq, hardening=(H, 0.0)):
        n = len(strain)
        return law(strain, plastic_strain, peeq, *(np.full(n, x) for x in (*elastic, FY, *hardening)))

    return returned


def states(k: int, n: int = 40):
    """Strains from elastic to 20 times the yield strain, and histories that plastic flow can leave behind."""
    rng = np.random.default_rng(k)
    plastic = 0.01 * rng.standard_normal((n, k))
    if k > 3:
        plastic[:, :3] -= plastic[:, :3].mean(axis=1, keepdims=True)
    strain = plastic + FY / E * rng.standard_normal((n, k)) * rng.choice([0.1, 1.0, 20.0], (n, 1))
    return strain, plastic, 0.02 * rng.random(n)


def slow_return(strain, plastic, peeq, hardening):
    """Stress, plastic strain and peeq of one point from the equations of plasticity in 3D, by a general root finder.

    Unknown are the stress over FY, the strain across the plane where there is one, and the increment of peeq over the yield strain.
    The back stress grows along the normal: by ``kinematic`` times this increment in the von Mises measure.
    """
    k, unit, (isotropic, kinematic) = len(strain), FY / E, hardening
    inside = {3: [0, 1, 5], 4: [0, 1, 2, 5], 6: list(range(6))}[k]
    eps, before = np.zeros(6), np.zeros(6)
    eps[inside], before[inside] = strain, plastic
    if k == 3:
        before[2] = -before[0] - before[1]
    compliance = ((1 + NU) * np.eye(6) - NU * np.outer(ONE, ONE)) / E

    def mises(s):
        return np.sqrt(1.5) * np.linalg.norm(s - ONE * s[:3].mean())

    def state(x, flowing):
        s, across, dp = FY * x[:6], unit * x[6], unit * x[7] * flowing
        total = eps.copy()
        total[2] += across
        over = s - 2 / 3 * kinematic * before
        normal = 1.5 * (over - ONE * over[:3].mean()) / max(mises(over), 1e-300)
        return s, total, before + dp * normal, peeq + dp

    def equations(x, flowing):
        s, total, ep, p = state(x, flowing)
        hooke = (compliance @ s - total + ep) / unit
        plane = x[2] if k == 3 else x[6]
        surface = (mises(s - 2 / 3 * kinematic * ep) - FY - isotropic * p) / FY if flowing else x[7]
        return [*hooke, plane, surface]

    guess = np.zeros(8)
    for flowing in (False, True):
        solution = root(equations, guess, args=(flowing,), method="hybr", options={"xtol": 1e-13})
        s, _, ep, p = state(solution.x, flowing)
        assert np.abs(equations(solution.x, flowing)).max() < 1e-9
        driving, flow = mises(s - 2 / 3 * kinematic * ep), FY + isotropic * p
        if driving <= flow + 1e-9 * FY:
            break
        # start the flow from the elastic stress scaled back
        guess = solution.x.copy()
        guess[:6] *= flow / driving
        guess[7] = 0.5 * (driving / FY - 1)
    if k != 3:
        s = s - ONE * s[:3].mean()
    return s[inside], ep[inside], p


@pytest.mark.parametrize("hardening", HARDENING)
@pytest.mark.parametrize("k", KINDS)
def test_return_solves_the_equations_of_plasticity(k, hardening):
    given = states(k)
    fast = kernel(k)(*given, hardening)
    slow = [slow_return(*point, hardening) for point in zip(*given)]
    plastic = fast.peeq > given[2]
    assert 5 < plastic.sum() < len(plastic) - 5
    for values, reference, scale in zip((fast.stress, fast.plastic_strain, fast.peeq), zip(*slow), (FY, FY / E, FY / E)):
        assert np.abs(values - np.array(reference)).max() < 1e-7 * scale


@pytest.mark.parametrize("hardening", HARDENING)
@pytest.mark.parametrize("k", KINDS)
def test_tangent_is_derivative_of_the_stress(k, hardening):
    strain, *before = states(k)
    returned, h = kernel(k), 1e-6 * FY / E
    tangent = returned(strain, *before, hardening).tangent
    assert np.abs(tangent - tangent.transpose(0, 2, 1)).max() < 1e-14 * E
    for j in range(k):
        step = h * np.eye(k)[j]
        slope = (returned(strain + step, *before, hardening).stress - returned(strain - step, *before, hardening).stress) / (
            2 * h
        )
        assert np.abs(slope - tangent[:, :, j]).max() < 1e-6 * E
    # the plastic parts only soften
    elastic = returned(0 * strain, *(0 * x for x in before)).tangent
    assert np.linalg.eigvalsh(elastic - tangent).min() > -1e-12 * E
    assert np.linalg.eigvalsh(tangent).min() > -1e-12 * E


def test_plane_stress_return_converges_from_every_state():
    """The steps are bounded by far more than the worst of these states needs, whatever its scale and its path."""
    rng, n = np.random.default_rng(1), 20000
    scale, size = 10 ** rng.uniform(-3, 12, n), 10 ** rng.uniform(-6, 0, n)
    nu, hardening = rng.uniform(-0.9, 0.999, n), scale * rng.choice([0.0, 1e-3, 1.0, 10.0], n)
    strain = rng.standard_normal((n, 3)) * (size * 10 ** rng.uniform(0, 6, n))[:, None]
    strain[: n // 3] *= [1.0, 1.0, 0.0]
    strain[: n // 6, 1] = strain[: n // 6, 0]
    new = plasticity.plane_stress_return(strain, 0 * strain, np.zeros(n), scale, nu, scale * size, hardening, 0 * hardening)
    s = new.stress
    mises = np.sqrt(s[:, 0] ** 2 - s[:, 0] * s[:, 1] + s[:, 1] ** 2 + 1.5 * s[:, 2] ** 2)
    flows = new.peeq > 0
    assert flows.mean() > 0.9
    assert np.abs(mises / (scale * size + hardening * new.peeq) - 1)[flows].max() < 1e-10


def test_plane_strain_is_3d_held_across():
    """The plastic strain across the plane is part of the history, and the elastic one makes up for it."""
    strain, plastic, peeq = states(4)
    wide = [np.insert(x, [3, 3], 0.0, axis=1) for x in (strain, plastic)]
    plane, full = kernel(4)(strain, plastic, peeq), kernel(6)(*wide, peeq)
    for name in ("stress", "plastic_strain"):
        assert np.abs(np.insert(getattr(plane, name), [3, 3], 0.0, axis=1) - getattr(full, name)).max() < 1e-15
    assert np.abs(plane.plastic_strain[:, 2]).max() > FY / E
    assert np.abs(plane.plastic_strain[:, :3].sum(axis=1)).max() < 1e-15
