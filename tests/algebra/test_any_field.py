"""P for fields that are no displacements: temperatures with one component a node, and blocks of more than there are coordinates.

Two tests to read first: ``test_perfect_conductance`` compares ``P'KP`` with SciPy, and ``test_linear_temperature`` is the patch test.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import scipy.linalg
import ufl
from helpers import blocks, gathered_matrix, gathered_vector, highest, scattered

from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.linear_solver import MOST_ACCURATE, UnitedSolver
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.geometry.bodies import find_bodies
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.surfaces import surface_nodes

COMM = MPI.COMM_WORLD
EPS = np.finfo(float).eps
DIRECT = {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps"}
CELLS = ["triangle", "quadrilateral", "tetrahedron"]


class Heat:
    """Two blocks on each other that conduct heat, the upper one's lower side as warm as what it lies on.

    Args:
        cell: kind of cells.
        low: cells along a side of the lower block.
        high: cells along a side of the upper block.
        warmth: temperature at places ``(n, gdim)``, which is prescribed all around but for the contactors.
    """

    def __init__(self, cell, low, high, warmth):
        b = blocks(COMM, cell, low, high)
        config = Configuration(b.u)
        self.V = V = compat.function_space(b.scene.mesh, 1)
        self.nodes = nodes = Nodes(V)
        # one mesh and one degree number nodes alike
        assert np.array_equal(nodes.X, config.X)
        contactors = surface_nodes(config, b.high)
        feet = MeshTarget(TargetFacets(config, b.low)).project(config.X[contactors])
        m, n, g = len(contactors), nodes.n_owned, nodes.gdim
        self.equations = UnitingEquations.along(
            contactors, np.ones((m, 1)), feet.nodes, feet.weights, np.zeros(m), np.ones(m, dtype=bool)
        )
        X = nodes.X[:n]
        self.exact = warmth(X)
        low_end, high_end = (np.array([sign * highest(COMM, sign * X[:, k]) for k in range(g)]) for sign in (-1.0, 1.0))
        around = (np.abs(X - low_end) < 1e-9).any(axis=1) | (np.abs(X - high_end) < 1e-9).any(axis=1)
        around[contactors] = False
        self.free = ~around[:, None]
        self.restriction = Restriction(nodes, self.equations, self.free, np.where(around, self.exact, 0.0)[:, None])
        T, v = ufl.TrialFunction(V), ufl.TestFunction(V)
        form = forms.form(ufl.inner(ufl.grad(T), ufl.grad(v)) * ufl.dx)
        self.K = forms.create_matrix(form)
        forms.assemble_matrix(self.K, form)

    def solve(self, f, options=DIRECT):
        r = self.restriction
        solver = UnitedSolver(self.nodes, "heat_", options)
        solver.set_operator(r, self.K, None)
        dq, _ = solver.solve(r.transpose(f - self.K * r.c), 1e-12)
        T = r.expand(dq)
        T.axpy(1.0, r.c)
        return T

    def constraints(self):
        """Dense ``C T = h`` of all ranks: equations, then what is prescribed."""
        size, eq, n = self.nodes.index_map.size_global, self.equations, self.nodes.n_owned
        C = np.zeros((len(eq), size))
        C[np.arange(len(eq)), self.nodes.to_global(eq.node)] = 1.0
        np.add.at(C, (eq.row, eq.followed), -eq.coefficients[:, 0])
        held = np.flatnonzero(~self.free[:, 0])
        D = np.zeros((len(held), size))
        D[np.arange(len(held)), self.nodes.to_global(held)] = 1.0
        C = np.concatenate([np.concatenate(COMM.allgather(A)) for A in (C, D)])
        h = np.concatenate(COMM.allgather(self.exact[:n][held]))
        return C, np.append(np.zeros(len(C) - len(h)), h)


def uneven(X):
    return np.sin(2.0 * X[:, 0]) + X[:, -1] ** 2


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("options", [DIRECT, {"ksp_type": "cg", "pc_type": "gamg"}], ids=["direct", "multigrid"])
def test_perfect_conductance(cell, options):
    """With sources and meshes that do not match: T of the dense Lagrange system, and contactors as warm as their targets there."""
    heat = Heat(cell, 3, 4, uneven)
    C, h = heat.constraints()
    K = gathered_matrix(heat.K)
    force = np.random.default_rng(1).normal(size=len(K))
    m = len(C)
    expected = scipy.linalg.solve(np.block([[K, C.T], [C, np.zeros((m, m))]]), np.append(force, h), assume_a="sym")[: len(K)]
    T = heat.solve(scattered(force, heat.K.createVecLeft()), options)
    found = gathered_vector(T)
    # as accurate as what a solve may leave of its right-hand side lets it be
    P = gathered_matrix(heat.restriction.P)
    P = P[:, np.abs(P).max(axis=0) > 0]
    left = np.linalg.cond(P.T @ K @ P) * (MOST_ACCURATE if "gamg" in options.values() else 10 * EPS)
    assert np.linalg.norm(found - expected) < left * np.linalg.norm(expected)
    assert np.abs(C @ found - h).max() < 1e-13


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("low,high,along", [(2, 4, (0.7, -0.4, 1.3)), (3, 4, (1.0, 0.0, 0.0))], ids=["nested", "along"])
def test_linear_temperature(cell, low, high, along):
    """Exact in any direction where contactors' traces are those of the target, and along the surface on any meshes."""

    def warmth(X):
        return 0.3 + X @ np.array(along)[[*range(X.shape[1] - 1), 2]]

    heat = Heat(cell, low, high, warmth)
    T = heat.solve(heat.K.createVecLeft())
    assert highest(COMM, np.abs(T.array_r - heat.exact)) < 1e-13


