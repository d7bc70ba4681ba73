"""Preloads: closed forms of bars and springs in parallel, bolts that are tightened in turn, poses, finite strain, checkpoints, errors.

The tests to read first: ``test_bar_between_walls`` (force and opening in closed form) and ``test_joint`` (locked and loaded).
"""

from __future__ import annotations

from itertools import pairwise

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import M, at, blocks, box, clamp, highest, linear, modulus, raised, rotation, scene, slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

COMM = MPI.COMM_WORLD
COUPLINGS = ("node_to_surface", "mortar")


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize(
    "cell,degree", [("triangle", 1), ("triangle", 2), ("hexahedron", 1), slow("tetrahedron", 1), slow("tetrahedron", 2)]
)
def test_bar_between_walls(cell, degree, coupling):
    """A bar of two parts of other meshes, cut and tightened: the force is exact, and so are opening and stress; locked, nothing moves."""
    b = blocks(COMM, cell, 2, 4 if coupling == "node_to_surface" else 3, degree=degree)
    bolt = uem.Preload(b.high, b.low, coupling=coupling, force=0.02)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=b.oedometer(0.0), contacts=[bolt])
    problem.solve()
    assert bolt.carried == pytest.approx(0.02, rel=1e-12)
    assert bolt.opening == pytest.approx(-0.02 / M * (1 + 1 / 2), rel=1e-12)
    assert highest(COMM, np.abs(bolt.pressures + 0.02)) < 1e-12
    assert bolt.resultant().force == pytest.approx([0.0] * (b.gdim - 1) + [-0.02], abs=1e-13)
    assert bolt.balance().force < 1e-12 and bolt.balance().moment < 1e-12
    bolt.lock()
    found = np.array(b.u.x.array)
    problem.solve()
    assert highest(COMM, np.abs(b.u.x.array - found)) < 1e-14 and bolt.carried == pytest.approx(0.02, rel=1e-12)


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_shortened_between_walls(coupling):
    """A given shortening takes the force of the closed form, in steps as well; a force in a later step lets the length go."""
    b = blocks(COMM, "quadrilateral", 2, 4, degree=1)
    bolt = uem.Preload(b.high, b.low, coupling=coupling, shortening=lambda s: 0.03 * s)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=b.oedometer(0.0), contacts=[bolt])
    stiffness = M / (1 + 1 / 2)
    for step in uem.load_steps(problem, 3):
        assert bolt.carried == pytest.approx(stiffness * 0.03 * step.factor, rel=1e-11)
        assert bolt.opening == pytest.approx(-0.03 * step.factor, rel=1e-14) and bolt.locked
    for _ in uem.load_steps(problem, [uem.Step("pull", 2, preload={bolt: 0.05}), uem.Step("keep", preload={bolt: None})]):
        pass
    assert bolt.carried == pytest.approx(0.05, rel=1e-11) and bolt.locked
    assert bolt.opening == pytest.approx(-0.05 / stiffness, rel=1e-11)
    for how in ({}, {"force": 1.0, "shortening": 1.0}):
        with pytest.raises(uem.InputError, match="expected one of them"):
            uem.Preload(b.high, b.low, **how)


