"""Contactors held in concave corners of a target: facets, normals, and the force on each facet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints, cross_products
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.projection import gap_hessians

#: Facets whose slopes differ by less are one plane. [convention; slope; test_corners.py::test_facets_in_one_plane]
ON_PLANE = 1e-9


#: Facets hold what is in their corner by friction up to this part of what would hold it against any pull.
#: [heuristic; coefficient of friction; test_concave_corners.py::test_a_block_driven_into_a_leaning_wall]
WEDGED = 0.99


@dataclass(frozen=True)
class Corners:
    """Position of contactors relative to an edge or vertex shared by several facets."""

    which: Ints  # indices among the pair's contactors ``(k,)``
    count: Ints  # number of facets, 2 to gdim ``(k,)``
    meets: Bools  # whether the facets share an edge or vertex ``(k,)``
    rising: Array  # slope at which the last facet rises above the planes of the others, positive if concave ``(k,)``
    normals: Array  # outward normals of the facets, zero beyond ``count`` ``(k, gdim, gdim)``
    away: Array  # unit directions along the facets away from the shared edge or vertex, zero beyond ``count`` ``(k, gdim, gdim)``
    axes: Array  # orthonormal axes; the first ``count`` span the normals, the first is their mean direction ``(k, gdim, gdim)``
    nodes: Ints  # global nodes of the first facet ``(k, nn)``
    weights: Array  # shape functions at the closest point of the shared edge or vertex ``(k, nn)``
    foot: Array  # this closest point ``(k, gdim)``; past the target's end it lies on the continuation of the edge
    beyond: Array  # vector of ``foot`` past the end ``(k, gdim)``
    x: Array  # positions of the nodes ``(k, nn, gdim)``
    dN: Array  # derivatives of the weights along the edge, zero at a vertex ``(k, nn, fdim - 1)``
    ddN: Array  # second derivatives ``(k, nn, fdim - 1, fdim - 1)``
    offset: Array | None = None  # distance from each facet at which contactors are held ``(k,)``; None without offset

    @property
    def concave(self) -> Bools:
        """Corners that can hold a contactor ``(k,)``."""
        return self.meets & (self.rising > ON_PLANE)

    @property
    def flat(self) -> Bools:
        """Corners whose facets lie in one plane ``(k,)``."""
        return np.abs(self.rising) <= ON_PLANE

    @property
    def summing(self) -> Array:
        """Vectors s with ``s . n = 1`` for all normals of a corner, so that ``s . f`` is the sum of the facets' forces ``(k, gdim)``."""
        return np.linalg.pinv(self.normals).sum(axis=2)

    def axes_of(self, n: int) -> Array:
        """Axes of the span of the normals for all ``n`` contactors; zero for contactors without corner ``(n, gdim, gdim)``."""
        axes = np.zeros((n, *self.axes.shape[1:]))
        axes[self.which] = np.where((np.arange(axes.shape[1]) < self.count[:, None])[:, :, None], self.axes, 0.0)
        return axes

    def gaps(self, points: Array) -> Array:
        """Distances of ``points (k, gdim)`` from the shared edge or vertex along the axes ``(k, gdim)``."""
        place = self.foot if self.offset is None else self.foot + self.offset[:, None] * self.summing
        return np.einsum("krg,kg->kr", self.axes, points - place)

    def pulls(self, force: Array, mu: Array | float = 0.0) -> Array:
        """Contribution of each facet to the contact forces, along its own outward normal.

        With friction, the direction is rotated against the motion that leaves the corner over this facet.

        Args:
            force: on the contactors ``(k, gdim)``.
            mu: coefficients of friction, for all or for each ``(k,)``.

        Returns:
            Coefficients ``(k, gdim)`` with which the facets' unit normals sum up to the force, or to its part in their span, if
            they span less than the space. Of all such coefficients they are the least in norm. A facet whose coefficient is negative pulls.
            They are infinite beyond ``count``, where there is no facet.
        """
        mean = self.axes[:, 0]
        over, out = (np.einsum("kjg,kg->kj", v, mean) for v in (self.normals, self.away))
        # self-locking facets still release contactors that are pulled out
        least = np.where(out > 0, over / np.where(out > 0, out, 1.0), np.inf).min(axis=1)
        along = self.normals - np.minimum(mu, WEDGED * least)[:, None, None] * self.away
        shares = np.einsum("kgr,kg->kr", np.linalg.pinv(along.transpose(0, 2, 1)).transpose(0, 2, 1), force)
        shares[np.arange(shares.shape[1])[None, :] >= self.count[:, None]] = np.inf
        return shares

    def friction(self, force: Array, mu: Array, first: Ints) -> Array:
        """Friction part of the forces on contactors that slid over one facet into the corner.

        A force is the sum of normal forces of the facets and of their friction forces, each within its cone. Contactors slid over
        the ``first`` facet: if its cone contains the force, this facet carries it alone. Otherwise friction there is at its limit,
        in the direction of the tangential force. The other facets carry the rest, with friction at its limit against leaving over
        them. Their normal forces are then minimal, and the frictional part of the work of sliding into the corner is maximal.

        Args:
            force: on the contactors ``(k, gdim)``.
            mu: coefficients of friction ``(k,)``.
            first: facet over which each contactor came ``(k,)``.

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
            # a facet in tension carries no force
            others &= shares > 0
            alone = i[~others[i].any(axis=1)]
            shares[alone] = np.where(place[alone], push[alone, None], 0.0)
        return np.asarray(force - np.einsum("kr,krg->kg", np.maximum(shares, 0.0), np.where(here[:, :, None], self.normals, 0.0)))

    def slid_over(self, before: Ints, facets: Ints, way: Array) -> Ints:
        """Facet over which each contactor came ``(k,)``: its facet at the start of the step, or the facet best aligned with its motion.

        Args:
            before: facets of the contactors at the start of the step ``(k,)``.
            facets: of the corners, -1 beyond ``count`` ``(k, gdim)``.
            way: displacement of the contactors relative to the target in the step ``(k, gdim)``.
        """
        here = np.arange(facets.shape[1])[None, :] < self.count[:, None]
        same = (facets == before[:, None]) & here
        against = np.where(here, np.einsum("kjg,kg->kj", self.away, way), np.inf)
        return np.where(same.any(axis=1), np.argmax(same, axis=1), np.argmin(against, axis=1))

    def rubbing(self, force: Array, tau: Array, way: Array, first: Ints) -> Array:
        """Normal forces of facets times the sliding distance along them, summed over the facets of each corner ``(k,)``.

        A contactor slides into a corner over its first facet. The force of this facet is then the whole force along its normal: of
        the force of another facet it includes the part c, the cosine of the angle between the two. The rest, ``1 - c``, acts only
        on motion along the edge between both, without friction across the edge.

        Args:
            force: on the contactors ``(k, gdim)``.
            tau: friction part of this force ``(k, gdim)``.
            way: displacement relative to the target ``(k, gdim)``.
            first: facet over which each contactor came ``(k,)``.
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
        """Second derivatives of the gaps times their forces; on an edge, the direction of the force is constant."""
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
    """Friction part of the forces on contactors held in corners ``(n, gdim)``; zero for others.

    Args:
        corners: that hold contactors.
        state: of the pair.
        before: facets of the contactors at the start of the step ``(n,)``.
        mu: coefficients of friction ``(n,)``.
        way: displacement of the contactors relative to the target in the step ``(n, gdim)``.
    """
    tau = np.zeros(state.force.shape)
    if corners is not None:
        i = corners.which
        tau[i] = corners.friction(state.force[i], mu[i], first_over(corners, state, before, way))
    return tau


def first_over(corners: Corners, state: PairState, before: Ints, way: Array) -> Ints:
    """Facet over which contactors held in corners came ``(k,)``; arguments as in ``friction_in``."""
    i = corners.which
    return corners.slid_over(before[i], np.column_stack([state.facet[i], state.held[i]]), way[i])
