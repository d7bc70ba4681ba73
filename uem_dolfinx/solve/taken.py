"""Shares: the derivatives of ramped values in a state with respect to the prescribed values at the end of the ramp.

A ramp that starts from a value of share b has the share ``s + (1 - s) b`` at its fraction s, if the prescribed value changes by the same
amount in all steps.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.solve.loading import ramped, set_by_load


@dataclass(frozen=True)
class Taken:
    """Shares of a committed state: a value.

    Attributes:
        held: share of the Dirichlet value of every unknown, ghosts included ``(n,)``, or one share of all; NaN where nodes were free at
            the start of the ramp, since their positions depend on all parameters.
        led: Constants, and contacts for their offsets, that steps have ramped, each with its value in that state and its share.
    """

    held: Array | float = 0.0
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

    Raises:
        InputError: for values that are ramped from positions of free nodes, since these depend on all parameters.
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
