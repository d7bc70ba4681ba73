"""Files and pictures of a solved scene: what is in them, and that every number of ranks writes the same.

Read ``test_history_is_what_the_contacts_say`` and ``test_nodal_average_is_taken_in_each_body`` first.
"""

from __future__ import annotations

import csv
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mpi4py import MPI

import helpers
import numpy as np
import pytest
import ufl
from dolfinx import fem, mesh

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.output import frames

comm = MPI.COMM_WORLD


@pytest.fixture
def folder() -> Iterator[Path]:
    """A folder that all ranks share, gone after the test."""
    keep = tempfile.TemporaryDirectory() if comm.rank == 0 else None
    yield Path(comm.bcast(keep.name if keep else None))
    comm.barrier()
    if keep:
        keep.cleanup()


def pressed(cell: str, degree: int = 1, names: tuple[str, ...] = ("pair",)) -> uem.UnitedProblem:
    """Two blocks pushed together by 0.1, with as many copies of their contact as there are names, all but the first asleep."""
    b = helpers.blocks(comm, cell, degree=degree)
    contacts = [uem.Contact(b.high, b.low, name=names[0])]
    contacts += [
        uem.Contact(b.high, uem.RigidPlane([0.0] * (b.gdim - 1) + [-9.0], np.eye(b.gdim)[-1]), name=n) for n in names[1:]
    ]
    return uem.UnitedProblem(helpers.linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=contacts)


def rows(path: Path) -> list[dict[str, str]]:
    """A CSV file as rank 0 reads it, on every rank."""
    return comm.bcast(list(csv.DictReader(path.open())) if comm.rank == 0 else None)


@pytest.mark.parametrize("cell", helpers.CELLS)
def test_history_is_what_the_contacts_say(folder: Path, cell: str) -> None:
    problem = pressed(cell)
    contact, g = problem.contacts[0], problem.config.gdim
    with uem.HistoryWriter(folder / "new" / "history.csv", problem) as history:
        for step in uem.load_steps(problem, 2):
            history.write(step)
        history.write(1.0)
    table = rows(folder / "new" / "history.csv")
    assert [float(r["factor"]) for r in table] == [0.5, 1.0, 1.0]
    assert [bool(r["newton_iterations"]) for r in table] == [True, True, False]
    last, resultant = table[1], contact.resultant()
    np.testing.assert_allclose([float(last[f"force_{a}"]) for a in "xyz"[:g]], resultant.force, rtol=1e-11, atol=1e-14)
    np.testing.assert_allclose(
        [float(last[f"moment_{a}"]) for a in ("z" if g == 2 else "xyz")], resultant.moment, rtol=1e-11, atol=1e-14
    )
    assert int(last["active"]) == contact.n_active > 0
    assert float(last["max_gap"]) < 1e-12
    # half the settlement, half the force
    up = f"force_{'xyz'[g - 1]}"
    assert float(table[0][up]) == pytest.approx(0.5 * float(table[1][up]), rel=1e-8)


def test_columns_name_the_contacts_where_there_are_several(folder: Path) -> None:
    problem = pressed("triangle", names=("left pad", "wall", "wall"))
    with uem.HistoryWriter(folder / "history.csv", problem) as history:
        history.write(0.0)
    assert {"active_left_pad", "force_y_wall_1", "moment_z_wall_2"} <= set(rows(folder / "history.csv")[0])


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_columns_that_are_chosen(folder: Path, cell: str) -> None:
    """Reactions of supports and quantities of the user's own; the support bears what the contact carries."""
    problem = pressed(cell)
    axes, u = "xyz"[: problem.config.gdim], problem.u
    lowest = helpers.highest(comm, -problem.config.X[:, -1]) * -1.0
    foot = mesh.locate_entities_boundary(problem.config.mesh, len(axes) - 1, lambda x: np.isclose(x[len(axes) - 1], lowest))
    requested = {
        "energy": lambda: 0.5 * len(axes),
        "mean": lambda: [uem.integrate(u[k] * ufl.dx) for k in range(len(axes))],
        "pair": lambda: [1.0, 2.0, 3.0, 4.0],
    }
    with uem.ResultsWriter(folder / "blocks", problem, reaction={"foot": foot}, columns=requested) as writer:
        for step in uem.load_steps(problem, 2):
            writer.write(step)
    first, last = rows(folder / "blocks.csv")
    up = axes[-1]
    assert float(last[f"reaction_foot_{up}"]) == pytest.approx(float(last[f"force_{up}"]), rel=1e-7)
    assert float(first[f"mean_{up}"]) == pytest.approx(0.5 * float(last[f"mean_{up}"]), rel=1e-7) != 0
    assert float(last["energy"]) == 0.5 * len(axes) and [float(last[f"pair_{k}"]) for k in range(4)] == [1.0, 2.0, 3.0, 4.0]
    with uem.HistoryWriter(folder / "one.csv", problem, reaction=foot) as history:
        history.write(1.0)
    assert float(rows(folder / "one.csv")[0][f"reaction_{up}"]) == pytest.approx(float(last[f"force_{up}"]), rel=1e-7)


