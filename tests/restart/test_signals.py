"""Ctrl-C and SIGTERM while load or time steps run: on whichever rank they come, all end together and the last state is kept.

The test to read first is ``test_one_rank_is_interrupted``.
"""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
import threading
from pathlib import Path

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import blocks, environment, linear, serial, start_process
from ramp_scenes import COMM, five_steps, nothing

import uem_dolfinx as uem
from uem_dolfinx.parallel import INTERRUPTED
from uem_dolfinx.solve.united.system import BodySystem

ENDS = {signal.SIGINT: KeyboardInterrupt, signal.SIGTERM: SystemExit}


@pytest.fixture(autouse=True)
def handlers():
    """Python's own handler of Ctrl-C and a handler that records SIGTERM, which are restored after every test."""
    before = {number: signal.getsignal(number) for number in ENDS}
    heard = []
    own = {signal.SIGINT: signal.default_int_handler, signal.SIGTERM: lambda number, frame: heard.append(number)}
    for number, handler in own.items():
        signal.signal(number, handler)
    yield own, heard
    assert {number: signal.getsignal(number) for number in own} == own
    for number, handler in before.items():
        signal.signal(number, handler)


def send(number, rank=COMM.size - 1):
    """A signal to one rank alone, which has come when this returns."""
    if COMM.rank == rank:
        os.kill(os.getpid(), number)


@pytest.mark.parametrize("number", ENDS, ids=["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("within", ["problem", "solve"])
def test_one_rank_is_interrupted_outside_of_steps(number, within, monkeypatch):
    """While the problem is made, or brought into equilibrium without steps: all ranks end."""
    b = blocks(COMM, "triangle")

    def method(*args, **how):
        if within == "problem":
            send(number)
        return BodySystem(*args, **how)

    def run():
        contact = uem.Contact(b.high, b.low)
        problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.05), contacts=[contact], method=method)
        if within == "solve":
            solve = problem.system.solve
            monkeypatch.setattr(problem.system, "solve", lambda *args: send(number) or solve(*args))
            problem.solve()

    with pytest.raises(ENDS[number]):
        run()
    assert not b.u.x.array.any()


@pytest.mark.parametrize("kind", [SystemExit, KeyboardInterrupt, ZeroDivisionError])
@pytest.mark.parametrize("what", ["load", "constant", "distance", "friction", "damping", "mass"])
def test_functions_that_end_one_rank(what, kind):
    """Whatever a function of the user's raises on one rank, and be it the end of the script, ends all ranks alike."""
    b, now, made = blocks(COMM, "triangle"), [], []

    def fail(value):
        if now and COMM.rank == COMM.size - 1:
            raise kind("of one rank")
        return value

    weight = fem.Constant(b.scene.mesh, 0.0)
    ground = uem.RigidSurface(lambda x: fail(x[:, 1]) if not made else end(x), lambda x: np.tile([0.0, 1.0], (len(x), 1)))
    options = {
        "load": lambda: {"load": lambda factor: fail(None)},
        "constant": lambda: {"load": {weight: fail}, "F": linear(b.u, 1.0) - weight * ufl.TestFunction(b.V)[0] * ufl.dx},
        "distance": dict,
        "friction": lambda: {"contacts": [uem.Contact(b.high, b.low, friction=lambda x: fail(0.1))]},
        "damping": lambda: {"dynamics": uem.Dynamics(uem.lumped_mass(b.V, 1.0), damping=fail)},
        "mass": lambda: {"dynamics": uem.Dynamics(uem.nodal_mass(b.V, lambda x: fail(np.ones(len(x)))))},
    }[what]

    def run():
        contacts = [uem.Contact(b.high, ground if what == "distance" else b.low)]
        # the functions of a surface are called where there are contactors
        now.extend([1] * (what != "distance"))
        given = {"bcs": b.oedometer(0.05), "contacts": contacts} | options()
        problem = uem.UnitedProblem(given.pop("F", linear(b.u, 1.0)), b.u, **given)
        owners = COMM.allgather(len(problem.contacts[0].nodes) > 0)
        now.extend([1] * (COMM.rank == owners.index(True)))
        made.extend([1] * (what == "distance" and bool(now)))
        for _ in uem.load_steps(problem, 1):
            pass

    def end(x):
        raise kind("of one rank")

    with pytest.raises(uem.UserFunctionError if kind is ZeroDivisionError else kind, match="of one rank"):
        run()


ALONE = """
from mpi4py import MPI
import signal, sys
import uem_dolfinx as uem
if MPI.COMM_WORLD.rank == 1:
    signal.raise_signal(signal.SIGINT)
MPI.COMM_WORLD.barrier()
"""


IMPORTING = """
from mpi4py import MPI
import signal, sys

class Finder:
    def find_spec(name, *more):
        if name == "dolfinx" and MPI.COMM_WORLD.rank == 1:
            signal.raise_signal(signal.SIGINT)

sys.meta_path.insert(0, Finder)
import uem_dolfinx as uem
MPI.COMM_WORLD.barrier()
"""


@serial
@pytest.mark.parametrize("script", [ALONE, IMPORTING], ids=["own lines", "import"])
def test_one_rank_is_interrupted_before_the_steps(script):
    """In the script's own lines, or while it imports, where nothing is collective: the run ends, and nobody waits for ever."""
    mpiexec = shutil.which("mpiexec", path=str(Path(sys.executable).parent)) or shutil.which("mpiexec")
    command = [str(mpiexec), "-n", "2", sys.executable, "-c", script]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=120)
    # mpiexec may cut off the end of the message of a rank that ends all others
    assert done.returncode == INTERRUPTED and "Traceback" in done.stderr


