"""The matrix of the curvature of the contact, against a loop over its blocks, and in the united matrix."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import blocks, clamp, gathered_matrix, gathered_vector, linear
from petsc4py import PETSc
from resting_scenes import COMM

import uem_dolfinx as uem
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.solve.bodies.tangent import contact_curvature, convex_part

# ---------------------------------------------------------------------------------------------- curvature of the contact


def test_convex_part():
    """Of symmetric blocks the positive eigenvalues stay, with their directions; others stay as they are."""
    rng = np.random.default_rng(1)
    A = rng.normal(size=(5, 6, 6))
    blocks = np.concatenate([A + A.transpose(0, 2, 1), A])
    made = convex_part(blocks)
    assert np.array_equal(made[5:], A)
    for block, convex in zip(blocks[:5], made):
        rest = convex - block
        assert np.linalg.eigvalsh(convex).min() > -1e-12 and np.linalg.eigvalsh(rest).min() > -1e-12
        assert np.abs(convex @ rest).max() < 1e-12


def test_curvature_is_the_sum_of_its_blocks():
    """Blocks of several pairs, over rows of other ranks, with nodes left out and a rank without any, against a loop."""
    n, g = 5, 2
    rng = np.random.default_rng(COMM.rank)
    du = PETSc.Vec().createMPI((n * g, PETSc.DETERMINE), bsize=g, comm=COMM)
    parts = []
    for m in (3, 4, 1):
        k = 0 if COMM.size > 1 and COMM.rank == COMM.size - 1 else 6
        nodes = rng.permuted(np.tile(np.arange(n * COMM.size), (k, 1)), axis=1)[:, :m]
        nodes[rng.random(nodes.shape) < 0.2] = -1
        parts.append((nodes, rng.normal(size=(k, m * g, m * g))))
    expected = np.zeros((n * COMM.size, g, n * COMM.size, g))
    for nodes, blocks_of in (part for ranks in COMM.allgather(parts) for part in ranks):
        for row, block in zip(nodes, blocks_of):
            for i, r in enumerate(row):
                for j, c in enumerate(row):
                    if r >= 0 and c >= 0:
                        expected[r, :, c] += block[i * g : (i + 1) * g, j * g : (j + 1) * g]
    expected = expected.reshape(n * g * COMM.size, -1)
    found = gathered_matrix(contact_curvature(parts, du))
    assert np.abs(found - expected).max() < 1e-14 * np.abs(expected).max()


@pytest.mark.parametrize("again", [False, True])
def test_curvature_without_equations(again):
    """Forces may outlive the last equation by an iteration; the united matrix then holds their curvature all the same."""
    b = blocks(COMM, "triangle", 2, 3)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=clamp(b.V, b.bottom), contacts=[uem.Contact(b.high, b.low)])
    config = problem.config
    free = problem.bodies.free[: config.n_owned]
    none = Restriction(config, UnitingEquations.join([], config.gdim), free, np.zeros(free.shape))
    K, pair = problem.bodies.update_tangent(), problem.contacts[0].pair
    nodes = np.column_stack([config.to_global(pair.nodes), pair.kinematics.projection.nodes])
    size = nodes.shape[1] * config.gdim
    blocks_of = np.random.default_rng(COMM.rank).normal(size=(len(nodes), size, size))
    G = contact_curvature([(nodes, blocks_of + blocks_of.transpose(0, 2, 1))], K.createVecRight())
    if again:
        problem.system.solver.set_operator(none, K, None)
    problem.system.solver.set_operator(none, K, G)
    used = gathered_vector(none.reduce(none.space.vector(np.ones(free.shape))))
    expected = used[:, None] * (gathered_matrix(K) + gathered_matrix(G)) * used
    expected += np.diag((1 - used) * np.diag(gathered_matrix(K)))
    found = gathered_matrix(problem.system.solver.A)
    assert np.abs(found - expected).max() < 1e-14 * np.abs(expected).max()
    # and without it the next matrix is as before
    problem.system.solver.set_operator(none, K, None)
    plain = used[:, None] * gathered_matrix(K) * used + np.diag((1 - used) * np.diag(gathered_matrix(K)))
    assert np.abs(gathered_matrix(problem.system.solver.A) - plain).max() < 1e-14 * np.abs(plain).max()
