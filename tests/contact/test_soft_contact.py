"""Soft contact: a pressure by the gap, p(g), on either coupling, in statics and in time; hard contact is its limit.

The tests to read first are ``test_closure_of_a_joint`` and ``test_the_limit_is_hard_contact``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import NU, M, arch, at, blocks, box, clamp, highest, linear, refused, run, scene, slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.solve.bodies.tangent import contact_curvature, curvature_of

COMM = MPI.COMM_WORLD
ROUGH = uem.Exponential(2e-3, 1e-3)


def closure(law, load: float) -> float:
    """Closure of a joint, minus its gap, under a pressure."""
    return law.h * (np.log(load / law.p0) if isinstance(law, uem.Exponential) else (load / law.p0) ** (1 / law.m))


def pressed(b, load, contacts, body=linear, **how) -> uem.UnitedProblem:
    """Two blocks between rollers and the ground, the upper one under a pressure at its top, which contact alone holds up."""
    g, x = b.gdim, b.scene.drawing
    bcs = clamp(b.V, b.bottom, g - 1)
    for c in range(g - 1):
        for end in (x[:, c].min(), x[:, c].max()):
            for part in (0, 1):
                bcs += clamp(b.V, b.scene.tag("side", part, at(c, end)), c)
    p = fem.Constant(b.scene.mesh, 0.0)
    F = body(b.u, 1.0) + p * ufl.TestFunction(b.u.function_space)[g - 1] * uem.ds(b.top)
    return uem.UnitedProblem(F, b.u, bcs=bcs, contacts=contacts, load={p: load}, petsc_options_prefix="soft_", **how)


def settled(b) -> float:
    """Mean displacement of the top."""
    area = uem.integrate(fem.Constant(b.scene.mesh, 1.0) * uem.ds(b.top))
    return uem.integrate(b.u[b.gdim - 1] * uem.ds(b.top)) / area


def test_prescribed_contactors_press():
    """A surface that is prescribed to be inside a plane has the force of the law there."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [2.0, 1.0], [3, 2])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, bottom = fem.Function(V), s.tag("bottom", 0, at(1, 0.0))
    bcs = clamp(V, bottom, value=(0.0, -0.01)) + clamp(V, s.tag("top", 0, at(1, 1.0)))
    contact = uem.Contact(bottom, uem.RigidPlane((0, 0), (0, 1)), normal=uem.SoftContact(3.0))
    uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact]).solve()
    assert contact.resultant().force == pytest.approx([0.0, 3.0 * 0.01 * 2.0], rel=1e-12, abs=1e-14)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("cell", ["quadrilateral", *map(slow, ["triangle", "hexahedron", "tetrahedron"])])
@pytest.mark.parametrize("law", [ROUGH, uem.PowerLaw(1e-2, 1e-3, 2.0)], ids=lambda law: type(law).__name__)
def test_closure_of_a_joint(cell, coupling, degree, law):
    """A stack of blocks closes by that of its joint, on any mesh: constant pressure, constant gap (the patch test)."""
    b = blocks(COMM, cell, 2, 3 if coupling == "mortar" else 4, degree=degree)
    contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(law), coupling=coupling)
    for step in uem.load_steps(pressed(b, load := 0.02, [contact]), 2):
        load = 0.02 * step.factor
        assert step.newton_iterations < 10
        assert -settled(b) == pytest.approx(2 * load / M + closure(law, load), rel=1e-10)
        assert highest(COMM, np.abs(contact.pressures / load - 1)) < 1e-9
        assert highest(COMM, np.abs(contact.pair.gaps() + closure(law, load))) < 1e-11
        assert contact.balance().force < 1e-13 and contact.balance().moment < 1e-13
        assert contact.resultant().force[-1] == pytest.approx(load, rel=1e-10)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("degree", [1, 2])
