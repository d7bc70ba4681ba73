"""State variables of a contact pair, per contactor."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from uem_dolfinx.arrays import Array, Bools, Ints

Renumber = Callable[[Ints], Ints]

#: Attributes that contain facet numbers.
FACETS = ("facet", "held", "friction_facet")
#: Prefix of the names of friction variables in checkpoints.
OF_FRICTION = "friction_"


@dataclass(frozen=True)
class FrictionState:
    """Friction variables of ``n`` contactors; active contactors that do not stick are slipping.

    The anchor is the point of the target to which a contactor sticks. For an open or slipping contactor it is the position at the
    end of the last step; it is constant while the contactor sticks.
    """

    stick: Bools  # whether it sticks to the anchor ``(n,)``
    direction: Array  # unit vector of the slip direction; zero for other contactors ``(n, gdim)``
    tau: Array  # friction force that belongs to ``lam`` ``(n, gdim)``
    facet: Ints  # facet of the anchor ``(n,)``; -1 on a rigid target
    xi: Array  # reference coordinates of the anchor on the facet ``(n, gdim - 1)``
    anchor: Array  # vector added to this point; on a rigid target the anchor at the target's reference position ``(n, gdim)``
    slipped: Array  # accumulated slip over all steps ``(n, gdim)``
    work: Array  # frictional dissipation ``(n,)``
    worn: Array  # wear depth ``(n,)``

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
    """State of ``n`` contactors; immutable, so that trial and committed states may share arrays."""

    reserved: Bools  # whether it has rows in the sparsity of P ``(n,)``
    redundant: Bools  # whether its equation depends on others and was left out ``(n,)``
    active: Bools  # whether the contact equation is active ``(n,)``
    lam: Array  # normal contact force, positive in compression ``(n,)``; on a degree-2 surface the control force
    nodal: Array  # normal contact force at the node ``(n,)``; equal to ``lam`` on a degree-1 surface
    force: Array  # contact force on the contactor ``(n, gdim)``
    facet: Ints  # target facet of the contactor ``(n,)``, -1 before the first projection
    held: Ints  # further facets of a contactor held in a concave corner of the target, or -1 ``(n, gdim - 1)``
    changes: Ints  # number of changes of facet across an edge in this step ``(n,)``
    passed: Bools  # whether it has been past the target's end since it was last in front of it ``(n,)``
    #: whether an end has held it since first touch, or it slid off the end in this step; such contactors do not alternate
    #: between release and activation ``(n,)``.
    at_end: Bools
    #: whether it re-entered the target from past its end while penetrating; ignored until it is in front again ``(n,)``.
    barred: Bools
    #: for mortar only: bits of its facets that a rigid target covers, or on which a mesh leaves it a dual function, in an
    #: order independent of the partition ``(n,)``.
    cover: Ints
    friction: FrictionState | None = None  # friction variables; None without friction
    bond: Array | None = None  # multipliers of the equations of tied contactors ``(n, gdim)``; None without ties
    #: power from contactors to the target by perfect conductance, one column per field ``(n, n_perfect)``; None without such
    #: conductances.
    heat: Array | None = None
    #: gaps at which the law of a soft contact gives the forces, infinity for the present gaps ``(n,)``; None for hard contact,
    #: and while it is switched off.
    law_gap: Array | None = None
    #: damage, delayed damage, load factor or time of these, permanent opening and normal of bonds ``(n, 3 + 2 gdim)``; None
    #: without cohesion.
    cohesion: Array | None = None
    wet: Bools | None = None  # whether a fluid between the surfaces reaches the contactor ``(n,)``; None without fluid
    #: gap, dissipated energy, and of the last step the gap at its beginning, damping over length, and time ``(n, 5)``; None
    #: without damping.
    damping: Array | None = None

    @property
    def has_law(self) -> bool:
        """Whether forces follow a law of gaps or openings."""
        return self.law_gap is not None or self.cohesion is not None

    @property
    def in_corner(self) -> Bools:
        """Contactors held in a corner ``(n,)``."""
        return np.asarray((self.held >= 0).any(axis=1))

    @classmethod
    def initial(cls, n: int, gdim: int) -> PairState:
        """The state of ``n`` contactors that nothing is known about."""
        return cls(
            reserved=np.zeros(n, bool),
            redundant=np.zeros(n, bool),
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
        """The attributes by name; ``keys_of`` turns facet numbers into keys independent of the partition (collective)."""
        kept = {f.name: getattr(self, f.name) for f in fields(self) if f.name != "friction"}
        for name in ("bond", "heat", "law_gap", "cohesion", "wet", "damping"):
            if getattr(self, name) is None:
                del kept[name]
        if self.heat is not None and self.heat.shape[1] == 1:
            kept["heat"] = self.heat[:, 0]
        if self.friction is not None:
            kept |= {OF_FRICTION + f.name: getattr(self.friction, f.name) for f in fields(FrictionState)}
        return {name: _renumbered(name, array, keys_of) for name, array in kept.items()}

    @classmethod
    def from_checkpoint(cls, kept: Mapping[str, npt.NDArray[Any]], facets_of: Renumber) -> PairState:
        """The state from the arrays of ``to_checkpoint``; ``facets_of`` turns keys into present facet numbers (collective)."""
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
