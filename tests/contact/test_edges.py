"""Sharp edges that cross are held apart, between their nodes as at their nodes.

Read first: ``test_one_force_wherever_the_nodes_are``.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import ufl
from benchmarks.scenes import box
from block_scenes import st_venant
from dolfinx import fem
from edge_scenes import COMM, E, continues_from_checkpoints, crossed, rod, rods, roofs, turned
from helpers import coulomb, factors, gathered_matrix, highest, refused, run, slow
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.solve.bodies.tangent import curvature_of

#: Of two rods of 24 with square section and clamped ends, in a row, by Timoshenko's theory with a shear factor of 5/6.
BENDING, SHEAR = 24.0**3 / (192.0 * E / 12.0), 24.0 / (4.0 * 5.0 / 6.0 * E / 2.6)
STIFFNESS = 0.5 / (BENDING + SHEAR)


def side(force):
    """Force across z over the force along it."""
    return np.hypot(*force[:2]) / abs(force[2])


@pytest.mark.parametrize("on_edge", [True, False])
def test_one_force_wherever_the_nodes_are(on_edge):
    """Two rods across each other: the same force, along z alone, with nodes at the crossing and between nodes, on either rod."""
    forces = []
    for n in ((48, 48), (49, 49), (48, 49)):
        r = rods(n, on_edge=on_edge)
        run(r.problem)
        assert r.n_crossings == (1 if on_edge else 4)
        assert side(r.force) < 1e-4
        forces.append(-r.force[2])
    assert np.ptp(forces) < 0.004 * forces[0]


@pytest.mark.long
def test_two_beams_in_a_row():
    """With cells of degree 2 the force is that of two beams, but for what clamping stiffens."""
    forces = []
    for n in ((12, 12), (13, 12)):
        r = rods(n, degree=2)
        run(r.problem)
        forces.append(-r.force[2])
    assert forces == pytest.approx([0.1 * STIFFNESS] * 2, rel=0.03) and np.ptp(forces) < 1e-3 * forces[0]


def test_nothing_holds_them_apart_without():
    """Before, rods between whose crossing edges there is no node passed through each other."""
    r = rods((49, 49), edges=False)
    run(r.problem)
    assert r.edges == [] and not r.force.any()


@pytest.mark.parametrize("angle", [1.0, slow(0.4), slow(2.3)])
def test_oblique(angle):
    """Rods on edge at any angle have the force of rods at right angles."""
    r, square = rods((25, 24), angle=angle), rods((25, 24))
    run(r.problem)
    run(square.problem)
    assert r.force[2] == pytest.approx(square.force[2], rel=1e-9) and side(r.force) < 1e-9


@pytest.mark.parametrize(
    "cell,degree", [("hexahedron", 1), slow("tetrahedron", 1), slow("hexahedron", 2), slow("tetrahedron", 2)]
)
def test_roofs(cell, degree):
    """Ridge over ridge: no force sideways at a node and between nodes, little where a piece of a ridge tilts between them."""
    for shift, most in (((0.0, 0.0), 1e-3), ((0.25, 0.25), 4e-3), ((0.1, 0.15), 0.03)):
        r = roofs(cell, shift, degree=degree)
        run(r.problem)
        assert r.n_crossings == 1 and r.force[2] < 0.0 and side(r.force) < most


@pytest.mark.long
def test_action_and_reaction():
    """Forces and moments on both bodies cancel, and so do those at the nodes."""
    r = rods((11, 12), length=12.0, angle=1.0, along=(0.7, 1.3), on_edge=False, law=st_venant, friction=0.2)
    run(r.problem, 2)
    one, other = (r.contact.between(f"body {k}", about=[0.1, 0.2, 0.3]) for k in (1, 2))
    assert np.abs(one.force + other.force).max() < 1e-12 and np.abs(one.moment + other.moment).max() < 1e-11
    for part in r.edges:
        assert part.balance().force < 1e-12 and part.balance().moment < 1e-11


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.3, slow(0.0)])
def test_any_pose_and_order(friction):
    """The force turns with the scene, and does not tell whose nodes are contactors."""
    how = {"length": 12.0, "angle": 1.0, "along": (0.7, 1.3), "way": (0.1, 0.2, -0.3), "law": st_venant, "friction": friction}
    found = []
    for more in ({}, {"R": turned(1)}, {"first": 1}, {"first": 0}):
        r = rods((11, 12), **how, **more)
        run(r.problem, 2)
        assert r.n_crossings == 1
        found.append(r.force)
    assert np.abs(np.array(found) - found[0]).max() < 1e-6 * np.abs(found[0]).max()


@pytest.mark.slow
@pytest.mark.parametrize("on_edge", [True, False])
def test_coulomb(on_edge):
    """Where a rod is dragged over the other one it slips, by Coulomb's law in the plane of both edges, and friction dissipates."""
    mu = 0.3
    r = rods((11, 12), length=12.0, on_edge=on_edge, law=st_venant, friction=mu, way=(0.8, 0.3, -0.3))
    history = run(r.problem, 4)
    assert max(len(step.iterations) for step in history) <= 9
    for part in r.edges:
        coulomb(part.pair, 1e-11, 1e-7)
        f, on = part.pair.trial.friction, part.pair.trial.active
        tau, normal = f.tau[on], part.pair.kinematics.projection.normal[on]
        assert highest(COMM, np.abs(np.einsum("ng,ng->n", tau, normal))) < 1e-9
        assert highest(COMM, np.abs(np.linalg.norm(tau, axis=1) - mu * part.pair.trial.lam[on])) < 1e-7
    assert sum(part.dissipation for part in r.edges) > 0.05 * 0.3 * 0.8
    assert side(r.force) == pytest.approx(mu, rel=0.1)


