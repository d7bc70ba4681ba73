"""Contactors and the target that they are searched on, whatever their gaps are."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.seam.ends import Ends
from uem_dolfinx.contact.seam.placement import Constraints, Kinematics, Traction
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import FacetProjection, Projection, Target
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import reduced


class OnTarget:
    """Contactors of one target.

    Args:
        config: configuration of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        target: what they may touch.
        free: components without Dirichlet condition of all owned nodes ``(n_owned, gdim)``.
        sliding: ``"finite"`` projects at every placement, ``"small"`` once per step, ``"fixed"`` once.
        thickness: of the target's body, a length: what has passed its end and is deeper than this lies behind it.
        contactor: facets of the contactors, for discretisations that integrate over them.

    Attributes:
        free: components without Dirichlet condition of the contactors ``(n, gdim)``.
        free_of_owned: of all owned nodes.
        prescribed: whether any contactor on any rank has a Dirichlet condition.
        frictional: whether there is friction.
        anchor: projection whose feet a contact with small or fixed sliding keeps.
        offset: by how much both surfaces together are taken to be thicker at the contactors ``(n,)``; None for nothing.
        far: whether the surfaces are so far apart that contactors are not looked at, see ``solve.bodies.far_apart``.
        asked: whether any contactor on any rank is in question, as placed last.
    """

    ordered_by = -1

    def __init__(
        self, config: Configuration, nodes: Indices, target: Target, *, free: Bools, sliding: str, thickness: float = np.inf,
        contactor: Tag | None = None,
    ):  # fmt: skip
        self.config, self.nodes, self.target, self.sliding, self.thickness = config, nodes, target, sliding, thickness
        self.contactor, self.frictional = contactor, False
        self.hold(free)
        self.anchor: Projection | None = None
        self.offset: Array | None = None
        self.far, self.asked = False, True
        #: Whether the next step finds feet of small sliding anew.
        self._renewing = False
        #: Positions of contactors and target when they were last projected, the feet that were kept, and what came of it.
        self._projected: tuple[Array, Array, Projection | None, Projection] | None = None

    def hold(self, free: Bools) -> None:
        """Take which components of the owned nodes have no Dirichlet condition ``(n_owned, gdim)``; see ``Discretisation`` (collective)."""
        self.free, self.free_of_owned = free[self.nodes], free
        self.prescribed = bool(reduced(self.config.comm, int(not self.free.all())))

    def with_friction(self, mu: Array) -> None:
        """Keep what friction needs; ``mu (n,)`` are the slopes of the contactors' cones."""
        self.frictional = True

    @property
    def followed(self) -> Indices:
        """Local nodes of the target, repeated or not ``(k,)``."""
        return self.target.dofs.ravel()

    def on_target(self, points: Array, anchor: Projection | None = None) -> Projection:
        """The contactors on the nearest places of the target, or with the feet of ``anchor``; as before if nothing moved (collective)."""
        if not self.target.n_nodes:
            return self.raised(self.target.project(points) if anchor is None else self.target.follow(points, anchor))
        x, last = self.config.x[self.target.dofs], self._projected
        same = last is not None and last[2] is anchor and np.array_equal(points, last[0]) and np.array_equal(x, last[1])
        if last is None or not reduced(self.config.comm, same, op=MPI.LAND):
            found = self.target.project(points) if anchor is None else self.target.follow(points, anchor)
            if anchor is None and self.offset is not None and isinstance(found, FacetProjection):
                found = self.across(found, points)
            raised = self.raised(found)
            self._projected = last = points, x, anchor, raised
        return last[3]

    def across(self, found: FacetProjection, points: Array) -> FacetProjection:
        """The projection of contactors that stay at a height, with normals along the way from convex edges."""
        assert self.offset is not None
        return found.across_edges(points, self.offset)

    def take_feet(self, points: Array) -> Projection:
        """The contactors on the nearest places of the target, whose feet are kept from now on (collective)."""
        self.anchor = found = self.target.project(points)
        raised = self.raised(found)
        self._projected = points, self.config.x[self.target.dofs], found, raised
        return raised

    def raised(self, projection: Any, which: Ints | None = None) -> Any:
        """The projection of all contactors, or of ``which (k,)``, with gaps less their offsets."""
        if self.offset is None:
            return projection
        offset = self.offset if which is None else self.offset[which]
        return replace(projection, gap=projection.height - offset, offset=offset)

    def spread(self, values: Array) -> Array:
        """The shape functions themselves."""
        return values

    def set_offset(self, offset: Array | None) -> None:
        """Take other offsets ``(n,)``; contactors are to be placed again."""
        self.offset, self._projected = offset, None

    def begin_step(self) -> None:
        """Small sliding finds its feet anew in every step that follows one that was kept."""
        if self._renewing:
            self.let_go()

    def look_farther(self) -> bool:
        """Look at surfaces that are far apart, from the next placement on: whether they were."""
        was, self.far = self.far, False
        return was

    def let_go(self) -> None:
        """Keep no feet: the next placement finds them."""
        self.anchor, self._renewing = None, False

    def commit(self) -> None:
        """The next step is to find the feet anew; a rigid target that it moves is asked for them before."""
        # contactors may be taken to where they were before
        self.far = False
        if self.sliding == "small":
            self._renewing = True
            if not self.target.n_nodes:
                self.let_go()


