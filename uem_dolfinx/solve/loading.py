"""The load of a problem: Constants in forms or prescribed values, with one rule for all kinds of steps.

A Constant that the load sets has the value of the load factor or time wherever it is used. Other prescribed values are ramped over load
steps, from the displacement at their beginning.

Shares: the derivatives of ramped values in a state with respect to the prescribed values at the end of the ramp.

A ramp that starts from a value of share b has the share ``s + (1 - s) b`` at its fraction s, if the prescribed value changes by the same
amount in all steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from numbers import Number
from types import CellType, FunctionType, MethodType, ModuleType
from typing import Any

from mpi4py import MPI

import numpy as np
import ufl
from dolfinx import fem
from ufl.core.expr import Expr
from ufl.corealg.traversal import traverse_unique_terminals

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.errors import InputError, InputTypeError
from uem_dolfinx.parallel import agreed, ask_together, reduced


class ByFunction:
    """A load that is set by a function of the load factor or the time.

    Args:
        function: as declared.
    """

    def __init__(self, function: Callable[[float], Any]):
        self._function = function
        self.at: float | None = None  # argument of its last call since the last step, or None
        self.last: float | None = None  # argument of its last call, or None

    def __call__(self, at: float) -> None:
        """Set the load; InputError for a function that returns a value, which would be lost."""
        self.at = self.last = at
        if isinstance(value := self._function(at), Number | np.ndarray):
            words = "a function that sets values itself and returns none, or {constant: function}"
            raise InputError(given.sentence(f"the result of load({at:.6g})", value, words))


def check_load(load: Any) -> Mapping[fem.Constant, Any] | ByFunction | None:
    """The load as a function, or as Constants and their values, numbers or functions; or None. InputTypeError or InputError for others."""
    expected = "a scalar Constant, a dictionary of Constants and their values, a function of the load factor or time, or None"
    if isinstance(load, fem.Constant):
        if np.shape(load.value) != ():
            raise InputError(
                f"load is a Constant of the shape {np.shape(load.value)}: expected {expected}; as load={{constant: value}} it grows to "
                "this value"
            )
        return {load: np.float64(1.0)}
    if isinstance(load, Mapping):
        given.kind("load", load, bool(load), expected)
        for constant, value in load.items():
            given.kind("a name in load", constant, isinstance(constant, fem.Constant), "a Constant")
            if not given.function(value):
                _fitting(constant, value)
        return {c: value if callable(value) else np.asarray(value, dtype=float)[()] for c, value in load.items()}
    if load is not None and not given.function(load):
        raise InputTypeError(given.sentence("load", load, expected))
    return load if load is None or isinstance(load, ByFunction) else ByFunction(load)


def words_of(load: Any) -> Any:
    """A load as checked, in words that are the same on all ranks."""
    if isinstance(load, Mapping):
        return ["a function" if callable(value) else given.plain(value) for value in load.values()]
    return load and "a function"


def set_loads(comm: MPI.Comm, load: Any, at: float, bcs: Sequence[Any] = ()) -> None:
    """Apply a problem's ``load``, and Dirichlet values by rules, at a load factor or time; None sets nothing (collective).

    Raises InputError or InputTypeError if the value of a Constant is not finite, or of another shape, and UserFunctionError if a
    function raises.
    """
    if isinstance(load, Mapping):
        for constant, value in load.items():
            now = ask_together(comm, f"the load of a Constant at {at:.6g}", value, at) if callable(value) else value * at
            with agreed(comm):
                constant.value = _fitting(constant, now)
    elif load is not None:
        ask_together(comm, f"load({at:.6g})", load, at)
    for rule in rules_of(bcs):
        rule.take_load(comm, at)


def _fitting(constant: fem.Constant, value: Any) -> Any:
    """The value as an array of the Constant's shape."""
    shape = np.shape(constant.value)
    words = f"finite numbers of the shape {shape}" if shape else "a finite number"
    try:
        array = given.numbers(value)
    except (TypeError, ValueError):
        raise InputTypeError(given.sentence("the value of a Constant in load", value, words)) from None
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(given.sentence("the value of a Constant in load", value, words))
    return array


def rules_of(bcs: Sequence[Any]) -> list[Any]:
    """The ``conditions.prescribed.Rule`` of Dirichlet conditions that have one."""
    return [bc.rule for bc in bcs if hasattr(bc, "rule")]


