"""Parallel closest-point search: gap, normal, weights and facet nodes for the positions of contactors.

A point is sent only to ranks whose part of the target can be nearest. Only the closest point and its facet are returned, so that no
rank holds a whole surface; derived quantities are computed on the rank of the point.
"""

from __future__ import annotations

from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import AnyArray, Array, Bools, Indices, Ints, replace
from uem_dolfinx.geometry.candidates import EQUALLY_NEAR, RankBoxes, candidate_pairs
from uem_dolfinx.geometry.facets import FacetData, TargetFacets
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.shapes import FacetShape, Tabulated, beneath, closest_point, unit_normals
from uem_dolfinx.parallel import Exchange, reduced

#: An averaged normal that leans further from the facet's no longer determines the position of the facet.
#: [convention; cosine of their angle; test_thresholds_geometry.py::test_gap_along_a_leaning_normal]
LEAST_LEAN = 0.1
#: A foot that is nearer to a side of its facet lies on it, and a point that is nearer to the foot on the facet.
#: [convention; reference coordinates, and lengths of a side; test_thresholds_geometry.py::test_points_on_a_side]
ON_SIDE = 1e-10
#: A point whose height over a facet is less than this part of its distance from a corner at the surface's end lies past the end.
#: [convention; the distance; test_thresholds_geometry.py::test_points_past_an_end]
SIDEWAYS = 0.1


class Feet(NamedTuple):
    """Closest points on facets: the data sent from the ranks of facets to the ranks of points."""

    facet: Ints  # number over all ranks ``(n,)``
    key: Ints  # of the facet, independent of the partition ``(n,)``
    xi: Array  # reference coordinates ``(n, fdim)``
    x: Array  # current positions of the facet's nodes ``(n, nn, gdim)``
    nodes: Ints  # their global numbers ``(n, nn)``
    nodal_normals: Array  # averaged normals there ``(n, nn, gdim)``
    sign: Array  # factor that makes the parametrisation's normal point outwards ``(n,)``
    open_sides: Bools  # sides that bound the surface ``(n, n_sides)``
    open_nodes: Bools  # nodes on such sides ``(n, nn)``
    #: height of the point in front of or behind the facet, see ``_facing`` ``(n,)``; zero for facets given by number.
    facing: Array
    cosine: Array  # least cosine between the facet's normal and the normals around the point if known, else 0 ``(n,)``


