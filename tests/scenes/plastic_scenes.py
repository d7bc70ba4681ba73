"""Bodies of von Mises material for the tests of the law, of limit loads and of the return mapping."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import Scene, at, box, clamp, highest, run, scene
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.materials.elastic import differentiate

E, NU, FY, H = 200.0, 0.3, 0.4, 15.0
MU = E / (2 * (1 + NU))
#: Back stress over plastic strain.
TABLE = [(0.0, 0.0), (0.002, 0.6 * FY), (0.01, 1.4 * FY), (0.05, 2.0 * FY)]


# -- scenes ------------------------------------------------------------------------------------------------------------


def block(comm: MPI.Comm, cell: str, n: int = 2, degree: int = 1, **how: Any) -> tuple[Scene, fem.Function]:
    """Unit square or cube with a displacement."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    s = scene(comm, cell, [box(cell, [0.0] * g, [1.0] * g, [n] * g)], **how)
    return s, fem.Function(compat.function_space(s.mesh, degree, (g,)), name="u")


def tube(
    comm: MPI.Comm, cell: str, n: int, degree: int, opening: float, law: Callable[..., uem.VonMises], steps: int
) -> tuple[float, list[uem.LoadStep]]:
    """Inner pressure, per area as drawn, of a perfectly plastic tube in plane strain, b = 2 a, after a has grown by ``opening``."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3

    def bent(X: np.ndarray) -> np.ndarray:
        angle = np.pi / 2 * X[:, 1]
        return np.column_stack([(1 + X[:, 0]) * np.cos(angle), (1 + X[:, 0]) * np.sin(angle), X[:, 2:]])

    s = scene(comm, cell, [box(cell, [0.0] * g, [1.0, 1.0, 0.25][:g], [n, 2 * n, 1][:g])], pose=bent)
    V = compat.function_space(s.mesh, degree, (g,))
    u, opened = fem.Function(V), fem.Function(V)
    X = V.tabulate_dof_coordinates()[:, :2]
    opened.x.array.reshape(-1, g)[:, :2] = opening * X / np.linalg.norm(X, axis=1, keepdims=True)
    bcs = clamp(V, s.tag("x", 0, at(1, 0.0)), 1) + clamp(V, s.tag("y", 0, at(1, 1.0)), 0)
    for z in (0.0, 0.25) if g == 3 else ():
        bcs += clamp(V, s.tag("end", 0, at(2, z)), 2)
    bcs.append(fem.dirichletbc(opened, fem.locate_dofs_topological(V, g - 1, s.tag("inner", 0, at(0, 0.0)).entities)))
    material = law(u, 1000.0, NU, 1.0, kind="3d" if g == 3 else "plane_strain")
    problem = uem.UnitedProblem(
        material.residual(ufl.TestFunction(V)), u, bcs=bcs, materials=[material], petsc_options_prefix="t_"
    )
    taken = run(problem, steps)
    return reaction(problem) / (opening * np.pi / 2 * (0.25 if g == 3 else 1.0)), taken


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


def to_flow(material: Any, bend: Callable[[float], None]) -> None:
    """Take a law to a state of flow after a history of large strains and turns, by what bends the body by a size."""
    for size in (0.2, 0.3):
        bend(size)
        material.update()
        material.commit()
    bend(0.35)
    material.update()


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


def tangent_in_flow(material: uem.VonMises, u: fem.Function) -> None:
    """Assert that the tangent is symmetric, and the derivative of the forces, in a state of flow."""
    V, comm = u.function_space, material.comm
    flowing = material._trial.peeq > material._committed()[1]
    assert comm.allreduce(int(flowing.sum())) > 0
    v, du = ufl.TestFunction(V), ufl.TrialFunction(V)
    differentiate([material])
    K = matrix(ufl.derivative(material.residual(v), u, du) + material.stiffness(du, v))
    x, y = K.createVecRight(), K.createVecRight()
    X = V.tabulate_dof_coordinates()[: V.dofmap.index_map.size_local, : len(u)]
    x.array[:], y.array[:] = np.cos(3 * X + 1).ravel(), np.sin(2 * X + 0.3 * X[:, ::-1]).ravel()
    assert y.dot(K * x) == pytest.approx(x.dot(K * y), rel=1e-11)
    direction, here, h = fem.Function(V), np.array(u.x.array), 1e-7
    direction.x.array[: len(x.array)] = x.array
    direction.x.scatter_forward()
    sides = []
    for sign in (1, -1):
        u.x.array[:] = here + sign * h * direction.x.array
        material.update()
        sides.append(vector(material.residual(v), V))
    slope, product = (sides[0] - sides[1]) / (2 * h), (K * x).array_r
    assert highest(comm, np.abs(slope - product)) < 2e-6 * highest(comm, np.abs(product))


# -- closed forms ------------------------------------------------------------------------------------------------------


class Masing:
    """Stress over strain in tension by Masing's rule, the plastic strain, and work.

    After a reversal the stress follows the virgin curve, twice as large, until the strain of the reversal before; there the older curve
    continues [Proc. 2nd Int. Congr. Applied Mechanics, Zurich (1926) 332-335].
    """

    def __init__(self, table: list[tuple[float, float]], stiffness: float = E, yield_stress: float = FY):
        p, back = np.transpose(table)
        stress = yield_stress + back
        self.stiffness, self.strain, self.stress, self.work, self.way = stiffness, 0.0, 0.0, 0.0, 0.0
        #: Bends of the virgin curve, which is constant at its end.
        self.bends = np.append(0.0, stress / stiffness + p), np.append(0.0, stress)
        #: Reversals ``(strain, stress)`` from which no loop has closed yet; the last one begins the present branch.
        self.open: list[tuple[float, float]] = []

    def to(self, strain: float) -> float:
        """Stress after a way in one direction."""
        way = np.sign(strain - self.strain)
        if way == -self.way:
            self.open.append((self.strain, self.stress))
        self.way = way
        while self.open:
            closes = self.open[-2][0] if len(self.open) > 1 else -self.open[-1][0]
            if way * (strain - closes) <= 0:
                break
            self._lead(closes)
            del self.open[-2:]
        self._lead(strain)
        return self.stress

    def _lead(self, strain: float) -> None:
        """Go on along the present branch, with the work of its straight parts."""
        (e, s), size = (self.open[-1], 2) if self.open else ((0.0, 0.0), 1)
        bends = e + size * np.concatenate([self.bends[0], -self.bends[0]])
        low, high = sorted((self.strain, strain))
        points = np.sort(np.concatenate([[low, high], bends[(bends > low) & (bends < high)]]))
        values = s + size * np.sign(points - e) * np.interp(abs(points - e) / size, *self.bends)
        self.work += self.way * float(((values[1:] + values[:-1]) / 2 * np.diff(points)).sum())
        self.strain, self.stress = strain, values[-1 if self.way > 0 else 0]

    @property
    def plastic(self) -> float:
        """Plastic strain."""
        return self.strain - self.stress / self.stiffness
