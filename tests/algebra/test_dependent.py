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
from hypothesis import assume, given, settings
from hypothesis import strategies as st

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.algebra.dependent import IndependentEquations, Rank, _eliminate, least_squares
from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations
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
    back = resolution.forces(r.multipliers(y), np.zeros(len(mine)))
    every = np.zeros(5)
    for i, values in COMM.allgather((mine, back)):
        every[i] = values
    loose = (C.T @ (every - lam)).reshape(-1, g) * free
    assert np.abs(loose).max() < 1e-9


def rows(rng, m, scale):
    """Conflicting rows of contactors that follow two nodes each, of any length: coefficients, free components."""
    A, own = np.zeros((m, m + 3, 2)), rng.integers(0, m, m)
    for i in range(m):
        n = rng.normal(size=2)
        n /= np.linalg.norm(n)
        A[i, own[i]] = n
        w = rng.uniform()
        for a, part in zip(rng.choice(np.delete(np.arange(m + 3), own[i]), 2, replace=False), (w, 1 - w)):
            A[i, a] -= part * n
    return A * scale[:, None, None], rng.uniform(size=(m + 3, 2)) > 0.15


def eliminated(A, h, free):
    """The group of these rows, and its independent rows in full ``(k, n_nodes * 2)`` with the directions that they eliminate."""
    group = _eliminate(A, h, free, np.arange(A.shape[1]), np.arange(len(A)))
    e = group.independent
    D = np.zeros((len(e), *A.shape[1:]))
    D[np.arange(len(e)), e.node] = e.direction
    C = D.copy()
    np.add.at(C, (e.row, e.followed), -e.coefficients)
    return group, C.reshape(len(e), free.size), D.reshape(len(e), free.size)


@given(seed=st.integers(0, 10**6), m=st.integers(1, 7), copies=st.integers(0, 3), decades=st.sampled_from([0.0, 3.0]))
def test_as_many_independent_rows_as_their_rank(seed, m, copies, decades):
    """However long the rows are: their rank decides, what is left out follows from the others, and P'KP is positive definite."""
    rng = np.random.default_rng(seed)
    A, free = rows(rng, m, 10.0 ** rng.uniform(-decades, decades, m))
    mixed = rng.normal(size=(copies, m))
    A = np.concatenate([A, np.einsum("ij,jng->ing", mixed, A)])
    movable = (A * free).reshape(len(A), -1)
    length = np.linalg.norm(movable, axis=1, keepdims=True)
    s = np.linalg.svd(movable / np.where(length > 0, length, 1.0), compute_uv=False)
    # dependent to rounding, or clearly not
    assume(not ((s > 1e-9) & (s < 0.2)).any())
    du = rng.normal(size=A.shape[1:])
    h = np.einsum("ing,ng->i", A, du)
    group, C, D = eliminated(A, h, free)
    assert len(C) == (s > 0.2).sum() == (~group.redundant).sum()
    # what solves the given rows solves the independent ones, each of which alone moves its own direction
    assert np.allclose(C @ du.ravel(), -group.independent.gap, rtol=1e-9, atol=1e-9 * (1 + np.abs(C).max(initial=0.0)))
    assert np.allclose(C @ D.T, np.eye(len(C)), atol=1e-9)
    # and the other way round, where nothing is prescribed
    P = np.eye(C.shape[1]) - D.T @ C
    P = P * free.ravel()
    assert np.abs(movable / np.where(length > 0, length, 1.0) @ P * 1.0).max(initial=0.0) < 1e-7 * (
        1 + np.abs(C).max(initial=0.0)
    )
    columns = np.linalg.svd(P)[0][:, : int(free.sum()) - len(C)]
    B = rng.normal(size=(C.shape[1], C.shape[1]))
    assert np.linalg.eigvalsh(columns.T @ P.T @ (B @ B.T + np.eye(len(B))) @ P @ columns).min() > 0.0


@given(seed=st.integers(0, 10**6), near=st.sampled_from([1e-6, 1e-3, 0.03]), scale=st.sampled_from([1e-3, 1.0, 1e3]))
def test_a_dependent_row_takes_no_other_along(seed, near, scale):
    """Two long rows that are nearly one leave the rows of other contactors what they are."""
    rng = np.random.default_rng(seed)
    A, free = rows(rng, 4, np.ones(4))
    free[:] = True
    movable = A.reshape(4, -1)
    assume(np.linalg.svd(movable / np.linalg.norm(movable, axis=1, keepdims=True), compute_uv=False)[-1] > 0.3)
    twin = scale * (A[0] + near * np.linalg.norm(A[0]) * A[1] / np.linalg.norm(A[1]))
    A = np.concatenate([A, twin[None]])
    group, C, _ = eliminated(A, np.zeros(5), free)
    assert len(C) == 4 and not group.redundant[1:4].any() and group.redundant[[0, 4]].sum() == 1


