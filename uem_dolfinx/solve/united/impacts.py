"""Impact of contactors that keep their mass, in implicit steps: contact acts for a whole step, with the force at its end.

The trapezoidal rule hands half of the contact force f of a step on to the next, in the acceleration. There it works after a release, so
that every touch gives energy. Here contact is fully implicit [C. Kane, E. A. Repetto, M. Ortiz, J. E. Marsden, Finite element analysis of
nonsmooth contact, Comput. Methods Appl. Mech. Engrg. 180 (1999) 1-26]: what f adds to acceleration and inertia forces at the end of a
step is taken out again, under all equations but those of contact,

    P'MP dq = P' f,      a - (1 - alpha_f) / (1 - alpha_m) P dq,      I - M P dq

The step has the impulse ``s dt f`` with ``s = gamma (1 - alpha_f) / (1 - alpha_m)``, 1/2 for the trapezoidal rule. Contact forces of the
committed state are therefore ``s f``, means over the step, and their work ``s f . du`` is not positive: gaps close, and forces push.
"""

from __future__ import annotations

from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.pair.interface import Interface, in_question
from uem_dolfinx.contact.seam.placement import Traction
from uem_dolfinx.dynamics.massless import followed_by, united_accelerations
from uem_dolfinx.dynamics.scheme import Scheme
from uem_dolfinx.errors import InputError, MassError
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
        moving = self.dynamics.moving
        self.dynamics.commit()
        if not moving:
            return
        problem, config = self._problem, self._problem.config
        near, forces = in_question(self.pairs), config.unknowns.vector()
        for pair in near:
            forces.array[: config.n_owned * config.gdim] += config.add_at_owners(*pair.nodal_forces(pair.trial)).ravel()
        if not reduced(config.comm, bool(forces.array_r.any()), op=MPI.LOR):
            return
        rows = self._rows()
        multipliers, found = self._take_out(rows, forces)
        # equations hold the bodies against contact for the whole step, too
        rest = 1.0 - self.dynamics.scheme.impulse
        for pair, own in zip(rows.pairs, found):
            if pair.tie is not None:
                pair.set_forces(_sum(pair.traction, own, -rest))
        if problem.linear is not None:
            problem.linear.multipliers = problem.linear.multipliers - rest * multipliers
        for pair in near:
            pair.set_forces(_sum(pair.traction, pair.traction, -rest))

    def _take_out(self, rows: Rows, forces: PETSc.Vec) -> tuple[Array, list[Traction]]:
        """Take out what contact forces add to rates; returns multipliers, and forces of ties, that balance them (collective)."""
        dynamics = self.dynamics
        part, shape, n = dynamics.scheme.lasting, dynamics.massy.shape, dynamics.massy.size
        found = united_accelerations(dynamics.matrix, rows.test, forces, added_mass(self._problem.linear, forces))
        a = found.array_r[:n].reshape(shape)
        now, own = (np.array(field.x.array[:n]) for field in (dynamics.velocity, dynamics.acceleration))
        dynamics.change_rates(now, own - part * (a * dynamics.massy).ravel(), part)
        left = forces.copy()
        left.array[:n] -= dynamics.mass.times(a * dynamics.massy).ravel()
        for one in dynamics.added:
            left.array[:n].reshape(shape)[one.set.nodes] -= one.take_out(a, part)
        ties, multipliers = read_forces(rows.pairs, rows, rows.test.pass_on(left), None)
        return multipliers, ties


def _sum(of: Traction, other: Traction, factor: float) -> Traction:
    """Contact forces plus a multiple of others."""
    parts: list[Any] = [a if a is None or b is None else a + factor * b for a, b in zip(of, other)]
    return Traction(*parts)


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
