"""Crossings of sharp convex edges of two surfaces in 3D: which edges are opposite to each other, for the nodes of one side.

Two edges are opposite if their closest points lie within both, and if their common normal lies between the normals of the facets of
either edge, so that no facet is nearer. Edges go to the ranks of the edges that they may meet, crossings to the owners of the nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints, pairs_of_equals
from uem_dolfinx.geometry.candidates import balls_that_meet
from uem_dolfinx.geometry.edge_gaps import EdgeGaps, cubics, may_cross
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.nodes import Halo
from uem_dolfinx.geometry.sharp import SHARP_EDGE, sharp_edges
from uem_dolfinx.log import timed_as
from uem_dolfinx.parallel import Exchange, gathered, reduced, sums_by_keys

#: Edges nearer to each other than this are opposite, and no deeper inside each other.
#: [convention; length of an edge between nodes; test_edge_crossings.py::test_how_near_edges_are]
REACH = 0.5
#: Edges at a smaller angle have no definite crossing.
#: [convention; sine of the angle; test_edge_crossings.py::test_edges_that_are_nearly_parallel]
EDGES_PARALLEL = 0.05
#: The common normal may leave the sector between the normals of an edge's facets by this much: facets turn as they deform.
#: [convention; length of a unit normal; test_edge_crossings.py::test_normals_beside_those_of_facets]
SECTOR = 0.1
#: Where the common normal lies between those of the facets of both edges by more than this, facets near the crossing do not touch, and
#: both nodes of each piece are held by it alone.
#: [convention; length of a unit normal; test_edge_crossings.py::test_nodes_at_ridges]
RIDGES = 0.2
#: Edges that were deeper inside each other at the end of the last step are on other sides of their bodies; crossings nearer to the end of
#: a line are left to its last node.
#: [convention; length of an edge between nodes; test_edge_crossings.py::test_edges_behind_each_other]
EDGES_BEHIND = 1e-3
#: The first node of an edge has the equation of crossings up to here, beyond the middle, since many lie there.
#: [convention; reference coordinate; test_edge_crossings.py::test_which_node_has_the_equation]
FIRST_NODE = 0.6
#: A node with all but this weight in a crossing is held by it, and by no facet of the other body; one with less does not follow it.
#: [convention; weight; test_edge_crossings.py::test_nodes_at_crossings]
AT_NODE = 0.1
#: Crossings that are nearer to each other on a line are one, seen from two pieces.
#: [convention; length of an edge between nodes; test_edge_crossings.py::test_crossings_of_one_node]
SAME = 0.05
#: A piece sees crossings this far past its ends, so that rounding loses none between two pieces.
#: [bound; reference coordinates; -]
PAST_END = 1e-8


class SharpLines:
    """Sharp convex edges of a surface of 3D bodies, in pieces between neighbouring nodes of lines, on one rank each (collective).

    Args:
        of: those of which every edge has one at least ``(m,)``; None: all.

    Attributes:
        facet: this rank's facet of each piece ``(k,)``.
        nodes: global numbers of four nodes of the line, the piece's own in the middle ``(k, 4)``; where the line ends or turns, the
            piece's own node again, without weight.
        ends: whether the line ends at the piece's first and second node ``(k, 2)``.
        cubics: of the pieces, see ``edge_gaps.cubics`` ``(k, 4, 4)``.
        keys: independent of the partition ``(k,)``.
        total: number of pieces over all ranks.
    """

    def __init__(self, facets: TargetFacets, of: Bools | None = None):
        self.facets, config = facets, facets.config
        convex = sharp_edges(facets).convex
        if of is not None:
            ours = sums_by_keys(config.comm, facets.side_keys(), np.repeat(of, len(facets.shape.edges)).astype(float)[:, None])
            convex &= ours.reshape(convex.shape) > 0
        facet, side = np.nonzero(convex)
        of_sides, own = facets.side_keys()[convex.ravel()], facets.keys[facet]
        other = sums_by_keys(config.comm, of_sides, own[:, None])[:, 0] - own
        #: Edges as both facets have them, and which of them are kept: those of the facet with the smaller key.
        self._sides, self._every, self._kept = of_sides, facet, own < other
        facet, side, own = facet[self._kept], side[self._kept], own[self._kept]
        edges = [nodes for _, nodes, _, _ in facets.shape.edges]
        along = facets.dofs[facet[:, None], np.array([[nodes[0], *nodes[2:], nodes[1]] for nodes in edges])[side]]
        n = self._pieces = along.shape[1] - 1
        self.facet: Ints = np.repeat(facet, n)
        self._side: Ints = np.repeat(side, n)
        self._piece: Ints = np.tile(np.arange(n), len(side))
        self.keys: Ints = np.repeat(own * len(edges) + side, n) * n + self._piece
        dofs = np.stack([along[:, :-1], along[:, 1:]], axis=2).reshape(-1, 2)
        self._join(config.to_global(dofs), config.X[dofs])
        self._halo = Halo(config, self.nodes.ravel())
        self.total = int(reduced(config.comm, len(self.facet)))

    def _join(self, nodes: Ints, X: Array) -> None:
        """Find the pieces before and after each piece between ``nodes (k, 2)`` at ``X (k, 2, 3)`` (collective)."""
        config = self.facets.config
        way = X[:, ::-1] - X
        length = np.linalg.norm(way, axis=2)
        way = (way / length[..., None]).reshape(-1, 3)
        exchange = Exchange.to(config.comm, config.owner_of(nodes.ravel()))
        there, other, far, out = exchange.send(nodes.ravel(), nodes[:, ::-1].ravel(), length.ravel(), way)
        i, j = pairs_of_equals(there)
        i, j = (k[i != j] for k in (i, j))
        continues = (np.bincount(i, minlength=len(there)) == 1)[i] & (-np.einsum("kg,kg->k", out[i], out[j]) > SHARP_EDGE)
        to_next, beyond = np.full(len(there), np.inf), np.full(len(there), -1)
        to_next[i[continues]], beyond[i[continues]] = far[j[continues]], other[j[continues]]
        lengths, others = np.empty(nodes.size), np.empty(nodes.size, np.int64)
        lengths[exchange.rows], others[exchange.rows] = exchange.back(to_next, beyond)
        before, after = lengths.reshape(-1, 2).T
        first, last = others.reshape(-1, 2).T
        self.ends: Bools = np.column_stack([first < 0, last < 0])
        outer = np.where(first < 0, nodes[:, 0], first), np.where(last < 0, nodes[:, 1], last)
        self.nodes: Ints = np.column_stack([outer[0], nodes, outer[1]])
        self.cubics: Array = cubics(before, length[:, 0], after)

    def places(self, x: Array) -> Array:
        """Positions of the pieces' nodes ``(k, 4, 3)`` with the owned nodes at ``x (n_owned, 3)`` (collective)."""
        return self._halo.take(x.__getitem__).reshape(-1, 4, 3)

    def normals(self) -> Array:
        """Outward unit normals of both facets of each piece now ``(k, 2, 3)`` (collective)."""
        _, normal = self.facets.middles(self.facets.x)
        own = normal[self._every]
        other = sums_by_keys(self.facets.config.comm, self._sides, own) - own
        return np.repeat(np.stack([own, other], axis=1)[self._kept], self._pieces, axis=0)

    def on_facet(self, which: Ints, t: Array) -> Array:
        """Reference coordinates in their facets of points at ``t (k,)`` along pieces ``which (k,)``: ``(k, 2)``."""
        shapes = self.facets.shape.edges
        start, way = np.array([o for *_, o, _ in shapes]), np.array([D[0] for *_, D in shapes])
        side, along = self._side[which], (self._piece[which] + np.clip(t, 0.0, 1.0)) / self._pieces
        return np.asarray(start[side] + along[:, None] * way[side])


