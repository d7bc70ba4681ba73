"""Thresholds of steps, passages, masses and plasticity: scenes about three times below and above each, from literal numbers."""

from __future__ import annotations

import logging

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, blocks, box, clamp, linear, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.materials.quadrature_points import QuadraturePoints
from uem_dolfinx.materials.return_mapping import plane_stress_return, radial_return
from uem_dolfinx.solve.passages import refuse_passages
from uem_dolfinx.solve.steps.time_steps import _refuse_given_energy

COMM = MPI.COMM_WORLD


def square():
    """Displacements of one square cell, on this rank alone."""
    s = scene(MPI.COMM_SELF, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [1, 1])])
    return compat.function_space(s.mesh, 1, (2,))


def bar(mass=None, **how):
    """A free linear bar ``[0, 1] x [0, 10]`` of density 1 in motion."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 10.0], [1, 4])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, w = fem.Function(V), ufl.TestFunction(V)
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0) if mass is None else uem.nodal_mass(V, mass), **how)
    law = uem.LinearElastic(900.0, 0.0, kind="plane_stress")
    return uem.UnitedProblem(law.residual(u, w) * ufl.dx, u, dynamics=dynamics)


# -- lengths of steps --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("left", "steps"), [(3e-10, 1), (3e-9, 2)])
def test_no_step_for_rounding(left, steps):
    """What is left to the end is a step, or rounding."""
    assert len(list(uem.time_steps(bar(), 0.01, 0.01 * (1 + left)))) == steps


def test_steps_lost_in_rounding():
    """Times about 1e6 are known to 1e-9: a step of 3e-6 may still be cut ten times, one of 3e-7 not."""
    problem = bar(time=1e6)
    uem.time_steps(problem, 3e-6, 1e6 + 1)
    with pytest.raises(ValueError, match="below the rounding error of the times"):
        uem.time_steps(problem, 3e-7, 1e6 + 1)


# -- what a step may do ------------------------------------------------------------------------------------------------


def test_energy_given(caplog):
    """Contacts may give a bar with the kinetic energy 500 an energy of 0.3 in a step, or 3 in a very short one, with a warning."""
    problem = bar(velocity=(0.0, -10.0))
    n = problem.config.n_owned
    problem.step_control.begin(0.01)
    problem.u.x.array.reshape(-1, 2)[:, 1] += 1.0
    total = COMM.allreduce(n)

    def refuse(energy, length):
        force = np.tile([0.0, 2 * energy / total], n)
        _refuse_given_energy(problem, problem.dynamics, length, [force], [])

    refuse(0.3, 0.01)
    with caplog.at_level(logging.WARNING, logger="uem_dolfinx"):
        refuse(3.0, 0.01 / 400)
    assert (
        COMM.rank != 0 or "3 of energy within a step of 2.5e-05, which have 500, and shorter steps are no better" in caplog.text
    )
    for length in (0.01, 0.01 / 40):
        with pytest.raises(uem.EnergyGivenError, match="3 of energy within a step of .*, which have 500"):
            refuse(3.0, length)


@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e3])
def test_a_bar_at_rest_is_not_given_energy(scale, caplog):
    """A bar that lies on a plane without any load does so in steps that are not cut, at sizes from nm to km."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [0.1 * scale, scale], [1, 100])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, w = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(1.0, 0.0, kind="plane_stress").residual(u, w) * ufl.dx
    foot = s.tag("foot", 0, lambda x: np.isclose(x[:, 1], 0.0, atol=1e-6 * scale))
    contact = uem.Contact(foot, uem.RigidPlane((0, 0), (0, 1)))
    dynamics = uem.Dynamics(uem.consistent_mass(V, 1.0))
    problem = uem.UnitedProblem(F, u, contacts=[contact], dynamics=dynamics)
    with caplog.at_level(logging.WARNING, logger="uem_dolfinx"):
        steps = list(uem.time_steps(problem, 0.005 * scale, 0.02 * scale))
    assert [step.cuts for step in steps] == [0] * 4
    assert "of energy" not in caplog.text


class Passing:
    """A small block whose tip moves straight from ``start`` to ``end``, past a rigid circle of radius 1 about the origin."""

    def __init__(self, start, end):
        x = np.array(start)
        s = scene(COMM, "quadrilateral", [box("quadrilateral", x, x + 1e-6, [1, 1])])
        V = compat.function_space(s.mesh, 1, (2,))
        u, w = fem.Function(V), ufl.TestFunction(V)
        law = uem.LinearElastic(1.0, 0.3, kind="plane_strain")
        contact = uem.Contact(s.tag("tip", 0, at(1, start[1])), uem.RigidSphere([0.0, 0.0], 1.0), max_penetration=1.0)
        self.problem = uem.UnitedProblem(law.residual(u, w) * ufl.dx, u, contacts=[contact])
        self.start = np.array(u.x.array)
        u.x.array.reshape(-1, 2)[:] = np.array(end) - x
        self.problem.system.place()

    def check(self):
        refuse_passages(self.problem.config, self.problem.pairs, self.start, [None], moving=True)


