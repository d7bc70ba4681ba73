"""Read access to an interface, including tied contactors, for results, checks and checkpoints."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.seam.placement import Discretisation, Kinematics, Traction
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import Projection, Target

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.sliding import Sliding
    from uem_dolfinx.contact.laws.law import FrictionLaw
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
    label: Ints
    kinematics: Kinematics
    discretisation: Discretisation

    @property
    def frictional(self) -> bool:
        """Whether there is friction."""
        return self.friction is not None

    @property
    def members(self) -> Sequence[Any]:
        """Interfaces of the single contacts: itself, unless several are treated together."""
        return [self]

    @property
    def whole(self) -> Any:
        """The joint interface that contains it: itself, unless several are treated together."""
        return self

    def name_at(self, i: int) -> str:
        """Name of the contact of a contactor."""
        return str(self.members[self.label[i]].name)

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

    def know_friction(self, law: FrictionLaw, value: Array) -> None:
        """Set the friction law and parameter values ``(n,)`` of the committed state (collective)."""
        assert self.friction is not None
        self.friction.set(law, value)

    @property
    def target(self) -> Target:
        """Target of the contactors."""
        return self.discretisation.target

    @property
    def points(self) -> Array:
        """Current positions of the contactors ``(n, gdim)``."""
        return self.config.here(self.nodes)

    @property
    def projection(self) -> Projection:
        """Projection of the contactors in the last placement."""
        return self.kinematics.projection

    @property
    def gap(self) -> Array:
        """Deciding gaps ``(n,)``: nodal gaps, or control gaps on a degree-2 surface."""
        return self.kinematics.gap

    @property
    def off(self) -> Bools:
        """Contactors past an end of the target, barred, or tied ``(n,)``."""
        return self._past_end if self.tie is None else self._past_end | self.tie.excluded

    @property
    def _past_end(self) -> Bools:
        return self.kinematics.ends.past(self.trial) | self.trial.barred

    @property
    def movable(self) -> Bools:
        """Contactors whose gap can be closed despite the Dirichlet conditions ``(n,)``."""
        return self.kinematics.movable

    @property
    def pattern(self) -> Ints:
        """Integers that identify the state of each contactor: active, corner, stick and direction of slip ``(n, k)``."""
        told, f = np.column_stack([self.trial.active, self.trial.held]).astype(np.int64), self.trial.friction
        return told if f is None else np.column_stack([told, f.stick, np.rint(f.direction).astype(np.int64)])

    def stiffness_across(self, stiffness: Array | None) -> Array:
        """Stiffness of the contactors along their normals ``(n,)``, from the stiffness at owned nodes ``(n_owned, gdim)``."""
        assert stiffness is not None
        return np.asarray(np.einsum("ng,ng->n", self.projection.normal**2, np.abs(stiffness[self.nodes])))

    @property
    def traction(self) -> Traction:
        """Contact forces of the trial state."""
        t = self.trial
        return Traction(t.lam, t.nodal, t.force, None if t.friction is None else t.friction.tau, bond=t.bond)

    def largest_gap_here(self) -> float:
        """Largest gap of an active contactor of this rank, or distance from its anchor or tied position, a length."""
        here = float(np.abs(self.gap[self.trial.active & ~self.trial.redundant]).max(initial=0.0))
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

    def areas(self, areas: Array, current: bool, reference: Array) -> Array:
        """See ``PressureMap.areas``; ``reference (n,)`` are the integrals over the reference surface (collective)."""
        found = self.kinematics.pressure_map(current).areas(areas)
        return found if self.tie is None else self.tie.areas(areas, reference, found)

    @property
    def chained(self) -> bool:
        """Whether contactors may follow each other."""
        return self.discretisation.traits.chained or (self.tie is not None and self.tie.chained)

    @property
    def works(self) -> bool:
        """Whether its forces do external work, for example on a moving rigid target."""
        return self.target.motion is not None or (self.tie is not None and self.tie.works)

    def applied_forces(self) -> tuple[Ints, Array] | None:
        """Loads that belong to the interface: global nodes ``(k,)`` and forces ``(k, gdim)``; None without loads (collective)."""
        return None if self.tie is None else self.tie.applied_forces()

    @property
    def functions(self) -> dict[str, fem.Function]:
        """Further Functions for checkpoints, by name; they are read before ``from_checkpoint`` is called."""
        return {} if self.tie is None else {"displacement it was tied at": self.tie.at}

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays ``(n, ...)`` for checkpoints, with facets as keys independent of the partition (collective)."""
        kept = self.committed.to_checkpoint(self.target.keys_of)
        return kept if self.tie is None else kept | self.tie.to_checkpoint()
