"""Settings of Newton's method, and of a run in words, for its checkpoint: a run restarted with others would differ from both.

Values of Constants and Functions are taken when the problem is made, since loads change later. They have six digits, which do not depend
on the partition.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from hashlib import blake2b
from inspect import signature
from typing import TYPE_CHECKING, Any, Literal

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from ufl.constantvalue import RealValue
from ufl.corealg.traversal import unique_pre_traversal

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.law import as_law, follows_load, parameters
from uem_dolfinx.errors import InputError
from uem_dolfinx.given import described
from uem_dolfinx.restart.numbering import DIGEST

if TYPE_CHECKING:
    from uem_dolfinx.dynamics.inertia import Dynamics

#: Numbers of a form that are shown. [format; numbers; -]
SHOWN = 12
#: Settings of every contact.
OF_CONTACTS = ("coupling", "sliding", "normals", "thickness", "chords")
#: Word for missing values.
NONE = "none"


class Settings:
    """Settings that a problem is made with (the constructor is collective).

    Args:
        forms: residual and damping form, by name.
        u: displacement.
        contacts: of the problem.
        materials: of the problem.
        dynamics: of the problem, or None.
        words: words for further settings, by name.
    """

    def __init__(
        self,
        forms: dict[str, Any],
        u: fem.Function,
        contacts: Sequence[Contact],
        materials: Sequence[Any],
        dynamics: Dynamics | None,
        words: Mapping[str, str],
    ):
        self.forms, self._contacts, self._dynamics = forms, contacts, dynamics
        #: Words that are the same on all ranks, and values described by their range over all ranks, by name.
        self._words: dict[str, str] = dict(words)
        self._values: dict[str, Array] = {}
        #: Words of settings with default values, by name.
        self._usual: dict[str, str] = {}
        of_contacts = defaults(Contact)
        for i, contact in enumerate(contacts, 1):
            name = f"contact {i} '{contact.name}'"
            self._usual |= {f"{name}, {what}": str(of_contacts[what]) for what in OF_CONTACTS} | {f"{name}, friction": NONE}
        if dynamics is not None:
            from uem_dolfinx.dynamics.scheme import newmark

            still = " ".join("0" for _ in dynamics.weight_of_one)
            self._usual |= {"scheme": str(newmark()), "contactors": defaults(type(dynamics))["contactors"], "gravity": still}
        history = [f for material in materials for f in vars(material).values() if isinstance(f, fem.Function)]
        for name, form in forms.items():
            if not isinstance(form, ufl.Form):
                continue
            numbers, operators = _contents(form)
            shown = ", ".join(f"{n:.6g}" for n in numbers[-SHOWN:])
            digest = blake2b(repr((numbers, operators)).encode(), digest_size=DIGEST).hexdigest()
            self._words[f"{name}, its expressions and numbers"] = f"{shown} in {digest}"
            given.alike(u.function_space.mesh.comm, "UnitedProblem", **self._words)
            for i, constant in enumerate(form.constants(), 1):
                self._words[f"{name}, Constant {i}"] = " ".join(f"{v:.6g}" for v in np.ravel(constant.value))
            for i, f in enumerate(form.coefficients(), 1):
                if f is not u and isinstance(f, fem.Function) and not any(f is other for other in history):
                    self._values[f"{name}, Function {i}"] = _extent(f.x.array)
        for i, material in enumerate(materials, 1):
            usual = defaults(type(material))
            for what, values in getattr(material, "parameters", {}).items():
                self._values[f"material {i}, {what}"] = _extent(values)
                if isinstance(usual.get(what), (int, float)):
                    self._usual[f"material {i}, {what}"] = f"{usual[what]:.6g}"

    def describe(self, comm: MPI.Comm) -> dict[str, str]:
        """All settings by name (collective)."""
        words, values = dict(self._words), dict(self._values)
        for i, contact in enumerate(self._contacts, 1):
            name = f"contact {i} '{contact.name}'"
            for what in OF_CONTACTS:
                words[f"{name}, {what}"] = str(getattr(contact, what))
            words |= {f"{name}, {what}": value for what, value in contact.words().items()}
            for k, value in enumerate(parameters(as_law(contact.friction))[1:], 2):
                words[f"{name}, parameter {k} of friction"] = described(value)
            if follows_load(as_law(contact.friction)):
                words[f"{name}, friction"] = "follows the load"
            else:
                values[f"{name}, friction"] = _extent(contact.friction_values())
            for k, law in enumerate(contact.heats, 1):
                for what, value in law.parameters.items():
                    words[f"{name}, {what} of heat{f' {k}' if k > 1 else ''}"] = described(value)
            if contact.pair.friction is not None and contact.pair.friction.wear is not None:
                values[f"{name}, wear"] = _extent(contact.pair.friction.wear.k)
        if (d := self._dynamics) is not None:
            words |= {
                "scheme": str(d.scheme),
                "contactors": d.contactors,
                "gravity": " ".join(f"{v:.6g}" for v in d.weight_of_one),
            }
            mass = " ".join(f"{m:.6g}" for m in d.mass.total)
            words["mass"] = f"{mass}, its matrix of norm {d.mass.M.norm():.6g}"
            for i, one in enumerate(d.added, 1):
                words[f"mass {i} at a point"] = " ".join(f"{m:.6g}" for m in one.masses)
        for name, extent in values.items():
            least, most = -comm.allreduce(-extent[0], op=MPI.MAX), comm.allreduce(extent[1], op=MPI.MAX)
            words[name] = NONE if least > most else f"{least:.6g}" + (f" to {most:.6g}" if most > least else "")
        # settings that differ between ranks by mistake must not raise an error on one rank only
        return dict(comm.bcast(words))

    def by_default(self, words: Mapping[str, str]) -> set[str]:
        """Names of settings whose values in ``words`` are the defaults."""
        return {name for name, usual in self._usual.items() if words.get(name) == usual}


def defaults(kind: type) -> dict[str, Any]:
    """Default values of the arguments of a class, by name."""
    return {name: p.default for name, p in signature(kind).parameters.items() if p.default is not p.empty}


def _contents(form: ufl.Form) -> tuple[list[float], list[Any]]:
    """Numbers in a form, and the number of operators of each kind in each integral.

    UFL's signature is unsuitable: UFL sorts operands by their numbers, so that it depends on objects made before the form.
    """
    numbers, operators = set(), []
    for part in form.integrals():
        kinds: Counter[str] = Counter()
        for e in unique_pre_traversal(part.integrand()):
            kinds[type(e).__name__] += 1
            if isinstance(e, RealValue):
                numbers.add(float(e))
        operators.append(
            (part.integral_type(), str(part.subdomain_id()), repr(sorted(part.metadata().items())), sorted(kinds.items()))
        )
    return sorted(numbers), sorted(operators)


def _extent(values: Any) -> Array:
    """Smallest and largest value on this rank."""
    array = np.asarray(values, dtype=float)
    return np.array([array.min(initial=np.inf), array.max(initial=-np.inf)])


#: Bounds of a relative tolerance.
ACCURACY = given.between(0.0, 1.0)


@dataclass(frozen=True, kw_only=True)
class Newton:
    """Settings of Newton's method, ``UnitedProblem(..., newton=uem.Newton(rtol=1e-10, max_iterations=30))``.

    Args:
        method: ``"full"`` or ``"modified"`` (the tangent of the step's first iteration is kept).
        consistent_tangent: add the curvature of the contact to K, which makes Newton quadratic.
        line_search: shorten steps that invert cells or do not reduce the residual's work.
        check_inversion: check for inverted cells in every iteration; None does so unless K is constant.
        rtol: bound on the norm of ``P'r`` relative to the forces at work.
        max_iterations: bound on the linear solves of one step.
        verbose: print one line per iteration.

    Raises:
        InputError, InputTypeError: for a value of another type or out of its range.
    """

    method: Literal["full", "modified"] = "full"
    consistent_tangent: bool = True
    line_search: bool = True
    check_inversion: bool | None = None
    rtol: float = 1e-8
    max_iterations: int = 50
    verbose: bool = False

    def __post_init__(self) -> None:
        def take(what: str, value: Any) -> None:
            object.__setattr__(self, what, value)

        given.word("method", self.method, ("full", "modified"))
        for what in ("consistent_tangent", "line_search", "verbose"):
            take(what, given.flag(what, getattr(self, what)))
        if self.check_inversion is not None:
            take("check_inversion", given.flag("check_inversion", self.check_inversion))
        take("rtol", given.number("rtol", self.rtol, ACCURACY))
        take("max_iterations", given.count("max_iterations", self.max_iterations))


def newton_of(newton: Any, **others: Any) -> Newton:
    """The settings of a problem: a ``Newton``, or a word and the others one by one.

    Raises:
        InputError: for other arguments in addition to a ``Newton``.
        InputTypeError, InputError: see ``Newton``.
    """
    if not isinstance(newton, Newton):
        given.word("newton", newton, ("full", "modified"))
        return Newton(method=newton, **others)
    defaults = {one.name: one.default for one in fields(Newton)}
    if twice := [name for name, value in others.items() if value is not defaults[name] and value != defaults[name]]:
        raise InputError(f"{twice[0]} is given in addition to newton, a Newton: expected it there, uem.Newton({twice[0]}=...)")
    return newton
