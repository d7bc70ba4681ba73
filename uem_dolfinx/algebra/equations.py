"""Uniting equations as data: all that the algebra knows of contact.

[UEM] is Farahani, Mofid, Vafai (2001).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from uem_dolfinx.arrays import Array, Bools, Indices, Ints

#: An equation whose direction has less than this part left in the free components of its node cannot eliminate any.
#: [convention; part of the direction's length; test_thresholds_algebra.py::test_what_a_condition_leaves_of_a_normal]
MOSTLY_PRESCRIBED = 1e-6
#: Coefficients below it are rounding: nothing follows by them, and changes below it make no new P.
#: [convention; directions of length one; test_thresholds_algebra.py::test_coefficients_that_are_rounding]
NEGLIGIBLE = 1e-12


@dataclass(frozen=True)
class UnitingEquations:
    """Scalar equations ``direction . du_node - sum_a coefficients_a . du_a = -gap`` [UEM, 4.1 and 6.1].

    Attributes:
        node: local number of the owned node whose displacement is eliminated ``(m,)``.
        direction: vectors ``(m, gdim)``, of unit length where a contactor follows its target.
        gap: lengths ``(m,)``.
        active: whether the equation holds ``(m,)``; one that does not only keeps its place in the sparsity of P, so that
            contactors can be activated and released without new symbolic work.
        row: the equation that each term belongs to ``(k,)``.
        followed: global block number of the node that the term follows ``(k,)``.
        coefficients: of its displacement ``(k, gdim)``.
    """

    node: npt.NDArray[np.integer]
    direction: Array
    gap: Array
    active: Bools
    row: Ints
    followed: Ints
    coefficients: Array

    def __len__(self) -> int:
        return len(self.node)

    @staticmethod
    def along(node: Indices, direction: Array, targets: Ints, weights: Array, gap: Array, active: Bools) -> UnitingEquations:
        """Equations whose terms all have one direction: ``direction . (du_node - sum_a weights_a du_a) = -gap``.

        Args:
            node: ``(m,)``.
            direction: ``(m, gdim)``.
            targets: global block numbers of the nodes followed ``(m, nn)``, -1 for none.
            weights: ``(m, nn)``.
            gap: ``(m,)``.
            active: ``(m,)``.
        """
        row, a = np.nonzero(targets >= 0)
        coefficients = weights[row, a][:, None] * direction[row]
        return UnitingEquations(node, direction, gap, active, row.astype(np.int64), targets[row, a], coefficients)

    @staticmethod
    def join(parts: list[UnitingEquations], gdim: int) -> UnitingEquations:
        """All equations of several lists, in this order."""
        if not parts:
            return UnitingEquations.along(
                np.zeros(0, np.int32), np.zeros((0, gdim)), np.zeros((0, 0), np.int64), np.zeros((0, 0)), np.zeros(0),
                np.zeros(0, bool),
            )  # fmt: skip
        first = np.cumsum([0, *(len(p) for p in parts)])
        return UnitingEquations(
            np.concatenate([p.node for p in parts]),
            np.concatenate([p.direction for p in parts]),
            np.concatenate([p.gap for p in parts]),
            np.concatenate([p.active for p in parts]),
            np.concatenate([p.row + f for p, f in zip(parts, first)]),
            np.concatenate([p.followed for p in parts]),
            np.concatenate([p.coefficients for p in parts]),
        )

    def select(self, which: Bools) -> UnitingEquations:
        """Some of the equations, in their order ``(m,)``."""
        place = np.cumsum(which) - 1
        terms = which[self.row]
        return UnitingEquations(
            self.node[which],
            self.direction[which],
            self.gap[which],
            self.active[which],
            place[self.row[terms]].astype(np.int64),
            self.followed[terms],
            self.coefficients[terms],
        )
