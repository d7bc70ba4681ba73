"""Contactors of many contacts, one contact after the other, each with its own target, and their friction.

A node of several contacts occurs several times.

Many contacts as one interface, with joint placement, active set and equations.

Users access each of the contacts through its ``Member``.
"""

from __future__ import annotations

import weakref
from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from itertools import pairwise
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.friction.limits import Limits
from uem_dolfinx.contact.friction.sliding import Sliding
from uem_dolfinx.contact.laws.law import FrictionLaw, parameters
from uem_dolfinx.contact.nodes.node_to_surface import NodalKinematics, NodeToSurface
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.kinds import PartsOfPair
from uem_dolfinx.contact.pair.tables import label_of
from uem_dolfinx.contact.seam.corners import Corners
from uem_dolfinx.contact.seam.placement import Kinematics
from uem_dolfinx.contact.seam.state import FACETS, OF_FRICTION, FrictionState, PairState
from uem_dolfinx.geometry.joined import JoinedFacets, JoinedRigid, JoinedTarget
from uem_dolfinx.geometry.projection import FacetProjection, Projection
from uem_dolfinx.geometry.rigid import RigidProjection
from uem_dolfinx.parallel import reduced


class JoinedNodes(NodeToSurface):
    """Implements ``Discretisation``: contactors of several contacts, from the discretisation of each (collective)."""

    target: Any  # a ``JoinedTarget`` or ``JoinedRigid``

    def __init__(self, own: Sequence[NodeToSurface]):
        first = own[0]
        label: Ints = np.repeat(np.arange(len(own)), [len(one.nodes) for one in own])
        ends = np.cumsum([0, *(len(one.nodes) for one in own)])
        #: Contactors of each contact.
        self.rows_of = [slice(a, b) for a, b in pairwise(ends.tolist())]
        surfaces = [getattr(one.target, "facets", one.target) for one in own]
        distinct: dict[int, Any] = {id(surface): surface for surface in surfaces}
        self.surface_of = [list(distinct).index(id(surface)) for surface in surfaces]  # number of the surface of each contact
        #: Converts numbers of facets, ``alone`` on their surface and ``here``.
        self.numbers: Any = JoinedRigid([one.target for one in own], self.rows_of)
        target: Any = self.numbers
        if first.target.n_nodes:
            self.numbers = JoinedFacets(first.config, list(distinct.values()))
            target = JoinedTarget(self.numbers, first.target.averaged, np.array(self.surface_of)[label])
        how: dict[str, Any] = {"free": first.setting.free, "sliding": first.sliding, "thickness": first.thickness}
        super().__init__(first.config, np.concatenate([one.nodes for one in own]), target, **how)
        self._own = own
        none = np.zeros(len(own), dtype=bool)
        self.set(far=none, on=~none, mutual=none, label=label)

    def set(self, **changed: Any) -> None:
        """See ``OnTarget`` (collective)."""
        super().set(**changed)
        for one in getattr(self, "_own", ()) if "free" in changed else ():
            one.set(free=changed["free"])
        if "far" in changed and self.target.n_nodes:
            self.target.projected = ~changed["far"][self.setting.label]

    def overhanging(self, projection: Projection, which: Bools) -> Bools:
        """See ``NodeToSurface``: by the facets of each contact."""
        if not isinstance(projection, FacetProjection):
            return super().overhanging(projection, which)
        from uem_dolfinx.contact.nodes.node_to_surface import close_to_ends

        near = close_to_ends(projection, which)
        if not reduced(self.config.comm, bool(near.any()), op=MPI.LOR):
            return near
        every = np.arange(len(self.nodes))
        parts = [one.overhanging(projection.take(every[own]), which[own]) for one, own in zip(self._own, self.rows_of)]
        return np.concatenate(parts)

    def across(self, found: FacetProjection, points: Array) -> FacetProjection:
        """See ``OnTarget``; only for contacts with offsets."""
        i = np.flatnonzero(np.array([one.offset is not None for one in self._own])[self.setting.label])
        assert self.offset is not None
        return found.with_those(i, found.take(i).across_edges(points[i], self.offset[i]))


class JoinedLaw:
    """Friction laws of several contacts, all of one kind, as one; ``label (n,)`` is the number of each contactor's contact."""

    def __init__(self, laws: Sequence[FrictionLaw], label: Ints):
        self.laws, self.field = list(laws), laws[0].field
        self.per_area = any(law.per_area for law in laws)
        kinds = {repr(parameters(law)[1:]): law for law in laws}
        self._kinds = list(kinds.values())
        self._kind = np.array([list(kinds).index(repr(parameters(law)[1:])) for law in laws])[label]

    def limit(self, value: Array, lam: Array, area: Array) -> tuple[Array, Array]:
        """Limit of each contactor by the law of its contact."""
        if len(self._kinds) == 1:
            return self._kinds[0].limit(value, lam, area)
        found = np.zeros((2, len(value)))
        for k, law in enumerate(self._kinds):
            own = self._kind == k
            found[:, own] = law.limit(value[own], lam[own], area[own])
        return found[0], found[1]


