"""Uniting equations as data: what contact hands to the algebra.

Between the fourth and the fifth step on the data's way, so that neither side knows the other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

#: An equation whose direction has less than this part left in the free components of its node cannot eliminate any.
MOSTLY_PRESCRIBED = 1e-6


@dataclass(frozen=True)
class UnitingEquations:
    """Scalar equations ``direction . (du_node - sum_a weights_a du_a) = -gap`` [UEM, 4.1 and 6.1].

    Attributes:
        node: local number of the owned node whose displacement is eliminated ``(m,)``.
        direction: unit vectors ``(m, gdim)``.
        targets: global block numbers of the nodes it follows ``(m, nn)``, -1 for none.
        weights: ``(m, nn)``.
        gap: lengths ``(m,)``.
        active: whether the equation holds ``(m,)``; one that does not only keeps its place in the sparsity of P, so that
            contactors can be activated and released without new symbolic work.
    """

    node: npt.NDArray[np.int32]
    direction: Array
    targets: Ints
    weights: Array
    gap: Array
    active: Bools

    def __len__(self) -> int:
        return len(self.node)

    @staticmethod
    def join(parts: list[UnitingEquations], gdim: int) -> UnitingEquations:
        """All equations of several pairs, padded to the same number of target nodes."""
        if not parts:
            return UnitingEquations(
                np.zeros(0, np.int32), np.zeros((0, gdim)), np.zeros((0, 0), np.int64), np.zeros((0, 0)), np.zeros(0),
                np.zeros(0, bool),
            )  # fmt: skip
        width = max(p.targets.shape[1] for p in parts)

        def pad(a: npt.NDArray[np.generic], fill: float) -> npt.NDArray[np.generic]:
            return np.pad(a, ((0, 0), (0, width - a.shape[1])), constant_values=fill)

        return UnitingEquations(
            np.concatenate([p.node for p in parts]),
            np.concatenate([p.direction for p in parts]),
            np.concatenate([pad(p.targets, -1) for p in parts]),
            np.concatenate([pad(p.weights, 0.0) for p in parts]),
            np.concatenate([p.gap for p in parts]),
            np.concatenate([p.active for p in parts]),
        )
