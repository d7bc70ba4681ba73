"""Contacts whose surfaces are too far from each other to touch: they are not searched until they come near.

The check uses bounding boxes of the surfaces, of all contacts by one reduction, at the beginning of each step. Within the step, a contact
is searched as soon as its surfaces come near, or may come near by an increment.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.tables import contacts_with, slides
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import reduced

#: Meshed surfaces whose boxes are farther from each other than this are far apart.
#: [convention; the target's longest facet; test_far_apart.py::test_what_is_far_apart]
FACETS_AWAY = 1.0


class Boxes(NamedTuple):
    """Distances between bounding boxes of surfaces, in one configuration; lengths."""

    between: Array  # along every axis, in both directions, for meshed targets ``(n_meshed, 2 gdim)``
    middle: Array  # of the boxes around the contactors of rigid targets ``(n_rigid, gdim)``
    radius: Array  # half of their diagonals ``(n_rigid,)``
    distance: Array  # of their middles from the targets ``(n_rigid,)``

    @property
    def apart(self) -> Array:
        """Lower bounds of the distances between the surfaces, meshed targets first ``(n_pairs,)``."""
        return np.concatenate([self.between.max(axis=1), self.distance - self.radius])

    def apart_until(self, then: Boxes) -> Array:
        """Lower bounds of the distances during straight motions of all nodes to the configuration of ``then`` ``(n_pairs,)``."""
        # surfaces separated along an axis before and after are separated in between
        meshed = np.minimum(self.between, then.between).max(axis=1)
        way = np.linalg.norm(then.middle - self.middle, axis=1)
        rigid = 0.5 * (self.distance + then.distance - way) - np.maximum(self.radius, then.radius)
        return np.concatenate([meshed, rigid])


class FarApart:
    """Contacts of a problem that are not searched (collective).

    Only node-to-surface contacts with finite sliding can be skipped, with meshes, or with rigid surfaces whose gap is a distance.
    """

    def __init__(self, config: Configuration, pairs: Sequence[Interface]):
        self._config = config
        some = [one for pair in pairs if _may_be_far(pair) for one in pair.members]
        targets = [pair.target for pair in some if isinstance(pair.target, MeshTarget)]
        self._rigid: list[Any] = [pair.target for pair in some if not pair.target.n_nodes]
        self._pairs = sorted(some, key=lambda pair: not pair.target.n_nodes)
        surfaces = {id(target.facets): target.dofs for target in targets}
        unique = {key: np.unique(dofs) for key, dofs in surfaces.items()}
        number = {id(pair): k for k, pair in enumerate(self._pairs)}
        #: Interfaces in use, and the indices of their members in ``_pairs``.
        self._wholes = [pair for pair in pairs if _may_be_far(pair)]
        self._places: list[Ints] = [np.array([number[id(one)] for one in pair.members]) for pair in self._wholes]
        sides = [pair.nodes for pair in self._pairs] + [unique[id(target.facets)] for target in targets]
        lengths = np.array([len(side) for side in sides], np.int64)
        #: Nodes of all surfaces, the surfaces with nodes on this rank, and the start of their nodes.
        self._nodes: Ints = np.concatenate([np.zeros(0, np.int64), *sides])
        self._here: Ints = np.flatnonzero(lengths)
        self._begin: Ints = (np.cumsum(lengths) - lengths)[self._here]
        self._n_surfaces = len(sides)
        # facets of higher degree may exceed the box around their nodes
        self._out = np.array([0.5 * (target.shape.lebesgue - 1) for target in targets])
        longest = np.zeros(len(self._pairs))
        size = {key: np.linalg.norm(np.ptp(config.X[dofs], axis=1), axis=1).max(initial=0.0) for key, dofs in surfaces.items()}
        longest[: len(targets)] = [size[id(target.facets)] for target in targets]
        if some:
            config.comm.Allreduce(MPI.IN_PLACE, longest, op=MPI.MAX)
        #: Distances that count as near, without and with offsets ``(n_pairs,)``; boxes of the last check.
        self._reach = self._near = FACETS_AWAY * longest
        self._boxes: Boxes

    def begin_step(self, falls: bool) -> None:
        """Decide which contacts are too far away; if bodies fall in statics, gaps to rigid surfaces limit their motion (collective)."""
        if not self._pairs:
            return
        offsets = [pair.discretisation.setting.offset for pair in self._pairs]
        more = np.zeros((2, len(self._pairs)))
        more[0] = [0.0 if offset is None else offset.max(initial=0.0) for offset in offsets]
        # contacts with active contactors, or contactors past an end, are searched
        for place, p in zip(self._places, self._wholes):
            more[1, place] = contacts_with(p, p.trial.active | p.trial.passed | p.trial.barred)
        if not self.any and reduced(self._config.comm, more[1], op=MPI.MAX).all():
            # none is left out, and none will be
            return
        self._boxes, (offset, used) = self._look(self._config.x, more)
        self._near = self._reach + offset
        far = (used == 0.0) & (self._boxes.apart > self._near)
        far[len(far) - len(self._rigid) :] &= not falls
        for pair in self._set(far):
            pair.project()

    def place(self) -> None:
        """Search contacts that are near at the present positions, from the next projection on (collective)."""
        if self.any:
            self._boxes, _ = self._look(self._config.x)
            self._look_at(self._boxes.apart <= self._near)

    def look_within(self, way: float) -> bool:
        """Search contacts that may come near if nodes move by at most ``way`` along each axis; whether there are new ones (collective)."""
        if not self.any:
            return False
        found = self._look_at(self._boxes.apart <= self._near + 2.0 * np.sqrt(self._config.gdim) * way)
        for pair in found:
            pair.project()
        return bool(found)

    def look_along(self, ways: Array) -> bool:
        """Search contacts that may come near in straight motions ``(n_local, gdim)``; whether there are new ones (collective)."""
        if not self.any:
            return False
        then, _ = self._look(self._config.x + ways)
        return bool(self._look_at(self._boxes.apart_until(then) <= self._near))

    def look_at_all(self) -> bool:
        """Search all contacts from the next projection on; whether there are new ones."""
        return bool(self._look_at(np.ones(len(self._pairs), dtype=bool)))

    @property
    def any(self) -> bool:
        """Whether any contact is not searched."""
        return bool(self._far.any())

    def _look(self, x: Array, more: Array | None = None) -> tuple[Boxes, Array]:
        """Boxes with the local nodes at ``x (n_local, gdim)``, and the maximum over all ranks of ``more (k, n_pairs)`` (collective)."""
        n, g = len(self._pairs), self._config.gdim
        # negative lower and upper corners
        corners = np.full((self._n_surfaces, 2 * g), -np.inf)
        if len(self._here):
            places = x[self._nodes]
            corners[self._here, :g] = -np.minimum.reduceat(places, self._begin)
            corners[self._here, g:] = np.maximum.reduceat(places, self._begin)
        extremes = np.concatenate([corners.ravel(), np.zeros(0) if more is None else more.ravel()])
        self._config.comm.Allreduce(MPI.IN_PLACE, extremes, op=MPI.MAX)
        corners, most = extremes[: corners.size].reshape(-1, 2 * g), extremes[corners.size :].reshape(-1, n)
        low, high = -corners[:, :g], corners[:, g:]
        m = self._n_surfaces - n
        out = self._out[:, None] * (high[n:] - low[n:])
        between = np.concatenate([low[n:] - out - high[:m], low[:m] - high[n:] - out], axis=1)
        middle, radius = 0.5 * (low[m:n] + high[m:n]), 0.5 * np.linalg.norm(high[m:n] - low[m:n], axis=1)
        distance = np.array([target.distance_of(at[None])[0] for target, at in zip(self._rigid, middle)])
        return Boxes(between, middle, radius, distance), most

    @property
    def _far(self) -> Bools:
        """Mask of contacts that are not searched ``(n_pairs,)``."""
        far = np.zeros(len(self._pairs), dtype=bool)
        for place, pair in zip(self._places, self._wholes):
            far[place] = pair.discretisation.setting.far
        return far

    def _set(self, far: Bools) -> list[Interface]:
        """Set the mask of contacts that are not searched ``(n_pairs,)``; returns the interfaces for which it has changed."""
        changed = far != self._far
        found = [(far[place], pair) for place, pair in zip(self._places, self._wholes) if changed[place].any()]
        for some, pair in found:
            pair.discretisation.set(far=some)
        return [pair for _, pair in found]

    def _look_at(self, near: Bools) -> list[Interface]:
        """Search the contacts in the mask ``near (n_pairs,)``, too; returns the interfaces that were not searched before."""
        return self._set(self._far & ~near)


def _may_be_far(pair: Interface) -> bool:
    measured = pair.discretisation.traits.at_feet and getattr(pair.target, "measures", False)
    return measured and slides(pair) and pair.tie is None and not (pair.heats or pair.trial.has_law)
