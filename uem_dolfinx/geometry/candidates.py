"""Candidates for nearest facets, and pairs of intersecting balls, by trees over facet midpoints. Pure geometry, on one rank.

Which ranks have a surface near which points: bounding boxes of all ranks' parts, known to every rank.

Only boxes near the box around all points of this rank are compared with single points. So time and memory grow with the points
and the parts nearby, not with the number of ranks.
"""

from __future__ import annotations

from collections.abc import Iterator

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.geometry.shapes import FacetShape, unit_normals
from uem_dolfinx.log import timed_as

#: Facets whose distances differ by less are equally near, and those whose heights do are faced alike.
#: [convention; part of the distance; test_thresholds_geometry.py::test_facets_equally_near]
EQUALLY_NEAR = 1e-9
#: So few pairs are all measured at once, which takes less time than trees.
#: [bound; points times facets; test_thresholds_geometry.py::test_no_facet_is_forgotten]
ALL_PAIRS = 2**15


@timed_as("search")
def candidate_pairs(
    shape: FacetShape, x: Array, points: Array, surface_of_point: Ints | None = None, surface: Ints | None = None
) -> tuple[Ints, Ints]:
    """Indices ``(k,)`` of points and of facets that can be closest; with many facets by one tree of midpoints per size class.

    A facet of radius R is a candidate if its middle is within R of the bound that the nearest middle gives. Sorting the facets
    into classes of like radius keeps a graded mesh from paying for its largest facet everywhere. Every one of the
    ``points (n, gdim)`` occurs at least once if there are facets, whose nodes are at ``x (m, nn, gdim)``. With numbers of surfaces those of
    each point's surface, ``surface_of_point (n,)``, are its only candidates; ``surface (m,)`` are those of the facets.
    """
    if len(points) == 0 or len(x) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    tab = shape.at_middle(len(x))
    middle = np.einsum("na,nag->ng", tab.N, x)
    arm = x - middle[:, None]
    radius = shape.lebesgue * np.linalg.norm(arm, axis=2).max(axis=1)
    normal = unit_normals(tab, x)
    bulge = shape.lebesgue * np.abs(np.einsum("mag,mg->ma", arm, normal)).max(axis=1)
    places, middles = points, middle
    if surface_of_point is not None and surface is not None:
        # a further axis, along which different surfaces are too far from each other to be near
        far = 4.0 * float(np.ptp(np.concatenate([points, middle]), axis=0).sum() + radius.max())
        places, middles = np.column_stack([points, far * surface_of_point]), np.column_stack([middle, far * surface])
    if len(places) * len(middles) <= ALL_PAIRS:
        distance = np.sqrt(sum([(places[:, None, k] - middles[:, k]) ** 2 for k in range(places.shape[1])]))
        bound = distance.min(axis=1) * (1 + EQUALLY_NEAR)
        i, f = np.nonzero(distance <= bound[:, None] + radius)
    else:
        from scipy.spatial import cKDTree

        bound = cKDTree(middles).query(places)[0] * (1 + EQUALLY_NEAR)
        i, f = balls_that_meet(places, bound, middles, radius)
    # a facet lies in a flat disc about its midpoint; from a distance, fewer discs than balls are near
    away = points[i] - middle[f]
    height = np.abs(np.einsum("kg,kg->k", away, normal[f]))
    lateral = np.sqrt(np.maximum(np.einsum("kg,kg->k", away, away) - height**2, 0.0))
    too_far = np.hypot(np.maximum(height - bulge[f], 0.0), np.maximum(lateral - radius[f], 0.0)) > bound[i]
    return i[~too_far], f[~too_far]


def balls_that_meet(points: Array, within: Array, middle: Array, radius: Array) -> tuple[Ints, Ints]:
    """Pairs ``(k,)`` of balls about ``points (n, gdim)`` and about facet midpoints ``(m, gdim)``, m > 0, that may intersect.

    There is a tree for each class of balls of similar radius on either side.

    Args:
        points: centres of the first balls.
        within: their radii ``(n,)``.
        middle: midpoints of the facets.
        radius: of the facets ``(m,)``.
    """
    from scipy.spatial import cKDTree

    rows, facets = [], []
    smallest = radius.min()
    theirs = [(which, cKDTree(middle[which]), radius[which].max()) for which in _like(radius)]
    for own in _like(np.maximum(within, smallest)):
        tree, largest = cKDTree(points[own]), within[own].max()
        for which, other, r in theirs:
            found = tree.sparse_distance_matrix(other, largest + r, output_type="ndarray")
            if not len(found):
                continue
            i, f = own[found["i"]], which[found["j"]]
            near = found["v"] <= within[i] + r
            rows.append(i[near])
            facets.append(f[near])
    none = np.zeros(0, np.int64)
    return np.concatenate([none, *rows]), np.concatenate([none, *facets])


