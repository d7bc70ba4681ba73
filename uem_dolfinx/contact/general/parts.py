"""The parts of a general contact: nodes with nearby bodies, facets with a body, and all nodes with rigid surfaces."""

from __future__ import annotations

from collections.abc import Callable
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
    from uem_dolfinx.geometry.edge_crossings import Crossings
    from uem_dolfinx.geometry.neighbours import Neighbours
    from uem_dolfinx.geometry.projection import FacetProjection
    from uem_dolfinx.geometry.skin import Skin


class GeneralPart(Contact):
    """Base of the parts of a general contact.

    Args:
        sides: contactor and target.
        skin: joint surface of all bodies.
        by_pairs: function of the rigid target, or None, and the name of the part that makes its friction by pairs of surfaces.
        options: see ``Contact``.
    """

    of_all_surfaces = True

    def __init__(self, *sides: Any, skin: Skin, by_pairs: Callable[[Any, str], ValuesOfPairs] | None = None, **options: Any):
        super().__init__(*sides, **options)
        rigid = self.target if hasattr(self.target, "project") else None
        self._skin, self._by_pairs = skin, None if by_pairs is None else by_pairs(rigid, self.name)

    @cached_property
    def surface(self) -> Areas:
        """See ``ContactResults``."""
        return super().surface if self.coupling == "mortar" else self._skin.areas

    def friction_values(self) -> Array:
        """Friction parameters at this rank's contactors, for all pairs."""
        return super().friction_values() if self._by_pairs is None else self._by_pairs.values.ravel()

    def _take_friction(self, law: FrictionLaw, mu: Array | None) -> None:
        """Set one law and value for all pairs, which replaces friction by pairs."""
        self._by_pairs = None
        super()._take_friction(law, mu)

    def _friction_at(self, law: FrictionLaw, nodes: Indices, at: float) -> Array | None:
        """Values at contactors ``(n,)``, with pairs the initial ones; None if no pair has friction (collective)."""
        if self._by_pairs is None or self._pair is not None:
            return super()._friction_at(law, nodes, at)
        if not reduced(self.config.comm, bool(self._by_pairs.at(nodes).any()), op=MPI.LOR):
            return None
        return self._by_pairs.now(np.full(len(nodes), -1))

    def whole_side(self) -> Indices:
        """See ``ContactResults``: all surface nodes of the contactors' bodies, of which a single face may be held (collective)."""
        skin, own = self._skin, np.zeros(self._skin.n_bodies, dtype=bool)
        own[skin.body_of_node[self.pair.nodes]] = True
        own = reduced(self.config.comm, own, op=MPI.LOR)
        nodes = surface_nodes(self.config, skin.tag)
        return nodes[own[skin.body_of_node[nodes]]]


class RigidContact(GeneralPart):
    """Part of a general contact: all nodes with a rigid surface."""


class BodiesContact(GeneralPart):
    """Part of a general contact: bodies with bodies."""

    def on_skin(self, facet: Ints) -> Ints:
        """Facets of contactors, numbered over the facets of all bodies ``(n,)``, -1 for no facet (collective)."""
        return facet

    def opposite(self, skin: Skin) -> Ints:
        """Numbers of the bodies opposite to contactors ``(n,)``, -1 for no body (collective)."""
        return np.asarray(skin.values_at(self.on_skin(self.pair.kinematics.projection.facet), skin.body))

    def _friction_now(self, kinematics: Kinematics) -> Array | None:
        """Values by the body opposite to contactors ``(n,)``; None if they do not depend on it (collective)."""
        if self._by_pairs is None:
            return super()._friction_now(kinematics)
        return None if not self.pair.in_reach else self._by_pairs.now(self.on_skin(kinematics.projection.facet))

    @property
    def watches_ends(self) -> bool:
        """False, since contactors pass the edges of bodies regularly."""
        return False


