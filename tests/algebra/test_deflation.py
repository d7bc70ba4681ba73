"""Multigrid with contactors much stiffer than their targets: as many iterations as between bodies alike.

The test to read first is ``test_iterations_do_not_depend_on_the_ratio_of_stiffness``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import blocks, gathered_matrix, linear, scattered

import uem_dolfinx as uem
from uem_dolfinx.algebra.deflation import deflated, pressed_hard
from uem_dolfinx.algebra.options import has_hypre

COMM = MPI.COMM_WORLD
AMG = [pytest.param("hypre", marks=pytest.mark.skipif(not has_hypre(), reason="PETSc without hypre")), "gamg"]


def pressed(ratio, amg="gamg", coupling="node_to_surface", n=4):
    """A block, so many times as stiff as the one below, pressed onto it: its contact and the problem, solved."""
    b = blocks(COMM, "hexahedron", n, n + 2, overhang=0.2)
    E = fem.Function(uem.function_space(b.scene.mesh, ("DG", 0)))
    E.interpolate(lambda x: np.where(x[2] > 0.0, ratio, 1.0))
    options = {"ksp_type": "cg", "ksp_rtol": 1e-8} | uem.multigrid_options(amg)
    contact = uem.Contact(b.high, b.low, coupling=coupling, sliding="small")
    problem = uem.UnitedProblem(linear(b.u, E), b.u, bcs=b.oedometer(0.01), contacts=[contact], petsc_options=options)
    history = problem.solve()
    return problem, contact, history


def iterations(problem):
    """Of a solve with the converged contact, and a preconditioner of its own."""
    system, solver = problem.system, problem.system.solver
    solver.forget()
    P = system.restriction()
    solver.set_operator(P, problem.bodies.tangent.K, None)
    force = scattered(np.sin(np.arange(3.0 * problem.config.index_map.size_global)), P.P.createVecLeft())
    return solver.solve(P.transpose(force))[1]


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("amg", AMG)
def test_iterations_do_not_depend_on_the_ratio_of_stiffness(amg, coupling):
    alike = iterations(pressed(1.0, amg, coupling)[0])
    assert iterations(pressed(1e6, amg, coupling)[0]) <= 1.5 * alike


@pytest.mark.parametrize("ratio, found", [(3.0, False), (30.0, True)])
def test_much_stiffer_contactors_are_found(ratio, found):
    """What lies on what is not much stiffer is left to multigrid."""
    problem, contact, _ = pressed(ratio)
    solver = problem.system.solver
    hard = pressed_hard(problem.config, solver.A, problem.bodies.tangent.K, problem.system.restriction())
    assert bool(COMM.allreduce(int(hard.sum()))) == found
    assert (solver.ksp.getPC().getType() == "python") == found


def test_deflated_unknowns_are_solved_exactly():
    """On the columns of W, unknowns near the contact and rigid motions of the stiff block, the preconditioner is the inverse."""
    problem, _, _ = pressed(1e4, n=3)
    solver, P, config = problem.system.solver, problem.system.restriction(), problem.config
    K = problem.bodies.tangent.K
    solver.forget()
    solver.set_operator(P, K, None)
    hard = pressed_hard(config, solver.A, K, P)
    W = deflated(config, solver.A, P, hard)
    assert np.linalg.matrix_rank(gathered_matrix(W)) == W.getSize()[1]
    pc = solver.ksp.getPC()
    pc.setUp()
    some = W.createVecRight()
    some.array[:] = 1.0 + np.arange(len(some.array_r))
    x = W * some
    y = x.duplicate()
    pc.apply(solver.A * x, y)
    assert (solver.A * (y - x)).norm() < 1e-9 * (solver.A * x).norm()
    # and it is symmetric
    rng = np.random.default_rng(0)
    a, b = (solver.A * scattered(rng.normal(size=problem.config.index_map.size_global * 3), x) for _ in range(2))
    moved, other = x.duplicate(), x.duplicate()
    pc.apply(a, moved)
    pc.apply(b, other)
    assert abs(a.dot(other) - b.dot(moved)) < 1e-7 * a.norm() * other.norm()
