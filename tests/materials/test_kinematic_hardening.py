"""Kinematic hardening in finite strain: cycles in closed form, simple shear, rotations, tangents, and what is stored.

The test to read first is ``test_a_bar_drawn_and_pushed``.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, clamp, raised, refused, rotation, slow
from plastic_scenes import FY, MU, NU, E, H, block, deform, reaction, spread, tangent_in_flow, to_flow, wiggle
from scipy.optimize import brentq

import uem_dolfinx as uem
from uem_dolfinx.materials.back_stress import kinematic_return
from uem_dolfinx.materials.hardening import Linear
from uem_dolfinx.materials.logarithmic import Flowed, logarithmic_return, to_tensors

#: Slope of the back stress.
K = 25.0
CURVES = {"none": (0.0, lambda p: FY + 0 * p), "voce": (uem.Voce(FY, 0.1, H), lambda p: FY * (2 - np.exp(-p / 0.1)) + H * p)}


# -- in problems -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("isotropic", ["none", slow("voce")])
def test_a_bar_drawn_and_pushed(comm, isotropic):
    """The logarithmic strain obeys the equations of small strains: it yields early on the way back, and stores what they say."""
    s, u = block(comm, "hexahedron")
    V, (hardening, flow) = u.function_space, CURVES[isotropic]
    material = uem.FinitePlasticity(u, E, NU, FY, hardening, kinematic_hardening=K)
    pulled = fem.Constant(s.mesh, 0.0)
    bcs = [bc for c in range(3) for bc in clamp(V, s.tag("roller", 0, at(c, 0.0)), c)]
    end = fem.locate_dofs_topological(V.sub(0), 2, s.tag("end", 0, at(0, 1.0)).entities)
    bcs.append(fem.dirichletbc(pulled, end, V.sub(0)))
    F = material.residual(ufl.TestFunction(V))
    problem = uem.UnitedProblem(F, u, bcs=bcs, materials=[material], petsc_options_prefix="bar_", rtol=1e-11)
    plastic, p, yielded = 0.0, 0.0, []
    # from twice the length back by 1.9 and 2.1 of the yield stress: within the surface, and beyond it where it has not grown
    back = [2.0 * np.exp(-part * FY / E) for part in (1.9, 2.1)]
    for stretch in (1.3, 2.0, *back, 1.4, 1.0, 0.7, 1.2):
        pulled.value = stretch - 1
        problem.solve()
        driving = E * (np.log(stretch) - plastic) - K * plastic
        over, dp = abs(driving) - flow(p), 0.0
        if over > 0:
            dp = brentq(
                lambda dp: abs(driving) - (E + K) * dp - flow(p + dp), 0.0, 1.001 * over / (E + K), xtol=1e-16, rtol=1e-14
            )
        yielded.append(dp > 0)
        plastic, p = plastic + np.sign(driving) * dp, p + dp
        tau = E * (np.log(stretch) - plastic)
        mean, scatter = spread(material, "stress")
        assert scatter < 1e-8 * FY and np.abs(mean[1:]).max() < 1e-8 * FY
        assert mean[0] == pytest.approx(tau * np.exp(-(1 - 2 * NU) * tau / E), abs=1e-8 * FY)
        assert spread(material, "peeq")[0] == pytest.approx([p], abs=1e-8)
        assert reaction(problem) == pytest.approx(tau / stretch * (stretch - 1), abs=1e-8 * FY)
        assert material.energy() == pytest.approx(tau**2 / (2 * E) + K * plastic**2 / 2, rel=1e-8)
    assert yielded == [True, True, False, isotropic == "none", *[True] * 4]


@pytest.mark.parametrize("cell, kind", [("quadrilateral", "plane_strain"), slow("hexahedron", "3d")])
def test_tangent_by_differences(comm, cell, kind):
    """In a state of flow after a history of large strains and turns; the tangent is symmetric."""
    _, u = block(comm, cell, 2)
    material = uem.FinitePlasticity(u, E, NU, FY, H, kinematic_hardening=K, kind=kind)
    to_flow(material, partial(wiggle, u))
    tangent_in_flow(material, u)


def test_bad_input_is_refused(comm):
    _, u = block(comm, "quadrilateral", 2)

    def law(modulus):
        return uem.FinitePlasticity(u, E, NU, FY, kinematic_hardening=modulus, kind="plane_strain")

    for value, error in ((-1.0, uem.InputError), (np.inf, uem.InputError), ("much", uem.InputTypeError)):
        refused(error, "kinematic_hardening = ", lambda value=value: law(value))
    material = law(K)
    for bad in (np.nan, 1e200):
        deform(u, (bad if comm.rank == comm.size - 1 else 0.0) * np.eye(2))
        raised(uem.NotFiniteError, "cell at", material.update)


# -- at points ---------------------------------------------------------------------------------------------------------


class Points:
    """Points of the law with a committed history."""

    def __init__(self, n: int, hardening: float = H, modulus: float = K, yield_stress: float = FY):
        self.mu, self.modulus, one = np.full(n, MU), np.full(n, modulus), np.ones(n)
        self.curve = Linear(yield_stress * one, hardening * one)
        self.plastic, self.peeq = np.zeros((n, 6)), np.zeros(n)

    def at(self, F: np.ndarray) -> Flowed:
        """After a return at these deformation gradients ``(n, 3, 3)``."""
        before = self.plastic, self.peeq, self.mu, self.curve, self.modulus
        return kinematic_return(F - np.eye(3), *before, np.divmod(np.arange(9), 3))

    def to(self, F: np.ndarray) -> Flowed:
        """Likewise, and committed."""
        flowed = self.at(F)
        self.plastic, self.peeq = flowed.plastic_strain, flowed.peeq
        return flowed


def drawn(size: float, n: int = 200, seed: int = 0) -> np.ndarray:
    """Deformation gradients that turn nothing inside out."""
    F = np.eye(3) + size * np.random.default_rng(seed).standard_normal((n, 3, 3))
    F[np.linalg.det(F) < 0.2] = np.eye(3)
    return F


def test_simple_shear():
    """A nearly rigid body: the back stress is 2/3 K ln(V), whose shear rises to a shear of 3.02 and does not oscillate."""
    points, steps = Points(1, 0.0, 2e-3 * FY, 1e-3 * FY), 120
    for gamma in np.linspace(0.0, 6.0, steps + 1)[1:]:
        flowed = points.to(np.eye(3) + gamma * np.outer(np.eye(3)[0], np.eye(3)[1])[None])
        shear = 1e-3 * FY / 3**0.5 + 2e-3 * FY * 2 / 3 * np.arcsinh(gamma / 2) / np.sqrt(1 + gamma**2 / 4)
        if gamma > 0.5:
            assert to_tensors(flowed.stress)[0, 0, 1] == pytest.approx(shear, rel=5e-4)


def test_rotations_turn_the_stress_and_change_nothing_else():
    """Of the body as it is, and of the body as drawn, which turns the plastic strain."""
    still, turned, cut = (Points(200) for _ in range(3))
    Q = rotation(3, 2.0)
    for k, size in enumerate((0.3, 0.3, 0.4)):
        F = drawn(size, seed=k)
        R = np.eye(3) if k == 0 else Q
        flowed, there, other = still.to(F), turned.to(R @ F), cut.to(F @ Q)
        assert np.abs(to_tensors(there.stress) - R @ to_tensors(flowed.stress) @ R.T).max() < 1e-11 * FY
        assert np.abs(there.plastic_strain - flowed.plastic_strain).max() < 1e-10
        assert np.abs(other.stress - flowed.stress).max() < 1e-10 * FY
        assert np.abs(to_tensors(other.plastic_strain) - Q.T @ to_tensors(flowed.plastic_strain) @ Q).max() < 1e-10
        assert np.abs(other.peeq - flowed.peeq).max() < 1e-12 and flowed.peeq.max() > 0.5


def test_returned_states_are_on_the_surface_and_stay():
    """Volumes are kept to rounding, and a state that has been committed flows no further; the tangent is the stress's derivative."""
    points = Points(200)
    for k, size in enumerate((0.3, 0.3, 0.6)):
        F = drawn(size, seed=k)
        first = points.to(F)
        again = points.at(F)
        assert np.abs(again.peeq - first.peeq).max() <= 0.0
        assert np.abs(again.stress - first.stress).max() < 1e-12
        assert np.abs(np.linalg.det(np.eye(3) - 2 * to_tensors(points.plastic)) - 1).max() < 1e-12
    F, way, h = drawn(0.05, seed=9) @ F, drawn(1.0, seed=8), 1e-6
    there, ahead, behind = points.at(F), points.at(F + h * way), points.at(F - h * way)
    assert (there.peeq > points.peeq).mean() > 0.5
    slope = (ahead.first_piola - behind.first_piola) / (2 * h)
    product = np.einsum("nij,nj->ni", there.tangent(), way.reshape(-1, 9))
    off = np.linalg.norm(slope - product, axis=1) / np.linalg.norm(product, axis=1)
    assert off.max() < 1e-7


def test_without_a_back_stress_it_is_the_radial_return():
    """As its slope vanishes: stress, history and tangent."""
    points = Points(200, modulus=1e-14)
    points.to(drawn(0.3))
    F, radial = drawn(0.4, seed=1), (points.plastic, points.peeq, points.mu, points.curve, np.divmod(np.arange(9), 3))
    found, wanted = points.at(F), logarithmic_return(F - np.eye(3), *radial)
    for name, bound in (("stress", 1e-11), ("plastic_strain", 1e-11), ("peeq", 1e-12), ("energy", 1e-11)):
        assert np.abs(getattr(found, name) - getattr(wanted, name)).max() < bound
    tangents = found.tangent(), wanted.tangent()
    assert np.abs(tangents[0] - tangents[1]).max() < 1e-9 * np.abs(tangents[1]).max()
