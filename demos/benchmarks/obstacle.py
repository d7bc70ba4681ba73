"""The obstacle problem: a membrane over a ball, by all kinds of methods on the same matrices.

    minimise  1/2 w' K w    with  w_i >= psi_i  at every node,    K of linear cells, A_i the area of a node

Such contact of a scalar field with an obstacle in its own domain cannot be declared in the package, whose contacts are those of surfaces.
So this scene compares the methods themselves, each in a few lines on one K: elimination du = P dq + c with its active set;
multipliers; springs; a barrier whose potential is divided by five after each equilibrium; and the latent variable proximal point method
[B. Keith, T. M. Surowiec, Foundations of Computational Mathematics (2024)], condensed and as a saddle point.

With psi = sqrt(1/4 - r^2), continued by its tangent, the membrane lies on the ball for r < a and is b ln r beyond:

    b / a = -a / sqrt(1/4 - a^2),    b ln a = sqrt(1/4 - a^2)

``PYTHONPATH=demos python -m benchmarks.obstacle --json demos/benchmarks/report/obstacle.json`` takes about a minute on one rank.

Options:
    sizes: number of meshes
"""

from __future__ import annotations

from collections.abc import Callable
from time import perf_counter
from typing import Any

import numpy as np
import ufl
from common import arguments, comm, report
from dolfinx import fem, mesh
from scipy.optimize import brentq
from scipy.sparse import bmat, csc_matrix, diags, identity
from scipy.sparse.linalg import splu
from benchmarks import eigenvalues

from uem_dolfinx import compat, forms

Array = np.ndarray
#: Half of the width of the domain, of which a quarter is meshed.
WIDTH = 0.7
#: The obstacle is continued by its tangent from this radius on.
TANGENT = 0.45
#: Barriers and proximal steps end where the work of the forces over the gaps is this part of the energy.
SMALL = 1e-6
#: Each of them is solved until gaps, or forces, change by this part.
INNER = 1e-2
#: Springs of the latent variable are at most so much stiffer than the membrane's nodes.
STIFFEST = 1e4
#: Newton iterations in all.
MOST = 200


def exact() -> tuple[float, float]:
    """Radius a of the contact, and the factor b of the logarithm."""
    a = brentq(lambda r: r**2 * np.log(r) + 0.25 - r**2, 0.1, 0.45)
    return a, -(a**2) / np.sqrt(0.25 - a**2)


def obstacle(r: Array) -> Array:
    """Height of the obstacle."""
    at = np.sqrt(0.25 - TANGENT**2)
    return np.where(r < TANGENT, np.sqrt(np.maximum(0.25 - r**2, 0.0)), at - TANGENT / at * (r - TANGENT))


class Membrane:
    """Matrices of a quarter of the membrane on n x n x 2 cells, without the nodes of the rim (serial)."""

    def __init__(self, n: int):
        self.a, self.b = exact()
        self.mesh = mesh.create_rectangle(comm, [np.zeros(2), np.full(2, WIDTH)], [n, n])
        V = compat.function_space(self.mesh, 1)
        self.w, v = fem.Function(V), ufl.TestFunction(V)
        a = forms.form(ufl.inner(ufl.grad(ufl.TrialFunction(V)), ufl.grad(v)) * ufl.dx)
        matrix = forms.create_matrix(a)
        forms.assemble_matrix(matrix, a)
        indptr, columns, values = matrix.getValuesCSR()
        A = forms.assemble_array(V, forms.form(v * ufl.dx))
        # K is symmetric
        K = csc_matrix((values, columns, indptr), shape=matrix.getSize())
        X = V.tabulate_dof_coordinates()
        r = np.hypot(X[:, 0], X[:, 1])
        self.free = np.flatnonzero(X[:, :2].max(axis=1) < WIDTH * (1 - 1e-9))
        rim = np.setdiff1d(np.arange(len(X)), self.free)
        self.w.x.array[rim] = self.b * np.log(r[rim])
        self.K, self.A, self.psi = K[self.free][:, self.free], A[self.free], obstacle(r[self.free])
        self.load, self.h = -K[self.free][:, rim] @ self.w.x.array[rim], WIDTH / n
        x = ufl.SpatialCoordinate(self.mesh)
        r2 = x[0] ** 2 + x[1] ** 2
        slope = ufl.conditional(ufl.lt(r2, self.a**2), -1 / ufl.sqrt(abs(0.25 - r2)), self.b / r2) * x
        dx = ufl.dx(metadata={"quadrature_degree": 8})
        self._error = tuple(forms.form(ufl.inner(g, g) * dx) for g in (ufl.grad(self.w) - slope, slope))

    def error(self, w: Array) -> float:
        """Of a displacement, in the energy norm."""
        self.w.x.array[self.free] = w
        e, size = (forms.assemble_scalar(form, comm) for form in self._error)
        return float(np.sqrt(e / size))


#: A displacement, its forces, Newton iterations, and the last matrix.
Found = tuple[Array, Array, int, csc_matrix]


def solve(A: csc_matrix, b: Array) -> Array:
    """By a sparse factorisation."""
    return np.asarray(splu(A.tocsc()).solve(b))


