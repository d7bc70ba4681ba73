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

from uem_dolfinx import forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.pair.interface import Interface
from uem_dolfinx.contact.pair.tables import table_of
from uem_dolfinx.dynamics.rate_slopes import RateChanges
from uem_dolfinx.gradients.anchor_slopes import AnchorSlopes
from uem_dolfinx.gradients.assemblies import Users, by_section, section_of
from uem_dolfinx.gradients.derivatives import Derivatives, Places, along
from uem_dolfinx.gradients.gradient import AnyControl
from uem_dolfinx.gradients.linearised import Motion
from uem_dolfinx.gradients.mean_slopes import MeanSlopes
from uem_dolfinx.gradients.parameters import ContactParameter, motion_of
from uem_dolfinx.gradients.records import Record
from uem_dolfinx.gradients.sweep import (
    LEANS_NO_MORE,
    MOST_LEANING,
    LinearisedStep,
    accelerations,
    anchor_slopes_of,
    place_at_start,
)
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.memory import Memory
from uem_dolfinx.solve.problem import UnitedProblem


class ForwardStep(LinearisedStep):
    """The constrained problem linearised at the end of a recorded step, forwards; arguments as of ``LinearisedStep`` (collective)."""

    _rates: RateChanges | None

    def set_operator(self) -> None:
        """Set the matrix ``Q'(K + G)P`` (collective)."""
        self.problem.solver.set_operator(self.P, self.K, self.G, None if self.Q is self.P else self.Q)

    def moved(
        self, direction: Sequence[tuple[AnyControl, Any]], gaps: Array | float = 0.0, pushed: Array | float = 0.0
    ) -> Motion:
        """With rows that lean, see ``LinearisedStep.adjoint`` (collective)."""
        motion, before = super().moved(direction, gaps, pushed), np.zeros(1)
        for _ in range(MOST_LEANING if self._leaning else 0):
            more = self.leaned(self.config.of(motion.du.x.array + motion.shape.x.array)[: self.config.n_owned])
            size, off = reduced(self.config.comm, np.array([(more**2).sum(), ((more - before) ** 2).sum()]))
            if off <= LEANS_NO_MORE**2 * size:
                return motion
            motion, before = super().moved(direction, gaps + more, pushed), more
        return self._given_up() if self._leaning else motion

    def stiffness(self, du: PETSc.Vec) -> PETSc.Vec:
        """``(K + G) du``, with what K lacks at prescribed displacements (collective)."""
        found = super().stiffness(du)
        if self._rates is not None:
            inertia, speed = self._rates.beyond(np.array(du.array_r))
            found.array[:] += inertia + damping_along(self.problem, speed)
        return found


def forces_along(problem: UnitedProblem, m: Any, change: Any) -> Array | float:
    """Change of the residual along that of a Constant or a Function, in the rows of vectors ``(n,)`` (collective)."""
    form = along(problem.bodies.F, m, change)
    if form is None:
        return 0.0
    return np.asarray(problem.config.rows(forms.assemble_array(problem.u.function_space, forms.form(form))).ravel())


