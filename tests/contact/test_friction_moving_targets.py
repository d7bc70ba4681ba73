"""Rigid targets that move under contactors: those that begin to slip, slip the other way, or come to stick take its motion into account."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from friction_scenes import on_plane
from helpers import at, box, highest, linear, scene
from pointed_scenes import neo_hooke

import uem_dolfinx as uem
from uem_dolfinx import compat

COUPLINGS = ["node_to_surface", "mortar"]
MU = 0.3


@pytest.mark.long
@pytest.mark.parametrize(
    ("coupling", "centre"), [("node_to_surface", (0.0, 0.0)), ("node_to_surface", (1.1, 0.05)), ("mortar", (1.0, 0.0))]
)
def test_a_turntable_under_a_block_that_is_held(coupling, centre):
    """A few iterations a step while slip spreads; at the end each contactor is dragged along the table's motion under it."""
    about = [*centre, 0.0]
    plane = uem.RigidPlane([0.0] * 3, [0.0, 0.0, 1.0])
    scene = on_plane(plane.move([0.0] * 3, [0.0] * 3, about), coupling, mu=MU)
    scene.to(0.0, 0.0, -0.01)
    for turn in (0.002, 0.004, 0.006, 0.008, *np.arange(0.028, 0.18, 0.02)):
        plane.move([0.0] * 3, [0.0, 0.0, turn], about)
        assert len(scene.to(0.0, 0.0, -0.01)) - 1 <= 10
    assert scene.states[0] == 0
    pair = scene.contact.pair
    arm, force = pair.points - about, pair.trial.friction.tau
    way = np.column_stack([-arm[:, 1], arm[:, 0], 0.0 * arm[:, 0]])
    # next to the axis the way is short, and what is left of the block's own motion is not; steps are chords of the way
    far = pair.trial.active & (np.linalg.norm(way, axis=1) > 0.1)
    exact = MU * pair.trial.lam[:, None] * way / np.linalg.norm(way, axis=1, keepdims=True)
    assert highest(scene.problem.comm, np.abs(force - exact)[far]) <= 4e-2 * highest(scene.problem.comm, np.abs(exact))


@pytest.mark.long
@pytest.mark.parametrize("centre", [(0.0, 0.0), (1.2, -0.2)])
@pytest.mark.parametrize(("mu", "press", "law"), [(0.1, 0.01, neo_hooke), (0.1, 0.01, linear), (0.3, 0.001, linear)])
def test_a_slender_block_on_a_turntable(mu, press, law, centre):
    """Friction would bend it further than the table has turned: what slipped outwards as it was pressed is held after a few exchanges.

    Were its slip turned as long as that friction is beyond its limit, it would turn back and forth.
    """
    about = [*centre, 0.0]
    plane = uem.RigidPlane([0.0] * 3, [0.0, 0.0, 1.0])
    scene = on_plane(plane.move([0.0] * 3, [0.0] * 3, about), "node_to_surface", mu=mu, depth=0.2, height=0.8, law=law)
    scene.to(0.0, 0.0, -press)
    assert scene.states[0] == 0
    plane.move([0.0] * 3, [0.0, 0.0, 0.002], about)
    history = scene.to(0.0, 0.0, -press)
    assert len(history) - 1 <= 6
    assert sum(iteration.exchanges for iteration in history) <= 15
    assert scene.states[0] > 0


@pytest.mark.long
@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_block_on_a_belt(coupling):
    """It is taken along with mu g until it is as fast as the belt: a few iterations a step, none of them cut."""
    comm, gravity, dt, aslant = MPI.COMM_WORLD, 10.0, 0.03, np.array([np.cos(0.3), np.sin(0.3)])
    s = scene(comm, "hexahedron", [box("hexahedron", [0.8, -0.2, 0.0], [1.2, 0.2, 0.3], [2, 2, 5])])
    V = compat.function_space(s.mesh, 1, (3,))
    u, low = fem.Function(V), s.tag("low", 0, at(2, 0.0))
    F = linear(u, 1e3) + gravity * ufl.TestFunction(V)[2] * ufl.dx
    belt = uem.RigidPlane([0.0] * 3, [0.0, 0.0, 1.0])
    uem.UnitedProblem(F, u, contacts=[uem.Contact(low, belt, friction=MU)], petsc_options_prefix="lying_").solve()
    contact = uem.Contact(low, belt, friction=MU, coupling=coupling)
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), scheme=uem.generalised_alpha(0.5))
    problem = uem.UnitedProblem(
        F, u, contacts=[contact], dynamics=dynamics, load=lambda t: belt.move([*(aslant * t), 0.0]), petsc_options_prefix="belt_"
    )
    speeds, n = [], problem.config.n_owned
    for step in uem.time_steps(problem, dt, 0.6):
        assert step.newton_iterations <= 6
        v = dynamics.velocity.x.array.reshape(-1, 3)[:n, :2]
        total = comm.allreduce(np.array([(v @ aslant).sum(), np.abs(v @ [-aslant[1], aslant[0]]).sum(), n]))
        speeds.append(total[0] / total[2])
        assert total[1] <= 0.1 * total[2]
    assert len(speeds) == 20
    assert speeds[7] == pytest.approx(MU * gravity * 8 * dt, rel=0.1)
    assert np.mean(speeds[-5:]) == pytest.approx(1.0, rel=0.05)
