"""The worked example of a discretisation from outside the package: ``scenes/gauss_points.py``, with gaps at Gauss points.

The test to read first is ``test_patch``.
"""

from __future__ import annotations

from pathlib import Path

from mpi4py import MPI

import gauss_points as example
import numpy as np
import pytest
from gauss_points import GaussPoints, gauss_points
from gradient_scenes import orders, pressed
from helpers import (
    CELLS,
    M,
    blocks,
    clamp,
    complementary,
    gathered_vector,
    highest,
    linear,
    modulus,
    raised,
    refused,
    run,
    st_venant,
    tangent_by_differences,
)  # fmt: skip

import uem_dolfinx as uem

COMM = MPI.COMM_WORLD


def compressed(cell, n_low, n_high, size=1.0, degree=3, offset=0.0):
    """Two blocks in uniaxial strain, an offset apart, the lower of which is three times as stiff; ``size`` is their length."""
    b = blocks(COMM, cell, n_low, n_high, gap=offset, pose=lambda x: size * x)
    contact = uem.Contact(b.high, b.low, coupling=gauss_points(degree), offset=offset * size)
    run(uem.UnitedProblem(linear(b.u, modulus(b.scene, 3.0, 1.0)), b.u, bcs=b.oedometer(0.01 * size), contacts=[contact]))
    return b, contact


def over(cell, target="mesh", coupling=GaussPoints):
    """A block close to another, or over a rigid ball, that it enters."""
    n = (5, 4) if cell in ("triangle", "quadrilateral") else (3, 2)
    b = blocks(COMM, cell, *n, gap=1e-3 if target == "mesh" else 0.1, overhang=0.5)
    other = b.low if target == "mesh" else uem.RigidSphere([0.4] * (b.gdim - 1) + [-1.0], 1.05)
    contact = uem.Contact(b.high, other, max_penetration=0.5, coupling=coupling)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0] * (b.gdim - 1) + [-0.15])]
    return b, contact, uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact])


def pressed_on_a_ball(cell, coupling):
    """The force between block and ball."""
    _, contact, problem = over(cell, "ball", coupling)
    run(problem)
    return contact.resultant().force[-1]


def test_it_is_short():
    """A discretisation has 150 lines at most."""
    assert len(Path(example.__file__).read_text(encoding="utf-8").splitlines()) <= 150


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("size", [1.0, 1e-9, 1e3])
def test_patch(cell, size):
    """Where each contactor facet lies on one target facet: force, pressure and displacement are those of uniaxial strain, in any unit."""
    b, contact = compressed(cell, 2, 4, size)
    p = 0.75 * 0.01 * M
    assert highest(COMM, np.abs(contact.pressures / p - 1)) < 1e-10
    assert contact.resultant().force[-1] == pytest.approx(p * size ** (b.gdim - 1), rel=1e-10)
    assert contact.n_active == 5 ** (b.gdim - 1)
    z = b.scene.drawing[:, -1]
    upper = np.arange(len(z)) >= len(z) - b.n_high_nodes
    exact = np.where(upper, -0.0025 - 0.0075 * z, -0.0025 * (z + 1)) * size
    assert np.abs(b.scene.gather(b.u)[:, -1] - exact).max() < 1e-11 * size
    complementary(contact, 1e-13 * size, 1e-13 * p * size ** (b.gdim - 1))


def test_offset():
    """Blocks press at a distance as they do without one."""
    _, contact = compressed("quadrilateral", 2, 4, offset=0.05)
    assert highest(COMM, np.abs(contact.pressures / (0.75 * 0.01 * M) - 1)) < 1e-10
    b = blocks(COMM, "triangle")
    contact = uem.Contact(b.high, b.low, coupling=GaussPoints, friction=0.3)
    raised(
        uem.InputError, "no friction", lambda: uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.01), contacts=[contact])
    )


@pytest.mark.parametrize("cell", CELLS)
def test_balance_on_any_meshes(cell):
    """Forces and moments on both bodies balance to rounding; pressures approach a constant with the number of points."""
    scatter = []
    for degree in (3, 19):
        _, contact = compressed(cell, 3, 4, degree=degree)
        balance = contact.balance()
        assert balance.force < 1e-12 and balance.moment < 1e-12
        scatter.append(highest(COMM, np.abs(contact.pressures / (0.75 * 0.01 * M) - 1)))
    assert scatter[1] < 0.25 * scatter[0] and scatter[0] < 0.01


@pytest.mark.parametrize("target", ["mesh", "ball"])
@pytest.mark.parametrize("cell", CELLS)
def test_rows_and_curvature_against_differences(cell, target):
    """Rows are derivatives of the gaps, and the curvature is the derivative of the forces at constant multipliers."""
    b, contact, problem = over(cell, target)
    pair, config = contact.pair, problem.config
    start, way = 0.01 * np.sin(3 * config.X[:, ::-1]), np.cos(5 * config.X + 1)
    gaps = []
    for h in (1e-6, -1e-6, 0.0):
        b.u.x.array[:] = (start + h * way).ravel()
        pair.project()
        gaps.append(pair.kinematics.gap)
    slope = pair.kinematics.gap_rows.gaps(way[: config.n_owned]) - pair.kinematics.gap
    assert highest(COMM, np.abs((gaps[0] - gaps[1]) / 2e-6 - slope)) < 1e-8
    b.u.x.array[:] = 0.0
    difference, full, plain = (gathered_vector(v) for v in tangent_by_differences(problem, contact))
    error, curvature = np.abs(difference - full).max(), np.abs(full - plain).max()
    assert error < 1e-5 * curvature


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_pressed_on_a_ball(cell):
    """A block on a rigid ball: equilibrium and complementarity (conftest), and the force that mortar finds."""
    own, mortar = (pressed_on_a_ball(cell, coupling) for coupling in (GaussPoints, "mortar"))
    assert 0 < own == pytest.approx(mortar, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("rigid", [False, True])
def test_gradients_of_its_pressures(rigid):
    """The seam is enough for derivatives of pressures, by all but the shape, with which weights over areas as drawn change."""
    s = pressed("triangle", 1, GaussPoints, rigid)
    assert min(orders(s, s.of_pressures, "E", "load", "top", "field", "sides").values()) >= 1.95


def test_gradients_by_the_shape_are_refused():
    """How rows change with the drawing is not part of the seam."""
    s = pressed("triangle", 1, GaussPoints, False)
    problem = s.solve()
    refused(uem.InputError, "a discretisation of one's own", lambda: uem.gradient(problem, s.J, s.X))
