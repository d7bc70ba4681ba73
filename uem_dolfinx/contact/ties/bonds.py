"""Bonds of contactors to the points of the target that faced them at the start: ties that open, by the law of an interface.

Their openings are what the equations of ``tied_rows`` leave, in both couplings. No component is eliminated: the bonds have forces and
stiffnesses, and contact acts in addition.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.seam.placement import ContactRows, Traction
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.contact.ties.tie import Tie
from uem_dolfinx.contact.ties.tied_rows import TiedRows


class Bonds(Tie):
    """Bonds of one interface; arguments as for ``Tie``."""

    def __init__(self, *args: Any, **how: Any):
        super().__init__(*args, **how)
        self.bonded: Bools = self.tied  # contactors with bonds ``(n,)``
        self.holds: Bools = self.tied  # contactors whose bonds hold bodies that nothing else holds ``(n,)``
        #: of the bonds' equations, their forces on the contactors ``(n, gdim)``.
        self.multipliers: Array = np.zeros(self._left_out.shape)

    def _take_rows(self, rows: TiedRows, off: Bools) -> None:
        super()._take_rows(rows, off)
        self.bonded, self.tied, self.whole = self.tied, np.zeros(len(self.nodes), dtype=bool), False

    def _make(self, which: Bools, off: Bools) -> None:
        if self.means is not None:
            # bonds to prescribed nodes open too
            self.means.set(free=np.ones((self.config.n_owned, self.config.gdim), dtype=bool))
        super()._make(which, off)

    def untie(self) -> None:
        """See ``Tie``; for good."""
        super().untie()
        self.bonded = self.holds = self.tied
        self.multipliers = np.zeros(self._left_out.shape)

    @property
    def knows_conditions(self) -> bool:
        """See ``Tie``; never."""
        return False

    def kept_gaps(self) -> Array:
        """See ``Tie``; none, for bonds open."""
        return np.zeros(0)

    def largest_gap_here(self) -> float:
        """See ``Interface``; openings are no violations."""
        return 0.0

    # -- openings and forces ---------------------------------------------------------------------------------------------

    def openings(self) -> Array:
        """Openings of the bonds, means with mortar ``(n, gdim)`` (collective)."""
        w, rows = np.zeros(self._left_out.shape), self.made
        w[rows.has] = self._equations().gap / np.where(rows.share > 0.0, rows.share, 1.0)[rows.has]
        return w

    def bonded_areas(self, areas: Array) -> Array:
        """Areas of the bonds in the reference configuration, from those of the nodes, each ``(n,)``; 0 without a bond."""
        return np.where(self.bonded, areas if self.made.area is None else self.made.area, 0.0)

    def stiffness(self, tangent: Array) -> tuple[Ints, Array]:
        """Blocks ``sum_cd tangent_cd r_c r_d'`` with the gradients r of the equations, see ``dyads``; ``tangent (n, gdim, gdim)``."""
        eq, g = self._equations(), self.config.gdim
        i, c = np.nonzero(self.made.has)
        row = np.append(np.arange(len(eq)), eq.row)
        node = np.append(self.config.to_global(eq.node), eq.followed)
        vector = np.concatenate([eq.direction, -eq.coefficients])
        # one column for each node of a contactor
        pairs, at = np.unique(np.column_stack([i[row], node]), axis=0, return_inverse=True)
        which, first, of = np.unique(pairs[:, 0], return_index=True, return_inverse=True)
        column = np.arange(len(pairs)) - first[of]
        nodes = np.full((len(which), int(column.max(initial=-1)) + 1), -1, dtype=np.int64)
        nodes[of, column] = pairs[:, 1]
        at = at.ravel()
        gradient = np.zeros((len(which), g, nodes.shape[1], g))
        np.add.at(gradient, (of[at], c[row], column[at]), vector)
        r = gradient.reshape(len(which), g, nodes.shape[1] * g)
        return nodes, np.einsum("kca,kcd,kdb->kab", r, tangent[which], r, optimize=True)

    def press(self, multipliers: Array, holds: Bools) -> None:
        """Set the forces of the bonds, and which of them hold bodies; see the attributes."""
        self.multipliers, self.holds = multipliers, holds

    def with_forces(self, contact: Traction, equations: ContactRows, multipliers: Array) -> Traction:
        """Contact forces, with those of the bonds (collective)."""
        if self.rows is None:
            return contact._replace(bond=self.multipliers)
        return contact._replace(force=contact.force + self._on_contactors(self.multipliers), bond=self.multipliers)

    def applied_forces(self) -> tuple[Ints, Array] | None:
        """See ``Interface``."""
        return None if self.rows is None else self.rows.handed_on(self._equations(), self.multipliers)

    def join(self, contact: ContactRows) -> ContactRows:
        """Equations of contact, and bonds that hold bodies, of which none is eliminated (collective)."""
        if self.rows is None:
            return contact
        i, c = np.nonzero(self.rows.has)
        some = self.holds[i]
        here: UnitingEquations = replace(self._equations().select(some), active=np.zeros(int(some.sum()), dtype=bool))
        held = np.ones(len(here), dtype=bool)
        own = ContactRows.straight(here, i[some], -1 - c[some])
        return ContactRows.join(
            [contact, replace(own, resisted=held, crosswise=replace(here, active=held))], [], self.config.gdim
        )

    def pressing(self, state: PairState, n: Array, lam: Array, tau: Array) -> tuple[Array, Array]:
        """See ``Interface``; contact forces with those of the bonds, which may be in tension (collective)."""
        if self.rows is None or state.bond is None:
            return lam, tau
        force = np.column_stack([self.discretisation.spread(part) for part in (state.bond * self.rows.share).T])
        along = np.einsum("ng,ng->n", force, n)
        return lam + along, tau + force - along[:, None] * n

    def areas(self, areas: Array, reference: Array, found: Array) -> Array:
        """See ``Interface``; those of contact."""
        return found
