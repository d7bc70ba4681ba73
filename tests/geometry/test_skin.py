"""Surfaces of many bodies as one: whose each facet is, edges round which no facet reaches, normals next to them, and the order of bodies.

Two tests to read first: ``test_which_edges_are_sharp`` and ``test_the_finer_follows``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from body_scenes import all_facets, ball, dimension, skin_of, turned
from helpers import CELLS, at, box, highest

from uem_dolfinx import forms
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.skin import names_of_bodies
from uem_dolfinx.geometry.surfaces import surface_nodes

COMM = MPI.COMM_WORLD


def three(cell, *n):
    """Unit boxes side by side, 1.5 apart, with so many divisions each."""
    g = dimension(cell)
    return [box(cell, [1.5 * k, *[0.0] * (g - 1)], [1.5 * k + 1, *[1.0] * (g - 1)], [m] * g) for k, m in enumerate(n)]


def side_middles(skin):
    """Middles of the sides of all facets of this rank, points in 2D ``(m, n_sides, gdim)``."""
    x, corners = skin.config.X[skin.dofs], 1 if skin.shape.dim == 1 else 2
    return np.stack([x[:, nodes[:corners]].mean(axis=1) for _, nodes, _, _ in skin.shape.edges], axis=1)


# -- bodies ----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("shuffle", [None, 3, 4])
def test_bodies_are_numbered_by_the_input(cell, shuffle):
    """By their first cells in what was handed to DOLFINx, whatever the partition."""
    s, skin = skin_of(cell, three(cell, 2, 1, 3), shuffle=shuffle)
    assert skin.n_bodies == 3
    reported = zip(*COMM.allgather((forms.original_cells(s.mesh), s.body)))
    cells, body = (np.concatenate(part) for part in reported)
    _, first = np.unique(body, return_index=True)
    lowest = [cells[body == b].min() for b in range(3)]
    number = np.argsort(np.argsort(lowest))
    if shuffle is None:
        assert np.array_equal(number, [0, 1, 2])
    drawn = np.floor(skin.config.X[:, 0] / 1.5 + 1e-9).astype(int)
    assert np.array_equal(skin.body_of_node, number[drawn])
    assert np.array_equal(skin.body, number[drawn[skin.dofs[:, 0]]])


@pytest.mark.parametrize("cell", CELLS)
def test_size_of_facets(cell):
    """The mean of their sides' lengths, of bodies; half of the longest, of each."""
    n = np.array([2, 1, 3])
    _, skin = skin_of(cell, three(cell, *n))
    mean, longest = {"tetrahedron": ((2 + np.sqrt(2)) / 3, np.sqrt(2))}.get(cell, (1.0, 1.0))
    assert skin.size == pytest.approx(mean / n, rel=1e-14)
    assert highest(COMM, np.abs(skin.radius - 0.5 * longest / n[skin.body])) < 1e-14


def test_a_body_without_a_surface():
    """One whose facets are not among those that may touch has no size, and comes before all."""
    _, skin = skin_of("triangle", three("triangle", 2, 2, 1), tag=lambda s: s.tag("top of 1", 1, at(1, 1.0)))
    assert np.array_equal(skin.size > 0, [False, True, False])
    assert skin.order([])[1] == 2


# -- edges -----------------------------------------------------------------------------------------------------------------


