"""The interface of a contact with cohesion: hard contact, and bonds whose tractions follow the openings until they are separated.

With the mean opening w_i of a bond, its area A_i and the law t(w, damage) the residual is ``F + sum_i A_i r_i t_i`` with the
gradients r_i of w_i. Its derivative has the terms ``sum_i A_i r_i (dt/dw) r_i'`` and the second derivatives of gaps that are
kept. Both bodies are in the rows: action equals reaction. Contactors that close are united as in hard contact, where bonds have
no traction along the normal. Normals are those at the beginning of the step, so that derivatives are exact.

Damage is committed with the step. With friction, limits are those of the damaged part, by the damage at the beginning of the step.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.laws.cohesive import Cohesive, Response
from uem_dolfinx.contact.laws.law import FrictionLaw
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.contact.ties.bonds import Bonds
from uem_dolfinx.parallel import reduced

#: Columns of the state: damage, delayed damage, the load factor or time that it belongs to, and whether damage has grown in the last step.
#: The permanent opening and the normal of the next step follow.
DAMAGE, DELAYED, AT, GREW, PERMANENT = range(5)


class SofteningInterface(Interface):
    """Contactors with forces that soften as gaps open, which can make linearised problems indefinite."""

    @property
    def growth(self) -> tuple[bool, bool]:
        """Whether damage has grown in the last step, and whether some of it can grow on, at this rank's contactors."""
        return False, False

    @property
    def largest_energy(self) -> float:
        """Largest energy that a contactor of this rank takes to separate."""
        return 0.0


def growth_of(state: Array) -> tuple[bool, bool]:
    """Whether damage has grown in the last step, and whether at bonds that have not separated; ``state (n, columns)`` of the bonds."""
    grew = state[:, GREW] > 0.0
    return bool(grew.any()), bool((grew & (state[:, DAMAGE] < 1.0)).any())


