"""Sets of nodes of input files hold these nodes and no others, of linear and of quadratic cells.

The tests to read first: ``test_any_nodes`` and ``test_a_bar_held_at_middles``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from deck_scenes import UNIT, deck, grid, node_sets
from dolfinx import fem
from helpers import NU, linear, refused, run

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.found import Block, Found
from uem_dolfinx.geometry.simplices import completed

COMM = MPI.COMM_WORLD
KINDS = [(kind, order) for kind in UNIT for order in (1, 2)]


def places(x):
    """Places as a set of whole numbers, of nodes on a grid of fourths."""
    return {tuple(row) for row in np.rint(4 * np.asarray(x)).astype(int).tolist()}


def held(V, part, scale=1.0, **options):
    """Places, by a scale, of all nodes where a condition on a part holds the displacement ``V`` (collective)."""
    nodes = np.unique(compat.bc_dofs(uem.dirichlet(V, part, **options))[0] // V.dofmap.index_map_bs)
    x = V.tabulate_dof_coordinates()[nodes[nodes < V.dofmap.index_map.size_local], : V.mesh.geometry.dim]
    every = np.concatenate(COMM.allgather(x)) / scale
    assert len(places(every)) == len(every)
    return places(every)


def with_added(points, name, cells, nodes):
    """Places that a set of nodes of the file stands for: also of nodes that serendipity cells lack, between nodes of it alone."""
    found, _ = completed(Found(points, [Block(name, cells)], point_sets={"a": np.asarray(nodes)}))
    chosen = set(nodes)
    wanted = places(points[list(nodes)])
    for x in found.points[len(points) :]:
        # nodes in the middle of a square or a cube of cells are half a cell from all others around
        near = np.flatnonzero(np.abs(points - x).max(axis=1) < 0.25 + 1e-9)
        plane = [near[np.abs(points[near] - x)[:, i] < 1e-9] for i in range(points.shape[1])]
        around = [some for some in plane if len(some) == 8] if points.shape[1] == 3 else []
        full = any(chosen >= set(some.tolist()) for some in around) if around else chosen >= set(near.tolist())
        wanted |= places([x]) if full else set()
    return wanted


@pytest.mark.parametrize("kind, order", KINDS)
@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e3])
def test_any_nodes(folder, kind, order, scale):
    """Of random sets, a few nodes, most, and all of them: a condition holds these in a space of the cells' own degree."""
    points, name, cells = grid(kind, order)
    g, rng = points.shape[1], np.random.default_rng(order)
    sets = {f"s{i}": np.flatnonzero(rng.random(len(points)) < p).tolist() for i, p in enumerate((0.1, 0.3, 0.5, 0.8, 0.95, 1.1))}
    sets["s0"] = sets["s0"] or [0]
    mesh, tags = uem.read_mesh(deck(folder, "a.inp", scale * points, {name: cells}, node_sets(sets)), COMM)
    V, straight = (uem.function_space(mesh, degree, (g,)) for degree in (order, 1))
    for label, nodes in sets.items():
        wanted = with_added(points, name, cells, nodes)
        assert held(V, tags[label], scale) == wanted, label
        vertices = {row for row in wanted if order == 1 or all(i % 2 == 0 for i in row)}
        assert not vertices or held(straight, tags[label], scale) == vertices, label


def sides_of(points):
    """Nodes of the side x = 0: all, those at vertices of cells, and the others."""
    side = np.flatnonzero(points[:, 0] == 0.0)
    vertex = np.all(np.rint(4 * points[side]) % 2 == 0, axis=1)
    return side.tolist(), side[vertex].tolist(), side[~vertex].tolist()


@pytest.mark.parametrize("kind, order", KINDS)
def test_what_is_a_surface(folder, kind, order):
    """All nodes of a side are a surface; without one of its nodes, with one more, or by its vertices alone it is a set of points."""
    points, name, cells = grid(kind, order)
    g = points.shape[1]
    side, vertices, _ = sides_of(points)
    # in the middle of all cells
    more = int(np.flatnonzero((points == 0.5).all(axis=1))[0])
    sets = {"side": side, "less": side[:-1], "more": [*side, more], "vertices": vertices}
    mesh, tags = uem.read_mesh(deck(folder, "a.inp", points, {name: cells}, node_sets(sets)), COMM)
    surface = {label: tags[label].dim == g - 1 for label in sets}
    # less one corner, a side of linear cells is still one of fewer facets in the plane, whose nodes are these
    assert surface["side"] and not surface["more"] and surface["vertices"] == (order == 1)
    assert uem.integrate(fem.Constant(mesh, 1.0) * uem.ds(tags["side"])) == pytest.approx(1.0, rel=1e-12)
    V = uem.function_space(mesh, order, (g,))
    for label, nodes in sets.items():
        assert held(V, tags[label]) == with_added(points, name, cells, nodes), label
    if order == 2:
        refused(uem.TagError, "dimension 0", lambda: uem.ds(tags["vertices"]))


