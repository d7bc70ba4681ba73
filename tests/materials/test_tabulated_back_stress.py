"""Kinematic hardening by a table or a slope: the curve of tension, Masing's rule in cycles, and what is stored and refused.

The test to read first is ``test_cycles_of_a_bar``.
"""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, clamp, refused, rotation, slow
from plastic_scenes import FY, MU, NU, TABLE, E, H, Masing, block, reaction, spread, tangent_in_flow, wiggle
from scipy.optimize import brentq

import uem_dolfinx as uem
from uem_dolfinx.materials.layers import BackTable, Layers
from uem_dolfinx.materials.logarithmic import to_components, to_tensors
from uem_dolfinx.materials.return_mapping import Returned, plane_stress_return, radial_return

#: Slope of a linear back stress, and the table that it is as far as strains go.
K = 25.0
STRAIGHT = [(0.0, 0.0), (10.0, 10 * K)]


#: Strains of a bar over that of its yield: turns within turns, loops that close, and beyond all before.
TURNS = np.array([0.5, 8.0, -3.0, 4.0, -6.0, 30.0, -40.0]) * FY / E


# -- in problems -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "law, kind, given, table",
    [
        (uem.VonMises, "plane_stress", TABLE, TABLE), (uem.FinitePlasticity, "3d", TABLE, TABLE),
        slow(uem.VonMises, "3d", TABLE, TABLE), slow(uem.VonMises, "plane_stress", K, STRAIGHT), slow(uem.VonMises, "3d", K, STRAIGHT),
    ],
)  # fmt: skip
def test_cycles_of_a_bar(comm, law, kind, given, table):
    """Monotone it follows the table, reversed the curve twice as large; energy and dissipation add up to the work."""
    s, u = block(comm, "hexahedron" if kind == "3d" else "quadrilateral")
    V, g, finite = u.function_space, len(u), law is uem.FinitePlasticity
    material = law(u, E, NU, FY, kinematic_hardening=given, kind=kind)
    pulled = fem.Constant(s.mesh, 0.0)
    bcs = [bc for c in range(g) for bc in clamp(V, s.tag("roller", 0, at(c, 0.0)), c)]
    end = fem.locate_dofs_topological(V.sub(0), g - 1, s.tag("end", 0, at(0, 1.0)).entities)
    bcs.append(fem.dirichletbc(pulled, end, V.sub(0)))
    F = material.residual(ufl.TestFunction(V))
    problem = uem.UnitedProblem(F, u, bcs=bcs, materials=[material], petsc_options_prefix="bar_", rtol=1e-12)
    bar = Masing(table)
    for strain in TURNS:
        pulled.value = np.expm1(strain) if finite else strain
        problem.solve()
        stress = bar.to(strain)
        mean, scatter = spread(material, "stress")
        assert scatter < 1e-9 * FY and np.abs(mean[1:]).max() < 1e-9 * FY
        assert reaction(problem) == pytest.approx(stress * (-np.expm1(-strain) if finite else strain), abs=1e-11 * FY)
        assert mean[0] == pytest.approx(stress * np.exp(-(1 - 2 * NU) * stress / E) if finite else stress, abs=1e-9 * FY)
        plastic = material.cell_averages()["plastic_strain"].x.array.reshape(-1, 9)[:, [0, 4]]
        assert np.abs(plastic - bar.plastic * np.array([1.0, -0.5])).max(initial=0.0) < 1e-9 * FY / E
        assert material.energy() + material.dissipation() == pytest.approx(bar.work, rel=1e-9)
    assert material.dissipation() > 0.5 * bar.work
    wiggle(u, 0.03)
    material.update()
    tangent_in_flow(material, u)


# -- at points ---------------------------------------------------------------------------------------------------------


class Points:
    """Points of layers with a committed history, in small strain: k components, 3 of them are plane stress."""

    def __init__(self, n, k, table=TABLE, unit=1.0, nu=NU):
        self.E, self.nu, self.k = np.full(n, unit * E), np.full(n, nu), k
        self.mu = self.E / (2 * (1 + self.nu))
        table = BackTable.read([(p, unit * back) for p, back in table])
        self.layers = Layers.of(table, np.full(n, unit * FY), self.mu)
        j = self.layers.count
        self.plastic, self.peeq = np.zeros((n * j, max(k, 4))), np.zeros(n * j)

    def at(self, strain) -> Returned:
        before = strain, self.plastic, self.peeq
        if self.k == 3:
            return self.layers.plane_stress_return(*before, self.E, self.nu)
        return self.layers.radial_return(*before, self.mu)

    def to(self, strain) -> Returned:
        """Likewise, and committed."""
        found = self.at(strain)
        self.plastic, self.peeq = found.plastic_strain, found.peeq
        return found


