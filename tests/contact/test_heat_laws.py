"""Conductances of both temperatures, as of radiation, and heat of electric currents through a contact, against closed forms.

Read first: ``test_radiation_across_a_gap``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from heat_scenes import COLD, HOT, Bars, Joint, K
from helpers import factors, highest, refused, run, slow
from scipy.optimize import brentq

import uem_dolfinx as uem
from uem_dolfinx.solve.bodies.tangent import slip_terms

COMM = MPI.COMM_WORLD
#: emissivity times the constant of Stefan and Boltzmann, in units in which gap and bars resist alike
RADIATION = 5e-8


def radiation(p, g, T, T_target):
    """Between surfaces so close that each faces the other alone."""
    return RADIATION * (T**2 + T_target**2) * (T + T_target)


def flux_through(power, resistance=1.0 / K):
    """Flux from HOT to COLD through two bars and a joint whose flux is a function of both its temperatures."""
    return brentq(
        lambda q: power(HOT - resistance * q, COLD + resistance * q) - q, 0.0, 0.5 * (HOT - COLD) / resistance, xtol=1e-13
    )


CASES = [
    ("triangle", "node_to_surface", 1, 1), ("triangle", "mortar", 2, 2), slow("triangle", "mortar", 1, 1),
    slow("quadrilateral", "mortar", 2, 1), slow("tetrahedron", "node_to_surface", 2, 2), slow("hexahedron", "mortar", 1, 1),
]  # fmt: skip


@pytest.mark.parametrize(("cell", "coupling", "degree", "of_heat"), CASES)
def test_radiation_across_a_gap(cell, coupling, degree, of_heat):
    """The flux is that of two bars and radiation in series, after Newton's steps whose errors are squared; one side loses what one gets."""
    n = 3 if coupling == "node_to_surface" else 4
    bars = Bars(radiation, cell=cell, degree=degree, of_heat=of_heat, n=n, coupling=coupling, gap=0.1, press=0.0)
    history = bars.problem.solve()
    flux = flux_through(lambda T, t: RADIATION * (T**4 - t**4))
    assert highest(COMM, np.abs(bars.flux / flux - 1.0)) < 1e-10
    assert len(history) <= 6 and max(factors(history)) < 1.0
    assert bars.contact.heat_balance() < 1e-14 and bars.contact.n_active == 0


@pytest.mark.parametrize("coupling", ["node_to_surface", slow("mortar")])
def test_conductance_in_contact_by_temperature(coupling):
    """A joint whose paste conducts better when it is warm, by the mean of both sides, and by one side alone."""
    for h, law in (
        (lambda p, g, T, t: np.where(g > 0, 0.0, 0.01 * (T + t)), lambda T, t: 0.01 * (T + t) * (T - t)),
        (lambda p, g, T, t: np.where(g > 0, 0.0, 0.02 * t), lambda T, t: 0.02 * t * (T - t)),
    ):
        bars = Bars(h, coupling=coupling, n=3 if coupling == "node_to_surface" else 4)
        history = bars.problem.solve()
        assert highest(COMM, np.abs(bars.flux / flux_through(law) - 1.0)) < 1e-7
        residuals = [one.residual for one in history[2:]]
        assert all(last <= 0.5 * before**2 for before, last in zip(residuals[:-2], residuals[1:-1]))


@pytest.mark.parametrize(("coupling", "degree"), [("mortar", 2), slow("mortar", 1), slow("node_to_surface", 2)])
def test_conductance_of_a_film(coupling, degree):
    """A film between even surfaces conducts by its thickness, the gap, which is the same at all contactors."""
    n = 3 if coupling == "node_to_surface" else 4
    bars = Bars(lambda p, g: 10.0 / np.maximum(g, 1e-3), degree=degree, n=n, coupling=coupling, gap=0.1, press=0.0)
    bars.problem.solve()
    assert highest(COMM, np.abs(bars.contact.gap.x.array[bars.contact.nodes] / 0.1 - 1.0)) < 1e-12
    assert highest(COMM, np.abs(bars.flux / flux_through(lambda T, t: 100.0 * (T - t)) - 1.0)) < 1e-10


def test_radiation_to_a_rigid_surface():
    """A bar, hot at its top, faces a surface of a given temperature."""
    joint = Bars(radiation, gap=0.5, press=0.0, rigid=uem.RigidPlane((0.0, 0.4), (0.0, 1.0)))
    joint.problem.solve()
    flux = brentq(lambda q: RADIATION * ((HOT - q / K) ** 4 - COLD**4) - q, 0.0, K * HOT, xtol=1e-13)
    assert highest(COMM, np.abs(joint.flux / flux - 1.0)) < 1e-10


def heats(h, Q, share):
    """Temperatures of both sides of a joint with heat Q per area between two bars that are cold at their ends."""
    return np.linalg.solve([[K + h, -h], [-h, K + h]], [K * COLD + share * Q, K * COLD + (1.0 - share) * Q])


@pytest.mark.parametrize(
    ("cell", "coupling", "degree"),
    [
        ("triangle", "node_to_surface", 1),
        ("triangle", "mortar", 2),
        slow("tetrahedron", "mortar", 1),
        slow("hexahedron", "node_to_surface", 1),
    ],
)  # fmt: skip
def test_current_that_heats_its_joint(cell, coupling, degree):
    """Resistances in series give the current, and its work at the joint the temperatures, by the share of each side."""
    h, s, share, sigma = 3.0, 0.8, 0.3, 0.5
    joint = Joint(h, s, cell=cell, degree=degree, coupling=coupling, share=share, n=3 if coupling == "node_to_surface" else 4)
    joint.problem.solve()
    current = 10.0 / (2.0 / sigma + 1.0 / s)
    made = current**2 / s
    assert joint.contact.heat_power_of(2) == pytest.approx(current, rel=1e-10)
    assert joint.contact.joule_power == pytest.approx(made, rel=1e-10)
    assert joint.sides(1) == pytest.approx(heats(h, made, share), rel=1e-10)
    assert joint.contact.heat_balance() < 1e-13


