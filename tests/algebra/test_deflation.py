"""Multigrid with contactors much stiffer than their targets: as many iterations as between bodies alike.

The test to read first is ``test_iterations_do_not_depend_on_the_ratio_of_stiffness``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, blocks, box, clamp, gathered_matrix, linear, modulus, scattered, scene

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


@pytest.mark.long
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


def test_several_stiff_bodies():
    """Two stiff blocks on a soft one have rigid motions of their own, all independent, and answers are those of a factorisation."""
    cell, sizes, found = "hexahedron", (2, 3), []
    uppers = [box(cell, [x, 0.0, 0.0], [x + 1.0, 1.0, 1.0], [n] * 3) for x, n in zip((0.0, 1.5), sizes)]
    s = scene(COMM, cell, [box(cell, [-0.2, -0.2, -1.0], [2.7, 1.2, 0.0], [4, 2, 2]), *uppers])
    V = uem.function_space(s.mesh, 1, (3,))
    low, tops = s.tag("low", 0, at(2, 0.0)), [s.tag("top", i, at(2, 1.0)) for i in (1, 2)]
    bcs = [*clamp(V, s.tag("bottom", 0, at(2, -1.0))), *(bc for top in tops for bc in clamp(V, top, value=[0.0, 0.0, -0.01]))]
    for options in ({"ksp_type": "cg", "ksp_rtol": 1e-10} | uem.multigrid_options("gamg"), None):
        u = fem.Function(V)
        contacts = [uem.Contact(s.tag("high", i, at(2, 0.0)), low, sliding="small", name=f"block {i}") for i in (1, 2)]
        problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 1e4, 1e4)), u, bcs=bcs, contacts=contacts, petsc_options=options)
        problem.solve()
        found.append([contact.resultant().force[2] for contact in contacts])
        if options is not None:
            solver, P = problem.system.solver, problem.system.restriction()
            W = deflated(problem.config, solver.A, P, pressed_hard(problem.config, solver.A, problem.bodies.tangent.K, P))
            assert solver.ksp.getPC().getType() == "python"
            assert np.linalg.matrix_rank(gathered_matrix(W)) == W.getSize()[1]
    assert found[0] == pytest.approx(found[1], rel=1e-7)


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
