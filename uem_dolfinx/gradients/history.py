"""Gradients of functionals of all steps: committed steps are recorded and swept backwards, with one adjoint problem each, see ``sweep``.

The active set, sticking and slipping, yielding points, and the number and lengths of steps are kept as recorded.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from hashlib import blake2b
from pathlib import Path
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from ufl.corealg.traversal import traverse_unique_terminals

from uem_dolfinx import forms, given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.laws.coulomb import Coulomb
from uem_dolfinx.contact.laws.law import as_law, follows_load, is_of_position
from uem_dolfinx.dynamics.explicit.refused import is_explicit
from uem_dolfinx.errors import InputError
from uem_dolfinx.form_checks import check_functional
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.gradients.assemblies import Prescribed, constants_of
from uem_dolfinx.gradients.gradient import (
    AnyControl,
    check_controls,
    check_problem,
    refuse_idle_controls,
    refuse_kept_projections,
    refuse_results,
    refuse_without_state,
)
from uem_dolfinx.gradients.parameters import keeps_distance
from uem_dolfinx.gradients.records import Record, Records
from uem_dolfinx.gradients.sweep import Sweep
from uem_dolfinx.materials.elastic import material_of
from uem_dolfinx.parallel import agreed
from uem_dolfinx.solve.memory import Memory, move_targets
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.steps.step import Step
from uem_dolfinx.solve.taken import Taken, led_by, uniform


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
        #: Digest of the positions of the nodes in each step.
        self._places: list[bytes] = []
        #: Initial state of a motion; None in statics.
        self._start: Record | None = None
        #: Constants and contacts ramped by steps, referenced here so that their ids stay unique.
        self._led: list[Any] = []
        #: Numbers of the steps that ramped them first; what their values end at has no share in steps before.
        self._led_from: list[int] = []
        #: Constants that Steps set by functions of the load factor.
        self._by_function: list[fem.Constant] = []
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
        self._places[len(self._records) :] = [_places(problem)]
        taken = problem.progress.taken
        new = [one for one, *_ in taken.led if all(one is not other for other in self._led)]
        self._led += new
        self._led_from += [len(self._records)] * len(new)
        held = uniform(problem, taken.held)
        self._records.add(self._record(before, taken.by_id(), taken.held if held is None else held))

    def check_steps(self, steps: Sequence[Step]) -> None:
        """Refuse Steps that change what the problem is, or that begin from forces that depend on its state (to be agreed on).

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
            states=[pair.trial for pair in problem.pairs],
            motions=problem.rigid_motions(),
            values=[np.array(forms.values_of(m)) for m in self._inputs],
            friction=[None if pair.friction is None else pair.friction.value for pair in problem.pairs],
            offsets=[pair.discretisation.setting.offset for pair in problem.pairs],
            shares=shares,
            held=held,
            dt=0.0 if dynamics is None else dynamics.dt,
            told=Prescribed.of(problem),
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
                ``velocity`` and ``acceleration`` of the dynamics; or a list of functionals, one for each step or None, whose sum is
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
        self._check_controls(some)
        self._refuse_moved_nodes()
        now, displacement = Memory.of(problem), np.array(problem.u.x.array)
        values, friction = [np.array(forms.values_of(m)) for m in self._inputs], [_friction_of(pair) for pair in problem.pairs]
        offsets, told = [pair.discretisation.setting.offset for pair in problem.pairs], Prescribed.of(problem)
        sweep = Sweep(problem, some)
        try:
            begun = False
            for k in reversed(range(len(self))):
                begun = begun or functionals[k] is not None
                if begun:
                    record = self._records[k]
                    none = {id(one): 0.0 for one, first in zip(self._led, self._led_from) if k < first}
                    record = replace(record, shares=none | record.shares)
                    self._place(record)
                    sweep.pass_back(record, functionals[k])
            sweep.begin(record)
            if self._start is not None:
                self._place(self._start)
                sweep.accelerate(self._start)
        finally:
            self._put(values, friction, offsets)
            told.put_back(problem)
            now.put_back(problem)
            problem.u.x.array[:] = displacement
        return sweep.found

    def _refuse_moved_nodes(self) -> None:
        """Refuse steps that were taken with other positions of the nodes (collective)."""
        now = _places(self.problem)
        with agreed(self.problem.comm):
            for k, then in enumerate(self._places):
                if then != now:
                    raise InputError(
                        f"the nodes have moved since step {k + 1} of the history, which would be swept over at their present places: "
                        "expected nodes that stay where they are while steps are recorded, and until there is a gradient"
                    )

    def _check_controls(self, controls: Sequence[AnyControl]) -> None:
        """Refuse controls by which recorded steps have no derivatives (collective)."""
        problem, dynamics = self.problem, self.problem.dynamics
        load = problem.load if isinstance(problem.load, Mapping) else {}
        density = None if dynamics is None else dynamics.mass.density
        made_of = [] if density is None else list(traverse_unique_terminals(density))
        varied = [c.name for c in problem.contacts if c.pair.frictional and is_of_position(as_law(c.friction).field)]
        with agreed(problem.comm):
            refuse_kept_projections(problem, len(self))
            for k, m in enumerate(controls):
                if isinstance(m, ufl.SpatialCoordinate) and varied:
                    raise InputError(
                        f"controls[{k}] is the shape, with which the friction of contact '{varied[0]}', a function of place, changes: "
                        "there is no derivative by it; expected a number or a Function"
                    )
                if isinstance(m, fem.Constant) and (callable(load.get(m)) or any(m is one for one in self._by_function)):
                    raise InputError(
                        f"controls[{k}] is set by a function of the load factor: expected a Constant that is not, as one by which it is "
                        "multiplied in the residual"
                    )
                if isinstance(m, ufl.SpatialCoordinate) and dynamics is not None:
                    raise InputError(
                        f"controls[{k}] is the shape, on which masses depend: there are no derivatives by it in time"
                    )
                if isinstance(m, ufl.SpatialCoordinate) and problem.materials:
                    raise InputError(f"controls[{k}] is the shape, by which there are no derivatives through laws with history")
                if isinstance(m, fem.Function) and material_of(m) is not None:
                    raise InputError(
                        f"controls[{k}] is '{m.name}', a field of a law with history: expected what the problem is made of"
                    )
                scales = m is density and isinstance(m, fem.Constant)
                if not scales and any(m is one for one in made_of):
                    raise InputError(f"controls[{k}] is a part of the density: expected a Constant that is the density itself")

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
        for pair, mu, offset in zip(self.problem.pairs, friction, offsets):
            if pair.friction is not None and mu is not None:
                pair.discretisation.set(cones=pair.friction.limits.change(mu))
            there = pair.discretisation.setting.offset
            if there is not offset and (there is None or offset is None or not np.array_equal(there, offset)):
                pair.discretisation.set(offset=offset)

    def _place(self, record: Record) -> None:
        """Set the problem to the end of a recorded step, before its commit (collective)."""
        problem = self.problem
        self._put(record.values, record.friction, record.offsets)
        record.told.put_back(problem)
        record.before.put_back(problem)
        problem.u.x.array[:] = record.displacement
        move_targets(problem, record.motions)
        for pair, state in zip(problem.pairs, record.states):
            pair.trial = state
        if problem.dynamics is not None and record is not self._start:
            problem.dynamics.begin(record.dt)