@pytest.mark.long
def test_conductance_of_the_current_by_temperature():
    """A joint that resists more when it is warm: temperature and current solve one scalar equation."""
    h, sigma = 3.0, 0.5
    s = lambda p, g, T, t: np.where(g > 0, 0.0, 600.0 / (400.0 + T + t))  # noqa: E731
    joint = Joint(h, s, of_field=1)
    history = joint.problem.solve()

    def difference(T):
        resistance = (400.0 + 2.0 * T) / 600.0
        return COLD + 0.5 * (10.0 / (2.0 / sigma + resistance)) ** 2 * resistance / K - T

    warm = brentq(difference, COLD, 2.0 * COLD, xtol=1e-13)
    assert joint.sides(1) == pytest.approx((warm, warm), rel=1e-7)
    assert len(history) <= 6 and max(factors(history)) < 1.0


@pytest.mark.parametrize(("coupling", "degree"), [("node_to_surface", 1), ("mortar", 1), slow("mortar", 2)])
def test_the_tangent_is_the_residuals_derivative(coupling, degree):
    """By temperatures and potentials on bent surfaces, for laws of all arguments and the heat of the current, against differences."""
    joint = Joint(
        lambda p, g, T, t: 3.0 + 1e-2 * T + 2e-5 * t**2, lambda p, g, T, t: 0.8 + 1e-3 * T - 4e-4 * t, of_field=1, coupling=coupling,
        degree=degree, n=4, pose=lambda x: x + 0.1 * np.sin(2.0 * x[:, ::-1]),
    )  # fmt: skip
    joint.problem.solve()
    config, w = joint.problem.config, joint.f.w
    residual = lambda: sum(heat.residual() for heat in joint.contact.pair.heats)  # noqa: E731
    way = fem.Function(w.function_space)
    way.sub(1).interpolate(lambda x: 10.0 * np.sin(5.0 * x[0]) + 10.0 * x[1] ** 2)
    way.sub(2).interpolate(lambda x: np.cos(4.0 * x[0]) * x[1])
    way.x.scatter_forward()
    H, _ = slip_terms(joint.problem.pairs, config.unknowns.vector())
    by = H * config.unknowns.vector(config.rows(way.x.array[: len(config.unknowns.place)]))
    start, found = np.array(w.x.array), []
    for sign in (1.0, -1.0):
        w.x.array[:] = start + sign * 1e-4 * way.x.array
        found.append(residual())
    w.x.array[:] = start
    assert highest(COMM, np.abs((found[0] - found[1]) / 2e-4 - by.array_r)) < 1e-6 * by.norm() and by.norm() > 0.0


@pytest.mark.parametrize("coupling", ["node_to_surface", slow("mortar")])
def test_newtons_method_is_quadratic(coupling):
    """A current through a joint that conducts by its pressure, which heat and current both do."""
    joint = Joint(lambda p, g: 0.1 * p, lambda p, g: 0.02 * p, coupling=coupling, n=4, press=0.02, alpha=1e-4, sliding="fixed")
    joint.problem.solve()
    joint.volt.value = 15.0
    history = joint.problem.solve()
    assert len(history) <= 5 and max(factors(history)) < 1.0
    assert joint.contact.joule_power > 0.0


def test_general_contact_conducts_where_it_touches():
    """A law of temperatures that vanishes across gaps, as a contact that is declared; radiation would need the facets far away."""
    flux = flux_through(lambda T, t: 0.01 * (T + t) * (T - t))

    def made(h):
        bars = Bars(5.0)
        general = uem.GeneralContact([bars.b.low, bars.b.high], heat=uem.Conductance(h, field=1))
        return general, uem.UnitedProblem(bars.F, bars.f.w, displacement=0, bcs=bars.bcs, contacts=[general])

    general, problem = made(lambda p, g, T, t: np.where(g > 0, 0.0, 0.01 * (T + t)))
    problem.solve()
    first, second = sorted(general.bodies) or ("body 1", "body 2")
    assert abs(general.heat_power(first, second)) == pytest.approx(flux, rel=1e-6)
    refused(uem.InputError, ("h(0, g)", "touch alone"), lambda: run(made(radiation)[1]))


def test_what_is_refused():
    """Each with what to do instead."""
    refused(uem.InputError, ("joule = 1", "heated field itself"), lambda: uem.Conductance(1.0, field=1, joule=1))
    refused(uem.InputError, ("of_field", "leave it out"), lambda: uem.Conductance(lambda p, g: p, field=1, of_field=2))
    refused(uem.InputError, ("joule_share = 2", "from 0 to 1"), lambda: uem.Conductance(1.0, field=1, joule=2, joule_share=2.0))
    alone = uem.Conductance(1.0, field=1, joule=2)
    refused(uem.InputError, ("joule = 2", "field=2"), lambda: uem.Contact("a", "b", heat=alone))
    twice = [alone, uem.Conductance(1.0, field=1, joule=2), uem.Conductance(1.0, field=2)]
    refused(uem.InputError, ("2 conductances of field 1", "joule"), lambda: uem.Contact("a", "b", heat=twice))
    refused(uem.InputError, ("h(p, g, T, T_target)", "0 or"), lambda: run(Bars(lambda p, g, T, t: -T).problem))
