"""Contactors that concave corners of a target hold: facets, normals, and the forces that each facet bears."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints, cross_products
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.projection import gap_hessians

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
