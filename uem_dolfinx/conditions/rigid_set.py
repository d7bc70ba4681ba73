"""A set of nodes with a point: its motion as one rigid body, and nodal forces equivalent to a force and a moment at the point.

With weights w of sum 1, the middle ``m = sum w x`` and arms ``r = x - m``, a force f and a moment t at the point p become

    f_i = w_i (f + a x r_i),    S a = t + (p - m) x f,    S = sum w (|r|^2 1 - r r')

with the same resultant and moment; this is the distribution nearest to a uniform one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Indices, Ints, cross_products
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.rigid import Motion, rotation_matrix, rotation_vector
from uem_dolfinx.parallel import reduced


def velocities(arms: Array) -> Array:
    """Velocities of points at ``arms (n, gdim)`` in translations and unit rotations about the axes ``(n, gdim, gdim + n_turns)``."""
    n, g = arms.shape
    shifts = np.broadcast_to(np.eye(g), (n, g, g))
    return np.concatenate([shifts, turned(np.eye(1 if g == 2 else 3)[:, None], arms).transpose(1, 2, 0)], axis=2)


def turned(turns: Array, arms: Array) -> Array:
    """``turns x arms`` of vectors ``(..., n_turns)`` and ``(..., gdim)``; in 2D a rotation is one number."""
    if arms.shape[-1] == 3:
        return cross_products(turns, arms)
    return np.asarray(turns * np.stack([-arms[..., 1], arms[..., 0]], axis=-1))


def moments(arms: Array, forces: Array) -> Array:
    """``arms x forces (..., gdim)``: ``(..., n_turns)``, one number each in 2D."""
    if arms.shape[-1] == 3:
        return cross_products(arms, forces)
    return np.asarray(arms[..., :1] * forces[..., 1:] - arms[..., 1:] * forces[..., :1])


@dataclass(frozen=True)
class Placement:
    """Position and orientation of a set as one rigid body."""

    motion: Motion  # from the reference configuration to the present, about the middle of the set
    small: Array | None = None  # small rotation ``(n_turns,)`` instead of the motion's rotation; None for a finite rotation

    def arms(self, X: Array) -> Array:
        """Present arms from the middle to points with reference positions ``X (n, gdim)``."""
        return (X - self.motion.about) @ self.motion.Q.T

    def displacement(self, X: Array) -> Array:
        """Displacement of points with reference positions ``X (n, gdim)``."""
        if self.small is None:
            return self.motion.translation + (X - self.motion.about) @ (self.motion.Q - np.eye(X.shape[1])).T
        return self.motion.translation + turned(self.small, X - self.motion.about)

    def moved(self, z: Array) -> Placement:
        """After a further translation and finite rotation about the middle ``z (gdim + n_turns,)``."""
        g = len(self.motion.about)
        Q = rotation_matrix(z[g:]) @ self.motion.Q
        return Placement(Motion(self.motion.translation + z[:g], Q, self.motion.about))

    @property
    def turn(self) -> Array:
        """Angle or rotation vector ``(n_turns,)``."""
        return rotation_vector(self.motion.Q) if self.small is None else self.small


class RigidSet:
    """Nodes of a rigid coupling, with its point (collective).

    Args:
        nodes: owned nodes.
        point: moves with the nodes, reference position ``(gdim,)``.
        large: whether rotations are finite.
    """

    def __init__(self, config: Configuration, nodes: Indices, point: Array, large: bool):
        self.config, self.nodes, self.point, self.large = config, nodes, point, large
        self.X: Array = config.X[nodes]  # reference positions of the nodes ``(n, gdim)``
        self.count = reduced(config.comm, len(nodes))
        self.middle = self._mean(self.X)  # their mean over all ranks ``(gdim,)``
        #: root of their mean squared distance from the middle, a length.
        self.radius = float(np.sqrt(self._mean(((self.X - self.middle) ** 2).sum(axis=1, keepdims=True))[0]))

    @property
    def scale(self) -> Array:
        """Scales of translations and rotations, so that unit ones move the nodes by the same amount ``(gdim + n_turns,)``."""
        g = self.config.gdim
        return np.append(np.ones(g), np.full(1 if g == 2 else 3, 1.0 / self.radius))

    def _mean(self, values: Array) -> Array:
        """Mean of values ``(n, ...)`` at the nodes over all ranks (collective)."""
        return np.asarray(reduced(self.config.comm, values.sum(axis=0))) / max(self.count, 1)

    @property
    def reference(self) -> Placement:
        """Its placement in the reference configuration."""
        g = self.config.gdim
        return Placement(Motion(np.zeros(g), np.eye(g), self.middle), None)

    def placement(self, u: Array) -> Placement:
        """The nearest rigid placement for a displacement ``(n_owned, gdim)`` (collective)."""
        own, arms, g = u[self.nodes], self.X - self.middle, self.config.gdim
        if not self.large:
            z = self.motion_of(self.reference, u)
            return Placement(Motion(z[:g], np.eye(g), self.middle), z[g:])
        sums = self._mean(np.concatenate([own[:, :, None], own[:, :, None] * arms[:, None, :]], axis=2))
        spread = self._mean(arms[:, :, None] * arms[:, None, :])
        left, _, right = np.linalg.svd(sums[:, 1:] + spread)
        left[:, -1] *= np.sign(np.linalg.det(left @ right))
        # sums over many nodes have rounding errors: the translation is corrected by the mean of the remaining displacement
        near = Placement(Motion(sums[:, 0], left @ right, self.middle))
        return Placement(Motion(sums[:, 0] + self._mean(own - near.displacement(self.X)), left @ right, self.middle))

    def motion_of(self, at: Placement, rates: Array) -> Array:
        """Translation and rotation about the middle nearest to rates ``(n_owned, gdim)``: ``(gdim + n_turns,)`` (collective)."""
        own = rates[self.nodes]
        V = velocities(at.arms(self.X)) * self.scale
        sums = self._mean(np.concatenate([np.einsum("ngz,ngy->nzy", V, V), np.einsum("ngz,ng->nz", V, own)[:, :, None]], axis=2))
        return self.scale * np.asarray(np.linalg.lstsq(sums[:, :-1], sums[:, -1], rcond=None)[0], dtype=float)

    def spread(self, u: Array, force: Array, moment: Array) -> Array:
        """Nodal forces ``(n, gdim)`` equivalent to a force and a moment at the point (collective)."""
        if not (force.any() or moment.any()):
            return np.zeros_like(self.X)
        if self.large:
            at = self.placement(u)
            arms, lever = self.X + u[self.nodes] - self.middle - at.motion.translation, at.arms(self.point[None])[0]
        else:
            arms, lever = self.X - self.middle, self.point - self.middle
        k = len(moment)
        V = turned(np.eye(k)[:, None], arms[None])
        S = self._mean(np.einsum("ang,bng->nab", V, V))
        a: Array = np.asarray(np.linalg.lstsq(S, moment + moments(lever, force), rcond=None)[0], dtype=float)
        return np.asarray(force + turned(a, arms)) / self.count


class RigidSets:
    """Several sets whose motions are one vector z: translation and rotation of each set about its middle, one set after the other.

    Args:
        sets: without common nodes, all with finite or all with small rotations.
    """

    def __init__(self, sets: Sequence[RigidSet]):
        self.each, self.large = list(sets), sets[0].large
        self.nodes: Indices = np.concatenate([one.nodes for one in sets])  # owned nodes of all sets ``(n,)``
        #: index of the set of each node ``(n,)``.
        self.part: Ints = np.repeat(np.arange(len(sets)), [len(one.nodes) for one in sets])
        self.X: Array = np.concatenate([one.X for one in sets])  # reference positions of the nodes ``(n, gdim)``
        #: of the components of z ``(n_z,)``, see ``RigidSet.scale``.
        self.scale: Array = np.concatenate([one.scale for one in sets])
        self._size = len(self.scale) // len(sets)

    def __getitem__(self, i: int) -> slice:
        """Components of z of a set."""
        return slice(i * self._size, (i + 1) * self._size)

    def placements(self, u: Array) -> list[Placement]:
        """The nearest rigid placements for a displacement ``(n_owned, gdim)`` (collective)."""
        return [one.placement(u) for one in self.each]

    def velocities(self, at: Sequence[Placement], X: Array, part: Ints) -> Array:
        """Velocities of points of sets ``part (n,)`` at reference positions ``X (n, gdim)`` in scaled motions ``(n, gdim, n_z)``."""
        V = np.zeros((*X.shape, len(self.scale)))
        for i, place in enumerate(at):
            V[part == i, :, self[i]] = velocities(place.arms(X[part == i]))
        return V * self.scale

    def displacement(self, at: Sequence[Placement], X: Array, part: Ints) -> Array:
        """Displacement of such points ``(n, gdim)``."""
        u = np.empty_like(X)
        for i, place in enumerate(at):
            u[part == i] = place.displacement(X[part == i])
        return u
