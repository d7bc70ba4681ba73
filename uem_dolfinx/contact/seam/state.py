"""What a contact pair remembers of its contactors from iteration to iteration and from step to step."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from uem_dolfinx.arrays import Array, Bools, Ints

Renumber = Callable[[Ints], Ints]

#: Attributes that number facets.
FACETS = ("facet", "held", "friction_facet")
#: Before the names of what friction remembers, in checkpoints.
OF_FRICTION = "friction_"


@dataclass(frozen=True)
class FrictionState:
    """What friction remembers of ``n`` contactors; those that are active and do not stick slip.

    The anchor is the point of the target that a contactor sticks to. For a contactor that is open or slips it is its position at the end of
    the last step, and stays where it is as long as the contactor sticks.

    Attributes:
        stick: held at the anchor ``(n,)``.
        direction: in which a contactor slips over the target, of length one; zero for all others ``(n, gdim)``.
        tau: force of friction that belongs to ``lam`` ``(n, gdim)``.
        facet: facet that the anchor is on ``(n,)``; -1 on a rigid target.
        xi: the anchor's reference coordinates on it ``(n, gdim - 1)``.
        anchor: what is to be added to that place; on a rigid target the anchor at the target's reference position ``(n, gdim)``.
        slipped: relative motion along the target while slipping, summed over all steps ``(n, gdim)``.
        work: that friction has taken from the bodies ``(n,)``.
        worn: depth that slip has worn off ``(n,)``.
    """

    stick: Bools
    direction: Array
    tau: Array
    facet: Ints
    xi: Array
    anchor: Array
    slipped: Array
    work: Array
    worn: Array

    @classmethod
    def initial(cls, n: int, gdim: int) -> FrictionState:
        """The state of ``n`` contactors that nothing is known about."""
        return cls(
            stick=np.zeros(n, bool),
            direction=np.zeros((n, gdim)),
            tau=np.zeros((n, gdim)),
            facet=np.full(n, -1, np.int64),
            xi=np.zeros((n, gdim - 1)),
            anchor=np.zeros((n, gdim)),
            slipped=np.zeros((n, gdim)),
            work=np.zeros(n),
            worn=np.zeros(n),
        )


@dataclass(frozen=True)
class PairState:
    """What is known of ``n`` contactors; frozen so that trial and committed never share an array by accident.

    Attributes:
        active: united to the target ``(n,)``.
        lam: contact force along the normal, positive in compression ``(n,)``; on a degree-2 surface the control force.
        nodal: contact force of the node along the normal ``(n,)``; the same as ``lam`` on a degree-1 surface.
        force: contact force on the contactor ``(n, gdim)``.
        facet: facet that the contactor is on ``(n,)``, -1 before the first projection.
        held: further facets of a contactor that rests in a concave corner of the target, or -1 ``(n, gdim - 1)``.
        changes: how often in this step it has changed facets across a bend ``(n,)``.
        passed: has been past the target's end since it was last in front of it ``(n,)``.
        at_end: came to the target, or was drawn, at its end, which has held it since, or has slid off it in this step: released there
            and pushed back it would go to and fro for ever ``(n,)``.
        barred: came back into the target from past its end with a blow, and has not been in front of it since ``(n,)``.
        cover: which of its facets a rigid target covers, or where a mesh leaves it a dual function, one bit each in an order that no
            partition changes ``(n,)``; mortar alone.
        friction: what friction remembers; None without friction.
        bond: multipliers of the equations of tied contactors ``(n, gdim)``; None where nothing is ever tied.
        heat: power that goes from contactors to the target without a jump of temperatures, a column for every field that is united
            ``(n, n_perfect)``; None where none ever does.
    """

    active: Bools
    lam: Array
    nodal: Array
    force: Array
    facet: Ints
    held: Ints
    changes: Ints
    passed: Bools
    at_end: Bools
    barred: Bools
    cover: Ints
    friction: FrictionState | None = None
    bond: Array | None = None
    heat: Array | None = None

    @property
    def in_corner(self) -> Bools:
        """Contactors that a corner holds ``(n,)``."""
        return np.asarray((self.held >= 0).any(axis=1))

    @classmethod
    def initial(cls, n: int, gdim: int) -> PairState:
        """The state of ``n`` contactors that nothing is known about."""
        return cls(
            active=np.zeros(n, bool),
            lam=np.zeros(n),
            nodal=np.zeros(n),
            force=np.zeros((n, gdim)),
            facet=np.full(n, -1, np.int64),
            held=np.full((n, gdim - 1), -1, np.int64),
            changes=np.zeros(n, np.int64),
            passed=np.zeros(n, bool),
            at_end=np.zeros(n, bool),
            barred=np.zeros(n, bool),
            cover=np.zeros(n, np.int64),
        )

    def to_checkpoint(self, keys_of: Renumber) -> dict[str, npt.NDArray[Any]]:
        """The attributes by name (collective).

        Args:
            keys_of: what tells facets in any partition, from their present numbers ``(k,)``.
        """
        kept = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "friction"}
        for name in ("bond", "heat"):
            if getattr(self, name) is None:
                del kept[name]
        if self.heat is not None and self.heat.shape[1] == 1:
            kept["heat"] = self.heat[:, 0]
        if self.friction is not None:
            kept |= {OF_FRICTION + f.name: getattr(self.friction, f.name) for f in fields(FrictionState)}
        return {name: _renumbered(name, array, keys_of) for name, array in kept.items()}

    @classmethod
    def from_checkpoint(cls, kept: Mapping[str, npt.NDArray[Any]], facets_of: Renumber) -> PairState:
        """The state of which ``to_checkpoint`` returned these arrays (collective).

        Args:
            kept: by name.
            facets_of: present numbers of facets, from what tells them in any partition ``(k,)``.
        """
        arrays = {name: _renumbered(name, np.array(array), facets_of) for name, array in kept.items()}
        of_friction = {name: array for name, array in arrays.items() if name.startswith(OF_FRICTION)}
        friction = (
            FrictionState(**{name.removeprefix(OF_FRICTION): array for name, array in of_friction.items()})
            if of_friction
            else None
        )
        if "heat" in arrays and arrays["heat"].ndim == 1:
            arrays["heat"] = arrays["heat"][:, None]
        own = [f.name for f in fields(cls) if f.name != "friction" and f.name in arrays]
        return cls(**{name: arrays[name] for name in own}, friction=friction)


def _renumbered(name: str, array: npt.NDArray[Any], renumber: Renumber) -> npt.NDArray[Any]:
    return renumber(array.ravel()).reshape(array.shape) if name in FACETS else array