class MeshTarget:
    """Meshed target, distributed over the ranks; if ``averaged``, normals are interpolated from averaged nodal normals."""

    motion: Any = None

    def __init__(self, facets: TargetFacets, averaged: bool = False):
        self.facets, self.averaged = facets, averaged
        self.shape: FacetShape = facets.shape
        self.comm: MPI.Comm = facets.config.comm
        self.dofs: Indices = facets.dofs
        self.n_nodes = facets.dofs.shape[1]
        corners = facets.config.X[facets.dofs[:, : len(self.shape.topology[0])]]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        # half the depth of the thinnest cell, or half the shortest side of a facet
        shortest = min(sides.min(initial=np.inf), facets.depth.min(initial=np.inf))
        self.stride = 0.5 * reduced(self.comm, float(shortest), op=MPI.MIN)
        self.first: Ints = facets.first
        self._nowhere: FacetProjection | None = None

    def project(self, points: Array, which: Ints | None = None) -> FacetProjection:
        """Exact closest points of ``points (n, gdim)`` on the whole target (collective).

        Args:
            points: positions.
            which: numbers of the contactors at these points ``(n,)``, for targets that depend on the contactor; None: all contactors.
        """
        data = self.facets.current(corners=True)
        if self.comm.size == 1:
            return self._evaluate(points, self._project_here(points, data))
        # the distance found by the rank that seems nearest excludes most other ranks
        boxes = self.boxes(data.x)
        first = boxes.nearest(points)
        found, feet = self._ask(Exchange.to(self.comm, first), data, points)
        bound = np.linalg.norm(points - found.foot, axis=1) * (1 + EQUALLY_NEAR) + ON_SIDE * self.stride
        return self._ask(Exchange(self.comm, boxes.near(points, bound, but=first)), data, points, found=feet)[0]

    def project_on(self, points: Array, facet: Ints) -> FacetProjection:
        """Closest points of ``points (n, gdim)`` on the facets numbered ``facet (n,)`` (collective)."""
        return self._ask(self.facets.owners(facet), self.facets.current(), points, facet)[0]

    def at(self, points: Array, facet: Ints, xi: Array) -> FacetProjection:
        """Projection of ``points (n, gdim)`` with given reference coordinates ``xi (n, fdim)`` of facets (collective)."""
        return self._ask(self.facets.owners(facet), self.facets.current(), points, facet, xi)[0]

    def follow(self, points: Array, old: FacetProjection) -> FacetProjection:
        """Gaps of ``points (n, gdim)`` with reference coordinates, normals and weights of an earlier projection (collective)."""
        new, _ = self._ask(self.facets.owners(old.facet), self.facets.current(), points, old.facet, old.xi)
        gap = np.einsum("ng,ng->n", old.normal, points - new.foot)
        return replace(new, gap=gap, normal=old.normal, beyond=old.beyond)

    def nowhere(self, points: Array) -> FacetProjection:
        """Projection of ``points (n, gdim)`` without a facet nearby: no facet, no normal, and the model's size as gap."""
        if self._nowhere is None or len(self._nowhere.gap) != len(points):
            n, g, nn, d = len(points), self.facets.config.gdim, self.n_nodes, self.shape.dim
            facet, none = np.zeros((nn, g)), np.zeros((n, g))
            facet[:, :d] = self.stride * self.shape.nodes
            tab = self.shape.at_middle(n)
            self._nowhere = FacetProjection(
                np.full(n, self.facets.config.size), none, np.full((n, nn), -1), np.zeros((n, nn)), np.full(n, -1), none,
                np.full(n, np.inf), np.zeros((n, d)), none, none, np.tile(facet, (n, 1, 1)), tab.dN, tab.ddN, np.zeros((n, d, g)),
            )  # fmt: skip
        return replace(self._nowhere, foot=points)

    measures = True  # gaps are distances everywhere, and bounding boxes detect surfaces that are separated

    @property
    def faceted(self) -> bool:
        """Whether normals jump from facet to facet."""
        return not self.averaged

    @property
    def keys(self) -> Ints:
        """Key of each of this rank's facets, independent of the partition ``(m,)``."""
        return self.facets.keys

    def continued(self, projection: FacetProjection, which: Ints, places: Array) -> FacetProjection:
        """The projection with some facets continued past their sides, up to below ``places (k, gdim)``."""
        p, x = projection, projection.x[which]
        xi, tab = beneath(self.shape, x, p.xi[which], places)
        foot = np.einsum("ka,kag->kg", tab.N, x)
        return p.with_rows(which, {"xi": xi, "weights": tab.N, "dN": tab.dN, "ddN": tab.ddN, "foot": foot})

    def chords(self, projection: FacetProjection) -> Array:
        """Weights of the straight pieces between the nodes of curved facets at the closest points ``(n, nn)`` [UEM, 4.5]."""
        return self.shape.chords(projection.xi)

    def reference(self, gdim: int) -> Array:
        """The origin."""
        return np.zeros(gdim)

    def outward(self, projection: FacetProjection) -> Array:
        """Outward normals of the facets at the closest points, also if ``normal`` is averaged ``(n, gdim)``."""
        own = unit_normals(Tabulated(projection.weights, projection.dN, projection.ddN), projection.x)
        return own * np.where(np.einsum("ng,ng->n", own, projection.averaged) < 0, -1.0, 1.0)[:, None]

    def spread(self, projection: FacetProjection) -> Array:
        """Sum of facet forces at the closest points over the force along their averaged normal ``(n,)`` (collective)."""
        at_nodes = self.of_facets(projection.facet, self.facets.spread())
        return np.asarray(np.einsum("na,na->n", projection.weights, at_nodes))

    def keys_of(self, facet: Ints) -> Ints:
        """Keys of the facets numbered ``facet (n,)``, -1 for -1 (collective; see ``TargetFacets.keys``)."""
        return self.of_facets(facet, self.facets.keys)

    def visibility_keys(self, which: Ints) -> Ints:
        """Visibility keys of the contactors ``which (k,)``: zeros, since they may touch all facets ``(k,)``."""
        return np.zeros(len(which), np.int64)

    def may_touch(self, visibility: Ints, facet: Ints) -> Bools:
        """Whether contactors with keys ``visibility (k,)`` may touch this rank's facets ``(k,)``."""
        return np.ones(len(visibility), bool)

    def allowed(self, visibility: Array, facet: Ints) -> Bools:
        """Whether contactor facets with keys ``visibility (k, m)`` may touch this rank's facets ``(k,)``."""
        return np.ones(len(facet), bool)

    def of_facets(self, facet: Ints, values: AnyArray) -> Any:
        """Values ``(m, ...)`` of ranks' own facets at the facets numbered ``facet (n,)``: ``(n, ...)``, -1 for -1 (collective)."""
        return self.facets.values_at(facet, values)

    def facets_of(self, keys: Ints) -> Ints:
        """Present numbers of the facets with these ``keys (n,)``, on any rank; -1 for keys of other surfaces (collective)."""
        size, mine = self.comm.size, self.facets.keys
        # known and wanted keys meet on the same rank
        known, number = Exchange.to(self.comm, mine % size).send(mine, self.first[self.comm.rank] + np.arange(len(mine)))
        order = np.argsort(known)
        known, number = known[order], np.append(number[order], -1)
        exchange = Exchange.to(self.comm, np.where(keys >= 0, keys % size, -1))
        (wanted,) = exchange.send(keys)
        at = np.searchsorted(known, wanted)
        facet = np.full(len(keys), -1, dtype=np.int64)
        (facet[exchange.rows],) = exchange.back(np.where(np.append(known, -1)[at] == wanted, number[at], -1))
        return facet

    def boxes(self, x: Array) -> RankBoxes:
        """Boxes around the facets of each rank, from the nodes of this rank's facets ``x (m, nn, gdim)`` (collective)."""
        # curved facets may extend beyond the box of their nodes
        return RankBoxes(self.comm, x.reshape(-1, x.shape[2]), 0.5 * (self.shape.lebesgue - 1))

    def _ask(
        self, exchange: Exchange, data: FacetData, points: Array, facet: Ints | None = None, xi: Array | None = None,
        found: Feet | None = None,
    ) -> tuple[FacetProjection, Feet]:  # fmt: skip
        """Send points to ranks (with facet and coordinates, if given), and keep the nearest of the closest points, including ``found``."""
        p, *rest = exchange.send(*(a for a in (points, facet, xi) if a is not None))
        if rest:
            rest[0] = rest[0] - self.first[self.comm.rank]
        feet = self._project_here(p, data, *rest)
        if self.comm.size == 1:
            return self._evaluate(points, feet), feet
        # closest points of several ranks are compared in the same way as on one rank
        rows, feet = exchange.rows, Feet._make(exchange.back(*feet))
        if found is not None:
            rows, feet = np.append(rows, np.arange(len(points))), Feet._make(map(np.concatenate, zip(feet, found)))
        return self._nearest_foot(points, rows, feet)

    def _nearest_foot(self, points: Array, rows: Ints, feet: Feet) -> tuple[FacetProjection, Feet]:
        """The nearest of several candidates ``feet`` of ``points (n, gdim)`` with indices ``rows (k,)``, in the order of the points."""
        answer = self._evaluate(points[rows], feet)
        distance = np.linalg.norm(points[rows] - answer.foot, axis=1)
        best = _nearest(rows, distance, feet.facing, feet.key, ON_SIDE * self.stride, feet.cosine)
        return answer.take(best), Feet._make(a[best] for a in feet)

    def _project_here(self, points: Array, data: FacetData, facet: Ints | None = None, xi: Array | None = None) -> Feet:
        """Project onto this rank's facets."""
        if facet is None:
            return self._on_nearest(points, data, *candidate_pairs(self.shape, data.x, points))
        if xi is None:
            xi, _ = closest_point(self.shape, data.x[facet], points)
        none = np.zeros(len(points))
        return self._feet(facet, xi, data, none, none)

    def _on_nearest(
        self,
        points: Array,
        data: FacetData,
        pairs: Ints,
        candidates: Ints,
        cosine: Array | None = None,
        open_sides: Bools | None = None,
    ) -> Feet:
        """Closest points on the nearest candidates.

        Args:
            points: ``(n, gdim)``.
            data: of this rank's facets.
            pairs: indices of points ``(k,)``.
            candidates: this rank's facets that may be nearest ``(k,)``.
            cosine: see ``Feet``; decides between candidates of equal distance and ``facing`` ``(k,)``; None if not known.
            open_sides: sides of the candidates that bound the surface for their point ``(k, n_sides)``; None: boundary of the surface.
        """
        xi, d2 = closest_point(self.shape, x := data.x[candidates], points[pairs])
        tab = self.shape.tabulate(xi)
        away = points[pairs] - np.einsum("na,nag->ng", tab.N, x)
        facing = self._facing(tab, away, candidates, data)
        cosine = np.zeros(len(pairs)) if cosine is None else cosine
        best = _nearest(pairs, np.sqrt(d2), facing, self.facets.keys[candidates], ON_SIDE * self.stride, cosine)
        opened = None if open_sides is None else open_sides[best]
        return self._feet(candidates[best], xi[best], data, facing[best], cosine[best], opened)

    def _feet(
        self, facet: Ints, xi: Array, data: FacetData, facing: Array, cosine: Array, open_sides: Bools | None = None
    ) -> Feet:
        of = self.facets
        open_nodes = of.open_nodes[facet]
        if open_sides is None:
            open_sides = of.open_sides[facet]
        else:
            for s, (_, nodes, _, _) in enumerate(self.shape.edges):
                open_nodes[:, nodes] |= open_sides[:, s, None]
        return Feet(
            facet + self.first[self.comm.rank], of.keys[facet], xi, data.x[facet], data.nodes[facet], data.nodal_normals[facet],
            of.sign[facet], open_sides, open_nodes, facing, cosine,
        )  # fmt: skip

    def _facing(self, tab: Tabulated, away: Array, facet: Ints, data: FacetData) -> Array:
        """Height of points in front of facets, or depth behind them if they are inside the body, a length ``(n,)``.

        It is the height over the facet's plane for points outside, and the depth below it for points inside. If the closest point
        is on an edge or inside the facet, the facet with the larger distance decides on the side of the surface. If it is a corner,
        where facets may hide each other, all facets around it decide together, unless the surface ends there.

        Args:
            tab: shape functions at the closest points of the facets.
            away: vectors from the closest points to the points ``(n, gdim)``.
            facet: this rank's numbers of the facets ``(n,)``.
            data: this rank's facets.
        """
        assert data.corner_normals is not None
        n_corners = data.corner_normals.shape[1]
        height = np.einsum("ng,ng->n", away, unit_normals(tab, data.x[facet])) * self.facets.sign[facet]
        corner, is_open = tab.N[:, :n_corners] > 1 - ON_SIDE, self.facets.open_nodes[facet, :n_corners]
        at_corner = corner & ~is_open
        above = np.einsum("nc,ncg,ng->n", at_corner, data.corner_normals[facet], away)
        # past the end of the surface, all facets that share a corner have equal ``facing``
        past = (corner & is_open).any(axis=1) & (np.abs(height) < SIDEWAYS * np.linalg.norm(away, axis=1))
        return np.where(at_corner.any(axis=1), np.copysign(1.0, above) * height, np.where(past, 0.0, np.abs(height)))

    def _evaluate(self, points: Array, feet: Feet) -> FacetProjection:
        """Gap, normal and geometry at the closest points of ``points (n, gdim)``."""
        xi, x = feet.xi, feet.x
        tab = self.shape.tabulate(xi)
        foot = np.einsum("na,nag->ng", tab.N, x)
        facet_normal = unit_normals(tab, x) * feet.sign[:, None]
        raw = np.einsum("na,nag->ng", tab.N, feet.nodal_normals)
        length = np.linalg.norm(raw, axis=1, keepdims=True)
        divisor = np.where(length > 0, length, 1.0)
        averaged_normal = raw / divisor
        on_side = self.shape.side_distances(xi) < ON_SIDE
        is_open = feet.open_sides
        away = points - foot
        # exactly on a shared side either facet's normal would be an arbitrary choice
        at_side = np.linalg.norm(away, axis=1) <= ON_SIDE * np.linalg.norm(x[:, 0] - x[:, 1], axis=1)
        use_average = np.full(len(points), True) if self.averaged else at_side & (on_side & ~is_open).any(axis=1)
        use_average &= length[:, 0] > 0
        normal = np.where(use_average[:, None], averaged_normal, facet_normal)
        shape_operator = np.einsum("naf,nag->nfg", tab.dN, feet.nodal_normals) / divisor[:, :, None]
        shape_operator -= np.einsum("nfg,ng,nh->nfh", shape_operator, averaged_normal, averaged_normal)
        shape_operator[~use_average] = 0.0
        # the distance to the facet along an inclined averaged normal exceeds the shortest distance
        lean = np.einsum("ng,ng->n", normal, facet_normal)
        gap = np.einsum("ng,ng->n", facet_normal, away) / np.where(lean > LEAST_LEAN, lean, 1.0)
        beyond = away - gap[:, None] * normal
        # only a vertex of a facet may lie on the end of the surface
        at_end = (on_side & is_open).any(axis=1) | ((tab.N > 1 - ON_SIDE) & feet.open_nodes).any(axis=1)
        beyond[~at_end] = 0.0
        from_end = np.where(is_open, self.shape.side_distances(xi), np.inf).min(axis=1, initial=np.inf)
        from_end[at_end] = 0.0
        return FacetProjection(
            gap,
            normal,
            feet.nodes,
            tab.N,
            feet.facet,
            beyond,
            from_end,
            xi,
            foot,
            averaged_normal,
            x,
            tab.dN,
            tab.ddN,
            shape_operator,
        )


