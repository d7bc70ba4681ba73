"""Residual and stiffness in a space of one degree more, by blocks of the nodes inside each edge, face and cell.

The space of degree p + 1 is the sum of that of degree p and of what its nodes inside edges, faces and cells span. A solution of degree p
leaves no residual in the first. So the residual r and the stiffness A in the others estimate the error,

    eta^2 = sum over entities E of r_E' A_E^-1 r_E,

a hierarchical estimate [R. E. Bank, R. K. Smith, SIAM Journal on Numerical Analysis 30 (1993) 921-935; P. Deuflhard, P. Leinen,
H. Yserentant, Impact of Computing in Science and Engineering 1 (1989) 3-35]. It uses the residual form alone, so it holds for every law.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from uem_dolfinx import compat, forms
from uem_dolfinx.accuracy.tractions import contact_tractions, outside
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.materials.elastic import differentiate
from uem_dolfinx.solve.problem import UnitedProblem


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
        energy: ``u' K u`` of the displacement.
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

        def stiffness(along: Any, of: Any) -> Any:
            J = ufl.derivative(ufl.replace(F, {test: of}), config.whole, along)
            for material in problem.materials:
                J += revolved(material.stiffness(along, of))
            return forms.form(forms.with_derivatives(J)[0])

        self._stiffness = stiffness(trial, self.test)
        # the same displacement, of which nothing is a derivative
        fixed = config.whole.copy()
        self.energy = abs(forms.assemble_scalar(stiffness(fixed, fixed), config.comm))
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
