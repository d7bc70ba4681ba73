"""Couplings: labelled equations against a loop over contactors, forces in pairs, trial rows apart from test rows.

The test to read first is ``test_equations_against_a_loop``.
"""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest
from helpers import arch, blocks, clamp, gathered_matrix, gathered_vector, highest, modulus, run, scattered, st_venant

import uem_dolfinx as uem
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
from uem_dolfinx.contact.seam.placement import NORMAL

COMM = MPI.COMM_WORLD


def pressed(cell, degree=1, **how):
    """A block over an arch, all contactors taken for active, with a wavy displacement."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    b = blocks(COMM, cell, *((5, 4) if g == 2 else (3, 2)), gap=0.1, overhang=0.5, degree=degree, pose=arch(0.3, 0.45))
    contact = uem.Contact(b.high, b.low, max_penetration=0.5, **how)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top)]
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact])
    x = problem.config.X
    problem.config.displacement[:] = 0.01 * np.sin(3 * x[:, ::-1])
    pair = contact.pair
    pair.trial = replace(pair.trial, active=np.ones(len(pair.nodes), bool))
    pair.project()
    return b, problem, contact


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_equations_against_a_loop(cell):
    """Each active contactor has one equation along its normal: ``n . (du_i - sum N_a du_a) = -g`` for any du."""
    _, problem, contact = pressed(cell)
    pair, config = contact.pair, problem.config
    rows = pair.equations()
    assert rows.P is rows.Q and (rows.kind == NORMAL).all()
    assert np.array_equal(np.sort(rows.contactor), np.arange(len(pair.nodes)))
    du = np.cos(5 * config.X + 1)
    of_all = np.concatenate(COMM.allgather(du[: config.n_owned]))
    eq, p = rows.P, pair.kinematics.projection
    left = np.einsum("mg,mg->m", eq.direction, du[eq.node])
    np.subtract.at(left, eq.row, np.einsum("kg,kg->k", eq.coefficients, of_all[eq.followed]))
    for k, i in enumerate(rows.contactor):
        n = p.normal[i]
        wanted = n @ du[pair.nodes[i]] - sum(w * (n @ of_all[a]) for w, a in zip(p.weights[i], p.nodes[i]))
        assert left[k] == pytest.approx(wanted, rel=1e-13, abs=1e-15) and eq.gap[k] == pair.kinematics.gap[i]


@pytest.mark.parametrize(("cell", "degree"), [("triangle", 1), ("triangle", 2), ("hexahedron", 1)])
def test_forces_come_in_pairs(cell, degree):
    """Any multipliers make nodal forces whose sum vanishes, and which do the equations' work on any displacement."""
    _, problem, contact = pressed(cell, degree)
    pair, config = contact.pair, problem.config
    rows = pair.equations()
    multipliers = 1.0 + np.sin(7 * config.X[pair.nodes[rows.contactor]].sum(axis=1))
    pair.set_forces(pair.forces(rows, multipliers))
    nodes, forces = pair.nodal_forces(pair.trial)
    total = COMM.allreduce(forces.sum(axis=0))
    assert np.abs(total).max() <= 1e-13 * COMM.allreduce(np.abs(forces).sum())
    du = np.cos(5 * config.X + 1)
    of_all = np.concatenate(COMM.allgather(du[: config.n_owned]))
    eq = rows.Q
    work = multipliers * np.einsum("mg,mg->m", eq.direction, du[eq.node])
    np.subtract.at(work, eq.row, multipliers[eq.row] * np.einsum("kg,kg->k", eq.coefficients, of_all[eq.followed]))
    assert COMM.allreduce(np.einsum("kg,kg->", forces, of_all[nodes])) == pytest.approx(COMM.allreduce(work.sum()), rel=1e-11)


