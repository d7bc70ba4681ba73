"""Contact against closed forms: uniform pressure through nested meshes, finite strain, gaps, bodies in series.

The test to read first is ``test_patch`` (a constant stress passes a nested interface to rounding, whatever the stiffnesses).
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import CELLS, M, at, blocks, box, clamp, complementary, highest, linear, modulus, run, scene, st_venant
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

COMM = MPI.COMM_WORLD


def vertical(b, settlement_low, settlement_high, gap=0.0):
    """Exact nodal displacement of two homogeneously compressed blocks, in the drawing's order."""
    z = b.scene.drawing[:, -1]
    lower = np.arange(len(z)) < len(z) - b.n_high_nodes
    exact = np.zeros((len(z), b.gdim))
    exact[lower, -1] = -settlement_low * (z[lower] + 1)
    exact[~lower, -1] = -settlement_low - gap - settlement_high * (z[~lower] - gap)
    return exact


# -- closed forms ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell,finer,ratio", [*product(CELLS, ("upper", "lower"), (1e-3, 1.0, 1e6))])
def test_patch(cell, finer, ratio):
    """Nested meshes, the finer side the contactor: force, pressure and every nodal displacement are the closed form's."""
    d = 0.01
    n_low, n_high = (2, 4) if finer == "upper" else (4, 2)
    b = blocks(COMM, cell, n_low, n_high)
    pair = (b.high, b.low) if finer == "upper" else (b.low, b.high)
    contact = uem.Contact(*pair)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, ratio)), b.u, bcs=b.oedometer(d), contacts=[contact])
    run(problem)
    low, high = d * ratio / (1 + ratio), d / (1 + ratio)
    force = M * low
    side = 1.0 if finer == "upper" else -1.0
    # forces are read from the contactor's own residual, whose rounding grows with its stiffness
    assert contact.resultant().force[-1] == pytest.approx(side * force, rel=1e-9 if ratio <= 1 else 1e-8)
    assert np.abs(contact.resultant().force[:-1]).max() < 1e-11 * force
    pressures = contact.pressures
    assert highest(COMM, np.abs(pressures / force - 1)) < (1e-9 if ratio <= 1 else 1e-6)
    assert contact.n_active == (max(n_low, n_high) + 1) ** (b.gdim - 1)
    exact = vertical(b, low, high)
    assert np.abs(b.scene.gather(b.u) - exact).max() < 1e-11 * d
    complementary(contact, 1e-13, 1e-14 * force)
    assert contact.balance().force < 1e-12 and contact.balance().moment < 1e-12


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_finite_strain_closed_form(cell):
    """Two St Venant-Kirchhoff blocks in series, a quarter of the height of one: M e (1 - e)(2 - e) / 2 on both sides."""
    d, ratio = 0.25, 3.0
    b = blocks(COMM, cell, 1, 2)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, ratio)), b.u, bcs=b.oedometer(d), contacts=[contact])
    run(problem)

    def law(e):
        return M * e * (1 - e) * (2 - e) / 2

    low, high = 0.0, d
    for _ in range(100):
        e = (low + high) / 2
        low, high = (e, high) if law(e) < ratio * law(d - e) else (low, e)
    assert contact.resultant().force[-1] == pytest.approx(law(e), rel=1e-9)
    assert np.abs(b.scene.gather(b.u) - vertical(b, e, d - e)).max() < 1e-9


