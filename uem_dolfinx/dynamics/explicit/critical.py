"""Critical step of central differences: the highest frequency of the nodes with mass, with the surface condensed, by Lanczos' method."""

from __future__ import annotations

from collections.abc import Callable

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.parallel import reduced

#: Products with the stiffness of one estimate: Ritz values and the size of their residuals then bound the highest frequency to a few per
#: cent, less than the safety of steps takes off.
#: [bound; products; -]
PRODUCTS = 20


def highest_eigenvalue(apply: Callable[[Array], Array], mass: Array, start: Array, comm: MPI.Comm) -> float:
    """Estimate from above of the largest eigenvalue of ``M^-1/2 K M^-1/2`` (collective).

    Args:
        apply: K times a field ``(n,)`` (collective).
        mass: diagonal of M, zero at components that do not move ``(n,)``.
        start: of the Krylov space ``(n,)``, the same for every partition of the mesh.
        comm: of the fields.
    """
    root = np.where(mass > 0.0, 1.0 / np.sqrt(np.where(mass > 0.0, mass, 1.0)), 0.0)

    def dot(x: Array, y: Array) -> float:
        return float(reduced(comm, float(x @ y)))

    q = start * (mass > 0.0)
    q, before, beta = q / np.sqrt(dot(q, q)), np.zeros_like(q), 0.0
    alphas, betas = [], []
    for _ in range(PRODUCTS):
        r = root * apply(root * q)
        alphas.append(dot(q, r))
        r -= alphas[-1] * q + beta * before
        beta = np.sqrt(dot(r, r))
        betas.append(beta)
        if beta <= np.finfo(float).eps * max(map(abs, alphas)):
            break
        before, q = q, r / beta
    k = len(alphas)
    T = np.diag(alphas) + np.diag(betas[: k - 1], 1) + np.diag(betas[: k - 1], -1)
    values, vectors = np.linalg.eigh(T)
    return float(values[-1] + betas[-1] * abs(vectors[-1, -1]))