def test_general_contact(coupling, degree):
    """One declaration of all surfaces: the blocks close as those of a declared contact, and neither presses twice."""
    law, load = ROUGH, 0.02
    b = blocks(COMM, "quadrilateral", 3, 6, degree=degree, overhang=0.25)
    contact = uem.GeneralContact(normal=uem.SoftContact(law), coupling=coupling)
    run(pressed(b, load, [contact]), 2)
    low = blocks(COMM, "quadrilateral", 3, 6, degree=degree, overhang=0.25)
    single = uem.Contact(low.high, low.low, normal=uem.SoftContact(law), coupling=coupling)
    run(pressed(low, load, [single]), 2)
    # at its edges a surface of all facets counts those that face the target
    near = 1e-3 if coupling == "node_to_surface" else 1e-9
    assert settled(b) == pytest.approx(settled(low), rel=near)
    assert contact.max_pressure() == pytest.approx(single.max_pressure(), rel=10 * near)
    (touch,) = contact.touching()
    assert abs(touch.force[1]) == pytest.approx(load, rel=1e-8)


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("degree", [1, slow(2)])
def test_the_limit_is_hard_contact(coupling, degree):
    """With growing stiffness a block pressed askew tends to hard contact, to first order in 1/stiffness, in as many iterations."""

    def bent(normal):
        b = blocks(COMM, "quadrilateral", 3, 5, degree=degree, overhang=0.5)
        bcs = clamp(b.V, b.bottom, 0) + clamp(b.V, b.bottom, 1)
        down = fem.Function(b.V)
        down.interpolate(lambda x: np.stack([0.0 * x[0], -0.02 - 0.01 * x[0]]))
        bcs += [uem.dirichlet(b.V, b.top, value=down)]
        contact = uem.Contact(b.high, b.low, normal=normal, coupling=coupling)
        (step,) = run(uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact], petsc_options_prefix="soft_"))
        return contact.resultant(), step.newton_iterations, contact.balance()

    hard, _, _ = bent(None)
    errors = []
    for k in (1e3, 1e4, 1e6, 1e9):
        soft, iterations, balance = bent(uem.SoftContact(k))
        errors.append(np.abs(soft.force - hard.force).max() / np.abs(hard.force).max())
        assert iterations <= 6
        assert balance.force < 1e-13 and balance.moment < 1e-9
    assert errors[0] < 2e-2 and errors[1] == pytest.approx(errors[0] / 10, rel=0.1)
    assert errors[2] == pytest.approx(errors[1] / 100, rel=0.1) and errors[3] < 1e-6


@pytest.mark.long
@pytest.mark.parametrize("contactors", ["massless", "massy"])
def test_frequency_on_a_contact_stiffness(contactors):
    """A stiff mass on a soft contact swings about its rest with the period 2 pi sqrt(m / (k A)), and loses no energy."""
    k, m, gravity, E = 40.0, 1.0, 1.0, 1e6
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [2, 8])])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V, name="u")
    plane = uem.RigidPlane((0, 0), (0, 1))
    contact = uem.Contact(s.tag("bottom", 0, at(1, 0.0)), plane, normal=uem.SoftContact(k))
    dynamics = uem.Dynamics(uem.consistent_mass(V, m), gravity=(0.0, -gravity), contactors=contactors)
    bcs = [bc for end in (0.0, 1.0) for bc in clamp(V, s.tag("side", 0, at(0, end)), 0)]
    how = {"dynamics": dynamics, "petsc_options_prefix": "soft_"}
    problem = uem.UnitedProblem(linear(u, E, 0.0), u, bcs=bcs, contacts=[contact], **how)
    eps = ufl.sym(ufl.grad(u))
    book = uem.EnergyBook(problem, stored=0.5 * E * ufl.inner(eps, eps) * ufl.dx)
    period, n = 2 * np.pi * np.sqrt(m / k), 100
    heights = []
    for step in uem.time_steps(problem, period / n, period):
        book.write(step)
        heights.append(highest(COMM, u.x.array[1::2]))
    swing = m * gravity / k
    expected = -swing + swing * np.cos(2 * np.pi * np.arange(1, n + 1) / n)
    # the trapezoidal rule lengthens the period by (omega dt)^2 / 12
    assert np.abs(heights - expected).max() < swing * (2 * np.pi * (2 * np.pi / n) ** 2 / 12 + 1e-4)
    energy = 0.5 * k * swing**2
    assert max(abs(row.defect) for row in book.rows) < 1e-6 * energy and abs(book.rows[-1].contact) < 1e-2 * energy


