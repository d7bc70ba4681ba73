"""The contacts that a general contact consists of: nodes with bodies near them, facets with a body, and all with rigid surfaces."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Indices, Ints
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.kinematics import Discretisation, Kinematics
from uem_dolfinx.contact.laws.law import FrictionLaw
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.projection import Target
from uem_dolfinx.geometry.surfaces import surface_nodes
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.among_mortar import Body
    from uem_dolfinx.geometry.neighbours import Neighbours


class GeneralPart(Contact):
    """One of the contacts that a general contact consists of."""

    of_all_surfaces = True

    def friction_values(self) -> Array:
        """Values that friction has at this rank's contactors, by whatever pair."""
        return super().friction_values() if self._by_pairs is None else self._by_pairs.values.ravel()

    def _friction_at(self, law: FrictionLaw, nodes: Indices, at: float) -> Array | None:
        """Values at contactors ``(n,)``, of pairs those to begin with; None if none has friction (collective)."""
        if self._by_pairs is None or self._pair is not None:
            return super()._friction_at(law, nodes, at)
        if not reduced(self.config.comm, bool(self._by_pairs.at(nodes).any()), op=MPI.LOR):
            return None
        return self._by_pairs.now(np.full(len(nodes), -1))


class RigidContact(GeneralPart):
    """One of the contacts that a general contact consists of: every node against a rigid surface."""


class BodiesContact(GeneralPart):
    """One of the contacts that a general contact consists of: of bodies with bodies."""

    def on_skin(self, facet: Ints) -> Ints:
        """Numbers among the facets of all bodies of those that contactors are on ``(n,)``, -1 for none (collective)."""
        return facet

    def _friction_now(self, kinematics: Kinematics) -> Array | None:
        """Values by what contactors are on, or would touch ``(n,)``; None where they do not depend on that (collective)."""
        if self._by_pairs is None:
            return super()._friction_now(kinematics)
        return None if kinematics.idle else self._by_pairs.now(self.on_skin(kinematics.projection.facet))

    def look_at_ends(self) -> None:
        """Contactors come and go past the edges of bodies."""


class AmongContact(BodiesContact):
    """One of the contacts that a general contact consists of: every node against one body near it."""

    def __init__(self, neighbours: Neighbours, number: int, **options: Any):
        from uem_dolfinx.contact.among_bodies import AmongBodies, AmongQuadraticBodies

        skin = neighbours.skin
        quadratic = skin.config.degree == 2
        coupling: Any = AmongQuadraticBodies if quadratic else AmongBodies
        super().__init__(skin.tag, skin.tag, coupling=coupling, **options)
        self._neighbours, self._number = neighbours, number

    def _sides(self, config: Configuration) -> tuple[Indices, Target]:
        from uem_dolfinx.geometry.neighbours import Neighbour

        return self._neighbours.nodes, Neighbour(self._neighbours, self._number, averaged=self.normals == "averaged")

    def begin(self) -> None:
        """Take the contact for that of a problem that is complete (collective)."""
        super().begin()
        # every node is beside something, and every corner of one body within the surface of all
        self._corners = None


class MortarContact(BodiesContact):
    """One of the contacts that a general contact consists of: facets of all bodies that follow one body, of smooth faces, against it."""

    def __init__(self, contactor: Tag, target: Tag, body: Body, **options: Any):
        super().__init__(contactor, target, coupling="mortar", **options)
        self._body = body

    def _sides(self, config: Configuration) -> tuple[Indices, Target]:
        return surface_nodes(config, self.contactor), self._body

    def _discretised(self, nodes: Indices, target: Any, **how: Any) -> tuple[Discretisation, None]:
        """Mortar against the body (collective)."""
        from uem_dolfinx.contact.among_mortar import AmongBodiesMortar

        surface = TargetFacets(self.config, self.contactor, "contactor")
        return AmongBodiesMortar(self.config, nodes, target, surface=surface, **how), None

    def on_skin(self, facet: Ints) -> Ints:
        """See ``BodiesContact``."""
        return np.asarray(self._body.of_facets(facet, self._body.numbers))
