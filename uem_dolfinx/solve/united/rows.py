"""Constraint equations of all pairs together: possible conflicts, Q, and the resolution of conflicts."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations, least_left
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.algebra.rings import DependentRingError
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.seam.active_set import TOUCHING
from uem_dolfinx.contact.seam.placement import ContactRows, Traction
from uem_dolfinx.errors import ConflictError, FrictionError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.surfaces import followed_nodes
from uem_dolfinx.parallel import agree, reduced
from uem_dolfinx.solve.bodies.tangent import contact_curvature, together
from uem_dolfinx.solve.united.equilibrium import IterationState

if TYPE_CHECKING:
    from uem_dolfinx.algebra.condensed import Solved
    from uem_dolfinx.algebra.dependent import IndependentEquations
    from uem_dolfinx.algebra.linear_solver import UnitedSolver
    from uem_dolfinx.conditions.user_rows import UserRows
    from uem_dolfinx.contact.thermal.heat import Heat, HeatEquations
    from uem_dolfinx.solve.bodies.bodies import Bodies


class OverConstraints:
    """Shared nodes of the equations of several contacts (collective).

    Args:
        pairs: of all contacts; ``mutual`` of their settings is set if surfaces are contactor and target of each other.
        linear: equations of users, or None.
        held: whether conditions prescribe contactors of which the pairs have no data.
    """

    def __init__(self, config: Configuration, pairs: Sequence[Interface], linear: UserRows | None = None, held: bool = False):
        self._unknowns = config.unknowns
        self._last: Restriction | None = None  # the restriction made last
        # joined contacts are compared one by one
        whole, pairs = pairs, [one for pair in pairs for one in pair.members]
        surfaces, which = _surfaces(pairs)
        follows = [followed_nodes(config, dofs) for dofs in surfaces]
        table: Bools = np.array(follows, dtype=np.bool_).reshape(len(follows), config.n_local)
        meeting = [np.asarray(table[:, pair.nodes].any(axis=1))[which] for pair in pairs]
        meets: Bools = np.array(meeting, dtype=np.bool_).reshape(len(pairs), len(pairs))
        on = np.concatenate([np.zeros(0, dtype=bool), *(pair.discretisation.setting.on for pair in whole)])
        meets &= on & on[:, None]
        contactors = np.concatenate([np.zeros(0, np.int32), *(pair.nodes for pair in compress(pairs, on))])
        shared = len(np.unique(contactors)) < len(contactors)
        found = np.append(meets.ravel(), shared)
        config.comm.Allreduce(MPI.IN_PLACE, found, op=MPI.LOR)
        meets = found[:-1].reshape(meets.shape)
        self.shared = bool(found[-1])  # whether a node is a contactor of several pairs
        # bodies that follow each other in one order never follow each other mutually
        ordered = np.array([pair.discretisation.traits.order for pair in pairs])
        one_order = (ordered[:, None] == ordered) & (ordered[:, None] != -1)
        both_ways = meets & meets.T & ~one_order
        # surfaces that are tied as a whole are never in contact; they share only edge nodes with other surfaces
        tied = np.array([pair.tie is not None and pair.tie.whole for pair in pairs], dtype=bool)
        refused = (both_ways & ~(tied[:, None] | tied)).any(axis=1)
        ends = np.cumsum([len(pair.members) for pair in whole])
        for pair, mutual in zip(whole, np.split(both_ways.any(axis=1), ends)):
            if (mutual != pair.discretisation.setting.mutual).any():
                pair.discretisation.set(mutual=mutual)
        for pair, wrong in zip(pairs, refused):
            if wrong and not pair.discretisation.traits.two_pass:
                raise ConflictError(
                    f"{pair.name}: another contact has these surfaces as target and contactor: mortar is exact in one pass, so keep "
                    "one of the two contacts, or give both coupling='node_to_surface'"
                )
        #: whether a node that is followed may itself be eliminated.
        self.stacked = bool(meets.any()) or any(
            pair.discretisation.traits.chained or (pair.tie is not None and pair.tie.chained) for pair in whole
        )
        #: whether equations can conflict even if they do not follow each other in a ring.
        self.contestable = held or self.shared or any(pair.discretisation.setting.prescribed for pair in whole)
        if any(_united_fields(pair) for pair in pairs):
            # rows contain temperatures of both sides, which may be prescribed
            self.stacked = self.contestable = True
        self._n_linear = 0
        self._rigid = None if linear is None else linear.rigid
        if linear is not None:
            self._meet(config, linear.equations, contactors, follows)

    def _meet(self, config: Configuration, linear: UnitingEquations, contactors: Indices, follows: Sequence[Bools]) -> None:
        """Include shared nodes of users' equations, among each other and with contacts (collective)."""
        self._n_linear = len(linear) - (0 if self._rigid is None else self._rigid.n_rows)
        eliminated = np.zeros(config.n_local, dtype=bool)
        eliminated[linear.node] = True
        at_contactors = bool(eliminated[contactors].any())
        followed = any(bool(f[linear.node].any()) for f in follows)
        eliminated[contactors] = True
        followed |= bool((config.ask_owners(linear.followed, eliminated[: config.n_owned, None].astype(float)) > 0).any())
        at_contactors, followed = reduced(config.comm, np.array([at_contactors, followed])) > 0
        self.stacked, self.contestable = self.stacked or bool(followed), self.contestable or bool(at_contactors)

    def parted(self, equations: UnitingEquations) -> tuple[UnitingEquations, list[UnitingEquations]]:
        """Equations without components that rigid couplings eliminate, and the equations of the rigid couplings (collective)."""
        if self._rigid is None:
            return equations, []
        last = np.arange(len(equations)) >= len(equations) - self._rigid.n_rows
        return self._rigid.rewritten(equations.select(~last)), [equations.select(last)]

    def restrict(
        self, equations: UnitingEquations, free: Bools, prescribed: Array, *masks: Bools
    ) -> tuple[Restriction, IndependentEquations | None]:
        """P or Q of equations, and the resolution of their conflicts (collective).

        Args:
            equations: of all pairs together, followed by the equations of users.
            free: mask of free components ``(n_rows, gdim)``.
            prescribed: increments prescribed by Dirichlet conditions ``(n_rows, gdim)``.
            masks: equations with forces that cannot be negative, and those that have been left out before ``(m,)``, or none.
        """
        given, rigid = self.parted(equations)
        m, g = len(given), prescribed.shape[1]
        firm, masks = np.arange(m) >= m - self._n_linear, tuple([mask[:m] for mask in masks])
        left = free if self._rigid is None else self._rigid.left(free)
        independent = self._independent(given, left, None, firm, *masks) if self.contestable else None
        own = given if independent is None else independent.equations
        stacked = self.stacked or (independent is not None and independent.found)
        every = joined(own, rigid, g)
        if self._last is not None and (known := self._last.with_gaps(every, free, prescribed, stacked)) is not None:
            return known, independent
        try:
            self._last = Restriction(self._unknowns, every, free, prescribed, stacked)
            return self._last, independent
        except DependentRingError as error:
            ring = error.rows[: len(own)] if independent is None else independent.of_given(error.rows[: len(own)])
        independent = self._independent(given, left, ring, firm, *masks)
        return Restriction(self._unknowns, joined(independent.equations, rigid, g), free, prescribed), independent

    def turned(self, equations: UnitingEquations, like: Restriction, prescribed: Array) -> Restriction | None:
        """P of equations in other directions than those of Q, ``like``, with its unknowns; None where they are dependent (collective)."""
        given, rigid = self.parted(equations)
        left = [least_left(given.direction[i] * like.free[at, None]).min() for at, i in given.by_node()] if self.shared else []
        if self.shared and reduced(like.comm, float(min(left, default=1.0)), op=MPI.MIN) < MOSTLY_PRESCRIBED:
            return None
        return Restriction(like.space, joined(given, rigid, prescribed.shape[1]), like.free, prescribed, like.stacked, like=like)

    def _independent(self, given: UnitingEquations, free: Bools, *masks: Bools | None) -> IndependentEquations:
        from uem_dolfinx.algebra.dependent import IndependentEquations

        return IndependentEquations(self._unknowns, given, free, *masks)


