"""What a problem's load drives: Constants, as terms of forms or as prescribed values, by one rule for all kinds of steps.

A Constant that the load sets has the value of the load factor or time wherever it acts. Other prescribed values are ramped over load
steps, from the displacement at which these begin.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem
from ufl.core.expr import Expr

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Bools
from uem_dolfinx.errors import InputError, InputTypeError
from uem_dolfinx.parallel import agreed, ask_together


class ByFunction:
    """A load that is set by a function of the load factor or the time.

    Args:
        function: as declared.

    Attributes:
        at: argument of its last call since the last step; None without one.
        last: argument of its last call of all.
    """

    def __init__(self, function: Callable[[float], None]):
        self._function = function
        self.at: float | None = None
        self.last: float | None = None

    def __call__(self, at: float) -> None:
        """Set the load."""
        self.at = self.last = at
        self._function(at)


def check_load(load: Any) -> Mapping[fem.Constant, Any] | ByFunction | None:
    """The load as a function of the factor or the time, or as Constants and their values, each numbers or a function; or None.

    Raises:
        InputTypeError, InputError: naming what it is instead.
    """
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
            if not callable(value):
                _fitting(constant, value)
        return {c: value if callable(value) else np.asarray(value, dtype=float)[()] for c, value in load.items()}
    if load is not None and (isinstance(load, Expr) or not callable(load)):
        raise InputTypeError(given.sentence("load", load, expected))
    return load if load is None or isinstance(load, ByFunction) else ByFunction(load)


def set_loads(comm: MPI.Comm, load: Any, at: float) -> None:
    """Set what a problem's ``load`` sets at a load factor or time; None sets nothing (collective).

    Raises:
        InputError, InputTypeError: where the value of a Constant is no finite number, or numbers of another shape.
        UserFunctionError: if a function raises.
    """
    if isinstance(load, Mapping):
        for constant, value in load.items():
            now = ask_together(comm, f"the load of a Constant at {at:.6g}", value, at) if callable(value) else value * at
            with agreed(comm):
                constant.value = _fitting(constant, now)
    elif load is not None:
        ask_together(comm, f"load({at:.6g})", load, at)


def _fitting(constant: fem.Constant, value: Any) -> Any:
    """The value as an array of the Constant's shape."""
    shape = np.shape(constant.value)
    words = f"finite numbers of the shape {shape}" if shape else "a finite number"
    try:
        array = np.asarray(value, dtype=float)
    except (TypeError, ValueError):
        raise InputTypeError(given.sentence("the value of a Constant in load", value, words)) from None
    if array.shape != shape or not np.isfinite(array).all():
        raise InputError(given.sentence("the value of a Constant in load", value, words))
    return array


def bring_load(problem: Any, at: float) -> None:
    """Set a problem's load to a factor or time where it is not there yet (collective).

    A function that was last called with it is not called again: what the script has moved since then stays.
    """
    load = problem.load
    if isinstance(load, ByFunction) and load.last == at:
        problem.load = None
    try:
        problem.set_load(at)
    finally:
        problem.load = load


def forget_load(problem: Any) -> None:
    """Let the loads that have been set be those of the committed state: the next ``solve`` takes its own."""
    problem.set_at = None
    if isinstance(problem.load, ByFunction):
        problem.load.at = None


def set_by_load(load: Any, bcs: Sequence[Any], n: int) -> Bools:
    """Unknowns ``(n,)`` whose Dirichlet values are Constants that a load sets; a function as load tells of none."""
    constants = list(load) if isinstance(load, Mapping) else []
    kept, found = [np.array(forms.values_of(c)) for c in constants], np.zeros((2, n))
    try:
        for k, values in enumerate(found if constants else ()):
            for c in constants:
                forms.values_of(c)[...] = float(k)
            compat.set_bc_values(values, bcs)
    finally:
        for c, value in zip(constants, kept):
            forms.values_of(c)[...] = value
    with np.errstate(invalid="ignore"):
        return np.asarray(found[1] - found[0] == 1.0)
