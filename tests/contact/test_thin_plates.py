"""General contact of plates thinner than the bound on overlaps: faces that look away from each other are none, small overlaps are."""

from __future__ import annotations

import numpy as np
import pytest
from body_scenes import Bodies
from helpers import box, clamp, slow

import uem_dolfinx as uem

T = 0.01


def plates(cell, cells, over, unit, count=2):
    """Plates of thickness T on each other, each inside the next by ``over`` of that."""
    g = 2 if cell in ("quadrilateral", "triangle") else 3
    step = T * (1 - over)
    return [
        box(cell, [0.0] * (g - 1) + [i * step], [1.0] + [0.3] * (g - 2) + [i * step + T], [4 + i % 2, *[2] * (g - 2), cells])
        .mapped(lambda x: unit * x)
        for i in range(count)
    ]  # fmt: skip


PLATES = [("quadrilateral", 1, 1.0), ("triangle", 2, 1.0), ("quadrilateral", 2, 1e-9), ("hexahedron", 1, 1.0)]
MORE = [("triangle", 1, 1e3), ("tetrahedron", 1, 1.0), ("hexahedron", 2, 1e3), ("tetrahedron", 2, 1e-9)]


@pytest.mark.parametrize(
    ("coupling", "cell", "cells", "unit"),
    [
        *(("mortar", *plate) for plate in PLATES),
        *(slow("mortar", *plate) for plate in MORE),
        ("node_to_surface", "quadrilateral", 1, 1.0),
    ],
)
@pytest.mark.parametrize("over", [0.0, 0.1])
def test_a_stack_of_thin_plates(cell, cells, unit, coupling, over):
    """Held at both ends it is pressed by the overlap alone, and by a settlement in addition: the strain of a rod, with E = 1."""
    count = 2 if over else 3
    bodies = plates(cell, cells, over, unit, count)
    b = Bodies(cell, bodies, nu=0.0)
    ends = bodies[0].x[:, -1].min(), bodies[-1].x[:, -1].max()
    low, top = (
        b.s.tag(name, body, lambda x, z=z: np.abs(x[:, -1] - z) < 1e-6 * unit)
        for name, body, z in zip("lt", (0, count - 1), ends)
    )
    down = 0.02 * T * unit
    bcs = [*clamp(b.V, low), *clamp(b.V, top, value=[*[0.0] * (b.g - 1), -down])]
    for i in range(1, count - 1):
        side = b.s.tag("side", i, lambda x: np.abs(x[:, 0]) < 1e-6 * unit)
        bcs += clamp(b.V, side, *range(b.g - 1))
    contact = uem.GeneralContact(coupling=coupling)
    problem = b.problem([contact], bcs)
    problem.solve()
    assert max(part.initial_overlap for part in contact.parts) == pytest.approx(over * T * unit, rel=1e-6, abs=1e-12 * unit)
    strain = (over * T * unit + down) / (count * T * unit)
    area = unit ** (b.g - 1) * 0.3 ** (b.g - 2)
    # plates of different meshes that meet by nodes carry no uniform pressure
    error = 0.2 * strain + (1e-9 if coupling == "mortar" else 0.02)
    assert contact.between("body 1").force[-1] == pytest.approx(-strain * area, rel=error)