class Joint:
    """Two bolts A and B and a sleeve between a floor and a plate, all in one place, each in one-dimensional strain.

    The bolts are tied to the plate, upon the sleeve it lies; stiffnesses are ``k``, of A, B and the sleeve.
    """

    E = 1.0, 0.5, 3.0
    k = M / 2 * np.array(E)

    def __init__(self, coupling, **force):
        cell = "quadrilateral"
        parts = [box(cell, [0.0, y], [1.0, y + 1], [1, 1]) for y in (-1.0, 0.0)]
        sleeve, plate = box(cell, [0.0, -1.0], [1.0, 1.0], [1, 2]), box(cell, [0.0, 1.0], [1.0, 1.5], [1, 1])
        s = scene(COMM, cell, [*parts, *parts, sleeve, plate])
        V = compat.function_space(s.mesh, 1, (2,))
        self.u, v = fem.Function(V), ufl.TestFunction(V)
        self.lift = fem.Constant(s.mesh, 0.0)
        top = forms.surface_measure(s.mesh, s.tag("top", 5, at(1, 1.5)).entities)
        F = linear(self.u, modulus(s, *np.repeat(self.E[:2], 2), self.E[2], 4.0)) - self.lift * v[1] * top
        bcs = [bc for body in range(6) for x in (0.0, 1.0) for bc in clamp(V, s.tag("side", body, at(0, x)), 0)]
        for body in (0, 2, 4):
            bcs += clamp(V, s.tag("floor", body, at(1, -1.0)), 1)
        below = s.tag("plate", 5, at(1, 1.0))
        self.bolts = [
            uem.Preload(
                s.tag("upper", i + 1, at(1, 0.0)), s.tag("lower", i, at(1, 0.0)), (0, -3.0), coupling=coupling, name=name, **force
            )
            for i, name in ((0, "A"), (2, "B"))
        ]
        self.seat = uem.Contact(s.tag("seat", 4, at(1, 1.0)), below, coupling=coupling)
        heads = [uem.Contact(s.tag("head", i, at(1, 1.0)), below, coupling=coupling, tied=True) for i in (1, 3)]
        self.problem = uem.UnitedProblem(F, self.u, bcs=bcs, contacts=[*self.bolts, *heads, self.seat])

    @property
    def carried(self):
        return [bolt.carried for bolt in self.bolts]


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_joint(coupling):
    """Bolts that are tightened in turn, locked and pulled: springs in parallel, up to the load that opens the joint and beyond."""
    j = Joint(coupling, force=lambda t: 0.03 * t)
    (A, B), (a, b, s) = j.bolts, j.k
    B.tighten(0.0)
    for step in uem.load_steps(j.problem, 2):
        assert j.carried == pytest.approx([0.03 * step.factor, 0.0], abs=1e-15)
        assert A.opening == pytest.approx(-0.03 * step.factor * (1 / a + 1 / s), rel=1e-12)
    # what B is tightened by, sleeve and A give way to in parallel
    A.lock()
    B.tighten(0.02)
    j.problem.solve()
    left = 0.03 - 0.02 * a / (a + s)
    assert j.carried == pytest.approx([left, 0.02], rel=1e-12) and j.seat.resultant().force[1] == pytest.approx(-left - 0.02)
    B.lock()
    opens = (left + 0.02) * (a + b + s) / s
    for part in (0.5, 0.99, 1.1):
        j.lift.value = part * opens
        j.problem.solve()
        by = j.lift.value / (a + b + s) if part < 1 else opens / (a + b + s) + (part - 1) * opens / (a + b)
        assert j.carried == pytest.approx([left + a * by, 0.02 + b * by], rel=1e-12)
        assert j.seat.n_active == (2 if part < 1 else 0)
    # tightened again it is free, and carries the given force
    A.tighten(0.05)
    j.problem.solve()
    assert not A.locked and B.locked and A.carried == pytest.approx(0.05, rel=1e-12)


def test_drawn_up_to_its_seat():
    """The head of a bolt that nothing holds along its axis, and that is drawn apart from its seat, is drawn onto it."""
    b = blocks(COMM, "quadrilateral", 1, 2)
    bolt = uem.Preload(b.high, b.low, force=0.02)
    seat = uem.Contact(b.top, uem.RigidPlane((0.0, 0.98), (0.0, 1.0)))
    sides = [b.scene.tag("side", i, at(0, x)) for i in (0, 1) for x in (0.0, 1.0)]
    rollers = [*clamp(b.V, b.bottom), *(bc for side in sides for bc in clamp(b.V, side, 0))]
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=rollers, contacts=[bolt, seat])
    problem.solve()
    assert bolt.carried == pytest.approx(0.02, rel=1e-12) and seat.resultant().force[1] == pytest.approx(0.02, rel=1e-12)
    assert bolt.opening == pytest.approx(-0.02 - 0.02 / M * (1 + 1 / 2), rel=1e-11)


