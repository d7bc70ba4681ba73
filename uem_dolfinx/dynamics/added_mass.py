"""Mass and inertia that rigid couplings add at their points.

They are carried by the point p and by axes d_i of length one that turn with the body: with the principal values of the inertia about p,
``J_i = tr(I) / 2 - I_i``, the kinetic energy is, for every rotation,

    (m |p'|^2 + sum J_i |d_i'|^2) / 2

In the plane one axis does, with J the inertia. The rule of integration acts on p and d_i as on the displacements of nodes, which have
gyroscopic terms thereby; what it makes of them are a force at the point and a moment about it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
from uem_dolfinx.conditions.rigid_set import Placement, moments, turned, velocities
from uem_dolfinx.dynamics.scheme import Scheme
from uem_dolfinx.parallel import gathered


class AddedMass:
    """What one coupling adds, alike on all ranks (collective).

    Args:
        coupling: attached.

    Attributes:
        set: nodes of the coupling.
        masses: of the point, and of its axes J ``(1 + n_axes,)``.
        places: displacement of the point, and change of its axes, of the committed state ``(1 + n_axes, gdim)``.
        velocity, acceleration, forces: theirs, and the forces of inertia ``(1 + n_axes, gdim)``.
        carried: inertia minus weight with which the coupling was in equilibrium last ``(1 + n_axes, gdim)``.
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
        #: Scheme of the step that has begun, and what it says of it; None between steps.
        self._step: tuple[Scheme, float, Array, float, Array] | None = None

    # -- as a rigid body ---------------------------------------------------------------------------------------------------

    @property
    def _placement(self) -> Placement:
        config = self.set.config
        return self.set.placement(config.displacement[: config.n_owned])

    def _now(self) -> Array:
        """Where point and axes are beside the drawing (collective)."""
        at = self._placement
        if at.small is None:
            change = self._axes @ (at.motion.Q - np.eye(len(self._point))).T
        else:
            change = turned(at.small, self._axes)
        return np.concatenate([at.displacement(self._point[None]), change])

    def arms(self, at: Placement) -> Array:
        """Arms of their forces about the point ``(1 + n_axes, gdim)``."""
        return np.concatenate([np.zeros((1, len(self._point))), self._axes @ at.motion.Q.T])

    def motions(self, at: Placement) -> Array:
        """Their velocities in shifts and unit turns about the middle of the set ``(1 + n_axes, gdim, gdim + n_turns)``."""
        V = velocities(self.arms(at))
        V[0], V[1:, :, : len(self._point)] = velocities(at.arms(self._point[None]))[0], 0.0
        return V

    def bend(self, at: Placement, turn: Array) -> Array:
        """Accelerations ``(1 + n_axes, gdim)`` that a spin ``(n_turns,)`` makes about the middle of the set."""
        arms = self.arms(at)
        arms[0] = at.arms(self._point[None])[0]
        return turned(turn, turned(turn, arms))

    def mass_of(self, at: Placement) -> Array:
        """Mass that the motions of the set feel ``(gdim + n_turns, gdim + n_turns)``."""
        V = self.motions(at)
        return np.asarray(np.einsum("n,ngz,ngy->zy", self.masses, V, V))

    def momentum_of(self, at: Placement, rates: Array) -> Array:
        """What these masses with rates ``(1 + n_axes, gdim)`` have along the motions of the set ``(gdim + n_turns,)``."""
        return np.asarray(np.einsum("n,ngz,ng->z", self.masses, self.motions(at), rates))

    @property
    def inert(self) -> Indices:
        """Owned nodes whose rigid motions it gives inertia (collective).

        All of them, or of a mass alone the one next to the point, or none of an inertia alone on what may shift.
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
        """Inertia minus weight where the set is now ``(1 + n_axes, gdim)`` (collective)."""
        return (self.forces if self._step is None else self._inertia()) - self._weight

    def nodal_forces(self, loads: Array) -> Array:
        """What such loads are at the owned nodes of the set ``(n, gdim)`` (collective)."""
        config = self.set.config
        turning = np.atleast_1d(moments(self.arms(self._placement), loads).sum(axis=0))
        return self.set.spread(config.displacement[: config.n_owned], loads[0], turning)

    @property
    def _as_forces(self) -> Array:
        """Factors that make forces of what turns the axes, alike to those at the nodes of the set ``(1 + n_axes, 1)``."""
        return np.append(1.0, np.full(len(self._axes), 1.0 / self.set.radius))[:, None]

    def size(self) -> float:
        """Norm of the loads, which the nodes of a body in balance do not see (collective)."""
        return float(np.linalg.norm(self._as_forces * self.loads()))

    def rounding(self) -> float:
        """Norm of what the displacement times the tangent is, whose rounding is in the loads (collective)."""
        ways = np.append(np.linalg.norm(self._now()[0]), np.ones(len(self._axes)))[:, None]
        return self.factor * float(np.linalg.norm(self._as_forces * self.masses[:, None] * ways))

    def _inertia(self) -> Array:
        """As of ``Dynamics`` (collective)."""
        assert self._step is not None
        scheme, a_rate, a_past, _, _ = self._step
        a = a_rate * (self._now() - self.places) + a_past
        mean = (1.0 - scheme.alpha_m) * a + scheme.alpha_m * self.acceleration
        return (self.masses[:, None] * mean - scheme.alpha_f * self.forces) / (1.0 - scheme.alpha_f)

    # -- in time -----------------------------------------------------------------------------------------------------------

    def start(self, velocity: Array, gravity: Array) -> None:
        """Move with the nodes at the start, whose velocities these are ``(n_owned, gdim)``, and fall ``(gdim,)`` (collective)."""
        self.velocity = self._carried(velocity)
        self._weight[0] = self.masses[0] * gravity

    def _carried(self, rates: Array) -> Array:
        """Rates that those of the nodes ``(n_owned, gdim)`` give point and axes ``(1 + n_axes, gdim)`` (collective)."""
        at = self._placement
        return self.motions(at) @ self.set.motion_of(at, rates)

    def begin(self, scheme: Scheme, dt: float) -> None:
        """Begin a step."""
        self._step = scheme, *scheme.ending(self.velocity, self.acceleration, dt)
        self.factor = scheme.factor(dt)

    def leave(self) -> None:
        """Leave a step that has begun."""
        self._step = None

    def accelerate(self, acceleration: Array) -> None:
        """Take the first acceleration, of the nodes ``(n_owned, gdim)`` (collective)."""
        self.acceleration = self._carried(acceleration)
        self.forces = self.masses[:, None] * self.acceleration

    def commit(self) -> None:
        """Keep what belongs to the present displacement (collective)."""
        now, self.carried = self._now(), self.loads()
        if self._step is not None:
            du, (_, a_rate, a_past, v_rate, v_past) = now - self.places, self._step
            self.forces, self._step = self._inertia(), None
            self.acceleration, self.velocity = a_rate * du + a_past, v_rate * du + v_past
        self.places = now

    def change_rates(self, velocity: Array, acceleration: Array) -> None:
        """Go on with another velocity and acceleration of the committed state ``(1 + n_axes, gdim)``."""
        self.forces = self.forces + self.masses[:, None] * (acceleration - self.acceleration)
        self.velocity, self.acceleration = velocity, acceleration

    @property
    def kept(self) -> list[Array]:
        """All that the next step begins with."""
        return [self.places, self.velocity, self.acceleration, self.forces, self.carried]

    @kept.setter
    def kept(self, values: Sequence[Array]) -> None:
        self._step = None
        self.places, self.velocity, self.acceleration, self.forces, self.carried = (np.array(v, dtype=float) for v in values)

    # -- sums --------------------------------------------------------------------------------------------------------------

    @property
    def pushed(self) -> Array:
        """Forces of the coupling and of gravity on point and axes, when these were in equilibrium last ``(1 + n_axes, gdim)``."""
        return self.carried + self._weight

    @property
    def momentum(self) -> Array:
        """Momentum ``(gdim,)``."""
        return np.asarray(self.masses[0] * self.velocity[0])

    @property
    def kinetic_energy(self) -> float:
        """Kinetic energy, that of rotation included."""
        return 0.5 * float(self.masses @ (self.velocity**2).sum(axis=1))


def principal(inertia: Array, gdim: int) -> tuple[Array, Array]:
    """Second moments J ``(n_axes,)`` of an inertia ``(n_turns, n_turns)``, and axes ``(n_axes, gdim)``; none without any."""
    if not inertia.any():
        return np.zeros(0), np.zeros((0, gdim))
    if gdim == 2:
        return inertia[0], np.eye(2)[:1]
    values, axes = np.linalg.eigh(inertia)
    return np.maximum(0.5 * values.sum() - values, 0.0), axes.T


def add_masses(couplings: Sequence[RigidCoupling], dynamics: Any) -> None:
    """Give couplings, which are attached, what they add, and the dynamics of a problem these (collective)."""
    for one in couplings:
        if one.mass or one.inertia.any():
            one.added = AddedMass(one)
            if dynamics is not None:
                dynamics.add(one.added)
