"""Interface between discretisations and contact: a discretisation makes an immutable ``Kinematics`` for each placement.

It contains gaps, rows of equations with their contactors and kinds, forces from the rows' multipliers, and their derivatives. Nodes
against facets, control gaps of quadratic surfaces, and integrals over segments have the same members. A contact law acts on gaps
and forces only, not on rows.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints, replace
from uem_dolfinx.contact.seam.pressure_map import PressureMap
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Halo
from uem_dolfinx.geometry.projection import Projection, Target

if TYPE_CHECKING:
    from uem_dolfinx.contact.seam.corners import Corners
    from uem_dolfinx.contact.seam.ends import Ends
    from uem_dolfinx.contact.seam.relative_motion import Terms, Ties

#: Kind of an equation along the contact normal; kind r is along the r-th further axis of a corner that holds the contactor.
#: [format; number of a kind; -]
NORMAL = 0


class Traction(NamedTuple):
    """Contact forces of the contactors of an interface."""

    lam: Array  # normal force that decides on contact ``(n,)``
    nodal: Array  # normal force at the node ``(n,)``
    force: Array  # on the contactor ``(n, gdim)``
    tau: Array | None = None  # friction that belongs to ``lam`` ``(n, gdim)``; None without friction
    bond: Array | None = None  # multipliers of tied contactors' equations ``(n, gdim)``; None without ties
    #: power from contactors to the target by perfect conductance, see ``PairState``; None without such conductances.
    heat: Array | None = None

    def with_friction(self, tau: Array, ties: Ties, force: Array) -> Traction:
        """With multipliers ``tau`` of tangential rows, and the ``force`` that they exert on contactors, each ``(n, gdim)``."""
        return self._replace(force=self.force + force, tau=tau * ties.share[:, None])


@dataclass(frozen=True)
class ContactRows:
    """Constraint equations of one interface or of several, each with its contactor. P and Q eliminate the same nodes."""

    #: Q without friction: gradients of the gaps, then directions along the target; active ones are eliminated ``(m,)``.
    rows: UnitingEquations
    contactor: Ints  # index of each row's contactor in its interface ``(m,)``; -1 for equations of users
    #: ``NORMAL``, or the number of a corner's further axis; ``-1 - c`` for component c of a permanent equation ``(m,)``.
    kind: Ints
    tangent: Ints  # number of the direction along the target, -1 for all other rows ``(m,)``
    moved: UnitingEquations | None = None  # rows of P if their weights or directions differ; None if P has the same rows
    #: what friction adds to the rows of slipping contactors in Q, zero for all others; None if no rank has any.
    tilt: UnitingEquations | None = None
    #: rows of relative motions that contact and friction resist ``(m,)``; None without friction, for the active ones.
    resisted: Bools | None = None
    #: rows across the slip of slipping contactors in 3D, for bodies that only contact holds; None without such.
    crosswise: UnitingEquations | None = None

    @classmethod
    def straight(cls, rows: UnitingEquations, contactor: Ints, kind: Ints, moved: UnitingEquations | None = None) -> ContactRows:
        """Rows without directions along the target."""
        return cls(rows, contactor, kind, np.full(len(rows), -1), moved)

    @classmethod
    def join(cls, parts: Sequence[ContactRows], more: Sequence[UnitingEquations], block: int) -> ContactRows:
        """All rows of several lists, followed by ``more`` equations of users."""
        parts = [*parts, *(cls.straight(e, *np.full((2, len(e)), -1)) for e in more)]
        if len(parts) == 1:
            return parts[0]
        none: list[Ints] = [np.zeros(0, np.int64)]
        join, crosswise = UnitingEquations.join, [p.crosswise for p in parts if p.crosswise is not None]
        moved, tilted = any([p.moved is not None for p in parts]), any([p.tilt is not None for p in parts])
        resisted = any([p.resisted is not None for p in parts])
        return cls(
            join([p.rows for p in parts], block),
            np.concatenate(none + [p.contactor for p in parts]),
            np.concatenate(none + [p.kind for p in parts]),
            np.concatenate(none + [p.tangent for p in parts]),
            moved=join([p.P for p in parts], block) if moved else None,
            tilt=join([p.tilt or without_terms(p.rows) for p in parts], block) if tilted else None,
            resisted=np.concatenate([p.resisting.active for p in parts]) if resisted else None,
            crosswise=join(crosswise, block) if crosswise else None,
        )

    @property
    def P(self) -> UnitingEquations:
        """Rows for the motion of contactors, ``du = P dq + c``."""
        return self.rows if self.moved is None else self.moved

    @cached_property
    def Q(self) -> UnitingEquations:
        """Rows for the distribution of contact forces, ``Q'r = 0``."""
        r, t = self.rows, self.tilt
        if t is None:
            return r
        return replace(
            r,
            direction=r.direction + t.direction,
            row=np.concatenate([r.row, t.row]),
            followed=np.concatenate([r.followed, t.followed]),
            coefficients=np.concatenate([r.coefficients, t.coefficients]),
        )

    @property
    def resisting(self) -> UnitingEquations:
        """Rows for all relative motions that contact and friction resist."""
        return self.rows if self.resisted is None else replace(self.rows, active=self.resisted)

    @property
    def stopping(self) -> UnitingEquations:
        """Rows that restrain rigid-body motions, those of gaps last."""
        return (
            self.rows
            if self.crosswise is None
            else UnitingEquations.join([self.crosswise, self.rows], self.rows.direction.shape[1])
        )

    @cached_property
    def normal(self) -> Bools:
        """Rows along contact normals ``(m,)``."""
        return (self.kind == NORMAL) & (self.tangent < 0)

    @property
    def permanent(self) -> Bools:
        """Rows of tied contactors and of users ``(m,)``."""
        return self.kind < 0

    def __len__(self) -> int:
        return len(self.rows)