def _like(sizes: Array) -> list[Ints]:
    """Indices of positive sizes in classes that differ by less than a factor of two."""
    size_class = np.floor(np.log2(sizes / sizes.max(initial=0.0)))
    order = np.argsort(size_class, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(size_class[order])) + 1) if len(order) else []


class RankBoxes:
    """Boxes around the positions on each rank, by kinds of positions (the constructor is collective).

    Args:
        places: positions on this rank ``(m, gdim)``.
        out: relative enlargement of the boxes to each side.
        kind: of each position, from 0 ``(m,)``; None: all alike.
        n_kinds: number of kinds.
    """

    def __init__(self, comm: MPI.Comm, places: Array, out: float = 0.0, kind: Ints | None = None, n_kinds: int = 1):
        self.size = comm.size
        mine = np.full((2, n_kinds, places.shape[1]), -np.inf)
        kind = np.zeros(len(places), np.int64) if kind is None else kind
        for side, sign in enumerate((-1.0, 1.0)):
            np.maximum.at(mine[side], kind, sign * places)
        every = np.empty((comm.size, *mine.shape))
        comm.Allgather(mine, every)
        low, high = -every[:, 0], every[:, 1]
        more = out * np.where(low <= high, high - low, 0.0)
        #: Corners of the boxes ``(size, n_kinds, gdim)``, low > high for ranks without positions.
        self.low, self.high = low - more, high + more

    def nearest(self, points: Array, kind: Ints | None = None) -> Ints:
        """The rank that seems nearest to each point ``(n, gdim)``: of those with the nearest box that whose box ends first ``(n,)``."""
        first = np.zeros(len(points), np.int64)
        near, far = np.full((2, len(points)), np.inf)
        about = _Group(self, points, kind)
        # no box nearer than the end of another one is left out
        for rank in about.ranks_within(about.ends):
            begins, ends = self._distances(rank, points, about.kind)
            better = (begins < near) | ((begins == near) & (ends < far))
            first[better], near[better], far[better] = rank, begins[better], ends[better]
        return first

    def near(
        self, points: Array, within: Array, kind: Ints | None = None, more: Array | None = None, but: Ints | None = None
    ) -> list[Ints]:
        """For each rank the points that lie within a distance of its box, in their order.

        Args:
            points: ``(n, gdim)``.
            within: distances ``(n,)``.
            kind: of the positions that count for each point ``(n,)``; None: all are alike.
            more: what each rank adds to the distances ``(size,)``.
            but: a rank for each point that is left out ``(n,)``.
        """
        none = np.zeros(0, np.int64)
        lists = [none] * self.size
        about = _Group(self, points, kind)
        most = np.full(self.low.shape[1], -np.inf)
        np.fmax.at(most, about.kind, within)
        for rank in about.ranks_within(most + (0.0 if more is None else more[:, None])):
            seen = self._distances(rank, points, about.kind)[0] <= within + (0.0 if more is None else more[rank])
            lists[rank] = np.flatnonzero(seen if but is None else seen & (but != rank))
        return lists

    def _distances(self, rank: int, points: Array, kind: Ints) -> tuple[Array, Array]:
        """Bounds on the distance of each point from the positions of a rank ``(n,)``; infinite without any."""
        low, high = self.low[rank, kind], self.high[rank, kind]
        near = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)
        far = np.linalg.norm(np.maximum(np.abs(points - low), np.abs(points - high)), axis=1)
        some = low[:, 0] <= high[:, 0]
        return np.where(some, near, np.inf), np.where(some, far, np.inf)


class _Group:
    """The points of this rank by kinds, and the boxes around them."""

    def __init__(self, boxes: RankBoxes, points: Array, kind: Ints | None):
        self.kind = np.zeros(len(points), np.int64) if kind is None else kind  # of each point ``(n,)``
        n_kinds, g = boxes.low.shape[1:]
        low, high = np.full((n_kinds, g), np.inf), np.full((n_kinds, g), -np.inf)
        np.minimum.at(low, self.kind, points)
        np.maximum.at(high, self.kind, points)
        some = (low[:, 0] <= high[:, 0]) & (boxes.low[:, :, 0] <= boxes.high[:, :, 0])
        with np.errstate(invalid="ignore"):
            near = np.linalg.norm(np.maximum(np.maximum(boxes.low - high, low - boxes.high), 0.0), axis=2)
            far = np.linalg.norm(np.maximum(np.abs(high - boxes.low), np.abs(low - boxes.high)), axis=2)
        self._near = np.where(some, near, np.inf)
        #: a distance for each kind within which every point of it has a position ``(n_kinds,)``; infinite without any.
        self.ends = np.where(some, far, np.inf).min(axis=0)

    def ranks_within(self, distances: Array) -> Iterator[int]:
        """Ranks with a box within a distance of the box around the points of its kind, by distances ``(n_kinds,)`` or of each rank too."""
        return iter(np.flatnonzero(((self._near <= distances) & np.isfinite(self._near)).any(axis=1)).tolist())
