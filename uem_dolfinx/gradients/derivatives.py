"""Derivatives of forms by controls, differentiated and compiled once for all states.

Also transposed matrices, and values of Functions in spaces with another numbering.

The shape as a control: changes of the positions of a mesh's nodes, in the nodes of a displacement of the same or a higher degree.

Cells of a lower degree than the displacement move the displacement's further nodes by their shape functions, ``V = N W``; derivatives by
the mesh's nodes are ``N'`` times those by the displacement's.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any
from weakref import WeakKeyDictionary

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.solve.problem import UnitedProblem

#: Forms whose derivatives are summed, each with its sign.
Terms = Sequence[tuple[ufl.Form, float]]


class Derivatives:
    """Derivatives of a residual's work along one field, and of functionals, at the present values of their coefficients.

    Args:
        F: residual, in UFL.
        W: space of its test function.
        V: space of the displacement, with the nodes for derivatives by positions.

    Attributes:
        test: test function of F.
        a: the field, a Function of W.
        work: F along it, a functional.
    """

    def __init__(self, F: ufl.Form, W: fem.FunctionSpace, V: fem.FunctionSpace):
        self.F, self.test, self.a, self._V = F, F.arguments()[0], fem.Function(W), V
        self.work = ufl.replace(F, {self.test: self.a})
        self._comm = V.mesh.comm
        #: Compiled derivatives, None if they vanish, with the form and the control whose ids are in the keys.
        self._known: dict[tuple[Any, ...], tuple[Any, ufl.Form, Any]] = {}
        self._used: set[tuple[Any, ...]] = set()

    def begin(self) -> None:
        """Keep only derivatives that were used since the last call, since functionals change."""
        self._known, self._used = {key: self._known[key] for key in self._used}, set()

    def along(self, values: Array) -> None:
        """Set the owned values of the field a for the residual's work (collective)."""
        self.a.x.array[: len(values)] = values
        self.a.x.scatter_forward()

    def _compiled(self, form: ufl.Form, m: Any, make: Callable[[], ufl.Form | None], *which: Any) -> Any:
        """A derivative by m, compiled on first use; None if the form does not depend on m."""
        key = id(form), id(m), *which
        if key not in self._known:
            found = make()
            self._known[key] = None if found is None else forms.form(found), form, m
        self._used.add(key)
        return self._known[key][0]

    def by_values(self, form: ufl.Form, m: fem.Function, test: Any = None) -> Array | None:
        """Derivative by the owned values of a Function, or along a given test function; None if it vanishes (collective)."""
        V = m.function_space if test is None else test.ufl_function_space()
        found = self._compiled(form, m, lambda: derivative(form, m, ufl.TestFunction(V) if test is None else test))
        return None if found is None else forms.assemble_array(V, found)

    def by_constant(self, terms: Terms, m: fem.Constant) -> Array:
        """Derivative by the entries of a Constant, an array of its shape (collective)."""
        found = np.zeros(np.shape(m.value))
        for entry in np.ndindex(found.shape):
            unit = np.zeros(found.shape)
            unit[entry] = 1.0
            for form, sign in terms:
                part = self._compiled(form, m, lambda form=form, unit=unit: along(form, m, unit), entry)  # type: ignore[misc]
                found[entry] += 0.0 if part is None else sign * forms.assemble_scalar(part, self._comm)
        return found

    def by_function(self, terms: Terms, m: fem.Function) -> fem.Function:
        """Derivative by the values of a Function, a Function of its space (collective)."""
        return self._added(terms, fem.Function(m.function_space), lambda form: self.by_values(form, m))

    def by_places(self, terms: Terms, X: ufl.SpatialCoordinate) -> fem.Function:
        """Derivative by the positions of the nodes in the domain of integration, a Function of V (collective)."""
        V = self._V

        def by(form: ufl.Form) -> Array | None:
            found = self._compiled(form, X, lambda: forms.by_places(form, V.mesh, ufl.TestFunction(V)))
            return None if found is None else forms.assemble_array(V, found)

        return self._added(terms, fem.Function(V), by)

    def _added(self, terms: Terms, found: fem.Function, by: Callable[[ufl.Form], Array | None]) -> fem.Function:
        for form, sign in terms:
            if (values := by(form)) is not None:
                found.x.array[: len(values)] += sign * values
        found.x.scatter_forward()
        return found


