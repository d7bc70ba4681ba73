"""Crossings of sharp edges: opposite edges, the node with the equation, and gaps with their derivatives.

Read first: ``test_derivatives``.
"""

from __future__ import annotations

import numpy as np
import pytest
from benchmarks.scenes import scene
from dolfinx import fem, mesh
from edge_scenes import COMM, rod, roof

import uem_dolfinx as uem
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.edge_crossings import Crossings, SharpLines
from uem_dolfinx.geometry.edge_gaps import EdgeGaps, cubics, weights_at
from uem_dolfinx.geometry.skin import Skin

RNG = np.random.default_rng(3)
INFINITE = np.inf


def pairs(k=8):
    """Cubics and nodes of lines that cross, some of them at their ends, with pieces of different lengths."""
    x, y = np.zeros((2, k, 4, 3))
    x[:, :, 0], x[:, :, 2], y[:, :, 1] = [-2.0, -0.6, 0.7, 2.0], 0.3, [-3.0, -1.0, 1.0, 2.0]
    ends = np.where(np.arange(k) % 2, 1.4, INFINITE)
    of = cubics(ends, np.full(k, 1.3), np.full(k, 1.3)), cubics(np.full(k, 2.0), np.full(k, 2.0), ends[::-1])
    return of, x + 0.2 * RNG.normal(size=x.shape), y + 0.2 * RNG.normal(size=y.shape)


def test_lines():
    """Through their nodes, of sum one, exact for parabolas but at ends, and smooth from piece to piece."""
    knots = np.array([0.0, 0.7, 1.5, 2.0, 3.1])
    h = np.diff(knots)
    both = cubics(h[[0, 1]], h[[1, 2]], h[[2, 3]])
    s = np.linspace(0.0, 1.0, 5)
    for i in (0, 1):
        N = weights_at(np.repeat(both[i : i + 1], 5, axis=0), s)[0]
        assert np.abs(N.sum(axis=1) - 1.0).max() < 1e-14
        assert np.abs(N[[0, -1]] - np.eye(4)[[1, 2]]).max() < 1e-14
        at = knots[i + 1] + s * h[i + 1]
        assert np.abs(N @ knots[i : i + 4] ** 2 - at**2).max() < 1e-13
    y = RNG.normal(size=5)
    slopes = [weights_at(both[i : i + 1], np.array([end]))[1][0] @ y[i : i + 4] / h[i + 1] for i, end in ((0, 1.0), (1, 0.0))]
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-12)
    last = cubics(np.array([INFINITE]), np.ones(1), np.array([INFINITE]))
    assert weights_at(last, np.array([0.3]))[0][0] == pytest.approx([0.0, 0.7, 0.3, 0.0])


def test_derivatives():
    """The gap's gradient are the weights times the normal; its second derivatives, and those of friction that turns with the normal."""
    of, x, y = pairs()
    up, k = np.tile([0.0, 0.0, 1.0], (len(x), 1)), len(x)

    def gaps(z):
        z = z.reshape(k, 2, 4, 3)
        return EdgeGaps.between(of, z[:, 0], z[:, 1], up)

    def along(found, vectors):
        weights = np.stack(found.weights, axis=1) * np.array([1.0, -1.0])[:, None]
        return (weights[..., None] * vectors[:, None, None]).reshape(k, -1)

    z = np.stack([x, y], axis=1).reshape(k, -1)
    found = gaps(z)
    assert np.abs(found.points - found.feet - found.gap[:, None] * found.normal).max() < 1e-14
    tau = np.cross(found.normal, RNG.normal(size=(k, 3)))

    def friction(one):
        lean = np.einsum("kg,kg->k", tau, one.normal)
        return along(one, tau - lean[:, None] * found.normal)

    h, H, T = 1e-6, found.hessians(), found.turnings(tau)
    for j in range(24):
        step = np.zeros(24)
        step[j] = h
        ahead, back = gaps(z + step), gaps(z - step)
        assert np.abs((ahead.gap - back.gap) / (2 * h) - along(found, found.normal)[:, j]).max() < 1e-8
        assert np.abs((along(ahead, ahead.normal) - along(back, back.normal)) / (2 * h) - H[:, :, j]).max() < 1e-8
        assert np.abs((friction(ahead) - friction(back)) / (2 * h) - T[:, :, j]).max() < 1e-8
    assert np.abs(H - H.transpose(0, 2, 1)).max() < 1e-14