@pytest.mark.parametrize("part, depends", [(5e-7, True), (2e-6, False)])
def test_rows_that_depend_nearly(part, depends):
    """The part of a row across the others determines whether it depends on them, not its entry at its own node."""
    rng = np.random.default_rng(0)
    A, free = rows(rng, 4, np.ones(4))
    free[:] = True
    across = np.linalg.svd(A.reshape(4, -1))[2][4].reshape(A.shape[1:])
    twin = np.sqrt(1 - part**2) * A[0] / np.linalg.norm(A[0]) + part * across
    group, _, _ = eliminated(np.concatenate([A, twin[None]]), np.zeros(5), free)
    assert group.redundant.sum() == depends


def plain(A, h, free):
    """Gauss-Jordan elimination of all rows at every pivot: the independent rows, in their order, and all that are left."""
    movable = (A * free).reshape(len(A), -1)
    length = np.linalg.norm(movable, axis=1)
    A, h, across = A / length[:, None, None], h / length, movable / length[:, None]
    rest, order = np.ones(len(A), dtype=bool), []
    while (rest := rest & (np.linalg.norm(across, axis=1) > MOSTLY_PRESCRIBED)).any():
        size = np.linalg.norm(A * free, axis=2)
        i, t = np.unravel_index(np.argmax(np.where(rest[:, None], size, -1.0)), size.shape)
        q, d = across[i] / np.linalg.norm(across[i]), A[i, t] * free[t] / size[i, t]
        across -= (across @ q)[:, None] * q
        A[i], h[i] = A[i] / size[i, t], h[i] / size[i, t]
        factor = np.where(np.arange(len(A)) == i, 0.0, A[:, t] @ d)
        A, h = A - factor[:, None, None] * A[i], h - factor * h[i]
        rest[i] = False
        order.append(int(i))
    return order, A[order].reshape(len(order), -1), h[order]


@pytest.mark.parametrize("m, copies", [(2, 0), (20, 5), (60, 40)])
def test_only_what_is_left_is_eliminated(m, copies):
    """Passing over zeros, and over rows that are chosen already, chooses the same rows and leaves the same of them."""
    rng = np.random.default_rng(m)
    A, free = rows(rng, m, np.ones(m))
    A = np.concatenate([A, A[rng.integers(0, m, copies)] * rng.uniform(0.5, 2.0, copies)[:, None, None]])
    free[:] = True
    h = np.einsum("ing,ng->i", A, rng.normal(size=A.shape[1:]))
    group, C, _ = eliminated(A.copy(), h.copy(), free)
    order, wanted, gaps = plain(A, h, free)
    assert np.array_equal(np.flatnonzero(~group.redundant), np.sort(order))
    assert np.allclose(C, wanted, rtol=0, atol=1e-9) and np.allclose(-group.independent.gap, gaps, atol=1e-9)
    # forces of the given rows, the least that do: what the pseudoinverse says
    S = np.linalg.pinv(A.reshape(len(A), -1).T) @ wanted.T
    assert np.allclose(group.shares, S, rtol=0, atol=1e-9 * max(1.0, np.abs(S).max()))


@pytest.mark.parametrize("m", [0, 3])
def test_rows_of_which_none_can_be_eliminated(m):
    """All of them are left out, where every component is prescribed; no rows are none."""
    A, free = rows(np.random.default_rng(1), m, np.ones(m))
    free[:] = False
    group, C, _ = eliminated(A, np.ones(m), free)
    assert len(C) == 0 and group.redundant.all() and group.shares.shape == (m, 0)


# -- two-pass ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("copies", [2, 3])
@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_equal_rows_have_equal_forces(copies, scale):
    """Contactors that firm equations make one, under any forces: equal parts, and the rest of each node's force is the equations'."""
    rng = np.random.default_rng(copies)
    n, g = copies + 1, 2
    normal = np.array([0.6, 0.8])
    A = np.zeros((2 * copies - 2 + copies, n, g))
    for i in range(1, copies):
        for c in range(g):
            A[2 * (i - 1) + c, [0, i], c] = scale * np.array([-1.0, 1.0])
    own = np.arange(2 * copies - 2, len(A))
    A[own, np.arange(copies)] = normal
    A[own, copies] = -normal
    rank = np.where(np.isin(np.arange(len(A)), own), Rank.WITHIN, Rank.FIRM)
    group = _eliminate(A.copy(), np.zeros(len(A)), np.ones((n, g), dtype=bool), np.arange(n), np.arange(len(A)), rank)
    lam = group.shares @ rng.normal(size=len(group.independent))
    assert lam[own] == pytest.approx(np.full(copies, lam[own].mean()), rel=1e-10)
    rows = np.zeros((len(group.independent), n, g))
    rows[np.arange(len(rows)), group.independent.node] = group.independent.direction
    np.add.at(rows, (group.independent.row, group.independent.followed), -group.independent.coefficients)
    assert np.einsum("mk,mng->kng", group.shares, A) == pytest.approx(rows, abs=1e-12)


@pytest.mark.long
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


