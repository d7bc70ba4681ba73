"""The exact solution of two-body Signorini contact, the orders of convergence it shows, and how methods are measured.

Two tests to read first: ``test_exact_solution_is_in_equilibrium`` and ``test_order_in_energy``.
"""

from __future__ import annotations

import math

from mpi4py import MPI

import numpy as np
import pytest
from benchmarks import measure
from benchmarks.problems import bar_impact, hertz_answer, hertz_cylinder, indenter
from benchmarks.signorini import Exact, signorini

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD
EXACT = Exact(c=1.3, nu=0.3)
STEP = 1e-5


def points(side):
    """Points inside of a body, away from the origin."""
    x, y = np.meshgrid(np.linspace(-0.9, 0.9, 8), np.linspace(0.1, 0.9, 5))
    return x.ravel(), side * y.ravel()


def differences(f, x, y):
    """Derivatives of the components of f by x and y, by central differences."""
    by_x = [(a - b) / (2 * STEP) for a, b in zip(f(x + STEP, y), f(x - STEP, y))]
    by_y = [(a - b) / (2 * STEP) for a, b in zip(f(x, y + STEP), f(x, y - STEP))]
    return by_x, by_y


@pytest.mark.parametrize("side", [1, -1])
def test_exact_solution_is_in_equilibrium(side):
    """div s = 0 in both bodies."""
    x, y = points(side)
    by_x, by_y = differences(lambda x, y: EXACT.stress(x, y, side), x, y)
    assert np.abs(by_x[0] + by_y[2]).max() < 1e-8
    assert np.abs(by_x[2] + by_y[1]).max() < 1e-8
    # each of the terms alone is far from zero
    assert np.abs(by_x[0]).max() > 0.1


@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("mu", [1.0, 250.0])
def test_exact_solution_obeys_hookes_law(side, mu):
    x, y = points(side)
    by_x, by_y = differences(lambda x, y: EXACT.displacement(x, y, side, mu), x, y)
    e_xx, e_yy, e_xy = by_x[0], by_y[1], (by_x[1] + by_y[0]) / 2
    lam = 2 * mu * EXACT.nu / (1 - 2 * EXACT.nu)
    s = EXACT.stress(x, y, side)
    for stress, strain in zip(s, (2 * mu * e_xx + lam * (e_xx + e_yy), 2 * mu * e_yy + lam * (e_xx + e_yy), 2 * mu * e_xy)):
        assert np.abs(stress - strain).max() < 1e-8


def test_exact_solution_satisfies_signorinis_conditions():
    """Gap or pressure, never both, no tension and no friction; both bodies feel the same."""
    x = np.linspace(-1, 1, 41)[np.arange(41) != 20]
    zero = np.zeros_like(x)
    up, low = (EXACT.displacement(x, zero, side, mu) for side, mu in ((1, 1.0), (-1, 7.0)))
    gap = up[1] - low[1]
    for side in (1, -1):
        xx, yy, xy = EXACT.stress(x, zero, side)
        assert np.abs(xy).max() == 0.0
        assert np.allclose(-yy, EXACT.pressure(x), atol=1e-15)
    assert (gap[x < 0] == 0.0).all() and (EXACT.pressure(x)[x < 0] > 0).all()
    assert (gap[x > 0] > 0).all() and (EXACT.pressure(x)[x > 0] == 0.0).all()
    weights, nodes = np.polynomial.legendre.leggauss(200)[::-1]
    assert (weights * EXACT.pressure(-(nodes + 1) / 2)).sum() / 2 == pytest.approx(EXACT.force, rel=1e-5)