class JoinedSliding(Sliding):
    """Friction of the contactors of several contacts, from the friction of each and the discretisation of all."""

    def __init__(self, own: Sequence[Sliding], discretisation: JoinedNodes):
        first, label = own[0], discretisation.setting.label
        ends = np.cumsum([0, *(len(one.value) for one in own)])

        def areas(normal: Array | None) -> Array:
            parts = [None] * len(own) if normal is None else [normal[a:b] for a, b in pairwise(ends)]
            return np.concatenate([one.limits.areas_of(part) for one, part in zip(own, parts)])

        super().__init__(
            first.config,
            discretisation.nodes,
            discretisation,
            law=JoinedLaw([one.limits.law for one in own], label),
            value=np.concatenate([one.value for one in own]),
            limits=Limits(areas, first.limits.duration, "", np.concatenate([one.config.X[one.nodes] for one in own])),
            keeps_feet=first.keeps_feet,
            value_now=lambda kinematics: None,
        )


class JoinedInterface(Interface):
    """Several contacts as one interface (collective).

    Args:
        own: what the interfaces of the contacts are made of, equal except for surfaces, friction values and penetration bounds.

    Attributes:
        members: access to each of the contacts.
    """

    discretisation: JoinedNodes

    def __init__(self, own: Sequence[PartsOfPair]):
        first, nodal = own[0], JoinedNodes([parts.discretisation for parts in own])
        sliding = [parts.friction for parts in own if parts.friction is not None]
        friction = JoinedSliding(sliding, nodal) if sliding else None
        super().__init__(nodal.config, nodal.nodes, nodal, friction, name=first.name, max_penetration=first.max_penetration)
        self._members: list[weakref.ref[Member]] = []

    @property
    def members(self) -> Sequence[Interface]:
        """Members of the contacts."""
        return [one for member in self._members if (one := member()) is not None]

    def make_members(self, own: Sequence[PartsOfPair]) -> list[Member]:
        """Make the members; the caller keeps references to them, and they keep this interface."""
        members = [Member(self, k, parts) for k, parts in enumerate(own)]
        self._members = list(map(weakref.ref, members))
        return members

    def state_of(self, k: int, state: PairState) -> PairState:
        """A contact's part of a state, with its own numbers of facets."""
        numbers, surface = self.discretisation.numbers, self.discretisation.surface_of[k]
        own = self.discretisation.rows_of[k]
        return _each(lambda name, a: numbers.alone(a[own], surface) if name in FACETS else a[own], state)

    def with_state_of(self, k: int, state: PairState, part: PairState) -> PairState:
        """The state with a contact's part."""
        numbers, surface = self.discretisation.numbers, self.discretisation.surface_of[k]
        renumbered = _each(lambda name, a: numbers.here(a, surface) if name in FACETS else a, part)
        return _with_rows(state, self.discretisation.rows_of[k], renumbered)

    def commit(self) -> None:
        """Make the trial state the committed one, except for skipped contacts; call ``project`` afterwards."""
        before, s = self.committed, self.discretisation.setting
        skipped = (s.far | ~s.on)[s.label]
        super().commit()
        if skipped.any():
            self.trial = self.committed = _with_rows(self.committed, skipped, _each(lambda _, a: a[skipped], before))


def _each(change: Callable[..., Any], *states: PairState) -> PairState:
    """The state whose arrays are made by ``change(name, *arrays)``, of arrays that all ``states`` have."""
    parts: list[Any] = [vars(state) for state in states]
    found = {
        name: change(name, *[part[name] for part in parts])
        for name, value in parts[0].items()
        if name != "friction" and value is not None
    }
    if states[0].friction is not None:
        parts = [vars(state.friction) for state in states]
        found["friction"] = FrictionState(
            **{name: change(OF_FRICTION + name, *[part[name] for part in parts]) for name in parts[0]}
        )
    return PairState(**found)


def _with_rows(state: PairState, which: Any, other: PairState) -> PairState:
    """The state with some contactors, by a slice, numbers or a mask, replaced by another state of these."""

    def changed(_: str, a: Any, b: Any) -> Any:
        a = a.copy()
        a[which] = b
        return a

    return _each(changed, state, other)


