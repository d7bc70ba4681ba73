"""Bodies whose contactors are massless.

Two tests to read first: ``test_bodies_keep_what_they_weigh`` (mass, centre and inertia of every body without its contactors'
mass, for all cells, degrees and kinds of mass) and ``test_bar_hits_wall`` (what massless contactors are for: energy, momentum and
contact force of an impact with an exact solution).
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import CELLS, at, box, gathered_matrix, highest, linear, lowest, modulus, scene
from mass_scenes import BUILD, COMM, KINDS, block, dimension, make, places, space
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import fsolve, linprog

import uem_dolfinx as uem
from uem_dolfinx import forms


def gathered(mass, values):
    """Nodal values of a P1 or P2 space on all ranks, sorted by place: places and values (collective)."""
    parts = mass.config.comm.allgather((places(mass), values))
    X, v = (np.concatenate(part) for part in zip(*parts))
    order = np.lexsort(np.round(X, 9).T)
    return X[order], v[order]


# -- massless contactors -----------------------------------------------------------------------------------------------


def facing(mass, axis, value):
    """Owned nodes in a plane."""
    return np.flatnonzero(at(axis, value)(places(mass)))


def is_without(mass, nodes, before):
    """Assert that rows and columns of owned nodes are zero and the others positive and symmetric (collective)."""
    g = mass.config.gdim
    D = gathered_matrix(mass.M)
    first = mass.M.getOwnershipRange()[0]
    rows = np.concatenate(COMM.allgather(first + (g * nodes[:, None] + np.arange(g)).ravel()))
    assert not D[rows].any() and not D[:, rows].any()
    assert np.abs(D - D.T).max() <= 1e-15 * np.abs(D).max()
    kept, E = np.setdiff1d(np.arange(len(D)), rows), gathered_matrix(before.M)
    for c in range(g):
        heavy = kept[(kept % g == c) & (np.diag(E)[kept] > 0)]
        old, new = (A[np.ix_(heavy, heavy)] for A in (E, D))
        assert (np.diag(new) >= 0.5 * np.diag(old) * (1 - 1e-12)).all()
        # as definite as it was, on the scale of the nodal masses
        scale = np.sqrt(np.outer(np.diag(old), np.diag(old)))
        assert np.linalg.eigvalsh(new / scale)[0] >= 0.5 * np.linalg.eigvalsh(old / scale)[0] * (1 - 1e-12)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", [*CELLS[:3], pytest.param(CELLS[3], marks=pytest.mark.slow)])
def test_bodies_keep_what_they_weigh(cell, degree, kind):
    """Two bodies lose the mass of the surfaces that face each other: what rigid motions feel of each is the same to rounding."""
    g = dimension(cell)
    n = 5 if degree == 1 else 3
    low = box(cell, [0.0] * g, [1.0] * g, [n] * g)
    high = box(cell, [0.2] * (g - 1) + [1.0], [1.2] * (g - 1) + [3.0], [n] * (g - 1) + [n + 2])
    before = make(kind, space(scene(COMM, cell, [low, high]), degree))
    nodes = facing(before, g - 1, 1.0)
    after = before.without(nodes)
    R, S = before.rigid(), after.rigid()
    assert R.shape[0] == 2
    for b in range(2):
        assert np.abs(R[b] - S[b]).max() < 1e-12 * np.abs(R[b]).max()
    assert after.total == pytest.approx(before.total, rel=1e-12) and after.centre == pytest.approx(before.centre, rel=1e-12)
    assert after.diagonal == before.diagonal and after.M.getSizes() == before.M.getSizes()
    is_without(after, nodes, before)
    assert after.without(nodes) is after


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_linear_velocities_keep_energy_and_momentum(cell, kind):
    """The matrices themselves, for velocities that stretch and turn a body."""
    g = dimension(cell)
    before = make(kind, block(cell, 6, pose=lambda x: x + 0.05 * np.sin(4 * x[:, ::-1])))
    after = before.without(np.flatnonzero(places(before).sum(axis=1) < 0.4))
    rng = np.random.default_rng(3)
    G, shift = rng.normal(size=(g, g)), rng.normal(size=g)
    v = np.concatenate(COMM.allgather(places(before) @ G + shift))
    results = []
    for mass in (before, after):
        p = (gathered_matrix(mass.M) @ v.ravel()).reshape(-1, g)
        results.append([*p.sum(axis=0), (p * v).sum()])
    assert results[0] == pytest.approx(results[1], rel=1e-12)


def test_slow_reference():
    """Factors 1 + p(X) of the nodes, found by a general solver for nonlinear equations in plain monomials."""
    before = uem.consistent_mass(block("triangle", 8, size=[2.0, 1.0]), 1.5)
    nodes = facing(before, 1, 0.0)
    after = before.without(nodes)
    X = np.concatenate(COMM.allgather(places(before)))
    M, new = (gathered_matrix(m.M)[::2, ::2] for m in (before, after))
    kept = X[:, 1] > 1e-9
    x = np.column_stack([np.ones(len(X)), X - [1.0, 0.5]])
    a, b = np.triu_indices(3)

    def moments(s):
        return ((s[:, None] * x).T @ M @ (s[:, None] * x))[a, b]

    whole = moments(np.ones(len(X)))
    alpha = fsolve(lambda c: moments(kept * (1 + x[:, a] * x[:, b] @ c)) - whole, np.zeros(6), xtol=1e-13)
    s = kept * (1 + x[:, a] * x[:, b] @ alpha)
    assert s[kept].min() > np.sqrt(0.5)
    assert np.abs(new - s[:, None] * M * s).max() < 1e-10 * M.max()


def possible(mass, kept):
    """Whether nodal masses of at least ``0.5`` of theirs can have the moments of all: a linear program (collective)."""
    X, m = gathered(mass, np.column_stack([mass.of_nodes[:, 0], kept]))
    x = np.column_stack([np.ones(len(X)), X - X.mean(axis=0)])
    a, b = np.triu_indices(x.shape[1])
    w, kept = m[:, 0], m[:, 1] > 0
    if not kept.any():
        return False
    bounds = np.column_stack([0.5 * w[kept], np.full(kept.sum(), np.inf)])
    phi = x[:, a] * x[:, b]
    return linprog(np.zeros(kept.sum()), A_eq=phi[kept].T, b_eq=w @ phi, bounds=bounds, method="highs").status == 0


@pytest.mark.parametrize("everywhere", [False, True])
@pytest.mark.parametrize("cell", CELLS)
def test_refused_only_where_impossible(cell, everywhere):
    """From coarse meshes to fine ones: nodal masses are found wherever there are any, and else the body is named."""
    outcomes, clipped = set(), False
    for n in range(1, 9):
        before = uem.lumped_mass(block(cell, n, size=[1.0] * dimension(cell)), 1.0)
        X = places(before)
        bare = (np.minimum(X, 1 - X) < 1e-9).any(axis=1) if everywhere else X[:, -1] < 1e-9
        feasible = possible(before, ~bare)
        outcomes.add(feasible)
        if not feasible:
            with pytest.raises(uem.MassError, match=r"body with its middle at \(0.5, 0.5.* are too few"):
                before.without(np.flatnonzero(bare))
            continue
        after = before.without(np.flatnonzero(bare))
        assert np.abs(after.rigid() - before.rigid()).max() < 1e-12
        ratio = lowest(COMM, (after.of_nodes / before.of_nodes)[~bare])
        assert ratio >= 0.5 * (1 - 1e-12)
        clipped = clipped or ratio < 0.5 + 1e-12
    assert outcomes == {False, True} and clipped


@pytest.mark.parametrize(("make", "between"), [(uem.consistent_mass, 7), (uem.lumped_mass, 6)])
@pytest.mark.parametrize("cell", CELLS)
def test_layers_that_the_error_asks_for(cell, make, between):
    """As many layers as it names are enough, behind one surface of contactors and between two."""
    g = dimension(cell)
    for layers, ends in ((5, (0.0,)), (between, (0.0, 1.0))):
        s = scene(COMM, cell, [box(cell, [0.0] * g, [1.0] * g, [2] * (g - 1) + [layers])])
        before = make(space(s), 1.0)
        bare = np.concatenate([facing(before, g - 1, end) for end in ends])
        after = before.without(bare)
        assert np.abs(after.rigid() - before.rigid()).max() < 1e-12
        assert highest(COMM, after.of_nodes[bare]) == 0.0
    fewer = make(space(scene(COMM, cell, [box(cell, [0.0] * g, [1.0] * g, [2] * g)])), 1.0)
    with pytest.raises(
        uem.MassError, match=r"five layers of cells of degree 1, or between two contactor surfaces to seven \(six"
    ):
        fewer.without(np.concatenate([facing(fewer, g - 1, end) for end in (0.0, 1.0)]))


def test_bodies_do_not_exchange_mass():
    """The body without contactors is left alone to the last bit; a massless body as well."""
    cell = "triangle"
    bodies = [box(cell, [0.0, y], [1.0, y + 0.9], [6, 6]) for y in (0.0, 1.0, 2.0)]
    s = scene(COMM, cell, bodies)
    before = uem.lumped_mass(space(s), modulus(s, 1.0, 2.0, 0.0))
    after = before.without(np.concatenate([facing(before, 1, 0.0), facing(before, 1, 2.0)]))
    y = places(before)[:, 1]
    assert highest(COMM, np.abs(after.of_nodes - before.of_nodes)[y > 0.95]) == 0.0
    assert highest(COMM, np.abs(after.of_nodes - before.of_nodes)[y < 0.95]) > 0.0
    assert highest(COMM, after.of_nodes[y > 1.95]) == 0.0
    R, S = before.rigid(), after.rigid()
    assert np.abs(R - S).max() < 1e-13 and sorted(R[:, 0, 0]) == pytest.approx([0.0, 0.9, 1.8], abs=1e-13)
    # the massless body's nodes need nothing
    assert before.without(facing(before, 1, 2.0)) is before


def test_contactors_one_after_the_other():
    """Surfaces that lose their mass one after the other: both are massless, and the body still weighs the same."""
    before = uem.consistent_mass(block("hexahedron", 6), 1.0)
    low, high = facing(before, 2, 0.0), facing(before, 2, 1.0)
    after = before.without(low).without(high)
    assert np.abs(after.rigid() - before.rigid()).max() < 1e-13
    assert highest(COMM, after.of_nodes[np.union1d(low, high)]) == 0.0


@pytest.mark.parametrize("kind", ["lumped", "consistent"])
@pytest.mark.parametrize("size", [1e-9, 1e3])
def test_from_nanometres_to_kilometres(kind, size):
    """Lengths and densities in other units, and far from the origin: the same factors, and thin bodies as well."""
    rng = np.random.default_rng(1)
    turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]

    def matrices(scale, density, where):
        def pose(x):
            slim = np.column_stack([(x[:, :2] - 0.5) * (1 + 0.4 * np.sin(x[:, 2:] / 300)), x[:, 2] - 0.5])
            return scale * (slim @ turn.T + where)

        V = block("hexahedron", [2, 2, 12], size=[1.0, 2.0, 2000.0], pose=pose)
        before = BUILD[kind](V, density)
        along = (places(before) / scale - where) @ turn[:, 2]
        after = before.without(np.flatnonzero(along < -0.499))
        R, S = before.rigid(), after.rigid()
        unit = np.sqrt(np.diag(R[0]))
        assert np.abs((R - S)[0] / np.outer(unit, unit)).max() < 1e-10
        assert after.total == pytest.approx(before.total, rel=1e-12)
        return gathered_matrix(after.M) / (density * scale**3)

    one, other = matrices(1.0, 1.0, 0.0), matrices(size, 7e3 / size, 100.0)
    assert np.abs(one - other).max() < 1e-7 * one.max()


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("kind", KINDS)
def test_same_on_all_ranks(kind, degree):
    """What all ranks find together is what one finds alone."""
    results = []
    for comm in (COMM, MPI.COMM_SELF):
        before = make(kind, block("triangle", [6, 5], degree, comm=comm, shuffle=4))
        after = before.without(facing(before, 1, 1.0))
        results.append([*gathered(after, after.of_nodes), after.total, after.centre, after.rigid()])
    for together, alone in zip(*results):
        assert np.abs(together - alone).max() < 1e-12 * np.abs(alone).max()


# -- impact ------------------------------------------------------------------------------------------------------------


def impact(mass, K, courant, n):
    """A bar of length 10, modulus 900, density 1 flies onto a wall at speed 10: trapezoidal rule, contactors held while pressed.

    Returns:
        Contact pressure over time, in units of the duration of contact, last and first energy, and the mean velocity at the end.
    """
    L, c, v0 = 10.0, 30.0, 10.0
    h, full = L / n, 2 * L / c
    M, dt = gathered_matrix(mass.M), courant * h / c
    A = K + M * 4 / dt**2
    held = 2 * facing(mass, 0, 0.0)
    rest = np.setdiff1d(np.arange(len(K)), held)
    factors = cho_factor(A), cho_factor(A[np.ix_(rest, rest)])
    u, v, a = np.zeros(len(K)), np.tile([-v0, 0.0], len(K) // 2), np.zeros(len(K))
    first, pressure, touching = 0.5 * v @ M @ v, [], False
    for _ in range(round(1.3 * full / dt)):
        rhs = M @ (u * 4 / dt**2 + v * 4 / dt + a)
        free, pressed = cho_solve(factors[0], rhs), np.zeros(len(K))
        pressed[rest] = cho_solve(factors[1], rhs[rest])
        p = (A @ pressed - rhs)[held].sum() / h
        touching = p > 0 if touching else free[held].min() <= 0 and p > 0
        new = pressed if touching else free
        pressure.append(p if touching else 0.0)
        a_new = (new - u) * 4 / dt**2 - v * 4 / dt - a
        u, v, a = new, v + dt / 2 * (a + a_new), a_new
    x = np.tile([1.0, 0.0], len(K) // 2)
    last = 0.5 * (v @ M @ v + u @ K @ u)
    return np.arange(1, len(pressure) + 1) * dt / full, np.array(pressure), last / first, x @ M @ v / (x @ M @ x)


@pytest.mark.parametrize("courant", [1.0, 0.5])
@pytest.mark.parametrize("kind", ["lumped", "consistent"])
def test_bar_hits_wall(kind, courant):
    """Exact: a pressure of 300 from the first touch until the wave is back, rebound at the speed of impact, no energy lost."""
    n = 100
    V = block("quadrilateral", [n, 1], size=[10.0, 10.0 / n], comm=MPI.COMM_SELF)
    u = fem.Function(V)
    form = forms.form(ufl.derivative(linear(u, 900.0, 0.0), u))
    K = forms.create_matrix(form)
    forms.assemble_matrix(K, form)
    heavy = BUILD[kind](V, 1.0)
    light = heavy.without(facing(heavy, 0, 0.0))
    t, p, energy, speed = impact(light, gathered_matrix(K), courant, n)
    plateau = p[(t > 0.1) & (t < 0.9)]
    assert energy == pytest.approx(1.0, abs=1e-3) and speed == pytest.approx(10.0, rel=0.02)
    assert plateau.min() > 291 and plateau.max() < 309
    assert p[t > 1.02].max() == 0.0 and np.sum(p) * (t[1] - t[0]) == pytest.approx(300, rel=0.01)
    # contactors with mass gain energy at every touch
    assert impact(heavy, gathered_matrix(K), courant, n)[2] > 2.0


def test_refused_nodes():
    mass = uem.lumped_mass(block("triangle", 3), 1.0)
    n = mass.config.n_owned
    with pytest.raises(uem.MassError, match="none of the .* nodes that rank .* owns"):
        mass.without([n] if COMM.rank == COMM.size - 1 else [])
    with pytest.raises(uem.MassError, match="node -1 is none"):
        mass.without([-1])


def test_all_nodes_cannot_be_massless():
    """The second of two bodies is the one that is named."""
    bodies = [box("triangle", [x, 0.0], [x + 1.0, 2.0], [3, 6]) for x in (0.0, 4.0)]
    mass = uem.lumped_mass(space(scene(COMM, "triangle", bodies)), 1.0)
    with pytest.raises(uem.MassError, match=r"middle at \(4.5, 1\) .* mass of 28 contactors: its other 0 nodes") as error:
        mass.without(np.flatnonzero(places(mass)[:, 0] > 3.5))
    assert "refine the mesh" in str(error.value) and isinstance(error.value, ValueError)
