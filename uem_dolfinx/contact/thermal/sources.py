"""Heat that a contact makes: of friction, and of electric currents."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.laws.conductance import Conductance
from uem_dolfinx.contact.laws.soft import value
from uem_dolfinx.contact.seam.active_set import GAP_ROUNDING
from uem_dolfinx.contact.seam.relative_motion import Terms
from uem_dolfinx.errors import InputError

#: Durations of a step that differ by less are one. [bound; length of the step; -]
SAME_DURATION = 1e-6


class Source(Protocol):
    """Heat that enters both sides at contactors."""

    share: float
    of_current: bool  # whether it is the work of an electric current

    @property
    def lags(self) -> bool:
        """Whether it depends on contact forces, which are taken from the previous iteration."""

    def power(self) -> Array:
        """Its power at contactors ``(n,)`` (collective)."""

    def sizes(self) -> Array:
        """Magnitudes of the operands in its differences ``(n,)`` (collective)."""

    def changes(self) -> list[tuple[Array, Terms]]:
        """Its derivatives; see ``Heat.changes`` (collective)."""

    def by_pressures(self) -> Array:
        """Its derivatives by the pressures of closed contactors ``(n,)`` (collective)."""


class Flow(Protocol):
    """Members of the heat, or of the current, of one conductance that sources need; as in ``Heat``."""

    law: Conductance
    pair: Any

    def power(self) -> Array:
        """Power from the contactors to the target ``(n,)`` (collective)."""

    def power_sizes(self) -> Array:
        """Magnitudes of the operands in this power ``(n,)`` (collective)."""

    def jump(self) -> Array:
        """Jump of the field ``(n,)`` (collective)."""

    def jumps(self) -> Terms:
        """These jumps as linear functions of the unknowns (collective)."""

    def changes(self) -> list[tuple[Array, Terms]]:
        """Derivatives of the power by temperatures and gaps (collective)."""

    def by_pressures(self) -> Array:
        """Derivatives of the power by pressures ``(n,)`` (collective)."""


class FrictionalHeat:
    """Work of friction in a step over its duration, without derivatives; a ``share`` of it enters the contactor."""

    lags, of_current = True, False

    def __init__(self, heat: Flow, share: float):
        self.share, self._pair, self._law = share, heat.pair, heat.law

    def power(self) -> Array:
        """Power ``(n,)`` (collective)."""
        pair, state = self._pair, self._pair.trial.friction
        assert pair.friction is not None and state is not None
        work = pair.friction.step(pair.trial, pair.committed, pair.kinematics)[-1]
        # contactors that stick in a mean slip by the rounding of positions
        slips = np.abs(work) > GAP_ROUNDING * pair.config.size * np.linalg.norm(state.tau, axis=1)
        dt, length = value(self._law.dt), 0.0 if (duration := pair.friction.limits.duration) is None else duration()
        if length and abs(dt - length) > SAME_DURATION * length:
            raise InputError(
                f"heat: dt = {dt:.6g}, and the step in time takes {length:.6g}, so that the work of friction would be another heat: set a "
                "Constant dt in the function load of the problem, which is called before every attempt, to the time since the last step"
            )
        return np.where(slips, work, 0.0) / dt

    def sizes(self) -> Array:
        """Slips are differences of positions."""
        pair = self._pair
        if pair.trial.friction is None:
            return np.zeros(len(pair.nodes))
        return np.asarray(pair.config.size * np.linalg.norm(pair.trial.friction.tau, axis=1) / value(self._law.dt))

    def changes(self) -> list[tuple[Array, Terms]]:
        """None."""
        return []

    def by_pressures(self) -> Array:
        """None."""
        return np.zeros(len(self._pair.nodes))


class JouleHeat:
    """Currents times jumps of the potential, a ``share`` of which enters the contactor; perfect conductances make no heat."""

    of_current = True

    def __init__(self, currents: Sequence[Flow], share: float):
        self.share, self._currents = share, [one for one in currents if not one.law.perfect]
        self._none = np.zeros(len(currents[0].pair.nodes))

    @property
    def lags(self) -> bool:
        """Whether currents depend on contact forces."""
        return any(callable(one.law.h) for one in self._currents)

    def power(self) -> Array:
        """Power ``(n,)`` (collective)."""
        return sum((one.power() * one.jump() for one in self._currents), self._none)

    def sizes(self) -> Array:
        """The square of a jump has the rounding of the jump, twice."""
        return sum((2.0 * one.power_sizes() * np.abs(one.jump()) for one in self._currents), self._none)

    def changes(self) -> list[tuple[Array, Terms]]:
        """Of the currents times the jumps, and of the jumps times the currents."""
        found = []
        for one in self._currents:
            jump = one.jump()
            found += [(jump * scale, right) for scale, right in one.changes()]
            found.append((one.power(), one.jumps()))
        return found

    def by_pressures(self) -> Array:
        """Of the currents, times the jumps."""
        return sum((one.jump() * one.by_pressures() for one in self._currents), self._none)