def test_a_temperature_has_one_mode_for_each_body():
    heat = Heat("triangle", 2, 3, uneven)
    body, count = find_bodies(heat.nodes)
    assert count == 2 and heat.nodes.modes().shape == (heat.nodes.n_owned, 1, 1)
    warm = heat.K.createVecLeft()
    warm.array[:] = heat.nodes.modes()[:, 0, 0] * (body[: heat.nodes.n_owned] == 1)
    assert warm.norm() > 1.0 and (heat.K * warm).norm() < 1e-13 * heat.K.norm()


@pytest.mark.parametrize("block,rows", [(4, 1), (4, 2), (5, 2), (5, 3), (6, 4)])
def test_blocks_of_any_size(block, rows):
    """Of several equations of a node with many components P spans all that they leave, one column for each."""
    mesh = blocks(COMM, "triangle", 2, 2).scene.mesh
    nodes = Nodes(compat.function_space(mesh, 1, (block,)))
    n, size = nodes.n_owned, block * nodes.index_map.size_global
    rng = np.random.default_rng(2)
    own = np.flatnonzero(nodes.to_global(np.arange(n)) % 5 == 1).astype(np.int32)
    node = np.repeat(own, rows)
    direction = np.tile(rng.normal(size=(rows, block)), (len(own), 1))
    free = np.ones((n, block), dtype=bool)
    free[own, 0] = False
    targets = (nodes.to_global(node)[:, None] - 1).astype(np.int64)
    m = len(node)
    eq = UnitingEquations.along(node, direction, targets, np.ones((m, 1)), np.zeros(m), np.ones(m, dtype=bool))
    r = Restriction(nodes, eq, free, np.zeros((n, block)))
    C = np.zeros((m, size))
    places = nodes.to_global(node)[:, None] * block + np.arange(block)
    np.put_along_axis(C, places, direction, axis=1)
    np.put_along_axis(C, places - block, -direction, axis=1)
    C = np.concatenate(COMM.allgather(C))
    P = gathered_matrix(r.P)
    used = np.abs(P).max(axis=0) > 0
    held = COMM.allreduce(len(own))
    assert used.sum() == size - len(C) - held and np.linalg.matrix_rank(P[:, used]) == used.sum()
    assert held > 1 and np.abs(C @ P).max() < 1e-13