@dataclass(frozen=True)
class Rows:
    """Constraint equations of all pairs in one state, with P and Q."""

    pairs: Sequence[Interface]  # with equations
    equations: list[ContactRows]  # of each pair
    whole: ContactRows  # those of all pairs together, then of temperatures and of users
    independent: IndependentEquations | None  # resolution of conflicts; None if there cannot be any
    test: Restriction  # Q
    frictionless: Restriction  # Q without the friction of slipping contactors; it also closes the gaps
    heat: dict[int, list[HeatEquations]]  # equations of temperatures by number of their pair, each of one field
    rigid: UserRows | None = None  # rigid couplings, whose equations come last, or None

    @property
    def conflict(self) -> bool:
        """Whether some of the equations depend on others."""
        return self.independent is not None and self.independent.found

    def with_gaps(self, over_constraints: OverConstraints, gap: Array, active: Bools) -> Rows:
        """The same equations with other gaps ``(m,)``, of which others are ``active (m,)``, and nothing prescribed (collective)."""
        whole, free = replace(self.whole, rows=replace(self.whole.rows, gap=gap, active=active)), self.test.free
        independent, Q, straight = _restricted(over_constraints, self.pairs, self.equations, whole, free, np.zeros(free.shape))
        return replace(self, whole=whole, independent=independent, test=Q, frictionless=straight)

    def settle(
        self, bodies: Bodies, solver: UnitedSolver, F: PETSc.Vec, G: PETSc.Mat | None, du: Array, left: float
    ) -> Solved | None:
        """Solve the linearised problem on arrays, with all conditions of contact, see ``slots.settle`` (collective)."""
        from uem_dolfinx.solve.slots.settle import settle

        own = dict(zip(self.pairs, self.equations))
        return None if self.conflict else settle(bodies, solver, own, self.whole, self.test, F, G, du, left)

    def of(self, pairs: Sequence[Interface]) -> list[ContactRows]:
        """Equations of each of these pairs; empty for pairs without equations."""
        known = {id(pair): own for pair, own in zip(self.pairs, self.equations)}
        none = np.zeros(0, np.int64)
        known |= {id(p): p.kinematics.gap_rows.select(none, p.trial.active) for p in pairs if id(p) not in known}
        return [known[id(pair)] for pair in pairs]


