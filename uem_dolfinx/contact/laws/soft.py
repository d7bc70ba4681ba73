"""Soft contact: the contact pressure is a function of the gap, p(g), as on rough surfaces, or under adhesion.

A law is a class with ``rest`` and ``pressure(gap)``: ``Linear``, ``Exponential``, ``PowerLaw`` and ``PressureTable`` are examples. A
user's own law is passed to ``SoftContact`` in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, Protocol, TypeAlias

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError, InputTypeError
from uem_dolfinx.parallel import agreed, ask_together


def value(number: float | fem.Constant) -> float:
    """The present value of a number or a Constant."""
    return float(number.value) if isinstance(number, fem.Constant) else number


def checked(what: str, number: Any, within: given.Range) -> float | fem.Constant:
    """A number or a Constant whose present value is in a range; raises as ``given.number`` does."""
    if isinstance(number, fem.Constant):
        given.number(what, number.value, within)
        return number
    return given.number(what, number, within)


def described(law: object) -> str:
    """A law with its arguments, the same in every run: Constants without their values."""
    return f"{type(law).__name__}({', '.join(f'{name}={given.described(one)}' for name, one in vars(law).items())})"


#: The pressure of a function is differentiated over so much of the gap, and of a law over so much of the value of a Constant.
#: [derived; the gap or the value; test_soft_laws.py::test_slopes_by_differences]
OF_GAP = np.finfo(float).eps ** (1 / 3)


class PressureLaw(Protocol):
    """A contact pressure that depends on the gap."""

    @property
    def rest(self) -> float:
        """Gap at which bodies that nothing else holds are put onto each other; the law has a slope there or just below."""

    def pressure(self, gap: Array) -> tuple[Array, Array | None]:
        """Pressures, 0 or positive, and their derivatives by the gap, 0 or negative, at gaps ``(n,)``, negative where surfaces overlap.

        Derivatives may be None, and are then computed from differences.
        """


@dataclass(frozen=True)
class _OfFunction:
    """Pressures of a user's function, see ``SoftContact``."""

    p: Callable[[Array], npt.ArrayLike]
    slope: Callable[[Array], npt.ArrayLike] | None
    rest = 0.0

    def pressure(self, gap: Array) -> tuple[Any, Any]:
        """See ``PressureLaw``."""
        return self.p(gap.copy()), None if self.slope is None else self.slope(gap)


#: A stiffness per area, a law, pairs of gap and pressure, or a function of gaps ``(n,)`` that returns pressures ``(n,)``.
OfGap: TypeAlias = float | fem.Constant | PressureLaw | Sequence[tuple[float, float]] | Callable[[Array], npt.ArrayLike]


