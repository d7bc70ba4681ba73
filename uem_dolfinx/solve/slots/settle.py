"""Contact and friction of a linearised problem, solved on arrays: which contactors are open, stick and slip.

The bodies are condensed onto the slots of all contactors near their targets. The state that is found there is given to the contacts; its
rows, its increment and the check of all conditions follow as for any other state.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra import mumps
from uem_dolfinx.algebra.condensed import Solved
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.algebra.options import FACTORISED_UP_TO
from uem_dolfinx.algebra.relative import Condensation, RelativeCoordinates
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.algebra.rings import DependentRingError
from uem_dolfinx.arrays import Array, Bools, Ints, replace
from uem_dolfinx.contact.laws.law import slides_otherwise
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.seam import active_set
from uem_dolfinx.contact.seam.active_set import Violations
from uem_dolfinx.contact.seam.placement import ContactRows
from uem_dolfinx.errors import ConflictError
from uem_dolfinx.geometry.nodes import Nodes
from uem_dolfinx.parallel import on_root, reduced
from uem_dolfinx.solve.bodies.bodies import Bodies
from uem_dolfinx.solve.bodies.tangent import known_forces
from uem_dolfinx.solve.slots import coulomb

if TYPE_CHECKING:
    from uem_dolfinx.algebra.linear_solver import UnitedSolver

#: A dense problem of so many slots takes 200 MB; beyond, one active set after the other is solved. [bound; slots; -]
MOST_SLOTS = 5_000
#: A condensation that does not serve other coordinates within so many passes is made anew. [bound; passes; -]
MOST_PASSES = 6


@dataclass(frozen=True)
class _Slots:
    """Slots of the contactors of one pair."""

    pair: Interface  # with its contactors
    contactor: Ints  # those with slots ``(k,)``
    normal: Ints  # number of the row along each one's normal, of all rows ``(k,)``
    tangents: Ints  # numbers of the rows along the target, -1 for none ``(k, gdim - 1)``
    directions: Array  # of these rows, zero for none ``(k, gdim - 1, gdim)``

    @classmethod
    def of(cls, pair: Interface, own: ContactRows, first: int, near: Bools) -> _Slots:
        """Slots of contactors of a pair whose rows ``near (m,)`` may close their gaps; ``first`` is the number of its first row."""
        place = np.full((len(pair.nodes), pair.config.gdim), -1, dtype=np.int64)
        rows = np.flatnonzero((own.normal | (own.tangent >= 0)) & own.rows.direction.any(axis=1))
        place[own.contactor[rows], own.tangent[rows] + 1] = rows
        there = place[:, 0] >= 0
        there[there] = near[place[there, 0]]
        place[~pair.trial.active & (pair.off | ~pair.kinematics.movable | ~there)] = -1
        contactor = np.flatnonzero(place[:, 0] >= 0)
        along = place[contactor, 1:]
        there = along >= 0
        directions = np.where(there[:, :, None], own.rows.direction[along], 0.0)
        return cls(pair, contactor, first + place[contactor, 0], np.where(there, first + along, -1), directions)

    @property
    def rows(self) -> Ints:
        """Numbers of all rows with slots."""
        every = np.append(self.normal, self.tangents)
        return every[every >= 0]

    def describable(self, du: Array) -> bool:
        """Whether two laws, of a gap and of a slip, describe all contactors of this rank, which increments ``du`` lead (collective)."""
        friction, cornered = self.pair.friction, bool(self.pair.trial.in_corner.any())
        of_speed = friction is not None and slides_otherwise(friction.limits.law)
        # slip along prescribed components takes part of the friction that slots count as their own
        led = friction is not None and bool((friction.forced(du)[self.contactor] & (self.tangents >= 0).any(axis=1)).any())
        return not (cornered or self.pair.trial.has_law or self.pair.tie or self.pair.heats or of_speed or led)

    def limits(self) -> tuple[Array, Array]:
        """Slopes of the limits of friction by the normal multiplier, and limits at zero multiplier ``(k,)`` (collective)."""
        pair, friction, i = self.pair, self.pair.friction, self.contactor
        if friction is None:
            return np.zeros(len(i)), np.zeros(len(i))
        rest, slope = friction.limits.cone(pair.trial.lam, friction.slipping(pair.trial))
        share = np.where(friction.value > 0, 1.0 / pair.kinematics.ties.share, 0.0)
        return (slope * share * pair.kinematics.pressure_map(False).force)[i], (rest * share)[i]

    def take(self, active: Bools, stick: Bools, direction: Array, slip: Array, force: Array) -> None:
        """Set the state of the contactors ``(k,)``; slip directions, slips and friction are along the rows ``(k, gdim - 1)``."""
        pair, i, pivot = self.pair, self.contactor, None
        before, friction, now = pair.trial.active, pair.friction, pair.trial.active.copy()
        now[i] = active
        state = active_set.exchange(pair.trial, Violations(now & ~before, before & ~now))
        if friction is not None:
            state = friction.come_and_go(state, before)
            assert state.friction is not None
            s, way, tau = (np.einsum("kr,krg->kg", parts, self.directions) for parts in (direction, slip, force))
            rubs = active & (friction.value[i] > 0)
            slides = rubs & ~stick
            sticks, directions = state.friction.stick.copy(), state.friction.direction.copy()
            sticks[i], directions[i] = rubs & stick, np.where(slides[:, None], s, 0.0)
            state = replace(state, friction=replace(state.friction, stick=sticks, direction=directions))
            q, of_slip, j = friction.pivot.q.copy(), friction.pivot.tau.copy(), i[slides]
            c = friction.pivot.stiffness[j, None]
            q[j], of_slip[j] = c * way[slides] - tau[slides], c * friction.frame.slip[j]
            pivot = replace(friction.pivot, q=q, tau=of_slip)
        pair.take(state, pivot)


def settle(
    bodies: Bodies,
    solver: UnitedSolver,
    equations: Mapping[Interface, ContactRows],
    whole: ContactRows,
    test: Restriction,
    F: PETSc.Vec,
    G: PETSc.Mat | None,
    du: Array,
    left: float,
) -> Solved | None:
    """Solve a linearised problem with all conditions of contact; the pairs then have its state (collective).

    Args:
        bodies: with their tangent.
        solver: keeps the condensation where the tangent is constant.
        equations: rows of every pair that may be in contact.
        whole: all rows.
        test: Q of the present state.
        F: forces of the bodies at the present displacement, minus friction that is independent of normal forces.
        G: curvature of the contact, or None.
        du: increment of the present state ``(n_owned, gdim)``: contactors whose gaps are wider than both sides go stay open.
        left: part of the right-hand side that a kept condensation may leave.

    Returns:
        The solution, or None if none has been found.
    """
    comm, space, slots, first, kept = bodies.comm, test.space, [], 0, solver.slots
    few = space.block * space.n_global <= FACTORISED_UP_TO[space.gdim] and mumps.has_schur_complements() and not space.mixed
    if not few:
        return None
    near = _near(whole.P, space, du)
    if kept.now is not None:
        near |= kept.now.nodes[whole.P.node]
    for pair, own in equations.items():
        slots.append(_Slots.of(pair, own, first, near[first : first + len(own)]))
        first += len(own)
    led = np.where(bodies.free[: len(du)], du, bodies.prescribed[: len(du)])
    described = all([one.describable(led) for one in slots]) and test.rings is None and first == len(whole)
    number, refused = reduced(comm, np.array([sum(len(one.rows) for one in slots), not described], dtype=np.int64))
    if refused or not 0 < number <= MOST_SLOTS:
        return None
    coordinates = _coordinates(bodies, whole, test, np.concatenate([one.rows for one in slots]))
    if coordinates is None:
        return None
    for nodes, forces in known_forces(list(equations)):
        F.array[: bodies.forces.size] += bodies.config.add_at_owners(nodes, forces).ravel()
    gap = whole.P.gap
    normal, tangents = (np.concatenate([getattr(one, name) for one in slots]) for name in ("normal", "tangents"))
    limits = [np.concatenate(parts) for parts in zip(*(one.limits() for one in slots))]
    slip = np.where(tangents >= 0, gap[tangents], 0.0)

    def solved_by(condensed: Condensation) -> tuple[Any, ...] | None:
        """States and flags of the solution, to which the condensation has moved (collective)."""
        arrays = [on_root(comm, a) for a in (*map(condensed.numbers, (normal, tangents)), gap[normal], slip, *limits)]
        condensed.begin(F)
        forces, found, w = condensed.forces(), None, np.zeros(len(condensed.stiffness))
        for n in range(MOST_PASSES):
            if comm.rank == 0:
                load = forces - condensed.stiffness @ w
                found = coulomb.solve(coulomb.SlotProblem(condensed.stiffness, load, *arrays), w)
            if comm.bcast(found is None if comm.rank == 0 else None):
                return None
            condensed.move(found.w - w if found is not None else None)
            w = found.w if found is not None else w
            forces = condensed.forces()
            if condensed.balanced(found.force if found is not None else None, left) or not (n or condensed.moved_on):
                return comm.bcast(None if found is None else (_states(found, *arrays[1:4:2]), found.negative, found.indefinite))
        return None

    of, answer, condensed = (*coordinates, bodies.tangent.K, G), None, kept.now
    if condensed is not None and condensed.serves(coordinates[0]):
        condensed.use(*of)
        answer = solved_by(condensed)
    if answer is None and (condensed := kept.make(space, *of)) is not None:
        answer = solved_by(condensed)
    solved = None
    if answer is not None and condensed is not None:
        flags = condensed.negative != answer[1], condensed.indefinite or answer[2]
        solved = Solved(condensed.moved(), *flags, condensed.left if condensed.moved_on else 0.0)
    if not solver.lasting:
        kept.drop()
    if answer is None:
        return None
    begins = sum(comm.allgather(len(normal))[: comm.rank])
    ends = begins + np.cumsum([len(one.contactor) for one in slots])
    for one, end in zip(slots, ends):
        one.take(*(values[end - len(one.contactor) : end] for values in answer[0]))
    return solved


def _near(equations: UnitingEquations, space: Nodes, du: Array) -> Bools:
    """Rows whose gaps are not wider than their nodes and the nodes that these follow go in an increment ``(m,)`` (collective)."""
    eq, way = equations, np.linalg.norm(du, axis=1)
    distinct, term = np.unique(eq.followed, return_inverse=True)
    there = space.ask_owners(distinct, way[:, None])[term, 0] * np.linalg.norm(eq.coefficients, axis=1)
    reach = np.linalg.norm(eq.direction, axis=1) * way[eq.node] + np.bincount(eq.row, there, len(eq))
    return np.asarray(eq.gap <= reach)


def _coordinates(
    bodies: Bodies, whole: ContactRows, test: Restriction, rows: Ints
) -> tuple[RelativeCoordinates, RelativeCoordinates] | None:
    """Coordinates of motions and forces, with slots of some ``rows``; None if these cannot be eliminated together (collective)."""
    of_slots = np.zeros(len(whole), dtype=bool)
    of_slots[rows] = True

    def restricted(equations: UnitingEquations, like: Restriction | None = None) -> Restriction:
        every = replace(equations, active=equations.active | of_slots, gap=np.where(of_slots, 0.0, equations.gap))
        return Restriction(test.space, every, test.free, bodies.prescribed, like=like)

    try:
        Q = restricted(whole.rows)
        P = Q if whole.moved is None else restricted(whole.moved, Q)
    except (ConflictError, DependentRingError):
        return None
    if P.rings is not None or Q.rings is not None:
        return None
    trial = RelativeCoordinates(P, of_slots)
    return trial, trial if P is Q else RelativeCoordinates(Q, of_slots)


def _states(found: coulomb.SlotState, tangents: Ints, slip: Array) -> Sequence[Any]:
    """Arguments of ``_Slots.take`` for all contactors."""
    there = tangents >= 0
    way, force = (np.where(there, values[tangents], 0.0) for values in (found.w, found.force))
    return found.active, found.stick, found.direction, slip + way, force
