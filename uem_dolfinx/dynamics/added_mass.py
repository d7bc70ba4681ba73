"""Mass and inertia that rigid couplings add at their points.

They are represented by the point p and by unit axes d_i that rotate with the body. With the principal values I_i of the inertia about p,
and ``J_i = tr(I) / 2 - I_i``, the kinetic energy is, for every rotation,

    (m |p'|^2 + sum J_i |d_i'|^2) / 2

In 2D one axis is sufficient, with J the inertia. The integrator treats p and d_i like displacements of nodes, which includes gyroscopic
terms. The inertia forces are then a force at the point and a moment about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
from uem_dolfinx.conditions.rigid_set import Placement, moments, turned, velocities
from uem_dolfinx.dynamics.scheme import CentralDifferences, Scheme
from uem_dolfinx.parallel import gathered


class AddedMass:
    """Mass and inertia of one coupling, the same on all ranks (collective).

    Args:
        coupling: attached.

    Attributes:
        set: nodes of the coupling.
        masses: of the point, and of its axes J ``(1 + n_axes,)``.
        places: displacement of the point, and change of its axes, of the committed state ``(1 + n_axes, gdim)``.
        velocity, acceleration, forces: of point and axes, and their inertia forces ``(1 + n_axes, gdim)``.
        carried: inertia forces minus weight in the last equilibrium ``(1 + n_axes, gdim)``.
        factor: of the masses in the tangent.
    """

    def __init__(self, coupling: RigidCoupling):
        self.set, self._point = coupling.nodes, coupling.nodes.point
        J, self._axes = principal(coupling.inertia, len(self._point))
        self.masses: Array = np.append(coupling.mass, J)
        self._on_bearing = set(range(len(self._point))) <= set(coupling.prescribed)
        self.places = self._now()
        self.velocity, self.acceleration, self.forces, self.carried = (np.zeros_like(self.places) for _ in range(4))
        self.factor = 0.0
        self._weight = np.zeros_like(self.places)
        #: Scheme of the present step, and its coefficients; None between steps.
        self._step: tuple[Scheme | CentralDifferences, float, Array, float, Array] | None = None

    # -- as a rigid body ---------------------------------------------------------------------------------------------------

    @property
    def _placement(self) -> Placement:
        config = self.set.config
        return self.set.placement(config.displacement[: config.n_owned])

    def _now(self) -> Array:
        """Present displacement of the point and change of the axes (collective)."""
        at = self._placement
        if at.small is None:
            change = self._axes @ (at.motion.Q - np.eye(len(self._point))).T
        else:
            change = turned(at.small, self._axes)
        return np.concatenate([at.displacement(self._point[None]), change])

    def arms(self, at: Placement) -> Array:
        """Arms of the forces of point and axes about the point ``(1 + n_axes, gdim)``."""
        return np.concatenate([np.zeros((1, len(self._point))), self._axes @ at.motion.Q.T])

    def motions(self, at: Placement) -> Array:
        """Velocities in translations and unit rotations about the middle of the set ``(1 + n_axes, gdim, gdim + n_turns)``."""
        V = velocities(self.arms(at))
        V[0], V[1:, :, : len(self._point)] = velocities(at.arms(self._point[None]))[0], 0.0
        return V

    def bend(self, at: Placement, turn: Array) -> Array:
        """Centripetal accelerations ``(1 + n_axes, gdim)`` of an angular velocity ``(n_turns,)`` about the middle of the set."""
        arms = self.arms(at)
        arms[0] = at.arms(self._point[None])[0]
        return turned(turn, turned(turn, arms))

    def mass_of(self, at: Placement) -> Array:
        """Mass matrix of the motions of the set ``(gdim + n_turns, gdim + n_turns)``."""
        V = self.motions(at)
        return np.asarray(np.einsum("n,ngz,ngy->zy", self.masses, V, V))

    @property
    def inert(self) -> Indices:
        """Owned nodes whose rigid motions have inertia by this mass (collective).

        With sufficient inertia all nodes; with a mass only, the node nearest to the point; with an inertia only and no bearing, none.
        """
        s, n_axes = self.set, np.count_nonzero(self.masses[1:])
        if n_axes >= len(self._point) - 1 and (self.masses[0] > 0.0 or self._on_bearing):
            return s.nodes
        if not self.masses[0] > 0.0:
            return s.nodes[:0]
        away = np.linalg.norm(s.X - self._point, axis=1)
        offer = np.full(1 + len(self._point), np.inf)
        order = np.lexsort([*s.X.T[::-1], away])[:1]
        if len(order):
            offer = np.append(away[order[0]], s.X[order[0]])
        every = gathered(s.config.comm, offer)
        best = every[np.lexsort(every.T[::-1])[0]]
        return s.nodes[order] if len(order) and np.array_equal(best, offer) else s.nodes[:0]

    # -- forces ------------------------------------------------------------------------------------------------------------

    def loads(self) -> Array:
        """Inertia forces minus weight at the present displacement ``(1 + n_axes, gdim)`` (collective)."""
        return (self.forces if self._step is None else self._inertia()) - self._weight

    def nodal_forces(self, loads: Array) -> Array:
        """Nodal forces of such loads at the owned nodes of the set ``(n, gdim)`` (collective)."""
        config = self.set.config
        turning = np.atleast_1d(moments(self.arms(self._placement), loads).sum(axis=0))
        return self.set.spread(config.displacement[: config.n_owned], loads[0], turning)

    @property
    def _as_forces(self) -> Array:
        """Factors that convert moments on the axes to forces at the nodes of the set ``(1 + n_axes, 1)``."""
        return np.append(1.0, np.full(len(self._axes), 1.0 / self.set.radius))[:, None]

    def size(self) -> float:
        """Norm of the loads, which may cancel at the nodes of a body (collective)."""
        return float(np.linalg.norm(self._as_forces * self.loads()))

    def rounding(self) -> float:
        """Norm of tangent times displacement, for the rounding of the loads (collective)."""
        sizes = np.append(np.linalg.norm(self._now()[0]), np.ones(len(self._axes)))[:, None]
        return self.factor * float(np.linalg.norm(self._as_forces * self.masses[:, None] * sizes))

    def _inertia(self) -> Array:
        """Inertia forces, as in ``Dynamics`` (collective)."""
        assert self._step is not None
        scheme, a_rate, a_past, _, _ = self._step
        a = a_rate * (self._now() - self.places) + a_past
        mean = (1.0 - scheme.alpha_m) * a + scheme.alpha_m * self.acceleration
        return (self.masses[:, None] * mean - scheme.alpha_f * self.forces) / (1.0 - scheme.alpha_f)

    # -- in time -----------------------------------------------------------------------------------------------------------

    def start(self, velocity: Array, gravity: Array) -> None:
        """Set the initial velocity from the nodes' velocities ``(n_owned, gdim)``, and gravity ``(gdim,)`` (collective)."""
        self.velocity = self.carried_by(velocity)
        self._weight[0] = self.masses[0] * gravity

    def carried_by(self, rates: Array) -> Array:
        """Rates of point and axes ``(1 + n_axes, gdim)``, from rates of the nodes ``(n_owned, gdim)`` (collective)."""
        at = self._placement
        return self.motions(at) @ self.set.motion_of(at, rates)

    def nodal_velocities(self) -> Array:
        """Velocities of the owned nodes of the set that follow point and axes ``(n, gdim)`` (collective)."""
        at, V, g = self._placement, self.motions(self._placement), len(self._point)
        # rows and columns of one unit
        rows, columns = 1.0 / self._as_forces, np.append(np.ones(g), np.full(V.shape[2] - g, 1.0 / self.set.radius))
        scaled = V * rows[:, :, None] * columns
        rates, *_ = np.linalg.lstsq(scaled.reshape(-1, V.shape[2]), (rows * self.velocity).ravel(), rcond=None)
        return np.asarray(velocities(at.arms(self.set.X)) @ (columns * rates))

    def begin(self, scheme: Scheme | CentralDifferences, dt: float) -> None:
        """Begin a step."""
        self._step = scheme, *scheme.ending(self.velocity, self.acceleration, dt)
        self.factor = scheme.factor(dt)

    def leave(self) -> None:
        """Leave a step that has begun."""
        self._step = None

    def accelerate(self, acceleration: Array) -> None:
        """Set the first acceleration from the acceleration of the nodes ``(n_owned, gdim)`` (collective)."""
        self.acceleration = self.carried_by(acceleration)
        self.forces = self.masses[:, None] * self.acceleration

    def take_out(self, acceleration: Array, part: float) -> Array:
        """Take ``part`` of an acceleration of the nodes ``(n_owned, gdim)`` and its inertia forces out of the committed ones (collective).

        Returns those inertia forces at the owned nodes of the set ``(n, gdim)``.
        """
        inertia = self.masses[:, None] * (a := self.carried_by(acceleration))
        self.acceleration, self.forces = self.acceleration - part * a, self.forces - inertia
        return self.nodal_forces(inertia)

    def commit(self) -> None:
        """Commit the rates and forces of the present displacement (collective)."""
        now, self.carried = self._now(), self.loads()
        if self._step is not None:
            du, (_, a_rate, a_past, v_rate, v_past) = now - self.places, self._step
            self.forces, self._step = self._inertia(), None
            self.acceleration, self.velocity = a_rate * du + a_past, v_rate * du + v_past
        self.places = now

    def change_rates(self, velocity: Array, acceleration: Array) -> None:
        """Replace velocity and acceleration of the committed state ``(1 + n_axes, gdim)``."""
        self.forces = self.forces + self.masses[:, None] * (acceleration - self.acceleration)
        self.velocity, self.acceleration = velocity, acceleration

    @property
    def kept(self) -> list[Array]:
        """Initial state of the next step."""
        return [self.places, self.velocity, self.acceleration, self.forces, self.carried]

    @kept.setter
    def kept(self, values: Sequence[Array]) -> None:
        self._step = None
        self.places, self.velocity, self.acceleration, self.forces, self.carried = (np.array(v, dtype=float) for v in values)

    # -- sums --------------------------------------------------------------------------------------------------------------

    @property
    def pushed(self) -> Array:
        """Forces of the coupling and of gravity on point and axes in the last equilibrium ``(1 + n_axes, gdim)``."""
        return self.carried + self._weight

    @property
    def momentum(self) -> Array:
        """Momentum ``(gdim,)``."""
        return np.asarray(self.masses[0] * self.velocity[0])

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy, including rotation."""
        return 0.5 * float(self.masses @ (self.velocity**2).sum(axis=1))


def principal(inertia: Array, gdim: int) -> tuple[Array, Array]:
    """Second moments J ``(n_axes,)`` of an inertia ``(n_turns, n_turns)``, and axes ``(n_axes, gdim)``; empty for zero inertia."""
    if not inertia.any():
        return np.zeros(0), np.zeros((0, gdim))
    if gdim == 2:
        return inertia[0], np.eye(2)[:1]
    values, axes = np.linalg.eigh(inertia)
    return np.maximum(0.5 * values.sum() - values, 0.0), axes.T


def add_masses(couplings: Sequence[RigidCoupling], dynamics: Any) -> None:
    """Make the added masses of attached couplings, and add them to the dynamics of a problem (collective)."""
    for one in couplings:
        if one.mass or one.inertia.any():
            one.added = AddedMass(one)
            if dynamics is not None:
                dynamics.add(one.added)