def without_terms(rows: UnitingEquations) -> UnitingEquations:
    """As many rows at the same nodes, with zero directions and no terms."""
    none = rows.select(np.zeros(len(rows), bool))
    return replace(rows, direction=0.0 * rows.direction, row=none.row, followed=none.followed, coefficients=none.coefficients)


@dataclass(frozen=True)
class GapRows:
    """Deciding gaps to first order: ``gap_i + scale_i (direction_i . du_i - sum_j C_ij . du_j)`` for every contactor.

    Rows along the contact normals come first, one for each contactor in their order; those of further axes of corners follow.
    """

    config: Configuration
    equations: UnitingEquations  # the constraint equations with gaps ``gap / scale``, all inactive ``(m,)``
    scale: Array  # deciding gaps over the gaps of the equations ``(n,)``
    free: Bools  # components of the contactors without Dirichlet condition ``(n, gdim)``
    contactor: Ints  # of each row ``(m,)``
    kind: Ints  # ``NORMAL``, or the number of a corner's further axis ``(m,)``
    #: rows of P if they are others, with weights of chords or along the facets' normals; None if they are equal.
    moved: UnitingEquations | None = None

    @classmethod
    def along_normals(cls, config: Configuration, equations: UnitingEquations, scale: Array, free: Bools) -> GapRows:
        """One row for each contactor."""
        n = len(equations)
        return cls(config, equations, scale, free, np.arange(n), np.full(n, NORMAL))

    @cached_property
    def _halo(self) -> Halo:
        """The followed nodes (first time: collective)."""
        return Halo(self.config, self.equations.followed)

    def along(self, values: Array, rows: UnitingEquations | None = None) -> Array:
        """Left sides of the equations, or of other ``rows``, for ``values (n_owned, gdim)`` of the owned nodes: ``(n,)`` (collective)."""
        eq, n = rows or self.equations, len(self.scale)
        theirs = np.einsum("kg,kg->k", eq.coefficients, self._halo.take(values.__getitem__))
        own = np.einsum("ng,ng->n", eq.direction[:n], values[eq.node[:n]])
        return np.asarray(own - np.bincount(eq.row, theirs, minlength=len(eq))[:n])

    def gaps(self, du: Array) -> Array:
        """Deciding gaps ``(n,)`` after an increment of the owned nodes ``(n_owned, gdim)``, to first order (collective)."""
        return np.asarray(self.scale * (self.equations.gap[: len(self.scale)] + self.along(du, self.moved)))

    @property
    def gradients(self) -> Terms:
        """Gradients of the gaps of all equations, as terms of both bodies."""
        from uem_dolfinx.contact.seam.relative_motion import Terms

        eq = self.equations
        row, node = np.append(np.arange(len(eq)), eq.row), np.append(self.config.to_global(eq.node), eq.followed)
        return Terms(row, node, np.concatenate([eq.direction, -eq.coefficients]))

    def forces(self, multipliers: Array) -> tuple[Ints, Array]:
        """Global nodes of both bodies ``(k,)``, and forces there ``(k, gdim)``, of multipliers of all rows ``(m,)``."""
        eq = self.equations
        own, terms = multipliers != 0, multipliers[eq.row] != 0
        nodes = np.concatenate([self.config.to_global(eq.node[own]), eq.followed[terms]])
        along, against = multipliers[own, None] * eq.direction[own], -multipliers[eq.row[terms], None] * eq.coefficients[terms]
        return nodes, np.concatenate([along, against])

    def select(self, which: Ints, active: Bools) -> ContactRows:
        """Rows of the contactors ``which (k,)``; rows of ``active (n,)`` contactors are active."""
        chosen = np.zeros(len(self.scale), dtype=bool)
        chosen[which] = True
        rows = chosen[self.contactor]
        contactor = self.contactor[rows]
        along = replace(self.equations.select(rows), active=active[contactor])
        moved = None if self.moved is None else replace(self.moved.select(rows), active=along.active)
        return ContactRows.straight(along, contactor, self.kind[rows], moved)

    def normal_return(self, active: Bools) -> Array:
        """Displacements of free components ``(n, gdim)`` that close the gaps of ``active (n,)`` contactors along their rows [UEM, 4.2]."""
        rows, found = np.flatnonzero(active[self.contactor]), np.zeros(self.free.shape)
        contactor = self.contactor[rows]
        normal = self.equations.direction[rows] * self.free[contactor]
        square = np.einsum("kg,kg->k", normal, normal)
        way = -self.equations.gap[rows] / np.where(square > MOSTLY_PRESCRIBED**2, square, np.inf)
        np.add.at(found, contactor, normal * way[:, None])
        return found


