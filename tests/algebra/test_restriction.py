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
import ufl
from dolfinx import fem
from helpers import blocks, clamp, gathered_matrix, gathered_vector, linear, scattered
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import forms
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.linear_solver import UnitedSolver, rigid_body_modes
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.geometry.configuration import Configuration

COMM = MPI.COMM_WORLD
DIRECT = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}


class Case:
    """Two blocks, and uniting equations between nodes given by their places in the drawing.

    Args:
        cell: kind of cells.
        equations: node, direction, nodes followed, weights, gap.
        reserved: equations of the same kind that do not hold, but keep their places in P.
        held: Dirichlet components as ``(node, component, increment)``.
    """

    def __init__(self, cell, equations, held=(), reserved=()):
        self.blocks = b = blocks(COMM, cell, 2, 2, gap=0.5)
        self.config = Configuration(b.u)
        g = self.g = b.gdim
        n, first = self.config.n_owned, self.config.index_map.local_range[0]
        numbering = b.scene.numbering(b.V)[:n]
        parts = COMM.allgather((numbering, first + np.arange(n)))
        where = np.empty(len(b.scene.drawing), dtype=np.int64)
        for drawn, number in parts:
            where[drawn] = number
        #: global block number of each node of the drawing
        self.where = where
        every = [
            (where[i], np.array(d) / np.linalg.norm(d), where[np.array(a, dtype=int)], np.array(w, dtype=float), gap)
            for i, d, a, w, gap in [*equations, *reserved]
        ]
        #: the equations that hold
        self.rows = every[: len(equations)]
        width = max((len(r[2]) for r in every), default=0)
        #: places in ``rows`` of this rank's equations
        self.mine = [k for k, r in enumerate(every) if first <= r[0] < first + n]
        mine = [every[k] for k in self.mine]
        targets, weights = np.full((len(mine), width), -1, np.int64), np.zeros((len(mine), width))
        for k, r in enumerate(mine):
            targets[k, : len(r[2])], weights[k, : len(r[2])] = r[2], r[3]
        self.equations = UnitingEquations.along(
            np.array([r[0] - first for r in mine], np.int32),
            np.array([r[1] for r in mine]).reshape(-1, g),
            targets,
            weights,
            np.array([r[4] for r in mine], dtype=float),
            np.array([k < len(equations) for k in self.mine], dtype=bool),
        )
        self.free, self.prescribed = np.ones((n, g), bool), np.zeros((n, g))
        self.held = [(int(where[i]) * g + c, value) for i, c, value in held]
        for dof, value in self.held:
            if first * g <= dof < (first + n) * g:
                self.free.flat[dof - first * g] = False
                self.prescribed.flat[dof - first * g] = value
        self.size = g * self.config.index_map.size_global

    def restriction(self):
        return Restriction(self.config, self.equations, self.free, self.prescribed)

    def constraints(self):
        """Dense ``C du = h``: uniting equations, then Dirichlet components."""
        C, h = np.zeros((len(self.rows) + len(self.held), self.size)), np.zeros(len(self.rows) + len(self.held))
        g = self.g
        for k, (node, direction, targets, weights, gap) in enumerate(self.rows):
            C[k, node * g : node * g + g] += direction
            for a, w in zip(targets, weights):
                C[k, a * g : a * g + g] -= w * direction
            h[k] = -gap
        for k, (dof, value) in enumerate(self.held, len(self.rows)):
            C[k, dof], h[k] = 1.0, value
        return C, h

    def stiffness(self):
        """Elastic stiffness plus a mass, so that nothing is singular, and its form."""
        u, v = ufl.TrialFunction(self.blocks.V), ufl.TestFunction(self.blocks.V)
        one = fem.Constant(self.blocks.scene.mesh, PETSc.ScalarType(1.0))
        a = ufl.derivative(linear(self.blocks.u, one), self.blocks.u) + 0.1 * ufl.inner(u, v) * ufl.dx
        form = forms.form(a)
        K = forms.create_matrix(form)
        forms.assemble_matrix(K, form)
        return K


def nodes_at(cell, *places):
    """Numbers in the drawing of the nodes at some places."""
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    return [int(np.linalg.norm(x - p, axis=1).argmin()) for p in places]


