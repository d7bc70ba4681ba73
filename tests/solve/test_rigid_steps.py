"""The programme of rigid steps against its own conditions, without bodies, and on any number of ranks."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import block_diag, csr_matrix, eye

from uem_dolfinx.solve.rigid import rigid_steps
from uem_dolfinx.solve.rigid.rigid_steps import least_motion, nearest_point, weighted

COMM = MPI.COMM_WORLD


@given(st.integers(0, 2**31), st.integers(1, 9), st.integers(0, 40), st.sampled_from([1e-9, 1.0, 1e6]))
def test_conditions_of_the_minimum(seed, k, m, length):
    """Feasible, and the rest of the force is balanced by pushes of gaps that have closed; rows are spread over ranks at random."""
    rng = np.random.default_rng(seed)
    n = k + int(rng.integers(0, 4))
    Z = np.linalg.qr(rng.normal(size=(n, k)))[0]
    f, M = rng.normal(size=n), 10.0 ** rng.uniform(-2, 2, n) / length
    R, g = rng.normal(size=(m, n)), length * np.where(rng.random(m) < 0.3, 0.0, rng.random(m))
    own = rng.integers(0, COMM.size, m) == COMM.rank
    likely = (rng.random(m) < 0.5)[own] if rng.random() < 0.5 else None
    v, push = least_motion(COMM, f, weighted(csr_matrix(Z), M), csr_matrix(R[own]), g[own], likely)
    assert COMM.allgather(v.tobytes()) == [v.tobytes()] * COMM.size
    way = np.abs(v).max(initial=0.0)
    assert np.abs(v - Z @ (Z.T @ v)).max(initial=0.0) <= 1e-9 * way
    assert (g + R @ v >= -1e-8 * max(way, length)).all()
    # all ranks' pushes, so that an example fails on all of them
    pushes = np.zeros(m)
    pushes[own] = push
    pushes = COMM.allreduce(pushes)
    assert (pushes >= 0).all() and (pushes[g + R @ v > 1e-7 * max(way, length)] <= 1e-12 * np.linalg.norm(f)).all()
    left = Z.T @ (M * v - f - R.T @ pushes)
    assert np.linalg.norm(left) <= 1e-6 * (np.linalg.norm(f) + np.linalg.norm(Z.T @ (M * v)))


def test_rows_that_bear_nothing_go(monkeypatch):
    """However many rows are broken on the way, the point is computed of no more than those that bear, one more, and some that come back."""
    rng, sizes = np.random.default_rng(3), []
    monkeypatch.setattr(rigid_steps, "nearest_point", lambda p, G, h: sizes.append(len(h)) or nearest_point(p, G, h))
    k, m = 6, 300
    own = np.arange(m) % COMM.size == COMM.rank
    for _ in range(20):
        f, R, g = rng.normal(size=k), rng.normal(size=(m, k)), 0.1 * rng.random(m)
        least_motion(COMM, f, csr_matrix(np.eye(k)), csr_matrix(R[own]), g[own])
    assert len(sizes) > 60 and max(sizes) < 2 * k + COMM.size


def test_couplings_that_cancel():
    """A body on three feet whose loads are between them does not move, though sums of products of their rows vanish."""
    R, B = csr_matrix([[0.0, 1.0], [0.5, 1.0], [-0.5, 1.0]]), csr_matrix(np.eye(2))
    own = np.arange(3) % COMM.size == COMM.rank
    v, push = least_motion(COMM, np.array([0.1, -1.0]), B, R[own], np.zeros(own.sum()))
    assert np.abs(v).max() <= 1e-12 and COMM.allreduce(push.sum()) == pytest.approx(1.0)


def test_rows_across_all_motions():
    """A contactor in a corner has a row across the only motion that is open, which stops nothing but by rounding."""
    R, B = csr_matrix([[0.0, 1.0], [1.0, 2.7e-16]]), csr_matrix([[0.0], [4.6]])
    own = np.arange(2) % COMM.size == COMM.rank
    v, push = least_motion(COMM, np.array([0.0, -1.0]), B, R[own], np.array([0.0, -5e-17])[own])
    assert np.abs(v).max() <= 1e-12 and COMM.allreduce(push.sum()) == pytest.approx(1.0)


def test_rows_that_contradict_each_other():
    """An overlap on both sides cannot be cured: nothing moves against either, and what is free moves on."""
    p, G = np.array([0.5, 1.0]), np.array([[1.0, 0.0], [-1.0, 0.0]])
    x, lam = nearest_point(p, G, np.array([0.1, 0.1]))
    assert x == pytest.approx([0.0, 1.0], abs=1e-9) and (lam >= 0).all()
    # an overlap on one side is brought to zero
    assert nearest_point(np.zeros(2), G[:1], np.array([0.1]))[0] == pytest.approx([0.1, 0.0], abs=1e-12)


@pytest.mark.long
def test_bodies_apart_are_programmes_of_their_own(monkeypatch):
    """Bodies that push each other in pairs move as each pair would alone, and no programme has more unknowns than two bodies."""
    rng = np.random.default_rng(3)
    pairs = [(rng.normal(size=(20, 6)), rng.random(20), 100 * rng.normal(size=6)) for _ in range(50)]
    sizes = []
    monkeypatch.setattr(rigid_steps, "nearest_point", lambda p, *row: sizes.append(len(p)) or nearest_point(p, *row))

    def motion(some, comm):
        R, g, f = (
            block_diag([csr_matrix(p[0]) for p in some], "csr"),
            np.concatenate([p[1] for p in some]),
            np.concatenate([p[2] for p in some]),
        )
        own = np.flatnonzero(np.arange(len(g)) % comm.size == comm.rank)
        B = weighted(eye(len(f), format="csr"), np.ones(len(f)))
        return least_motion(comm, f, B, R[own], g[own])[0]

    together = motion(pairs, COMM).reshape(-1, 6)
    assert max(sizes) == 6
    for v, pair in zip(together, pairs):
        assert v == pytest.approx(motion([pair], MPI.COMM_SELF), abs=1e-9 * np.abs(v).max())


@pytest.mark.parametrize("seed", range(0, 40, 4))
def test_as_many_rows_as_unknowns_that_touch(seed):
    """At vertices, where as many rows bear as there are unknowns, nothing is driven in and no force is on an open gap."""
    rng = np.random.default_rng(seed)
    for _ in range(50):
        G, g, p = rng.normal(size=(20, 6)), rng.random(20), 100 * rng.normal(size=6)
        x, lam = nearest_point(p, G, -g)
        assert (g + G @ x >= -1e-9).all() and (lam >= 0).all()
        assert np.abs(lam * (g + G @ x)).max() <= 1e-7 and np.abs(p + G.T @ lam - x).max() <= 1e-10