@pytest.mark.long
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_newton_is_quadratic(friction):
    """With the curvature of crossings, at large bending."""
    how = {"length": 12.0, "angle": 1.0, "along": (0.7, 1.3), "law": st_venant, "friction": friction, "way": (0.3, 0.2, -1.0)}
    for step in run(rods((11, 12), **how).problem, 3):
        assert len(step.iterations) <= 6
        assert all(factor < 200.0 for factor in factors(step.iterations))


def test_tangent_by_differences():
    """``K - sum lambda grad^2 g`` is the change of ``F - sum lambda grad g``, with forces at all crossings."""
    r = rods((11, 12), length=12.0, angle=1.0, along=(0.7, 1.3), law=st_venant, on_edge=False)
    problem, pair = r.problem, r.edges[0].pair
    config, system = problem.config, problem.system
    X, du = config.X, np.zeros_like(config.X)
    smooth = 0.01 * np.column_stack([np.sin(X[:, 1]), np.cos(X[:, 0]), np.sin(X[:, 0] + X[:, 1])])
    du[:] = np.column_stack([np.cos(3 * X[:, i] + 2 * i) + 0.3 * X[:, (i + 1) % 3] for i in range(3)])
    lam = 0.3 + 0.2 * np.sin(X[pair.nodes].sum(axis=1))

    def residual(u):
        problem.u.x.array[:] = u.ravel()
        system.place()
        problem.bodies.assemble()
        here = np.zeros(len(lam))
        here[pair.kinematics.which] = lam[pair.kinematics.which]
        leads = ~pair.kinematics.ends.out
        pair.trial = replace(pair.trial, active=leads, lam=here * leads, nodal=here * leads)
        out = problem.bodies.residual
        out.axpy(-1.0, compat.petsc_vector(r.edges[0].force))
        return out

    residual(smooth)
    assert COMM.allreduce(int(pair.trial.active.sum())) >= 2
    A = problem.bodies.update_tangent().copy()
    curvature = curvature_of([pair], config.vector(), False, False)
    v = A.createVecRight()
    v.array[:] = du[: config.n_owned].ravel()
    plain = A * v
    full = plain + curvature * v
    h = 1e-6
    difference = residual(smooth + h * du) - residual(smooth - h * du)
    difference.scale(0.5 / h)
    off, without = ((difference - one).norm(PETSc.NormType.INFINITY) for one in (full, plain))
    assert off < 1e-5 * difference.norm(PETSc.NormType.INFINITY) and off < 1e-3 * without


def test_the_united_matrix_is_symmetric():
    """P'KP, with rows of four nodes on either edge, and with the curvature of the crossing."""
    r = roofs(shift=(0.1, 0.15))
    run(r.problem)
    system = r.problem.system
    system.place()
    system.linearise(system.assemble_constraints(lambda *_: True), 0)
    A = gathered_matrix(system.solver.A)
    assert np.abs(A - A.T).max() < 1e-12 * np.abs(A).max()
    assert np.linalg.eigvalsh(A).min() > 0.0


def flying(end=0.3, **how):
    """A rod that hits another one in flight, at crossings between their nodes, with the speed of one; after a time (collective)."""

    def dynamics(V):
        v = fem.Function(V)
        v.interpolate(lambda x: np.vstack([0.0 * x[0], 0.0 * x[0], np.where(x[2] > 0.01, -1.0, 0.0)]))
        return uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=v)

    low, high = (rod("hexahedron", n, 4.0, k > 0, 1.2 * k, True, 0.3 * k) for k, n in enumerate((5, 4)))
    bodies = [low, high.mapped(lambda x: x + [0.0, 0.0, 0.05])]
    r = crossed("hexahedron", bodies, law=st_venant, dynamics=dynamics, **how)
    book, law = uem.EnergyBook(r.problem), r.problem.dynamics
    start, most = law.momentum(), 0
    for step in uem.time_steps(r.problem, 0.01, end):
        book.write(step)
        most = max(most, r.n_crossings)
    return r, most, law.momentum() - start, book


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.3])
def test_impact(friction):
    """A rod flies into another one, edge on edge: it pushes it, momentum is kept, and contact adds no energy."""
    r, most, gained, book = flying(friction=friction)
    assert most == 1 and np.abs(gained).max() < 1e-9
    assert all(part.n_active == 0 for part in r.contact.parts if part not in r.edges)
    # the lower body is on its way, and the upper one is slower
    v = r.problem.dynamics.velocity.x.array.reshape(-1, 3)[: r.problem.config.n_owned, 2]
    upper = r.problem.config.X[: r.problem.config.n_owned, 2] > 0.01
    sums = [COMM.allreduce(values.sum()) / COMM.allreduce(len(values)) for values in (v[~upper], v[upper])]
    assert sums[0] < -0.2 and sums[1] > -0.9
    assert max(row.contact for row in book.rows) < 0.02 * book.rows[0].kinetic


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.2, slow(0.0)])
def test_checkpoints(friction, folder):
    """A run that continues from a checkpoint ends like one that was left alone, with rods that touch at several crossings."""

    def begun():
        how = {"length": 12.0, "angle": 1.0, "along": (0.7, 1.3), "law": st_venant, "friction": friction, "way": (0.4, 0.2, -0.5)}
        return rods((11, 12), on_edge=False, **how)

    continues_from_checkpoints(begun, folder)