class Opposite(NamedTuple):
    """Crossings at contactor nodes; one row for each."""

    node: Ints  # global number of the contactor ``(k,)``
    own: Ints  # its number among the nodes of its line ``(k,)``
    leads: Bools  # whether it has the equation of the crossing; otherwise another node of the line has it ``(k,)``
    ridges: Bools  # whether no facet at either line touches near the crossing ``(k,)``
    s: Array  # coordinate on its line ``(k,)``
    t: Array  # coordinate on the opposite line ``(k,)``
    x: Array  # positions of its line's nodes ``(k, 4, 3)``
    y: Array  # positions of the opposite line's nodes ``(k, 4, 3)``
    cubic: Array  # of its line ``(k, 4, 4)``
    opposite: Array  # of the opposite line ``(k, 4, 4)``
    normal: Array  # from the opposite line to its own ``(k, 3)``
    nodes: Ints  # global numbers of its line's nodes ``(k, 4)``
    followed: Ints  # global numbers of the opposite line's nodes ``(k, 4)``
    ends: Bools  # whether the lines end at the pieces' nodes ``(k, 4)``, first its own
    facet: Ints  # number over all ranks of a facet at the opposite line ``(k,)``
    xi: Array  # coordinates in this facet ``(k, 2)``
    facet_nodes: Ints  # global numbers of its nodes ``(k, nn)``
    facet_x: Array  # their positions ``(k, nn, 3)``
    key: Ints  # of both pieces, independent of the partition ``(k, 2)``
    visibility: Ints  # visibility keys of both ``(k, 2 m)``

    @property
    def gaps(self) -> EdgeGaps:
        """Gaps at the crossings."""
        return EdgeGaps((self.cubic, self.opposite), self.s, self.t, self.x, self.y, self.normal)

    def take(self, which: Any) -> Opposite:
        """Some of the rows."""
        return Opposite._make(values[which] for values in self)


