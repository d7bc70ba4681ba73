"""P, c and P'KP against dense linear algebra that knows nothing of frames, elimination or PETSc.

Two tests to read first: ``test_united_increment_solves_the_saddle_point_problem`` compares du = P dq + c with the solution of the
Lagrange system, and ``test_product_keeps_its_pattern`` shows that an iteration only writes new numbers into the old matrix.
"""

from __future__ import annotations

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
import scipy.linalg
from dolfinx import fem
from equation_scenes import CASES, Case, nodes_at, united
from helpers import blocks, clamp, gathered_matrix, gathered_vector, linear, scattered
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import arrays
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.products import UnitedMatrix
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import sums_of_rows
from uem_dolfinx.contact.seam.placement import ContactRows
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.geometry.configuration import Configuration

COMM = MPI.COMM_WORLD
DIRECT = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}


cases = pytest.mark.parametrize("name", CASES)


@cases
def test_P_spans_the_null_space_and_c_meets_the_conditions(name):
    case = CASES[name]()
    C, h = case.constraints()
    r = case.restriction()
    P, c = gathered_matrix(r.P), gathered_vector(r.c)
    used = np.abs(P).max(axis=0) > 0
    assert np.array_equal(used, np.concatenate(COMM.allgather(r.used.ravel())))
    # m = n - number of conditions, and the columns in use are independent
    assert used.sum() == case.size - np.linalg.matrix_rank(C)
    assert np.linalg.svd(P[:, used], compute_uv=False)[-1] > 1e-3
    assert np.abs(C @ P).max() < 1e-13
    assert np.abs(C @ c - h).max() < 1e-14


@cases
def test_vector_maps_are_those_of_the_matrix(name):
    case = CASES[name]()
    r = case.restriction()
    P = gathered_matrix(r.P)
    rng = np.random.default_rng(0)
    y, q = rng.normal(size=case.size), rng.normal(size=case.size)
    like = r.P.createVecLeft()
    reduced = r.transpose(scattered(y, like))
    assert np.allclose(gathered_vector(reduced), P.T @ y, atol=1e-14, rtol=1e-14)
    assert np.allclose(gathered_vector(r.expand(scattered(q, like))), P @ q, atol=1e-14, rtol=1e-14)


@cases
def test_other_gaps(name):
    """With other gaps and prescribed increments P is kept, and c is that of a new restriction; other equations are not taken."""
    r = CASES[name]().restriction()
    if r.rings is not None:
        return
    rng = np.random.default_rng(COMM.rank)
    prescribed = np.where(r.free, 0.0, rng.normal(size=r.free.shape))
    equations = replace(r.equations, gap=rng.normal(size=len(r.equations)))
    known, new = (
        r.with_gaps(equations, r.free, prescribed, r.stacked),
        Restriction(r.space, equations, r.free, prescribed, r.stacked),
    )
    assert (known.c - new.c).norm() <= 1e-15 * new.c.norm() and (known.P - new.P).norm() == 0.0
    turned = replace(equations, direction=equations.direction * (1.0 + 1e-15))
    assert (r.with_gaps(turned, r.free, prescribed, r.stacked) is None) == (COMM.allreduce(len(r.equations)) > 0)
    assert r.with_gaps(equations, r.free, prescribed, not r.stacked) is None


@cases
def test_united_increment_solves_the_saddle_point_problem(name):
    case = CASES[name]()
    C, h = case.constraints()
    K = case.stiffness()
    dense, n, m = gathered_matrix(K), case.size, len(C)
    force = np.random.default_rng(1).normal(size=n)
    solution = scipy.linalg.solve(np.block([[dense, C.T], [C, np.zeros((m, m))]]), np.concatenate([force, h]), assume_a="sym")
    expected, multipliers = solution[:n], solution[n:]

    r = case.restriction()
    solver = UnitedSolver(case.config, "restriction_", DIRECT)
    solver.set_operator(r, K, None)
    f = scattered(force, K.createVecLeft())
    rhs = r.transpose(f - K * r.c)
    dq, _ = solver.solve(rhs)
    du = r.expand(dq)
    du.axpy(1.0, r.c)
    assert np.abs(gathered_vector(du) - expected).max() < 1e-11 * np.abs(expected).max()

    # lambda = n . (f_int - f_ext) at the contactor, with what it received from further contactors
    lam = r.multipliers(r.pass_on(K * du - f))
    holding = case.equations.active
    assert (lam[~holding] == 0.0).all()
    own = [k for k in case.mine if k < len(case.rows)]
    error = np.abs(lam[holding] + multipliers[own]).max(initial=0.0)
    assert COMM.allreduce(error, op=MPI.MAX) < 1e-11 * max(1.0, np.abs(multipliers).max())