def values_at(x: Array, bcs: Sequence[Any]) -> Array:
    """A local array with its Dirichlet values, those by UFL expressions at their present values (collective)."""
    for rule in rules_of(bcs):
        if isinstance(rule.value, Expr):
            rule.interpolate()
    found = np.array(x)
    compat.set_bc_values(found, bcs)
    return found


def bring_load(problem: Any, at: float) -> None:
    """Set a problem's load to a factor or time, unless it is already set (collective).

    A function that was last called with this argument is not called again, so that later changes by the script are kept.
    """
    load = problem.load
    if isinstance(load, ByFunction) and load.last == at:
        problem.load = None
    try:
        problem.set_load(at)
    finally:
        problem.load = load


def forget_load(problem: Any) -> None:
    """Mark the present loads as loads of the committed state: the next ``solve`` sets its own."""
    problem.set_at = None
    if isinstance(problem.load, ByFunction):
        problem.load.at = None


def set_by_load(load: Any, bcs: Sequence[Any], n: int) -> Bools:
    """Mask of unknowns ``(n,)`` whose Dirichlet values a load sets as Constants, or rules of the load factor; see ``set_by``."""
    constants = list(load) if isinstance(load, Mapping) else []
    led = [rule.values for rule in rules_of(bcs) if rule.of_load or any(holds(rule.value, c) for c in constants)]
    return set_by([*constants, *led], bcs, n)


def set_by(some: Sequence[fem.Constant | fem.Function], bcs: Sequence[Any], n: int) -> Bools:
    """Mask of unknowns ``(n,)`` whose Dirichlet values are these Constants and Functions."""
    kept, found = [np.array(forms.values_of(c)) for c in some], np.zeros((2, n))
    try:
        for k, values in enumerate(found if some else ()):
            for c in some:
                forms.values_of(c)[...] = float(k)
            compat.set_bc_values(values, bcs)
    finally:
        for c, value in zip(some, kept):
            forms.values_of(c)[...] = value
    with np.errstate(invalid="ignore"):
        return np.asarray(found[1] - found[0] == 1.0)


def ramped(load: Any, bcs: Sequence[Any], start: Array, wanted: Array, fraction: float) -> Array:
    """Unknowns ``(n,)`` interpolated from ``start`` to ``wanted``, except Dirichlet values that the load sets."""
    if fraction >= 1.0:
        return wanted
    return np.where(set_by_load(load, bcs, len(wanted)), wanted, start + fraction * (wanted - start))


# -- Constants without effect ----------------------------------------------------------------------------------------------

#: Objects within objects that are looked into for a Constant.
#: [bound; objects; test_loads.py::test_a_constant_that_nothing_follows]
DEPTH = 4


def refuse_idle(problem: Any, load: Any, bcs: Sequence[Any], what: str = "load", further: Sequence[Any] = ()) -> None:
    """Refuse Constants in a load that do not occur in the problem (collective).

    Args:
        problem: a ``UnitedProblem``.
        load: as returned by ``check_load``.
        bcs: Dirichlet conditions, whose values may be the Constants.
        what: name of the load in the message.
        further: other objects and functions that may contain them, e.g. objects in a step.

    Raises:
        InputError: names the first of them.
    """
    if not isinstance(load, Mapping):
        return
    n, in_forms = len(problem.u.x.array), problem.bodies.F.constants()
    rules = [rule.value for rule in rules_of(bcs)]
    held = np.array([bool(set_by([c], bcs, n).any()) or holds(rules, c) for c in load])
    held = reduced(problem.comm, held, op=MPI.LOR)
    parts = [problem.equations, problem.couplings, problem.points, problem.dynamics, problem.materials, problem.declared]
    for i, (c, follows) in enumerate(zip(load, held)):
        if follows or any(c is one for one in in_forms):
            continue
        others = [value for constant, value in load.items() if constant is not c]
        found = any(holds(one, c) for one in (parts, others, further))
        if not reduced(problem.comm, found, op=MPI.LOR):
            now = given.shown(np.asarray(c.value).tolist())
            raise InputError(
                f"item {i + 1} of {what}, a Constant that is {now} now, is in no form, Dirichlet condition, equation, coupling, point load "
                "or contact of the problem, so that nothing follows it: expected a Constant of these; rigid surfaces and all else are "
                "moved by a function of the load factor as load"
            )


def holds(one: Any, c: fem.Constant | fem.Function) -> bool:
    """Whether an object is a given Constant or Function, or contains it in attributes, items, terms, or variables of a function."""
    return _holds(one, c, DEPTH, set())


