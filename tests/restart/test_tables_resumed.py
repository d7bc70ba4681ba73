"""Tables that continue with a run: what is made before the checkpoint is read refuses its first row."""

from __future__ import annotations

import pytest
from restart_scenes import Killed
from resting_scenes import COMM, Bar

import uem_dolfinx as uem

# ---------------------------------------------------------------------------------------------- tables


@pytest.mark.parametrize("kind", ["energy", "history"])
def test_table_made_before_the_checkpoint_is_read(kind, folder):
    """It refuses the first row and leaves the file alone; made after the checkpoint was read it continues."""

    def run(end, early):
        bar, checkpoint = Bar((0.0, -3.0)), Killed(folder / "run", every=2)
        if not early:
            checkpoint.begin(bar.problem.state())
        path = folder / "table.csv"
        if kind == "energy":
            table = uem.EnergyBook(bar.problem, path=path, resume=True)
        else:
            table = uem.HistoryWriter(path, bar.problem, resume=True)
        with table:
            for step in uem.time_steps(bar.problem, 0.01, end, checkpoint=checkpoint):
                table.write(step)
        COMM.barrier()

    def text():
        COMM.barrier()
        return (folder / "table.csv").read_text().splitlines()

    run(0.04, early=True)
    before = text()
    assert len(before) == 5 + (kind == "energy")
    with pytest.raises(uem.CheckpointError, match="table.csv with resume=True was opened before the checkpoint was read"):
        run(0.06, early=True)
    assert text() == before
    run(0.06, early=False)
    after = text()
    assert after[: len(before)] == before and len(after) == len(before) + 2


def test_damping_continues(folder):
    """The energy that damping takes is the same bit for bit in a run that is taken up again."""

    def run(name, *ends):
        for end in ends:
            bar, checkpoint = Bar((0.0, -3.0), eta=20.0), uem.Checkpoint(folder / name)
            checkpoint.begin(bar.problem.state())
            with uem.EnergyBook(bar.problem, path=folder / f"{name}.csv", resume=True) as book:
                for step in uem.time_steps(bar.problem, 0.01, end, checkpoint=checkpoint):
                    damped = book.write(step).damped
        COMM.barrier()
        return damped, (folder / f"{name}.csv").read_text()

    (damped, whole), (_, parted) = run("whole", 0.06), run("parted", 0.03, 0.06)
    assert damped > 0.0 and whole == parted
