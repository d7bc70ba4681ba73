"""What a contact pair remembers of its contactors from iteration to iteration and from step to step.

A part of the fourth step on the data's way; whoever decides about contactors makes a new state of the old one.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from uem_dolfinx.geometry.search import MeshTarget

if TYPE_CHECKING:
    from collections.abc import Mapping

    from uem_dolfinx.geometry.projection import Target

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

#: Attributes that number facets.
FACETS = ("facet", "held")


@dataclass(frozen=True)
class PairState:
    """What a pair remembers of its contactors; frozen so that trial and committed never share an array by accident.

    Attributes:
        active: united to the target ``(n,)``.
        lam: contact force along the normal, positive in compression ``(n,)``; on a degree-2 surface the control force.
        nodal: contact force of the node along the normal ``(n,)``; the same as ``lam`` on a degree-1 surface.
        force: contact force on the contactor ``(n, gdim)``.
        facet: facet that the contactor is on ``(n,)``, -1 before the first projection.
        held: further facets of a contactor that rests in a concave corner of the target, or -1 ``(n, gdim - 1)``.
        changes: how often in this step it has changed facets across a bend ``(n,)``.
        slips: how often it has slid off the target's end ``(n,)``; released there and pushed back it would go to and fro for ever.
        passed: has been past the target's end since it was last in front of it ``(n,)``.
    """

    active: Bools
    lam: Array
    nodal: Array
    force: Array
    facet: Ints
    held: Ints
    changes: Ints
    slips: Ints
    passed: Bools

    @property
    def united_to(self) -> bytes:
        """What tells this active set from others: who is active, and the corners that hold contactors."""
        corner = np.where((self.held >= 0).any(axis=1), self.facet, -1)
        return self.active.tobytes() + corner.tobytes() + self.held.tobytes()

    @classmethod
    def initial(cls, n: int, gdim: int) -> PairState:
        """The state of ``n`` contactors that nothing is known about."""
        return cls(
            active=np.zeros(n, bool),
            lam=np.zeros(n),
            nodal=np.zeros(n),
            force=np.zeros((n, gdim)),
            facet=np.full(n, -1, np.int64),
            held=np.full((n, gdim - 1), -1, np.int64),
            changes=np.zeros(n, np.int64),
            slips=np.zeros(n, np.int64),
            passed=np.zeros(n, bool),
        )

    def to_checkpoint(self, target: Target) -> dict[str, npt.NDArray[Any]]:
        """The attributes by name, facets of a mesh by what tells them in any partition (collective)."""
        kept = {f.name: getattr(self, f.name) for f in fields(self)}
        if isinstance(target, MeshTarget):
            for name in FACETS:
                kept[name] = target.keys_of(kept[name].ravel()).reshape(kept[name].shape)
        return kept

    @classmethod
    def from_checkpoint(cls, kept: Mapping[str, npt.NDArray[Any]], target: Target) -> PairState:
        """The state of which ``to_checkpoint`` returned these arrays (collective)."""
        arrays = {name: np.array(array) for name, array in kept.items()}
        if isinstance(target, MeshTarget):
            for name in FACETS:
                arrays[name] = target.facets_of(arrays[name].ravel()).reshape(arrays[name].shape)
        return cls(**arrays)
