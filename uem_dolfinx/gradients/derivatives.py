"""Derivatives of forms by controls, differentiated and compiled once for all states that they are assembled at.

Beside them transposed matrices, and values of Functions in spaces that are numbered otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array

#: Forms whose derivatives are added up, each with its sign.
Terms = Sequence[tuple[ufl.Form, float]]


class Derivatives:
    """Derivatives of a residual's work along one field, and of functionals, at the present values of all they hold.

    Args:
        F: residual, in UFL.
        W: space of its test function.
        V: of the displacement, by whose nodes places are told.

    Attributes:
        F: likewise.
        test: test function of F.
        a: the field, a Function of W.
        work: F along it, a functional.
    """

    def __init__(self, F: ufl.Form, W: fem.FunctionSpace, V: fem.FunctionSpace):
        self.F, self.test, self.a, self._V = F, F.arguments()[0], fem.Function(W), V
        self.work = ufl.replace(F, {self.test: self.a})
        self._comm = V.mesh.comm
        #: Compiled derivatives, None for those that vanish, with the form and the control that their keys number.
        self._known: dict[tuple[Any, ...], tuple[Any, ufl.Form, Any]] = {}
        self._used: set[tuple[Any, ...]] = set()

    def begin(self) -> None:
        """Go on with what has been asked for since this was called last, and forget the rest: functionals come and go."""
        self._known, self._used = {key: self._known[key] for key in self._used}, set()

    def along(self, values: Array) -> None:
        """Take the residual's work along a field with these owned values (collective)."""
        self.a.x.array[: len(values)] = values
        self.a.x.scatter_forward()

    def _compiled(self, form: ufl.Form, m: Any, make: Callable[[], ufl.Form | None], *which: Any) -> Any:
        """A derivative by m, compiled when it is asked for first; None where the form does not depend on it."""
        key = id(form), id(m), *which
        if key not in self._known:
            found = make()
            self._known[key] = None if found is None else forms.form(found), form, m
        self._used.add(key)
        return self._known[key][0]

    def by_values(self, form: ufl.Form, m: fem.Function, test: Any = None) -> Array | None:
        """Derivative by the owned values of a Function, or along a test function of another space; None without any (collective)."""
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
        """Derivative by the values of a Function, one of its space (collective)."""
        return self._added(terms, fem.Function(m.function_space), lambda form: self.by_values(form, m))

    def by_places(self, terms: Terms, X: ufl.SpatialCoordinate) -> fem.Function:
        """Derivative by the places of the nodes that integrals are taken over, a Function of V (collective)."""
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
    """A matrix of its own."""
    out = PETSc.Mat()
    A.transpose(out)
    return out


def values_in(V: Any, f: fem.Function) -> Array:
    """Local values of f as its element's space V numbers them: spaces made from parts of a mixed one are numbered otherwise."""
    places = []
    for space in (V, f.function_space):
        block = space.dofmap.index_map_bs
        places.append(compat.cell_dofs(space)[:, :, None] * block + np.arange(block))
    values = np.zeros(len(f.x.array))
    values[places[0]] = f.x.array[places[1]]
    return values


def derivative(form: ufl.Form, m: fem.Function, direction: Any) -> ufl.Form | None:
    """Derivative of a form by a Function; None where it does not depend on it."""
    return forms.expanded(ufl.derivative(form, m, direction)) if m in form.coefficients() else None


def along(form: ufl.Form, m: fem.Constant | fem.Function, change: Any) -> ufl.Form | None:
    """Derivative of a form along a change of a Constant or a Function; None where it does not depend on it."""
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
