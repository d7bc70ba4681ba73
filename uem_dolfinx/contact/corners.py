"""Contactors in the concave corners of a faceted target: held by two facets on an edge, by three in a vertex.

Facet normals jump from facet to facet; where two facets form a concave edge, a contactor
drawn to it belongs to both, and would flip between them for ever if it had to choose.
"""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints, cross_products
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.geometry.projection import FacetProjection, gap_hessians
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.shapes import beneath, closest_point, tangents
from uem_dolfinx.parallel import reduced

#: Facets whose slopes differ by less are one plane.
#: [convention; slope; test_corners.py::test_facets_in_one_plane]
ON_PLANE = 1e-9
#: Facets hold what is in their corner by friction up to this part of what would hold it against any pull.
#: [heuristic; coefficient of friction; test_concave_corners.py::test_a_block_driven_into_a_leaning_wall]
WEDGED = 0.99


@dataclass(frozen=True)
class Corners:
    """Where contactors stand relative to the edge or vertex that several facets share.

    Attributes:
        which: their places among the pair's contactors ``(k,)``.
        count: number of facets, 2 to gdim ``(k,)``.
        meets: whether the facets share a place to be held at ``(k,)``.
        rising: slope at which the last facet rises above the planes of the others, positive if concave ``(k,)``.
        normals: outward normals of the facets, zero beyond ``count`` ``(k, gdim, gdim)``.
        away: unit directions along the facets away from the shared place, zero beyond ``count`` ``(k, gdim, gdim)``.
        axes: orthonormal; the first ``count`` span the normals, the very first is their mean ``(k, gdim, gdim)``.
        nodes: global nodes of the first facet ``(k, nn)``.
        weights: shape functions at the closest point of the shared place ``(k, nn)``.
        foot: that point ``(k, gdim)``; past the target's end, where the edge is continued, as far as the contactor is.
        beyond: how far that is, and in which direction ``(k, gdim)``.
        x: positions of the nodes ``(k, nn, gdim)``.
        dN: derivatives of the weights along the edge, zero at a vertex ``(k, nn, fdim - 1)``.
        ddN: second derivatives ``(k, nn, fdim - 1, fdim - 1)``.
        offset: how far from each facet contactors are held ``(k,)``; None on the facets.
    """

    which: Ints
    count: Ints
    meets: Bools
    rising: Array
    normals: Array
    away: Array
    axes: Array
    nodes: Ints
    weights: Array
    foot: Array
    beyond: Array
    x: Array
    dN: Array
    ddN: Array
    offset: Array | None = None

    @property
    def concave(self) -> Bools:
        """Corners that can hold a contactor ``(k,)``."""
        return self.meets & (self.rising > ON_PLANE)

    @property
    def flat(self) -> Bools:
        """Facets that lie in one plane, between which nothing changes ``(k,)``."""
        return np.abs(self.rising) <= ON_PLANE

    @property
    def summing(self) -> Array:
        """Vectors whose products with all normals of a corner are one, so that those with forces add up the facets' ``(k, gdim)``."""
        return np.linalg.pinv(self.normals).sum(axis=2)

    def axes_of(self, n: int) -> Array:
        """Axes of the space that the normals span, of all ``n`` contactors; the others' are zero ``(n, gdim, gdim)``."""
        axes = np.zeros((n, *self.axes.shape[1:]))
        axes[self.which] = np.where((np.arange(axes.shape[1]) < self.count[:, None])[:, :, None], self.axes, 0.0)
        return axes

    def gaps(self, points: Array) -> Array:
        """Distances of ``points (k, gdim)`` from the shared place along the axes ``(k, gdim)``."""
        place = self.foot if self.offset is None else self.foot + self.offset[:, None] * self.summing
        return np.einsum("krg,kg->kr", self.axes, points - place)

    def pulls(self, force: Array, mu: Array | float = 0.0) -> Array:
        """What each facet contributes to the contact forces, along its own outward normal.

        With friction it is along the force on one that leaves the corner over this facet: rotated against that way.

        Args:
            force: on the contactors ``(k, gdim)``.
            mu: coefficients of friction, of all or of each ``(k,)``.

        Returns:
            Coefficients ``(k, gdim)`` with which the facets' unit normals sum up to the force, or, where they span less than the
            space, to the part of it in their span; of those possible the least in norm. A facet whose coefficient is negative pulls.
            They are infinite beyond ``count``, where there is no facet.
        """
        mean = self.axes[:, 0]
        over, out = (np.einsum("kjg,kg->kj", v, mean) for v in (self.normals, self.away))
        # facets that would hold by themselves whatever is between them still let go of what is pulled out
        least = np.where(out > 0, over / np.where(out > 0, out, 1.0), np.inf).min(axis=1)
        along = self.normals - np.minimum(mu, WEDGED * least)[:, None, None] * self.away
        shares = np.einsum("kgr,kg->kr", np.linalg.pinv(along.transpose(0, 2, 1)).transpose(0, 2, 1), force)
        shares[np.arange(shares.shape[1])[None, :] >= self.count[:, None]] = np.inf
        return shares

    def friction(self, force: Array, mu: Array, first: Ints) -> Array:
        """Friction's part in the forces on contactors that came over one facet, until the others stopped them.

        A force is a sum of what the facets push with, each along its normal, and of friction, each in its own cone. Contactors have
        slid over the ``first`` facet: where its cone holds the force, that facet bears it alone. Else friction there is at its limit and
        leans as the force does, and the others bear the rest, with friction at its limit against leaving over them. So the others
        push with no more than they must, and as much of the work over the way into the corner is friction's as the cones allow.

        Args:
            force: on the contactors ``(k, gdim)``.
            mu: coefficients of friction ``(k,)``.
            first: which facet each came over ``(k,)``.

        Returns:
            Friction ``(k, gdim)``; along the edge that two facets share all of the force is friction.
        """
        k, gdim, _ = self.axes.shape
        here, place = np.arange(gdim)[None, :] < self.count[:, None], np.arange(gdim)[None, :] == first[:, None]
        axes = np.where(here[:, :, None], self.axes, 0.0)
        across = np.einsum("krg,kr->kg", axes, np.einsum("krg,kg->kr", axes, force))
        own = self.normals[np.arange(k), first]
        push = np.maximum(np.einsum("kg,kg->k", own, across), 0.0)
        lean = across - push[:, None] * own
        size = np.linalg.norm(lean, axis=1)
        limit = own + (mu / np.where(size > 0, size, 1.0))[:, None] * lean
        along = np.where(place[:, :, None], limit[:, None], self.normals - mu[:, None, None] * self.away)
        others = here & ~place & (size > mu * push)[:, None]
        shares = np.where(place, push[:, None], 0.0)
        for _ in range(gdim):
            i = np.flatnonzero(others.any(axis=1))
            bearing = np.where((others | place)[i, :, None], along[i], 0.0)
            shares[i] = np.einsum("kgr,kg->kr", np.linalg.pinv(bearing), across[i])
            # a facet that would have to pull bears nothing
            others &= shares > 0
            alone = i[~others[i].any(axis=1)]
            shares[alone] = np.where(place[alone], push[alone, None], 0.0)
        return np.asarray(force - np.einsum("kr,krg->kg", np.maximum(shares, 0.0), np.where(here[:, :, None], self.normals, 0.0)))

    def slid_over(self, before: Ints, facets: Ints, way: Array) -> Ints:
        """Which facet each contactor came over ``(k,)``: the one it was on, or, from farther away, the one that its way lies along best.

        Args:
            before: facets that the contactors were on at the start of the step ``(k,)``.
            facets: of the corners, -1 beyond ``count`` ``(k, gdim)``.
            way: of the contactors past the target in the step ``(k, gdim)``.
        """
        here = np.arange(facets.shape[1])[None, :] < self.count[:, None]
        same = (facets == before[:, None]) & here
        against = np.where(here, np.einsum("kjg,kg->kj", self.away, way), np.inf)
        return np.where(same.any(axis=1), np.argmax(same, axis=1), np.argmin(against, axis=1))

    def rubbing(self, force: Array, tau: Array, way: Array, first: Ints) -> Array:
        """Forces of facets along their normals times the ways along them, summed over the facets of each corner ``(k,)``.

        A contactor slides into a corner over its first facet, whose force on the way is all that it is pushed with along that facet's
        normal: a part of what another pushes with that is the cosine c of the angle between both. The rest of it, ``1 - c``, acts on
        the way along the edge between them alone, and on that way there is no friction across the edge.

        Args:
            force: on the contactors ``(k, gdim)``.
            tau: friction's part in it ``(k, gdim)``.
            way: past the target ``(k, gdim)``.
            first: which facet each came over ``(k,)``.
        """
        n = self.normals[np.arange(len(first)), first]
        over = np.linalg.norm(way - np.einsum("kg,kg->k", way, n)[:, None] * n, axis=1)
        pushed, push = (np.einsum("kg,kg->k", f, n) for f in (force, force - tau))
        if way.shape[1] == 2:
            return np.asarray(np.maximum(push * over, 0.0))
        edges = cross_products(n[:, None], self.normals)
        size = np.linalg.norm(edges, axis=2)
        along = np.abs(np.einsum("kjg,kg->kj", edges, way)) / np.where(size > 0, size, 1.0)
        shares = np.einsum("kgj,kg->kj", np.linalg.pinv(self.normals), force)
        rest = shares * (1.0 - np.einsum("kjg,kg->kj", self.normals, n))
        longest = along.max(axis=1)
        return np.asarray(np.maximum(push * (over - longest) + pushed * longest + (rest * along).sum(axis=1), 0.0))

    def hessians(self, force: Array) -> Array:
        """Second derivatives of the gaps times their forces: it is the direction of the force that stays on an edge."""
        size = np.linalg.norm(force, axis=1)
        n = force / np.where(size > 0, size, 1.0)[:, None]
        on_edge = (self.dN != 0).any(axis=(1, 2))
        k, nn, d = self.dN.shape
        H = np.zeros((k, (1 + nn) * n.shape[1], (1 + nn) * n.shape[1]))
        if d:
            i = np.flatnonzero(on_edge)
            H[i] = gap_hessians(
                n[i], np.zeros(len(i)), self.weights[i], self.dN[i], self.ddN[i], self.x[i], np.zeros((len(i), d, n.shape[1]))
            )
        return size[:, None, None] * H


