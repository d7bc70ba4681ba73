"""Lists of the facets that each surface node may touch, rebuilt only after a body has moved far enough.

A facet may constrain a node under three conditions: its body comes after the node's own in the order, it faces the node, and the
node was in front of it in the last accepted state. Nodes at sharp edges follow in both directions, since they could otherwise
penetrate between the nodes of the other surface. Facets that are not listed cost nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import count, pairwise
from typing import Any, NamedTuple

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.geometry.candidates import EQUALLY_NEAR, RankBoxes, balls_that_meet
from uem_dolfinx.geometry.facets import FacetData, heights
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.search import Feet, MeshTarget
from uem_dolfinx.geometry.shapes import closest_point
from uem_dolfinx.geometry.skin import Apart, Skin
from uem_dolfinx.log import timed_as
from uem_dolfinx.parallel import Exchange, gathered, reduced

#: Lists reach so far ahead of every body, if it hardly moves.
#: [convention; mean length of the sides of its facets; test_neighbours.py::test_lists_last]
AHEAD_AT_REST = 0.5
#: Lists reach ahead of a body by so many times what it moves in a step.
#: [convention; motion in a step; test_neighbours.py::test_lists_last]
STEPS_AHEAD = 4.0
#: A facet faces a node if the cosine of the angle between its normal and one around the node, see ``Skin.cones``, is below minus this.
#: [convention; cosine; test_neighbours.py::test_facing_pairs]
FACED = 0.5
#: Of two places of one body that meet, the nodes of that one follow whose normal in the reference configuration points more in this
#: direction, or that lies farther in it: its slopes are irrational, so that no side of a body is likely to lie along it.
#: [convention; direction; -]
DIRECTION = np.array([0.6180339887, 1.0, 0.4142135624])
#: A node that was farther behind a facet than this is not in front of it.
#: [convention; depth of the cell behind, or half a side of the facet; test_neighbours.py::test_through_a_thin_plate]
BEHIND = 0.25

_orders = count()


@dataclass(frozen=True)
class Listing:
    """Pairs of nodes and facets, each stored on the rank of the facet."""

    exchange: Exchange  # with the ranks that have facets for this rank's nodes; its rows are indices of nodes
    node: Ints  # index among the nodes received ``(k,)``
    facet: Ints  # number on this rank ``(k,)``
    cosine: Array  # least cosine between the facet's normal and the normals around the node, when it was listed ``(k,)``
    opened: Bools  # sides of these facets beyond which no facet is listed for the node ``(k, n_sides)``
    empty: bool  # whether no rank has a pair


class Asking(NamedTuple):
    """Data of nodes that the ranks of facets need."""

    points: Array  # current positions ``(n, gdim)``
    committed: Array  # positions at the end of the last accepted step ``(n, gdim)``
    drawn: Array  # positions in the reference configuration ``(n, gdim)``
    reach: Array  # search distance, a length ``(n,)``
    body: Ints  # body of each node ``(n,)``
    node: Ints  # global number ``(n,)``
    corner: Bools  # whether it lies on a sharp convex edge ``(n,)``
    cones: Array  # normals of the facets around them, now and in the reference configuration ``(n, c, 2, gdim)``
    sides: Bools  # whether they are in sets of facets that never touch each other ``(n, s)``
    held: Ints  # facets that hold them ``(n, n_lists)``


#: Attributes of ``Neighbours`` that change when bodies are placed; a repeated step restores them.
OF_A_STEP = ("lists", "body", "held", "_reach", "_lasts", "_made_at", "_overlap", "_farther")


class Neighbours:
    """Lists of the facets that surface nodes may touch, one for each of the bodies that a node may touch at once (collective).

    Args:
        skin: the surfaces.
        nodes: owned surface nodes that may touch others ``(n,)``.
        place: position of each body in the order in which they follow each other ``(n_bodies,)``.
        apart: pairs of sets of facets that never touch each other, as local nodes and this rank's facets of both, each once.
        overlap: bound on the initial penetration of nodes, a length.
        n_lists: how many bodies a node may touch at once.
        itself: which bodies may touch themselves ``(n_bodies,)``.
    """

    def __init__(
        self, skin: Skin, nodes: Indices, place: Ints, apart: Sequence[Apart], overlap: float, n_lists: int,
        itself: Bools,
    ):  # fmt: skip
        self.skin, self.nodes, self.place, self._n = skin, nodes, place, n_lists
        self.apart, self._overlap, self.itself = apart, overlap, itself
        config = self._config = skin.config
        watched = np.unique(np.concatenate([skin.dofs.ravel(), nodes]))
        #: Nodes whose motion counts, sorted by body, and the index of the first node of each body.
        self._watched = watched[np.argsort(skin.body_of_node[watched], kind="stable")]
        self._bodies, self._begin = np.unique(skin.body_of_node[self._watched], return_index=True)
        self._committed = config.x.copy()
        self._last_motion = np.zeros(skin.n_bodies)
        self.held: Ints = np.full((n_lists, len(nodes)), -1)  # facets that hold nodes now, by list ``(n_lists, n)``, -1 for none
        self.number = next(_orders)  # number of the order of the bodies
        self._made_at: Array | None = None
        self._kept, self._farther = False, 0.0
        self._reach = np.zeros(skin.n_bodies)
        self._lasts = self._reach
        self.lists: list[Listing] = []
        self.times_made = 0  # how often lists have been made
        self._at_start: dict[str, Any] | None = None

    def _motion(self, since: Array) -> Array:
        """Largest motion of each body's surface on this rank ``(n_bodies,)``."""
        w, most = self._watched, np.zeros(self.skin.n_bodies)
        if len(w):
            way = self._config.X[w] + self._config.displacement[w] - since[w]
            most[self._bodies] = np.sqrt(np.maximum.reduceat(np.einsum("ng,ng->n", way, way), self._begin))
        return most

    def update(self) -> None:
        """Rebuild the lists if a body has moved farther than they reach (collective)."""
        if self._kept:
            self._last_motion, self._committed, self._kept = self._motion(self._committed), self._config.x.copy(), False
            # initial penetrations have been removed by now
            if (self._reach < self._overlap).any():
                self._made_at = None
            self._overlap = self._farther = 0.0
            self._at_start = None
        stale = self._made_at is None or bool((self._motion(self._made_at) > self._lasts).any())
        if reduced(self._config.comm, stale, op=MPI.LOR):
            self._make()
        if self._at_start is None:
            self._at_start = {name: getattr(self, name) for name in OF_A_STEP} | {"held": self.held.copy()}

    def begin_step(self) -> None:
        """Begin a step, or repeat it: restore the lists with which an earlier attempt began."""
        if self._at_start is not None and not self._kept:
            vars(self).update(self._at_start, held=self._at_start["held"].copy())

    def commit(self) -> None:
        """Accept a step, or return to one: at the next update, the current positions decide which facets nodes are in front of."""
        self._kept = True

    def look_farther(self) -> bool:
        """Extend the reach by a factor of 4 until a step is accepted: False if it already exceeds the size of the model."""
        if self._farther > self._config.size:
            return False
        self._farther, self._made_at = 4.0 * max(self._farther, float(self._reach.max(initial=0.0))), None
        return True

    @timed_as("search")
    def _make(self) -> None:
        skin, config, comm = self.skin, self._config, self._config.comm
        motion = reduced(comm, np.maximum(self._motion(self._committed), self._last_motion), op=MPI.MAX)
        self._reach = np.maximum(np.maximum(AHEAD_AT_REST * skin.size, STEPS_AHEAD * motion), max(self._farther, self._overlap))
        self._made_at = config.x.copy()
        self.times_made += 1
        # data of a node are sent to all ranks with a facet that may be in reach
        n, g, own = len(self.nodes), config.gdim, skin.body_of_node[self.nodes]
        points, reach = self._made_at[self.nodes], self._reach[own]
        ahead = self._reach[skin.body]
        most = gathered(comm, float(ahead.max(initial=0.0)))
        boxes = RankBoxes(comm, self._made_at[skin.dofs].reshape(-1, g), 0.5 * (skin.shape.lebesgue - 1))
        exchange = Exchange(comm, boxes.near(points, reach, more=most))
        about = Asking(
            points, self._committed[self.nodes], config.X[self.nodes], reach, own, config.to_global(self.nodes),
            skin.corners[self.nodes], skin.cones(self.nodes), self.sides, self.held.T,
        )  # fmt: skip
        *arrived, rows = exchange.send(*about, np.arange(n))
        node, facet, cosine, *about_pairs = self._pairs(Asking(*arrived))
        home, row = exchange.origins[node], rows[node]
        # the rank of the node decides on the list of each pair, and on the sides of facets beyond which no facet is listed
        meeting, first = Exchange.to(comm, home), self.skin.first[comm.rank]
        pairs = meeting.send(row, skin.body[facet], facet + first, skin.edges.across[facet], skin.keys[facet], *about_pairs)
        seen = self._on_this_side(pairs[0], pairs[1], *pairs[4:])
        rows, bodies, facets, across, _, distance = (a[seen] for a in pairs[:6])
        self.body = self._shared_out(rows, bodies, distance)
        number, opened = np.full(len(row), -1), np.zeros((len(row), skin.edges.across.shape[1]), bool)
        which, ends = np.full(len(seen), -1), np.ones((len(seen), skin.edges.across.shape[1]), bool)
        which[seen] = np.where(self.body[:, rows] == bodies, np.arange(self._n)[:, None], -1).max(axis=0)
        ends[seen] = self._open_sides(rows, facets, across)
        # lists are rebuilt before a node can meet a body that is in reach, but on no list
        left, lasts = which[seen] < 0, self._reach.copy()
        for body in (own[rows[left]], bodies[left]):
            np.minimum.at(lasts, body, 0.5 * distance[left])
        self._lasts = reduced(comm, lasts, op=MPI.MIN)
        number[meeting.rows], opened[meeting.rows] = meeting.back(which, ends)
        opened |= skin.open_sides[facet]
        mine = [np.flatnonzero(number == k) for k in range(self._n)]
        empty = reduced(comm, np.array([len(m) for m in mine])) == 0
        self.lists = [self._list(home[m], row[m], facet[m], (cosine[m], opened[m]), bool(e)) for m, e in zip(mine, empty)]

    def _on_this_side(
        self, row: Ints, body: Ints, key: Ints, distance: Array, faces: Bools, front: Bools, normal: Array
    ) -> Bools:
        """Which facets may hold nodes ``(k,)``: facets with the node in front, and facets of the same body on the same side.

        A node outside a round body is behind the planes of facets that it may slide to next. They are accepted unless they are
        turned away from the nearest facet that has the node in front, as the back of a plate is. For a node inside a body at the
        start, the nearest of all facets counts.

        Args:
            row: places of nodes ``(k,)``.
            body: of the facets.
            key: of the facets, independent of the partition.
            distance: of the nodes from the facets.
            faces: whether the facets face the nodes; other facets occur only at the start.
            front: whether the nodes are in front of the facets.
            normal: of the facets ``(k, gdim)``.
        """
        known, pair = np.unique(row * self.skin.n_bodies + body, return_inverse=True)
        closest = np.full(len(known), np.inf)
        np.minimum.at(closest, pair, distance)
        inside = np.ones(len(known), bool)
        inside[pair[front & (distance <= closest[pair] * (1 + EQUALLY_NEAR))]] = False
        inside &= self._overlap > 0.0
        order = np.lexsort((key, distance, ~((front & faces) | inside[pair]), pair))
        nearest = order[np.searchsorted(pair[order], np.arange(len(known)))][pair]
        same_side = np.einsum("kg,kg->k", normal, normal[nearest]) > -FACED
        return np.asarray(faces & np.where(inside[pair], same_side, front | (same_side & (front & faces)[nearest])))

    def _open_sides(self, row: Ints, facet: Ints, across: Ints) -> Bools:
        """Sides of facets beyond which no facet is listed for the same node: closest points there are past an end ``(k, n_sides)``."""
        most = self.skin.first[-1]
        listed = np.sort(row * most + facet)
        queried = np.where(across >= 0, row[:, None] * most + across, -1)
        at = np.minimum(np.searchsorted(listed, queried), max(len(listed) - 1, 0))
        return np.asarray(listed[at] != queried if len(listed) else np.ones(queried.shape, bool))

    def _pairs(self, of: Asking) -> tuple[Ints, Ints, Array, Array, Bools, Bools, Array]:
        """Nodes and this rank's facets that may touch.

        Returns indices of nodes, facets, least cosines between their normals, distances, whether they face each other, whether
        the nodes are in front ``(k,)``, and the facets' normals ``(k, gdim)``.
        """
        assert self._made_at is not None
        skin, x, points = self.skin, self._made_at[self.skin.dofs], of.points
        none = np.zeros(0, np.int64)
        if not len(points) or not len(x):
            return none, none, *np.zeros((2, 0)), *np.zeros((2, 0), bool), np.zeros((0, points.shape[1]))
        middle, outward = skin.middles(x)
        radius = skin.shape.lebesgue * np.linalg.norm(x - middle[:, None], axis=2).max(axis=1)
        i, f = balls_that_meet(points, of.reach, middle, radius + self._reach[skin.body])
        own, its = of.body[i], skin.body[f]
        same = (own == its) & self.itself[own]
        follows = (self.place[its] > self.place[own]) | (of.corner[i] & (its != own))
        follows |= same & (skin.nodes[f] != of.node[i, None]).all(axis=1)
        i, f, same = i[follows], f[follows], same[follows]
        normal = outward[f]
        cosines = np.einsum("kcg,kg->kc", of.cones[i, :, 0], normal)
        front, cosine = self._in_front(of.committed[i], f), cosines.min(axis=1, initial=0.0)
        faces = cosine < -FACED
        # at the start, facets that do not face the node also decide whether it is inside a body
        kept = np.where(same, faces & front, faces | (self._overlap > 0.0))
        kept[same] &= of.corner[i[same]] | self._first_of_itself(of, i[same], f[same], cosines[same])
        holds = (of.held[i] == (f + self.skin.first[self._config.comm.rank])[:, None]).any(axis=1)
        kept, faces, front = kept | holds, faces | holds, front | holds
        kept &= ~self.excluded(of.sides[i], f)
        i, f, faces, front, normal = i[kept], f[kept], faces[kept], front[kept], normal[kept]
        distance = np.sqrt(closest_point(skin.shape, x[f], points[i])[1])
        near = distance <= (of.reach[i] + self._reach[skin.body[f]]) * (1 + EQUALLY_NEAR)
        return i[near], f[near], cosine[kept][near], distance[near], faces[near], front[near], normal[near]

    @cached_property
    def sides(self) -> Bools:
        """Membership of the nodes in the sets of facets that never touch each other ``(n, s)``."""
        sets = [a[0] for a in self.apart] + [a[2] for a in self.apart] + [np.zeros(self._config.n_local, bool)]
        return np.column_stack([a[self.nodes] for a in sets])

    def excluded(self, sides: Bools, facet: Ints) -> Bools:
        """Whether nodes of these sets ``(k, s)`` never touch this rank's facets ``(k,)``."""
        out, n = np.zeros(len(facet), bool), len(self.apart)
        for k, (_, a, _, b) in enumerate(self.apart):
            out |= (sides[:, k] & b[facet]) | (sides[:, n + k] & a[facet])
        return out

    def _in_front(self, points: Array, facet: Ints) -> Bools:
        """Which nodes at ``points (k, gdim)`` were in front of this rank's facets ``(k,)``."""
        skin = self.skin
        height = heights(points, facet, skin.middles(self._committed[skin.dofs]))
        return np.asarray(height >= -BEHIND * np.minimum(skin.depth, skin.radius)[facet])

    def _first_of_itself(self, of: Asking, node: Ints, facet: Ints, cosines: Array) -> Bools:
        """In self-contact, decide for each pair which side is the contactor: True where the node follows the facet ``(k,)``."""
        skin, d = self.skin, DIRECTION[: self._config.gdim]
        middle, normal = skin.middles(self._config.X[skin.dofs])
        # reference normal, around the node, that faces the facet most directly
        own = of.cones[node, cosines.argmin(axis=1), 1] if len(node) else np.zeros((0, len(d)))
        # if normals are equal, as on one side of a folded strip, positions decide
        return np.asarray((own - normal[facet] + (of.drawn[node] - middle[facet]) / self._config.size) @ d > 0)

    def _shared_out(self, row: Ints, body: Ints, distance: Array) -> Ints:
        """Body of each node on each list, -1 for no body ``(n_lists, n)``: first the body that holds the node now, then the nearest."""
        order = np.lexsort((body, distance, row))
        row, body = row[order], body[order]
        # several ranks may report the same body
        _, first = np.unique(row * self.skin.n_bodies + body, return_index=True)
        first.sort()
        row, body = row[first], body[first]
        held = np.stack([self.skin.values_at(facets, self.skin.body) for facets in self.held])
        found, taken = np.full(held.shape, -1), np.zeros(len(row), bool)
        for k in range(self._n):
            keeps = (held[k][row] == body) & ~taken
            found[k][row[keeps]] = body[keeps]
            taken |= keeps
        for k in range(self._n):
            left = np.flatnonzero(~taken & (found[k][row] < 0))
            rows, nearest = np.unique(row[left], return_index=True)
            found[k][rows] = body[left[nearest]]
            taken[left[nearest]] = True
        return found

    def _list(self, home: Ints, row: Ints, facet: Ints, more: tuple[Array, Bools], empty: bool) -> Listing:
        """A list of pairs of nodes, ``row (k,)`` on the ranks ``home (k,)``, and facets (collective)."""
        comm = self._config.comm
        n = len(self.nodes) if comm.size == 1 else int(reduced(comm, len(self.nodes), op=MPI.MAX))
        queried, node = np.unique(home * n + row, return_inverse=True)
        # ranks with facets request their nodes, which then arrive in the requested order
        back = Exchange.to(comm, queried // max(n, 1))
        (rows,) = back.send(queried % max(n, 1))
        ends = np.searchsorted(back.origins, np.arange(comm.size + 1))
        return Listing(Exchange(comm, [rows[a:b] for a, b in pairwise(ends)]), node.ravel(), facet, *more, empty)


class Neighbour(MeshTarget):
    """The target of one list: for each node, the listed facets of one body.

    Args:
        neighbours: the lists.
        number: of the list.
        averaged: see ``MeshTarget``.
    """

    measures = False  # nearby facets are found from the lists, not by bounding boxes

    def __init__(self, neighbours: Neighbours, number: int, averaged: bool = False):
        super().__init__(neighbours.skin, averaged)
        self.neighbours, self.number = neighbours, number

    def hold(self, facet: Ints) -> None:
        """Set the facets that hold the contactors now ``(n,)``, -1 for no facet."""
        self.neighbours.held[self.number] = facet

    def nothing_near(self) -> bool:
        """Whether this list has no pair on any rank (collective)."""
        self.neighbours.update()
        return self.neighbours.lists[self.number].empty

    @property
    def beside_themselves(self) -> Ints:
        """Contactors with facets of their own body on a list; only the first list reports them, for the check of tunnelling."""
        n = self.neighbours
        own = n.skin.body_of_node[n.nodes]
        return np.flatnonzero((n.body == own).any(axis=0) & n.itself[own] & (self.number == 0))

    @property
    def behind_others(self) -> Bools:
        """Contactors that follow other bodies ``(n,)``; only the first list reports them, for the check of tunnelling."""
        n = self.neighbours
        last = n.place[n.skin.size > 0].max()
        return np.asarray((n.place[n.skin.body_of_node[n.nodes]] < last) & (self.number == 0))

    def visibility_keys(self, which: Ints) -> Ints:
        """Visibility keys of contactors: position of their body in the order, body, global node and sets ``(k, 3 + s)``."""
        n, nodes = self.neighbours, self.neighbours.nodes[which]
        body = n.skin.body_of_node[nodes]
        return np.column_stack([n.place[body], body, n.skin.config.to_global(nodes), n.sides[which]])

    def may_touch(self, visibility: Ints, facet: Ints) -> Bools:
        """Whether this rank's facets ``(k,)`` belong to bodies that the contactors with keys ``visibility`` follow."""
        n = self.neighbours
        return np.asarray((n.place[n.skin.body[facet]] > visibility[:, 0]) & ~n.excluded(visibility[:, 3:] > 0, facet))

    def of_itself(self, visibility: Ints, facet: Ints) -> Bools:
        """Whether this rank's facets ``(k,)`` belong to the contactor's own body, but not to the contactor, from keys ``visibility``."""
        n = self.neighbours
        others = (n.skin.body[facet] == visibility[:, 1]) & (n.skin.nodes[facet] != visibility[:, 2, None]).all(axis=1)
        return np.asarray(others & ~n.excluded(visibility[:, 3:] > 0, facet))

    def project(self, points: Array, which: Ints | None = None) -> FacetProjection:
        """Closest points of contactors on the listed facets; ``nowhere`` for contactors without any (collective)."""
        self.neighbours.update()
        listed, n = self.neighbours.lists[self.number], len(self.neighbours.nodes)
        if which is not None:
            every = np.zeros((n, points.shape[1]))
            every[which] = points
            points = every
        found = self.nowhere(points)
        if not listed.empty:
            data: FacetData = self.facets.current(corners=True)
            (p,) = listed.exchange.send(points)
            feet = Feet._make(
                listed.exchange.back(*self._on_nearest(p, data, listed.node, listed.facet, listed.cosine, listed.opened))
            )
            nearest, _ = self._nearest_foot(points, listed.exchange.rows, feet)
            rows = np.unique(listed.exchange.rows)
            found = found.with_those(rows, nearest)
        return found if which is None else found.take(which)
