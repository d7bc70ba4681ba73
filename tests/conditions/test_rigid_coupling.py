"""Surfaces and bodies that move rigidly with a point, and loads that are spread.

Two tests to read first: ``test_large_turns``, exact rigidity and quadratic convergence, and ``test_a_mean_motion_works_with_its_load``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, blocks, box, clamp, highest, linear, modulus, refused, run, scene, slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.conditions.rigid_set import RigidSet, moments, turned
from uem_dolfinx.geometry.rigid import rotation_matrix

COMM = MPI.COMM_WORLD


class Bar:
    """A bar of length 2 with its ends, in the plane or in space."""

    def __init__(self, cell="quadrilateral", degree=1):
        g = 2 if cell in ("quadrilateral", "triangle") else 3
        self.g, self.k = g, 1 if g == 2 else 3
        self.scene = scene(COMM, cell, [box(cell, [0.0] * g, [2.0, *[1.0] * (g - 1)], [4, *[2] * (g - 1)])])
        self.V = compat.function_space(self.scene.mesh, degree, (g,))
        self.u = fem.Function(self.V, name="u")
        self.left, self.right = self.scene.tag("left", 0, at(0, 0.0)), self.scene.tag("right", 0, at(0, 2.0))
        self.point = np.array([2.7, 0.4, 0.1])[:g]

    def problem(self, *couplings, law=linear, bcs=None, **how):
        bcs = clamp(self.V, self.left) if bcs is None else bcs
        return uem.UnitedProblem(law(self.u, 1.0), self.u, bcs=bcs, couplings=list(couplings), **how)

    def nodes(self, problem, x=2.0):
        return np.flatnonzero(np.isclose(problem.config.X[: problem.config.n_owned, 0], x))

    def moment_of_left(self, problem):
        """Moment of the support about the coupling's point as it is drawn (collective)."""
        config, m = problem.config, self.nodes(problem, 0.0)
        problem.bodies.assemble()
        return COMM.allreduce(moments(config.X[m] - self.point, problem.bodies.forces[m]).sum(axis=0))


def rigid_part(coupling, X, point):
    """Displacement of places that go with a small motion of the coupling."""
    return coupling.displacement + turned(np.atleast_1d(coupling.rotation), X - point)


@pytest.mark.parametrize(("cell", "degree"), [("quadrilateral", 2), slow("tetrahedron", 1)])
def test_loads_and_motions_are_conjugate(cell, degree):
    """The support balances force and moment; prescribed, in part or all of it, the motion found takes them as reactions."""
    b = Bar(cell, degree)
    force, moment = np.array([0.01, 0.02, -0.01])[: b.g], np.array([0.03, 0.01, -0.02])[: b.k]
    loaded = uem.RigidCoupling(b.right, b.point, force=force, moment=moment)
    problem = b.problem(loaded)
    problem.solve()
    assert np.allclose(problem.reaction(b.left), -force, rtol=1e-11)
    assert np.allclose(b.moment_of_left(problem), -moment, rtol=1e-10)
    config, m = problem.config, b.nodes(problem)
    assert highest(COMM, np.abs(config.displacement[m] - rigid_part(loaded, config.X[m], b.point))) <= 1e-13
    found, u = np.append(loaded.displacement, loaded.rotation), np.array(b.u.x.array)
    for held in (range(len(found)), (0, len(found) - 1)):
        b.u.x.array[:] = 0.0
        rest = np.where(np.isin(range(len(found)), list(held)), 0.0, np.append(force, moment))
        motion = [found[i] if i in held else None for i in range(len(found))]
        led = uem.RigidCoupling(b.right, b.point, motion=motion, force=rest[: b.g], moment=rest[b.g :])
        for step in uem.load_steps(b.problem(led), 2):
            assert np.allclose(np.append(led.displacement, led.rotation)[list(held)], step.factor * found[list(held)], rtol=1e-12)
        assert np.abs(b.u.x.array - u).max(initial=0.0) <= 1e-10 * np.abs(found).max()
        assert np.allclose(np.append(*led.reaction) + rest, np.append(force, moment), rtol=1e-9)