def test_refused():
    """Where crossings have no equations, for pressures and heat flows, which need areas."""
    for word, value in (
        ("normal", uem.SoftContact(lambda g: np.maximum(-g, 0.0))), ("heat", uem.Conductance(1.0, field=1)),
        ("friction", uem.Tresca(1.0)),
    ):  # fmt: skip
        refused(uem.InputError, ["edges = True", word], lambda more={word: value}: uem.GeneralContact(edges=True, **more))
        assert not uem.GeneralContact(**{word: value}).edges
    refused(uem.InputTypeError, ["edges", "True or False"], lambda: uem.GeneralContact(edges="yes"))


def dragged(steps, first=None):
    """A rod on edge that is pressed onto another one, and then dragged along three of its pieces (collective)."""
    r = rods((11, 12), length=12.0, law=st_venant, friction=0.3, way=(0.0, 0.0, 0.0), first=first)
    low, high = (bc.g for bc in r.problem.bodies.bcs)

    def load(t):
        high.value[:] = [3.0 * max(0.0, 2.0 * t - 1.0), 0.0, -0.3 * min(1.0, 2.0 * t)]

    r.problem.load = load
    run(r.problem, 2 * steps)
    assert not low.value.any()
    return r


@pytest.mark.slow
def test_from_piece_to_piece():
    """A crossing that slides on to the next nodes keeps its friction: force and dissipation know nothing of steps or order."""
    fine, swapped, coarse = dragged(6, first=0), dragged(6, first=1), dragged(4)
    for r in (swapped, coarse):
        assert np.abs(r.force - fine.force).max() < 1e-7
    assert fine.edges[0].dissipation == pytest.approx(swapped.edges[0].dissipation, rel=1e-8)


@pytest.mark.slow
@pytest.mark.parametrize("angle", [0.25 * np.pi, slow(0.3), slow(1.0)])
def test_a_box_on_a_box(angle):
    """Turned: at crossings of edges where no node is near, too; forces on coarse meshes are nearer to those on fine ones."""
    forces = []
    for n, edges in ((8, True), (4, True), (4, False)):
        held = [lambda x: np.abs(x[:, 2] + 1.0) < 1e-9, lambda x: np.abs(x[:, 2] - 1.0) < 1e-9]
        low, high = (box("hexahedron", (-1.0, -1.0, k - 1.0), (1.0, 1.0, k), (n, n, n // 2)) for k in (0.0, 1.0))
        turn = np.array([[np.cos(angle), np.sin(angle), 0.0], [-np.sin(angle), np.cos(angle), 0.0], [0.0, 0.0, 1.0]])
        r = crossed("hexahedron", [low, high.mapped(lambda x, R=turn: x @ R)], held, (0.0, 0.0, -0.02), edges=edges)
        run(r.problem)
        assert side(r.force) < 1e-6
        forces.append(r.force[2])
    assert forces[1] == pytest.approx(forces[0], rel=0.04)
    assert abs(forces[1] - forces[0]) < abs(forces[2] - forces[0]) or angle < 0.7


@pytest.mark.slow
def test_gradient():
    """The derivative by one rod's modulus, through a crossing that moves along both edges, is that of differences."""

    def solved(modulus):
        kept = []

        def law(u, E):
            mesh = u.function_space.mesh
            kept.append(fem.Constant(mesh, modulus))
            return st_venant(u, ufl.conditional(ufl.lt(ufl.SpatialCoordinate(mesh)[2], 0.0), kept[0], E))

        r = rods((11, 12), length=12.0, angle=1.0, along=(0.7, 1.3), way=(0.0, 0.0, -0.5), law=law)
        run(r.problem, 2)
        return r, (r.u[0] ** 2 + r.u[1] * r.u[2]) * ufl.dx, kept[0]

    r, J, control = solved(E)
    (found,), h = uem.gradient(r.problem, J, [control]), 1.0
    ahead, back = (uem.integrate(solved(E + step)[1]) for step in (h, -h))
    assert float(found) == pytest.approx((ahead - back) / (2 * h), rel=1e-5)