def bent(angle):
    """Pose that bends the top of a box about its middle by an angle between both halves' normals, into a roof or a valley."""

    def pose(x):
        y = x.copy()
        y[:, -1] -= np.tan(0.5 * angle) * np.abs(x[:, 0] - 0.5) * (x[:, -1] > 0.99)
        return y

    return pose


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("angle,sharp", [(0.0, False), (0.5, False), (1.1, True), (-0.5, False), (-1.1, True)])
def test_which_edges_are_sharp(cell, degree, angle, sharp):
    """Those of a box are, a roof of 63 degrees is, one of 29 is not; no facet reaches round one that is convex."""
    g = dimension(cell)
    _, skin = skin_of(cell, [box(cell, [0.0] * g, [1.0] * g, [2, *[1] * (g - 2), 2])], degree, pose=bent(angle))
    side = side_middles(skin)
    top = bent(angle)(np.insert(side[..., :-1].reshape(-1, g - 1), g - 1, 1.0, axis=1))[:, -1].reshape(side.shape[:2])
    on_top = np.abs(side[..., -1] - top) < 1e-9
    crest = (np.abs(side[..., 0] - 0.5) < 1e-9) & on_top
    faces = (np.abs(side[..., :-1] - 0.5) > 0.49).sum(axis=2) + (side[..., -1] < 0.01) + on_top
    box_edge = faces > 1
    assert COMM.allreduce(int(crest.sum())) >= 2
    assert np.array_equal(skin.edges.sharp, box_edge | (crest & sharp))
    assert np.array_equal(skin.open_sides, box_edge | (crest & sharp & (angle > 0)))


def test_the_end_of_a_surface_is_open():
    """Where the skin ends no facet reaches on, whatever the angle; sharp it is not."""
    _, skin = skin_of("hexahedron", [box("hexahedron", [0.0] * 3, [1.0] * 3, [2] * 3)], tag=lambda s: s.tag("top", 0, at(2, 1.0)))
    side = side_middles(skin)
    assert np.array_equal(skin.open_sides, (np.abs(side[..., :2] - 0.5) > 0.49).any(axis=2))
    assert not skin.edges.sharp.any()


@pytest.mark.parametrize("cell", CELLS)
def test_normals_at_sharp_edges(cell):
    """At the edges of boxes they are the facets' own, on bodies that are round the mean of those around."""
    g = dimension(cell)
    parts = [turned(box(cell, [0.0] * g, [1.0] * g, [3] * g), 0.4), ball(cell, [3.0, *[0.0] * (g - 1)], 1.0, 4)]
    _, skin = skin_of(cell, parts)
    normal = skin.current().nodal_normals
    flat = skin.body == 0
    assert highest(COMM, np.abs(normal - skin.normals())[flat]) < 1e-14
    out = skin.config.X[skin.dofs] - [3.0, *[0.0] * (g - 1)]
    round_ = np.einsum("mag,mag->ma", normal, out)[~flat]
    assert highest(COMM, 1.0 - round_) < (1e-12 if g == 2 else 0.1)
    own = np.einsum("mag,mag->ma", skin.normals(), out)[~flat]
    assert highest(COMM, 1.0 - own) > 2 * highest(COMM, 1.0 - round_)


def test_normals_follow_what_turns():
    """Normals at edges are those of where the bodies are now."""
    _, skin = skin_of("quadrilateral", three("quadrilateral", 2, 2, 2))
    before, R = skin.current().nodal_normals, np.array([[0.0, -1.0], [1.0, 0.0]])
    skin.config.displacement[:] = skin.config.X @ (R - np.eye(2)).T
    assert highest(COMM, np.abs(skin.current().nodal_normals - before @ R.T)) < 1e-14


# -- order of bodies -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("length", [1e-9, 1.0, 1e6])
def test_the_finer_follows(length):
    """Bodies with smaller facets come first; of bodies whose facets are nearly alike, the first in the mesh's input."""
    for n, place in (((6, 5, 18), (1, 2, 0)), ((5, 18, 6), (1, 0, 2)), ((18, 5, 6), (0, 1, 2)), ((2, 8, 4), (2, 0, 1))):
        _, skin = skin_of("triangle", three("triangle", *n), pose=lambda x: length * x)
        assert np.array_equal(skin.order([]), place), n


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("turn", [0.0, 0.7])
def test_the_smaller_of_equally_fine_bodies_follows(cell, turn):
    """Whatever the pose and the order of the input; of equally large bodies the first in the mesh's input."""
    g = dimension(cell)
    for sides, place in (((1.0, 0.8), (1, 0)), ((0.8, 1.0), (0, 1)), ((1.0, 0.8, 0.6), (2, 1, 0)), ((1.0, 0.99), (0, 1))):
        boxes = [
            box(cell, [2.0 * k] + [0.0] * (g - 1), [2.0 * k + a] + [a] * (g - 1), [round(5 * a)] * g) for k, a in enumerate(sides)
        ]
        _, skin = skin_of(cell, [turned(b, turn * k) for k, b in enumerate(boxes)])
        assert np.array_equal(skin.order([]), place), sides


