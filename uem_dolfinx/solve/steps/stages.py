"""Steps in progress: switched conditions and contacts, forces released by them, and ramps of loads and coefficients."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.general.general import GeneralContact
from uem_dolfinx.contact.laws.law import Field, FrictionLaw, as_law, given_field, given_friction
from uem_dolfinx.contact.preload import Preload
from uem_dolfinx.contact.switched import (
    between,
    blended_friction,
    frozen_friction,
    hold,
    mark,
    refuse_ramp,
    settle,
    switch_off,
    switch_on,
)
from uem_dolfinx.errors import CheckpointError, InputError
from uem_dolfinx.parallel import agreed, ask_together, reduced
from uem_dolfinx.solve.checks import check_conditions
from uem_dolfinx.solve.kept import take_multipliers
from uem_dolfinx.solve.loading import check_load, owned_displacement, reactions, refuse_idle
from uem_dolfinx.solve.memory import move_targets
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.united.system import BodySystem


@dataclass(frozen=True, eq=False, repr=False)
class Step:
    """A step in a sequence of steps, each of which starts at the end of the previous one: ``load_steps(problem, [fit, turn])``.

    A step lists only what changes relative to the previous step. Its load factor s runs from 0 to 1. Constants and coefficients are
    ramped from their present values to the given ones, Dirichlet values from the present displacement to the conditions' values.
    Removed conditions, and contacts that are switched off, are replaced by their forces, times 1 - s.

    Args:
        name: for messages and results.
        n: nominal number of load steps, cut on failure as in ``load_steps``.
        bcs: all Dirichlet conditions of the step; None keeps the conditions of the previous step.
        loads: as ``load`` of a ``UnitedProblem``: ``{constant: value}``, each with its value at the end of the step, to which it is
            ramped from the present one, or a function of s. Or one function of s that sets loads and Dirichlet values itself, which
            are then not ramped.
        contacts: contacts that are switched on (True) or off (False). A contact that is switched on starts as in a new problem, at
            the present positions of the bodies.
        friction: of contacts that were made with friction, as in ``Contact``, with the same law: its coefficient, or other parameter,
            is ramped; a function of position and s is not ramped.
        offset: of contacts, as in ``Contact``: a length or a function of position, ramped.
        preload: of ``Preload`` sections: the force at the end of the step, to which it is ramped from the present one, or a
            function of s; None locks the section at its present length.
        begin: called at the beginning of the step, before anything else, on all ranks, e.g. ``contact.tie``. It is not called again
            after a restart from a checkpoint of this step or a later one, which must contain its effect.
        ramp: False applies all changes in full from the first load step on.

    Raises:
        InputError, InputTypeError: for an argument of another type or out of its range.
    """

    name: str = ""
    n: int = 1
    bcs: Sequence[fem.DirichletBC] | None = field(default=None, kw_only=True)
    loads: Mapping[fem.Constant, Any] | Callable[[float], None] | None = field(default=None, kw_only=True)
    contacts: Mapping[Contact | GeneralContact, bool] = field(default_factory=dict, kw_only=True)
    friction: Mapping[Contact, Field | FrictionLaw] = field(default_factory=dict, kw_only=True)
    offset: Mapping[Contact, Field] = field(default_factory=dict, kw_only=True)
    preload: Mapping[Preload, float | Callable[[float], float] | None] = field(default_factory=dict, kw_only=True)
    begin: Callable[[], None] | None = field(default=None, kw_only=True)
    ramp: bool = field(default=True, kw_only=True)

    def __post_init__(self) -> None:
        given.kind("name", self.name, isinstance(self.name, str), "a text")
        of = f"Step('{self.name}'): " if self.name else "Step: "

        def take(what: str, value: Any) -> None:
            object.__setattr__(self, what, value)

        def of_contacts(what: str, values: str, kinds: Any, check: Callable[[Any], Any]) -> None:
            found = getattr(self, what)
            given.kind(f"{of}{what}", found, isinstance(found, Mapping), f"{values} by contact, as {{contact: ...}}")
            for contact in found:
                words = f"a {getattr(kinds, '__name__', 'Contact or a GeneralContact')}"
                given.kind(f"{of}a name in {what}", contact, isinstance(contact, kinds), words)
            take(what, {contact: check(value) for contact, value in found.items()})

        take("n", given.count(f"{of}n", self.n))
        take("ramp", given.flag(f"{of}ramp", self.ramp))
        take("loads", check_load(self.loads))
        given.kind(
            f"{of}begin", self.begin, self.begin is None or given.function(self.begin), "a function without arguments, or None"
        )
        of_contacts("contacts", "True and False", Contact | GeneralContact, lambda on: given.flag(f"{of}on or off", on))
        of_contacts("friction", "coefficients or laws", Contact, given_friction)
        of_contacts("offset", "lengths or functions", Contact, lambda offset: given_field(f"{of}offset", offset))
        of_contacts(
            "preload", "forces", Preload, lambda f: f if f is None or given.function(f) else given.number(f"{of}preload", f)
        )

    def __repr__(self) -> str:
        """Its name, number of load steps, and the arguments that are set."""
        more = [what for what in ("bcs", "loads", "begin") if getattr(self, what) is not None]
        more += [what for what in ("contacts", "friction", "offset", "preload") if getattr(self, what)]
        return f"Step({self.name!r}, n={self.n}, of {', '.join(more) or 'nothing'})"


def check_stages(problem: UnitedProblem, steps: Sequence[Step]) -> None:
    """Refuse steps that do not fit this problem, before the first is taken (collective).

    Raises:
        InputError, InputTypeError, SpaceError: names the step and the unsupported change.
    """
    with agreed(problem.comm):
        given.items("steps", steps, lambda one: isinstance(one, Step), "a Step")
        if not steps:
            raise InputError("steps = []: expected one Step at least")
        if problem.load is not None:
            raise InputError("the problem has a load, which its steps do not use: leave load out, and give the steps their loads")
        if problem.history is not None:
            problem.history.check_steps(steps)
        for i, step in enumerate(steps):
            _check(problem, step, f"step {i + 1}" + (f", '{step.name}'" if step.name else ""))
    bcs = [bc for conditions in (problem.bodies.bcs, *(step.bcs or () for step in steps)) for bc in conditions]
    for i, step in enumerate(steps):
        words = f"the loads of step {i + 1}" + (f", '{step.name}'" if step.name else "")
        refuse_idle(problem, step.loads, bcs, words, [replace(one, loads=None) for one in steps])
    declared = [[step.name, step.n, step.ramp, -1 if step.bcs is None else len(step.bcs)] for step in steps]
    switched = [[f"{contact.name}: {on}" for contact, on in step.contacts.items()] for step in steps]
    given.alike(problem.comm, "load_steps", steps=declared, contacts=switched)


def _check(problem: UnitedProblem, step: Step, words: str) -> None:
    if step.bcs is not None:
        check_conditions(problem.config, step.bcs)
    for contact in [*step.contacts, *step.friction, *step.offset, *step.preload]:
        if not any(contact is one for one in problem.declared):
            names = ", ".join(repr(one.name) for one in problem.declared) or "none"
            raise InputError(f"{words}: contact '{contact.name}' is not the problem's: expected one of its contacts, {names}")
    for contact, value in step.friction.items():
        before, law = as_law(contact.friction), as_law(value)
        known = f"a value for the law {type(before).__name__}, with which contact '{contact.name}' was made"
        given.kind(f"{words}: friction", value, type(law) is type(before), known)
        if contact.pair.friction is None and (callable(law.field) or law.field > 0.0):
            raise InputError(
                f"{words}: contact '{contact.name}' was made without friction: make it with the friction that it is to have, and give "
                "an earlier step friction 0"
            )
        refuse_ramp(f"{words}: friction of contact '{contact.name}'", before.field, law.field)
    for contact, end in step.offset.items():
        refuse_ramp(f"{words}: offset of contact '{contact.name}'", contact.offset, end)
    for contact, on in step.contacts.items():
        if isinstance(contact, Preload):
            raise InputError(f"{words}: preload '{contact.name}' cannot be switched: give the step preload = {{preload: 0.0}}")
        if on and getattr(contact, "tied", False) is True:
            raise InputError(
                f"{words}: contact '{contact.name}' is tied from the start, and cannot be switched on: make it with tied='after', and "
                "give the step begin=contact.tie"
            )
    if step.contacts or step.bcs is not None:
        if not isinstance(problem.system, BodySystem):
            raise InputError(f"{words}: conditions and contacts change where contact is eliminated alone: leave method out")
        if any(law.perfect for contact in problem.contacts for law in contact.heats):
            raise InputError(
                f"{words}: conditions and contacts cannot change where temperatures are equal on both sides: give a finite conductance"
            )


class Stage:
    """A step that a problem begins or continues (the constructor is collective).

    Args:
        step: the declared and checked step.
        end: load factor at the end of the step, if the problem's state belongs to a later call.

    Attributes:
        step: the declared step.

    Raises:
        CheckpointError: if the problem's state belongs to another step.
        InputError: if conditions change at nodes that mortar ties.
    """

    def __init__(self, problem: UnitedProblem, step: Step, end: float = 1.0):
        self._problem, self.step = problem, step
        progress, self._at = problem.progress, 0.0
        fresh = progress.ahead > 0  # whether the step begins now; otherwise it was begun or completed before a checkpoint
        if progress.ahead == 0 and progress.step != step.name:
            raise CheckpointError(
                f"the state is one of the step '{progress.step}', which is '{step.name}' now: expected the same steps as before; go "
                "on with these, or remove the checkpoint"
            )
        if fresh and step.begin is not None:
            ask_together(problem.comm, f"begin of the step '{step.name}'", step.begin)
        self._switch(fresh)
        starts = self._take_loads(fresh)
        known = not fresh
        for contact, value in step.friction.items():
            contact.ramp_friction(blended_friction(contact, value, self._share), known)
        #: Offsets at the beginning of the step.
        self._offsets = {contact: contact.offset for contact in step.offset}
        problem.stage = self
        if fresh:
            progress.step, progress.loads = step.name, starts
        else:
            at = progress.factor if progress.ahead == 0 else end
            problem.set_load(at, known=True)
            # shares of earlier steps are known already
            progress.take_shares(replace(progress.began, led=progress.taken.now().led), progress.taken)
            progress.take_shares(progress.began, progress.taken.with_led(self.led(at)))
            move_targets(problem, problem.motions)
            for pair in problem.interfaces:
                settle(pair)

    def _share(self, at: float) -> float:
        """Fraction of the step's ramps at a load factor."""
        return at if self.step.ramp else 1.0

    # -- switched conditions and contacts --------------------------------------------------------------------------------

    def _switch(self, fresh: bool) -> None:
        """Apply the step's conditions and contacts, and keep the forces of released conditions and contacts (collective)."""
        problem, step = self._problem, self.step
        bodies, held = problem.bodies, problem.bodies.held
        parts = [
            (part, on) for one, on in step.contacts.items() for part in (one.all_parts if isinstance(one, Contact) else one.parts)
        ]
        left, come = ([part for part, on in parts if on is not part.on and on is which] for which in (False, True))
        acting = reactions(problem) if fresh and problem.progress.steps else None
        if step.bcs is not None:
            bodies.hold(step.bcs)
        changed = held != bodies.held
        other = bool(reduced(problem.comm, bool(changed.any()), op=MPI.LOR))
        if fresh:
            problem.progress.carried = self._carried(acting, held & changed, left)
        for pair in problem.interfaces if other else ():
            hold(pair, bodies.free[: problem.config.n_owned], None if not fresh else problem.config.of(changed).any(axis=1))
        for part, on in parts:
            mark(part, on)
        for part in left if fresh else ():
            switch_off(part.pair)
        for part in come if fresh else ():
            switch_on(part)
        if other or left or come or problem.linear is not None:
            assert isinstance(problem.system, BodySystem)
            problem.unite(step.loads, 0.0)
            if problem.linear is not None and problem.progress.ahead == 0:
                take_multipliers(problem)
            left_on = {id(contact.pair.whole) for contact in problem.contacts if contact.on}
            problem.system.take([pair for pair in problem.interfaces if id(pair) in left_on], problem.linear)

    # -- released forces -------------------------------------------------------------------------------------------------

    def _carried(self, acting: Array | None, released: Bools, left: Sequence[Contact]) -> Array | None:
        """Forces of released conditions and contacts ``(n,)``, plus the rest of an interrupted step; None if zero.

        ``acting`` are the forces of the conditions, None before the first step, when all forces are zero.
        """
        problem, config = self._problem, self._problem.config
        total = np.zeros(len(released)) if problem.bodies.dead is None else np.array(problem.bodies.dead)
        if acting is not None:
            total += np.where(released, acting, 0.0)
            at = owned_displacement(problem)
            for contact in left:
                total[at] += config.add_at_owners(*contact.pair.nodal_forces(contact.pair.committed))
        return total if reduced(problem.comm, bool(total.any()), op=MPI.LOR) else None

    # -- ramps -----------------------------------------------------------------------------------------------------------

    def _take_loads(self, fresh: bool) -> list[Any]:
        """Set loads and preloads of the step; returns their initial values (collective)."""
        problem, loads, bolts = self._problem, self.step.loads, self.step.preload
        constants = dict(loads) if isinstance(loads, dict) else {}
        starts = problem.progress.loads
        if fresh or problem.progress.ahead < 0:
            starts = [np.asarray(c.value).tolist() for c in constants]
            starts += [bolt.carried for bolt in bolts]

        def ramp(start: Any, end: Any) -> Callable[[float], Any]:
            if callable(end):
                return end
            return lambda s: (1.0 - self._share(s)) * np.asarray(start) + self._share(s) * np.asarray(end)

        ramps = [ramp(start, end) for start, end in zip(starts, [*constants.values(), *bolts.values()])]
        problem.load = dict(zip(constants, ramps)) if constants else check_load(loads)
        for (bolt, force), follows in zip(bolts.items(), ramps[len(constants) :]):
            bolt.ramp_force(None if force is None else follows, not fresh)
        return starts

    def led(self, at: float) -> Iterator[tuple[Any, float]]:
        """Constants, and contacts for their offsets, that the step ramps, with their shares at a load factor, see ``taken``."""
        share, loads, began = self._share(at), self.step.loads, self._problem.progress.began
        for constant, end in loads.items() if isinstance(loads, Mapping) else ():
            yield constant, 1.0 if callable(end) else share + (1.0 - share) * began.began(constant)
        for contact in self.step.offset:
            yield contact, share + (1.0 - share) * began.began(contact)

    def take_load(self, at: float) -> None:
        """Ramp down released forces, and ramp offsets, at a load factor (collective)."""
        problem, self._at = self._problem, at
        carried, left = problem.progress.carried, 1.0 - self._share(at)
        problem.bodies.dead = carried * left if carried is not None and left else None
        for contact, start in self._offsets.items():
            end = self.step.offset[contact]
            contact.offset = end if left == 0.0 else between(start, end, self._share(at))

    def leave(self) -> None:
        """End the step and keep its values at the load factor that has been reached."""
        problem = self._problem
        problem.load = problem.stage = None
        for contact, value in self.step.friction.items():
            contact.ramp_friction(frozen_friction(contact, value, self._at), True, self._at)
        for bolt in self.step.preload:
            bolt.keep_force(self._at)
