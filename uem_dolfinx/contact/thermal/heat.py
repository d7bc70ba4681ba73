"""Heat through the contact of one interface: what leaves contactors enters the target by the same weights, and heat that friction makes.

The temperature is a field beside the displacement. At every contactor i the power ``q_i A_i`` with ``q_i = h (T_i - sum_a N_a T_a)`` stands
in the field's equations, at the contactor and with the opposite sign at what it faces. With rows ``v_i`` that make jumps of the
unknowns these are ``sum_i v_i q_i A_i``, and their derivative is ``sum_i A_i h v_i v_i'``, symmetric. A conductance h(p, g) adds
``sum_i A_i (T_i - sum_a N_a T_a) v_i (dh/dp p_i' + dh/dg g_i')``, with differences for dh/dp and dh/dg, gaps that change by
``n (du_i - sum_a N_a du_a)``, and pressures by the rows of K at the contactors, over their areas. Pressures in h, and the heat of friction,
are those that the last linearised problem has predicted. Perfect conductance unites temperatures, ``v_i' T = 0``, as gaps are
closed: one unknown of each contactor that touches is eliminated, and the heat is the equation's multiplier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.laws.conductance import Conductance, value
from uem_dolfinx.contact.seam.active_set import GAP_ROUNDING
from uem_dolfinx.contact.seam.placement import NORMAL, Constraints, Discretisation, Kinematics
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.contact.thermal.sides import Sides, sides_of
from uem_dolfinx.errors import InputError, SpaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.fields import ConfigurationAmongFields
from uem_dolfinx.geometry.nodal_fields import nodal_field
from uem_dolfinx.geometry.projection import Projection, Target
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.sliding import Sliding


#: A conductance is differentiated over so much of the largest pressure, or of the largest gap.
#: [derived; largest pressure or gap; test_heat.py::test_the_tangent_by_gaps_and_pressures]
OF_CONDUCTANCE = np.finfo(float).eps ** 0.5


class Pair(Protocol):
    """What heat asks of an interface; attributes as those of ``Interface``."""

    name: str
    config: Configuration
    nodes: Indices
    trial: PairState
    committed: PairState
    kinematics: Kinematics
    discretisation: Discretisation
    friction: Sliding | None
    reserved: Bools

    @property
    def asked(self) -> bool:
        """Whether any contactor on any rank is in question, as placed last."""

    @property
    def target(self) -> Target:
        """What the contactors may touch."""

    @property
    def projection(self) -> Projection:
        """Of the contactors, as last placed."""

    @property
    def united(self) -> Bools:
        """Contactors that are active or tied ``(n,)``."""

    @property
    def off(self) -> Bools:
        """Contactors that have slid past an end of the target ``(n,)``."""


class Declared(Protocol):
    """What heat asks of the contact; as those of ``ContactResults``."""

    measure: str

    def areas_facing(self, nodes: Indices, normal: Array | None, current: bool) -> Array:
        """Areas of contactors towards the target ``(n,)`` (collective)."""

    def measured_areas(self) -> Array:
        """Areas that pressures are forces over ``(n,)``, zero where there is none (collective)."""

    def pressing(self) -> tuple[Array, Array]:
        """Forces across ``(n,)`` and along ``(n, gdim)`` the target (collective)."""

    def leads(self) -> Bools:
        """Contactors through which heat passes ``(n,)`` (collective)."""


@dataclass(frozen=True)
class Passage(Sides):
    """What is opposite to contactors at one placement.

    Attributes:
        areas: that heat passes through ``(n,)``.
        force: contact forces over multipliers, as of ``PressureMap`` ``(n,)``.
        leads: contactors that it passes where they touch ``(n,)``.
    """

    areas: Array
    force: Array
    leads: Bools

    @property
    def jump(self) -> Array:
        """By what the contactor's mean exceeds the target's ``(k,)``."""
        return self.own - self.theirs


class HeatEquations(NamedTuple):
    """Uniting equations of temperatures.

    Attributes:
        rows: the equations ``(m,)``.
        which: places of their contactors ``(m,)``.
        own: by what they were divided, the part of the contactor's own unknown in its mean ``(m,)``.
    """

    rows: UnitingEquations
    which: Ints
    own: Array


class Heat:
    """Heat through one interface.

    Args:
        pair: the interface.
        law: what conducts.
        contact: which tells areas and pressures.
        column: of ``PairState.heat``, of a perfect conductance.

    Raises:
        InputError, SpaceError: if there is no such field, or if the target's temperature is not known, or given twice.
    """

    def __init__(self, pair: Pair, law: Conductance, contact: Declared, column: int = 0):
        words, config = f"contact '{pair.name}': heat", pair.config
        if not isinstance(config, ConfigurationAmongFields):
            raise InputError(
                f"{words} needs a temperature among the unknowns: expected a mixed Function with displacement= its displacement's part"
            )
        if pair.target.n_nodes and law.temperature is not None:
            raise InputError(f"{words}: temperature is of a rigid target, and a mesh has its own: leave it out")
        if not pair.target.n_nodes and law.temperature is None:
            raise InputError(f"{words}: a rigid target has no temperature of its own: give temperature, a number or a Constant")
        if law.friction_share is not None and pair.friction is None:
            raise InputError(
                f"{words}: friction_share = {law.friction_share} is a part of no heat, since the contact has no friction: leave it out"
            )
        self.law, self.field, self._pair = law, nodal_field(config, law.field, words), pair
        self._contact, self._column = contact, column
        if law.perfect and self.field.weights.shape[1] > 1:
            raise SpaceError(
                f"{words}: h = inf unites temperatures at the displacement's nodes: give the field the displacement's degree"
            )
        #: Contactors whose temperatures could not be united, since conditions prescribe all of them ``(n,)``.
        self._held: Bools = np.zeros(len(pair.nodes), dtype=bool)
        self._passage: Passage | None = None

    @property
    def lags(self) -> bool:
        """Whether heat depends on contact forces, which an iteration takes from the one before."""
        return callable(self.law.h) or self.law.friction_share is not None

    # -- perfect conductance ---------------------------------------------------------------------------------------------

    def equations(self) -> HeatEquations:
        """Of the temperatures of contactors that touch, and of those that may, which only keep their place (collective)."""
        pair, at, g = self._pair, self.passage, self._pair.config.gdim
        which = np.flatnonzero((pair.united | pair.reserved) & at.leads)
        place = np.full(len(pair.nodes), -1, dtype=np.int64)
        place[which] = np.arange(len(which))
        known: Any = at.halo.take(self.field.terms)
        number, weight, row = known[:, 0].astype(np.int64), at.jump * known[:, 1], place[at.row]
        here = self.field.config.unknowns.numbers[self.field.unknowns[pair.nodes[which], 0]]
        kept = row >= 0
        number, weight, row = number[kept], weight[kept], row[kept]
        itself = number == here[row]
        own = np.zeros(len(which))
        np.add.at(own, row[itself], weight[itself])
        direction, coefficients = np.zeros((len(which), g)), np.zeros((int((~itself).sum()), g))
        direction[np.arange(len(which)), here % g] = 1.0
        row, number = row[~itself], number[~itself]
        coefficients[np.arange(len(row)), number % g] = -weight[~itself] / own[row]
        node = here // g - self.field.config.unknowns.first
        rows = UnitingEquations(
            node.astype(np.int32), direction, self.jump()[which] / own, pair.united[which], row, number // g, coefficients
        )
        return HeatEquations(rows, which, own)

    def read(self, equations: HeatEquations, multipliers: Array, redundant: Bools) -> Array:
        """Power that goes from the contactors to the target ``(n,)``, from the multipliers of equations, some left out, ``(m,)``."""
        power = np.zeros(len(self._pair.nodes))
        power[equations.which] = -multipliers / equations.own
        self._held = np.zeros(len(power), dtype=bool)
        self._held[equations.which] = redundant
        return power

    def torn(self) -> float:
        """Largest jump of temperatures that are united, over the largest temperature there (collective)."""
        if not self.law.perfect:
            return 0.0
        at = self.passage
        united = self._pair.united & at.leads & ~self._held
        hot = at.means(at.own, np.abs(self.field.values)) + at.means(at.theirs, np.abs(self.field.values))
        both = np.array([np.abs(self.jump()[united]).max(initial=0.0), hot[united].max(initial=0.0)])
        jump, size = reduced(self._pair.config.comm, both, op=MPI.MAX)
        return float(jump / size) if size > 0 else 0.0

    # -- finite conductance ----------------------------------------------------------------------------------------------

    @property
    def passage(self) -> Passage:
        """Of the last placement (collective)."""
        # a projection that is the same on one rank is so on all
        if self._passage is None or self._passage.projection is not self._pair.projection:
            pair, current = self._pair, self._contact.measure == "current"
            areas = self._contact.areas_facing(pair.nodes, pair.projection.normal, current)
            pressures, leads = pair.kinematics.pressure_map(current), self._contact.leads()
            self._passage = Passage(**vars(sides_of(pair)), areas=pressures.of_means(areas), force=pressures.force, leads=leads)
        return self._passage

    def conductances(self) -> Array:
        """At the contactors ``(n,)``, none past an end of the target (collective)."""
        return self._conductances(*self._pressures_and_gaps())

    def _pressures_and_gaps(self) -> tuple[Array, Array]:
        """At the contactors ``(n,)`` each, of which one is zero (collective)."""
        closed = self._pair.united
        p, g = np.zeros(len(closed)), np.where(closed, 0.0, np.maximum(self._pair.projection.gap, 0.0))
        if callable(self.law.h):
            # while contact is not settled, and where ties pull, forces may be negative
            p = np.where(closed, np.maximum(self._contact.pressing()[0], 0.0) * self._per_area(), 0.0)
        return p, g

    def _per_area(self) -> Array:
        """Pressures over forces ``(n,)`` (collective)."""
        areas = self._contact.measured_areas()
        return np.where(areas > 0, 1.0 / np.where(areas > 0, areas, 1.0), 0.0)

    def _conductances(self, p: Array, g: Array) -> Array:
        pair, closed = self._pair, self._pair.united
        h = self.law.conductances(pair.config.comm, pair.name, p, g, closed)
        return np.where((closed | ~pair.off) & self.passage.leads, h, 0.0)

    def _slopes(self) -> Array:
        """Derivatives of the power with the pressures of closed contactors, and with the gaps of open ones ``(n,)`` (collective)."""
        p, g = self._pressures_and_gaps()
        largest = reduced(self._pair.config.comm, np.array([np.abs(p).max(initial=0.0), g.max(initial=0.0)]), op=MPI.MAX)
        at_p, at_g = OF_CONDUCTANCE * largest
        more = np.where(self._pair.united, at_p, np.where(self._pair.projection.gap > 0.0, at_g, 0.0))
        ahead = self._conductances(p + np.where(self._pair.united, more, 0.0), g + np.where(self._pair.united, 0.0, more))
        slopes = (ahead - self._conductances(p, g)) / np.where(more > 0.0, more, 1.0)
        return np.asarray(slopes * self.jump() * self.passage.areas)

    def jump(self) -> Array:
        """By what contactors are hotter than the target ``(n,)`` (collective)."""
        at = self.passage
        rigid = 0.0 if self.law.temperature is None else value(self.law.temperature)
        return at.means(at.jump, self.field.values) - rigid

    def power(self) -> Array:
        """That goes from the contactors to the target ``(n,)`` (collective)."""
        if self.law.perfect:
            assert self._pair.trial.heat is not None
            return self._pair.trial.heat[:, self._column]
        return np.asarray(self.conductances() * self.jump() * self.passage.areas)

    def flux(self) -> Array:
        """The same per area ``(n,)`` (collective)."""
        if not self.law.perfect:
            return np.asarray(self.conductances() * self.jump())
        # shape functions of degree 2 have no integral at some nodes
        through = np.where(self._pair.united & self.passage.leads, self.passage.areas, 0.0)
        power, areas = (self._pair.discretisation.spread(part) for part in (self.power(), through))
        return np.where(areas > 0, power / np.where(areas > 0, areas, 1.0), 0.0)

    def friction(self) -> Array:
        """Power that the work of friction in the present step is ``(n,)`` (collective)."""
        pair, state = self._pair, self._pair.trial.friction
        assert pair.friction is not None and state is not None
        work = pair.friction.step(pair.trial, pair.committed, pair.kinematics)[-1]
        # means that stick slip by rounding of places
        slips = np.abs(work) > GAP_ROUNDING * pair.config.size * np.linalg.norm(state.tau, axis=1)
        return np.where(slips, work, 0.0) / value(self.law.dt)

    def nodal(self) -> tuple[Array, Array]:
        """Power that passes from the contactors to the target, as what owned nodes lose, and what friction heats them by ``(n_owned,)``.

        Collective.
        """
        if not self._pair.asked:
            none = np.zeros(self._pair.config.n_owned)
            return none, none
        at = self.passage
        passing = at.hand_on(at.jump, self.power())
        if self.law.friction_share is None:
            return passing, np.zeros_like(passing)
        share = self.law.friction_share
        return passing, at.hand_on(share * at.own + (1.0 - share) * at.theirs, self.friction())

    def sizes(self) -> Array:
        """Sizes of what the heat's terms are differences of, in the rows of vectors ``(n_rows * gdim,)`` (collective)."""
        at, pair, hot = self.passage, self._pair, np.abs(self.field.values)
        size = np.zeros(len(at.areas))
        if not self.law.perfect:
            size = self.conductances() * at.areas * (at.means(at.own, hot) + at.means(at.theirs, hot))
        if self.law.friction_share is not None and pair.trial.friction is not None:
            # slips are differences of places
            size = size + pair.config.size * np.linalg.norm(pair.trial.friction.tau, axis=1) / value(self.law.dt)
        return self.field.rows(at.hand_on(at.own + at.theirs, size))

    def residual(self) -> Array:
        """What heat adds to the residual, in the rows of vectors ``(n_rows * gdim,)`` (collective)."""
        passing, made = self.nodal()
        # what equations hand on stands in no residual
        return self.field.rows(-made if self.law.perfect else passing - made)

    def tangent(self) -> list[tuple[Ints, Array]]:
        """Derivatives of that with temperatures and gaps (collective).

        Returns:
            Pairs of global rows ``(k, m)``, -1 for none, and blocks ``(k, m gdim, m gdim)``.
        """
        at, jumps = self.passage, self._jumps()
        kappa = np.zeros(len(at.areas)) if self.law.perfect else self.conductances() * at.areas
        found = [_dyads(kappa, jumps, jumps)]
        if callable(self.law.h):
            opening = at.jump[:, None] * self._pair.projection.normal[at.row]
            slopes = np.where(self._pair.united, 0.0, self._slopes())
            found.append(_dyads(slopes, jumps, Terms(at.row, at.node, opening)))
        return found

    def by_forces(self, equations: Constraints, lift: Array) -> tuple[Ints, Array]:
        """Derivatives of that with forces F at the contactors, of which multipliers are ``lift F``, as of ``tangent`` (collective).

        None of degree 2, where pressures are those of several contactors' forces.

        Args:
            equations: of the interface, in the present state.
            lift: of each ``(m, gdim)``.
        """
        pair, config = self._pair, self._pair.config
        slopes = np.where(pair.trial.active & (config.degree == 1), self._slopes(), 0.0)
        weights, own = slopes * self._per_area() * self.passage.force, equations.kind == NORMAL
        which = equations.contactor[own]
        return _dyads(weights, self._jumps(), Terms(which, config.to_global(pair.nodes[which]), lift[own]))

    def _jumps(self) -> Terms:
        """By which unknowns contactors are hotter than the target (collective)."""
        at, g = self.passage, self._pair.config.gdim
        known: Any = at.halo.take(self.field.terms)
        number, weight = np.hsplit(known, 2)
        some = weight != 0
        row = np.broadcast_to(at.row[:, None], weight.shape)[some]
        number, weight = number[some].astype(np.int64), (at.jump[:, None] * weight)[some]
        vector = np.zeros((len(row), g))
        vector[np.arange(len(row)), number % g] = weight
        return Terms(row, number // g, vector)


def heats_of(pair: Pair, laws: Sequence[Conductance], contact: Declared) -> list[Heat]:
    """What conductances let through an interface, which is given room for the powers of those that are perfect (collective).

    Raises:
        InputError, SpaceError: as ``Heat``.
    """
    columns = np.cumsum([law.perfect for law in laws])
    if columns[-1]:
        pair.trial = pair.committed = replace(pair.committed, heat=np.zeros((len(pair.nodes), columns[-1])))
    return [Heat(pair, law, contact, column - 1) for law, column in zip(laws, columns.tolist())]


class Terms(NamedTuple):
    """Linear functions of the unknowns, one for each contactor, by their terms.

    Attributes:
        row: place of the contactor ``(k,)``.
        node: global row of vectors ``(k,)``.
        vector: of the components there ``(k, gdim)``.
    """

    row: Ints
    node: Ints
    vector: Array


def _dyads(scale: Array, left: Terms, right: Terms) -> tuple[Ints, Array]:
    """``sum_i scale_i v_i w_i'`` of linear functions v and w of contactors, by blocks as those of ``Heat.tangent``."""
    row, node = (np.concatenate(both) for both in zip(left[:2], right[:2]))
    some = np.flatnonzero(scale[row] != 0.0)
    # terms of each contactor side by side
    order = some[np.argsort(row[some], kind="stable")]
    which, first, i = np.unique(row[order], return_index=True, return_inverse=True)
    place = np.arange(len(order)) - first[i]
    rows = np.full((len(which), int(place.max(initial=-1)) + 1), -1, dtype=np.int64)
    rows[i, place] = node[order]
    of_left, g = order < len(left.row), left.vector.shape[1]
    vectors, both = np.concatenate([left.vector, right.vector])[order], np.zeros((2, *rows.shape, g))
    both[0, i, place], both[1, i, place] = vectors * of_left[:, None], vectors * ~of_left[:, None]
    v, w = both.reshape(2, len(which), rows.shape[1] * g)
    return rows, scale[which, None, None] * v[:, :, None] * w[:, None, :]
