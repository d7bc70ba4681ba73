"""What pressures are forces per area of: the surface as it was drawn or as it is now, the same for both couplings."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, clamp, highest, lowest, st_venant
from mortar_scenes import Blocks

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def squeezed(cell, degree, coupling, **how):
    """Two blocks of one material pressed by a quarter between planes on which they slide: a homogeneous state, wherever they meet."""
    n = (3, 2) if coupling == "mortar" else (2, 2)
    b = Blocks(cell, n, degree, E=(1.0, 1.0), **how)
    g = b.g
    b.contact = uem.Contact(b.high, b.low, coupling=coupling, **how)
    b.bcs = clamp(b.V, b.scene.tag("bottom", 0, at(g - 1, -1.0)), g - 1)
    down = fem.dirichletbc(
        fem.Constant(b.scene.mesh, -0.5), fem.locate_dofs_topological(b.V.sub(g - 1), g - 1, b.top.entities), b.V.sub(g - 1)
    )
    b.bcs += [
        down,
        *(one for c in range(g - 1) for body in (0, 1) for one in clamp(b.V, b.scene.tag("side", body, at(c, 0.0)), c)),
    ]
    for _ in uem.load_steps(b.problem(st_venant(b.u, b.E), rtol=1e-10), 2):
        pass
    return b


@pytest.mark.parametrize("sliding", ["finite", "small", "fixed"])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize(
    "cell, degree",
    [
        ("quadrilateral", 1),
        ("triangle", 2),
        pytest.param("hexahedron", 1, marks=pytest.mark.slow),
        pytest.param("tetrahedron", 1, marks=pytest.mark.slow),
    ],
)
def test_force_over_the_area_meant(cell, degree, coupling, sliding):
    """The force over the area drawn, or over that and what the blocks have widened by."""
    pressures = {}
    for measure in ("reference", "current"):
        b = squeezed(cell, degree, coupling, measure=measure, sliding=sliding)
        force = b.contact.resultant().force[-1]
        wide = 1.0 + highest(COMM, b.contact.config.displacement[b.contact.nodes, 0])
        area = 1.0 if measure == "reference" else wide ** (b.g - 1)
        p = b.contact.pressures
        assert wide > 1.05 and highest(COMM, np.abs(p - force / area)) < 2e-6 * force
        assert lowest(COMM, p) > 0 and b.contact.max_pressure() == pytest.approx(force / area, rel=1e-5)
        pressures[measure] = b.contact.max_pressure()
    assert uem.Contact(b.high, b.low).measure == "reference" and pressures["current"] < 0.96 * pressures["reference"]


def test_words_of_measures():
    plane = uem.RigidPlane([0.0, 0.0], [0.0, 1.0])
    with pytest.raises(
        uem.InputError, match="measure = 'curent': expected one of 'reference' or 'current'; did you mean 'current'"
    ):
        uem.Contact(np.array([0]), plane, measure="curent")
