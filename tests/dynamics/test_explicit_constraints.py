"""Central differences with ties, linear equations and rigid couplings, for nodes that keep their mass.

Read first: ``test_a_wave_through_a_tie``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, refused, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
C = 30.0


def bars(coupling="node_to_surface", tied=True, equations=lambda s: (), contactors="massy", couplings=lambda s: ()):
    """Two bars in line, of 20 and 14 cells, at rest and in flight; the problem, its book of energies, the tie and the scene."""
    shapes = [box("quadrilateral", [0.0, y], [1.0, y + 5.0], [wide, n]) for y, wide, n in ((0.0, 2, 20), (5.0, 1, 14))]
    s = scene(COMM, "quadrilateral", shapes)
    V = compat.function_space(s.mesh, 1, (2,))
    u, v, velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
    upper = V.tabulate_dof_coordinates()[:, 1] > 5.0 + 1e-9
    velocity.x.array.reshape(-1, 2)[upper, 1] = -1.0
    law = uem.LinearElastic(C**2, 0.0, kind="plane_stress")
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=velocity, scheme=uem.CentralDifferences(), contactors=contactors)
    tie = uem.Contact(s.tag("top", 0, at(1, 5.0)), s.tag("bottom", 1, at(1, 5.0)), coupling=coupling, tied=tied)
    problem = uem.UnitedProblem(
        law.residual(u, v) * ufl.dx, u, contacts=[tie] if tied else [], equations=list(equations(s)), couplings=list(couplings(s)),
        dynamics=dynamics, rtol=1e-11,
    )  # fmt: skip
    return problem, uem.EnergyBook(problem, law.energy(u) * ufl.dx), tie, s


def test_a_rigid_lid_that_is_at_rest_at_first():
    """Without a force there is only what a law of the deformation gradient rounds, which no later force is compared with."""
    s = scene(COMM, "hexahedron", [box("hexahedron", [0.0] * 3, [1.0] * 3, [2, 2, 2])])
    V = compat.function_space(s.mesh, 1, (3,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    lid = uem.RigidCoupling(s.tag("lid", 0, at(2, 1.0)), (0.5, 0.5, 1.0), force=lambda t: (0.0, 0.0, 1e-3 * t))
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), scheme=uem.CentralDifferences(), contactors="massy")
    problem = uem.UnitedProblem(uem.NeoHooke(1.0, 0.3).residual(u, v) * ufl.dx, u, couplings=[lid], dynamics=dynamics)
    for step in uem.time_steps(problem, end=1.0):
        pass
    # the impulse of steps that begin without a force
    assert problem.dynamics.momentum()[2] == pytest.approx(0.5e-3 * step.time**2, rel=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_a_wave_through_a_tie(coupling):
    """A moving bar tied to one at rest: momentum to rounding, the surfaces together, both as fast after the wave has been to and fro."""
    problem, book, tie, s = bars(coupling)
    u, touching = problem.u, 0.0
    top, bottom = s.tag("top", 0, at(1, 5.0)), s.tag("bottom", 1, at(1, 5.0))
    fast = []
    for step in uem.time_steps(problem, end=4 * 10.0 / C):
        row = book.write(step)
        apart = uem.integrate(u[1] * uem.ds(bottom)) - uem.integrate(u[1] * uem.ds(top))
        touching = max(touching, abs(apart))
        if step.time > 2 * 10.0 / C:
            fast.append(row.kinetic)
    momenta = np.array(book.momenta)[:, 1]
    assert np.abs(momenta / momenta[0] - 1).max() < 1e-9
    assert touching < 1e-9
    first = book.rows[0].kinetic
    assert all(abs((row.kinetic + row.stored) / first - 1.0) < 0.01 for row in book.rows)
    # half of the energy is that of the common motion, and half of the rest is kinetic in the mean
    assert abs(np.mean(fast) / first - 0.75) < 0.05


def test_led_in_the_mean():
    """A bar whose foot has a prescribed mean motion, which it follows exactly."""
    lead = lambda s: [uem.MeanMotion(s.tag("foot", 0, at(1, 0.0)), (0, 1), b=lambda t: 0.3 * t**2)]  # noqa: E731
    problem, _, _, s = bars(equations=lead)
    foot = s.tag("foot", 0, at(1, 0.0))
    for step in uem.time_steps(problem, end=0.2):
        assert uem.integrate(problem.u[1] * uem.ds(foot)) == pytest.approx(0.3 * step.time**2, abs=1e-12)


def test_what_is_refused():
    """Massless surfaces, and what the critical step does not count."""
    refused(uem.InputError, ("tied", "massy"), lambda: bars(contactors="massless"))
    lead = lambda s: [uem.MeanMotion(s.tag("foot", 0, at(1, 0.0)), (0, 1))]  # noqa: E731
    refused(uem.InputError, ("equations", "massy"), lambda: bars(tied=False, equations=lead, contactors="massless"))
    rigid = lambda s: [uem.RigidCoupling(s.tag("foot", 0, at(1, 0.0)), (0.5, 0.0))]  # noqa: E731
    refused(uem.InputError, ("couplings need nodes with mass", "massy"), lambda: bars(couplings=rigid, contactors="massless"))
    heavy = lambda s: [uem.RigidCoupling(s.tag("foot", 0, at(1, 0.0)), (0.5, 0.0), mass=1.0)]  # noqa: E731
    refused(uem.InputError, "the mass of the RigidCoupling of 'foot'", lambda: bars(couplings=heavy))

    def sprung(s):
        foot = uem.RigidCoupling(s.tag("foot", 0, at(1, 0.0)), (0.5, 0.0))
        return [foot, uem.Spring(foot, None, 2.0, points=[(0.5, 0.0), (0.5, -1.0)])]

    refused(uem.InputError, "the stiffness of a Spring", lambda: bars(couplings=sprung))


class Plate:
    """A plate that central differences move, all or the upper half of it made rigid by couplings."""

    def __init__(
        self, couplings, law, velocity, cell="quadrilateral", place=(0.0, 0.0), gravity=None, contacts=lambda s: (), n=4, **how
    ):
        s = scene(COMM, cell, [box(cell, place, np.add(place, [1.0, 2.0]), [n, 2 * n])])
        V = compat.function_space(s.mesh, 1, (2,))
        self.u, v, self.velocity = fem.Function(V), ufl.TestFunction(V), fem.Function(V)
        self.velocity.interpolate(velocity)
        how = {"scheme": uem.CentralDifferences(), "contactors": "massy"} | how
        self.dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=self.velocity, gravity=gravity, **how)
        self.couplings = couplings(s)
        self.problem = uem.UnitedProblem(
            law.residual(self.u, v) * ufl.dx, self.u, contacts=list(contacts(s)), couplings=self.couplings, dynamics=self.dynamics,
            rtol=1e-10,
        )  # fmt: skip


SOFT = uem.NeoHooke(900.0, 0.2, kind="plane_strain")


@pytest.mark.slow
def test_a_rigid_plate_that_spins():
    """Momentum to rounding, and two thirds of the square of the angle of a step are lost of the turning, nothing of the flight."""
    spin, turned, left = 5.0, [], []
    for dt in (0.02, 0.01):
        p = Plate(
            lambda s: [uem.RigidCoupling(s.tag("all", 0, lambda x: x[:, 0] >= 0.0), (0.5, 1.0), rotations="large")],
            uem.NeoHooke(1.0, 0.2, kind="plane_strain"), lambda x: np.stack([0.3 - spin * (x[1] - 1.0), spin * (x[0] - 0.5)]),
        )  # fmt: skip
        energy = []
        for _ in uem.time_steps(p.problem, dt, 1.0):
            energy.append(p.dynamics.kinetic_energy())
            assert np.allclose(p.dynamics.momentum(), [0.6, 0.0], atol=1e-11)
        assert np.allclose(p.couplings[0].displacement, [0.3, 0.0], atol=1e-11)
        turned.append(abs(p.couplings[0].rotation - spin))
        left.append(1.0 - energy[-1] / energy[0])
    # both vanish with the square of the step or faster
    assert turned[0] < 0.01 * spin and turned[1] <= 0.3 * turned[0]
    assert 0.0 < left[0] < 0.01 and left[1] <= 0.3 * left[0]


@pytest.mark.slow
def test_a_pendulum():
    """A rigid plate on a hinge falls from the side: its kinetic energy is the work of the weight."""

    def hinged(s):
        plate = uem.RigidCoupling(s.tag("all", 0, lambda x: x[:, 0] >= 0.0), (0.5, 1.0), rotations="large")
        return [plate, uem.Hinge(plate, None, (0.0, 1.0))]

    p = Plate(hinged, SOFT, lambda x: 0.0 * x[:2], gravity=(0.0, -10.0))
    for step in uem.time_steps(p.problem, end=0.5):
        fallen = -uem.integrate(p.u[1] * ufl.dx)
        assert p.dynamics.kinetic_energy() == pytest.approx(10.0 * fallen, rel=0.01, abs=2e-3), step.time
    assert abs(p.couplings[0].rotation) > 0.5 and fallen > 0.5


@pytest.mark.slow
@pytest.mark.parametrize("law, rotations", [slow(SOFT, None), (uem.LinearElastic(900.0, 0.0, kind="plane_stress"), "small")])
def test_a_rigid_head(law, rotations):
    """A block with a rigid head that hits the ground askew rebounds as with implicit steps and massless contactors."""
    found = []
    for how in ({}, {"scheme": uem.newmark(), "contactors": "massless"}):
        p = Plate(
            lambda s: [uem.RigidCoupling(s.tag("head", 0, lambda x: x[:, 1] >= 1.02 - 1e-9), (0.5, 1.5), rotations=rotations)],
            law, lambda x: np.stack([0.3 - 0.5 * (x[1] - 1.0), -1.0 + 0.5 * (x[0] - 0.5)]), place=(0.0, 0.02),
            contacts=lambda s: [uem.Contact(s.tag("foot", 0, at(1, 0.02)), uem.RigidPlane([0.0, 0.0], [0.0, 1.0]), friction=0.2)],
            n=6, **how,
        )  # fmt: skip
        book = uem.EnergyBook(p.problem, law.energy(p.u) * ufl.dx)
        for step in uem.time_steps(p.problem, 0.002 if how else None, 0.6):
            row = book.write(step)
        found.append([p.dynamics.momentum()[1], p.couplings[0].displacement[1]])
        assert row.kinetic + row.stored <= book.rows[0].kinetic * 1.001
        head = np.flatnonzero(p.problem.config.X[:, 1] >= 1.02 - 1e-9)
        apart, drawn = (np.linalg.norm(x[head] - x[head].mean(axis=0), axis=1) for x in (p.problem.config.x, p.problem.config.X))
        if rotations is None and COMM.size == 1:
            assert np.allclose(apart, drawn, atol=1e-9)
    # the surface's mass, a twenty-fourth of the body, loses its energy in the explicit impact
    assert found[0] == pytest.approx(found[1], rel=0.06)


@pytest.mark.long
def test_a_motor():
    """A led rotation is exact at the end of every step, and drives the elastic part."""
    p = Plate(
        lambda s: [
            uem.RigidCoupling(
                s.tag("head", 0, lambda x: x[:, 1] >= 1.0 - 1e-9), (0.5, 1.5), rotations="large", motion=(0.0, 0.0, lambda t: 0.5 * t**2)
            )
        ],
        SOFT, lambda x: 0.0 * x[:2],
    )  # fmt: skip
    for step in uem.time_steps(p.problem, end=0.4):
        assert p.couplings[0].rotation == pytest.approx(0.5 * step.time**2, rel=1e-9)
    assert p.dynamics.kinetic_energy() > 0.0


@pytest.mark.slow
def test_it_continues_from_a_checkpoint(tmp_path):
    """A run with a motor, a rigid head and a hinge that stops and continues ends as the one that does not."""
    path = COMM.bcast(str(tmp_path / "run.h5") if COMM.rank == 0 else None)

    def plate():
        def couplings(s):
            head = uem.RigidCoupling(
                s.tag("head", 0, lambda x: x[:, 1] >= 1.5 - 1e-9), (0.5, 1.75), rotations="large", moment=3.0
            )
            return [head, uem.Hinge(head, None, (0.0, 2.0))]

        return Plate(couplings, SOFT, lambda x: np.stack([0.0 * x[0], -0.5 + 0.0 * x[0]]), gravity=(0.0, -1.0))

    whole = plate()
    for _ in uem.time_steps(whole.problem, end=0.4):
        pass
    first, again = plate(), plate()
    for step in uem.time_steps(first.problem, end=0.4, checkpoint=uem.Checkpoint(path, every=5)):
        if step.number == 11:
            break
    steps = list(uem.time_steps(again.problem, end=0.4, checkpoint=uem.Checkpoint(path, every=5)))
    assert 5 < steps[0].number < steps[-1].number
    assert np.abs(again.u.x.array - whole.u.x.array).max(initial=0.0) <= 1e-11
    assert again.couplings[0].rotation == pytest.approx(whole.couplings[0].rotation, rel=1e-11)
