"""Long runs in time that are stopped, killed and gone on with: the states and the tables of a run that was never stopped.

Two tests to read first: ``test_going_on`` and ``test_killed_in_mid_run``.
"""

from __future__ import annotations

import csv
import os
import signal
import subprocess
import sys
from pathlib import Path

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, box, clamp, highest, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
DT, END, EVERY = 0.01, 0.5, 10


def impact(comm=COMM, scheme=None, plastic=True):
    """A plastic block falls askew onto an elastic one, slides and leaves: problem, contact, stored energy of the elastic part."""
    low = box("quadrilateral", [0.0, 0.0], [2.0, 0.6], [8, 3])
    high = box("quadrilateral", [0.43, 0.7], [1.27, 1.54], [6, 6])
    s = scene(comm, "quadrilateral", [low, high])
    V, S = compat.function_space(s.mesh, 1, (2,)), compat.dg0_space(s.mesh)
    u, velocity = fem.Function(V), fem.Function(V)
    falling = V.tabulate_dof_coordinates()[: len(velocity.x.array) // 2, 1] > 0.65
    velocity.x.array.reshape(-1, 2)[falling] = [0.5, -2.0]
    strength = fem.Function(S)
    above = S.tabulate_dof_coordinates()[: len(strength.x.array), 1] > 0.65
    strength.x.array[:] = np.where(above, 40.0, np.inf) if plastic else np.inf
    law = uem.VonMises(u, 1000.0, 0.3, strength, 200.0, kind="plane_stress", strain="green_lagrange")
    contact = uem.Contact(s.tag("foot", 1, at(1, 0.7)), s.tag("table", 0, at(1, 0.6)))
    dynamics = uem.Dynamics(uem.lumped_mass(V, 1.0), velocity=velocity, gravity=(0.0, -5.0), scheme=scheme)
    problem = uem.UnitedProblem(
        law.residual(ufl.TestFunction(V)), u, bcs=clamp(V, s.tag("base", 0, at(1, 0.0))), contacts=[contact], materials=[law],
        dynamics=dynamics, rtol=1e-10,
    )  # fmt: skip
    return problem, contact, law


def run(folder, name, end, *, comm=COMM, scheme=None, wait=False):
    """Step to the end, going on from a checkpoint if there is one; the problem at the end."""
    problem, contact, law = impact(comm, scheme)
    checkpoint = uem.Checkpoint(folder / f"{name}.uem", every=EVERY)
    checkpoint.begin(problem.state())
    with (
        checkpoint,
        uem.EnergyBook(problem, path=folder / f"{name}_energy.csv", resume=True) as book,
        uem.HistoryWriter(folder / f"{name}.csv", problem, resume=True) as history,
    ):
        for step in uem.time_steps(problem, DT, end, event_tolerance=1e-3, checkpoint=checkpoint):
            book.write(step)
            history.write(step)
            if wait:
                print(step.number, flush=True)
    return problem, contact, law


def table(path):
    """Columns and rows of a CSV file, as text, read alike on all ranks."""
    COMM.barrier()
    with Path(path).open(newline="", encoding="utf-8") as file:
        head, *rows = csv.reader(file)
    return head, rows


def states(problem, law):
    fields = (problem.u, problem.dynamics.velocity, problem.dynamics.acceleration, problem.dynamics.forces, *law.history.values())
    return [np.array(f.x.array) for f in fields]


def gathered(problem):
    """Displacement by place of the node, on every rank."""
    config = problem.config
    parts = config.comm.allgather(np.column_stack([config.X, config.displacement])[: config.n_owned])
    rows = np.concatenate(parts)
    return rows[np.lexsort(np.round(rows[:, :2], 9).T)]


@pytest.mark.parametrize("scheme", [None, uem.generalised_alpha(0.7)])
def test_going_on(scheme, folder):
    """A run stopped in mid-contact, after plastic flow, ends like one that was not: to the last bit where there is one rank."""
    straight, _, law = run(folder, "straight", END, scheme=scheme)
    run(folder, "parted", 0.17, scheme=scheme)
    parted, _, other = run(folder, "parted", END, scheme=scheme)
    assert law.dissipation() > 0.01 and parted.dynamics.number == straight.dynamics.number
    assert parted.dynamics.time == straight.dynamics.time
    for file in ("{}.csv", "{}_energy.csv"):
        (head, rows), (_, others) = (table(folder / file.format(name)) for name in ("straight", "parted"))
        assert len(rows) == len(others) > END / DT
        if COMM.size == 1:
            assert rows == others
        else:
            # iterations and gaps are those of rounding
            told = [i for i, name in enumerate(head) if name not in ("newton_iterations", "max_gap")]
            a, b = (np.array([[float(row[i]) for i in told] for row in r]) for r in (rows, others))
            assert np.allclose(a, b, rtol=1e-7, atol=1e-7 * np.abs(a).max(axis=0)), head
    if COMM.size == 1:
        assert all(np.array_equal(a, b) for a, b in zip(states(straight, law), states(parted, other)))
    else:
        a, b = gathered(straight), gathered(parted)
        assert np.abs(a - b).max() < 1e-9 * np.abs(a).max()


def test_going_on_with_other_ranks(folder):
    """Written by one rank, read by all; every rank goes on with a mesh parted anew."""
    if COMM.rank == 0:
        run(folder, "run", 0.2, comm=MPI.COMM_SELF)
    COMM.barrier()
    (problem, _, law), (alone, _, its_law) = run(folder, "run", 0.35), impact(MPI.COMM_SELF)
    for _ in uem.time_steps(alone, DT, 0.35, event_tolerance=1e-3):
        pass
    a, b = gathered(alone), gathered(problem)
    assert np.abs(a - b).max() < 1e-9 * np.abs(a).max()
    assert np.isclose(law.dissipation(), its_law.dissipation(), rtol=1e-8) and its_law.dissipation() > 0.01


def test_balance_of_the_whole():
    """Energy of an impact with plastic flow, sliding and gravity: what is missing was dissipated."""
    problem, contact, law = impact()
    book = uem.EnergyBook(problem)
    pressed = 0.0
    for step in uem.time_steps(problem, 0.0025, 0.3):
        row = book.write(step)
        pressed = max(pressed, contact.resultant().force[1])
    assert pressed > 5.0 and row.dissipated > 0.05 * book.rows[0].kinetic
    assert abs(row.defect) < 1e-2 * book.rows[0].kinetic
    assert abs(row.contact) < 2e-2 * book.rows[0].kinetic


def test_checkpoint_of_another_run(folder):
    """Without plastic flow there is the same state; another scheme of time is the script's; another mesh or statics is refused."""
    run(folder, "run", 0.05)
    problem, _, _ = impact()
    static = uem.UnitedProblem(
        uem.LinearElastic(1.0, 0.3, kind="plane_stress").residual(problem.u, ufl.TestFunction(problem.config.V)) * ufl.dx, problem.u,
        bcs=problem.system.bcs,
    )  # fmt: skip
    with pytest.raises(uem.CheckpointError, match="run.uem"):
        uem.Checkpoint(folder / "run.uem").begin(static.state())


RUN = """
import sys
sys.path.insert(0, {tests!r})
from pathlib import Path
from test_long_runs import run
run(Path({folder!r}), "run", {end}, wait=True)
"""


@pytest.mark.skipif(COMM.size > 1, reason="starts processes of its own")
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGTERM])
def test_killed_in_mid_run(how, folder):
    """A run that is killed loses no more than the last interval, and ends like one that was not."""
    script = RUN.format(tests=str(Path(__file__).parent), folder=str(folder), end=END)
    environment = dict(os.environ, PYTHONPATH=os.pathsep.join([str(Path(uem.__file__).parents[1]), *sys.path]))
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE, text=True, env=environment)
    assert process.stdout is not None
    last = 0
    for line in process.stdout:
        last = int(line)
        if last >= 2 * EVERY + 3:
            process.send_signal(how)
            break
    assert process.wait(60) == (-signal.SIGKILL if how == signal.SIGKILL else 143)
    begun, _, _ = impact()
    assert uem.Checkpoint(folder / "run.uem").begin(begun.state())
    assert begun.dynamics.number >= (last // EVERY) * EVERY
    problem, _, law = run(folder, "run", END)
    straight, _, its_law = run(folder, "straight", END)
    assert all(np.array_equal(a, b) for a, b in zip(states(problem, law), states(straight, its_law)))
    assert table(folder / "run_energy.csv") == table(folder / "straight_energy.csv")
    assert highest(COMM, [problem.dynamics.time]) == END
