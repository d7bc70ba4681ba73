"""Results that continue, and results of another run, which are kept aside or refused: nothing is overwritten.

Read ``test_same_on_every_number_of_ranks`` and ``test_results_of_earlier_runs_are_kept`` first. That a killed run continues with its
results is tested with its load steps in ``restart/test_load_steps_resumed.py``.
"""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import helpers
import numpy as np
import pytest
from dolfinx import fem, mesh
from helpers import raised
from ramp_scenes import RAMPS
from restart_scenes import Killed
from resting_scenes import Bar
from results_scenes import pressed, rows, same_series, series, strains

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.output.xdmf import XdmfSeries

COMM = MPI.COMM_WORLD


@pytest.fixture(autouse=True)
def without_vtx(monkeypatch):
    """ADIOS2 has its own ways to fail, and its files are not continued."""
    monkeypatch.setattr(compat, "has_vtx", lambda: False)


def write(problem, path, times, **how):
    """Write the present state at some times."""
    with uem.ResultsWriter(path, problem, **how) as writer:
        for time in times:
            writer.write(time)
    COMM.barrier()


def contents(folder):
    """All files below a folder."""
    COMM.barrier()
    return {str(f.relative_to(folder)): f.read_bytes() for f in sorted(folder.rglob("*")) if f.is_file()}


@pytest.mark.long
@pytest.mark.parametrize("cell, degree", [("triangle", 2), ("quadrilateral", 1), ("tetrahedron", 1), ("hexahedron", 1)])
def test_same_on_every_number_of_ranks(cell, degree, folder):
    """One rank alone and all together write the same text, mesh and values; the mesh is the one that was read."""
    for comm, name in ((COMM, "all"), (MPI.COMM_SELF, f"one{COMM.rank}")):
        problem = pressed(comm, cell, degree, shuffle=5)
        with uem.ResultsWriter(folder / name / "run", problem, fields=strains(problem)) as writer:
            for step in uem.load_steps(problem, 2):
                writer.write(step)
    COMM.barrier()
    same_series(folder / "all" / "run.xdmf", folder / "one0" / "run.xdmf")
    assert (folder / "all" / "run.xdmf").read_bytes() == (folder / "one0" / "run.xdmf").read_bytes()
    (_, half), (_, fields) = series(folder / "all" / "run.xdmf")
    x, cells, g = fields["geometry"], fields["topology"], problem.config.gdim
    assert sum(volume(x[c]) for c in cells) == pytest.approx(2.0) and len(cells) == fields["trace"].shape[0]
    # u is linear in each body, but for what the nodes at the edges of contact do
    high = x[:, g - 1] == x[:, g - 1].max()
    np.testing.assert_allclose(fields["displacement"][high, g - 1], -0.1, rtol=1e-12)
    np.testing.assert_allclose(half["displacement"][high, g - 1], -0.05, rtol=1e-12)
    assert fields["strain"].shape[1] == 9 and fields["slope"].shape[1] == 3 and (fields["active"] > 0).any()
    np.testing.assert_allclose(fields["strain"][:, [0, 4, 8]].sum(axis=1), fields["trace"][:, 0], atol=1e-14)


@pytest.mark.parametrize("cell,degree", [("quadrilateral", 2), ("tetrahedron", 1)])
def test_gone_on_with_on_another_number_of_ranks(cell, degree, folder):
    """One rank begins, all continue; coordinates that no binary fraction is equal to are those of the input on both."""

    def run(comm, steps):
        domain = (mesh.create_rectangle if cell == "quadrilateral" else mesh.create_box)(
            comm, np.array([[-1.1, -1.7, -0.3], [1.3, 0.0, 0.4]])[:, : 2 if cell == "quadrilateral" else 3],
            (5, 4, 3)[: 2 if cell == "quadrilateral" else 3], getattr(mesh.CellType, cell),
        )  # fmt: skip
        g = domain.geometry.dim
        V = uem.function_space(domain, degree, (g,))
        u = fem.Function(V, name="displacement")
        low, high = (mesh.locate_entities_boundary(domain, g - 1, lambda x, y=y: np.isclose(x[1], y)) for y in (-1.7, 0.0))
        tool = uem.RigidPlane(np.zeros(g), -np.eye(g)[1])
        problem = uem.UnitedProblem(
            helpers.linear(u, 1.0), u, bcs=[uem.dirichlet(V, low)], contacts=[uem.Contact(high, tool)],
            load=lambda s: tool.move(-0.1 * s * np.eye(g)[1]),
        )  # fmt: skip
        with uem.Checkpoint(folder / "run.uem", every=1) as checkpoint:
            checkpoint.begin(problem.state())
            with uem.ResultsWriter(folder / "run", problem, resume=True) as writer:
                for step in uem.load_steps(problem, 4, checkpoint=checkpoint):
                    writer.write(step)
                    if step.number == steps:
                        break

    if COMM.rank == 0:
        run(MPI.COMM_SELF, 2)
    COMM.barrier()
    run(COMM, 4)
    COMM.barrier()
    assert [time for time, _ in series(folder / "run.xdmf")] == [0.25, 0.5, 0.75, 1.0]


