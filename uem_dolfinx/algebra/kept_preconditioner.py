"""Reuse of a preconditioner for further constrained matrices, and the number of iterations after which it is made anew."""

from __future__ import annotations

from math import ceil

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.returning import Returning
from uem_dolfinx.arrays import Array

#: A preconditioner is kept for matrices that differ from its own in no more than this part of the equations.
#: [convention; part of the equations; test_kept_preconditioner.py::test_preconditioner_is_kept]
KEPT_CHANGES = 0.1
#: A preconditioner is kept while it takes no more than this times as many iterations for each digit as at first.
#: [convention; ratio of iterations; test_kept_preconditioner.py::test_preconditioner_is_kept]
KEPT_SLOWER = 2.0


class KeptPreconditioner(Returning):
    """Equations that a preconditioner was made with, and its iterations per digit.

    Attributes:
        kept: whether it was made for an earlier matrix than the present one.
    """

    def __init__(self) -> None:
        self.kept = False
        self._made_with: UnitingEquations | None = None
        #: Iterations per digit at first, and in the last solve.
        self._first_pace = self._pace = 0.0

    def changes(self, equations: UnitingEquations) -> tuple[int, int]:
        """Number of owned equations activated or released since the preconditioner was made, and number active at that time."""
        if (before := self._made_with) is None:
            return 0, 0
        same = np.array_equal(equations.node, before.node)
        changed = (equations.active != before.active).sum() if same else len(before) + 1
        return int(changed), int(before.active.sum())

    def serves(self, equations: UnitingEquations, changed: int, present: int) -> bool:
        """Whether to reuse it for the present matrix, from ``changes`` summed over all ranks; otherwise it counts as made anew."""
        known = self._made_with is not None
        self.kept = known and changed <= KEPT_CHANGES * present and 0.0 < self._pace <= KEPT_SLOWER * self._first_pace
        if not self.kept:
            self._made_with, self._first_pace = equations, 0.0
        return self.kept

    def most(self, rtol: float) -> int | None:
        """Iterations within which a kept preconditioner reduces the residual by ``rtol``, or is made anew; None for a new one."""
        if not self.kept or not 0.0 < rtol < 1.0:
            return None
        return ceil(-KEPT_SLOWER * self._first_pace * np.log10(rtol))

    def see(self, iterations: int, norms: Array) -> None:
        """Record the pace of a solve from the residual norms of its iterations."""
        if iterations > 0 and len(norms) > iterations and norms[iterations] > 0:
            self._pace = iterations / max(np.log10(norms[0] / norms[iterations]), np.finfo(float).eps)
            self._first_pace = self._first_pace or self._pace
