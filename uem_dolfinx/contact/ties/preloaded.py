"""The tie of a preloaded section: two facing surfaces, tied except for a common opening along an axis.

With the tied rows r, which vanish without an opening, the axis a and the opening d,

    r_ic = s_ic a_c d    for every contactor i and component c,

where s are the shares of ``TiedRows``. While the section has a given force, d is unknown: it is determined by one leading row 0, on
which the others depend,

    r_ic - (s_ic a_c / s_0 a_0) r_0 = 0,    d = r_0 / (s_0 a_0),

so that the leading row leaves the opening free. The force F, positive in tension, acts as a pair of forces with the virtual work -F
times the variation of d, which is a multiplier -F / (s_0 a_0) of the leading row. Once locked, d is constant and all rows are
active. In both cases the multipliers are forces of the tie, and ``-sum lam_ic s_ic a_c`` is the force in the section.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, NEGLIGIBLE, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.contact.ties.tie import Tie
from uem_dolfinx.contact.ties.tied_rows import TiedRows
from uem_dolfinx.errors import InputError, SurfaceError
from uem_dolfinx.geometry.projection import Projection
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import agree, gathered, reduced


class Preloaded(Tie):
    """A section that opens along an axis and is otherwise tied; other arguments as for ``Tie``.

    Args:
        axis: unit vector ``(gdim,)``; None is the mean normal of the target.
        free: components of the contactors without Dirichlet condition ``(n, gdim)``.

    Attributes:
        axis: the direction that points out of the target ``(gdim,)``, available after tying.
        force: force in the section while it is not locked, positive in tension.
        locked: whether the opening is constant.
        opening: change of the distance between the faces along the axis, negative if the bolt is shortened.
        shortened: whether the opening is prescribed rather than locked as it was.
        along: value of every row for a unit opening ``(m,)``.
    """

    def __init__(self, *between: Any, axis: Array | None, free: Bools, **of: Any):
        super().__init__(*between, **of)
        self._given_axis, self._free = axis, free
        self.axis: Array = np.zeros(self.config.gdim)
        self.force, self.locked, self.opening, self.shortened = 0.0, False, 0.0, False
        self.along: Array = np.zeros(0)
        self._lead, self._root = -1, 0  # number of the leading row, -1 on other ranks, and the rank that has it

    # -- the axis and the leading row ------------------------------------------------------------------------------------

    def unite(self, state: PairState, projection: Projection, off: Bools, which: Bools | None = None) -> PairState:
        """See ``Tie`` (collective).

        Raises InputError if the axis lies in the section, and SurfaceError if conditions prescribe the whole section along the
        axis.
        """
        n = projection.normal[self._within_reach(state)].sum(axis=0)
        n = np.asarray(reduced(self.config.comm, n))
        n = n / (np.linalg.norm(n) or 1.0)
        axis = n if self._given_axis is None else self._given_axis
        if abs(axis @ n) < MOSTLY_PRESCRIBED and n.any():
            raise InputError(
                f"{self.name}: the axis {axis} lies in the section, whose normal is {n}: expected the direction of the bolt"
            )
        axis = np.where(np.abs(axis) > NEGLIGIBLE, axis, 0.0) * (1.0 if axis @ n > 0 else -1.0)
        self.axis = axis / (np.linalg.norm(axis) or 1.0)
        united = super().unite(state, projection, off, which)
        if loose := int(reduced(self.config.comm, int((~self.tied).sum()))):
            logger.warning("%s: %d contactors of the section are not opposite to the target, and are not tied", self.name, loose)
        return united

    def _within_reach(self, state: PairState) -> Bools:
        """See ``Tie``; also contactors at the rim, for which facets are continued past their sides (collective)."""
        p = self.target.project(self._points)
        return np.maximum(np.abs(p.gap), p.way_beyond) <= p.facet_size

    def _take_rows(self, rows: TiedRows, off: Bools) -> None:
        super()._take_rows(rows, off)
        self.whole = True
        i, c = np.nonzero(rows.has)
        self.along = rows.share[i, c] * self.axis[c]
        comm, main = self.config.comm, int(np.argmax(np.abs(self.axis)))
        if not reduced(comm, len(i)):
            return
        can = self._free[i, c] & (c == main)
        # rows that contain no other contactor cause no cycles
        mark = np.zeros((self.config.n_owned, 1))
        mark[self.nodes] = 1.0
        alone = can & ~np.isin(i, rows.terms[0][self.config.ask_owners(rows.terms[1], mark)[:, 0] > 0])
        if reduced(comm, bool(alone.any()), op=MPI.LOR):
            can = alone
        X, here = self.config.X[self.nodes[i]], np.flatnonzero(can)
        middle = reduced(comm, np.append(X[here].sum(axis=0), len(here)))
        error = None
        if not middle[-1]:
            error = SurfaceError(
                f"{self.name}: Dirichlet conditions hold all of the section along the axis {self.axis}, so that it cannot open: cut the "
                "bolt elsewhere, or leave the conditions out"
            )
        agree(comm, error)
        away = np.linalg.norm(X[here] - middle[:-1] / middle[-1], axis=1)
        nearest = gathered(comm, float(away.min(initial=np.inf)))
        self._root = int(np.argmin(nearest))
        self._lead = int(here[np.argmin(away)]) if comm.rank == self._root else -1

    # -- rows ------------------------------------------------------------------------------------------------------------

    @property
    def excluded(self) -> Bools:
        """See ``Tie``; all contactors, since untied contactors of the section have no contact either."""
        return np.ones(len(self.nodes), dtype=bool)

    @property
    def knows_conditions(self) -> bool:
        """See ``Tie``; True, since the leading row needs a free component."""
        return True

    @property
    def rows_in_use(self) -> int:
        """Number of this rank's rows but for the leading one of an opening that is free."""
        return len(self.along) - (self._lead >= 0 and not self.locked)

    @property
    def chained(self) -> bool:
        """See ``Interface``; True, since all rows depend on the contactor of the leading row."""
        return True

    def _equations(self) -> UnitingEquations:
        """See ``Tie``; gaps relative to the present opening, which is computed if it is free (collective)."""
        if self._here is None:
            here = super()._equations()
            if not self.locked:
                own = here.gap[self._lead] / self.along[self._lead] if self._lead >= 0 else None
                self.opening = float(self.config.comm.bcast(own, root=self._root))
            self._here = replace(here, gap=here.gap - self.opening * self.along)
        return self._here

    def _uniting(self) -> tuple[UnitingEquations, Ints, Ints]:
        """See ``Tie``; while the opening is free, all rows except the leading one, on which they depend (collective)."""
        here, (i, c) = self._equations(), np.nonzero(self.made.has)
        if self.locked:
            return here, i, c
        own = None
        if self._lead >= 0:
            of = here.row == self._lead
            node = self.config.to_global(here.node[[self._lead]])
            vectors = np.concatenate([-here.direction[[self._lead]], here.coefficients[of]]) / self.along[self._lead]
            own = np.append(node, here.followed[of]), vectors
        nodes, vectors = self.config.comm.bcast(own, root=self._root)
        others = np.arange(len(here)) != self._lead
        follow = np.flatnonzero(others & (self.along != 0))
        row = np.concatenate([here.row, np.repeat(follow, len(nodes))])
        followed = np.concatenate([here.followed, np.tile(nodes, len(follow))])
        more = -self.along[follow, None, None] * vectors
        coefficients = np.concatenate([here.coefficients, more.reshape(-1, self.config.gdim)])
        # terms at a row's own node belong to its direction
        direction, itself = here.direction.copy(), followed == self.config.to_global(here.node)[row]
        np.add.at(direction, row[itself], -coefficients[itself])
        made = replace(
            here, direction=direction, row=row[~itself], followed=followed[~itself], coefficients=coefficients[~itself]
        )
        return made.select(others), i[others], c[others]

    def without_lead(self, nodes: Ints, vectors: Array) -> tuple[Ints, Array]:
        """Nodes ``(m, k)`` and vectors ``(m, k, gdim)`` of sums at rows, for the rows in use: all if the section is locked (collective)."""
        if self.locked:
            return nodes, vectors
        lead = (nodes[self._lead], vectors[self._lead] / self.along[self._lead]) if self._lead >= 0 else None
        of, by = self.config.comm.bcast(lead, root=self._root)
        others = np.arange(len(nodes)) != self._lead
        more = -self.along[others, None, None] * by
        at = np.broadcast_to(of, (len(more), len(of)))
        return np.column_stack([nodes[others], at]), np.concatenate([vectors[others], more], axis=1)

    def along_rows(self, gaps: Array) -> Array:
        """Changes of the gaps of the rows in use, from those of all rows ``(m,)`` at a constant opening (collective)."""
        if self.locked:
            return gaps
        own = gaps[self._lead] / self.along[self._lead] if self._lead >= 0 else None
        opened = self.config.comm.bcast(own, root=self._root)
        return np.asarray((gaps - opened * self.along)[np.arange(len(gaps)) != self._lead])

    def back_to_rows(self, by_gaps: Array) -> Array:
        """The transpose of ``along_rows``: derivatives by the gaps of all rows ``(m,)`` (collective)."""
        if self.locked:
            return by_gaps
        found = np.zeros(len(self.along))
        found[np.arange(len(found)) != self._lead] = by_gaps
        opened = float(reduced(self.config.comm, float(found @ self.along)))
        if self._lead >= 0:
            found[self._lead] = -opened / self.along[self._lead]
        return found

    def _bond(self, bond: Array) -> Array:
        """See ``Tie``; the leading row carries the rest of the given force (collective)."""
        return bond if self.locked else bond + self._by_lead(self.force - self._pull(bond))

    def _pull(self, bond: Array) -> float:
        """Force in the section from multipliers ``bond (n, gdim)``, positive in tension (collective)."""
        return -float(reduced(self.config.comm, float(self.along @ bond[self.made.has])))

    def _by_lead(self, force: float) -> Array:
        """Multipliers ``(n, gdim)`` of a section ``force`` that the leading row carries alone."""
        alone = np.zeros(self.made.has.shape)
        if self._lead >= 0:
            i, c = np.nonzero(self.made.has)
            alone[i[self._lead], c[self._lead]] = -force / self.along[self._lead]
        return alone

    @property
    def works(self) -> bool:
        """See ``Tie``; True while the opening is free or prescribed."""
        return not self.locked or self.shortened

    def applied_forces(self, force: float | None = None) -> tuple[Ints, Array] | None:
        """See ``Interface``; the pair of forces on the faces, by default the given one, while the opening is free (collective)."""
        if self.locked:
            return None
        return self.made.handed_on(self._equations(), self._by_lead(self.force if force is None else force))

    def opening_back(self) -> Array:
        """Derivative of the opening by the positions of the owned nodes, while it is free ``(n_owned, gdim)`` (collective)."""
        return self.config.add_at_owners(*self.made.handed_on(self._equations(), self._by_lead(-1.0)))

    # -- results, and from step to step ----------------------------------------------------------------------------------

    def carried(self, state: PairState) -> float:
        """Force in the section in a state, positive in tension (collective)."""
        return 0.0 if state.bond is None else self._pull(state.bond)

    def find_opening(self) -> float:
        """The opening in the current configuration (collective)."""
        self._equations()
        return self.opening

    def lock(self) -> None:
        """Lock the present opening (collective)."""
        self.find_opening()
        self.locked, self.shortened, self._here = True, False, None

    def shorten(self, length: float) -> None:
        """Lock the opening that shortens the bolt by a ``length``."""
        self.locked, self.shortened, self.opening, self._here = True, True, -length, None

    def pull(self, force: float) -> None:
        """Set the force, which acts while the opening is free."""
        self.force = force

    def put(self, force: float, locked: bool, shortened: bool, opening: float) -> None:
        """Set force and opening of a recorded step."""
        self.force, self.locked, self.shortened, self.opening, self._here = force, locked, shortened, opening, None

    def release(self) -> None:
        """Make the opening free."""
        self.locked, self._here = False, None

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """See ``Tie``; with the opening, and whether it is locked (collective)."""
        n, opening = len(self.nodes), self.find_opening()
        return super().to_checkpoint() | {"locked": np.full(n, self.locked), "opening": np.full(n, opening)}

    def from_checkpoint(self, kept: Mapping[str, npt.NDArray[Any]], off: Bools) -> None:
        """See ``Tie`` (collective)."""
        locked, opening = np.array(kept["locked"]), np.array(kept["opening"])
        self.locked = bool(reduced(self.config.comm, bool(locked.any()), op=MPI.LOR))
        self.opening = float(reduced(self.config.comm, float(opening.max(initial=-np.inf)), op=MPI.MAX))
        super().from_checkpoint(kept, off)