def test_a_motion_by_expressions():
    """Of Constants and of the place, which is the point: ramped, but for a Constant of the load; gradients by it are refused."""
    b = Bar()
    mesh = b.u.function_space.mesh
    c, d, X = fem.Constant(mesh, 0.1), fem.Constant(mesh, (0.01, 0.02)), ufl.SpatialCoordinate(mesh)
    motion, there = (c * X[0] - d[1], X[1] * d[0] ** 2, ufl.sin(c)), lambda c: np.array([2.7 * c - 0.02, 0.4e-4, np.sin(c)])
    led = uem.RigidCoupling(b.right, b.point, motion=motion)
    problem = b.problem(led)
    for step in uem.load_steps(problem, 2):
        assert np.append(led.displacement, led.rotation) == pytest.approx(step.factor * there(0.1), rel=1e-12)
    refused(uem.InputError, "expression", lambda: uem.gradient(problem, ufl.inner(b.u, b.u) * ufl.dx, c))
    b.u.x.array[:] = 0.0
    led = uem.RigidCoupling(b.right, b.point, motion=motion)
    problem = b.problem(led, load={c: 0.2})
    for step in uem.load_steps(problem, 2):
        assert led.displacement[0] == pytest.approx(there(0.2 * step.factor)[0], rel=1e-12)
    for wrong in (2.0 * d, b.u[0]):
        refused(
            uem.InputTypeError, "expression of Constants", lambda: uem.RigidCoupling(b.right, b.point, motion=(wrong, None, None))
        )


def test_conditions_among_rigid_nodes():
    """Dirichlet values on a rigid part guide it, as far as a rigid motion can follow them."""
    b = Bar()
    top = b.scene.tag("top", 0, lambda x: np.isclose(x[:, 1], 1.0))
    roof = clamp(b.V, top, 1, value=0.0)
    guided = uem.RigidCoupling(b.right, b.point, force=(0.01, 0.02))
    problem = b.problem(guided, bcs=[*clamp(b.V, b.left), *roof])
    problem.solve()
    assert abs(guided.displacement[1] + guided.rotation * (2.0 - b.point[0])) <= 1e-14 and guided.displacement[0] > 0
    bent = fem.Function(b.V)
    bent.interpolate(lambda x: np.stack([0.0 * x[0], 0.1 * x[1] ** 2]))
    end = fem.dirichletbc(bent, fem.locate_dofs_geometrical(b.V, lambda x: np.isclose(x[0], 2.0)))
    problem = b.problem(uem.RigidCoupling(b.right, b.point), bcs=[end])
    refused(uem.ConflictError, ("RigidCoupling of 'right'", "no rigid motion"), problem.solve)


# -- large turns -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", slow("hexahedron")])
def test_large_turns(cell):
    """A bar of finite strain is bent far: its end stays rigid to the last digits, and Newton's method is quadratic."""
    b = Bar(cell)
    turn = 0.8 if b.g == 2 else np.array([0.4, 0.3, 0.7])
    free = [None] * b.g
    coupling = uem.RigidCoupling(b.right, b.point, force=np.full(b.g, 0.002), motion=[*free, *np.atleast_1d(turn)])
    problem = b.problem(coupling, law=st_venant, rtol=1e-13)
    steps = list(uem.load_steps(problem, 2))
    config, m = problem.config, b.nodes(problem)
    R = rotation_matrix(np.atleast_1d(turn))
    where = (config.X[m] - b.point) @ R.T + b.point + coupling.displacement
    assert highest(COMM, np.abs(config.x[m] - where)) <= 1e-13
    assert np.allclose(coupling.rotation, turn, rtol=1e-13)
    r = [i.residual for i in steps[-1].iterations]
    assert any(1e-9 < a < 1e-2 and after <= 10.0 * a**2 + 1e-13 for a, after in zip(r, r[1:]))
    assert np.allclose(problem.reaction(b.left), -0.002, rtol=1e-8)


def test_a_load_that_turns_freely():
    """A moment turns an end far: the tangent has what turning forces add, and Newton's method is quadratic."""
    b = Bar()
    coupling = uem.RigidCoupling(b.right, b.point, moment=lambda factor: 0.04 * factor)
    problem = b.problem(coupling, law=st_venant, rtol=1e-13)
    steps = list(uem.load_steps(problem, 2))
    assert coupling.rotation > 0.75 and all(s.newton_iterations <= 8 for s in steps)
    r = [i.residual for i in steps[-1].iterations]
    assert any(1e-9 < a < 1e-2 and after <= 10.0 * a**2 + 1e-12 for a, after in zip(r, r[1:]))


