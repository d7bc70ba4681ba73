"""The interface of a contact whose contactors are tied to the target: from the start, or from a given step on.

What is tied has equations of ``tied_rows`` in all components, and no part in contact. What is not, because it was too far away or did
not touch when the others were tied, goes on as contact does.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.bernstein import Bernstein
from uem_dolfinx.contact.interface import Interface
from uem_dolfinx.contact.kinematics import Constraints, Discretisation, Traction
from uem_dolfinx.contact.mortar import Mortar
from uem_dolfinx.contact.node_to_surface import past_end
from uem_dolfinx.contact.sliding import Sliding
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.contact.tied_rows import TiedRows, to_facets, to_means, to_surface
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.parallel import agree, reduced


@dataclass(frozen=True)
class TiedConstraints(Constraints):
    """``Constraints`` of contactors that touch, and after them those of contactors that are tied.

    Attributes:
        contact: those that come first.
    """

    contact: Constraints

    @property
    def tied(self) -> Bools:
        """As of ``Constraints``."""
        return np.arange(len(self)) >= len(self.contact)

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


class Tied(Interface):
    """Contactors that are tied to the target, besides what an interface is; other arguments as those of ``Interface``.

    Args:
        means: discretisation by which means are found when contactors are tied, which serves nothing else; None ties nodes.
        reach: contactors that are tied at the start are no farther from the target, a length; None is a side of its facet.

    Attributes:
        rows: of what is tied; None before.
        whole: whether no contactor is left for contact, on any rank.
        at: displacement at which they were tied.
    """

    def __init__(
        self,
        config: Configuration,
        nodes: Indices,
        discretisation: Discretisation,
        friction: Sliding | None = None,
        *,
        means: Mortar | None,
        reach: float | None,
        **of: Any,
    ):
        super().__init__(config, nodes, discretisation, friction, **of)
        self._means, self._reach = means, reach
        self.rows: TiedRows | None = None
        self.whole = False
        self.at = fem.Function(config.V, name="tied_at")
        none = np.zeros((len(nodes), config.gdim))
        self.trial = self.committed = replace(self.trial, bond=none)
        #: Components whose equations depend on others and were left out ``(n, gdim)``.
        self._left_out: Bools = none > 0
        #: Equations where the bodies have been placed last, and whether a placement is to find contactors again that no contact needs.
        self._here: UnitingEquations | None = None
        self._lost = True

    # -- tying -----------------------------------------------------------------------------------------------------------

    def tie(self, which: Bools | None = None) -> None:
        """Tie contactors where they are now: those within reach, or ``which (n,)``; to be followed by ``project`` (collective).

        Raises:
            SurfaceError: if there are none.
        """
        state, f = self.committed, self.committed.friction
        drag = 0.0 if f is None else f.tau
        forces = state.lam[:, None] * self.projection.normal + drag if self._means else state.force
        self.at.x.array[:] = self.config.displacement.ravel()
        self._make(self._within_reach() if which is None else which)
        assert self.rows is not None
        error = None
        if not reduced(self.config.comm, int(self.tied.sum())):
            what = "is near enough to the target" if which is None else "touches the target"
            error = SurfaceError(
                f"{self.name}: no contactor {what} to be tied to it: bring the surfaces together, or give a larger adjust"
            )
        agree(self.config.comm, error)
        self.reserved = self.reserved & ~self.tied
        bond = np.where(self.rows.has, forces / np.where(self.rows.share > 0, self.rows.share, 1.0), 0.0)
        self.committed = self._untouched(replace(state, bond=bond))
        self.restore()

    def _within_reach(self) -> Bools:
        """Contactors near enough to the target to be tied ``(n,)`` (collective)."""
        p = self.target.project(self.points)
        reach = p.facet_size if self.target.n_nodes else self.max_penetration
        near = np.abs(p.gap) <= (reach if self._reach is None else self._reach)
        return np.asarray(near if self._means else near & ~past_end(p, self.committed, np.inf))

    def _make(self, which: Bools) -> None:
        """Rows of contactors ``which (n,)`` where they were at the displacement ``at``, or are on a rigid target (collective)."""
        config, nodes, kept = self.config, self.nodes, self.sliding != "finite"
        if not self.target.n_nodes:
            self._take_rows(to_surface(config, nodes, self.target, which))
            return
        with config.at(config.values_of(config.functions() | {"displacement": self.at})):
            if self._means is not None:
                self._means.let_go()
                found = self._means.place(self.points, PairState.initial(len(nodes), config.gdim))
                rows = to_means(self._means, found.rows, which, kept)
                self._means.let_go()
            else:
                assert isinstance(self.target, MeshTarget)
                rows = to_facets(config, nodes, self.target, self.target.project(self.points), which, kept)
        self._take_rows(rows)

    def _take_rows(self, rows: TiedRows) -> None:
        self.rows, self.tied, self._here, self._lost = rows, np.asarray(rows.has.any(axis=1)), None, True
        left = ~self.tied & ~super().off
        self.whole = not reduced(self.config.comm, int(left.sum()))

    def _untouched(self, state: PairState) -> PairState:
        """The state in which nothing that is tied is in contact."""
        tied, f = self.tied, state.friction
        if f is not None:
            f = replace(f, stick=f.stick & ~tied, tau=np.where(tied[:, None], 0.0, f.tau))
        lam, nodal = (np.where(tied, 0.0, force) for force in (state.lam, state.nodal))
        return replace(state, active=state.active & ~tied, lam=lam, nodal=nodal, friction=f)

    # -- where the contactors stand --------------------------------------------------------------------------------------

    def project(self) -> None:
        """As of ``Interface``; tied contactors need no search, but once a step for what is told of them (collective)."""
        self._here = None
        if self._lost or not self.whole:
            super().project()
            self._lost = False

    @property
    def off(self) -> Bools:
        """As of ``Interface``, and all that are tied."""
        return super().off | self.tied

    def _equations(self) -> UnitingEquations:
        """Of what is tied, where the bodies are now (collective)."""
        assert self.rows is not None
        if self._here is None:
            self._here = self.rows.equations(self.target.motion)
        return self._here

    def largest_gap_here(self) -> float:
        """As of ``Interface``, or the largest component of the way from where a contactor is tied."""
        here = super().largest_gap_here()
        if self.rows is None:
            return here
        apart = np.where(self._left_out, 0.0, self.apart())
        return max(here, float(np.abs(apart).max(initial=0.0)))

    def apart(self) -> Array:
        """How far tied contactors are from where they are tied ``(n, gdim)``; known where the equations have been asked for."""
        way = np.zeros(self._left_out.shape)
        if self.rows is not None and self._here is not None:
            way[self.rows.has] = self._here.gap
        return way

    def kept_gaps(self) -> Array:
        """As of ``Interface``."""
        spacers = None if self.rows is None else self.rows.spacers
        return np.zeros(0) if spacers is None else spacers.height

    def torn(self) -> Array:
        """How far contactors are from where they are tied if their equations were left out ``(n,)``."""
        return np.linalg.norm(np.where(self._left_out, self.apart(), 0.0), axis=1)

    # -- what the united system gets -------------------------------------------------------------------------------------

    def equations(self) -> Constraints:
        """As of ``Interface``, and after those of contact those of what is tied (collective)."""
        own = super().equations()
        return own if self.rows is None else TiedConstraints.join(own, *self._uniting())

    def _uniting(self) -> tuple[UnitingEquations, Ints, Ints]:
        """Equations that unite what is tied, their contactors and components ``(m,)`` (collective)."""
        assert self.rows is not None
        i, c = np.nonzero(self.rows.has)
        return self._equations(), i, c

    def set_redundant(self, equations: Constraints, redundant: Bools) -> None:
        """As of ``Interface``."""
        if not isinstance(equations, TiedConstraints):
            super().set_redundant(equations, redundant)
            return
        k = len(equations.contact)
        super().set_redundant(equations.contact, redundant[:k])
        self._left_out = np.zeros_like(self._left_out)
        self._left_out[equations.contactor[k:], equations.kind[k:]] = redundant[k:]

    def forces(self, equations: Constraints, multipliers: Array, du: Array | None = None) -> Traction:
        """As of ``Interface``, with the multipliers of what is tied (collective)."""
        if not isinstance(equations, TiedConstraints):
            return super().forces(equations, multipliers, du)._replace(bond=np.zeros(self._left_out.shape))
        k = len(equations.contact)
        bond = self._bond(equations.contactor[k:], equations.kind[k:], multipliers[k:])
        found = super().forces(equations.contact, multipliers[:k], du)
        return found._replace(force=found.force + self._on_contactors(bond), bond=bond)

    def _bond(self, contactor: Ints, kind: Ints, multipliers: Array) -> Array:
        """Multipliers of all that is tied ``(n, gdim)``, from those of the equations of ``_uniting (m,)`` (collective)."""
        bond = np.zeros(self._left_out.shape)
        bond[contactor, kind] = multipliers
        return bond

    def _on_contactors(self, bond: Array) -> Array:
        """Forces on the contactors of multipliers ``bond (n, gdim)``: ``(n, gdim)`` (collective)."""
        assert self.rows is not None
        return np.asarray(self.config.add_at_owners(*self.rows.handed_on(self._equations(), bond))[self.nodes])

    @property
    def traction(self) -> Traction:
        """As of ``Interface``."""
        return super().traction._replace(bond=self.trial.bond)

    def with_forces(self, found: Traction) -> PairState:
        """As of ``Interface``."""
        return replace(super().with_forces(found), bond=found.bond)

    def nodal_forces(self, state: PairState) -> tuple[Ints, Array]:
        """As of ``Interface`` (collective)."""
        if self.rows is None or state.bond is None:
            return super().nodal_forces(state)
        nodes, forces = super().nodal_forces(replace(state, force=state.force - self._on_contactors(state.bond)))
        more = self.rows.handed_on(self._equations(), state.bond)
        return np.concatenate([nodes, more[0]]), np.concatenate([forces, more[1]])

    def curvature(self) -> list[tuple[Ints, Array]]:
        """As of ``Interface``, and of gaps that turn with the target (collective)."""
        parts = super().curvature()
        return parts if self.rows is None or self.trial.bond is None else parts + self.rows.curvature(self.trial.bond)

    # -- what is told ----------------------------------------------------------------------------------------------------

    def pressing(self) -> tuple[Array, Array]:
        """As of ``Interface``: tied contactors are pulled, too (collective)."""
        lam, tau = super().pressing()
        if self.rows is None or self.trial.bond is None:
            return lam, tau
        force = self.trial.bond * self.rows.share
        if isinstance(self.discretisation, Bernstein):
            force = np.column_stack([self.discretisation.family.spread(part) for part in force.T])
        n = self.projection.normal
        along = np.einsum("ng,ng->n", force, n)
        return np.where(self.tied, along, lam), np.where(self.tied[:, None], force - along[:, None] * n, tau)

    def areas(self, areas: Array, current: bool, reference: Array) -> Array:
        """As of ``Interface`` (collective)."""
        found = super().areas(areas, current, reference)
        if self.rows is None:
            return found
        if isinstance(self.discretisation, Bernstein):
            own = self.discretisation.family.spread(areas)
        elif self.rows.area is None:
            own = areas
        else:
            own = self.rows.area * np.where(reference > 0, areas / np.where(reference > 0, reference, 1.0), 1.0)
        return np.where(self.tied, own, found)

    # -- from step to step -----------------------------------------------------------------------------------------------

    def restore(self) -> None:
        """As of ``Interface``."""
        super().restore()
        self._lost = True

    def remember(self, memory: tuple[PairState, Bools, Bools, Bools]) -> None:
        """As of ``Interface``; what has been tied since then stays so."""
        super().remember(memory)
        self.committed, self.reserved = self._untouched(self.committed), self.reserved & ~self.tied
        self.restore()

    @property
    def functions(self) -> dict[str, fem.Function]:
        """As of ``Interface``."""
        return {"displacement it was tied at": self.at}

    def to_checkpoint(self) -> dict[str, npt.NDArray[Any]]:
        """As of ``Interface``, with what is tied, and where on a rigid target (collective)."""
        held = None if self.rows is None else self.rows.held
        return super().to_checkpoint() | {"tied": self.tied, "held_at": np.zeros(self._left_out.shape) if held is None else held}

    def from_checkpoint(self, kept: Mapping[str, npt.NDArray[Any]]) -> None:
        """As of ``Interface``; ``at`` has been read before (collective)."""
        tied = np.array(kept["tied"])
        if reduced(self.config.comm, int(tied.sum())):
            self._make(tied)
            assert self.rows is not None
            if self.rows.held is not None:
                self._take_rows(replace(self.rows, held=np.array(kept["held_at"])))
        super().from_checkpoint(kept)
