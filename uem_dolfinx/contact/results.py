"""Force and moment of nodal contact forces, and how far they are from balance."""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, cross_products


@dataclass(frozen=True)
class Resultant:
    """Force ``(gdim,)`` and moment about a point, ``(1,)`` in 2D and ``(3,)`` in 3D."""

    force: Array
    moment: Array


@dataclass(frozen=True)
class Balance:
    """Relative imbalance of the forces and of the moments of a pair."""

    force: float
    moment: float


def moments(x: Array, f: Array) -> Array:
    """Moments about the origin of forces ``f (n, gdim)`` at ``x``, ``(n, 1)`` in 2D and ``(n, 3)`` in 3D."""
    if x.shape[1] == 2:
        return (x[:, 0] * f[:, 1] - x[:, 1] * f[:, 0])[:, None]
    return cross_products(x, f)


def sum_up(comm: MPI.Comm, x: Array, f: Array) -> Resultant:
    """Resultant about the origin of the forces ``f (n, gdim)`` at ``x (n, gdim)`` of all ranks (collective)."""
    parts = comm.allgather((f.sum(axis=0), moments(x, f).sum(axis=0)))
    return Resultant(np.sum([p[0] for p in parts], axis=0), np.sum([p[1] for p in parts], axis=0))


def imbalance(comm: MPI.Comm, x: Array, f: Array) -> Balance:
    """Resultants of forces ``f (n, gdim)`` at ``x (n, gdim)`` relative to the sums of absolute forces and moments (collective)."""
    size = np.linalg.norm(f, axis=1)
    whole = sum_up(comm, x, f)
    all_f, all_m = (sum(part) for part in zip(*comm.allgather((size.sum(), (size * np.linalg.norm(x, axis=1)).sum()))))
    return Balance(
        float(np.linalg.norm(whole.force) / all_f) if all_f > 0 else 0.0,
        float(np.linalg.norm(whole.moment) / all_m) if all_m > 0 else 0.0,
    )
