"""Residual and stiffness in a space of one degree more, by blocks of the nodes inside each edge, face and cell.

The space of degree p + 1 is the sum of that of degree p and of what its nodes inside edges, faces and cells span. A solution of degree p
leaves no residual in the first. So the residual r and the stiffness A in the others estimate the error,

    eta^2 = sum over entities E of r_E' A_E^-1 r_E,

a hierarchical estimate [R. E. Bank, R. K. Smith, SIAM Journal on Numerical Analysis 30 (1993) 921-935; P. Deuflhard, P. Leinen,
H. Yserentant, Impact of Computing in Science and Engineering 1 (1989) 3-35]. It uses the residual form alone, so it holds for every law.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import ufl
from dolfinx import fem
from dolfinx.mesh import exterior_facet_indices
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import facets_of
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import logger
from uem_dolfinx.materials.elastic import differentiate
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.problem import UnitedProblem

#: Residual of the tractions' mass matrix, whose condition does not depend on the mesh. [bound; norm of the nodal forces; -]
SOLVED = 1e-10


def contact_tractions(problem: UnitedProblem) -> tuple[fem.Function, Any] | None:
    """Nominal tractions t of all contacts with ``∫ t . v = f(v)`` for every v of the displacement's space (collective).

    The nodal contact forces f of both sides are those of the equilibrium, whichever coupling they come from. So t is in
    equilibrium with the bodies, and acts on contactors and targets alike. Tractions are linear on linear cells, and quadratic on
    quadratic ones. Returns t per undeformed area, zero beyond the surfaces, and the measure of the surfaces; None without
    surfaces.
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


class Enriched:
    """Residuals of a converged state in a space of one degree more than the displacement's.

    Args:
        problem: its state is in equilibrium.

    Attributes:
        W: the space.
        test: its test function.
        degree: of the space.
        nodes: its nodes.
        forces: residual of the bodies without contacts, at the owned nodes of W, zero at prescribed components ``(n, gdim)``.
        residual: the same with the contact tractions.
        traction: of contacts, in the displacement's space; None without contact surfaces.
    """

    def __init__(self, problem: UnitedProblem):
        self.problem, config = problem, problem.config
        self.g, bodies = config.gdim, problem.bodies
        self.degree = config.degree + 1
        self.W = compat.function_space(config.mesh, self.degree, (self.g,))
        self.cells = compat.cell_dofs(self.W)
        self.test = ufl.TestFunction(self.W)
        self.held = self._held()
        differentiate(problem.materials)
        F, test, trial = bodies.F, bodies.F.arguments()[0], ufl.TrialFunction(self.W)
        self._stiffness = forms.form(forms.with_derivatives(stiffness_form(problem, trial, self.test))[0])
        self.forces = self.residual = self.assembled(ufl.replace(F, {test: self.test}))
        self.traction = None
        if (found := contact_tractions(problem)) is not None:
            self.traction = found[0]
            self.residual = self.forces - self.assembled(ufl.inner(found[0], self.test) * found[1])

    @cached_property
    def nodes(self) -> Nodes:
        """Nodes of W (first time: collective)."""
        return Nodes(self.W)

    def assembled(self, form: ufl.Form) -> Array:
        """A linear form at the owned nodes of W, zero at prescribed components ``(n, gdim)`` (collective)."""
        own = forms.assemble_array(self.W, forms.form(form)).reshape(-1, self.g)
        return np.where(self.held[: len(own)], 0.0, own)

    def stiffness(self) -> PETSc.Mat:
        """K of the whole space, with the identity at prescribed components (collective)."""
        A = forms.create_matrix(self._stiffness)
        forms.assemble_matrix(A, self._stiffness)
        first = self.g * self.nodes.first
        A.zeroRowsColumns((first + np.flatnonzero(self.held[: len(self.residual)])).astype(PETSc.IntType), diag=1.0)
        return A

    def energies(self) -> Array:
        """``|r_E' A_E^-1 r_E|``, shared by the cells of each E ``(n_owned_cells,)`` (collective)."""
        A = forms.create_matrix(self._stiffness)
        forms.assemble_matrix(A, self._stiffness)
        indptr, indices, values = A.getDiagonalBlock().getValuesCSR()
        inside = csr_matrix((values, indices, indptr))
        of_nodes = np.zeros(len(self.residual))
        for nodes in self._entities():
            of_nodes[nodes[:, 0]] = self._block_energies(inside, nodes)
        A.destroy()
        return self.of_cells(of_nodes)

    def of_cells(self, of_nodes: Array) -> Array:
        """Values of the owned nodes of W ``(n,)``, shared by the cells around each of them ``(n_owned_cells,)`` (collective)."""
        n = self.problem.config.mesh.topology.index_map(self.problem.config.tdim).size_local
        shares = fem.Function(self.W)
        view = shares.x.array.reshape(-1, self.g)
        np.add.at(view[:, 0], self.cells[:n].ravel(), 1.0)
        forms.sum_ghosts(shares)
        view[: len(of_nodes), 0] = of_nodes / np.maximum(view[: len(of_nodes), 0], 1.0)
        shares.x.scatter_forward()
        return np.asarray(view[self.cells[:n], 0].sum(axis=1))

    def _block_energies(self, A: csr_matrix, nodes: Ints) -> Array:
        """``|r' A^-1 r|`` of blocks of owned nodes ``(m, k)``, in ``(m,)``; prescribed components are left out."""
        m, size = len(nodes), nodes.shape[1] * self.g
        dofs = (nodes[:, :, None] * self.g + np.arange(self.g)).reshape(m, size)
        shape = (m, size, size)
        rows, columns = (np.broadcast_to(part, shape).ravel() for part in (dofs[:, :, None], dofs[:, None, :]))
        blocks = np.asarray(A[rows, columns]).reshape(shape)
        held, r = self.held.reshape(-1)[dofs], self.residual.reshape(-1)[dofs]
        blocks[held[:, :, None] | held[:, None, :]] = 0.0
        # the size of the diagonal does not matter at prescribed components, whose residual is zero
        blocks[:, np.arange(size), np.arange(size)] += held
        # unstable states have blocks that are not positive
        return np.abs(np.einsum("mi,mi->m", r, np.linalg.solve(blocks, r[:, :, None])[:, :, 0]))

    def _entities(self) -> list[Ints]:
        """Owned nodes inside edges, faces and cells, those of each entity in a row: arrays ``(m, k)``, one for each k."""
        layout, tdim, n = self.W.dofmap.dof_layout, self.problem.config.tdim, len(self.residual)
        rows: dict[int, list[Ints]] = {}
        for dim, entities in enumerate(forms.reference_topology(compat.cell_name(self.problem.config.mesh))):
            for i in range(len(entities) if 0 < dim <= tdim else 0):
                inside = np.asarray(layout.entity_dofs(dim, i))
                if len(inside):
                    rows.setdefault(len(inside), []).append(np.sort(self.cells[:, inside].astype(np.int64), axis=1))
        together = [np.unique(np.concatenate(found), axis=0) for found in rows.values()]
        return [nodes[nodes[:, -1] < n] for nodes in together]

    def _held(self) -> Bools:
        """Prescribed components of the nodes of W, ghosts included ``(n, gdim)`` (collective).

        A facet of the outside is held in a component if all nodes of the displacement on it are, by conditions or by rigid couplings.
        """
        problem, dim = self.problem, self.problem.config.tdim - 1
        held = problem.bodies.held.reshape(-1, self.g).copy()
        for coupling in problem.couplings:
            held[coupling.nodes.nodes] = True
        held = problem.bodies.of_owners(held.ravel()).reshape(held.shape)
        facets, nodes = outside(problem.config)
        whole: Bools = np.asarray(held[nodes].all(axis=1))
        found = np.zeros((int(self.cells.max(initial=-1)) + 1, self.g), dtype=bool)
        for k in range(self.g):
            # nodes of facets of other ranks as well
            found[fem.locate_dofs_topological(self.W, dim, facets[whole[:, k]]), k] = True
        # single nodes that hold a body
        vertices = len(forms.reference_topology(compat.cell_name(problem.config.mesh))[0])
        of_solution = compat.cell_dofs(problem.config.u.function_space)
        found[self.cells[:, :vertices]] |= held[of_solution[:, :vertices]]
        return found


