"""Forces of the bodies without contact: what counts as rounding of a force and of a Dirichlet value."""

from mpi4py import MPI

import numpy as np
import pytest
from helpers import blocks, clamp, linear, modulus

import uem_dolfinx as uem
from uem_dolfinx.geometry.bodies import find_bodies

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("length", [1e-9, 1.0, 1e3])
def test_rounding_of_forces(length):
    """Displacements changed in their last bits change the forces by less than counts as rounding, though by no more than 5 times."""
    b = blocks(COMM, "triangle", 4, 5, pose=lambda x: length * x)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom))
    bodies, n = problem.bodies, problem.config.n_owned * 2
    u = length * np.sin(problem.config.X / length * 3 + 1).ravel()
    eps = np.finfo(float).eps
    changes = []
    for seed in range(20):
        rng = np.random.default_rng(seed + 100 * COMM.rank)
        F = []
        for sign in (0.0, 1.0):
            b.u.x.array[:] = u
            b.u.x.array[:n] *= 1.0 + sign * 2 * eps * rng.choice([-1.0, 1.0], n)
            b.u.x.scatter_forward()
            bodies.assemble()
            F.append(bodies.residual)
        changes.append((F[1] - F[0]).norm())
    bodies.update_tangent()
    reported = bodies.rounding(np.zeros(0, np.int32))
    assert max(changes) < reported < 5 * max(changes)


@pytest.mark.parametrize("value", [1e-9, 1.0, -7.0e5])
def test_dirichlet_values_are_met(value):
    """To 2 units in the last place, not to 12."""
    b = blocks(COMM, "triangle", 2, 2)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=value)])
    bodies = problem.bodies
    wanted = problem.config.of(bodies.wanted)
    wanted[~bodies.free] = 0.0
    top = np.abs(problem.config.X[:, 1] - 1.0) < 1e-9
    wanted[top] = value
    for units, met in ((0.0, True), (2.0, True), (12.0, False)):
        problem.config.displacement[:] = wanted * (1.0 + units * np.finfo(float).eps)
        assert bodies.dirichlet_met() == met


@pytest.mark.parametrize("length", [1e-9, 1.0, 1e3])
def test_forces_above_rounding(length):
    """A body carried far without strain has none; strained by 5e-12 of its way it has, where the other body does not count."""
    b = blocks(COMM, "triangle", 4, 5, gap=1.0, pose=lambda x: length * x)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1e-3, 1e3)), b.u, bcs=clamp(b.V, b.bottom))
    bodies, config = problem.bodies, problem.config
    bodies.update_tangent()
    body, _ = find_bodies(config)
    upper = config.X[:, 1] > 0.5 * length
    for strain, reported in ((0.0, False), (3e-13, False), (5e-12, True)):
        config.displacement[:] = 0.0
        config.displacement[upper] = length * np.array([1.0, 2.0]) * (1.0 + strain * np.sin(config.X[upper] / length))
        b.u.x.scatter_forward()
        bodies.assemble()
        assert (bodies.above_rounding(False) > 0.0) == reported
    # a soft body's forces are distinguished from its own rounding, not from that of a stiff one
    config.displacement[~upper, 1] = 1e-3 * (config.X[~upper, 1] + length)
    b.u.x.scatter_forward()
    bodies.assemble()
    assert bodies.above_rounding(False) > 1e-5 * length * 1e-3
