"""Linear equations of users as constraint equations that are always active, with right-hand sides that follow loads and steps."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from ufl.core.expr import Expr
from ufl.corealg.traversal import traverse_unique_terminals

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.conditions.equation import GivenRows, LinearEquations, values_of
from uem_dolfinx.conditions.independent_rows import Solved, divided, eliminated, singles, sizes
from uem_dolfinx.errors import ConflictError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Halo
from uem_dolfinx.parallel import Exchange, agree, agreed, ask_together, reduced


class RightSides:
    """Values b of declared equations, one after the other (collective).

    Args:
        declared: the equations as users declared them.
        loaded: Constants that the load sets; other values are ramped with the Dirichlet values.
        at: load factor or time of the first evaluation of functions.
    """

    def __init__(self, config: Configuration, declared: Sequence[LinearEquations], loaded: Collection[fem.Constant], at: float):
        self._comm, self._block, self.declared = config.comm, config.block, list(declared)
        counts = [one.n_values(config.block) for one in self.declared]
        self.first: Ints = np.cumsum([0, *counts])  # number of the first value of each declaration, and the number of all
        #: mask of values that are ramped ``(n_values,)``.
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


#: Equations that were left out because they follow from others hold up to this part of the displacements and values in them.
#: [convention; displacements and values; test_equation.py::test_what_contradicts]
CONTRADICTING = 1e-8


class UnitedRows:
    """All linear equations of a problem (collective).

    Args:
        sides: right-hand sides.
        rows: this rank's equations, with values numbered as in ``sides``.
        item: number of the declaration of each ``(m,)``.
        free: components without Dirichlet condition of the owned nodes ``(n_owned, gdim)``.
        contactors: mask of owned nodes of contacts, which are eliminated only if no other node can be ``(n_owned,)``.

    Attributes:
        sides: right-hand sides.
        equations: of this rank, with the gaps of the last call of ``at_present``.

    Raises:
        ConflictError: for equations without a component to eliminate, and for equations that follow from others or contradict them.
    """

    def __init__(self, config: Configuration, sides: RightSides, rows: GivenRows, item: Ints, free: Bools, contactors: Bools):
        self._config, self.sides = config, sides
        self._make(rows, item, free, contactors)
        self._halo = Halo(config, self.equations.followed)
        left = self._left
        self._left_halo = Halo(config, left.node)
        every = sides.ramped
        #: Mask of rows whose values are ramped with the Dirichlet values, and the same for the equations that were left out.
        self._ramped = np.asarray(self._weights[:, ~every].getnnz(axis=1) == 0), every[left.value]
        #: Left-hand sides at the beginning of the ramp, of rows and of equations left out, and the fraction of the ramp.
        self._start, self._fraction = (np.zeros(len(self.equations)), np.zeros(len(left))), 1.0
        self._wanted = self.values()

    def _make(self, rows: GivenRows, item: Ints, free: Bools, contactors: Bools) -> None:
        """Choose the component that each equation eliminates (collective)."""
        config = self._config
        size = sizes(config, rows, free)
        able = np.zeros(len(rows), dtype=bool)
        able[rows.row[(size > 0).any(axis=1)]] = True
        self._refuse(rows, item, ~able, "leaves nothing to eliminate, as its components are prescribed or cancel: leave it out")
        spared = config.ask_owners(rows.node, contactors[:, None].astype(float))[:, 0] > 0
        chosen = singles(config, rows, size, spared)
        single, shared = chosen >= 0, able & (chosen < 0)
        # terms of independent equations are renumbered
        place = np.cumsum(single[rows.row]) - 1
        g = config.block
        own = chosen[single]
        solved = [self._sent(divided(rows.select(single), place[own // g] * g + own % g))]
        follows = np.zeros(len(rows), dtype=bool)
        if reduced(config.comm, int(shared.sum())):
            terms = shared[rows.row]
            more, follows[shared] = eliminated(config, rows.select(shared), item[shared], size[terms], spared[terms])
            solved.append(more)
        self._refuse(rows, item, follows, "follows from the equations before it, or contradicts them: leave it out or mend it")
        self._left = rows.select(~able | follows)
        self._take(solved)

    def _refuse(self, rows: GivenRows, item: Ints, which: Bools, words: str) -> None:
        """Raise a ConflictError with ``words`` if any of these rows belongs to a firm equation (collective)."""
        firm = np.array([one.firm for one in self.sides.declared], dtype=bool)
        bad, error = np.flatnonzero(which & firm[item]), None
        X = self._config.ask_owners(rows.node, self._config.X[: self._config.n_owned])
        if len(bad):
            place = ", ".join(f"{x:.6g}" for x in X[np.searchsorted(rows.row, bad[0])])
            error = ConflictError(f"equations[{item[bad[0]]}], at the node at ({place}), {words}")
        agree(self._config.comm, error)

    def _sent(self, rows: Solved) -> Solved:
        """Rows with one weight each, sent to the ranks that own their eliminated nodes (collective)."""
        comm, order = self._config.comm, np.argsort(rows.row, kind="stable")
        rank = self._config.owner_of(rows.pivot // self._config.block)
        counts = np.bincount(rows.row, minlength=len(rows.pivot))
        pivot, n_terms, value, weight = Exchange.to(comm, rank).send(rows.pivot, counts, rows.weight_value, rows.weight)
        column, entry = Exchange.to(comm, rank[rows.row[order]]).send(rows.column[order], rows.entry[order])
        every = np.arange(len(pivot))
        return Solved(pivot, np.repeat(every, n_terms), column, entry, every, value, weight)

    def _take(self, solved: list[Solved]) -> None:
        """Make constraint equations of independent rows whose nodes this rank owns."""
        from scipy.sparse import csr_matrix

        config, g = self._config, self._config.block
        first = np.cumsum([0, *(len(s.pivot) for s in solved)])
        pivot, column, entry, value, weight = (
            np.concatenate([getattr(s, name) for s in solved]) for name in ("pivot", "column", "entry", "weight_value", "weight")
        )
        row, weight_row = (
            np.concatenate([getattr(s, name) + f for s, f in zip(solved, first)]) for name in ("row", "weight_row")
        )
        m = len(pivot)
        node = (pivot // g - config.first).astype(np.int32)
        terms, at = np.unique(np.stack([row, column // g], axis=1), axis=0, return_inverse=True)
        coefficients = np.zeros((len(terms), g))
        coefficients[at.ravel(), column % g] = -entry
        self.equations = UnitingEquations(
            node, np.eye(g)[pivot % g], np.zeros(m), np.ones(m, dtype=bool), terms[:, 0], terms[:, 1], coefficients
        )
        self._weights = csr_matrix((weight, (weight_row, value)), shape=(m, len(self.sides.ramped)))
        #: Size of the gaps for displacements of size one.
        self._size = 1.0 + np.bincount(terms[:, 0], np.abs(coefficients).sum(axis=1), m)

    # -- right-hand sides ------------------------------------------------------------------------------------------------

    def values(self) -> Array:
        """Present right-hand sides ``(n_values,)`` (collective)."""
        return self.sides.values()

    def begin_step(self, start: Array, fraction: float) -> None:
        """Begin a step at a fraction of a ramp that started at a displacement of the owned nodes ``(n_owned, gdim)`` (collective)."""
        self._start, self._fraction = (self._sides(start), self._left_sides(start)), fraction
        self._wanted = self.values()

    @property
    def led(self) -> tuple[Any, ...]:
        """Present values and their ramp."""
        return self._wanted, self._start, self._fraction

    @led.setter
    def led(self, led: tuple[Any, ...]) -> None:
        self._wanted, self._start, self._fraction = led

    def opened(self, change: Array, share: float) -> Array:
        """Change of the gaps ``(m,)`` with right-hand sides ``(n_values,)``, of which ramped ones change by a ``share``."""
        gaps = -(self._weights @ change)
        return np.asarray(np.where(self._ramped[0] & (gaps != 0.0), share, 1.0) * gaps)

    def _sides(self, u: Array) -> Array:
        """Left-hand sides of a displacement ``(m,)`` (collective)."""
        eq = self.equations
        there = np.einsum("kg,kg->k", eq.coefficients, self._halo.take(u.__getitem__))
        return np.einsum("mg,mg->m", eq.direction, u[eq.node]) - np.bincount(eq.row, there, len(eq))

    def _left_sides(self, u: Array) -> Array:
        """Left-hand sides of the equations that were left out (collective)."""
        left = self._left
        there = np.einsum("kg,kg->k", left.coefficients, self._left_halo.take(u.__getitem__))
        return np.asarray(np.bincount(left.row, there, len(left)), dtype=float)

    def _targets(self, b: Array, start: Array, ramped: Bools) -> Array:
        return np.where(ramped, start + self._fraction * (b - start), b) if self._fraction < 1.0 else b

    def at_present(self) -> UnitingEquations:
        """The equations with the gaps of the present displacement (collective)."""
        wanted = self._targets(self._weights @ self._wanted, self._start[0], self._ramped[0])
        here = self._config.displacement[: self._config.n_owned]
        self.equations = replace(self.equations, gap=self._sides(here) - wanted)
        return self.equations

    def largest_gap_here(self) -> float:
        """Largest gap over the sum of the coefficients of its equation, a length, on this rank."""
        return float((np.abs(self.equations.gap) / self._size).max(initial=0.0))

    def check(self) -> None:
        """ConflictError for values that contradict each other or Dirichlet values: equations left out must hold, too (collective)."""
        config, left = self._config, self._left
        if not reduced(config.comm, len(left)):
            return
        u, b = config.displacement[: config.n_owned], self._wanted[left.value]
        misfit = np.abs(self._left_sides(u) - self._targets(b, self._start[1], self._ramped[1]))
        scale = float(reduced(config.comm, np.abs(u).max(initial=0.0), op=MPI.MAX)) + np.abs(b)
        X, error = config.ask_owners(left.node, config.X[: config.n_owned]), None
        bad = np.flatnonzero(misfit > CONTRADICTING * scale)
        if len(bad):
            i = int(bad[np.argmax(misfit[bad])])
            place = ", ".join(f"{x:.6g}" for x in X[np.searchsorted(left.row, i)])
            error = ConflictError(
                f"an equation of the node at ({place}) is missed by {misfit[i]:.4g}: it is a combination of other equations and "
                "Dirichlet conditions, but its value contradicts theirs; give values that agree"
            )
        agree(config.comm, error)


def forces_of(config: Configuration, eq: UnitingEquations, multipliers: Array) -> Array:
    """Forces of equations by their multipliers ``(m,)`` at the owned nodes ``(n_owned, gdim)`` (collective)."""
    return config.add_at_owners(np.concatenate([config.to_global(eq.node), eq.followed]), eq.forces(multipliers))