def test_depth_of_a_passage():
    """A way through a circle of radius 1 that is 0.03 deep grazes it, one that is 0.3 deep passes through."""
    Passing([-1.95, 0.97], [1.95, 0.97]).check()
    with pytest.raises(uem.TunnellingError, match="passes through the target within a step, up to 0.3 inside"):
        Passing([-1.95, 0.70], [1.95, 0.70]).check()


def test_too_many_places():
    """A way of 80 radii is examined, one of 800 is too long, although it leads nowhere near."""
    Passing([0.0, 5.0], [0.0, 85.0]).check()
    with pytest.raises(uem.TunnellingError, match="move by 800 within a step"):
        Passing([0.0, 5.0], [0.0, 805.0]).check()


# -- masses ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("c", "kept"), [(0.25, True), (0.328, False)])
def test_small_row_sums(c, kept):
    """With the density ``x - c`` the row sums at x = 0 are 1/3 or 1/32 of what scaling the diagonal gives."""
    V = square()
    mass = uem.lumped_mass(V, ufl.SpatialCoordinate(V.mesh)[0] - c)
    left = mass.of_nodes[mass.config.X[:, 0] < 0.5, 0]
    assert np.allclose(left, (1 / 6 - c / 2) / 2 if kept else (1 / 2 - c) / 4, rtol=1e-12)


@pytest.mark.parametrize(("m", "missing"), [(7.5e-20, 3e-11), (7.5e-19, 3e-10)])
def test_moments_of_a_thin_body(m, missing):
    """Two nodes on a line cannot take over the second moments ``missing`` across it of two far nodes of mass m.

    Coordinates across the line are counted in 1e-4 of its spread, 0.5; masses are 1.
    """
    assert m / (1e-4 * 0.5) ** 2 == pytest.approx(missing)
    mass = uem.nodal_mass(square(), lambda X: np.where(X[:, 1] > 0.5, m, 1.0))
    far = np.flatnonzero(mass.config.X[:, 1] > 0.5)
    if missing < 1e-10:
        mass.without(far)
    else:
        with pytest.raises(uem.MassError, match="cannot keep its mass"):
            mass.without(far)


@pytest.mark.parametrize(("m", "a"), [(3e-12, -10.0), (3e-13, 0.0)])
def test_components_without_mass(m, a):
    """Next to nodes of mass 1 those of 3e-12 fall, those of 3e-13 are taken for massless."""
    problem = bar(lambda X: np.where(X[:, 1] > 9.9, m, 1.0), gravity=(0.0, -10.0))
    problem.system.accelerate()
    top = problem.config.X[:, 1] > 9.9
    found = problem.dynamics.acceleration.x.array.reshape(-1, 2)[:, 1]
    assert np.allclose(found[top], a) and np.allclose(found[~top], -10.0)


# -- plasticity --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("outside", "flows"), [(3e-11, False), (3e-10, True)])
def test_on_the_yield_surface(outside, flows):
    """In simple shear a stress that exceeds the yield stress 2 by this part of it is elastic, or flows."""
    one, zero = np.ones(1), np.zeros(1)
    shear = 2.0 * (1 + outside) / np.sqrt(1.5)
    for k, kernel in ((4, radial_return), (6, radial_return), (3, plane_stress_return)):
        # mu = 1/2, E = 1, nu = 0: stress and strain are equal
        strain = np.zeros((1, k))
        strain[0, -1] = shear
        elastic = (0.5 * one,) if k > 3 else (one, zero)
        assert (kernel(strain, np.zeros((1, k)), zero, *elastic, 2 * one, zero, zero).peeq[0] > 0) == flows


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_points_beside_the_centre(cell):
    """The points that stand for a centre give its value of products, and of squares to 1e-8."""
    g = 2 if cell == "quadrilateral" else 3
    s = scene(MPI.COMM_SELF, cell, [box(cell, [0.0] * g, [1.0] * g, [1] * g)])
    points = QuadraturePoints(s.mesh, np.zeros(1, np.int32), 0)
    x = points.points
    assert np.allclose(x.mean(axis=0), 0.5, rtol=1e-15)
    squares = (x**2).mean(axis=0) - 0.25
    assert ((squares > 3e-9) & (squares < 3e-8)).all()
    assert points.volumes.sum() == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_at_rest_nothing_is_cut(coupling):
    """A block that a static solve has brought to rest under its weight stays there, in steps of full length."""
    b, force = blocks(COMM, "quadrilateral", 3, 6, overhang=0.5), (0.0, -10.0)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.scene.tag("side", 1, at(0, 0.0)), 0)]
    F, weight = linear(b.u, 1e3), ufl.inner(fem.Constant(b.scene.mesh, np.array(force)), ufl.TestFunction(b.V)) * ufl.dx
    contacts = [uem.Contact(b.high, uem.RigidPlane([0.0, 0.0], [0.0, 1.0]), coupling=coupling) for _ in range(2)]
    uem.UnitedProblem(F - weight, b.u, bcs=bcs, contacts=contacts[:1]).solve()
    dynamics = uem.Dynamics(uem.consistent_mass(b.V, 1.0), gravity=force)
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=contacts[1:], dynamics=dynamics)
    assert [step.cuts for step in uem.time_steps(problem, dt=0.01, end=0.05)] == [0] * 5
