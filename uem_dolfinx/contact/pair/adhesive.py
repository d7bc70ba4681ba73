"""The interface of a contact with adhesion: hard contact, and an attraction by the present gaps.

With the gap g_i, its gradient r_i and the area A_i, the residual is ``F + sum_i A_i r_i a(g_i)``. Its derivative has the terms
``sum_i A_i a'(g_i) r_i r_i'``, which soften, and the curvature ``sum_i A_i a(g_i) grad^2 g_i``. The multipliers of contact are
what is pressed beyond the attraction; results are the sum.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.laws.soft import Adhesion
from uem_dolfinx.contact.pair.cohesive import SofteningInterface, together
from uem_dolfinx.contact.pair.soft import stiffness_of_gaps, traction_by_gaps
from uem_dolfinx.contact.seam.active_set import TOUCHING
from uem_dolfinx.contact.seam.placement import Traction
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.errors import InputError


class AdhesiveInterface(SofteningInterface):
    """Contactors attracted by a law of the gap, on areas of a ``contact``; other arguments as for ``Interface``."""

    def __init__(self, *args: Any, law: Adhesion, contact: Any, **how: Any):
        super().__init__(*args, **how)
        self._law, self._contact, n = law, contact, len(self.nodes)
        if law.range < TOUCHING * self.config.size:
            raise InputError(
                f"{self.name}: {law!r} attracts over gaps up to {law.range:.3g}, but surfaces nearer than {TOUCHING:g} of the model's "
                f"size, {TOUCHING * self.config.size:.3g}, count as touching: take a smaller strength, or leave cohesion out"
            )
        # marks that forces follow a law; there is no damage
        self.trial = self.committed = replace(self.committed, cohesion=np.zeros((n, 2)))
        #: Multipliers of the rows of gaps, negative in attraction, and stiffnesses ``(n,)``.
        self._pull = self._stiffness = np.zeros(n)

    def activate_touching(self, which: Bools | bool = True) -> None:
        """See ``Interface``; a contact that was switched off attracts again."""
        self.trial = self.committed = replace(self.committed, cohesion=np.zeros((len(self.nodes), 2)))
        super().activate_touching(which)

    def project(self) -> None:
        """See ``Interface``; the law gives the attraction there (collective)."""
        super().project()
        if self.trial.cohesion is None or not self.in_reach:
            self._pull = self._stiffness = np.zeros(len(self.nodes))
            return
        share = self.kinematics.pressure_map(False).force
        a, slope = self._law.attraction(self.kinematics.gap_rows.equations.gap[: len(share)] / share)
        area = np.where(self.off | ~self._contact.leads(), 0.0, self._contact.measured_areas())
        self._pull, self._stiffness = -area * a / share, area * slope / share**2

    def _pulled(self) -> Array:
        """Forces of attraction on the contactors ``(n, gdim)`` (collective)."""
        return np.asarray(self.config.add_at_owners(*self.kinematics.gap_rows.forces(self._all()))[self.nodes])

    def _all(self) -> Array:
        """Multipliers of attraction of all rows, of corners' further axes too ``(m,)``."""
        rows = self.kinematics.gap_rows
        return np.append(self._pull, np.zeros(len(rows.equations) - len(self._pull)))

    def applied_forces(self) -> tuple[Ints, Array] | None:
        """The attraction, as loads of both bodies."""
        return self.kinematics.gap_rows.forces(self._all()) if self.trial.cohesion is not None else None

    def slip_terms(self, convex: bool = False) -> tuple[Ints, Array, Array] | None:
        """Terms of friction, and the stiffness of the attraction; see ``Interface``."""
        own, stiffness = super().slip_terms(convex), 0.0 * self._stiffness if convex else self._stiffness
        nodes, which, v = stiffness_of_gaps(self, stiffness)
        blocks = stiffness[which, None, None] * v[:, :, None] * v[:, None, :]
        pull = nodes, blocks, np.zeros(v.shape)
        return pull if own is None else together(own, pull)

    def curvature(self, state: PairState | None = None) -> list[tuple[Ints, Array]]:
        """See ``Interface``; the attraction bends as the contact forces do (collective)."""
        t, found = self.trial, traction_by_gaps(self, self._pull)
        pulled = replace(t, active=np.zeros_like(t.active), lam=found.lam, nodal=found.nodal, force=0.0 * t.force)
        pulled = replace(pulled, held=np.full_like(t.held, -1))
        return super().curvature(state) + self.kinematics.curvature(pulled)

    # -- results ---------------------------------------------------------------------------------------------------------

    def with_forces(self, found: Traction) -> PairState:
        """See ``Interface``; forces on the contactors contain the attraction (collective)."""
        return super().with_forces(found._replace(force=found.force + self._pulled()))

    def nodal_forces(self, state: PairState) -> tuple[Ints, Array]:
        """See ``Interface`` (collective)."""
        nodes, forces = super().nodal_forces(replace(state, force=state.force - self._pulled()))
        more = self.kinematics.gap_rows.forces(self._all())
        return np.concatenate([nodes, more[0]]), np.concatenate([forces, more[1]])

    def pressing(self) -> tuple[Array, Array]:
        """See ``Interface``; contact and attraction."""
        lam, tau = super().pressing()
        return lam + self._pull * self.kinematics.pressure_map(False).force, tau

    @property
    def united(self) -> Bools:
        """Contactors that touch ``(n,)``."""
        return self.trial.active
