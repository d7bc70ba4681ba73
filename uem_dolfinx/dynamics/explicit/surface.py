"""Equilibrium of the surface with the contacts as they are, by a matrix of the surface alone that is factorised once.

The Newton loop of the united system then has nothing left to do but to check forces and gaps, unless the contact changes.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Bools
from uem_dolfinx.dynamics.explicit.surface_solver import SurfaceSolver, numbers
from uem_dolfinx.log import compiling

#: Solves with the kept matrix in one step, before Newton's method goes on with its own.
#: [convention; solves; test_explicit.py::test_how_long_a_factor_of_the_surface_serves]
MOST_SURFACE_SOLVES = 4
#: The kept matrix serves as long as Newton's method needs no more iterations after it.
#: [convention; iterations; test_explicit.py::test_how_long_a_factor_of_the_surface_serves]
ITERATIONS_OF_KEPT = 1


class Prediction:
    """Moves the surface of a problem with the equations of its last state (collective).

    Args:
        problem: a ``UnitedProblem``, whose nodes with mass are held while it is used.
        system: its united system, of which the surface is solved.
        massive: mask of the unknowns that are held, ghosts included ``(n,)``.

    Attributes:
        kept: whether the factorisation is of the present contact, and good enough.
    """

    def __init__(self, problem: Any, system: Any, massive: Bools):
        self.problem, self.system, self.kept = problem, system, False
        self._massive, self._solver = massive, SurfaceSolver(problem.bodies.unknowns, "uem_prediction_")
        #: State of the values of K whose columns at the surface are known.
        self._state = -1
        #: Writes the residual of the cells behind the surface; None if it is as well to write that of all.
        self._write: Callable[[PETSc.Vec], None] | None = None

    def learn(self, history: Any) -> None:
        """Take note of how much the Newton loop has had to do in a step."""
        self.kept = self.kept and len(history) <= ITERATIONS_OF_KEPT + 1 and not any(one.changed for one in history)

    def predict(self, start: Any) -> None:
        """Move nodes with mass to ``start (n,)``, ghosts included, and the surface from there into equilibrium with the last contact."""
        problem, bodies, system = self.problem, self.problem.bodies, self.system
        if system.rows is None:
            # the first step of a run that goes on
            bodies.update_tangent()
            system.rows_of_last()
        if not self.kept:
            self._prepare()
        u = np.array(start)
        compat.set_bc_values(u, bodies.bcs)
        bodies.u.x.array[:] = u
        bodies.u.x.scatter_forward()
        fine, before = self._assemble(), np.inf
        for _ in range(MOST_SURFACE_SOLVES):
            F = self._Q.transpose(system.residual())
            norm = F.norm()
            if not fine or norm >= before or norm <= problem.rtol * bodies.residual.norm():
                break
            dq, _ = self._solver.solve(-F)
            du, before = self._P.expand(dq), norm
            if bodies.linear:
                self._du.array[:] = du.array_r[self._light]
                change = du.duplicate()
                self._K.mult(self._du, change)
                bodies.move(du, change)
            else:
                bodies.move(du)
                fine = self._assemble()
        if not fine:
            # Newton's method has a line search
            bodies.u.x.array[:] = problem.committed

    def _assemble(self) -> bool:
        """Assemble the forces at the surface at least; whether they are finite on all ranks (collective)."""
        bodies = self.problem.bodies
        return bool(bodies.assemble_once() if self._write is None else bodies.assemble(self._write))

    def _prepare(self) -> None:
        """Factorise ``Q'KP`` of the surface's unknowns, and find what their motion changes (collective)."""
        system, bodies = self.system, self.problem.bodies
        self._P, self._Q = system.rows.frictionless, system.rows.test
        self._solver.set_operator(self._P, K := bodies.update_tangent(), None, self._Q)
        space, self.kept = bodies.unknowns, True
        if bodies.linear and self._state != K.stateGet():
            self._state, self._light = K.stateGet(), np.flatnonzero(bodies.free_rows)
            self._K = K.createSubMatrix(numbers(space, np.arange(bodies.free_rows.size)), numbers(space, self._light))
            self._du = self._K.createVecRight()
        elif not bodies.linear and self._write is None and not bodies.materials:
            config = bodies.config
            cells = np.flatnonzero(~config.of(self._massive).all(axis=1)[compat.cell_dofs(config.V)].all(axis=1))
            if (F := _in_cells(bodies.F, cells)) is not None:
                with compiling("the residual behind the surface"):
                    self._write = partial(forms.assemble_vector, L=forms.form(F))


def _in_cells(F: ufl.Form, cells: npt.ArrayLike) -> ufl.Form | None:
    """A form whose integrals over cells are restricted to some cells ``(n,)``; None if they have other marks than MeshTags."""
    integrals, mesh = [], F.arguments()[0].ufl_function_space().mesh
    for integral in F.integrals():
        of = integral.subdomain_data()
        if integral.integral_type() == "cell":
            own, ids = cells, np.ravel(integral.subdomain_id())
            if "everywhere" not in ids:
                if not hasattr(of, "indices"):
                    return None
                own = np.intersect1d(cells, of.indices[np.isin(of.values, ids.astype(np.int32))])
            tags = forms.mesh_tags(mesh, mesh.topology.dim, own, 1)
            integral = integral.reconstruct(subdomain_data=tags, subdomain_id=1)
        integrals.append(integral)
    return ufl.Form(integrals)