@pytest.mark.parametrize("n", [(8, 6), (16, 12), (20, 20), (24, 14)])
def test_two_pass_of_pressed_discs(n):
    """Two-pass on a curved contact, whose rows depend on each other only nearly: what is left out and does not touch is open."""
    forces = []
    for passes in (2, 1):
        b = blocks(COMM, "triangle", *n, gap=0.02, overhang=0.5, pose=lambda x: x + np.array([0.0, 0.1]) * (x[:, :1] - 0.5) ** 2)
        contacts = [uem.Contact(b.high, b.low), uem.Contact(b.low, b.high)][:passes]
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0, -0.03])]
        run(uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=contacts))
        forces.append(sum(sign * c.resultant().force[1] for sign, c in zip((1, -1), contacts)))
        for c in contacts:
            complementary(c, 1e-12, 1e-12)
    # a contactor on a bend of the target has two lawful places
    assert forces[0] == pytest.approx(forces[1], rel=1e-5)


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


@pytest.mark.parametrize("up", [True, False])
def test_stack_of_thirty(up):
    """However many layers lie upon each other, all are compressed alike."""
    cell, layers = "quadrilateral", 30
    bodies = [box(cell, [0.0, float(k)], [1.0, k + 1.0], [2, 1]) for k in range(layers)]
    s = scene(COMM, cell, bodies)
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    low, high = ([s.tag(f"{k}{e}", k, at(1, float(k + e))) for k in range(layers)] for e in (0, 1))
    contacts = [uem.Contact(low[k + 1], high[k]) if up else uem.Contact(high[k], low[k + 1]) for k in range(layers - 1)]
    bcs = [*clamp(V, low[0], 1), *clamp(V, high[-1], 1, value=-0.01 * layers)]
    for k in range(layers):
        for end in (0.0, 1.0):
            bcs += clamp(V, s.tag("side", k, at(0, end)), 0)
    problem = uem.UnitedProblem(linear(u, 1.0), u, bcs=bcs, contacts=contacts)
    run(problem)
    assert highest(COMM, np.abs(problem.config.displacement[:, 1] + 0.01 * problem.config.x[:, 1] / 0.99)) < 1e-12
    for contact in contacts[:: layers // 3]:
        assert abs(contact.resultant().force[1]) == pytest.approx(0.01 * M, rel=1e-9)


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


@pytest.mark.parametrize("in_cone", [True, False])
@pytest.mark.parametrize("seed", range(3))
def test_forces_of_dependent_rows_do_not_pull(in_cone, seed):
    """A rigid line presses nodes with more contactors than nodes: forces push and balance, or the rest lifts contactors off."""
    rng, n = np.random.default_rng(seed), 5
    x = np.linspace(0.0, n - 1.0, 3 * (n - 1) + 1)
    weight = np.maximum(0.0, 1.0 - np.abs(x[:, None] - np.arange(n)))
    A = np.zeros((len(x), len(x) + n, 2))
    A[np.arange(len(x)), np.arange(len(x)), 1], A[:, len(x) :, 1] = 1.0, -weight
    free = np.repeat(np.arange(len(x) + n) >= len(x), 2).reshape(-1, 2)
    every = np.ones(len(x), bool)
    group = _eliminate(A.copy(), np.zeros(len(x)), free, np.arange(len(x) + n), np.arange(len(x)), None, every)
    assert group.redundant.sum() == len(x) - n
    least = np.zeros(len(x))
    while least.min() >= 0.0:
        # loads for which the least norm pulls
        loads = weight.T @ np.where(rng.random(len(x)) < 0.3, rng.random(len(x)), 0.0) if in_cone else rng.normal(size=n)
        least = np.linalg.pinv(weight.T) @ loads
    mu = np.linalg.lstsq(group.shares, least, rcond=None)[0]
    lam = group.forces(mu, np.zeros(len(x)))
    left = weight.T @ np.maximum(lam, 0.0) - loads
    if in_cone:
        assert lam.min() >= -1e-14 and np.abs(left).max() < 1e-13
        # one that is left out and penetrates replaces another, without which the rest bears the same loads and is independent of it
        i = np.flatnonzero(group.redundant)[seed % group.redundant.sum()]
        j = np.flatnonzero(group.forces(mu, np.where(np.arange(len(x)) == i, -1.0, 0.0)) < -1e-12)
        rest = np.append(np.setdiff1d(np.flatnonzero(~group.redundant), j), i)
        assert len(j) == 1 and np.linalg.matrix_rank(weight[rest]) == n
        others = weight[np.delete(np.arange(len(x)), j)].T
        assert np.linalg.norm(others @ least_squares(others, loads) - loads) < 1e-12
    else:
        # the loads that are left lift off the contactors that pull, and move none with a force
        opens = weight @ left
        assert (opens[lam < -1e-12] > 1e-12).all() and (lam < -1e-12).any()
        assert np.abs(opens[lam > 1e-12]).max() < 1e-12 and opens.min() > -1e-12
