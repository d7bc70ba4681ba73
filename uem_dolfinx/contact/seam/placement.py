"""The seam of contact: a discretisation makes a value ``Kinematics`` of where contactors stand relative to their target.

An interface asks it for gaps, for rows of equations with the contactor and the kind of each, for forces from the rows' multipliers and
for their derivatives. How they come about it does not ask, so that nodes against facets, control gaps of quadratic surfaces, or
integrals over segments differ in nothing else. A law decides on gaps and forces, without knowing of rows.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple, Protocol

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.seam.pressure_map import PressureMap
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Halo
from uem_dolfinx.geometry.projection import Projection, Target

if TYPE_CHECKING:
    from uem_dolfinx.contact.seam.corners import Corners
    from uem_dolfinx.contact.seam.ends import Ends
    from uem_dolfinx.contact.seam.relative_motion import Ties

#: Kind of an equation along the contact normal; kind r is along the r-th further axis of a corner that holds the contactor.
#: [format; number of a kind; -]
NORMAL = 0


class Traction(NamedTuple):
    """Contact forces of the contactors of an interface.

    Attributes:
        lam: along the normal, that decides on contact ``(n,)``.
        nodal: of the node along the normal ``(n,)``.
        force: on the contactor ``(n, gdim)``.
        tau: friction that belongs to ``lam`` ``(n, gdim)``; None without friction.
        bond: multipliers of tied contactors' equations ``(n, gdim)``; None where nothing is ever tied.
        heat: power that goes from contactors to the target without a jump of temperatures, as of ``PairState``; None where none ever does.
    """

    lam: Array
    nodal: Array
    force: Array
    tau: Array | None = None
    bond: Array | None = None
    heat: Array | None = None


@dataclass(frozen=True)
class Constraints:
    """Uniting equations of one interface, each with its contactor and kind. Lists that do not differ are the same object.

    Attributes:
        trial: rows of P: how contactors move, ``du = P dq + c``.
        test: rows of Q: how contact forces are handed on, ``Q'r = 0``. Equations of both are in the same order and eliminate the same
            nodes.
        frictionless: test rows as they are without the friction of contactors that slip.
        resisting: trial rows of all relative motions that the contact resists.
        stopping: trial rows of the relative motions that the contact does not let go on without end.
        contactor: place of each equation's contactor among those of the interface ``(m,)``.
        kind: ``NORMAL``, or the number of a corner's further axis ``(m,)``.
        tangent: number of the direction along the target of equations by which friction holds, -1 for all others ``(m,)``.
    """

    trial: UnitingEquations
    test: UnitingEquations
    frictionless: UnitingEquations
    resisting: UnitingEquations
    stopping: UnitingEquations
    contactor: Ints
    kind: Ints
    tangent: Ints

    @classmethod
    def without_friction(cls, trial: UnitingEquations, test: UnitingEquations, contactor: Ints, kind: Ints) -> Constraints:
        """Equations across the target alone."""
        return cls(trial, test, test, trial, trial, contactor, kind, np.full(len(kind), -1))

    @property
    def tied(self) -> Bools:
        """Which of the equations hold for good ``(m,)``."""
        return np.zeros(len(self), dtype=bool)

    @property
    def contact(self) -> Constraints:
        """Those of contactors that touch, which come first."""
        return self

    def across(self) -> Constraints:
        """The test rows across the target alone, without friction."""
        which = self.tangent < 0
        rows = self.frictionless.select(which)
        return Constraints.without_friction(rows, rows, self.contactor[which], self.kind[which])

    def __len__(self) -> int:
        return len(self.contactor)


@dataclass(frozen=True)
class GapRows:
    """Gaps that decide on contact to first order: ``gap_i + scale_i (direction_i . du_i - sum_j C_ij . du_j)`` for every contactor.

    Rows along the contact normals come first, one for each contactor in their order; those of further axes of corners follow.

    Attributes:
        config: configuration of the displacement.
        equations: the uniting equations, ``gap / scale`` among them, with no row active ``(m,)``.
        scale: of the deciding gaps over those of the equations ``(n,)``.
        free: components of the contactors without Dirichlet condition ``(n, gdim)``.
        contactor: of each row ``(m,)``.
        kind: ``NORMAL``, or the number of a corner's further axis ``(m,)``.
        moved: rows of P where their weights differ from those of the gaps; None where they are the same.
    """

    config: Configuration
    equations: UnitingEquations
    scale: Array
    free: Bools
    contactor: Ints
    kind: Ints
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

    def along(self, values: Array) -> Array:
        """Left sides of the equations along the normals for ``values (n_owned, gdim)`` of the owned nodes: ``(n,)`` (collective)."""
        eq, n = self.equations, len(self.scale)
        theirs = np.einsum("kg,kg->k", eq.coefficients, self._halo.take(values.__getitem__))
        own = np.einsum("ng,ng->n", eq.direction[:n], values[eq.node[:n]])
        return np.asarray(own - np.bincount(eq.row, theirs, minlength=len(eq))[:n])

    def gaps(self, du: Array) -> Array:
        """Deciding gaps ``(n,)`` after an increment of the owned nodes ``(n_owned, gdim)``, to first order (collective)."""
        return np.asarray(self.scale * (self.equations.gap[: len(self.scale)] + self.along(du)))

    def forces(self, multipliers: Array) -> tuple[Ints, Array]:
        """Global nodes of both bodies ``(k,)``, and forces there ``(k, gdim)``, of multipliers of all rows ``(m,)``."""
        eq = self.equations
        own, terms = multipliers != 0, multipliers[eq.row] != 0
        nodes = np.concatenate([self.config.to_global(eq.node[own]), eq.followed[terms]])
        along, against = multipliers[own, None] * eq.direction[own], -multipliers[eq.row[terms], None] * eq.coefficients[terms]
        return nodes, np.concatenate([along, against])

    def select(self, which: Ints, active: Bools) -> Constraints:
        """Rows of the contactors ``which (k,)``, those of ``active (n,)`` contactors active."""
        chosen = np.zeros(len(self.scale), dtype=bool)
        chosen[which] = True
        rows = chosen[self.contactor]
        contactor = self.contactor[rows]
        test = replace(self.equations.select(rows), active=active[contactor])
        trial = test if self.moved is None else replace(self.moved.select(rows), active=test.active)
        return Constraints.without_friction(trial, test, contactor, self.kind[rows])

    def normal_return(self, active: Bools) -> Array:
        """Displacements of free components ``(n, gdim)`` that close the gaps of ``active (n,)`` contactors along their rows [UEM, 4.2]."""
        rows, found = np.flatnonzero(active[self.contactor]), np.zeros(self.free.shape)
        contactor = self.contactor[rows]
        normal = self.equations.direction[rows] * self.free[contactor]
        square = np.einsum("kg,kg->k", normal, normal)
        way = -self.equations.gap[rows] / np.where(square > MOSTLY_PRESCRIBED**2, square, np.inf)
        np.add.at(found, contactor, normal * way[:, None])
        return found


class Kinematics(Protocol):
    """Where contactors stand relative to their target, in one state and at one displacement: a value."""

    @property
    def points(self) -> Array:
        """Of the contactors ``(n, gdim)``."""

    @property
    def projection(self) -> Projection:
        """Of the contactors; those that a corner holds are in the corner."""

    @property
    def nearest(self) -> Projection:
        """Of the contactors, on their nearest facets."""

    @property
    def gap(self) -> Array:
        """That decides on contact ``(n,)``: of nodes, control gaps on a quadratic surface, or weighted ones."""

    @property
    def corners(self) -> Corners | None:
        """Of the target that hold contactors; None if no rank has any."""

    @property
    def normal(self) -> Array:
        """Unit vectors across which friction acts ``(n, gdim)``."""

    @property
    def movable(self) -> Bools:
        """Contactors whose gap can be closed, for all the Dirichlet conditions on both sides ``(n,)``."""

    @property
    def ties(self) -> Ties:
        """By what contactors follow other nodes, and how they move relative to these (first time: collective)."""

    @property
    def force_per_multiplier(self) -> Array:
        """Friction that belongs to ``lam`` over the multipliers of equations along the target ``(n,)`` (first time: collective)."""

    @property
    def cone(self) -> Array:
        """``lam`` over these times the multiplier of a contactor's equation along the normal ``(n,)`` (first time: collective)."""

    # -- the same contactors in another state ----------------------------------------------------------------------------

    def placed_again(self, state: PairState) -> Kinematics:
        """At the same points in another state (collective)."""

    def follow(self, state: PairState) -> tuple[Kinematics, PairState, bool]:
        """Follow contactors from facet to facet, into corners and out of them: whether equations change here (collective)."""

    # -- what decides ----------------------------------------------------------------------------------------------------

    @property
    def ends(self) -> Ends:
        """Where contactors stand relative to open ends of the target; made once."""

    # -- equations and forces --------------------------------------------------------------------------------------------

    @property
    def gap_rows(self) -> GapRows:
        """Of all contactors; made once."""

    def forces(self, state: PairState, equations: Constraints, multipliers: Array) -> Traction:
        """Contact forces across the target from the multipliers of equations ``(m,)`` (collective)."""

    def nodal_friction(self, tau: Array) -> Array:
        """Forces at the contactors of multipliers ``tau (n, gdim)`` of rows along the target ``(n, gdim)`` (collective)."""

    def nodal_forces(self, state: PairState) -> tuple[Ints, Array]:
        """The state's contact forces at nodes of both bodies: global nodes, repeated or not ``(k,)``, and forces ``(k, gdim)``."""

    def curvature(self, state: PairState) -> list[tuple[Ints, Array]]:
        """Blocks of ``-sum lambda grad^2 g``: lists of global nodes ``(k, m)`` and values ``(k, m gdim, m gdim)``."""

    def turning(self, state: PairState, which: Ints, tau: Array, held: Bools | None = None) -> list[tuple[Ints, Array]]:
        """Derivatives of forces of friction (collective).

        Args:
            state: of the interface.
            which: contactors, ascending; where forces act ``at_feet`` those alone that slip ``(k,)``.
            tau: their friction, as multipliers of rows along the target ``(k, gdim)``.
            held: those that stick, whose multipliers are kept rather than their coefficients of friction ``(k,)``; None if none do.

        Returns:
            Lists of global nodes, negative where there is none, and blocks, as of ``curvature``.
        """

    def pressure_map(self, current: bool) -> PressureMap:
        """From multipliers along normals to pressures, in the reference or the ``current`` configuration (collective)."""

    def heights(self) -> Array:
        """Of the contactors over the target ``(n,)``, which have the gaps that decide, but for offsets (collective)."""

    def means(self) -> tuple[tuple[Ints, Ints, Array], tuple[Ints, Ints, Array]]:
        """Of a field at the contactors, and of what is opposite: places, global nodes and weights, which add up to one (collective)."""


