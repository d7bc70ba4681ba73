"""Additional columns of a history: reactions of supports, and quantities defined by the user."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError
from uem_dolfinx.parallel import agreed, ask_together
from uem_dolfinx.solve.problem import UnitedProblem


class Columns:
    """Numbers by name, evaluated after every step (the constructor is collective).

    Args:
        problem: for the reactions.
        reaction: part of the mesh with Dirichlet conditions, as in ``UnitedProblem.reaction``, or several parts by name; or None.
        quantities: functions without arguments by name that return a number or a vector, the same on all ranks; or None.

    Attributes:
        names: of the columns.

    Raises:
        InputError, InputTypeError: for arguments of another form, and for duplicate names.
    """

    def __init__(self, problem: UnitedProblem, reaction: Any, quantities: Mapping[str, Callable[[], Any]] | None):
        self._comm, self._axes = problem.comm, "xyz"[: problem.config.gdim]
        self._asked: dict[str, Callable[[], Any]] = {}
        with agreed(self._comm):
            expected = "functions without arguments that return numbers, by the names of their columns"
            given.kind("columns", quantities, quantities is None or isinstance(quantities, Mapping), expected)
            supports = dict(reaction) if isinstance(reaction, Mapping) else {} if reaction is None else {"": reaction}
            for name, support in supports.items():
                suffix = f"_{given.name('the name of a reaction', name)}" if isinstance(reaction, Mapping) else ""
                self._asked[f"reaction{suffix}"] = partial(problem.reaction, support)
            for name, quantity in (quantities or {}).items():
                given.name("the name of a column", name)
                given.kind(
                    f"columns[{name!r}]", quantity, given.function(quantity), "a function without arguments that returns numbers"
                )
                if name in self._asked:
                    raise InputError(f"columns[{name!r}]: a reaction has this name: choose another")
                self._asked[name] = quantity
        self._sizes = {name: value.shape for name, value in self._values().items()}
        self.names = [column for name, shape in self._sizes.items() for column in self._columns(name, shape)]

    def _columns(self, name: str, shape: tuple[int, ...]) -> list[str]:
        """Names of the columns of a number ``()`` or a vector ``(n,)``."""
        if not shape:
            return [name]
        return [f"{name}_{a}" for a in (self._axes if shape[0] == len(self._axes) else range(shape[0]))]

    def _values(self) -> dict[str, Array]:
        """Present values of the functions (collective)."""
        found = {name: ask_together(self._comm, f"columns[{name!r}]", ask) for name, ask in self._asked.items()}
        with agreed(self._comm):
            for name, value in found.items():
                what = f"columns[{name!r}]"
                found[name] = (
                    np.array(given.number(what, value)) if np.ndim(value) == 0 else given.vector(what, value, len(value))
                )
        given.alike(self._comm, "columns", **{name: value.tolist() for name, value in found.items()})
        return found

    def row(self) -> list[float]:
        """The present numbers of all columns (collective if there are columns).

        Raises:
            InputError, InputTypeError: if a function returns numbers that are not finite, differ between ranks, or changed in number.
            UserFunctionError: if a function raises an error.
        """
        if not self._asked:
            return []
        values = self._values()
        with agreed(self._comm):
            for name, value in values.items():
                if value.shape != self._sizes[name]:
                    words = "a number" if not self._sizes[name] else f"{self._sizes[name][0]} numbers"
                    raise InputError(given.sentence(f"columns[{name!r}]", value, f"{words}, as at first"))
        return [float(x) for value in values.values() for x in value.ravel()]
