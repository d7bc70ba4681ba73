"""Where contact slides between bodies that are hardly strained any more, one factorisation serves all Newton iterations of a step."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from contact_on_block import DIRECT, pressed
from counting import FACTORISATION, PRODUCT, counted
from equation_scenes import triangles, united
from helpers import st_venant
from petsc4py import PETSc

from uem_dolfinx.algebra import kept_factor
from uem_dolfinx.algebra.condensed import Condensed
from uem_dolfinx.algebra.kept_factor import KeptFactor, most_solves
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.options import has_mumps

COMM_SELF = MPI.COMM_SELF


@pytest.mark.long
@pytest.mark.parametrize("dim", [2, 3])
def test_one_factorisation_serves_all_iterations(dim, monkeypatch):
    """The state is that of factorisations in every iteration, to the tolerance; active contactors are the same."""
    s, contact, problem = pressed(st_venant, way=0.005, dim=dim)
    with counted() as calls:
        history = problem.solve()
    assert len(history) > 3 and contact.n_active > 2
    assert not any(i.exchanges for i in history) and calls[FACTORISATION] == calls[PRODUCT] < len(history) - 1
    assert sum(i.linear_iterations for i in history) > len(history) - 1
    monkeypatch.setattr(kept_factor, "OF_CHANGES", np.nan)
    t, other, again = pressed(st_venant, way=0.005, dim=dim)
    with counted() as calls:
        iterations = again.solve()
    assert calls[FACTORISATION] == len(iterations) - 1 + sum(i.exchanges for i in iterations)
    u, v = s.gather(problem.u), t.gather(again.u)
    assert np.abs(u - v).max() <= 1e-8 * np.abs(v).max()
    assert np.array_equal(s.gather(contact.active), t.gather(other.active))
    assert np.abs(contact.resultant().force - other.resultant().force).max() <= 1e-7 * np.abs(other.resultant().force).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_linear_bodies_with_a_large_contact_zone(dim, monkeypatch):
    """Where their condensation onto the contact would cost more than a factorisation, one factorisation serves a step as well."""
    s, contact, problem = pressed(way=0.005, dim=dim)
    problem.solve()
    monkeypatch.setattr(Condensed, "_is_cheaper", lambda *_: False)
    made, set_up = [], UnitedSolver._set_up
    monkeypatch.setattr(UnitedSolver, "_set_up", lambda self, **options: made.append(set_up(self, **options)))
    t, other, again = pressed(way=0.005, dim=dim)
    assert len(again.solve()) > 3 and len(made) == 1
    u, v = s.gather(problem.u), t.gather(again.u)
    assert np.abs(u - v).max() <= 1e-8 * np.abs(v).max()
    assert np.array_equal(s.gather(contact.active), t.gather(other.active))


def test_linear_bodies_are_factorised_once_a_run(monkeypatch):
    """The factorisation of the first step preconditions the solves of later ones, which end as by a new one."""
    monkeypatch.setattr(Condensed, "_is_cheaper", lambda *_: False)
    made, set_up, found = [], UnitedSolver._set_up, []
    monkeypatch.setattr(UnitedSolver, "_set_up", lambda self, **options: made.append(set_up(self, **options)))
    for anew in (False, True):
        s, contact, problem = pressed(way=0.005)
        problem.solve()
        if anew:
            problem.system.forget()
        before = len(made)
        assert len(problem.solve(start=np.zeros_like(problem.u.x.array), fraction=0.98)) > 2
        found.append((len(made) - before, s.gather(problem.u), contact.n_active))
    (none, u, active), (one, v, same) = found
    assert (none, one) == (0, 1) and active == same > 2
    assert np.abs(u - v).max() <= 1e-8 * np.abs(v).max()


@pytest.mark.parametrize("dim", [2, 3])
def test_one_factorisation_serves_slipping_contactors(dim, monkeypatch):
    """Matrices that friction makes unsymmetric are preconditioned by another such: the state is that of factorisations."""
    found = []
    for few in (kept_factor.OF_CHANGES, np.nan):
        monkeypatch.setattr(kept_factor, "OF_CHANGES", few)
        s, contact, problem = pressed(st_venant, way=0.005, dim=dim, friction=0.1)
        with counted() as calls:
            history = problem.solve()
        assert s.gather(contact.slip).any() and contact.n_active > 2
        found.append(
            (calls[FACTORISATION], len(history), s.gather(problem.u), contact.resultant().force, s.gather(contact.active))
        )
    (fewer, _, u, force, active), (every, _, v, other, same) = found
    assert fewer < every
    assert np.abs(u - v).max() <= 1e-8 * np.abs(v).max() and np.array_equal(active, same)
    assert np.abs(force - other).max() <= 1e-7 * np.abs(other).max()


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_a_factor_serves_matrices_with_its_sign(sign):
    """Only if none of their eigenvalues is negative with respect to the factorised matrix; it does not matter where Q is P."""
    config, K, pc = identity(8)
    kept, P, Q = KeptFactor(config), united(config, []), united(config, [])
    kept.keep(pc, P, K, Q)
    diagonal = K.getDiagonal()
    diagonal.array[3] = sign * 2.0
    K.setDiagonal(diagonal)
    rhs = diagonal.duplicate()
    rhs.set(1.0)
    assert (kept.solve(P, K, None, Q, rhs, 1e-10) is None) == (sign < 0.0)
    dq, _ = kept.solve(P, K, None, P, rhs, 1e-10)
    assert np.abs(dq.array * diagonal.array - 1.0).max() < 1e-9


def test_every_step_factorises_once():
    """Where bodies are strained, no step depends on the ones before it."""
    _, _, problem = pressed(st_venant, way=0.002)
    problem.solve()
    with counted() as calls:
        again = problem.solve()
    assert len(again) == 1 and calls[FACTORISATION] == 0
    with counted() as calls:
        back = problem.solve(start=np.zeros_like(problem.u.x.array), fraction=0.98)
    assert len(back) > 2 and not any(i.exchanges for i in back) and calls[FACTORISATION] == 1


def test_strained_bodies():
    """One that is strained by a little keeps its factorisation, one that is strained by more and more does not."""
    counts = []
    for way in (0.001, 0.2):
        _, _, problem = pressed(law=st_venant, way=way)
        with counted() as calls:
            history = problem.solve()
        counts.append((calls[FACTORISATION], len(history) - 1))
    (few, iterations), (many, _) = counts
    assert few == 1 < iterations and many > 2


def identity(n):
    """Configuration of some triangles on this rank alone, and a unit matrix with what solves with it."""
    config = triangles(n)
    K = PETSc.Mat().createAIJ(2 * config.n_owned, nnz=1, comm=COMM_SELF)
    K.setDiagonal(K.createVecLeft().duplicate())
    K.shift(1.0)
    pc = PETSc.PC().create(COMM_SELF)
    pc.setType("none")
    pc.setOperators(K)
    return config, K, pc


@pytest.mark.parametrize(
    "changed, stiffer, serves",
    [(0, 0.0, True), (4, 0.0, True), (5, 0.0, False), (40, 0.0, False), (0, 0.01, True), (0, 0.1, False)],
)
def test_a_factor_serves_few_changes(changed, stiffer, serves):
    """Of what is used, and of the bodies' stiffness."""
    config, K, pc = identity(16)
    kept = KeptFactor(config)
    P = united(config, [])
    kept.keep(pc, P, K, P)
    K.shift(stiffer)
    fewer = united(config, [], fixed=[(node, 0) for node in range(changed)])
    assert kept.serves(fewer, K, fewer) == serves and not kept.serves(fewer, K, P)
    kept.drop()
    assert not kept.serves(P, K, P)


