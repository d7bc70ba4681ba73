"""Recovered stresses: polynomials in patches of cells, whose difference from the stress estimates the error.

Around each vertex a polynomial q of the displacement's degree is fitted to the stress s_h at superconvergent points of the cells, by least
squares [O. C. Zienkiewicz, J. Z. Zhu, International Journal for Numerical Methods in Engineering 33 (1992) 1331-1364]. With the linear
functions N of the vertices the recovered stress is ``s* = sum N q`` [T. Blacker, T. Belytschko, ibid. 37 (1994) 517-536], and

    eta^2 = integral of (s* - s_h) : C^-1 : (s* - s_h),

C the mean tangent of each cell. The residual form gives s_h and C, with tensors in place of the gradients of its arguments. So they
exist for every law: s_h is Cauchy's stress in small strains, else the first Piola-Kirchhoff stress. Patches end where bodies do, and where
the law changes.
"""

from __future__ import annotations

from itertools import product
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from scipy.special import binom
from ufl.algorithms import expand_derivatives
from ufl.classes import Division, FixedIndex, Indexed
from ufl.corealg.traversal import traverse_unique_terminals, unique_pre_traversal

from uem_dolfinx import compat, forms
from uem_dolfinx.accuracy.enriched import stiffness_form
from uem_dolfinx.arrays import Array, Bools, Ints, sums_of_rows
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.axisymmetry import displacement_gradient
from uem_dolfinx.geometry.bodies import middle
from uem_dolfinx.geometry.nodes import Halo, Nodes
from uem_dolfinx.materials.elastic import differentiate
from uem_dolfinx.materials.quadrature_points import QuadraturePoints
from uem_dolfinx.parallel import agree, reduced
from uem_dolfinx.solve.problem import UnitedProblem

#: Cells around a vertex determine its polynomial if their normal equations, with a unit diagonal, have no smaller eigenvalue.
#: [convention; unit diagonal; test_recovered.py::test_effectivity]
DETERMINED = 1e-2
#: Patches end where Functions that are constant in cells jump, unless they have more values than this.
#: [bound; values; test_recovered.py::test_laws_that_jump]
MOST_VALUES = 16
#: A smaller tangent is rounding. [bound; the cell's largest tangent; -]
NO_WORK = 1e-10


