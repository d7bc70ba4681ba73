"""When a checkpoint is written: every few steps, at the end, on a signal; and what is left of a run that is killed.

The test to read first is ``test_killed_without_warning``.
"""

from __future__ import annotations

import os
import signal
import threading
import time

import numpy as np
import pytest
from helpers import serial, start_process
from restart_scenes import COMM, bits, lead, slider, small

import uem_dolfinx as uem

# -- runs ------------------------------------------------------------------------------------------------------------------


def counted(path, steps, every=3, stop=None):
    """A run that counts its steps; stops by an exception after some of them."""
    state = small(numbers=("time", "step"))
    state.numbers["step"] = 0
    with uem.Checkpoint(path, every=every) as checkpoint:
        begun = checkpoint.begin(state)
        for k in range(state.numbers["step"] + 1, steps + 1):
            state.numbers["step"] = k
            state.functions["u"].x.array[:] = k
            checkpoint.step()
            if k == stop:
                raise KeyboardInterrupt
        checkpoint.finish()
    return begun, state


def step_in(path):
    state = small(numbers=("time", "step"))
    uem.read_checkpoint(path, state)
    assert (state.functions["u"].x.array == state.numbers["step"]).all()
    return state.numbers["step"]


def test_interval_and_end(folder, caplog):
    """Written every three steps and at the end; what was stopped loses no more than an interval and continues, with a word about it."""
    path = folder / "deeper" / "run"
    with pytest.raises(KeyboardInterrupt):
        counted(path, 20, stop=2)
    assert not path.exists()
    COMM.barrier()
    with pytest.raises(KeyboardInterrupt):
        counted(path, 20, stop=8)
    assert step_in(path) == 6
    begun, state = counted(path, 10)
    assert begun and state.numbers["step"] == 10 and step_in(path) == 10
    begun, state = counted(path, 10)
    assert begun and state.numbers["step"] == 10
    assert COMM.rank > 0 or any("continuing from the checkpoint" in r.message for r in caplog.records)
    COMM.barrier()
    assert [f.name for f in path.parent.iterdir()] == ["run"]
    with pytest.raises(ValueError, match="every = 0: expected a whole number, 1 or more"):
        uem.Checkpoint(path, every=0)


def test_leftovers_are_removed(folder):
    """Half a file of a writing that was killed is no checkpoint, and goes when the run begins anew."""
    if COMM.rank == 0:
        (folder / "run.part").write_bytes(b"uem_dolfinx checkpoint, half of it")
    COMM.barrier()
    begun, _ = counted(folder / "run", 2)
    assert not begun and step_in(folder / "run") == 2
    COMM.barrier()
    assert [f.name for f in folder.iterdir()] == ["run"]


def test_one_number_between_steps(folder, monkeypatch):
    """A step that does not write sends one number around, and touches neither state nor disk."""
    state, calls = small(), []

    class Counting:
        def __init__(self, comm):
            self.comm = comm

        def __getattr__(self, name):
            # what a communicator knows of itself sends nothing
            calls.extend([name] if callable(getattr(self.comm, name)) else [])
            return getattr(self.comm, name)

    checkpoint = uem.Checkpoint(folder / "run", every=100)
    checkpoint.begin(state)
    monkeypatch.setattr(uem.State, "comm", property(lambda self: Counting(self.mesh.comm)))
    state.collect.append(lambda: calls.append("collect"))
    for _ in range(99):
        checkpoint.step()
    assert calls == ["Allreduce"] * (99 if COMM.size > 1 else 0)
    monkeypatch.undo()
    calls.clear()
    checkpoint.step()
    assert calls == ["collect"] and (folder / "run").exists()


