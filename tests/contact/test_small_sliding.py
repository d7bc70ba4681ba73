"""Small and fixed sliding keep rows for a step: derivatives of the gaps where the step begins, on surfaces that slope, too.

Read first: ``test_second_order_in_the_step``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, box, clamp, linear, scene, slow

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
#: Drop, way, number of cells of the lower block along the way.
DROP, WAY, ALONG = 0.14, 0.8, 18


def pushed(cell, slope, *, sliding="small", rigid=False, **how):
    """A problem, its contact, and the way of the top of a block that is led along a surface ``y = 1 + slope(x)`` and down onto it."""
    g = 3 if cell in ("tetrahedron", "hexahedron") else 2

    def raised(x):
        x = x.copy()
        x[:, -1] *= 1.0 + slope(x[:, 0])
        return x

    deep = [1] * (g - 2)
    low = box(cell, [0.0] * g, [3.0, *[1.0] * (g - 1)], [ALONG, *deep, 3]).mapped(raised)
    high = box(cell, [0.5, *[0.25] * (g - 2), 1.15], [1.5, *[0.75] * (g - 2), 1.7], [5, *deep, 2])
    s = scene(COMM, cell, [low, high])
    V = compat.function_space(s.mesh, 1, (g,))
    u, push = fem.Function(V), fem.Constant(s.mesh, [WAY, *[0.0] * (g - 2), -DROP])
    top, bottom, foot = s.tag("top", 1, at(g - 1, 1.7)), s.tag("bottom", 0, at(g - 1, 0.0)), s.tag("foot", 1, at(g - 1, 1.15))
    up = s.tag("up", 0, lambda x: np.abs(x[:, -1] - 1.0 - slope(x[:, 0])) < 1e-9)
    bcs = [*clamp(V, bottom), uem.dirichlet(V, top, value=push)]
    if rigid:
        up = uem.RigidPlane([0.0] * (g - 1) + [1.0], [-slope(1.0), *[0.0] * (g - 2), 1.0])
        bcs += [uem.dirichlet(V, s.tag("all", 0, lambda x: x[:, 0] >= -1.0))]
    contact = uem.Contact(foot, up, coupling="mortar", sliding=sliding, **how)
    return uem.UnitedProblem(linear(u, 100.0), u, bcs=bcs, contacts=[contact]), contact, push


def drawn(cell, slope, *, steps=1, **how):
    """Force on the block at the end of its way."""
    problem, contact, _ = pushed(cell, slope, **how)
    for _ in uem.load_steps(problem, steps):
        pass
    return np.asarray(contact.resultant().force)


@pytest.mark.slow
@pytest.mark.parametrize("cell", ["quadrilateral", "triangle", "hexahedron"])
def test_second_order_in_the_step(cell):
    """Forces on a wavy block differ from those of finite sliding by the square of the step."""
    errors = []
    for steps in (10, 40):
        small, finite = (drawn(cell, lambda x: 0.1 * np.sin(2 * x), sliding=way, steps=steps) for way in ("small", "finite"))
        errors.append(abs(small[-1] / finite[-1] - 1.0))
    assert errors[-1] <= errors[0] / 8


@pytest.mark.parametrize("sliding", ["small", slow("fixed")])
@pytest.mark.parametrize(
    ("cell", "rigid"), [("quadrilateral", True), ("quadrilateral", False), slow("hexahedron", True), slow("hexahedron", False)]
)
def test_force_on_an_incline_is_normal_to_it(cell, rigid, sliding):
    """Without friction it is normal to the target, not to a contactor at an angle to it; on a plane it is that of finite sliding."""
    force = drawn(cell, lambda x: 0.1 * x, sliding=sliding, rigid=rigid)
    assert abs(force[0] + 0.1 * force[-1]) <= 1e-9 * force[-1]
    if rigid:
        finite = drawn(cell, lambda x: 0.1 * x, sliding="finite", rigid=True)
        np.testing.assert_allclose(force, finite, atol=1e-9 * force[-1])


def test_wear_on_a_slope_continues_from_a_checkpoint(folder):
    """Slip is measured by the rows of its own step: a resumed run is the uninterrupted one."""

    def advance(run, steps):
        for k in steps:
            run[2].value[:] = (0.1 * WAY * k, -DROP * min(k, 3) / 3)
            run[0].solve()

    path = folder / "third"
    whole, resumed = (pushed("quadrilateral", lambda x: 0.1 * np.sin(2 * x), wear=1e-2) for _ in range(2))
    advance(whole, (1, 2, 3))
    uem.write_checkpoint(path, whole[0].state())
    uem.read_checkpoint(path, resumed[0].state())
    for run in (whole, resumed):
        advance(run, (4, 5))
    volumes = [run[1].worn_volume for run in (whole, resumed)]
    assert volumes[0] > 0.0 and volumes[1] == pytest.approx(volumes[0], rel=1e-12)
    np.testing.assert_allclose(resumed[0].u.x.array, whole[0].u.x.array, atol=1e-13)