class Recovered:
    """Stresses of the present state: those of the cells, and recovered ones (collective).

    Args:
        problem: solved.

    Attributes:
        points: of integration, in all owned cells.
        stress: components of the stress there ``(n, n_points, s)``: rows of the tensor one after another, the hoop stress last.
        recovered: the same of the recovered stress.

    Raises:
        InputError: where a body, or a part of it with a law of its own, has too few cells; for residuals without a stress.
    """

    def __init__(self, problem: UnitedProblem):
        self.problem, config = problem, problem.config
        self.mesh, self.degree, g = config.mesh, config.degree, config.gdim
        self._cell, self._n = compat.cell_name(self.mesh), self.mesh.topology.index_map(config.tdim).size_local
        #: Components of gradients that may vary.
        self._components = list(product(range(g), repeat=2)) + [(2, 2)] * config.axisymmetric
        differentiate(problem.materials)
        F = problem.bodies.F
        v = F.arguments()[0]
        self._arguments = v, ufl.TrialFunction(v.ufl_function_space())
        self._residual, self._tangent = _in_cells(F), _in_cells(stiffness_form(problem, self._arguments[1], v))
        #: Rows of an argument: of the displacement, and of other fields without gradients, as a pressure.
        self._moving = [int(config.u[i].ufl_operands[1][0]) for i in range(g)]
        self._local = self._without_gradients()
        cells = np.arange(self._n, dtype=np.int32)
        self.points, self._samples = (QuadraturePoints(self.mesh, cells, k) for k in (2 * self.degree + 1, self.degree))
        stress = self._stress()
        self.stress, sampled = (self._functions(at, self._of_stress) @ stress for at in (self.points, self._samples))
        self.recovered = self._recover(sampled)

    def energies(self) -> Array:
        """Squared differences of both stresses in the inverse tangent of each cell ``(n_owned_cells,)`` (collective)."""
        A = self._mean_tangents()
        # changes of gradients that do work: all but rotations
        J, s = self._strains(A), len(self._components)
        A = J.transpose(0, 2, 1) @ A @ J
        k = J.shape[2] - len(self._local)
        size = np.abs(A).max(axis=(1, 2), initial=0.0)[:, None]
        scale = np.where(np.arange(J.shape[2]) < k, 1.0, size)
        C = np.linalg.pinv(A * scale[:, :, None] * scale[:, None], NO_WORK, hermitian=True)[:, :k, :k]
        away = (self.recovered - self.stress) @ J[:, :s, :k]
        # unstable states have tangents that are not positive
        return np.asarray(np.abs(np.einsum("cq,cqi,cqi->c", self.points.volumes, away @ C, away)))

    def _without_gradients(self) -> list[int]:
        """Rows of other fields than the displacement of which the residual has no gradients."""
        v = self._arguments[0]
        parts = (part for one in self._residual.integrals() for part in unique_pre_traversal(one.integrand()))
        first = [part.ufl_operands[1][0] for part in parts if isinstance(part, Indexed) and part.ufl_operands[0] == ufl.grad(v)]
        if not all(isinstance(i, FixedIndex) for i in first):
            return []
        return sorted(set(range(v.ufl_shape[0])) - set(map(int, first)) - set(self._moving))

    def _replaced(self, form: ufl.Form, *tensors: Any) -> ufl.Form:
        """A form with components of tensors in place of gradients of arguments, and of the values of fields without gradients."""
        g = len(self._moving)
        found: dict[Any, Any] = {}
        for argument, t in zip(self._arguments, tensors):
            rows = argument.ufl_shape[0]
            gradient, value = [[0] * g for _ in range(rows)], [0] * rows
            for k, (i, j) in enumerate(self._components[: g * g]):
                gradient[self._moving[i]][j] = t[k]
            for k, row in enumerate(self._local):
                value[row] = t[len(self._components) + k]
            found |= {ufl.grad(argument): ufl.as_matrix(gradient), argument: ufl.as_vector(value)}
            if self.problem.config.axisymmetric:
                radial = argument[self._moving[0]]
                parts = (part for one in form.integrals() for part in unique_pre_traversal(one.integrand()))
                found |= {part: t[g * g] for part in parts if isinstance(part, Division) and part.ufl_operands[0] == radial}
        return ufl.replace(form, found)

    def _stress(self) -> Array:
        """Stress of each cell at the nodes of a polynomial, by its integrals ``(n, n_nodes, s)`` (collective)."""
        s, N = len(self._components), self._functions(self.points, self._of_stress)
        W = compat.function_space(self.mesh, ("DG", self._of_stress), (s + len(self._local),))
        form = self._replaced(self._residual, ufl.TestFunction(W))
        if form.empty():
            raise InputError("the residual has no stress, which is multiplied by the gradient of its test function")
        integrals = forms.assemble_array(W, forms.form(form)).reshape(-1, s + len(self._local))
        mass = np.einsum("cq,qi,qj->cij", self.points.volumes, N, N, optimize=True)
        return np.linalg.solve(mass, integrals[compat.cell_dofs(W)[: self._n], :s])

    @property
    def _of_stress(self) -> int:
        """Degree of the stress in a cell."""
        return self.degree - (self._cell in ("triangle", "tetrahedron"))

    def _functions(self, at: QuadraturePoints, degree: int) -> Array:
        """Lagrange functions of a cell at points ``(n_points, n_nodes)``."""
        n = len(at.points)
        return (
            forms.create_lagrange_element(self._cell, degree).tabulate(0, at.points)[0].reshape(n, -1)
            if degree
            else np.ones((n, 1))
        )

    def _mean_tangents(self) -> Array:
        """Mean derivative of the stress, and of equations of other local fields, in each cell ``(n, k, k)`` (collective)."""
        k = len(self._components) + len(self._local)
        W = compat.function_space(self.mesh, ("DG", 0), (k,))
        form = forms.form(self._replaced(self._tangent, ufl.TestFunction(W), ufl.TrialFunction(W)))
        A = forms.create_matrix(form)
        forms.assemble_matrix(A, form)
        # one block of each cell
        found = np.array(A.getDiagonalBlock().getValuesCSR()[2]).reshape(-1, k, k)[compat.cell_dofs(W)[: self._n, 0]]
        A.destroy()
        return np.asarray(found + found.transpose(0, 2, 1)) / (2 * self.points.volumes.sum(axis=1)[:, None, None])

    def _strains(self, A: Array) -> Array:
        """Changes of gradients by symmetric strains of the deformed cells, and of other local fields ``(n, k, n_strains)`` (collective).

        In small strains cells count as undeformed: then rotations of these do not change the stress.
        """
        rows, columns = np.transpose(self._components)
        s, size = len(rows), rows.max() + 1
        pairs = np.array([pair for pair in self._components if pair[0] <= pair[1]])
        lower = np.zeros((len(pairs), size, size))
        lower[np.arange(len(pairs)), pairs[:, 1], pairs[:, 0]] = 1.0
        turns = (lower - lower.transpose(0, 2, 1))[:, rows, columns]
        F = np.broadcast_to(np.eye(size), (self._n, size, size)).copy()
        turned, largest = (np.abs(part).max(initial=0.0) for part in (A[:, :s, :s] @ turns.T, A[:, :s, :s]))
        if reduced(self.mesh.comm, turned > NO_WORK * largest, op=MPI.LOR):
            H = displacement_gradient(self.problem.config.u)
            values = self._samples.evaluate(self._samples.compile(ufl.as_vector([H[i, j] for i, j in self._components])))
            F[:, rows, columns] += values.reshape(self._n, len(self._samples.points), s).mean(axis=1)
        J = np.zeros((self._n, A.shape[1], len(pairs) + len(self._local)))
        J[:, :s, : len(pairs)] = ((lower + lower.transpose(0, 2, 1)) @ F[:, None])[:, :, rows, columns].transpose(0, 2, 1)
        J[:, s:, len(pairs) :] = np.eye(len(self._local))
        return J

    def _recover(self, sampled: Array) -> Array:
        """The recovered stress at the points, from the stress at the samples of all cells ``(n, n_samples, s)`` (collective)."""
        out = np.zeros_like(self.stress)
        x, X = (of.evaluate(of.compile(ufl.SpatialCoordinate(self.mesh))) for of in (self.points, self._samples))
        x, X = (places.reshape(*values.shape[:2], places.shape[1]) for places, values in ((x, out), (X, sampled)))
        part, count = self._parts()
        patches = _Patches(self.mesh, self.degree)
        for k in range(count):
            here = np.flatnonzero(part == k)
            patches.fit(here, X[here], sampled[here])
            out[here] = patches.at(here, x[here], self._functions(self.points, 1))
        return out

    def _parts(self) -> tuple[Ints, int]:
        """Part of each cell within which the law is the same ``(n,)``, and their number (collective)."""
        cells, comm = np.arange(self._n), self.mesh.comm
        functions: dict[int, Any] = {}
        keys: list[Any] = [np.isin(cells, one.cells) for one in self.problem.materials if hasattr(one, "cells")]
        for one in self._tangent.integrals():
            tags, numbers = one.subdomain_data(), [n for n in np.ravel(one.subdomain_id()) if not isinstance(n, str)]
            if numbers and hasattr(tags, "indices"):
                keys.append(np.isin(cells, tags.indices[np.isin(tags.values, numbers)]))
            coefficients = (f for f in traverse_unique_terminals(one.integrand()) if isinstance(f, ufl.Coefficient))
            functions |= {f.count(): f for f in coefficients}
        for _, f in sorted(functions.items()):
            V = f.ufl_function_space()
            if compat.element_family(V) == ("Discontinuous Lagrange", 0):
                values = f.x.array.reshape(-1, V.dofmap.index_map_bs)[compat.cell_dofs(V)[: self._n, 0]]
                if len(_of_all(comm, np.unique(values, axis=0)[: MOST_VALUES + 1])) <= MOST_VALUES:
                    keys += list(values.T)
        rows, which = np.unique(np.column_stack([np.zeros(self._n), *keys]), axis=0, return_inverse=True)
        known = _of_all(comm, rows)
        return np.array([known.index(tuple(row)) for row in rows.tolist()], dtype=np.int64)[which.ravel()], len(known)