def _places(problem: UnitedProblem) -> bytes:
    """Digest of the positions of this rank's nodes."""
    return blake2b(np.ascontiguousarray(problem.config.mesh.geometry.x).tobytes()).digest()


def _friction_of(pair: Any) -> Array | None:
    return None if pair.friction is None else pair.friction.value


@contextmanager
def recording(problem: UnitedProblem, *, scratch: str | Path | None = None) -> Iterator[History]:
    """Record all steps of a problem in a ``with`` block, for gradients through their history (collective).

    Example::

        with uem.recording(problem) as history:
            for step in uem.load_steps(problem, 10):
                ...
        by_E, by_mu = history.gradient(J, [E, uem.ContactParameter(contact, "friction")])

    A record contains the displacement, the history of contactors, laws and inertia, and the changed values of Constants and Functions in
    the residual.

    Args:
        problem: in statics or in time; supported are Coulomb friction between nodes of degree 1 and surfaces with sliding='finite', and
            ``VonMises`` as law with history.
        scratch: folder for a file of each rank with the steps, which is deleted with the history; None keeps them in memory.

    Yields: The history, which may be used in the block and after it.

    Raises:
        InputError, InputTypeError: for a problem without such derivatives: with mortar and friction, other laws with history or of
            friction, wear, ties, offsets of contacts with friction, or in time sliding='small'; or if the folder does not exist.
    """
    check_problem(problem)
    with agreed(problem.comm):
        given.kind("scratch", scratch, scratch is None or isinstance(scratch, (str, Path)), "a folder, or None")
        if problem.history is not None:
            raise InputError("the problem is being recorded: expected one history at a time")
        if is_explicit(problem.dynamics):
            raise InputError("steps of CentralDifferences have no derivatives: take an implicit scheme, as uem.newmark()")
        for contact in problem.contacts:
            if contact.pair.frictional:
                _check_first(problem, f"those of contact '{contact.name}' with friction")
                _check_friction(problem, contact)
            if problem.dynamics is not None and contact.sliding == "small":
                raise InputError(
                    f"contact '{contact.name}': a step in time has no derivative by where contactors of sliding='small' were projected: "
                    "expected 'finite' or 'fixed'"
                )
        if problem.dynamics is not None:
            _check_first(problem, "steps in time")
        for material in problem.materials:
            _check_first(problem, "those of a law with history")
            if not getattr(material, "has_slopes", False):
                raise InputError(
                    f"a history has no derivatives through what {type(material).__name__} remembers: expected VonMises "
                    "without back stresses as law with history; else take differences of runs"
                )
        try:
            history = History(problem, None if scratch is None else Path(scratch))
        except OSError as error:
            raise InputError(f"scratch = {scratch!r}: cannot write there ({error}); expected a folder on every rank") from error
    problem.history = history
    try:
        yield history
    finally:
        problem.history = None


def _check_first(problem: UnitedProblem, what: str) -> None:
    """Refuse a problem whose steps depend on earlier steps that were not recorded."""
    if problem.progress.steps:
        raise InputError(
            f"the problem has taken {problem.progress.steps} step(s), on which {what} depend: expected a problem that is recorded from its "
            "first step on"
        )


def _check_friction(problem: UnitedProblem, contact: Any) -> None:
    """Refuse contacts with friction whose history has no derivatives."""
    pair, law = contact.pair, as_law(contact.friction)
    for wrong, expected in (
        (
            not pair.discretisation.traits.pointwise or problem.config.degree > 1,
            "coupling='node_to_surface' and cells of degree 1",
        ),
        (contact.sliding != "finite", "sliding='finite'"),
        (contact.normals != "facet", "normals='facet'"),
        (type(law) is not Coulomb or law.per_area or law.per_point or follows_load(law), "Coulomb's law, without limit or load"),
        (pair.friction.wear is not None, "no wear"),
        (pair.discretisation.setting.offset is not None, "no offset and no adjust"),
        (not keeps_distance(contact), "a rigid plane, sphere or cylinder"),
    ):
        if wrong:
            raise InputError(
                f"contact '{contact.name}': a history with friction has derivatives for {expected} alone; else take differences of runs"
            )
