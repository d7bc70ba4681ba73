"""Equations that follow each other in rings: closed ones say the same, those that depend on each other are made independent.

``test_closed_rings_are_those_of_a_dense_system`` compares with dense linear algebra, ``test_three_bodies_about_a_line`` is where rings
come from: each of three bodies is contactor of the next, and at the line where they meet nobody comes first.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from equation_scenes import united
from helpers import at, blocks, box, clamp, gathered_matrix, gathered_vector, highest, linear, modulus, run, scene
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra import restriction, rings
from uem_dolfinx.algebra.dependent import IndependentEquations
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.algebra.rings import DependentRingError
from uem_dolfinx.geometry.configuration import Configuration

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("part", [0.0, 5e-9, 0.1, 0.5, 0.999, 1.0 - 1e-7, 1.0])
def test_a_ring_of_equal_parts(comm, part):
    """Each follows the next by a part: du = part du + the rest; where these leave a millionth of a row, it depends on the others."""
    config = Configuration(blocks(comm, "triangle", 2, 2, gap=0.5).u)
    ring = [(0, [0.0, 1.0], 3), (3, [0.6, 0.8], 5), (5, [0.0, 1.0], 0)]
    if part > 0.9999:
        with pytest.raises(DependentRingError, match="follows itself"):
            united(config, [(0, [0.0, 1.0], 3), (3, [0.0, 1.0], 0)], coefficient=part)
    else:
        two = united(config, [(0, [0.0, 1.0], 3), (3, [0.0, 1.0], 0)], coefficient=part)
        assert (two.rings is not None) == (part > 0.33) and two.fades == (0 < part < 0.33)
        # with nothing from outside neither moves
        assert (
            np.abs(gathered_vector(two.expand(two.space.vector(np.ones((config.n_owned, 2))))).reshape(-1, 2)[[0, 3], 1]).max()
            == 0
        )
    if part == 1.0:
        return
    r = united(config, ring, coefficient=part)
    q = r.P.createVecRight()
    q.array[:] = np.sin(1.0 + np.arange(q.local_size) + q.owner_range[0])
    moved = r.expand(q)
    assert ((r.P * q) - moved).norm() <= 1e-15 * moved.norm()
    du = gathered_vector(moved).reshape(-1, 2)
    for node, direction, followed in ring:
        assert np.dot(direction, du[node] - part * du[followed]) == pytest.approx(0.0, abs=1e-15)


def random_rings(seed, g):
    """Rows ``A du = h`` of some nodes, two of one, that follow each other and nodes of none: A ``(m, n, g)``, h, their nodes, all nodes."""
    rng = np.random.default_rng(seed)
    config = Configuration(blocks(COMM, "triangle" if g == 2 else "tetrahedron", 3, 3, gap=0.5).u)
    total = config.index_map.size_global
    nodes = rng.choice(total, 9, replace=False)
    own = nodes[[0, 1, 2, 2, 3, 4, 5]]
    A = np.zeros((7, total, g))
    for i, node in enumerate(own):
        n = rng.normal(size=g)
        A[i, node] = n / np.linalg.norm(n)
        if i == 3:
            # the two of one node lean less than 45 degrees to each other
            A[i, node] = A[2, node] + 0.9 * np.linalg.qr(np.stack([A[2, node], n], axis=1))[0][:, 1]
        # a ring of four rows, one of two, and one row that follows the first and is followed by none
        near = ([1, 2, 6], [2, 7], [0, 8], [1, 7], [4, 6], [3, 8], [0, 7])[i]
        for a in near:
            A[i, nodes[a]] -= rng.uniform(0.1, 0.5) * rng.normal(size=g) / np.sqrt(g)
    return config, A, rng.normal(size=7), own


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("g", [2, 3])
def test_closed_rings_are_those_of_a_dense_system(seed, g, monkeypatch):
    """``du = P dq + c`` solves all rows, the unknowns of P are as many as are left, and forces of the rows arrive as they are."""
    monkeypatch.setattr(rings, "NODES_TOGETHER", 4)
    # some of these would fade
    monkeypatch.setattr(restriction, "MOST_ROUND", 0)
    config, A, h, own = random_rings(seed, g)
    m, total, _ = A.shape
    first, n = config.first, config.n_owned
    mine = np.flatnonzero((own >= first) & (own < first + n))
    row, followed = np.nonzero((A[mine] != 0).any(axis=2) & (np.arange(total) != own[mine, None]))
    equations = UnitingEquations(
        (own[mine] - first).astype(np.int32), A[mine, own[mine]], -h[mine], np.ones(len(mine), bool), row, followed,
        -A[mine[row], followed],
    )  # fmt: skip
    free = np.ones((n, g), bool)
    r = Restriction(config, equations, free, np.zeros((n, g)))
    assert r.rings is not None
    C, P, c = A.reshape(m, -1), gathered_matrix(r.P), gathered_vector(r.c)
    assert np.abs(C @ P).max() < 1e-13 * np.abs(P).max() and np.abs(C @ c - h).max() < 1e-13 * max(1.0, np.abs(c).max())
    assert np.linalg.matrix_rank(P) == total * g - m
    lam = np.sin(1.0 + np.arange(m))
    F = r.P.createVecLeft()
    F.array[:] = (C.T @ lam).reshape(-1, g)[first : first + n].ravel()
    y = r.pass_on(F)
    assert r.reduce(y).norm() < 1e-13
    found = np.zeros(m)
    for i, values in COMM.allgather((mine, r.multipliers(y))):
        found[i] = values
    assert np.abs(found - lam).max() < 1e-12


def test_rings_are_found_in_any_graph():
    """Only those that ways lead from and to, each with a number of its own: a chain into a ring, and one out of it, are not of it."""
    ways = [(0, 1), (1, 2), (2, 0), (3, 0), (2, 4), (5, 6), (6, 5), (4, 7), (8, 8)]
    total = 9
    first, end = total * COMM.rank // COMM.size, total * (COMM.rank + 1) // COMM.size
    follows = PETSc.Mat().createAIJ(((end - first, total),) * 2, comm=COMM)
    follows.setUp()
    for i, j in ways:
        if first <= i < end:
            follows.setValue(i, j, 1.0)
    follows.assemble()
    label, ranks = rings.in_rings(follows)
    every = np.concatenate(COMM.allgather(label))
    assert (every[[3, 4, 7]] == -1).all() and len(ranks) == 3
    assert len(set(every[[0, 1, 2]])) == len(set(every[[5, 6]])) == 1 and len({every[0], every[5], every[8]}) == 3


def test_groups_are_spread_over_ranks():
    """Conflicting equations that share no nodes are solved each where most of it is, not all on one rank."""
    config = Configuration(blocks(COMM, "triangle", 8, 8, gap=0.5).u)
    n, first = config.n_owned, config.first
    # on every rank two equations of one node that say the same, apart from those of the others
    node, e = np.array([0, 0], np.int32), np.array([[0.0, 1.0]] * 2)
    target = np.full((2, 1), first + n - 1)
    equations = UnitingEquations.along(node, e, target, np.ones((2, 1)), np.zeros(2), np.ones(2, bool))
    found = IndependentEquations(config, equations, np.ones((n, 2), bool))
    assert found.found and len(found._groups) == 1
    assert len(found.equations) == 1 and found.forces(np.array([3.0]), np.zeros(2)) == pytest.approx([1.5, 1.5])
    assert found.redundant.sum() == 1


# -- bodies ----------------------------------------------------------------------------------------------------------------


def sectors(n, cell="triangle", layers=1):
    """Three rhombic bodies of 120 degrees about an axis, and the surfaces on which each meets the next and the one before."""
    e = np.array([[np.cos(a), np.sin(a)] for a in 2 * np.pi / 3 * np.arange(3)])
    g = 2 if cell in ("triangle", "quadrilateral") else 3

    def body(k):
        flat = box(cell, [0.0] * g, [1.0] * g, [n, n] + [layers] * (g - 2))
        return flat.mapped(lambda x: np.hstack([x[:, :2] @ np.stack([e[k], e[(k + 1) % 3]]), x[:, 2:]]))

    def side(k, which):
        way = e[k]
        return s.tag(f"{which} of {k % 3}", (k if which == "first" else k - 1) % 3, lambda x: (
            (np.abs(x[:, 0] * way[1] - x[:, 1] * way[0]) < 1e-9) & (x[:, :2] @ way > -1e-9)))  # fmt: skip

    s = scene(COMM, cell, [body(k) for k in range(3)])
    firsts, lasts = zip(*((side(k, "first"), side(k, "last")) for k in range(3)))
    return s, g, e, firsts, lasts


@pytest.mark.parametrize("cell, n", [("triangle", 4), ("quadrilateral", 2), ("hexahedron", 2), ("tetrahedron", 2)])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_three_bodies_about_a_line(cell, n, coupling):
    """Pressed from all sides evenly they stay in uniform strain, and every surface carries the same pressure 2 eps (lambda + mu)."""
    s, g, e, firsts, lasts = sectors(n, cell)
    V = compat.function_space(s.mesh, 1, (g,))
    u, eps, nu = fem.Function(V), 1e-3, 0.3
    shrunk = fem.Function(V)
    shrunk.interpolate(lambda x: np.vstack([-eps * x[:2], 0.0 * x[2:g]]))
    rims = [s.tag("rim", k, lambda x, k=k: rim(x, e, k)) for k in range(3)]
    bcs = [uem.dirichlet(V, tag, value=shrunk) for tag in rims]
    if g == 3:
        bcs += [uem.dirichlet(V, s.tag("end", k, at(2, z)), 2) for k in range(3) for z in (0.0, 1.0)]
    # the last side of each body lies on the first one of the next
    contacts = [uem.Contact(a, b, coupling=coupling) for a, b in zip(lasts, firsts)]
    problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0, 1.0), nu), u, bcs=bcs, contacts=contacts)
    run(problem)
    exact = -eps * problem.config.X[:, :2]
    assert highest(COMM, np.abs(problem.config.displacement[:, :2] - exact)) <= 1e-13 * 1.0
    p = 2 * eps * nu / ((1 + nu) * (1 - 2 * nu)) + eps / (1 + nu)
    for contact in contacts:
        assert contact.balance().force < 1e-12
        # at the rim both are prescribed, and the share of half a facet is what holds them there
        assert np.linalg.norm(contact.resultant().force) == pytest.approx(p * (1 - 0.5 / n), rel=1e-9)


def rim(x, e, k):
    """Places on the two outer sides of a rhombus."""
    parts = x[:, :2] @ np.linalg.inv(np.stack([e[k], e[(k + 1) % 3]]))
    return np.abs(parts - 1).min(axis=1) < 1e-9


def test_three_surfaces_at_one_place():
    """Each follows the next as a whole: their equations depend on each other, one of every ring is left out, and all move as one."""
    cell = "triangle"
    bodies = [box(cell, [0.0, -1.0], [1.0, 0.0], [2, 2]), box(cell, [0.0, 0.0], [1.0, 1.0], [2, 2]),
              box(cell, [0.0, 0.0], [1.0, 0.5], [2, 1])]  # fmt: skip
    s = scene(COMM, cell, bodies)
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    a, b, c = s.tag("a", 0, at(1, 0.0)), s.tag("b", 1, at(1, 0.0)), s.tag("c", 2, at(1, 0.0))
    contacts = [uem.Contact(b, a), uem.Contact(c, b, max_penetration=9.0), uem.Contact(a, c)]
    bcs = [*clamp(V, s.tag("bottom", 0, at(1, -1.0))), *clamp(V, s.tag("top", 1, at(1, 1.0)), value=[0.0, -0.01])]
    problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0, 1.0), 0.0), u, bcs=bcs, contacts=contacts)
    run(problem)
    moved = s.gather(u)
    rows = [np.flatnonzero((s.drawing[:, 1] == 0.0) & (np.arange(len(s.drawing)) // 9 == k)) for k in range(3)]
    heights = np.stack([moved[r, 1] for r in rows])
    assert np.abs(heights + 0.005).max() < 1e-14
