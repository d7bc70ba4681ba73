"""The membrane over a ball: every method against the closed form."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from benchmarks.obstacle import METHODS, Membrane, exact, row

pytestmark = pytest.mark.skipif(MPI.COMM_WORLD.size > 1, reason="matrices of SciPy, on one rank")


def test_the_closed_form():
    """The membrane leaves the ball with its height and slope, and vanishes at radius 1."""
    a, b = exact()
    assert b * np.log(a) == pytest.approx(np.sqrt(0.25 - a**2)) and b / a == pytest.approx(-a / np.sqrt(0.25 - a**2))


@pytest.mark.slow
@pytest.mark.parametrize("name", list(METHODS))
def test_order_one(name):
    """Errors in energy fall with h, those of the force are small, and condition numbers of elimination alone stay those of the membrane."""
    coarse, fine = (row(Membrane(n), name) for n in (16, 32))
    assert 1.7 < coarse["error_energy"] / fine["error_energy"] < 2.2
    assert fine["error_energy"] < 0.031 and fine["error_force"] < 0.01
    united = row(Membrane(32), "united")
    if name == "lagrange":
        assert fine["error_energy"] == pytest.approx(united["error_energy"], rel=1e-9)
    if name in ("barrier", "proximal"):
        assert fine["condition"] > 1e3 * united["condition"]
