"""Curves of histories and energies: what is drawn are the numbers of the run, from writers and from their files alike."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from helpers import blocks, linear, refused

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def drawn(draw):
    """Labels, abscissas and ordinates of the lines of a panel on rank 0, and its labels."""
    pytest.importorskip("matplotlib")
    from io import BytesIO

    with uem.figure(BytesIO(), COMM) as (panel,):
        draw(panel)
        found = ({}, None)
        if panel is not None:
            found = {line.get_label(): line.get_xydata().T for line in panel.lines}, (panel.get_xlabel(), panel.get_ylabel())
    return COMM.bcast(found)


@pytest.fixture
def run(folder):
    """A pressed block, written in four steps."""
    b = blocks(COMM, "triangle", 2, 2)
    problem = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=[uem.Contact(b.high, b.low)])
    writer = uem.ResultsWriter(folder / "run", problem, reaction=b.bottom, columns={"way": lambda: 0.1 * problem.progress.factor})
    with writer:
        for step in uem.load_steps(problem, 4):
            writer.write(step)
        yield folder, writer


@pytest.mark.slow
def test_histories(run):
    """Reaction and force are opposite, and proportional to the way; any source draws the same."""
    folder, writer = run
    sources = [writer, writer.history, folder / "run.csv", str(folder / "run"), uem.read_results(folder / "run")]
    for source in sources:
        lines, labels = drawn(lambda panel, source=source: uem.plot_history(source, panel, over="way"))
        assert {"force_y", "reaction_y"} <= set(lines) and labels == ("way", "")
        (s, force), (_, reaction) = lines["force_y"], lines["reaction_y"]
        np.testing.assert_allclose(s, [0.025, 0.05, 0.075, 0.1], rtol=1e-14)
        np.testing.assert_allclose(force, force[-1] * s / 0.1, rtol=1e-9)
        np.testing.assert_allclose(force, reaction, rtol=1e-9)
    lines, labels = drawn(lambda panel: uem.plot_history(writer, panel, columns="max_gap", over_label="load"))
    assert list(lines["max_gap"][0]) == [0.25, 0.5, 0.75, 1.0] and labels == ("load", "max_gap")
    picture = uem.plot_history(writer)
    assert picture.png.startswith(b"\x89PNG") if COMM.rank == 0 else not picture.png


@pytest.mark.long
def test_energies(folder):
    """A block that swings freely: the sum is constant, and drawn from the log and from its file alike."""
    b = blocks(COMM, "triangle", 2, 2)
    law = uem.LinearElastic(1.0, 0.3, kind="plane_strain")
    dynamics = uem.Dynamics(uem.lumped_mass(b.V, 1.0))
    F = law.residual(b.u, ufl.TestFunction(b.V)) * ufl.dx
    b.u.interpolate(lambda x: 0.01 * np.stack([x[1], x[0] * x[1]]))
    problem = uem.UnitedProblem(F, b.u, bcs=[uem.dirichlet(b.V, [b.bottom, b.top])], dynamics=dynamics)
    b.u.x.array[:] = 0.0
    dynamics.velocity.interpolate(lambda x: 0.01 * np.stack([np.sin(3 * x[1]), x[0]]))
    with uem.EnergyBook(problem, law.energy(b.u) * ufl.dx, path=folder / "energy.csv") as book:
        for step in uem.time_steps(problem, 0.1, 1.0):
            book.write(step)
        found = [
            drawn(lambda panel, source=source: uem.plot_energies(source, panel))[0] for source in (book, folder / "energy.csv")
        ]
    every, _ = drawn(lambda panel: uem.plot_history(folder / "energy.csv", panel))
    assert {"kinetic", "stored"} <= set(every) and "time" not in every
    for lines in found:
        assert {"kinetic", "stored", "sum less external work"} <= set(lines) <= {"external", *found[0]}
        (t, total), (_, stored) = lines["sum less external work"], lines["stored"]
        assert len(t) == 11 and np.ptp(stored) > 0.01 * total[0]
        # held nodes are stopped within the first step
        np.testing.assert_allclose(total[1:], total[1], rtol=1e-7)
    for name, line in found[0].items():
        np.testing.assert_allclose(found[1][name], line, rtol=1e-14)


def test_refused(run):
    folder, writer = run
    if COMM.rank == 0:
        (folder / "empty.csv").write_text("")
    COMM.barrier()
    for error, words, call in (
        (uem.InputTypeError, ("source = 3", "read_results"), lambda: uem.plot_history(3)),
        (uem.InputError, ("columns = 'force_z'", "did you mean"), lambda: uem.plot_history(writer, columns="force_z")),
        (uem.InputError, "over = 'wy'", lambda: uem.plot_history(writer, over="wy")),
        (uem.InputError, "expected the name of a column", lambda: uem.plot_history(writer, columns=[])),
        (uem.InputTypeError, "columns[0] = 3", lambda: uem.plot_history(writer, columns=[3])),
        (uem.InputError, ("no column 'time'", "EnergyBook"), lambda: uem.plot_energies(writer)),
        (uem.InputError, "no column of numbers", lambda: uem.plot_history(folder / "empty.csv")),
        (uem.MissingFileError, "there are no results", lambda: uem.plot_history(folder / "other.csv")),
    ):
        refused(error, words, call)
