"""Mass of bodies, lumped, consistent and nodal: totals, centres and inertia against closed forms, and what is refused.

The test to read first is ``test_box_against_closed_forms``.
"""

from __future__ import annotations

from math import factorial

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import CELLS, gathered_matrix, highest, linear, lowest
from mass_scenes import BUILD, COMM, KINDS, block, dimension, make

import uem_dolfinx as uem
from uem_dolfinx import compat, forms

# -- totals ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", CELLS)
def test_box_against_closed_forms(cell, degree):
    """Mass, centre and moments of inertia of a homogeneous box, and of one whose density grows along x."""
    g = dimension(cell)
    size = np.array([2.0, 1.0, 0.5][:g])
    V = block(cell, [3, 2, 2][:g], degree, list(size))
    volume, rho = size.prod(), 1.7
    for mass in (consistent := uem.consistent_mass(V, rho), uem.lumped_mass(V, rho)):
        assert mass.total == pytest.approx([rho * volume] * g, rel=1e-13)
        assert mass.centre == pytest.approx(size / 2, rel=1e-13)
    R = consistent.rigid()
    assert R.shape == (1, g * (g + 1) // 2, g * (g + 1) // 2)
    planes = [(i, j) for i in range(g) for j in range(i + 1, g)]
    inertia = [rho * volume * (size[i] ** 2 + size[j] ** 2) / 12 for i, j in planes]
    assert R[0] == pytest.approx(np.diag([rho * volume] * g + inertia), abs=1e-13)

    grows = rho * (1 + ufl.SpatialCoordinate(V.mesh)[0])
    centre = (size[0] / 2 + size[0] ** 2 / 3) / (1 + size[0] / 2)
    for mass in (uem.consistent_mass(V, grows), uem.lumped_mass(V, grows)):
        assert mass.total == pytest.approx([rho * volume * (1 + size[0] / 2)] * g, rel=1e-13)
        assert mass.centre[1:] == pytest.approx(size[1:] / 2, rel=1e-2)
    # 1'Mx is exact if the mass is consistent
    assert uem.consistent_mass(V, grows).centre == pytest.approx([centre, *size[1:] / 2], rel=1e-13)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", CELLS)
def test_consistent_mass_is_the_integral(cell, degree):
    """v'Mv is the integral of rho v.v, for a field that the space holds."""
    V = block(cell, 2, degree)
    X = ufl.SpatialCoordinate(V.mesh)
    mass = uem.consistent_mass(V, 1 + X[0])
    v = fem.Function(V)
    x = mass.config.X
    v.x.array[:] = np.stack([np.sin(3 * x[:, i] + i) + x.sum(axis=1) for i in range(x.shape[1])], axis=1).ravel()
    y = mass.M.createVecLeft()
    mass.M.mult(compat.petsc_vector(v), y)
    exact = forms.assemble_scalar(forms.form((1 + X[0]) * ufl.inner(v, v) * ufl.dx), COMM)
    assert y.dot(compat.petsc_vector(v)) == pytest.approx(exact, rel=1e-13)


def simplex_shares(g):
    """Diagonal of the consistent mass of one P2 simplex, over its trace: at a vertex, and at an edge's middle.

    From ``integral of l1^a l2^b = a! b! g! / (a + b + g)!`` of a unit volume.
    """

    def integral(a, b=0):
        return factorial(a) * factorial(b) * factorial(g) / factorial(a + b + g)

    vertex = 4 * integral(4) - 4 * integral(3) + integral(2)
    edge = 16 * integral(2, 2)
    trace = (g + 1) * vertex + g * (g + 1) / 2 * edge
    return vertex / trace, edge / trace


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", CELLS)
def test_lumped_mass_cell_by_cell(cell, degree):
    """Nodal masses of equal cells against a sum over the cells, with the shares of each kind of cell."""
    g = dimension(cell)
    V = block(cell, [2, 3, 2][:g], degree)
    mass = uem.lumped_mass(V, 1.3)
    config, table = mass.config, compat.cell_dofs(V)
    n_cells = V.mesh.topology.index_map(g).size_local
    number = COMM.allreduce(n_cells)
    if degree == 1:
        shares = np.full(table.shape[1], 1.0 / table.shape[1])
    elif cell in ("triangle", "tetrahedron"):
        vertex, edge = simplex_shares(g)
        shares = np.array([vertex] * (g + 1) + [edge] * (table.shape[1] - g - 1))
    else:
        # Simpson's rule: a middle counts four times as much as an end, in every direction
        dims = [d for d, entities in enumerate(forms.reference_topology(cell)) for _ in entities]
        shares = 4.0 ** np.array(dims) / 6.0**g
    assert shares.sum() == pytest.approx(1.0)
    expected = np.zeros(config.n_local)
    for nodes in table[:n_cells]:
        expected[nodes] += 1.3 / number * shares
    expected = config.to_owners(np.arange(config.n_local), expected)[: config.n_owned]
    assert highest(COMM, np.abs(mass.of_nodes / expected[:, None] - 1)) < 1e-12
    assert mass.diagonal and lowest(COMM, mass.of_nodes) > 0


def test_row_sums_where_they_are_positive():
    """A density that varies inside the cells is lumped by rows of the consistent matrix."""
    V = block("quadrilateral", 3, pose=lambda x: x + 0.1 * np.sin(5 * x[:, ::-1]))
    rho = 1 + ufl.SpatialCoordinate(V.mesh)[1] ** 2
    M = gathered_matrix(uem.consistent_mass(V, rho).M)
    assert np.abs(np.diag(gathered_matrix(uem.lumped_mass(V, rho).M)) - M.sum(axis=1)).max() < 1e-14 * M.max()


@pytest.mark.parametrize("degree", [1, 2])
def test_graded_triangles_keep_their_centre(degree):
    lumped = uem.lumped_mass(block("triangle", 4, degree, pose=lambda x: x**2), 2.0)
    assert lumped.centre == pytest.approx([0.5, 0.5], rel=1e-13) and lumped.total == pytest.approx([2.0, 2.0], rel=1e-13)


@pytest.mark.long
def test_density_of_any_kind():
    """Number, Constant, Function and expression weigh the same."""
    V = block("triangle", 3)
    f = fem.Function(compat.function_space(V.mesh, ("DG", 0)))
    f.x.array[:] = 2.0
    for rho in (2, np.float32(2.0), np.int64(2), fem.Constant(V.mesh, 2.0), f, 0.5 * f + 1.0, ufl.as_ufl(2.0)):
        for build in BUILD.values():
            assert build(V, rho).total == pytest.approx([2.0, 2.0], rel=1e-13)
    nothing = uem.consistent_mass(V, 0)
    assert not nothing.total.any() and np.isnan(nothing.centre).all() and highest(COMM, nothing.of_nodes) == 0.0
    assert nothing.without(np.arange(nothing.config.n_owned)) is nothing


def test_layout_is_that_of_the_tangent():
    V = block("tetrahedron", 2)
    u = fem.Function(V)
    K = forms.create_matrix(forms.form(ufl.derivative(linear(u, 1.0), u)))
    for kind in KINDS:
        M = make(kind, V).M
        assert M.getSizes() == K.getSizes() and M.getBlockSizes() == K.getBlockSizes() and M.type == K.type
        entries = COMM.allreduce(len(M.getValuesCSR()[2]))
        assert (entries == M.getSize()[0]) == make(kind, V).diagonal


def test_nodal_mass():
    """Unit masses in x and y on chosen nodes; mass in y only; arrays and functions alike."""
    V = block("quadrilateral", [1, 4])
    chosen = uem.nodal_mass(V, lambda x: np.where(x[:, 1] > 0.3, 1.0, 0.0))
    assert chosen.total == pytest.approx([6.0, 6.0]) and chosen.centre == pytest.approx([0.5, 0.75])
    only_y = uem.nodal_mass(V, lambda x: np.column_stack([0 * x[:, 0], 1 + x[:, 0]]))
    assert only_y.total == pytest.approx([0.0, 15.0])
    for mass, values in ((only_y, only_y.of_nodes), (chosen, chosen.of_nodes[:, 0])):
        assert np.array_equal(gathered_matrix(uem.nodal_mass(V, values).M), gathered_matrix(mass.M))


# -- refusals ----------------------------------------------------------------------------------------------------------


def test_refused_densities():
    V = block("triangle", 2)
    f = fem.Function(compat.function_space(V.mesh, ("DG", 0)))
    f.x.array[:] = 1.0
    f.x.array[f.x.array.size // 2 :] = -1.0
    for build in BUILD.values():
        for rho, message in (
            (-1.0, r"cell at \(.*\) has the mass -0.125"),
            (np.nan, "has the mass nan"),
            (f, "has the mass -0.125"),
            (ufl.SpatialCoordinate(V.mesh), "has shape"),
            ("heavy", "'heavy' is neither a number"),
            (None, "None is neither a number"),
        ):
            with pytest.raises(uem.MassError, match=message):
                build(V, rho)
        with pytest.raises(uem.SpaceError, match="another mesh"):
            build(V, fem.Function(compat.function_space(block("triangle", 1).mesh, ("DG", 0))))
        with pytest.raises(uem.SpaceError, match="use a vector Lagrange space"):
            build(compat.function_space(V.mesh, 1), 1.0)


def test_refused_nodal_masses():
    V = block("triangle", 3)
    with pytest.raises(uem.MassError, match=r"negative or not finite"):
        uem.nodal_mass(V, lambda x: x[:, 0] - 0.1)
    with pytest.raises(uem.MassError, match=r"mass \[nan nan\] of the node at \(.*, .*\) is"):
        uem.nodal_mass(V, lambda x: np.where((x < 1e-9).all(axis=1), np.nan, 1.0))
    n = uem.lumped_mass(V, 1.0).config.n_owned
    with pytest.raises(uem.MassError, match=r"have shape \(\d+, 3\)"):
        # wrong on the last rank only, raised on all
        uem.nodal_mass(V, np.ones((n, 3 if COMM.rank == COMM.size - 1 else 2)))