@dataclass(frozen=True)
class PlacedOnTarget:
    """Implements ``Kinematics`` as far as ``gap_rows``, ``pressure_map`` and ``ties`` tell, for rows that are the same in every state.

    Attributes:
        of: what ties the contactors to their target.
        points: of the contactors ``(n, gdim)``.
        projection: of the contactors; where a corner holds some, of the corner.
        nearest: of the contactors, on their nearest facets.
        gap: that decides on contact ``(n,)``.
    """

    of: OnTarget
    points: Array
    projection: Projection
    nearest: Projection
    gap: Array

    @property
    def normal(self) -> Array:
        """Of the projection ``(n, gdim)``."""
        return self.projection.normal

    def placed_again(self: Kinematics, state: PairState) -> Kinematics:
        """No equation depends on the state."""
        return self

    def follow(self: Kinematics, state: PairState) -> tuple[Kinematics, PairState, bool]:
        """There is no bend to follow contactors across."""
        return self, state, False

    @cached_property
    def ends(self) -> Ends:
        """They hold no contactors."""
        return Ends(self.projection, self.of.thickness)

    def forces(self: Kinematics, state: PairState, equations: Constraints, multipliers: Array) -> Traction:
        """Forces of the rows at both bodies, where contactors follow each other too (collective)."""
        rows, mu = self.gap_rows, np.zeros(len(self.points))
        mu[equations.contactor] = multipliers
        force = np.asarray(rows.config.add_at_owners(*rows.forces(mu))[rows.equations.node])
        lam = mu * self.pressure_map(False).force
        return Traction(lam, np.einsum("ng,ng->n", force, self.projection.normal), force)

    def nodal_friction(self: Kinematics, tau: Array) -> Array:
        """Of the weights, on both sides of contactors that follow each other (collective)."""
        rows = self.gap_rows
        return np.asarray(rows.config.add_at_owners(*self.ties.handed_on(tau))[rows.equations.node])

    def nodal_forces(self: Kinematics, state: PairState) -> tuple[Ints, Array]:
        """Of the state's multipliers, by the rows, and of friction by the weights."""
        nodes, forces = self.gap_rows.forces(state.lam / self.pressure_map(False).force)
        if state.friction is None:
            return nodes, forces
        along = self.ties.handed_on(state.friction.tau / self.force_per_multiplier[:, None])
        return np.concatenate([nodes, along[0]]), np.concatenate([forces, along[1]])