def stiffness_form(problem: UnitedProblem, along: Any, test: Any) -> ufl.Form:
    """The tangent of a problem's bodies along a trial function or displacement, with a test function or displacement."""
    F = problem.bodies.F
    J = ufl.derivative(ufl.replace(F, {F.arguments()[0]: test}), problem.config.whole, along)
    for material in problem.materials:
        J += revolved(material.stiffness(along, test))
    return J


def energy(problem: UnitedProblem) -> float:
    """``u' K u`` of the displacement, with the tangent K (collective)."""
    config = problem.config
    # the same displacement, of which nothing is a derivative; other fields are zero
    fixed, moving = fem.Function(config.whole.function_space), config.of(np.arange(len(config.whole.x.array)))
    fixed.x.array[moving] = config.whole.x.array[moving]
    form = forms.form(forms.with_derivatives(stiffness_form(problem, fixed, fixed))[0])
    return abs(forms.assemble_scalar(form, config.comm))


class FewFacets(NamedTuple):
    """A contact that begins and ends within a few facets."""

    name: str
    closed: int  # number of facets of all whose contactors are active
    few: int  # the least number with which estimates are trusted


def of_facets(config: Configuration, contact: Contact, values: Array) -> Array:
    """Values at the owned nodes ``(n_owned, k)``, at those of the contactor's facets on this rank ``(m, nn, k)`` (collective)."""
    dofs = facets_of(config, contact.contactor, "contactor").dofs
    return np.asarray(config.from_owners(np.arange(config.n_owned), values, dofs.ravel()).reshape(*dofs.shape, values.shape[1]))


def narrow_contacts(problem: UnitedProblem, few: int) -> list[FewFacets]:
    """Contacts with fewer than ``few`` facets along each direction; where all facets touch, the ends are known (collective)."""
    config, found = problem.config, []
    for contact in problem.contacts:
        if not contact.on or contact.tied:
            continue
        state = np.zeros((config.n_owned, 1))
        state[contact.pair.nodes, 0] = contact.pair.trial.active
        active = of_facets(config, contact, state)[:, :, 0] > 0
        touched, closed, count = reduced(config.comm, np.array([active.any(axis=1).sum(), active.all(axis=1).sum(), len(active)]))
        least = few ** (config.tdim - 1)
        if touched and closed < min(least, count):
            found.append(FewFacets(contact.name, int(closed), least))
    return found


def warn_of_few_facets(narrow: list[FewFacets], estimate: str) -> None:
    """Warn of contacts of which an estimate, with what may be wrong with it, sees too little."""
    for one in narrow:
        logger.warning(
            "contact '%s': %d facets are in contact, expected %d at least: %s; refine the contactor there", *one, estimate
        )