def _holds(one: Any, c: fem.Constant | fem.Function, depth: int, seen: set[int]) -> bool:
    """As ``holds``, for nested objects up to a depth."""
    if one is c:
        return True
    if (
        depth == 0
        or id(one) in seen
        or isinstance(one, (str, bytes, int, float, np.ndarray, type, ModuleType, fem.FunctionSpace))
    ):
        return False
    seen.add(id(one))
    inside: list[Any] = []
    if isinstance(one, ufl.Form):
        return any(c is part for part in (*one.constants(), *one.coefficients()))
    if isinstance(one, Expr):
        return any(c is part for part in traverse_unique_terminals(one))
    if isinstance(one, Mapping):
        inside = [*one.keys(), *one.values()]
    elif isinstance(one, (list, tuple, set)):
        inside = list(one)
    elif isinstance(one, MethodType):
        inside = [one.__self__, one.__func__]
    elif isinstance(one, FunctionType):
        cells = [cell.cell_contents for cell in one.__closure__ or () if _is_set(cell)]
        named = [one.__globals__[name] for name in one.__code__.co_names if name in one.__globals__]
        inside = [*cells, *named, *(one.__defaults__ or ())]
    elif isinstance(one, partial):
        inside = [one.func, *one.args, *one.keywords.values()]
    else:
        inside = list(getattr(one, "__dict__", {}).values())
    # items of a list have the depth of the list
    flat = isinstance(one, (list, tuple, set, Mapping))
    return any(_holds(part, c, depth if flat else depth - 1, seen) for part in inside)


def _is_set(cell: CellType) -> bool:
    """Whether a variable of an enclosing function has a value yet."""
    try:
        return cell.cell_contents is not None
    except ValueError:
        return False


@dataclass(frozen=True)
class Taken:
    """Shares of a committed state: a value."""

    #: share of the Dirichlet value of every unknown, ghosts included ``(n,)``, or one share of all; NaN where nodes were free at
    #: the start of the ramp, since their positions depend on all parameters.
    held: Array | float = 0.0
    #: Constants, and contacts for their offsets, that steps have ramped, each with its value in that state and its share.
    led: tuple[tuple[Any, Any, float], ...] = ()

    def of(self, one: Any, other: float = 1.0) -> float:
        """Share of a Constant, or of the offset of a contact; ``other`` if no step has ramped it to its present value."""
        return next((share for what, value, share in self.led if what is one and _is(what, value)), other)

    def began(self, one: Any) -> float:
        """Share of its value at the beginning of a step, whatever its value is now; 0 if no step had ramped it."""
        return next((share for what, _, share in self.led if what is one), 0.0)

    def now(self) -> Taken:
        """Without Constants and offsets whose values have been changed since."""
        return replace(self, led=tuple(item for item in self.led if _is(*item[:2])))

    def with_led(self, led: Iterator[tuple[Any, float]]) -> Taken:
        """With the present values and the shares of the Constants and offsets in ``led``."""
        new = [(one, _value(one), share) for one, share in led]
        old = [item for item in self.led if all(item[0] is not one for one, _, _ in new)]
        return replace(self, led=(*old, *new))

    def by_id(self) -> dict[int, float]:
        """Shares of the Constants and offsets that still have their ramped values, by ``id``."""
        return {id(one): share for one, _, share in self.now().led}


def _value(one: Any) -> Any:
    return np.array(forms.values_of(one)) if isinstance(one, fem.Constant) else one.offset


def _is(one: Any, value: Any) -> bool:
    """Whether a Constant, or the offset of a contact, still has a value."""
    now = _value(one)
    return now is value or (not callable(now) and not callable(value) and np.array_equal(now, value))


def led_by(problem: Any, at: float) -> Iterator[tuple[Any, float]]:
    """Constants and contacts that a problem's load or its ``Step`` ramps, with their shares at a load factor or time."""
    if problem.stage is not None:
        yield from problem.stage.led(at)
    elif isinstance(problem.load, Mapping):
        for constant, value in problem.load.items():
            yield constant, 1.0 if callable(value) else at


def taken_by(problem: Any) -> Taken:
    """Shares at the end of the step that a problem is about to commit."""
    progress, bodies = problem.progress, problem.bodies
    start, fraction, _ = problem.led
    before, at = progress.taken, problem.set_at
    after = before if at is None else before.with_led(led_by(problem, at))
    if problem.dynamics is not None:
        return replace(after, held=1.0)
    known = np.broadcast_to(before.held, len(bodies.held))
    if start is progress.start:
        known = np.broadcast_to(progress.began.held, len(bodies.held))
    elif start is not None:
        known = np.where(start == problem.committed, known, np.nan)
    share = np.where(fraction >= 1.0, 1.0, fraction + (1.0 - fraction) * known)
    share = np.where(set_by_load(problem.load, bodies.bcs, len(share)), 1.0, share)
    return replace(after, held=np.where(bodies.held, share, np.nan))


