"""Load steps with a checkpoint: what is interrupted and continued ends as if it had not been, fields and history included.

The test to read first is ``test_interrupted_is_uninterrupted``.
"""

from __future__ import annotations

import atexit
import functools
import shutil
import signal
import tempfile
from pathlib import Path

import numpy as np
import pytest
from helpers import serial, start_process
from ramp_scenes import COMM, RAMPS
from restart_scenes import Killed, bits
from results_scenes import rows, same_series, series

import uem_dolfinx as uem


def reported(steps):
    """What is the same in two runs to the last bit, on any number of ranks to rounding."""
    return [(s.number, s.cuts, s.newton_iterations, round(s.factor, 12)) for s in steps]


@functools.cache
def uninterrupted(kind):
    """A run left alone: the scene, its steps and its folder (collective)."""
    folder = Path(COMM.bcast(tempfile.mkdtemp() if COMM.rank == 0 else None))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    whole = RAMPS[kind](COMM)
    return whole, whole.run(folder, every=2), folder


def same_end(kind, last, folder):
    """Displacement, fields and history are those of the run left alone, in serial bit by bit."""
    whole, _, alone = uninterrupted(kind)
    COMM.barrier()
    a, b = whole.scene.gather(whole.problem.u), last.scene.gather(last.problem.u)
    assert np.abs(a - b).max() <= 1e-9 * np.abs(a).max() and last.problem.progress.steps == whole.problem.progress.steps
    assert [r["step"] for r in rows(folder / "out.csv")] == [r["step"] for r in rows(alone / "out.csv")]
    same_series(alone / "out.xdmf", folder / "out.xdmf")
    if COMM.size == 1:
        assert np.array_equal(bits(whole.problem.u.x.array), bits(last.problem.u.x.array))
        for name in ("run", "out.csv", "out.xdmf", "out.bin"):
            assert (alone / name).read_bytes() == (folder / name).read_bytes(), name
    assert sorted(f.name for f in folder.iterdir() if f.is_file()) == ["out.bin", "out.csv", "out.xdmf", "run"]


def kept(kind, folder):
    """Number of steps in the checkpoint (collective)."""
    there = RAMPS[kind](COMM)
    uem.read_checkpoint(folder / "run", there.problem.state())
    return there.problem.progress.steps


@pytest.mark.long
@pytest.mark.parametrize(
    "stops", [*(pytest.param(n, marks=pytest.mark.slow) for n in ((3,), (3, 2, 1)) if COMM.size == 1), (4, 1)], ids=str
)
@pytest.mark.parametrize("kind", RAMPS)
def test_interrupted_is_uninterrupted(kind, stops, folder):
    """Left in mid-run, in the first call of ``load_steps`` or in a later one, once or several times, and continued."""
    _, steps, _ = uninterrupted(kind)
    done, made = 0, 0
    for stop in stops:
        found = RAMPS[kind](COMM).run(folder, every=2, stop=stop)
        assert reported(found) == reported(steps[done : done + stop])
        made, done = done + stop, kept(kind, folder)
        # a step that was left is not counted
        assert made - 2 <= done < made
    last = RAMPS[kind](COMM)
    assert reported(last.run(folder, every=2)) == reported(steps[done:])
    same_end(kind, last, folder)


@pytest.mark.long
def test_scenes_have_what_they_are_made_for():
    """Steps that are cut, two calls, plastic flow."""
    assert sum(s.cuts for s in uninterrupted("sliding")[1]) > 2
    assert [s.number for s in uninterrupted("ramped")[1]] == [1, 2, 3, 1, 2, 3]
    assert uninterrupted("plastic")[0].problem.materials[0].dissipation() > 0.0


@pytest.mark.parametrize("kind", ["ramped", "rolling"])
def test_done_is_done(kind, folder):
    """A run that has come to its end makes no step, stands where it stood with its load, and adds nothing to its results."""
    first = RAMPS[kind](COMM)
    first.run(folder, every=2)
    again = RAMPS[kind](COMM)
    assert again.run(folder, every=2) == []
    same_end(kind, again, folder)
    a, b = (r.problem.contacts[0].resultant(on="contactor").force for r in (first, again))
    np.testing.assert_allclose(a, b, rtol=1e-9, atol=1e-12)


def test_begun_by_the_load_steps(folder):
    """Without ``begin`` before, and called twice, the second call finds that it is meant."""
    first = RAMPS["ramped"](COMM)
    checkpoint = Killed(folder / "run", every=1)
    steps = first.steps(checkpoint)
    made = [next(steps) for _ in range(5)]
    steps.close()
    assert made[4].number == 2
    COMM.barrier()
    last = RAMPS["ramped"](COMM)
    end = list(last.steps(uem.Checkpoint(folder / "run", every=1)))
    assert reported(end) == reported(uninterrupted("ramped")[1][4:])


@pytest.mark.long
def test_read_back(folder):
    """A state that is read back in the same run is continued from by the next call."""
    one = RAMPS["loaded"](COMM)
    state = one.problem.state()
    (_, n), *_ = one.calls
    for step in uem.load_steps(one.problem, n):
        if step.number == 2:
            uem.write_checkpoint(folder / "kept", state)
    a = one.scene.gather(one.problem.u)
    uem.read_checkpoint(folder / "kept", state)
    assert reported(list(uem.load_steps(one.problem, n))) == reported(uninterrupted("loaded")[1][2:])
    np.testing.assert_allclose(one.scene.gather(one.problem.u), a, rtol=0, atol=1e-12)


RUN = """
from pathlib import Path
import sys
import ramp_scenes
from ramp_scenes import COMM, RAMPS

class Counting(ramp_scenes.Killed):
    def step(self):
        super().step()
        print(self._state.steps, flush=True)

ramp_scenes.Killed = Counting
RAMPS[{kind!r}](COMM).run(Path({folder!r}), every=2)
"""


@serial
@pytest.mark.parametrize("kind", ["sliding", "plastic"])
@pytest.mark.slow
def test_killed(kind, folder):
    """kill -9 twice in mid-run: files are whole whenever it comes, and the run that continues ends in the very same ones."""
    for count in (3, 2):
        process = start_process(RUN.format(kind=kind, folder=str(folder)))
        for _ in range(count):
            process.stdout.readline()
        process.kill()
        process.stdout.read()
        assert process.wait() == -signal.SIGKILL
        # whatever was being done, what XDMF says is there
        assert len(series(folder / "out.xdmf")) >= count
    last = RAMPS[kind](COMM)
    last.run(folder, every=2)
    same_end(kind, last, folder)