@pytest.mark.parametrize("law", [ROUGH, uem.PowerLaw(1e-2, 1e-3, 2.0), [(-2e-3, 0.03), (-1e-3, 0.01), (0.0, 0.0)]], ids=type)
def test_a_load_cycle_is_elastic(law):
    """Down and up again every state comes back, and with it the work: nothing is lost."""
    b = blocks(COMM, "quadrilateral", 2, 3)
    contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(law))
    problem = pressed(b, lambda s: 0.02 * (1.0 - 0.9 * abs(2.0 * s - 1.0)), [contact], st_venant)
    states = [(settled(b), contact.max_pressure()) for _ in uem.load_steps(problem, 8)]
    assert states[4:-1] == [pytest.approx(state, rel=1e-8) for state in states[2::-1]]


def test_a_block_that_rests_on_a_power_law():
    """A block falls onto a surface without stiffness at gap 0, and sinks in; a later step with less load comes up again."""
    law, weight = uem.PowerLaw(1e-2, 1e-3, 3.0), 0.02
    assert -2e-2 < law.rest / law.h < -5e-3
    b = blocks(COMM, "quadrilateral", 2, 4, gap=0.3)
    contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(law))
    problem = pressed(b, lambda s: weight * (1.0 - 0.75 * (s > 0.6)), [contact])
    for step in uem.load_steps(problem, 2):
        load = weight * (1.0 - 0.75 * (step.factor > 0.6))
        assert -settled(b) == pytest.approx(0.3 + 2 * load / M + closure(law, load), rel=1e-9)
        assert step.newton_iterations < 15


@pytest.mark.parametrize("part", [1.0, 1e-4, 1e-2, 1e3])
def test_light_and_heavy_blocks(part):
    """Far up the flank of an exponential law, and far down, a light or heavy block is in equilibrium."""
    law = uem.Exponential(1e-4, 1e-3)
    b = blocks(COMM, "quadrilateral", 2, 4)
    contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(law))
    run(pressed(b, lambda s: part * law.p0 * 0.5 * (1 + s), [contact]), 2)
    assert contact.max_pressure() == pytest.approx(part * law.p0, rel=1e-6)


def test_what_holds_a_body():
    """A flank of a millionth of the slope at rest, the load of a feather; a law without slope lets the body fall."""
    for gap, holds in ((13e-3, True), (14.6e-3, False)):
        b = blocks(COMM, "quadrilateral", 2, 4, gap=gap)
        contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(uem.Exponential(1e-4, 1e-3)))
        pressed(b, 1e-3, [contact])
        assert (COMM.allreduce(len(contact.pair.equations())) > 0) == holds
    b = blocks(COMM, "quadrilateral", 2, 4)
    problem = pressed(b, 1e-3, [uem.Contact(b.high, b.low, normal=uem.SoftContact(lambda g: 0.0 * g))])
    refused(uem.FloatingBodyError, "no contact stops it", lambda: run(problem))


@pytest.mark.parametrize("unit", [1e-9, 1e-3, 1e3])
def test_units_of_length(unit):
    """Drawn in nm, mm or km, the joint closes by as much, in as many iterations."""

    def closed(scale):
        b = blocks(COMM, "quadrilateral", 2, 4, pose=lambda x: scale * x)
        law = uem.Exponential(2e-3, 1e-3 * scale)
        contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(law))
        bcs = clamp(b.V, b.bottom, 0) + clamp(b.V, b.bottom, 1) + clamp(b.V, b.top, 0) + clamp(b.V, b.top, 1, value=-0.02 * scale)
        (step,) = run(uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact], petsc_options_prefix="soft_"))
        return contact.resultant().force[1] / scale, contact.max_pressure(), step.newton_iterations

    assert closed(unit) == pytest.approx(closed(1.0), rel=1e-9)


