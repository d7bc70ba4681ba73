"""Contactors inside a target behind its concave edges: their gaps are heights over facets that continue, and turn with the bodies.

The test to read first is ``test_a_plug_that_almost_nothing_holds``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import arch, at, box, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def ring(inner, outer, n, around, phase=0.0):
    """A ring of ``n`` by ``around`` quadrilaterals."""
    flat = box("quadrilateral", [inner, phase], [outer, 2 * np.pi + phase], [n, around])
    number = np.arange(len(flat.x)).reshape(n + 1, around + 1)
    number[:, -1] = number[:, 0]
    kept, number = np.unique(number, return_inverse=True)
    r, angle = flat.x[kept].T
    return type(flat)(r[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]), number.ravel()[flat.cells])


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e3])
@pytest.mark.parametrize("springs", [1e-6, 1e-3])
def test_a_plug_that_almost_nothing_holds(springs, scale):
    """A ring too large for the hole that it is in: weak springs alone keep both from turning, and the first step does not turn them.

    The mean pressure is Lame's for the distance of nodes and facets, but for what the polygon and large strains change.
    """
    over, E = 0.1, 1.0
    s = scene(COMM, "quadrilateral", [ring(1.0, 2.0, 6, 60), ring(0.5, 1.0 + over, 4, 48, 0.03)], pose=lambda x: scale * x)
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.NeoHooke(E, 0.3, "plane_strain").residual(u, v) * ufl.dx
    F += fem.Constant(s.mesh, springs / scale**2) * ufl.dot(u, v) * ufl.dx
    contact = uem.GeneralContact(max_penetration=0.2 * scale)
    (step,) = uem.load_steps(uem.UnitedProblem(F, u, contacts=[contact]), 1)
    assert step.cuts == 0 and step.newton_iterations <= 20
    assert COMM.allreduce(float(np.abs(u.x.array).max()), op=MPI.MAX) < 0.2 * scale

    def yields(r, a, b, inside):
        """Displacement at r per pressure there, of a ring from a to b."""
        return r * (1 - 0.09) / E * ((a**2 + b**2) / (b**2 - a**2) + (1 if inside else -1) * 0.3 / 0.7)

    overlap = over + 1 - np.cos(np.pi / 60)
    lame = overlap / (yields(1.0, 1.0, 2.0, True) + yields(1.0 + over, 0.5, 1.0 + over, False))
    (pair,) = contact.touching()
    forces = COMM.allreduce(float(sum(part.pair.trial.lam.sum() for part in contact.parts)))
    assert np.linalg.norm(pair.force) <= 1e-6 * forces
    assert forces / (2 * np.pi * scale) == pytest.approx(lame, rel=0.06)


@pytest.mark.parametrize("scale", [1e-6, 1.0])
@pytest.mark.parametrize("sliding", ["finite", "small"])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_gaps_of_contactors_behind_edges(cell, sliding, scale):
    """Rows say how gaps change to first order as nodes move, and vanish where all bodies turn by a small angle."""
    g = 2 if cell == "triangle" else 3
    low = box(cell, [-0.5, *[-0.25] * (g - 2), -1.0], [1.5, *[1.25] * (g - 2), 0.0], [8, *[2] * (g - 2), 2])
    high = box(cell, [0.0, *[0.0] * (g - 2), -0.1], [0.5, *[1.0] * (g - 2), 0.4], [16, *[2] * (g - 2), 2])
    bowl = arch(-0.6)
    s = scene(COMM, cell, [low, high], pose=lambda x: scale * bowl(x))
    V = compat.function_space(s.mesh, 1, (g,))
    u = fem.Function(V)
    F = uem.LinearElastic(1.0, 0.3, "plane_strain" if g == 2 else "3d").residual(u, ufl.TestFunction(V)) * ufl.dx
    contact = uem.Contact(
        s.tag("foot", 1, at(g - 1, -0.1)), s.tag("low", 0, at(g - 1, 0.0)), sliding=sliding, max_penetration=scale
    )
    uem.UnitedProblem(F, u, contacts=[contact])
    pair, config = contact.pair, contact.pair.config
    p, x = pair.kinematics.projection, config.X[: config.n_owned]
    past = (p.gap < 0) & ((p.weights < -1e-6) | (p.weights > 1 + 1e-6)).any(axis=1)
    assert COMM.allreduce(int(past.sum())) >= 2
    gaps = pair.kinematics.gap_rows.gaps
    turned = np.zeros_like(x)
    turned[:, 0], turned[:, -1] = -x[:, -1], x[:, 0]
    assert np.abs(gaps(turned) - p.gap)[past].max(initial=0.0) <= 1e-14 * scale
    if sliding == "small":
        return
    du = 0.1 * np.sin(np.arange(1, g + 1) * 3.0 * x / scale + 1.0) * scale
    error = []
    for h in (1e-3, 1e-4):
        u.x.array[: x.size] = h * du.ravel()
        u.x.scatter_forward()
        pair.project()
        left = pair.kinematics.projection.gap - p.gap - h * (gaps(du) - p.gap)
        error.append(COMM.allreduce(float(np.abs(left)[past].max(initial=0.0)), op=MPI.MAX))
    assert error[1] < 0.02 * error[0] and error[0] < 1e-4 * scale


@pytest.mark.parametrize("scale", [1e-9, 1.0])
@pytest.mark.parametrize(("slope", "continues"), [(0.03, True), (0.2, True), (0.3, False), (2.0, False)])
def test_shallow_edges(slope, continues, scale):
    """A node straight below the bottom of a V is off its facets by slope times its depth; facets of sharp ones end at the bottom."""
    low, high = box("triangle", [-1.0, -1.0], [1.0, 0.0], [2, 1]), box("triangle", [-0.1, -0.02], [0.1, 0.3], [2, 1])
    s = scene(COMM, "triangle", [low, high], pose=lambda x: scale * (x + np.column_stack([0 * x[:, 0], slope * np.abs(x[:, 0])])))
    u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
    F = uem.LinearElastic(1.0, 0.3, "plane_strain").residual(u, ufl.TestFunction(u.function_space)) * ufl.dx
    contact = uem.Contact(s.tag("foot", 1, at(1, -0.02)), s.tag("low", 0, at(1, 0.0)), max_penetration=scale)
    uem.UnitedProblem(F, u, contacts=[contact])
    pair = contact.pair
    bottom = np.abs(pair.config.X[pair.nodes, 0]) < 1e-3 * scale
    weights = pair.kinematics.projection.weights[bottom]
    assert COMM.allreduce(len(weights)) == 1
    assert COMM.allreduce(int(((weights < -1e-6) | (weights > 1 + 1e-6)).any())) == continues
