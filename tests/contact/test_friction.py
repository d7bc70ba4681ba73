"""Coulomb friction by elimination; every converged state is checked for its law by the fixture in conftest.

The tests to read first are ``test_a_block_slides_at_mu_times_its_load`` and ``test_friction_holds_a_block``.
"""

from dataclasses import replace
from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
from friction_scenes import RADIUS, cylinder, driven, fields, history, loose
from helpers import NU, blocks, clamp, factors, gathered_matrix, highest, lowest, modulus, refused, rotation, run, slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.solve.bodies.tangent import curvature_of


@pytest.mark.parametrize("mu", [slow(0.1), 0.3, slow(0.9)])
@pytest.mark.parametrize("rigid", [True, False])
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_a_block_slides_at_mu_times_its_load(mu, rigid, degree, coupling):
    """Driven far enough the whole surface slips, and the force along the base is mu times the force on it."""
    n = (3, 4) if degree == 1 else (2, 2)
    how = {"sliding": "finite" if rigid else "fixed", "coupling": coupling}
    scene = driven("quadrilateral", mu, rigid=rigid, degree=degree, n=n, how=how)
    assert scene.to(0.0, -0.01)
    assert scene.states[0] > 0
    for x in np.linspace(0.0, 0.1 if mu > 0.5 else 0.06, 7)[1:]:
        scene.to(x, -0.01)
    sticking, slipping = scene.states
    # at a high coefficient the rear lifts off
    assert sticking == 0 and slipping >= (5 if mu < 0.5 else 3)
    f = scene.contact.resultant().force
    assert abs(-f[0] / (mu * f[1]) - 1) <= 1e-10
    if not rigid:
        assert scene.contact.balance().force <= 1e-12


@pytest.mark.long
@pytest.mark.parametrize(
    "cell, n",
    [
        slow("triangle", (3, 4)),
        ("quadrilateral", (3, 4)),
        ("tetrahedron", (2, 2)),
        slow("tetrahedron", (3, 4)),
        slow("hexahedron", (3, 4)),
    ],
)
@pytest.mark.parametrize("rigid", [True, False])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_friction_holds_a_block(cell, n, rigid, coupling):
    """Pushed with less than mu times its weight, it stays: weight, push and friction balance. It is pushed back as well."""
    scene = loose(cell, 0.3, rigid=rigid, n=n, coupling=coupling, rtol=1e-12)
    g = scene.problem.config.gdim
    for push in (0.0, 0.15, 0.27, -0.2):
        load = np.zeros(g)
        load[0], load[-1] = push, -1.0
        scene.under(*load)
        assert np.abs(scene.contact.resultant().force + load).max() <= 1e-12
        if not rigid:
            balance = scene.contact.balance()
            assert balance.force <= 1e-12 and balance.moment <= (1e-11 if coupling == "node_to_surface" else 1e-7)


def test_no_friction_is_the_contact_without():
    """A coefficient of zero, or one that is zero everywhere, leaves every bit as it is without friction."""
    found, bits = [], set()
    for mu in (None, 0.0, lambda x: 0.0 * x[0]):
        scene = driven("quadrilateral", mu)
        found.append(history(scene, (0.01, -0.02)))
        bits.add(scene.problem.u.x.array.tobytes())
        assert scene.contact.pair.friction is None
    assert all(np.abs(u - found[0]).max() <= 1e-12 * np.abs(found[0]).max() for u in found)
    # ranks share out each mesh in its own way
    assert scene.contact.config.comm.size > 1 or len(bits) == 1


def test_what_sticks_does_not_move():
    """All of it sticks at a high coefficient: then it is one body with its base, to rounding, on the way forth and back."""
    scene = driven("quadrilateral", 50.0)
    scene.to(0.0, -0.01)
    for x in (0.001, 0.004, -0.003):
        scene.to(x, -0.01)
        assert scene.states == (5, 0)
        assert highest(scene.problem.comm, np.abs(scene.contact.pair.friction.frame.slip)) <= 1e-15