def test_a_run_that_continues(folder):
    """From a checkpoint a run continues as if it had not ended; another law is named."""

    def begun(law=ROUGH):
        b = blocks(COMM, "quadrilateral", 2, 3)
        contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(law))
        return b, contact, pressed(b, 0.02, [contact])

    b, contact, problem = begun()
    whole = [settled(b) for _ in uem.load_steps(problem, 3)]
    b, contact, problem = begun()
    for step in uem.load_steps(problem, 3, checkpoint=uem.Checkpoint(folder / "run.npz")):
        if step.number == 2:
            break
    b, contact, problem = begun()
    rest = [settled(b) for _ in uem.load_steps(problem, 3, checkpoint=uem.Checkpoint(folder / "run.npz"))]
    assert rest == pytest.approx(whole[2:], rel=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("general", [True, slow(False)])
def test_damped_surfaces_that_are_far_apart_at_first(general, folder):
    """The flight before does not change how a damped block meets another, and a run that stops on the way continues as the whole one."""

    def fallen(gap, n, stop=None):
        b = blocks(COMM, "quadrilateral", 2, 3, gap=gap)
        normal = uem.SoftContact(20.0, damping=2.0)
        contact = uem.GeneralContact(normal=normal) if general else uem.Contact(b.high, b.low, normal=normal)
        velocity = fem.Function(b.V)
        velocity.x.array[1::2] = np.where(b.V.tabulate_dof_coordinates()[:, 1] > 0.5 * gap, -1.0, 0.0)
        dynamics = uem.Dynamics(uem.lumped_mass(b.V, 1.0), velocity=velocity, contactors="massy")
        problem = uem.UnitedProblem(linear(b.u, 10.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact], dynamics=dynamics)
        for step in uem.time_steps(problem, 0.1, 0.1 * n, checkpoint=stop and uem.Checkpoint(folder / "run.npz")):
            if step.number == stop:
                break
        return b.scene.gather(b.u) + np.where(b.scene.drawing[:, 1:] > 0.5 * gap, [[0.0, gap]], 0.0)

    whole = fallen(0.8, 12)
    fallen(0.8, 12, stop=3)
    assert np.abs(fallen(0.8, 12, stop=99) - whole).max() < 1e-12
    near = fallen(0.1, 5)
    assert np.abs(near - whole).max() < 1e-6 * np.abs(whole).max()


@pytest.mark.parametrize("general", [False, slow(True)])
def test_contactors_over_edges_of_tetrahedra(general):
    """Contactors that alternate between two facets of a bending surface get averaged normals, and a step ends."""
    b = blocks(COMM, "tetrahedron", 2, 3, overhang=0.3)
    normal = uem.SoftContact(uem.Exponential(2e-3, 1e-3))
    contact = uem.GeneralContact(normal=normal) if general else uem.Contact(b.high, b.low, normal=normal)
    bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top, value=(0.0, 0.0, -0.03))]
    (step,) = run(uem.UnitedProblem(st_venant(b.u, 1.0), b.u, bcs=bcs, contacts=[contact], petsc_options_prefix="soft_"))
    assert step.newton_iterations < 20 and step.cuts == 0


def test_switched_off_and_on():
    """A soft contact that is switched off presses no more, and presses as before when it is on again."""
    b = blocks(COMM, "quadrilateral", 2, 4)
    contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(ROUGH))
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.02), contacts=[contact], petsc_options_prefix="soft_")
    steps = [uem.Step(), uem.Step(contacts={contact: False}), uem.Step(contacts={contact: True})]
    forces = [contact.resultant().force[1] for _ in uem.load_steps(problem, steps)]
    assert forces[0] > 0.01 and forces[1] == 0.0 and forces[2] == pytest.approx(forces[0], rel=1e-8)


def test_what_is_refused():
    """What does not go with a soft contact is named; so are laws that are none."""
    b = blocks(COMM, "quadrilateral", 2, 3)
    soft = uem.SoftContact(1.0)
    for what, how in (
        ("friction", {"friction": 0.3}),
        ("wear", {"wear": 1e-3}),
        ("tied", {"tied": True}),
        ("heat with h = inf", {"heat": uem.Conductance(np.inf, field=1)}),
    ):
        refused(
            uem.InputError,
            f"{what} does not go with normal = SoftContact",
            lambda how=how: uem.Contact(b.high, b.low, normal=soft, **how),
        )
    refused(uem.InputError, "friction does not go", lambda: uem.GeneralContact(normal=soft, friction=0.3))
    refused(uem.InputTypeError, "a SoftContact", lambda: uem.Contact(b.high, b.low, normal=1.0))

    def problem(*contacts, **how):
        return pressed(b, 0.02, list(contacts), **how)

    both = [uem.Contact(b.high, b.low, normal=soft), uem.Contact(b.low, b.high, normal=soft)]
    refused(uem.ConflictError, "share the pressure", lambda: problem(*both))
    far = uem.GeneralContact(normal=uem.SoftContact(uem.Exponential(1.0, 0.1)))
    refused(uem.InputError, "at a gap of half a facet", lambda: problem(far))
    one = uem.Contact(b.high, b.low, normal=soft)
    made = problem(one)
    run(made)
    explicit = uem.Dynamics(uem.lumped_mass(b.V, 1.0), scheme=uem.CentralDifferences())
    soft_one = uem.Contact(b.high, b.low, normal=soft)
    refused(uem.InputError, "CentralDifferences", lambda: problem(soft_one, dynamics=explicit))


