"""Contactors on the facets, vertices and ends of a polygon, on its rim and in its grooves; every state is complementary.

The test to read first is ``test_sliding_along_a_polygon``.
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import arch, at, blocks, box, clamp, complementary, highest, linear, modulus, run, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD


def sliding_block(cell, height, normals, start=0.0, n_low=8, length=2.0, offset=0.0):
    """A block, narrower than the polygon below it, on its way from left to right."""
    g = 2 if cell == "triangle" else 3
    low = box(cell, [-0.5, *[-0.25] * (g - 2), -1.0], [length - 0.5, *[1.25] * (g - 2), 0.0], [n_low, *[2] * (g - 2), 2])
    high = box(cell, [start, *[0.0] * (g - 2), offset], [start + 0.5, *[1.0] * (g - 2), offset + 0.5], [2, *[2] * (g - 2), 2])
    s = scene(COMM, cell, [low, high], pose=arch(height))
    V = compat.function_space(s.mesh, 1, (g,))
    u = fem.Function(V)
    tags = [s.tag("bottom", 0, at(g - 1, -1.0)), s.tag("low", 0, at(g - 1, 0.0))]
    tags += [s.tag("high", 1, at(g - 1, offset)), s.tag("top", 1, at(g - 1, offset + 0.5))]
    return s, V, u, tags


@pytest.mark.parametrize(
    ("cell", "height", "normals"),
    [
        *product(["triangle"], [0.15, -0.15], ["facet", "averaged"]),
        pytest.param("hexahedron", -0.15, "facet", marks=pytest.mark.slow),
        pytest.param("hexahedron", 0.15, "averaged", marks=pytest.mark.slow),
        pytest.param("hexahedron", 0.15, "facet", marks=pytest.mark.slow),
        pytest.param("hexahedron", -0.15, "averaged", marks=pytest.mark.slow),
    ],
)
def test_sliding_along_a_polygon(cell, height, normals):
    """Over several facets and vertices of an arch or a bowl, starting exactly on a vertex; no step is cut, none cycles."""
    # the block's corners start above nodes of the polygon
    offset = 0.0 if height > 0 else -height / 4
    s, V, u, (bottom, low, high, top) = sliding_block(cell, height, normals, offset=offset)
    g = V.mesh.geometry.dim
    path = fem.Function(V)
    dofs = fem.locate_dofs_topological(V, g - 1, top.entities)
    contact = uem.Contact(high, low, normals=normals, max_penetration=0.2)

    def load(factor):
        p = path.x.array.reshape(-1, g)
        middle = 0.25 + factor
        p[:, 0] = factor
        # follow the polygon's parabola, pressed in a little
        p[:, -1] = -height * (middle - 0.5) ** 2 - 0.02 - offset / 2

    problem = uem.UnitedProblem(
        st_venant(u, modulus(s, 1.0, 2.0)), u, bcs=[*clamp(V, bottom), fem.dirichletbc(path, dofs)], contacts=[contact], load=load
    )
    touched, facets = [], set()
    for step in uem.load_steps(problem, 16):
        assert step.cuts == 0 and step.newton_iterations <= 12
        complementary(contact, 1e-12, 1e-10)
        touched.append(contact.n_active)
        facets |= {
            int(f) for part in COMM.allgather(contact.pair.kinematics.projection.facet[contact.pair.trial.active]) for f in part
        }
    assert min(touched[1:]) > 0
    assert len(facets) > 3


@pytest.mark.parametrize("normals", ["facet", "averaged"])
def test_sliding_off_the_end(normals):
    """Past the end of the target a contactor is let go, one after the other, and the last force is gone with the last of them."""
    s, V, u, (bottom, low, high, top) = sliding_block("triangle", 0.0, normals, start=0.9, offset=0.0)
    path = fem.Function(V)
    dofs = fem.locate_dofs_topological(V, 1, top.entities)
    contact = uem.Contact(high, low, normals=normals)

    def load(factor):
        path.x.array.reshape(-1, 2)[:] = [0.8 * factor, -0.01]

    problem = uem.UnitedProblem(
        linear(u, modulus(s, 1.0, 1.0)), u, bcs=[*clamp(V, bottom), fem.dirichletbc(path, dofs)], contacts=[contact], load=load
    )
    counts = []
    for step in uem.load_steps(problem, 16):
        counts.append(contact.n_active)
        complementary(contact, 1e-13, 1e-12)
        # the end of the flat target has moved by a few per cent at most
        assert highest(COMM, contact.pair.points[contact.pair.trial.active, 0]) < 1.55
    assert counts[0] == 3 and counts[-1] == 0 and (np.diff(counts) <= 0).all()
    assert np.abs(contact.resultant().force).max() == 0.0


@pytest.mark.parametrize("normals", ["facet", "averaged"])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
def test_contactor_exactly_on_a_vertex(cell, normals):
    """Matching meshes over a roof: every contactor starts on a vertex, the middle ones on a ridge.

    On a ridge the facets' normals have no balance but on one of its slopes; averaged normals keep the symmetry of the scene.
    """

    def roof(x):
        y = x.copy()
        y[:, -1] -= 0.3 * np.abs(x[:, 0] - 0.5) * np.where(x[:, -1] <= 0.5, 1.0, 2 * (1 - x[:, -1]) if x.shape[1] else 0.0)
        return y

    b = blocks(COMM, cell, 2, 2, pose=roof)
    contact = uem.Contact(b.high, b.low, normals=normals, max_penetration=0.1)
    slide = [0.0] * (b.gdim - 1) + [-0.02]
    problem = uem.UnitedProblem(
        st_venant(b.u, modulus(b.scene, 1.0, 1.0)),
        b.u,
        bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=slide)],
        contacts=[contact],
    )
    steps = run(problem, 2)
    assert max(s.newton_iterations for s in steps) <= (8 if normals == "facet" else 12) and not any(s.cuts for s in steps)
    complementary(contact, 1e-13, 1e-12)
    u, x = b.scene.gather(b.u), b.scene.drawing
    sign, lower = np.r_[-1.0, np.ones(b.gdim - 1)], np.arange(len(x)) < len(x) - b.n_high_nodes
    ridge = (np.abs(x[:, 0] - 0.5) < 1e-9) & (np.abs(x[:, -1]) < 1e-9)
    if cell != "triangle" and normals == "averaged":
        # triangles have diagonals, and facets' normals no balance on the ridge: all else mirrors itself
        turned = np.linalg.norm(x[:, None] * sign + (1 - sign) / 2 - x[None], axis=2) + 2 * (lower[:, None] != lower)
        assert np.abs(u - sign * u[turned.argmin(axis=1)]).max() < 1e-9
    assert u[ridge, -1].max() < -0.005
    assert contact.resultant().force[-1] > 0


@pytest.mark.parametrize("cell,ratio", [*product(("quadrilateral", "tetrahedron", "hexahedron"), (0.2, 5.0))])
def test_contactors_on_the_rim_of_the_target(cell, ratio):
    """Equal blocks with free sides: the softer bulges past the stiffer one's rim, where contactors sit from the start."""
    b = blocks(COMM, cell, 2, 4 if b_is_flat(cell) else 3)
    g = b.gdim
    contact = uem.Contact(b.high, b.low)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=[0.0] * (g - 1) + [-0.1])]
    problem = uem.UnitedProblem(st_venant(b.u, modulus(b.scene, 1.0, ratio)), b.u, bcs=bcs, contacts=[contact])
    for step in uem.load_steps(problem, 2):
        assert step.cuts == 0 and step.newton_iterations <= 20
        complementary(contact, 1e-12, 1e-10)
    assert contact.n_active > 1


