"""What writers refuse: steps of another problem and names that are taken; and sections that are not switched."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from helpers import blocks, raised
from ramp_scenes import COMM, five_steps, nothing

import uem_dolfinx as uem


@pytest.mark.parametrize("in_time", [False, True], ids=["load", "time"])
def test_a_step_of_another_problem(in_time, folder):
    """It would be written with a time at which this one never was."""
    one, begin = five_steps(in_time, nothing)
    other, _ = five_steps(in_time, nothing)
    step = next(iter(begin(None)))
    with uem.ResultsWriter(folder / "own", one, vtx=False) as own, uem.ResultsWriter(folder / "out", other, vtx=False) as out:
        own.write(step)
        raised(uem.InputError, "is a step of another problem", lambda: out.write(step))
        raised(uem.InputError, "is a step of another problem", lambda: out.history.write(step))


@pytest.mark.parametrize("name", ["displacement", "gap", "contact_pressure"])
def test_a_field_of_the_problems_own_name(name, folder):
    problem, _ = five_steps(False, nothing)
    raised(
        uem.InputError,
        "the problem's own field has this name",
        lambda: uem.ResultsWriter(folder / "r", problem, fields={name: problem.u[0]}),
    )


def test_columns_and_values():
    """A column of a name that the table has, numbers that are not finite, and what is of facets."""
    problem, _ = five_steps(False, nothing)
    raised(uem.InputError, "two columns 'step'", lambda: uem.HistoryWriter("never.csv", problem, columns={"step": lambda: 1.0}))
    raised(uem.InputError, "the path of a file; the system says", lambda: uem.HistoryWriter("a" * 300, problem))
    for value, words in (
        (np.nan * problem.u[0], "holds the number nan"),
        (ufl.FacetNormal(problem.config.mesh)[0], "is of facets"),
    ):
        raised(uem.InputError, words, lambda: uem.ResultsWriter("never", problem, fields={"a": value}))  # noqa: B023


def test_steps_switch_contacts():
    b = blocks(COMM, "triangle")
    bolt, contact = uem.Preload(b.high, b.low, force=1.0), uem.Contact(b.high, b.low)
    raised(uem.InputError, "cannot be switched", lambda: bolt.switch(False))
    raised(
        uem.InputError, r"is switched by a step: expected Step\(..., contacts=\{contact: False\}\)", lambda: contact.switch(False)
    )


@pytest.mark.parametrize("kind", [GeneratorExit, StopIteration])
def test_functions_that_end_generators(kind):
    """They are errors of the function, not the end of the steps, on all ranks; the state is the last converged one."""
    made = []

    def load(at):
        if len(made) == 2 and COMM.rank == COMM.size - 1:
            raise kind

    problem, begin = five_steps(False, load)

    def run():
        for step in begin(None):
            made.append((step, np.array(problem.u.x.array)))

    raised(uem.UserFunctionError, kind.__name__, run)
    assert len(made) == 2 and np.array_equal(made[-1][1], problem.u.x.array)


WRITERS = {
    "results": lambda folder, problem: uem.ResultsWriter(folder / "t", problem, vtx=False),
    "history": lambda folder, problem: uem.HistoryWriter(folder / "t.csv", problem),
    "energy": lambda folder, problem: uem.EnergyBook(problem, path=folder / "t.csv"),
}


@pytest.mark.parametrize("second", WRITERS)
@pytest.mark.parametrize("first", WRITERS)
def test_one_name_for_two_kinds_of_writers(first, second, folder):
    """The file is not moved away under the first; once that is closed the name is free, and two of a kind are as of two runs."""
    problem, begin = five_steps(True, nothing)
    step = next(iter(begin(None)))
    one = WRITERS[first](folder, problem)
    one.write(step)
    if first != second:
        raised(uem.OutputError, "is the table of", lambda: WRITERS[second](folder, problem))
        COMM.barrier()
        assert (folder / "t.csv").exists() and not (folder / "t.1").exists()
    one.close()
    WRITERS[second](folder, problem).close()
