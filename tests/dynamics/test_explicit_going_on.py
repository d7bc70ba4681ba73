"""Explicit runs that continue from a checkpoint."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from flight_scenes import Flight

import uem_dolfinx as uem
from uem_dolfinx.dynamics.explicit.stepper import ExplicitStepper

COMM = MPI.COMM_WORLD


@pytest.mark.slow
@pytest.mark.parametrize("law", [uem.NeoHooke, uem.LinearElastic])
@pytest.mark.parametrize("stop", [9, 15])
def test_it_continues_from_a_checkpoint(tmp_path, law, stop):
    """A run that stops before or during contact and continues has the steps of the one that does not, and on one rank its last bits."""
    path = COMM.bcast(str(tmp_path / "run.h5") if COMM.rank == 0 else None)
    whole, first, again = (Flight(2, 12, law=law, friction=0.3, speed=14.0) for _ in range(3))
    every = [(step.number, step.dt) for step in uem.time_steps(whole.problem, None, 0.6)]
    for step in uem.time_steps(first.problem, None, 0.6, checkpoint=uem.Checkpoint(path, every=5)):
        if step.number == stop:
            break
    later = [
        (step.number, step.dt) for step in uem.time_steps(again.problem, None, 0.6, checkpoint=uem.Checkpoint(path, every=5))
    ]
    assert later == every[stop:] or (COMM.size > 1 and len(later) == len(every) - stop)
    for one, other in ((again.u, whole.u), (again.dynamics.velocity, whole.dynamics.velocity)):
        change = np.abs(one.x.array - other.x.array).max(initial=0.0)
        assert change == 0.0 or (COMM.size > 1 and change <= 1e-11 * np.abs(other.x.array).max(initial=1.0))


def test_steps_shortened_by_a_refusal_stay_short(monkeypatch, tmp_path):
    """Steps are shorter from a refused one on, also in a run that continues from a checkpoint after it."""
    path, step, limit = COMM.bcast(str(tmp_path / "run.h5")), ExplicitStepper.step, []

    def refusing(self, dt):
        limit[:] = limit or [0.5 * dt]
        if self.problem.step_control.number == 3 and dt > limit[0]:
            self.limit = limit[0]
            raise uem.StepAccuracyError("too long")
        return step(self, dt)

    monkeypatch.setattr(ExplicitStepper, "step", refusing)
    whole, first, again = (Flight(2, 6, law=uem.NeoHooke, gap=9.0) for _ in range(3))
    every = [(step.number, step.dt) for step in uem.time_steps(whole.problem, end=0.4)]
    assert every[-2][1] == 0.9 * limit[0] and len(every) > 10
    for taken in uem.time_steps(first.problem, end=0.4, checkpoint=uem.Checkpoint(path, every=5)):
        if taken.number == 5:
            break
    later = [(step.number, step.dt) for step in uem.time_steps(again.problem, end=0.4, checkpoint=uem.Checkpoint(path, every=5))]
    assert later == every[5:]
