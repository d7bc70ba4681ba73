"""Ties from step to step: tied after contact, together with contact, in dynamics, and from checkpoints.

The test to read first: ``test_tied_from_a_step_on`` (pressed, tied where it is, and hung up).
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import arch, at, blocks, box, clamp, highest, linear, lowest, modulus, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.parallel import reduced

COMM = MPI.COMM_WORLD
COUPLINGS = ("node_to_surface", "mortar")


def pulled(u, E, top):
    """Linear residual, and a pull at the top that is a Constant."""
    g, mesh = u.function_space.mesh.geometry.dim, u.function_space.mesh
    pull, v = fem.Constant(mesh, np.zeros(g)), ufl.TestFunction(u.function_space)
    return linear(u, E) - ufl.dot(pull, v) * forms.surface_measure(mesh, top.entities), pull


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_tied_across_a_gap(coupling):
    """Blocks that do not touch are tied across their gap within the reach: the lower one hangs on the upper one, and the gap stays."""
    b = blocks(COMM, "quadrilateral", 2, 4, gap=0.05)
    contact = uem.Contact(b.high, b.low, coupling=coupling, tied="after")
    F = uem.LinearElastic(1.0, 0.0, kind="plane_strain").residual(b.u, ufl.TestFunction(b.V)) * ufl.dx
    rise = fem.Constant(b.scene.mesh, 0.0)
    bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top, 0), uem.dirichlet(b.V, b.top, 1, rise)]
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact])
    problem.solve()
    with pytest.raises(uem.SurfaceError):
        contact.tie(reach=0.04)
    with pytest.raises(uem.InputError, match="reach"):
        contact.tie(reach=-1.0)
    contact.tie(reach=0.06)
    for height in (0.1, -0.1):
        rise.value = height
        problem.solve()
        assert contact.resultant().force[1] == pytest.approx(-height / 2.0, rel=1e-9)
        assert contact.n_active == reduced(COMM, len(contact.nodes))


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_tied_from_a_step_on(coupling, friction):
    """A block is pressed down, slides or sticks, is tied where it is, and then hangs: the tie carries tension and shear."""
    b = blocks(COMM, "triangle", 3, 2)
    contact = uem.Contact(b.high, b.low, coupling=coupling, friction=friction, tied="after")
    F, pull = pulled(b.u, modulus(b.scene, 1.0, 2.0), b.top)
    rollers = [] if friction else clamp(b.V, b.scene.tag("side", 1, at(0, 0.0)), 0)
    bcs = [*clamp(b.V, b.bottom), *rollers]
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact])
    pull.value[:] = [0.0, -0.02]
    problem.solve()
    pressed, touching = np.array(b.u.x.array), contact.n_active
    force = contact.resultant().force
    contact.tie()
    assert contact.n_active == touching
    assert contact.resultant().force == pytest.approx(force, rel=1e-10, abs=1e-14)
    problem.solve()
    # the same loads: nothing has moved, with mortar but for gaps that vanished in means, across which forces go now
    still = 1e-12 if coupling == "node_to_surface" else 5e-5 * highest(COMM, np.abs(pressed))
    assert highest(COMM, np.abs(b.u.x.array - pressed)) < still
    assert contact.resultant().force == pytest.approx(force, abs=1e-12 if coupling == "node_to_surface" else 1e-6 * 0.02)
    pull.value[:] = [0.01 if friction else 0.0, 0.02]
    problem.solve()
    assert contact.resultant().force[1] == pytest.approx(-0.02, rel=1e-10)
    assert lowest(COMM, contact.pressures) < 0.0
    assert contact.n_active == touching and contact.max_gap() < 1e-14
    pull.value[:] = [0.0, -0.02]
    problem.solve()
    assert highest(COMM, np.abs(b.u.x.array - pressed)) < max(1e-11, still)


def test_what_does_not_touch_stays_in_contact():
    """Of an arched block the crown is tied; pressed harder, the rest comes into contact, and lifted, the crown alone holds."""
    b = blocks(COMM, "quadrilateral", 8, 8, gap=1e-3, pose=arch(0.1))
    contact = uem.Contact(b.high, b.low, tied="after")
    F, pull = pulled(b.u, modulus(b.scene, 1.0, 1.0), b.top)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.scene.tag("side", 1, at(0, 0.0)), 0)]
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact])
    pull.value[1] = -0.0005
    problem.solve()
    some = contact.n_active
    assert 0 < some < 9
    contact.tie()
    pull.value[1] = -0.02
    problem.solve()
    assert contact.n_active > some and lowest(COMM, contact.pair.kinematics.gap[~contact.pair.tied]) > -1e-13
    pull.value[1] = 0.001
    problem.solve()
    assert contact.n_active == some and contact.resultant().force[1] == pytest.approx(-0.001, rel=1e-9)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_dynamics_of_one_piece(coupling):
    """Two meshes that match and are tied swing as one piece does, with all of its mass."""
    cell = "quadrilateral"
    b = blocks(COMM, cell, 2, 2)
    contact = uem.Contact(b.high, b.low, coupling=coupling, tied=True)
    whole = scene(COMM, cell, [box(cell, [0.0, -1.0], [1.0, 1.0], [2, 4])])
    V = compat.function_space(whole.mesh, 1, (2,))
    found, energy = [], []
    for u, s, bottom, contacts in (
        (b.u, b.scene, b.bottom, [contact]),
        (fem.Function(V), whole, whole.tag("b", 0, at(1, -1.0)), []),
    ):
        space = u.function_space
        speed = fem.Function(space)
        speed.interpolate(lambda x: np.stack([0.2 * (x[1] + 1), 0.1 * x[0] * (x[1] + 1)]))
        dynamics = uem.Dynamics(uem.consistent_mass(space, 1.0), velocity=speed)
        E = [1.0] * (1 + len(contacts))
        problem = uem.UnitedProblem(
            st_venant(u, modulus(s, *E)), u, bcs=clamp(space, bottom), contacts=contacts, dynamics=dynamics, rtol=1e-12
        )
        for _ in uem.time_steps(problem, 0.1, 1.0):
            pass
        rows = np.round(np.column_stack([s.drawing, s.gather(u)]), 14)
        found.append(rows[np.lexsort(rows[:, :2].T)])
        energy.append(dynamics.kinetic_energy())
    two = found[0][np.append(True, (np.diff(found[0][:, :2], axis=0) != 0).any(axis=1))]
    assert np.abs(two - found[1]).max() < 1e-11
    assert energy[0] == pytest.approx(energy[1], rel=1e-10)


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize("after", [False, True])
def test_checkpoint(coupling, after, tmp_path):
    """A run that continues from a file continues with what was tied, where it was tied."""
    path = COMM.bcast(str(tmp_path / "tied"))
    pulls = ([0.0, -0.02], [0.02, 0.03], [-0.01, 0.05])

    def made():
        b = blocks(COMM, "triangle", 2, 3)
        contact = uem.Contact(b.high, b.low, coupling=coupling, friction=0.3 if after else 0.0, tied="after" if after else True)
        v = ufl.TestFunction(b.V)
        pull = fem.Constant(b.scene.mesh, np.zeros(2))
        F = st_venant(b.u, modulus(b.scene, 1.0, 2.0)) - ufl.dot(pull, v) * forms.surface_measure(b.scene.mesh, b.top.entities)
        problem = uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact], rtol=1e-12)
        return b, contact, problem, pull

    def go(contact, problem, pull, steps):
        for k in steps:
            if after and k == 1:
                contact.tie()
            pull.value[:] = pulls[k]
            problem.solve()

    b, contact, problem, pull = made()
    go(contact, problem, pull, (0, 1))
    checkpoint = uem.Checkpoint(path)
    checkpoint.begin(problem.state())
    checkpoint.finish()
    go(contact, problem, pull, (2,))
    c, other, again, pulled_again = made()
    uem.Checkpoint(path).begin(again.state())
    assert other.n_active == contact.n_active
    go(other, again, pulled_again, (2,))
    assert highest(COMM, np.abs(b.u.x.array - c.u.x.array)) < 1e-12
    assert highest(COMM, np.abs(contact.force.x.array - other.force.x.array)) < 1e-11