def wanted_by_step(problem: Any) -> Array | None:
    """Unknowns of the last step under the present Dirichlet values ``(n,)``; None for a state that was read within its load steps."""
    progress, (start, fraction, arc) = problem.progress, problem.led
    if start is None and not arc and progress.ramp and progress.factor < 1.0:
        return None
    begin = problem._before.displacement if start is None else start
    wanted = np.array(begin)
    compat.set_bc_values(wanted, problem.bodies.bcs)
    # after a step has been left, the problem has no load
    load = {one: value for one, value, _ in progress.taken.now().led if isinstance(one, fem.Constant)}
    return np.asarray(problem.bodies.of_owners(ramped(load, problem.bodies.bcs, begin, wanted, fraction)))


def uniform(problem: Any, held: Array | float) -> float | None:
    """The share of all Dirichlet values if it is known and uniform; otherwise None (collective)."""
    own = np.broadcast_to(held, len(problem.bodies.held))[problem.bodies.held]
    own = np.where(np.isnan(own), np.inf, own)
    low = float(reduced(problem.comm, np.min(own, initial=np.inf), op=MPI.MIN))
    high = float(reduced(problem.comm, np.max(own, initial=-np.inf), op=MPI.MAX))
    return low if low == high and np.isfinite(low) else None


def to_checkpoint(problem: Any) -> list[float | None]:
    """Uniform shares at the beginning of the ramp and now, for ``from_checkpoint`` (collective)."""
    return [uniform(problem, shares.held) for shares in (problem.progress.began, problem.progress.taken)]


def from_checkpoint(problem: Any, kept: list[float | None]) -> tuple[Taken, Taken]:
    """Shares at the beginning of the ramp and of the committed state, from the values that ``to_checkpoint`` returned."""
    at, load = problem.progress.factor, problem.load if isinstance(problem.load, Mapping) else {}
    led = tuple((constant, np.asarray(value) * at, at) for constant, value in load.items() if not callable(value))
    began, held = (np.nan if one is None else one for one in kept)
    return Taken(began), Taken(held, led)


def in_rows(problem: Any, held: Array | float) -> Array:
    """Shares of Dirichlet values in the rows of vectors ``(n_rows, gdim)``, zero where free (collective).

    Raises InputError for values that are ramped from positions of free nodes, since these depend on all parameters.
    """
    bodies = problem.bodies
    unknown = np.flatnonzero(bodies.held & np.isnan(held))
    with agreed(problem.comm):
        if len(unknown):
            raise InputError(
                f"the Dirichlet value of {problem.config.place_of(int(unknown[0]))} is being ramped from where the node was before it was "
                "held, or before the run was interrupted, which depends on steps whose derivatives are not known: expected the end of "
                "this ramp, load factor 1, or conditions that are the same in all steps"
            )
    return np.asarray(problem.config.rows(np.where(bodies.held, held, 0.0)[: len(bodies.residual_of_all)]))


def reactions(problem: Any) -> Array:
    """Reactions of Dirichlet conditions in the present state, without contacts and equations, at all unknowns ``(n,)`` (collective).

    Rounding at unknowns without condition, zero at ghosts; for other fields the flow into the body.
    """
    bodies, config = problem.bodies, problem.config
    bodies.assemble()
    own = bodies.residual_of_all
    forces: Array = np.zeros(len(bodies.held))
    forces[: len(own)] = own
    at = owned_displacement(problem)
    for contact in problem.contacts:
        forces[at] -= contact.force.x.array.reshape(-1, config.gdim)[: config.n_owned]
        if contact.leak is not None and contact.on:
            forces[at] -= contact.pair.on_nodes()
        for heat in contact.pair.heats if contact.on else ():
            forces[: len(own)] += config.from_rows(heat.residual())
    if problem.linear is not None:
        forces[at] -= problem.linear.forces(problem.linear.multipliers)
    return forces


def owned_displacement(problem: Any) -> Any:
    """Unknowns of the components of the owned nodes ``(n_owned, gdim)``."""
    return problem.config.of(np.arange(len(problem.bodies.held)))[: problem.config.n_owned]