def test_fields_of_results():
    """Status, traction, slip and pressures agree with the forces."""
    scene = driven("quadrilateral", 0.3, rigid=True)
    scene.to(0.0, -0.01)
    scene.to(0.05, -0.01)
    contact, pair = scene.contact, scene.contact.pair
    assert set(contact.status.x.array[pair.nodes]) <= {2.0}
    traction = contact.traction.x.array.reshape(-1, 2)[pair.nodes]
    assert np.abs(traction + 0.3 * contact.pressures[:, None] * [1.0, 0.0]).max(initial=0.0) <= 1e-15
    slipped = contact.slip.x.array.reshape(-1, 2)[pair.nodes]
    assert (slipped[:, 0] > 0.03).all() and not slipped[:, 1].any()
    assert contact.dissipation > 0


def test_the_coefficient_may_be_a_function_of_place():
    """Where there is no friction everything slips, at no force."""
    scene = driven("quadrilateral", lambda x: np.where(x[0] > 0.6, 0.4, 0.0), rigid=True)
    scene.to(0.0, -0.01)
    scene.to(0.002, -0.01)
    pair = scene.contact.pair
    smooth = pair.points[:, 0] < 0.6
    assert not pair.trial.friction.stick[smooth].any()
    assert np.abs(pair.trial.force[smooth, 0]).max(initial=0.0) <= 1e-12
    force = scene.contact.resultant().force
    assert force[0] < -1e-4


@pytest.mark.parametrize(
    "mu, words",
    [(-0.1, "friction"), (np.nan, "friction"), ("much", "friction"), (lambda x: -x[0] - 1, "friction"), (lambda x: 1.0, "shape")],
)
def test_coefficients_that_are_none(mu, words):
    error = uem.InputTypeError if isinstance(mu, str) else uem.InputError
    refused(error, words, lambda: driven("quadrilateral", mu))


def test_what_slides_away():
    """A load beyond mu times the weight has no equilibrium, whatever the step: a named error, and the last state is kept."""
    scene = loose("quadrilateral", 0.3, rigid=True)
    scene.under(0.29999, -1.0)
    before = scene.problem.u.x.array.copy()
    refused(uem.FrictionError, "drive a body over its target", lambda: scene.under(0.30001, -1.0))
    assert np.array_equal(scene.problem.u.x.array, before)
    scene.under(-0.29999, -1.0)
    assert abs(scene.contact.resultant().force[0] - 0.29999) <= 1e-9


@pytest.mark.parametrize(
    ("cell", "coupling"),
    [*product(("quadrilateral", "tetrahedron"), ("node_to_surface", "mortar")), ("hexahedron", "node_to_surface")],
)
def test_slip_converges_quadratically(cell, coupling):
    """Finite sliding and finite strains over a base that bends: the tangent of the rotated rows is exact."""
    scene = driven(cell, 0.4, law=st_venant, n=(2, 3), how={"coupling": coupling}, options={"rtol": 1e-11})
    g = scene.problem.config.gdim
    side = [0.03] * (g - 2)
    scene.to(*[0.0] * (g - 1), -0.05)
    found = []
    for x in (0.1, 0.14, 0.18):
        found += factors(scene.to(x, *side, -0.05))
    assert scene.states[0] == 0
    assert len(found) >= 3 and max(found) <= 50.0


