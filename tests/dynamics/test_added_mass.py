"""Mass and inertia at the points of rigid couplings.

Two tests to read first: ``test_as_if_it_were_meshed``, the same body by density and by its moments, and ``test_a_top``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, box, clamp, linear, modulus, refused, scene, slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.conditions.rigid_set import moments, turned
from uem_dolfinx.geometry.rigid import rotation_matrix

COMM = MPI.COMM_WORLD


class Block:
    """A bar of length 2 whose right half is rigid, and what mass its nodes have by a density of that half."""

    def __init__(self, cell="quadrilateral", n=1):
        g = 2 if cell == "quadrilateral" else 3
        self.g, self.k = g, 1 if g == 2 else 3
        self.scene = scene(COMM, cell, [box(cell, [0.0] * g, [2.0, 1.0, 0.7][:g], [2 * n, n, 1][:g])])
        self.V = compat.function_space(self.scene.mesh, 1, (g,))
        self.u = fem.Function(self.V, name="u")
        self.half = self.scene.tag("half", 0, lambda x: x[:, 0] >= 1.0 - 1e-9)
        self.face = self.scene.tag("face", 0, at(0, 1.0))
        self.left = self.scene.tag("left", 0, at(0, 0.0))
        X = self.V.tabulate_dof_coordinates()[: self.V.dofmap.index_map.size_local, :g]
        m = self.masses(0.0, 3.0).of_nodes[:, 0]
        self.mass = COMM.allreduce(m.sum())
        self.centre = COMM.allreduce(m @ X) / self.mass
        J = COMM.allreduce(np.einsum("n,ng,nh->gh", m, X - self.centre, X - self.centre))
        self.inertia = np.trace(J) if g == 2 else np.trace(J) * np.eye(3) - J

    def masses(self, left, right):
        density = fem.Function(compat.function_space(self.scene.mesh, ("DG", 0)))
        density.interpolate(lambda x: np.where(x[0] < 1.0, left, right))
        return uem.lumped_mass(self.V, density)

    def moving(self, shift, spin):
        """Velocity of all nodes in a rigid motion about the centre."""
        v = fem.Function(self.V)
        g, centre, turn = self.g, self.centre, np.atleast_1d(spin)
        v.interpolate(lambda x: (np.asarray(shift) + turned(turn, x[:g].T - centre)).T)
        return v

    def problem(self, mass, coupling, law=st_venant, bcs=(), **how):
        dynamics = uem.Dynamics(mass, **how)
        return uem.UnitedProblem(law(self.u, 2.0), self.u, bcs=bcs, couplings=[coupling], dynamics=dynamics, rtol=1e-13), dynamics


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "turns"), [("quadrilateral", "large"), slow("quadrilateral", "small"), slow("hexahedron", "large")]
)
def test_as_if_it_were_meshed(cell, turns):
    """A cantilever with a rigid end that falls askew: the same by the end's density, and by its mass and inertia far from a face."""
    found = []
    for meshed in (True, False):
        b = Block(cell)
        added = {} if meshed else {"mass": b.mass, "inertia": b.inertia}
        # without density and load the other half hangs at the face and is not strained
        end = uem.RigidCoupling(b.half if meshed else b.face, b.centre, rotations=turns, **added)
        down = np.array([0.05, -0.3, 0.1][: b.g])
        v = b.moving([0.0] * b.g, 0.3 if b.g == 2 else (0.3, -0.2, 0.1))
        v.x.array.reshape(-1, b.g)[b.V.tabulate_dof_coordinates()[:, 0] < 0.9] = 0.0
        law = linear if turns == "small" else st_venant
        problem, dynamics = b.problem(
            b.masses(1.0, 3.0 if meshed else 0.0), end, law, clamp(b.V, b.left), velocity=v, gravity=down,
            scheme=uem.generalised_alpha(0.8),
        )  # fmt: skip
        book, rows = uem.EnergyBook(problem), []
        for step in uem.time_steps(problem, 0.25, 1.0):
            row = book.write(step)
            rows.append([*end.displacement, *np.atleast_1d(end.rotation), *dynamics.momentum(), row.kinetic, row.external])
            r = [i.residual for i in step.iterations]
            assert len(r) == 2 or any(1e-9 < a < 1e-2 and after <= 10.0 * a**2 + 1e-13 for a, after in zip(r, r[1:]))
        found.append(np.array(rows))
    assert np.abs(found[1][:, b.g]).max() > 0.1
    assert np.abs(found[1] - found[0]).max() <= 1e-10


def flying(cell, inertia, spin):
    """A body of no density that flies and spins with what is added at its centre; where it flies."""
    b = Block(cell)
    whole, shift = b.scene.tag("whole", 0, lambda x: x[:, 0] >= -1.0), np.array([0.3, 0.1, -0.2][: b.g])
    body = uem.RigidCoupling(whole, b.centre, mass=1.5, inertia=inertia, rotations="large")
    return *b.problem(b.masses(0.0, 0.0), body, velocity=b.moving(shift, spin)), body, shift