@pytest.mark.parametrize("values, solves", [(1, 1), (6, 6), (12, None)])
def test_a_factor_that_does_not_serve(values, solves):
    """A Krylov method takes as many solves as there are different eigenvalues; too many are no gain."""
    config, K, pc = identity(8)
    assert solves_of(config, K, pc, values) == solves


@pytest.mark.skipif(not has_mumps(), reason="this PETSc has no MUMPS")
@pytest.mark.parametrize("kind, each", [("lu", 1), ("cholesky", 2)])
def test_a_factor_may_take_as_long_as_another(kind, each):
    """A full matrix takes 2 n / 3 operations for each entry of L and U: if large it allows more solves, and does with these."""
    small, large = (triangles(n) for n in (4, 150))
    for config, values in ((small, 8), (large, 12)):
        n = 2 * config.n_owned
        K = PETSc.Mat().createAIJ(n, nnz=n, comm=COMM_SELF)
        K.setValues(np.arange(n, dtype=np.int32), np.arange(n, dtype=np.int32), np.eye(n) + 1e-15)
        K.assemble()
        pc = PETSc.PC().create(COMM_SELF)
        pc.setOperators(K.copy())
        pc.setType(kind)
        pc.setFactorSolverType("mumps")
        pc.setUp()
        assert abs(most_solves(pc) - max(8, 2 * n / 3 / 20 / each)) <= 1
        assert solves_of(config, K, pc, values) == values


