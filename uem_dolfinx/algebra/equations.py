"""Constraint ("uniting") equations as data, the only interface between contact and algebra.

[UEM] is Farahani, Mofid, Vafai (2001).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from uem_dolfinx.arrays import AnyArray, Array, Bools, Indices, Ints
from uem_dolfinx.parallel import Exchange

#: An equation whose direction has less than this part left in the free components of its node cannot eliminate any, and one that
#: has no more across other equations depends on them. Surfaces that bend under load leave more, the first order of their strain.
#: [convention; part of the direction's length; test_equations.py::test_what_a_condition_leaves_of_a_normal]
MOSTLY_PRESCRIBED = 1e-6
#: Coefficients below it are rounding: nothing follows by them, and changes below it make no new P.
#: [convention; directions of length one; test_equations.py::test_coefficients_that_are_rounding]
NEGLIGIBLE = 1e-12


@dataclass(frozen=True)
class UnitingEquations:
    """Scalar equations ``direction . du_node - sum_a coefficients_a . du_a = -gap`` [UEM, 4.1 and 6.1]."""

    node: npt.NDArray[np.integer]  # local number of the owned node whose displacement is eliminated ``(m,)``
    direction: Array  # vectors ``(m, block)``, of unit length if a contactor follows its target
    gap: Array  # lengths ``(m,)``
    #: mask of active equations ``(m,)``; inactive ones only keep their entries in the sparsity of P, so that contactors can
    #: be activated and released without new symbolic factorisations.
    active: Bools
    row: Ints  # the equation that each term belongs to ``(k,)``
    followed: Ints  # global block number of the node that the term follows ``(k,)``
    coefficients: Array  # of its displacement ``(k, block)``

    def __len__(self) -> int:
        return len(self.node)

    @property
    def but_gaps(self) -> tuple[AnyArray, ...]:
        """All arrays but the gaps."""
        return self.node, self.direction, self.active, self.row, self.followed, self.coefficients

    @staticmethod
    def along(node: Indices, direction: Array, targets: Ints, weights: Array, gap: Array, active: Bools) -> UnitingEquations:
        """Equations whose terms all have one direction: ``direction . (du_node - sum_a weights_a du_a) = -gap``.

        ``targets (m, nn)`` are the global block numbers of the followed nodes, -1 if missing, with ``weights (m, nn)``.
        """
        row, a = np.nonzero(targets >= 0)
        coefficients = weights[row, a][:, None] * direction[row]
        return UnitingEquations(node, direction, gap, active, row.astype(np.int64), targets[row, a], coefficients)

    @staticmethod
    def join(parts: list[UnitingEquations], block: int) -> UnitingEquations:
        """All equations of several lists, in this order."""
        if not parts:
            return UnitingEquations.along(
                np.zeros(0, np.int32), np.zeros((0, block)), np.zeros((0, 0), np.int64), np.zeros((0, 0)), np.zeros(0),
                np.zeros(0, bool),
            )  # fmt: skip
        parts = [p for p in parts if p.node.size] or parts[:1]
        if len(parts) == 1:
            return parts[0]
        every = [(p.node, p.direction, p.gap, p.active, p.row, p.followed, p.coefficients) for p in parts]
        lists: list[Any] = list(zip(*every))
        first = np.cumsum([0, *map(len, lists[0])])
        lists[4] = [row + f for row, f in zip(lists[4], first)]
        return UnitingEquations(*map(np.concatenate, lists))

    def select(self, which: Bools) -> UnitingEquations:
        """The equations in a mask ``(m,)``, in the same order."""
        place, terms = np.cumsum(which) - 1, which[self.row]
        kept: list[Any] = [v[which] for v in (self.node, self.direction, self.gap, self.active)]
        kept += [place[self.row[terms]].astype(np.int64), self.followed[terms], self.coefficients[terms]]
        return UnitingEquations(*kept)

    def forces(self, multipliers: Array) -> Array:
        """Forces by multipliers ``(m,)`` on the equations' own nodes, then on the followed nodes ``(m + k, block)``."""
        return np.concatenate([multipliers[:, None] * self.direction, -multipliers[self.row, None] * self.coefficients])

    def by_node(self) -> Iterator[tuple[Indices, Ints]]:
        """Nodes ``(n,)`` with k active equations each, and these equations ``(n, k)``, for every k."""
        which = self.active.nonzero()[0]
        order = which[self.node[which].argsort(kind="stable")]
        at = self.node[order]
        first = np.concatenate([[True], at[1:] != at[:-1]])[: len(at)].nonzero()[0]
        counts = np.concatenate([first[1:], [len(at)]])[: len(first)] - first
        for k in range(1, counts.max(initial=0) + 1):
            if len(some := first[counts == k]):
                yield at[some], order[some[:, None] + np.arange(k)]


def least_left(A: Array) -> Array:
    """Smallest singular values ``(n,)`` of the directions ``A (n, k, block)`` of k equations at each node, in free components."""
    if A.shape[1] > A.shape[2]:
        return np.zeros(len(A))
    if A.shape[1] == 1:
        return np.asarray(np.linalg.norm(A[:, 0], axis=1))
    return np.asarray(np.linalg.svd(A, compute_uv=False)[:, -1])


def send(comm: MPI.Comm, equations: UnitingEquations, rank: Ints) -> tuple[UnitingEquations, Exchange]:
    """Send equations of global nodes, each to one ``rank (m,)``, with their terms; returns the received ones (collective)."""
    exchange, order = Exchange.to(comm, rank), np.argsort(equations.row, kind="stable")
    node, direction, gap, active, n_terms = exchange.send(
        equations.node.astype(np.int64), equations.direction, equations.gap, equations.active,
        np.bincount(equations.row, minlength=len(equations)),
    )  # fmt: skip
    terms = Exchange.to(comm, rank[equations.row[order]])
    followed, coefficients = terms.send(equations.followed[order], equations.coefficients[order])
    row = np.repeat(np.arange(len(node)), n_terms)
    return UnitingEquations(node, direction, gap, active, row, followed, coefficients), exchange