def volume(x):
    """Of a cell with its nodes in VTK's order: positive and right only if that is their order."""
    if x.shape == (3, 2) or x.shape == (4, 2):
        y = np.roll(x, -1, axis=0)
        return abs(0.5 * (x[:, 0] * y[:, 1] - y[:, 0] * x[:, 1]).sum())
    if len(x) == 4:
        return abs(np.linalg.det(x[1:] - x[0])) / 6
    return abs(np.linalg.det(x[[1, 3, 4]] - x[0]))


def test_results_of_earlier_runs_are_kept(folder, caplog):
    """Every run with the same name finds its place, whatever other files there are; what has no step in it is no loss."""
    problem = pressed(COMM, "triangle")
    uem.ResultsWriter(folder / "run", problem).close()
    for name in ("run_of_another.csv", "run.1.txt"):
        (folder / name).write_text("beside")
    for k in range(3):
        before = contents(folder)
        write(problem, folder / "run", [float(k)])
        after = contents(folder)
        kept = {name.replace(f"run.{k}/", ""): after[name] for name in after if name.startswith(f"run.{k}/")}
        assert kept == ({name: before[name] for name in ("run.bin", "run.csv", "run.xdmf")} if k else {})
        assert {t for t, _ in series(folder / "run.xdmf")} == {float(k)}
    # what was moved can be read where it is
    assert [t for t, _ in series(folder / "run.1" / "run.xdmf")] == [0.0]
    assert COMM.rank > 0 or "run.xdmf: results of an earlier run are kept in" in caplog.text


@pytest.mark.parametrize("kind", ["history", "energy"])
def test_tables_of_earlier_runs_are_kept(kind, folder):
    problem = Bar((0.0, -3.0)).problem
    path = folder / "table.csv"
    made = []
    for _ in range(2):
        table = uem.HistoryWriter(path, problem) if kind == "history" else uem.EnergyBook(problem, path=path)
        with table:
            table.write(0.0)
        COMM.barrier()
        made.append(path.read_bytes())
        COMM.barrier()
    assert contents(folder) == {"table.1/table.csv": made[0], "table.csv": made[1]}


@pytest.mark.parametrize("kind", ["history", "energy"])
def test_tables_resumed_without_a_checkpoint(kind, folder):
    """A run that begins anew although its tables are to continue loses nothing: the whole table is kept aside as it was."""

    def run():
        problem = Bar((0.0, -3.0)).problem
        path = folder / "table.csv"
        table = (
            uem.HistoryWriter(path, problem, resume=True)
            if kind == "history"
            else uem.EnergyBook(problem, path=path, resume=True)
        )
        with table:
            for step in uem.time_steps(problem, 0.01, 0.03):
                table.write(step)
        return contents(folder)

    (whole,) = run().values()
    again = run()
    assert sorted(again) == ["table.1/table.csv", "table.csv"]
    assert again["table.1/table.csv"] == whole
    # two runs of several ranks differ by what rounding leaves where messages meet in another order
    first, second = (
        np.genfromtxt(text.decode().splitlines(), delimiter=",", skip_header=1) for text in (whole, again["table.csv"])
    )
    assert second == pytest.approx(first, rel=1e-12, abs=1e-12 * abs(first).max())


def test_resumed_without_a_checkpoint(folder):
    """The checkpoint is gone, the results are not: the run begins anew, and they are kept aside."""
    RAMPS["ramped"](COMM).run(folder, every=2)
    COMM.barrier()
    before = contents(folder)
    COMM.barrier()
    if COMM.rank == 0:
        (folder / "run").unlink()
    COMM.barrier()
    RAMPS["ramped"](COMM).run(folder, every=2, stop=2)
    after = contents(folder)
    assert {f"out.1/{name}": before[name] for name in ("out.bin", "out.csv", "out.xdmf")}.items() <= after.items()
    assert len(rows(folder / "out.csv")) == 3


