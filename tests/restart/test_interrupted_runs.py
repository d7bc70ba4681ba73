"""Long runs: what is interrupted and continued from a checkpoint ends as if it had not been, tables included, and what is refused.

Two tests to read first: ``test_interrupted_is_uninterrupted`` (an elastic-plastic impact, bit for bit in serial) and
``test_killed`` (kill -9 in mid-run).
"""

from __future__ import annotations

import atexit
import csv
import functools
import shutil
import signal
import tempfile
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import raised, serial, start_process
from restart_scenes import DT, END, SIZE, Impact

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.output.tables import CsvTable

COMM = MPI.COMM_WORLD


def table(path):
    """Rows of a CSV file as they are written."""
    with Path(path).open(newline="") as file:
        return list(csv.reader(file))


def numbers(path):
    """The table as numbers, without its head."""
    return np.array([[float(v) for v in row] for row in table(path)[1:]])


def same_tables(one, other, bound=1e-9):
    """Row by row the same numbers, relative to the largest of their column; gaps, which are zero, to the bodies' size."""
    for name in ("energy.csv", "history.csv"):
        head, a, b = table(one / name)[0], numbers(one / name), numbers(other / name)
        assert head == table(other / name)[0] and a.shape == b.shape
        scale = np.where([column.startswith("max_gap") for column in head], SIZE, np.abs(a).max(axis=0))
        assert np.all(np.abs(a - b) <= bound * scale), (name, dict(zip(head, np.abs(a - b).max(axis=0))))


def same_runs(one, other):
    """Two folders tell the same run: tables to 1e-9, and in serial tables and checkpoint byte by byte."""
    COMM.barrier()
    same_tables(one, other)
    for name in ("energy.csv", "history.csv", "run") if COMM.size == 1 else ():
        assert (one / name).read_bytes() == (other / name).read_bytes(), name


def close(a, b):
    """End states of two runs to 1e-9, gathered in the order of the drawing."""
    for f in (lambda i: i.u, lambda i: i.problem.dynamics.velocity):
        x, y = a.s.gather(f(a)), b.s.gather(f(b))
        assert np.abs(x - y).max() <= 1e-9 * np.abs(x).max()
    x, y = (i.law.dissipation() for i in (a, b))
    assert x > 0.0 and abs(x - y) <= 1e-9 * x


@functools.cache
def uninterrupted(rho=None):
    """A run left alone: the impact, its steps and its folder (collective)."""
    folder = Path(COMM.bcast(tempfile.mkdtemp() if COMM.rank == 0 else None))
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    impact = Impact(scheme=None if rho is None else uem.generalised_alpha(rho))
    return impact, impact.run(folder), folder


# -- going on --------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("rho", [None, 0.6])
@pytest.mark.slow
def test_interrupted_is_uninterrupted(rho, folder):
    """Left twice in mid-run, in flight before the touch and in contact after steps that were cut, and continued each time."""
    scheme = None if rho is None else uem.generalised_alpha(rho)
    whole, steps, alone = uninterrupted(rho)
    assert any(s.touched for s in steps) and sum(s.cuts for s in steps) > 0 and len({s.dt for s in steps}) > 3
    assert whole.contact.n_active > 0 and whole.book.rows[-1].dissipated > 0.05
    done = []
    for every, stop in ((2, 5), (4, 9)):
        done += Impact(scheme=scheme).run(folder, every=every, stop=stop)
    assert sum(s.cuts for s in done) > 0
    last = Impact(scheme=scheme)
    end = last.run(folder, every=3)
    assert end[0].number == 9 and len(end) == len(steps) - 8
    for a, b in zip(steps[8:], end):
        assert (a.number, a.cuts, a.touched, a.left, a.newton_iterations) == (
            b.number,
            b.cuts,
            b.touched,
            b.left,
            b.newton_iterations,
        )
        assert abs(a.time - b.time) <= 1e-9 * END and (COMM.size > 1 or a.time == b.time)
    same_runs(alone, folder)
    close(whole, last)