@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_tangent_by_differences(cell):
    """K and the curvature of rotated rows are the derivative of ``F - sum lambda (n - mu s)``, all contactors slipping."""
    mu = 0.4
    scene = driven(cell, mu)
    problem, pair = scene.problem, scene.contact.pair
    g, n = problem.config.gdim, len(pair.nodes)
    smooth, way, lam = fields(problem, pair)

    def residual(u, direction):
        friction = replace(pair.trial.friction, stick=np.zeros(n, bool), direction=direction)
        pair.trial = replace(pair.trial, active=np.ones(n, bool), lam=lam, nodal=lam, friction=friction)
        problem.u.x.array[:] = u.ravel()
        problem.system.place()
        problem.bodies.assemble()
        pair.trial = replace(
            pair.trial, force=lam[:, None] * (pair.kinematics.projection.normal - mu * pair.friction.directions(pair.trial))
        )
        r = problem.bodies.residual
        r.axpy(-1.0, compat.petsc_vector(scene.contact.force))
        return r

    residual(smooth, np.tile([1.0, *[0.5] * (g - 1)], (n, 1)))
    s = pair.friction.directions(pair.trial)
    residual(smooth, s)
    problem.system._petrov_galerkin = True
    du = problem.config.vector(way[: problem.config.n_owned])
    plain = problem.bodies.update_tangent() * du
    full = plain + curvature_of([pair], du, problem.system._petrov_galerkin, False) * du
    difference = residual(smooth + 1e-5 * way, s) - residual(smooth - 1e-5 * way, s)
    difference.scale(0.5e5)
    assert (difference - full).norm() <= 1e-7 * (difference - plain).norm()


def test_mirror_image():
    """A scene driven to the other side is its own mirror image."""
    places = [(0.0, -0.02), (0.01, -0.02), (0.06, -0.02), (0.02, -0.02)]
    there = driven("quadrilateral", 0.3)
    back = driven("quadrilateral", 0.3, pose=lambda x: x * [-1.0, 1.0] + [1.0, 0.0])
    u, v = history(there, *places), history(back, *((-x, y) for x, y in places))
    assert np.abs(u - v * [-1.0, 1.0]).max() <= 1e-10


def test_space_is_the_plane_pulled_out():
    """Between walls without friction a block in space slides as one in the plane."""
    places = [(0.0, -0.02), (0.02, -0.02), (0.1, -0.02), (0.03, -0.02)]
    plane = history(driven("quadrilateral", 0.3, rigid=True), *places)
    scene = driven("hexahedron", 0.3, rigid=True, walls=True)
    space = history(scene, *((x, 0.0, y) for x, y in places))
    drawing = scene.blocks.scene.drawing
    flat = driven("quadrilateral", 0.3, rigid=True).blocks.scene.drawing
    _, of = np.unique(np.round(drawing[:, [0, 2]], 9), axis=0, return_inverse=True)
    _, place = np.unique(np.round(flat, 9), axis=0, return_index=True)
    # nodes of both blocks coincide where they touch
    high = drawing[:, 2] > 1e-9
    assert np.abs(space[:, high][:, :, [0, 2]] - plane[:, place[of]][:, high]).max() <= 1e-9


@pytest.mark.parametrize("cell", ["triangle", slow("hexahedron")])
@pytest.mark.parametrize("angle, scale", [slow(0.7, 1.0), slow(0.0, 1e3), (2.5, 1e-3)])
def test_pose_and_units(cell, angle, scale):
    """Turned, and drawn in other units, it is the same."""
    g = 3 if cell == "hexahedron" else 2
    R = rotation(g, angle)
    places = np.zeros((4, g))
    places[:, -1] = -0.02
    places[1:, 0] = 0.02, 0.06, 0.03
    places[2:, : g - 1] += 0.01
    still = history(driven(cell, 0.3), *places)
    turned = driven(cell, 0.3, E=1 / scale**2, pose=lambda x: scale * x @ R.T)
    moved = history(turned, *(scale * places @ R.T))
    assert np.abs(moved @ R / scale - still).max() <= 2e-8


