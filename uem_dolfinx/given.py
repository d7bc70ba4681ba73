"""Checks of arguments of users: numbers, words, vectors, lists, functions, and agreement between ranks.

Every message contains the name of the argument, its value, the expected values and, if it is not obvious, a remedy.
"""

from __future__ import annotations

import inspect
import pickle
import re
import sys
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from copy import deepcopy
from dataclasses import dataclass
from functools import cache, wraps
from pathlib import Path
from typing import Any, ClassVar, TypeGuard, TypeVar

from mpi4py import MPI

import numpy as np
import numpy.typing as npt

from uem_dolfinx.arrays import Array, is_whole
from uem_dolfinx.errors import InputError, InputTypeError

W = TypeVar("W", bound=str)

#: Values are shown with so many letters. [format; letters; -]
LONGEST = 80
#: Prefix of the names of the package's modules. [format; -; -]
PACKAGE = "uem_dolfinx."


@dataclass(frozen=True)
class Range:
    """A range of numbers, its description in words, and a remedy for other numbers."""

    words: str
    holds: Callable[[Any], Any]  # of a number or an array of them
    remedy: str = ""


FINITE = Range("a finite number", np.isfinite)
POSITIVE = Range("a positive number", lambda x: (x > 0) & np.isfinite(x))
POSITIVE_OR_INFINITE = Range("a positive number, or infinity", lambda x: x > 0)
NOT_NEGATIVE = Range("0 or a positive number", lambda x: (x >= 0) & np.isfinite(x))


def between(low: float, high: float, remedy: str = "") -> Range:
    """The open interval between two bounds."""
    return Range(f"a number between {low:g} and {high:g}", lambda x: (low < x) & (x < high), remedy)


def described(value: object) -> str:
    """A value in one line, the same on all ranks: without addresses of memory."""
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, (str, int, float, complex, list, tuple, dict, set, np.ndarray)):
        return re.sub(r" at 0x[0-9a-f]+", "", " ".join(repr(value).split()))
    name = type(value).__name__
    return f"{'an' if name[0] in 'AEIO' else 'a'} {name}"


def shown(value: object) -> str:
    """A value, shortened for a message."""
    text = described(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST - 4]} ..."


def sentence(what: str, value: object, expected: str, remedy: str = "") -> str:
    """The message of a refusal."""
    return f"{what} = {shown(value)}: expected {expected}{'; ' if remedy else ''}{remedy}"


def symbolic(value: Any) -> bool:
    """Whether a value is an expression of UFL, as a Constant, or a list with one."""
    from ufl.core.expr import Expr

    return isinstance(value, Expr) or (isinstance(value, list | tuple) and any(map(symbolic, value)))


def truth(value: Any) -> bool:
    """Whether a value is True or False, or a list with one; Python counts them among the whole numbers."""
    return isinstance(value, (bool, np.bool_)) or (isinstance(value, list | tuple) and any(map(truth, value)))


def numbers(value: Any) -> Array:
    """Copy of a value as an array of numbers; TypeError for all else, as expressions of UFL, truth, None, texts and complex numbers."""
    if symbolic(value) or truth(value) or value is None or np.asarray(value).dtype.kind in "USc":
        raise TypeError("an expression of UFL, True, False, None, a text or a complex number is no real number")
    return np.array(value, dtype=float)


def returned(what: str, value: Any, expected: str) -> Array:
    """What a function returned as an array of numbers; InputTypeError for all else."""
    try:
        return numbers(value)
    except (TypeError, ValueError):
        raise InputTypeError(sentence(what, value, expected)) from None


def function(value: Any) -> TypeGuard[Callable[..., Any]]:
    """Whether a value is a function of users; Python calls expressions of UFL callable, too."""
    return callable(value) and not symbolic(value)


