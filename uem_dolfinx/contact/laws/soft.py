"""Soft contact: the contact pressure is a function of the gap, p(g), as on rough surfaces.

A law is a class with ``rest`` and ``pressure(gap)``. ``linear``, ``exponential``, ``power_law`` and ``pressure_table`` are examples, one
file each; a user's own law is passed to ``SoftContact`` in the same way.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.laws.constants import checked
from uem_dolfinx.contact.laws.linear import Linear
from uem_dolfinx.errors import InputError
from uem_dolfinx.parallel import agreed, ask_together

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
        return self.p(gap), None if self.slope is None else self.slope(gap)


#: A stiffness per area, a law, pairs of gap and pressure, or a function of gaps ``(n,)`` that returns pressures ``(n,)``.
OfGap: TypeAlias = float | fem.Constant | PressureLaw | Sequence[tuple[float, float]] | Callable[[Array], npt.ArrayLike]


class SoftContact(given.Sealed):
    """Normal contact with a pressure p(g) per area: contactors are not united with the target, the gap has a stiffness.

        uem.SoftContact(1e12)                                   # linear: stiffness per area
        uem.SoftContact(uem.Exponential(p0=1e6, h=2e-6))        # rough surfaces
        uem.SoftContact([(-3e-6, 4e6), (-1e-6, 1e6), (0.0, 0.0)])

    Args:
        p: stiffness per area, a number or a Constant; or a law, ``Exponential`` or ``PowerLaw``; or a table of at least two gaps, in
            ascending order, with their pressures; or a function of gaps ``(n,)``, negative where surfaces overlap, that returns
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
            from uem_dolfinx.contact.laws.pressure_table import PressureTable

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
            found, within = np.asarray(values, dtype=float), given.Range("", lambda x: given.NOT_NEGATIVE.holds(sign * x))
            with agreed(comm):
                if found.shape != gap.shape or not within.holds(found).all():
                    fault = given.fault(found, gap.shape, within)
                    raise InputError(
                        f"contact '{name}': normal, {what}(g) {fault}: expected {len(gap)} finite numbers, pressures that are not "
                        "negative and do not increase with the gap"
                    )
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