@cases
def test_united_matrix_is_the_dense_product(name):
    case = CASES[name]()
    r, K = case.restriction(), case.stiffness()
    solver = UnitedSolver(case.config, "restriction_", DIRECT)
    solver.set_operator(r, K, None)
    P, k = gathered_matrix(r.P), gathered_matrix(K)
    A = gathered_matrix(solver.A)
    idle = np.abs(P).max(axis=0) == 0
    expected = P.T @ k @ P + np.diag(np.where(idle, np.diag(k), 0.0))
    assert np.abs(A - expected).max() < 1e-13 * np.abs(k).max()
    assert np.abs(A - A.T).max() < 1e-14 * np.abs(k).max()
    assert np.linalg.eigvalsh(A)[0] > 0


@pytest.mark.parametrize("name", ["triangles", "hexahedra"])
def test_product_keeps_its_pattern(name):
    case = CASES[name]()
    K = case.stiffness()
    united, r = UnitedMatrix(case.config, True), case.restriction()
    A = united.update(r, r, K, None)
    before, info = A.handle, A.getInfo()

    # turned directions, other weights, and another set of active equations: new numbers in the same places
    turn = np.eye(case.g)
    turn[:2, :2] = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    e = case.equations
    other = np.repeat(1.3 * e.coefficients[:, :1] + 0.1, case.g, axis=1) @ turn.T
    active = e.active.copy()
    active[::2] = False
    case.equations = replace(e, direction=e.direction @ turn.T, coefficients=other, active=active)
    r = case.restriction()
    A = united.update(r, r, K, None)
    after = A.getInfo()
    assert A.handle == before
    assert after["nz_used"] == info["nz_used"] and after["nz_allocated"] == info["nz_allocated"]
    assert after["mallocs"] == 0
    P, k = gathered_matrix(r.P), gathered_matrix(K)
    idle = np.abs(P).max(axis=0) == 0
    expected = P.T @ k @ P + np.diag(np.where(idle, np.diag(k), 0.0))
    assert np.abs(gathered_matrix(A) - expected).max() < 1e-13 * np.abs(k).max()


def test_new_pattern_is_noticed():
    """Other target nodes, then none at all, then the first ones again."""
    case = CASES["triangles"]()
    K = case.stiffness()
    united = UnitedMatrix(case.config, True)
    e = case.equations
    none = e.select(np.zeros(len(e), bool))
    other = replace(e, followed=np.full_like(e.followed, case.where[0]))
    for equations in (e, other, none, e):
        case.equations = equations
        r = case.restriction()
        A = united.update(r, r, K, None)
        P, k = gathered_matrix(r.P), gathered_matrix(K)
        idle = np.abs(P).max(axis=0) == 0
        expected = P.T @ k @ P + np.diag(np.where(idle, np.diag(k), 0.0))
        assert np.abs(gathered_matrix(A) - expected).max() < 1e-13 * np.abs(k).max()


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_rigid_motion_is_a_united_motion(cell):
    """Bodies in contact turn together: P reproduces every rigid mode, and K annihilates it."""
    b = blocks(COMM, cell, 2, 3)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, fem.Constant(b.scene.mesh, PETSc.ScalarType(1.0))), b.u, contacts=[contact])
    assert contact.n_active == 4 ** (b.gdim - 1)
    free = np.ones((problem.config.n_owned, b.gdim), bool)
    r = Restriction(problem.config, contact.pair.equations().Q, free, np.zeros(free.shape))
    K = problem.bodies.update_tangent()
    solver = UnitedSolver(problem.config, "modes_", {"ksp_type": "cg", "pc_type": "gamg"})
    solver.set_operator(r, K, None)
    size = gathered_matrix(K).max()
    for mode in problem.config.modes().transpose(1, 0, 2):
        full = solver.A.createVecLeft()
        full.array[:] = mode.ravel()
        q = r.reduce(full)
        assert (r.expand(q) - full).norm() < 1e-13 * full.norm()
        assert (solver.A * q).norm() < 1e-12 * size * q.norm()
    # the two bodies have modes of their own, and to slide along each other costs nothing
    body, count = find_bodies(problem.config)
    assert count == 2
    upper = COMM.allreduce(int(body[contact.pair.nodes].max(initial=-1)), op=MPI.MAX)
    assert {int(k) for k in body[contact.pair.nodes]} <= {upper}
    assert (body == upper)[problem.config.X[:, -1] > 1e-9].all() and not (body == upper)[problem.config.X[:, -1] < -1e-9].any()
    full.array[:] = (problem.config.modes()[:, 0] * (body == upper)[: problem.config.n_owned, None]).ravel()
    q = r.reduce(full)
    assert q.norm() > 0 and (solver.A * q).norm() < 1e-12 * size * q.norm()
    vectors = solver.A.getNearNullSpace().getVecs()
    assert len(vectors) == b.gdim * (b.gdim + 1)
    for i, a in enumerate(vectors):
        for j, other in enumerate(vectors):
            assert abs(a.dot(other) - (i == j)) < 1e-12


