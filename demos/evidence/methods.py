"""Every method by its name, as a problem with the arguments, steps and results of ``UnitedProblem``."""

from __future__ import annotations

import importlib.util
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import LinearOperator, eigsh, splu

import uem_dolfinx as uem
from evidence.lagrange import LagrangeSystem
from evidence.penalty import NodePoints, PenaltySystem, SurfacePoints

if TYPE_CHECKING:
    from collections.abc import Iterable

    import ufl
    from dolfinx import fem
    from petsc4py import PETSc

#: Every method, the package itself first.
METHODS = ("united", "mortar", "penalty", "penalty_surface", "lagrange", "augmented", "barrier")
#: The package's own, by what unites: nodes on facets, or integrals over both surfaces.
OWN = ("united", "mortar")
#: Those that need a number.
NEED_PARAMETER = ("penalty", "penalty_surface", "augmented", "barrier")
#: Those that know friction.
RUB = ("united", "mortar", "penalty", "augmented")
#: Overlap at which Uzawa's multipliers are good enough, as part of the model's size.
UZAWA_OVERLAP = 1e-9
#: Linear solves of a step: every update of the multipliers takes one or more.
MOST_UZAWA_ITERATIONS = 100
MOST_BARRIER_ITERATIONS = 100


def available(method: str) -> bool:
    """Whether what the method needs is installed."""
    return method != "barrier" or importlib.util.find_spec("ipctk") is not None


def create(method: str, F: ufl.Form, u: fem.Function, *, parameter: float | None = None, **options: Any) -> uem.UnitedProblem:
    """A problem that reaches contact by ``method``.

    Args:
        method: one of ``METHODS``.
        F: as for ``UnitedProblem``.
        u: likewise.
        parameter: stiffness of the springs, a pressure per length (penalty, penalty_surface, augmented); distance at which the
            barrier begins, a length (barrier).
        options: as for ``UnitedProblem``.
    """
    if method not in METHODS:
        raise ValueError(f"'{method}' is not known here: expected one of {', '.join(METHODS)}")
    if (method in NEED_PARAMETER) != (parameter is not None):
        raise ValueError(f"{method} {'needs a parameter' if parameter is None else 'has no parameter'}")
    if method == "mortar":
        # scenes make their contacts for all methods alike
        for contact in options.get("contacts", ()):
            contact.coupling = "mortar"
    if method in OWN:
        return uem.UnitedProblem(F, u, **options)
    if method == "lagrange":
        return uem.UnitedProblem(F, u, method=LagrangeSystem, **options)
    tags = [contact.contactor for contact in options.get("contacts", ())]
    if method == "barrier":
        from evidence.barrier import BarrierSystem

        options.setdefault("max_iterations", MOST_BARRIER_ITERATIONS)
        method_of = partial(BarrierSystem, contacts=options.get("contacts", ()), distance=parameter)
        return uem.UnitedProblem(F, u, method=method_of, **options)
    rough = [contact.friction for contact in options.get("contacts", ())]
    for contact in options.get("contacts", ()):
        # springs have friction of their own
        contact.friction = 0.0
    system = partial(
        PenaltySystem, tags=tags, stiffness=parameter, friction=rough,
        points=SurfacePoints if method == "penalty_surface" else NodePoints,
    )  # fmt: skip
    if method == "augmented":
        options.setdefault("max_iterations", MOST_UZAWA_ITERATIONS)
        system = partial(system, overlap=UZAWA_OVERLAP)
    return uem.UnitedProblem(F, u, method=system, **options)


def counts(steps: Iterable[uem.LoadStep]) -> tuple[int, int]:
    """Newton iterations and linear iterations of load steps."""
    histories = [step.iterations for step in steps]
    return sum(len(h) - 1 for h in histories), sum(i.linear_iterations for h in histories for i in h)


def condition_number(problem: uem.UnitedProblem) -> float:
    """Largest over smallest magnitude of the eigenvalues of the last linear system (serial)."""
    largest, smallest = extreme_eigenvalues(problem)
    return largest / smallest


def extreme_eigenvalues(problem: uem.UnitedProblem) -> tuple[float, float]:
    """Largest and smallest magnitude of the eigenvalues of the last linear system (serial).

    Idle unknowns are left out; the equations of a saddle point are scaled by the mean diagonal of K.
    """
    system = problem.system
    A = _sparse(system.saddle if isinstance(system, LagrangeSystem) else system.solver.A)
    idle = np.asarray(np.abs(A - diags(A.diagonal())).sum(axis=1)).ravel() == 0
    A = A[~idle][:, ~idle].tocsc()
    solver = splu(A)
    return _largest(A), 1 / _largest(LinearOperator(A.shape, matvec=solver.solve))


def largest_without_contact(problem: uem.UnitedProblem) -> float:
    """Largest eigenvalue of the last tangent of the bodies alone (serial)."""
    return _largest(_sparse(problem.system.forces.tangent.K))


def _sparse(matrix: PETSc.Mat) -> csr_matrix:
    indptr, columns, values = matrix.getValuesCSR()
    return csr_matrix((values, columns, indptr), shape=matrix.getSize())


def _largest(A: csr_matrix | LinearOperator) -> float:
    """Largest magnitude of the eigenvalues."""
    start = np.random.default_rng(0).standard_normal(A.shape[0])
    return float(abs(eigsh(A, k=1, which="LM", return_eigenvectors=False, v0=start, tol=1e-6)[0]))
