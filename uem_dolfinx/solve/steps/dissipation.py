"""Arc length by the energy that damage dissipates, to follow paths that snap back: its declaration, and laws that it does not measure.

With a load ``lam f`` and bodies that unload to the origin, the energy that a step dissipates is ``(lam0 f . du - dlam f . u0) / 2``:
linear in the unknowns [Gutierrez, Communications in Numerical Methods in Engineering 20 (2004) 19-29; Verhoosel, Remmers, Gutierrez,
International Journal for Numerical Methods in Engineering 77 (2009) 1290-1321].
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from uem_dolfinx import given
from uem_dolfinx.errors import ConvergenceError, InputError


class Dissipation(given.Sealed):
    """Load steps of given arc length that dissipate an energy each as soon as damage grows.

        uem.load_steps(problem, 20, arc_length=uem.Dissipation(2.0))

    A step has the length ``(1 - e) |du| / s + dG / energy = 1`` with the arc length s and its dissipated energy dG. The step before has
    dissipated the part e of ``energy``, at most 1. Elastic steps thus equal those of ``arc_length=True``.

    Args:
        energy: of a step, in 2D per thickness: for a crack the critical energy release rate times the area it grows by.

    Raises:
        InputError, InputTypeError: for an energy that is not positive.
    """

    def __init__(self, energy: float):
        self.energy = given.number("energy", energy, given.POSITIVE)

    def __repr__(self) -> str:
        """With its energy."""
        return f"Dissipation({self.energy:g})"


def advise(error: ConvergenceError, energy: float, largest: float) -> None:
    """Name an ``energy`` of a step above the ``largest`` that a contactor takes to separate: the path may turn within such a step."""
    if energy > largest:
        error.amend(
            f"Dissipation({energy:g}) separates several contactors in a step, as each takes at most {largest:.3g}: take a smaller energy"
        )


def refuse_other_laws(contacts: Sequence[Any], materials: Sequence[Any]) -> None:
    """Refuse laws whose dissipation is not measured by load and displacement alone.

    Raises InputError for materials with history, for plastic unloading, and for a viscosity, which is a part of the load factor.
    """
    for material in materials:
        raise InputError(
            f"{type(material).__name__} does not go with arc_length = Dissipation(...), as load and displacement do not tell what it "
            "dissipates: take arc_length=True"
        )
    for contact in contacts:
        law = contact.cohesion
        for what, there in (
            ("unloading = 'plastic'", getattr(law, "unloading", "") == "plastic"),
            ("viscosity", getattr(law, "viscosity", 0.0) > 0.0),
        ):
            if there:
                raise InputError(
                    f"{what} of contact '{contact.name}' does not go with arc_length = Dissipation(...): leave it out"
                )
