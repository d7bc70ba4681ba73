"""A forward sweep over recorded steps, each linearised at its end, with one linear problem per step; see ``sweep`` for the steps.

With changes m' of the controls, displacements u_n and history variables h_n change by

    dR/du u_n' = - dR/dh h_{n-1}' - dR/dm m',        h_n' = dH/du u_n' + dH/dh h_{n-1}'
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.gradients.anchor_slopes import AnchorSlopes
from uem_dolfinx.gradients.assemblies import section_of
from uem_dolfinx.gradients.derivatives import Derivatives, along
from uem_dolfinx.gradients.gradient import AnyControl
from uem_dolfinx.gradients.linearised import Motion
from uem_dolfinx.gradients.parameters import ContactParameter, motion_of
from uem_dolfinx.gradients.places import Places
from uem_dolfinx.gradients.records import Record
from uem_dolfinx.gradients.sweep import LinearisedStep, anchor_slopes_of
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.memory import Memory
from uem_dolfinx.solve.problem import UnitedProblem


class ForwardStep(LinearisedStep):
    """The constrained problem linearised at the end of a recorded step, forwards (collective)."""

    def set_operator(self) -> None:
        """Set the matrix ``Q'(K + G)P`` (collective)."""
        self.problem.solver.set_operator(self.P, self.K, self.G, None if self.Q is self.P else self.Q)

    def solve(self, forces: PETSc.Vec) -> PETSc.Vec:
        """``P dq`` with ``Q'(K + G)P dq = Q' forces`` (collective)."""
        dq, _ = self.problem.solver.solve(self.Q.transpose(forces))
        return self.P.expand(self.problem.solver.complete(dq))


class Forward:
    """Changes of displacement and history along a direction, from the first to the last step.

    Args:
        problem: of the steps.
        direction: pairs of a control and its change.

    Attributes:
        found: change of the displacement at the end of each step so far.
    """

    def __init__(self, problem: UnitedProblem, direction: Sequence[tuple[AnyControl, Any]]):
        self.problem, self._direction, self.found = problem, direction, list[fem.Function]()
        self._derivatives = Derivatives(problem.bodies.F, problem.u.function_space, problem.config.V)
        self._anchors = [np.zeros((0, 0))] * len(problem.pairs)
        self._sections = [section_of(contact) for contact in problem.contacts]
        self._openings = [0.0] * len(self._sections)
        laws: list[Any] = problem.materials
        self._laws = [law.slopes(self._derivatives.a, self._derivatives.test, True) for law in laws]

    def begin(self, first: Record) -> None:
        """Compute changes of the anchors before the first step (collective)."""
        problem = self.problem
        if not any(pair.friction is not None for pair in problem.pairs):
            return
        Memory.put_back(first.before, problem)
        places, shape = Places(problem.config), np.zeros((problem.config.n_owned, problem.config.gdim))
        for m, change in self._direction:
            if isinstance(m, ufl.SpatialCoordinate):
                shape += self._at_nodes(places.at_nodes(change))
        slopes = anchor_slopes_of(problem)
        self._anchors = [
            np.zeros((0, 0)) if at is None else np.zeros((len(p.nodes), at.size)) for at, p in zip(slopes, problem.pairs)
        ]
        self._follow(slopes, shape, True)

    def advance(self, record: Record) -> None:
        """Process a step, with the problem set to its end (collective)."""
        step = ForwardStep(self.problem, record, self._derivatives, None)
        with step:
            gaps, pushed = np.zeros_like(step.multipliers), np.zeros((step.config.n_owned, step.config.gdim))
            first = 0
            for at, own, moved, section, opening in zip(
                step.slopes, step.equations, self._anchors, self._sections, self._openings
            ):
                which = slice(first, first + len(own))
                first += len(own)
                if at is not None:
                    gaps[which], forces = at.pushed(moved, own)
                    pushed += forces
                if section is not None and section.locked and not section.shortened:
                    gaps[which] -= section.along[: len(own)] * opening
            for law in self._laws:
                forces, bulk = law.begin_along(self._direction)
                if (form := along(step.F, law.bulk, bulk)) is not None:
                    forces = forces + step.assembled(form)
                pushed += forces.reshape(pushed.shape)
            motion = step.moved(self._direction, gaps, pushed)
            self.found.append(motion.du)
            self._end(step, motion)

    def _end(self, step: ForwardStep, motion: Motion) -> None:
        """Compute changes of the history at the end of a step (collective)."""
        self._follow(step.slopes, self._at_nodes(motion.du) + self._at_nodes(motion.shape), False)
        for k, section in enumerate(self._sections):
            if section is not None and not section.locked:
                opened = float((section.opening_back() * self._at_nodes(motion.du)).sum())
                self._openings[k] = float(reduced(self.problem.comm, opened))
        self._derivatives.along(motion.du.x.array[: self.problem.config.n_owned * self.problem.config.gdim])
        for law in self._laws:
            law.end()

    def _follow(self, slopes: Sequence[AnchorSlopes | None], way: Array, first: bool) -> None:
        """Compute changes of the anchors, with those of the owned nodes ``way (n_owned, gdim)`` (collective)."""
        for k, (at, contact) in enumerate(zip(slopes, self.problem.contacts)):
            if at is not None:
                self._anchors[k] = at.follow(self._anchors[k], way - self._led(contact, len(way)), first)

    def _led(self, contact: Contact, n: int) -> Array | float:
        """Changes of the positions of nodes on the rigid target of a contact ``(n, gdim)``."""
        found: Array | float = 0.0
        for m, change in self._direction:
            if isinstance(m, ContactParameter) and m.contact is contact and m.parameter in ("place", "turn"):
                for entry, size in np.ndenumerate(np.asarray(change, dtype=float)):
                    found = found + size * motion_of(m, self.problem.config.x[:n], entry)
        return found

    def _at_nodes(self, f: fem.Function) -> Array:
        """Values at the owned nodes ``(n_owned, gdim)``."""
        config = self.problem.config
        return np.array(f.x.array[: config.n_owned * config.gdim]).reshape(-1, config.gdim)
