"""Nodes of a displacement: what a rank may ask of them alone."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import box, scene

from uem_dolfinx import compat
from uem_dolfinx.geometry.configuration import Configuration

COMM = MPI.COMM_WORLD


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
@pytest.mark.parametrize("degree", [1, 2])
def test_one_rank_asks_for_the_size(cell, degree, monkeypatch):
    """The model's diagonal is the same on all ranks, and asking for it is no communication, which ranks without facets would miss."""
    g = 2 if cell == "triangle" else 3
    s = scene(COMM, cell, [box(cell, [0.0] * g, [1.0] * g, [2] * g), box(cell, [3.0] * g, [4.0] * g, [2] * g)])
    config = Configuration(fem.Function(compat.function_space(s.mesh, degree, (g,))))
    monkeypatch.setattr(config, "comm", None)
    assert abs(config.size / (4.0 * np.sqrt(g)) - 1.0) < 1e-14
