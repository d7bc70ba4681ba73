"""A step of a problem as declared by users: active conditions and contacts, and end values of loads and coefficients."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.general.general import GeneralContact
from uem_dolfinx.contact.laws.law import Field, FrictionLaw, given_field, given_friction
from uem_dolfinx.contact.preload import Preload
from uem_dolfinx.solve.loading import check_load


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
            ramped from the present one, or a function of s; or one function of s that sets loads and Dirichlet values itself, which
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