def damping_along(problem: UnitedProblem, speed: Array) -> Array | float:
    """Change of the forces of damping with that of its velocity ``(n,)``; 0 without damping (collective)."""
    if problem.dynamics is None or problem.dynamics.damping is None:
        return 0.0
    change = fem.Function(problem.config.V)
    change.x.array[: len(speed)] = speed
    change.x.scatter_forward()
    return forces_along(problem, problem.dynamics.past, change)


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
        self._anchors = [np.zeros((0, 0))] * len(problem.interfaces)
        self._sections = [section_of(pair) for pair in problem.interfaces]
        self._openings = [0.0] * len(self._sections)
        self._rates = None if problem.dynamics is None else RateChanges(problem.dynamics, self._density())
        laws: list[Any] = problem.materials
        self._laws = [law.slopes(self._derivatives.a, self._derivatives.test, True) for law in laws]

    def _density(self) -> float:
        """Change of the logarithm of the density."""
        dynamics, found = self.problem.dynamics, 0.0
        for m, change in self._direction:
            if isinstance(m, fem.Constant) and dynamics is not None and m is dynamics.mass.density:
                found += float(change / m.value)
        return found

    def accelerate(self, start: Record) -> None:
        """Compute changes of the first velocity and acceleration, with the problem set to the start (collective)."""
        problem, dynamics = self.problem, self.problem.dynamics
        if dynamics is None or self._rates is None:
            return
        place_at_start(problem, [control for control, _ in self._direction])
        users, n = Users(problem, 0.0), problem.config.n_owned * problem.config.gdim
        forces, velocity = np.array(self._rates.pushed_at_start()), np.zeros(n)
        for m, change in self._direction:
            if isinstance(m, fem.Constant):
                change = start.shares.get(id(m), 1.0) * np.asarray(change, dtype=float)
                forces += forces_along(problem, m, change)
                if users.have(m):
                    forces += users.changes(m, change)[1].ravel()
            elif isinstance(m, fem.Function):
                forces += forces_along(problem, m, change)
                velocity += change.x.array[:n] if m is dynamics.start_velocity else 0.0
            elif isinstance(m, ContactParameter) and (section := section_of(m.contact.pair)) is not None:
                forces += float(change) * by_section(section, m.parameter, 0)[1].ravel()
        forces += damping_along(problem, velocity)
        acceleration = np.where(dynamics.massy.ravel(), -accelerations(problem, forces).array_r[:n], 0.0)
        self._rates.start(velocity, acceleration)

    def begin(self, first: Record) -> None:
        """Compute changes of the anchors before the first step (collective)."""
        problem = self.problem
        if not any(pair.friction is not None for pair in problem.interfaces):
            return
        Memory.put_back(first.before, problem)
        places, shape = Places(problem.config), np.zeros((problem.config.n_owned, problem.config.gdim))
        for m, change in self._direction:
            if isinstance(m, ufl.SpatialCoordinate):
                shape += self._at_nodes(places.at_nodes(change))
        slopes = anchor_slopes_of(problem)
        self._anchors = [np.zeros((0, 0)) if at is None else at.none for at in slopes]
        self._follow(slopes, shape, True)

    def advance(self, record: Record) -> None:
        """Process a step, with the problem set to its end (collective)."""
        step = ForwardStep(self.problem, record, self._derivatives, self._rates)
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
            if self._rates is not None:
                self._rates.begin()
                inertia, speed = self._rates.pushed()
                pushed += np.reshape(inertia + damping_along(self.problem, speed), pushed.shape)
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
        if self._rates is not None:
            self._rates.end(self._at_nodes(motion.du).ravel())
        self._follow(step.slopes, self._at_nodes(motion.du) + self._at_nodes(motion.shape), False)
        for k, section in enumerate(self._sections):
            if section is not None and not section.locked:
                opened = float((section.opening_back() * self._at_nodes(motion.du)).sum())
                self._openings[k] = float(reduced(self.problem.comm, opened))
        self._derivatives.along(motion.du.x.array[: self.problem.config.n_owned * self.problem.config.gdim])
        for law in self._laws:
            law.end()

    def _follow(self, slopes: Sequence[AnchorSlopes | MeanSlopes | None], way: Array, first: bool) -> None:
        """Compute changes of the anchors, with those of the owned nodes ``way (n_owned, gdim)`` (collective)."""
        for k, (at, pair) in enumerate(zip(slopes, self.problem.interfaces)):
            if at is not None:
                self._anchors[k] = at.follow(self._anchors[k], way, self._led(pair), first)

    def _led(self, pair: Interface) -> Array:
        """Changes of the positions of rigid targets below contactors ``(n, gdim)``."""
        found = np.zeros(pair.points.shape)
        for m, change in self._direction:
            if isinstance(m, ContactParameter) and m.parameter in ("place", "turn"):
                whole, rows = table_of(m.contact.pair)
                for entry, size in np.ndenumerate(np.asarray(change, dtype=float)) if whole is pair else ():
                    found[rows] += size * motion_of(m, pair.points[rows], entry)
        return found

    def _at_nodes(self, f: fem.Function) -> Array:
        """Values at the owned nodes ``(n_owned, gdim)``."""
        config = self.problem.config
        return np.array(f.x.array[: config.n_owned * config.gdim]).reshape(-1, config.gdim)