class Along(NamedTuple):
    """Friction forces whose derivatives are part of the curvature."""

    which: Ints  # contactors, ascending; with ``at_feet`` only slipping ones ``(k,)``
    tau: Array  # their friction, as multipliers of tangential rows ``(k, gdim)``
    held: Bools  # sticking contactors, with constant multipliers instead of a constant coefficient of friction ``(k,)``


class Kinematics(Protocol):
    """Position of contactors relative to their target, in one state and at one displacement; immutable."""

    @property
    def projection(self) -> Projection:
        """Projection of the contactors; onto the corner for contactors held by one."""

    @property
    def nearest(self) -> Projection:
        """Projection of the contactors onto their nearest facets."""

    @property
    def gap(self) -> Array:
        """Deciding gaps ``(n,)``: nodal gaps, control gaps on a quadratic surface, or weighted gaps."""

    @property
    def corners(self) -> Corners | None:
        """Corners of the target that hold contactors; None if no rank has such a corner."""

    @property
    def normal(self) -> Array:
        """Unit normals of the planes in which friction acts ``(n, gdim)``."""

    @property
    def movable(self) -> Bools:
        """Contactors whose gap can be closed despite the Dirichlet conditions on both sides ``(n,)``."""

    @property
    def ties(self) -> Ties:
        """Weights by which contactors follow other nodes, and their relative motion (first time: collective)."""

    def follow(self, state: PairState, off: Bools) -> tuple[Kinematics, PairState]:
        """Release contactors ``off (n,)`` the target, follow others from facet to facet, into and out of corners (collective).

        Returns kinematics at the same points, the same object on all ranks unless equations change, and the state.
        """

    @property
    def ends(self) -> Ends:
        """Position of contactors relative to open ends of the target; made once."""

    @property
    def gap_rows(self) -> GapRows:
        """Rows of all contactors; made once."""

    def forces(
        self, state: PairState, rows: ContactRows, multipliers: Array, friction: Callable[[Array], Array] | None = None
    ) -> Traction:
        """Contact forces (collective).

        Args:
            state: of the interface.
            rows: equations of the interface.
            multipliers: of the rows, of which only those across the target count ``(m,)``.
            friction: function of the normal forces ``lam (n,)`` that returns the multipliers of tangential rows ``(n, gdim)``; or None.
        """

    def nodal_forces(self, state: PairState) -> tuple[Ints, Array]:
        """The state's contact forces at nodes of both bodies: global nodes, repeated or not ``(k,)``, and forces ``(k, gdim)``."""

    def curvature(self, state: PairState, along: Along | None = None) -> list[tuple[Ints, Array]]:
        """Blocks of ``-sum lambda grad^2 g``, followed by those of friction (collective).

        Args:
            state: of the interface.
            along: friction whose rows turn; None without.

        Returns:
            Lists of global nodes, negative for no node ``(k, m)``, and values ``(k, m gdim, m gdim)``.
        """

    def pressure_map(self, current: bool) -> PressureMap:
        """From multipliers along normals to pressures, in the reference or the ``current`` configuration (collective)."""

    def heights(self) -> Array:
        """Heights of the contactors over the target ``(n,)``: deciding gaps without offsets (collective)."""

    def means(self) -> tuple[tuple[Ints, Ints, Array], tuple[Ints, Ints, Array]]:
        """Means of a field at contactors, and on the opposite side: indices, global nodes and weights of sum 1 (collective)."""