@pytest.mark.parametrize("kind", UNIT)
def test_middles_alone(folder, kind):
    """Nodes in the middle of edges and no others: loads, conditions with values of all kinds, unions; no space of degree 1 has them."""
    points, name, cells = grid(kind, 2)
    g = points.shape[1]
    _, vertices, middles = sides_of(points)
    sets = {"middles": middles, "corner": vertices[:1], "some": middles[1:]}
    mesh, tags = uem.read_mesh(deck(folder, "a.inp", points, {name: cells}, node_sets(sets)), COMM)
    V, W = uem.function_space(mesh, 2, (g,)), uem.function_space(mesh, [("Lagrange", 2, (g,)), 1])
    wanted = places(points[middles])
    assert held(V, tags["middles"]) == wanted and held(V, [tags["corner"], tags["middles"]]) == wanted | places(
        points[vertices[:1]]
    )
    assert held(V, [tags["some"], tags["middles"]]) == wanted
    f, scalar = fem.Function(V), fem.Function(uem.function_space(mesh, 2))
    f.interpolate(lambda x: x[:g])
    scalar.interpolate(lambda x: x[1])
    assert held(V, tags["middles"], value=f) == wanted == held(V, tags["middles"], component=1, value=scalar)
    u = fem.Function(V)
    for bc in (uem.dirichlet(V, tags["middles"], value=f), uem.dirichlet(V, tags["middles"], 1, scalar)):
        u.x.array[:] = 0.0
        fem.set_bc(u.x.array, [bc])
        x = V.tabulate_dof_coordinates()[:, 1]
        own = np.flatnonzero(u.x.array.reshape(-1, g)[:, 1])
        assert np.allclose(u.x.array.reshape(-1, g)[own, 1], x[own]) and COMM.allreduce(len(own)) >= len(middles)
    dofs, _ = compat.bc_dofs(uem.dirichlet(W.sub(0), tags["middles"], 1))
    assert COMM.allreduce(int((dofs < W.dofmap.index_map.size_local).sum())) == len(middles)
    refused(uem.SpaceError, ("'middles'", "degree 2"), lambda: uem.dirichlet(uem.function_space(mesh, 1, (g,)), tags["middles"]))


@pytest.mark.parametrize("kind", UNIT)
@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e3])
def test_a_bar_held_at_middles(folder, kind, scale):
    """Pulled along x, and held by just as many components as its rigid motions, in sets of one node each: strains are uniform.

    The nodes are in the middle of edges; reactions vanish, and the displacement is that of a bar, to rounding.
    """
    points, name, cells = grid(kind, 2)
    g = points.shape[1]

    def node(*x):
        return [int(np.flatnonzero((np.abs(points - x[:g]) < 1e-9).all(axis=1))[0])]

    sets = {"a": node(0.25, 0.0, 0.0), "b": node(0.75, 0.0, 0.0), "c": node(0.0, 0.25, 0.0)}
    sets |= {"left": np.flatnonzero(points[:, 0] == 0.0).tolist(), "right": np.flatnonzero(points[:, 0] == 1.0).tolist()}
    mesh, tags = uem.read_mesh(deck(folder, "a.inp", scale * points, {name: cells}, node_sets(sets)), COMM)
    V, E, p = uem.function_space(mesh, 2, (g,)), 3.0, 0.01
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = linear(u, E) - p * v[0] * uem.ds(tags["right"]) + p * v[0] * uem.ds(tags["left"])
    bcs = [uem.dirichlet(V, tags["a"], i) for i in range(g)] + [uem.dirichlet(V, tags["b"], i) for i in range(1, g)]
    bcs += [uem.dirichlet(V, tags["c"], 2)] if g == 3 else []
    problem = uem.UnitedProblem(F, u, bcs=bcs)
    run(problem)
    x = V.tabulate_dof_coordinates()[:, :g] - scale * points[sets["a"][0]]
    strains = np.array([1 - NU**2, -NU * (1 + NU)] if g == 2 else [1.0, -NU, -NU]) * p / E
    assert COMM.allreduce(np.abs(u.x.array.reshape(-1, g) - x * strains).max(initial=0.0), op=MPI.MAX) <= 1e-10 * p / E * scale
    for label in ("a", "b"):
        assert np.abs(problem.reaction(tags[label])).max() <= 1e-9 * p * scale ** (g - 1)
    force = problem.reaction([tags["a"], tags["b"]])
    assert np.abs(force).max() <= 1e-9 * p * scale ** (g - 1)
    loads = [uem.PointLoad([tags["a"], tags["c"]], (1.0, *[0.0] * (g - 1)))]
    points_of_load = uem.UnitedProblem(linear(u, E), u, bcs=[uem.dirichlet(V, tags["left"])], points=loads)
    run(points_of_load)
    # the node c is on the side that is held
    assert np.allclose(points_of_load.reaction(tags["left"])[0], -2.0, rtol=1e-9)
