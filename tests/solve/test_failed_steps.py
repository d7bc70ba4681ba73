"""Load and time steps that fail: remainders are halved, and loads that raise end the run on all ranks."""

from __future__ import annotations

import numpy as np
import pytest
from helpers import blocks, linear, raised
from resting_scenes import COMM, Bar

import uem_dolfinx as uem


def pressed_blocks(load=None):
    """Linear block on block, the top pushed down by a twentieth."""
    b = blocks(COMM, "triangle", 2, 4)
    contact = uem.Contact(b.high, b.low)
    return uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.05), contacts=[contact], load=load)


# ---------------------------------------------------------------------------------------------- load steps


def test_failed_remainder_is_halved(monkeypatch):
    """What is left to the full load is tried once as a whole, then by halves, whatever the length of steps was to be."""
    problem, tried = pressed_blocks(), []
    solve = problem.solve

    def fails_on_long_ways(*, start, fraction):
        tried.append(fraction)
        if len(tried) in (1, 3):
            raise uem.ConvergenceError("too long")
        return solve(start=start, fraction=fraction)

    monkeypatch.setattr(problem, "solve", fails_on_long_ways)
    done = [step.factor for step in uem.load_steps(problem, 1)]
    assert tried == [1.0, 0.5, 1.0, 0.75, 1.0] and done == [0.5, 0.75, 1.0]


@pytest.mark.parametrize("sendable", [True, False])
@pytest.mark.parametrize("in_time", [False, True])
def test_load_that_raises_on_one_rank(in_time, sendable):
    """All ranks leave the run with its words, and the last step stays."""

    class LocalError(Exception):
        """Of a class that other ranks cannot look up."""

    def load(at):
        if at > 0.03 and COMM.rank == COMM.size - 1:
            raise (ValueError if sendable else LocalError)("no tide table")

    problem = Bar((0.0, -3.0), load=load).problem if in_time else pressed_blocks(load)
    steps = uem.time_steps(problem, 0.02, 0.06) if in_time else uem.load_steps(problem, 50)
    words = r"load\(0.04\) raised (ValueError|LocalError): no tide table \(test_failed_steps.py, line \d+\)"
    before = []

    def go():
        for _ in steps:
            before[:] = [problem.u.x.array.copy()]

    found = raised(uem.UserFunctionError, words, go)
    assert np.array_equal(problem.u.x.array, before[0])
    if COMM.rank == COMM.size - 1:
        assert type(found.__cause__) is (ValueError if sendable else LocalError)