def order(ratio, sizes, **how):
    """Errors of the united elements on two meshes, and the order between them."""
    found = [measure.measure(signorini(n, ratio=ratio, **how), "united", runs=0) for n in sizes]
    return found, measure.rate(found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ratio", "contactor"),
    [
        (1.0, "lower"), (1e3, "upper"),
        (1.0, "upper"), (1e3, "lower"),
    ],
)  # fmt: skip
def test_order_in_energy(ratio, contactor):
    """Linear elements with the finer body as contactor: 1; quadratic ones on matching meshes: 3/2, on graded ones 2."""
    found, linear = order(ratio, (8, 16), degree=1, finer=2.0, contactor=contactor)
    assert linear >= 0.95
    assert found[-1]["overlap"] < 1e-12
    assert found[-1]["error_force"] < 2e-3 and found[-1]["error_pressure"] < 0.02
    _, quadratic = order(ratio, (4, 8), degree=2, finer=1.0, contactor=contactor)
    assert quadratic >= 1.4
    if contactor == "upper":
        _, graded = order(ratio, (4, 8), degree=2, finer=1.0, graded=2.0)
        assert graded >= 1.8


def test_sides_and_bodies_do_not_matter():
    """The mirrored problem has the same errors."""
    (up,), (low,) = ([measure.measure(signorini(4, ratio=10.0, contactor=c), "united", runs=0)] for c in ("upper", "lower"))
    for key in ("error_energy", "error_l2", "error_pressure", "error_force"):
        assert up[key] == pytest.approx(low[key], rel=1e-6)


def test_every_method_solves_the_same_problem():
    """Multipliers and Uzawa's method find the united solution; a penalty comes nearer as it grows."""
    scene = signorini(4)
    united, lagrange = (measure.measure(scene, name, runs=0) for name in ("united", "lagrange"))
    uzawa = measure.measure(scene, "augmented", 10.0, runs=0)
    for other in (lagrange, uzawa):
        assert other["error_energy"] == pytest.approx(united["error_energy"], rel=1e-4)
    overlaps = [measure.measure(scene, "penalty", alpha, runs=0)["overlap"] for alpha in (10.0, 100.0, 1000.0)]
    assert overlaps[0] > 5 * overlaps[1] > 25 * overlaps[2] > 0.0


@pytest.mark.long
def test_indenter_is_exact_by_elimination():
    scene = indenter(4)
    assert measure.measure(scene, "united", runs=0)["error_energy"] < 1e-6
    soft, hard = (measure.measure(scene, "penalty", alpha, runs=0) for alpha in (1.0, 100.0))
    assert soft["error_energy"] > 10 * hard["error_energy"] > 1e-5


@pytest.mark.long
def test_energy_of_hertz_errors_does_not_reward_overlap():
    """The error in energy grows with the overlap, and falls with h."""
    answer = hertz_answer(1 / 60)
    coarse, fine = (hertz_cylinder(h, 1, answer) for h in (1 / 15, 1 / 30))
    united = [measure.measure(scene, "united", runs=0)["error_energy"] for scene in (coarse, fine)]
    assert 1.5 < united[0] / united[1] < 2.6
    overlapping = [measure.measure(fine, "penalty", alpha, runs=0)["error_energy"] for alpha in (1.0, 10.0, 1e4)]
    assert overlapping[0] > overlapping[1] > 0.99 * overlapping[2]
    assert overlapping[2] == pytest.approx(united[1], rel=0.02)


@pytest.mark.slow
def test_bar_impact_converges_to_the_wave():
    coarse, fine = (measure.measure(bar_impact(10, cfl), "united", runs=0) for cfl in (2.0, 1.0))
    assert fine["error_pressure"] < 0.25 and fine["error_force"] < 0.05
    assert fine["error_l2"] < coarse["error_l2"] and fine["overlap"] < 1e-9


def point(problem, method, seconds, error, parameter=None, dofs=100):
    return {
        "problem": problem, "degree": 1, "method": method, "parameter": parameter, "seconds": seconds, "error_energy": error,
        "dofs": dofs, "h": 1 / dofs,
    }  # fmt: skip