@pytest.mark.parametrize("kept", [True, False])
@pytest.mark.parametrize("within", ["load", "solve", "body"])
@pytest.mark.parametrize("number", ENDS, ids=["SIGINT", "SIGTERM"])
@pytest.mark.parametrize("in_time", [False, True], ids=["load", "time"])
def test_one_rank_is_interrupted(in_time, number, within, kept, folder, handlers, monkeypatch):
    """Before a step, within an iteration and in the caller's loop: all ranks end in the same committed state, which is kept."""
    done, sent = [], []

    def at_step_3(place):
        if within == place and len(done) == 2 and not sent:
            sent.append(place)
            send(number)

    def load(at):
        at_step_3("load")

    problem, begin = five_steps(in_time, load)
    solve = problem.system.solve

    def interrupted_solve(*what):
        at_step_3("solve")
        return solve(*what)

    monkeypatch.setattr(problem.system, "solve", interrupted_solve)
    checkpoint = uem.Checkpoint(folder / "run", every=100) if kept else None
    with pytest.raises(ENDS[number]) as end:
        for step in begin(checkpoint):
            done.append(step)
            committed = problem.u.x.array.copy()
            at_step_3("body")
    assert number == signal.SIGINT or end.value.code == 143
    assert {signal.getsignal(n) for n in ENDS} == set(handlers[0].values()) and handlers[1] == []
    assert set(COMM.allgather(len(done))) == {2} and problem.progress.steps == 2
    # not what the iteration had come to
    assert np.array_equal(problem.u.x.array, committed)
    if kept:
        again, begin = five_steps(in_time, nothing)
        assert len(list(begin(uem.Checkpoint(folder / "run")))) == 3
        whole, begin = five_steps(in_time, nothing)
        list(begin(None))
        np.testing.assert_allclose(again.u.x.array, whole.u.x.array, rtol=0, atol=1e-9 * np.abs(whole.u.x.array).max())


def test_once_more(handlers):
    """Ctrl-C after a signal acts at once; SIGTERM twice, as some senders send it, is one."""
    problem, begin = five_steps(False, nothing)
    with pytest.raises(SystemExit):
        for _ in begin(None):
            send(signal.SIGTERM)
            send(signal.SIGTERM)
    steps = begin(None)
    next(steps)
    os.kill(os.getpid(), signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        os.kill(os.getpid(), signal.SIGINT)
        # Python's handlers run between its instructions
        signal.getsignal(signal.SIGINT)
    steps.close()
    assert handlers[1] == []


def test_what_nobody_has_acted_on(handlers):
    """A signal in the last pass of a loop that is left is passed to the previous handler."""
    _, begin = five_steps(False, nothing)
    steps = begin(None)
    next(steps)
    send(signal.SIGTERM, COMM.rank)
    assert handlers[1] == []
    steps.close()
    assert handlers[1] == [signal.SIGTERM]


def test_handlers_of_others(handlers):
    """What is ignored stays ignored, what others install meanwhile stays theirs, and problems may step within each other's steps."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _, begin = five_steps(False, nothing)
    for _ in begin(None):
        assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
    signal.signal(signal.SIGINT, handlers[0][signal.SIGINT])
    outer = begin(None)
    next(outer)
    ours = signal.getsignal(signal.SIGTERM)
    assert ours not in (handlers[0][signal.SIGTERM], signal.SIG_DFL)
    _, begin_other = five_steps(False, nothing)
    for _ in begin_other(None):
        pass
    assert signal.getsignal(signal.SIGTERM) == ours
    for number, handler in handlers[0].items():
        signal.signal(number, handler)
    outer.close()


def test_outside_the_main_thread():
    """Python allows handlers in the main thread only; elsewhere steps run without."""
    found, before = [], signal.getsignal(signal.SIGTERM)
    problem, begin = five_steps(False, nothing)

    def run():
        found.extend(signal.getsignal(signal.SIGTERM) for _ in begin(None))

    thread = threading.Thread(target=run)
    thread.start()
    thread.join()
    assert found == [before] * 5


RUN = """
import time
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from ramp_scenes import COMM, RAMPS
import uem_dolfinx as uem

ramps = RAMPS["ramped"](COMM)
try:
    for step in ramps.steps({checkpoint}):
        print(ramps.problem.progress.steps, flush=True)
        time.sleep(0.2)
finally:
    print("at", ramps.problem.progress.steps, flush=True)
"""


@serial
@pytest.mark.parametrize("number, status", [(signal.SIGINT, -signal.SIGINT), (signal.SIGTERM, 143)], ids=["SIGINT", "SIGTERM"])
@pytest.mark.slow
def test_status(number, status, folder):
    """What a shell sees of a run that was ended, and what is in its checkpoint."""
    process = start_process(RUN.format(checkpoint=f"uem.Checkpoint({str(folder / 'run')!r})"))
    process.stdout.readline()
    process.send_signal(number)
    last = process.stdout.read().split()[-1]
    assert process.wait() == status
    process = start_process(RUN.format(checkpoint=f"uem.Checkpoint({str(folder / 'run')!r})"))
    lines = process.stdout.read().split()
    assert process.wait() == 0 and int(lines[0]) == int(last) + 1 and lines[-1] == "6"
