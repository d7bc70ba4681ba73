"""The interface of a contact with fluid between its surfaces: hard contact, and the pressure of the fluid where it has got to.

With the gradients r_i of the gaps and the areas A_i, the fluid adds the loads ``sum_i A_i p r_i`` over the contactors that it
reaches, to both bodies: action equals reaction. The constraint of a closed contactor then carries the pressure of the solids alone,
and the contact conditions decide whether it opens. The active set decides in every iteration which contactors the fluid reaches;
directions and areas are those at the beginning of the step.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.laws.leak import Leak
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.seam.placement import GapRows
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.facets import facets_of
from uem_dolfinx.geometry.surfaces import followed_nodes, surface_nodes
from uem_dolfinx.geometry.tags import as_tag
from uem_dolfinx.parallel import reduced

#: A contactor that the fluid has reached and left so often in a step keeps it until the step ends. [bound; changes in a step; -]
MOST_REACHED = 3


class LeakingInterface(Interface):
    """Contactors with fluid between them and the target; other arguments as for ``Interface``.

    Args:
        law: pressure of the fluid, and where it comes from.
        contact: that it belongs to, for ``measured_areas`` and the present load factor.

    Raises:
        InputError: if no contactor is at the inlet.
    """

    works = True  # its forces do work

    def __init__(self, *args: Any, law: Leak, contact: Any, **how: Any):
        super().__init__(*args, **how)
        self._law, self._contact, config = law, contact, self.config
        inlet = surface_nodes(config, as_tag(law.inlet, config.mesh, (config.tdim - 1, 0), "inlet"))
        self._inlet: Bools = np.isin(self.nodes, inlet)  # contactors at the inlet ``(n,)``
        if not reduced(config.comm, int(self._inlet.sum())):
            raise InputError(
                f"contact '{self.name}': leak, no contactor is at the inlet: expected a part that meets the contactor's edge"
            )
        #: Nodes of the contactor's facets ``(n_facets, n_nodes)``.
        self._facets: Indices = facets_of(config, contact.contactor, "contactor").dofs
        self._mark = fem.Function(compat.function_space(config.mesh, config.degree))
        #: How often the fluid has reached or left a contactor in this step ``(n,)``.
        self._changes: Ints = np.zeros(len(self.nodes), np.int64)
        #: Rows of gaps at the beginning of the step, and areas over the forces of multipliers ``(n,)``; None before the first residual.
        self._begun: tuple[GapRows, Array] | None = None
        #: Global nodes and forces of the fluid as last applied, and in the committed state; None before the first residual.
        self._acting: tuple[Ints, Array] | None = None
        self._committed_acting: tuple[Ints, Array] | None = None
        self.trial = self.committed = replace(self.committed, wet=self._inlet)

    def _everywhere(self, contactors: Bools) -> Bools:
        """Contactors of a mask ``(n,)`` among the local nodes, ghosts included (collective)."""
        self._mark.x.array[:] = 0.0
        self._mark.x.array[self.nodes] = contactors
        self._mark.x.scatter_forward()
        return np.asarray(self._mark.x.array > 0.5)

    def _reached(self) -> Bools:
        """Contactors that the fluid reaches by way of open ones ``(n,)`` (collective)."""
        is_open, wet = self._everywhere(~self.united), self._inlet
        while True:
            passes = self._everywhere(wet) & is_open
            some = self._facets[passes[self._facets].any(axis=1)]
            further = wet | followed_nodes(self.config, np.unique(some))[self.nodes]
            if not reduced(self.config.comm, int((further != wet).sum())):
                return wet
            wet = further

    def follow(self) -> bool:
        """Let the fluid reach further contactors or leave them (collective); see ``Interface``."""
        moved = super().follow()
        # a contact that was switched off has no fluid
        before = self._inlet if self.trial.wet is None else self.trial.wet
        wet = self._reached() | (before & (self._changes > MOST_REACHED))
        changed = wet != before
        self._changes = self._changes + changed
        self.trial = replace(self.trial, wet=wet)
        return moved or bool(changed.any())

    def applied_forces(self) -> tuple[Ints, Array] | None:
        """The fluid's forces by the rows of gaps, as loads of both bodies (collective)."""
        if not self.in_reach:
            return None
        # a contact that was switched off has no fluid
        wet = self._inlet if self.trial.wet is None else self.trial.wet
        p = self._law.at(self.config.comm, self.name, float(self._contact._at))
        if self._begun is None:
            self._begun = self.kinematics.gap_rows, self._contact.measured_areas() / self.kinematics.pressure_map(False).force
        rows, area = self._begun
        multipliers = np.zeros(len(rows.equations))
        multipliers[: len(area)] = np.where(wet & ~self.off, p * area, 0.0)
        self._acting = rows.forces(multipliers)
        return self._acting

    def on_nodes(self) -> Array:
        """The fluid's forces in the last equilibrium, on the owned nodes of both bodies ``(n_owned, gdim)`` (collective)."""
        if self._acting is None and self.applied_forces() is not None:
            # the next step has rows of its own
            self._begun = None
        none: Array = np.zeros((self.config.n_owned, self.config.gdim))
        return none if self._acting is None or not self.in_reach else self.config.add_at_owners(*self._acting)

    def commit(self) -> None:
        """See ``Interface``."""
        self._committed_acting = self._acting
        super().commit()

    def restore(self) -> None:
        """See ``Interface``."""
        super().restore()
        self._acting = self._committed_acting
        self._changes, self._begun = np.zeros(len(self.nodes), np.int64), None