def friction_in(corners: Corners | None, state: PairState, before: Ints, mu: Array, way: Array) -> Array:
    """Friction's part in the forces on contactors that corners hold ``(n, gdim)``; zero for others.

    Args:
        corners: that hold contactors.
        state: of the pair.
        before: facets that the contactors were on at the start of the step ``(n,)``, which they came over.
        mu: coefficients of friction ``(n,)``.
        way: of the contactors past the target in the step ``(n, gdim)``.
    """
    tau = np.zeros(state.force.shape)
    if corners is not None:
        i = corners.which
        tau[i] = corners.friction(state.force[i], mu[i], first_over(corners, state, before, way))
    return tau


def first_over(corners: Corners, state: PairState, before: Ints, way: Array) -> Ints:
    """Which facet those that corners hold came over ``(k,)``; arguments as those of ``friction_in``."""
    i = corners.which
    return corners.slid_over(before[i], np.column_stack([state.facet[i], state.held[i]]), way[i])


def find_corners(comm: MPI.Comm, target: MeshTarget, points: Array, which: Ints, facets: Ints) -> Corners | None:
    """Corners that sets of facets form with each other; None if no rank asks for any (collective).

    Args:
        comm: communicator.
        target: whose facets they are.
        points: positions of the contactors ``(k, gdim)``.
        which: their places among the pair's contactors ``(k,)``.
        facets: at least two for each, the rest -1 ``(k, gdim)``.
    """
    if not reduced(comm, len(which)):
        return None
    k, gdim = facets.shape
    row, j = np.nonzero(facets >= 0)
    every = target.project_on(points[row], facets[row, j])
    first = every.take(np.flatnonzero(j == 0))
    normals, middles = np.zeros((2, k, gdim, gdim))
    normals[row, j], middles[row, j] = target.outward(every), every.x.mean(axis=1)
    common = np.ones(first.nodes.shape, dtype=bool)
    for n in range(1, gdim):
        other, i = every.nodes[j == n], row[j == n]
        common[i] &= (first.nodes[i][:, :, None] == other[:, None, :]).any(axis=2)
    count = (facets >= 0).sum(axis=1)
    place = _shared_place(target, first, points, common, count, normals)
    arms = middles - place.foot[:, None]
    arm = arms[np.arange(k), count - 1]
    arm /= np.linalg.norm(arm, axis=1, keepdims=True)
    earlier = np.arange(gdim)[None, :] < count[:, None] - 1
    rising = np.where(earlier, np.einsum("kg,kjg->kj", arm, normals), np.inf).min(axis=1)
    return Corners(
        which, count, place.found, rising, normals, _away(arms, normals, count), _axes(normals, count), first.nodes,
        place.weights, place.foot, place.beyond, first.x, place.dN, place.ddN,
    )  # fmt: skip


