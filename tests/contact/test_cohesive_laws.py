"""Cohesive laws on arrays of openings: their energies, tangents, unloading and mixed modes.

The test to read first is ``test_a_separation_takes_the_energy``.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers import refused

import uem_dolfinx as uem
from uem_dolfinx.contact.laws.cohesive import Response

LAWS, UNLOADINGS = ("bilinear", "exponential"), ("origin", "plastic")
MIXED = [None, uem.BenzeggaghKenane(2.1), uem.Power(1.0), uem.Power(2.0)]


def cohesive(mixed=None, **how):
    """Twice as strong, and four times as tough, in shear as in opening, or alike."""
    shear = {} if mixed is None else {"shear_strength": 4.0, "shear_energy": 4.0, "mixed": mixed}
    return uem.Cohesive(2.0, 1.0, **shear, **how)


def intact(n, g):
    return Response(*(np.zeros(0),) * 3, np.zeros(n), np.zeros(n), np.zeros((n, g)))


def strip(law, B, sizes, kept=None):
    """Equivalent tractions while openings of a share B of shear grow to these sizes, and the last response."""
    way, n = np.array([[np.sqrt(B), np.sqrt(1.0 - B)]]), np.array([[0.0, 1.0]])
    now, t = kept or intact(1, 2), []
    for size in sizes:
        now = law.respond(size * way, n, now, 1.0)
        t.append(float(now.traction[0] @ way[0]))
    return np.array(t), now


@pytest.mark.parametrize("unloading", UNLOADINGS)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("mixed", MIXED, ids=repr)
def test_a_separation_takes_the_energy(mixed, law, unloading):
    """By Gauss's rule between the kinks, in opening, in shear and between: to 1e-6; the largest traction is the strength."""
    c = cohesive(mixed, law=law, unloading=unloading)
    for B in (0.0, 0.3, 1.0):
        if mixed is None:
            s, G = 2.0, 1.0
        elif isinstance(mixed, uem.Power):
            s, G = (((1 - B) / a) ** mixed.a + (B / b) ** mixed.a for a, b in ((4.0, 16.0), (1.0, 4.0)))
            s, G = s ** (-0.5 / mixed.a), G ** (-1.0 / mixed.a)
        else:
            s, G = np.sqrt(4.0 + 12.0 * B**mixed.eta), 1.0 + 3.0 * B**mixed.eta
        onset, last = s / c.stiffness, 2.0 * G / s
        ends = [0.0, onset, last] if law == "bilinear" else [0.0, onset, *(onset + last * np.arange(1, 16))]
        x, w = np.polynomial.legendre.leggauss(16)
        at = np.concatenate([a + 0.5 * (b - a) * (x + 1) for a, b in zip(ends, ends[1:])])
        weight = np.concatenate([0.5 * (b - a) * w for a, b in zip(ends, ends[1:])])
        t, now = strip(c, B, at)
        assert t @ weight == pytest.approx(G, rel=1e-6)
        assert strip(c, B, [onset])[0] == pytest.approx([s], rel=1e-12)
        assert t.max() <= s and strip(c, B, [1.001 * ends[-1]], now)[1].damage[0] > 1.0 - 1e-6


@pytest.mark.parametrize("law", LAWS)
def test_unloading(law):
    """To the origin along the damaged secant; plastic with the first stiffness, to a permanent opening; and back onto the curve."""
    for unloading in UNLOADINGS:
        c = cohesive(law=law, unloading=unloading)
        (t,), there = strip(c, 0.0, [0.4])
        (less,), half = strip(c, 0.0, [0.4 - 0.5 * t / c.stiffness], there)
        slope = t / 0.4 if unloading == "origin" else c.stiffness
        assert less == pytest.approx(t - slope * 0.5 * t / c.stiffness, rel=1e-12)
        assert half.damage[0] == there.damage[0] > 0.0
        assert strip(c, 0.0, [0.4], half)[0] == pytest.approx([t], rel=1e-10)
        (rest,), _ = strip(c, 0.0, [0.4 - t / c.stiffness], there)
        assert abs(rest) < 1e-12 or unloading == "origin"


@pytest.mark.parametrize("gdim", [2, 3])
@pytest.mark.parametrize("unloading", UNLOADINGS)
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("mixed", MIXED, ids=repr)
def test_the_tangent_is_the_derivative(mixed, law, unloading, gdim):
    """From damaged states, loading and unloading in any direction, by differences; also with viscosity."""
    rng, n, h = np.random.default_rng(1), 100, 1e-7
    normal = rng.normal(size=(n, gdim))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    for viscosity in (0.0, 0.3) if unloading == "origin" else (0.0,):
        c = cohesive(mixed, law=law, unloading=unloading, viscosity=viscosity)
        w = 0.3 * rng.normal(size=(n, gdim))
        kept = c.respond(w, normal, intact(n, gdim), 1.0)
        w = w + rng.choice([0.3, 0.3 if unloading == "origin" else 1e-3], size=(n, 1)) * rng.normal(size=(n, gdim))
        now = c.respond(w, normal, kept, 0.1)
        off = []
        for j, e in enumerate(h * np.eye(gdim)):
            ahead, behind = (c.respond(w + s * e, normal, kept, 0.1).traction for s in (1, -1))
            size = c.stiffness * 1e-3 + np.abs(now.tangent).max(axis=(1, 2))
            off.append(np.abs((ahead - behind) / (2 * h) - now.tangent[:, :, j]).max(axis=1) / size)
        # a few lie at a kink
        assert np.sort(np.max(off, axis=0))[-4] < 1e-5
        assert (now.damage > kept.damage).sum() > 20 and (now.damage == kept.damage).sum() > 9


def test_viscosity_delays_damage():
    """Damage that is held at D acts as ``D (1 - (1 + dt / eta)^-k)`` after k steps, the backward rule."""
    c, w, n = cohesive(viscosity=0.5), np.array([[0.0, 0.5]]), np.array([[0.0, 1.0]])
    now = intact(1, 2)
    for k in range(1, 5):
        now = c.respond(w, n, now, 0.1)
        assert now.delayed[0] == pytest.approx(now.damage[0] * (1.0 - 1.2**-k), rel=1e-12)


def test_the_stiffness_before_damage():
    """A hundred times strength^2 / (2 energy), of the harder mode; the usual strength in shear makes it that of both."""
    tough = uem.Cohesive(2.0, 1.0, shear_energy=4.0, mixed=MIXED[1])
    assert tough.shear_strength == pytest.approx(4.0) and tough.stiffness == pytest.approx(200.0)
    assert uem.Cohesive(2.0, 1.0).stiffness == pytest.approx(200.0)
    assert cohesive(MIXED[1]).stiffness == pytest.approx(200.0)


def test_what_is_refused():
    """Numbers out of their range, and what is not said, are named."""
    refused(uem.InputError, "mixed = None", lambda: uem.Cohesive(1.0, 1.0, shear_energy=2.0))
    refused(uem.InputError, "too small", lambda: uem.Cohesive(1.0, 1.0, stiffness=1.0))
    refused(uem.InputError, "viscosity does not go", lambda: uem.Cohesive(1.0, 1.0, unloading="plastic", viscosity=1.0))
    refused(uem.InputError, "eta", lambda: uem.BenzeggaghKenane(0.5))
    refused(uem.InputError, "energy", lambda: uem.Cohesive(1.0, -1.0))
    refused(uem.InputTypeError, "mixed", lambda: uem.Cohesive(1.0, 1.0, mixed=2.0))