def strains(k, size, n=100, seed=0):
    return FY / E * size * np.random.default_rng(seed).standard_normal((n, k))


@pytest.mark.parametrize("k", [4, 6])
def test_any_deviator_obeys_masing(k):
    """Along any direction of the strain's deviator, as shear and tension: to rounding."""
    points, bars = Points(20, k), [Masing(TABLE, 3 * MU) for _ in range(20)]
    way = strains(k, 1.0, 20)
    way[:, :3] -= way[:, :3].mean(axis=1, keepdims=True)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    for strain in TURNS:
        found = points.to(1.5**0.5 * strain * way)
        for bar in bars:
            bar.to(strain)
        assert np.abs(found.stress - (2 / 3) ** 0.5 * bars[0].stress * way).max() < 1e-14 * E
        plastic = points.layers.mean(points.plastic)
        assert np.abs(plastic - 1.5**0.5 * bars[0].plastic * way).max() < 1e-14


@pytest.mark.parametrize("k", [3, 4, 6])
def test_a_straight_line_is_prager_s_rule(k):
    """Along paths of random strains: two returns that have nothing in common but the answer."""
    points, zero = Points(100, k, STRAIGHT), np.zeros(100)
    plastic, peeq = np.zeros((100, k)), zero
    law, elastic = (plane_stress_return, (points.E, points.nu)) if k == 3 else (radial_return, (points.mu,))
    for step in range(6):
        strain = strains(k, 5.0, seed=step)
        one, layered = law(strain, plastic, peeq, *elastic, zero + FY, zero, zero + K), points.to(strain)
        plastic, peeq = one.plastic_strain, one.peeq
        of_body = points.layers.mean(points.plastic)
        assert np.abs(of_body[:, [0, 1, 3]] - plastic if k == 3 else of_body - plastic).max() < 1e-14
        assert np.abs(points.layers.mean(points.peeq) - peeq).max() < 1e-13
        for name, bound in (("stress", 1e-12 * FY), ("tangent", 1e-9 * E), ("energy", 1e-12 * FY)):
            assert np.abs(getattr(layered, name) - getattr(one, name)).max() < bound
    assert peeq.min() > 5 * FY / E


@pytest.mark.parametrize("k", [3, 6])
def test_tangent_is_derivative_of_the_stress(k):
    points = Points(100, k)
    points.to(strains(k, 4.0))
    strain, h = strains(k, 4.0, seed=1), 1e-6 * FY / E
    tangent = points.at(strain).tangent
    for j in range(k):
        step = h * np.eye(k)[j]
        slope = (points.at(strain + step).stress - points.at(strain - step).stress) / (2 * h)
        assert np.abs(slope - tangent[:, :, j]).max() < 2e-6 * E
    assert np.linalg.eigvalsh(tangent).min() > -1e-12 * E


@pytest.mark.parametrize("nu", [-0.5, 0.3, 0.4999])
def test_plane_stress_is_3d_free_across(nu):
    """Against a root finder for the strain across, from elastic states to 300 times the yield strain."""
    plane, full = Points(60, 3, nu=nu), Points(60, 4, nu=nu)
    plane.to(strains(3, 4.0, 60))
    full.plastic, full.peeq = plane.plastic, plane.peeq
    strain = strains(3, 1.0, 60, 1) * np.repeat([1.0, 10.0, 300.0], 20)[:, None]
    bulk, wide = E / (3 * (1 - 2 * nu)), np.insert(strain, 2, 0.0, axis=1)

    def stress(across):
        wide[:, 2] = across
        return full.at(wide).stress + bulk * wide[:, :3].sum(axis=1, keepdims=True) * np.array([1.0, 1.0, 1.0, 0.0])

    def misfit(x, i):
        return stress(np.where(np.arange(60) == i, x, 0.0))[i, 2]

    limit = 10 * np.abs(strain).max()
    across = [brentq(misfit, -limit, limit, (i,), xtol=1e-18, rtol=1e-15) for i in range(60)]
    found = plane.at(strain)
    assert np.abs(found.stress - stress(across)[:, [0, 1, 3]]).max() < 1e-8 * FY


def test_pose_and_units():
    """A turned path turns the stress; units that are powers of two change no digit."""
    still, turned, scaled = Points(100, 6), Points(100, 6), Points(100, 6, unit=2.0**40)
    Q = rotation(3, 1.0)
    for step in range(3):
        strain = strains(6, 5.0, seed=step)
        found, other = still.to(strain), turned.to(to_components(Q @ to_tensors(strain) @ Q.T, 6))
        assert np.abs(to_tensors(other.stress) - Q @ to_tensors(found.stress) @ Q.T).max() < 1e-12 * FY
        large = scaled.to(strain)
        assert np.array_equal(large.stress, 2.0**40 * found.stress) and np.array_equal(large.peeq, found.peeq)