class SoftContact(given.Sealed):
    """Normal contact with a pressure p(g) per area: contactors are not united with the target, the gap has a stiffness.

        uem.SoftContact(1e12)                                   # linear: stiffness per area
        uem.SoftContact(uem.Exponential(p0=1e6, h=2e-6))        # rough surfaces
        uem.SoftContact([(-3e-6, 4e6), (-1e-6, 1e6), (0.0, 0.0)])

    Args:
        p: stiffness per area, a number or a Constant; or a law, ``Exponential`` or ``PowerLaw``; or a table of at least two gaps, in
            ascending order, with their pressures. Or a function of gaps ``(n,)``, negative where surfaces overlap, that returns
            pressures ``(n,)``. Pressures are 0 or positive and do not increase with the gap.
        slope: derivative of a function p by the gap, ``(n,)``; None computes it from differences.
        damping: pressure per speed at which surfaces in contact approach each other, in addition to p(g); the sum is never negative.
            In time steps only.

    Raises:
        InputError, InputTypeError: for a stiffness that is not positive, a table that is not monotone, a slope without function, or a
            negative damping; when the problem is made, for a damping in statics.
    """

    def __init__(self, p: OfGap, slope: Callable[[Array], npt.ArrayLike] | None = None, *, damping: float = 0.0):
        self.damping = given.number("damping", damping, given.NOT_NEGATIVE)
        function = p if given.function(p) else None
        if slope is not None:
            given.kind(
                "slope",
                slope,
                given.function(slope) and function is not None,
                "a function of gaps, for a function p",
                "leave it out",
            )
        if hasattr(p, "pressure"):
            self.law: PressureLaw = given.kind("p", p, True, "a law")
        elif function is not None:
            self.law = _OfFunction(function, slope)
        elif isinstance(p, Sequence | np.ndarray) and not isinstance(p, str):
            self.law = PressureTable.of(p)
        else:
            self.law = Linear(checked("p", p, given.POSITIVE))

    def __repr__(self) -> str:
        """Its law, with its numbers."""
        damping = f", damping={self.damping!r}" if self.damping else ""
        return f"SoftContact({'a function' if isinstance(self.law, _OfFunction) else self.law!r}{damping})"

    def pressures(self, comm: MPI.Comm, name: str, gap: Array, least: float) -> tuple[Array, Array]:
        """Pressures and their derivatives by the gap at gaps ``(n,)`` of a contact; gaps below ``least`` are rounding (collective).

        Raises:
            InputError, UserFunctionError: if a function raises, or does not return n finite numbers in its range.
        """
        words = f"contact '{name}': normal, p"

        def checked(what: str, values: Any, sign: float) -> Array:
            within, called = given.Range("", lambda x: given.NOT_NEGATIVE.holds(sign * x)), f"contact '{name}': normal, {what}(g)"
            expected = f"{len(gap)} finite numbers, pressures that are not negative and do not increase with the gap"
            with agreed(comm):
                found = given.returned(called, values, expected)
                if found.shape != gap.shape or not within.holds(found).all():
                    raise InputError(f"{called} {given.fault(found, gap.shape, within)}: expected {expected}")
            return found

        p, slope = ask_together(comm, words, self.law.pressure, gap)
        p = checked("p", p, 1.0)
        if slope is None:
            step = OF_GAP * np.maximum(np.abs(gap), least)
            sides = (ask_together(comm, words, self.law.pressure, g)[0] for g in (gap - step, gap + step))
            behind, ahead = (checked("p", side, 1.0) for side in sides)
            slope = (ahead - behind) / (2.0 * step)
        return p, checked("slope", slope, -1.0)

    @property
    def constants(self) -> list[fem.Constant]:
        """Constants among the law's attributes."""
        return [one for one in getattr(self.law, "__dict__", {}).values() if isinstance(one, fem.Constant)]

    def by_constant(self, comm: MPI.Comm, name: str, gap: Array, m: fem.Constant) -> Array:
        """Derivatives of pressures at gaps ``(n,)`` by one of the Constants, from differences (collective); see ``pressures``."""
        before, sides = float(m.value), []
        step = OF_GAP * abs(before) or OF_GAP
        try:
            for side in (before + step, before - step):
                m.value = side
                sides.append(self.pressures(comm, name, gap, 0.0)[0])
        finally:
            m.value = before
        return np.asarray((sides[0] - sides[1]) / (2.0 * step))


@dataclass(frozen=True, repr=False)
class Linear:
    """``p = -k g`` for g <= 0, else 0; k is a pressure over a length, a number or a Constant."""

    k: float | fem.Constant
    rest = 0.0
    __repr__ = described

    def pressure(self, gap: Array) -> tuple[Array, Array]:
        """See ``PressureLaw``."""
        k = value(self.k)
        return k * np.maximum(-gap, 0.0), np.where(gap <= 0.0, -k, 0.0)


@dataclass(frozen=True, repr=False)
class Exponential:
    """``p = p0 exp(-g / h)``, the closure of rough surfaces with exponentially distributed heights.

    Greenwood, Williamson, Proceedings of the Royal Society A 295 (1966) 300-319. Beyond ``REACH`` times h the pressure is zero.

    Args:
        p0: pressure at gap 0, a number or a Constant.
        h: length over which the pressure changes by a factor e, a number or a Constant.

    Raises:
        InputError, InputTypeError: for numbers that are not positive.
    """

    p0: float | fem.Constant
    h: float | fem.Constant
    rest = 0.0
    __repr__ = described
    #: Gap, over h, beyond which the pressure is rounding of p0; and overlap, over h, beyond which it grows linearly: below overflow.
    #: [derived; h; test_soft_laws.py::test_an_exponential_law_far_out]
    REACH: ClassVar[float] = float(-np.log(np.finfo(float).eps))

    def __post_init__(self) -> None:
        for name in ("p0", "h"):
            object.__setattr__(self, name, checked(name, getattr(self, name), given.POSITIVE))

    def pressure(self, gap: Array) -> tuple[Array, Array]:
        """See ``PressureLaw``."""
        p0, h = value(self.p0), value(self.h)
        x = gap / h
        e = p0 * np.exp(-np.maximum(x, -self.REACH)) * (x < self.REACH)
        return e * (1.0 + np.maximum(-self.REACH - x, 0.0)), -e / h


#: Bodies that nothing else holds are put onto a surface of a power law with this overlap, over h: at gap 0 it has no stiffness.
#: [convention; h; test_soft_contact.py::test_a_block_that_rests_on_a_power_law]
SUNK = 1e-2
EXPONENT = given.Range("a number of at least 1", lambda m: (m >= 1) & np.isfinite(m))


