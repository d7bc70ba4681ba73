"""Boxes of many ranks: the same answers as from all pairs of points and ranks, in time and memory that do not grow with the ranks.

A communicator of as many ranks as one likes is made up: every rank has a cube of a regular grid, and a few have nothing.
"""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from helpers import serial

from uem_dolfinx.geometry.candidates import RankBoxes

pytestmark = serial


class Grid:
    """Ranks of a cube of ``side`` ranks along each axis, each with some positions; this one is in its middle."""

    def __init__(self, side: int, n: int, kinds: int, empty: int = 0):
        self.size, self.side = side**3, side
        rng = np.random.default_rng(7)
        corner = np.stack(np.unravel_index(np.arange(self.size), (side,) * 3), axis=1)
        self.places = corner[:, None] + rng.random((self.size, n, 3))
        self.kind = rng.integers(kinds, size=(self.size, n))
        self.rank = self.size // 2
        self.without = set(rng.choice(np.delete(np.arange(self.size), self.rank), empty, replace=False).tolist())

    def Allgather(self, mine: np.ndarray, every: np.ndarray) -> None:
        for rank in range(self.size):
            if rank in self.without:
                every[rank] = -np.inf
                continue
            every[rank] = -np.inf
            for side, sign in enumerate((-1.0, 1.0)):
                np.maximum.at(every[rank, side], self.kind[rank], sign * self.places[rank])

    def boxes(self, kinds: int, out: float) -> RankBoxes:
        return RankBoxes(self, self.places[self.rank], out, self.kind[self.rank], kinds)  # type: ignore[arg-type]


def all_pairs(boxes: RankBoxes, points: np.ndarray, kind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Bounds on the distance of each point from the positions of its kind of each rank, one by one ``(size, n)``."""
    near, far = np.full((2, boxes.size, len(points)), np.inf)
    for r in range(boxes.size):
        for i, (p, k) in enumerate(zip(points, kind)):
            low, high = boxes.low[r, k], boxes.high[r, k]
            if low[0] <= high[0]:
                near[r, i] = np.linalg.norm(np.maximum(np.maximum(low - p, p - high), 0.0))
                far[r, i] = np.linalg.norm(np.maximum(np.abs(p - low), np.abs(p - high)))
    return near, far


@pytest.mark.parametrize("kinds", [1, 3])
@pytest.mark.parametrize("apart", [0.0, 5.0])
def test_as_of_all_pairs(kinds, apart):
    grid, rng = Grid(3, 6, kinds, empty=5), np.random.default_rng(3)
    boxes = grid.boxes(kinds, 0.1)
    points, kind = apart + 3 * rng.random((40, 3)), rng.integers(kinds, size=40)
    near, far = all_pairs(boxes, points, kind)
    first = np.where(near <= near.min(axis=0), far, np.inf).argmin(axis=0)
    assert np.array_equal(boxes.nearest(points, kind), first)
    within, more = rng.random(40) + apart, 0.3 * rng.random(grid.size)
    for options, wanted in (
        ({}, near <= within),
        ({"more": more}, near <= within + more[:, None]),
        ({"but": first}, (near <= within) & (first != np.arange(grid.size)[:, None])),
    ):
        lists = boxes.near(points, within, kind, **options)
        assert len(lists) == grid.size and all(np.array_equal(one, np.flatnonzero(w)) for one, w in zip(lists, wanted))
    assert not boxes.nearest(points[:0], kind[:0]).size and not any(map(len, boxes.near(points[:0], within[:0], kind[:0])))


def test_nothing_anywhere():
    grid = Grid(2, 3, 1)
    grid.without = set(range(grid.size))
    boxes = grid.boxes(1, 0.0)
    assert not boxes.nearest(np.zeros((4, 3))).any() and not any(map(len, boxes.near(np.zeros((4, 3)), np.full(4, 9.0))))


def test_memory_by_the_points_and_not_by_the_ranks():
    """A thousand ranks, of which 27 are nearby: memory is that of eight times fewer ranks, and a small part of all pairs."""
    peaks = []
    for side in (5, 10):
        grid = Grid(side, 40, 1)
        points = side // 2 + np.random.default_rng(5).random((4000, 3))
        boxes = grid.boxes(1, 0.0)
        tracemalloc.start()
        first = boxes.nearest(points)
        sent = sum(map(len, boxes.near(points, np.full(4000, 0.1), but=first)))
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert 0 < sent < 8 * len(points)
    few, many = peaks
    assert many < 1.5 * few and many < 0.05 * 16 * 1000 * 4000
