"""Steps of time whose length follows their error.

Read first: ``test_a_vibration``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from bar_scenes import Bar
from helpers import refused

import uem_dolfinx as uem
from uem_dolfinx.solve.step_control import StepControl

COMM = MPI.COMM_WORLD


def first_mode(X):
    """Velocity of a bar that is held at y = 0 and swings in its first mode."""
    v = np.zeros_like(X)
    v[:, -1] = np.sin(np.pi * X[:, -1] / 20)
    return v


def swing(tolerance, dt=0.32, end=1.28, scheme=None):
    """Lengths of the steps of the first mode, and the relative error of its phase at the end."""
    n = 20
    h, c = 10.0 / n, 30.0
    omega = 2 * c / h * np.sin(np.pi * h / 40)
    bar = Bar(n, gap=0.0, v=first_mode, wall=False, held=True, scheme=scheme or uem.newmark())
    lengths = [step.dt for step in uem.time_steps(bar.problem, dt, end, tolerance=tolerance)]
    mode = bar.field(first_mode).x.array
    weight = COMM.allreduce(mode @ mode)
    u, v = (COMM.allreduce(f.x.array @ mode) / weight for f in (bar.u, bar.problem.dynamics.velocity))
    phase = np.unwrap([omega * end, np.arctan2(omega * u, v)])
    return lengths, abs(phase[1] - phase[0]) / (omega * end)


@pytest.mark.long
def test_a_vibration():
    """The error of the period is the tolerance, nearly; steps are as long as this allows, and powers of two."""
    counts = []
    for tolerance in (1e-2, 1e-3, 1e-4):
        lengths, error = swing(tolerance)
        assert tolerance / 4 < error <= 1.5 * tolerance, (tolerance, error)
        parts = np.log2(0.32 / np.array(lengths))
        assert np.allclose(parts, np.round(parts))
        counts.append(len(lengths))
    assert 5 < counts[2] / counts[0] < 20


@pytest.mark.long
def test_steps_are_doubled_in_time():
    """Steps become longer only where twice the length is accurate as well: none is refused after the first one."""
    control = StepControl(1.0)
    control.longest = 0.25
    control.done([None] * 3, longer=1.0)
    assert control.longest == 0.25
    control.done([None] * 3)
    assert control.longest == 0.5
    bar = Bar(20, gap=0.0, v=first_mode, wall=False, held=True, scheme=uem.newmark())
    cuts = [step.cuts for step in uem.time_steps(bar.problem, 0.32, 1.28, tolerance=1e-3)]
    assert cuts[0] > 0 and sum(cuts[1:]) < 0.2 * len(cuts)
    lengths, _ = swing(2.5e-3)
    assert max(lengths) == 4 * min(lengths) == 0.08 and len(lengths) < 50
    lengths, _ = swing(2e-2)
    assert max(lengths) == min(lengths) == 0.08
    lengths, _ = swing(0.3)
    assert max(lengths) == 0.32


@pytest.mark.slow
def test_errors_fall_with_the_tolerance():
    """By a quarter with a quarter of it: steps do not grow where the vibration turns, whose speed the estimate does not see."""
    errors = [swing(2e-2 / 4**k)[1] for k in range(4)]
    assert np.allclose(np.array(errors[:-1]) / errors[1:], 4.0, rtol=0.05)


def test_without_a_tolerance():
    """Steps have the length that was given."""
    lengths, _ = swing(None)
    assert lengths == [0.32] * 4


def test_what_is_refused():
    """Tolerances out of their range, and those that no step reaches."""
    bar = Bar(20, gap=0.0, v=first_mode, wall=False, held=True, scheme=uem.newmark())
    refused(uem.InputError, "between 0 and 1", lambda: uem.time_steps(bar.problem, 0.1, 1.0, tolerance=2.0))
    refused(
        uem.StepAccuracyError, ["tolerance", "no better"], lambda: list(uem.time_steps(bar.problem, 0.1, 1.0, tolerance=1e-13))
    )


def thrown(dt, tolerance=None):
    """Displacements and lengths of the steps of a bar that falls, hits a wall and flies back, with its instants."""
    bar = Bar(10, scheme=uem.generalised_alpha(0.5))
    times = bar.run(dt, 1.8, tolerance=tolerance, event_tolerance=1e-2)[:, 0]
    return np.array(bar.u.x.array), np.array([step.dt for step in bar.steps]), times


@pytest.mark.slow
def test_an_impact():
    """In free flight steps have the length that was given, from the blow on they are short: fewer than equal ones of the same error."""
    exact, _, _ = thrown(0.002)
    errors = []
    for tolerance in (3e-2, 1e-2):
        u, lengths, times = thrown(0.1, tolerance)
        assert np.allclose(lengths[times < 0.45], 0.1) and lengths[times > 0.55].max() < 0.03
        equal, count, _ = thrown(1.8 / len(lengths))
        assert len(count) >= len(lengths)
        found = [COMM.allreduce(np.abs(x - exact).max(initial=0.0), op=MPI.MAX) for x in (u, equal)]
        assert found[0] < 0.8 * found[1]
        errors.append(found[0])
    assert errors[1] < 0.5 * errors[0]
