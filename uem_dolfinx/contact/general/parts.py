"""The contacts that a general contact consists of: nodes with bodies near them, facets with a body, and all with rigid surfaces."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints, sums_of_rows
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.law import FrictionLaw
from uem_dolfinx.contact.seam.placement import Discretisation, Kinematics
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.projection import Target
from uem_dolfinx.geometry.surfaces import Areas, surface_nodes
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.general.mortar import Body
    from uem_dolfinx.contact.general.pair_friction import ValuesOfPairs
    from uem_dolfinx.contact.warnings.edges_inside import Meeting
    from uem_dolfinx.geometry.neighbours import Neighbours
    from uem_dolfinx.geometry.skin import Skin


class GeneralPart(Contact):
    """One of the contacts that a general contact consists of."""

    of_all_surfaces = True
    #: Of all bodies.
    _skin: Skin
    #: Friction by pairs of surfaces.
    _by_pairs: ValuesOfPairs | None = None

    @cached_property
    def surface(self) -> Areas:
        """See ``ContactResults``."""
        return super().surface if self.coupling == "mortar" else self._skin.areas

    def friction_values(self) -> Array:
        """Values that friction has at this rank's contactors, by whatever pair."""
        return super().friction_values() if self._by_pairs is None else self._by_pairs.values.ravel()

    def _take_friction(self, law: FrictionLaw, mu: Array | None) -> None:
        """One value for all pairs is all that there is from then on."""
        self._by_pairs = None
        super()._take_friction(law, mu)

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

    def opposite(self, skin: Skin) -> Ints:
        """Numbers of the bodies that contactors are on ``(n,)``, -1 for none (collective)."""
        return np.asarray(skin.values_at(self.on_skin(self.pair.projection.facet), skin.body))

    def _friction_now(self, kinematics: Kinematics) -> Array | None:
        """Values by what contactors are on, or would touch ``(n,)``; None where they do not depend on that (collective)."""
        if self._by_pairs is None:
            return super()._friction_now(kinematics)
        return None if not self.pair.asked else self._by_pairs.now(self.on_skin(kinematics.projection.facet))

    @property
    def watches_ends(self) -> bool:
        """No: contactors come and go past the edges of bodies."""
        return False


class AmongContact(BodiesContact):
    """One of the contacts that a general contact consists of: every node against one body near it."""

    def __init__(self, neighbours: Neighbours, number: int, together: list[AmongContact], **options: Any):
        from uem_dolfinx.contact.general.nodes import AmongBodies, AmongQuadraticBodies

        skin = neighbours.skin
        quadratic = skin.config.degree == 2
        coupling: Any = AmongQuadraticBodies if quadratic else AmongBodies
        super().__init__(skin.tag, skin.tag, coupling=coupling, **options)
        self._neighbours, self._number, self._skin = neighbours, number, skin
        self._together = together

    def _sides(self, config: Configuration) -> tuple[Indices, Target]:
        from uem_dolfinx.geometry.neighbours import Neighbour

        return self._neighbours.nodes, Neighbour(self._neighbours, self._number, averaged=self.normals == "averaged")

    def pressing(self) -> tuple[Array, Array]:
        """With forces by which nodes at sharp edges are followed by what they follow: these press on the same areas (collective)."""
        (across, along), pair = super().pressing(), self.pair
        if not pair.asked:
            return across, along
        received, normal, spread = self._received(), pair.projection.normal, pair.discretisation.spread
        pressing = np.einsum("ng,ng->n", received, normal)
        sliding = received - pressing[:, None] * normal
        return across + spread(pressing), along + np.column_stack([spread(part) for part in sliding.T])

    def leads(self) -> Bools:
        """See ``ContactResults``: those whose bodies follow, not those at edges that are followed as well (collective)."""
        skin, place = self._skin, self._neighbours.place
        body = skin.values_at(self.pair.projection.facet, skin.body)
        return np.asarray((body >= 0) & (place[skin.body_of_node[self.pair.nodes]] <= place[body]))

    def edges_that_meet(self) -> Meeting:
        """Those of all bodies."""
        from uem_dolfinx.contact.warnings.edges_inside import Meeting

        return Meeting(self._skin, self._skin, self._neighbours.apart, self._neighbours.itself)

    def _received(self) -> Array:
        """Forces on active contactors by nodes of the body that they touch which follow them, where either is at a sharp edge.

        Returns:
            ``(n, gdim)`` (collective).
        """
        skin, config, told = self._skin, self.config, []
        for pair in (one.pair for one in self._together if one.pair.asked):
            row, node, weight = pair.kinematics.means()[1]
            own = np.flatnonzero(pair.trial.active[row])
            row, i = row[own], pair.nodes[row[own]]
            forces = -weight[own, None] * pair.trial.force[row]
            told.append(np.column_stack([node[own], skin.body_of_node[i], skin.corners[i], forces]))
        both = np.concatenate(told)
        there, arrived = config.send_to_owners(both[:, 0].astype(np.int64), both[:, 1:])
        active = np.flatnonzero(self.pair.trial.active)
        place = np.full(config.n_owned, -1)
        place[self.pair.nodes[active]] = active
        body = np.full(len(place), -1)
        body[self.pair.nodes[active]] = skin.values_at(self.pair.projection.facet[active], skin.body)
        counts = (body[there] == arrived[:, 0]) & ((arrived[:, 1] > 0) | skin.corners[there])
        return sums_of_rows(place[there][counts], arrived[counts, 2:], len(self.pair.nodes))

    @property
    def sees_corners(self) -> bool:
        """No: every node is beside something, and every corner of one body within the surface of all."""
        return False


class MortarContact(BodiesContact):
    """One of the contacts that a general contact consists of: facets of all bodies that follow one body, of smooth faces, against it."""

    def __init__(self, contactor: Tag, target: Tag, body: Body, **options: Any):
        super().__init__(contactor, target, coupling="mortar", **options)
        self._body, self._skin = body, body.skin

    def _sides(self, config: Configuration) -> tuple[Indices, Target]:
        return surface_nodes(config, self.contactor), self._body

    def _discretised(self, nodes: Indices, target: Any, **how: Any) -> tuple[Discretisation, None]:
        """Mortar against the body (collective)."""
        from uem_dolfinx.contact.general.mortar import AmongBodiesMortar

        surface = TargetFacets(self.config, self.contactor, "contactor")
        return AmongBodiesMortar(self.config, nodes, target, surface=surface, **how), None

    def edges_that_meet(self) -> Meeting:
        """Those of all bodies, none with itself."""
        from uem_dolfinx.contact.warnings.edges_inside import Meeting

        return Meeting(self._skin, self._skin, self._body.apart, np.zeros(self._skin.n_bodies, dtype=bool))

    def on_skin(self, facet: Ints) -> Ints:
        """See ``BodiesContact``."""
        return np.asarray(self._body.of_facets(facet, self._body.numbers))

    def opposite(self, skin: Skin) -> Ints:
        """The one body, also of contactors that nothing is opposite to: rows of others may have them."""
        return np.full(len(self.pair.nodes), self._body.number)
