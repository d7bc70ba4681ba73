"""Constraints that meet: prescribed contactors, contactors of two pairs, two-pass contact, stacks and cycles.

Two tests to read first: ``test_two_pass_is_exact_on_any_two_meshes`` and ``test_independent_equations_say_the_same``, which compares
the equations that replace contested ones with dense linear algebra.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import CELLS, M, at, blocks, box, clamp, complementary, highest, linear, modulus, run, scene
from hypothesis import given, settings
from hypothesis import strategies as st

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra.dependent import IndependentEquations
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.geometry.configuration import Configuration

COMM = MPI.COMM_WORLD


def squeezed(b, E_low=1.0, E_high=1.0, d=0.01, how=(), **options):
    """Both blocks in an oedometer: the problem."""
    return uem.UnitedProblem(linear(b.u, modulus(b.scene, E_low, E_high)), b.u, bcs=b.oedometer(d), contacts=how, **options)


def vertical_error(problem, d):
    """Largest deviation from uniform compression of both blocks together, relative to d."""
    x, u = problem.config.X, problem.config.displacement
    return highest(COMM, np.abs(u[:, -1] + 0.5 * d * (x[:, -1] + 1))) / d


# -- the algebra ---------------------------------------------------------------------------------------------------------


@settings(max_examples=25, deadline=None, derandomize=True)
@given(seed=st.integers(0, 10**6), prescribed=st.integers(0, 3), both=st.booleans())
def test_independent_equations_say_the_same(seed, prescribed, both):
    """Whatever rows meet: ``du = P dq + c`` solves all of them, and the forces of the independent ones are theirs."""
    rng = np.random.default_rng(seed)
    b = blocks(COMM, "triangle", 2, 2, gap=0.5)
    config = Configuration(b.u)
    n, g, first = config.n_owned, 2, config.index_map.local_range[0]
    total = config.index_map.size_global
    # the same rows on every rank; each keeps those of its own nodes
    nodes = rng.choice(total, 6, replace=False)
    A = np.zeros((5, total, g))
    for i in range(5):
        A[i, nodes[i % 3 if both else i]] = rng.normal(size=g)
        for a in rng.choice(6, 2, replace=False):
            A[i, nodes[a]] -= rng.random() * np.array([0.0, 1.0])
    A[4] = A[0] + A[1]
    h = rng.normal(size=5)
    h[4] = h[0] + h[1]
    free = np.ones((total, g), bool)
    free[nodes[:prescribed], 1] = False
    bound = np.where(free, 0.0, rng.normal(size=free.shape))
    own = np.array([nodes[i % 3 if both else i] for i in range(4)] + [nodes[0]])
    mine = np.flatnonzero((own >= first) & (own < first + n))
    terms = [(k, a) for k, i in enumerate(mine) for a in nodes if a != own[i]]
    row = np.array([k for k, _ in terms], np.int64)
    followed = np.array([a for _, a in terms], np.int64)
    equations = UnitingEquations(
        (own[mine] - first).astype(np.int32), A[mine, own[mine]], -h[mine], np.ones(len(mine), bool), row, followed,
        -np.array([A[mine[k], a] for k, a in terms]).reshape(-1, g),
    )  # fmt: skip
    here = slice(first, first + n)
    resolution = IndependentEquations(config, equations, free[here], np.ones(len(mine), bool))
    r = Restriction(config, resolution.equations, free[here], bound[here], True)
    C = A.reshape(5, -1)
    q = r.P.createVecRight()
    q.array[:] = np.random.default_rng(seed + COMM.rank).normal(size=n * g)
    du = r.expand(q)
    du.axpy(1.0, r.c)
    moved = np.concatenate(COMM.allgather(du.array_r.copy()))
    assert np.abs(C @ moved - h).max() < 1e-9 * max(1.0, np.abs(moved).max())
    # forces of the rows, any, arrive as forces of the rows
    lam = rng.normal(size=5)
    F = r.P.createVecLeft()
    F.array[:] = (C.T @ lam).reshape(-1, g)[here].ravel()
    y = r.pass_on(F)
    assert r.reduce(y).norm() < 1e-9
    back = resolution.forces(r.multipliers(y))
    every = np.zeros(5)
    for i, values in COMM.allgather((mine, back)):
        every[i] = values
    loose = (C.T @ (every - lam)).reshape(-1, g) * free
    assert np.abs(loose).max() < 1e-9


# -- two-pass ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("n", [(2, 3), (3, 2), (2, 4), (2, 2)])
def test_two_pass_is_exact_on_any_two_meshes(cell, n):
    """Rows that depend on others are left out: constant pressure is transmitted to rounding, which single pass cannot."""
    b = blocks(COMM, cell, *n)
    contacts = [uem.Contact(b.high, b.low), uem.Contact(b.low, b.high)]
    problem = squeezed(b, how=contacts)
    run(problem)
    assert vertical_error(problem, 0.01) < 1e-12
    force = sum(c.resultant().force[-1] * sign for c, sign in zip(contacts, (1, -1)))
    assert force == pytest.approx(0.005 * M, rel=1e-10)
    for c in contacts:
        complementary(c, 1e-13, 1e-12)
        assert c.balance().force < 1e-12


def test_two_pass_of_pressed_discs():
    """Two-pass on a curved contact, where the rows depend on each other only nearly."""
    forces = []
    for passes in (2, 1):
        b = blocks(
            COMM, "triangle", 8, 6, gap=0.02, overhang=0.5, pose=lambda x: x + np.array([0.0, 0.1]) * (x[:, :1] - 0.5) ** 2
        )
        contacts = [uem.Contact(b.high, b.low), uem.Contact(b.low, b.high)][:passes]
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0, -0.03])]
        run(uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=contacts))
        forces.append(sum(sign * c.resultant().force[1] for sign, c in zip((1, -1), contacts)))
    assert forces[0] == pytest.approx(forces[1], rel=1e-9)


# -- prescribed contactors -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", CELLS)
def test_prescribed_contactors_eliminate_the_target(cell):
    """A contactor surface that is prescribed pushes the target down: a component of the target goes [UEM, 4.1, end]."""
    b = blocks(COMM, cell, 2, 4)
    g = b.gdim
    contact = uem.Contact(b.high, b.low)
    bottom, _, *sides = b.oedometer(0.02)
    problem = uem.UnitedProblem(
        linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=[bottom, *sides, *clamp(b.V, b.top, g - 1, value=-0.01),
                                                           *clamp(b.V, b.high, g - 1, value=-0.01)], contacts=[contact],
    )  # fmt: skip
    run(problem)
    x, u = problem.config.X, problem.config.displacement
    low = x[:, -1] < -1e-9
    assert highest(COMM, np.abs(u[low, -1] + 0.01 * (x[low, -1] + 1))) < 1e-13
    assert contact.resultant().force[-1] == pytest.approx(0.01 * M, rel=1e-10)
    assert contact.max_gap() < 1e-14
    assert contact.balance().force < 1e-12


def test_one_prescribed_contactor_among_free_ones():
    b = blocks(COMM, "triangle", 3, 4)
    one = b.scene.tag("edge", 1, lambda x: (np.abs(x[:, 1]) < 1e-9) & (x[:, 0] < 0.3))
    problem = uem.UnitedProblem(
        linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u,
        bcs=[*b.oedometer(0.01), *clamp(b.V, one, 1, value=-0.005)], contacts=[contact := uem.Contact(b.high, b.low)],
    )  # fmt: skip
    run(problem, 2)
    complementary(contact, 1e-13, 1e-12)
    assert contact.max_gap() < 1e-14 and contact.n_active >= 4


# -- contactors of two pairs -----------------------------------------------------------------------------------------------


def three(cell, n):
    """Three unit blocks upon each other, from bottom to top with n divisions."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    bodies = [box(cell, [0.0] * (g - 1) + [float(k)], [1.0] * (g - 1) + [k + 1.0], [n[k]] * g) for k in range(3)]
    s = scene(COMM, cell, bodies)
    V = compat.function_space(s.mesh, 1, (g,))
    return s, V, fem.Function(V)


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
@pytest.mark.parametrize("up", [True, False])
def test_stack(cell, up):
    """The middle block is contactor below and target above (or the other way round)."""
    s, V, u = three(cell, (1, 2, 4) if up else (4, 2, 1))
    g = V.mesh.geometry.dim
    names = [[s.tag(f"{k}{e}", k, at(g - 1, float(k + e))) for e in (0, 1)] for k in range(3)]
    contacts = [uem.Contact(names[k + 1][0], names[k][1]) if up else uem.Contact(names[k][1], names[k + 1][0]) for k in range(2)]
    bcs = [*clamp(V, names[0][0], g - 1), *clamp(V, names[2][1], g - 1, value=-0.03)]
    for k in range(3):
        for c in range(g - 1):
            for end in (0.0, 1.0):
                bcs += clamp(V, s.tag("side", k, at(c, end)), c)
    problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 1e4, 1.0)), u, bcs=bcs, contacts=contacts)
    run(problem)
    k = M / (2 + 1e-4) * 0.03
    for contact in contacts:
        assert abs(contact.resultant().force[-1]) == pytest.approx(k, rel=1e-9)
        complementary(contact, 1e-12, 1e-8)
        assert contact.balance().force < 1e-10