class AmongContact(BodiesContact):
    """Part of a general contact: every node with one nearby body."""

    def __init__(
        self, neighbours: Neighbours, number: int, together: list[AmongContact], crossings: Crossings | None, **options: Any
    ):  # fmt: skip
        from uem_dolfinx.contact.general.nodes import AmongBodies, AmongQuadraticBodies

        skin = neighbours.skin
        quadratic = skin.config.degree == 2
        coupling: Any = AmongQuadraticBodies if quadratic else AmongBodies
        super().__init__(skin.tag, skin.tag, coupling=coupling, **options)
        self._neighbours, self._number, self._together, self._crossings = neighbours, number, together, crossings

    def _sides(self, config: Configuration) -> tuple[Indices, Target]:
        from uem_dolfinx.geometry.neighbours import Neighbour

        return self._neighbours.nodes, Neighbour(self._neighbours, self._number, averaged=self.normals == "averaged")

    def _discretised(self, nodes: Indices, target: Any, **how: Any) -> tuple[Any, None]:
        """Nodes, without those at crossings of edges with the body on this list."""
        found: Any = super()._discretised(nodes, target, **how)[0]
        crossings, n = self._crossings, self._neighbours

        def at_crossings(_: FacetProjection) -> Bools:
            n.update()
            assert crossings is not None
            return crossings.hold(nodes, n.body[self._number], n.skin.n_bodies)

        if crossings is not None:
            found.leave(at_crossings, n.number)
        return found, None

    def pressing(self) -> tuple[Array, Array]:
        """Forces, including forces from nodes of the other body that follow this node at sharp edges (collective)."""
        (across, along), pair = super().pressing(), self.pair
        if not pair.in_reach:
            return across, along
        received, normal, spread = self._received(), pair.kinematics.projection.normal, pair.discretisation.spread
        pressing = np.einsum("ng,ng->n", received, normal)
        sliding = received - pressing[:, None] * normal
        return across + spread(pressing), along + np.column_stack([spread(part) for part in sliding.T])

    def leads(self) -> Bools:
        """See ``ContactResults``: contactors of bodies that follow in the order; not edge nodes in the opposite direction (collective)."""
        skin, place = self._skin, self._neighbours.place
        body = skin.values_at(self.pair.kinematics.projection.facet, skin.body)
        return np.asarray((body >= 0) & (place[skin.body_of_node[self.pair.nodes]] <= place[body]))

    def edges_that_meet(self) -> Meeting:
        """Sharp edges of all bodies."""
        from uem_dolfinx.contact.warnings.edges_inside import Meeting

        return Meeting(self._skin, self._skin, self._neighbours.apart, self._neighbours.itself)

    def _received(self) -> Array:
        """Forces ``(n, gdim)`` by nodes of the touched body that follow active contactors, where one is at a sharp edge (collective)."""
        skin, config, parts = self._skin, self.config, []
        for pair in (one.pair for one in self._together if one.pair.in_reach):
            row, node, weight = pair.kinematics.means()[1]
            own = np.flatnonzero(pair.trial.active[row])
            row, i = row[own], pair.nodes[row[own]]
            forces = -weight[own, None] * pair.trial.force[row]
            parts.append(np.column_stack([node[own], skin.body_of_node[i], skin.corners[i], forces]))
        both = np.concatenate(parts)
        there, arrived = config.send_to_owners(both[:, 0].astype(np.int64), both[:, 1:])
        active = np.flatnonzero(self.pair.trial.active)
        place = np.full(config.n_owned, -1)
        place[self.pair.nodes[active]] = active
        body = np.full(len(place), -1)
        body[self.pair.nodes[active]] = skin.values_at(self.pair.kinematics.projection.facet[active], skin.body)
        counts = (body[there] == arrived[:, 0]) & ((arrived[:, 1] > 0) | skin.corners[there])
        return sums_of_rows(place[there][counts], arrived[counts, 2:], len(self.pair.nodes))

    @property
    def sees_corners(self) -> bool:
        """False, since corners of all bodies are contactors themselves."""
        return False


class MortarContact(BodiesContact):
    """Part of a general contact: one target body with the facets, on smooth faces, of all bodies that follow it."""

    def __init__(self, contactor: Tag, target: Tag, body: Body, crossings: Crossings | None, order: int, **options: Any):
        super().__init__(contactor, target, coupling="mortar", **options)
        self._body, self._crossings, self._order = body, crossings, order

    def _sides(self, config: Configuration) -> tuple[Indices, Target]:
        return surface_nodes(config, self.contactor), self._body

    def _discretised(self, nodes: Indices, target: Any, **how: Any) -> tuple[Discretisation, None]:
        """Mortar discretisation with the body as target (collective)."""
        from uem_dolfinx.contact.general.mortar import AmongBodiesMortar

        surface = TargetFacets(self.config, self.contactor, "contactor")
        found = AmongBodiesMortar(self.config, nodes, target, surface=surface, of_gaps=self.normal is not None, **how)
        crossings, body = self._crossings, self._body

        def at_crossings(_: FacetProjection) -> Bools:
            """Which nodes are at crossings of edges with the body (collective)."""
            assert crossings is not None
            return crossings.hold(nodes, np.full(len(nodes), body.number), body.skin.n_bodies)

        if crossings is not None:
            found.leave(at_crossings, self._order)
        return found, None

    def edges_that_meet(self) -> Meeting:
        """Sharp edges of all bodies, without self-contact."""
        from uem_dolfinx.contact.warnings.edges_inside import Meeting

        return Meeting(self._skin, self._skin, self._body.apart, np.zeros(self._skin.n_bodies, dtype=bool))

    def on_skin(self, facet: Ints) -> Ints:
        """See ``BodiesContact``."""
        return np.asarray(self._body.of_facets(facet, self._body.numbers))

    def opposite(self, skin: Skin) -> Ints:
        """The one body, also for contactors without opposite facets, since rows of other contactors may contain them."""
        return np.full(len(self.pair.nodes), self._body.number)