def test_made_before_the_checkpoint_is_read(folder):
    """The writer refuses its first step, and the files stay as they were."""
    RAMPS["ramped"](COMM).run(folder, every=2, stop=4)
    before = contents(folder)
    late = RAMPS["ramped"](COMM)
    writer = uem.ResultsWriter(folder / "out", late.problem, fields={"u2": late.problem.u[1]}, resume=True)
    late.calls[0][0]()
    steps = late.steps(Killed(folder / "run"))
    step = next(steps)
    with pytest.raises(uem.CheckpointError, match="call checkpoint.begin"):
        writer.write(step)
    steps.close()
    assert contents(folder) == before


@pytest.mark.parametrize(
    "other, match",
    [
        ({"fields": {"u1": "u2"}}, "belong to another run: expected the fields displacement, .*u1 on"),
        ({"fields": {}}, "belong to another run: expected the fields"),
        ({"shuffle": 3}, "belong to another run: expected the mesh of this one"),
        ({"n_low": 3}, "belong to another run: expected the fields .* on 50 cells"),
        ({"cut": 8}, "run.bin is damaged: expected .* bytes, found"),
    ],
    ids=str,
)
def test_results_that_cannot_be_gone_on_with(other, match, folder):
    """Other fields, another mesh, half a file: refused on all ranks, and nothing is changed."""

    def begun(shuffle=8, n_low=2):
        problem = pressed(COMM, "triangle", shuffle=shuffle, n_low=n_low)
        problem.progress.steps = 1
        return problem

    problem = begun()
    write(problem, folder / "run", [0.5], fields={"u2": problem.u[1]})
    if "cut" in other and COMM.rank == 0:
        with (folder / "run.bin").open("r+b") as file:
            file.truncate((folder / "run.bin").stat().st_size - other["cut"])
    before = contents(folder)
    problem = begun(**{k: v for k, v in other.items() if k in ("shuffle", "n_low")})
    fields = {name: problem.u[1] for name in other.get("fields", {"u2": ""})}
    raised(uem.CheckpointError, match, lambda: uem.ResultsWriter(folder / "run", problem, fields=fields, resume=True))
    assert contents(folder) == before


def test_steps_after_the_checkpoint_are_replaced(folder):
    """Whatever a killed run has left behind the last step kept: whole steps, half a step, numbers without text."""
    problem = pressed(COMM, "triangle")
    with uem.ResultsWriter(folder / "run", problem) as writer:
        for k in range(5):
            problem.progress.steps = k
            writer.write(0.1 * k)
    COMM.barrier()
    if COMM.rank == 0:
        with (folder / "run.xdmf").open("a") as file:
            file.write('<Grid Name="mesh">\n<Time Val')
        with (folder / "run.bin").open("ab") as file:
            file.write(b"x" * 1000)
    COMM.barrier()
    problem.progress.steps, problem.progress.resumed = 2, 1
    with uem.ResultsWriter(folder / "run", problem, resume=True) as writer:
        # known already
        writer.write(-1.0)
        problem.progress.steps = 3
        writer.write(0.25)
    COMM.barrier()
    assert [t for t, _ in series(folder / "run.xdmf")] == [0.0, 0.1, 0.2, 0.25]
    assert [float(row["factor"]) for row in rows(folder / "run.csv")] == [0.0, 0.1, 0.2, 0.25]
    assert (folder / "run.bin").stat().st_size == len(series_bytes(folder / "run.xdmf"))


def series_bytes(path: Path) -> bytes:
    """All numbers that an XDMF file names, one after the other."""
    steps = series(path)
    mesh_part = [steps[0][1].pop(name) for name in ("topology", "geometry")]
    parts = [a for _, fields in steps for name, a in fields.items() if name not in ("topology", "geometry")]
    return b"".join(a.tobytes() for a in [*mesh_part, *parts])


def test_mesh_made_from_another(folder):
    """A mesh that does not know its input is written in its own order."""
    if COMM.size > 1:
        pytest.skip("DOLFINx 0.5 makes no such mesh of a distributed one")
    whole = helpers.blocks(COMM, "triangle").scene.mesh
    part = mesh.create_submesh(whole, 2, np.arange(20, dtype=np.int32))[0]
    u = fem.Function(compat.function_space(part, 1, (2,)), name="u")
    u.x.array[:] = np.arange(len(u.x.array))
    XdmfSeries(folder / "part.xdmf", part, [u], []).write(1.0, 1)
    ((_, fields),) = series(folder / "part.xdmf")
    assert np.array_equal(fields["u"][:, :2].ravel(), u.x.array) and fields["topology"].max() == len(fields["geometry"]) - 1