def fault(values: Array, shape: tuple[int, ...], within: Range, places: Array | None = None) -> str:
    """What is wrong with values that a function returned, of which not all are as expected: their shape, or the first one.

    Args:
        values: of a user's function.
        shape: wanted.
        within: range of each of them.
        places: of these values ``(gdim, n)``, if known.
    """
    if values.shape != shape:
        return f"has shape {values.shape}"
    first = int(np.flatnonzero(~within.holds(values))[0])
    at = "somewhere" if places is None else f"at ({', '.join(f'{x:.4g}' for x in places[:, first])})"
    return f"is {values[first]:.6g} {at}"


def number(what: str, value: Any, within: Range = FINITE) -> float:
    """A number of a range: InputTypeError for anything else, InputError outside of it."""
    if symbolic(value) or truth(value) or isinstance(value, (str, bytes)) or np.ndim(value):
        raise InputTypeError(sentence(what, value, within.words, within.remedy))
    try:
        x = float(value)
    except (TypeError, ValueError):
        raise InputTypeError(sentence(what, value, within.words, within.remedy)) from None
    if not within.holds(x):
        raise InputError(sentence(what, value, within.words, within.remedy))
    return x


def length(what: str, value: Any, none: str = "") -> float:
    """A positive finite length; ``none`` describes the effect of None if it is allowed; raises as ``number`` does."""
    words = "a positive length" + (f", or None {none}" if none else "")
    return number(what, value, Range(words, POSITIVE.holds))


def count(what: str, value: Any, remedy: str = "") -> int:
    """A whole number, 1 or more; raises as ``number`` does."""
    whole = Range("a whole number, 1 or more", lambda x: np.isfinite(x) and x >= 1 and x == np.floor(x), remedy)
    return int(number(what, value, whole))


def part_number(what: str, value: Any, of: str) -> int:
    """Number of a part of a mixed space, ``of`` in words; InputTypeError unless a whole number, InputError below 0."""
    expected = f"the number of the part of the mixed space that is {of}, counted from 0"
    kind(what, value, is_whole(value), expected)
    if value < 0:
        raise InputError(sentence(what, value, expected))
    return int(value)


def flag(what: str, value: Any) -> bool:
    """True or False; InputTypeError for anything else."""
    if not isinstance(value, (bool, np.bool_)):
        raise InputTypeError(sentence(what, value, "True or False"))
    return bool(value)


def did_you_mean(value: Any, known: Collection[str], otherwise: str = "") -> str:
    """A hint with the known word most similar to a value; ``otherwise`` if no word is similar."""
    import difflib

    near = difflib.get_close_matches(str(value), known, n=1)
    return f"did you mean {near[0]!r}?" if near else otherwise


def word(what: str, value: Any, known: Sequence[W]) -> W:
    """One of the known words; InputError for other words, InputTypeError for other types."""
    if not isinstance(value, str) or value not in known:
        some = " or ".join(filter(None, [", ".join(map(repr, known[:-1])), repr(known[-1])]))
        error = InputError if isinstance(value, str) else InputTypeError
        raise error(sentence(what, value, f"one of {some}", did_you_mean(value, known) if isinstance(value, str) else ""))
    return known[known.index(value)]


def name(what: str, value: Any, remedy: str = "") -> str:
    """A text without blanks that is not empty; raises as ``word`` does."""
    if not isinstance(value, str) or not re.fullmatch(r"\S+", value):
        error = InputError if isinstance(value, str) else InputTypeError
        raise error(sentence(what, value, "a text without blanks", remedy))
    return value


def vector(what: str, value: npt.ArrayLike, size: int | None = None) -> Array:
    """Copy of ``size`` finite numbers, by default 2 or 3; InputTypeError for other objects, InputError for other numbers."""
    expected = f"{'2 or 3' if size is None else size} finite numbers"
    try:
        a = np.atleast_1d(numbers(value))
    except (TypeError, ValueError):
        raise InputTypeError(sentence(what, value, expected)) from None
    if value is None:
        raise InputTypeError(sentence(what, value, expected))
    if a.shape not in (((2,), (3,)) if size is None else ((size,),)) or not np.isfinite(a).all():
        fault = f"has shape {a.shape}" if np.isfinite(a).all() else "is not finite"
        raise InputError(f"{what} = {shown(value)} {fault}: expected {expected}")
    return a