def test_trial_rows_apart_from_test_rows():
    """Chords stand in the trial rows alone; the matrix is ``Q'KP``, against dense products, and its solves are exact."""
    b, problem, _ = pressed("triangle", 2, chords=True)
    system, n = problem.system, problem.config.n_owned
    problem.bodies.assemble()
    state = system.assemble_constraints(lambda norm, scale, rounding: False)
    assert state.trial is not state.test
    K = problem.bodies.update_tangent()
    P, Q, Kd = gathered_matrix(state.trial.P), gathered_matrix(state.test.P), gathered_matrix(K)
    assert np.abs(P - Q).max() > 1e-3
    used = gathered_vector(scattered_like(state, n, b.gdim))
    wanted = Q.T @ Kd @ P + np.diag(np.where(used > 0, 0.0, np.diag(Kd)))
    rhs = scattered(np.where(used > 0, np.sin(np.arange(len(used))), 0.0), state.residual)
    for options in (
        {"ksp_type": "preonly", "pc_type": "cholesky"},
        {"ksp_type": "cg", "pc_type": "jacobi", "ksp_rtol": 1e-12, "ksp_gmres_restart": 200},
    ):
        if COMM.size > 1 and options["pc_type"] == "cholesky":
            options |= {"pc_factor_mat_solver_type": "mumps"}
        solver = UnitedSolver(problem.config, "chords_", options)
        solver.set_operator(state.trial, K, None, state.test)
        A = gathered_matrix(solver.ksp.getOperators()[0] if solver.iterative else solver.A)
        assert np.abs(A - wanted).max() <= 1e-13 * np.abs(wanted).max()
        dq, _ = solver.solve(rhs, 1e-12)
        expected = np.linalg.solve(wanted, gathered_vector(rhs))
        assert np.abs(gathered_vector(dq) - expected).max() <= 1e-8 * np.abs(expected).max()
        # and a symmetric matrix afterwards is solved as such
        solver.set_operator(state.test, K, None)
        symmetric, rest = Q.T @ Kd @ Q + np.diag(np.where(used > 0, 0.0, np.diag(Kd))), rhs.copy()
        dq, _ = solver.solve(rest, 1e-12)
        expected = np.linalg.solve(symmetric, gathered_vector(rhs))
        assert np.abs(gathered_vector(dq) - expected).max() <= 1e-8 * np.abs(expected).max()


def scattered_like(state, n, g):
    """A vector that is 1 at the unknowns in use."""
    v = state.residual.duplicate()
    v.array[:] = state.trial.used.ravel().astype(float)
    return v


def test_chords_reach_the_same_answer_with_conjugate_gradients():
    """Options for symmetric matrices give way to ones for others where trial and test rows differ."""
    forces = []
    for chords, options in ((False, None), (True, {"ksp_type": "cg", "pc_type": "jacobi", "ksp_max_it": 5000})):
        b = blocks(COMM, "triangle", 4, 3, gap=0.1, overhang=0.5, degree=2, pose=arch(0.3, 0.45))
        contact = uem.Contact(b.high, b.low, chords=chords, max_penetration=0.2)
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0, -0.15])]
        law = st_venant(b.u, modulus(b.scene, 1.0, 2.0))
        run(uem.UnitedProblem(law, b.u, bcs=bcs, contacts=[contact], petsc_options=options, rtol=1e-10), 2)
        forces.append(contact.resultant().force)
    assert np.abs(forces[0] - forces[1]).max() <= 1e-8 * np.abs(forces[0]).max()


def test_nodal_gaps_for_other_methods():
    """A coupling of degree 2 can be had without control gaps; nodal gaps then decide."""
    _, _, contact = pressed("triangle", 2)
    pair = contact.pair
    control = pair.kinematics.gap.copy()
    pair.discretisation = NodeToSurface.like(pair.discretisation)
    pair.project()
    assert np.array_equal(pair.kinematics.gap, pair.kinematics.projection.gap)
    pair.trial = replace(pair.trial, active=np.zeros(len(pair.nodes), bool))
    assert highest(COMM, np.abs(control - pair.kinematics.gap)) < 1.0
