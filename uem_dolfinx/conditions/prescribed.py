"""Dirichlet values by functions of place and load factor or time, and by UFL expressions, kept up to date in a Function."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from ufl.core.expr import Expr

from uem_dolfinx import forms, given
from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.errors import InputError, InputTypeError
from uem_dolfinx.parallel import agreed, ask_together


class Rule:
    """A function or a UFL expression that a Dirichlet value follows.

    Args:
        value: function of places ``(3, n)``, or of places and the load factor or time; or a UFL expression.
        values: Function that the Dirichlet condition reads.
        dofs: its local blocked d.o.f. on the part ``(n,)``.
        name: of the part.

    Attributes:
        value: as given.
        values: as given.
        of_load: whether the value is a function of the load factor or time, too.

    Raises:
        InputTypeError: for a function of other arguments.
    """

    def __init__(self, value: Any, values: fem.Function, dofs: Indices, name: str):
        self.value, self.values, self._dofs = value, values, dofs
        self._words = f"the value of the Dirichlet condition on '{name}'"
        self.of_load = not isinstance(value, Expr) and _n_arguments(self._words, value) == 2
        if isinstance(value, Expr):
            self.interpolate = forms.interpolation(values, value)
        else:
            self._places: Array = values.function_space.tabulate_dof_coordinates()[dofs].T

    def take_load(self, comm: MPI.Comm, at: float) -> None:
        """Evaluate the value at a load factor or time; UserFunctionError if it raises, InputError for another shape (collective)."""
        if isinstance(self.value, Expr):
            self.interpolate()
            return
        arguments = (self._places, at) if self.of_load else (self._places,)
        found = ask_together(comm, f"{self._words} at {at:.6g}", self.value, *arguments)
        with agreed(comm):
            self._write(found)

    def _write(self, found: Any) -> None:
        n, size = len(self._dofs), self.values.function_space.dofmap.bs
        shape = (n,) if size == 1 else (size, n)
        try:
            array = given.numbers(found)
            array = (
                array if array.shape == shape else np.broadcast_to(array.reshape((*array.shape, *(1,) * (size > 1))[:2]), shape)
            )
        except (TypeError, ValueError):
            kind = "complex numbers of the shape" if np.iscomplexobj(found) else "the shape"
            raise InputError(
                f"{self._words} has {kind} {np.shape(found)} at {n} places x of the shape (3, {n}): expected {shape}; "
                "a load factor or time is the second argument, f(x, s)"
            ) from None
        self.values.x.array.reshape(-1, size)[self._dofs] = array.T.reshape(-1, size)


def _n_arguments(words: str, value: Callable[..., Any]) -> int:
    """Number of arguments of a function, 1 or 2."""
    try:
        inspect.signature(value).bind(None)
        return 1
    except TypeError:
        pass
    except ValueError:
        # functions of NumPy have no signature
        return 1
    try:
        inspect.signature(value).bind(None, None)
    except TypeError:
        expected = "a function of places x (3, n), or of x and the load factor or time"
        raise InputTypeError(given.sentence(words, value, expected)) from None
    return 2
