"""Read access to an interface, including tied contactors, for results, checks and checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.seam.placement import Discretisation, Kinematics, Traction
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import Target

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.sliding import Sliding
    from uem_dolfinx.contact.ties.tie import Tie


class Readings:
    """Read access for results, checks and checkpoints; attributes as in ``Interface``."""

    name: str
    config: Configuration
    nodes: Indices
    trial: PairState
    friction: Sliding | None
    tie: Tie | None
    committed: PairState
    kinematics: Kinematics
    discretisation: Discretisation

    @property
    def members(self) -> Sequence[Any]:
        """Interfaces of the single contacts: itself, unless several are treated together."""
        return [self]

    @property
    def whole(self) -> Any:
        """The joint interface that contains it: itself, unless several are treated together."""
        return self

    @property
    def asked(self) -> bool:
        """Whether any contactor on any rank was near the target in the last placement."""
        return self.discretisation.asked

    @property
    def far(self) -> bool:
        """Whether it is skipped, since the surfaces are separated."""
        return all(self.discretisation.setting.far)

    def set_offset(self, offset: Array | None) -> None:
        """Set offsets ``(n,)``; contactors must be placed again (collective)."""
        self.discretisation.set(offset=offset)

    @property
    def target(self) -> Target:
        """Target of the contactors."""
        return self.discretisation.target

    @property
    def points(self) -> Array:
        """Current positions of the contactors ``(n, gdim)``."""
        return self.config.here(self.nodes)

    @property
    def off(self) -> Bools:
        """Contactors past an end of the target, barred, or tied ``(n,)``."""
        out = self.kinematics.ends.excluded(self.trial)
        return out if self.tie is None else out | self.tie.excluded

    @property
    def traction(self) -> Traction:
        """Contact forces of the trial state."""
        t = self.trial
        return Traction(t.lam, t.nodal, t.force, None if t.friction is None else t.friction.tau, bond=t.bond)

    def largest_gap_here(self) -> float:
        """Largest gap of an active contactor of this rank, or distance from its anchor or tied position, a length."""
        here = float(np.abs(self.kinematics.gap[self.trial.active & ~self.trial.redundant]).max(initial=0.0))
        if self.friction is not None:
            here = max(here, float(self.friction.distances(self.trial).max(initial=0.0)))
        return here if self.tie is None else max(here, self.tie.largest_gap_here())

    @property
    def tied(self) -> Bools:
        """Contactors tied permanently to the target in all components ``(n,)``."""
        return np.zeros(len(self.nodes), dtype=bool) if self.tie is None else self.tie.tied

    @property
    def united(self) -> Bools:
        """Contactors that are active or tied ``(n,)``."""
        return self.trial.active | self.tied

    def displaced(self) -> float:
        """Norm of the forces that gaps would make by a displacement of the size of positions; 0 without stiffness (collective)."""
        return 0.0

    def pressing(self) -> tuple[Array, Array]:
        """Normal ``(n,)`` and tangential forces ``(n, gdim)`` that belong to ``areas`` (collective)."""
        t = self.trial
        tau = 0.0 * t.force if t.friction is None else t.friction.tau
        return (t.lam, tau) if self.tie is None else self.tie.pressing(t, self.kinematics.projection.normal, t.lam, tau)

    def applied_forces(self) -> tuple[Ints, Array] | None:
        """Loads that belong to the interface: global nodes ``(k,)`` and forces ``(k, gdim)``; None without loads (collective)."""
        return None if self.tie is None else self.tie.applied_forces()

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays ``(n, ...)`` for checkpoints, with facets as keys independent of the partition (collective)."""
        kept = self.committed.to_checkpoint(self.target.keys_of)
        return kept if self.tie is None else kept | self.tie.to_checkpoint()
