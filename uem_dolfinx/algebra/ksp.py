"""A KSP with options: made from them, made again where the present one has to be kept, and adapted to unsymmetric matrices.

Its preconditioner serves further constrained matrices, up to a number of iterations after which it is made anew.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from math import ceil
from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import compat, given
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.kept_factor import Returning
from uem_dolfinx.algebra.options import GMRES_RESTART, last_words
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.nodes import Nodes

#: A preconditioner is kept for matrices that differ from its own in no more than this part of the equations.
#: [convention; part of the equations; test_kept_preconditioner.py::test_preconditioner_is_kept]
KEPT_CHANGES = 0.1
#: A preconditioner is kept while it takes no more than this times as many iterations for each digit as at first.
#: [convention; ratio of iterations; test_kept_preconditioner.py::test_preconditioner_is_kept]
KEPT_SLOWER = 2.0


class KeptPreconditioner(Returning):
    """Equations that a preconditioner was made with, and its iterations per digit."""

    def __init__(self) -> None:
        self.kept = False  # whether it was made for an earlier matrix than the present one
        self._made_with: UnitingEquations | None = None
        self._first_pace = self._pace = 0.0  # iterations per digit at first, and in the last solve

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


#: Replacements for types of KSP and PC that need symmetric matrices.
UNSYMMETRIC = {"cg": "gmres", "minres": "gmres", "cholesky": "lu", "icc": "ilu"}


class KspOfOptions(Returning):
    """A KSP and its preconditioner."""

    made, stays = "ksp", ("lasting", "_unused")
    space: Nodes
    ksp: Any
    options: dict[str, Any]
    _prefix: str
    _at_need: dict[str, Any]
    _unused: set[str] | None

    def _create_ksp(self) -> PETSc.KSP:
        ksp = PETSc.KSP().create(self.space.comm)
        self.pc = ksp.getPC()  # the preconditioner of the options, which the KSP may use within a deflated one
        ksp.setOptionsPrefix(self._prefix)
        ksp.setErrorIfNotConverged(False)
        ksp.setConvergenceHistory(reset=True)
        with self._in_database():
            try:
                ksp.setFromOptions()
            except PETSc.Error as error:
                raise InputError(
                    f"PETSc refuses petsc_options = {given.shown(self.options)}: {last_words(error)}; correct them"
                ) from error
        return ksp

    def _use(self, options: dict[str, Any]) -> None:
        """Make a new KSP with these options (collective)."""
        self.options = options
        self.lose()
        #: Whether the preconditioner has to be set up for the present matrix; what it was made for.
        self._new, self._preconditioner = True, KeptPreconditioner()
        self.ksp = self._create_ksp()
        #: Whether the KSP is for symmetric matrices, and the types of KSP and PC in the options.
        self._symmetric = True
        self._types = self.ksp.getType(), self.pc.getType()
        self.iterative: bool = self._types[0] != "preonly"  # whether solves have a tolerance

    @contextmanager
    def _in_database(self, **instead: Any) -> Iterator[None]:
        """Put the options into PETSc's database, some with other values; levels of a multigrid read theirs during set-up."""
        database, prefix, options = PETSc.Options(), self._prefix, self.options | instead
        for key, value in options.items():
            database[prefix + key] = value
        try:
            yield
        finally:
            for key in options:
                if self._unused and compat.petsc_option_used(prefix + key) is not False:
                    self._unused.discard(key)
                del database[prefix + key]

    def _adapt(self, symmetric: bool) -> None:
        """Use the KSP and PC of the options, or their replacements for unsymmetric matrices."""
        if symmetric == self._symmetric:
            return
        self._symmetric = symmetric
        pc, before = self.pc, self.pc.getType()
        self._types = self._types if symmetric else (self.ksp.getType(), before)
        ksp_type, pc_type = self._types if symmetric else (UNSYMMETRIC.get(kind, kind) for kind in self._types)
        self.ksp.setType(ksp_type)
        if ksp_type != self._types[0] or symmetric:
            # GMRES measures true residuals, without preconditioner: P'KP is nearly singular if all contactors slip
            self.ksp.setPCSide(PETSc.PC.Side.LEFT if symmetric else PETSc.PC.Side.RIGHT)
        if ksp_type != self._types[0]:
            self.ksp.setGMRESRestart(GMRES_RESTART)
        pc.setType(pc_type)
        # a new PC reads its own options; an unchanged PC must not read them again, because hypre would lose its set-up
        reader = pc
        if pc.getType() == before:
            reader = PETSc.PC().create(self.space.comm)
            reader.setType("none")
        self.ksp.setPC(reader)
        few = {"ksp_max_it": GMRES_RESTART} if self._at_need and not symmetric and self.iterative else {}
        with self._in_database(ksp_type=self.ksp.getType(), pc_type=reader.getType(), **few):
            self.ksp.setFromOptions()
        self.ksp.setPC(pc)
