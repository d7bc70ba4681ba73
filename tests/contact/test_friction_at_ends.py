"""Mortar with friction where the target ends over facets of the contactor that stick: equations follow each other in circles.

The test to read first is ``test_forces_are_those_of_all_equations``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, box, clamp, gathered_matrix, linear, scene

import uem_dolfinx as uem
from uem_dolfinx import compat


def pressed(half, n, comm=MPI.COMM_WORLD, *, friction=0.9, way=0.05, rtol=1e-10):
    """A block pressed into a larger one, which is the contactor, and pushed; half of both, or both: the problem, its contact, the scene."""
    y, m = (0.0, 1) if half else (-1.0, 2)
    lower = box("tetrahedron", [-0.4, 1.4 * y, -1.0], [1.4, 1.4, 0.0], [n, n * m // 2 + 1, 2])
    upper = box("tetrahedron", [0.05, y, 0.0], [1.05, 1.0, 1.0], [3, 3 * m, 3])
    s = scene(comm, "tetrahedron", [lower, upper])
    V = compat.function_space(s.mesh, 1, (3,))
    u, low, high, top = fem.Function(V), s.tag("low", 0, at(2, 0.0)), s.tag("high", 1, at(2, 0.0)), s.tag("top", 1, at(2, 1.0))
    held = [
        (top, 0, way),
        (top, 1, 0.0),
        (top, 2, -0.02),
        *[(s.tag(f"middle {k}", k, at(1, 0.0)), 1, 0.0) for k in (0, 1) if half],
    ]
    bcs = clamp(V, s.tag("bottom", 0, at(2, -1.0)))
    for surface, component, value in held:
        bcs += clamp(V, surface, component, value=value)
    contact = uem.Contact(low, high, coupling="mortar", friction=friction)
    return uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=[contact], rtol=rtol), contact, s


def rows_of(equations, n):
    """Left sides of equations as a matrix of the displacement of ``n`` nodes."""
    A = np.zeros((len(equations), n, equations.direction.shape[1]))
    A[np.arange(len(equations)), equations.node] += equations.direction
    np.subtract.at(A, (equations.row, equations.followed), equations.coefficients)
    return A.reshape(len(equations), -1)


@pytest.mark.long
@pytest.mark.parametrize(
    ("half", "n", "friction"), [(False, 4, 0.9), (True, 5, 0.9), pytest.param(True, 4, 0.9, marks=pytest.mark.slow)]
)
def test_forces_are_those_of_all_equations(half, n, friction):
    """Equations follow each other in circles, by a small part each: motions and forces are those of a dense system of all."""
    problem, contact, _ = pressed(half, n, MPI.COMM_SELF, friction=friction, rtol=1e-12)
    list(uem.load_steps(problem, 2))
    pair, state, size = contact.pair, contact.pair.trial, problem.config.n_owned
    stick = state.active & state.friction.stick
    assert stick.any() and pair.friction.slipping(state).any() and problem.system._rows().frictionless.fades
    made, placed, free = pair.equations(), pair.kinematics, problem.bodies.free[:size].ravel()
    kept = made.rows.active
    rows, node, normal = rows_of(made.rows.select(kept), size)[:, free], made.contactor[kept], made.tangent[kept] < 0
    # no motion that is left opens a gap or moves what sticks
    P = gathered_matrix(problem.system._rows().frictionless.P)[free]
    assert np.abs(rows @ P).max() <= 1e-13 and np.linalg.matrix_rank(P) == free.sum() - len(rows)
    problem.bodies.assemble()
    share = placed.ties.share
    slipping = np.where(pair.friction.slipping(state)[:, None], state.friction.tau / share[:, None], 0.0)
    F = problem.bodies.residual.array_r[free] - problem.config.add_at_owners(*placed.ties.handed_on(slipping)).ravel()[free]
    found, *_ = np.linalg.lstsq(rows.T, F, rcond=None)
    assert np.linalg.norm(rows.T @ found - F) <= 1e-10 * np.linalg.norm(F)
    largest, lam, tau = state.lam.max(), np.zeros_like(state.lam), np.zeros_like(state.force)
    lam[node[normal]] = found[normal] * placed.pressure_map(False).force[node[normal]]
    np.add.at(tau, node[~normal], found[~normal, None] * made.rows.select(kept).direction[~normal])
    assert np.abs(lam - state.lam).max() <= 1e-7 * largest
    assert np.abs(tau * share[:, None] - state.friction.tau)[stick].max() <= 1e-7 * largest


@pytest.mark.long
@pytest.mark.parametrize("half", [False, True])
def test_ends_on_any_number_of_ranks(half):
    """The same displacement and friction, and Newton's method stays quadratic."""
    found = []
    for comm in (MPI.COMM_WORLD, MPI.COMM_SELF):
        problem, contact, s = pressed(half, 5, comm)
        steps = list(uem.load_steps(problem, 2))
        assert max(step.newton_iterations for step in steps) <= 7
        found.append((s.gather(problem.u), contact.resultant().force))
    (u, force), (alone, its) = found
    assert np.abs(u - alone).max() <= 1e-9 and np.abs(np.asarray(force) - its).max() <= 1e-10