class CohesiveInterface(SofteningInterface):
    """Contactors with bonds of a law, made by ``unite``, at a ``contact``'s load factor; other arguments as for ``Interface``."""

    def __init__(self, *args: Any, law: Cohesive, contact: Any, **how: Any):
        super().__init__(*args, **how)
        assert isinstance(self.tie, Bonds)
        self._law, self._contact, self._bonds = law, contact, self.tie
        n, g = len(self.nodes), self.config.gdim
        #: Derivatives of the bonds' forces by their equations, and without growth of damage ``(n, gdim, gdim)``.
        self._tangent = self._secant = np.zeros((n, g, g))
        self._first: Array | None = None  # openings at the first placement of this step ``(n, gdim)``
        #: Parameter of friction of surfaces without cohesion ``(n,)``.
        self._mu: Array = np.zeros(n) if self.friction is None else self.friction.value

    def unite(self, which: Bools | None = None) -> None:
        """Make the bonds, intact, at the start (collective)."""
        super().unite(which)
        n, g = len(self.nodes), self.config.gdim
        state = np.zeros((n, PERMANENT + 2 * g))
        state[:, :AT] = np.where(self._bonds.bonded, 0.0, 1.0)[:, None]
        state[:, AT], state[:, -g:] = self._contact._at, self.kinematics.projection.normal
        self.trial = self.committed = replace(self.committed, cohesion=state)
        self._rub()

    # -- tractions -------------------------------------------------------------------------------------------------------

    def project(self) -> None:
        """See ``Interface``; the law gives the tractions of the bonds there (collective)."""
        super().project()
        before = self.committed.cohesion
        if before is None or self._bonds.rows is None:
            return
        # the load factor of another step begins at 0
        at = float(self._contact._at)
        passed = np.where(at < before[:, AT], at, at - before[:, AT])
        permanent, normal = np.split(before[:, PERMANENT:], 2, axis=1)
        kept = Response(*(np.zeros(0),) * 3, before[:, DAMAGE], before[:, DELAYED], permanent)
        offsets = self._contact._offsets
        # what an offset takes up is no opening
        taken = 0.0 if offsets is None else offsets.declared[:, None] * normal
        w = self._bonds.openings() - taken
        self._first = w if self._first is None else self._first
        # as long as bonds have not moved, those that have grown in the last step are expected to grow on
        growing = (before[:, GREW] > 0.0) & (w == self._first).all(axis=1)
        now = self._law.respond(w, normal, kept, passed, growing)
        share = np.where(self._bonds.rows.share > 0.0, self._bonds.rows.share, 1.0)
        area = self._bonds.bonded_areas(self._contact._areas)[:, None]
        self._bonds.press(-area * now.traction / share, (area[:, 0] > 0.0) & (now.delayed < 1.0))
        self._secant, self._tangent = (
            (area / share)[:, :, None] * part / share[:, None, :] for part in (now.secant, now.tangent)
        )
        states = np.column_stack(
            [now.damage, now.delayed, np.full(len(area), at), now.damage > before[:, DAMAGE], now.permanent, normal]
        )
        self.trial = replace(self.trial, cohesion=states, bond=self._bonds.multipliers)

    @property
    def growth(self) -> tuple[bool, bool]:
        """See ``SofteningInterface``."""
        state = self.committed.cohesion
        return (False, False) if state is None else growth_of(state)

    @property
    def largest_energy(self) -> float:
        """See ``SofteningInterface``."""
        areas = self._bonds.bonded_areas(self._contact._areas)
        return float(max(self._law.energy, self._law.shear_energy) * areas.max(initial=0.0))

    def slip_terms(self, convex: bool = False) -> tuple[Ints, Array, Array] | None:
        """Terms of friction, and the stiffness of the bonds; see ``Interface``."""
        own = super().slip_terms(convex)
        if self._bonds.rows is None:
            return own
        nodes, blocks = self._bonds.stiffness(self._secant if convex else self._tangent)
        bonds = nodes, blocks, np.zeros(blocks.shape[:2])
        return bonds if own is None else together(own, bonds)

    def displaced(self) -> float:
        """See ``Interface``."""
        size = np.linalg.norm(self.points, axis=1, ord=np.inf) if len(self.nodes) else np.zeros(0)
        stiff = np.abs(self._tangent).sum(axis=2).max(axis=1, initial=0.0)
        return float(np.sqrt(2.0 * reduced(self.config.comm, float(((stiff * size) ** 2).sum()))))

    # -- friction of the damaged part ------------------------------------------------------------------------------------

    def _rubbing(self, value: Array) -> Array:
        """Parameter of friction on the damaged part ``(n,)``."""
        state = self.committed.cohesion
        return value if state is None else value * state[:, DELAYED]

    def _rub(self) -> None:
        """Friction by the committed damage (collective)."""
        if self.friction is not None:
            super().set_friction(self.friction.limits.law, self._rubbing(self._mu))

    def set_friction(self, law: FrictionLaw, value: Array, known: bool = False) -> None:
        """See ``Interface``; ``value (n,)`` is that of surfaces without cohesion (collective)."""
        self._mu = value
        super().set_friction(law, self._rubbing(value), known)

    # -- from step to step -----------------------------------------------------------------------------------------------

    def commit(self) -> None:
        """See ``Interface``; bonds open along the normals of this state in the next step (collective)."""
        if self.trial.cohesion is not None:
            g = self.config.gdim
            states = np.column_stack([self.trial.cohesion[:, :-g], self.kinematics.projection.normal])
            self.trial, self._first = replace(self.trial, cohesion=states), None
        super().commit()
        self._rub()

    def restore(self) -> None:
        """See ``Interface``."""
        super().restore()
        self._first = None

    def remember(self, state: PairState) -> None:
        """See ``Interface``."""
        super().remember(state)
        self._first = None
        if self.friction is not None:
            self.friction.set(self.friction.limits.law, self._rubbing(self._mu))


def together(a: tuple[Ints, Array, Array], b: tuple[Ints, Array, Array]) -> tuple[Ints, Array, Array]:
    """Terms of two lists of contactors in one, of the wider blocks."""
    (k, m), (n, o) = a[0].shape, b[0].shape
    nodes, g = np.full((k + n, max(m, o)), -1, dtype=np.int64), (a[2].shape[1] // m if m else b[2].shape[1] // max(o, 1))
    forces = np.zeros((k + n, nodes.shape[1] * g))
    blocks = np.zeros((*forces.shape, forces.shape[1]))
    for part, (rows, K, f) in ((slice(k), a), (slice(k, None), b)):
        nodes[part, : rows.shape[1]] = rows
        forces[part, : f.shape[1]] = f
        blocks[part, : f.shape[1], : f.shape[1]] = K
    return nodes, blocks, forces
