"""Von Mises plasticity in finite strain: closed forms of large strains and turns, exact volumes, tangents, and dissipation.

The test to read first is ``test_uniaxial_tension``.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, clamp, highest, rotation
from plastic_scenes import FY, MU, NU, E, H, block, deform, reaction, skewed, spread, tangent_in_flow, to_flow, vector, wiggle
from scipy.integrate import quad
from scipy.optimize import brentq

import uem_dolfinx as uem
from uem_dolfinx.materials.logarithmic import to_tensors

#: A plateau, then hardening; and what follows the table.
TABLE = [(0.0, FY), (0.02, 1.2 * FY), (0.1, 1.2 * FY), (0.4, 2.0 * FY)]
LAWS = {
    "linear": ((FY, H), lambda p: FY + H * p),
    "perfect": ((FY,), lambda p: FY + 0 * p),
    "voce": ((FY, uem.Voce(1.5 * FY, 0.1, 2 * FY)), lambda p: FY * (1 + 1.5 * (1 - np.exp(-p / 0.1)) + 2 * p)),
    "table": ((TABLE, 3 * FY), lambda p: np.interp(p, *np.transpose(TABLE)) + 3 * FY * np.maximum(p - 0.4, 0)),
}


def tensors(material: uem.FinitePlasticity, name: str) -> np.ndarray:
    """Values of a field at this rank's points ``(n, 3, 3)``."""
    return to_tensors(material._points.read(getattr(material, name)))


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("law", LAWS)
def test_uniaxial_tension(comm, law):
    """The logarithmic strain and the Kirchhoff stress obey the equations of small strains: to three times the length, and back."""
    s, u = block(comm, "hexahedron")
    V, (parameters, flow) = u.function_space, LAWS[law]
    material = uem.FinitePlasticity(u, E, NU, *parameters)
    pulled = fem.Constant(s.mesh, 0.0)
    bcs = [bc for c in range(3) for bc in clamp(V, s.tag("roller", 0, at(c, 0.0)), c)]
    end = fem.locate_dofs_topological(V.sub(0), 2, s.tag("end", 0, at(0, 1.0)).entities)
    bcs.append(fem.dirichletbc(pulled, end, V.sub(0)))
    F = material.residual(ufl.TestFunction(V))
    problem = uem.UnitedProblem(F, u, bcs=bcs, materials=[material], petsc_options_prefix="bar_", rtol=1e-11)
    plastic, p = 0.0, 0.0
    for stretch in (1 + 0.5 * FY / E, 1.03, 1.3, 2.0, 3.0, 3.0 * (1 - FY / E), 2.0, 1.4, 1.0, 0.7):
        pulled.value = stretch - 1
        problem.solve()
        trial = E * (np.log(stretch) - plastic)
        over = abs(trial) - flow(p)
        dp = (
            brentq(lambda dp: abs(trial) - E * dp - flow(p + dp), 0.0, 1.001 * over / E, xtol=1e-16, rtol=1e-14)
            if over > 0
            else 0.0
        )
        plastic, p = plastic + np.sign(trial) * dp, p + dp
        tau = E * (np.log(stretch) - plastic)
        mean, scatter = spread(material, "stress")
        assert scatter < 1e-8 * FY
        assert mean[0] == pytest.approx(tau * np.exp(-(1 - 2 * NU) * tau / E), abs=1e-8 * FY)
        assert np.abs(mean[1:]).max() < 1e-8 * FY
        assert spread(material, "peeq")[0] == pytest.approx([p], abs=1e-8)
        assert reaction(problem) == pytest.approx(tau / stretch * (stretch - 1), abs=1e-8 * FY)
        strains = material.cell_averages()["plastic_strain"].x.array.reshape(-1, 9)[:, [0, 4, 8]]
        assert highest(comm, np.abs(strains - plastic * np.array([1.0, -0.5, -0.5]))) < 1e-8
        assert material.dissipation() == pytest.approx(quad(flow, 0, p, points=[0.02, 0.1, 0.4])[0], rel=1e-6, abs=1e-12)
    assert p > 2


@pytest.mark.parametrize("cell, kind", [("quadrilateral", "plane_strain"), ("hexahedron", "3d")])
def test_simple_shear(comm, cell, kind):
    """Perfectly plastic shear is borne by FY / sqrt(3), at any shear."""
    _, u = block(comm, cell)
    material = uem.FinitePlasticity(u, E, NU, FY, kind=kind)
    for gamma in np.linspace(0.0, 5.0, 251)[1:]:
        deform(u, gamma * np.outer(np.eye(len(u))[0], np.eye(len(u))[1]))
        material.update()
        material.commit()
    stress = spread(material, "stress")[0]
    assert stress[-1] / 2**0.5 == pytest.approx(FY / 3**0.5, rel=2e-4)
    assert np.abs(stress[:-1]).max() < 2 * FY * FY / MU
    assert spread(material, "peeq")[0] == pytest.approx((5.0 - FY / 3**0.5 / MU) / 3**0.5, rel=1e-4)


