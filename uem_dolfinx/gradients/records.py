"""Committed steps of a problem, kept in memory or in a scratch file of each rank."""

from __future__ import annotations

import pickle
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.gradients.assemblies import Prescribed
from uem_dolfinx.solve.memory import Memory


@dataclass(frozen=True)
class Record:
    """One committed step: a value."""

    before: Memory  # initial state of the step
    displacement: Array  # at its end ``(n_local incl. ghosts,)``
    states: list[PairState]  # of the interfaces in equilibrium, before their commit
    motions: list[Motion | None]  # of their rigid targets
    values: list[Array]  # of Constants and Functions in the residual
    friction: list[Array | None]  # of the interfaces' contactors ``(n,)`` each, or None
    offsets: list[Array | None]  # of the contacts' contactors ``(n,)`` each, or None
    shares: dict[int, float]  # of Constants and offsets, see ``solve.loading``, by their ids
    held: Array | float  # shares of Dirichlet values, ghosts included ``(n,)``, or one share of all
    dt: float  # length of a time step; 0 in statics
    prescribed: Prescribed  # what equations, couplings and preloads prescribe


class Records:
    """Records of steps in their order; values that have not changed since the previous step are stored once.

    Args:
        folder: for a scratch file of each rank, which is deleted with this object; None keeps all records in memory.

    Raises:
        OSError: if the folder does not exist or is not writable.
    """

    def __init__(self, folder: Path | None = None):
        self._file: Any = None if folder is None else tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        self._steps: list[tuple[Any, list[Any]]] = []  # stored record of every step, and its stored values one by one
        self._last: list[Array] = []  # values of the last step

    def __len__(self) -> int:
        return len(self._steps)

    def __getitem__(self, k: int) -> Record:
        """A record, read from the file if there is one."""
        record, values = self._steps[k]
        found: Record = self._get(record)
        return replace(found, values=[self._get(value) for value in values])

    def __iter__(self) -> Iterator[Record]:
        return (self[k] for k in range(len(self)))

    def cut(self, n: int) -> None:
        """Remove all steps except the first n."""
        if n < len(self):
            del self._steps[n:]
            self._last = self[n - 1].values if n else []

    def add(self, record: Record) -> None:
        """Append a step."""
        kept = self._steps[-1][1] if self._steps else []
        same = [np.array_equal(a, b) for a, b in zip(self._last, record.values)] or [False] * len(record.values)
        values = [kept[k] if same[k] else self._keep(value) for k, value in enumerate(record.values)]
        self._last = record.values
        self._steps.append((self._keep(replace(record, values=[])), values))

    def _keep(self, what: Any) -> Any:
        """Store an object for ``_get``; returns the object, or its position in the file."""
        if self._file is None:
            return what
        place = self._file.seek(0, 2)
        pickle.dump(what, self._file, protocol=pickle.HIGHEST_PROTOCOL)
        return place

    def _get(self, kept: Any) -> Any:
        if self._file is None:
            return kept
        self._file.seek(kept)
        return pickle.load(self._file)
