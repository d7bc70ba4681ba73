"""The seam of contact: a coupling ties contactors to one target, and says so in uniting equations.

A pair asks its coupling, state by state, for gaps, for equations with the contactor and the kind of each, for contact forces from the
equations' multipliers, and for the curvature of the contact. It never asks how they come about, so that nodes against facets, control
gaps of quadratic surfaces, or integrals over segments differ in nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.geometry.projection import Projection, Target

#: Kind of an equation along the contact normal; kind r is along the r-th further axis of a corner that holds the contactor.
#: [format; number of a kind; -]
NORMAL = 0


@dataclass(frozen=True)
class LabelledEquations:
    """Uniting equations of one pair, each with its contactor and kind.

    Attributes:
        trial: rows of P: how contactors move, ``du = P dq + c``.
        test: rows of Q: how contact forces are handed on, ``Q'r = 0``; the same object unless the two differ. Equations of both are
            in the same order and eliminate the same nodes.
        contactor: place of each equation's contactor among the pair's ``(m,)``.
        kind: ``NORMAL``, the number of a corner's further axis, or minus the number of a tangent along which friction holds ``(m,)``.
        untilted: test rows as they are without the friction of contactors that slip; None where ``test`` is not tilted.
        holding: trial rows, of which those that friction resists are active as well; None where there is no friction.
        turning: trial rows, and those across the directions of slip, in which friction resists as well; None where there is no friction.
    """

    trial: UnitingEquations
    test: UnitingEquations
    contactor: Ints
    kind: Ints
    untilted: UnitingEquations | None = None
    holding: UnitingEquations | None = None
    turning: UnitingEquations | None = None

    def __len__(self) -> int:
        return len(self.contactor)

    @property
    def upright(self) -> UnitingEquations:
        """Test rows without the friction of contactors that slip."""
        return self.test if self.untilted is None else self.untilted

    @property
    def resisting(self) -> UnitingEquations:
        """Rows of all relative motions that the contact resists."""
        return self.trial if self.holding is None else self.holding

    @property
    def stopping(self) -> UnitingEquations:
        """Rows of the relative motions that the contact does not let go on without end."""
        return self.trial if self.turning is None else self.turning


@dataclass(frozen=True)
class Placement:
    """Where contactors stand relative to their target, in one state and at one displacement.

    Attributes:
        projection: of the contactors; those that a corner holds are in the corner.
        gap: that decides on contact ``(n,)``: the nodal gap, or the control gap on a quadratic surface.
        target_moves: whether the target can move along the normal ``(n,)``; None where no contactor is prescribed.
        details: what else the coupling keeps of it.
    """

    projection: Projection
    gap: Array
    target_moves: Bools | None
    details: Any


class Coupling(Protocol):
    """Ties contactors to a target. States are handed in and out; nothing of them is kept."""

    target: Target
    #: Whether the target may be the contactor of another contact with these surfaces.
    two_pass: bool

    @property
    def followed(self) -> Indices:
        """Local nodes that contactors may follow, repeated or not ``(k,)``."""

    @property
    def chained(self) -> bool:
        """Whether contactors may follow each other."""

    @property
    def prescribed(self) -> bool:
        """Whether any contactor on any rank has a Dirichlet condition."""

    def with_nodal_gaps(self) -> Coupling:
        """The same contactors and target with nodal gaps, for methods that push nodes."""

    @property
    def nodal(self) -> bool:
        """Whether each contactor follows the point of the target below it, rather than in a mean."""

    @property
    def at_feet(self) -> bool:
        """Whether contact forces act at the feet of the projection."""

    def rub(self, mu: Array) -> None:
        """Take the contactors' coefficients of friction ``(n,)``."""

    def place(self, points: Array, state: PairState) -> Placement:
        """Project contactors at ``points (n, gdim)`` (collective)."""

    def place_again(self, placement: Placement, points: Array, state: PairState) -> Placement:
        """The placement at the same points in another state (collective)."""

    def with_active(self, placement: Placement, state: PairState) -> Placement:
        """The placement in a state of which only the active set is another (collective)."""

    def returned(self, placement: Placement, points: Array, state: PairState, gap: Array) -> Placement:
        """The placement after the normal return to ``points``, which left the nodal gaps ``gap (n,)`` (collective)."""

    def foreseen(self, placement: Placement, du: Array) -> Array:
        """Gaps that decide on contact, to first order in an increment of the owned nodes ``(n_owned, gdim)``: ``(n,)`` (collective)."""

    def weights(self, placement: Placement) -> tuple[Ints, Ints, Array]:
        """By what contactors follow other nodes: places of contactors, global nodes and weights, ``(k,)`` each (collective)."""

    def driven(self, placement: Placement, way: Array) -> Array:
        """How far an increment ``(n_owned, gdim)`` takes prescribed components over the target ``(n, gdim)``; free ones 0 (collective)."""

    def shares(self, placement: Placement, state: PairState) -> Array:
        """What ``lam`` is of the multiplier that friction at its limit is mu times ``(n,)`` (collective)."""

    def tilts(self, placement: Placement, state: PairState) -> Array:
        """Friction at its limit, over mu times the multiplier of a contactor's equation along the normal ``(n,)`` (collective)."""

    def normals(self, placement: Placement, state: PairState) -> Array:
        """Unit vectors across which friction acts ``(n, gdim)`` (collective)."""

    def off(self, placement: Placement, state: PairState) -> Bools:
        """Contactors that have slid past an end of the target ``(n,)``."""

    def at_end(self, placement: Placement, state: PairState) -> Bools:
        """Contactors that an end of the target holds in the next step ``(n,)``."""

    def movable(self, placement: Placement) -> Bools:
        """Contactors whose gap can be closed, for all the Dirichlet conditions on both sides ``(n,)``."""

    def change_facets(self, placement: Placement, points: Array, state: PairState) -> tuple[Placement, PairState, bool]:
        """Follow contactors across bends and corners: whether equations change here (collective)."""

    def return_vectors(self, placement: Placement, points: Array, state: PairState) -> Array:
        """Displacements that put the active contactors back onto the target [UEM, 4.2], zero for others ``(n, gdim)``."""

    def near(self, placement: Placement, state: PairState) -> Bools:
        """Contactors so near that a row in the sparsity of P pays ``(n,)``."""

    def approach(self, placement: Placement, which: Ints) -> UnitingEquations:
        """The equations that the contactors ``which (k,)`` would have if they were active."""

    def equations(self, placement: Placement, points: Array, state: PairState, which: Ints) -> LabelledEquations:
        """Uniting equations of the contactors ``which (k,)``; those of inactive ones only keep their place."""

    def forces(
        self, placement: Placement, state: PairState, equations: LabelledEquations, multipliers: Array
    ) -> tuple[Array, Array, Array]:
        """``lam``, ``nodal`` and ``force`` of a state from the multipliers of its equations ``(m,)`` (collective)."""

    def nodal_forces(self, placement: Placement, state: PairState) -> tuple[Ints, Array]:
        """The state's contact forces at nodes of both bodies: global nodes, repeated or not ``(k,)``, and forces ``(k, gdim)``."""

    def curvature(self, placement: Placement, state: PairState) -> tuple[Ints, Array]:
        """Blocks of ``-sum lambda grad^2 g``: global nodes ``(k, 1 + nn)``, values ``(k, (1 + nn) gdim, (1 + nn) gdim)``."""

    def turning(self, placement: Placement, state: PairState, which: Ints, tau: Array) -> list[tuple[Ints, Array]]:
        """Derivatives of the forces of friction of contactors that slip (collective).

        Args:
            placement: of the contactors.
            state: of the pair.
            which: contactors that slip and push, ascending ``(k,)``.
            tau: their friction, as multipliers of rows along the target ``(k, gdim)``.

        Returns:
            Lists of global nodes, negative where there is none, and blocks, as of ``curvature``.
        """

    def areas(self, placement: Placement, areas: Array) -> Array:
        """What ``lam`` is an integral of the pressure over, from the integrals of the shape functions ``(n,)`` (collective)."""

    def commit(self) -> None:
        """A step has been kept."""
