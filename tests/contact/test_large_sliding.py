"""Sliding far: over many facets, vertices and corners, off the end of the target and back again, lawful after every step.

Two tests to read first: ``test_there_and_back`` (without friction the way back passes the states of the way there) and
``test_off_the_end_and_back``.
"""

from __future__ import annotations

from itertools import product

from mpi4py import MPI

import numpy as np
import pytest
from dolfinx import fem
from helpers import at, blocks, box, clamp, highest, lawful, linear, modulus, run, scene, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat

COMM = MPI.COMM_WORLD
NORMALS = ("facet", "averaged")


def slider(cell, way, *, pose=lambda x: x, target=None, normals="facet", start=0.4, gap=0.0, **how):
    """A small block led by its lid along ``way(factor) -> (gdim,)`` over a slab ``[0, 3] x [-0.75, 0]``; ``pose`` bends both."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3
    low = box(cell, [0.0, *[-0.2] * (g - 2), -0.75], [3.0, *[0.6] * (g - 2), 0.0], [12, *[2] * (g - 2), 3])
    high = box(cell, [start, *[0.0] * (g - 2), gap], [start + 0.4, *[0.4] * (g - 2), 0.4 + gap], [2, *[1] * (g - 2), 2])
    s = scene(COMM, cell, [low, high], pose=pose)
    V = compat.function_space(s.mesh, 1, (g,))
    u, place = fem.Function(V), fem.Function(V)
    lid, base = s.tag("lid", 1, at(g - 1, 0.4 + gap)), s.tag("base", 0, at(g - 1, -0.75))
    bcs = [*clamp(V, base), fem.dirichletbc(place, fem.locate_dofs_topological(V, g - 1, lid.entities))]
    contact = uem.Contact(
        s.tag("high", 1, at(g - 1, gap)),
        s.tag("target", 0, target or at(g - 1, 0.0)),
        normals=normals,
        max_penetration=0.1,
        **how,
    )

    def load(factor):
        place.x.array.reshape(-1, g)[:] = way(factor)

    problem = uem.UnitedProblem(st_venant(u, modulus(s, 1.0, 2.0)), u, bcs=bcs, contacts=[contact], rtol=1e-10, load=load)
    return s, contact, problem


def facets_met(contact):
    """Facets under active contactors, on all ranks."""
    pair = contact.pair
    return {int(f) for part in COMM.allgather(pair.kinematics.projection.facet[pair.trial.active]) for f in part}


def waved(height):
    """Bend the slab's top into a wave with vertices convex and concave, and leave the block as it is."""

    def pose(x):
        y = x.copy()
        y[:, -1] += np.where(x[:, -1] <= 1e-9, height * np.sin(2 * np.pi * x[:, 0] / 1.5) * (1 + x[:, -1] / 0.75), 0.0)
        return y

    return pose


@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_small_sliding_searches_once_a_step(cell, coupling):
    """Down a wave the error of small sliding falls with the length of the steps; of rows that are never made again it stays."""

    def force(n, sliding):
        _, contact, problem = slider(
            cell, lambda factor: (0.3 * factor, -0.04), pose=waved(0.03), coupling=coupling, sliding=sliding
        )
        for _ in uem.load_steps(problem, n):
            pass
        return contact.resultant().force[1]

    finite, coarse, fine = force(3, "finite"), force(4, "small"), force(12, "small")
    assert finite > 0 and abs(fine - finite) < 0.7 * abs(coarse - finite)


@pytest.mark.long
@pytest.mark.parametrize(
    ("cell", "normals"),
    [
        *product(["triangle"], NORMALS), ("quadrilateral", "facet"),
        pytest.param("quadrilateral", "averaged", marks=pytest.mark.slow),
        *(pytest.param("hexahedron", how, marks=pytest.mark.slow) for how in NORMALS),
    ],
)  # fmt: skip
def test_over_vertices_convex_and_concave(cell, normals):
    """Up and down along a wave of facets, pressed onto it all the way."""
    g, height = (3 if cell == "hexahedron" else 2), 0.05

    def way(factor):
        s = 1.6 * factor
        # along the wave under the block's middle, from above its crest
        return [s, *[0.0] * (g - 2), height * np.sin(2 * np.pi * (s + 0.6) / 1.5) - height - 0.05 * min(1.0, 10 * factor)]

    _, contact, problem = slider(cell, way, pose=waved(height), normals=normals, gap=height)
    met = set()
    for _ in uem.load_steps(problem, 16):
        lawful(contact)
        met |= facets_met(contact)
        assert contact.n_active > 0
    assert len(met) >= 6