@dataclass(frozen=True)
class BodyState(IterationState):
    """``IterationState`` with its rows, and with the terms of the slip directions in tangent (``added``) and ``forces``.

    ``solved`` is the solution of its linearised problem, if known.
    """

    rows: Rows
    added: PETSc.Mat | None
    forces: PETSc.Vec
    solved: Solved | None = None

    def with_rows(
        self, rows: Rows, solved: Solved | None, trial: Restriction, added: PETSc.Mat | None, forces: PETSc.Vec, active: int
    ) -> BodyState:
        """The same bodies with other rows; a known solution holds if no body has come loose, or was loose, by these (collective)."""
        alike = reduced(rows.test.comm, int(np.array_equal(rows.test.free, self.test.free)), op=MPI.LAND)
        now = replace(self, rows=rows, test=rows.test, trial=trial, added=added, forces=forces, active=active)
        return replace(now, right=False, solved=solved if alike else None)

    def set_operator(self, solver: UnitedSolver, K: PETSc.Mat, G: PETSc.Mat | None, roughly: bool) -> None:
        """Set ``Q'(K + G)P``, see ``UnitedSolver.set_operator``, or the known solution (collective)."""
        if self.solved is None:
            solver.set_operator(self.trial, K, G, self.test, roughly)
        else:
            solver.take(self.solved, self.trial, K, G, self.test)

    def with_pressures(self, K: PETSc.Mat, G: PETSc.Mat | None) -> BodyState:
        """The state with the derivatives of heat by pressures, if pressures are forces of single contactors (collective).

        Args:
            K: tangent of the bodies, whose rows at the contactors are the derivatives of contact forces.
            G: curvature of the contact, or None.
        """
        state, test, parts, first = self, self.test, [], 0
        if test.rings is not None or self.rows.conflict:
            return self
        for pair, own in zip(self.rows.pairs, self.rows.equations):
            parts += [part for heat in pair.heats for part in heat.by_forces(own, test.lift[first : first + len(own)])]
            first += len(own)
        if not parts:
            return self
        by_forces = contact_curvature(parts, self.residual)
        for matrix in (K, G):
            if matrix is not None:
                state = replace(state, added=together(state.added, by_forces.matMult(matrix)))
        return state


def make_rows(
    over_constraints: OverConstraints,
    pairs: Sequence[Interface],
    hold: Callable[[ContactRows], Bools],
    prescribed: Array,
    linear: UserRows | None = None,
) -> Rows:
    """Equations of all pairs in their present states, and Q (collective).

    Args:
        over_constraints: of the pairs.
        pairs: that may be in contact.
        hold: returns the free components ``(n_rows, gdim)``, from the rows of all pairs and of users.
        prescribed: increments prescribed by Dirichlet conditions ``(n_rows, gdim)``.
        linear: equations of users, or None.

    Raises:
        FrictionError: if contactors with several equations wedge.
    """
    if over_constraints.shared:
        _meet([pair for pair in pairs if not pair.target.n_nodes])
    equations, g = [pair.equations() for pair in pairs], prescribed.shape[1]
    heat = {i: [one.equations() for one in own] for i, pair in enumerate(pairs) if (own := _united_fields(pair))}
    users = [] if linear is None else [linear.at_present()]
    united = [e.rows for own in heat.values() for e in own]
    whole = ContactRows.join(equations, [*united, *users], g)
    # the derivatives of the gaps determine the open motions of a body
    free = hold(ContactRows.join(equations, users, g) if united else whole)
    independent, Q, straight = _restricted(over_constraints, pairs, equations, whole, free, prescribed)
    return Rows(pairs, equations, whole, independent, Q, straight, heat, None if linear is None else linear.rigid)


