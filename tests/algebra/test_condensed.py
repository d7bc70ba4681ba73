"""The united problem on the components of the contact: dense algebra of the whole says the same, one factorisation of K does.

The test to read first is ``test_solutions_are_those_of_the_whole``.
"""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from contact_on_block import pressed
from counting import CONDENSED, FACTORISATION, INSIDE, counted
from equation_scenes import CASES, triangles, turned, united
from helpers import gathered_matrix, gathered_vector, raised, scattered, st_venant
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import forms
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.options import has_mumps

pytestmark = pytest.mark.skipif(not has_mumps(), reason="this PETSc has no MUMPS")

EXACT = 1e-12


def solver_of(config, kind="lu"):
    """One for a K that lasts."""
    solver = UnitedSolver(config, "condensed_", {"ksp_type": "preonly", "pc_type": kind, "pc_factor_mat_solver_type": "mumps"})
    solver.lasting = True
    return solver


def diagonal(config, values):
    """A matrix with some values on its diagonal, by component, and ones."""
    K = PETSc.Mat().createAIJ(2 * config.n_owned, nnz=1, comm=config.comm)
    d = K.createVecLeft()
    d.array[:] = [values.get(i, 1.0) for i in range(2 * config.n_owned)]
    K.setDiagonal(d)
    K.assemble()
    return K


def curvature(case, symmetric):
    """A matrix of the nodes that the equations touch."""
    nodes = np.unique(np.concatenate([[i, *followed] for i, _, followed, *_ in case.rows]).astype(np.int64))
    at = (nodes[:, None] * case.g + np.arange(case.g)).ravel().astype(PETSc.IntType)
    values = 0.1 * np.random.default_rng(2).normal(size=(len(at),) * 2)
    G = case.stiffness()
    first, end = G.getOwnershipRange()
    own = (at >= first) & (at < end)
    G = PETSc.Mat().createAIJ(G.getSizes(), bsize=case.g, nnz=len(at), comm=G.comm)
    G.setValues(at[own], at, (values + values.T if symmetric else values)[own])
    G.assemble()
    return G


@pytest.mark.parametrize("name", [name for name in CASES if name != "no equation"])
@pytest.mark.parametrize("kind, apart, curved", [("cholesky", False, True), ("lu", False, False), ("lu", True, True)])
def test_solutions_are_those_of_the_whole(name, kind, apart, curved):
    """Of Q'(K + G)P in one configuration after the other, all with one factorisation; the sign of the determinant, too."""
    case = CASES[name]()
    K, G = case.stiffness(), curvature(case, not apart) if curved else None
    k, g = gathered_matrix(K), 0.0 if G is None else gathered_matrix(G)
    solver, rng = solver_of(case.config, kind), np.random.default_rng(0)
    some = case.equations.active.copy()
    some[::2] = False
    forces, known, whole = scattered(rng.normal(size=case.size), K.createVecLeft()), None, 0
    with counted() as calls:
        for n, (angle, active) in enumerate([(0.0, None), (0.0, some), (0.2, None)]):
            P = turned(case, angle, active)
            Q = turned(case, angle + 0.1, active, like=P) if apart and "chain" not in name else P
            solver.set_operator(P, K, G, Q)
            c = P.c
            solver.begin_at(c)
            rhs = -Q.transpose(forces + K * c + (0.0 * c if G is None else G * c))
            dq, solves = solver.solve(rhs, near=known)
            requested = solver.forces(K, P.expand(dq) + c)
            known, dq = dq, solver.complete(dq)
            p, q, b = gathered_matrix(P.P), gathered_matrix(Q.P), gathered_vector(rhs)
            used = np.abs(p).max(axis=0) > 0
            A = (q.T @ (k + g) @ p)[np.ix_(used, used)]
            expected = np.zeros(case.size)
            expected[used] = np.linalg.solve(A, b[used])
            found = gathered_vector(dq)
            assert solves == 1 and solver.exact
            whole += P.n_equations == 0 and G is None
            assert np.abs(found - expected).max() <= EXACT * np.abs(expected).max() * np.linalg.cond(A), n
            # forces that are known before I is solved for: right but for prescribed components
            exact = gathered_vector(K * (P.expand(dq) + c))
            free = gathered_vector(P.space.vector(P.free)) > 0
            assert np.abs((gathered_vector(requested) - exact)[free]).max() <= EXACT * np.abs(exact).max() * np.linalg.cond(A)
            assert solver.negative == (Q is not P and np.linalg.slogdet(A)[0] < 0)
            assert kind == "lu" or solver.indefinite == (np.linalg.eigvalsh(A)[0] < 0)
    # without anything that contact does, it is of the whole
    assert calls[FACTORISATION] == 1 + whole and calls[CONDENSED] == 3 - whole


