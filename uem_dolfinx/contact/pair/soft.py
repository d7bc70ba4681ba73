"""The interface of a soft contact: contactors are never united, their gaps have a force and a stiffness.

The gap g_i of a contactor has the gradient r_i, the row that hard contact unites with. Its force is ``lam_i = A_i p(g_i)`` with
the area A_i of the pressure, so that the residual is ``F - sum_i r_i lam_i``. Its derivative has the terms ``-sum_i A_i p'(g_i)
r_i r_i'`` and, as for hard contact, the curvature ``-sum_i lam_i grad^2 g_i``. Areas of mortar's mean gaps
change with the bodies, which is part of both. Changes of current areas in pressures are left out of the derivative.

Within a step the forces are those that the linearised problem predicts, as the multipliers of hard contact are, and the law holds at the
gaps g_i* under them: the problem also closes what is left between g_i and g_i*. Any stiffness is then as good as hard contact, where
forces by the gaps of every iterate would be too large. Rows contain both bodies: action equals reaction. For bodies that only
contact holds, gaps with a stiffness are held.

In a concave corner of a faceted target the gaps from its facets are equal: equations along the further axes of the corner, which are
united, with multipliers that share the force of the law among the facets. The force is that of the gap along the mean of their normals,
and a contactor leaves a facet that pulls in equilibrium.

With damping c the pressure at the end of a time step dt that begins at the gap h is

    P(g) = max(p(g) + c (min(h, r) - min(g, r)) / dt, 0)

with the gap at rest r: the mean speed while the surfaces are in contact. P is a monotone and continuous law of the gap, so that damped
contact is solved in the same way. It vanishes from the gap s <= r on, at which surfaces that separate come off.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any
from weakref import proxy

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.laws.soft import SoftContact
from uem_dolfinx.contact.nodes.concave_edges import MOST_CHANGES, ConcaveEdges
from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.seam.active_set import TOUCHING, Violations
from uem_dolfinx.contact.seam.corners import Corners
from uem_dolfinx.contact.seam.placement import NORMAL, ContactRows, Traction
from uem_dolfinx.contact.seam.relative_motion import grouped
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.parallel import reduced

#: A gap holds a body that nothing else holds where it has more than this part of its stiffness at rest.
#: [convention; slope of the law; test_soft_contact.py::test_what_holds_a_body]
HELD_FROM = 1e-6
#: Gaps under a pressure are found by so many bisections, and one step of Newton's method. [bound; bisections; -]
BISECTIONS = 30
#: Columns of the state of damping: gap, dissipated energy, and of its last step the gap at its beginning, damping over length, and time.
GAP, WORK, BEGUN, RATE, AT = range(5)


def stiffness_of_gaps(pair: Interface, stiffness: Array) -> tuple[Ints, Ints, Array]:
    """Global rows of the gaps with a ``stiffness (n,)``, their contactors, and gradients there, see ``dyads.grouped``."""
    rows = pair.kinematics.gap_rows
    gradients = rows.gradients
    return grouped(np.append(stiffness, np.zeros(len(rows.equations) - len(stiffness))), gradients, gradients)[:3]


def traction_by_gaps(pair: Interface, multipliers: Array) -> Traction:
    """Contact forces of multipliers ``(n,)`` of the rows of all gaps, without those along further axes of corners (collective)."""
    every = np.ones(len(pair.nodes), dtype=bool)
    rows = pair.kinematics.gap_rows.select(np.arange(len(every)), every)
    along = np.where(rows.normal, multipliers[rows.contactor], 0.0)
    found = pair.kinematics.forces(replace(pair.trial, active=every), rows, along)
    return found._replace(lam=multipliers * pair.kinematics.pressure_map(False).force)


def _in_corners(found: Traction, rows: ContactRows, multipliers: Array) -> Traction:
    """With the multipliers ``(m,)`` of rows along further axes of corners, by which forces are shared among their facets."""
    force, i = found.force.copy(), np.flatnonzero(rows.kind > NORMAL)
    np.add.at(force, rows.contactor[i], multipliers[i, None] * rows.rows.direction[i])
    return found._replace(force=force)


class _Corners(ConcaveEdges):
    """``ConcaveEdges``; contactors that press leave a corner in equilibrium only, as a function says: predicted forces pull too early."""

    def __init__(self, of: NodeToSurface, in_equilibrium: Callable[[], bool]):
        super().__init__(of)
        self._in_equilibrium = in_equilibrium

    def leave(self, corners: Corners | None, state: PairState) -> tuple[PairState, Bools]:
        """See ``ConcaveEdges``."""
        after, left = super().leave(corners, state)
        if self._in_equilibrium():
            return after, left
        stay = left & state.active
        facet, held = np.where(stay, state.facet, after.facet), np.where(stay[:, None], state.held, after.held)
        return replace(after, facet=facet, held=held), left & ~stay


class SoftInterface(Interface):
    """Contactors with a pressure by their gaps; other arguments as for ``Interface``.

    Args:
        law: pressure by the gap.
        contact: that it belongs to, for ``measured_areas`` and ``leads``, see ``ContactResults``.
        duration: length of the present step, a time; None in statics.
    """

    def __init__(self, *args: Any, law: SoftContact, contact: Any, duration: Callable[[], float] | None = None, **how: Any):
        super().__init__(*args, **how)
        self._law, self._contact, self._duration = law, contact, duration
        #: Damping over the length of the step, gaps at its beginning, and gaps s from which on pressures vanish ``(n,)``, or None.
        self._damped: tuple[Array, Array, Array] | None = None
        if isinstance(self.discretisation, NodeToSurface):
            # also at corners of bodies in general contact: those opposite do not press
            own = proxy(self)
            self.discretisation.follow_by(_Corners(self.discretisation, lambda: own._settled))
        n = len(self.nodes)
        # surfaces that are far apart at the start have a state of damping, too
        damping = np.tile([np.inf, 0.0, np.inf, 0.0, float(contact._at)], (n, 1)) if law.damping else None
        self.trial = self.committed = replace(self.committed, law_gap=np.full(n, np.inf), damping=damping)
        #: Gaps at which the law gives the forces, multipliers and stiffnesses of the rows there, areas, and contactors whose gap is held
        #: ``(n,)``.
        self._at = self._multipliers = self._stiffness = self._area = np.zeros(n)
        self._holds: Bools = np.zeros(n, dtype=bool)
        self._stops = True  # whether the law has a slope at rest, which stops bodies that fall
        self._settled = False  # whether forces are those of an equilibrium
        #: Gaps and multipliers that the last linearised problem predicts ``(n,)``, or None.
        self._predicted: tuple[Array, Array] | None = None

    @property
    def _acts(self) -> bool:
        """Whether any contactor may press."""
        return self.in_reach and self.trial.law_gap is not None

    # -- placement and forces --------------------------------------------------------------------------------------------

    def project(self) -> None:
        """See ``Interface``; the law gives the forces of the gaps there (collective)."""
        super().project()
        self._press()

    def _press(self) -> None:
        """Forces and stiffnesses of the present gaps by the law, and their share among facets of corners (collective)."""
        n, known = len(self.nodes), self.trial.law_gap
        if not self._acts or known is None:
            self._multipliers, self._stiffness, self._holds = *np.zeros((2, n)), np.zeros(n, dtype=bool)
            return
        gap, rest, touching = self.gaps(), self._at_rest(), TOUCHING * self.config.size
        # where the law has no slope contactors are open; those that just touch have the stiffness of those that press
        begun = np.where(self.pressures_at(rest)[1] < 0.0, rest, rest - touching)
        self._at = np.where(np.isinf(known), gap, known)
        # a law that is flat at rest, too, presses by the gaps
        for other in (np.where(gap <= rest + touching, begun, gap), gap):
            self._at = np.where(self.pressures_at(self._at)[1] < 0.0, self._at, other)
        p, slope = self.pressures_at(self._at)
        at_rest, below = self._of_law(self._law.law.rest - np.array([0.0, touching]))[1]
        stiff = float(at_rest or below)
        self._area = np.where(self.off | ~self._contact.leads(), 0.0, self._contact.measured_areas())
        self._multipliers, self._stiffness = self._area * p / self._force, -self._area * slope / self._force**2
        self._holds = (self._area > 0.0) & (slope < 0.0) & (slope <= HELD_FROM * stiff)
        self._stops = stiff < 0.0
        rows = self.equations()
        shared = np.einsum("mg,mg->m", rows.rows.direction, self.trial.force[rows.contactor])
        super().set_forces(_in_corners(traction_by_gaps(self, self._multipliers), rows, shared))

    def _of_law(self, gap: Array) -> tuple[Array, Array]:
        """Pressures p and their derivatives at gaps ``(n,)`` (collective)."""
        return self._law.pressures(self.config.comm, self.name, gap, TOUCHING * self.config.size)

    def pressures_at(self, gap: Array) -> tuple[Array, Array]:
        """Pressures with damping and their derivatives at gaps ``(n,)`` (collective)."""
        p, slope = self._of_law(gap)
        if self._damped is None:
            return p, slope
        rate, _, rest = self._damped
        p = p + rate * self._approached(gap)
        presses = (gap <= rest) | (p > 0.0)
        slope = slope - rate * (gap <= self._law.law.rest)
        return np.where(presses, np.maximum(p, 0.0), 0.0), np.where(presses, slope, 0.0)

    def _approached(self, gap: Array) -> Array:
        """Approach of surfaces in contact from the beginning of the step to gaps ``(n,)``."""
        assert self._damped is not None
        rest = self._law.law.rest
        return np.asarray(np.minimum(self._damped[1], rest) - np.minimum(gap, rest))

    def _at_rest(self) -> Array:
        """Gaps from which on pressures vanish, or at which the law rests ``(n,)`` (collective)."""
        n, rest, state = len(self.nodes), self._law.law.rest, self.committed.damping
        if state is None or self._duration is None:
            return np.full(n, rest)
        at, dt = float(self._contact._at), self._duration()
        # a state that is committed keeps its pressures
        here = state[:, AT] == at
        rate = np.where(here, state[:, RATE], self._law.damping / dt if dt > 0.0 else 0.0)
        begun = np.where(here, state[:, BEGUN], state[:, GAP])
        low, high = np.minimum(begun, rest), np.full(n, rest)
        self._damped = rate, begun, high
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            presses = self._of_law(middle)[0] + rate * self._approached(middle) > 0.0
            low, high = np.where(presses, middle, low), np.where(presses, high, middle)
        p, slope = self._of_law(middle)
        slope, left = slope - rate, p + rate * self._approached(middle)
        there = np.where((begun < rest) & (slope < 0.0), middle - left / np.where(slope < 0.0, slope, 1.0), rest)
        self._damped = rate, begun, np.minimum(there, rest)
        return self._damped[2]

    @property
    def _force(self) -> Array:
        """Forces over multipliers, or gaps of rows over the gaps that the law sees ``(n,)`` (collective)."""
        return self.kinematics.pressure_map(False).force

    def gaps(self) -> Array:
        """Gaps of the law ``(n,)``: of nodes, in Bernstein's basis at degree 2, or means with the dual functions (collective)."""
        return np.asarray(self.kinematics.gap_rows.equations.gap[: len(self.nodes)] / self._force)

    def forces(self, equations: ContactRows, multipliers: Array, du: Array | None = None) -> Traction:
        """Contact forces, present or predicted by the linearised law; see ``Interface`` (collective)."""
        if not self._acts:
            return self.traction
        self._settled = du is None
        if du is None:
            return _in_corners(traction_by_gaps(self, self._multipliers), equations, multipliers)
        rows, force = self.kinematics.gap_rows, self._force
        ahead = rows.equations.gap[: len(force)] + rows.along(du)
        predicted = self._multipliers - self._stiffness * (ahead - force * self._at)
        self._predicted = ahead / force, predicted
        return _in_corners(traction_by_gaps(self, np.maximum(predicted, 0.0)), equations, multipliers)

    def set_forces(self, found: Traction, active: Bools | None = None) -> None:
        """Set contact forces of the trial state; predicted ones hold from the next placement on (collective)."""
        super().set_forces(found, active)
        if self._predicted is None:
            return
        (gap, multipliers), self._predicted = self._predicted, None
        pressing, area = (self._stiffness > 0.0) & (multipliers > 0.0), np.where(self._area > 0.0, self._area, 1.0)
        p = np.where(pressing, multipliers * self._force / area, 0.0)
        # where the law is linearised from without a slope it begins at rest: forces grow with the solutions, not with the gaps
        there = np.where(pressing, self._gaps_under(p, gap), np.maximum(gap, self._at_rest()))
        self.trial = replace(self.trial, law_gap=there)

    def _gaps_under(self, p: Array, gap: Array) -> Array:
        """Gaps under pressures ``(n,)``, from the present ones in the direction of predicted gaps (collective)."""

        def more(g: Array) -> Bools:
            return self.pressures_at(g)[0] > p

        begin, end = self._at, gap
        up, way = end > begin, end - begin
        for k in range(BISECTIONS):
            # for a convex law unloading ends beyond
            beyond = up & more(end)
            if not reduced(self.config.comm, bool(beyond.any()), op=MPI.LOR):
                break
            begin, end = np.where(beyond, end, begin), np.where(beyond, end + 2.0**k * way, end)
        low, high = np.minimum(begin, end), np.maximum(begin, end)
        for _ in range(BISECTIONS):
            middle = 0.5 * (low + high)
            low, high = np.where(more(middle), middle, low), np.where(more(middle), high, middle)
        # Newton's rule for what bisection leaves
        there, slope = self.pressures_at(middle)
        return np.asarray(np.where(slope < 0.0, middle - (there - p) / np.where(slope < 0.0, slope, 1.0), middle))

    def applied_forces(self) -> tuple[Ints, Array] | None:
        """The contact forces by the rows, as loads of both bodies."""
        return self.kinematics.gap_rows.forces(self._all(self._multipliers)) if self._acts else None

    def _all(self, multipliers: Array) -> Array:
        """Multipliers of all rows ``(m,)``, zero along further axes of corners."""
        return np.append(multipliers, np.zeros(len(self.kinematics.gap_rows.equations) - len(multipliers)))

    def pushed_by(self, m: fem.Constant) -> Array:
        """Derivative of the residual by a Constant of the law at the owned nodes ``(n_owned, gdim)`` (collective)."""
        by = self._law.by_constant(self.config.comm, self.name, self._at, m)
        nodes, forces = self.kinematics.gap_rows.forces(self._all(self._area * by / self._force))
        return -self.config.add_at_owners(nodes, forces)

    def slip_terms(self, convex: bool = False) -> tuple[Ints, Array, Array] | None:
        """Stiffness of the gaps, and their forces by what is left between the gaps and those of the law; see ``Interface``."""
        if not self._acts:
            return None
        nodes, which, v = stiffness_of_gaps(self, self._stiffness)
        k, left = self._stiffness[which], (self._force * (self.gaps() - self._at))[which]
        return nodes, k[:, None, None] * v[:, :, None] * v[:, None, :], (k * left)[:, None] * v

    def largest_gap_here(self) -> float:
        """Largest difference of a gap from that of its force, or between gaps from facets of a corner, a length."""
        if not self._acts:
            return 0.0
        apart = self.kinematics.gap_rows.equations.gap[len(self.nodes) :]
        return float(np.abs(np.append((self.gaps() - self._at)[self._stiffness > 0.0], apart)).max(initial=0.0))

    def displaced(self) -> float:
        """See ``Interface``."""
        size = np.linalg.norm(self.points, axis=1, ord=np.inf) if len(self.nodes) else np.zeros(0)
        return float(np.sqrt(2.0 * reduced(self.config.comm, float(((self._stiffness * size) ** 2).sum()))))

    # -- no contactor is active ------------------------------------------------------------------------------------------

    @property
    def united(self) -> Bools:
        """Contactors under pressure ``(n,)``."""
        return self.trial.lam > 0.0

    def violated(self, gap: Array, *conditions: Any, **how: Any) -> Violations:
        """None."""
        return Violations.none(len(self.nodes))

    def activate_touching(self, which: Bools | bool = True) -> None:
        """None, but ends hold contactors that touch there, and pressures begin to act (collective)."""
        self.trial = self.committed = replace(
            self.trial,
            at_end=self.kinematics.ends.drawn(self.trial),
            law_gap=np.full(len(self.nodes), np.inf),
            damping=self._damping(False),
        )
        self.project()

    def follow(self) -> bool:
        """Release contactors past an end (collective); see ``Interface``."""
        pressing = replace(self.trial, active=self.united)
        gone, before = bool((pressing.active & self.off).any()), self.kinematics
        self.kinematics, state = before.follow(pressing, self.off)
        self.trial = replace(state, active=self.trial.active)
        if moved := self.kinematics is not before:
            self._press()
        return gone or moved

    # -- bodies that only contact holds ----------------------------------------------------------------------------------

    def equations(self) -> ContactRows:
        """Rows of gaps that hold bodies, of which only those along further axes of corners are eliminated (collective)."""
        corner = self.trial.in_corner
        rows = self.kinematics.gap_rows.select(np.flatnonzero(self._holds | corner), corner)
        united, held = rows.kind > NORMAL, np.ones(len(rows), dtype=bool)
        own = replace(rows.rows, active=united)
        kind = np.where(united, rows.kind, -1)
        return replace(rows, rows=own, kind=kind, moved=None, resisted=held, crosswise=replace(own, active=held))

    @property
    def approach(self) -> tuple[Ints, UnitingEquations]:
        """Rows of contactors that hold no body yet, with gaps above the gap at rest; gaps hold by themselves."""
        rows = self.kinematics.gap_rows
        ahead = rows.select(np.flatnonzero(~self._holds & ~self.off & self._stops), np.ones(len(self.nodes), dtype=bool))
        equations = ahead.rows.select(ahead.normal)
        rest = (self._law.law.rest * self._force)[ahead.contactor[ahead.normal]]
        return np.full(len(rest), -1), replace(equations, gap=equations.gap - rest)

    def commit(self) -> None:
        """See ``Interface``; contactors that press have not passed an end, those that hold nothing follow their gaps."""
        known = self.trial.law_gap
        kept = None if known is None else np.where(self._holds, self._at, np.inf)
        self.trial = replace(self.trial, passed=self.trial.passed & ~self.united, law_gap=kept, damping=self._damping(True))
        pressing = self.united & (self.trial.changes >= MOST_CHANGES)
        super().commit()
        # forces are those of the gaps, along the averaged normals that they have been found with
        self.trial = self.committed = replace(self.committed, changes=np.where(pressing, MOST_CHANGES, 0))

    def _damping(self, presses: bool) -> Array | None:
        """The state of damping ``(n, 5)``, at the end of a step or, unless it ``presses``, at the start; None without (collective)."""
        if not self._law.damping:
            return None
        gap, before = self.gaps(), self.committed.damping
        state = np.column_stack([gap, np.zeros(len(gap)), gap, np.zeros(len(gap)), np.full(len(gap), float(self._contact._at))])
        state[:, WORK] = 0.0 if before is None else before[:, WORK]
        if presses and self._acts and self._damped is not None:
            state[:, RATE], state[:, BEGUN], _ = self._damped
            again = 0.0 if before is None else state[:, AT] == before[:, AT]
            work = self._area * (self.pressures_at(gap)[0] - self._of_law(gap)[0]) * self._approached(gap)
            state[:, WORK] += np.where(again, 0.0, work)
        return state

    def restore(self) -> None:
        """See ``Interface``."""
        super().restore()
        self._predicted, self._settled = None, False

    def from_checkpoint(self, kept: Mapping[str, npt.NDArray[Any]]) -> None:
        """See ``Interface``; pressures with damping are those of the state's own time (collective)."""
        super().from_checkpoint(kept)
        state = self.committed.damping
        if state is not None and len(state):
            self._contact._at = float(state[0, AT])
