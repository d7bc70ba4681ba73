"""Checks of contacts after every step, with warnings given once."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.both_sides import OfBothSides
from uem_dolfinx.contact.pair.tables import contacts_with
from uem_dolfinx.contact.warnings.checks import sagging, warn_of_sagging_facets, warn_of_slipped
from uem_dolfinx.errors import InputError, OrientationError, UEMError
from uem_dolfinx.geometry.facets import facets_of
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.offsets import Offsets
    from uem_dolfinx.contact.seam.state import PairState
    from uem_dolfinx.contact.warnings.confined import Confined
    from uem_dolfinx.contact.warnings.edges_inside import EdgesInside, Meeting
    from uem_dolfinx.contact.warnings.target_corners import CornerInside


class WatchedContact(OfBothSides):
    """A contact of a problem, with checks of ends, corners and wear after every step.

    Attributes:
        adjust: whether initial gaps have been closed, or up to which length.
        tied: whether contactors are tied from the start, or ``"after"``.
        target: facets, or a rigid surface.
    """

    adjust: float | bool
    tied: bool | str
    target: Any
    of_all_surfaces: bool
    _offsets: Offsets | None

    def begin(self, overlaps: Mapping[int, float]) -> None:
        """Begin the checks, when the problem is complete; ``overlaps`` as ``check_initial`` returns them (collective)."""
        self.taken, self._slipped, self._on, self._overlap = True, False, True, 0.0
        self.note_overlap(overlaps)
        self._corner: CornerInside | None = None  # the reported convex corner of the target, which reduces the contact force
        self.off_at_start: Bools = self.pair.off.copy()  # contactors that were past an end of the target at the start ``(n,)``

    @property
    def initial_overlap(self) -> float:
        """Largest penetration of contactors before the first step, a length; 0 without penetration."""
        return self._overlap

    def note_overlap(self, overlaps: Mapping[int, float]) -> None:
        """Take its own of initial penetrations, see ``check_initial``."""
        self._overlap = overlaps.get(id(self.pair), self._overlap)

    @property
    def adjusted(self) -> float:
        """The largest initial gap or penetration that ``adjust`` has removed, a length (collective).

        Of tied contactors it is the largest gap that is kept.
        """
        tie = self.pair.tie
        kept = np.zeros(0) if tie is None else tie.kept_gaps()
        own = kept if self._offsets is None else self._offsets.adjusted
        return float(reduced(self.config.comm, float(np.abs(own).max(initial=0.0)), op=MPI.MAX))

    @property
    def on(self) -> bool:
        """Whether the contact is switched on."""
        return self._on

    def switch(self, on: bool) -> None:
        """Raise InputError: a ``Step`` switches contacts, with their forces."""
        raise InputError(f"contact '{self.name}' is switched by a step: expected Step(..., contacts={{contact: {on!r}}})")

    def note_on(self, on: bool) -> None:
        """Note that a step has switched the contact on or off."""
        self._on = on

    @property
    def sees_corners(self) -> bool:
        """Whether convex corners of the target may penetrate facets between contactors."""
        return self.pair.discretisation.traits.at_feet and self.contactor.dim > 0

    def edges_that_meet(self) -> Meeting | None:
        """Surfaces whose sharp edges may cross, in 3D; shared by contacts of the same surfaces (collective)."""
        from uem_dolfinx.contact.warnings.edges_inside import Meeting

        if self.contactor.dim < 2 or self.tied is True or not isinstance(self.target, Tag):
            return None
        try:
            return Meeting(facets_of(self.config, self.contactor, "contactor"), facets_of(self.config, self.target))
        except OrientationError:
            # a surface inside a body has no outer side from which an edge could enter
            return None

    @property
    def corner(self) -> CornerInside | None:
        """The reported convex corner of the target, which reduces the contact force; None without one."""
        return self._corner

    def note_corner(self, corner: CornerInside) -> None:
        """Warn of a convex corner of the target that reduces the contact force."""
        self._corner = corner
        logger.warning("%s: %s", self.name, corner)

    @property
    def watches_ends(self) -> bool:
        """Whether contactors may slide off an end of the target, and no warning of this has been given."""
        return not self._slipped and self.pair.target.n_nodes > 0

    def warn_of_ends(self) -> None:
        """Warn if many contactors have slid off the target's end (collective)."""
        self._slipped = warn_of_slipped(self.pair, self.off_at_start | self.pair.tied, self._areas)

    def look_at_wear(self, before: PairState | None, stiffness: Array | None) -> None:
        """Warn, once, of too much wear in the step from the state ``before``; ``stiffness`` as in ``Watch.look`` (collective)."""
        wear = None if self.pair.friction is None else self.pair.friction.wear
        if wear is not None and before is not None and stiffness is not None:
            wear.look_at_step(before, self.pair.committed, self.pair.kinematics.normal, stiffness)