@pytest.mark.slow
def test_a_later_end(folder):
    """A run that has come to its end continues if the end is later, as if that had been the end from the beginning."""
    Impact().run(folder, end=0.12)
    assert Impact().run(folder, end=0.12) == []
    Impact().run(folder)
    # half a step ends at the end, or at the multiple of dt that is the same but for rounding
    COMM.barrier()
    same_tables(uninterrupted()[2], folder)


@pytest.mark.long
@pytest.mark.parametrize("writer, reader", [(MPI.COMM_SELF, COMM), (COMM, MPI.COMM_SELF)], ids=["one to all", "all to one"])
def test_ranks_change(writer, reader, folder):
    """Written by one rank and read by all, and the reverse: velocities and plastic history find their places."""
    whole, _, alone = uninterrupted()
    mine = folder / ("first" if writer is COMM else f"first {COMM.rank}")
    first = Impact(writer)
    first.run(mine, every=8, stop=9)
    COMM.barrier()
    source = mine if writer is COMM else folder / "first 0"
    # each reader that is alone has a folder of its own
    target = folder / "second" if reader is COMM else folder / f"second {COMM.rank}"
    if reader is MPI.COMM_SELF or COMM.rank == 0:
        target.mkdir()
        for name in ("run", "energy.csv", "history.csv"):
            (target / name).write_bytes((source / name).read_bytes())
    COMM.barrier()
    last = Impact(reader)
    assert last.run(target)[0].number == 9
    COMM.barrier()
    same_tables(alone, target)
    x, y = whole.s.gather(whole.u), last.s.gather(last.u)
    assert np.abs(x - y).max() <= 1e-9 * np.abs(x).max()


@pytest.mark.long
@pytest.mark.parametrize(
    "other, match",
    [
        ({"dynamic": False}, "for function 'load start' expected Lagrange 1.*, found nothing"),
        (
            {"kind": "plane_stress"},
            "for function 'plastic_strain 1' expected Quadrature 2, 3 components .* found Quadrature 2, 4",
        ),
    ],
)
def test_checkpoint_of_another_problem(other, match, folder):
    """Statics and another kind of material do not continue from the file, and the problem stays as it was."""
    Impact(moving=False).run(folder, end=0.04)
    wrong = Impact(moving=False, **other)
    checkpoint = uem.Checkpoint(folder / "run")

    def go_on():
        if wrong.problem.dynamics is None:
            checkpoint.begin(wrong.problem.state())
        else:
            uem.time_steps(wrong.problem, DT, END, checkpoint=checkpoint)

    raised(uem.CheckpointError, match, go_on)
    assert not wrong.u.x.array.any()


def test_checkpoint_of_statics(folder):
    """Time steps do not continue from a static problem's file."""
    static = Impact(dynamic=False)
    uem.write_checkpoint(folder / "run", static.problem.state())
    wrong = Impact()
    with pytest.raises(uem.CheckpointError, match="for function 'velocity' expected Lagrange 1.*found nothing"):
        uem.time_steps(wrong.problem, DT, END, checkpoint=uem.Checkpoint(folder / "run"))


RUN = """
from restart_scenes import DT, END, TOLERANCE, Impact
import uem_dolfinx as uem

impact = Impact()
with uem.Checkpoint({path!r}, every={every}) as checkpoint:
    for step in uem.time_steps(impact.problem, DT, END, event_tolerance=TOLERANCE, checkpoint=checkpoint):
        print(step.number, flush=True)
"""


def start(path, every):
    """A process that runs until it is done or killed."""
    return start_process(RUN.format(path=str(path), every=every))