class Discretisation(Protocol):
    """Ties contactors to a target. It keeps the feet or segments of a contact with small sliding, and what holds for one step."""

    @property
    def offset(self) -> Array | None:
        """What gaps are less than heights ``(n,)``; None for nothing."""

    @property
    def target(self) -> Target:
        """What the contactors may touch."""

    @property
    def followed(self) -> Indices:
        """Local nodes that contactors may follow, repeated or not ``(k,)``."""

    @property
    def two_pass(self) -> bool:
        """Whether the target may be the contactor of another contact with these surfaces."""

    @property
    def pointwise(self) -> bool:
        """Whether each contactor follows the point of the target below it, rather than in a mean."""

    @property
    def at_feet(self) -> bool:
        """Whether contact forces act at the feet of the projection."""

    @property
    def ordered_by(self) -> int:
        """Number of the order in which bodies follow each other, which rows of this and others of that order keep; -1 without one."""

    @property
    def chained(self) -> bool:
        """Whether contactors may follow each other."""

    @property
    def prescribed(self) -> bool:
        """Whether any contactor on any rank has a Dirichlet condition."""

    #: Whether the surfaces are so far apart that contactors are not looked at.
    far: bool
    #: Whether any contactor on any rank is in question, as placed last; where none is no other function is called in an iteration.
    asked: bool

    def with_friction(self, mu: Array) -> None:
        """Keep what friction needs; ``mu (n,)`` are the slopes of the contactors' cones."""

    def spread(self, values: Array) -> Array:
        """Of integrals with the shape functions, those with functions that are nowhere negative ``(n,)`` (collective)."""

    def hold(self, free: Bools) -> None:
        """Take which components of the owned nodes have no Dirichlet condition ``(n_owned, gdim)``, to be followed by ``place``."""

    def set_offset(self, offset: Array | None) -> None:
        """Take what gaps are less than heights ``(n,)``; contactors are to be placed again."""

    def begin_step(self) -> None:
        """A step begins, for the first time or anew; contactors are placed again."""

    def look_farther(self) -> bool:
        """From the next placement on, find what is farther away, for bodies that fall: whether there may be more to be found."""

    def place(self, points: Array, state: PairState) -> Kinematics:
        """The only search: where contactors at ``points (n, gdim)`` stand (collective)."""

    def commit(self) -> None:
        """A step has been kept."""