class Watch:
    """Joint checks of all contacts after every step; ``rigid (n_owned,)`` nodes move as rigid bodies (collective)."""

    def __init__(self, contacts: Sequence[WatchedContact], rigid: Bools | None = None):
        self._contacts = contacts
        self._rigid_sides: Any = None  # contactors of rigid bodies, a ``RigidSides``; None without rigid nodes
        if contacts and rigid is not None and reduced(contacts[0].config.comm, int(rigid.sum())):
            from uem_dolfinx.contact.warnings.rigid_sides import RigidSides

            self._rigid_sides = RigidSides(contacts, rigid)
        if contacts and contacts[0].config.equations:
            from uem_dolfinx.contact.warnings.rigid_sides import warn_of_seams, warn_past_seams

            warn_of_seams([contact.pair for contact in contacts])
            warn_past_seams(contacts)
        self._edges: list[tuple[EdgesInside, list[WatchedContact]]] = []
        self._confined: Confined | None = None
        by_nodes = any(c.sees_corners and isinstance(c.target, Tag) for c in contacts)
        if by_nodes and not any(c.of_all_surfaces for c in contacts):
            from uem_dolfinx.contact.warnings.confined import Confined

            self._confined = Confined([c for c in contacts if not c.is_further_part])
        self._begin()
        self._take_edges()
        for group in _by_interface([c for c in contacts if not c.adjust]).values():
            _warn_of_sagging_facets(group)

    def _take_edges(self) -> None:
        """Find the sharp edges of surfaces in 3D that may meet (collective)."""
        if not self._contacts or self._contacts[0].config.tdim < 3:
            return
        meetings: dict[tuple[int, int], tuple[Meeting, list[WatchedContact]]] = {}
        for contact in self._contacts:
            meeting = contact.edges_that_meet()
            if meeting is not None:
                meetings.setdefault((id(meeting.own), id(meeting.theirs)), (meeting, []))[1].append(contact)
        if not meetings:
            return
        from uem_dolfinx.contact.warnings.edges_inside import EdgesInside

        edges = [(EdgesInside(meeting), group) for meeting, group in meetings.values()]
        self._edges = [(one, group) for one, group in edges if one.any]

    def _begin(self) -> None:
        """Find the corners of targets, and contactors past ends at the start (collective)."""
        from uem_dolfinx.contact.warnings.target_corners import TargetCorners

        groups = _by_interface([c for c in self._contacts if c.sees_corners]).values()
        self._corners = [(TargetCorners([c.pair for c in group], [c.contactor for c in group]), group) for group in groups]
        own = {id(c.pair): c.off_at_start for c in self._contacts}
        wholes = {key: group[0].pair.whole for key, group in _by_interface(self._contacts).items()}
        self._off_at_start = {key: np.concatenate([own[id(m)] for m in whole.members]) for key, whole in wholes.items()}

    def look(self, before: Mapping[int, PairState], stiffness: Array | None) -> None:
        """Check contacts that are switched on, after a step (collective).

        Args:
            before: states at the start of the step, by ``id`` of the single interfaces.
            stiffness: diagonal of K at the owned nodes ``(n_owned, gdim)``; None before it is known.
        """
        looked_at = [c for c in self._contacts if c.on and not c.pair.far]
        for group in _by_interface(looked_at).values():
            self._look_at_ends(group)
        if self._confined is not None:
            self._confined.look()
        self._look_at_edges()
        for contact, corner in self.corners_inside([c for c in looked_at if c.corner is None], stiffness).items():
            contact.note_corner(corner)
        for contact in looked_at:
            contact.look_at_wear(before.get(id(contact.pair)), stiffness)

    def _look_at_edges(self) -> None:
        """Warn of sharp edges that cross, once for each contact and step (collective)."""
        for edges, group in self._edges:
            # edges may be near each other without a contactor nearby
            looked_at = [c for c in group if c.on]
            found = edges.find() if looked_at else None
            if found is not None:
                from uem_dolfinx.contact.warnings.edges_inside import warn

                warn(looked_at[0].name, found)

    def _look_at_ends(self, group: Sequence[WatchedContact]) -> None:
        """Warn of contactors that have slid off the ends of targets, for contacts treated together (collective)."""
        group = [c for c in group if c.watches_ends]
        if not group:
            return
        whole = group[0].pair.whole
        gone = whole.off & ~self._off_at_start[id(whole)] & ~whole.tied
        some = dict(zip(map(id, whole.members), contacts_with(whole, gone)))
        mine = np.array([some[id(c.pair)] for c in group])
        for contact, some in zip(group, reduced(whole.config.comm, mine, op=MPI.LOR)):
            if some:
                contact.warn_of_ends()

    def corners_inside(self, contacts: Sequence[WatchedContact], stiffness: Array | None) -> dict[WatchedContact, CornerInside]:
        """Convex target corners inside contactors that reduce contact forces; ``stiffness`` as in ``look`` (collective)."""
        if stiffness is None:
            return {}
        found: dict[WatchedContact, CornerInside] = {}
        checked = set(map(id, contacts))
        for corners, group in self._corners:
            of_group = corners.find(stiffness, np.array([id(c) in checked for c in group]))
            found |= {group[k]: corner for k, corner in of_group.items()}
        return found

    def advise(self, error: UEMError) -> None:
        """Add advice to an error if rigid contactors have caused it (collective)."""
        if self._rigid_sides is not None:
            self._rigid_sides.advise(error)

    def name_corner(self, stiffness: Array | None, error: UEMError) -> None:
        """Add a convex target corner inside contactors to an error message, if there is one (collective).

        The corner reduces a contact force now or did so before; ``stiffness`` as in ``look``.
        """
        now = self.corners_inside([c for c in self._contacts if c.on], stiffness)
        for contact in self._contacts:
            corner = now.get(contact) or contact.corner
            if corner is not None:
                error.amend(f"{contact.name}: {corner}")
                return


def _warn_of_sagging_facets(group: Sequence[WatchedContact]) -> None:
    """Warn of targets too coarse for their contactors, for contacts treated together (collective)."""
    whole = group[0].pair.whole
    some = np.ones(len(whole.members), dtype=bool)
    if len(some) > 1:
        some = reduced(whole.config.comm, contacts_with(whole, sagging(whole)[0]), op=MPI.LOR)
    near_pairs = {id(member) for member, one in zip(whole.members, some) if one}
    for contact in group:
        if id(contact.pair) in near_pairs:
            warn_of_sagging_facets(contact.pair)


def _by_interface(contacts: Sequence[WatchedContact]) -> dict[int, list[WatchedContact]]:
    """Contacts by ``id`` of their joint interface."""
    groups: dict[int, list[WatchedContact]] = {}
    for contact in contacts:
        groups.setdefault(id(contact.pair.whole), []).append(contact)
    return groups