def test_turns_of_an_attempt_come_back():
    """A body that was led around by more than half a turn, and back to where the step began, has not turned at all."""
    b = Bar()
    turn = fem.Constant(b.scene.mesh, 0.0)
    whole = b.scene.tag("all", 0, lambda x: x[:, 0] >= 0.0)
    coupling = uem.RigidCoupling(whole, (1.0, 0.5), motion=(0.1, 0.0, turn))
    problem = b.problem(coupling, bcs=(), law=st_venant)
    problem.solve()
    before = problem.linear.memory()
    turn.value = 1.4 * np.pi
    problem.attempt()
    assert coupling.rotation == pytest.approx(1.4 * np.pi, rel=1e-13)
    problem.restore()
    assert abs(coupling.rotation) <= 1e-13
    assert np.array_equal(problem.linear.multipliers, before[0])


def test_several_turns_are_counted():
    """A body that is led around three times is where it was, and knows how far it has turned."""
    b = Bar()
    coupling = uem.RigidCoupling(b.scene.tag("all", 0, lambda x: x[:, 0] >= 0.0), (1.0, 0.5), motion=(0.1, 0.0, 6.0 * np.pi))
    problem = b.problem(coupling, bcs=(), law=st_venant)
    state = problem.state()
    for step in uem.load_steps(problem, 4):
        assert coupling.rotation == pytest.approx(6.0 * np.pi * step.factor, rel=1e-13)
        if step.number == 2:
            # a run that continues from a checkpoint knows them
            for act in (*state.collect, *state.restore):
                act()
            assert coupling.turns == pytest.approx(3.0 * np.pi, rel=1e-13)
    assert np.abs(b.u.x.array.reshape(-1, 2) - (0.1, 0.0)).max(initial=0.0) <= 1e-13


def test_when_components_are_chosen_anew():
    """Turned by 45 degrees the components at hand still tell the motion, by 70 degrees others do better."""
    from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
    from uem_dolfinx.conditions.rigid_rows import RigidRows
    from uem_dolfinx.geometry.configuration import Configuration

    b = Bar()
    config, coupling = Configuration(b.u), RigidCoupling(b.right, b.point, rotations="large")
    coupling.attach(config, False)
    rows = RigidRows(config, [coupling], [], np.ones((config.n_owned, 2), bool), np.zeros(config.n_owned, bool), [])
    first = rows._basis
    for degrees, same in ((45.0, True), (70.0, False)):
        R = rotation_matrix(np.array([np.radians(degrees)]))
        b.u.x.array[:] = (config.X @ R.T - config.X).ravel()
        rows.at_present()
        assert (rows._basis is first) == same
        assert highest(COMM, np.abs(rows.equations.gap)) <= 1e-14


# -- spread loads ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_a_mean_motion_works_with_its_load(cell):
    """In any displacement the nodal forces do the work of force and moment in the mean motion, and have their sum and moment."""
    b, rng = Bar(cell), np.random.default_rng(3)
    config = uem.UnitedProblem(linear(b.u, 1.0), b.u).config
    m = np.flatnonzero(np.isclose(config.X[: config.n_owned, 0], 2.0)).astype(np.int32)
    group = RigidSet(config, m, b.point, large=False)
    force, moment = rng.normal(size=b.g), rng.normal(size=b.k)
    u = np.sin(3.0 * config.X[: config.n_owned] + np.arange(b.g)) * np.prod(config.X[: config.n_owned] + 0.3, axis=1)[:, None]
    f = group.spread(u, force, moment)
    assert np.allclose(COMM.allreduce(f.sum(axis=0)), force, rtol=1e-12)
    assert np.allclose(COMM.allreduce(moments(config.X[m] - b.point, f).sum(axis=0)), moment, rtol=1e-12)
    place = group.placement(u)
    work = force @ place.displacement(b.point[None])[0] + moment @ place.turn
    assert COMM.allreduce((f * u[m]).sum()) == pytest.approx(work, rel=1e-12)


