"""Mortar between the surfaces of many bodies: each body is a separate target for the facets of all bodies that follow it.

A mortar equation has one direction: facets that meet at a sharp edge belong to different contacts, see ``geometry.skin``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.mortar.discretisation import Mortar
from uem_dolfinx.contact.mortar.placement import MortarKinematics
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets, heights
from uem_dolfinx.geometry.opposite import thickness
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.skin import Apart, Skin


class Body(MeshTarget):
    """One body as a target of facets of other bodies that were not behind its cells at the end of the last accepted step.

    Args:
        skin: the surfaces of all bodies.
        facets: of the body.
        body: its number.
        apart: pairs of sets of facets that never touch each other, see ``Neighbours``.
        overlap: bound on the initial penetration of facets, a length.
    """

    def __init__(self, skin: Skin, facets: TargetFacets, body: int, apart: Sequence[Apart], overlap: float):
        super().__init__(facets)
        self.skin, self.number, self.apart = skin, body, apart
        own = np.flatnonzero(skin.body == body)
        #: Numbers of its facets among those of all bodies, over all ranks ``(m,)``.
        self.numbers: Ints = skin.first[skin.config.comm.rank] + own
        #: Sets of nodes and of all bodies' facets that never touch certain facets of this body, and these facets.
        self._apart = [sets for a, f, b, h in apart for sets in ((a, f, h[own]), (b, h, f[own]))]
        self._planes = facets.middles(facets.x)
        #: Largest depth of opposite facets behind this body's facets, limited by its thickness.
        self._overlap = thickness(self, overlap)

    def commit(self) -> None:
        """Accept a step, or return to one."""
        self._planes, self._overlap = self.facets.middles(self.facets.x), np.zeros_like(self._overlap)

    def sets_of(self, surface: TargetFacets) -> Bools:
        """Whether facets of a surface belong to sets that never touch certain facets of this body ``(m, s)``."""
        number = np.searchsorted(self.skin.entities, surface.entities)
        return np.column_stack([np.zeros((len(number), 0), dtype=bool), *(facets[number] for _, facets, _ in self._apart)])

    def excluded(self, nodes: Indices, facet: Ints) -> Bools:
        """Whether local nodes ``(n,)`` never touch their nearest facets, with these numbers ``(n,)`` (collective)."""
        out = np.zeros(len(nodes), dtype=bool)
        for own, _, facets in self._apart:
            out |= own[nodes] & (self.of_facets(facet, facets.astype(np.int64)) > 0)
        return out

    def allowed(self, visibility: Array, facet: Ints) -> Bools:
        """See ``MeshTarget``; keys are the last accepted midpoints of contactor facets, and their sets ``(k, gdim + s)``."""
        where, sets = np.split(visibility, [self.skin.config.gdim], axis=1)
        # facets on the same side of a body may be below each other's planes; facets of the other side are behind the cells
        may = heights(where, facet, self._planes) >= -np.maximum(self.facets.depth, self._overlap)[facet]
        for k, (_, _, facets) in enumerate(self._apart):
            may &= ~((sets[:, k] > 0) & facets[facet])
        return np.asarray(may)


class AmongBodiesMortar(Mortar):
    """Implements ``Discretisation``: contactor facets with the facets of one body that they follow."""

    target: Body

    def __init__(self, config: Configuration, nodes: Indices, target: Body, **how: Any):
        super().__init__(config, nodes, target, **how)
        self._at_edge = target.skin.on_sides(target.skin.edges.sharp)[nodes]
        self._sets, self._middles = target.sets_of(self.surface), self.surface.x.mean(axis=1)

    def place(self, points: Array, state: PairState) -> MortarKinematics:
        """Project contactors and find the segments of their facets (collective); see ``Discretisation``."""
        found = super().place(points, state)
        assert isinstance(found.nearest, FacetProjection)
        # at a sharp edge, a node counts only for faces that are covered by the body
        out = self._at_edge | self.target.excluded(self.nodes, found.nearest.facet)
        out &= ~found.rows.covered
        return replace(found, out=out if found.out is None else out | found.out)

    def visibility_keys(self, facets: Ints) -> Array:
        """Visibility keys of contactor facets, see ``Body.allowed`` ``(m, k)``."""
        return np.column_stack([self._middles[facets], self._sets[facets]])

    def commit(self) -> None:
        """Accept a step: current positions decide which side of facets contactors are on."""
        super().commit()
        self._middles = self.surface.x.mean(axis=1)
        self.target.commit()
