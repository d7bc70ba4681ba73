"""One of the contacts that are treated together, with the interface of a single contact for users, results and checkpoints."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.laws.law import FrictionLaw
from uem_dolfinx.contact.nodes.node_to_surface import NodalKinematics
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.joined_nodes import JoinedLaw
from uem_dolfinx.contact.pair.kinds import PartsOfPair
from uem_dolfinx.contact.pair.tables import label_of
from uem_dolfinx.contact.seam.corners import Corners
from uem_dolfinx.contact.seam.placement import Kinematics
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.rigid import RigidProjection


class Member(Interface):
    """One contact of a ``JoinedInterface`` as a separate interface, with its rows of states and its own numbers of facets.

    Args:
        whole: the ``JoinedInterface``.
        k: number of the contact.
        own: what its interface alone would be made of, with its own target.
    """

    def __init__(self, whole: Any, k: int, own: PartsOfPair):
        self.joined, self._k, self._rows = whole, k, whole.discretisation.rows_of[k]
        _, nodal, self.friction, self.name, self.max_penetration = own
        self.discretisation, self.config, self.nodes, self.tie, self.heats = nodal, nodal.config, nodal.nodes, None, []
        #: The last kinematics, and the last trial state, of all contacts that were looked at, and their parts.
        self._known: tuple[Kinematics, Kinematics] | None = None
        self._seen: tuple[PairState, PairState] | None = None

    @property
    def whole(self) -> Interface:
        """The joint interface."""
        return self.joined

    # -- states ----------------------------------------------------------------------------------------------------------

    @property
    def trial(self) -> PairState:  # type: ignore[override]
        """State of the present iteration."""
        if self._seen is None or self._seen[0] is not self.joined.trial:
            self._seen = self.joined.trial, self.joined.state_of(self._k, self.joined.trial)
        return self._seen[1]

    @trial.setter
    def trial(self, state: PairState) -> None:
        self.joined.trial = self.joined.with_state_of(self._k, self.joined.trial, state)

    @property
    def committed(self) -> PairState:  # type: ignore[override]
        """State of the last step."""
        return self.joined.state_of(self._k, self.joined.committed)

    @committed.setter
    def committed(self, state: PairState) -> None:
        self.joined.committed = self.joined.with_state_of(self._k, self.joined.committed, state)

    def largest_gap_here(self) -> float:
        """Largest gap of an active contactor of this rank, or distance from its anchor, a length."""
        whole = self.joined
        here = float(np.abs(self.kinematics.gap[self.trial.active & ~self.trial.redundant]).max(initial=0.0))
        if whole.friction is None:
            return here
        return max(here, float(whole.friction.distances(whole.trial)[self._rows].max(initial=0.0)))

    # -- placement of contactors -----------------------------------------------------------------------------------------

    def project(self) -> None:
        """Project the contactors of all contacts onto their targets (collective)."""
        self.joined.project()

    @property
    def far(self) -> bool:
        """Whether it is skipped, since the surfaces are separated."""
        return bool(self.joined.discretisation.setting.far[self._k])

    def search(self) -> None:
        """Search for its contactors from the next placement on (collective)."""
        if self.far:
            far = self.joined.discretisation.setting.far.copy()
            far[self._k] = False
            self.joined.discretisation.set(far=far)

    @property
    def asked(self) -> bool:
        """Whether any contactor of this contact, on any rank, was near the target in the last placement."""
        return self.joined.asked and not self.far

    @property
    def kinematics(self) -> Kinematics:  # type: ignore[override]
        """Kinematics of its contactors, made at the first access."""
        whole: Any = self.joined.kinematics
        if self._known is None or self._known[0] is not whole:
            self._known = whole, self._kinematics_of(whole)
        return self._known[1]

    def _kinematics_of(self, whole: Any) -> Kinematics:
        some, points = self._rows, whole.points[self._rows]
        of: Any = self.discretisation
        if not self.asked:
            return of.nowhere(points)
        nearest = self._alone(whole.nearest)
        projection = nearest if whole.projection is whole.nearest else self._alone(whole.projection)
        moves = None if whole.target_moves is None else whole.target_moves[some]
        return NodalKinematics(of, points, projection, nearest, whole.gap[some], self._corners_of(whole.corners), moves)

    def _alone(self, p: Any) -> Any:
        nodal = self.joined.discretisation
        parts = {f.name: v[self._rows] for f in fields(p) if isinstance(v := getattr(p, f.name), np.ndarray)}
        parts["facet"] = nodal.numbers.alone(parts["facet"], nodal.surface_of[self._k])
        if isinstance(p, RigidProjection):
            parts["motion"] = self.target.motion
        return replace(p, **parts)

    def _corners_of(self, corners: Corners | None) -> Corners | None:
        if corners is None:
            return None
        some = (corners.which >= self._rows.start) & (corners.which < self._rows.stop)
        parts = {f.name: v[some] for f in fields(corners) if (v := getattr(corners, f.name)) is not None}
        parts["which"] = parts["which"] - self._rows.start
        return replace(corners, **parts)

    # -- changes between steps -------------------------------------------------------------------------------------------

    def activate_touching(self, which: Bools | bool = True) -> None:
        """See ``Interface``; contactors of other contacts stay as they are (collective)."""
        own = np.zeros(len(self.joined.nodes), dtype=bool)
        own[self._rows] = which
        self.joined.activate_touching(own)

    def set_offset(self, offset: Array | None) -> None:
        """Set offsets ``(n,)``; contactors must be placed again (collective)."""
        self.discretisation.set(offset=offset)
        nodal = self.joined.discretisation
        every = np.zeros(len(nodal.nodes)) if nodal.offset is None else nodal.offset.copy()
        every[self._rows] = 0.0 if offset is None else offset
        others = any(pair.discretisation.setting.offset is not None for pair in self.joined.members)
        nodal.set(offset=every if others else None)

    def set_friction(self, law: FrictionLaw, value: Array, known: bool = False) -> None:
        """See ``Interface`` (collective)."""
        assert self.friction is not None
        self.friction.set(law, value)
        own = [pair.friction for pair in self.joined.members if pair.friction is not None]
        every = JoinedLaw([one.limits.law for one in own], label_of(self.joined))
        self.joined.set_friction(every, np.concatenate([one.value for one in own]), known)