# -- what is refused ---------------------------------------------------------------------------------------------------


def test_equations_that_are_each_other_s():
    """Two that say the same of two nodes are a ring that depends on itself."""
    i, j, _ = nodes_at("triangle", (0.0, 0.5), (0.0, 0.0), (1.0, 0.0))
    case = Case("triangle", [(i, (0, 1), [j], [1.0], 0.0), (j, (0, 1), [i], [1.0], 0.0)])
    with pytest.raises(uem.ConflictError, match="follows itself"):
        case.restriction()


def test_node_that_follows_itself():
    """By a half of itself and a half of another it follows the other."""
    i, j = nodes_at("triangle", (0.0, 0.5), (0.0, 0.0))
    case = Case("triangle", [(i, (0, 1), [i, j], [0.5, 0.5], 0.01)])
    r, where = case.restriction(), 2 * case.where[[i, j]] + 1
    P, c = gathered_matrix(r.P), gathered_vector(r.c)
    assert P[where[0], where[1]] == pytest.approx(1.0) and np.count_nonzero(P[where[0]]) == 1
    assert c[where[0]] == pytest.approx(-0.02)
    with pytest.raises(uem.ConflictError, match="follows itself"):
        Case("triangle", [(i, (0, 1), [i], [1.0], 0.0)]).restriction()


def test_prescribed_normal_is_refused():
    i, j = nodes_at("triangle", (0.0, 0.5), (0.0, 0.0))
    case = Case("triangle", [(i, (0, 1), [j], [1.0], 0.0)], [(i, 1, 0.1)])
    with pytest.raises(uem.ConflictError, match=r"\(0, 0.5\).* in y is prescribed"):
        case.restriction()


@pytest.mark.parametrize("directions", [[(0, 1), (1, 0), (1, 1)], [(0, 1), (0, 1)], [(0, 1), (1e-9, 1)]])
def test_too_many_equations_are_refused(directions):
    i, j = nodes_at("triangle", (0.0, 0.5), (0.0, 0.0))
    case = Case("triangle", [(i, d, [j], [1.0], 0.01 * k) for k, d in enumerate(directions)])
    with pytest.raises(uem.ConflictError, match=f"has {len(directions)} uniting equation"):
        case.restriction()


def test_stack_deeper_than_a_few_bodies_is_no_cycle():
    """A chain of ten contactors, each on the next, moves as one."""
    x = blocks(MPI.COMM_SELF, "triangle", 2, 2, gap=0.5).scene.drawing
    case = Case("triangle", [(i, (0, 1), [i + 1], [1.0], 0.01) for i in range(10)])
    r = case.restriction()
    lift = scattered(np.zeros(case.size), r.P.createVecLeft())
    dof = 2 * case.where[10] + 1
    lift.setValue(dof, 1.0)
    lift.assemble()
    moved = gathered_vector(r.expand(lift))
    assert np.allclose(moved[2 * case.where[:11] + 1], 1.0)
    assert np.allclose(gathered_vector(r.c)[2 * case.where[:11] + 1], -0.01 * np.arange(10, -1, -1))
    assert len(x) > 10


def test_forces_keep_their_sum_and_moment():
    """P' hands a contactor's normal force on with the weights of its foot: no force and no moment is lost."""
    b = blocks(COMM, "triangle", 2, 3)
    clamped = clamp(b.V, b.bottom)
    problem = uem.UnitedProblem(
        linear(b.u, fem.Constant(b.scene.mesh, PETSc.ScalarType(1.0))), b.u, bcs=clamped, contacts=[uem.Contact(b.high, b.low)]
    )
    r = problem.system.restriction()
    y = r.P.createVecLeft()
    nodal = np.zeros((problem.config.n_owned, 2))
    nodes = problem.contacts[0].pair.nodes
    nodal[nodes, 1] = -1.0 - problem.config.X[nodes, 0] ** 2
    y.array[:] = nodal.ravel()
    passed = r.pass_on(y)
    # what stays at a contactor is eliminated with it; what its target received must balance it
    target = passed.array_r.reshape(-1, 2) - nodal
    x = problem.config.X[: problem.config.n_owned]
    sums = COMM.allreduce(np.array([nodal.sum(axis=0), target.sum(axis=0)]))
    moments = COMM.allreduce(np.array([(x[:, 0] * nodal[:, 1]).sum(), (x[:, 0] * target[:, 1]).sum()]))
    assert np.abs(sums[0] - sums[1]).max() < 1e-14
    assert abs(moments[0] - moments[1]) < 1e-14