def test_a_spread_load_stiffens_nothing():
    """It bends a bar as a load on its nodes does, in small strain and in finite."""
    b = Bar()
    for law in (linear, st_venant):
        coupling = uem.RigidCoupling(b.right, (2.0, 0.5), force=(0.0, 0.006), distribute=True)
        b.u.x.array[:] = 0.0
        b.problem(coupling, law=law).solve()
        u = np.array(b.u.x.array)
        b.u.x.array[:] = 0.0
        loads = [uem.PointLoad((2.0, y), (0.0, 0.002)) for y in (0.0, 0.5, 1.0)]
        uem.UnitedProblem(law(b.u, 1.0), b.u, bcs=clamp(b.V, b.left), points=loads).solve()
        assert highest(COMM, np.abs(b.u.x.array - u)) <= 1e-10 * highest(COMM, np.abs(u))


# -- in contact ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("side", ["contactor", "target"])
def test_a_rigid_block_without_stiffness(side):
    """Pressed on by a force and a moment it touches as one that is led to where it comes, whichever side it is; forces balance."""
    found = []
    for motion, force, moment in (((0.0, None, None), (0.0, -0.02), 0.001), (None, (0.0, 0.0), 0.0)):
        b = blocks(COMM, "quadrilateral", 3, 3)
        own = [b.high, b.low] if side == "contactor" else [b.low, b.high]
        upper = b.scene.tag("upper", 1, lambda x: x[:, 1] >= 0.0)
        motion = (0.0, *found[0]) if motion is None else motion
        coupling = uem.RigidCoupling(upper, (0.4, 0.5), motion=motion, force=force, moment=moment, rotations="large")
        contact, E = uem.Contact(*own), modulus(b.scene, 1.0, 0.0)
        problem = uem.UnitedProblem(
            st_venant(b.u, E), b.u, bcs=clamp(b.V, b.bottom), contacts=[contact], couplings=[coupling], rtol=1e-11
        )
        (step,) = run(problem)
        push, turn = coupling.reaction
        total = contact.resultant().force * (1.0 if side == "contactor" else -1.0) + push + force
        assert np.abs(total).max() <= 1e-11 and np.allclose(problem.reaction(b.bottom)[1], 0.02, rtol=1e-8)
        found += [(coupling.displacement[1], coupling.rotation)]
    assert push[1] == pytest.approx(-0.02, rel=1e-8) and turn == pytest.approx(0.001, rel=1e-7)


@pytest.mark.long
@pytest.mark.parametrize("how", [{}, slow({"petsc_options": {"ksp_type": "cg", "pc_type": "hypre"}})])
def test_moments_about_fixed_axes(how):
    """The end of a bar turns by more than a right angle about three axes: quadratic convergence, and the same end whatever the steps."""
    ends = []
    for n in (3, 5):
        b = Bar("hexahedron")
        moment = fem.Constant(b.scene.mesh, np.zeros(3))
        coupling = uem.RigidCoupling(b.right, b.point, moment=moment, rotations="large")
        problem = b.problem(coupling, law=st_venant, load={moment: np.array([0.03, 0.04, -0.02])}, rtol=1e-10, **how)
        for step in uem.load_steps(problem, n):
            left = [one.residual for one in step.iterations]
            assert len(left) <= 9 and left[-1] <= 1e-2 * left[-2] <= 1e-4 * left[-3], left
        ends.append(coupling.rotation)
    assert np.linalg.norm(ends[0]) > np.pi / 2
    np.testing.assert_allclose(*ends, rtol=1e-7)


def test_rigid_bodies_on_each_other():
    """Flat on flat more contactors touch than two bodies have motions: what they carry together is the load, and where it acts."""
    b = blocks(COMM, "quadrilateral", 2, 3)
    upper, lower = b.scene.tag("upper", 1, lambda x: x[:, 1] >= 0.0), b.scene.tag("lower", 0, lambda x: x[:, 1] <= 0.0)
    load = uem.RigidCoupling(upper, (0.5, 0.5), motion=(0.0, None, None), force=(0.0, -0.02), moment=0.002, rotations="large")
    base = uem.RigidCoupling(lower, (0.5, -0.5), motion=(0.0, 0.0, 0.0), rotations="large")
    contact = uem.Contact(b.high, b.low)
    run(uem.UnitedProblem(st_venant(b.u, 1.0), b.u, contacts=[contact], couplings=[load, base]))
    assert np.abs(b.u.x.array).max(initial=0.0) <= 1e-13
    assert np.allclose(contact.resultant().force, (0.0, 0.02), atol=1e-12)
    assert np.allclose(base.reaction[0], (0.0, 0.02), atol=1e-12) and base.reaction[1] == pytest.approx(-0.002, abs=1e-12)