class Crossings:
    """Crossings of the edges of two surfaces, in lists with one crossing for each node (collective).

    Args:
        first: edges of the surface with the contactors.
        second: edges of the other surface, or the same.
        keys: visibility keys of the edges of both ``(k, m)``.
        meet: function of two arrays of keys ``(n, m)`` that returns whether the first edge's nodes may be contactors of the second.
        overlap: bound on the initial penetration, a length.
        n_lists: how many crossings a node may have at once.
        ridges: whether only those count at which facets near the crossing do not touch, as others have the facets' integrals.
    """

    def __init__(
        self, first: SharpLines, second: SharpLines, keys: tuple[Ints, Ints], meet: Callable[[Ints, Ints], Bools], overlap: float,
        n_lists: int, ridges: bool = False,
    ):  # fmt: skip
        self._least = RIDGES if ridges else -SECTOR
        self.first, self.second, self._keys, self._meet, self._overlap = first, second, keys, meet, overlap
        config = self._config = first.facets.config
        self.nodes = config.gather_owned(first.nodes.ravel())  # owned nodes on edges, the contactors ``(n,)``
        #: Owned nodes of all lines, and positions at the end of the last step.
        self._watched: Ints = np.union1d(self.nodes, config.gather_owned(second.nodes.ravel()))
        self._committed, self._keeps = self._x, False
        #: facets of the crossings that hold the contactors now, -1 for none ``(n_lists, n)``.
        self.held: Ints = np.full((n_lists, len(self.nodes)), -1)
        self.lists: list[tuple[Ints, Opposite]] = []  # contactors with a crossing, and these, for each list
        #: Nodes at crossings, owned, and the visibility keys of the edges that hold them.
        self.at_crossings: tuple[Ints, Ints] = (np.zeros(0, np.int64), keys[0][:0])
        self._made_at: tuple[Array, Ints] | None = None

    @property
    def _x(self) -> Array:
        """Present positions of the owned nodes ``(n_owned, 3)``."""
        return np.array(self._config.x[: self._config.n_owned])

    def commit(self) -> None:
        """Accept a step, or return to one: at the next update, the current positions decide which edges face each other."""
        self._keeps = True

    def hold(self, nodes: Indices, body: Ints, n_bodies: int) -> Bools:
        """Which owned ``nodes (n,)`` are at crossings with edges of a ``body (n,)`` each; keys end with the body (collective)."""
        self.update()
        there, visibility = self.at_crossings
        return np.isin(nodes * n_bodies + body, there * n_bodies + visibility[:, -1]) & (body >= 0)

    def update(self) -> None:
        """Find the crossings at the present positions (collective)."""
        config = self._config
        if self._keeps:
            self._committed, self._keeps, self._overlap, self._made_at = self._x, False, 0.0, None
        x, last = self._x[self._watched], self._made_at
        stale = last is None or not (np.array_equal(x, last[0]) and np.array_equal(self.held, last[1]))
        if reduced(config.comm, stale, op=MPI.LOR):
            self._made_at = x, self.held.copy()
            self._make()

    @timed_as("search")
    def _make(self) -> None:
        config = self._config
        found = self._found()
        place = np.searchsorted(self.nodes, found.node - config.first)
        length, gaps = _lengths(found.x), found.gaps
        past = np.maximum(np.abs(found.s - 0.5), np.abs(found.t - 0.5)) > 0.5
        order = np.lexsort((*found.key.T, past, np.round(gaps.gap / (SAME * length)), ~found.leads, place))
        found, place, length, foot = found.take(order), place[order], length[order], gaps.feet[order]
        self.lists = [(place[own], found.take(own)) for own in self._shared_out(found, place, length, foot)]
        self._mark_nodes()

    def _shared_out(self, found: Opposite, place: Ints, length: Array, foot: Array) -> list[Ints]:
        """Rows of each list: first the crossings that hold their nodes now, then the deepest; rows are in this order."""
        n, taken = len(self.nodes), np.zeros(len(place), bool)
        chosen = np.full((len(self.held), n), -1)

        def choose(k: int, among: Bools) -> None:
            nonlocal taken
            rows = np.flatnonzero(among & ~taken & (chosen[k][place] < 0))
            nodes, at = np.unique(place[rows], return_index=True)
            chosen[k][nodes] = rows[at]
            row = chosen[k][place]
            same = np.linalg.norm(foot - foot[row], axis=1) <= SAME * length if len(foot) else taken
            taken = taken | ((row >= 0) & same)

        for k, held in enumerate(self.held):
            choose(k, (held[place] == found.facet) & found.leads)
        for k in range(len(self.held)):
            choose(k, np.ones(len(place), bool))
        return [own[own >= 0] for own in chosen]

    def _mark_nodes(self) -> None:
        """Collect the nodes that lie at crossings, of both sides (collective)."""
        nodes, keys = [], []
        for _, found in self.lists:
            half = found.visibility.shape[1] // 2
            sides = (found.nodes, found.visibility[:, half:]), (found.followed, found.visibility[:, :half])
            for weights, (own, visibility) in zip(found.gaps.weights, sides):
                middle = np.array([False, True, True, False])
                k, a = np.nonzero(found.leads[:, None] & ((weights >= 1.0 - AT_NODE) | (found.ridges[:, None] & middle)))
                nodes.append(own[k, a])
                keys.append(visibility[k])
        there, visibility = np.concatenate(nodes), np.concatenate(keys)
        arrived, their = Exchange.to(self._config.comm, self._config.owner_of(there)).send(there, visibility)
        self.at_crossings = arrived - self._config.first, their

    def _found(self) -> Opposite:
        """All crossings of owned nodes (collective)."""
        config, one, other = self._config, self.first, self.second
        comm, now = config.comm, self._x
        x, before, normals = one.places(now), one.places(self._committed), one.normals()
        y, behind, m = x, before, normals
        if other is not one:
            y, behind, m = other.places(now), other.places(self._committed), other.normals()
        (c, r), (d, q) = _balls(x), _balls(y)
        box = np.stack([(d - q[:, None]).min(axis=0, initial=np.inf), (d + q[:, None]).max(axis=0, initial=-np.inf)])
        rows = [np.flatnonzero(((c - r[:, None] <= b[1]) & (c + r[:, None] >= b[0])).all(axis=1)) for b in gathered(comm, box)]
        x, before, cubic, normals, nodes, key, visibility, ends = Exchange(comm, rows).send(
            x, before, one.cubics, normals, one.nodes, one.keys, self._keys[0], one.ends
        )
        i, j = np.zeros((2, 0), np.int64)
        if len(x) and len(y):
            i, j = balls_that_meet(*_balls(x), d, q)
            apart = (nodes[i][:, 1:3, None] != other.nodes[j][:, None, 1:3]).all(axis=(1, 2))
            some = np.flatnonzero(apart & self._meet(visibility[i], self._keys[1][j]))
            i, j = i[some], j[some]
            near = may_cross(x[i], y[j], EDGES_PARALLEL)
            i, j = i[near], j[near]
        gaps = EdgeGaps.between((cubic[i], other.cubics[j]), x[i], y[j], m[j].sum(axis=1))
        ends = np.concatenate([ends[i], other.ends[j]], axis=1)
        within = np.minimum(_within(-gaps.normal, normals[i]), _within(gaps.normal, m[j]))
        fits = np.flatnonzero(self._opposite(gaps, within, ends))
        fits = fits[self._in_front(gaps.take(fits), before[i[fits]], behind[j[fits]])]
        i, j, gaps, within, ends, facets = i[fits], j[fits], gaps.take(fits), within[fits], ends[fits], other.facets
        f, second, ridges = other.facet[j], gaps.s > FIRST_NODE, within > RIDGES
        visibility, keys = np.concatenate([visibility[i], self._keys[1][j]], axis=1), np.column_stack([key[i], other.keys[j]])
        both = []
        for leads, own in ((True, np.where(second, 2, 1)), (False, np.where(second, 1, 2))):
            both.append(
                Opposite(
                    nodes[i, own], own, np.full(len(i), leads), ridges, gaps.s, gaps.t, gaps.x, gaps.y, *gaps.cubics,
                    gaps.normal, nodes[i], other.nodes[j], ends, f + facets.first[comm.rank], other.on_facet(j, gaps.t),
                    facets.nodes[f], facets.x[f], keys, visibility,
                )
            )  # fmt: skip
        found = Opposite._make(np.concatenate(parts) for parts in zip(*both))
        found = found.take(found.leads | (found.gaps.weights[0][np.arange(len(found.own)), found.own] >= AT_NODE))
        return Opposite._make(Exchange.to(comm, config.owner_of(found.node)).send(*found))

    def _in_front(self, gaps: EdgeGaps, before: Array, behind: Array) -> Bools:
        """Which pieces were not inside each other at the end of the last accepted step, with nodes there at these places ``(k, 4, 3)``."""
        # lines that slide along each other turn, and their crossing moves
        then = EdgeGaps.between(gaps.cubics, before, behind, gaps.normal)
        committed = np.maximum(then.gap, replace(gaps, x=before, y=behind).gap)
        shorter = np.minimum(_lengths(gaps.x), _lengths(gaps.y))
        return np.asarray(committed >= -np.maximum(EDGES_BEHIND * shorter, self._overlap))

    def _opposite(self, gaps: EdgeGaps, within: Array, ends: Bools) -> Bools:
        """Which pairs of pieces, with these gaps, are opposite to each other ``(k,)``; ``ends`` as in ``Opposite``."""
        g, lengths = gaps.gap, (_lengths(gaps.x), _lengths(gaps.y))
        shorter, longer = np.minimum(*lengths), np.maximum(*lengths)
        inside: Bools = (gaps.sine > EDGES_PARALLEL) & (g <= REACH * longer) & (g >= -np.maximum(REACH * shorter, self._overlap))
        at_corners: Bools = np.ones(len(g), bool)
        for k, (xi, length) in enumerate(zip((gaps.s, gaps.t), lengths)):
            first, last = ends[:, 2 * k], ends[:, 2 * k + 1]
            at_corners &= (first & (xi < AT_NODE)) | (last & (xi > 1.0 - AT_NODE))
            least, most = np.where(first, EDGES_BEHIND, -PAST_END), np.where(last, 1.0 - EDGES_BEHIND, 1.0 + PAST_END)
            inside &= (xi >= least) & (xi <= most)
            # bodies that overlap by less past the end of a line part there
            left = np.minimum(np.where(first, xi, np.inf), np.where(last, 1.0 - xi, np.inf)) * length
            inside &= (g >= 0.0) | (-g <= left)
        # two corners on each other are held as nodes
        return np.asarray(inside & (within >= self._least) & ~at_corners)


def _lengths(x: Array) -> Array:
    """Lengths of pieces ``x (k, 4, 3)``: ``(k,)``."""
    return np.asarray(np.linalg.norm(x[:, 2] - x[:, 1], axis=1))


def _balls(x: Array) -> tuple[Array, Array]:
    """Middles ``(k, 3)`` of pieces ``x (k, 4, 3)`` and radii ``(k,)`` of balls round them that reach as far as crossings."""
    return 0.5 * (x[:, 1] + x[:, 2]), (0.5 + REACH) * _lengths(x)


def _within(n: Array, normals: Array) -> Array:
    """How far ``n (k, 3)``, across edges, are between the unit normals of two facets each ``(k, 2, 3)``; negative outside ``(k,)``."""
    along = np.einsum("kg,kfg->kf", n, normals)
    c = np.einsum("kg,kg->k", normals[:, 0], normals[:, 1])
    parts = (along - c[:, None] * along[:, ::-1]) / (1.0 - c[:, None] ** 2)
    return np.asarray(np.where(along.sum(axis=1) > 0.0, parts.min(axis=1), -np.inf))