@dataclass(frozen=True)
class _Place:
    found: Bools
    weights: Array
    foot: Array
    beyond: Array
    dN: Array
    ddN: Array


def _shared_place(
    target: MeshTarget, first: FacetProjection, points: Array, common: Bools, count: Ints, normals: Array
) -> _Place:
    """Closest points on what the facets have in common: a side of the first for two facets, a vertex for three.

    A side that ends where the target does is continued for contactors that are past that end. Two facets that share only a vertex stand
    for others beside them; their planes meet in a line.
    """
    k, nn = common.shape
    shape = target.shape
    d = shape.dim - 1
    found, weights = np.zeros(k, bool), np.zeros((k, nn))
    dN, ddN = np.zeros((k, nn, d)), np.zeros((k, nn, d, d))
    x, beyond, past = first.x, np.zeros(points.shape), (first.beyond != 0).any(axis=1)
    for side, nodes, _, _ in shape.edges():
        i = np.flatnonzero((count == 2) & common[:, nodes].all(axis=1) & ~found)
        s, _ = closest_point(side, x[i][:, nodes], points[i])
        if d:
            j = np.flatnonzero(past[i])
            line, end = x[i[j]][:, nodes], s[j]
            s[j], there = beneath(side, line, end, points[i[j]])
            beyond[i[j]] = np.einsum("ka,kag->kg", there.N - side.functions(end), line)
        tab = side.tabulate(s)
        weights[i[:, None], nodes], dN[i[:, None], nodes], ddN[i[:, None], nodes] = tab.N, tab.dN, tab.ddN
        found[i] = True
    for node in range(len(shape.topology[0])):
        i = np.flatnonzero(common[:, node] & ~found)
        weights[i, node] = 1.0
        found[i] = True
        if d:
            i = i[count[i] == 2]
            weights[i], dN[i, :, 0] = _on_line(target, x[i], points[i], node, normals[i])
    foot = np.einsum("ka,kag->kg", weights, x)
    return _Place(found, weights, foot, beyond, dN, ddN)