@pytest.mark.parametrize("coupling", COUPLINGS)
@pytest.mark.parametrize("cell", ["triangle", slow("hexahedron")])
def test_turned_at_finite_strain(cell, coupling):
    """A thick bar between walls under a fifth of its stiffness, of any size and pose: exact force, one opening, quadratic convergence."""
    openings, g = [], 2 if cell == "triangle" else 3
    for angle, size in ((0.0, 1.0), (0.7, 1e-9)):
        R = rotation(g, angle)
        b, force = blocks(COMM, cell, 1, 2, pose=lambda x, A=size * R: x @ A.T), 0.2 * size ** (g - 1)
        # any length and either sign
        bolt = uem.Preload(b.high, b.low, -2.0 * R[:, -1], coupling=coupling, force=force)
        held = [*clamp(b.V, b.bottom), *clamp(b.V, b.top)]
        problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=held, contacts=[bolt], rtol=1e-13)
        history = [i.residual for i in problem.solve()]
        assert all(after < 2 * before**2 for before, after in pairwise(history[1:]) if after > 1e-14) and len(history) < 8
        assert bolt.carried == pytest.approx(force, rel=1e-12)
        assert (R.T @ bolt.resultant().force)[-1] == pytest.approx(-force, rel=1e-12)
        openings.append(bolt.opening / size)
    assert openings[0] == pytest.approx(openings[1], rel=1e-11) and openings[0] < -0.1


@pytest.mark.parametrize("locked", [False, True])
def test_continues_from_a_checkpoint(tmp_path, locked):
    """A run that continues from a file is the run that was not interrupted, to the last bit, free or locked."""
    path, kept, found = COMM.bcast(str(tmp_path / "state")), [], []
    for continues in (False, True):
        j = Joint("mortar", force=0.03)
        if continues:
            uem.read_checkpoint(path, j.problem.state())
        else:
            j.problem.solve()
            for bolt in j.bolts if locked else ():
                bolt.lock()
            uem.write_checkpoint(path, j.problem.state())
        kept.append((j.carried, [bolt.opening for bolt in j.bolts], [bolt.locked for bolt in j.bolts]))
        j.lift.value = 0.02
        history = [i.residual for i in j.problem.solve()]
        found.append((j.carried, [bolt.opening for bolt in j.bolts], j.u.x.array.tolist(), history))
    assert kept[0] == kept[1] and kept[0][2] == [locked, locked]
    assert found[0] == found[1]


def test_energy_in_motion():
    """A force that acts at once sets the bar swinging: what it works along the opening is in motion and strain."""
    b = blocks(COMM, "quadrilateral", 1, 2)
    bolt = uem.Preload(b.high, b.low, force=0.02)
    E = modulus(b.scene, 1.0, 2.0)
    dynamics = uem.Dynamics(uem.lumped_mass(b.V, 1.0))
    F = linear(b.u, E)
    problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.0), contacts=[bolt], dynamics=dynamics)
    book, openings = uem.EnergyBook(problem, 0.5 * ufl.replace(F, {F.arguments()[0]: b.u})), []
    for step in uem.time_steps(problem, 0.1, 2.0):
        row = book.write(step)
        openings.append(bolt.opening)
        assert bolt.carried == pytest.approx(0.02, rel=1e-9)
        assert row.kinetic + row.stored == pytest.approx(-0.02 * openings[-1], rel=1e-9)
    # it swings between no opening and about twice that at rest
    assert min(openings) == pytest.approx(-2 * 0.02 / M * 1.5, rel=0.2) and max(openings) < 0.0


def test_shortened_in_motion():
    """A section that is shortened in time does work as a tool does: no step is cut for it, and the energy book closes."""
    b = blocks(COMM, "quadrilateral", 2, 4, degree=1)
    bolt = uem.Preload(b.high, b.low, shortening=lambda t: 0.03 * np.sin(0.5 * np.pi * t) ** 2)
    F, dynamics = linear(b.u, modulus(b.scene, 1.0, 2.0)), uem.Dynamics(uem.lumped_mass(b.V, 1.0))
    problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.0), contacts=[bolt], dynamics=dynamics)
    book = uem.EnergyBook(problem, 0.5 * ufl.replace(F, {F.arguments()[0]: b.u}))
    for n, step in enumerate(uem.time_steps(problem, 0.1, 1.0), 1):
        row = book.write(step)
        assert step.number == n and step.cuts == 0 and bolt.opening == pytest.approx(-0.03 * np.sin(0.05 * np.pi * n) ** 2)
    assert row.contact > 1e-4 and abs(row.defect) <= 1e-12