class Traits(NamedTuple):
    """Properties of a discretisation that no placement changes."""

    at_feet: bool  # whether contact forces act at the closest points of the projection
    pointwise: bool  # whether each contactor follows the point of the target below it, not a mean
    chained: bool  # whether contactors may follow each other
    two_pass: bool  # whether the target may be the contactor of another contact with these surfaces
    order: int = -1  # number of the order of bodies that the rows of this and other contacts respect; -1 without an order
    sliding: str = "finite"  # ``"finite"``, ``"small"`` or ``"fixed"``


class Setting(NamedTuple):
    """What is set for the contactors of a discretisation, for all placements until a part is set anew."""

    free: Bools  # components of all owned nodes without Dirichlet condition ``(n_owned, gdim)``
    prescribed: bool  # whether any contactor on any rank has a Dirichlet condition
    #: contacts whose surfaces are separated, so that their contactors are skipped, see ``solve.bodies.far_apart`` ``(n_contacts,)``.
    far: Bools
    on: Bools  # contacts that are switched on; contactors of others are left out ``(n_contacts,)``
    mutual: Bools  # contacts whose contactors and target follow each other (two-pass) ``(n_contacts,)``
    label: Ints  # number of the contact of each contactor ``(n,)``
    offset: Array | None = None  # heights minus gaps ``(n,)``; None without offset
    #: slopes of the contactors' cones of friction ``(n,)`` at normal forces ``(n,)``; None without friction.
    cones: Callable[[Array], Array] | None = None


class Discretisation(Protocol):
    """Relates contactors to a target. It keeps closest points or segments for small sliding, and data of one step."""

    @property
    def setting(self) -> Setting:
        """What is set for its contactors."""

    @property
    def target(self) -> Target:
        """Target of the contactors."""

    @property
    def followed(self) -> Indices:
        """Local nodes that contactors may follow, repeated or not ``(k,)``."""

    @property
    def traits(self) -> Traits:
        """Properties that no placement changes."""

    #: Whether any contactor on any rank was near the target in the last placement; otherwise no other function is called.
    in_reach: bool

    def set(self, **changed: Any) -> None:
        """Set parts of the setting but ``prescribed``; contactors must be placed again (collective)."""

    def spread(self, values: Array) -> Array:
        """Integrals with non-negative functions, from integrals with the shape functions ``(n,)`` (collective)."""

    def begin_step(self) -> None:
        """Begin a step, or repeat it; contactors are placed again."""

    def place(self, points: Array, state: PairState) -> Kinematics:
        """Search the target for contactors at ``points (n, gdim)`` (collective)."""

    def commit(self) -> None:
        """Accept a step."""