class Member(Interface):
    """One contact of a ``JoinedInterface`` as a separate interface, with its rows of states and its own numbers of facets.

    Args:
        whole: the ``JoinedInterface``.
        k: number of the contact.
        own: what its interface alone would be made of, with its own target.
    """

    def __init__(self, whole: Any, k: int, own: PartsOfPair):
        self.joined, self._k, self._rows = whole, k, whole.discretisation.rows_of[k]
        _, nodal, self.friction, self.name, self.max_penetration = own
        self.discretisation, self.config, self.nodes, self.tie, self.heats = nodal, nodal.config, nodal.nodes, None, []
        #: The last kinematics, and the last trial state, of all contacts that were looked at, and their parts.
        self._known: tuple[Kinematics, Kinematics] | None = None
        self._seen: tuple[PairState, PairState] | None = None

    @property
    def whole(self) -> Interface:
        """The joint interface."""
        return self.joined

    # -- states ----------------------------------------------------------------------------------------------------------

    @property
    def trial(self) -> PairState:  # type: ignore[override]
        """State of the present iteration."""
        if self._seen is None or self._seen[0] is not self.joined.trial:
            self._seen = self.joined.trial, self.joined.state_of(self._k, self.joined.trial)
        return self._seen[1]

    @trial.setter
    def trial(self, state: PairState) -> None:
        self.joined.trial = self.joined.with_state_of(self._k, self.joined.trial, state)

    @property
    def committed(self) -> PairState:  # type: ignore[override]
        """State of the last step."""
        return self.joined.state_of(self._k, self.joined.committed)

    @committed.setter
    def committed(self, state: PairState) -> None:
        self.joined.committed = self.joined.with_state_of(self._k, self.joined.committed, state)

    def largest_gap_here(self) -> float:
        """Largest gap of an active contactor of this rank, or distance from its anchor, a length."""
        whole = self.joined
        here = float(np.abs(self.kinematics.gap[self.trial.active & ~self.trial.redundant]).max(initial=0.0))
        if whole.friction is None:
            return here
        return max(here, float(whole.friction.distances(whole.trial)[self._rows].max(initial=0.0)))

    # -- placement of contactors -----------------------------------------------------------------------------------------

    def project(self) -> None:
        """Project the contactors of all contacts onto their targets (collective)."""
        self.joined.project()

    @property
    def far(self) -> bool:
        """Whether it is skipped, since the surfaces are separated."""
        return bool(self.joined.discretisation.setting.far[self._k])

    def search(self) -> None:
        """Search for its contactors from the next placement on (collective)."""
        if self.far:
            far = self.joined.discretisation.setting.far.copy()
            far[self._k] = False
            self.joined.discretisation.set(far=far)

    @property
    def in_reach(self) -> bool:
        """Whether any contactor of this contact, on any rank, was near the target in the last placement."""
        return self.joined.in_reach and not self.far

    @property
    def kinematics(self) -> Kinematics:  # type: ignore[override]
        """Kinematics of its contactors, made at the first access."""
        whole: Any = self.joined.kinematics
        if self._known is None or self._known[0] is not whole:
            self._known = whole, self._kinematics_of(whole)
        return self._known[1]

    def _kinematics_of(self, whole: Any) -> Kinematics:
        some, points = self._rows, whole.points[self._rows]
        of: Any = self.discretisation
        if not self.in_reach:
            return of.nowhere(points)
        nearest = self._alone(whole.nearest)
        projection = nearest if whole.projection is whole.nearest else self._alone(whole.projection)
        moves = None if whole.target_moves is None else whole.target_moves[some]
        return NodalKinematics(of, points, projection, nearest, whole.gap[some], self._corners_of(whole.corners), moves)

    def _alone(self, p: Any) -> Any:
        nodal = self.joined.discretisation
        parts = {f.name: v[self._rows] for f in fields(p) if isinstance(v := getattr(p, f.name), np.ndarray)}
        parts["facet"] = nodal.numbers.alone(parts["facet"], nodal.surface_of[self._k])
        if isinstance(p, RigidProjection):
            parts["motion"] = self.target.motion
        return replace(p, **parts)

    def _corners_of(self, corners: Corners | None) -> Corners | None:
        if corners is None:
            return None
        some = (corners.which >= self._rows.start) & (corners.which < self._rows.stop)
        parts = {f.name: v[some] for f in fields(corners) if (v := getattr(corners, f.name)) is not None}
        parts["which"] = parts["which"] - self._rows.start
        return replace(corners, **parts)

    # -- changes between steps -------------------------------------------------------------------------------------------

    def activate_touching(self, which: Bools | bool = True) -> None:
        """See ``Interface``; contactors of other contacts stay as they are (collective)."""
        own = np.zeros(len(self.joined.nodes), dtype=bool)
        own[self._rows] = which
        self.joined.activate_touching(own)

    def set_offset(self, offset: Array | None) -> None:
        """Set offsets ``(n,)``; contactors must be placed again (collective)."""
        self.discretisation.set(offset=offset)
        nodal = self.joined.discretisation
        every = np.zeros(len(nodal.nodes)) if nodal.offset is None else nodal.offset.copy()
        every[self._rows] = 0.0 if offset is None else offset
        others = any(pair.discretisation.setting.offset is not None for pair in self.joined.members)
        nodal.set(offset=every if others else None)

    def set_friction(self, law: FrictionLaw, value: Array, known: bool = False) -> None:
        """See ``Interface`` (collective)."""
        assert self.friction is not None
        self.friction.set(law, value)
        own = [pair.friction for pair in self.joined.members if pair.friction is not None]
        every = JoinedLaw([one.limits.law for one in own], label_of(self.joined))
        self.joined.set_friction(every, np.concatenate([one.value for one in own]), known)
