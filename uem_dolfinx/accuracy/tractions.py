"""Contact tractions on the bodies' surfaces, from the nodal contact forces."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.solve.problem import UnitedProblem

#: Residual of the tractions' mass matrix, whose condition does not depend on the mesh.
#: [bound; norm of the nodal forces; -]
SOLVED = 1e-10


def contact_tractions(problem: UnitedProblem) -> tuple[fem.Function, Any] | None:
    """Nominal tractions t of all contacts with ``∫ t . v = f(v)`` for every v of the displacement's space (collective).

    The nodal contact forces f of both sides are those of the equilibrium, whichever coupling they come from. So t is in equilibrium with
    the bodies, and acts on contactors and targets alike. Tractions are linear on linear cells, and quadratic on quadratic ones.

    Returns:
        t per undeformed area, zero beyond the surfaces, and the measure of the surfaces; None without surfaces.
    """
    config = problem.config
    V = config.u.function_space
    force: Array = np.zeros(len(config.u.x.array))
    for contact in problem.contacts:
        force += contact.force.x.array
    facets = _surfaces(problem, force.reshape(-1, config.gdim))
    comm = config.comm
    if not comm.allreduce(len(facets)):
        return None
    ds = forms.surface_measure(config.mesh, facets)
    trial, test = ufl.TrialFunction(V), ufl.TestFunction(V)
    mass = forms.form(ufl.inner(trial, test) * ds + fem.Constant(config.mesh, 0.0) * ufl.inner(trial, test) * ufl.dx)
    M = forms.create_matrix(mass)
    forms.assemble_matrix(M, mass)
    diagonal = M.getDiagonal()
    beyond = diagonal.array_r == 0.0
    diagonal.array[beyond] = 1.0
    M.setDiagonal(diagonal)
    t = fem.Function(V)
    rhs, solution = compat.create_vector(V), compat.petsc_vector(t)
    rhs.array[:] = np.where(beyond, 0.0, force[: len(beyond)])
    ksp = PETSc.KSP().create(config.comm)
    ksp.setOperators(M)
    ksp.setType("cg")
    ksp.getPC().setType("jacobi")
    ksp.setTolerances(rtol=SOLVED, atol=0.0)
    ksp.solve(rhs, solution)
    t.x.scatter_forward()
    for one in (ksp, M, rhs):
        one.destroy()
    return t, ds


def _surfaces(problem: UnitedProblem, force: Array) -> Indices:
    """Facets of contactors and targets; of a general contact, facets of the outside with contact forces at a node (collective)."""
    config = problem.config
    dim = config.tdim - 1
    found: list[Any] = [np.zeros(0, np.int32)]
    for contact in problem.declared:
        if hasattr(contact, "parts"):
            found.append(_loaded(problem, force))
            continue
        found += [tag.entities for tag in (contact.contactor, contact.target) if isinstance(tag, Tag) and tag.dim == dim]
    return np.unique(np.concatenate(found)).astype(np.int32)


def _loaded(problem: UnitedProblem, force: Array) -> Indices:
    """Facets of the outside with a contact force at any node."""
    config = problem.config
    facets, of_cell = outside(config)
    cells, loaded = compat.cell_dofs(config.u.function_space), (force != 0.0).any(axis=1)
    layout = config.u.function_space.dofmap.dof_layout
    closure = [np.asarray(layout.entity_closure_dofs(config.tdim - 1, i)) for i in range(int(of_cell[:, 1].max(initial=-1)) + 1)]
    return facets[[bool(loaded[cells[cell, closure[i]]].any()) for cell, i in of_cell]]


def outside(config: Any) -> tuple[Indices, Any]:
    """Facets of the outside on this rank ``(n,)``, and the cell of each with its number in the cell ``(n, 2)``."""
    topology, tdim = config.mesh.topology, config.tdim
    topology.create_connectivity(tdim - 1, tdim)
    topology.create_connectivity(tdim, tdim - 1)
    facets = np.asarray(exterior_facet_indices(topology), dtype=np.int32)
    n_facets = len(forms.reference_topology(compat.cell_name(config.mesh))[tdim - 1])
    sides = compat.cell_table(topology.connectivity(tdim, tdim - 1), n_facets)
    to_cells = topology.connectivity(tdim - 1, tdim)
    cells = np.array([to_cells.links(f)[0] for f in facets], dtype=np.int64)
    local = np.argmax(sides[cells] == facets[:, None], axis=1) if len(facets) else np.zeros(0, np.int64)
    return facets, np.column_stack([cells, local])