@pytest.mark.parametrize(
    ("how", "error", "words"),
    [
        ({"columns": {"a": 1.0}}, uem.InputTypeError, "a function without arguments"),
        ({"columns": {"a": lambda: "one"}}, uem.InputTypeError, r"columns\['a'\] = 'one'"),
        ({"columns": {"a": lambda: np.nan}}, uem.InputError, "finite"),
        ({"columns": {"a": lambda: 1 / 0}}, uem.UserFunctionError, "ZeroDivisionError"),
        ({"columns": [1]}, uem.InputTypeError, "by the names of their columns"),
        ({"columns": {"a b": lambda: 1.0}}, uem.InputError, "without blanks"),
        ({"columns": {"reaction_y": lambda: 1.0}, "reaction": {"y": 1}}, uem.InputError, "choose another"),
        ({"reaction": "foot"}, uem.UEMError, "support"),
    ],
)
def test_columns_that_cannot_be_had(folder: Path, how: dict[str, Any], error: type[Exception], words: str) -> None:
    with pytest.raises(error, match=words):
        uem.HistoryWriter(folder / "history.csv", pressed("triangle"), **how)
    assert not (folder / "history.csv").exists()


@pytest.mark.skipif(comm.size == 1, reason="one rank is alike")
def test_columns_are_the_same_on_all_ranks(folder: Path) -> None:
    with pytest.raises(uem.InputError, match="on rank 0, but"):
        uem.HistoryWriter(folder / "history.csv", pressed("triangle"), columns={"own": lambda: float(comm.rank)})


@pytest.mark.long
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_files_for_paraview(folder: Path, cell: str, degree: int) -> None:
    problem = pressed(cell, degree)
    strain = ufl.sym(ufl.grad(problem.u))
    with uem.ResultsWriter(folder / "out" / "blocks", problem, fields={"strain": strain, "trace": ufl.tr(strain)}) as writer:
        for step in uem.load_steps(problem, 2):
            writer.write(step)
    comm.barrier()
    text = (folder / "out" / "blocks.xdmf").read_text()
    for name in ("displacement", "contact_pressure", "gap", "active", "contact_force", "strain", "trace"):
        assert text.count(f'Name="{name}"') >= 1, name
    assert 'Value="0.5"' in text and 'Value="1"' in text
    assert len(rows(folder / "out" / "blocks.csv")) == 2
    for kind in ("vectors", "scalars"):
        assert (folder / "out" / f"blocks_{kind}.bp").exists() == compat.has_vtx()


@pytest.mark.skipif(not compat.has_vtx(), reason="this DOLFINx has no ADIOS2")
@pytest.mark.parametrize("degree", [1, 2])
def test_vtx_has_the_numbers_of_every_step(folder: Path, degree: int) -> None:
    """Values at all nodes of the displacement's degree, by the names and at the times of XDMF, on any ranks."""
    adios2 = pytest.importorskip("adios2")
    problem = pressed("triangle", degree)
    with uem.ResultsWriter(folder / "blocks", problem, vtx=True) as writer:
        ends = [(writer.write(step), helpers.highest(comm, np.abs(problem.u.x.array)))[1] for step in uem.load_steps(problem, 2)]
    comm.barrier()
    if comm.rank:
        return
    for kind, name, n in (("vectors", "displacement", 3), ("scalars", "contact_pressure", 1)):
        with adios2.Stream(str(folder / f"blocks_{kind}.bp"), "r") as stream:
            read = []
            for _ in stream.steps():
                blocks = stream.all_blocks_info(name)[0]
                read.append(
                    (float(stream.read("step")), np.concatenate([stream.read(name, block_id=k) for k in range(len(blocks))]))
                )
        assert [time for time, _ in read] == [0.5, 1.0]
        assert all(values.shape[1:] in ((n,), ()) for _, values in read)
        if kind == "vectors":
            assert [np.abs(values).max() for _, values in read] == pytest.approx(ends, rel=1e-12)
        else:
            assert read[1][1].max() == pytest.approx(2 * read[0][1].max(), rel=1e-9) and read[0][1].max() > 0


