"""Slip that eats its way along a surface, one contactor an exchange, and takes others ahead with it."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.geometry.search import box_distances, nearest_of
from uem_dolfinx.parallel import reduced

#: Others go along this times as far ahead as the last time.
#: [convention; how far they last went along; test_slip_front.py::test_slip_that_eats_its_way_goes_ahead]
FARTHER = 2.0
#: And by this part of it where some of those that went along have been held again.
#: [convention; how far they last went along; test_slip_front.py::test_slip_that_eats_its_way_goes_ahead]
NEARER = 0.25


class Front:
    """Where contactors begin to slip, and how far ahead of them others go along.

    Args:
        comm: communicator.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._last: Array | None = None
        self._reach = 0.0

    def along(self, begin: Bools, back: Bools, force: Array, points: Array) -> tuple[Bools, Array]:
        """Which contactors go along with those that ``begin (n,)``, if some ``back (n,)`` are held again, as ``move`` (collective)."""
        return self.move(points[begin], force[begin], bool(back.any()), points)

    def move(self, here: Array, force: Array, too_far: bool, points: Array) -> tuple[Bools, Array]:
        """Which contactors go along, at first as far ahead as slip has come, and the forces they take over (collective).

        Args:
            here: where this rank's contactors begin to slip ``(k, gdim)``.
            force: on these ``(k, gdim)``.
            too_far: whether some of this rank that went along last have been held again.
            points: where this rank's contactors are ``(n, gdim)``.

        Returns:
            Those that go along ``(n,)``, and the force on the nearest that begins to slip ``(n, gdim)``, zero for the others.
        """
        begin, back = reduced(self._comm, np.array([len(here), too_far]))
        if not begin:
            return np.zeros(len(points), dtype=bool), np.zeros(points.shape)
        self._reach = self._reach * (NEARER if back else FARTHER) or self._come(here)
        self._last = here
        distance, taken = nearest_of(self._comm, points, here, self._reach, force)
        return np.isfinite(distance), taken

    def _come(self, here: Array) -> float:
        """How far slip has come since the last time; zero the first (collective)."""
        if self._last is None:
            return 0.0
        _, far = box_distances(self._comm, here, self._last)
        bound = reduced(self._comm, float(far.min(initial=np.inf)), op=MPI.MIN)
        distance, _ = nearest_of(self._comm, self._last, here, bound, here)
        return float(reduced(self._comm, float(distance.min(initial=np.inf)), op=MPI.MIN))