@serial
@pytest.mark.slow
def test_killed(folder):
    """kill -9 in mid-run, twice: no more than the interval is lost, and the run ends in the very state of one that was left alone."""
    _, steps, alone = uninterrupted()
    path, last, n = folder / "run", 0, len(steps)
    for count in (4, 4):
        process = start(path, 3)
        lines = [int(process.stdout.readline()) for _ in range(count)]
        process.kill()
        lines += [int(line) for line in process.stdout.read().split()]
        assert process.wait() == -signal.SIGKILL
        assert lines[0] == last + 1
        there = Impact()
        uem.read_checkpoint(path, there.problem.state())
        last = there.problem.step_control.number
        assert lines[-1] - 3 <= last <= lines[-1] < n
    process = start(path, 3)
    lines = [int(line) for line in process.stdout.read().split()]
    assert process.wait() == 0 and lines[0] == last + 1 and lines[-1] == n
    assert path.read_bytes() == (alone / "run").read_bytes()


@serial
@pytest.mark.slow
def test_terminated(folder):
    """SIGTERM in mid-run: the step is finished and written, the status is 143, and the run continues to the same end."""
    _, steps, alone = uninterrupted()
    path, n = folder / "run", len(steps)
    process = start(path, 10**6)
    for _ in range(4):
        process.stdout.readline()
    process.send_signal(signal.SIGTERM)
    lines = [4, *map(int, process.stdout.read().split())]
    assert process.wait() == 143
    there = Impact()
    uem.read_checkpoint(path, there.problem.state())
    # the signal may come between a step's end and its print
    assert lines[-1] <= there.problem.step_control.number <= lines[-1] + 1 < n
    process = start(path, 10**6)
    assert int(process.stdout.read().split()[-1]) == n and process.wait() == 0
    assert path.read_bytes() == (alone / "run").read_bytes()


# -- what is refused, and what stays after errors ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    "dt, end, match",
    [
        (np.nan, 1.0, "dt = nan.*expected a positive number"),
        (np.inf, 1.0, "dt = inf.*expected a positive number"),
        (0.1, np.nan, "end = nan: expected a time that is not before the start, 3"),
        (0.1, np.inf, "end = inf"),
        (0.1, 2.9, "end = 2.9: expected a time that is not before the start, 3"),
        (1e-14, 3.1, "dt = 1e-14: below the rounding error of the times from 3 to 3.1"),
    ],
)
def test_times_that_are_none(dt, end, match):
    """Refused before anything is done, on all ranks."""
    impact = Impact(time=3.0)
    with pytest.raises(ValueError, match=match):
        uem.time_steps(impact.problem, dt, end)
    with pytest.raises(ValueError, match="time = nan"):
        Impact(time=np.nan)


def test_times_far_from_zero():
    """Steps of a millionth of the time still end at its multiples, without a last step that is rounding alone."""
    impact = Impact(time=1e5, moving=False)
    impact.problem.load = None
    steps = list(uem.time_steps(impact.problem, 0.01, 1e5 + 0.1))
    assert len(steps) == 10 and steps[-1].time == 1e5 + 0.1 and {s.dt for s in steps[:-1]} == {0.01}


def test_errors_leave_the_last_step(monkeypatch):
    """After a step that fails for good, and after a load that raises, forces are those of the last step, and it continues from it."""
    impact = Impact(moving=False)
    list(uem.time_steps(impact.problem, DT, 0.04))
    problem, bodies = impact.problem, impact.problem.bodies

    def residual():
        bodies.assemble()
        return bodies.residual.array_r.copy()

    before, u = residual(), impact.u.x.array.copy()

    def fail(*how, **more):
        raise uem.ConflictError("two conditions disagree")

    def no_load(t):
        impact.load(t)
        if t > 0.041:
            raise RuntimeError("no load")

    with monkeypatch.context() as patch, pytest.raises(uem.ConflictError):
        patch.setattr(problem, "attempt", fail)
        next(uem.time_steps(problem, DT, END))
    assert np.array_equal(residual(), before) and np.isclose(impact.push.value, 0.24)
    problem.load = no_load
    with pytest.raises(RuntimeError, match="no load"):
        next(uem.time_steps(problem, DT, END))
    impact.load(0.04)
    assert np.array_equal(residual(), before) and np.array_equal(impact.u.x.array, u)
    problem.load = impact.load
    step = next(uem.time_steps(problem, DT, END))
    assert step.number == 3 and np.isclose(step.time, 0.06, rtol=1e-14)