def _nearest(points: Ints, distance: Array, facing: Array, key: Ints, rounding: float, cosine: Array | None = None) -> Ints:
    """The nearest of several candidates for each point, as indices.

    Facets that share an edge are equally near to a point outside a convex edge, and to one behind a concave edge. The one with the
    largest ``facing`` is taken, so that the gap vanishes on no plane of another facet. The next criterion is the smallest
    ``cosine``, the last one the facets' keys, which are independent of the partition. Lengths that differ by at most ``rounding``,
    or by a small part of the distance, are equal.
    """
    n = points.max(initial=-1) + 1
    closest, most = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(closest, points, distance)
    band = (EQUALLY_NEAR * closest + rounding)[points]
    farther = distance > closest[points] + band
    np.maximum.at(most, points, np.where(farther, -np.inf, facing))
    aslant = facing < most[points] - band
    cosine = np.zeros(len(points)) if cosine is None else cosine
    least = np.full(n, np.inf)
    np.minimum.at(least, points, np.where(farther | aslant, np.inf, cosine))
    order = np.lexsort((key, cosine > least[points] + EQUALLY_NEAR, aslant, farther, points))
    _, first = np.unique(points[order], return_index=True)
    return order[first]


def nearest_of(comm: MPI.Comm, points: Array, places: Array, within: float, values: Array) -> tuple[Array, Array]:
    """Distance of each point from the nearest position on any rank, and the values there (collective).

    Positions are sent only to ranks with points nearby.

    Args:
        comm: communicator.
        points: ``(n, gdim)``.
        places: positions on this rank ``(m, gdim)``.
        within: largest distance of the search; the same on all ranks.
        values: at these positions ``(m, k)``.

    Returns:
        Distances ``(n,)``, infinite if no position is near, and values ``(n, k)``, zero there.
    """
    sent = RankBoxes(comm, points).near(places, np.full(len(places), within * (1 + EQUALLY_NEAR)))
    there, arrived = Exchange(comm, sent).send(places, values)
    distance, found = np.full(len(points), np.inf), np.zeros((len(points), values.shape[1]))
    if len(there) and len(points):
        from scipy.spatial import cKDTree

        length, which = cKDTree(there).query(points)
        i = length <= within
        distance[i], found[i] = length[i], arrived[which[i]]
    return distance, found
