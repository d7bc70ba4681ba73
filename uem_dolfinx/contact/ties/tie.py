"""Permanent tie of an interface's contactors to the target, from the start or from a given step on.

Tied contactors have equations of ``tied_rows`` in all components, and no contact conditions. Contactors that were out of reach or
open at the time of tying remain in contact.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.mortar.discretisation import Mortar
from uem_dolfinx.contact.seam.ends import Ends
from uem_dolfinx.contact.seam.placement import ContactRows, Discretisation, Traction
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.contact.ties.tied_rows import TiedRows, to_facets, to_means, to_surface
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import Projection
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import agree, reduced


class Tie:
    """Permanent tie of contactors of one interface to the target.

    Args:
        nodes: owned contactor nodes ``(n,)``.
        discretisation: of the interface.
        name: for messages.
        max_penetration: see ``Interface``.
        means: separate mortar discretisation for weighted means at the time of tying; None ties nodes.
        reach: largest distance from the target of contactors tied at the start, a length; None is a side of the target's facet.

    Attributes:
        means: as given.
        rows: equations of tied contactors; None before tying.
        tied: contactors tied to the target in all components ``(n,)``.
        whole: whether no rank has contactors left for contact.
        at: displacement at which they were tied.
    """

    def __init__(
        self,
        config: Configuration,
        nodes: Indices,
        discretisation: Discretisation,
        *,
        name: str,
        max_penetration: float,
        means: Mortar | None,
        reach: float | None,
    ):
        self.config, self.nodes, self.discretisation, self.target = config, nodes, discretisation, discretisation.target
        self.name, self.max_penetration = name, max_penetration
        self.means, self._reach = means, reach
        self.rows: TiedRows | None = None
        self.tied: Bools = np.zeros(len(nodes), dtype=bool)
        self.whole = False
        self.at = fem.Function(config.V, name="tied_at")
        #: Components whose equations are redundant and were dropped ``(n, gdim)``.
        self._left_out: Bools = np.zeros((len(nodes), config.gdim), dtype=bool)
        #: Equations of the last placement, and whether the next one projects all contactors, even if contact needs none of them.
        self._here: UnitingEquations | None = None
        self._lost = True

    # -- tying -----------------------------------------------------------------------------------------------------------

    def unite(self, state: PairState, projection: Projection, off: Bools, which: Bools | None = None) -> PairState:
        """Tie contactors at their current positions: all within reach, or ``which (n,)`` (collective).

        Args:
            state: committed state.
            projection: of the contactors.
            off: contactors that have slid past an end of the target ``(n,)``.
            which: contactors to be tied ``(n,)``.

        Returns:
            The committed state, in which tied contactors have no contact conditions and keep their forces.

        Raises:
            SurfaceError: if no contactor is tied.
        """
        drag = 0.0 if state.friction is None else state.friction.tau
        forces = state.lam[:, None] * projection.normal + drag if self.means else state.force
        self.at.x.array[:] = self.config.displacement.ravel()
        self._make(self._within_reach(state) if which is None else which, off)
        rows, error = self.made, None
        if not reduced(self.config.comm, int(rows.has.sum())):
            what = "is near enough to the target" if which is None else "touches the target"
            error = SurfaceError(
                f"{self.name}: no contactor {what} to be tied to it: bring the surfaces together, or give a larger adjust"
            )
        agree(self.config.comm, error)
        bond = np.where(rows.has, forces / np.where(rows.share > 0, rows.share, 1.0), 0.0)
        return self.untouched(replace(state, bond=bond))

    @property
    def _points(self) -> Array:
        """Current positions of the contactors ``(n, gdim)``."""
        return self.config.here(self.nodes)

    def untie(self) -> None:
        """Release all tied contactors; call ``remember`` and ``project`` afterwards."""
        self.rows, self.tied, self._here, self._lost, self.whole = None, np.zeros(len(self.nodes), dtype=bool), None, True, False
        self._left_out = np.zeros_like(self._left_out)

    @property
    def knows_conditions(self) -> bool:
        """Whether its rows depend on the Dirichlet conditions at the time of tying."""
        return self.means is not None

    def followed_by_ties(self) -> Ints:
        """Global nodes that tied contactors follow, repeated or not ``(k,)`` (collective)."""
        return np.zeros(0, np.int64) if self.rows is None else self._equations().followed

    def _within_reach(self, state: PairState) -> Bools:
        """Contactors within reach of the target ``(n,)`` (collective)."""
        p = self.target.project(self._points)
        reach = p.facet_size if self.target.n_nodes else self.max_penetration
        near = np.abs(p.gap) <= (reach if self._reach is None else self._reach)
        return np.asarray(near if self.means else near & ~Ends(p, np.inf).past(state))

    def _make(self, which: Bools, off: Bools) -> None:
        """Make rows of contactors ``which (n,)`` at the displacement ``at``, or at the current one for a rigid target (collective)."""
        config, nodes, kept = self.config, self.nodes, self.discretisation.traits.sliding != "finite"
        if not self.target.n_nodes:
            self._take_rows(to_surface(config, nodes, self.target, which), off)
            return
        with config.at(config.values_at(self.at)):
            if self.means is not None:
                self.means.let_go()
                found = self.means.place(self._points, PairState.initial(len(nodes), config.gdim))
                rows = to_means(self.means, found.rows, which, kept)
                self.means.let_go()
            else:
                assert isinstance(self.target, MeshTarget)
                rows = to_facets(config, nodes, self.target, self.target.project(self._points), which, kept)
        self._take_rows(rows, off)

    def _take_rows(self, rows: TiedRows, off: Bools) -> None:
        """Set the rows; ``off (n,)`` as in ``unite`` (collective)."""
        self.rows, self.tied, self._here, self._lost = rows, np.asarray(rows.has.any(axis=1)), None, True
        self.whole = not reduced(self.config.comm, int((~self.tied & ~off).sum()))

    def untouched(self, state: PairState) -> PairState:
        """The state without contact at tied contactors."""
        tied, f = self.tied, state.friction
        if f is not None:
            f = replace(f, stick=f.stick & ~tied, tau=np.where(tied[:, None], 0.0, f.tau))
        lam, nodal = (np.where(tied, 0.0, force) for force in (state.lam, state.nodal))
        return replace(state, active=state.active & ~tied, reserved=state.reserved & ~tied, lam=lam, nodal=nodal, friction=f)

    # -- placement of contactors -----------------------------------------------------------------------------------------

    def begin_placement(self) -> bool:
        """Bodies have moved: whether contactors must be projected. If all are tied, this is done once a step, for results."""
        self._here, search = None, self._lost or not self.whole
        self._lost = False
        return search

    def lose(self) -> None:
        """Let the next placement project all contactors."""
        self._lost = True

    @property
    def excluded(self) -> Bools:
        """Contactors that take no part in contact ``(n,)``."""
        return self.tied

    @property
    def made(self) -> TiedRows:
        """The rows, once contactors are tied."""
        assert self.rows is not None
        return self.rows

    def _equations(self) -> UnitingEquations:
        """Equations of tied contactors in the current configuration (collective)."""
        if self._here is None:
            self._here = self.made.equations(self.target.motion)
        return self._here

    def largest_gap_here(self) -> float:
        """Largest component of the violation of this rank's tie equations, a length."""
        return float(np.abs(np.where(self._left_out, 0.0, self.apart())).max(initial=0.0))

    def apart(self) -> Array:
        """Distance of tied contactors from their tied positions ``(n, gdim)``; zero before the equations have been made."""
        way = np.zeros(self._left_out.shape)
        if self.rows is not None and self._here is not None:
            way[self.rows.has] = self._here.gap
        return way

    def kept_gaps(self) -> Array:
        """Constant heights of this rank's tied contactors over the target ``(k,)``."""
        spacers = None if self.rows is None else self.rows.spacers
        return np.zeros(0) if spacers is None else spacers.height

    def torn(self) -> Array:
        """Violation of tie equations that were dropped as redundant ``(n,)``."""
        return np.linalg.norm(np.where(self._left_out, self.apart(), 0.0), axis=1)

    # -- equations and forces --------------------------------------------------------------------------------------------

    def join(self, contact: ContactRows) -> ContactRows:
        """Equations of contact, followed by those of tied contactors (collective)."""
        if self.rows is None:
            return contact
        here, i, c = self._uniting()
        return ContactRows.join([contact, ContactRows.straight(here, i, -1 - c)], [], self.config.gdim)

    def _uniting(self) -> tuple[UnitingEquations, Ints, Ints]:
        """Equations of tied contactors, with their contactors and components ``(m,)`` (collective)."""
        i, c = np.nonzero(self.made.has)
        return self._equations(), i, c

    def set_redundant(self, equations: ContactRows, redundant: Bools) -> None:
        """Set which of the equations ``(m,)`` are redundant and were dropped."""
        self._left_out = self._of_components(equations, redundant)

    def _of_components(self, equations: ContactRows, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        """Values of equations ``(m,)`` at the tied contactors' components ``(n, gdim)``."""
        found, tied = np.zeros(self._left_out.shape, values.dtype), equations.permanent
        found[equations.contactor[tied], -1 - equations.kind[tied]] = values[tied]
        return found

    def with_forces(self, contact: Traction, equations: ContactRows, multipliers: Array) -> Traction:
        """Contact forces, and tie forces from the multipliers of all equations ``(m,)`` (collective)."""
        bond = self._of_components(equations, multipliers)
        if self.rows is None:
            return contact._replace(bond=bond)
        bond = self._bond(bond)
        return contact._replace(force=contact.force + self._on_contactors(bond), bond=bond)

    def _bond(self, bond: Array) -> Array:
        """Multipliers of tied contactors, from those of the equations of ``_uniting``, each ``(n, gdim)`` (collective)."""
        return bond

    def _on_contactors(self, bond: Array) -> Array:
        """Forces on the contactors of multipliers ``bond (n, gdim)``: ``(n, gdim)`` (collective)."""
        return np.asarray(self.config.add_at_owners(*self.made.handed_on(self._equations(), bond))[self.nodes])

    def nodal_forces(self, state: PairState, contact: Callable[[PairState], tuple[Ints, Array]]) -> tuple[Ints, Array]:
        """Forces at nodes of both bodies as in ``Kinematics``; ``contact`` returns the contact part (collective)."""
        if self.rows is None or state.bond is None:
            return contact(state)
        nodes, forces = contact(replace(state, force=state.force - self._on_contactors(state.bond)))
        more = self.rows.handed_on(self._equations(), state.bond)
        return np.concatenate([nodes, more[0]]), np.concatenate([forces, more[1]])

    def curvature(self, state: PairState) -> list[tuple[Ints, Array]]:
        """See ``Interface``; second derivatives of kept gaps that rotate with the target (collective)."""
        return [] if self.rows is None or state.bond is None else self.rows.curvature(state.bond)

    @property
    def chained(self) -> bool:
        """See ``Interface``; here because of the tie."""
        return False

    @property
    def works(self) -> bool:
        """Whether its forces do external work."""
        return False

    def applied_forces(self) -> tuple[Ints, Array] | None:
        """See ``Interface``."""
        return None

    # -- results ---------------------------------------------------------------------------------------------------------

    def pressing(self, state: PairState, n: Array, lam: Array, tau: Array) -> tuple[Array, Array]:
        """See ``Interface``; from contact forces and normals ``(n, gdim)``, with tied contactors, which may be in tension (collective)."""
        if self.rows is None or state.bond is None:
            return lam, tau
        force = state.bond * self.rows.share
        force = np.column_stack([self.discretisation.spread(part) for part in force.T])
        along = np.einsum("ng,ng->n", force, n)
        return np.where(self.tied, along, lam), np.where(self.tied[:, None], force - along[:, None] * n, tau)

    def areas(self, areas: Array, reference: Array, found: Array) -> Array:
        """See ``Interface``; from the areas of contact ``found (n,)`` (collective)."""
        if self.rows is None:
            return found
        if self.rows.area is None:
            own = self.discretisation.spread(areas)
        else:
            own = self.rows.area * np.where(reference > 0, areas / np.where(reference > 0, reference, 1.0), 1.0)
        return np.where(self.tied, own, found)

    # -- from step to step -----------------------------------------------------------------------------------------------

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """Tied contactors, and their positions on a rigid target, see ``Interface`` (collective)."""
        held = None if self.rows is None else self.rows.held
        return {"tied": self.tied, "held_at": np.zeros(self._left_out.shape) if held is None else held}

    def from_checkpoint(self, kept: Mapping[str, npt.NDArray[Any]], off: Bools) -> None:
        """Restore a state from ``to_checkpoint`` after ``at`` has been read; ``off`` as in ``unite`` (collective)."""
        tied = np.array(kept["tied"])
        if reduced(self.config.comm, int(tied.sum())):
            self._make(tied, off)
            if self.made.held is not None:
                self._take_rows(replace(self.made, held=np.array(kept["held_at"])), off)