def test_a_free_spin(folder):
    """In the plane the trapezoidal rule keeps momentum, energy and spin of a body that is nothing but what is added.

    So it does in a run that continues from a checkpoint, to the last bit, and where a step is taken twice.
    """
    problem, dynamics, body, shift = flying("quadrilateral", 0.7, 2.0)
    for step in uem.time_steps(problem, 0.1, 0.4):
        if step.number == 2:
            uem.write_checkpoint(folder / "run", problem.state())
        if step.number == 3:
            problem.solve()
        assert dynamics.kinetic_energy() == pytest.approx(0.5 * 1.5 * shift @ shift + 0.5 * 0.7 * 2.0**2, rel=1e-12)
        assert np.allclose(dynamics.momentum(), 1.5 * shift, rtol=1e-12)
        assert body.rotation == pytest.approx(2.0 * step.number * np.arctan(0.5 * 2.0 * 0.1), rel=1e-12)
        assert np.allclose(body.displacement, shift * step.time, rtol=1e-12)
    other, again, same, _ = flying("quadrilateral", 0.7, 2.0)
    uem.read_checkpoint(folder / "run", other.state())
    for step in uem.time_steps(other, 0.1, 0.4):
        if step.number == 3:
            other.solve()
    assert same.rotation == body.rotation and again.kinetic_energy() == dynamics.kinetic_energy()
    assert np.array_equal(other.u.x.array, problem.u.x.array)


@pytest.mark.long
def test_a_top():
    """An asymmetric body that turns about its middle axis tumbles as Euler's equations say, to second order in the step."""
    from scipy.integrate import solve_ivp
    from scipy.spatial.transform import Rotation

    axes, spin = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix(), np.array([0.4, 2.0, 0.3])
    inertia = axes @ np.diag([0.3, 0.5, 0.7]) @ axes.T
    start = inertia @ spin

    def tumble(t, R):
        """R' = [w] R with the spin w that has the momentum of the start."""
        R = R.reshape(3, 3)
        return np.cross(R @ np.linalg.solve(inertia, R.T @ start), R.T).T.ravel()

    exact = solve_ivp(tumble, (0.0, 0.6), np.eye(3).ravel(), rtol=1e-10, atol=1e-10).y[:, -1].reshape(3, 3)
    off = []
    for dt in (0.2, 0.1):
        problem, dynamics, body, shift = flying("hexahedron", inertia, spin)
        energy, (top,) = 0.5 * 1.5 * shift @ shift + 0.5 * spin @ start, dynamics.added
        for _ in uem.time_steps(problem, dt, 0.6):
            assert np.allclose(dynamics.momentum(), 1.5 * shift, rtol=1e-10)
        R = rotation_matrix(body.rotation)
        turning = moments(
            top.arms(body.nodes.placement(np.array(problem.config.displacement))), top.masses[:, None] * top.velocity
        )
        off.append([np.abs(R - exact).max(), np.abs(turning.sum(axis=0) - start).max(), abs(dynamics.kinetic_energy() - energy)])
    assert (np.array(off[1]) <= np.array(off[0]) / 3.5).all() and off[1][0] <= 0.02


@pytest.mark.slow
def test_led():
    """What turns and shifts it feels mass and inertia: the reactions are the rate of its momentum, less its weight."""
    way, turn, off = lambda t: 0.5 * t**3, lambda t: -0.4 * t**3, []
    for dt in (0.1, 0.05):
        b = Block()
        rotor = uem.RigidCoupling(b.half, (1.7, 0.2), motion=(way, 0.0, turn), mass=1.5, inertia=0.7)
        problem, _ = b.problem(b.masses(0.0, 0.0), rotor, gravity=(0.0, -2.0), scheme=uem.generalised_alpha(0.5))
        for _ in uem.time_steps(problem, dt, 1.0):
            pass
        off.append(np.abs(np.append(*rotor.reaction) - (1.5 * 3.0, 1.5 * 2.0, -0.7 * 2.4)))
    assert (off[1][[0, 2]] <= off[0][[0, 2]] / 3.5).all() and off[1].max() <= 0.005


