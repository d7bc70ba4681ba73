"""A contact pair: contactor nodes and what couples them to their target. It projects, returns and commits.

A pair keeps a trial state that changes with every iteration and a committed one that changes only after convergence.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact import active_set
from uem_dolfinx.contact.coupling import NORMAL, Coupling, LabelledEquations, Placement
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.errors import NotFiniteError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import Projection, Target
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import agree

#: A normal return may change nodal forces by this part of the largest contact force.
#: [heuristic; largest contact force; -]
GENTLE = 0.1


class ContactPair:
    """Contactors against one target.

    Args:
        config: configuration of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        coupling: what ties them to their target.
        name: for messages.
        sliding: ``"finite"``, ``"small"`` or ``"fixed"``.
        max_penetration: bound on the initial penetration, a length.
        thickness: of the target's body, a length.

    Attributes:
        trial: state of the present iteration.
        committed: state of the last step.
        placement: of the contactors, for the trial state; known after ``project``.
        initial_overlap: depth of the deepest contactor inside the target before the first step, a length.
        redundant: active contactors whose equations depend on others and were left out ``(n,)``.
        reserved: contactors that have rows in the sparsity of P ``(n,)``.
        barred: contactors that came back into the target from beside it with a blow; they are left out until they are in front of it
            again ``(n,)``.
        mutual: whether contactor and target follow each other (two-pass).
    """

    placement: Placement
    #: Whether there is friction.
    rough = False

    def __init__(
        self,
        config: Configuration,
        nodes: Indices,
        coupling: Coupling,
        *,
        name: str,
        sliding: str,
        max_penetration: float,
        thickness: float = np.inf,
    ):
        self.config, self.nodes, self.coupling, self.name = config, nodes, coupling, name
        self.sliding, self.max_penetration, self.thickness = sliding, max_penetration, thickness
        self.trial = self.committed = PairState.initial(len(nodes), config.gdim)
        self.initial_overlap, self.mutual = 0.0, False
        self.redundant: Bools = np.zeros(len(nodes), dtype=bool)
        self.reserved: Bools = np.zeros(len(nodes), dtype=bool)
        self.barred: Bools = np.zeros(len(nodes), dtype=bool)

    @property
    def target(self) -> Target:
        """What the contactors may touch."""
        return self.coupling.target

    @property
    def points(self) -> Array:
        """Current positions of the contactors ``(n, gdim)``."""
        return self.config.X[self.nodes] + self.config.displacement[self.nodes]

    # -- where the contactors stand --------------------------------------------------------------------------------------

    @timed("projection")
    def project(self) -> None:
        """Project the contactors onto the target where both are now (collective).

        Raises:
            NotFiniteError: if the target's functions return what is not finite.
        """
        self.placement = self.coupling.place(self.points, self.trial)
        p = self.projection
        bad = np.flatnonzero(~(np.isfinite(p.gap) & np.isfinite(p.normal).all(axis=1)))
        error = None
        if len(bad):
            error = NotFiniteError(
                f"{self.name}: gap {p.gap[bad[0]]}, normal {p.normal[bad[0]]} at {self.config.describe(int(self.nodes[bad[0]]))}: "
                "distance and gradient of the target must be finite, and the gradient must not vanish, near the contactors"
            )
        agree(self.config.comm, error)

    @property
    def projection(self) -> Projection:
        """Of the contactors, as last placed."""
        return self.placement.projection

    @property
    def gap(self) -> Array:
        """Gaps that decide on contact ``(n,)``: nodal gaps, or control gaps on a degree-2 surface."""
        return self.placement.gap

    @property
    def off(self) -> Bools:
        """Contactors that have slid past an end of the target, and are not taken back yet ``(n,)``."""
        return self.coupling.off(self.placement, self.trial) | self.barred

    @property
    def movable(self) -> Bools:
        """Contactors whose gap can be closed, for all the Dirichlet conditions ``(n,)``."""
        return self.coupling.movable(self.placement)

    def return_to_target(self, stiffness: Array) -> None:
        """Normal return [UEM, 4.2]: put the active contactors back onto the moved target (collective).

        A return that would disturb the contact forces is left to the next linear solve, which moves the whole body with it.

        Args:
            stiffness: diagonal of K at the owned nodes ``(n_owned, gdim)``, a force per length.
        """
        correction = self._return_vectors()
        disturbance = np.abs(stiffness[self.nodes] * correction).max(axis=1)
        largest = self.config.comm.allreduce(float(self.trial.lam.max(initial=0.0)), op=MPI.MAX)
        correction[disturbance > GENTLE * largest] = 0.0
        self.config.displacement[self.nodes] += correction
        gap = self.projection.gap + np.einsum("ng,ng->n", correction, self.projection.normal)
        self.placement = self.coupling.returned(self.placement, self.points, self.trial, gap)

    def _return_vectors(self) -> Array:
        """Displacements that put the active contactors back onto the target ``(n, gdim)`` (collective)."""
        return self.coupling.return_vectors(self.placement, self.points, self.trial)

    @property
    def n_active(self) -> int:
        """Number of active contactors over all ranks (collective)."""
        return int(self.config.comm.allreduce(int(self.trial.active.sum())))

    @property
    def pattern(self) -> bytes:
        """What tells one distribution of active contactors of this rank from others."""
        return self.trial.active.tobytes()

    def largest_gap(self) -> float:
        """Largest gap of an active contactor over all ranks, a length (collective)."""
        here = float(np.abs(self.gap[self.trial.active & ~self.redundant]).max(initial=0.0))
        return float(self.config.comm.allreduce(here, op=MPI.MAX))

    # -- activation and release ------------------------------------------------------------------------------------------

    def _set_active(self, state: PairState) -> None:
        """Take over a state of which only the active set is another (collective)."""
        self.trial = state
        self.placement = self.coupling.with_active(self.placement, state)

    def activate_touching(self) -> None:
        """Start with the contactors that touch without force as active (collective)."""
        state = active_set.touching(self.trial, self.gap, self.config.size, ~self.off & self.movable)
        state = replace(state, at_end=self._at_end(self.trial))
        # a first step that fails and is cut starts from here again
        self.committed = state
        self._set_active(state)

    def bar_returned(self) -> int:
        """Leave out contactors that had passed the end of the target, sunk, and are taken back in this step: how many (collective)."""
        came = self.trial.active & ~self.committed.active & self.committed.passed
        self.barred = self.barred | came
        return int(self.config.comm.allreduce(int(came.sum())))

    def _at_end(self, state: PairState) -> Bools:
        """Contactors that an end of the target holds in the next step ``(n,)``.

        Where the surfaces follow each other none needs to be: past the end, it is the end that touches.
        """
        return self.coupling.at_end(self.placement, state) & (not self.mutual)

    def follow(self) -> bool:
        """Let go of contactors past an end of the target, follow the others from facet to facet (collective).

        Returns:
            Whether any rank changed what its contactors are united to.
        """
        off = self.off
        gone = bool((self.trial.active & off).any())
        state = active_set.slide_off(self.trial, off)
        self.placement, state, moved = self.coupling.change_facets(self.placement, self.points, state)
        self._set_active(state)
        return bool(self.config.comm.allreduce(gone or moved, op=MPI.LOR))

    def foreseen(self, du: Array) -> Array:
        """Gaps that decide on contact, to first order in an increment; see ``Coupling.foreseen`` (collective)."""
        return self.coupling.foreseen(self.placement, du)

    def wrong(
        self,
        gap: Array,
        lam: Array,
        stiffness: Array,
        force_rounding: Array,
        gap_rounding: float,
        swept: bool,
        du: Array | None = None,
    ) -> active_set.Wrong:
        """Contactors that break the conditions of contact with such gaps and forces (collective).

        Args:
            gap: that decides on contact ``(n,)``.
            lam: force along the normal that decides on contact ``(n,)``.
            stiffness: of the contactors along the normal ``(n,)``.
            force_rounding: forces below it are zero ``(n,)``.
            gap_rounding: gaps below it are zero, and below rounding of positions.
            swept: leave out those that have slid off a thin target, which sweeps past them on the way to equilibrium.
            du: increment of the owned nodes with which they are foreseen ``(n_owned, gdim)``; None where the bodies are now.
        """
        off = self.off
        if swept and self.thickness < np.inf:
            off = off | (self.trial.slips > 0)
        # an equation that was left out as dependent and does not hold is no contact
        apart = self.redundant & (gap > max(gap_rounding, active_set.TOUCHING * self.config.size))
        # the facets of a corner are let go of one by one, which ``follow`` does
        pulled = np.where(self.trial.in_corner, 0.0, lam)
        rounding = max(gap_rounding, active_set.GAP_ROUNDING * self.config.size)
        wrong = active_set.find_wrong(
            self.trial, gap, pulled, off, self.movable & ~apart, stiffness, force_rounding=force_rounding, gap_rounding=rounding
        )
        return self._with_friction(wrong, lam, stiffness, force_rounding, rounding, du)

    def _with_friction(
        self, wrong: active_set.Wrong, lam: Array, stiffness: Array, force_rounding: Array, gap_rounding: float, du: Array | None
    ) -> active_set.Wrong:
        """Those that break the conditions of contact and those that break the ones of friction; arguments as of ``wrong`` (collective)."""
        return wrong

    def exchange(self, wrong: active_set.Wrong, ahead: bool) -> bool:
        """Let wrong contactors change sides, and those that are to follow them if ``ahead`` (collective): whether there are any."""
        self._set_active(active_set.exchange(self.trial, wrong))
        return False

    def place_again(self) -> None:
        """Put contactors whose equations have changed where they now belong (collective)."""
        self.placement = self.coupling.place_again(self.placement, self.points, self.trial)

    # -- bodies that only contact holds ----------------------------------------------------------------------------------

    @property
    def _ahead(self) -> Ints:
        """Contactors in front of the target that are not active."""
        return np.flatnonzero(~self.trial.active & ~self.off & self.movable)

    @property
    def approach(self) -> UnitingEquations:
        """The equations that all contactors in front of the target would have, of those that are not active."""
        return self.coupling.approach(self.placement, self._ahead)

    def activate_closing(self, closing: Bools) -> bool:
        """Activate the contactors among those of ``approach`` that close and touch (collective): whether there are any."""
        i = self._ahead
        now = i[closing & (self.projection.gap[i] <= active_set.TOUCHING * self.config.size)]
        active = self.trial.active.copy()
        active[now] = True
        self._set_active(replace(self.trial, active=active))
        return bool(self.config.comm.allreduce(len(now)))

    # -- what the united system gets -------------------------------------------------------------------------------------

    def equations(self) -> LabelledEquations:
        """Uniting equations of the contactors that are or may become active.

        Contactors near the target keep rows in the sparsity of P; they are looked for anew when an active one lacks its row. Where
        nothing touches at the start of a step, none has one until something does.
        """
        if (self.trial.active & ~self.reserved).any():
            self.reserved = self.coupling.near(self.placement, self.trial)
        return self.coupling.equations(self.placement, self.points, self.trial, np.flatnonzero(self.reserved))

    def set_redundant(self, equations: LabelledEquations, redundant: Bools) -> None:
        """Take which of the pair's equations ``(m,)`` depend on others and were left out."""
        normal = equations.kind == NORMAL
        self.redundant = np.zeros(len(self.nodes), dtype=bool)
        self.redundant[equations.contactor[normal]] = redundant[normal]

    def forces(self, equations: LabelledEquations, multipliers: Array, du: Array | None = None) -> tuple[Array, Array, Array]:
        """Contact forces from the multipliers of the pair's equations ``(m,)``; see ``Coupling.forces`` (collective).

        ``du (n_owned, gdim)`` is the increment that they are foreseen with; None where the bodies are now.
        """
        return self.coupling.forces(self.placement, self.trial, equations, multipliers)

    def nodal_forces(self, state: PairState) -> tuple[Ints, Array]:
        """The contact forces of a state at nodes of both bodies; see ``Coupling.nodal_forces``."""
        return self.coupling.nodal_forces(self.placement, state)

    def with_forces(self, lam: Array, nodal: Array, force: Array) -> PairState:
        """The trial state with contact forces that were read or foreseen.

        Args:
            lam: force along the normal that decides on contact ``(n,)``.
            nodal: of the node along the normal ``(n,)``.
            force: on the contactor ``(n, gdim)``.
        """
        return replace(self.trial, lam=lam, nodal=nodal, force=force)

    def set_forces(self, lam: Array, nodal: Array, force: Array, active: Bools | None = None) -> None:
        """Give the trial state contact forces, and an active set ``(n,)`` if another method than elimination decides on it."""
        state = self.with_forces(lam, nodal, force)
        self.trial = state if active is None else replace(state, active=active)

    def curvature(self) -> list[tuple[Ints, Array]]:
        """Blocks of ``-sum lambda grad^2 g``: lists of global nodes ``(k, m)`` and values ``(k, m g, m g)`` (collective)."""
        return [self.coupling.curvature(self.placement, self.trial)]

    def check(self) -> None:
        """Refuse an equilibrium that the pair cannot stand for (collective)."""

    def turn(self, stiffness: Array) -> None:
        """Take the directions of friction from where the contactors are; ``stiffness (n, gdim)`` is the diagonal of K at them."""

    def slip_terms(self) -> tuple[Ints, Array, Array] | None:
        """What sliding friction adds to tangent and residual: nodes and blocks as in ``curvature``, forces ``(k, (1 + nn) gdim)``."""
        return None

    # -- trial and committed ---------------------------------------------------------------------------------------------

    def commit(self) -> None:
        """Make the trial state the committed one; to be followed by ``project``."""
        slips = np.where(self.trial.active, self.trial.slips, 0)
        self.barred = self.barred & (self.projection.gap < 0)
        passed = self.off | (self.trial.passed & (self.projection.gap < 0))
        fresh = replace(self.trial, changes=np.zeros_like(slips), slips=slips, passed=passed)
        self.committed = replace(fresh, at_end=self._at_end(fresh))
        self.restore()
        self.coupling.commit()
        if not self.trial.active.any():
            self.reserved = np.zeros_like(self.reserved)

    def restore(self) -> None:
        """Go back to the committed state; to be followed by ``project``."""
        self.trial = self.committed

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """Arrays ``(n, ...)`` that a run goes on from, facets by what tells them in any partition (collective)."""
        kept: dict[str, npt.NDArray[Any]] = {"reserved": self.reserved, "redundant": self.redundant, "barred": self.barred}
        return kept | self.committed.to_checkpoint(self.target.keys_of)

    def from_checkpoint(self, kept: Mapping[str, npt.NDArray[Any]]) -> None:
        """Go on from what ``to_checkpoint`` returned, to be followed by ``project`` (collective)."""
        self.reserved, self.redundant, self.barred = (np.array(kept[name]) for name in ("reserved", "redundant", "barred"))
        self.committed = PairState.from_checkpoint(kept, self.target.facets_of)
        self.coupling.commit()
        self.restore()
