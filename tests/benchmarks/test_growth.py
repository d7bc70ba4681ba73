"""What grows with the number of ranks: the model finds what made the counts, and a step says as much to each rank on four as on two."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from benchmarks import growth
from helpers import serial, start_process

SCRIPT = Path(__file__).parents[2] / "demos" / "growth.py"


@pytest.mark.parametrize(
    "parts",
    [
        {"always": 40.0, "own_surface": 3000.0},
        {"own_surface": 500.0, "partners": 900.0},
        {"own_surface": 5.0, "whole_surface": 70.0},
    ],
)
def test_model_finds_its_terms(parts):
    rows = [{"dofs": N, "ranks": p} for N in (5e3, 2e4, 6e4) for p in (1, 2, 4, 8, 16)]
    for row in rows:
        row["row_bytes"] = sum(growth.on_paper(parts, row["dofs"], row["ranks"]).values())
    model = growth.fitted(rows, "row_bytes")
    assert model.pop("error") < 1e-6
    assert {name: value for name, value in model.items() if value > 1e-6 * max(parts.values())} == pytest.approx(parts)
    reported = growth.on_paper(model, 1e8, 1000)
    assert sum(reported.values()) == pytest.approx(sum(growth.on_paper(parts, 1e8, 1000).values()))


def test_too_few_counts_make_no_model():
    assert growth.fitted([{"dofs": 1e4, "ranks": 2, "collectives": 5.0}] * 2, "collectives") == {}


@serial
@pytest.mark.slow
@pytest.mark.parametrize("declared", ["pair", "general"])
def test_a_step_on_two_and_four_ranks(folder, declared):
    """As many collective calls, as many bytes to each other rank, and not more rows where the surface is shared by more ranks."""
    file = folder / "growth.json"
    options = ["--scenes", declared, "--sizes", "6", "--ranks", "2,4", "--memory", "0", "--json", str(file)]
    run = f"import runpy, sys; sys.argv = {[str(SCRIPT), *options]!r}; sys.path.insert(0, {str(SCRIPT.parent)!r}); "
    process = start_process(run + f"runpy.run_path({str(SCRIPT)!r}, run_name='__main__')")
    process.communicate(timeout=300)
    assert process.returncode == 0
    found = json.loads(file.read_text())
    two, four = found["counts"]
    assert (two["ranks"], four["ranks"]) == (2, 4) and two["dofs"] == four["dofs"]
    assert four["iterations"] == two["iterations"] and four["collectives"] == pytest.approx(two["collectives"], rel=0.02)
    assert 0 < four["gathered_bytes"] / 3 < 1.2 * two["gathered_bytes"]
    assert 0 < four["row_bytes"] < 1.1 * two["row_bytes"]
    # no rank hears a part of the surface by what all tell all: a facet has 37 numbers
    assert four["gathered_bytes"] < 8 * 37 * 6**2
    stages = [row["collectives"] for row in found["stages"] if row["ranks"] == 4]
    assert sum(stages) == pytest.approx(four["collectives"] + four["solver_collectives"])