def flat_case(cell):
    """One equation per contactor, oblique directions, some Dirichlet components at targets."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    upper = np.flatnonzero(np.abs(x[:, -1] - 0.5) < 1e-9)
    lower = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)
    rng = np.random.default_rng(3)
    rows = []
    for i in upper:
        followed = rng.choice(lower, 2 ** (g - 1), replace=False)
        w = rng.random(len(followed))
        rows.append((i, rng.normal(size=g), followed, w / w.sum(), 0.1 * rng.normal()))
    held = [(i, c, 0.02 * (c + 1)) for i in np.flatnonzero(np.abs(x[:, -1] + 1.0) < 1e-9) for c in range(g)]
    held += [(lower[0], 0, -0.03), (lower[1], g - 1, 0.04)]
    return Case(cell, rows[1:], held, reserved=rows[:1])


def corner_case(cell):
    """Two equations at some contactors (a corner), one at others."""
    g = 2 if cell == "triangle" else 3
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    upper = np.flatnonzero(np.abs(x[:, -1] - 0.5) < 1e-9)
    a, b = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)[:2]
    rng = np.random.default_rng(4)
    rows = [(i, rng.normal(size=g), [a, b], [0.3, 0.7], 0.05) for i in upper]
    rows += [(i, rng.normal(size=g), [a, b], [0.6, 0.4], -0.02) for i in upper[::2]]
    return Case(cell, rows, [(int(np.flatnonzero(np.abs(x[:, -1] + 1.0) < 1e-9)[0]), 0, 0.1)])


def symmetry_case(cell):
    """Contactors whose own tangential component is prescribed (a symmetry plane), with an oblique direction."""
    g = 2 if cell == "triangle" else 3
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    plane = np.flatnonzero((np.abs(x[:, -1] - 0.5) < 1e-9) & (np.abs(x[:, 0]) < 1e-9))
    lower = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)
    direction = np.array([0.3, 0.2, 0.9])[-g:] if g == 3 else np.array([0.4, 0.9])
    rows = [(i, direction, lower[:2], [0.5, 0.5], 0.01) for i in plane]
    return Case(cell, rows, [(i, 0, 0.07) for i in plane] + [(i, 0, 0.05) for i in lower])


def chain_case(cell):
    """Stacked bodies: what a contactor follows is itself a contactor, three deep, and two roads meet in one node."""
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    g = x.shape[1]
    upper = np.flatnonzero(np.abs(x[:, -1] - 0.5) < 1e-9)[:3]
    lower = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)[:2]
    top, base = np.flatnonzero(np.abs(x[:, -1] - 1.5) < 1e-9)[0], np.flatnonzero(np.abs(x[:, -1] + 1.0) < 1e-9)[:2]
    rng = np.random.default_rng(5)
    rows = [(top, rng.normal(size=g), [upper[0], lower[0]], [0.25, 0.75], 0.02)]
    rows += [(i, rng.normal(size=g), lower, [0.5, 0.5], 0.03) for i in upper]
    rows += [(i, rng.normal(size=g), base, [0.1, 0.9], -0.01) for i in lower]
    return Case(cell, rows, [(base[0], 0, 0.04)])


def rigid_chain_case(cell):
    """A contactor that follows nodes which are themselves held by an oblique rigid surface."""
    x = blocks(MPI.COMM_SELF, cell, 2, 2, gap=0.5).scene.drawing
    g = x.shape[1]
    upper = np.flatnonzero(np.abs(x[:, -1] - 0.5) < 1e-9)
    lower = np.flatnonzero(np.abs(x[:, -1]) < 1e-9)[:2]
    oblique = np.array([0.6, 0.1, 0.8])[-g:] if g == 3 else np.array([0.6, 0.8])
    rows = [(i, [0.0] * (g - 1) + [1.0], lower, [0.4, 0.6], 0.02) for i in upper]
    rows += [(i, oblique, [], [], 0.01) for i in lower]
    return Case(cell, rows)


CASES = {
    "triangles": lambda: flat_case("triangle"),
    "quadrilaterals": lambda: flat_case("quadrilateral"),
    "tetrahedra": lambda: flat_case("tetrahedron"),
    "hexahedra": lambda: flat_case("hexahedron"),
    "corner 2D": lambda: corner_case("triangle"),
    "corner 3D": lambda: corner_case("tetrahedron"),
    "symmetry 2D": lambda: symmetry_case("triangle"),
    "symmetry 3D": lambda: symmetry_case("tetrahedron"),
    "chain 2D": lambda: chain_case("triangle"),
    "chain 3D": lambda: chain_case("hexahedron"),
    "chain to a rigid surface 2D": lambda: rigid_chain_case("quadrilateral"),
    "chain to a rigid surface 3D": lambda: rigid_chain_case("tetrahedron"),
    "no equation": lambda: Case("triangle", [], [(0, 0, 0.1), (0, 1, 0.0), (3, 1, -0.2)]),
}
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
    solver = UnitedSolver(case.config, "restriction_", DIRECT)
    solver.set_operator(case.restriction(), K, None)
    before, info = solver.A.handle, solver.A.getInfo()

    # turned directions, other weights, and another set of active equations: new numbers in the same places
    turn = np.eye(case.g)
    turn[:2, :2] = [[np.cos(0.3), -np.sin(0.3)], [np.sin(0.3), np.cos(0.3)]]
    e = case.equations
    other = np.repeat(1.3 * e.coefficients[:, :1] + 0.1, case.g, axis=1) @ turn.T
    active = e.active.copy()
    active[::2] = False
    case.equations = replace(e, direction=e.direction @ turn.T, coefficients=other, active=active)
    r = case.restriction()
    solver.set_operator(r, K, None)
    after = solver.A.getInfo()
    assert solver.A.handle == before
    assert after["nz_used"] == info["nz_used"] and after["nz_allocated"] == info["nz_allocated"]
    assert after["mallocs"] == 0
    P, k = gathered_matrix(r.P), gathered_matrix(K)
    idle = np.abs(P).max(axis=0) == 0
    expected = P.T @ k @ P + np.diag(np.where(idle, np.diag(k), 0.0))
    assert np.abs(gathered_matrix(solver.A) - expected).max() < 1e-13 * np.abs(k).max()


def test_new_pattern_is_noticed():
    """Other target nodes, then none at all, then the first ones again."""
    case = CASES["triangles"]()
    K = case.stiffness()
    solver = UnitedSolver(case.config, "restriction_", DIRECT)
    e = case.equations
    none = e.select(np.zeros(len(e), bool))
    other = replace(e, followed=np.full_like(e.followed, case.where[0]))
    for equations in (e, other, none, e):
        case.equations = equations
        r = case.restriction()
        solver.set_operator(r, K, None)
        P, k = gathered_matrix(r.P), gathered_matrix(K)
        idle = np.abs(P).max(axis=0) == 0
        expected = P.T @ k @ P + np.diag(np.where(idle, np.diag(k), 0.0))
        assert np.abs(gathered_matrix(solver.A) - expected).max() < 1e-13 * np.abs(k).max()


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_rigid_motion_is_a_united_motion(cell):
    """Bodies in contact turn together: P reproduces every rigid mode, and K annihilates it."""
    b = blocks(COMM, cell, 2, 3)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, fem.Constant(b.scene.mesh, PETSc.ScalarType(1.0))), b.u, contacts=[contact])
    assert contact.n_active == 4 ** (b.gdim - 1)
    free = np.ones((problem.config.n_owned, b.gdim), bool)
    r = Restriction(problem.config, contact.pair.equations().test, free, np.zeros(free.shape))
    K = problem.forces.update_tangent()
    solver = UnitedSolver(problem.config, "modes_", {"ksp_type": "cg", "pc_type": "gamg"})
    solver.set_operator(r, K, None)
    size = gathered_matrix(K).max()
    for mode in rigid_body_modes(problem.config):
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
    full.array[:] = (rigid_body_modes(problem.config)[0] * (body == upper)[: problem.config.n_owned, None]).ravel()
    q = r.reduce(full)
    assert q.norm() > 0 and (solver.A * q).norm() < 1e-12 * size * q.norm()
    vectors = solver.A.getNearNullSpace().getVecs()
    assert len(vectors) == b.gdim * (b.gdim + 1)
    for i, a in enumerate(vectors):
        for j, other in enumerate(vectors):
            assert abs(a.dot(other) - (i == j)) < 1e-12


# -- what is refused ---------------------------------------------------------------------------------------------------


def test_cycle_is_refused():
    i, j, k = nodes_at("triangle", (0.0, 0.5), (0.0, 0.0), (1.0, 0.0))
    case = Case("triangle", [(i, (0, 1), [j, k], [0.5, 0.5], 0.0), (j, (0, 1), [i, k], [0.5, 0.5], 0.0)])
    with pytest.raises(uem.ConflictError, match="follows itself"):
        case.restriction()


def test_node_that_follows_itself_is_refused():
    i, j = nodes_at("triangle", (0.0, 0.5), (0.0, 0.0))
    case = Case("triangle", [(i, (0, 1), [i, j], [0.5, 0.5], 0.0)])
    with pytest.raises(uem.ConflictError, match="follows itself"):
        case.restriction()


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
