"""How often each stage of a solution runs, by the timers of the package."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from mpi4py import MPI

from uem_dolfinx import compat

SEARCH, PROJECTION = "search", "projection"
P, PRODUCT, CROSSED = "restriction matrix P", "united matrix P'KP", "cross out prescribed components"
CONDENSED, INSIDE = "condensed matrix", "solve without the contact"
TANGENT, FACTORISATION, SOLVE = "assemble tangent", "factorisation or preconditioner set-up", "linear solve"
MASS = ("assemble mass", "redistribute mass", "first acceleration", "inertia forces")
HISTORY = ("return mapping", "commit history")
OUTPUT = ("write fields", "write table", "write checkpoint", "read checkpoint")
STAGES = (SEARCH, PROJECTION, P, PRODUCT, CROSSED, CONDENSED, INSIDE, TANGENT, FACTORISATION, SOLVE, *MASS, *HISTORY, *OUTPUT)


class Calls(dict):
    """Number of calls by timer."""

    def of(self, timers: tuple[str, ...]) -> int:
        return sum(self[timer] for timer in timers)


@contextmanager
def counted() -> Iterator[Calls]:
    """How often each stage runs inside, known at the end (alike on all ranks, or it fails)."""
    before = {stage: compat.timing(f"~UEM: {stage}")[0] for stage in STAGES}
    calls = Calls()
    yield calls
    calls.update({stage: compat.timing(f"~UEM: {stage}")[0] - n for stage, n in before.items()})
    assert len({tuple(c.items()) for c in MPI.COMM_WORLD.allgather(calls)}) == 1
