"""Derivatives of a time step by its initial state: displacement, velocity and acceleration, in both modes.

With ``du = u(n+1) - u(n)``, the results of a step are linear in du and in the initial velocity v, acceleration a and mean velocity w,
component by component: the acceleration b in the equation of motion, the velocity in the damping form, and v, a and w at the end. The
next step also depends on the inertia forces

    I(n+1) = (M b - alpha_f I(n)) / (1 - alpha_f)

which are a term of the residual, too.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from uem_dolfinx.arrays import Array
from uem_dolfinx.dynamics.inertia import Dynamics
from uem_dolfinx.dynamics.scheme import Scheme
from uem_dolfinx.parallel import reduced


@dataclass(frozen=True)
class ByState:
    """Derivatives by the initial state of a step, at the owned components ``(n,)``; forwards its changes.

    Attributes:
        u, v, a, w: by displacement, velocity, acceleration and mean velocity.
    """

    u: Array
    v: Array
    a: Array
    w: Array
    forces: Array  # by the inertia forces


class RateSlopes:
    """Derivatives through the time steps of a problem, from the last to the first."""

    def __init__(self, dynamics: Dynamics):
        self._dynamics = dynamics
        self._n = dynamics.massy.size
        #: derivatives by the final state of the present step, and by its initial state after ``pass_back``; zero at first.
        self.by = ByState(*np.zeros((5, self._n)))

    def begin(self) -> None:
        """Begin with the present step of the dynamics, at its final displacement."""
        d, s, dt, n = self._dynamics, self._dynamics.scheme, self._dynamics.dt, self._n
        assert isinstance(s, Scheme)
        _, last, _, u, (_, a, w, _), _ = d.memory()
        held, massy = d.held, d.massy.ravel()
        mean = self._rows(du=1.0 / dt)
        a_end = self._rows(1.0 / (s.beta * dt**2), -1.0 / (s.beta * dt), 1.0 - 0.5 / s.beta)
        v_end = self._rows(v=1.0) + dt * ((1.0 - s.gamma) * self._rows(a=1.0) + s.gamma * a_end)
        slope = 2.0 * ((d.config.displacement.ravel() - u)[:n] / dt - w[:n]) / (dt + last)
        # for prescribed components the smaller of two slopes, zero if their signs differ
        some, less = slope * a[:n] > 0.0, np.abs(slope) < np.abs(a[:n])
        taken = (some & less) * 2.0 / (dt + last) * (mean - self._rows(w=1.0)) + (some & ~less) * self._rows(a=1.0)
        v_held = mean + 0.5 * dt * taken
        a_held = (v_held - self._rows(v=1.0)) / dt
        on = (0.5 - s.alpha_f) * 2.0 * dt / (dt + (last or dt))
        b_held = a_held + on * (a_held - self._rows(a=1.0))
        #: Derivatives of each result by du, v, a and w ``(4, n)``.
        self._damped = np.where(held, v_held, v_end)
        self._b = np.where(held, b_held, (1.0 - s.alpha_m) * a_end + s.alpha_m * self._rows(a=1.0))
        self._v, self._w = np.where(massy, self._damped, mean), mean
        self._a = np.where(massy, np.where(held, a_held, a_end), 0.0)
        #: Derivatives by the displacement that are not in the tangent, zero for free components ``(n,)``.
        self._more_b = np.where(held, self._b[0] - (1.0 - s.alpha_m) * a_end[0], 0.0)
        self._more_damped = np.where(held, self._damped[0] - v_end[0], 0.0)

    def look_at(self, by_velocity: Array, by_acceleration: Array) -> None:
        """Add derivatives by velocity and acceleration at the end of the step ``(n,)`` each."""
        self.by = replace(self.by, v=self.by.v + by_velocity, a=self.by.a + by_acceleration)

    def _rows(self, du: npt.ArrayLike = 0.0, v: float = 0.0, a: float = 0.0, w: float = 0.0) -> Array:
        """Derivatives by du, v, a and w ``(4, n)``."""
        return np.repeat(np.array([[du], [v], [a], [w]], dtype=float), self._n, axis=1)

    def _inertia(self, x: Array) -> Array:
        """Derivative by b, from derivatives ``x (n,)`` by the inertia forces (collective)."""
        d = self._dynamics
        return d.mass.times(x.reshape(-1, d.config.gdim)).ravel() / (1.0 - d.scheme.alpha_f)

    def load(self) -> Array:
        """Derivative by the final displacement of the step, through its final state ``(n,)`` (collective)."""
        by = self.by
        return by.u + self._v[0] * by.v + self._a[0] * by.a + self._w[0] * by.w + self._b[0] * self._inertia(by.forces)

    def beyond_tangent(self, a: Array, damped: Array | float) -> Array:
        """Terms at prescribed displacements that are missing in the transposed tangent ``(n,)`` (collective).

        Args:
            a: adjoint displacement ``(n,)``.
            damped: derivative of the work of damping along a by the velocity ``(n,)``; 0 without damping.
        """
        return self._more_b * self._inertia(a) + self._more_damped * damped

    def pass_back(self, a: Array, damped: Array | float) -> None:
        """Compute derivatives by the initial state of the step; arguments as in ``beyond_tangent`` (collective)."""
        by, alpha = self.by, self._dynamics.scheme.alpha_f
        left = by.forces - a
        rates = self._v * by.v + self._a * by.a + self._w * by.w
        du, v, a_start, w = rates + self._b * self._inertia(left) - self._damped * damped
        self.by = ByState(-du, v, a_start, w, -alpha / (1.0 - alpha) * left)

    def by_acceleration(self) -> Array:
        """Derivative by the first acceleration ``(n,)``, also through the inertia forces (collective)."""
        d = self._dynamics
        of_forces = d.mass.times(self.by.forces.reshape(-1, d.config.gdim)).ravel()
        return np.where(d.massy.ravel(), self.by.a + of_forces, 0.0)

    def by_density(self, a: Array) -> float:
        """Derivative by the logarithm of a density of all mass, before ``pass_back``, with the same ``a (n,)`` (collective)."""
        inertia, weight = self._densities(False)
        return float(reduced(self._dynamics.config.comm, float((self.by.forces - a) @ inertia + a @ weight)))

    def by_density_at_start(self, a: Array) -> float:
        """Derivative by the same logarithm through the first acceleration, with ``a (n,)`` of its adjoint problem (collective)."""
        inertia, weight = self._densities(True)
        return float(reduced(self._dynamics.config.comm, float((self.by.forces - a) @ inertia + a @ weight)))

    def _densities(self, start: bool) -> tuple[Array, Array]:
        """What is proportional to the density in the inertia forces, at the start or the end of a step, and weight (collective)."""
        d, alpha = self._dynamics, self._dynamics.scheme.alpha_f
        weight, before = d.weight(), d.forces.x.array[: self._n]
        if start:
            return d.mass.times(d.acceleration.x.array[: self._n].reshape(-1, d.config.gdim)).ravel(), weight
        load = d.load()
        assert load is not None
        return load + weight + alpha / (1.0 - alpha) * before, weight


class RateChanges(RateSlopes):
    """Changes through the time steps of a problem along a direction, from the first to the last; ``by`` is the change of the state.

    Args:
        density: change of the logarithm of the density of all mass.
    """

    def __init__(self, dynamics: Dynamics, density: float = 0.0):
        super().__init__(dynamics)
        self._density = density

    def pushed_at_start(self) -> Array:
        """Change of the initial forces by the density ``(n,)`` (collective)."""
        inertia, weight = self._densities(True)
        return self._density * (inertia - weight)

    def start(self, velocity: Array, acceleration: Array) -> None:
        """Begin with changes of the initial velocity and acceleration ``(n,)`` (collective)."""
        d = self._dynamics
        inertia = d.mass.times(acceleration.reshape(-1, d.config.gdim)).ravel() + self._density * self._densities(True)[0]
        self.by = ByState(np.zeros(self._n), velocity, acceleration, velocity, inertia)

    def _after(self, rows: Array, du: Array) -> Array:
        """Change of a result of the step, with its derivatives ``(4, n)`` and the change of its displacement."""
        return np.asarray(rows[0] * du + rows[1] * self.by.v + rows[2] * self.by.a + rows[3] * self.by.w)

    def _forces(self, du: Array) -> Array:
        """Change of the inertia forces with that of the step's displacement (collective)."""
        alpha = self._dynamics.scheme.alpha_f
        changed = self._inertia(self._after(self._b, du)) - alpha / (1.0 - alpha) * self.by.forces
        return np.asarray(changed + self._density * self._densities(False)[0])

    def pushed(self) -> tuple[Array, Array]:
        """Changes of inertia forces minus weight, and of the velocity in the damping form, at fixed final displacement (collective)."""
        weight = self._density * self._densities(False)[1]
        return self._forces(-self.by.u) - weight, self._after(self._damped, -self.by.u)

    def beyond(self, v: Array) -> tuple[Array, Array]:
        """Those of a change ``v (n,)`` of prescribed final displacements, as far as the tangent lacks them (collective)."""
        return self._inertia(self._more_b * v), self._more_damped * v

    def end(self, u: Array) -> None:
        """Compute changes of the final state, with that of the final displacement (collective)."""
        du = u - self.by.u
        v, a, w = (self._after(rows, du) for rows in (self._v, self._a, self._w))
        self.by = ByState(u, v, a, w, self._forces(du))