def test_sigterm_on_one_rank_ends_all(folder):
    """One rank gets a signal to end: all write the step they are at and leave with 143; afterwards the signal is whose it was."""
    before, heard = signal.getsignal(signal.SIGTERM), []
    signal.signal(signal.SIGTERM, lambda *what: heard.append(what))
    try:
        own = signal.getsignal(signal.SIGTERM)
        state = small(numbers=("time", "step"))
        state.numbers["step"] = 1
        state.functions["u"].x.array[:] = 1
        with pytest.raises(SystemExit) as end, uem.Checkpoint(folder / "run", every=100) as checkpoint:
            checkpoint.begin(state)
            checkpoint.step()
            assert not (folder / "run").exists()
            COMM.barrier()
            if COMM.rank == COMM.size - 1:
                os.kill(os.getpid(), signal.SIGTERM)
            state.numbers["step"] = 2
            state.functions["u"].x.array[:] = 2
            checkpoint.step()
        assert end.value.code == 143 and step_in(folder / "run") == 2
        assert signal.getsignal(signal.SIGTERM) is own and heard == []
        # a signal that no step has seen is handed on, and without ``with`` nothing is caught
        with uem.Checkpoint(folder / "run") as checkpoint:
            os.kill(os.getpid(), signal.SIGTERM)
            assert heard == []
        assert len(heard) == 1
        uem.Checkpoint(folder / "run").begin(state)
        assert signal.getsignal(signal.SIGTERM) is own
    finally:
        signal.signal(signal.SIGTERM, before)


def test_no_handler_outside_the_main_thread(folder):
    """Python allows handlers in the main thread only; elsewhere a Checkpoint works without."""
    found = []

    def run():
        with uem.Checkpoint(folder / "run"):
            found.append(signal.getsignal(signal.SIGTERM))

    before = signal.getsignal(signal.SIGTERM)
    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [before]


RUN = """
from restart_scenes import lead, slider
import uem_dolfinx as uem

_, _, problem = slider()
state = problem.state()
state.numbers["step"] = 0
with uem.Checkpoint({path!r}, every={every}) as checkpoint:
    checkpoint.begin(state)
    while True:
        k = state.numbers["step"] + 1
        lead(problem, [1 + k % 10] if k > 9 else [k])
        state.numbers["step"] = k
        checkpoint.step()
        print(k, flush=True)
"""


def start(path, every):
    """A process that runs until it is done or killed."""
    return start_process(RUN.format(path=str(path), every=every))


@serial
@pytest.mark.slow
def test_killed_without_warning(folder):
    """kill -9 at any instant, four times over: the file is whole, at most one interval old, and the run continues from it."""
    last = 0
    for wait in (0.0, 0.003, 0.011, 0.02):
        process = start(folder / "run", 2)
        lines = []
        while len(lines) < 5:
            lines.append(int(process.stdout.readline()))
        time.sleep(wait)
        process.kill()
        lines += [int(line) for line in process.stdout.read().split()]
        process.wait()
        assert lines[0] == last + 1
        _, _, problem = slider()
        state = problem.state()
        state.numbers["step"] = None
        uem.read_checkpoint(folder / "run", state)
        last = state.numbers["step"]
        assert lines[-1] - 2 < last <= lines[-1] + 1
    # it is a state of the run, not just a readable one
    _, _, whole = slider()
    lead(whole, [k if k <= 9 else 1 + k % 10 for k in range(1, last + 1)])
    assert np.array_equal(bits(whole.u.x.array), bits(problem.u.x.array))


def test_a_signal_within_a_step_waits_for_its_end(folder):
    """A script that counts its own steps has no other place to write: the step that a signal comes in is finished and written."""
    _, _, problem = slider()
    state, solve = problem.state(), problem.system.solver.solve
    state.numbers["step"] = 0

    def signalled(*how):
        if COMM.rank == COMM.size - 1:
            os.kill(os.getpid(), signal.SIGTERM)
        return solve(*how)

    with pytest.raises(SystemExit) as end, uem.Checkpoint(folder / "run", every=100) as checkpoint:
        checkpoint.begin(state)
        for k in (1, 2, 3):
            if k == 2:
                problem.system.solver.solve = signalled
            lead(problem, [k])
            state.numbers["step"] = k
            checkpoint.step()
    there = slider()[2].state()
    there.numbers["step"] = None
    uem.read_checkpoint(folder / "run", there)
    assert end.value.code == 143 and there.numbers["step"] == 2


@pytest.mark.long
@serial
def test_terminated(folder):
    """SIGTERM ends a run with 143 after its step is written, far from the end of the interval."""
    process = start(folder / "run", 10**6)
    for _ in range(3):
        process.stdout.readline()
    process.send_signal(signal.SIGTERM)
    lines = process.stdout.read().split()
    assert process.wait() == 143
    _, _, problem = slider()
    state = problem.state()
    state.numbers["step"] = None
    uem.read_checkpoint(folder / "run", state)
    # the step that was written was not printed any more
    assert state.numbers["step"] == int(lines[-1] if lines else 3) + 1