def test_what_is_refused():
    b = blocks(COMM, "triangle", 1, 1)
    E = modulus(b.scene, 1.0, 1.0)

    def problem(axis=None, bcs=(), **how):
        bolt = uem.Preload(b.high, b.low, axis, **({"force": 1.0} | how))
        return bolt, uem.UnitedProblem(
            linear(b.u, E), b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top), *bcs], contacts=[bolt]
        )

    raised(uem.InputError, "lies in the section, whose normal is", lambda: problem((1.0, 0.0)))
    raised(uem.InputError, "axis = .*expected 2 finite numbers", lambda: problem((1.0, 0.0, 0.0)))
    raised(uem.InputError, "axis = .*non-zero", lambda: problem((0.0, 0.0)))
    raised(uem.InputError, "force = nan: expected a finite number", lambda: problem(force=np.nan))
    raised(uem.InputTypeError, "force = 'much'", lambda: problem(force="much"))
    raised(uem.InputError, r"force\(0\) = inf", lambda: problem(force=lambda t: np.inf))
    plane = uem.RigidPlane((0.0, 0.0), (0.0, 1.0))
    raised(uem.InputTypeError, "target = .*the other face of the section", lambda: uem.Preload(b.high, plane, force=1.0))
    raised(uem.SurfaceError, "conditions hold all of the section", lambda: problem(bcs=[*clamp(b.V, b.high), *clamp(b.V, b.low)]))
    apart = blocks(COMM, "triangle", 1, 1, gap=3.0)
    far = uem.Preload(apart.high, apart.low, force=1.0)
    held = clamp(apart.V, apart.bottom)
    raised(
        uem.SurfaceError,
        "no contactor is near enough",
        lambda: uem.UnitedProblem(linear(apart.u, 1.0), apart.u, bcs=held, contacts=[far]),
    )
    raised(uem.SurfaceError, "belongs to no problem", lambda: uem.Preload(b.high, b.low, force=1.0).lock())
    bolt, _ = problem()
    raised(uem.InputTypeError, "force = None", lambda: bolt.tighten(None))
    raised(uem.InputError, "has no 'force' to be set", lambda: setattr(bolt, "force", 2.0))


@pytest.mark.parametrize(
    ("cell", "coupling", "h"),
    [("triangle", "mortar", np.inf), slow("triangle", "node_to_surface", 6.0), slow("hexahedron", "node_to_surface", np.inf)],
)
def test_a_section_conducts(cell, coupling, h):
    """A bolt between walls, tightened, locked and heated at one end: heat flows as through one piece, or a joint, and relieves it."""
    b = blocks(COMM, cell, 2, 3 if coupling == "mortar" else 4)
    g, E, ALPHA, K = b.gdim, 1000.0, 1e-5, 3.0
    W = uem.function_space(b.scene.mesh, [("Lagrange", 1, (g,)), 1])
    w, hot, (v, q) = fem.Function(W), fem.Constant(b.scene.mesh, 0.0), ufl.TestFunctions(W)
    u, T = ufl.split(w)
    law = uem.LinearElastic(E, 0.0, kind="plane_stress" if g == 2 else "3d")
    F = (law.residual(u, v) - law.thermal_residual(u, v, ALPHA * T) + K * ufl.inner(ufl.grad(T), ufl.grad(q))) * ufl.dx
    sides = [(c, b.scene.tag("side", body, at(c, end))) for c in range(g - 1) for end in (0.0, 1.0) for body in (0, 1)]
    bcs = [uem.dirichlet(W.sub(0), tag, c) for c, tag in (*sides, (g - 1, b.bottom), (g - 1, b.top))]
    bcs += [uem.dirichlet(W.sub(1), b.bottom, value=hot), uem.dirichlet(W.sub(1), b.top)]
    bolt = uem.Preload(b.high, b.low, np.eye(g)[-1], force=5.0, coupling=coupling, heat=uem.Conductance(h, field=1))
    problem = uem.UnitedProblem(F, w, displacement=0, bcs=bcs, contacts=[bolt], rtol=1e-11)
    problem.solve()
    assert bolt.carried == pytest.approx(5.0, rel=1e-9)
    bolt.lock()
    hot.value = 100.0
    problem.solve()
    # h = infinity: as one piece of length 2
    flux = 100.0 / (2.0 / K + 1.0 / h)
    assert abs(bolt.heat_power) == pytest.approx(flux, rel=1e-8)
    assert bolt.carried == pytest.approx(5.0 - E * ALPHA * 50.0, rel=1e-8)
