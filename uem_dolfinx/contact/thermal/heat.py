"""Heat conduction through one interface, conservative by the weights of the contact, and heat of friction and of currents.

The temperature is a further field of the mixed space. The power ``q_i A_i`` with ``q_i = h (T_i - sum_a N_a T_a)`` enters the
field's equations at contactor i, and with opposite sign at the opposite nodes. With rows ``v_i`` for the jumps of the unknowns,
these terms are ``sum_i v_i q_i A_i`` with the symmetric derivative ``sum_i A_i h v_i v_i'``. A conductance h(p, g, T, T_target)
adds ``sum_i A_i (T_i - sum_a N_a T_a) v_i (dh/dp p_i' + dh/dg g_i' + dh/dT T_i' + dh/dT_target T_target,i')``. Derivatives of h
are finite differences, gaps change by ``n (du_i - sum_a N_a du_a)``, and pressures by the rows of K at the contactors over their
areas. Pressures in h, and frictional heat, are the prediction of the last linearised problem. Perfect conductance is the
constraint ``v_i' T = 0``: one unknown of each touching contactor is eliminated, and the heat flow is the multiplier.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.laws.conductance import Conductance
from uem_dolfinx.contact.laws.soft import value
from uem_dolfinx.contact.seam.placement import ContactRows, Discretisation, Kinematics
from uem_dolfinx.contact.seam.relative_motion import Terms, dyads
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.contact.thermal.sides import Sides, sides_of
from uem_dolfinx.contact.thermal.sources import FrictionalHeat, JouleHeat, Source
from uem_dolfinx.errors import InputError, SpaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.fields import ConfigurationAmongFields, NodalField, nodal_field
from uem_dolfinx.geometry.projection import Target
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.friction.sliding import Sliding


#: A conductance is differentiated over so much of the largest pressure, gap or temperature.
#: [derived; largest pressure, gap or temperature; test_heat.py::test_the_tangent_by_gaps_and_pressures]
OF_CONDUCTANCE = np.finfo(float).eps ** 0.5


class Pair(Protocol):
    """Members of an interface that heat needs; attributes as in ``Interface``."""

    name: str
    config: Configuration
    nodes: Indices
    trial: PairState
    committed: PairState
    kinematics: Kinematics
    discretisation: Discretisation
    friction: Sliding | None

    @property
    def in_reach(self) -> bool:
        """Whether any contactor on any rank was near the target in the last placement."""

    @property
    def target(self) -> Target:
        """Target of the contactors."""

    @property
    def united(self) -> Bools:
        """Contactors that are active or tied ``(n,)``."""

    @property
    def off(self) -> Bools:
        """Contactors that have slid past an end of the target ``(n,)``."""


class Declared(Protocol):
    """Members of a contact that heat needs; as in ``ContactResults``."""

    measure: str

    def areas_facing(self, nodes: Indices, normal: Array | None, current: bool) -> Array:
        """Areas of contactors that face the target ``(n,)`` (collective)."""

    def measured_areas(self) -> Array:
        """Areas for pressures ``(n,)``, zero where there is no area (collective)."""

    def pressing(self) -> tuple[Array, Array]:
        """Normal ``(n,)`` and tangential forces ``(n, gdim)`` (collective)."""

    def leads(self) -> Bools:
        """Contactors that conduct heat ``(n,)`` (collective)."""


@dataclass(frozen=True)
class Passage(Sides):
    """Heat flow of one placement: the nodes opposite to contactors, and areas."""

    areas: Array  # areas for heat flow ``(n,)``
    force: Array  # contact forces over multipliers, see ``PressureMap`` ``(n,)``
    leads: Bools  # contactors that conduct heat when they touch ``(n,)``

    @property
    def jump(self) -> Array:
        """Weights of the contactor's mean minus the target's mean ``(k,)``."""
        return self.own - self.theirs


class HeatEquations(NamedTuple):
    """Constraint equations of temperatures."""

    rows: UnitingEquations  # the equations ``(m,)``
    which: Ints  # indices of their contactors ``(m,)``
    own: Array  # divisor of each equation, the weight of the contactor's own unknown in its mean ``(m,)``


class Heat:
    """Heat through one interface.

    Args:
        law: conductance.
        contact: source of areas and pressures.
        column: column of ``PairState.heat``, for a perfect conductance.

    Raises:
        InputError, SpaceError: if the field does not exist, or if the target's temperature is missing or given twice.
    """

    #: Numbers of the arguments of h that gaps change; pressures of hard contact are unknowns of their own.
    _of_gaps: tuple[int, ...] = (1,)

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
        self.law, self.field, self.pair = law, nodal_field(config, law.field, words), pair
        self._contact, self._column = contact, column
        #: Heat that the contact itself makes.
        self.sources: list[Source] = [] if law.friction_share is None else [FrictionalHeat(self, law.friction_share)]
        self._of = nodal_field(config, law.field_of_h, words)
        if law.temperature is not None and law.field_of_h != law.field:
            raise InputError(
                f"{words}: of_field = {law.of_field}, and a rigid target has no values of that field: expected h(p, g), or a meshed target"
            )
        if law.perfect and self.field.weights.shape[1] > 1:
            raise SpaceError(
                f"{words}: h = inf unites temperatures at the displacement's nodes: give the field the displacement's degree"
            )
        #: Contactors without a temperature constraint, since conditions prescribe all of its unknowns ``(n,)``.
        self._held: Bools = np.zeros(len(pair.nodes), dtype=bool)
        self._passage: Passage | None = None

    @property
    def lags(self) -> bool:
        """Whether heat depends on contact forces, which are taken from the previous iteration."""
        return callable(self.law.h) or any(source.lags for source in self.sources)

    # -- perfect conductance ---------------------------------------------------------------------------------------------

    def equations(self) -> HeatEquations:
        """Equations for temperatures of touching contactors; contactors that may touch have inactive equations (collective)."""
        pair, at, g = self.pair, self.passage, self.pair.config.gdim
        which = np.flatnonzero((pair.united | pair.trial.reserved) & at.leads)
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
        """Power from the contactors to the target ``(n,)``, from the multipliers of equations ``(m,)``, of which some are ``redundant``."""
        power = np.zeros(len(self.pair.nodes))
        power[equations.which] = -multipliers / equations.own
        self._held = np.zeros(len(power), dtype=bool)
        self._held[equations.which] = redundant
        return power

    def torn(self) -> float:
        """Largest violation of the temperature constraints, over the largest temperature there (collective)."""
        if not self.law.perfect:
            return 0.0
        at = self.passage
        united = self.pair.united & at.leads & ~self._held
        hot = at.means(at.own, np.abs(self.field.values)) + at.means(at.theirs, np.abs(self.field.values))
        both = np.array([np.abs(self.jump()[united]).max(initial=0.0), hot[united].max(initial=0.0)])
        jump, size = reduced(self.pair.config.comm, both, op=MPI.MAX)
        return float(jump / size) if size > 0 else 0.0

    # -- finite conductance ----------------------------------------------------------------------------------------------

    @property
    def passage(self) -> Passage:
        """Heat flow of the last placement (collective)."""
        # projections are identical on all ranks or on none
        if self._passage is None or self._passage.projection is not self.pair.kinematics.projection:
            pair, current = self.pair, self._contact.measure == "current"
            areas = self._contact.areas_facing(pair.nodes, pair.kinematics.projection.normal, current)
            pressures, leads = pair.kinematics.pressure_map(current), self._contact.leads()
            self._passage = Passage(**vars(sides_of(pair)), areas=pressures.of_means(areas), force=pressures.force, leads=leads)
        return self._passage

    def conductances(self) -> Array:
        """Conductances at the contactors ``(n,)``, zero past an end of the target (collective)."""
        return self._conductances(*self._state())

    def _state(self) -> tuple[Array, ...]:
        """What h is a function of at the contactors ``(n,)``: pressures and gaps, one of the two zero, and temperatures (collective)."""
        closed = self.pair.united
        p, g = np.zeros(len(closed)), np.where(closed, 0.0, np.maximum(self.pair.kinematics.projection.gap, 0.0))
        if callable(self.law.h):
            # forces may be negative before the active set has converged, and at ties
            p = np.where(closed, np.maximum(self._contact.pressing()[0], 0.0) * self._per_area(), 0.0)
        return (p, g, *self._temperatures()) if self.law.of_temperatures else (p, g)

    def _temperatures(self) -> tuple[Array, Array]:
        """Means of ``of_field`` on both sides ``(n,)``; contactors without a target get their own value twice (collective)."""
        at = self.passage
        own = at.means(self._shares(at.own), self._of.values)
        if self.law.temperature is not None:
            return own, np.full(len(own), value(self.law.temperature))
        return own, np.where(at.sum(at.theirs) != 0.0, at.means(self._shares(at.theirs), self._of.values), own)

    def _shares(self, weights: Array) -> Array:
        """Weights of a mean ``(k,)`` over their sum."""
        total = self.passage.sum(weights)
        return np.asarray(weights / np.where(total != 0.0, total, 1.0)[self.passage.row])

    def _per_area(self) -> Array:
        """Pressures over forces ``(n,)`` (collective)."""
        areas = self._contact.measured_areas()
        return np.where(areas > 0, 1.0 / np.where(areas > 0, areas, 1.0), 0.0)

    def _conductances(self, *state: Array) -> Array:
        pair, closed = self.pair, self.pair.united
        h = self.law.conductances(pair.config.comm, pair.name, state, closed)
        return np.where((closed | ~pair.off) & self.passage.leads, h, 0.0)

    def _slopes(self, *which: int) -> list[Array]:
        """Derivatives of the power by some arguments of h, each ``(n,)`` (collective)."""
        state = self._state()
        largest = reduced(self.pair.config.comm, np.array([np.abs(part).max(initial=0.0) for part in state]), op=MPI.MAX)
        every = np.ones(len(self.pair.nodes), dtype=bool)
        changes = *self._moving(), every, every
        here, scale, found = self._conductances(*state), self.jump() * self.passage.areas, []
        for k in which:
            more = np.where(changes[k], OF_CONDUCTANCE * largest[k], 0.0)
            ahead = self._conductances(*state[:k], state[k] + more, *state[k + 1 :])
            found.append(np.asarray((ahead - here) / np.where(more > 0.0, more, 1.0) * scale))
        return found

    def _moving(self) -> tuple[Bools, Bools]:
        """Contactors at which the pressure changes, those that are closed, and at which the gap changes, open ones ``(n,)`` each."""
        closed = self.pair.united
        return closed, ~closed & (self.pair.kinematics.projection.gap > 0.0)

    def jump(self) -> Array:
        """Temperature of contactors minus temperature of the target ``(n,)`` (collective)."""
        at = self.passage
        rigid = 0.0 if self.law.temperature is None else value(self.law.temperature)
        return at.means(at.jump, self.field.values) - rigid

    def power(self) -> Array:
        """Power from the contactors to the target ``(n,)`` (collective)."""
        if self.law.perfect:
            assert self.pair.trial.heat is not None
            return self.pair.trial.heat[:, self._column]
        return np.asarray(self.conductances() * self.jump() * self.passage.areas)

    def flux(self) -> Array:
        """Power per area from the contactors to the target ``(n,)`` (collective)."""
        if not self.law.perfect:
            return np.asarray(self.conductances() * self.jump())
        # integrals of shape functions of degree 2 vanish at some nodes
        through = np.where(self.pair.united & self.passage.leads, self.passage.areas, 0.0)
        power, areas = (self.pair.discretisation.spread(part) for part in (self.power(), through))
        return np.where(areas > 0, power / np.where(areas > 0, areas, 1.0), 0.0)

    def nodal(self) -> tuple[Array, Array]:
        """Power that owned nodes lose by conduction, and power that they gain by sources, ``(n_owned,)`` each.

        Collective.
        """
        if not self.pair.in_reach:
            none = np.zeros(self.pair.config.n_owned)
            return none, none
        at = self.passage
        passing = at.hand_on(at.jump, self.power())
        return passing, sum((at.hand_on(self.weights(source), source.power()) for source in self.sources), np.zeros_like(passing))

    def weights(self, source: Source) -> Array:
        """Weights of a source's heat in the terms of both sides ``(k,)``."""
        return source.share * self.passage.own + (1.0 - source.share) * self.passage.theirs

    def sizes(self) -> Array:
        """Magnitudes of the operands in differences of heat terms, in the rows of vectors ``(n_rows * gdim,)`` (collective)."""
        at = self.passage
        size = sum((source.sizes() for source in self.sources), self.power_sizes())
        return self.field.rows(at.hand_on(at.own + at.theirs, size))

    def power_sizes(self) -> Array:
        """Magnitudes of the operands in the power of finite conductance ``(n,)`` (collective)."""
        at, hot = self.passage, np.abs(self.field.values)
        if self.law.perfect:
            return np.zeros(len(at.areas))
        return np.asarray(self.conductances() * at.areas * (at.means(at.own, hot) + at.means(at.theirs, hot)))

    def residual(self) -> Array:
        """Contribution of heat to the residual, in the rows of vectors ``(n_rows * gdim,)`` (collective)."""
        passing, made = self.nodal()
        # heat flow by constraint equations is not part of the residual
        return self.field.rows(-made if self.law.perfect else passing - made)

    def changes(self) -> list[tuple[Array, Terms]]:
        """Derivatives of the power by temperatures and gaps: scales ``(n,)`` of linear functions of the unknowns (collective)."""
        at = self.passage
        if self.law.perfect:
            return []
        found = [(self.conductances() * at.areas, self.jumps())]
        if callable(self.law.h):
            sides = [self._terms(self._of, self._shares(side)) for side in (at.own, at.theirs) if self.law.of_temperatures]
            slopes, n = self._slopes(*self._of_gaps, *range(2, 2 + len(sides))), len(self._of_gaps)
            found += [self._opening(*slopes[:n]), *zip(slopes[n:], sides)]
        return found

    def _opening(self, *slopes: Array) -> tuple[Array, Terms]:
        """Derivatives of the power by gaps, from its ``slopes`` ``(n,)`` by ``_of_gaps``, and gaps as functions of the unknowns."""
        at, pair = self.passage, self.pair
        return np.where(pair.united, 0.0, slopes[0]), Terms(
            at.row, at.node, at.jump[:, None] * pair.kinematics.projection.normal[at.row]
        )

    def by_pressures(self) -> Array:
        """Derivatives of the power by the pressures of closed contactors ``(n,)`` (collective)."""
        return self._slopes(0)[0] if callable(self.law.h) else np.zeros(len(self.passage.areas))

    def tangent(self) -> list[tuple[Ints, Array]]:
        """Derivatives of the residual by temperatures and gaps (collective).

        Returns pairs of global rows ``(k, m)``, -1 for no row, and blocks ``(k, m gdim, m gdim)``.
        """
        jumps = self.jumps()
        found = [dyads(scale, jumps, right) for scale, right in self.changes()]
        for source in self.sources:
            enters = self._terms(self.field, -self.weights(source))
            found += [dyads(scale, enters, right) for scale, right in source.changes()]
        return found

    def by_forces(self, equations: ContactRows, lift: Array) -> list[tuple[Ints, Array]]:
        """Derivatives of the residual by forces F at the contactors, with multipliers ``lift F``; see ``tangent`` (collective).

        They are neglected at degree 2, where each pressure depends on the forces of several contactors.

        Args:
            equations: of the interface, in the present state.
            lift: of each ``(m, gdim)``.
        """
        pair, config = self.pair, self.pair.config
        parts = [(self.by_pressures(), self.jumps())] if callable(self.law.h) else []
        parts += [
            (source.by_pressures(), self._terms(self.field, -self.weights(source))) for source in self.sources if source.lags
        ]
        if not parts:
            return []
        own = equations.normal
        which = equations.contactor[own]
        forces = Terms(which, config.to_global(pair.nodes[which]), lift[own])
        scale = np.where(pair.trial.active & (config.degree == 1), self._per_area() * self.passage.force, 0.0)
        return [dyads(slopes * scale, left, forces) for slopes, left in parts]

    def jumps(self) -> Terms:
        """Jumps of the field at contactors as linear functions of the unknowns (collective)."""
        return self._terms(self.field, self.passage.jump)

    def _terms(self, field: NodalField, weights: Array) -> Terms:
        """Sums of a field over the terms of contactors, with weights ``(k,)``, as linear functions of the unknowns (collective)."""
        at, g = self.passage, self.pair.config.gdim
        known: Any = at.halo.take(field.terms)
        number, weight = np.hsplit(known, 2)
        some = weight != 0
        row = np.broadcast_to(at.row[:, None], weight.shape)[some]
        number, weight = number[some].astype(np.int64), (weights[:, None] * weight)[some]
        vector = np.zeros((len(row), g))
        vector[np.arange(len(row)), number % g] = weight
        return Terms(row, number // g, vector)


def heats_of(pair: Pair, laws: Sequence[Conductance], contact: Declared, kind: type[Heat]) -> list[Heat]:
    """Heat flows of an interface by several conductances; InputError or SpaceError as ``Heat`` (collective)."""
    columns = np.cumsum([law.perfect for law in laws])
    heats = [kind(pair, law, contact, column - 1) for law, column in zip(laws, columns.tolist())]
    for heat in heats:
        if heat.law.joule is not None:
            heat.sources.append(JouleHeat([one for one in heats if one.law.field == heat.law.joule], heat.law.joule_share))
    return heats
