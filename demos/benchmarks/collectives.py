"""How many collective calls of MPI each stage of a solve makes, by a library that is loaded before MPI's and counts them."""

from __future__ import annotations

import ctypes
import os
import shutil
import subprocess
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from uem_dolfinx import log

SOURCE = Path(__file__).with_suffix(".c")
#: Where a process is told which library counts.
LIBRARY = "UEM_COUNTS_COLLECTIVES"


def environment(mpiexec: str, folder: Path) -> dict[str, str]:
    """What makes processes of this ``mpiexec`` count; nothing where no compiler of the same MPI stands beside it."""
    compiler = shutil.which("mpicc", path=str(Path(mpiexec).parent))
    if compiler is None:
        return {}
    library = folder / "collectives.so"
    subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", str(library), str(SOURCE)], check=True)
    return {"LD_PRELOAD": str(library), LIBRARY: str(library)}


def counts() -> bool:
    """Whether collective calls of this process are counted."""
    return LIBRARY in os.environ


@contextmanager
def counted() -> Iterator[Counter[str]]:
    """Collective calls of this rank in the block, by stage, those of stages within it aside; the rest is ``"other"``."""
    library = ctypes.CDLL(os.environ[LIBRARY])
    library.collectives.restype = ctypes.c_long
    found: Counter[str] = Counter()
    #: Stages that are open, with the calls before what of them has not been counted yet.
    open_stages = [["other", library.collectives()]]

    def take() -> None:
        stage, before = open_stages[-1]
        now = library.collectives()
        found[stage] += now - before
        open_stages[-1][1] = now

    class Counting(timer):  # type: ignore[misc, valid-type]
        def __init__(self, name: str):
            super().__init__(name)
            self._stage = name.removeprefix("~UEM: ")

        def __enter__(self) -> Any:
            take()
            open_stages.append([self._stage, library.collectives()])
            return super().__enter__()

        def __exit__(self, *error: Any) -> Any:
            done = super().__exit__(*error)
            take()
            open_stages.pop()
            open_stages[-1][1] = library.collectives()
            return done

    log.Timer = Counting  # type: ignore[attr-defined]
    try:
        yield found
    finally:
        take()
        log.Timer = timer  # type: ignore[attr-defined]


timer: Any = log.Timer  # type: ignore[attr-defined]