def test_large_pure_shear_and_rotations():
    """Where axes stay, logarithmic strains obey the equations of small ones; turning the body turns the stress alone."""
    shears = np.array([0.3, -0.2, 0.1, 0.6])
    layers = Layers.of(BackTable.read(TABLE + [(0.5, 5 * FY)]), np.full(1, FY), np.full(1, MU))
    bar, Q = Masing(TABLE + [(0.5, 5 * FY)], 3 * MU), rotation(3, 2.0)
    histories = [(np.zeros((layers.count, 6)), np.zeros(layers.count))] * 2
    for shear in shears:
        F = np.diag(np.exp([shear, -shear, 0.0]))[None]
        flowed = [
            layers.logarithmic_return(G - np.eye(3), *before, np.full(1, MU), np.divmod(np.arange(9), 3))
            for G, before in zip((F, Q @ F), histories)
        ]
        histories = [(f.plastic_strain, f.peeq) for f in flowed]
        tau = bar.to(2 / 3**0.5 * shear) / 3**0.5
        here, there = (to_tensors(f.stress)[0] for f in flowed)
        assert np.abs(here - np.diag([tau, -tau, 0.0])).max() < 1e-12 * E
        assert np.abs(there - Q @ here @ Q.T).max() < 1e-12 * E


# -- what is refused ---------------------------------------------------------------------------------------------------


def test_points_on_a_straight_line():
    """Slopes that differ by rounding are one; those that rise are refused, those that fall make a layer."""
    for change, layers in ((5e-10, 1), (-5e-10, 1), (-5e-9, 2)):
        assert len(BackTable.read([(0, 0), (1, 1), (2, 2 + change), (3, 2 + change)]).strains) == layers + 1
    refused(uem.InputError, "the slope rises", lambda: BackTable.read([(0, 0), (1, 1), (2, 2 + 5e-9)]))
    assert len(BackTable.read([(0.0, 0.0), (0.1, 30.0), (0.3, 90.0)]).strains) == 2


PAIRS = "pairs (plastic strain, back stress) from (0, 0)"


@pytest.mark.parametrize(
    "given, words",
    [
        ({"kinematic_hardening": [(0.0, 0.0), (0.1, 1.0), (0.2, 0.5)]}, ("kinematic_hardening = [(0.0, 0.0)", PAIRS)),
        ({"kinematic_hardening": [(0.0, 0.0), (0.1, 1.0), (0.2, 3.0)]}, ("the slope rises from 10 to 20", "leave points out")),
        ({"kinematic_hardening": [(0.0, 1.0), (0.1, 2.0)]}, (PAIRS, "the initial yield stress")),
        ({"kinematic_hardening": [(0.0, 0.0), (0.1, -1.0)]}, (PAIRS,)),
        ({"kinematic_hardening": [(0.0, 0.0), (0.0, 1.0)]}, (PAIRS,)),
        ({"kinematic_hardening": [(0.0, 0.0), (0.1, np.nan)]}, (PAIRS,)),
        ({"kinematic_hardening": []}, ("kinematic_hardening = []", PAIRS)),
        ({"kinematic_hardening": [(0.0, 0.0)]}, (PAIRS,)),
        ({"kinematic_hardening": [("soft", 1.0)]}, ("kinematic_hardening = [('soft', 1.0)]", PAIRS)),
        ({"kinematic_hardening": "much"}, ("kinematic_hardening = 'much'", "0 or a positive number, or a table")),
        ({"kinematic_hardening": -1.0}, ("kinematic_hardening = -1.0", "0 or a positive number, or a table")),
        ({"kinematic_hardening": TABLE, "hardening": H}, ("isotropic hardening together with a table", "hardening = 0")),
        ({"kinematic_hardening": TABLE, "nu": 0.5, "kind": "plane_stress"}, ("nu = 0.5", "between -1 and 0.5")),
    ],
)
def test_bad_input_is_refused(comm, given, words):
    _, u = block(comm, "quadrilateral")
    good = {"E": E, "nu": NU, "yield_stress": FY, "kind": "plane_strain"}
    error = uem.InputTypeError if "soft" in words[0] or "much" in words[0] else uem.InputError
    for law in (uem.VonMises, uem.FinitePlasticity)[: 1 if "nu" in given else 2]:
        refused(error, words, lambda law=law: law(u, **good | given))
    if "hardening" in given:
        for hardening in ({"hardening": uem.Voce(1.0, 0.1)}, {"yield_stress": [(0.0, 1.0), (0.1, 2.0)], "hardening": 0.0}):
            refused(error, words, lambda hardening=hardening: uem.FinitePlasticity(u, **good | given | hardening))