def between(bodies, cell="hexahedron", degree=1, overlap=0.0, n_lists=2):
    """Crossings of the edges of two bodies, the first of which has the contactors (collective)."""
    s = scene(COMM, cell, bodies)
    config = Configuration(fem.Function(uem.function_space(s.mesh, degree, (3,))))
    s.mesh.topology.create_connectivity(2, 3)
    skin = Skin(config, uem.Tag("all", 0, 2, s.mesh, mesh.exterior_facet_indices(s.mesh.topology)))
    lines = SharpLines(skin)
    keys = skin.body[lines.facet][:, None]
    return Crossings(lines, lines, (keys, keys), lambda a, b: a[:, 0] < b[:, 0], overlap, n_lists)


def found(crossings):
    """Crossings that lead: position of the contactor, both coordinates and gap, sorted, on all ranks (collective)."""
    crossings.update()
    rows = []
    for which, at in crossings.lists:
        X = crossings._config.X[crossings.nodes[which]]
        rows.append(np.column_stack([X, at.s, at.t, at.gaps.gap])[at.leads])
    return np.array(sorted(row for part in COMM.allgather(np.concatenate(rows).tolist()) for row in part)).reshape(-1, 6)


def roofs(shift, up=0.0, slopes=(0.5, 0.5), angle=None, **how):
    """Crossings of two roofs with edges of 0.5, the upper one shifted and raised."""
    low, high = roof("hexahedron", False, slopes=slopes), roof("hexahedron", True, slopes=slopes)
    if angle is not None:
        c, s = np.cos(angle - 0.5 * np.pi), np.sin(angle - 0.5 * np.pi)
        high = high.mapped(lambda x: x @ np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]]))
    return between([low, high.mapped(lambda x: x + [*shift, up])], **how)


@pytest.mark.parametrize("degree", [1, 2])
def test_one_crossing(degree):
    """Of two ridges, at its place on both, with its gap, on any number of ranks; one at nodes, too."""
    for shift, up in (((0.11, 0.17), 0.03), ((0.0, 0.0), 0.03), ((0.25, 0.5), 0.0)):
        rows = found(roofs(shift, up, degree=degree))
        assert len(rows) == 1 and rows[0, -1] == pytest.approx(up, abs=1e-14)
        h = 0.5 / degree
        # the lower ridge lies along x, and the node that has the equation is one of two around the crossing
        assert abs(rows[0, 0] - shift[0]) <= 0.6 * h + 1e-12 and abs(rows[0, 1]) < 1e-14
        assert (rows[0, 3:5] > -1e-7).all() and (rows[0, 3:5] < 1.0 + 1e-7).all()


def test_how_near_edges_are():
    """Up to half the length of an edge."""
    assert len(found(roofs((0.1, 0.2), 0.4 * 0.5))) == 1 and len(found(roofs((0.1, 0.2), 0.6 * 0.5))) == 0


def test_edges_that_are_nearly_parallel():
    """They have no definite crossing."""
    for angle, n in ((0.1, 1), (0.02, 0)):
        rows = found(roofs((0.1, 0.0), angle=angle))
        assert int((np.abs(rows[:, -1]) < 1e-12).sum()) == n


