"""Lists of what surface nodes may touch, against loops over all nodes and facets, and against plain projections.

Two tests to read first: ``test_lists_are_what_a_loop_finds`` and ``test_lists_last``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
from body_scenes import ball, dimension, skin_of, turned
from helpers import box, highest, slow

import uem_dolfinx as uem
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.neighbours import BEHIND, DIRECTION, FACED, Neighbour, Neighbours
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.shapes import closest_point, unit_normals
from uem_dolfinx.geometry.surfaces import surface_nodes

COMM = MPI.COMM_WORLD


def lists_of(skin, order=None, apart=(), overlap=0.0, itself=False):
    """Lists of all nodes of a skin."""
    place = skin.order([]) if order is None else np.asarray(order)
    nodes, touch = surface_nodes(skin.config, skin.tag), np.full(skin.n_bodies, itself)
    return Neighbours(skin, nodes, place, apart, overlap, skin.config.gdim, touch)


def cloud(cell, n, seed, degree=1, **how):
    """Boxes and balls at random places on a grid, turned and of several sizes, about as far apart as facets are long; their skin."""
    g, rng = dimension(cell), np.random.default_rng(seed)
    bodies = []
    for k in range(n):
        middle = np.array([k % 2, k // 2 % 2, k // 4][:g]) if g == 3 else np.array([k % 3, k // 3])
        middle = middle + rng.uniform(-0.05, 0.05, g)
        size, m = rng.uniform(0.35, 0.48), int(rng.integers(1, (4 if g == 3 else 6) - (degree > 1)))
        if k % 2:
            bodies.append(ball(cell, middle, size, m))
        else:
            bodies.append(turned(box(cell, middle - 0.8 * size, middle + 0.8 * size, [m] * g), rng.uniform(0, 1)))
    return skin_of(cell, bodies, degree, shuffle=seed, **how)[1]


def everywhere(*arrays):
    """Rows of all ranks, on every rank (collective)."""
    return [np.concatenate(COMM.allgather(a)) for a in arrays]


def drawn(skin, n, seed):
    """A displacement that turns and shifts each body a little, the same on any number of ranks."""
    rng = np.random.default_rng(seed)
    g = skin.config.gdim
    shift, turn = rng.uniform(-0.05, 0.05, (n, g)), rng.uniform(-0.2, 0.2, n)
    body, X = skin.body_of_node, skin.config.X
    u = shift[body]
    u[:, :2] += turn[body, None] * np.column_stack([-X[:, 1], X[:, 0]])
    skin.config.displacement[:] = u


class Loops:
    """All nodes and all facets on every rank: which may touch (collective)."""

    def __init__(self, n: Neighbours):
        skin, config = n.skin, n.skin.config
        tab = skin.shape.tabulate(np.tile(skin.shape.middle, (len(skin.dofs), 1)))
        x, y = config.x[skin.dofs], n._committed[skin.dofs]
        normal, normal_then = (unit_normals(tab, z) * skin.sign[:, None] for z in (x, y))
        self.facets = everywhere(
            x, normal, normal_then, np.einsum("na,nag->ng", tab.N, y), skin.body, np.minimum(skin.depth, skin.radius), skin.keys,
            skin.nodes,
        )  # fmt: skip
        self.nodes = everywhere(
            config.to_global(n.nodes), config.x[n.nodes], n._committed[n.nodes], skin.body_of_node[n.nodes], skin.corners[n.nodes]
        )
        self.shape, self.place, self.reach = skin.shape, n.place, n._reach

    def pairs(self, overlap=0.0):
        """Of every node: the facets that may hold it, by key, with their bodies and distances."""
        x, normal, then, middle, body, depth, key, corners = self.facets
        for node, point, before, own, corner in zip(*self.nodes):
            around = normals_of_node(corners, node, x, self.shape, normal)
            faces = (around @ normal.T).min(axis=0) < -FACED
            front = np.einsum("fg,fg->f", before - middle, then) >= -np.maximum(BEHIND * depth, overlap)
            f = np.flatnonzero(((self.place[body] > self.place[own]) | (corner & (body != own))) & faces)
            distance = np.sqrt(closest_point(self.shape, x[f], np.tile(point, (len(f), 1)))[1])
            near = distance <= (self.reach[own] + self.reach[body[f]]) * (1 + 1e-10)
            f, distance = f[near], distance[near]
            # round the nearest facet of each body that the node is in front of
            kept = np.zeros(len(f), bool)
            for b in set(body[f[front[f]]]):
                nearest = min(np.flatnonzero((body[f] == b) & front[f]), key=lambda i: (distance[i], key[f[i]]))
                kept |= (body[f] == b) & (front[f] | (normal[f] @ normal[f[nearest]] > -FACED))
            f, distance = f[kept], distance[kept]
            yield node, key[f], body[f], distance


def normals_of_node(corners, node, x, shape, outward):
    """Outward normals, there, of the facets around a node, and their mean ``(k, gdim)``."""
    f, a = np.nonzero(corners == node)
    raw = unit_normals(shape.tabulate(shape.nodes[a]), x[f])
    raw *= np.sign(np.einsum("kg,kg->k", raw, outward[f]))[:, None]
    return np.vstack([raw, raw.sum(axis=0) / np.linalg.norm(raw.sum(axis=0))])


def listed(n: Neighbours):
    """All pairs in the lists: of each list ``{node: facets' keys}``, on every rank (collective)."""
    found = []
    for one in n.lists:
        (node,) = one.exchange.send(n.skin.config.to_global(n.nodes))
        nodes, keys = everywhere(node[one.node], n.skin.keys[one.facet])
        found.append({k: sorted(keys[nodes == k].tolist()) for k in np.unique(nodes)})
    return found


CLOUDS = [("triangle", 1), ("quadrilateral", 1), ("triangle", 2), ("tetrahedron", 1), ("hexahedron", 1), slow("tetrahedron", 2)]


@pytest.mark.parametrize("cell,degree", CLOUDS)
@pytest.mark.parametrize("seed", [1, 2])
def test_lists_are_what_a_loop_finds(cell, degree, seed):
    """One list for the nearest body, the next for the next one; all facets of that body in reach that face the node, and no others."""
    count = 6 if dimension(cell) == 2 else 4
    skin = cloud(cell, count, seed, degree)
    n = lists_of(skin)
    for moved in (False, True):
        if moved:
            drawn(skin, count, seed)
        # by motion, or made anew
        n._made_at = None
        n.update()
        found, total = listed(n), 0
        for node, keys, bodies, distances in Loops(n).pairs():
            nearest = sorted(set(bodies), key=lambda b: (distances[bodies == b].min(), b))[: len(found)]
            total += len(nearest)
            for k, one in enumerate(found):
                expected = sorted(keys[bodies == nearest[k]].tolist()) if k < len(nearest) else []
                assert one.get(node, []) == expected, (node, k)
        assert total > 4
        assert [one.empty for one in n.lists] == [not one for one in found]


@pytest.mark.parametrize("cell,degree", CLOUDS)
@pytest.mark.parametrize("averaged", [False, True])
def test_projections_are_those_of_the_body_alone(cell, degree, averaged):
    """Where a node's nearest place on a body is listed, all is as if the body were declared as its target by hand."""
    g = dimension(cell)
    bodies = [
        ball(cell, [0.0] * g, 1.0, 3),
        ball(cell, [2.02, *[0.0] * (g - 1)], 1.0, 4),
        ball(cell, [0.3, 2.05, 0.0][:g], 1.0, 3),
    ]
    s, skin = skin_of(cell, bodies, degree)
    n = lists_of(skin)
    points, seen = skin.config.x[n.nodes], 0
    targets = [Neighbour(n, k, averaged) for k in range(g)]
    found = [target.project(points) for target in targets]
    for body in range(3):
        alone = MeshTarget(TargetFacets(skin.config, only(skin, body)), averaged)
        plain = alone.project(points)
        for k, target in enumerate(targets):
            i = np.flatnonzero(n.body[k] == body)
            i = i[np.linalg.norm(found[k].foot[i] - plain.foot[i], axis=1) < 1e-12]
            seen += len(i)
            # of two facets that share the nearest place either may be meant
            alike = i[(found[k].nodes[i] == plain.nodes[i]).all(axis=1)]
            for name in ("gap", "normal", "foot", "averaged", "weights"):
                assert np.abs(getattr(found[k], name)[alike] - getattr(plain, name)[alike]).max(initial=0.0) < 1e-12, name
            on_side = skin.shape.side_distances(plain.xi[i]).min(axis=1) < 1e-9
            assert np.isin(i[~on_side], alike).all()
            # part of the nodes is projected as all are
            some = i[::2]
            part = target.project(points[some], some)
            assert np.abs(part.foot - found[k].foot[some]).max(initial=0.0) < 1e-13
            assert np.array_equal(part.facet, found[k].facet[some])
            # none nearer is left out among those in reach that face the node
            near = np.flatnonzero((plain.gap < 0.5 * n._reach[body]) & (plain.gap > -1e-9) & (n.body[k] == body))
            assert np.isin(near, i).all()
    assert COMM.allreduce(seen) > (4 if g == 2 else 8)


def only(skin, body):
    """The facets of one body of a skin, as a tag."""
    mesh, tdim = skin.config.mesh, skin.config.tdim
    mesh.topology.create_connectivity(tdim, tdim - 1)
    links = mesh.topology.connectivity(tdim, tdim - 1)
    of = skin.body == body
    facets = [links.links(c)[s] for c, s in zip(skin.cells[of], skin.sides[of])]
    return uem.Tag("one", 1, tdim - 1, mesh, np.sort(np.array(facets, dtype=np.int32)))


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_nothing_near_is_nothing_listed(cell):
    """Bodies far apart have empty lists, and projections that no contact can come from."""
    g = dimension(cell)
    _, skin = skin_of(cell, [ball(cell, [5.0 * k, *[0.0] * (g - 1)], 1.0, 2) for k in range(3)])
    n = lists_of(skin)
    found = Neighbour(n, 0).project(skin.config.x[n.nodes])
    assert all(one.empty and not len(one.node) for one in n.lists)
    assert (found.facet == -1).all() and (found.nodes == -1).all() and not found.normal.any() and not found.weights.any()
    assert (found.gap > 3.0).all() and np.isinf(found.from_end).all()
    assert (n.body == -1).all()


def test_parts_that_are_kept_apart():
    """Facets of the one part list no nodes of the other, either way round; the others stay."""
    s, skin = skin_of("quadrilateral", [box("quadrilateral", [k, 0.0], [k + 0.99, 1.0], [4, 4]) for k in range(3)])
    nodes = np.zeros((3, skin.config.n_local), bool)
    facets = np.zeros((3, len(skin.body)), bool)
    for b in range(3):
        nodes[b], facets[b] = skin.body_of_node == b, skin.body == b
    for apart, pairs in (((), {(0, 1), (1, 2)}), ((0, 1), {(1, 2)}), ((1, 0), {(1, 2)}), ((1, 2), {(0, 1)})):
        n = lists_of(skin, apart=[(nodes[apart[0]], facets[apart[0]], nodes[apart[1]], facets[apart[1]])] if apart else [])
        n.update()
        own, other = everywhere(np.tile(skin.body_of_node[n.nodes], len(n.body)), n.body.ravel())
        assert {(min(p), max(p)) for p in zip(own[other >= 0], other[other >= 0])} == pairs


# -- how long lists last ---------------------------------------------------------------------------------------------------


def projections(n):
    """What all lists tell of their nodes: ``{(node, body): point, foot, gap, ...}`` (collective)."""
    points, found = n.skin.config.x[n.nodes], {}
    for target in [Neighbour(n, k) for k in range(len(n.held))]:
        p = target.project(points)
        for i in np.flatnonzero(p.facet >= 0):
            found[int(n.nodes[i]), int(n.body[target.number][i])] = {
                "point": points[i], "foot": p.foot[i], "gap": p.gap[i], "normal": p.normal[i], "facet": p.facet[i],
            }  # fmt: skip
    return found


def nothing_is_missed(n, order, within, step):
    """What is nearer than a length is what lists made now tell, of two nodes at least."""
    found, fresh = projections(n), projections(lists_of(n.skin, order))
    near = [key for key, p in fresh.items() if np.linalg.norm(p["point"] - p["foot"]) < within]
    assert COMM.allreduce(len(near)) >= 2
    for key in near:
        assert key in found, (step, key)
        for name, value in fresh[key].items():
            assert np.abs(found[key][name] - value).max() < 1e-12, (step, key, name)


@pytest.mark.parametrize("way,times", [(0.05, (3, 6)), (0.45, (6, 14))], ids=["slow", "fast"])
@pytest.mark.parametrize("cell", ["quadrilateral", "hexahedron"])
def test_lists_last(cell, way, times):
    """A block slides over a floor, so many facets a step: lists are made a few times in 40 steps, and nothing near is missed."""
    g = dimension(cell)
    wide, side = [0.5] * (g - 2), 0.25
    long = int(np.ceil(40 * way + 4))
    floor = box(cell, [0.0, *[0.0] * (g - 2), -0.25], [long * side, *wide, 0.0], [long, *[2] * (g - 2), 1])
    block = box(cell, [side, *[0.0] * (g - 2), 0.02], [3 * side, *wide, 0.27], [2] * (g - 1) + [1])
    _, skin = skin_of(cell, [floor, block])
    config, order = skin.config, [1, 0]
    n = lists_of(skin, order)
    moving = skin.body_of_node == 1
    for step in range(41):
        config.displacement[moving, 0] = way * side * step
        nothing_is_missed(n, order, 0.25 * side, step)
        n.commit()
    assert times[0] <= n.times_made <= times[1]


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
@pytest.mark.parametrize("width", [1, 2])
def test_bodies_that_come_and_go_are_not_missed(cell, width):
    """Over a row of bodies, more of which are in reach than a node has lists: what is near is what lists made at every step tell."""
    side, way, steps = 0.25, 0.45, 20
    count = int((steps * way + 4) / width) + 1
    row = [
        box(cell, [1.02 * side * width * k, -side], [1.02 * side * width * k + side * width, 0.0], [width, 1])
        for k in range(count)
    ]
    block = box(cell, [0.0, 0.02], [2 * side, 0.02 + side], [2, 1])
    _, skin = skin_of(cell, [*row, block])
    n, order = lists_of(skin, [*range(1, count + 1), 0]), [*range(1, count + 1), 0]
    for step in range(steps + 1):
        skin.config.displacement[skin.body_of_node == count, 0] = way * side * step
        nothing_is_missed(n, order, 0.15 * side, step)
        n.commit()


@pytest.mark.parametrize("facets,way", [(3, 0.03), (4, 0.06)])
def test_facets_that_come_and_go_are_not_missed(facets, way):
    """A block led over a coarse disc stays in touch with facets that it was behind the planes of when the lists were made."""
    disc = ball("quadrilateral", [0.0, 0.0], 1.0, facets)
    height = np.sqrt(1 - 0.45**2)
    block = box("quadrilateral", [-0.5, height], [-0.4, height + 0.1], [2, 1])
    _, skin = skin_of("quadrilateral", [disc, block])
    n, alone, seen = lists_of(skin, [1, 0]), MeshTarget(TargetFacets(skin.config, only(skin, 0))), 0
    for step in range(int(0.9 / way)):
        x = way * step
        skin.config.displacement[skin.body_of_node == 1] = [x, np.sqrt(1 - (x - 0.45) ** 2) - height]
        points = skin.config.x[n.nodes]
        found, plain = Neighbour(n, 0).project(points), alone.project(points)
        low = np.flatnonzero((skin.body_of_node[n.nodes] == 1) & (skin.config.X[n.nodes][:, 1] < height + 0.01))
        seen += len(low)
        for name in ("gap", "foot", "normal", "beyond"):
            assert np.abs(getattr(found, name) - getattr(plain, name))[low].max(initial=0.0) < 1e-12, (step, name)
        n.commit()
    assert COMM.allreduce(seen) > 30


@pytest.mark.parametrize("far", [0.3, 3.0, 20.0])
@pytest.mark.parametrize("cell", ["triangle", "quadrilateral"])
def test_lists_of_a_failed_attempt_do_not_outlive_it(cell, far):
    """A step that begins anew has the lists that it began with, wherever an attempt has made others."""
    skin = cloud(cell, 6, 3)
    n = lists_of(skin)
    n.update()
    before, times = listed(n), n.times_made
    start = skin.config.displacement.copy()
    drawn(skin, 6, 4)
    skin.config.displacement[:] *= far
    n.update()
    away = n.times_made
    skin.config.displacement[:] = start
    n.begin_step()
    n.update()
    assert listed(n) == before
    assert n.times_made == away >= times


def test_trial_states_far_away_and_back():
    """A long trial step makes lists anew, and so does the way back; what is listed then is what was listed before."""
    skin = cloud("triangle", 6, 3)
    n = lists_of(skin)
    n.update()
    before, times = listed(n), n.times_made
    drawn(skin, 6, 4)
    skin.config.displacement[:] *= 20
    n.update()
    assert n.times_made == times + 1
    skin.config.displacement[:] = 0.0
    n.commit()
    n._made_at = None
    n.update()
    assert listed(n) == before


# -- pairs that may touch --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("lean,faced", [(-0.4, False), (0.3, False), (1.0, True)])
def test_facing_pairs(degree, lean, faced):
    """A wall next to a level face holds nodes of it only if it leans over them by more than 30 degrees."""
    low = box("quadrilateral", [0.0, 0.0], [2.0, 1.0], [8, 4])
    wall = box("quadrilateral", [1.02, 1.02], [1.52, 2.02], [2, 8])
    wall = wall.mapped(lambda x: x - np.column_stack([lean * (x[:, 1] - 1.02), np.zeros(len(x))]))
    _, skin = skin_of("quadrilateral", [low, wall], degree)
    n = lists_of(skin, [0, 1], overlap=1.0)
    n.update()
    X, one = skin.config.X[n.nodes], n.lists[0]
    level = (np.abs(X[:, 1] - 1.0) < 1e-9) & (np.abs(X[:, 0] - 1.0) < 0.9)
    (of_level,) = one.exchange.send(level)
    f = one.facet[of_level[one.node]]
    side = np.abs(skin.normals()[f][:, 0, 0] + np.cos(np.arctan(lean))) < 1e-9
    assert COMM.allreduce(len(f)) > 0
    assert (COMM.allreduce(int(side.sum())) > 0) == faced


@pytest.mark.parametrize("along", [0.3, -0.3])
def test_contactors_on_one_body(along):
    """Of opposite ends of a ring the one whose normal points more along the fixed direction, and all corners."""
    d, middle = DIRECTION[:2], 0.02
    turn = np.arctan2(d[1], d[0]) + np.arccos(along / np.linalg.norm(d)) - 0.5 * np.pi

    def rolled(x):
        angle, r = turn + middle + 2 * (np.pi - middle) * x[:, 0], 2.0 - x[:, 1]
        return np.column_stack([r * np.cos(angle), r * np.sin(angle)])

    _, skin = skin_of("quadrilateral", [box("quadrilateral", [0.0, 0.0], [1.0, 1.0], [24, 4])], pose=rolled)
    for itself in (False, True):
        n = lists_of(skin, itself=itself)
        n.update()
        one = n.lists[0]
        assert one.empty != itself
    reported = one.exchange.send(skin.corners[n.nodes], skin.cones(n.nodes)[:, :, 0])
    corner, cone = (a[one.node] for a in reported)
    normal = skin.normals()[one.facet][:, 0]
    facing = np.einsum("kcg,kg->kc", cone, normal)
    own = np.take_along_axis(cone, facing.argmin(axis=1)[:, None, None], axis=1)[:, 0]
    assert (facing.min(axis=1, initial=-1.0) < -0.99).all() and ((own - normal)[~corner] @ d > 0).all()
    assert COMM.allreduce(int((~corner).sum())) > 0 and COMM.allreduce(int(((own - normal)[corner] @ d < 0).sum())) > 0


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", "hexahedron"])
@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("sunk,front", [(-0.01, True), (0.1, True), (0.6, False)])
def test_through_a_thin_plate(cell, degree, sunk, front):
    """A plate on another one, sunk in by parts of the thickness: its nodes see the face before them, and never the back one.

    Those of its upper face look at the lower plate's lower face, and are more than its thickness behind it.
    """
    g = dimension(cell)
    wide, n = [1.0] * (g - 1), [2] * (g - 1)
    plates = [box(cell, [0.0] * (g - 1) + [z], [*wide, z + 0.1], [*n, 1]) for z in (-0.1, -0.1 * sunk)]
    _, skin = skin_of(cell, plates, degree)
    n = lists_of(skin, [1, 0])
    n.update()
    one = n.lists[0]
    normal, of_lower = skin.normals()[one.facet][:, 0, -1], skin.body[one.facet] == 0
    (height,) = one.exchange.send(skin.config.X[n.nodes][:, -1])
    lower = np.abs(height[one.node] + 0.1 * sunk) < 1e-9
    assert (COMM.allreduce(int((lower & of_lower & (normal > 0.9)).sum())) > 0) == front
    assert COMM.allreduce(int((of_lower & (normal < -0.9)).sum())) == 0


@pytest.mark.parametrize("overlap", [0.0, 0.08])
def test_overlaps_at_the_start(overlap):
    """What is inside others at the start may be, within the bound, until the first step is kept."""
    plates = [box("quadrilateral", [0.0, z], [1.0, z + 0.1], [2, 1]) for z in (-0.1, -0.03)]
    _, skin = skin_of("quadrilateral", plates)
    n = lists_of(skin, [1, 0], overlap=overlap)
    n.update()
    assert n.lists[0].empty == (overlap == 0.0)
    n.commit()
    n._made_at = None
    n.update()
    assert n.lists[0].empty


def test_a_facet_that_holds_a_node_stays():
    """Whatever side the node is on in a trial state: a contactor is not lost while it is held."""
    plates = [box("quadrilateral", [0.0, z], [1.0, z + 0.1], [2, 1]) for z in (-0.1, 0.0)]
    _, skin = skin_of("quadrilateral", plates)
    n = lists_of(skin, [1, 0])
    target = Neighbour(n, 0)
    upper = skin.body_of_node[n.nodes] == 1
    facet = np.where(upper, target.project(skin.config.x[n.nodes]).facet, -1)
    assert COMM.allreduce(int((facet >= 0).sum())) == 3
    for held in (True, False):
        target.hold(np.where(held, facet, -1))
        skin.config.displacement[:] = 0.0
        skin.config.displacement[skin.body_of_node == 1, 1] = -0.06
        n.commit()
        n._made_at = None
        again = np.where(upper, target.project(skin.config.x[n.nodes]).facet, -1)
        assert np.array_equal(again, facet if held else np.full(len(facet), -1))
    assert highest(COMM, facet) >= 0