@pytest.mark.parametrize(("part", "height", "pressed"), [(0.99, 1.0, True), slow(0.99, 1.0, False), (1.2, 0.1, False)])
def test_what_friction_cannot_hold(part, height, pressed):
    """A rigid block on a soft base, pushed by parts of the friction limit: the error is that of an elastic one, pressed on before or not.

    At 0.99 pushed at its top the rear of the block digs into the base, whose slope takes a part of its weight.
    """
    b, now = blocks(COMM, "quadrilateral", 6, 4, overhang=0.5), [(0.0, -0.01)]
    upper = b.scene.tag("upper", 1, lambda x: x[:, 1] >= 0.0)
    coupling = uem.RigidCoupling(upper, (0.5, height), force=lambda _: now[-1])
    contact, E = uem.Contact(b.high, b.low, friction=0.3), modulus(b.scene, 1.0, 0.0)
    how = {"contacts": [contact], "couplings": [coupling], "load": lambda _: None}
    problem = uem.UnitedProblem(linear(b.u, E), b.u, bcs=clamp(b.V, b.bottom), **how)
    if pressed:
        problem.solve()
    now.append((part * 0.3 * 0.01, -0.01))
    problem.set_load(1.0)
    error = refused(uem.FrictionError, (), problem.solve)
    assert "friction does not hold it" in str(error) or "stick and slip in turn" in str(error)


def test_supports_of_rigid_bodies():
    """What nothing holds of a rigid body is held at components that its coupling leaves, one for each motion."""
    b = Bar()
    coupling = uem.RigidCoupling(b.scene.tag("all", 0, lambda x: x[:, 0] >= 0.0), (1.0, 0.5), motion=(0.1, None, None))
    problem = b.problem(coupling, bcs=())
    rigid, motions = problem.linear.rigid, problem.system.floating.rigid
    n = problem.config.n_owned
    left = rigid.left(np.ones((n, 2), dtype=bool))
    pins = motions.supports(motions.open_motions(None), UnitingEquations.join([], 2), left)
    # the third motion is the coupling's own, which the other two components determine
    assert COMM.allreduce(left.sum()) == 2 and COMM.allreduce((pins & left).sum()) == COMM.allreduce(pins.sum()) == 2


# -- in motion -------------------------------------------------------------------------------------------------------------


def flying(scheme=None, mass=uem.lumped_mass):
    """A rigid plate that flies and spins, of which nothing is stiff; the angle of Cayley's rule in a step."""
    b, spin, dt = Bar(), 5.0, 0.05
    plate = b.scene.tag("plate", 0, lambda x: x[:, 0] >= 0.0)
    v = fem.Function(b.V)
    v.interpolate(lambda x: np.stack([0.3 - spin * (x[1] - 0.5), spin * (x[0] - 1.0)]))
    coupling = uem.RigidCoupling(plate, (1.0, 0.5), rotations="large")
    dynamics = uem.Dynamics(mass(b.V, 2.0), velocity=v, scheme=scheme)
    return b.problem(coupling, bcs=(), law=st_venant, dynamics=dynamics, rtol=1e-13), coupling, dynamics, spin, dt


@pytest.mark.parametrize("mass", [uem.lumped_mass, slow(uem.consistent_mass)])
def test_a_plate_that_spins(mass):
    """The trapezoidal rule keeps its momentum, its energy and its rate of turning, for ever."""
    problem, coupling, dynamics, spin, dt = flying(mass=mass)
    energy, momentum = [], []
    for _ in uem.time_steps(problem, dt, 8 * dt):
        energy.append(dynamics.kinetic_energy())
        momentum.append(dynamics.momentum())
    assert coupling.rotation == pytest.approx(16.0 * np.arctan(0.5 * spin * dt), rel=1e-12)
    assert np.allclose(coupling.displacement, (0.3 * 8 * dt, 0.0), atol=1e-12)
    assert np.allclose(momentum, [1.2, 0.0], atol=1e-12) and np.allclose(energy, energy[0], rtol=1e-12)