def b_is_flat(cell):
    """Whether cells are two-dimensional."""
    return cell in ("triangle", "quadrilateral")


@pytest.mark.parametrize("normals", ["facet", "averaged"])
@pytest.mark.parametrize("off_centre", [0.0, 0.02, -0.03])
def test_tip_in_a_groove(normals, off_centre):
    """A wedge's tip falls into a V-shaped groove and is held by both of its faces, wherever it came down."""
    low = box("triangle", [0.0, -1.0], [1.0, 0.0], [2, 2]).mapped(
        lambda x: x + np.outer((x[:, 1] + 1) * np.abs(x[:, 0] - 0.5), [0, 0.8])
    )
    high = box("triangle", [0.3 + off_centre, 0.05], [0.7 + off_centre, 0.9], [2, 2])
    # steeper than the groove, so that nothing but the tip touches
    high = high.mapped(lambda x: x + np.outer((0.9 - x[:, 1]) * np.abs(x[:, 0] - 0.5 - off_centre), [0, 1.5]))
    s = scene(COMM, "triangle", [low, high])
    V = compat.function_space(s.mesh, 1, (2,))
    u = fem.Function(V)
    bottom = s.tag("bottom", 0, at(1, -1.0))
    groove = s.tag("groove", 0, lambda x: np.abs(x[:, 1] - 0.8 * np.abs(x[:, 0] - 0.5)) < 1e-9)
    tip = s.tag("tip", 1, lambda x: np.abs(x[:, 1] - 0.05 - 0.85 * 1.5 * np.abs(x[:, 0] - 0.5 - off_centre)) < 1e-9)
    top = s.tag("top", 1, at(1, 0.9))
    contact = uem.Contact(tip, groove, normals=normals)
    problem = uem.UnitedProblem(
        linear(u, modulus(s, 1.0, 1.0)), u, bcs=[*clamp(V, bottom), *clamp(V, top, value=[0.0, -0.1])], contacts=[contact]
    )
    for step in uem.load_steps(problem, 4):
        assert step.newton_iterations <= (12 if normals == "facet" else 30)
        complementary(contact, 1e-13, 1e-12)
    assert contact.n_active == 1
    force = contact.resultant().force
    assert force[1] > 1e-3
    if normals == "facet":
        # the tip rests in the corner: it and the corner are one point, and neither face pulls
        place = s.gather(u) + s.drawing
        corner = place[np.linalg.norm(s.drawing - [0.5, 0.0], axis=1).argmin()]
        apex = place[np.linalg.norm(s.drawing - [0.5 + off_centre, 0.05], axis=1).argmin()]
        assert np.abs(corner - apex).max() < 1e-12
        assert abs(force[0]) <= 0.8 * force[1] * (1 + 1e-9)
