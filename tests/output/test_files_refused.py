"""Results that cannot be written: the same named error on all ranks, and the steps before stay whole.

Read ``test_full_disk`` and ``test_folder_that_cannot_be_made`` first.
"""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path

from mpi4py import MPI

import pytest
from helpers import raised
from resting_scenes import Bar
from results_scenes import pressed, rows, series, small_disk, strains

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.files import OwnFile
from uem_dolfinx.parallel import agreed

COMM = MPI.COMM_WORLD


@pytest.fixture(autouse=True)
def without_vtx(monkeypatch):
    """ADIOS2 has its own ways to fail, and its files are not continued."""
    monkeypatch.setattr(compat, "has_vtx", lambda: False)


def picture(path):
    pytest.importorskip("matplotlib")
    with uem.figure(path, COMM):
        pass


@contextmanager
def filled_disk(folder, size, left):
    """A disk of so many bytes at the folder, of which so many are left."""
    with small_disk(COMM, folder, size) as permitted:
        if not permitted:
            pytest.skip("this system does not permit to mount a disk")
        if COMM.rank == 0:
            (folder / "filler").write_bytes(b"x" * (size - left))
        COMM.barrier()
        yield


MAKERS = {
    "results": lambda path: uem.ResultsWriter(path, pressed(COMM, "triangle")),
    "results resumed": lambda path: uem.ResultsWriter(path, pressed(COMM, "triangle"), resume=True),
    "history": lambda path: uem.HistoryWriter(path.with_suffix(".csv"), pressed(COMM, "triangle")),
    "energy": lambda path: uem.EnergyBook(Bar((0.0, -3.0)).problem, path=path.with_suffix(".csv")),
    "figure": lambda path: picture(path.with_suffix(".png")),
    "scene": lambda path: uem.plot_scene(pressed(COMM, "triangle"), path.with_suffix(".png")),
    "pressure": lambda path: uem.plot_pressure(pressed(COMM, "triangle").contacts, path.with_suffix(".png")),
}


@pytest.mark.parametrize("what", MAKERS)
def test_folder_that_cannot_be_made(what, folder):
    """A file stands where the folder should be."""
    if COMM.rank == 0:
        (folder / "out").write_text("in the way")
    COMM.barrier()
    raised(
        uem.OutputError, "out.*cannot be written .*: check the folder, its rights", lambda: MAKERS[what](folder / "out" / "run")
    )
    raised(OSError, "out", lambda: MAKERS[what](folder / "out" / "deeper" / "run"))


@pytest.mark.parametrize("ending", [".xdmf", ".bin", ".csv"])
def test_folder_where_a_file_should_be(ending, folder):
    if COMM.rank == 0:
        (folder / f"run{ending}").mkdir()
    COMM.barrier()
    raised(uem.OutputError, "run.*cannot be written", lambda: MAKERS["results"](folder / "run"))


@pytest.mark.parametrize("rank", sorted({0, COMM.size - 1}))
def test_numbers_that_one_rank_cannot_write(rank, folder, monkeypatch):
    """All ranks raise at the same step, and once there is space again the series continues without a hole."""
    problem = pressed(COMM, "quadrilateral")
    writer = uem.ResultsWriter(folder / "run", problem, fields=strains(problem))
    writer.write(0.0)

    def full(self, offset, array):
        raise OSError("no space left")

    with monkeypatch.context() as patch:
        if COMM.rank == rank:
            patch.setattr(OwnFile, "write_at", full)
        raised(uem.OutputError, "run.xdmf cannot be written .no space left.", lambda: writer.write(1.0))
    writer.write(2.0)
    writer.close()
    COMM.barrier()
    assert [t for t, _ in series(folder / "run.xdmf")] == [0.0, 2.0]
    assert [float(row["factor"]) for row in rows(folder / "run.csv")] == [0.0, 2.0]


@pytest.mark.parametrize("kilobytes", [0, 4, 12, 16, 24, 40])
def test_full_disk(kilobytes, folder):
    """Wherever the disk becomes full - in numbers, XDMF or CSV, or at the very beginning."""
    with filled_disk(folder, 2**20, 1024 * kilobytes):
        problem, written = pressed(COMM, "triangle"), []

        def run():
            writer = uem.ResultsWriter(folder / "run", problem)
            while True:
                writer.write(float(len(written)))
                written.append(len(written))

        raised(uem.OutputError, "run.* cannot be written .*: check the folder, its rights and its free space", run)
        assert len(set(COMM.allgather(len(written)))) == 1 and (len(written) > 0) == (kilobytes > 4)
        if written:
            COMM.barrier()
            # a step is in the fields before it is in the history
            assert [t for t, _ in series(folder / "run.xdmf")][: len(written)] == written
            assert [float(row["factor"]) for row in rows(folder / "run.csv")] == written


@pytest.mark.parametrize("resume", [False, True])
def test_full_disk_under_a_table(resume, folder):
    """What is written of a row that does not fit is taken back; with space the next row follows the last whole one."""
    with filled_disk(folder, 2**16, 2**12):
        history, written = uem.HistoryWriter(folder / "run.csv", pressed(COMM, "triangle"), resume=resume), []

        def run():
            while True:
                history.write(float(len(written)))
                written.append(float(len(written)))

        raised(uem.OutputError, "run.csv cannot be written .*[Nn]o space left", run)
        if COMM.rank == 0:
            (folder / "filler").unlink()
        COMM.barrier()
        history.write(-1.0)
        history.close()
        COMM.barrier()
        assert len(written) > 10 and [float(row["factor"]) for row in rows(folder / "run.csv")] == [*written, -1.0]


def test_drawing_that_fails(folder):
    """What rank 0 alone draws, and what users hand it, fails on all ranks alike."""
    pytest.importorskip("matplotlib")
    problem = pressed(COMM, "triangle")
    raised(uem.InputError, "no such colours", lambda: uem.plot_scene(problem, folder / "a.png", cmap="no such colours"))

    def curve(s):
        raise ZeroDivisionError("no such curve")

    raised(uem.UserFunctionError, "no such curve", lambda: uem.plot_pressure(problem.contacts, folder / "b.png", reference=curve))
    with uem.figure(folder / "c.png", COMM) as (panel,):
        raised(uem.UserFunctionError, "no such curve", lambda: uem.plot_pressure(problem.contacts, panel, reference=curve))


class Unsendable(Exception):
    def __init__(self, one, two):
        super().__init__(f"{one} {two}")


@pytest.mark.parametrize("error", [KeyError("a"), Unsendable(1, 2)], ids=["sent", "reported"])
def test_agreed(error):
    """What one rank raises in a block is raised on all at its end, by its words where it cannot be sent."""
    kind = RuntimeError if isinstance(error, Unsendable) and COMM.size > 1 else type(error)
    with pytest.raises(kind) as caught, agreed(COMM):
        if COMM.rank == COMM.size - 1:
            raise error
    assert len(set(COMM.allgather(str(caught.value)))) == 1


def test_name_with_marks(folder: Path):
    """Names of files and fields that XML writes otherwise."""
    problem = pressed(COMM, "triangle")
    with uem.ResultsWriter(folder / 'a & "b" <c>', problem, fields={"x<y&z": problem.u[0]}) as writer:
        writer.write(1.0)
    COMM.barrier()
    ((time, fields),) = series(folder / 'a & "b" <c>.xdmf')
    assert time == 1.0 and "x<y&z" in fields
