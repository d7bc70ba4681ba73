"""Implicit against explicit steps: errors of a bar that hits a wall fall with the mesh, and those of explicit steps are smaller."""

from __future__ import annotations

import pytest
from benchmarks.schemes import WAYS, run


@pytest.mark.long
@pytest.mark.parametrize("dim", [2, pytest.param(3, marks=pytest.mark.slow)])
def test_errors_of_schemes(dim):
    rule, _, explicit, massy = ([run(dim, cells, way) for cells in (8, 16)] for way in WAYS)
    for coarse, fine in (rule, explicit, massy):
        assert (
            fine["error_displacement"] < 0.75 * coarse["error_displacement"] and fine["error_impulse"] < coarse["error_impulse"]
        )
        assert fine["unknowns"] > coarse["unknowns"] and fine["seconds"] > 0.0
    assert explicit[1]["error_displacement"] < rule[1]["error_displacement"]
    # half a cell of mass stops at the wall
    assert massy[1]["error_impulse"] > explicit[1]["error_impulse"]