@pytest.mark.parametrize("cell", ["quadrilateral", "tetrahedron"])
def test_closing_a_gap(cell):
    """No force before the gap is closed, the series stiffness after."""
    gap = 0.025
    b = blocks(COMM, cell, 2, 4, gap=gap)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=b.oedometer(0.05), contacts=[contact])
    for step in uem.load_steps(problem, 5):
        closed = max(0.0, 0.05 * step.factor - gap)
        assert contact.resultant().force[-1] == pytest.approx(M * closed * 2 / 3, abs=1e-12)
        assert (contact.n_active > 0) == (closed > 0)
        complementary(contact, 1e-13, 1e-15)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_body_held_by_contact_alone(cell):
    """A block that only the contact holds up carries exactly its load."""
    b = blocks(COMM, cell, 2, 4)
    g = b.gdim
    load = fem.Constant(b.scene.mesh, PETSc.ScalarType(0.0))
    v = ufl.TestFunction(b.V)
    F = linear(b.u, modulus(b.scene, 1.0, 2.0)) + 0.01 * load * v[g - 1] * forms.surface_measure(b.scene.mesh, b.top.entities)
    bcs = [*clamp(b.V, b.bottom, g - 1)]
    for c, end, body in product(range(g - 1), (0.0, 1.0), (0, 1)):
        bcs += clamp(b.V, b.scene.tag("side", body, at(c, end)), c)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], load=load)
    for step in uem.load_steps(problem, 2):
        assert contact.resultant().force[-1] == pytest.approx(0.01 * step.factor, rel=1e-10)
        assert np.abs(b.scene.gather(b.u) - vertical(b, 0.01 * step.factor / M, 0.005 * step.factor / M)).max() < 1e-12


@pytest.mark.parametrize("sliding", ["finite", "small", "fixed"])
@pytest.mark.parametrize("normals", ["facet", "averaged"])
def test_every_kind_of_sliding_passes_the_patch(sliding, normals):
    b = blocks(COMM, "quadrilateral", 2, 4)
    contact = uem.Contact(b.high, b.low, sliding=sliding, normals=normals)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(0.01), contacts=[contact])
    run(problem, 2)
    assert np.abs(b.scene.gather(b.u) - vertical(b, 0.005, 0.005)).max() < 1e-14


@pytest.mark.parametrize("degree", [2])
def test_patch_of_degree_two(degree):
    b = blocks(COMM, "triangle", 2, 2, degree=degree)
    contact = uem.Contact(b.high, b.low)
    problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 1.0)), b.u, bcs=b.oedometer(0.01), contacts=[contact])
    run(problem)
    x, u = problem.config.X, problem.config.displacement
    # upper and lower sides of the interface both move by half
    assert highest(COMM, np.abs(u[np.abs(x[:, 1]) < 1e-9, 1] + 0.005)) < 1e-13
    assert contact.resultant().force[-1] == pytest.approx(0.005 * M, rel=1e-10)


def test_two_pairs_and_a_rigid_floor():
    """Stacked bodies on a rigid plane: three contacts in series carry one force."""
    g = 2
    bodies = [box("quadrilateral", [0.0, k], [1.0, k + 1.0], [n, 2]) for k, n in ((0.0, 1), (1.0, 2), (2.0, 4))]
    s = scene(COMM, "quadrilateral", bodies)
    V = compat.function_space(s.mesh, 1, (g,))
    u = fem.Function(V)
    sides = [bc for body in range(3) for end in (0.0, 1.0) for bc in clamp(V, s.tag("side", body, at(0, end)), 0)]
    top = s.tag("top", 2, at(1, 3.0))
    contacts = [
        uem.Contact(s.tag("floor", 0, at(1, 0.0)), uem.RigidPlane((0.0, 0.0), (0.0, 1.0))),
        uem.Contact(s.tag("second", 1, at(1, 1.0)), s.tag("first", 0, at(1, 1.0))),
        uem.Contact(s.tag("third", 2, at(1, 2.0)), s.tag("second top", 1, at(1, 2.0))),
    ]
    problem = uem.UnitedProblem(
        linear(u, modulus(s, 1.0, 2.0, 4.0)), u, bcs=[*sides, *clamp(V, top, 1, value=-0.07)], contacts=contacts
    )
    run(problem)
    force = M * 0.07 / (1 + 1 / 2 + 1 / 4)
    for contact in contacts:
        assert contact.resultant().force[1] == pytest.approx(force, rel=1e-10)
        complementary(contact, 1e-13, 1e-14)
    assert contacts[0].balance() is None
