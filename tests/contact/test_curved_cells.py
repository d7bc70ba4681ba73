"""Contact of cells whose geometry is of degree 2, and chords of curved facets.

The test to read first is ``test_arch_of_curved_cells``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from dolfinx import mesh as dmesh
from helpers import MESHES, NU, arch, blocks, box, clamp, complementary, factors, highest, lawful, linear, modulus, run, st_venant
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.shapes import facet_shape

COMM = MPI.COMM_WORLD


def test_hertz_on_curved_cells():
    """Degree-2 cells that follow the arc, coarse: peak pressure and half width of Hertz at the computed force."""
    E, R = 1e6, 3.0
    mesh, tags = uem.read_gmsh(MESHES / "hertz_cylinder.geo", COMM, gdim=2, parameters={"h": 1 / 30, "order": 2})
    V = compat.function_space(mesh, 2, (2,))
    u = fem.Function(V)
    bcs = [*clamp(V, tags["symmetry"], 0), *clamp(V, tags["block_bottom"], 1), *clamp(V, tags["disc_top"], 1, value=-0.006)]
    contact = uem.Contact(tags["disc_arc"], tags["block_top"])
    problem = uem.UnitedProblem(linear(u, fem.Constant(mesh, PETSc.ScalarType(E))), u, bcs=bcs, contacts=[contact], rtol=1e-10)
    for _ in uem.load_steps(problem, 2):
        lawful(contact, force=E)
    P = 2 * contact.resultant().force[1]
    E_star = E / (2 * (1 - NU**2))
    p0 = np.sqrt(P * E_star / (np.pi * R))
    a = 2 * P / (np.pi * p0)
    assert contact.max_pressure() == pytest.approx(p0, rel=0.05)
    x = contact.pair.points[:, 0]
    assert highest(COMM, x[contact.pair.trial.active]) == pytest.approx(a, abs=1 / 30)
    # moment of the half profile about the axis: the integral of p x
    assert contact.resultant().moment[0] == pytest.approx(p0 * a**2 / 3, rel=0.03)


# -- curved geometry -----------------------------------------------------------------------------------------------------------


def curved_blocks(cell, comm=COMM):
    """A block over an arch, both in cells of degree 2 whose nodes lie on the arch; none of the contactors is above a vertex."""
    # nodes of the cells of degree 2 in Gmsh's order, on a grid of half cells
    ring = [(0, 0), (2, 0), (2, 2), (0, 2)]
    if cell == "quadrilateral":
        kinds = [[*ring, (1, 0), (2, 1), (1, 2), (0, 1), (1, 1)]]
    else:
        kinds = [[(0, 0), (2, 0), (2, 2), (1, 0), (2, 1), (1, 1)], [(0, 0), (2, 2), (0, 2), (1, 1), (1, 2), (0, 1)]]
    points, cells, first = [], [], 0
    for lo, hi, n in (((-0.5, -1.0), (1.5, 0.0), (5, 2)), ((0.0, 0.1), (1.0, 1.1), (3, 3))):
        grid = box("quadrilateral", lo, hi, (2 * n[0], 2 * n[1]))
        stride = np.array([2 * n[1] + 1, 1])
        corner = np.stack(np.meshgrid(2 * np.arange(n[0]), 2 * np.arange(n[1]), indexing="ij"), axis=-1).reshape(-1, 2) @ stride
        cells += [first + corner[:, None] + np.array(k) @ stride for k in kinds]
        points.append(arch(0.3)(grid.x))
        first += len(grid.x)
    x, cells = np.concatenate(points), np.concatenate(cells).astype(np.int64)
    given_ = slice(None) if comm.rank == 0 else slice(0)
    used = np.unique(cells)
    place = np.zeros(len(x), np.int64)
    place[used] = np.arange(len(used))
    mesh = compat.create_mesh(comm, place[cells][given_], x[used][given_], cell, 2)
    for a, b in ((1, 0), (1, 2)):
        mesh.topology.create_connectivity(a, b)

    def tag(name, where):
        return uem.Tag(name, 1, 1, mesh, dmesh.locate_entities_boundary(mesh, 1, where).astype(np.int32))

    tags = [
        tag("bottom", lambda x: np.abs(x[1] + 1) < 1e-9), tag("low", lambda x: np.abs(x[1] + 0.3 * (x[0] - 0.5) ** 2) < 1e-9),
        tag("high", lambda x: np.abs(x[1] - 0.1) < 1e-9), tag("top", lambda x: np.abs(x[1] - 1.1) < 1e-9),
    ]  # fmt: skip
    return mesh, tags


@pytest.mark.parametrize("arch_presses", [False, True])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_arch_of_curved_cells(cell, arch_presses):
    """The arch as target and as contactor: lawful, quadratic, alike on any number of ranks, and first touched at its crown."""
    answers = []
    for comm in (COMM, MPI.COMM_SELF):
        mesh, (bottom, low, high, top) = curved_blocks(cell, comm)
        V = compat.function_space(mesh, 2, (2,))
        u, lid = fem.Function(V), fem.Function(V)
        contact = uem.Contact(*((low, high) if arch_presses else (high, low)), max_penetration=0.2)
        dofs = fem.locate_dofs_topological(V, 1, top.entities)

        def load(factor, lid=lid):
            lid.x.array.reshape(-1, 2)[:, 1] = -0.1 - 0.05 * factor

        problem = uem.UnitedProblem(
            st_venant(u, fem.Constant(mesh, PETSc.ScalarType(1.0))), u, bcs=[*clamp(V, bottom), fem.dirichletbc(lid, dofs)],
            contacts=[contact], load=load, rtol=1e-11,
        )  # fmt: skip
        seen = []
        for step in uem.load_steps(problem, 3):
            lawful(contact)
            seen += factors(step.iterations)
        assert len(seen) >= 2 and max(seen) < 20
        answers.append(contact.resultant().force)
        centre = contact.resultant().moment[0] / contact.resultant().force[1]
        # the pressure's middle is the crown's
        assert centre == pytest.approx(0.5, abs=0.02)
    assert np.abs(answers[0] - answers[1]).max() < 1e-9 * np.abs(answers[1]).max()


def test_chords_change_the_way_but_not_the_answer():
    """Straight pieces in P alone [UEM, 4.5]: the same state to rounding, after more iterations."""
    found = {}
    for chords in (False, True):
        pose = lambda x: x + np.array([0.0, -0.2]) * ((x[:, :1] - 0.5) ** 2) * (x[:, 1:] <= 1e-12) * (x[:, 1:] + 1)  # noqa: E731
        b = blocks(COMM, "triangle", 5, 4, gap=0.02, degree=2, overhang=0.25, pose=pose)
        contact = uem.Contact(b.high, b.low, chords=chords)
        bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.03, -0.06])]
        problem = uem.UnitedProblem(linear(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact], rtol=1e-10)
        steps = run(problem, 2)
        found[chords] = contact.resultant().force, sum(s.newton_iterations for s in steps), contact.n_active
        complementary(contact, 1e-12, 1e-10)
    assert np.allclose(found[True][0], found[False][0], rtol=1e-8)
    assert found[True][2] == found[False][2] > 2
    assert found[True][1] > found[False][1]


@pytest.mark.parametrize("kind", ["interval", "triangle", "quadrilateral"])
def test_chords_interpolate_between_neighbouring_nodes(kind):
    shape, rng = facet_shape(kind, 2), np.random.default_rng(4)
    xi = rng.random((200, shape.dim))
    xi = np.concatenate([xi[shape.contains(xi)], shape.nodes])
    w = shape.chords(xi)
    assert w.min() >= 0.0 and np.abs(w.sum(axis=1) - 1).max() < 1e-15
    assert np.abs(w @ shape.nodes - xi).max() < 1e-15
    assert np.abs(w[-len(shape.nodes) :] - np.eye(len(shape.nodes))).max() < 1e-15