def transposed(A: PETSc.Mat) -> PETSc.Mat:
    """The transpose as a new matrix."""
    out = PETSc.Mat()
    A.transpose(out)
    return out


def values_in(V: Any, f: fem.Function) -> Array:
    """Local values of f in the numbering of V, a space of the same element; spaces from parts of mixed ones have another numbering."""
    places = []
    for space in (V, f.function_space):
        block = space.dofmap.index_map_bs
        places.append(compat.cell_dofs(space)[:, :, None] * block + np.arange(block))
    values = np.zeros(len(f.x.array))
    values[places[0]] = f.x.array[places[1]]
    return values


def derivative(form: ufl.Form, m: fem.Function, direction: Any) -> ufl.Form | None:
    """Derivative of a form by a Function; None if the form does not depend on it."""
    return forms.expanded(ufl.derivative(form, m, direction)) if m in form.coefficients() else None


def along(form: ufl.Form, m: fem.Constant | fem.Function, change: Any) -> ufl.Form | None:
    """Derivative of a form along a change of a Constant or a Function; None if the form does not depend on it."""
    if isinstance(m, fem.Function):
        return derivative(form, m, change)
    if m not in form.constants():
        return None
    v, integrals = ufl.variable(m), []
    for integral in form.integrals():
        by, shape = ufl.diff(ufl.replace(integral.integrand(), {m: v}), v), np.shape(m.value)
        parts = [float(np.asarray(change)[i]) * (by[i] if i else by) for i in np.ndindex(shape) if np.asarray(change)[i] != 0.0]
        integrals += [integral.reconstruct(integrand=sum(parts[1:], parts[0]))] if parts else []
    return forms.expanded(ufl.Form(integrals))


#: Derivatives of problems, compiled for their gradients so far.
_KEPT: WeakKeyDictionary[UnitedProblem, Derivatives] = WeakKeyDictionary()


def derivatives_of(problem: UnitedProblem) -> Derivatives:
    """Derivatives of a problem's residual and of functionals, reused from its last gradient."""
    F, kept = problem.bodies.F, _KEPT.get(problem)
    if kept is None or kept.F is not F:
        kept = _KEPT[problem] = Derivatives(F, problem.u.function_space, problem.config.V)
    kept.begin()
    return kept


class Places:
    """Positions of the nodes of a mesh with a displacement.

    Attributes:
        V: space of the displacement.
        W: space of vectors at the nodes of the mesh; V if they are the same.
    """

    def __init__(self, config: Configuration):
        mesh, self.V = config.mesh, config.V
        corners = len(forms.reference_topology(compat.cell_name(mesh))[0])
        own = compat.geometry_dofs(mesh).shape[1]
        self._degree, self.lower = config.degree, own < compat.cell_dofs(self.V).shape[1]
        #: Whether a change of the mesh's nodes can be a Function of V.
        self.known = own == compat.cell_dofs(self.V).shape[1] or (self.lower and own == corners)
        self.W = compat.function_space(mesh, 1, (config.gdim,)) if self.lower and self.known else self.V

    def at_nodes(self, change: fem.Function) -> fem.Function:
        """A change in W as a Function of V (collective)."""
        found = fem.Function(self.V)
        if self.lower:
            found.interpolate(change)
            found.x.scatter_forward()
        else:
            found.x.array[:] = values_in(self.V, change)
        return found

    def back(self, by: fem.Function) -> fem.Function:
        """Derivative by the nodes of the mesh, a Function of W, from the derivative by those of V (collective)."""
        if not self.lower:
            return by
        g, cell_type, found = self.V.dofmap.index_map_bs, compat.cell_name(self.V.mesh), fem.Function(self.W)
        points = forms.create_lagrange_element(cell_type, self._degree).points
        N = forms.create_lagrange_element(cell_type, 1).tabulate(0, points)[0, :, :, 0]
        nodes, corners = compat.cell_dofs(self.V), compat.cell_dofs(self.W)
        # each node of V in one cell, on its owner
        node, first = np.unique(nodes.ravel(), return_index=True)
        first = first[node < self.V.dofmap.index_map.size_local]
        cell, i = first // nodes.shape[1], first % nodes.shape[1]
        shares = N[i][:, :, None] * by.x.array.reshape(-1, g)[nodes[cell, i]][:, None]
        np.add.at(found.x.array.reshape(-1, g), corners[cell], shares)
        forms.sum_ghosts(found)
        return found
