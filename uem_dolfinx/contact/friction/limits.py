"""Limits of friction at contactors from a law, by normal forces, areas and slip speeds."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.laws.law import FrictionLaw, is_of_users, of_rate, slides_otherwise
from uem_dolfinx.contact.seam.placement import Kinematics
from uem_dolfinx.errors import InputError, InputTypeError
from uem_dolfinx.parallel import agree, ask

#: What is left of a limit that is proportional to the force along the normal, below this part of it, is rounding.
#: [bound; limit of friction; -]
ROUNDING = 1e-14


class Limits:
    """Limits of friction of the contactors of one interface.

    Args:
        areas: function of target normals ``(n, gdim)`` that returns reference areas facing the target ``(n,)``, for laws that need
            them; for None, before the first placement, total areas (collective).
        duration: length of the present step, a time; None in statics.
        name: of the contact, for messages.
        places: reference positions of the contactors ``(n, gdim)``, for messages.

    Attributes:
        value: parameter of the law at the contactors ``(n,)``.
        area: area of ``lam`` as an integral of the pressure ``(n,)``; zeros unless the law needs it.
        speed: slip speed in the present step ``(n,)``; zeros unless the law needs it.
    """

    law: FrictionLaw
    value: Array

    def __init__(self, areas: Callable[[Array | None], Array], duration: Callable[[], float] | None, name: str, places: Array):
        self.areas_of, self.duration, self._name, self._places = areas, duration, name, places
        self.whole = False  # whether friction acts for whole steps with its force at the end
        self._fault: BaseException | None = None  # of a law of the user, on this rank, until ``agree``
        self._known = object()  # replaced at a fault, so that limits found with it are not used again

    def set(self, law: FrictionLaw, value: Array) -> None:
        """Set a law and the values of its parameter ``(n,)`` (collective)."""
        self.law, self.value, self._fault = law, value, None
        self.area = self.areas_of(None) if law.per_area else np.zeros(len(value))
        self.speed = np.zeros(len(value))

    def act_whole_steps(self) -> None:
        """From now on friction acts for whole steps, with its force at the end."""
        self.whole = True

    def change(self, value: Array) -> None:
        """Set other values of the parameter ``(n,)``."""
        self.value = value

    def cones(self, lam: Array) -> Array:
        """Slopes of the cones that contain all forces which stick at normal forces ``lam (n,)``."""
        limit, slope = self._stuck(lam)
        return np.where(lam > 0, limit / np.where(lam > 0, lam, 1.0), slope)

    @property
    def given(self) -> tuple[Any, ...]:
        """What ``cone`` depends on in addition to its arguments; arrays are replaced, never changed."""
        return self.law, self.value, self.area, self.speed, self._known

    def grow(self, kinematics: Kinematics) -> None:
        """Update the areas to the current placement (collective)."""
        if self.law.per_area:
            self.area = kinematics.pressure_map(False).areas(self.areas_of(kinematics.projection.normal))

    def see(self, way: Array) -> None:
        """Set the slip of contactors in the present step ``(n,)``, for the speed."""
        dt = 0.0 if self.duration is None else self.duration()
        if of_rate(self.law) and dt > 0.0:
            self.speed = way / dt

    def of(self, lam: Array, slips: Bools) -> tuple[Array, Array, Array]:
        """Limits at normal forces ``lam (n,)``, of which some contactors slip, and derivatives by ``lam`` and the slip."""
        lam = np.maximum(lam, 0.0)
        limit, slope = self._stuck(lam)
        rate = none = np.zeros(len(limit))
        if slides_otherwise(self.law):
            sliding = self._returned("sliding", self.law.sliding, lam, self.speed)
            limit, slope, rate = (np.where(slips, new, old) for new, old in zip(sliding, (limit, slope, rate)))
            dt = 0.0 if self.duration is None else self.duration()
            rate = rate / dt if dt > 0.0 else none
        return limit, slope, rate

    def cone(self, lam: Array, slips: Bools) -> tuple[Array, Array]:
        """Limits as linear functions of the normal force, about ``lam (n,)``: values at 0 and slopes ``(n,)``."""
        limit, slope, _ = self.of(lam, slips)
        rest = limit - slope * np.maximum(lam, 0.0)
        return np.where(np.abs(rest) > ROUNDING * limit, rest, 0.0), slope

    def agree(self, comm: MPI.Comm) -> None:
        """Raise, on all ranks, what a law of the user has done wrong on any rank since the last call (collective)."""
        if is_of_users(self.law):
            fault, self._fault = self._fault, None
            agree(comm, fault)

    def _stuck(self, lam: Array) -> tuple[Array, Array]:
        limit, slope = self._returned("limit", self.law.limit, lam)
        return limit, slope

    def _returned(self, what: str, f: Callable[..., Any], lam: Array, *more: Array) -> tuple[Array, ...]:
        """What a method of the law returns, ``(n,)`` each; zeros if it is the user's and wrong, an error that ``agree`` raises.

        Ranks call it at different times, so that it is not collective.
        """
        if not is_of_users(self.law):
            return tuple(f(self.value, lam, self.area, *more))
        words = f"contact '{self._name}': friction, {type(self.law).__name__}.{what}"
        try:
            return self._checked(words, ask(words, f, self.value, lam, self.area, *more), 2 + len(more))
        except BaseException as error:
            self._fault, self._known = self._fault or error, object()
            return (np.zeros(len(lam)),) * (2 + len(more))

    def _checked(self, words: str, found: Any, parts: int) -> tuple[Array, ...]:
        """``parts`` arrays ``(n,)`` of finite numbers, the first not negative; InputError or InputTypeError for all else."""
        n = len(self.value)
        expected = f"{parts} arrays of {n} finite numbers, a force that is not negative and its derivative{'s' * (parts > 2)}"
        if not isinstance(found, tuple | list | np.ndarray) or len(found) != parts:
            raise InputTypeError(given.sentence(words, found, expected))
        checked = []
        for k, (part, within) in enumerate(zip(found, (given.NOT_NEGATIVE, *(given.FINITE,) * (parts - 1)))):
            values = given.returned(f"{words}[{k}]", part, expected)
            values = np.full(n, values) if values.ndim == 0 else values
            if values.shape != (n,) or not within.holds(values).all():
                wrong = given.fault(values, (n,), within, self._places.T)
                raise InputError(f"{words}[{k}] {wrong}: expected {expected}")
            checked.append(values)
        return tuple(checked)