def test_a_loop_closes():
    """Driven forth and back twice, forces of the second loop repeat; its area is what friction takes, and what is lost of the work."""
    scene = driven("quadrilateral", 0.3, rigid=True, n=(2, 6))
    scene.to(0.0, -0.02)
    way = np.concatenate([np.linspace(a, b, 9)[1:] for a, b in ((0.0, 0.03), (0.03, -0.03), (-0.03, 0.03))])
    loops, work, last = [], [0.0], None
    for x in [*way, *np.linspace(0.03, -0.03, 9)[1:], *np.linspace(-0.03, 0.03, 9)[1:]]:
        scene.to(x, -0.02)
        force = -scene.contact.resultant().force[0]
        if last is not None:
            work.append(work[-1] + 0.5 * (force + last[1]) * (x - last[0]))
        last = x, force
        loops.append((force, scene.contact.dissipation))
    forces, lost = np.array(loops).T
    assert np.abs(forces[8:24] - forces[24:]).max() <= 1e-8 * forces.max()
    area = work[-1] - work[len(work) - 17]
    assert lost[-1] - lost[-17] == pytest.approx(area, rel=1e-10)
    assert (np.diff(lost) >= 0).all()


def test_a_moving_plane_takes_the_block_along():
    """A rigid target that moves drags what sticks to it to rounding, and slips under what does not."""
    plane = uem.RigidPlane([0.0, 0.0], [0.0, 1.0])
    for mu, sticks in ((20.0, True), (0.05, False)):
        scene = driven("quadrilateral", mu, target=plane.move([0.0, 0.0]))
        scene.to(0.0, -0.01)
        plane.move([0.004, 0.0])
        scene.to(0.0, -0.01)
        pair = scene.contact.pair
        u = scene.problem.config.displacement[pair.nodes, 0]
        if sticks:
            assert highest(scene.problem.comm, np.abs(pair.friction.frame.slip)) <= 1e-15
            assert not u.size or np.abs(u - u.mean()).max() <= 1e-3
        else:
            assert scene.states[0] == 0
            f = scene.contact.resultant().force
            assert f[0] == pytest.approx(0.05 * f[1], rel=1e-10)


@pytest.mark.slow
def test_multigrid_between_stick_and_slip(comm):
    """Multigrid of the user's serves united matrices that are symmetric and unsymmetric by turns: the answer of a factorisation."""

    def solved(options):
        b = blocks(comm, "hexahedron", 4, 5, overhang=0.5)
        contact = uem.Contact(b.high, b.low, friction=0.3)
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.02, 0.02, -0.1])]
        law = st_venant(b.u, modulus(b.scene, 1.0, 2.0))
        problem = uem.UnitedProblem(law, b.u, bcs=bcs, contacts=[contact], petsc_options=options)
        run(problem, 2)
        return b.scene.gather(b.u)

    multigrid = {"ksp_type": "cg", "pc_type": "gamg", "mg_levels_pc_type": "jacobi"}
    np.testing.assert_allclose(solved(multigrid), solved(None), rtol=0, atol=1e-8)


def test_the_sign_of_the_determinant():
    """Where Q'KP has a negative determinant, which dense algebra confirms, the answer is refused by name."""
    for mu, negative in ((0.5, False), (6.0, True)):
        scene = driven("quadrilateral", mu, rigid=True)
        scene.to(0.0, -0.01)
        system, pair = scene.problem.system, scene.contact.pair
        n, before = len(pair.nodes), system.assemble_constraints(lambda *norms: False)
        friction = replace(pair.trial.friction, stick=np.zeros(n, bool), direction=np.tile([1.0, 0.0], (n, 1)))
        pair.trial = replace(pair.trial, active=np.ones(n, bool), friction=friction)
        state = system._with_rows(before)
        system.solve(system.linearise(state, None), 0.0, None)
        P, Q, K = (gathered_matrix(A) for A in (state.trial.P, state.test.P, scene.problem.bodies.tangent.K))
        used = np.abs(P).max(axis=0) > 0
        assert (np.linalg.slogdet((Q.T @ K @ P)[np.ix_(used, used)])[0] < 0) == negative == system.solver.negative
        system._not_unique = (state, True) if negative else None
        if negative:
            refused(uem.FrictionError, "more than one answer", system.end_step)
        else:
            system.end_step()


