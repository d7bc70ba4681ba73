"""What each stage of a solve calls and sends by MPI, counted by a library that is loaded before MPI's."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from uem_dolfinx import log

SOURCE = Path(__file__).with_suffix(".c")
#: Environment variable with the library that counts.
LIBRARY = "UEM_COUNTS_COLLECTIVES"


def environment(mpiexec: str, folder: Path) -> dict[str, str]:
    """Environment in which processes of this ``mpiexec`` count; empty without a compiler of the same MPI in its folder."""
    compiler = shutil.which("mpicc", path=str(Path(mpiexec).parent))
    if compiler is None:
        return {}
    library = folder / "collectives.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(SOURCE)], check=True)
    return {"LD_PRELOAD": str(library), LIBRARY: str(library)}


def counts() -> bool:
    """Whether collective calls of this process are counted."""
    return LIBRARY in os.environ


#: What is counted, in the order of the library's enumeration.
KINDS = ("collectives", "reduced_bytes", "gathered_bytes", "row_bytes", "sent_bytes", "messages")


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Collective calls of this rank in the block, by stage, those of stages within it aside; the rest is ``"other"``."""
    found: Counter[str] = Counter()
    with traffic() as stages:
        yield found
    found.update({stage: int(counts[0]) for stage, counts in stages.items()})


@contextmanager
def traffic() -> Iterator[dict[str, np.ndarray]]:
    """Counts of each of ``KINDS`` of this rank in the block, by stage as in ``counted``."""
    library = ctypes.CDLL(os.environ[LIBRARY])
    found: defaultdict[str, np.ndarray] = defaultdict(lambda: np.zeros(len(KINDS), np.int64))

    def counts() -> np.ndarray:
        now = (ctypes.c_long * len(KINDS))()
        library.traffic(now)
        return np.array(now)

    #: Stages that are open, and the counts up to which they have been reported.
    open_stages, before = ["other"], counts()

    def take() -> None:
        nonlocal before
        now = counts()
        found[open_stages[-1]] += now - before
        before = now

    class Counting(timer):  # type: ignore[misc, valid-type]
        def __init__(self, name: str):
            super().__init__(name)
            self._stage = name.removeprefix("~UEM: ")

        def __enter__(self) -> Any:
            take()
            open_stages.append(self._stage)
            return super().__enter__()

        def __exit__(self, *error: Any) -> Any:
            done = super().__exit__(*error)
            take()
            open_stages.pop()
            return done

    log.Timer = Counting  # type: ignore[attr-defined]
    try:
        yield found
    finally:
        take()
        log.Timer = timer  # type: ignore[attr-defined]


timer: Any = log.Timer  # type: ignore[attr-defined]