@pytest.mark.parametrize("m", [0, 1, 500])
def test_sums_of_rows(m):
    """They are NumPy's, to the last bit, and floats where there is nothing to add."""
    rng = np.random.default_rng(m)
    places, values, sums = rng.integers(0, 7, m), rng.normal(size=(m, 3)), np.zeros((7, 3))
    np.add.at(sums, places, values)
    added = sums_of_rows(places, values, 7)
    assert added.dtype == float and np.array_equal(added, sums)


@pytest.mark.parametrize("length", [1, 17, 40])
def test_chains_of_any_length(comm, length):
    """What the last node of a chain does, all do; closed to a circle it is refused."""
    config = Configuration(blocks(comm, "triangle", 5, 5, gap=0.5).u)
    order = np.random.default_rng(0).permutation(config.index_map.size_global)[: length + 1]
    rows = [(a, [0.0, 1.0], b) for a, b in zip(order, order[1:])]
    r = united(config, rows)
    assert r.chain == length
    first = config.index_map.local_range[0]
    q = r.P.createVecRight()
    q.array.reshape(-1, 2)[np.arange(config.n_owned) + first == order[-1]] = [0.2, 0.7]
    moved = gathered_vector(r.expand(q)).reshape(-1, 2)
    assert np.abs(moved[order[:-1]] - [0.0, 0.7]).max() < 1e-15 and np.abs(moved[order[-1]] - [0.2, 0.7]).max() < 1e-15
    assert np.abs(moved).sum() == pytest.approx(0.7 * (length + 1) + 0.2)
    assert np.abs(gathered_matrix(r.P) @ gathered_vector(q) - moved.ravel()).max() < 1e-15
    with pytest.raises(uem.ConflictError, match="follows itself"):
        united(config, [*rows, (order[-1], [0.0, 1.0], order[0])])


@pytest.mark.parametrize("part, length", [(5e-9, 2), (0.1, 16), (0.32, 32), (0.33, None), (0.5, None)])
def test_rings_that_fade(comm, part, length):
    """Equations that follow each other by a part each: the series ends where what comes round is rounding, or the ring is closed."""
    config = Configuration(blocks(comm, "triangle", 2, 2, gap=0.5).u)
    r = united(config, [(0, [0.0, 1.0], 3), (3, [0.0, 1.0], 0)], coefficient=part)
    assert (r.chain, r.fades, r.rings is None) == (length or 1, bool(length), bool(length))
    # rounding has no places in P
    if r.fades:
        assert np.abs(r.rows().value).max(axis=(1, 2)).min(initial=np.inf) > 2e-16


def test_faster_functions_of_arrays():
    """They are those of NumPy and of dataclasses; a copy forgets what was derived from the fields that change."""
    rng = np.random.default_rng(0)
    values, known = rng.integers(0, 20, 50), np.unique(rng.integers(0, 20, 9))
    assert np.array_equal(arrays.among(values, known), np.isin(values, known)) and not arrays.among(values, known[:0]).any()
    parts, order = rng.random((50, 2, 3)), rng.permutation(50)
    for o in (None, order):
        groups = arrays.sums_of_groups(parts, np.array([0, 7, 8, 40]), o)
        assert np.abs(groups - np.add.reduceat(parts if o is None else parts[o], [0, 7, 8, 40])).max() < 1e-14
    rows = UnitingEquations.along(
        np.array([0, 1], np.int32), np.eye(2), np.full((2, 1), -1), np.zeros((2, 1)), np.ones(2), np.ones(2, bool)
    )
    whole = ContactRows.straight(rows, np.arange(2), np.zeros(2, np.int64))
    assert whole.Q is rows and arrays.replace(whole, tilt=rows).Q.direction[0, 0] == 2.0
    with pytest.raises(AssertionError, match="nothing"):
        arrays.replace(whole, nothing=0)