@pytest.mark.slow
def test_a_block_that_strikes():
    """A rigid block falls askew on one that flies free: momentum is kept to rounding, with friction, and the block stays rigid."""
    s = scene(
        COMM,
        "quadrilateral",
        [box("quadrilateral", [-1, -1], [2, 0], [6, 3]), box("quadrilateral", [0, 0.02], [1, 1.02], [2, 2])],
    )
    V = compat.function_space(s.mesh, 1, (2,))
    u, v = fem.Function(V, name="u"), fem.Function(V)
    v.interpolate(lambda x: np.where(x[1] > 0.01, 1.0, 0.0) * np.stack([0.3 - (x[1] - 0.5), x[0] - 1.5]))
    coupling = uem.RigidCoupling(s.tag("block", 1, lambda x: x[:, 1] > 0.01), (0.5, 0.5), rotations="large")
    contact = uem.Contact(s.tag("high", 1, at(1, 0.02)), s.tag("low", 0, at(1, 0.0)), friction=0.3)
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=v, contactors="massy")
    E = modulus(s, 20.0, 0.0)
    problem = uem.UnitedProblem(linear(u, E), u, contacts=[contact], couplings=[coupling], dynamics=dynamics, rtol=1e-12)
    start, touched = None, 0
    for step in uem.time_steps(problem, 0.02, 0.16):
        start = dynamics.momentum() if start is None else start
        assert np.abs(dynamics.momentum() - start).max() <= 1e-12
        touched += step.iterations[-1].active > 0
    assert touched > 1 and abs(coupling.rotation) > 0.05
    block = np.flatnonzero(problem.config.X[:, 1] > 0.01)
    R = rotation_matrix(np.array([coupling.rotation]))
    where = (problem.config.X[block] - 0.5) @ R.T + 0.5 + coupling.displacement
    assert highest(COMM, np.abs(problem.config.x[block] - where)) <= 1e-13


# -- what is refused -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_a_number_is_no_vector(cell):
    """A single number has no direction: not as a number, a Constant or a function's value, unless it is 0 or there is one component."""
    b = Bar(cell)
    for kind in ("number", "constant", "function"):
        for what in ("force", "moment"):

            def solve(kind=kind, what=what):
                value = {"number": 2.0, "constant": fem.Constant(b.scene.mesh, 2.0), "function": lambda _: 2.0}[kind]
                b.problem(uem.RigidCoupling(b.right, b.point, **{what: value})).solve()

            if what == "moment" and b.k == 1:
                solve()
            else:
                refused(uem.InputError, (what, f"{b.g} finite numbers", "no direction"), solve)
    b.problem(uem.RigidCoupling(b.right, b.point, force=0.0, moment=np.ones(b.k))).solve()
    refused(
        uem.InputError, ("equations[0]", "no direction"), lambda: b.problem(equations=[uem.periodic(b.right, b.left, jump=0.1)])
    )


def test_what_is_refused():
    b = Bar()
    shared = [uem.RigidCoupling(b.right, b.point), uem.RigidCoupling(b.right, b.point)]
    refused(uem.ConflictError, "in another one", lambda: b.problem(*shared))
    refused(uem.InputError, "mean motion", lambda: uem.RigidCoupling(b.right, b.point, motion=(0.0, 0.0, 0.0), distribute=True))
    refused(uem.InputError, "3 items", lambda: uem.RigidCoupling(b.right, b.point, motion=(0.0, 0.0)))
    refused(uem.InputError, "the point", lambda: b.problem(uem.RigidCoupling(b.right, (0.0, 0.0, 0.0))))
    one = uem.RigidCoupling(b.right, b.point)
    refused(uem.SpaceError, "in no problem yet", lambda: one.displacement)
    b.problem(one)
    refused(uem.SpaceError, "another problem", lambda: b.problem(one))
    s = Bar("tetrahedron")
    refused(uem.SurfaceError, "on a line", lambda: s.problem(uem.RigidCoupling((2.0, 1.0, 1.0), s.point)))