@pytest.mark.parametrize("cell, coupling, target, overhang, degree", [
    ("triangle", "node_to_surface", "mesh", 0.25, 1),
    ("triangle", "mortar", "mesh", 0.25, 1),
    ("triangle", "mortar", "mesh", 0.0, 1),
    ("triangle", "mortar", "mesh", -0.24, 1),
    ("quadrilateral", "mortar", "mesh", 0.25, 2),
    slow("triangle", "mortar", "ball", 0.25, 1),
    slow("quadrilateral", "mortar", "mesh", 0.25, 1),
    slow("quadrilateral", "mortar", "ball", 0.25, 2),
    slow("tetrahedron", "node_to_surface", "mesh", 0.25, 1),
    slow("tetrahedron", "mortar", "mesh", 0.25, 1),
    slow("tetrahedron", "mortar", "ball", 0.25, 1),
    slow("tetrahedron", "mortar", "ball", 0.25, 2),
    slow("hexahedron", "mortar", "mesh", -0.15, 1),
    slow("hexahedron", "mortar", "mesh", -0.15, 2),
    slow("hexahedron", "mortar", "mesh", 0.25, 2),
])  # fmt: skip
def test_the_tangent_is_the_derivative(cell, coupling, target, overhang, degree):
    """On arched surfaces forces are those of the energy in the gaps, and ``K + sum k r r' - sum lambda grad^2 g`` is their derivative.

    Without overhang facets of the contactor are covered in part, and with a negative one hardly. Gaps are far from closed.
    """
    law = uem.Exponential(2e-3, 5e-2)
    b = blocks(COMM, cell, 3, 4, pose=arch(0.2), gap=-0.02, overhang=overhang, degree=degree)
    ball = uem.RigidSphere([0.4] * (b.gdim - 1) + [-2.0], 2.0)
    contact = uem.Contact(b.high, b.low if target == "mesh" else ball, normal=uem.SoftContact(law), coupling=coupling)
    problem = uem.UnitedProblem(st_venant(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])
    system, pair, config = problem.system, contact.pair, problem.config
    x = config.X
    smooth = 0.005 * np.stack([np.sin(2 * x[:, i] + i) for i in range(b.gdim)], axis=1)
    direction = np.stack([np.cos(3 * x[:, i] + 2 * i) for i in range(b.gdim)], axis=1)

    def residual(u):
        problem.u.x.array[:] = u.ravel()
        system.place()
        problem.bodies.assemble()
        return system.residual()

    def total(values) -> float:
        return COMM.allreduce(float(np.sum(values)))

    assert highest(COMM, np.abs(residual(smooth).array_r)) > 0 and COMM.allreduce(int((pair.trial.lam > 0).sum())) > 2
    area, n = np.where(pair.off, 0.0, contact.measured_areas()), config.n_owned
    force = total(config.add_at_owners(*pair.applied_forces()) * direction[:n])
    K = problem.bodies.update_tangent().copy()
    nodes, blocks_of_gaps, left = pair.slip_terms()
    assert highest(COMM, np.abs(left)) < 1e-12
    of_gaps = contact_curvature([(nodes, blocks_of_gaps)], config.vector())
    bends = curvature_of([pair], config.vector(), True, False)
    du = K.createVecRight()
    du.array[:] = direction[:n].ravel()
    of_contact = of_gaps * du + bends * du
    h = 1e-6
    sides = []
    for side in (h, -h):
        found = residual(smooth + side * direction)
        sides.append((found, total(area * law.p0 * law.h * np.exp(-pair.gaps() / law.h))))
    (ahead, more), (behind, less) = sides
    assert (more - less) / (2 * h) == pytest.approx(-force, rel=1e-7)
    found = (ahead - behind) * (0.5 / h) - K * du
    assert (found - of_contact).norm() < 1e-5 * of_contact.norm()
    assert (bends * du).norm() > 1e-2 * of_contact.norm() and (of_gaps * du).norm() > 1e-2 * of_contact.norm()


