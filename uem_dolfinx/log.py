"""The logger of the package, its timers and its progress bar.

It logs on rank 0 only, and is silent until the application configures logging. Timings are in DOLFINx's table, under ``~UEM:``.
"""

from __future__ import annotations

import logging
import sys
from contextlib import contextmanager
from functools import wraps
from typing import TYPE_CHECKING, Any, TypeVar, cast

from mpi4py import MPI

from dolfinx.common import Timer

from uem_dolfinx import compat, given
from uem_dolfinx.errors import InputError

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Iterator

T = TypeVar("T")
F = TypeVar("F", bound="Callable[..., Any]")


logger = logging.getLogger("uem_dolfinx")
"""Rank 0's logger; handlers and levels are the application's business."""
logger.addFilter(lambda record: MPI.COMM_WORLD.rank == 0)


def say(line: str) -> None:
    """Print a line that the user has requested, on rank 0."""
    if MPI.COMM_WORLD.rank == 0:
        print(line, flush=True)


#: All stages that the package times.
STAGES = (
    "assemble mass", "assemble residual", "assemble tangent", "commit history", "compile forms", "condensed matrix", "contact curvature",
    "corners of the target", "cross out prescribed components", "deflation", "eigenvalues", "estimate errors",
    "factorisation or preconditioner set-up", "first acceleration", "inertia forces", "linear solve", "projection", "read checkpoint",
    "read mesh", "redistribute mass", "restriction matrix P", "return mapping", "search", "search and projection", "segments",
    "solve without the contact", "united matrix", "united matrix P'KP", "united matrix Q'KP", "united matrix of explicit steps",
    "uniting equations", "write checkpoint", "write fields", "write surfaces", "write table",
)  # fmt: skip
#: Stages that have been timed so far, in the order of their first time.
_stages: dict[str, None] = {}


def timed(stage: str) -> Timer:
    """A context that times a stage of the method, as ``"search"``; ``list_timings`` shows it as ``~UEM: search``."""
    _stages[stage] = None
    return Timer(f"~UEM: {stage}")


def timed_as(stage: str) -> Callable[[F], F]:
    """Decorator of a function whose calls are a stage, see ``timed``."""

    def decorated(function: F) -> F:
        @wraps(function)
        def run(*args: Any, **how: Any) -> Any:
            with timed(stage):
                return function(*args, **how)

        return cast("F", run)

    return decorated


class Timings(dict[str, tuple[int, float]]):
    """Number of calls and wall time in seconds of each stage; printed as a table, the longest first."""

    def __str__(self) -> str:
        rows = sorted(self.items(), key=lambda item: -item[1][1])
        return "\n".join(["seconds  times  stage, some within others", *(f"{s:7.3f} {n:6d}  {stage}" for stage, (n, s) in rows)])


def timings() -> Timings:
    """Number of calls and wall time in seconds of each stage on this rank so far; some stages contain others.

    ``print(uem.timings())`` shows a table.
    """
    return Timings((stage, timing(stage)) for stage in _stages)


def timing(stage: str) -> tuple[int, float]:
    """Number of calls and wall time in seconds of a stage on this rank so far; names as in ``timings``.

    Raises:
        InputError, InputTypeError: for an unknown stage.
    """
    known = "the name of a stage, as print(uem.timings()) shows them"
    given.kind("stage", stage, isinstance(stage, str), known)
    if stage not in STAGES and stage not in _stages:
        raise InputError(given.sentence("stage", stage, known, given.did_you_mean(stage, STAGES)))
    return compat.timing(f"~UEM: {stage}")


@contextmanager
def compiling(what: str) -> Iterator[None]:
    """Time the compilation of forms, as ``"the residual"``, and log it if it happens: it takes a while, in the first run only."""
    ffcx = logging.getLogger("ffcx")
    said = False

    def info(message: object, *_: object) -> None:
        nonlocal said
        if not said and str(message).startswith("Compiler stage"):
            said = True
            logger.info("compiling %s: later runs find it in the cache", what)

    # FFCx logs the stages of a compilation, at a level that it sets itself; forms found in its cache have no stages
    ffcx.info = info  # type: ignore[assignment]
    try:
        with timed("compile forms"):
            yield
    finally:
        del ffcx.info


def progress(items: Iterable[T], description: str = "", total: int | None = None) -> Iterable[T]:
    """Iterate with a progress bar if standard error is a terminal.

    Args:
        items: to iterate over.
        description: text in front of the bar.
        total: number of items, if ``items`` has no length.

    Returns:
        ``items`` behind a tqdm bar on rank 0 when standard error is a terminal and tqdm is installed, else ``items``.
    """
    if MPI.COMM_WORLD.rank != 0 or not sys.stderr.isatty():
        return items
    try:
        from tqdm import tqdm
    except ImportError:
        return items
    return tqdm(items, desc=description, total=total, file=sys.stderr)
