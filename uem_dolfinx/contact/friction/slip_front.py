"""Slip front that propagates along a surface; contactors ahead of it slip in advance, to save exchanges."""

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
    """Position of the slip front, and the distance ahead of it within which contactors slip in advance.

    Args:
        comm: communicator.
    """

    def __init__(self, comm: MPI.Comm) -> None:
        self._comm = comm
        self._last: Array | None = None
        self._reach = 0.0

    def along(self, begin: Bools, back: Bools, force: Array, points: Array) -> tuple[Bools, Array]:
        """Contactors that slip in advance of those that ``begin (n,)``; ``back (n,)`` stick again; see ``move`` (collective)."""
        return self.move(points[begin], force[begin], bool(back.any()), points)

    def move(self, here: Array, force: Array, too_far: bool, points: Array) -> tuple[Bools, Array]:
        """Contactors that slip in advance, at first as far ahead as the front has moved, and their forces (collective).

        Args:
            here: positions at which this rank's contactors begin to slip ``(k, gdim)``.
            force: forces on these contactors ``(k, gdim)``.
            too_far: whether contactors of this rank that slipped in advance stick again.
            points: positions of this rank's contactors ``(n, gdim)``.

        Returns:
            Contactors that slip in advance ``(n,)``, and the force of the nearest that begins to slip ``(n, gdim)``, zero for others.
        """
        begin, back = reduced(self._comm, np.array([len(here), too_far]))
        if not begin:
            return np.zeros(len(points), dtype=bool), np.zeros(points.shape)
        self._reach = self._reach * (NEARER if back else FARTHER) or self._come(here)
        self._last = here
        distance, taken = nearest_of(self._comm, points, here, self._reach, force)
        return np.isfinite(distance), taken

    def _come(self, here: Array) -> float:
        """Distance of the front from its last position; zero at first (collective)."""
        if self._last is None:
            return 0.0
        _, far = box_distances(self._comm, here, self._last)
        bound = reduced(self._comm, float(far.min(initial=np.inf)), op=MPI.MIN)
        distance, _ = nearest_of(self._comm, self._last, here, bound, here)
        return float(reduced(self._comm, float(distance.min(initial=np.inf)), op=MPI.MIN))
