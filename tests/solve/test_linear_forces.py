"""Forces of linear bodies in explicit steps: K u without the rounding of translations."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.bodies.linear_forces import resistance_to_translation

COMM = MPI.COMM_WORLD


def flying(foundation=0.0, cell="triangle", degree=1):
    """Two irregular bodies in flight, on a foundation of this stiffness by volume."""
    parts = [box(cell, [0.0, 3.0 * k], [2.0, 3.0 * k + 1.0], [9, 6]) for k in range(2)]
    s = scene(COMM, cell, parts, pose=lambda x: x + 0.02 * np.sin(7.0 * x[:, ::-1]))
    V = compat.function_space(s.mesh, degree, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(900.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    F += fem.Constant(s.mesh, foundation) * ufl.inner(u, v) * ufl.dx
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), scheme=uem.CentralDifferences(), contactors="massy")
    return uem.UnitedProblem(F, u, dynamics=dynamics)


@pytest.mark.parametrize("foundation", [0.0, 1e-3, 10.0])
def test_momentum_of_translated_bodies(foundation):
    """Far away, internal forces add up to rounding of the strains; a foundation resists with its stiffness."""
    problem = flying(foundation)
    bodies, far = problem.bodies, np.array([300.0, -700.0])
    x = problem.u.function_space.tabulate_dof_coordinates()[:, :2]
    problem.u.x.array.reshape(-1, 2)[:] = far * (1.0 + (x[:, 1:] > 2.0)) + 1e-3 * np.sin(x)
    bodies.update_tangent()
    for _ in range(3):
        bodies.assemble()
    total = np.sum(COMM.allgather(bodies.forces.sum(axis=0)), axis=0)
    size = reduced(COMM, float(np.abs(bodies.stiffness).max(initial=0.0)), op=MPI.MAX)
    held = [foundation * forms.assemble_scalar(forms.form(problem.u[i] * ufl.dx), COMM) for i in range(2)]
    # what resists a translation is known to rounding of K
    assert foundation == 0.0 or np.abs(total - held).max() <= 1e-14 * size * np.abs(far).max() + 1e-12 * np.abs(held).max()
    if foundation == 0.0:
        strained = reduced(COMM, float(np.abs(bodies.forces).max(initial=0.0)), op=MPI.MAX)
        assert np.abs(total).max() <= 1e-12 * strained


@pytest.mark.parametrize(
    "foundation, cell, degree", [(0.0, "triangle", 1), (0.0, "triangle", 2), (0.0, "quadrilateral", 1), (1e-9, "triangle", 1)]
)
def test_what_resists_a_translation(foundation, cell, degree):
    """Rounding of K does not resist a translation; the weakest foundation that differs from it does, with its stiffness."""
    problem = flying(foundation, cell, degree)
    found = resistance_to_translation(problem.bodies.update_tangent(), problem.config.unknowns)
    total = np.sum(COMM.allgather(found.sum(axis=0)), axis=0)
    if foundation == 0.0:
        assert not found.any()
    else:
        assert np.abs(total / (4.0 * foundation) - 1).max() < 0.2
