"""Eigenvalues of symmetric matrices at both ends of their spectrum, and condition numbers (serial)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import LinearOperator, eigsh, splu

if TYPE_CHECKING:
    from petsc4py import PETSc


def condition_number(matrix: PETSc.Mat) -> float:
    """Largest over smallest magnitude of the eigenvalues."""
    largest, smallest = extreme_eigenvalues(matrix)
    return largest / smallest


def of_sparse(A: csr_matrix) -> float:
    """The condition number of a matrix of SciPy."""
    largest, smallest = _extremes(A)
    return largest / smallest


def extreme_eigenvalues(matrix: PETSc.Mat) -> tuple[float, float]:
    """Largest and smallest magnitude of the eigenvalues, without idle unknowns, which nothing but their own diagonal is left of."""
    return _extremes(_sparse(matrix))


def _extremes(A: csr_matrix) -> tuple[float, float]:
    idle = np.asarray(np.abs(A - diags(A.diagonal())).sum(axis=1)).ravel() == 0
    A = A[~idle][:, ~idle].tocsc()
    solver = splu(A)
    return _largest(A), 1 / _largest(LinearOperator(A.shape, matvec=solver.solve))


def largest_eigenvalue(matrix: PETSc.Mat) -> float:
    """Largest magnitude of the eigenvalues."""
    return _largest(_sparse(matrix))


def _sparse(matrix: PETSc.Mat) -> csr_matrix:
    indptr, columns, values = matrix.getValuesCSR()
    return csr_matrix((values, columns, indptr), shape=matrix.getSize())


def _largest(A: csr_matrix | LinearOperator) -> float:
    start = np.random.default_rng(0).standard_normal(A.shape[0])
    return float(abs(eigsh(A, k=1, which="LM", return_eigenvectors=False, v0=start, tol=1e-6)[0]))