def test_a_given_order():
    """Bodies that are named come first, by facets or by cells; the others as before."""
    s, skin = skin_of("triangle", three("triangle", 2, 4, 8))
    last, middle = s.tag("last", 0, at(0, 0.0)), s.tag("middle", 1, at(0, 2.5))
    assert np.array_equal(skin.order([]), [2, 1, 0])
    assert np.array_equal(skin.order([last]), [0, 2, 1])
    assert np.array_equal(skin.order([middle, last]), [1, 0, 2])
    # one that names two bodies leaves their order as it was, and the first that names a body counts
    both = all_facets(s.mesh)
    assert np.array_equal(skin.order([both, last]), [2, 1, 0])
    nodes = surface_nodes(skin.config, both)
    assert highest(COMM, len(nodes)) > 0
    # rigid bodies come last, unless they are named; one that is rigid in part does not
    rigid = skin.body_of_node[: skin.config.n_owned] == 2
    assert np.array_equal(skin.order([], rigid), [1, 0, 2])
    assert np.array_equal(skin.order([both], rigid), [2, 1, 0])
    assert np.array_equal(skin.order([], rigid & (skin.config.X[: skin.config.n_owned, 0] > 3.5)), [2, 1, 0])


# -- cones -----------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("cell", CELLS)
@pytest.mark.parametrize("degree", [1, 2])
def test_cones_hold_the_normals_around_a_node(cell, degree):
    """Of a box: those of the faces that the node is on, and no others, now and after a turn."""
    g = dimension(cell)
    _, skin = skin_of(cell, [box(cell, [0.0] * g, [1.0] * g, [2] * g)], degree)
    nodes = surface_nodes(skin.config, skin.tag)
    nodes = nodes[nodes < skin.config.n_owned]
    X = skin.config.X[nodes]
    R = np.eye(g)
    R[:2, :2] = [[0.6, -0.8], [0.8, 0.6]]
    for turn in (np.eye(g), R):
        skin.config.displacement[:] = skin.config.X @ (turn - np.eye(g)).T
        cones, drawn = np.moveaxis(skin.cones(nodes), 2, 0)
        cones = cones @ turn
        assert np.abs(drawn - cones).max(initial=0.0) < 1e-13
        for c in range(g):
            for end, sign in ((0.0, -1.0), (1.0, 1.0)):
                on = np.abs(X[:, c] - end) < 1e-9
                assert np.array_equal((np.abs(cones - sign * np.eye(g)[c]).max(axis=2) < 1e-13).any(axis=1), on)
        faces = (np.abs(X - 0.5) > 0.49).sum(axis=1)
        length = np.linalg.norm(cones, axis=2)
        assert np.abs(length * (length - 1)).max(initial=0.0) < 1e-13
        assert ((length > 0.5).sum(axis=1) >= faces).all()


def test_names_of_bodies():
    """Each body has one name, also where a part has that of another body by default."""
    first, second, both = np.array([True, False]), np.array([False, True]), np.array([True, True])
    assert names_of_bodies({}, 2) == ["body 1", "body 2"]
    assert names_of_bodies({"a": second}, 2) == ["body 1", "a"]
    assert names_of_bodies({"body 2": second}, 2) == ["body 1", "body 2"]
    assert names_of_bodies({"body 2": first, "body 1": second}, 2) == ["body 2", "body 1"]
    for parts, words in (
        ({"body 2": first}, "'body 2' is the name of two bodies"),
        ({"a": both}, "'a' is the name of two bodies"),
        ({"a": first, "b": first}, "'b' and 'a' are one body"),
        ({"body 1": first, "b": first}, "'b' and 'body 1' are one body"),
    ):
        with pytest.raises(SurfaceError, match=words):
            names_of_bodies(parts, 2)
