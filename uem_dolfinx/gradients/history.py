"""Gradients of functionals of all steps: committed steps are recorded and swept backwards, with one adjoint problem each, see ``sweep``.

The active set, sticking and slipping, yielding points, and the number and lengths of steps are kept as recorded.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from ufl.corealg.traversal import traverse_unique_terminals

from uem_dolfinx import forms, given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.laws.law import as_law, is_of_position
from uem_dolfinx.errors import InputError
from uem_dolfinx.form_checks import check_functional
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.gradients.assemblies import Prescribed, constants_of
from uem_dolfinx.gradients.gradient import (
    AnyControl,
    check_controls,
    refuse_idle_controls,
    refuse_kept_projections,
    refuse_results,
    refuse_without_state,
)
from uem_dolfinx.gradients.records import Record, Records
from uem_dolfinx.gradients.sweep import Sweep
from uem_dolfinx.materials.elastic import material_of
from uem_dolfinx.parallel import agreed
from uem_dolfinx.solve.loading import Taken, led_by, uniform
from uem_dolfinx.solve.memory import Memory, move_targets
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.steps.stages import Step


class History(given.Sealed):
    """All steps that a problem takes while it is recorded, see :func:`recording`.

    Args:
        problem: whose steps are recorded.
        folder: for a scratch file of each rank; None keeps them in memory.
    """

    def __init__(self, problem: UnitedProblem, folder: Path | None = None):
        self.problem = problem
        self._first = problem.progress.steps
        self._records = Records(folder)
        self._start: Record | None = None  # initial state of a motion; None in statics
        self._led: list[Any] = []  # Constants and contacts ramped by steps, referenced here so that their ids stay unique
        #: Numbers of the steps that ramped them first; what their values end at has no share in steps before.
        self._led_from: list[int] = []
        self._by_function: list[fem.Constant] = []  # Constants that Steps set by functions of the load factor
        #: Laws with history that have derivatives.
        self._laws: list[Any] = problem.materials
        F = problem.bodies.F
        known = (f for f in F.coefficients() if f is not problem.u and material_of(f) is None)
        self._inputs = list({id(m): m for m in [*F.constants(), *known, *constants_of(problem)]}.values())

    def __len__(self) -> int:
        """Number of steps."""
        return len(self._records)

    def __repr__(self) -> str:
        """Its number of steps."""
        return f"History({len(self)} steps)"

    def note(self, before: Memory, arc: bool) -> None:
        """Record the step that the problem is about to commit; a repeated step replaces the last record."""
        problem = self.problem
        if arc:
            raise InputError(
                "the steps of an arc depend on each other by their lengths, of which there are no derivatives: record steps of given load"
            )
        self._records.cut(problem.progress.steps - self._first - 1)
        taken = problem.progress.taken
        new = [one for one, *_ in taken.led if all(one is not other for other in self._led)]
        self._led += new
        self._led_from += [len(self._records)] * len(new)
        held = uniform(problem, taken.held)
        self._records.add(self._record(before, taken.by_id(), taken.held if held is None else held))

    def check_steps(self, steps: Sequence[Step]) -> None:
        """Refuse Steps that change the problem itself, or that begin from forces that depend on its state (to be agreed on).

        Raises:
            InputError: names what is not recorded.
        """
        locked = {bolt for step in steps for bolt, force in step.preload.items() if force is None or bolt.locked}
        for wrong, what in (
            (
                any(step.bcs is not None or step.contacts or step.begin is not None for step in steps),
                "conditions, contacts or begin=",
            ),
            (self.problem.linear is not None, "equations or couplings, whose ramps each of them begins"),
            (
                any(as_law(contact.friction).field != 0.0 for step in steps for contact in step.offset),
                "offset= of contacts with friction",
            ),
            (
                any(bolt in locked and force is not None and step.ramp for step in steps for bolt, force in step.preload.items()),
                "preloads of locked sections, ramped from the force that these carry: expected ramp=False",
            ),
        ):
            if wrong:
                raise InputError(f"the problem is being recorded, and no history has derivatives through Steps with {what}")
        self._by_function += [
            c for step in steps if isinstance(step.loads, Mapping) for c, end in step.loads.items() if callable(end)
        ]

    def note_start(self) -> None:
        """Record the initial state of a motion, and its first acceleration."""
        dynamics = self.problem.dynamics
        assert dynamics is not None
        led = Taken().with_led(led_by(self.problem, dynamics.time))
        self._start = self._record(Memory.of(self.problem), led.by_id(), 1.0)

    def _record(self, before: Memory, shares: dict[int, float], held: Array | float) -> Record:
        """Record of the present state, at the end of a step that began with ``before``."""
        problem, dynamics = self.problem, self.problem.dynamics
        return Record(
            before=before,
            displacement=np.array(problem.u.x.array),
            states=[pair.trial for pair in problem.interfaces],
            motions=problem.rigid_motions(),
            values=[np.array(forms.values_of(m)) for m in self._inputs],
            friction=[_friction_of(pair) for pair in problem.interfaces],
            offsets=[pair.discretisation.setting.offset for pair in problem.pairs],
            shares=shares,
            held=held,
            dt=0.0 if dynamics is None else dynamics.dt,
            prescribed=Prescribed.of(problem),
        )

    def gradient(
        self, J: ufl.Form | Sequence[ufl.Form | None], controls: Sequence[AnyControl] | AnyControl
    ) -> list[Array | fem.Function]:
        """Derivatives of a functional of the recorded steps by parameters of the problem, by one adjoint solve a step (collective).

        Exact for the discrete steps: the recorded active sets, sticking and slipping contactors, yielding points and step lengths are
        kept. A change of a control is the same in all steps. A change of a value in ``load``, or of a Dirichlet value at the end of a
        ramp, is its change at the full load, or at time 1. The problem is unchanged.

        Args:
            J: functional of ``problem.u`` in the last step and of the controls, as in :func:`uem_dolfinx.gradient`; in time also of
                ``velocity`` and ``acceleration`` of the dynamics. Or a list of functionals, one for each step or None, whose sum is
                differentiated.
            controls: as in :func:`uem_dolfinx.gradient`, and coefficients of friction; in time also the Constant that is the density of
                the mass, and the Function with the initial velocity; for ``VonMises`` the objects passed as its parameters.

        Returns:
            As in :func:`uem_dolfinx.gradient`.

        Raises:
            InputError, InputTypeError: see :func:`uem_dolfinx.gradient` and :func:`recording`; if no step was recorded; for controls and
                fields in J without derivatives; for anchors without derivatives, next to edges of the target in 3D and in its corners.
            LinearSolveError: if a constrained matrix is singular.
        """
        problem = self.problem
        some = check_controls(problem, "controls", [controls] if isinstance(controls, AnyControl) else controls)
        functionals = self._functionals(J)
        given_forms = [f for f in functionals if f is not None]
        refuse_without_state(problem, given_forms, self._state())
        refuse_idle_controls(problem, "controls", some, given_forms)
        self.check_controls(some)
        sweep = Sweep(problem, some)
        with self._replayed():
            begun = False
            for k in reversed(range(len(self))):
                begun = begun or functionals[k] is not None
                if begun:
                    record = self._placed(k)
                    sweep.pass_back(record, functionals[k])
            sweep.begin(record)
            if self._start is not None:
                self._place(self._start)
                sweep.accelerate(self._start)
        return sweep.found

    def tangent(self, direction: Sequence[tuple[AnyControl, Any]]) -> list[fem.Function]:
        """Derivatives of the displacements of all steps along changes of parameters, by one linear solve a step (collective).

        Exact as ``gradient``, whose controls may be changed.

            by_mu = history.tangent([(uem.ContactParameter(contact, "friction"), 1.0)])[-1]

        Args:
            direction: pairs of a control and its change, as in :func:`uem_dolfinx.tangent`.

        Returns:
            The derivative of the displacement at the end of each recorded step.

        Raises:
            InputError, InputTypeError, LinearSolveError: see ``gradient``.
        """
        problem = self.problem
        pairs = check_controls(problem, "direction", direction)
        with agreed(problem.comm):
            if not len(self):
                raise InputError("the history has no step: expected steps to be taken while it is recorded")
        controls = [control for control, _ in pairs]
        refuse_idle_controls(problem, "direction", controls)
        self.check_controls(controls, "direction")
        from uem_dolfinx.gradients.forward import Forward

        forward = Forward(problem, pairs)
        with self._replayed():
            if self._start is not None:
                self._place(self._start)
                forward.accelerate(self._start)
            for k in range(len(self)):
                record = self._placed(k)
                if k == 0:
                    forward.begin(record)
                    self._place(record)
                forward.advance(record)
        return forward.found

    @contextmanager
    def _replayed(self) -> Iterator[None]:
        """Let recorded steps take the place of the problem's present state for a while (collective)."""
        problem = self.problem
        now, displacement = Memory.of(problem), np.array(problem.u.x.array)
        values, friction = (
            [np.array(forms.values_of(m)) for m in self._inputs],
            [_friction_of(pair) for pair in problem.interfaces],
        )
        offsets, prescribed = [pair.discretisation.setting.offset for pair in problem.pairs], Prescribed.of(problem)
        try:
            yield
        finally:
            self._put(values, friction, offsets)
            prescribed.put_back(problem)
            now.put_back(problem)
            problem.u.x.array[:] = displacement

    def _placed(self, k: int) -> Record:
        """Set the problem to the end of step k, and return its record (collective)."""
        record = self._records[k]
        none = {id(one): 0.0 for one, first in zip(self._led, self._led_from) if k < first}
        record = replace(record, shares=none | record.shares)
        self._place(record)
        return record

    def check_controls(self, controls: Sequence[AnyControl], what: str = "controls") -> None:
        """Refuse controls by which recorded steps have no derivatives (collective)."""
        problem, dynamics = self.problem, self.problem.dynamics
        load = problem.load if isinstance(problem.load, Mapping) else {}
        density = None if dynamics is None else dynamics.mass.density
        made_of = [] if density is None else list(traverse_unique_terminals(density))
        varied = [c.name for c in problem.contacts if c.pair.friction is not None and is_of_position(as_law(c.friction).field)]
        with agreed(problem.comm):
            refuse_kept_projections(problem, len(self))
            for k, m in enumerate(controls):
                if isinstance(m, ufl.SpatialCoordinate) and varied:
                    raise InputError(
                        f"{what}[{k}] is the shape, with which the friction of contact '{varied[0]}', a function of place, changes: "
                        "there is no derivative by it; expected a number or a Function"
                    )
                if isinstance(m, fem.Constant) and (callable(load.get(m)) or any(m is one for one in self._by_function)):
                    raise InputError(
                        f"{what}[{k}] is set by a function of the load factor: expected a Constant that is not, as one by which it is "
                        "multiplied in the residual"
                    )
                if isinstance(m, ufl.SpatialCoordinate) and dynamics is not None:
                    raise InputError(f"{what}[{k}] is the shape, on which masses depend: there are no derivatives by it in time")
                if isinstance(m, ufl.SpatialCoordinate) and problem.materials:
                    raise InputError(f"{what}[{k}] is the shape, by which there are no derivatives through laws with history")
                if isinstance(m, fem.Function) and material_of(m) is not None:
                    raise InputError(
                        f"{what}[{k}] is '{m.name}', a field of a law with history: expected what the problem is made of"
                    )
                scales = m is density and isinstance(m, fem.Constant)
                if not scales and any(m is one for one in made_of):
                    raise InputError(f"{what}[{k}] is a part of the density: expected a Constant that is the density itself")

    def _functionals(self, J: Any) -> list[ufl.Form | None]:
        """A functional for each step, or None (collective)."""
        n, problem = len(self), self.problem
        with agreed(problem.comm):
            if not n:
                raise InputError("the history has no step: expected steps to be taken while it is recorded")
            one = isinstance(J, ufl.Form)
            some = (
                [None] * (n - 1) + [J]
                if one
                else given.items("J", J, lambda f: f is None or isinstance(f, ufl.Form), "a UFL form or None")
            )
            if len(some) != n:
                raise InputError(f"J has {len(some)} items: expected one for each of the {n} recorded steps")
            if all(functional is None for functional in some):
                raise InputError("J holds no functional: expected one of a step at least")
            for k, functional in enumerate(some):
                if functional is not None:
                    what = "J" if one else f"J[{k}]"
                    given.kind(what, functional, not functional.empty(), "a UFL form with an integral")
                    check_functional(what, functional, problem.config.mesh)
                    refuse_results(functional)
                    self._refuse_unknown(what, functional)
        # the same form in several steps stays the same
        whole = {id(f): revolved(f) for f in some if f is not None}
        return [None if f is None else whole[id(f)] for f in some]

    def _state(self) -> list[fem.Function]:
        """Functions that functionals may depend on."""
        dynamics = self.problem.dynamics
        rates = [] if dynamics is None else [dynamics.velocity, dynamics.acceleration]
        return [self.problem.u, *rates, *(law.stress_in_forms for law in self._laws)]

    def _refuse_unknown(self, what: str, J: ufl.Form) -> None:
        """Refuse a functional of fields whose derivatives by the displacement are not available."""
        dynamics = self.problem.dynamics
        for f in J.coefficients():
            if dynamics is not None and (f is dynamics.mean_velocity or f is dynamics.forces):
                raise InputError(f"{what} holds '{f.name}': expected displacement, velocity and acceleration alone")
            if material_of(f) is not None and all(f is not law.stress_in_forms for law in self._laws):
                raise InputError(
                    f"{what} holds '{f.name}', a field of a law with history: expected the displacement, and what the residual of this "
                    "problem's laws holds"
                )

    def _put(self, values: Sequence[Array], friction: Sequence[Array | None], offsets: Sequence[Array | None]) -> None:
        """Set the values of Constants and Functions, friction and offsets of the problem (collective)."""
        for m, value in zip(self._inputs, values):
            forms.values_of(m)[...] = value
        for pair, mu in zip(self.problem.interfaces, friction):
            if pair.friction is not None and mu is not None:
                pair.friction.limits.change(mu)
        for pair, offset in zip(self.problem.pairs, offsets):
            there = pair.discretisation.setting.offset
            if there is not offset and (there is None or offset is None or not np.array_equal(there, offset)):
                pair.set_offset(offset)

    def _place(self, record: Record) -> None:
        """Set the problem to the end of a recorded step, before its commit (collective)."""
        problem = self.problem
        self._put(record.values, record.friction, record.offsets)
        record.prescribed.put_back(problem)
        record.before.put_back(problem)
        problem.u.x.array[:] = record.displacement
        move_targets(problem, record.motions)
        for pair, state in zip(problem.interfaces, record.states):
            pair.take(state)
        if problem.dynamics is not None and record is not self._start:
            problem.dynamics.begin(record.dt)


def _friction_of(pair: Any) -> Array | None:
    return None if pair.friction is None else pair.friction.value
