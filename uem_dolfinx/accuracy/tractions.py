"""Contact tractions on the bodies' surfaces, from the nodal contact forces."""

from __future__ import annotations

from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Indices, Ints
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import reduced
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
    if not reduced(config.comm, len(facets)):
        return None
    ds = forms.surface_measure(config.mesh, facets)
    trial, test = ufl.TrialFunction(V), ufl.TestFunction(V)
    mass = forms.form(ufl.inner(trial, test) * ds + fem.Constant(config.mesh, 0.0) * ufl.inner(trial, test) * ufl.dx)
    M = forms.create_matrix(mass)
    forms.assemble_matrix(M, mass)
    t, rhs = fem.Function(V), M.createVecLeft()
    rhs.array[:] = force[: len(rhs.array_r)]
    found, _ = forms.solve_mass(M, rhs, 0.0, SOLVED)
    t.x.array[: len(found.array_r)] = found.array_r
    t.x.scatter_forward()
    for one in (M, rhs, found):
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
    facets, nodes = outside(problem.config)
    return np.asarray(facets[(force != 0.0).any(axis=1)[nodes].any(axis=1)])


def outside(config: Configuration) -> tuple[Indices, Ints]:
    """Facets of the outside on this rank ``(n,)``, and the nodes of the displacement on each ``(n, k)``."""
    mesh, V, dim = config.mesh, config.u.function_space, config.tdim - 1
    mesh.topology.create_connectivity(dim, config.tdim)
    facets = np.asarray(exterior_facet_indices(mesh.topology), dtype=np.int32)
    cells, sides = forms.cells_of_facets(mesh, facets)
    layout, number = V.dofmap.dof_layout, len(forms.reference_topology(compat.cell_name(mesh))[dim])
    closure = np.array([layout.entity_closure_dofs(dim, i) for i in range(number)])
    return facets, compat.cell_dofs(V)[cells[:, None], closure[sides]].astype(np.int64)
