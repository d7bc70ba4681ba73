"""Bodies that only contact holds: rigid motion into contact, and statically determinate supports that keep the system regular.

A body without enough Dirichlet conditions can move as a rigid body until contact holds it. Motions that conditions and active contacts
leave open are loaded or neutral. Along loaded motions the body falls until it touches something; neutral motions are held by statically
determinate supports with zero reactions.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.contact.pair.interface import Interface, in_question
from uem_dolfinx.contact.seam.active_set import TOUCHING
from uem_dolfinx.contact.seam.placement import NORMAL, ContactRows
from uem_dolfinx.errors import FloatingBodyError
from uem_dolfinx.form_checks import takes_values
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.bodies.bodies import Bodies
from uem_dolfinx.solve.rigid.rigid_motions import LOADED, OPEN, RigidMotions

if TYPE_CHECKING:
    from uem_dolfinx.conditions.user_rows import UserRows
    from uem_dolfinx.solve.bodies.far_apart import FarApart

#: Bodies that slide without end are moved by so many sizes of the model, to find the contactors whose slip this would reverse.
#: [convention; the model's size; test_friction.py::test_what_slides_away]
FAR = 1e3
#: Bodies turn by so much in a step, in radians, and go as far as their radius times that, or to where they touch first.
#: [heuristic; radians; test_heaps.py::test_heap_comes_to_rest_in_few_steps]
TURN = 0.3
#: Bodies without loads are as light as this part of the most loaded one: what touches them pushes them aside.
#: [bound; the largest load; -]
LIGHT = 1e-3
#: A body that contact has pushed, and holds no more, has gone no farther than so many times the way of all else, deformations included.
#: [heuristic; largest displacement in the step; test_unheld.py::test_a_body_that_is_thrown_out]
THROWN = 10.0
#: A body that falls comes to rest in so many steps at most. [bound; steps; -]
MOST_RIGID_STEPS = 200


class _Held(NamedTuple):
    """Equations that hold bodies."""

    rows: UnitingEquations  # equations of contactors that follow their target, and of users
    rates: Any  # how fast each motion opens their gaps, a sparse matrix ``(m, n_motions)``
    which: Bools  # mask of rows that cannot separate again: with friction, of ties and of users ``(m,)``
    basis: Any  # motions that these rows leave open ``(n_motions, k)``


class FloatingBodies:
    """Treatment of bodies that only contact holds, within a step.

    Args:
        linear: equations of users, or None.
        far_apart: contacts that are not searched until bodies come near.
    """

    def __init__(self, bodies: Bodies, pairs: Sequence[Interface], linear: UserRows | None, far_apart: FarApart):
        self._bodies, self._pairs, self._linear, self._far_apart = bodies, pairs, linear, far_apart
        config, dynamics = bodies.config, bodies.dynamics
        self.rigid: RigidMotions | None = None  # rigid motions of the bodies; None of a scalar field
        self._at_rest: RigidMotions | None = None
        self._in_motion: RigidMotions | None = None
        if config.moves:
            free, finite = bodies.free[: config.n_owned], not bodies.tangent.linear
            self.rigid = RigidMotions(config, free, finite)
            self._at_rest = self._floating(self.rigid)
            if dynamics is not None:
                # in a time step, inertia holds bodies with mass
                moving = RigidMotions(config, free & ~dynamics.inert, finite)
                self._in_motion = self._floating(moving)
        self.motions = self._at_rest  # rigid motions of the present step; None if conditions, springs and inertia hold all bodies
        #: Motions that conditions and contacts leave open, held by supports ``(n_motions, k)``.
        self._open: Array = np.zeros((0, 0))
        #: Minus the displacement at the beginning of the step and minus the rigid motions since ``(n_local, gdim)``.
        self._went: Array = np.zeros((0, 0))
        self._loads: float | None = None  # sum of the forces at the beginning of the step; None until known
        #: Open motions including those that only friction resists, if all contactors slip ``(n_motions, k)``.
        self._sliding: Array = np.zeros((0, 0))
        #: The same along which gaps do not change, which increments leave out; others where gaps close otherwise than forces act.
        self._left_out: Array = np.zeros((0, 0))

    @cached_property
    def _has_springs(self) -> bool:
        """Whether springs may hold bodies: springs at nodes, or a form that depends on the values of u, not only on gradients."""
        return self._bodies.tangent.points is not None or takes_values(self._bodies.F, self._bodies.u)

    def _floating(self, motions: RigidMotions) -> RigidMotions | None:
        """The motions, if neither conditions nor springs in the form hold all bodies; else None (collective)."""
        bodies = self._bodies
        if not motions.any_open():
            return None
        if (self._pairs or self._linear is not None) and not self._has_springs:
            return motions
        bodies.initial_stiffness()
        motions.ask_stiffness(bodies.tangent.K)
        return motions if motions.any_open() else None

    def begin_step(self, place: Callable[[], None]) -> None:
        """Let bodies fall until they touch; ``place`` projects all contactors. FloatingBodyError if they do not (collective)."""
        if self._bodies.dynamics is not None:
            self.motions = self._in_motion if self._bodies.dynamics.moving else self._at_rest
        self._far_apart.begin_step(self.motions is not None)
        if self.motions is not None:
            self._went = -self._bodies.config.displacement
            self.motions.forget_supports()
            self._loads = None
            self._fall(place, freely=True)

    def begin_motion(self) -> None:
        """Use the motions of a time step for the first acceleration."""
        self.motions = self._in_motion

    @contextmanager
    def held(self) -> Iterator[None]:
        """Context in which something else holds all bodies, so that none falls."""
        motions, self.motions = self.motions, None
        try:
            yield
        finally:
            self.motions = motions

    def end_step(self) -> None:
        """Refuse a state in which supports carry more than rounding by a FloatingBodyError; in a time step, warn."""
        if self.motions is None:
            return
        if self._bodies.dynamics is None:
            self._refuse_thrown()
        if self.motions.share <= LOADED:
            return
        message = (
            f"a body that only contact holds is driven sideways by {self.motions.share:.1g} of the forces, and is held at its position: "
            "its contact does not determine its equilibrium"
        )
        if self._bodies.dynamics is None:
            raise FloatingBodyError(f"{message}; hold it by a Dirichlet condition, or let it come to rest with a decaying drag")
        logger.warning(message)

    def _refuse_thrown(self) -> None:
        """ThrownBodyError for a step in which contacts have pushed a body so far that they no longer hold it (collective)."""
        motions, config = self.motions, self._bodies.config
        assert motions is not None
        if not self._open.shape[1]:
            return
        # rigid motions of falling bodies do not count
        way = (config.displacement + self._went)[: config.n_owned]
        thrown = motions.part(self._open, way)
        far, else_ = (np.linalg.norm(part, axis=1).max(initial=0.0) for part in (thrown, way - thrown))
        far, else_ = reduced(self._bodies.comm, np.array([far, else_]), op=MPI.MAX)
        if far > THROWN * else_ + TOUCHING * config.size:
            raise motions.thrown(thrown, THROWN * else_)

    def hold(self, free: Bools, rows: ContactRows) -> Bools:
        """Free components ``(n_rows, gdim)`` without the supports that hold neutral motions; rows of all pairs, then users (collective)."""
        if self.motions is None:
            return free
        equations = rows.stopping
        self._open = self._sliding = self._left_out = self.motions.open_motions(self._rates(equations))
        if rows.moved is not None:
            self._left_out = self.motions.open_motions(self._rates(replace(rows, rows=rows.moved, moved=None).stopping))
        if rows.resisted is not None and self.neutral:
            # friction resists more motions, never fewer
            self._open = self.motions.open_motions(self._rates(rows.resisting))
        rigid, parted = None if self._linear is None else self._linear.rigid, None
        if rigid is not None:
            # supports may use the components that rigid couplings leave of their nodes
            parted = rigid.left(np.ones((self._bodies.config.n_owned, free.shape[1]), dtype=bool))
            equations = equations.select(np.arange(len(equations)) < len(equations) - rigid.n_rows)
        left, supports = free.copy(), self.motions.supports(self._sliding, equations, parted)
        left[: len(supports)] &= ~supports
        return left

    def slide(self, driving: Array, forces: Array) -> Array | None:
        """Very large increment of the bodies that slide under the forces of the supports; None if no body does (collective).

        Args:
            driving: forces that are not in equilibrium, at the owned nodes ``(n_owned, gdim)``.
            forces: all forces of the bodies, relative to which ``driving`` may be rounding ``(n_owned, gdim)``.
        """
        if self.motions is None or self._sliding.shape[1] == self._open.shape[1]:
            return None
        motion = self.motions.load(self._sliding, driving, forces)
        return FAR * self._bodies.config.size * self.motions.field(motion / size) if (size := np.linalg.norm(motion)) else None

    @property
    def neutral(self) -> bool:
        """Whether conditions and contacts leave motions open; supports keep bodies at rest along them."""
        return self.motions is not None and self._sliding.shape[1] > 0

    @property
    def adrift(self) -> bool:
        """Whether a motion that only supports hold is loaded, so that no equilibrium exists with this active set (collective)."""
        if self.motions is None:
            return False
        force = self.motions.load(self._open, self._forces())
        return bool(force.any())

    def fall_again(self, place: Callable[[], None], changed: bool, in_equilibrium: bool) -> bool:
        """Let bodies that contact no longer holds fall (collective).

        Args:
            place: projects all contactors (collective).
            changed: whether the active set has changed, or is about to.
            in_equilibrium: whether the bodies are in equilibrium.

        Returns:
            Whether bodies have moved or contactors have become active.
        """
        if self.motions is None:
            return False
        if not (changed or in_equilibrium):
            return False
        if not self._held().basis.shape[1]:
            self.motions.share = 0.0
            return False
        # a body that contact no longer holds falls only after the active set has stopped changing
        return self._fall(place, freely=not changed)

    def without_open_motions(self, du: Array) -> Array:
        """An increment ``(n_owned * gdim,)`` without its part along neutral motions (collective)."""
        if self.motions is None:
            return du
        return du - self.motions.part(self._left_out, du.reshape(-1, self._bodies.config.gdim)).ravel()

    def _forces(self) -> Array:
        """Forces of the bodies minus the loads of contacts, at the owned nodes ``(n_owned, gdim)`` (collective)."""
        F = self._bodies.forces
        for nodes, loads in filter(None, (pair.applied_forces() for pair in self._pairs)):
            F = F - self._bodies.config.add_at_owners(nodes, loads)
        return F

    def _rates(self, equations: UnitingEquations) -> Any:
        """Rates of the active equations, and of springs between rigid parts, see ``RigidMotions`` (collective)."""
        assert self.motions is not None
        more = [] if self._linear is None else self._linear.sprung()
        rows = equations.select(equations.active)
        return self.motions.rates(UnitingEquations.join([rows, *more], self._bodies.config.gdim) if more else rows)

    def _fall(self, place: Callable[[], None], freely: bool) -> bool:
        """Move bodies rigidly along their loads until contact holds them (collective).

        Args:
            place: projects all contactors (collective).
            freely: whether bodies move; otherwise only contactors that touch already become active.

        Returns:
            Whether any body has moved or any contactor has become active.

        Raises:
            FloatingBodyError: names a body and its unrestrained motion.
        """
        motions = self.motions
        assert motions is not None
        changed, before, damping = False, np.zeros(motions.count * motions.n_modes), np.ones(motions.count)
        for _ in range(MOST_RIGID_STEPS):
            place()
            self._bodies.assemble()
            for pair in in_question(self._pairs):
                # without friction, rigid motions may have separated contactors from the target
                if pair.friction is None:
                    near = pair.kinematics.gap <= TOUCHING * self._bodies.config.size
                    pair.take(replace(pair.trial, active=pair.trial.active & near))
            v, took = self._step(damping, freely)
            changed |= took
            if v is None:
                return changed
            ways = motions.ways(v)
            if self._far_apart.look_along(ways):
                continue
            motions.config.shift(slice(None), ways)
            self._went -= ways
            damping, before, changed = self._pace(damping, before, v), v, True
        raise motions.error(before)

    def _pace(self, damping: Array, before: Array, v: Array) -> Array:
        """Factors of every body's next step ``(count,)``, from its last step v and the step ``before``.

        The factor is halved if a body reverses. It is doubled if a body continues, for instance from an unstable balance, and twice the
        step stays within the limit of rotation.
        """
        motions = self.motions
        assert motions is not None
        last, now = before.reshape(motions.count, -1), v.reshape(motions.count, -1)
        along, small = (last * now).sum(axis=1), 2.0 * np.abs(now).max(axis=1) <= TURN * motions.radius
        faster = np.where((along > 0) & small, 2.0 * damping, np.maximum(damping, np.minimum(1.0, 2.0 * damping)))
        return np.where(along < 0, 0.5 * damping, faster)

    def _held(self) -> _Held:
        """Motions that contacts and equations of users hold at the present positions (collective)."""
        motions, g = self.motions, self._bodies.config.gdim
        assert motions is not None
        pairs = in_question(self._pairs)
        equations = [pair.equations() for pair in pairs]
        more = [] if self._linear is None else [self._linear.at_present(), *self._linear.sprung()]
        rows = UnitingEquations.join([*(_of_held(pair, e) for pair, e in zip(pairs, equations)), *more], g)
        # sticking contactors are held in all directions, those in corners both ways across; others without friction may separate again
        firm = [((e.kind != NORMAL) | (pair.friction is not None))[e.resisting.active] for pair, e in zip(pairs, equations)]
        which = np.concatenate([np.zeros(0, bool), *firm, *(np.ones(len(e), bool) for e in more)])
        rates = motions.rates(rows)
        return _Held(rows, rates, which, motions.open_motions(rates[which]))

    def _step(self, damping: Array, freely: bool) -> tuple[Array | None, bool]:
        """Activate contactors that touch and carry force; an increment of all motions under the loads (collective).

        Args:
            damping: factor of every body's step ``(count,)``.
            freely: see ``_fall``.

        Returns:
            The increment, None if contact holds the bodies, and whether any contactor has become active.

        Raises:
            FloatingBodyError: if the bodies move and no gap closes.
        """
        from scipy.sparse import vstack

        from uem_dolfinx.solve.rigid.rigid_steps import least_motion, weighted

        motions, config, comm = self.motions, self._bodies.config, self._bodies.comm
        assert motions is not None
        held, motions.share, n = self._held(), 0.0, motions.n_modes
        basis = held.basis
        if not basis.shape[1]:
            return None, False
        residual = self._forces()
        loose = motions.load(motions.open_motions(held.rates), residual).any()
        motions.share = 0.0
        if not (loose or freely):
            return None, False
        force, scale = motions.forces(residual)
        f = basis @ (basis.T @ force)
        size = np.linalg.norm(f.reshape(-1, n), axis=1)
        self._loads = scale if self._loads is None else self._loads
        # if all bodies float, the residual of equilibrium is rounding, small relative to the loads at the beginning of the step
        if size.max() <= max(LOADED * max(scale, self._loads), self._bodies.rounding_of_displacement()):
            return None, False
        pairs = in_question(self._pairs)
        ahead = [pair.approach for pair in pairs]
        front = UnitingEquations.join([rows for _, rows in ahead], config.gdim)
        R = vstack([motions.rates(front), held.rates[~held.which]]).tocsr()
        gap = np.concatenate([front.gap, held.rows.gap[~held.which]])
        # the mass of each body is proportional to its load; bodies without loads are nearly massless
        weight, turn = np.maximum(size, LIGHT * size.max()), TURN * motions.radius
        ways = self._ways(R, gap, f / np.repeat(weight, n))
        shift = np.maximum(turn, np.where(np.isinf(ways), 0.0, ways))
        M = ((weight / damping)[:, None] / np.where(np.arange(n) < config.gdim, shift[:, None], turn[:, None])).ravel()
        B = weighted(basis, M)
        v, push = least_motion(comm, f, B, R, gap, np.arange(len(gap)) >= len(front))
        took = False
        if loose:
            free = B @ (B.T @ f)
            carries = (push > 0) | ((R @ free < -OPEN * np.linalg.norm(free)) & (R @ v <= OPEN * np.linalg.norm(free)))
            parts = np.split(carries[: len(front)], np.cumsum([len(i) for i, _ in ahead])[:-1])
            active = [_activate(pair, i[c]) for pair, (i, _), c in zip(pairs, ahead, parts)]
            took = any(active)
            if freely and any(a and pair.friction is not None for a, pair in zip(active, pairs)):
                return np.zeros_like(v), True
        if not freely:
            return None, took
        left = basis @ (basis.T @ (M * v))
        motions.share = float(np.abs(left).max() / scale)
        if np.abs(v).max() <= TOUCHING * config.size:
            return None, took
        # if no gap closes and no overlap is removed, the motion never stops
        rate, some = R @ v, OPEN * np.abs(v).max()
        if not reduced(comm, bool(((rate < -some) | ((push > 0) & (rate > some))).any()), op=MPI.LOR):
            lists = {id(one): one for pair in self._pairs if (one := getattr(pair.target, "neighbours", None)) is not None}
            if any([self._far_apart.look_at_all(), *(one.look_farther() for one in lists.values())]):
                return np.zeros_like(v), took
            raise motions.error(v)
        return v, took

    def _ways(self, R: Any, gap: Array, v: Array) -> Array:
        """Multiple of motions ``v (n_motions,)`` at which the first gap of every body closes ``(count,)`` (collective)."""
        motions = self.motions
        assert motions is not None
        ways, rate = np.full(motions.count, np.inf), R @ v
        closing = np.flatnonzero(rate < -OPEN)
        terms = R[closing].tocoo()
        large = np.abs(terms.data) > OPEN
        way = np.maximum(gap[closing], 0.0) / -rate[closing]
        np.minimum.at(ways, terms.col[large] // motions.n_modes, way[terms.row[large]])
        self._bodies.comm.Allreduce(MPI.IN_PLACE, ways, op=MPI.MIN)
        return ways


def _activate(pair: Interface, closing: Ints) -> bool:
    """Activate contactors ``closing (k,)`` that touch, negative for those whose gaps hold by themselves (collective): whether any do."""
    now = closing[(closing >= 0) & (pair.kinematics.gap[closing] <= TOUCHING * pair.config.size)]
    active = pair.trial.active.copy()
    active[now] = True
    pair.take(replace(pair.trial, active=active))
    return bool(reduced(pair.config.comm, len(now)))


def _of_held(pair: Interface, equations: ContactRows) -> UnitingEquations:
    """Active rows of an interface; contactors stay as far inside as the equations that replace theirs leave them."""
    rows = equations.resisting
    inside = equations.normal & pair.trial.redundant[equations.contactor] & (rows.gap < 0.0)
    return replace(rows, gap=np.where(inside, 0.0, rows.gap)).select(rows.active)
