"""Detection of sharp edges that cross between their nodes, where no condition prevents penetration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Bools, Ints
from uem_dolfinx.geometry.crossings import Crossing, SharpEdges, find_crossing
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.skin import Apart, Skin
from uem_dolfinx.log import logger


@dataclass(frozen=True)
class Meeting:
    """Two surfaces whose edges may cross."""

    own: TargetFacets  # the first surface
    theirs: TargetFacets  # the second surface, or the same
    apart: Sequence[Apart] = ()  # sets of facets that never touch each other, for the joint surface of many bodies
    itself: Bools | None = None  # bodies that may touch themselves ``(n_bodies,)``, for such a surface; None for two surfaces


class EdgesInside:
    """Edges of two surfaces of 3D bodies (collective)."""

    def __init__(self, meeting: Meeting):
        self._meeting = meeting
        self._own = SharpEdges(meeting.own)
        self._theirs = self._own if meeting.own is meeting.theirs else SharpEdges(meeting.theirs)
        self._keys = self._of(self._own), self._of(self._theirs)

    @property
    def any(self) -> bool:
        """Whether both surfaces have sharp edges."""
        return self._own.total > 0 and self._theirs.total > 0

    def _of(self, edges: SharpEdges) -> Ints:
        """Visibility keys of edge segments: body, and sets of the facet ``(k, 1 + 2 n_sets)``; for two surfaces ``(k, 0)``."""
        skin, f = edges.facets, edges.facet
        if not isinstance(skin, Skin):
            return np.zeros((len(f), 0), dtype=np.int64)
        sets = [facets[f] for _, a, _, b in self._meeting.apart for facets in (a, b)]
        return np.column_stack([skin.body[f], *sets]).astype(np.int64)

    def _may_meet(self, one: Ints, other: Ints) -> Bools:
        """Whether edge segments with these visibility keys may touch ``(k,)``."""
        if self._meeting.itself is None:
            return np.ones(len(one), dtype=bool)
        may: Bools = (one[:, 0] != other[:, 0]) | self._meeting.itself[one[:, 0]]
        for k in range(1, one.shape[1], 2):
            a, b = (part[:, k : k + 2] > 0 for part in (one, other))
            may &= ~((a[:, 0] & b[:, 1]) | (a[:, 1] & b[:, 0]))
        return may

    def find(self) -> Crossing | None:
        """The deepest crossing, or None (collective)."""
        return find_crossing(self._own, self._theirs, self._keys, self._may_meet)


def warn(name: str, found: Crossing) -> None:
    """Warn of edges that cross."""
    place = ", ".join(f"{x:.6g}" for x in found.place)
    logger.warning(
        "%s: sharp edges of two surfaces cross between their nodes, %.4g deep inside each other at (%s), and no equation holds them apart: "
        "take edges = True, with hard contact and sliding = 'finite'; else refine both edges there, or round them off",
        name, found.depth, place,
    )  # fmt: skip