@pytest.mark.parametrize("resume", [False, True])
def test_table_that_cannot_be_written(resume, folder):
    """A file stands where the folder should be, or a folder where the file should: the same error on all ranks."""
    if COMM.rank == 0:
        (folder / "out").write_text("in the way")
        (folder / "energy.csv").mkdir()
    COMM.barrier()
    impact = Impact(moving=False)
    for path in (folder / "out" / "energy.csv", folder / "energy.csv"):
        with pytest.raises(OSError, match="out|energy.csv"):
            uem.EnergyBook(impact.problem, path=path, resume=resume)


def test_tables_go_on(folder, caplog):
    """Half a row goes, what is later goes, another table is refused and stays, and a warning names a hole."""

    def create(columns, at):
        return CsvTable(folder / "t.csv", COMM, columns, at)

    with create(["time", "x"], None) as t:
        for k in range(4):
            t.write([0.1 * k, 1.0 / 3 + k])
    COMM.barrier()
    if COMM.rank == 0:
        with (folder / "t.csv").open("a", newline="") as file:
            file.write("0.35,4.3")
    COMM.barrier()
    with create(["time", "x"], 10.0) as t:
        assert t.first == {"time": 0.0, "x": 1 / 3} and t.last == {"time": 0.1 * 3, "x": 1 / 3 + 3}
    with create(["time", "x"], 0.1) as t:
        assert t.last == {"time": 0.1, "x": 1 / 3 + 1}
        t.write([0.2, 7.0])
    COMM.barrier()
    assert table(folder / "t.csv") == [["time", "x"], ["0.0", repr(1 / 3)], ["0.1", repr(1 / 3 + 1)], ["0.2", "7.0"]]
    with pytest.raises(uem.CheckpointError, match="t.csv belongs to another run: expected the columns time, y, found time,x"):
        create(["time", "y"], 0.2)
    with pytest.raises(ValueError, match="t.csv is closed"):
        t.write([0.3, 8.0])
    assert len(table(folder / "t.csv")) == 4
    COMM.barrier()
    if COMM.rank == 0:
        with (folder / "t.csv").open("a", newline="") as file:
            file.write("soon,4.3\r\n")
    COMM.barrier()
    with pytest.raises(ValueError, match="soon"):
        create(["time", "x"], 10.0)
    impact = Impact(moving=False)
    uem.EnergyBook(impact.problem, path=folder / "e.csv").close()
    list(uem.time_steps(impact.problem, DT, 0.02))
    COMM.barrier()
    uem.EnergyBook(impact.problem, path=folder / "e.csv", resume=True).close()
    assert COMM.rank > 0 or "e.csv ends at time 0 and is gone on with at 0.02" in caplog.text


def test_what_dynamics_refuse():
    """A load that is not finite, the dynamics of another problem, and a velocity that is another space's on one rank alone."""
    impact = Impact(moving=False)
    impact.problem.load = lambda t: setattr(impact.push, "value", np.nan)
    with pytest.raises(uem.NotFiniteError, match="forces at the start, time 0, contain NaN"):
        next(uem.time_steps(impact.problem, DT, END))
    F = uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(impact.u, ufl.TestFunction(impact.V)) * ufl.dx
    with pytest.raises(uem.SpaceError, match="dynamics belong to another problem"):
        uem.UnitedProblem(F, impact.u, dynamics=impact.problem.dynamics)
    # one rank has a Function of the right size by chance
    lone = fem.Function(compat.function_space(Impact(MPI.COMM_SELF).s.mesh, 2, (2,)))
    fits = fem.Function(impact.V)
    velocity = fits if COMM.rank == 0 and COMM.size > 1 else lone
    with pytest.raises(uem.SpaceError, match="velocity belongs to another space"):
        uem.UnitedProblem(F, impact.u, dynamics=uem.Dynamics(uem.lumped_mass(impact.V, 1.0), velocity=velocity))