@pytest.mark.parametrize("cell", ["triangle", slow("hexahedron")])
@pytest.mark.parametrize("rigid", [True, False])
def test_going_on_from_a_checkpoint(cell, rigid, folder):
    """Written by one rank in the middle of a slide and read by all, a run continues as if it had not stopped."""
    comm, side = MPI.COMM_WORLD, [0.01] if cell == "hexahedron" else []
    places = [(x, *side, -0.02) for x in (0.0, 0.01, 0.03, 0.08, 0.07, 0.02)]
    whole = driven(cell, 0.3, rigid=rigid)
    u = history(whole, *places)
    if comm.rank == 0:
        first = driven(cell, 0.3, rigid=rigid, comm=MPI.COMM_SELF)
        history(first, *places[:3])
        uem.write_checkpoint(folder / "run", first.problem.state())
    comm.barrier()
    second = driven(cell, 0.3, rigid=rigid)
    uem.read_checkpoint(folder / "run", second.problem.state())
    v = history(second, *places[3:])
    assert np.abs(u[3:] - v).max() <= 1e-9 * np.abs(u).max()
    assert second.states == whole.states and min(np.ptp(whole.states), 1) == 1
    assert second.contact.dissipation == pytest.approx(whole.contact.dissipation, rel=1e-8)
    if comm.size == 1:
        assert whole.problem.u.x.array.tobytes() == second.problem.u.x.array.tobytes()


@pytest.mark.long
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_iterative_solvers(cell):
    """Where contactors slip, GMRES with the multigrid of P'KP takes the place of CG, and finds the same."""
    g = 2 if cell == "quadrilateral" else 3
    places = [(x, *[0.0] * (g - 2), -0.02) for x in (0.0, 0.01, 0.08)]
    direct = driven(cell, 0.3, options={"rtol": 1e-10})
    multigrid = {"ksp_type": "cg", **uem.multigrid_options("gamg")}
    other = driven(cell, 0.3, options={"rtol": 1e-10, "petsc_options": multigrid})
    u, v = history(direct, *places), history(other, *places)
    assert other.states == direct.states and other.states[0] == 0
    assert other.problem.system.solver.ksp.getType() == "gmres"
    assert np.abs(u - v).max() <= 1e-7 * np.abs(u).max()


@pytest.mark.parametrize(
    "degree, coupling, n",
    [
        (1, "node_to_surface", 16),
        slow(1, "node_to_surface", 24),
        (2, "node_to_surface", 12),
        (1, "mortar", 16),
        slow(1, "mortar", 24),
        (2, "mortar", 12),
    ],
)
def test_cattaneo_and_mindlin(degree, coupling, n):
    """A cylinder pressed, then driven sideways: the middle sticks over c = a (1 - Q / mu P)^(1/2), with Mindlin's tractions."""
    mu, press = 0.3, 0.02
    scene = cylinder(mu, n=n, degree=degree, coupling=coupling)
    for y in (0.5 * press, press):
        scene.to(0.0, -y)
    most = 0
    for x in (0.0025, 0.005, 0.0075):
        most = max(most, len(scene.to(x, -press)) - 1)
        pair, f = scene.contact.pair, scene.contact.resultant().force
        half = 2 * np.sqrt(2 * RADIUS * f[1] * (1 - NU**2) * 2 / np.pi)
        stick = half * np.sqrt(1 + f[0] / (mu * f[1]))
        place, facet = np.abs(pair.points[:, 0]), scene.facet
        sticks = pair.trial.friction.stick & pair.trial.active
        assert highest(scene.problem.comm, place[sticks]) <= stick + 1.5 * facet(stick)
        assert lowest(scene.problem.comm, place[pair.friction.slipping(pair.trial)]) >= stick - 1.5 * facet(stick)
    assert most <= 5