def by_sets(m: Membrane, saddle: bool) -> Found:
    """Elimination, du = P dq + c, or multipliers; active nodes change until they push and others do not enter."""
    active, everywhere = m.psi > 0.0, identity(len(m.psi), format="csc")
    for k in range(1, MOST):
        P, c = everywhere[:, ~active], np.where(active, m.psi, 0.0)
        if saddle:
            s, n = m.K.diagonal().mean(), len(m.psi)
            B = s * everywhere[active]
            A = bmat([[m.K, B.T], [B, None]], format="csc")
            w = solve(A, np.concatenate([m.load, s * m.psi[active]]))[:n]
        else:
            A = (P.T @ m.K @ P).tocsc()
            w = c + P @ solve(A, P.T @ (m.load - m.K @ c))
        lam = m.K @ w - m.load
        now = np.where(active, lam > 0.0, w < m.psi)
        if (now == active).all():
            break
        active = now
    return w, np.where(active, lam, 0.0), k, A


def by_springs(m: Membrane, stiffness: float) -> Found:
    """Springs of a multiple of the tension over h^2."""
    inside, w = m.psi > 0.0, np.zeros(len(m.psi))
    for k in range(1, MOST):
        springs = stiffness / m.h**2 * m.A * inside
        A = (m.K + diags(springs)).tocsc()
        w = solve(A, m.load + springs * m.psi)
        if ((w < m.psi) == inside).all():
            break
        inside = w < m.psi
    return w, springs * (m.psi - w), k, A


def by_barrier(m: Membrane, first: float) -> Found:
    """The potential -mu A log(gap), from a first mu on; no step exceeds 0.9 of the distance to the obstacle."""
    w, mu, k = np.full(len(m.psi), 2 * m.psi.max()), first, 0
    while True:
        while k < MOST:
            k, gap = k + 1, w - m.psi
            A = (m.K + diags(mu * m.A / gap**2)).tocsc()
            dw = solve(A, m.load - m.K @ w + mu * m.A / gap)
            w = w + min(1.0, 0.9 / max(float((-dw / gap).max()), 1e-300)) * dw
            if np.abs(dw / gap).max() < INNER:
                break
        if mu * m.A.sum() < SMALL * (w @ m.K @ w) or k == MOST:
            return w, mu * m.A / (w - m.psi), k, A
        mu /= 5.0


def by_latent(m: Membrane, first: float, saddle: bool) -> Found:
    """Proximal steps from a first length on, each twice as long as the one before, with gap = exp(psi)."""
    w, latent, length, k, ended = np.zeros(len(m.psi)), np.zeros(len(m.psi)), first, 0, False
    mean = m.K.diagonal().mean()
    while not ended and k < MOST:
        before, fine = latent, INNER
        while k < MOST:
            gap, k = np.exp(latent), k + 1
            slope = np.maximum(gap, m.A / (length * STIFFEST * mean))
            off, lam, springs = w - m.psi - gap, m.A * (before - latent) / length, m.A / (length * slope)
            A = (m.K + diags(springs)).tocsc()
            dw = solve(A, m.load - m.K @ w + lam - springs * off)
            w, change = w + dw, (dw + off) / slope
            # where the gap opens its logarithm is exact
            latent = latent + np.where(change > 0.0, np.log1p(np.maximum(change, 0.0)), change)
            lam = m.A * (before - latent) / length
            if np.linalg.norm(m.K @ w - m.load - lam) < fine * np.linalg.norm(lam):
                ended = abs(lam) @ np.exp(latent) < SMALL * (w @ m.K @ w)
                if fine < INNER or not ended:
                    break
                # the last proximal step is solved to more digits
                fine = SMALL
        length *= 1.0 if ended else 2.0
    if saddle:
        s = length * mean / m.A.mean()
        A = bmat([[m.K, diags(s / length * m.A)], [diags(s / length * m.A), diags(-(s**2) / length * m.A * slope)]])
    return w, lam, k, A.tocsc()


#: Methods, with the parameters of which each row has the best.
METHODS: dict[str, tuple[Callable[..., Found], tuple[Any, ...]]] = {
    "united": (lambda m, p: by_sets(m, False), (None,)),
    "lagrange": (lambda m, p: by_sets(m, True), (None,)),
    "penalty": (by_springs, (1e0, 1e1, 1e2, 1e3)),
    "barrier": (by_barrier, (1e-3, 1e-2, 1e-1)),
    "proximal": (lambda m, p: by_latent(m, p, False), (1e0, 1e1, 1e2)),
    "proximal, saddle point": (lambda m, p: by_latent(m, p, True), (1e0, 1e1, 1e2)),
}


def row(m: Membrane, name: str) -> dict[str, Any]:
    """Errors, iterations, seconds and the condition number of a method, with fewest iterations among parameters that err least."""
    method, parameters = METHODS[name]
    found = []
    for p in parameters:
        start = perf_counter()
        w, lam, k, A = method(m, p)
        seconds = perf_counter() - start
        force = abs(lam.sum() / (-m.b * np.pi / 2) - 1)
        found.append(
            {
                "unknowns": len(m.psi),
                "method": name,
                "parameter": p,
                "error_energy": m.error(w),
                "error_force": force,
                "iterations": k,
            }
            | {"seconds": seconds, "condition": eigenvalues.of_sparse(A)}
        )
    least = min(max(one["error_energy"], one["error_force"]) for one in found)
    return min(
        (one for one in found if max(one["error_energy"], one["error_force"]) <= 1.1 * least), key=lambda one: one["iterations"]
    )


if __name__ == "__main__":
    args = arguments(__doc__, sizes=4)
    if comm.size > 1:
        raise SystemExit("the matrices are SciPy's, on one rank: run this without mpirun")
    rows = []
    for n in (16, 32, 64, 128)[: args.sizes]:
        membrane = Membrane(n)
        for name in METHODS:
            rows.append(row(membrane, name))
            print(rows[-1], flush=True)
    report(args, {"rows": rows})