def _of_all(comm: MPI.Comm, rows: Array) -> list[Any]:
    """Different rows of all ranks, sorted (collective)."""
    return sorted({tuple(row) for one in comm.allgather(rows.tolist()) for row in one})


def _in_cells(form: ufl.Form) -> ufl.Form:
    """The integrals of a form over cells, with expanded derivatives."""
    return expand_derivatives(ufl.Form(form.integrals_by_type("cell")))


class _Patches:
    """Polynomials of a degree around the vertices of a mesh (collective)."""

    def __init__(self, mesh: Any, degree: int):
        self._nodes = Nodes(compat.function_space(mesh, 1))
        self._vertices = compat.cell_dofs(self._nodes.V).astype(np.int64)
        self._halo = Halo(self._nodes, self._nodes.to_global(np.arange(self._nodes.n_local)))
        #: Powers of the coordinates in the monomials ``(m, gdim)``.
        self._powers = np.array([e for e in product(range(degree + 1), repeat=mesh.geometry.dim) if sum(e) <= degree])

    def fit(self, cells: Ints, x: Array, values: Array) -> None:
        """Fit polynomials to values ``(n, n_samples, s)`` at samples ``x (n, n_samples, gdim)`` of cells (collective).

        A vertex with too few cells around it has the mean of the polynomials of their other vertices, as those inside bodies.
        Raises InputError if no vertex has enough cells.
        """
        vertices, m, nodes = self._vertices[cells], len(self._powers), self._nodes
        phi = self._monomials(x[:, None] - nodes.X[vertices][:, :, None])
        back = phi.transpose(0, 1, 3, 2)
        sums = self._summed(vertices, np.concatenate([back @ phi, back @ values[:, None]], 3))
        diagonal = np.einsum("nii->ni", sums[:, :, :m])
        scale = np.divide(1.0, np.sqrt(diagonal), out=np.zeros_like(diagonal), where=diagonal > 0.0)[:, :, None]
        normal = scale * sums[:, :, :m] * scale.transpose(0, 2, 1)
        known: Bools = np.linalg.eigvalsh(normal)[:, 0] > DETERMINED
        normal[~known] = np.eye(m)
        self._coefficients = scale * np.linalg.solve(normal, scale * sums[:, :, m:])
        there, here = (vertices[:, k].ravel() for k in np.indices((vertices.shape[1],) * 2).reshape(2, -1))
        left: Bools = ~known & (diagonal[:, 0] > 0.0)
        while reduced(nodes.comm, bool(left.any()), op=MPI.LOR):
            some = ~left[there] & left[here]
            i, j = there[some], here[some]
            moved = self._shift(nodes.X[j] - nodes.X[i]).transpose(0, 2, 1) @ self._coefficients[i]
            means = self._summed(j, np.concatenate([moved, np.ones((len(j), m, 1))], 2))
            found = means[:, 0, -1] > 0.0
            if not reduced(nodes.comm, int(found.sum())):
                where = middle(nodes.comm, nodes.X[: nodes.n_owned][left[: nodes.n_owned]])
                agree(
                    nodes.comm,
                    InputError(f"too few cells around {where} to recover stresses: refine there, or estimate by the residual"),
                )
            self._coefficients[found] = means[found, :, :-1] / means[found, :, -1:]
            left &= ~found

    def _summed(self, vertices: Ints, values: Array) -> Array:
        """Sums of values ``(..., m, k)`` of local vertices ``(...)``, at all local vertices ``(n_local, m, k)`` (collective)."""
        m, k = values.shape[-2:]
        total = self._halo.add(sums_of_rows(vertices.ravel(), values.reshape(vertices.size, m * k), self._nodes.n_local))
        return np.asarray(self._halo.take(lambda nodes: total[nodes])).reshape(-1, m, k)

    def at(self, cells: Ints, x: Array, N: Array) -> Array:
        """Values ``(n, n_points, s)`` at points ``x`` of cells, where vertices have the functions ``N (n_points, n_vertices)``."""
        vertices = self._vertices[cells]
        phi = self._monomials(x[:, None] - self._nodes.X[vertices][:, :, None])
        return np.asarray(np.einsum("qv,cvqs->cqs", N, phi @ self._coefficients[vertices]))

    def _monomials(self, x: Array) -> Array:
        """Monomials of coordinates ``(..., gdim)``, in ``(..., m)``."""
        return np.asarray(np.prod(x[..., None, :] ** self._powers, axis=-1))

    def _shift(self, d: Array) -> Array:
        """Monomials at ``x + d`` as sums of those at x: matrices ``(n, m, m)`` of ``d (n, gdim)``."""
        of, by = self._powers[:, None], self._powers
        return np.asarray(np.prod(binom(of, by) * d[:, None, None] ** np.maximum(of - by, 0), axis=-1))