@pytest.mark.parametrize("cell, kind", [("quadrilateral", "plane_strain"), ("hexahedron", "3d")])
def test_rotations_turn_the_stress_and_change_nothing_else(comm, cell, kind):
    """A stretched body is turned, and stretched on: as if it had not been turned."""
    _, u = block(comm, cell)
    g = len(u)
    still, turned = (uem.FinitePlasticity(u, E, NU, FY, H, kind=kind) for _ in range(2))
    stretched, further = np.eye(g) + 0.3 * np.eye(g, k=1), np.diag([1.2, 0.9, 1.1][:g])
    Q = rotation(g, 2.0)
    for F, R in ((stretched, np.eye(g)), (stretched, Q), (further @ stretched, Q)):
        for material, of in ((still, F), (turned, R @ F)):
            deform(u, of - np.eye(g))
            material.update()
            material.commit()
        full = np.eye(3)
        full[:g, :g] = R
        sigma, there = tensors(still, "stress"), tensors(turned, "stress")
        assert highest(comm, np.abs(there - full @ sigma @ full.T)) < 2e-12 * FY
        assert highest(comm, np.abs(turned.peeq.x.array - still.peeq.x.array)) < 1e-13
        assert highest(comm, np.abs(turned.plastic_strain.x.array - still.plastic_strain.x.array)) < 1e-13
    assert highest(comm, still.peeq.x.array) > 0.2


@pytest.mark.parametrize("law", LAWS)
def test_flow_keeps_the_volume_and_dissipates(comm, law):
    """Over a path that turns back and forth: det F_p = 1 to rounding."""
    _, u = block(comm, "hexahedron")
    material = uem.FinitePlasticity(u, E, NU, *LAWS[law][0])
    before = 0.0
    for k in range(40):
        wiggle(u, 0.5 * np.sin(0.7 * k))
        material.update()
        material.commit()
        volume = np.linalg.det(np.eye(3) - 2 * tensors(material, "plastic_strain"))
        assert highest(comm, np.abs(volume - 1)) < 1e-12
        now = material.dissipation()
        assert now >= before
        before = now
    assert highest(comm, material.peeq.x.array) > 3 and before > 0


@pytest.mark.parametrize("cell, kind", [("quadrilateral", "plane_strain"), ("tetrahedron", "3d"), ("hexahedron", "3d")])
def test_small_strains_are_those_of_the_small_law(comm, cell, kind):
    """In states that are alike but for their size, stresses differ to second order."""
    _, u = block(comm, cell, 2, degree=2 if cell == "tetrahedron" else 1, pose=skewed)
    off = []
    for size in (2e-3, 1e-3):
        laws = [law(u, E, NU, 0.1 * size * E, H, kind=kind) for law in (uem.VonMises, uem.FinitePlasticity)]
        for part in (0.3, 0.6, 1.0, 0.8):
            wiggle(u, part * size)
            for law in laws:
                law.update()
                law.commit()
        small, large = laws
        assert highest(comm, small.peeq.x.array) > 0.1 * size
        off.append(highest(comm, np.abs(large.stress.x.array - small.stress.x.array)))
        assert large.energy() == pytest.approx(small.energy(), rel=20 * size)
        assert large.dissipation() == pytest.approx(small.dissipation(), rel=20 * size)
    assert off[0] / off[1] == pytest.approx(4.0, rel=0.02)


# -- forms -------------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize(
    "cell, degree, kind, law",
    [
        ("quadrilateral", 1, "plane_strain", "table"), ("triangle", 2, "plane_strain", "perfect"), ("hexahedron", 1, "3d", "voce"),
        ("tetrahedron", 2, "3d", "linear"),
        pytest.param("quadrilateral", 2, "plane_strain", "linear", marks=pytest.mark.slow),
        pytest.param("hexahedron", 2, "3d", "table", marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_tangent_by_differences(comm, cell, degree, kind, law):
    """In a state of flow after a history of large strains and turns; the tangent is symmetric."""
    _, u = block(comm, cell, 1 if degree == 2 else 2, degree=degree, pose=skewed)
    material = uem.FinitePlasticity(u, E, NU, *LAWS[law][0], kind=kind)
    to_flow(material, partial(wiggle, u))
    tangent_in_flow(material, u)


def test_forces_are_the_derivative_of_the_stored_energy(comm):
    """Where nothing flows on, after large plastic strains."""
    _, u = block(comm, "hexahedron", 1, pose=skewed)
    V = u.function_space
    material = uem.FinitePlasticity(u, E, NU, FY, H)
    wiggle(u, 0.3)
    material.update()
    material.commit()
    here, step, h = (
        np.array(u.x.array),
        np.array(vector(ufl.inner(ufl.SpatialCoordinate(V.mesh), ufl.TestFunction(V)) * ufl.dx, V)),
        1e-6,
    )
    u.x.array[:] = 0.999 * here
    material.update()
    there = np.array(u.x.array)
    direction = fem.Function(V)
    direction.x.array[: len(step)] = step
    direction.x.scatter_forward()
    wanted = comm.allreduce(float(vector(material.residual(ufl.TestFunction(V)), V) @ step))
    sides = []
    for sign in (1, -1):
        u.x.array[:] = there + sign * h * direction.x.array
        sides.append(material.energy())
    assert highest(comm, material._trial.peeq - material._committed()[1]) <= 0
    assert (sides[0] - sides[1]) / (2 * h) == pytest.approx(wanted, rel=1e-7)
