"""What a contact is looked at for while steps are taken, and warns of once."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from mpi4py import MPI

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.checks import warn_of_sagging_facets, warn_of_slipped
from uem_dolfinx.contact.results import ContactResults
from uem_dolfinx.errors import UEMError
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.state import PairState
    from uem_dolfinx.contact.target_corners import CornerInside


class WatchedContact(ContactResults):
    """A contact of a problem, whose ends, corners and wear are looked at after every step.

    Attributes:
        adjust: whether gaps at the start have been closed, and how far.
    """

    adjust: float | bool

    def begin(self) -> None:
        """Take the contact for that of a problem that is complete, and warn of a target too coarse for it (collective)."""
        self.taken, self._slipped, self._on = True, False, True
        self._entered: CornerInside | None = None
        self._off_at_start = self.pair.off.copy()
        nodes_on_facets = self.pair.discretisation.at_feet and self.contactor.dim > 0
        from uem_dolfinx.contact.target_corners import TargetCorners

        self._corners = TargetCorners(self.pair, self.contactor) if nodes_on_facets else None
        if not self.adjust:
            warn_of_sagging_facets(self.pair)

    @property
    def on(self) -> bool:
        """Whether it is switched on."""
        return self._on

    def switch(self, on: bool) -> None:
        """Switch it on or off; its pair is the caller's."""
        self._on = on

    def look_at(self, before: PairState, stiffness: Array | None) -> None:
        """Look at the contact after a step from the state ``before``, if it is on; ``stiffness`` as of ``corner_inside`` (collective)."""
        if self.on and not self.pair.discretisation.far:
            self.look_at_ends()
            self.look_at_corners(stiffness)
            self.look_at_wear(before, stiffness)

    def look_at_ends(self) -> None:
        """Warn, once, if contactors have slid off the target's end since the start (collective)."""
        gone = self.pair.off & ~self._off_at_start & ~self.pair.tied
        if not self._slipped and self.pair.target.n_nodes and reduced(self.config.comm, gone.any(), op=MPI.LOR):
            self._slipped = warn_of_slipped(self.pair, self._off_at_start | self.pair.tied, self._areas)

    def look_at_wear(self, before: PairState, stiffness: Array | None) -> None:
        """Warn, once, if the step from the state ``before`` has worn too much; ``stiffness`` as of ``corner_inside`` (collective)."""
        wear = None if self.pair.friction is None else self.pair.friction.wear
        if wear is not None and stiffness is not None:
            wear.look_at_step(before, self.pair.committed, self.pair.kinematics.normal, stiffness)

    def corner_inside(self, stiffness: Array | None) -> CornerInside | None:
        """A convex corner of the target inside the contactor by which the contact lacks force, or lacked it before (collective).

        Args:
            stiffness: diagonal of K at the owned nodes ``(n_owned, gdim)``; None where it is not known yet.
        """
        found = None if self._corners is None or stiffness is None or not self.on else self._corners.find(stiffness)
        return found or self._entered

    def look_at_corners(self, stiffness: Array | None) -> None:
        """Warn, once, if a convex corner of the target is inside the contactor; argument as of ``corner_inside`` (collective)."""
        if self._entered is None:
            self._entered = self.corner_inside(stiffness)
            if self._entered is not None:
                logger.warning("%s: %s", self.name, self._entered)


def name_corner(contacts: Sequence[WatchedContact], stiffness: Array | None, error: UEMError) -> None:
    """Tell in an error of a convex corner of a target inside contactors, if there is one; ``stiffness`` as there (collective)."""
    for contact in contacts:
        corner = contact.corner_inside(stiffness)
        if corner is not None:
            error.amend(f"{contact.name}: {corner}")
            return
