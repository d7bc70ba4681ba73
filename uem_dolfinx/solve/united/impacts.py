"""Impact of contactors that keep their mass, in implicit steps: contact acts for a whole step, with the force at its end.

The trapezoidal rule hands half of the contact force f of a step on to the next, in the acceleration. There it works after a release, so
that every touch gives energy. Here contact is fully implicit [C. Kane, E. A. Repetto, M. Ortiz, J. E. Marsden, Finite element analysis of
nonsmooth contact, Comput. Methods Appl. Mech. Engrg. 180 (1999) 1-26]: what f adds to acceleration and inertia forces at the end of a
step is taken out again, under all equations but those of contact,

    P'MP dq = P' f,      a - (1 - alpha_f) / (1 - alpha_m) P dq,      I - M P dq

The step has the impulse ``s dt f`` with ``s = gamma (1 - alpha_f) / (1 - alpha_m)``, 1/2 for the trapezoidal rule, and its work
``s f . du`` is not positive: gaps close, and forces push. The rule would turn the velocity of a contactor that is held round in every step.
So velocities change at the end of the step until closed gaps stay closed, and what sticks at rest, by impulses of contact and friction,

    Q'M (P dq + c) = 0,      v + P dq + c          c closes the rates of gaps

which is plastic impact of the contactors' mass. Contact forces of the committed state are means over the step, of both.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.pair.interface import Interface, in_question
from uem_dolfinx.contact.seam.placement import Traction
from uem_dolfinx.dynamics.massless import followed_by, united_accelerations
from uem_dolfinx.dynamics.scheme import Scheme
from uem_dolfinx.errors import InputError, MassError
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import agree, agreed, reduced
from uem_dolfinx.solve.bodies.tangent import added_mass
from uem_dolfinx.solve.united.rows import OverConstraints, Rows, make_rows, read_forces
from uem_dolfinx.solve.united.system import BodySystem

WITHOUT = "leave it out, or take contactors='massless'"


class Impacts:
    """Contacts of a problem whose forces act for whole steps.

    Args:
        problem: with implicit dynamics, whose contactors keep their mass.
        pairs: of hard contacts.

    Raises:
        InputError: for contacts with forces that are not proportional to normal forces, or histories of contact forces.
        MassError: for nodes without mass.
    """

    def __init__(self, problem: Any, pairs: list[Interface]):
        self._problem, self.dynamics, self.pairs = problem, problem.dynamics, pairs
        self._equations: tuple[Any, OverConstraints] | None = None  # equations of users, and what they and ties have in common
        #: Work of impulses at the end of the last step on prescribed components, and on free ones in excess of the work of their means over
        #: the step (this rank) ``(2,)``.
        self.excess: Array = np.zeros(2)
        with agreed(problem.comm):
            for pair in pairs:
                _refuse(pair)
        self._refuse_bare_nodes()
        for pair in pairs:
            if pair.friction is not None:
                pair.friction.limits.act_whole_steps()

    def _refuse_bare_nodes(self) -> None:
        config, massy = self._problem.config, self.dynamics.inert | ~self._problem.bodies.free[: self._problem.config.n_owned]
        for pair in self.pairs:
            touches = followed_by(config, pair.discretisation)[: config.n_owned]
            touches[pair.nodes] = True
            bare = np.flatnonzero(touches & ~massy.all(axis=1))
            words = f"{pair.name}: the node at {config.describe(int(bare[0]))} has no mass" if len(bare) else ""
            agree(
                config.comm, MassError(f"{words}, which contactors='massy' needs: take contactors='massless'") if words else None
            )

    def _rows(self) -> Rows:
        """Equations of ties and of users at the last projection (collective)."""
        problem, others = self._problem, [pair for pair in self._problem.interfaces if pair not in self.pairs]
        bodies, linear = problem.bodies, problem.linear
        if self._equations is None or self._equations[0] is not linear:
            self._equations = linear, OverConstraints(problem.config, others, linear)
        return make_rows(self._equations[1], in_question(others), lambda _: bodies.free_rows, bodies.prescribed, linear)

    def accelerate(self) -> None:
        """Find the first acceleration, without contact (collective)."""
        self._problem.system.accelerate(lambda: self._rows().test)

    def refuse_statics(self) -> None:
        """Refuse an equilibrium after time steps: no contact force is left that it could begin with."""
        if self.dynamics.last > 0.0:
            raise InputError(
                f"solve() after time steps with contactors='massy', whose contact forces act within steps: {WITHOUT}"
            )

    def commit(self) -> None:
        """Commit the rates of a step, without what contact forces have added to acceleration and inertia forces (collective)."""
        moving, self.excess = self.dynamics.moving, np.zeros(2)
        self.dynamics.commit()
        if not moving:
            return
        problem, config, system = self._problem, self._problem.config, self._problem.system
        forces = config.unknowns.vector()
        for pair in in_question(self.pairs):
            forces.array[: config.n_owned * config.gdim] += config.add_at_owners(*pair.nodal_forces(pair.trial)).ravel()
        if not reduced(config.comm, bool(forces.array_r.any()), op=MPI.LOR):
            return
        # equations hold the bodies against contact for the whole step, too
        held = system.residual()
        held.axpy(self.dynamics.scheme.impulse - 1.0, self._take_out(forces))
        if problem.linear is not None:
            problem.linear.settle(self.dynamics)
        self._strike(system.rows_of_last(), held)

    def _take_out(self, forces: PETSc.Vec) -> PETSc.Vec:
        """Take out what contact forces add to rates; returns the inertia forces that they add (collective)."""
        dynamics = self.dynamics
        part, shape, n = dynamics.scheme.lasting, dynamics.massy.shape, dynamics.massy.size
        found = united_accelerations(dynamics.matrix, self._rows().test, forces, added_mass(self._problem.linear, forces))
        a = found.array_r[:n].reshape(shape)
        now, own = (np.array(field.x.array[:n]) for field in (dynamics.velocity, dynamics.acceleration))
        dynamics.change_rates(now, own - part * (a * dynamics.massy).ravel(), part)
        inertia = self._problem.config.unknowns.vector()
        inertia.array[:n] = dynamics.mass.times(a * dynamics.massy).ravel()
        for one in dynamics.added:
            inertia.array[:n].reshape(shape)[one.set.nodes] += one.take_out(a, part)
        return inertia

    def _strike(self, rows: Rows, forces: PETSc.Vec) -> None:
        """Let closed gaps stay closed, by impulses at the end of the step, and set all forces to means over it (collective).

        A contactor that impulses would hold back, or push out of the cone of friction, is left out.

        Args:
            rows: equations of the step's end.
            forces: that they carry, means over the step without these impulses.
        """
        dynamics, problem, shape, n = self.dynamics, self._problem, self.dynamics.massy.shape, self.dynamics.massy.size
        M, more, pairs = dynamics.matrix, added_mass(problem.linear, forces), rows.pairs
        gap, left = np.where(rows.whole.kind >= 0, self._rates(rows), 0.0), True
        kept = [(pair.trial.lam > 0.0) & (pair in self.pairs) for pair in pairs]
        while left:
            on = rows.whole.rows.active.copy()
            of = [one[part.contactor] | (part.kind < 0) for one, part in zip(kept, rows.equations)]
            on[: sum(map(len, of))] &= np.concatenate([np.zeros(0, bool), *of])
            now = rows.with_gaps(problem.system.over_constraints, gap, on)
            c = now.frictionless.c
            dv = c + united_accelerations(M, now.frictionless, -forms.product(M, c, more), more, now.test)
            every, total = dv.array_r[:n].reshape(shape), forces.copy()
            change = every * dynamics.massy
            impulse = dynamics.mass.times(change)
            of_points = [(one, one.carried_by(every)) for one in dynamics.added]
            total.array[:n] += impulse.ravel() / dynamics.last
            for one, own in of_points:
                total.array[:n].reshape(shape)[one.set.nodes] += one.nodal_forces(one.masses[:, None] * own) / dynamics.last
            found, multipliers = read_forces(pairs, rows, rows.test.pass_on(total), None)
            bad = [one & ~_admissible(pair, force) for one, pair, force in zip(kept, pairs, found)]
            kept = [one & ~wrong for one, wrong in zip(kept, bad)]
            left = reduced(problem.comm, any(wrong.any() for wrong in bad), op=MPI.LOR)
        v, mean = (field.x.array[:n].reshape(shape) for field in (dynamics.velocity, dynamics.mean_velocity))
        held, rates = dynamics.held.reshape(shape), v + 0.5 * change - mean
        self.excess = np.array([(impulse * v)[held].sum(), (impulse * rates)[~held].sum()])
        for one, own in of_points:
            # the same on all ranks
            lead = one.velocity + 0.5 * own - one.carried_by(mean)
            self.excess[1] += one.masses @ (own * lead).sum(axis=1) / problem.comm.size
            one.change_rates(one.velocity + own, one.acceleration)
        dynamics.change_rates((v + change).ravel(), np.array(dynamics.acceleration.x.array[:n]))
        for pair, force in zip(pairs, found):
            if pair in self.pairs or pair.tie is not None:
                pair.set_forces(force)
        if problem.linear is not None:
            problem.linear.multipliers = multipliers

    def _rates(self, rows: Rows) -> Array:
        """Rates of the gaps of all equations ``(m,)``, relative to the mean motions of rigid targets over the step (collective)."""
        config, eq, n = self._problem.config, rows.whole.rows, self.dynamics.massy.size
        (every := config.unknowns.vector()).array[:n] = self.dynamics.velocity.x.array[:n]
        v = every.array.reshape(-1, config.gdim)
        # nodes without mass of their own move with that at the point of their coupling
        for one in self.dynamics.added:
            nodes = one.set.nodes
            v[nodes] = np.where(self.dynamics.massy[nodes], v[nodes], one.nodal_velocities())
        theirs, at, first = np.einsum("kg,kg->k", eq.coefficients, config.unknowns.ask_owners(eq.followed, v)), v[eq.node], 0
        before, still = dict(zip(self._problem.interfaces, self._problem.motions)), Motion.none(config.gdim)
        for pair, part in zip(rows.pairs, rows.equations):
            if pair.target.motion is not before[pair]:
                x = pair.points[part.contactor]
                way = x - (before[pair] or still).carry((pair.target.motion or still).back(x))
                at[first : first + len(part)] -= way / self.dynamics.last
            first += len(part)
        return np.asarray(np.einsum("mg,mg->m", eq.direction, at) - np.bincount(eq.row, theirs, len(eq)))


def _admissible(pair: Interface, found: Traction) -> Bools:
    """Contactors that are pressed, and within the cone of friction ``(n,)``."""
    pressed = (found.lam >= 0.0) | pair.trial.in_corner
    if pair.friction is None or found.tau is None:
        return pressed
    size = np.linalg.norm(found.tau, axis=1)
    return pressed & (pair.friction.slipping(pair.trial) | (size <= pair.friction.bound(pair.trial, np.maximum(found.lam, 0.0))))


def impacts_of(problem: Any) -> Impacts | None:
    """Contacts with impacts of a problem whose contactors keep their mass; None without, and with other methods (collective)."""
    if not (problem.interfaces and isinstance(problem.dynamics.scheme, Scheme)):
        return None
    if type(problem.system) is not BodySystem:
        logger.warning(
            "contactors='massy': with this method, contact forces enter the accelerations, so that every touch adds energy"
        )
        return None
    tied = {id(contact.pair.whole) for contact in problem.contacts if contact.tied is True}
    hard = [pair for pair in problem.interfaces if not (pair.trial.has_law or id(pair) in tied)]
    return Impacts(problem, hard) if hard else None


def _refuse(pair: Interface) -> None:
    """Refuse what does not go with contact forces of whole steps."""
    friction, words = pair.friction, f"with Dynamics(..., contactors='massy') in implicit steps: {WITHOUT}"
    for what, there in (
        ("a tie of contactors that also touch", pair.tie is not None),
        ("heat", bool(pair.heats)),
        ("wear", friction is not None and friction.wear is not None),
        ("a fluid", pair.trial.wet is not None),
        ("friction with a limit per area", friction is not None and friction.limits.law.per_area),
    ):
        if there:
            raise InputError(f"{pair.name}: {what} does not go {words}")
