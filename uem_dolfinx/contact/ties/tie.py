"""What ties contactors of an interface to the target for good: from the start, or from a given step on.

What is tied has equations of ``tied_rows`` in all components, and no part in contact. What is not, because it was too far away or did
not touch when the others were tied, goes on as contact does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.mortar.discretisation import Mortar
from uem_dolfinx.contact.seam.ends import Ends
from uem_dolfinx.contact.seam.placement import Constraints, Discretisation, Traction
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.contact.ties.tied_rows import TiedRows, to_facets, to_means, to_surface
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import Projection
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import agree, reduced


@dataclass(frozen=True)
class TiedConstraints(Constraints):
    """``Constraints`` of contactors that touch, and after them those of contactors that are tied.

    Attributes:
        first: those of contactors that touch.
    """

    first: Constraints

    @property
    def contact(self) -> Constraints:
        """As of ``Constraints``."""
        return self.first

    @property
    def tied(self) -> Bools:
        """As of ``Constraints``."""
        return np.arange(len(self)) >= len(self.first)

    @classmethod
    def join(cls, contact: Constraints, tied: UnitingEquations, contactor: Ints, kind: Ints) -> TiedConstraints:
        """Both, the tied ones of these contactors and components ``(m,)``."""
        g, made = tied.direction.shape[1], dict[int, UnitingEquations]()
        lists = [contact.trial, contact.test, contact.frictionless, contact.resisting, contact.stopping]
        for own in lists:
            made.setdefault(id(own), UnitingEquations.join([own, tied], g))
        pairs = ((contact.contactor, contactor), (contact.kind, kind), (contact.tangent, np.full(len(kind), -1)))
        contactor, kind, tangent = (np.concatenate(pair) for pair in pairs)
        trial, test, frictionless, resisting, stopping = (made[id(own)] for own in lists)
        return cls(trial, test, frictionless, resisting, stopping, contactor, kind, tangent, contact)


class Tie:
    """What ties contactors of one interface to the target.

    Args:
        config: configuration of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        discretisation: of the interface.
        name: for messages.
        sliding: as of ``Interface``.
        max_penetration: likewise.
        means: discretisation by which means are found when contactors are tied, which serves nothing else; None ties nodes.
        reach: contactors that are tied at the start are no farther from the target, a length; None is a side of its facet.

    Attributes:
        means: as given.
        rows: of what is tied; None before.
        tied: contactors that are united with the target in all components ``(n,)``.
        whole: whether no contactor is left for contact, on any rank.
        at: displacement at which they were tied.
    """

    def __init__(
        self,
        config: Configuration,
        nodes: Indices,
        discretisation: Discretisation,
        *,
        name: str,
        sliding: str,
        max_penetration: float,
        means: Mortar | None,
        reach: float | None,
    ):
        self.config, self.nodes, self.discretisation, self.target = config, nodes, discretisation, discretisation.target
        self.name, self.sliding, self.max_penetration = name, sliding, max_penetration
        self.means, self._reach = means, reach
        self.rows: TiedRows | None = None
        self.tied: Bools = np.zeros(len(nodes), dtype=bool)
        self.whole = False
        self.at = fem.Function(config.V, name="tied_at")
        #: Components whose equations depend on others and were left out ``(n, gdim)``.
        self._left_out: Bools = np.zeros((len(nodes), config.gdim), dtype=bool)
        #: Equations where the bodies have been placed last, and whether a placement is to find contactors again that no contact needs.
        self._here: UnitingEquations | None = None
        self._lost = True

    # -- tying -----------------------------------------------------------------------------------------------------------

    def unite(self, state: PairState, projection: Projection, off: Bools, which: Bools | None = None) -> PairState:
        """Tie contactors where they are now: those within reach, or ``which (n,)`` (collective).

        Args:
            state: committed so far.
            projection: of the contactors.
            off: contactors that have slid past an end of the target ``(n,)``.
            which: contactors to be tied ``(n,)``.

        Returns:
            The committed state, in which what is tied is in no contact and keeps its forces.

        Raises:
            SurfaceError: if there are none.
        """
        drag = 0.0 if state.friction is None else state.friction.tau
        forces = state.lam[:, None] * projection.normal + drag if self.means else state.force
        self.at.x.array[:] = self.config.displacement.ravel()
        self._make(self._within_reach(state) if which is None else which, off)
        assert self.rows is not None
        error = None
        if not reduced(self.config.comm, int(self.tied.sum())):
            what = "is near enough to the target" if which is None else "touches the target"
            error = SurfaceError(
                f"{self.name}: no contactor {what} to be tied to it: bring the surfaces together, or give a larger adjust"
            )
        agree(self.config.comm, error)
        bond = np.where(self.rows.has, forces / np.where(self.rows.share > 0, self.rows.share, 1.0), 0.0)
        return self.untouched(replace(state, bond=bond))

    @property
    def _points(self) -> Array:
        """Current positions of the contactors ``(n, gdim)``."""
        return self.config.X[self.nodes] + self.config.displacement[self.nodes]

    def untie(self) -> None:
        """Tie nothing any more; to be followed by ``remember`` and ``project``."""
        self.rows, self.tied, self._here, self._lost, self.whole = None, np.zeros(len(self.nodes), dtype=bool), None, True, False
        self._left_out = np.zeros_like(self._left_out)

    @property
    def knows_conditions(self) -> bool:
        """Whether its rows belong to the Dirichlet conditions that there were when they were made."""
        return self.means is not None

    def followed_by_ties(self) -> Ints:
        """Global nodes that tied contactors follow, repeated or not ``(k,)`` (collective)."""
        return np.zeros(0, np.int64) if self.rows is None else self._equations().followed

    def _within_reach(self, state: PairState) -> Bools:
        """Contactors near enough to the target to be tied ``(n,)`` (collective)."""
        p = self.target.project(self._points)
        reach = p.facet_size if self.target.n_nodes else self.max_penetration
        near = np.abs(p.gap) <= (reach if self._reach is None else self._reach)
        return np.asarray(near if self.means else near & ~Ends(p, np.inf).past(state))

    def _make(self, which: Bools, off: Bools) -> None:
        """Rows of contactors ``which (n,)`` where they were at the displacement ``at``, or are on a rigid target (collective)."""
        config, nodes, kept = self.config, self.nodes, self.sliding != "finite"
        if not self.target.n_nodes:
            self._take_rows(to_surface(config, nodes, self.target, which), off)
            return
        with config.at(config.values_of(config.functions() | {"displacement": self.at})):
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
        """Take the rows; ``off (n,)`` as of ``unite`` (collective)."""
        self.rows, self.tied, self._here, self._lost = rows, np.asarray(rows.has.any(axis=1)), None, True
        self.whole = not reduced(self.config.comm, int((~self.tied & ~off).sum()))

    def untouched(self, state: PairState) -> PairState:
        """The state in which nothing that is tied is in contact."""
        tied, f = self.tied, state.friction
        if f is not None:
            f = replace(f, stick=f.stick & ~tied, tau=np.where(tied[:, None], 0.0, f.tau))
        lam, nodal = (np.where(tied, 0.0, force) for force in (state.lam, state.nodal))
        return replace(state, active=state.active & ~tied, lam=lam, nodal=nodal, friction=f)

    # -- where the contactors stand --------------------------------------------------------------------------------------

    def begin_placement(self) -> bool:
        """The bodies have moved: whether contactors are to be projected; of tied ones that is done once a step, to be told."""
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

    def _equations(self) -> UnitingEquations:
        """Of what is tied, where the bodies are now (collective)."""
        assert self.rows is not None
        if self._here is None:
            self._here = self.rows.equations(self.target.motion)
        return self._here

    def largest_gap_here(self) -> float:
        """Largest component of the way from where a contactor of this rank is tied, a length."""
        return float(np.abs(np.where(self._left_out, 0.0, self.apart())).max(initial=0.0))

    def apart(self) -> Array:
        """How far tied contactors are from where they are tied ``(n, gdim)``; known where the equations have been asked for."""
        way = np.zeros(self._left_out.shape)
        if self.rows is not None and self._here is not None:
            way[self.rows.has] = self._here.gap
        return way

    def kept_gaps(self) -> Array:
        """As of ``Told``."""
        spacers = None if self.rows is None else self.rows.spacers
        return np.zeros(0) if spacers is None else spacers.height

    def torn(self) -> Array:
        """As of ``Told``."""
        return np.linalg.norm(np.where(self._left_out, self.apart(), 0.0), axis=1)

    # -- what the united system gets -------------------------------------------------------------------------------------

    def join(self, contact: Constraints) -> Constraints:
        """Equations of contact, and after them those of what is tied (collective)."""
        return contact if self.rows is None else TiedConstraints.join(contact, *self._uniting())

    def _uniting(self) -> tuple[UnitingEquations, Ints, Ints]:
        """Equations that unite what is tied, their contactors and components ``(m,)`` (collective)."""
        assert self.rows is not None
        i, c = np.nonzero(self.rows.has)
        return self._equations(), i, c

    def set_redundant(self, equations: Constraints, redundant: Bools) -> None:
        """Take which of the equations ``(m,)`` depend on others and were left out."""
        k = len(equations.contact)
        self._left_out = np.zeros_like(self._left_out)
        self._left_out[equations.contactor[k:], equations.kind[k:]] = redundant[k:]

    def with_forces(self, contact: Traction, equations: Constraints, multipliers: Array) -> Traction:
        """Forces of contact, and those of what is tied from the multipliers of all equations ``(m,)`` (collective)."""
        if equations.contact is equations:
            return contact._replace(bond=np.zeros(self._left_out.shape))
        k = len(equations.contact)
        bond = self._bond(equations.contactor[k:], equations.kind[k:], multipliers[k:])
        return contact._replace(force=contact.force + self._on_contactors(bond), bond=bond)

    def _bond(self, contactor: Ints, kind: Ints, multipliers: Array) -> Array:
        """Multipliers of all that is tied ``(n, gdim)``, from those of the equations of ``_uniting (m,)`` (collective)."""
        bond = np.zeros(self._left_out.shape)
        bond[contactor, kind] = multipliers
        return bond

    def _on_contactors(self, bond: Array) -> Array:
        """Forces on the contactors of multipliers ``bond (n, gdim)``: ``(n, gdim)`` (collective)."""
        assert self.rows is not None
        return np.asarray(self.config.add_at_owners(*self.rows.handed_on(self._equations(), bond))[self.nodes])

    def nodal_forces(self, state: PairState, contact: Callable[[PairState], tuple[Ints, Array]]) -> tuple[Ints, Array]:
        """Forces at nodes of both bodies as of ``Kinematics``, which is asked for those of ``contact`` (collective)."""
        if self.rows is None or state.bond is None:
            return contact(state)
        nodes, forces = contact(replace(state, force=state.force - self._on_contactors(state.bond)))
        more = self.rows.handed_on(self._equations(), state.bond)
        return np.concatenate([nodes, more[0]]), np.concatenate([forces, more[1]])

    def curvature(self, state: PairState) -> list[tuple[Ints, Array]]:
        """As of ``Interface``, of gaps that turn with the target (collective)."""
        return [] if self.rows is None or state.bond is None else self.rows.curvature(state.bond)

    @property
    def chained(self) -> bool:
        """As of ``Told``, because of what is tied."""
        return False

    @property
    def works(self) -> bool:
        """As of ``Told``, likewise."""
        return False

    def applied_forces(self) -> tuple[Ints, Array] | None:
        """As of ``Told``."""
        return None

    # -- what is told ----------------------------------------------------------------------------------------------------

    def pressing(self, state: PairState, n: Array, lam: Array, tau: Array) -> tuple[Array, Array]:
        """As of ``Told``, from those of contact and normals ``(n, gdim)``: tied contactors are pulled, too (collective)."""
        if self.rows is None or state.bond is None:
            return lam, tau
        force = state.bond * self.rows.share
        force = np.column_stack([self.discretisation.spread(part) for part in force.T])
        along = np.einsum("ng,ng->n", force, n)
        return np.where(self.tied, along, lam), np.where(self.tied[:, None], force - along[:, None] * n, tau)

    def areas(self, areas: Array, reference: Array, found: Array) -> Array:
        """As of ``Told``, from those of contact ``found (n,)`` (collective)."""
        if self.rows is None:
            return found
        if self.rows.area is None:
            own = self.discretisation.spread(areas)
        else:
            own = self.rows.area * np.where(reference > 0, areas / np.where(reference > 0, reference, 1.0), 1.0)
        return np.where(self.tied, own, found)

    # -- from step to step -----------------------------------------------------------------------------------------------

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """What is tied, and where on a rigid target, as of ``Interface`` (collective)."""
        held = None if self.rows is None else self.rows.held
        return {"tied": self.tied, "held_at": np.zeros(self._left_out.shape) if held is None else held}

    def from_checkpoint(self, kept: Mapping[str, npt.NDArray[Any]], off: Bools) -> None:
        """Go on from what ``to_checkpoint`` returned; ``at`` has been read before; ``off`` as of ``unite`` (collective)."""
        tied = np.array(kept["tied"])
        if reduced(self.config.comm, int(tied.sum())):
            self._make(tied, off)
            assert self.rows is not None
            if self.rows.held is not None:
                self._take_rows(replace(self.rows, held=np.array(kept["held_at"])), off)