def _restricted(
    over_constraints: OverConstraints,
    pairs: Sequence[Interface],
    equations: Sequence[ContactRows],
    whole: ContactRows,
    free: Bools,
    prescribed: Array,
) -> tuple[IndependentEquations | None, Restriction, Restriction]:
    """Resolution of conflicts of all equations, Q, and Q without friction, see ``make_rows`` (collective)."""
    masks, start, g = np.zeros((2, len(whole)), dtype=bool), 0, prescribed.shape[1]
    for pair, own in zip(pairs, equations):
        part = slice(start, start + len(own))
        masks[0, part] = own.normal & (not pair.trial.has_law)
        masks[1, part] = own.normal & pair.trial.redundant[own.contactor]
        start = part.stop
    Q, independent = over_constraints.restrict(whole.rows, free, prescribed, *masks)
    rotated = Q
    if whole.tilt is not None:
        test, last = over_constraints.parted(whole.Q)
        if independent is not None and independent.found:
            independent = independent.rotated(test)
            _refuse_wedged(pairs, test, independent.undetermined)
            test = independent.equations
        try:
            rotated = Restriction(Q.space, joined(test, last, g), free, prescribed, Q.stacked, like=Q)
        except DependentRingError as error:
            _refuse_wedged(pairs, test, error.rows[: len(test)])
            raise
    return independent, rotated, Q


def _meet(rigid: Sequence[Interface]) -> None:
    """Set in contacts with rigid surfaces the normals of others that constrain the same contactors (collective)."""
    if not rigid:
        return
    node, held = (np.concatenate(parts) for parts in zip(*((pair.nodes, pair.trial.active) for pair in rigid)))
    i = held.nonzero()[0]
    i = i[node[i].argsort(kind="stable")]
    # contactors with several rows, each row among those of its node
    place = np.arange(len(i)) - node[i].searchsorted(node[i])
    k = int(place.max(initial=0)) + 1
    others = np.zeros((len(node), k if k > 1 else 0, rigid[0].config.gdim))
    if k > 1:
        normal = np.concatenate([pair.kinematics.projection.normal for pair in rigid])
        there, group = np.unique(node[i], return_inverse=True)
        every = np.zeros((len(there) + 1, *others.shape[1:]))
        every[group, place] = normal[i]
        others[:] = every[np.where(np.append(there, -1)[at := there.searchsorted(node)] == node, at, len(there))]
        others[i, place] = 0.0
    first = 0
    for pair in rigid:
        if pair.friction is not None:
            pair.friction.meet(pair.kinematics, others[first : first + len(pair.nodes)])
        first += len(pair.nodes)


def _surfaces(pairs: Sequence[Interface]) -> tuple[list[Indices], Ints]:
    """Nodes of all distinct target surfaces, and the index of each pair's surface ``(n_pairs,)``."""
    keys = [id(getattr(pair.target, "facets", pair)) if len(pair.whole.members) > 1 else id(pair) for pair in pairs]
    first = {key: pair.discretisation.followed for key, pair in reversed(list(zip(keys, pairs)))}
    return list(first.values()), np.array([list(first).index(key) for key in keys], dtype=np.int64)


def joined(equations: UnitingEquations, more: list[UnitingEquations], block: int) -> UnitingEquations:
    """Equations, followed by more equations."""
    return UnitingEquations.join([equations, *more], block) if more else equations


def _united_fields(pair: Interface) -> list[Heat]:
    """Heat laws with perfect conductance, whose temperatures are equal on both sides of the contact."""
    return [heat for heat in pair.heats if heat.law.perfect]


