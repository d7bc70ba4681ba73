"""Contact at the seam of a periodic strip: as away from it with nodes; mortar warns."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, box, clamp, linear, run, scene

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
PERIOD, HEIGHT, DEPTH = 2.0, 1.0, 0.01


def strip(crest, coupling="node_to_surface", begin=0.0):
    """A periodic strip under a wave of a rigid surface, and its contact; contactors from x = ``begin`` on."""
    s = scene(COMM, "quadrilateral", [box("quadrilateral", [0.0, 0.0], [PERIOD, HEIGHT], [24, 8])])
    V = compat.function_space(s.mesh, 1, (2,))
    u, phase = fem.Function(V), lambda x: np.pi * (x[0] - crest)
    wave = uem.RigidSurface(
        lambda x: HEIGHT + 0.02 * (1 - np.cos(phase(x))) - x[1],
        lambda x: np.stack([0.02 * np.pi * np.sin(phase(x)), -np.ones(x.shape[1])]),
    )
    top = s.tag("top", 0, lambda x: at(1, HEIGHT)(x) & (x[:, 0] > begin - 1e-9))
    right, left = (s.tag(name, 0, at(0, x)) for name, x in (("right", PERIOD), ("left", 0.0)))
    contact = uem.Contact(top, wave, coupling=coupling)
    problem = uem.UnitedProblem(
        linear(u, 1000.0), u, bcs=clamp(V, s.tag("bottom", 0, at(1, 0.0))), contacts=[contact],
        equations=[uem.periodic(right, left)], rtol=1e-11, load=lambda f: wave.move((0.0, -DEPTH * f)),
    )  # fmt: skip
    return problem, contact


def warned(caplog):
    return COMM.bcast(any("equations unite contactors between (0, 1) and (2, 1)" in r.getMessage() for r in caplog.records))


def test_contact_at_a_seam():
    """Force and pressures are those of contact away from the seam."""
    found = []
    for crest in (0.0, 0.5 * PERIOD):
        problem, contact = strip(crest)
        run(problem)
        found.append([contact.resultant().force[1], contact.max_pressure()])
    assert found[0] == pytest.approx(found[1], rel=1e-9)


@pytest.mark.parametrize("coupling, begin", [("mortar", 0.0), ("mortar", PERIOD / 24), ("node_to_surface", 0.0)])
def test_what_is_warned_of(coupling, begin, caplog):
    """Mortar, whose rows at a seam are those of two sides; not of a surface that ends before the seam."""
    strip(0.0, coupling, begin)
    assert warned(caplog) == (coupling == "mortar" and begin == 0.0)