@pytest.mark.slow
@pytest.mark.parametrize("degree", [1, 2])
def test_what_a_slide_stores(degree):
    """Without friction the work of a block that slides over an arch by mortar is stored in the bodies and in the gaps."""
    law, travel, press = uem.Exponential(2e-3, 2e-2), 0.5, 0.03

    def slid(steps):
        b = blocks(COMM, "quadrilateral", 6, 3, pose=arch(0.2), degree=degree, overhang=0.75)
        contact = uem.Contact(b.high, b.low, normal=uem.SoftContact(law), coupling="mortar")
        down = uem.dirichlet(
            b.V, b.top, value=lambda x, s: np.stack([travel * s + 0 * x[0], -press * min(1.0, 2 * s) + 0 * x[0]])
        )
        problem = uem.UnitedProblem(st_venant(b.u, 1.0), b.u, bcs=[*clamp(b.V, b.bottom), down], contacts=[contact])
        E = 0.5 * (ufl.grad(b.u).T * ufl.grad(b.u) + ufl.grad(b.u) + ufl.grad(b.u).T)
        shear = 0.5 / (1 + NU)
        stored = 0.5 * (M - 2 * shear) * ufl.tr(E) ** 2 + shear * ufl.inner(E, E)
        forces, energies = [], []
        for step in uem.load_steps(problem, 2 * steps):
            assert step.newton_iterations <= 6
            in_gaps = float((contact.measured_areas() * law.p0 * law.h * np.exp(-contact.pair.gaps() / law.h)).sum())
            forces.append(contact.resultant().force[0])
            energies.append(uem.integrate(stored * ufl.dx) + COMM.allreduce(in_gaps))
        pull = np.array(forces[steps - 1 :])
        return -travel * np.sum(pull[1:] + pull[:-1]) / (4 * steps), energies[-1] - energies[steps - 1]

    (coarse, _), (fine, gained) = slid(4), slid(8)
    # Simpson's rule
    assert (4 * fine - coarse) / 3 == pytest.approx(gained, rel=5e-3)


@pytest.mark.slow
def test_averaged_normals_last_until_the_end_of_a_step():
    """A free block on a polygonal bowl, whose contactors alternate between facets: forces at the end are the loads."""

    def bend(x):
        return np.column_stack([x[:, 0], x[:, 1] + 0.3 * (x[:, 0] - 0.5) ** 2])

    def at_height(h):
        return lambda x: np.abs(x[:, 1] - 0.3 * (x[:, 0] - 0.5) ** 2 - h) < 1e-9

    parts = [([-0.5, -1.0], [1.5, 0.0], [4, 3]), ([0.0, 0.0], [1.0, 1.0], [3, 3])]
    s = scene(COMM, "quadrilateral", [box("quadrilateral", *part).mapped(bend) for part in parts])
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    lid = s.tag("lid", 1, at_height(1.0))
    load = fem.Constant(s.mesh, 0.0)
    F = linear(u, 1.0) + load * v[1] * uem.ds(lid)
    foot, top = s.tag("foot", 1, at_height(0.0)), s.tag("top", 0, at_height(0.0))
    contact = uem.Contact(foot, top, normal=uem.SoftContact(100.0), max_penetration=0.5)
    bcs = clamp(V, s.tag("base", 0, at_height(-1.0)))
    run(uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], load={load: 0.02}, rtol=1e-10), 2)
    length = uem.integrate(fem.Constant(s.mesh, 1.0) * uem.ds(lid))
    assert contact.resultant().force == pytest.approx([0.0, 0.02 * length], rel=1e-8, abs=1e-10 * length)
