"""What an interface tells of its contactors, for results, checks and checkpoints; one whose contactors are tied tells of these, too."""

from __future__ import annotations

import numpy as np
from dolfinx import fem

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.kinematics import Discretisation, Kinematics
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.parallel import reduced


class Told:
    """What results, checks and checkpoints ask; attributes as those of ``Interface``."""

    config: Configuration
    nodes: Indices
    trial: PairState
    tied: Bools
    kinematics: Kinematics
    discretisation: Discretisation

    @property
    def united(self) -> Bools:
        """Contactors that are active or tied ``(n,)``."""
        return self.trial.active | self.tied

    @property
    def n_active(self) -> int:
        """Number of active contactors over all ranks (collective)."""
        return int(reduced(self.config.comm, int(self.united.sum())))

    def pressing(self) -> tuple[Array, Array]:
        """Forces across ``(n,)`` and along ``(n, gdim)`` the target that belong to ``areas`` (collective)."""
        t = self.trial
        return t.lam, 0.0 * t.force if t.friction is None else t.friction.tau

    def areas(self, areas: Array, current: bool, reference: Array) -> Array:
        """As of ``Kinematics``; ``reference (n,)`` are the integrals over the reference surface (collective)."""
        return self.kinematics.areas(areas, current)

    def kept_gaps(self) -> Array:
        """Heights over the target that tied contactors keep, of this rank ``(k,)``."""
        return np.zeros(0)

    def torn(self) -> Array:
        """How far contactors are from where they are tied if their equations were left out ``(n,)``."""
        return np.zeros(len(self.nodes))

    @property
    def chained(self) -> bool:
        """Whether contactors may follow each other."""
        return self.discretisation.chained

    @property
    def works(self) -> bool:
        """Whether its forces do work by themselves, as where a rigid target moves."""
        return self.discretisation.target.motion is not None

    def applied_forces(self) -> tuple[Ints, Array] | None:
        """Loads that belong to the interface: global nodes ``(k,)`` and forces ``(k, gdim)``; None without any (collective)."""
        return None

    @property
    def functions(self) -> dict[str, fem.Function]:
        """Further Functions that a run goes on from, by name; they are read before ``from_checkpoint`` is called."""
        return {}