@pytest.mark.skipif(compat.has_vtx(), reason="this DOLFINx has ADIOS2")
def test_vtx_where_there_is_none_is_a_named_error(folder: Path) -> None:
    with pytest.raises(uem.MissingBackendError, match="ADIOS2"):
        uem.ResultsWriter(folder / "blocks", pressed("triangle"), vtx=True)


@pytest.mark.slow
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_pictures(folder: Path, cell: str) -> None:
    pytest.importorskip("matplotlib")
    problem = pressed(cell, names=("pair", "asleep"))
    uem.plot_scene(problem, folder / "start.png")
    for _ in uem.load_steps(problem):
        pass
    uem.plot_scene(problem, folder / "scene.png")
    uem.plot_pressure(problem.contacts, folder / "pressure.png", reference=lambda s: 0 * s + 0.1)
    with uem.figure(folder / "new" / "both.png", comm, panels=2) as (left, right):
        assert (left is not None) == (comm.rank == 0)
        uem.plot_scene(
            problem,
            left,
            field=ufl.div(problem.u),
            label="dilation",
            levels=[-0.2, -0.1, 0.0],
            window=(-1, 1, -0.5, 0.5),
            mirror=True,
        )
        uem.plot_pressure(problem.contacts[0], right, mirror=True, along=lambda x: x[:, 0], window=(-1.0, 1.0))
    comm.barrier()
    for name in ("start.png", "scene.png", "pressure.png", "new/both.png"):
        assert (folder / name).stat().st_size > 5000
    with uem.figure(None, comm) as (panel,):
        assert panel is None
    for picture in (uem.plot_scene(problem), uem.plot_pressure(problem.contacts)):
        # what Jupyter shows
        shown = picture._repr_png_()
        assert shown[:4] == b"\x89PNG" and len(shown) > 5000 if comm.rank == 0 else shown is None


def test_pictures_leave_the_backend_of_matplotlib_alone(folder: Path) -> None:
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("svg")
    uem.plot_pressure(pressed("triangle").contacts, folder / "pressure.png")
    assert matplotlib.get_backend().lower() == "svg"


def test_no_matplotlib_is_a_named_error_on_every_rank(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    with pytest.raises(uem.MissingBackendError, match="matplotlib"):
        uem.plot_scene(pressed("triangle"), folder / "scene.png")


@pytest.mark.parametrize("cell", helpers.CELLS)
def test_nodal_average_is_taken_in_each_body(cell: str) -> None:
    b = helpers.blocks(comm, cell)
    E = helpers.modulus(b.scene, 3.0, 7.0)
    S = compat.function_space(b.scene.mesh, 1)
    values, cells = frames.nodal_average(E, b.scene.mesh), compat.cell_dofs(S)
    np.testing.assert_allclose(values[cells], np.where(b.scene.body == 0, 3.0, 7.0)[:, None] * np.ones(cells.shape[1]))


@pytest.mark.long
def test_ranks_without_a_cell_write_along(folder: Path) -> None:
    """One cell for all ranks: results and a picture as one rank makes them, and a checkpoint that one rank continues from."""

    def press(comm: MPI.Comm, name: str) -> tuple[int, list[float]]:
        domain = mesh.create_unit_square(comm, 1, 1, mesh.CellType.quadrilateral)
        u = fem.Function(compat.function_space(domain, 1, (2,)))
        low, top = (mesh.locate_entities_boundary(domain, 1, lambda x, y=y: np.isclose(x[1], y)) for y in (0.0, 1.0))
        contact = uem.Contact(low, uem.RigidPlane([0.0, 0.0], [0.0, 1.0]))
        bcs = [uem.dirichlet(u.function_space, top, 0), uem.dirichlet(u.function_space, top, 1, -0.1)]
        problem = uem.UnitedProblem(helpers.linear(u, 1.0), u, bcs=bcs, contacts=[contact])
        uem.plot_scene(problem, folder / f"{name}.png")
        with uem.Checkpoint(folder / "run.uem") as checkpoint, uem.ResultsWriter(folder / name, problem, vtx=False) as results:
            begun = checkpoint.begin(problem.state())
            for step in uem.load_steps(problem, 2, checkpoint=checkpoint):
                results.write(step)
        return begun, list(contact.resultant().force)

    begun, force = press(comm, "together")
    assert not begun and force[1] > 0
    if comm.rank == 0:
        (folder / "run.uem").rename(folder / "theirs.uem")
        assert press(MPI.COMM_SELF, "alone") == (begun, pytest.approx(force, rel=1e-12))
        together, alone = (np.fromfile(folder / f"{name}.bin", np.float64) for name in ("together", "alone"))
        np.testing.assert_allclose(together, alone, rtol=1e-12, atol=1e-15)
        (folder / "theirs.uem").rename(folder / "run.uem")
        assert press(MPI.COMM_SELF, "again")[0]
