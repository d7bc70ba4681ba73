"""Contactors of many contacts, one contact after the other, each with its own target, and their friction.

A node of several contacts occurs several times.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.friction.limits import Limits
from uem_dolfinx.contact.friction.sliding import Sliding
from uem_dolfinx.contact.laws.law import FrictionLaw, parameters
from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
from uem_dolfinx.geometry.joined import JoinedFacets, JoinedTarget
from uem_dolfinx.geometry.joined_rigid import JoinedRigid
from uem_dolfinx.geometry.projection import FacetProjection, Projection
from uem_dolfinx.parallel import reduced


class JoinedNodes(NodeToSurface):
    """Implements ``Discretisation``: contactors of several contacts (collective).

    Args:
        own: discretisations of the contacts.
    """

    #: A ``JoinedTarget`` or ``JoinedRigid``.
    target: Any

    def __init__(self, own: Sequence[NodeToSurface]):
        first = own[0]
        label: Ints = np.repeat(np.arange(len(own)), [len(one.nodes) for one in own])
        ends = np.cumsum([0, *(len(one.nodes) for one in own)])
        #: Contactors of each contact.
        self.rows_of = [slice(a, b) for a, b in pairwise(ends.tolist())]
        surfaces = [getattr(one.target, "facets", one.target) for one in own]
        distinct: dict[int, Any] = {id(surface): surface for surface in surfaces}
        #: Number of the surface of each contact.
        self.surface_of = [list(distinct).index(id(surface)) for surface in surfaces]
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
            self.target.asked = ~changed["far"][self.setting.label]

    def overhanging(self, projection: Projection, which: Bools) -> Bools:
        """See ``NodeToSurface``: by the facets of each contact."""
        if not isinstance(projection, FacetProjection):
            return super().overhanging(projection, which)
        from uem_dolfinx.contact.nodes.overhang import close_to_ends

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
    """Friction laws of several contacts, all of one kind, as one ``FrictionLaw``.

    Args:
        laws: of the contacts.
        label: number of the contact of each contactor ``(n,)``.
    """

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
    """Friction of the contactors of several contacts.

    Args:
        own: friction of each contact.
        discretisation: of all of them.
    """

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
            limits=Limits(areas, first.limits.duration),
            keeps_feet=first.keeps_feet,
            value_now=lambda kinematics: None,
        )
