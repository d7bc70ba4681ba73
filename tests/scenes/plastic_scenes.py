"""Bodies of von Mises material for the tests of the law, of limit loads and of the return mapping."""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from helpers import Scene, box, highest, scene
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

E, NU, FY, H = 200.0, 0.3, 0.4, 15.0
MU = E / (2 * (1 + NU))


# -- scenes ------------------------------------------------------------------------------------------------------------


def block(comm: MPI.Comm, cell: str, n: int = 2, degree: int = 1, **how: Any) -> tuple[Scene, fem.Function]:
    """Unit square or cube with a displacement."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    s = scene(comm, cell, [box(cell, [0.0] * g, [1.0] * g, [n] * g)], **how)
    return s, fem.Function(compat.function_space(s.mesh, degree, (g,)), name="u")


def reaction(problem: uem.UnitedProblem) -> float:
    """Work of the internal forces on the present displacement."""
    problem.bodies.assemble()
    r = problem.bodies.residual.array_r
    return problem.comm.allreduce(float(r @ problem.u.x.array[: len(r)]))


def skewed(X: np.ndarray) -> np.ndarray:
    """A map that leaves no cell a parallelogram."""
    return X + 0.1 * np.sin(3 * X[:, ::-1] + X)


def deform(u: fem.Function, gradient: Any) -> None:
    """Homogeneous displacement."""
    g = u.function_space.mesh.geometry.dim
    u.x.array[:] = (u.function_space.tabulate_dof_coordinates()[:, :g] @ np.asarray(gradient).T).ravel()


def wiggle(u: fem.Function, size: float) -> None:
    """Smooth displacement that is not homogeneous."""
    g = u.function_space.mesh.geometry.dim
    X = u.function_space.tabulate_dof_coordinates()[:, :g]
    u.x.array[:] = size * np.stack([np.sin(2 * X[:, i] + i) * np.cos(X[:, (i + 1) % g]) for i in range(g)], axis=1).ravel()


def vector(form: ufl.Form, V: Any) -> np.ndarray:
    """Assembled owned entries."""
    b = compat.create_vector(V)
    forms.assemble_vector(b, forms.form(form))
    return np.array(b.array_r)


def matrix(form: ufl.Form) -> PETSc.Mat:
    """Assembled."""
    compiled = forms.form(form)
    A = forms.create_matrix(compiled)
    forms.assemble_matrix(A, compiled)
    return A


def spread(material: uem.VonMises, name: str) -> tuple[np.ndarray, float]:
    """Mean over this rank's points of a quadrature Function, and how far any point is from it."""
    f = getattr(material, name)
    values = material._points.read(f)
    mean = np.mean(f.function_space.mesh.comm.allgather(values.mean(axis=0)), axis=0)
    return mean, highest(material.comm, np.abs(values - mean))
