"""Loops and ``with`` blocks that are left before their end: the last converged step is in the checkpoint.

The test to read first is ``test_left_in_any_way``.
"""

from __future__ import annotations

from contextlib import suppress

import numpy as np
import pytest
from ramp_scenes import five_steps, nothing
from restart_scenes import COMM, small

import uem_dolfinx as uem
from uem_dolfinx.parallel import agreed
from uem_dolfinx.restart import checkpoint as keeping


class OwnError(Exception):
    """What a script raises."""


def left_by_break(steps, done):
    for step in steps:
        done.append(step.number)
        if step.number == 3:
            break


def left_by_an_error(steps, done):
    for step in steps:
        done.append(step.number)
        if step.number == 3:
            raise OwnError


def left_by_exit(steps, done):
    for step in steps:
        done.append(step.number)
        if step.number == 3:
            raise SystemExit(0)


def left_held(steps, done):
    """The iterator lives on."""
    held.append(steps)
    left_by_break(iter(steps), done)


held = []


@pytest.mark.parametrize("block", [True, False], ids=["with", "without"])
@pytest.mark.parametrize("leave", [left_by_break, left_by_an_error, left_by_exit])
@pytest.mark.parametrize("in_time", [False, True], ids=["load", "time"])
def test_left_in_any_way(in_time, leave, block, folder):
    """By ``break``, an error and ``sys.exit`` in the body, after step 3: the next run begins with step 4 and ends as one left alone."""
    problem, begin = five_steps(in_time, nothing)
    checkpoint, done, own = uem.Checkpoint(folder / "run", every=100), [], False
    try:
        if block:
            with checkpoint:
                leave(begin(checkpoint), done)
        else:
            leave(begin(checkpoint), done)
    except (OwnError, SystemExit):
        own = True
    assert done == [1, 2, 3] and own == (leave is not left_by_break)
    again, begin = five_steps(in_time, nothing)
    assert next(iter(begin(uem.Checkpoint(folder / "run", every=100)))).number == 4
    again, begin = five_steps(in_time, nothing)
    assert [step.number for step in begin(uem.Checkpoint(folder / "run"))] == [5]
    whole, begin = five_steps(in_time, nothing)
    list(begin(None))
    np.testing.assert_allclose(again.u.x.array, whole.u.x.array, rtol=0, atol=1e-9 * np.abs(whole.u.x.array).max())


@pytest.mark.parametrize("kind", [RuntimeError, uem.ConvergenceError, GeneratorExit, MemoryError])
@pytest.mark.parametrize("in_time", [False, True], ids=["load", "time"])
def test_a_step_that_fails(in_time, kind, folder):
    """On one rank, by any error of the load's function, also one that no step is cut for: the steps before it are kept."""
    steps = []

    def load(at):
        if len(steps) == 3 and COMM.rank == COMM.size - 1:
            raise kind("no table")

    problem, begin = five_steps(in_time, load)
    with pytest.raises((uem.UEMError, kind)), uem.Checkpoint(folder / "run", every=100) as checkpoint:
        for step in begin(checkpoint):
            steps.append(step.number)
            committed = problem.u.x.array.copy()
    assert steps == [1, 2, 3] and np.array_equal(problem.u.x.array, committed)
    _, begin = five_steps(in_time, nothing)
    assert [step.number for step in begin(uem.Checkpoint(folder / "run"))] == [4, 5]


def test_an_iterator_that_is_held(folder):
    """The end of the block writes, too, and what is done with the iterator later writes nothing more."""
    _, begin = five_steps(False, nothing)
    with uem.Checkpoint(folder / "run", every=100) as checkpoint:
        left_held(begin(checkpoint), [])
    written = (folder / "run").read_bytes()
    COMM.barrier()
    (folder / "run").unlink(missing_ok=True)
    held.clear()
    COMM.barrier()
    assert written and not (folder / "run").exists()


def test_loops_of_the_script(folder):
    """Left without an error the state is kept as it is; by an error only if it can go back to the last step."""

    def run(error, back):
        state = small(numbers=("time", "step"))
        if back:
            state.back.append(lambda: state.numbers.update(step=1))
        with uem.Checkpoint(folder / "run", every=100) as checkpoint:
            checkpoint.begin(state)
            state.numbers["step"] = 1
            checkpoint.step()
            if error:
                state.numbers["step"] = 1.5
                raise OwnError

    with pytest.raises(OwnError):
        run(True, False)
    assert not (folder / "run").exists()
    for error in (False, True):
        with suppress(OwnError):
            run(error, True)
        state = small(numbers=("time", "step"))
        uem.read_checkpoint(folder / "run", state)
        assert state.numbers["step"] == 1 and state.steps == 1 + error


@pytest.mark.skipif(COMM.size == 1, reason="needs several ranks")
def test_left_by_one_rank(folder, monkeypatch):
    """Its own error passes after a while, with nothing written, and the others hear of the steps' end where the script agrees."""
    monkeypatch.setattr(keeping, "LEAVING", 0.2)
    _, begin = five_steps(False, nothing)
    steps = begin(uem.Checkpoint(folder / "run", every=100))
    next(steps)
    with pytest.raises(OwnError), agreed(COMM):
        if COMM.rank == 0:
            steps.close()
            raise OwnError
    # ranks that come later do not wait for it
    steps.close()
    assert not (folder / "run").exists()
