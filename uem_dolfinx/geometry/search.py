"""Parallel closest-point search: from contactor positions to gap, normal, weights and the facet's nodes.

A point is sent only to the ranks whose part of the target can be nearest, and only its foot and facet come back, so that no rank
ever holds a whole surface; what follows from them is found where the point is.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import AnyArray, Array, Bools, Indices, Ints
from uem_dolfinx.geometry.candidates import EQUALLY_NEAR, candidate_pairs
from uem_dolfinx.geometry.facets import FacetData, TargetFacets
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.shapes import FacetShape, Tabulated, beneath, closest_point, unit_normals
from uem_dolfinx.parallel import Exchange, reduced

#: An averaged normal that leans further from the facet's no longer tells where the facet is.
#: [convention; cosine of their angle; test_thresholds_geometry.py::test_gap_along_a_leaning_normal]
LEAST_LEAN = 0.1
#: A foot that is nearer to a side of its facet lies on it, and a point that is nearer to the foot on the facet.
#: [convention; reference coordinates, and lengths of a side; test_thresholds_geometry.py::test_points_on_a_side]
ON_SIDE = 1e-10
#: A point whose height over a facet is less than this part of its distance from a corner at the surface's end lies past the end.
#: [convention; the distance; test_thresholds_geometry.py::test_points_past_an_end]
SIDEWAYS = 0.1


class Feet(NamedTuple):
    """Closest points on facets: all that travels from the facets' ranks to the points'.

    Attributes:
        facet: number over all ranks ``(n,)``.
        key: what tells the facet in any partition ``(n,)``.
        xi: reference coordinates ``(n, fdim)``.
        x: the facet's nodes where they are now ``(n, nn, gdim)``.
        nodes: their global numbers ``(n, nn)``.
        nodal_normals: averaged normals there ``(n, nn, gdim)``.
        sign: that turns the parametrisation's normal outwards ``(n,)``.
        open_sides: which sides bound the surface ``(n, n_sides)``.
        open_nodes: which nodes lie on such a side ``(n, nn)``.
        facing: how squarely the point is in front of the facet, or behind it, a length ``(n,)``; not known of facets that were asked for.
        cosine: between the facet's normal and that around the point which it faces most squarely, where this is known, else 0 ``(n,)``.
    """

    facet: Ints
    key: Ints
    xi: Array
    x: Array
    nodes: Ints
    nodal_normals: Array
    sign: Array
    open_sides: Bools
    open_nodes: Bools
    facing: Array
    cosine: Array


class MeshTarget:
    """Target whose facets are spread over the ranks; if averaged, normals are interpolated from nodes, not the facets' own."""

    motion: Any = None

    def __init__(self, facets: TargetFacets, averaged: bool = False):
        self.facets, self.averaged = facets, averaged
        self.shape: FacetShape = facets.shape
        self.comm: MPI.Comm = facets.config.comm
        self.dofs: Indices = facets.dofs
        self.n_nodes = facets.dofs.shape[1]
        corners = facets.config.X[facets.dofs[:, : len(self.shape.topology[0])]]
        sides = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        # half of what the thinnest body of one cell, or its shortest facet, measures
        shortest = min(sides.min(initial=np.inf), facets.depth.min(initial=np.inf))
        self.stride = 0.5 * reduced(self.comm, float(shortest), op=MPI.MIN)
        self.first: Ints = facets.first
        self._nowhere: FacetProjection | None = None

    def project(self, points: Array, which: Ints | None = None) -> FacetProjection:
        """Exact closest points of ``points (n, gdim)`` on the whole target (collective).

        Args:
            points: positions.
            which: of the contactors they are ``(n,)``, where it matters who asks; None are all.
        """
        data, size = self.facets.current(corners=True), self.comm.size
        if size == 1:
            return self._evaluate(points, self._project_here(points, data))
        # the answer of the rank that seems nearest tells who else can be as near
        near, far = self.bounds(points, data.x)
        first = np.where(near <= near.min(axis=0), far, np.inf).argmin(axis=0)
        found, feet = self._ask(Exchange.to(self.comm, first), data, points)
        bound = np.linalg.norm(points - found.foot, axis=1) * (1 + EQUALLY_NEAR) + ON_SIDE * self.stride
        others = (near <= bound) & (first != np.arange(size)[:, None])
        return self._ask(Exchange(self.comm, [np.flatnonzero(o) for o in others]), data, points, found=feet)[0]

    def project_on(self, points: Array, facet: Ints) -> FacetProjection:
        """Closest points of ``points (n, gdim)`` on the facets numbered ``facet (n,)`` (collective)."""
        return self._ask(self.facets.owners(facet), self.facets.current(), points, facet)[0]

    def at(self, points: Array, facet: Ints, xi: Array) -> FacetProjection:
        """Where ``points (n, gdim)`` stand relative to given places ``xi (n, fdim)`` of facets (collective)."""
        return self._ask(self.facets.owners(facet), self.facets.current(), points, facet, xi)[0]

    def follow(self, points: Array, old: FacetProjection) -> FacetProjection:
        """Gaps of ``points (n, gdim)`` with the feet, normals and weights of an earlier projection (collective)."""
        new, _ = self._ask(self.facets.owners(old.facet), self.facets.current(), points, old.facet, old.xi)
        gap = np.einsum("ng,ng->n", old.normal, points - new.foot)
        return replace(new, gap=gap, normal=old.normal, beyond=old.beyond)

    def nowhere(self, points: Array) -> FacetProjection:
        """The projection of ``points (n, gdim)`` that have nothing near: no facet, no normal, and a gap as large as the model."""
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

    #: Gaps are distances everywhere, and boxes around surfaces tell which are far apart.
    measures = True

    @property
    def faceted(self) -> bool:
        """Whether normals jump from facet to facet."""
        return not self.averaged

    @property
    def keys(self) -> Ints:
        """What tells each of this rank's facets in any partition ``(m,)``."""
        return self.facets.keys

    def continued(self, projection: FacetProjection, which: Ints) -> FacetProjection:
        """The projection with some facets continued past the target's open end, as far as their points lie beyond it."""
        p, x = projection, projection.x[which]
        xi, tab = beneath(self.shape, x, p.xi[which], p.foot[which] + p.beyond[which])
        foot = np.einsum("ka,kag->kg", tab.N, x)
        return p.with_rows(which, {"xi": xi, "weights": tab.N, "dN": tab.dN, "ddN": tab.ddN, "foot": foot})

    def chords(self, projection: FacetProjection) -> Array:
        """Weights of the straight pieces between the nodes of curved facets at the feet ``(n, nn)`` [UEM, 4.5]."""
        return self.shape.chords(projection.xi)

    def reference(self, gdim: int) -> Array:
        """The origin."""
        return np.zeros(gdim)

    def outward(self, projection: FacetProjection) -> Array:
        """The facets' own outward normals at the feet, also where ``normal`` is an averaged one ``(n, gdim)``."""
        own = unit_normals(Tabulated(projection.weights, projection.dN, projection.ddN), projection.x)
        return own * np.where(np.einsum("ng,ng->n", own, projection.averaged) < 0, -1.0, 1.0)[:, None]

    def spread(self, projection: FacetProjection) -> Array:
        """What facets that meet at the feet push with together, over the force along their averaged normal ``(n,)`` (collective)."""
        at_nodes = self.of_facets(projection.facet, self.facets.spread())
        return np.asarray(np.einsum("na,na->n", projection.weights, at_nodes))

    def keys_of(self, facet: Ints) -> Ints:
        """What tells the facets numbered ``facet (n,)`` in any partition, -1 for -1 (collective; see ``TargetFacets.keys``)."""
        return self.of_facets(facet, self.facets.keys)

    def told(self, which: Ints) -> Ints:
        """What tells which facets the contactors ``which (k,)`` may pass through: nothing, they may touch all ``(k,)``."""
        return np.zeros(len(which), np.int64)

    def may_touch(self, told: Ints, facet: Ints) -> Bools:
        """Whether the contactors of ``told (k,)`` may touch this rank's facets ``(k,)``."""
        return np.ones(len(told), bool)

    def allowed(self, told: Array, facet: Ints) -> Bools:
        """Whether contactor facets of which this was ``told (k, m)`` may touch this rank's facets ``(k,)``."""
        return np.ones(len(facet), bool)

    def of_facets(self, facet: Ints, values: AnyArray) -> Any:
        """Values ``(m, ...)`` of ranks' own facets at the facets numbered ``facet (n,)``: ``(n, ...)``, -1 for -1 (collective)."""
        return self.facets.values_at(facet, values)

    def facets_of(self, keys: Ints) -> Ints:
        """Numbers of the facets that ``keys (n,)`` tell, wherever they are now, -1 for those not of this target (collective)."""
        size, mine = self.comm.size, self.facets.keys
        # the keys of facets and those asked for meet on the same rank
        known, number = Exchange.to(self.comm, mine % size).send(mine, self.first[self.comm.rank] + np.arange(len(mine)))
        order = np.argsort(known)
        known, number = known[order], np.append(number[order], -1)
        exchange = Exchange.to(self.comm, np.where(keys >= 0, keys % size, -1))
        (wanted,) = exchange.send(keys)
        at = np.searchsorted(known, wanted)
        facet = np.full(len(keys), -1, dtype=np.int64)
        (facet[exchange.rows],) = exchange.back(np.where(np.append(known, -1)[at] == wanted, number[at], -1))
        return facet

    def bounds(self, points: Array, x: Array) -> tuple[Array, Array]:
        """Bounds on the distance of each point from the facets of each rank, from the boxes around them ``(size, n)`` (collective).

        Args:
            points: ``(n, gdim)``.
            x: nodes of this rank's facets ``(m, nn, gdim)``.
        """
        # curved facets reach out of the box of their nodes
        return box_distances(self.comm, points, x.reshape(-1, points.shape[1]), 0.5 * (self.shape.lebesgue - 1))

    def _ask(
        self, exchange: Exchange, data: FacetData, points: Array, facet: Ints | None = None, xi: Array | None = None,
        found: Feet | None = None,
    ) -> tuple[FacetProjection, Feet]:  # fmt: skip
        """Send points to ranks (with the facet, or facet and foot, if given), and keep the nearest foot, or that found before."""
        p, *rest = exchange.send(*(a for a in (points, facet, xi) if a is not None))
        if rest:
            rest[0] = rest[0] - self.first[self.comm.rank]
        feet = self._project_here(p, data, *rest)
        if self.comm.size == 1:
            return self._evaluate(points, feet), feet
        # the answers of several ranks are judged as those of one
        rows, feet = exchange.rows, Feet._make(exchange.back(*feet))
        if found is not None:
            rows, feet = np.append(rows, np.arange(len(points))), Feet._make(map(np.concatenate, zip(feet, found)))
        return self._nearest_foot(points, rows, feet)

    def _nearest_foot(self, points: Array, rows: Ints, feet: Feet) -> tuple[FacetProjection, Feet]:
        """The nearest of several feet of ``points (n, gdim)``, of places ``rows (k,)``, in the order of those that have any."""
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
        """Feet of points that have candidates, on the nearest of them.

        Args:
            points: ``(n, gdim)``.
            data: of this rank's facets.
            pairs: places of points ``(k,)``.
            candidates: this rank's facets that may be nearest ``(k,)``.
            cosine: as of ``Feet``, which tells where points are as near to several and faced alike ``(k,)``; None where it is not known.
            open_sides: sides of these that bound the surface for their points ``(k, n_sides)``; None are those that bound it for all.
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
            for s, (_, nodes, _, _) in enumerate(self.shape.edges()):
                open_nodes[:, nodes] |= open_sides[:, s, None]
        return Feet(
            facet + self.first[self.comm.rank], of.keys[facet], xi, data.x[facet], data.nodes[facet], data.nodal_normals[facet],
            of.sign[facet], open_sides, open_nodes, facing, cosine,
        )  # fmt: skip

    def _facing(self, tab: Tabulated, away: Array, facet: Ints, data: FacetData) -> Array:
        """How squarely points are in front of facets, or behind them if they are inside the body, a length ``(n,)``.

        It is the height over the facet's plane, from outside, and the depth below it from inside. With an edge or an inner place for its
        closest point, the point is on that side of the surface on which it is of the facet that it is farther from. With a corner, where
        facets may hide each other, all of them tell it together, unless the surface ends there.

        Args:
            tab: shape functions at the closest points of the facets.
            away: ways from there to the points ``(n, gdim)``.
            facet: this rank's numbers of the facets ``(n,)``.
            data: this rank's facets.
        """
        assert data.corner_normals is not None
        n_corners = data.corner_normals.shape[1]
        height = np.einsum("ng,ng->n", away, unit_normals(tab, data.x[facet])) * self.facets.sign[facet]
        corner, is_open = tab.N[:, :n_corners] > 1 - ON_SIDE, self.facets.open_nodes[facet, :n_corners]
        at_corner = corner & ~is_open
        above = np.einsum("nc,ncg,ng->n", at_corner, data.corner_normals[facet], away)
        # past the surface's end facets that share a corner there are faced alike
        past = (corner & is_open).any(axis=1) & (np.abs(height) < SIDEWAYS * np.linalg.norm(away, axis=1))
        return np.where(at_corner.any(axis=1), np.copysign(1.0, above) * height, np.where(past, 0.0, np.abs(height)))

    def _evaluate(self, points: Array, feet: Feet) -> FacetProjection:
        """Gap, normal and geometry at the feet of ``points (n, gdim)``."""
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
        # along an averaged normal, which leans, the way to the facet is longer than to its closest point
        lean = np.einsum("ng,ng->n", normal, facet_normal)
        gap = np.einsum("ng,ng->n", facet_normal, away) / np.where(lean > LEAST_LEAN, lean, 1.0)
        beyond = away - gap[:, None] * normal
        # a facet may touch the surface's end with a vertex alone
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

    The facets that share an edge are equally near to a point outside a convex edge, and to one behind a concave edge. The one that the
    point faces most squarely counts: no point hovers in the plane of another one, and none is hidden there. Then that counts which faces
    the point's own surface most squarely, that of the smallest ``cosine``. What is still tied goes by the facets' keys, which no
    partition changes. Lengths that differ by no more than ``rounding``, or by a small part of the distance, are equal.
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


def box_distances(comm: MPI.Comm, points: Array, places: Array, out: float = 0.0) -> tuple[Array, Array]:
    """Bounds on the distance of each point from what each rank has, from the boxes around that ``(size, n)`` (collective).

    Args:
        comm: communicator.
        points: ``(n, gdim)``.
        places: that this rank's box is about ``(m, gdim)``.
        out: part of its size by which the box is larger to each side.
    """
    box = np.stack([places.min(axis=0, initial=np.inf), places.max(axis=0, initial=-np.inf)])
    boxes = np.empty((comm.size, *box.shape))
    comm.Allgather(box, boxes)
    near, far = np.full((2, comm.size, len(points)), np.inf)
    for r in np.flatnonzero(boxes[:, 0, 0] <= boxes[:, 1, 0]):
        more = out * (boxes[r, 1] - boxes[r, 0])
        low, high = boxes[r, 0] - more, boxes[r, 1] + more
        near[r] = np.linalg.norm(np.maximum(np.maximum(low - points, points - high), 0.0), axis=1)
        far[r] = np.linalg.norm(np.maximum(np.abs(points - low), np.abs(points - high)), axis=1)
    return near, far


def nearest_of(comm: MPI.Comm, points: Array, places: Array, within: float, values: Array) -> tuple[Array, Array]:
    """Distance of each point from the nearest place of all ranks, and the values there (collective).

    A place travels only to the ranks in whose part of the points it lies.

    Args:
        comm: communicator.
        points: ``(n, gdim)``.
        places: this rank's ``(m, gdim)``.
        within: what lies farther away is not looked for; the same on all ranks.
        values: at the places ``(m, k)``.

    Returns:
        ``(n,)``, infinite where no place is near, and ``(n, k)``, zero there.
    """
    near, _ = box_distances(comm, places, points)
    sent = [np.flatnonzero(n <= within * (1 + EQUALLY_NEAR)) for n in near]
    there, told = Exchange(comm, sent).send(places, values)
    distance, found = np.full(len(points), np.inf), np.zeros((len(points), values.shape[1]))
    if len(there) and len(points):
        from scipy.spatial import cKDTree

        length, which = cKDTree(there).query(points)
        i = length <= within
        distance[i], found[i] = length[i], told[which[i]]
    return distance, found
