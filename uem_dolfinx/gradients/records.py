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
from uem_dolfinx.solve.memory import Memory


@dataclass(frozen=True)
class Record:
    """One committed step: a value.

    Attributes:
        before: what the step began with.
        displacement: it ended with ``(n_local incl. ghosts,)``.
        states: of the pairs in equilibrium, before they were committed.
        motions: of the pairs' rigid targets.
        values: of what the residual is made of.
        friction, offsets: of the pairs' contactors ``(n,)`` each; None without.
        shares: that it has of values that its load leads Constants to, by the ids of these.
        held: of Dirichlet values, ghosts included ``(n,)``, or of all.
        dt: length of a step in time; 0 in statics.
    """

    before: Memory
    displacement: Array
    states: list[PairState]
    motions: list[Motion | None]
    values: list[Array]
    friction: list[Array | None]
    offsets: list[Array | None]
    shares: dict[int, float]
    held: Array | float
    dt: float


class Records:
    """Records of steps in their order; values that have not changed since the step before are kept once.

    Args:
        folder: where each rank has a scratch file, which goes with this object; None keeps all in memory.

    Raises:
        OSError: if there is no such folder, or it cannot be written in.
    """

    def __init__(self, folder: Path | None = None):
        self._file: Any = None if folder is None else tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        #: Of every step what is kept of it, and of its values one by one.
        self._steps: list[tuple[Any, list[Any]]] = []
        #: Values of the last step.
        self._last: list[Array] = []

    def __len__(self) -> int:
        return len(self._steps)

    def __getitem__(self, k: int) -> Record:
        """A record, read from the file where there is one."""
        record, values = self._steps[k]
        found: Record = self._get(record)
        return replace(found, values=[self._get(value) for value in values])

    def __iter__(self) -> Iterator[Record]:
        return (self[k] for k in range(len(self)))

    def cut(self, n: int) -> None:
        """Forget all steps but the first n."""
        if n < len(self):
            del self._steps[n:]
            self._last = self[n - 1].values if n else []

    def add(self, record: Record) -> None:
        """Keep a further step."""
        kept = self._steps[-1][1] if self._steps else []
        same = [np.array_equal(a, b) for a, b in zip(self._last, record.values)] or [False] * len(record.values)
        values = [kept[k] if same[k] else self._keep(value) for k, value in enumerate(record.values)]
        self._last = record.values
        self._steps.append((self._keep(replace(record, values=[])), values))

    def _keep(self, what: Any) -> Any:
        """What ``_get`` gives back: itself, or its place in the file."""
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
