"""Convex corners of a target that enter the contactors' facets: nodes on facets do not see them, so they are looked for and told of.

Between two contactors nothing keeps a target's corner out of the facet. How deep it is in there, times the stiffness of both bodies at
this place, is force that the contact lacks; beside the contact force it tells how wrong the answer is, whatever the load.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.contact.active_set import TIED
from uem_dolfinx.contact.interface import Interface
from uem_dolfinx.errors import OrientationError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets, nodes_of_facets
from uem_dolfinx.geometry.search import MeshTarget, nearest_of
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import reduced

#: A node of a target is at a convex corner if a facet falls away from the mean of the normals there by more than this.
#: [convention; sine; test_target_corners.py::test_what_is_a_corner]
FALLS = 0.15
#: Corners that are no deeper in a facet than this part of its size lie on it.
#: [convention; size of the facet; test_target_corners.py::test_what_is_told]
ON_FACET = 1e-2
#: Corners are told of where the contact lacks more than this part of its force by them: resultants are then wrong by a per cent or more.
#: [convention; largest contact force so far; test_target_corners.py::test_what_is_told]
LACKING = 0.1


@dataclass(frozen=True)
class CornerInside:
    """Corners of a target inside the contactors' surface.

    Attributes:
        place: where the one that is deepest for its facet was drawn, as text.
        depth: of this one, a length.
        part: of the facet's size that it is deep.
        lacking: force that the contact lacks by all of them, over the largest contact force so far.
    """

    place: str
    depth: float
    part: float
    lacking: float

    def __str__(self) -> str:
        return (
            f"a convex corner of the target, at {self.place}, is {self.depth:.3g} inside a facet of the contactor, "
            f"{100 * self.part:.2g} % of its size, between contactors, which do not see it: swap the two, or take coupling = 'mortar'"
        )


class TargetCorners:
    """The convex corners of a pair's target, and the contactors' surface that they may enter (collective).

    Args:
        pair: with equations at nodes.
        tag: of the contactors' facets.
    """

    def __init__(self, pair: Interface, tag: Tag):
        self.pair, self._tag, config = pair, tag, pair.config
        self._largest = 0.0
        #: Owned nodes of the target at corners and ends ``(k,)``, and whether any rank has one.
        self.nodes = corner_nodes(config, pair.target.facets) if isinstance(pair.target, MeshTarget) else np.zeros(0, np.int32)
        self.some = isinstance(pair.target, MeshTarget) and bool(reduced(config.comm, len(self.nodes)))
        if not self.some:
            return
        x = config.x[nodes_of_facets(config, tag).dofs]
        sides = np.linalg.norm(x[:, 0] - x[:, 1], axis=1)
        #: Sizes of the largest and of the smallest facet, lengths.
        self.reach: float = reduced(config.comm, float(np.ptp(x, axis=1).max(initial=0.0)), op=MPI.MAX)
        self.smallest: float = reduced(config.comm, float(sides.min(initial=np.inf)), op=MPI.MIN)

    @cached_property
    def surface(self) -> MeshTarget | None:
        """The contactors' surface; None inside a body, which has no outside that a corner could come from (first time: collective)."""
        try:
            return MeshTarget(TargetFacets(self.pair.config, self._tag, "contactor"))
        except OrientationError:
            return None

    @timed("corners of the target")
    def find(self, stiffness: Array) -> CornerInside | None:
        """The corners that are inside where the bodies are now; None if they do not matter (collective).

        Args:
            stiffness: diagonal of K at the owned nodes ``(n_owned, gdim)``, a force per length.
        """
        pair, config, comm = self.pair, self.pair.config, self.pair.config.comm
        if not self.some or pair.mutual:
            return None
        near = self._near()
        some, force = reduced(comm, np.array([len(near), pair.trial.lam.sum()]))
        # bodies that part press hardly any more
        self._largest = force = max(force, self._largest)
        if not some:
            return None
        # beside a contactor none is deeper than it is away from there
        points, least = pair.points, ON_FACET * self.smallest
        distance, _ = nearest_of(comm, config.x[near], points, least, np.zeros((len(points), 1)))
        near = near[distance > least]
        if not reduced(comm, len(near)) or self.surface is None:
            return None
        points = config.x[near]
        p = self.surface.project(points)
        depth, part = -p.gap, -p.gap / p.facet_size
        inside = (part > ON_FACET) & (p.from_end > 0.0) & (p.beyond == 0.0).all(axis=1)
        # deeper than the cell behind the facet it may as well be behind the body
        inside &= depth < self.surface.of_facets(p.facet, self.surface.facets.depth)
        if not reduced(comm, int(inside.sum())):
            return None
        stiffness = np.abs(stiffness)
        of_facet = config.ask_owners(p.nodes.ravel(), stiffness).reshape(*p.nodes.shape, config.gdim)
        theirs, own = (
            np.einsum("na,nag,ng->n", p.weights, of_facet, p.normal**2),
            np.einsum("ng,ng->n", stiffness[near], p.normal**2),
        )
        both = np.where(inside, theirs * own / np.where(theirs + own > 0.0, theirs + own, 1.0), 0.0)
        lacking = reduced(comm, float(both @ depth))
        if not lacking > LACKING * force:
            return None
        found = [(float(part[i]), config.describe(int(near[i])), float(depth[i])) for i in np.flatnonzero(inside)]
        everywhere = sorted((one for there in comm.allgather(found) for one in there), reverse=True)
        # of equals the one that no rounding and no partition chooses
        deepest = min(place for part, place, _ in everywhere if part >= (1.0 - TIED) * everywhere[0][0])
        part, place, deep = next(one for one in everywhere if one[1] == deepest)
        return CornerInside(place, deep, part, lacking / force if force > 0.0 else np.inf)

    def _near(self) -> Indices:
        """Corners in the box of the contactors that are no farther from the target than a facet is large (collective)."""
        pair, config = self.pair, self.pair.config
        points = pair.points
        points = points[np.linalg.norm(points - pair.projection.foot, axis=1) <= self.reach]
        bounds = np.concatenate([np.max(sign * points, axis=0, initial=-np.inf) for sign in (-1.0, 1.0)])
        config.comm.Allreduce(MPI.IN_PLACE, bounds, op=MPI.MAX)
        x, g = config.x[self.nodes], config.gdim
        return self.nodes[((x >= -bounds[:g] - self.reach) & (x <= bounds[g:] + self.reach)).all(axis=1)]


def corner_nodes(config: Configuration, facets: TargetFacets) -> Indices:
    """Owned nodes of a surface at its convex corners and edges, and at its ends ``(k,)`` (collective)."""
    data = facets.current()
    arms = data.x[:, None] - data.x[:, :, None]
    length = np.linalg.norm(arms, axis=3)
    falls = -np.einsum("mabg,mag->mab", arms, data.nodal_normals) > FALLS * length
    falls &= length > 0.0
    at_corner = falls.any(axis=2) | facets.open_nodes
    marked = config.to_owners(facets.dofs[at_corner], np.ones(int(at_corner.sum())))
    return np.flatnonzero(marked[: config.n_owned] > 0).astype(np.int32)
