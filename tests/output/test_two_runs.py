"""Two runs with one name for their results: each keeps all of its own, or is refused by name; nothing is lost, mixed or overwritten.

Read ``test_both_keep_all_of_their_own`` first.
"""

from __future__ import annotations

import os
import subprocess
import sys
import textwrap
from pathlib import Path

from mpi4py import MPI

import pytest
from helpers import raised
from results_scenes import pressed, rows, series

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.output.tables import CsvTable

COMM = MPI.COMM_WORLD


@pytest.fixture(autouse=True)
def without_vtx(monkeypatch):
    """ADIOS2 has files of its own."""
    monkeypatch.setattr(compat, "has_vtx", lambda: False)


def holds(path: Path, times: list[float]) -> None:
    """Results that are whole: these times in the table and in the fields, in files that can be parsed."""
    COMM.barrier()
    assert [float(row["factor"]) for row in rows(path.with_suffix(".csv"))] == times
    found = series(path.with_suffix(".xdmf"))
    assert [t for t, _ in found] == times
    # each step has the displacement of its own
    assert [round(-fields["displacement"][:, 1].min(), 12) for _, fields in found] == pytest.approx([0.1 * t for t in times])


@pytest.mark.parametrize("before", [0, 1, 2])
def test_both_keep_all_of_their_own(before, folder, caplog):
    """A second run begins before the first has written anything, or after some steps; both write on, by turns, to their own ends."""
    path, writers, written, steps = folder / "run", [], [[], []], [iter(()), iter(())]

    def step(k: int) -> None:
        found = next(steps[k])
        writers[k].write(found)
        written[k].append(found.factor)

    for k in range(2):
        problem = pressed(COMM, "quadrilateral")
        writers.append(uem.ResultsWriter(path, problem))
        steps[k] = uem.load_steps(problem, 4)
        for _ in range(before):
            step(k)
    assert COMM.rank or any(
        "results of another run, which still writes them, are kept in" in r.getMessage() for r in caplog.records
    )
    for k in (0, 1, 0, 1)[: 4 if before < 2 else 2]:
        step(k)
    for writer in writers:
        writer.close()
    holds(folder / "run.1" / "run", written[0])
    holds(path, written[1])
    COMM.barrier()
    assert sorted(f.name for f in folder.iterdir()) == ["run.1", "run.bin", "run.csv", "run.xdmf"]


def test_going_on_with_what_another_run_writes(folder):
    """It is refused by name while the other is at work, and possible once it has closed its files."""
    problem = pressed(COMM, "triangle")
    first = uem.ResultsWriter(folder / "run", problem)
    for step in uem.load_steps(problem, 2):
        first.write(step)
    words = "run.csv is being written by another run, or by a writer that was not closed: let it end, or choose another name"
    raised(uem.OutputError, words, lambda: uem.ResultsWriter(folder / "run", problem, resume=True))
    first.write(2.0)
    first.close()
    with uem.ResultsWriter(folder / "run", problem, resume=True):
        pass
    COMM.barrier()
    assert [float(row["factor"]) for row in rows(folder / "run.csv")] == [0.5, 1.0, 2.0]


@pytest.mark.parametrize("what", ["removed", "replaced", "longer"])
def test_files_that_others_change(what, folder):
    """A table that has been removed, replaced or written to by others is not written over, and nothing gets lost unseen."""
    table = CsvTable(folder / "run.csv", COMM, ["time", "a"])
    table.write([0.0, 1.0])
    if COMM.rank == 0:
        if what == "longer":
            with (folder / "run.csv").open("a") as file:
                file.write("note\n")
        else:
            (folder / "run.csv").unlink()
            if what == "replaced":
                (folder / "run.csv").write_text("another\n")
    COMM.barrier()
    words = "has been changed, from 17 to 22 bytes" if what == "longer" else "has been removed or replaced"
    raised(uem.OutputError, f"run.csv {words}.* since this run wrote to it last", lambda: table.write([1.0, 2.0]))


RUN = """
import sys, time
from pathlib import Path
sys.path[:0] = {paths!r}
from mpi4py import MPI
from results_scenes import pressed
import uem_dolfinx as uem
problem, here = pressed(MPI.COMM_WORLD, "quadrilateral"), Path({folder!r})
with uem.ResultsWriter(here / "run", problem, vtx=False, resume={resume}) as writer:
    for step in uem.load_steps(problem, 4):
        writer.write(step)
        (here / "begun").touch()
        while step.number == 2 and not (here / "go on").exists():
            time.sleep(0.01)
"""


@pytest.mark.long
@pytest.mark.skipif(COMM.size > 1, reason="starts processes of its own")
@pytest.mark.parametrize("killed", [pytest.param(False, marks=pytest.mark.slow), True])
def test_two_processes(killed, folder):
    """The first process writes on in the folder that its files were moved to; one that was killed holds nothing back."""
    code = textwrap.dedent(RUN).format(paths=sys.path, folder=str(folder), resume=False)
    alone = {k: v for k, v in os.environ.items() if not k.startswith(("OMPI_", "PMIX_", "PMI_"))}
    first = subprocess.Popen([sys.executable, "-c", code], env=alone)
    try:
        # a head and two rows, each written whole
        while not (folder / "run.csv").exists() or (folder / "run.csv").read_text().count("\n") < 3:
            assert first.poll() is None
        problem = pressed(COMM, "quadrilateral")
        if killed:
            first.kill()
            first.wait()
            uem.ResultsWriter(folder / "run", problem, resume=True).close()
        else:
            raised(
                uem.OutputError, "is being written by another", lambda: uem.ResultsWriter(folder / "run", problem, resume=True)
            )
        with uem.ResultsWriter(folder / "run", problem) as writer:
            for step in uem.load_steps(problem, 2):
                writer.write(step)
            (folder / "go on").touch()
            assert first.wait(60) == (-9 if killed else 0)
    finally:
        first.kill()
        first.wait()
    holds(folder / "run", [0.5, 1.0])
    holds(folder / "run.1" / "run", [0.25, 0.5] if killed else [0.25, 0.5, 0.75, 1.0])
