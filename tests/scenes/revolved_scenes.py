"""Bodies of revolution, for the tests of axisymmetry: blocks in half of a plane through the axis, which are cylinders and rings."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from benchmarks.scenes import Array, Body, at, box, clamp, scene
from dolfinx import fem

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


class Revolved:
    """Bodies in half of a plane through their axis, with a displacement.

    Args:
        bodies: nodes and cells.
        cell: kind of the cells.
        degree: of the displacement.
        how: see ``scene``.
    """

    def __init__(self, *bodies: Body, cell: str = "quadrilateral", degree: int = 1, **how: Any):
        self.cell, self.scene = cell, scene(COMM, cell, bodies, **how)
        self.mesh = uem.axisymmetric(self.scene.mesh)
        self.V = uem.function_space(self.mesh, degree, (2,))
        self.u = fem.Function(self.V, name="u")
        self.v = ufl.TestFunction(self.V)
        self.bcs: list[fem.DirichletBC] = []

    def side(self, axis: int, place: float, body: int = 0) -> uem.Tag:
        """Facets of a body along one coordinate."""
        return self.scene.tag(f"side {axis} {place} {body}", body, at(axis, place))

    def hold(self, axis: int, place: float, body: int = 0, component: int | None = None, value: float = 0.0) -> None:
        """Prescribe a component of a side, by default the one across."""
        self.bcs += clamp(self.V, self.side(axis, place, body), axis if component is None else component, value=value)

    def hold_axis(self, bodies: int = 1) -> None:
        """No radial displacement on the axis."""
        for body in range(bodies):
            self.hold(0, 0.0, body)

    def problem(self, F: ufl.Form, contacts: Sequence[uem.Contact] = (), **how: Any) -> uem.UnitedProblem:
        return uem.UnitedProblem(F, self.u, bcs=self.bcs, contacts=contacts, **how)

    @cached_property
    def X(self) -> Array:
        """Local nodes as drawn ``(n_local, 2)``."""
        return np.asarray(self.V.tabulate_dof_coordinates()[:, :2])

    @property
    def U(self) -> Array:
        """Their displacements ``(n_local, 2)``."""
        return np.asarray(self.u.x.array.reshape(-1, 2))


def rectangle(lo: Sequence[float], hi: Sequence[float], n: Sequence[int], cell: str = "quadrilateral") -> Body:
    """A cylinder from the axis, or a ring, of a rectangle in the half plane."""
    return box(cell, lo, hi, n)


def modulus(s: Revolved, *E: float) -> fem.Function:
    """A number for each body as a DG0 field."""
    f = fem.Function(compat.function_space(s.mesh, ("DG", 0)), name="E")
    f.x.array[compat.cell_dofs(f.function_space)[:, 0]] = np.array(E, dtype=float)[s.scene.body]
    return f