def solves_of(config, K, pc, values):
    """Number of solves with a factor of K after its diagonal has got so many values; None if these were too many."""
    kept = KeptFactor(config)
    P = united(config, [])
    kept.keep(pc, P, K, P)
    diagonal = K.getDiagonal()
    diagonal.array[:] = 1.0 + np.arange(len(diagonal.array)) % values
    K.setDiagonal(diagonal)
    rhs = diagonal.duplicate()
    rhs.set(1.0)
    found = kept.solve(P, K, None, P, rhs, 1e-10)
    if found is not None:
        assert np.abs(found[0].array * diagonal.array - 1.0).max() < 1e-9
        assert kept.cheap == (found[1] <= 8)
    return None if found is None else found[1]


def test_a_factor_leaves_little():
    """However little is required, a solve leaves less than 1e-3, and is not much more accurate than that."""
    config, K, pc = identity(8)
    kept = KeptFactor(config)
    P = united(config, [])
    kept.keep(pc, P, K, P)
    diagonal = K.getDiagonal()
    diagonal.array[:] = 1.0 + 0.5 * np.linspace(0.0, 1.0, len(diagonal.array))
    K.setDiagonal(diagonal)
    rhs = diagonal.duplicate()
    rhs.set(1.0)
    dq, _ = kept.solve(P, K, None, P, rhs, 0.1)
    assert 1e-4 < (K * dq - rhs).norm() / rhs.norm() < 1e-3


def test_a_preconditioner_that_stays_reads_its_options_once():
    """Where friction takes turns with none GMRES and CG read theirs; hypre that did so again would lose its coarsest grid and crash."""
    options = {"ksp_type": "cg", "pc_type": "gamg", "pc_gamg_threshold": 0.02, "ksp_gmres_restart": 7}
    solver = UnitedSolver(triangles(1), "kept_", options)
    read = []
    for symmetric in (False, True):
        solver._unused = set(options)
        solver._adapt(symmetric)
        read.append(set(options) - solver._unused)
        assert solver.pc.getType() == "gamg" and solver.ksp.getPC().handle == solver.pc.handle
    assert all("ksp_type" in keys and "pc_gamg_threshold" not in keys for keys in read) and "ksp_gmres_restart" in read[0]
    direct = UnitedSolver(triangles(1), "kept_", DIRECT | {"pc_type": "cholesky"})
    direct._adapt(False)
    assert direct.pc.getType() == "lu" and direct.pc.getFactorSolverType() == "mumps"
