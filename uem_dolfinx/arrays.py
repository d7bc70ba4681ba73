"""Types of NumPy arrays for annotations, and fast replacements of NumPy functions for small arrays."""

from __future__ import annotations

from typing import Any, TypeAlias, TypeVar

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.float64]
Ints: TypeAlias = npt.NDArray[np.int64]
Bools: TypeAlias = npt.NDArray[np.bool_]
AnyArray: TypeAlias = npt.NDArray[Any]
T = TypeVar("T")
#: Local numbers of nodes, facets or cells in DOLFINx.
Indices: TypeAlias = npt.NDArray[np.int32]


def replace(of: T, /, **changed: Any) -> T:
    """A copy of a frozen dataclass with some fields changed; a faster ``dataclasses.replace`` for classes without ``__post_init__``."""
    known: dict[str, Any] = of.__dataclass_fields__  # type: ignore[attr-defined]
    assert changed.keys() <= known.keys(), changed.keys()
    new, values = object.__new__(type(of)), of.__dict__
    new.__dict__.update({name: values[name] for name in known} | changed)
    return new


def is_whole(value: Any) -> bool:
    """Whether a value is a whole number; True and False, which Python counts among these, are none."""
    return isinstance(value, (int, np.integer)) and not isinstance(value, bool)


def sums_of_rows(places: Ints, values: Array, size: int) -> Array:
    """Sums of the rows of ``values (m, k)`` with the same index in ``places (m,)``: ``(size, k)``; a faster ``numpy.add.at``."""
    k = values.shape[1]
    # cast, since sums of no rows would be integers
    return np.asarray(np.bincount((places[:, None] * k + np.arange(k)).ravel(), values.ravel(), size * k), float).reshape(size, k)


def sums_of_groups(values: Array, first: Ints, order: Ints | None = None) -> Array:
    """Sums of groups of rows of ``values (m, ...)`` that start at ``first (k,)``, optionally in an ``order (m,)``: ``(k, ...)``.

    A faster ``numpy.add.reduceat`` along the first axis.
    """
    starts = np.zeros(len(values), dtype=np.int64)
    starts[first[1:]] = 1
    group = starts.cumsum()
    if order is not None:
        group[order] = group.copy()
    return sums_of_rows(group, values.reshape(len(values), -1), len(first)).reshape(len(first), *values.shape[1:])


def pairs_of_equals(numbers: Ints) -> tuple[Ints, Ints]:
    """Pairs of indices of equal numbers ``(n,)``, including each index with itself ``(k,)``."""
    order = np.argsort(numbers, kind="stable")
    first, end = (np.searchsorted(numbers[order], numbers[order], side=side) for side in ("left", "right"))
    count = end - first
    j = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count - first, count)
    return order[np.repeat(np.arange(len(numbers)), count)], order[j]


def among(values: Ints, known: Ints) -> Bools:
    """Which of the values ``(m,)`` are ``known (k,)``, distinct and sorted: ``(m,)``; a faster ``numpy.isin``."""
    if not len(known):
        return np.zeros(len(values), dtype=bool)
    return np.asarray(known[np.minimum(np.searchsorted(known, values), len(known) - 1)] == values)


def largest_of_groups(group: Ints, values: Array, count: int) -> Array:
    """Largest of the values ``(m,)`` of each group ``(count,)``, 0 for those without; a faster ``numpy.maximum.at`` for one group."""
    if count == 1:
        return np.array([values.max(initial=0.0)])
    largest = np.zeros(count)
    np.maximum.at(largest, group, values)
    return largest


def cross_products(a: Array, b: Array) -> Array:
    """Cross products of 3D vectors ``a`` and ``b (..., 3)``; a faster ``numpy.cross``."""
    ahead, back = [1, 2, 0], [2, 0, 1]
    return np.asarray(a[..., ahead] * b[..., back] - a[..., back] * b[..., ahead])


class NumbersOnly(np.ndarray):
    """An array for functions of users, which refuses expressions of UFL, as Constants: NumPy would take them for lists without end."""

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **kwargs: Any) -> Any:
        """As of other arrays; TypeError with an expression."""
        _refuse_symbols(inputs)
        if "out" in kwargs:
            kwargs["out"] = tuple(map(plain, kwargs["out"]))
        found = getattr(ufunc, method)(*map(plain, inputs), **kwargs)
        return tuple(map(numbers_only, found)) if isinstance(found, tuple) else numbers_only(found)

    def __array_function__(self, func: Any, types: Any, args: Any, kwargs: Any) -> Any:
        """As of other arrays; TypeError with an expression."""
        _refuse_symbols((*args, *kwargs.values()))
        return super().__array_function__(func, types, args, kwargs)


def _refuse_symbols(values: Any) -> None:
    """TypeError for expressions of UFL among values and the items of lists."""
    for one in values:
        if hasattr(one, "ufl_shape"):
            raise TypeError(
                "an array meets a Constant or another expression of UFL: expected numbers, as c.value of a Constant c"
            )
        if isinstance(one, list | tuple):
            _refuse_symbols(one)


def copied(value: Any) -> Any:
    """A copy of an array, and other objects as they are."""
    return value.copy() if type(value) is np.ndarray else value


def numbers_only(value: Any) -> Any:
    """An array as ``NumbersOnly``, and other objects as they are."""
    return value.view(NumbersOnly) if type(value) is np.ndarray else value


def plain(value: Any) -> Any:
    """An array of ``NumbersOnly`` as an ordinary one, also in lists, and other objects as they are."""
    if isinstance(value, list | tuple) and any(isinstance(one, NumbersOnly) for one in value):
        return type(value)([plain(one) for one in value])
    return value.view(np.ndarray) if isinstance(value, NumbersOnly) else value