def _on_line(target: MeshTarget, x: Array, points: Array, node: int, normals: Array) -> tuple[Array, Array]:
    """Closest points on the line through a vertex in which the planes of two facets meet.

    Returns:
        Shape functions of the first facet, continued as far as need be, and their derivatives along the line ``(k, nn)``.
    """
    along = cross_products(normals[:, 0], normals[:, 1])
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along /= np.where(length > 0, length, 1.0)
    vertex = x[:, node]
    foot = vertex + np.einsum("kg,kg->k", along, points - vertex)[:, None] * along
    _, tab = beneath(target.shape, x, np.tile(target.shape.nodes[node], (len(x), 1)), foot)
    t = tangents(tab, x)
    m = np.einsum("kfg,keg->kfe", t, t)
    rate = np.linalg.solve(m, np.einsum("kfg,kg->kf", t, along)[..., None])[..., 0]
    return tab.N, np.einsum("kaf,kf->ka", tab.dN, rate)


def _away(arms: Array, normals: Array, count: Ints) -> Array:
    """Unit directions along facets with these normals away from the place they share, across an edge ``(k, gdim, gdim)``.

    ``arms (k, gdim, gdim)`` lead from that place to the facets' middles.
    """
    gdim = arms.shape[2]
    along = arms - np.einsum("krg,krg->kr", arms, normals)[:, :, None] * normals
    if gdim == 3:
        edge = cross_products(normals[:, 0], normals[:, 1])
        size = np.linalg.norm(edge, axis=1, keepdims=True)
        edge = np.where((count == 2)[:, None], edge / np.where(size > 0, size, 1.0), 0.0)
        along -= np.einsum("krg,kg->kr", along, edge)[:, :, None] * edge[:, None]
    size = np.linalg.norm(along, axis=2, keepdims=True)
    here = np.arange(gdim)[None, :, None] < count[:, None, None]
    return np.where(here, along / np.where(size > 0, size, 1.0), 0.0)


def _axes(normals: Array, count: Ints) -> Array:
    """Orthonormal axes of the space that the normals span, their mean first ``(k, gdim, gdim)``."""
    k, gdim, _ = normals.shape
    spread = normals[:, 0] - normals[:, 1]
    # two normals span a plane; whatever completes the axes is right for three
    basis = np.concatenate([normals.sum(axis=1)[:, None], spread[:, None], np.tile(np.eye(gdim), (k, 1, 1))], axis=1)
    axes = np.zeros((k, gdim, gdim))
    for r in range(gdim):
        rest = basis - np.einsum("kbg,krg,krh->kbh", basis, axes, axes)
        length = np.linalg.norm(rest, axis=2)
        # in this order, but never a direction that is spent
        best = np.argmax(length > (1e-12 if r < 2 else 0.5), axis=1)
        v = rest[np.arange(k), best]
        v -= np.einsum("kg,krg,krh->kh", v, axes, axes)
        axes[:, r] = v / np.linalg.norm(v, axis=1, keepdims=True)
    return axes