def direction(what: str, value: npt.ArrayLike, size: int | None = None) -> Array:
    """The unit vector along a given vector; raises as ``vector`` does, and InputError for a zero vector."""
    a = vector(what, value, size)
    # scaled by the largest entry, so that squares neither overflow nor underflow
    largest = np.abs(a).max()
    if not largest > 0:
        raise InputError(sentence(what, value, "a direction", "give a non-zero vector"))
    a = a / largest
    return a / np.linalg.norm(a)


def kind(what: str, value: Any, fits: bool, expected: str, remedy: str = "") -> Any:
    """The value if ``fits``; otherwise, and for a class instead of an object of it, an InputTypeError."""
    if isinstance(value, type):
        raise InputTypeError(sentence(what, value, expected, f"make an object of it, as {value.__name__}(...)"))
    if not fits:
        raise InputTypeError(sentence(what, value, expected, remedy))
    return value


def items(what: str, value: Any, fits: Callable[[Any], bool], one: str) -> list[Any]:
    """A list of items of one kind, ``one`` in words, e.g. ``"a Dirichlet condition"``; InputTypeError for anything else."""
    if not isinstance(value, Sequence) or isinstance(value, (str, bytes)):
        remedy = f"put it in brackets: {what}=[...]" if fits(value) else f"each item must be {one}"
        raise InputTypeError(sentence(what, value, "a list", remedy))
    for i, item in enumerate(value):
        kind(f"{what}[{i}]", item, fits(item), one)
    return list(value)


def plain(value: Any) -> Any:
    """A value with arrays converted to lists, and Constants replaced by their present values."""
    value = getattr(value, "value", value)
    return value.tolist() if isinstance(value, np.ndarray) else value


def alike(comm: MPI.Comm, where: str, **values: Any) -> None:
    """InputError on all ranks for values that differ between ranks, which would cause a deadlock (collective)."""
    if comm.size == 1:
        return
    of_ranks = comm.allgather([described(value) for value in values.values()])
    for rank, others in enumerate(of_ranks):
        for what, first, other in zip(values, of_ranks[0], others):
            if other != first:
                raise InputError(
                    f"{where}: {what} = {first} on rank 0, but {other} on rank {rank}: expected the same on all ranks; "
                    "compute it alike on all of them, or send it to all"
                )


