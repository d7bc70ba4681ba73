"""Rigid surfaces of many contacts as one target, each point on its own surface, and their motions."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Indices, Ints
from uem_dolfinx.geometry.rigid import Motion, RigidProjection


class JoinedMotion:
    """Motions of several rigid surfaces, with the methods of ``Motion`` for the points of all of them.

    Args:
        each: motions of the surfaces; None for surfaces that have not moved.
        rows: points of each surface.
    """

    def __init__(self, each: Sequence[Motion | None], rows: Sequence[slice]):
        self.each, self._rows = list(each), rows

    def carry(self, X: Array) -> Array:
        """See ``Motion`` ``(n, gdim)``."""
        return self._moved("carry", X)

    def back(self, x: Array) -> Array:
        """See ``Motion`` ``(n, gdim)``."""
        return self._moved("back", x)

    def turn(self, v: Array) -> Array:
        """See ``Motion`` ``(n, gdim)``."""
        return self._moved("turn", v)

    def since(self, before: JoinedMotion, part: float) -> JoinedMotion:
        """See ``Motion``; of each surface."""

        def moved(now: Motion | None, then: Motion | None) -> Motion | None:
            if now is then:
                return None
            still = Motion.none(len((now or then).about))  # type: ignore[union-attr]
            return (now or still).since(then or still, part)

        return JoinedMotion([moved(*both) for both in zip(self.each, before.each)], self._rows)

    def _moved(self, how: str, points: Array) -> Array:
        found = points
        for motion, own in zip(self.each, self._rows):
            if motion is not None:
                found = found.copy() if found is points else found
                found[own] = getattr(motion, how)(points[own])
        return found


class JoinedRigid:
    """Implements ``Target``: rigid surfaces of many contacts, each met by its own contactors.

    Args:
        targets: of the contacts.
        rows: contactors of each.
    """

    n_nodes, averaged, faceted = 0, False, False
    dofs: Indices = np.zeros((0, 0), np.int32)
    keys: Ints = np.zeros(0, np.int64)

    def __init__(self, targets: Sequence[Any], rows: Sequence[slice]):
        self._targets, self._rows = targets, rows
        self.measures = all(getattr(target, "measures", False) for target in targets)
        self._motion = JoinedMotion([None] * len(rows), rows)

    @property
    def stride(self) -> float:
        """The smallest of the surfaces, a length."""
        return min(target.stride for target in self._targets)

    @property
    def motion(self) -> JoinedMotion:
        """Present motions of the surfaces; the same object as long as none has moved."""
        each = [target.motion for target in self._targets]
        if any(now is not then for now, then in zip(each, self._motion.each)):
            self._motion = JoinedMotion(each, self._rows)
        return self._motion

    @motion.setter
    def motion(self, motion: JoinedMotion) -> None:
        for target, own in zip(self._targets, motion.each):
            target.motion = own

    def project(self, points: Array) -> RigidProjection:
        """Each point onto its own surface (collective)."""
        parts = [target.project(points[own]) for target, own in zip(self._targets, self._rows)]
        names = ("gap", "normal", "nodes", "weights", "facet", "beyond", "points", "shape_operator")
        arrays: dict[str, Any] = {name: np.concatenate([getattr(p, name) for p in parts]) for name in names}
        return RigidProjection(**arrays, motion=self.motion)  # type: ignore[arg-type]

    def alone(self, facet: Ints, surface: int) -> Ints:
        """Rigid surfaces have no facets to number."""
        return facet

    here = alone