def read_forces(pairs: Sequence[Interface], rows: Rows, y: PETSc.Vec, du: Array | None) -> tuple[list[Traction], Array]:
    """Contact forces and heat flow of every pair, and multipliers of users' equations ``(m,)`` (collective).

    Args:
        pairs: of all contacts; redundant equations are marked in the pairs of the rows.
        rows: equations.
        y: forces transferred by Q.
        du: increment ``(n_owned, gdim)`` of a prediction; None for the present state.
    """
    n_rigid = 0 if rows.rigid is None else rows.rigid.n_rows
    lam, last = np.split(rows.test.multipliers(y), [len(rows.test.equations) - n_rigid])
    redundant = np.zeros(len(lam), dtype=bool)
    if rows.independent is not None:
        redundant = rows.independent.redundant
        lam = rows.independent.forces(lam, _inside(rows, len(redundant), du))
    found, start = [], 0
    for pair, own in zip(rows.pairs, rows.equations):
        part = slice(start, start + len(own))
        pair.set_redundant(own, redundant[part])
        found.append(pair.forces(own, lam[part], du))
        start = part.stop
    for i, fields in rows.heat.items():
        powers = []
        for heat, equations in zip(_united_fields(rows.pairs[i]), fields):
            part = slice(start, start + len(equations.which))
            powers.append(heat.read(equations, lam[part], redundant[part]))
            start = part.stop
        found[i] = found[i]._replace(heat=np.column_stack(powers))
    if rows.rigid is not None:
        last = rows.rigid.with_rewritten(last, rows.whole.Q.select(np.arange(len(rows.whole)) < len(lam)), lam)
    known = dict(zip(map(id, rows.pairs), found))
    return [known.get(id(pair)) or pair.traction for pair in pairs], np.append(lam[start:], last)


def _inside(rows: Rows, m: int, du: Array | None) -> Array:
    """Penetrations along the normals of contactors, after an increment ``du``; 0 in all other of m rows (collective)."""
    inside, start = np.zeros(m), 0
    if not rows.conflict:
        return inside
    for pair, own in zip(rows.pairs, rows.equations):
        gap = pair.kinematics.gap if du is None else pair.kinematics.gap_rows.gaps(du)
        gap = np.where(pair.kinematics.movable & (gap < -TOUCHING * pair.config.size), gap, 0.0)
        inside[start : start + len(own)] = np.where(own.normal, gap[own.contactor], 0.0)
        start += len(own)
    return inside


def in_turns(pair: Interface) -> list[Ints]:
    """Groups of active contactors with distinct nodes: those of the first contact of each node, then of the second (collective)."""
    i = np.flatnonzero(pair.trial.active)
    i = i[np.argsort(pair.nodes[i], kind="stable")]
    turn = np.arange(len(i)) - np.searchsorted(pair.nodes[i], pair.nodes[i])
    return [i[turn == k] for k in range(reduced(pair.config.comm, int(turn.max(initial=-1)), op=MPI.MAX) + 1)]


def _refuse_wedged(pairs: Sequence[Interface], test: UnitingEquations, wedged: Bools) -> None:
    """Raise a FrictionError for the first contactor with rotated equations that no longer determine its motion (collective)."""
    bad, error = np.flatnonzero(wedged), None
    if len(bad):
        node = int(test.node[bad[0]])
        names = ", ".join(one.name for pair in pairs for one in pair.members if node in one.nodes)
        error = FrictionError(
            f"{names}: friction leaves more than one answer about the contactor at {pairs[0].config.describe(node)}, where several uniting "
            "equations meet and it wedges: take less friction there, or drop one of the contacts"
        )
    agree(pairs[0].config.comm, error)


def unbalanced(
    pairs: Sequence[Interface], F: PETSc.Vec, forces: Sequence[Traction], more: Array | None = None
) -> tuple[Array, Array]:
    """The bodies' forces F minus contact forces, and F, at the owned nodes ``(n_owned, gdim)`` each (collective).

    ``forces`` are the contact forces of every pair, ``more (n_owned, gdim)`` the forces of users' equations, or None.
    """
    config = pairs[0].config
    every = F.array_r.reshape(-1, config.gdim)[: config.n_owned].copy()
    left = every.copy() if more is None else every - more
    for pair, found in zip(pairs, forces):
        left -= pair.config.add_at_owners(*pair.nodal_forces(pair.with_forces(found)))
    return left, every


def not_held() -> FrictionError:
    """The error for bodies that friction does not hold."""
    return FrictionError(
        "the loads drive a body over its target, and friction does not hold it: there is no equilibrium; hold it by a "
        "Dirichlet condition, give it inertia, or take less load"
    )


def several_answers() -> FrictionError:
    """The error for an equilibrium whose matrix has a determinant of another sign than without friction."""
    return FrictionError(
        "friction leaves more than one answer: with these slipping contactors the determinant of Q'KP has another sign than "
        "without friction; take less friction, or stiffer bodies"
    )
