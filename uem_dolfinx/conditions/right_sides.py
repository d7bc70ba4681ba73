"""Right-hand sides of linear equations of users, which follow loads and steps."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from dolfinx import fem
from ufl.core.expr import Expr
from ufl.corealg.traversal import traverse_unique_terminals

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.conditions.equation import LinearEquations, values_of
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import agreed, ask_together


class RightSides:
    """Values b of declared equations, one after the other (collective).

    Args:
        config: configuration of the displacement.
        declared: the equations as users declared them.
        loaded: Constants that the load sets; other values are ramped with the Dirichlet values.
        at: load factor or time of the first evaluation of functions.

    Attributes:
        first: number of the first value of each declaration, and the number of all.
        ramped: mask of values that are ramped ``(n_values,)``.
    """

    def __init__(self, config: Configuration, declared: Sequence[LinearEquations], loaded: Collection[fem.Constant], at: float):
        self._comm, self._block, self.declared = config.comm, config.block, list(declared)
        counts = [one.n_values(config.block) for one in self.declared]
        self.first: Ints = np.cumsum([0, *counts])
        self.ramped: Bools = np.repeat([is_ramped(one.b, loaded) for one in self.declared], counts).astype(bool)
        self._evaluated: list[Any] = [None] * len(counts)
        self.take_load(at)

    def take_load(self, at: float) -> None:
        """Evaluate functions at a load factor or time; UserFunctionError if a function raises (collective)."""
        for i, one in enumerate(self.declared):
            if callable(one.b) and not isinstance(one.b, fem.Constant):
                self._evaluated[i] = ask_together(self._comm, f"the value of equations[{i}] at {at:.6g}", one.b, at)

    def by_name(self) -> dict[str, Any]:
        """Present right-hand sides, by name."""
        now = [one.b if known is None else known for one, known in zip(self.declared, self._evaluated)]
        return {f"the value of equations[{i}]": value for i, value in enumerate(now)}

    def values(self) -> Array:
        """Present right-hand sides ``(n_values,)`` (collective)."""
        with agreed(self._comm):
            found = [
                values_of(name, value, one.n_values(self._block))
                for one, (name, value) in zip(self.declared, self.by_name().items())
            ]
        return np.concatenate([np.zeros(0), *found])


def is_ramped(b: Any, loaded: Collection[fem.Constant]) -> bool:
    """Whether a right-hand side is ramped with the Dirichlet values; functions and what contains ``loaded`` Constants are not."""
    if isinstance(b, Expr):
        return not any(one is constant for one in traverse_unique_terminals(b) for constant in loaded)
    return not callable(b)
