"""Heat through soft contact: the conductance gets the law's pressure and gap, and temperatures; against two bars in series.

Read first: ``test_two_bars_and_a_joint``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from heat_scenes import COLD, HOT, Bars, K
from helpers import highest, refused, run, slow
from scipy.optimize import brentq

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
E, NU = 1e3, 0.3
M, PRESS = E * (1 - NU) / ((1 + NU) * (1 - 2 * NU)), 0.02
ROUGH = uem.Exponential(2.0, 1e-2)
POWER = uem.PowerLaw(3.0, 1e-2, 2.0)


def of_state(p, g):
    """Through asperities in contact, by the pressure, and through what fills the gap."""
    return 0.05 * np.power(np.maximum(p, 0.0), 0.95) + 0.1 * np.exp(-g / 0.01)


def of_temperatures(p, g, T, t):
    """Better under pressure and where it is warm."""
    return 1e-3 * (1.0 + p) * (T + t) / 2.0


def joint(h, law, alpha=0.0, above=1.0):
    """Pressure and flux of two bars whose ends approach by PRESS, with a joint between them, by closed form."""

    def flux(p):
        g = gap(p)

        def left(q):
            T, t = HOT - q / (above * K), COLD + q / K
            return (h(p, g, T, t) if h is of_temperatures else h(p, g)) * (T - t) - q

        return brentq(left, 0.0, (HOT - COLD) / (1 / K + 1 / (above * K)), xtol=1e-13)

    def gap(p):
        return -law.h * (np.log(p / law.p0) if isinstance(law, uem.Exponential) else (p / law.p0) ** (1 / law.m))

    def left(p):
        q, beta = flux(p), alpha * E / (1 - 2 * NU)
        means = COLD + 0.5 * q / K + HOT - 0.5 * q / (above * K)
        return (2 * p - beta * means) / M - gap(p) - PRESS

    p = brentq(left, 1e-3, 200.0, xtol=1e-13)
    return p, flux(p)


CASES = [
    ("triangle", "node_to_surface", 1, 1), ("quadrilateral", "mortar", 2, 1), slow("triangle", "mortar", 1, 1),
    slow("quadrilateral", "node_to_surface", 2, 2), slow("tetrahedron", "mortar", 1, 1), slow("hexahedron", "node_to_surface", 1, 1),
]  # fmt: skip


@pytest.mark.parametrize("h, law", [(of_state, ROUGH), (of_temperatures, POWER)], ids=["state", "temperatures"])
@pytest.mark.parametrize(("cell", "coupling", "degree", "of_heat"), CASES)
def test_two_bars_and_a_joint(cell, coupling, degree, of_heat, h, law):
    """Pressure and flux are those of the closed form, bars that expand included; one side loses what the other gets."""
    n = 4 if coupling == "mortar" else 6
    how = {"cell": cell, "degree": degree, "of_heat": of_heat, "n": n, "coupling": coupling}
    how["sliding"] = "small" if law is POWER else "finite"
    # strains of degree 0 do not follow temperatures of degree 1
    alpha = 1e-5 if degree == 2 else 0.0
    bars = Bars(h, press=PRESS, normal=uem.SoftContact(law), alpha=alpha, above=3.0, **how)
    history = bars.problem.solve()
    p, q = joint(h, law, alpha, 3.0)
    assert bars.contact.max_pressure() == pytest.approx(p, rel=1e-7)
    assert highest(COMM, np.abs(bars.flux / q - 1.0)) < 1e-7
    # at gap 0 a power law has no stiffness
    assert bars.contact.heat_balance() < 1e-13 and len(history) <= (12 if law is POWER else 8)
    assert bars.ends() == pytest.approx([-q, q], rel=1e-5)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_without_expansion_it_is_exact(coupling):
    """Bars without expansion: pressure and flux to rounding of the steps, and errors that are squared."""
    bars = Bars(of_state, n=4 if coupling == "mortar" else 6, coupling=coupling, press=PRESS, normal=uem.SoftContact(ROUGH))
    history = bars.problem.solve()
    p, q = joint(of_state, ROUGH)
    assert bars.contact.max_pressure() == pytest.approx(p, rel=1e-10)
    assert highest(COMM, np.abs(bars.flux / q - 1.0)) < 1e-8
    residuals = [one.residual for one in history[2:]]
    assert len(residuals) > 2 and all(last <= 2.0 * before**2 for before, last in zip(residuals[:-1], residuals[1:]))


def test_a_number_conducts_where_it_presses():
    """A number conducts under pressure alone: none across an open gap of a law that ends there."""
    for press, q in ((PRESS, (HOT - COLD) / (2 / K + 1 / 0.5)), (0.0, 0.0)):
        bars = Bars(0.5, n=6, press=press, gap=0.0 if press else 0.05, normal=uem.SoftContact(POWER))
        run(bars.problem)
        assert highest(COMM, np.abs(bars.flux - q)) < 1e-8 * HOT


def test_a_rigid_target():
    """A bar on a rigid surface of a given temperature."""
    plane = uem.RigidPlane((0.0, 0.0), (0.0, 1.0))
    bars = Bars(of_state, n=3, press=PRESS, rigid=plane, normal=uem.SoftContact(ROUGH))
    run(bars.problem)
    p = brentq(lambda p: p / M + ROUGH.h * np.log(p / ROUGH.p0) - PRESS, 1e-3, 100.0, xtol=1e-14)
    h = of_state(p, -ROUGH.h * np.log(p / ROUGH.p0))
    assert highest(COMM, np.abs(bars.flux / ((HOT - COLD) / (1 / K + 1 / h)) - 1.0)) < 1e-7


@pytest.mark.parametrize("coupling", ["node_to_surface", slow("mortar")])
def test_general_contact(coupling):
    """One declaration of all surfaces conducts as a declared contact does: once."""
    law = uem.Exponential(2.0, 2e-3)
    bars = Bars(0.5, n=4 if coupling == "mortar" else 6, press=PRESS, normal=uem.SoftContact(law))
    heat = uem.Conductance(lambda p, g: 0.05 * p, field=1)
    contact = uem.GeneralContact(normal=uem.SoftContact(law), coupling=coupling, heat=heat)
    run(uem.UnitedProblem(bars.F, bars.f.w, displacement=0, bcs=bars.bcs, contacts=[contact]))
    p, q = joint(lambda p, g: 0.05 * p, law)
    assert contact.max_pressure() == pytest.approx(p, rel=1e-9)
    assert abs(contact.heat_power("body 2")) == pytest.approx(q, rel=1e-7)


def test_what_is_refused():
    """Equal temperatures, and heat of currents, which need constrained contactors."""
    soft = uem.SoftContact(ROUGH)
    for heat, words in (
        (uem.Conductance(np.inf, field=1), "heat with h = inf"),
        ([uem.Conductance(1.0, field=1, joule=2), uem.Conductance(1.0, field=2)], "heat with joule"),
    ):
        refused(uem.InputError, words, lambda heat=heat: uem.GeneralContact(normal=soft, heat=heat))
        refused(uem.InputError, words, lambda heat=heat: uem.Contact(1, 2, normal=soft, heat=heat))