def tilted(lean):
    """Two rods face on face that cross at right angles, of which the upper one turns about its axis by a small angle."""
    low, high = rod("hexahedron", 5, 5.0, False, 0.0, False), rod("hexahedron", 5, 5.0, True, 0.0, False)
    c, s = np.cos(lean), np.sin(lean)

    def turn(x):
        # about the edge of the rod that stays in the plane, then across the lower rod
        x = (x - [0.0, 0.5, 0.0]) @ np.array([[1.0, 0.0, 0.0], [0.0, c, s], [0.0, -s, c]]) + [0.0, 0.5, 0.0]
        return np.column_stack([-x[:, 1], x[:, 0], x[:, 2]])

    return between([low, high.mapped(turn)])


def test_normals_beside_those_of_facets():
    """Edges that face away a little still cross, as bodies deform; those that face away do not."""
    # of the two edges of a rod that turns about one of them, that one leaves the sector of its facets
    assert [len(found(tilted(-lean))) for lean in (0.0, 0.05, 0.2)] == [4, 4, 2]


def test_edges_behind_each_other():
    """Edges that were inside each other at the end of the last step are not opposite, but those that have been are."""
    for depth, n in ((0.4e-3, 1), (5e-3, 0)):
        crossings = roofs((0.1, 0.2), -depth * 0.5)
        assert len(found(crossings)) == n
    assert len(found(roofs((0.1, 0.2), -0.05, overlap=0.1))) == 1


def test_which_node_has_the_equation():
    """One of the two around it, and the same one up to beyond the middle; the other one keeps track of it."""
    at = [found(roofs((-0.5 + 0.5 * s, 0.2)))[0, 0] for s in (0.35, 0.45, 0.5, 0.55, 0.65)]
    # the first node is on one side or the other, as the facet has it
    first = at[2]
    assert at[1:4] == [first] * 3 or abs(at[0] - at[4]) > 0.4
    assert len(set(np.round(at, 6))) == 2
    crossings = roofs((-0.25, 0.2))
    crossings.update()
    assert COMM.allreduce(sum(len(which) for which, _ in crossings.lists)) == 2


def at_nodes(crossings):
    """Positions of the nodes that crossings hold (collective)."""
    crossings.update()
    X = crossings._config.X[crossings.at_crossings[0]]
    return np.unique(np.round(np.concatenate(COMM.allgather(X)), 6), axis=0)


def test_nodes_at_crossings():
    """Face on face, a crossing holds nodes near to it, and no others."""
    for along, n in ((0.15, 4), (0.35, 0)):
        low = rod("hexahedron", 5, 5.0, False, 0.0, False, along=along)
        high = rod("hexahedron", 5, 5.0, True, 0.5 * np.pi, False, along=along + 0.35)
        assert len(at_nodes(between([low, high]))) == n


def test_nodes_at_ridges():
    """Ridge on ridge, a crossing holds both nodes of either piece, but not where a facet almost touches."""
    assert len(at_nodes(roofs((0.25, 0.25), slopes=(0.3, 1.0)))) == 4
    assert len(at_nodes(roofs((0.25, 0.25), slopes=(0.1, 1.0)))) == 0


def test_crossings_of_one_node():
    """Two edges that cross a piece near each other are two, unless nothing is between them; a node has both."""
    low = rod("hexahedron", 3, 6.0, False, 0.0, True)
    for width, n in ((0.3, 2), (0.05, 1)):
        high = rod("hexahedron", 6, 6.0, True, 0.5 * np.pi, False).mapped(lambda x, w=width: x * [w, 1.0, 1.0])
        assert len(found(between([low, high]))) == n


def test_no_crossing_of_corners_and_sides():
    """The side of a block over another one's edge does not cross it, and corners on each other are no crossing."""
    low, high = (rod("hexahedron", 1, 1.0, k > 0, 0.0, False, along=0.3 * k) for k in (0, 1))
    assert len(found(between([low, high]))) == 0
    assert len(found(between([low, high.mapped(lambda x: x - [0.0, 0.0, 1e-4])], overlap=0.05))) == 0