class Copied:
    """A public object that copies and pickles as Python does, or names itself where what it belongs to does not."""

    def __copy__(self) -> Any:
        """Another object with the same attributes."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        return other

    def __deepcopy__(self, memo: dict[int, Any]) -> Any:
        """An object with copies of all attributes; InputTypeError if there are none."""
        memo[id(self)] = other = object.__new__(type(self))
        with self._of_its_own("copied"):
            other.__dict__.update(deepcopy(self.__dict__, memo))
        return other

    def __reduce_ex__(self, protocol: Any) -> Any:
        """For ``pickle``; InputTypeError if it cannot keep all attributes."""
        with self._of_its_own("pickled"):
            pickle.dumps(self.__dict__, protocol)
        return object.__new__, (type(self),), self.__dict__

    @contextmanager
    def _of_its_own(self, done: str) -> Iterator[None]:
        """Context in which errors of Python about attributes become one about this object."""
        try:
            yield
        except (TypeError, AttributeError, RecursionError, pickle.PicklingError) as error:
            raise InputTypeError(
                f"{described(self)} cannot be {done}, since a mesh, a file or a function of the script belongs to it: expected an object "
                f"of numbers; make another {type(self).__name__}, or keep a problem by uem.write_checkpoint(path, problem.state())"
            ) from error


class Sealed(Copied):
    """A public object that, once made, refuses to set unknown attributes, and arguments that no longer have an effect.

    Attributes:
        SETTABLE: arguments that may be set at any time, each with a function that checks and returns the value, or None.
    """

    SETTABLE: ClassVar[Mapping[str, Callable[[Any], Any] | None]] = {}
    _made = False
    _shown: Mapping[str, Any] = {}  # arguments as given, where attributes of these names hold something else, for ``repr``

    def __init_subclass__(cls, **options: Any) -> None:
        """Seal an object at the end of its outermost ``__init__``."""
        super().__init_subclass__(**options)
        init = cls.__dict__.get("__init__")
        if init is None:
            return

        @wraps(init)
        def making(self: Any, *args: Any, **named: Any) -> None:
            init(self, *args, **named)
            if type(self).__init__ is making:
                self._made = True

        cls.__init__ = making  # type: ignore[method-assign]

    def __repr__(self) -> str:
        """Its class, with the arguments that it was made with, as far as they are not the defaults."""
        shows, kept = [], self.__dict__ | dict(self._shown)
        for name, parameter in inspect.signature(type(self)).parameters.items():
            value = kept.get(name, kept.get(f"_{name}", parameter.default))
            usual = value is parameter.default or (np.ndim(value) == 0 and value == parameter.default)
            if not usual and value is not parameter.empty:
                shows.append(f"{name}={shown(str(value) if isinstance(value, Path) else plain(value))}")
        return f"{type(self).__name__}({', '.join(shows)})"

    @property
    def _called(self) -> str:
        """Its name in messages."""
        own, kind = self.__dict__.get("name"), type(self).__name__
        return f"the {kind} {own!r}" if isinstance(own, str) else f"a {kind}"

    @property
    def _is_open(self) -> bool:
        """Whether arguments may still be set, because the object is not in use yet."""
        return False

    def _too_late(self) -> str:
        """Message that arguments no longer have an effect, with the remedy."""
        kind, more = type(self).__name__, " or ".join(self.SETTABLE)
        whole = "" if kind == "UnitedProblem" else ", and a new problem of it"
        return f"counts only as an argument: make a new {kind}{whole}" + (f"; only {more} may be set" if more else "")

    def __setattr__(self, name: str, value: Any) -> None:
        """Set an attribute; InputError if it is unknown, or an argument that can no longer be changed."""
        # code of the package may set all attributes
        if self._made and not name.startswith("_") and not sys._getframe(1).f_globals.get("__name__", "").startswith(PACKAGE):
            if name in self.SETTABLE:
                check = self.SETTABLE[name]
                value = value if check is None else check(value)
            else:
                self._refuse(name, value)
        super().__setattr__(name, value)

    def _refuse(self, name: str, value: Any) -> None:
        """Raise if an attribute is unknown, computed, or an argument that can no longer be changed."""
        kind: Any = type(self)
        arguments = arguments_of(kind)
        there = inspect.getattr_static(self, name, None)
        computed = isinstance(there, property) and there.fset is None
        if name in arguments and not self._is_open and not computed:
            raise InputError(f"{self._called}: {name} = {shown(value)} {self._too_late()}")
        # classes derived by users may have further attributes; a single letter is no misspelt word, but an attribute of the script
        own = name in self.__dict__ or len(name) == 1 or not kind.__module__.startswith(PACKAGE)
        if computed or (there is None and not own):
            known = sorted({*self.SETTABLE, *(n for n in arguments if self._is_open and n in self.__dict__)})
            hint = did_you_mean(name, known, f"expected one of {', '.join(known)}" if known else "expected none to be set")
            raise InputError(f"{self._called} has no '{name}' to be set: {hint}")


@cache
def arguments_of(kind: Any) -> tuple[str, ...]:
    """Names of the arguments of the constructors of a class and its base classes."""
    names: dict[str, None] = {}
    for one in kind.__mro__:
        if "__init__" in one.__dict__ and one is not object:
            names |= dict.fromkeys(list(inspect.signature(one.__dict__["__init__"]).parameters)[1:])
    return tuple(names)
