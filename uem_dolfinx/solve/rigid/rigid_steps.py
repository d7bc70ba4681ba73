"""Motion of rigid bodies under their loads until contact holds them: a quadratic programme of 3 or 6 unknowns a body.

With pseudo-masses M that limit the motion of each body in a step, forces f, and gaps g with derivatives R, the increment v solves

    min 1/2 v' M v - f' v   subject to   g + R v >= 0        (Gauss' principle of least constraint, from rest)

and ``M v = f + R' lam`` with the contact forces ``lam >= 0``. If contact forces balance f, v vanishes for any M.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.dependent import least_squares
from uem_dolfinx.algebra.equations import NEGLIGIBLE
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.solve.rigid.rigid_motions import blocks_of, by_block

#: Gaps may stay negative by this part of the longest way, and forces smaller than this part of the largest are none.
#: [convention; the longest way; test_rigid_steps.py::test_conditions_of_the_minimum]
KEPT = 1e-10


def weighted(basis: Any, M: Array) -> Any:
    """Motions B, a sparse matrix ``(n, k)``, that span those of ``basis (n, k)``, with ``B' M B = 1`` for pseudo-masses ``M (n,)``."""
    from scipy.sparse import diags

    def make(blocks: Array) -> tuple[Array, Bools]:
        return np.linalg.inv(np.linalg.cholesky(blocks)).transpose(0, 2, 1), np.ones(blocks.shape[:2], dtype=bool)

    return (basis @ by_block(basis.T @ diags(M) @ basis, make)).tocsc()


def least_motion(comm: MPI.Comm, f: Array, B: Any, R: Any, g: Array, likely: Bools | None = None) -> tuple[Array, Array]:
    """Solve the programme for motions ``v = B x``; violated rows are added until there are no more (collective).

    Bodies that the rows do not couple are solved separately.

    Args:
        comm: communicator.
        f: forces, the same on all ranks ``(n,)``.
        B: motions that conditions leave open, from ``weighted``.
        R: derivatives of this rank's gaps, a sparse matrix ``(m, n)``.
        g: this rank's gaps ``(m,)``; negative gaps are closed to zero if possible.
        likely: mask of initial rows, e.g. rows with forces before ``(m,)``, or None.

    Returns:
        v ``(n,)``, the same on all ranks, and the contact forces of this rank's gaps ``(m,)``.
    """
    from scipy.sparse import vstack

    # in the coordinates x the solution is the point of a polyhedron nearest to p
    p = x = np.asarray(B.T @ f)
    G, length = (R @ B).tocsr(), _lengths(R)
    # coefficients of the size of rounding are removed, so that they do not couple bodies
    G.data[np.abs(G.data) <= NEGLIGIBLE * np.repeat(length, np.diff(G.indptr)) * _lengths(B.T)[G.indices]] = 0.0
    G.eliminate_zeros()
    idle, alike, been = _lengths(G) == 0, _same_columns(R), np.zeros(len(g), dtype=bool)
    # rows of all ranks in use, their gaps, owners, numbers, whether they are permanent, and forces
    rows, gaps, whose, lam = G[:0], g[:0], np.zeros((0, 3), np.int64), np.zeros(0)
    while True:
        v = B @ x
        own = whose[whose[:, 0] == comm.rank, 1]
        slack = np.where(idle, 0.0, g + R @ v)
        slack[own] = 0.0
        broken = np.flatnonzero(slack < -KEPT * np.abs(v).max(initial=0.0) * length)
        # of rows of the same bodies the most violated one
        broken = broken[np.argsort(slack[broken] / length[broken], kind="stable")]
        worst = broken[np.unique(alike[broken], return_index=True)[1]]
        if likely is not None:
            worst, likely = np.union1d(worst, np.flatnonzero(likely & ~idle)), None
        places = np.column_stack([np.full(len(worst), comm.rank), worst, been[worst]]).astype(np.int64)
        been[worst] = True
        new = comm.allgather((G[worst], g[worst], places))
        if not sum(len(h) for _, h, _ in new):
            push = np.zeros(len(g))
            push[own] = lam[whose[:, 0] == comm.rank]
            return v, push
        # rows without force are dropped, since the distance from p increases each time; rows that are added again become permanent
        kept = (lam > 0) | (whose[:, 2] > 0)
        rows = vstack([rows[kept], *(r for r, _, _ in new)]).tocsr()
        gaps = np.concatenate([gaps[kept], *(h for _, h, _ in new)])
        whose = np.concatenate([whose[kept], *(t for _, _, t in new)])
        # absolute values, since couplings by several rows must not cancel
        block, _, _ = blocks_of(abs(rows).T @ abs(rows))
        of, x, lam = block[rows.indices[rows.indptr[:-1]]], p.copy(), np.zeros(len(gaps))
        for b in np.unique(of):
            m, k = np.flatnonzero(of == b), np.flatnonzero(block == b)
            x[k], lam[m] = nearest_point(p[k], rows[m][:, k].toarray(), -gaps[m])


def _lengths(R: Any) -> Array:
    """Lengths of the rows of a sparse matrix ``(m, n)``: ``(m,)``."""
    return np.sqrt(np.asarray(R.multiply(R).sum(axis=1)).ravel())


def _same_columns(R: Any) -> Any:
    """A number for each row of a sparse matrix ``(m, n)``, equal for rows with the same first and last column ``(m,)``."""
    columns = np.append(R.indices, 0).astype(np.int64)
    return columns[R.indptr[:-1]] * R.shape[1] + columns[R.indptr[1:] - 1]


def nearest_point(p: Array, G: Array, h: Array) -> tuple[Array, Array]:
    """The point ``x = p + G' lam`` nearest to ``p (k,)`` with ``G x >= h``, ``G (m, k)``, and ``lam (m,)``.

    Least distance programming by bounded least squares (Lawson and Hanson, Solving Least Squares Problems, 1974, chapter 23).
    If rows contradict each other, their bounds are relaxed to values that the origin satisfies.
    """
    size = np.linalg.norm(G, axis=1)
    scale = float(np.linalg.norm(p)) + float(np.abs(h / size).max(initial=0.0))
    if scale == 0:
        return p, np.zeros(len(h))
    unit = G / size[:, None]
    for quick, bound in ((True, h), (False, h), (False, np.minimum(h, 0.0))):
        d = (bound / size - unit @ p) / scale
        lam = least_squares(np.vstack([unit.T, d]), np.append(np.zeros(len(p)), 1.0), quick)
        left = 1.0 - float(d @ lam)
        if left <= KEPT:
            continue
        lam *= scale / left
        # refined to rounding with the rows with forces, by least squares, since rounding may add more rows than there are unknowns
        i = np.flatnonzero(lam > KEPT * lam.max(initial=0.0))
        exact = np.zeros(len(lam))
        exact[i] = scale * np.linalg.lstsq(unit[i] @ unit[i].T, d[i], rcond=None)[0]
        x = p + unit.T @ exact
        slack = unit @ x - bound / size
        tight = not quick or (slack[i] <= KEPT * scale).all()
        if tight and (exact >= 0).all() and (slack >= -KEPT * scale).all():
            return x, exact / size
        if not quick:
            break
    return p + unit.T @ lam, lam / size
