"""Finite plasticity of bodies of revolution: closed forms, volumes of rings, a body in 3D, no locking, tangents.

The test to read first is ``test_a_billet_is_upset_without_friction``.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import box, highest, run, scene, slow
from plastic_scenes import FY, NU, E, H, deform, spread, tangent_in_flow, to_flow
from revolved_scenes import COMM, Revolved, rectangle

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.geometry.axisymmetry import revolved

A, B = 1.0, 2.0


def oblique(X: np.ndarray) -> np.ndarray:
    """A map that leaves no cell a parallelogram, and the axis where it is."""
    return X + 0.1 * np.stack([X[:, 0] * np.sin(3 * X[:, 1] + 1), np.sin(3 * X[:, 0] + X[:, 1])], axis=1)


def bent(s: Revolved, size: float) -> None:
    """A displacement that is not homogeneous, zero across the axis."""
    r, z = s.X.T
    s.u.x.array.reshape(-1, 2)[:] = size * np.stack([r * np.cos(2 * z + r), np.sin(2 * r + 1) * np.cos(z)], axis=1)


def metal(s: Revolved, *parameters: float, **how: float) -> uem.FinitePlasticity:
    return uem.FinitePlasticity(s.u, *parameters, kind="axisymmetric", **how)


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.long
@pytest.mark.parametrize("cell, degree", [("quadrilateral", 1), slow("quadrilateral", 2)])
def test_a_billet_is_upset_without_friction(cell, degree):
    """By a rigid plane to half its height: Kirchhoff's stress times the area that an incompressible billet would have; and back."""
    K = 25.0
    s = Revolved(rectangle((0, 0), (1, 1), (3, 2), cell), cell=cell, degree=degree)
    s.hold_axis()
    s.hold(1, 0.0)
    law = metal(s, E, NU, FY, H, kinematic_hardening=K)
    plane = uem.RigidPlane([0.0, 1.0], [0.0, -1.0])
    contact = uem.Contact(s.side(1, 1.0), plane)
    problem = s.problem(
        law.residual(s.v), [contact], materials=[law], rtol=1e-11, load=lambda factor: plane.move([0.0, -0.5 * factor])
    )
    run(problem, 3)
    plastic = (np.log(0.5) + FY / E) / (1 + (H + K) / E)
    tau = E * (np.log(0.5) - plastic)
    assert abs(contact.resultant().force[1]) == pytest.approx(-tau / 0.5 * np.pi, rel=1e-10)
    assert law.energy() == pytest.approx(np.pi * (tau**2 / (2 * E) + K * plastic**2 / 2), rel=1e-7)
    assert law.dissipation() == pytest.approx(np.pi * (FY - H * plastic / 2) * -plastic, rel=1e-7)


@pytest.mark.long
def test_a_stretch_is_that_of_a_cube():
    """A homogeneous stretch along all three axes, there and back, with the stress of the law in 3D."""
    s = Revolved(rectangle((0.5, 0), (1, 1), (2, 2)))
    cube = scene(COMM, "hexahedron", [box("hexahedron", (0, 0, 0), (1, 1, 1), (2, 2, 2))])
    u = fem.Function(uem.function_space(cube.mesh, 1, (3,)))
    ring, other = metal(s, E, NU, FY, H), uem.FinitePlasticity(u, E, NU, FY, H)
    for stretch in ((0.3, -0.2, 0.3), (0.1, 0.4, 0.1)):
        s.u.x.array.reshape(-1, 2)[:] = s.X * stretch[:2]
        deform(u, np.diag(stretch))
        for law in (ring, other):
            law.update()
            law.commit()
        found, wanted = (spread(law, "stress")[0] for law in (ring, other))
        assert np.abs(found[:3] - wanted[:3]).max() < 1e-8 * FY and np.abs(found[3]) < 1e-8 * FY
        assert ring.energy() == pytest.approx(0.75 * np.pi * other.energy(), rel=1e-8)
    assert ring.dissipation() == pytest.approx(0.75 * np.pi * other.dissipation(), rel=1e-8)


@pytest.mark.parametrize("cell, n, degree, error", [
    ("quadrilateral", 4, 1, 0.002), slow("quadrilateral", 2, 2, 0.01), slow("triangle", 2, 2, 0.02),
])  # fmt: skip
def test_a_tube_widens_without_locking(cell, n, degree, error):
    """A perfectly plastic tube between two planes, whose bore grows by half: 2 FY / sqrt(3) ln(b / a) of the present radii."""
    opening, height = 0.5, 0.25
    s = Revolved(rectangle((A, 0), (B, height), (n, 1), cell), cell=cell, degree=degree)
    s.hold(1, 0.0)
    s.hold(1, height)
    s.hold(0, A, value=opening)
    law = metal(s, 1000.0, NU, 1.0)
    steps = run(s.problem(law.residual(s.v), materials=[law]), 10)
    push = fem.Function(s.V)
    push.x.array.reshape(-1, 2)[np.abs(s.X[:, 0] - A) < 1e-9, 0] = 1.0
    pressure = uem.integrate(ufl.replace(law.residual(s.v), {s.v: push})) / (2 * np.pi * (A + opening) * height)
    outer = np.sqrt(B**2 + (A + opening) ** 2 - A**2)
    assert pressure == pytest.approx(2 / 3**0.5 * np.log(outer / (A + opening)), rel=error)
    assert max(step.newton_iterations for step in steps) <= 8


# -- forms -------------------------------------------------------------------------------------------------------------


def test_changes_of_volume_are_those_of_the_rings():
    """Of parallelograms, one row of them at the axis, each cell's own."""
    s = Revolved(rectangle((0, 0), (1, 1), (3, 3)), pose=lambda X: X + np.outer(0.3 * X[:, 0], [0.0, 1.0]))
    law = metal(s, E, NU, FY)
    bent(s, 0.4)
    found = np.exp(law._volume_changes())
    F, cells = ufl.Identity(3) + uem.displacement_gradient(s.u), compat.function_space(s.mesh, ("DG", 0))
    drawn, present = (
        forms.assemble_array(cells, forms.form(revolved(J * ufl.TestFunction(cells) * ufl.dx))) for J in (1, ufl.det(F))
    )
    assert highest(COMM, np.abs(present / drawn - 1)) > 0.1
    assert highest(COMM, np.abs(found.mean(axis=1) * drawn / present - 1)) < 1e-7


@pytest.mark.parametrize("cell, degree", [("quadrilateral", 1), slow("quadrilateral", 2), slow("triangle", 2)])
def test_tangent_by_differences(cell, degree):
    """In a state of flow after a history of large strains, from the axis on; the tangent is symmetric."""
    s = Revolved(rectangle((0, 0), (1, 1), (2, 2), cell), cell=cell, degree=degree, pose=oblique)
    law = metal(s, E, NU, FY, H, kinematic_hardening=25.0)
    to_flow(law, partial(bent, s))
    tangent_in_flow(law, s.u)