@pytest.mark.slow
@pytest.mark.parametrize("unit", [1.0, 1e-9])
def test_a_block_that_strikes(unit):
    """A rigid block falls askew on a free one, with friction: the same by its density, and by mass and inertia alone, in any unit."""
    found = []
    for meshed in (True, False):
        boxes = [box("quadrilateral", [-1, -1], [2, 0], [6, 3]), box("quadrilateral", [0, 0.02], [1, 1.02], [2, 2])]
        s = scene(COMM, "quadrilateral", boxes)
        top, bottom, whole = (
            s.tag("high", 1, at(1, 0.02)),
            s.tag("low", 0, at(1, 0.0)),
            s.tag("block", 1, lambda x: x[:, 1] > 0.01),
        )
        s.mesh.geometry.x[:] *= unit
        V = compat.function_space(s.mesh, 1, (2,))
        u, v, density = fem.Function(V, name="u"), fem.Function(V), fem.Function(compat.function_space(s.mesh, ("DG", 0)))
        high = np.array([0.5, 0.52]) * unit
        density.interpolate(lambda x: np.where(x[1] > 0.0, 1.0 if meshed else 0.0, 1.0))
        v.interpolate(
            lambda x: np.where(x[1] > 0.01 * unit, 1.0, 0.0) * np.stack([0.3 * unit - (x[1] - high[1]), x[0] - 3.0 * high[0]])
        )
        # nodal masses of four cells: 1/4 in the middle, 1/8 at the sides, 1/16 at the corners
        added = {} if meshed else {"mass": unit**2, "inertia": 0.25 * unit**4}
        block = uem.RigidCoupling(whole, high, rotations="large", **added)
        contact = uem.Contact(top, bottom, friction=0.3)
        dynamics = uem.Dynamics(uem.lumped_mass(V, density), velocity=v, contactors="massy")
        problem = uem.UnitedProblem(
            linear(u, modulus(s, 20.0 * unit**2, 0.0)), u, contacts=[contact], couplings=[block], dynamics=dynamics, rtol=1e-12
        )
        rows = []
        for step in uem.time_steps(problem, 0.02, 0.08):
            force = contact.resultant().force / unit**3
            momentum = dynamics.momentum() / unit**3
            rows.append([block.rotation, *block.displacement / unit, *force, *momentum, dynamics.kinetic_energy() / unit**4])
            assert step.newton_iterations <= 5
        found.append(np.array(rows))
    assert np.abs(found[0][:, 4]).max() > 0.1 and np.ptp(found[1][:, 5:7], axis=0).max() <= 1e-12
    assert np.abs(found[1] - found[0]).max() <= 1e-9


def test_natural_frequencies():
    """The first of a light beam that carries a mass is that of the mass on its static stiffness; with inertia all are those of a mesh."""
    pytest.importorskip("slepc4py")
    b, m = Block(n=2), 3.0
    load = uem.RigidCoupling(b.half, (1.5, 0.5), force=(0.0, 1e-3), mass=m)
    b.u.x.array[:] = 0.0
    uem.UnitedProblem(linear(b.u, 2.0), b.u, bcs=clamp(b.V, b.left), couplings=[load]).solve()
    k = 1e-3 / load.displacement[1]
    b.u.x.array[:] = 0.0
    tip = uem.RigidCoupling(b.half, (1.5, 0.5), mass=m)
    problem = uem.UnitedProblem(linear(b.u, 2.0), b.u, bcs=clamp(b.V, b.left), couplings=[tip])
    found = uem.modes(problem, 1, mass=b.masses(0.0, 0.0))
    assert found.eigenvalues[0] == pytest.approx(k / m, rel=1e-8)
    of = []
    for meshed in (True, False):
        end = uem.RigidCoupling(b.half, b.centre, **({} if meshed else {"mass": b.mass, "inertia": b.inertia}))
        problem = uem.UnitedProblem(linear(b.u, 2.0), b.u, bcs=clamp(b.V, b.left), couplings=[end])
        of.append(uem.modes(problem, 4, mass=b.masses(1.0, 3.0 if meshed else 0.0)).eigenvalues)
    assert np.allclose(*of, rtol=1e-8)


def test_what_is_refused():
    refused(uem.InputError, "mass = -1", lambda: uem.RigidCoupling((0.0, 0.0), (0.0, 0.0), mass=-1.0))
    refused(uem.InputError, "carries them", lambda: uem.RigidCoupling((0.0, 0.0), (0.0, 0.0), mass=1.0, distribute=True))
    refused(uem.InputError, "a number", lambda: uem.RigidCoupling((0.0, 0.0), (0.0, 0.0), inertia=np.eye(3)))
    b = Block()
    whole = b.scene.tag("whole", 0, lambda x: x[:, 0] >= -1.0)
    wheel = uem.RigidCoupling(whole, b.centre, inertia=1.0, moment=0.1, rotations="large")
    problem, _ = b.problem(b.masses(0.0, 0.0), wheel)
    refused(uem.FloatingBodyError, "the body", lambda: next(iter(uem.time_steps(problem, 0.1, 0.1))))
    refused(uem.InputTypeError, "inertia", lambda: uem.RigidCoupling((0.0, 0.0), (0.0, 0.0), inertia="much"))
    for inertia, words in (
        (np.diag([1.0, 1.0, 2.1]), "no body has"),
        (np.diag([-1.0, 1.0, 1.0]), "no body has"),
        (np.triu(np.ones((3, 3))), "symmetric"),
        (np.ones(3), "3 rows"),
    ):
        refused(uem.InputError, words, lambda: uem.RigidCoupling((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), inertia=inertia))