@dataclass(frozen=True, repr=False)
class PowerLaw:
    """``p = p0 (-g / h)^m`` for g < 0, else 0, the closure of rough surfaces.

    Greenwood, Williamson, Proceedings of the Royal Society A 295 (1966) 300-319, with the power law of Back, Burdekin, Cowley (1973)
    for machined joints. An ``offset`` of the contact is the height at which asperities touch first.

    Args:
        p0: pressure at an overlap h.
        h: an overlap, a positive length.
        m: exponent, at least 1. All three are numbers or Constants.

    Raises:
        InputError, InputTypeError: for numbers out of their range.
    """

    p0: float | fem.Constant
    h: float | fem.Constant
    m: float | fem.Constant
    __repr__ = described

    def __post_init__(self) -> None:
        for name, within in (("p0", given.POSITIVE), ("h", given.POSITIVE), ("m", EXPONENT)):
            object.__setattr__(self, name, checked(name, getattr(self, name), within))

    @property
    def rest(self) -> float:
        """See ``PressureLaw``."""
        return -SUNK * value(self.h)

    def pressure(self, gap: Array) -> tuple[Array, Array]:
        """See ``PressureLaw``."""
        p0, h, m = value(self.p0), value(self.h), value(self.m)
        x = np.maximum(-gap / h, 0.0)
        return p0 * x**m, np.where(gap <= 0.0, -p0 * m / h * x ** (m - 1.0), 0.0)


@dataclass(frozen=True)
class PressureTable:
    """Pressures between the points of a table are linear; below its first gap they continue with its first slope, above its last one 0."""

    gaps: tuple[float, ...]  # ascending
    values: tuple[float, ...]  # pressures, not increasing, the last one 0

    @classmethod
    def of(cls, table: Any) -> PressureTable:
        """The table of pairs ``(gap, pressure)``.

        Raises InputTypeError if it consists of no pairs of numbers, and InputError for gaps that do not ascend, or pressures that
        increase, are negative, or are not 0 at the last gap.
        """
        words = "two or more pairs (gap, pressure), gaps in ascending order, pressures that do not increase and end with 0"
        try:
            a = given.numbers(table)
        except (TypeError, ValueError):
            raise InputTypeError(given.sentence("p", table, words)) from None
        fits = a.ndim == 2 and a.shape[1:] == (2,) and len(a) > 1 and bool(np.isfinite(a).all())
        if not fits or not (np.diff(a[:, 0]) > 0).all() or (np.diff(a[:, 1]) > 0).any() or a[-1, 1] != 0.0 or a[0, 1] <= 0.0:
            raise InputError(given.sentence("p", table, words))
        return cls(*map(tuple, a.T.tolist()))

    @property
    def rest(self) -> float:
        """See ``PressureLaw``."""
        return self.gaps[self.values.index(0.0)]

    def pressure(self, gap: Array) -> tuple[Array, Array]:
        """See ``PressureLaw``."""
        g, p = np.array(self.gaps), np.array(self.values)
        # a point belongs to the piece before it
        i = np.maximum(np.searchsorted(g, gap) - 1, 0)
        slopes = np.append(np.diff(p) / np.diff(g), 0.0)
        return p[i] + slopes[i] * (gap - g[i]), slopes[i]


class Adhesion(given.Sealed):
    """Attraction of surfaces by their gap, ``strength (1 - g / range)`` up to the ``range = 2 energy / strength``.

    Where surfaces touch, contact is hard; they separate at the strength, and adhere again when they touch. A large strength is the
    limit of Johnson, Kendall and Roberts (JKR), in which a sphere of radius R is pulled off by ``1.5 pi energy R``.

    Args:
        energy: of adhesion, an energy per area.
        strength: largest attraction, a force per area. The zone of attraction around a contact is of the length
            ``energy E* / strength^2``, which cells must resolve.

    Raises:
        InputError, InputTypeError: for numbers that are not positive; when the problem is made, for a range within which surfaces count
            as touching, 1e-9 of the model's size.
    """

    bonds = False  #: Whether surfaces are bonded point to point.

    def __init__(self, energy: float, strength: float):
        self.energy = given.number("energy", energy, given.POSITIVE)
        self.strength = given.number("strength", strength, given.POSITIVE)

    def __repr__(self) -> str:
        """With its numbers."""
        return f"Adhesion({self.energy:g}, {self.strength:g})"

    @property
    def range(self) -> float:
        """Gap at which the attraction ends, a length."""
        return 2.0 * self.energy / self.strength

    def attraction(self, gap: Array) -> tuple[Array, Array]:
        """Attractions, and their derivatives by the gap, at gaps ``(n,)``; constant below zero, where contact closes the gap."""
        within = (gap > 0.0) & (gap < self.range)
        t = self.strength * np.clip(1.0 - gap / self.range, 0.0, 1.0)
        return t, np.where(within, -self.strength / self.range, 0.0)
