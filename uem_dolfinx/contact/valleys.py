"""Which facets contactors rest on where normals jump from facet to facet: changes across bends, corners entered and left.

A part of the fourth step on the data's way; it answers with new states and projections, and the pair takes them over.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from uem_dolfinx.contact.corners import Corners, find_corners
from uem_dolfinx.geometry.projection import FacetProjection

if TYPE_CHECKING:
    from uem_dolfinx.contact.state import PairState
    from uem_dolfinx.geometry.configuration import Configuration
    from uem_dolfinx.geometry.projection import Projection
    from uem_dolfinx.geometry.search import MeshTarget

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

#: So many bends a contactor passes freely in a step before a concave one holds it: sliding far is no chatter.
HOLD_AFTER = 2
#: A contactor that has changed facets across bends this often in a step gets averaged normals for the rest of it.
MOST_CHANGES = 8
#: A corner holds a contactor if its free components keep this part of each of the corner's directions.
FREE_ENOUGH = 1e-3


class FacetChanges:
    """Follows contactors from facet to facet of a target with the facets' own normals.

    Args:
        config: configuration of the displacement.
        target: whose facets they are.
        free: components of the contactors without Dirichlet condition ``(n, gdim)``.
    """

    def __init__(self, config: Configuration, target: MeshTarget, free: Bools):
        self.config, self.target, self.free = config, target, free
        #: Corners that hold contactors, None if no rank has any.
        self.corners: Corners | None = None
        self._nearest: FacetProjection
        self._left: Bools = np.zeros(len(free), dtype=bool)

    def place(self, nearest: Projection, state: PairState, points: Array) -> Projection:
        """Put contactors that a corner holds into it, and give those that change facets too often averaged normals (collective).

        Args:
            nearest: the contactors on their nearest facets.
            state: of the pair.
            points: current positions of the contactors ``(n, gdim)``.
        """
        assert isinstance(nearest, FacetProjection)
        self._nearest = nearest
        locked = state.changes >= MOST_CHANGES
        gap = np.einsum("ng,ng->n", nearest.averaged, points - nearest.foot)
        normal = np.where(locked[:, None], nearest.averaged, nearest.normal)
        projection = replace(nearest, normal=normal, gap=np.where(locked, gap, nearest.gap))
        held = np.flatnonzero((state.held >= 0).any(axis=1))
        self.corners = c = self._corners_of(state, points, held, state.held[held])
        if c is None:
            return projection
        at_corner: dict[str, Any] = {"normal": c.axes[:, 0], "gap": c.gaps(points[held])[:, 0], "facet": state.facet[held]}
        return projection.with_rows(held, at_corner | {"nodes": c.nodes, "weights": c.weights, "foot": c.foot, "beyond": 0.0})

    def place_again(self, state: PairState, points: Array) -> Projection:
        """The projection after contactors have entered or left corners, their positions being the same (collective)."""
        # one that has just left is still as near to the facet it left
        left = np.flatnonzero(self._left & (state.held < 0).all(axis=1))
        nearest = self._nearest
        if self.config.comm.allreduce(len(left)):
            own = self.target.project_on(points[left], state.facet[left])
            own = replace(own, normal=self.target.outward(own))
            own = replace(own, gap=np.einsum("ng,ng->n", own.normal, points[left] - own.foot))
            nearest = nearest.with_rows(left, {f.name: getattr(own, f.name) for f in fields(own)})
        return self.place(nearest, state, points)

    def leave(self, state: PairState, trusted: bool) -> tuple[PairState, bool]:
        """Let go of the facet of a corner that would have to pull.

        Args:
            state: of the pair.
            trusted: whether its forces tell; otherwise only contactors that are not active let go.

        Returns:
            The new state, and whether a contactor on this rank has let go.
        """
        self._left = np.zeros(len(self.free), dtype=bool)
        c = self.corners
        if c is None or not len(c.which):
            return state, False
        i = c.which
        pulls = c.pulls(state.force[i])
        leaving = (trusted & (pulls < 0).any(axis=1)) | ~state.active[i]
        facets = np.column_stack([state.facet[i], state.held[i]])
        rows = np.flatnonzero(leaving)
        facets[rows, np.argmin(pulls[rows], axis=1)] = -1
        # the facets that stay move up
        facets = np.take_along_axis(facets, np.argsort(facets < 0, axis=1, kind="stable"), axis=1)
        facet, held = state.facet.copy(), state.held.copy()
        facet[i], held[i] = facets[:, 0], facets[:, 1:]
        held[~state.active] = -1
        self._left[i[leaving]] = True
        return replace(state, facet=facet, held=held), bool(leaving.any())

    def follow(self, state: PairState, points: Array) -> tuple[PairState, bool]:
        """Follow contactors onto new facets; into a concave corner they take the old facet with them (collective).

        Args:
            state: of the pair, after ``leave``.
            points: current positions of the contactors ``(n, gdim)``.

        Returns:
            The new state, and whether a contactor on this rank has entered a corner or left it for good.
        """
        nearest = self._nearest.facet
        known = (state.facet == nearest) | (state.held == nearest[:, None]).any(axis=1) | (state.facet < 0)
        moved = ~known & state.active & ~self._left & (state.changes < MOST_CHANGES)
        i = np.flatnonzero(moved)
        facet, held, changes = state.facet.copy(), state.held.copy(), state.changes.copy()
        settled = ~moved & ~self._left & (held < 0).all(axis=1)
        facet[settled] = nearest[settled]
        # first together with all facets that it is on, then with the first of them alone
        together = np.column_stack([state.held[i], nearest[i]])
        full = (state.held[i] >= 0).all(axis=1)
        together = np.take_along_axis(together, np.argsort(together < 0, axis=1, kind="stable"), axis=1)[:, : held.shape[1]]
        alone = np.full_like(together, -1)
        alone[:, 0] = nearest[i]
        taken = np.zeros(len(i), dtype=bool)
        entered = False
        for others, allowed in ((together, ~full), (alone, (state.held[i] >= 0).any(axis=1) | full)):
            ask = np.flatnonzero(allowed & ~taken)
            c = self._corners_of(state, points, i[ask], others[ask])
            if c is None:
                continue
            hold = c.concave & self._can_be_held(c) & (state.changes[c.which] >= HOLD_AFTER)
            held[c.which[hold]] = others[ask[hold]]
            taken[ask[hold]] = True
            changes[c.which[~c.flat]] += 1
            entered |= bool(hold.any())
        switch = i[~taken]
        facet[switch], held[switch] = nearest[switch], -1
        # one that is still led past the end of what holds it goes on with averaged normals
        past = ~known & state.active & (state.changes >= MOST_CHANGES) & (held >= 0).any(axis=1)
        facet[past], held[past] = nearest[past], -1
        entered |= bool(past.any())
        return replace(state, facet=facet, held=held, changes=changes), entered

    def _corners_of(self, state: PairState, points: Array, which: Ints, others: Ints) -> Corners | None:
        """Corners between the facet of some contactors and other facets ``(k, gdim - 1)`` (collective)."""
        return find_corners(self.config.comm, self.target, points[which], which, np.column_stack([state.facet[which], others]))

    def _can_be_held(self, c: Corners) -> Bools:
        """Corners whose contactor has a free direction for every facet ``(k,)``."""
        asked = np.arange(self.config.gdim) < c.count[:, None]
        A = np.where(asked[:, :, None], c.axes * self.free[c.which][:, None, :], 0.0)
        return (np.linalg.svd(A, compute_uv=False) > FREE_ENOUGH).sum(axis=1) == c.count