@pytest.mark.parametrize("inside, contact", [(1.0, 1.0), (-1.0, 1.0), (1.0, -1.0), (-1.0, -1.0)])
def test_sign_of_the_determinant(inside, contact):
    """Is that of K without the contact times that of what is left."""
    config = triangles(2)
    K = diagonal(config, {0: contact, 2 * config.n_owned - 1: inside})
    solver, equations = solver_of(config), [(0, [0.0, 1.0], 1)]
    solver.set_operator(united(config, equations), K, None, united(config, equations))
    assert solver._on_condensed and solver.negative == (inside * contact < 0)
    solver = solver_of(config, "cholesky")
    solver.set_operator(united(config, equations), K, None)
    assert solver._on_condensed and solver.indefinite == (min(inside, contact) < 0)


def test_a_singular_problem():
    """A component of a contactor that nothing holds."""
    config = triangles(2)
    K, solver = diagonal(config, {0: 0.0}), solver_of(config)
    solver.set_operator(united(config, [(0, [0.0, 1.0], 1)]), K, None)
    ones = K.createVecLeft()
    ones.set(1.0)
    raised(uem.LinearSolveError, "singular", lambda: solver.solve(ones))


def pairs_of_nodes(config, size):
    """P of as many equations as it takes to touch so many components."""
    return united(config, [(node, [0.0, 1.0], node + 1) for node in range(0, size // 2, 2)])


@pytest.mark.parametrize("size, cheaper", [(700, True), (900, False)])
def test_which_way_is_cheaper(size, cheaper):
    """Dense algebra of so many components of 12,000 takes 2.3e8 or 4.9e8 operations, 3.6e8 the factorisation of the whole."""
    config = triangles(2_000)
    u, v = ufl.TrialFunction(config.V), ufl.TestFunction(config.V)
    mass = forms.form(ufl.inner(u, v) * ufl.dx)
    K = forms.create_matrix(mass)
    forms.assemble_matrix(K, mass)
    P = pairs_of_nodes(config, size)
    assert solver_of(config)._factorise_inside(P, P, K, None) == cheaper


@pytest.mark.parametrize("coupled", [True, False])
def test_bodies_that_are_dear_themselves(coupled):
    """The same equations of as many unknowns: what a factorisation of K takes decides."""
    config = triangles(100)
    n = 2 * config.n_owned
    k = np.eye(n) + coupled * 1e-3 * np.ones((n, n))
    K = PETSc.Mat().createAIJ(n, nnz=n, comm=config.comm)
    K.setValues(range(n), range(n), k) if coupled else K.setDiagonal(diagonal(config, {}).getDiagonal())
    K.assemble()
    P = pairs_of_nodes(config, 400)
    assert solver_of(config, "cholesky")._factorise_inside(P, P, K, None) == coupled


def test_one_factorisation_of_linear_bodies():
    """Serves all exchanges, stick and slip, and iterations, those of later steps as well."""
    _, contact, problem = pressed(friction=0.1)
    with counted() as calls:
        history = problem.solve()
    solves = sum(i.linear_iterations for i in history)
    assert len(history) > 3 and sum(i.exchanges for i in history) > 1 and contact.n_active > 2
    # exchanges ask for no solve of the bodies, iterations for two at most: not all contactors of the arc are among what has touched
    assert len(history) - 1 <= calls[INSIDE] <= 2 * (len(history) - 1)
    # one more where contactors touch first
    assert calls[FACTORISATION] == 2 and calls[CONDENSED] == solves == len(history) - 1 + sum(i.exchanges for i in history)
    with counted() as calls:
        back = problem.solve(start=np.zeros_like(problem.u.x.array), fraction=0.98)
    assert len(back) > 2 and calls[FACTORISATION] <= 1


@pytest.mark.parametrize("wide, factorisations", [(True, 1), (False, 2)])
def test_feet_that_move_to_the_next_facets(wide, factorisations):
    """They find its nodes among those that are left out of the factorisation from the start."""
    _, contact, problem = pressed(way=0.04)
    assert problem.system.solver.condensed.adjacent_nodes is not None
    if not wide:
        problem.system.solver.condensed.adjacent_nodes = None
    before = contact.pair.kinematics.projection.facet
    with counted() as calls:
        problem.solve()
    moved = (contact.pair.kinematics.projection.facet != before)[contact.pair.trial.active].any()
    assert any(problem.comm.allgather(bool(moved))) and calls[FACTORISATION] == factorisations


def test_one_factorisation_of_every_tangent():
    """Where bodies are strained, exchanges and contactors that begin to slip have none of their own."""
    _, _, problem = pressed(st_venant, friction=0.1)
    with counted() as calls:
        history = problem.solve()
    # one more where friction begins, and one less at the end, where the last factorisation serves
    assert sum(i.exchanges for i in history) > 1 and calls[FACTORISATION] == len(history) - 1


def test_nothing_touches():
    """Bodies that do not touch are solved for as a whole."""
    _, contact, problem = pressed(way=-0.01)
    problem.solve()
    with counted() as calls:
        problem.solve(start=np.zeros_like(problem.u.x.array), fraction=0.98)
    assert contact.n_active == 0 and calls[CONDENSED] == 0 and calls[FACTORISATION] <= 1