@pytest.mark.parametrize("overlap", [False, True])
def test_contactor_of_two_pairs(overlap):
    """A block on two neighbours: the contactor above the joint meets both; rows that coincide count once."""
    cell = "quadrilateral"
    bodies = [box(cell, [0.0, -1.0], [1.0, 0.0], [2, 2]), box(cell, [1.0, -1.0], [2.0, 0.0], [2, 2]),
              box(cell, [0.0, 0.0], [2.0, 1.0], [4, 2])]  # fmt: skip
    s = scene(COMM, cell, bodies)
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    low = [s.tag(f"low{k}", k, at(1, 0.0)) for k in (0, 1)]
    high = s.tag("high", 2, at(1, 0.0))
    contacts = [uem.Contact(high, target, name=f"pair {k}") for k, target in enumerate(low)]
    if overlap:
        contacts.append(uem.Contact(high, low[0], name="pair again"))
    bcs = []
    for k in (0, 1, 2):
        bcs += clamp(V, s.tag("left", k, at(0, float(k == 1))), 0) + clamp(V, s.tag("right", k, at(0, [1.0, 2.0, 2.0][k])), 0)
    for k in (0, 1):
        bcs += clamp(V, s.tag("bottom", k, at(1, -1.0)), 1)
    bcs += clamp(V, s.tag("top", 2, at(1, 1.0)), 1, value=-0.01)
    problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0, 1.0)), u, bcs=bcs, contacts=contacts)
    run(problem)
    x = problem.config.X
    exact = -0.005 * (x[:, 1] + 1)
    assert highest(COMM, np.abs(problem.config.displacement[:, 1] - exact)) < 1e-14
    assert sum(c.resultant().force[1] for c in contacts) == pytest.approx(2 * 0.005 * M, rel=1e-10)


def test_ring_of_three_surfaces_is_refused():
    """Three surfaces at one place that follow each other in a ring have no order of elimination."""
    cell = "triangle"
    bodies = [box(cell, [0.0, -1.0], [1.0, 0.0], [2, 2]), box(cell, [0.0, 0.0], [1.0, 1.0], [3, 2]),
              box(cell, [0.0, 0.0], [1.0, 0.5], [2, 1])]  # fmt: skip
    s = scene(COMM, cell, bodies)
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    a, b, c = s.tag("a", 0, at(1, 0.0)), s.tag("b", 1, at(1, 0.0)), s.tag("c", 2, at(1, 0.0))
    contacts = [uem.Contact(b, a), uem.Contact(c, b, max_penetration=9.0), uem.Contact(a, c)]
    bcs = [*clamp(V, s.tag("bottom", 0, at(1, -1.0))), *clamp(V, s.tag("top", 1, at(1, 1.0)), value=[0.0, -0.01])]
    problem = uem.UnitedProblem(linear(u, modulus(s, 1.0, 1.0, 1.0)), u, bcs=bcs, contacts=contacts)
    with pytest.raises(uem.ConflictError, match="follows itself"):
        run(problem)
