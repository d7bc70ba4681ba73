"""Common base of discretisations: contactors and their projection onto the target."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, cast

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.seam.ends import Ends, slide_off
from uem_dolfinx.contact.seam.placement import ContactRows, Kinematics, Setting, Traction, Traits
from uem_dolfinx.contact.seam.relative_motion import Ties
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import FacetProjection, Projection, Target
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import reduced


class OnTarget:
    """Contactors of one target.

    Args:
        nodes: owned contactor nodes ``(n,)``.
        target: target of the contactors.
        free: components without Dirichlet condition of all owned nodes ``(n_owned, gdim)``.
        sliding: ``"finite"`` projects at every placement, ``"small"`` once per step, ``"fixed"`` once.
        thickness: of the target's body, a length: contactors past its end and deeper than this lie behind the body.
        contactor: facets of the contactors, for discretisations that integrate over them.

    Attributes:
        free: components without Dirichlet condition of the contactors ``(n, gdim)``.
        setting: what is set for the contactors.
        anchor: projection whose closest points are kept, with small or fixed sliding.
        in_reach: whether any contactor on any rank was near the target in the last placement.
    """

    traits: Traits
    _leaves: Sequence[Callable[[FacetProjection], Bools]] = ()  # which contactors are left to other equations, see ``leave``

    def __init__(
        self, config: Configuration, nodes: Indices, target: Target, *, free: Bools, sliding: str, thickness: float = np.inf,
        contactor: Tag | None = None,
    ):  # fmt: skip
        self.config, self.nodes, self.target, self.sliding, self.thickness = config, nodes, target, sliding, thickness
        self.contactor = contactor
        self.traits, none = self.traits._replace(sliding=sliding), np.zeros(1, dtype=bool)
        self.setting = Setting(free, False, far=none, on=~none, mutual=none, label=np.zeros(len(nodes), dtype=np.int64))
        self.set(free=free)
        self.anchor: Projection | None = None
        self.in_reach = True
        self._renewing = False  # whether small sliding renews its closest points in the next step
        #: Last projection: positions of contactors and target, the anchor, and the result.
        self._projected: tuple[Array, Array, Projection | None, Projection] | None = None
        #: The same where the anchor's closest points were found; from there a step after a failed attempt begins again.
        self._at_feet: tuple[Array, Array, Projection | None, Projection] | None = None

    def set(self, **changed: Any) -> None:
        """Set parts of the setting but ``prescribed``; contactors must be placed again (collective)."""
        if "free" in changed:
            self.free = changed["free"][self.nodes]
            changed["prescribed"] = bool(reduced(self.config.comm, int(not self.free.all())))
        if changed.keys() & {"far", "offset"}:
            self._projected = self._at_feet = None
        self.setting = self.setting._replace(**changed)

    def leave(self, which: Callable[[FacetProjection], Bools], order: int) -> None:
        """Leave contactors, ``which (n,)`` by their projection (collective), to another contact; both share an order of bodies."""
        self._leaves, self.traits = [*self._leaves, which], self.traits._replace(order=order)

    def left(self, nearest: Projection) -> Bools | None:
        """Contactors that are left to other contacts ``(n,)``, by their nearest facets; None without (collective)."""
        left = [which(cast("FacetProjection", nearest)) for which in self._leaves]
        return np.any(left, axis=0) if left else None

    @property
    def offset(self) -> Array | None:
        """Additional thickness of both surfaces together at the contactors ``(n,)``; None without offset."""
        return self.setting.offset

    @property
    def followed(self) -> Indices:
        """Local nodes of the target, repeated or not ``(k,)``."""
        return self.target.dofs.ravel()

    def on_target(self, points: Array, anchor: Projection | None = None) -> Projection:
        """Projection onto the nearest points of the target, or with those of ``anchor``; reused if no node has moved (collective)."""
        if not self.target.n_nodes:
            return self.raised(self.target.project(points) if anchor is None else self.target.follow(points, anchor))
        x, last = self.config.x[self.target.dofs], self._projected
        same = last is not None and last[2] is anchor and np.array_equal(points, last[0]) and np.array_equal(x, last[1])
        if last is None or not reduced(self.config.comm, same, op=MPI.LAND):
            if (last := self._at_feet) is not None and last[2] is anchor:
                same = np.array_equal(points, last[0]) and np.array_equal(x, last[1])
                if reduced(self.config.comm, same, op=MPI.LAND):
                    return last[3]
            found = self.target.project(points) if anchor is None else self.target.follow(points, anchor)
            if anchor is None and self.offset is not None and isinstance(found, FacetProjection):
                found = self.across(found, points)
            if anchor is None:
                found = self._turning(found, points)
            raised = self.raised(found)
            self._projected = last = points, x, anchor, raised
        return last[3]

    def _turning(self, found: Any, points: Array) -> Any:
        """The projection with facets continued behind concave edges, so that gaps do not change to first order as all bodies turn."""
        if not (isinstance(found, FacetProjection) and self.target.faceted):
            return found
        behind = found.behind_edges(points)
        return self.target.continued(found, behind, points[behind]) if len(behind) else found

    def across(self, found: FacetProjection, points: Array) -> FacetProjection:
        """The projection of contactors with offset, with normals that point away from convex edges."""
        assert self.offset is not None
        return found.across_edges(points, self.offset)

    def take_feet(self, points: Array) -> Projection:
        """Projection onto the nearest points of the target, which are kept from now on (collective)."""
        self.anchor = found = self._turning(self.target.project(points), points)
        raised = self.raised(found)
        self._projected = self._at_feet = points, self.config.x[self.target.dofs], found, raised
        return raised

    def raised(self, projection: Any, which: Ints | None = None) -> Any:
        """The projection of all contactors, or of ``which (k,)``, with offsets subtracted from the gaps."""
        if self.offset is None:
            return projection
        offset = self.offset if which is None else self.offset[which]
        return replace(projection, gap=projection.height - offset, offset=offset)

    def ties(self, terms: tuple[Ints, Ints, Array], share: Array) -> Ties:
        """Relative motion with the weights ``terms`` and the ``share (n,)`` of friction, see ``Ties.of`` (collective)."""
        free = self.setting.free if self.setting.prescribed else None
        return Ties.of(self.config, self.nodes, terms, free, self.traits.at_feet, share)

    def spread(self, values: Array) -> Array:
        """The shape functions themselves."""
        return values

    def begin_step(self) -> None:
        """Begin a step: small sliding renews its closest points after every accepted step."""
        if self._renewing:
            self.let_go()

    def let_go(self) -> None:
        """Drop the kept closest points; the next placement finds new ones."""
        self.anchor, self._renewing = None, False

    def commit(self) -> None:
        """Accept a step: small sliding renews its closest points in the next step, on rigid targets at the next placement."""
        if self.sliding == "small":
            self._renewing = True
            if not self.target.n_nodes:
                self.let_go()


@dataclass(frozen=True)
class PlacedOnTarget:
    """Implements ``Kinematics`` from ``gap_rows``, ``pressure_map`` and ``ties``, for rows that are equal in every state."""

    of: OnTarget  # discretisation
    points: Array  # of the contactors ``(n, gdim)``
    projection: Projection  # of the contactors; onto the corner for contactors held by one
    nearest: Projection  # of the contactors, on their nearest facets
    gap: Array  # deciding gaps ``(n,)``

    @property
    def normal(self) -> Array:
        """Of the projection ``(n, gdim)``."""
        return self.projection.normal

    def follow(self: Kinematics, state: PairState, off: Bools) -> tuple[Kinematics, PairState]:
        """Release contactors; equations do not depend on a single facet."""
        return self, slide_off(state, off)

    @cached_property
    def ends(self) -> Ends:
        """Open ends, which hold no contactors here."""
        return Ends(self.projection, self.of.thickness)

    def heights(self) -> Array:
        """Those of the projection."""
        return self.projection.height

    def forces(
        self: Kinematics,
        state: PairState,
        rows: ContactRows,
        multipliers: Array,
        friction: Callable[[Array], Array] | None = None,
    ) -> Traction:
        """Forces of the rows, and friction by the weights, at both bodies, where contactors follow each other too (collective)."""
        of, mu = self.gap_rows, np.zeros(len(self.gap))
        mu[rows.contactor[rows.normal]] = multipliers[rows.normal]
        force = np.asarray(of.config.add_at_owners(*of.forces(mu))[of.equations.node])
        lam = mu * self.pressure_map(False).force
        found = Traction(lam, np.einsum("ng,ng->n", force, self.projection.normal), force)
        if friction is None:
            return found
        return found.with_friction(
            tau := friction(lam), self.ties, of.config.add_at_owners(*self.ties.handed_on(tau))[of.equations.node]
        )

    def nodal_forces(self: Kinematics, state: PairState) -> tuple[Ints, Array]:
        """Nodal forces of the state's multipliers by the rows, and of friction by the weights."""
        nodes, forces = self.gap_rows.forces(state.lam / self.pressure_map(False).force)
        if state.friction is None:
            return nodes, forces
        along = self.ties.handed_on(state.friction.tau / self.ties.share[:, None])
        return np.concatenate([nodes, along[0]]), np.concatenate([forces, along[1]])