@pytest.mark.parametrize("normals", NORMALS)
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
@pytest.mark.slow
def test_there_and_back(cell, normals):
    """Over half of a wave and back: each state on the way back is the one on the way there."""
    g, height = (3 if cell == "hexahedron" else 2), 0.03

    def way(factor):
        s = 0.8 * (1 - abs(1 - 2 * factor))
        return [s, *[0.0] * (g - 2), -0.05]

    s, contact, problem = slider(cell, way, pose=waved(height), normals=normals)
    states = {}
    for step in uem.load_steps(problem, 16):
        lawful(contact)
        states[round(16 * step.factor, 9)] = (contact.resultant().force, s.gather(problem.u))
    for k in range(1, 8):
        (force, u), (later, v) = states[k], states[16 - k]
        assert np.abs(force - later).max() < 1e-6 * np.abs(force).max()
        assert np.abs(u - v).max() < 1e-6


@pytest.mark.parametrize(
    ("cell", "normals"),
    [*product(["triangle"], NORMALS), *(pytest.param("hexahedron", how, marks=pytest.mark.slow) for how in NORMALS)],
)
def test_off_the_end_and_back(cell, normals):
    """Past the end nothing holds the block, not even a line that the last facet points along; back on it, all is as before."""
    g = 3 if cell == "hexahedron" else 2

    def way(factor):
        return [1.2 * (1 - abs(1 - 2 * factor)), *[0.0] * (g - 2), -0.03]

    s, contact, problem = slider(cell, way, normals=normals, start=2.2)
    states, counts = {}, []
    for step in uem.load_steps(problem, 16):
        lawful(contact)
        states[round(16 * step.factor, 9)] = (contact.resultant().force, s.gather(problem.u))
        counts.append((step.factor, contact.n_active))
        # the end bulges by less than this
        assert highest(COMM, contact.pair.points[contact.pair.trial.active, 0]) < 3.05
    away = [factor for factor, n in counts if n == 0]
    assert min(abs(f - 0.5) for f in away) < 1e-9
    assert np.abs(states[8][0]).max() == 0.0
    slab = np.arange(len(s.drawing)) < 13 * 4 * 3 ** (g - 2)
    assert np.abs(states[8][1][slab]).max() < 1e-9
    for k in range(1, 4):
        (force, u), (later, v) = states[k], states[16 - k]
        assert force[-1] > 0.0 and np.abs(force - later).max() < 1e-6 * force[-1]
        assert np.abs(u - v).max() < 1e-6


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize(("way", "held"), [(0.03, True), (0.2, False)])
def test_an_end_holds_what_was_drawn_there(way, held, degree):
    """Edges that coincide slide past each other by 0.06 of a facet and hold on, with forces in balance; by 0.4 of it they let go."""
    b = blocks(COMM, "quadrilateral", 2, 2, degree=degree)
    contact = uem.Contact(b.high, b.low)
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, 0, value=way), *clamp(b.V, b.top, 1, value=-0.01)]
    run(uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=bcs, contacts=[contact]), 4)
    lawful(contact)
    assert contact.n_active == COMM.allreduce(len(contact.pair.nodes)) - (0 if held else 1)


@pytest.mark.parametrize("normals", ["facet", pytest.param("averaged", marks=pytest.mark.slow)])
def test_round_a_corner(normals):
    """The target continues down the slab's end: led round the corner, the contactors press on the other side."""

    def way(factor):
        # out past the corner, down, then back against the slab's end
        out, down = 0.7 * min(1.0, 2 * factor), 0.3 * np.clip(4 * factor - 2, 0.0, 1.0)
        return [out - 0.12 * np.clip(4 * factor - 3, 0.0, 1.0), -0.03 - down]

    def top_and_end(x):
        return (np.abs(x[:, -1]) < 1e-9) | (np.abs(x[:, 0] - 3.0) < 1e-9)

    _, contact, problem = slider("triangle", way, target=top_and_end, normals=normals, start=2.4)
    pushed = []
    for step in uem.load_steps(problem, 24):
        lawful(contact)
        pushed.append((step.factor, *contact.resultant().force))
    first, last = pushed[0], pushed[-1]
    assert first[2] > 0.0 and abs(first[1]) < 0.2 * first[2]
    assert last[1] > 0.0 and abs(last[2]) < abs(last[1])