def test_table_names_the_first():
    some = [
        point("a", "united", 2.0, 5e-3), point("a", "united", 3.0, 5e-4, dofs=400), point("a", "penalty", 1.0, 9e-3, 10.0),
        point("a", "penalty", 0.5, 2e-2, 1.0), point("a", "broken", None, None),
    ]  # fmt: skip
    united, penalty, broken = measure.at_a_glance(some)
    assert united["1 %"].startswith("2 s") and not united["1 %"].endswith("*")
    assert penalty["1 %"].startswith("1 s") and penalty["1 %"].endswith("*")
    assert united["0.1 %"].startswith("3 s (400") and penalty["0.1 %"] == "-" and united["0.01 %"] == "-"
    assert broken["smallest error"] == "failed"


def test_times_for_the_same_error_are_interpolated():
    """Times that grow like 1/error^2, and one method's alone that ends at a larger error."""
    ours = [point("a", "united", 1e-4 / e**2, e) for e in (0.04, 0.02, 0.01)]
    theirs = [point("a", "penalty", 4e-4 / e**2, e, 10.0) for e in (0.05, 0.015)] + [point("a", "penalty", 9.0, 0.02, 1.0)]
    (row,) = measure.at_equal_error([*theirs, *ours, point("a", "broken", None, None), point("b", "united", 1.0, 0.1)])
    assert list(row) == ["scene", "error", "united", "penalty"] and row["error"] == 0.015
    assert row["united"] == pytest.approx(1e-4 / 0.015**2) and row["penalty"] == pytest.approx(4e-4 / 0.015**2)


def test_answers_that_are_less_accurate_decide_nothing():
    some = [point("a", "united", 2.0, 5e-4) | {"reference": 2e-3}]
    (row,) = measure.at_a_glance(some)
    assert row["1 %"] != "-" and row["0.1 %"] == "-"


def test_best_is_the_cheapest_of_those_that_are_as_good():
    assert measure.best([point("a", "m", 3.0, 1.0), point("a", "m", 1.0, 1.01), point("a", "m", 0.1, 2.0)])["seconds"] == 1.0
    assert measure.best([point("a", "m", None, None)]) is None


def test_sweep_tries_what_is_worth_it(monkeypatch):
    """A parameter that failed or was slow is dropped, and the last mesh gets the best one and the next."""
    tried = []

    def fake(scene, name, parameter, runs, *, progress):
        tried.append((scene, parameter))
        seconds = {1.0: 9.0, 10.0: 1.0, 100.0: None, 1e3: 1.0, 1e4: 1.0}[parameter]
        return point("a", name, seconds, None if seconds is None else 1 / parameter, parameter)

    monkeypatch.setattr(measure, "measure", fake)
    assert len(measure.sweep(lambda n: n, (1, 2, 3), ["penalty"], 5)) == len(tried) == 9
    assert [p for n, p in tried if n == 1] == list(measure.SWEEPS["penalty"])
    assert [p for n, p in tried if n == 2] == [10.0, 1e3, 1e4]
    assert [p for n, p in tried if n == 3] == [1e4]


def test_rate_is_the_power_of_h():
    some = [point("a", "m", 1.0, 0.3 * h**1.5, dofs=1 / h) for h in (0.5, 0.25, 0.125)]
    assert measure.rate(some) == pytest.approx(1.5)
    assert measure.rate(some[:1]) is None


def test_a_method_that_fails_is_a_point_without_errors(monkeypatch):
    def fail(*args, **options):
        raise uem.ConvergenceError("no", [])

    monkeypatch.setattr(measure.methods, "create", fail)
    found = measure.measure(signorini(2), "united", runs=0)
    assert found["failed"] == "ConvergenceError" and found["error_energy"] is None and found["seconds"] is None


def test_condition_numbers_are_for_one_rank():
    found = measure.measure(signorini(2), "united", runs=0)
    assert (found["condition"] is None) == (COMM.size > 1)
    assert found["condition"] is None or 10 < found["condition"] < 1e4
    assert math.isfinite(found["error_energy"])
