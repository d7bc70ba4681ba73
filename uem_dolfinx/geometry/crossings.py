"""Crossings of straight paths of points with moving facets: exact times, and entry into or exit from the body.

Facets are cut into simplices between neighbouring nodes. Points and nodes move on straight paths, so that the height of a point over the
plane of a simplex is a cubic polynomial of time (in 2D quadratic). Its roots are bracketed by its extremes. For a body that rotates and
deforms, paths are straight relative to the facets, which rotate with the body around them.

Sharp convex edges of surfaces in 3D, and crossings of edges of two surfaces inside both bodies, between their nodes.

The nearest points of two edges lie on their common normal. If the bodies overlap, each point lies behind the mean of the facets at the
other edge. An edge of degree 2 consists of two straight pieces.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints, cross_products
from uem_dolfinx.geometry.bodies import rotations
from uem_dolfinx.geometry.candidates import balls_that_meet
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.search import ON_SIDE, MeshTarget
from uem_dolfinx.geometry.sharp import sharp_edges
from uem_dolfinx.parallel import Exchange, gathered, reduced, sums_by_keys

#: Halvings that find a time to the last bit. [bound; halvings; -]
HALVINGS = 53
#: A point that leaves the plane of a facet by less than this part of the reach moves with the facet.
#: [bound; the reach; test_crossings.py::test_points_that_ride_on_facets]
BY_ROUNDING = 1e-10


@dataclass(frozen=True)
class Crossings:
    """Crossings of ``k`` simplices, in no order."""

    point: Ints  # index of the point ``(k,)``
    facet: Ints  # index of the simplex, or number over all ranks of its facet ``(k,)``
    way: Array  # length of the point's path relative to the simplex ``(k,)``
    time: Array  # 0 at the start and 1 at the end of the path ``(k,)``
    inwards: Bools  # whether it enters the body ``(k,)``, or leaves it
    normal: Array  # outward unit normals at the crossing ``(k, gdim)``


def find_crossings(
    start: tuple[Array, Array],
    end: tuple[Array, Array],
    sign: Array,
    reach: float,
    meet: Callable[[Ints, Ints], Bools] | None = None,
    turning: bool = False,
) -> Crossings:
    """Crossings of ``n`` points with ``m`` simplices of ``gdim`` nodes each; all move on straight paths.

    Args:
        start: points ``(n, gdim)`` and simplices ``(m, gdim, gdim)`` at the beginning.
        end: the same at the end.
        sign: 1 where a simplex is numbered so that its normal points out of its body, -1 where it points inwards ``(m,)``.
        reach: length by which each point's path is extended at both ends, so that points at rest on a facet cross it.
        meet: mask of pairs of points and simplices ``(k,)`` that count; None for all pairs.
        turning: whether paths are straight relative to the rotating simplices, not in space.
    """
    (p0, x0), (p1, x1) = start, end
    i, f = _near(p0, p1, x0, x1, reach, not turning)
    if meet is not None:
        some = meet(i, f)
        i, f = i[some], f[some]
    if turning:
        p0, x0 = _carried_along(p0, x0, x1, i, f)
    else:
        p0, x0 = p0[i], x0[f]
    p1, x1 = p1[i], x1[f]
    pass_by, way = _pass_by(p0, p1, x0, x1, reach)
    i, f = i[pass_by], f[pass_by]
    p0, p1, x0, x1, way = (a[pass_by] for a in (p0, p1, x0, x1, way))
    further = np.minimum(reach / np.where(way > 0, way, np.inf), 1.0)

    def height(t: Array, k: Ints) -> tuple[Array, Array, Array]:
        """Volume under the points, simplices' nodes relative to the points, and outward normals, at times ``t (k,)``."""
        s = t[:, None]
        x = x0[k] + s[..., None] * (x1[k] - x0[k]) - (p0[k] + s * (p1[k] - p0[k]))[:, None]
        n = sign[f[k], None] * _normals(x)
        return -np.einsum("kg,kg->k", n, x[:, 0]), x, n

    every = np.arange(len(i))
    times = np.stack(_extremes(lambda t: height(t, every)[0], -further, 1.0 + further))
    volumes, _, normals = (np.stack(parts) for parts in zip(*(height(t, every) for t in times)))
    passed, leaves = volumes >= 0, np.abs(volumes) > BY_ROUNDING * reach * np.linalg.norm(normals, axis=2)
    # intervals between extremes that contain a root
    interval, k = np.nonzero((passed[:-1] != passed[1:]) & leaves[:-1] & leaves[1:])
    low, high, falls = times[interval, k], times[interval + 1, k], passed[interval, k]
    for _ in range(HALVINGS if len(k) else 0):
        middle = 0.5 * (low + high)
        beyond = (height(middle, k)[0] >= 0) != falls
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    _, x, n = height(high, k)
    met = _contain_origin(x)
    k, n = k[met], n[met]
    return Crossings(i[k], f[k], way[k], high[met], falls[met], n / np.linalg.norm(n, axis=1, keepdims=True))


def cross_target(
    target: MeshTarget,
    which: Ints,
    points: tuple[Array, Array],
    nodes: tuple[Array, Array],
    reach: float,
    keys: Ints,
    meet: Callable[[Ints, Ints], Bools],
    turning: bool = False,
) -> Crossings:
    """Crossings of points with a target whose facets are spread over ranks, on the points' own ranks (collective).

    Args:
        target: the surface.
        which: numbers of the points ``(k,)``.
        points: at the beginning and at the end ``(k, gdim)`` each.
        nodes: of this rank's facets at the beginning and at the end ``(m, nn, gdim)`` each.
        reach: see ``find_crossings``.
        keys: visibility keys of the points ``(k, ...)``.
        meet: function of these keys and this rank's facets ``(k,)`` that returns whether crossings count.
        turning: see ``find_crossings``.
    """
    comm, (p0, p1), g, pieces = target.comm, points, points[0].shape[1], target.shape.pieces
    low, high = _boxes(p0[:, None], p1[:, None], turning)
    x0, x1 = (x[:, pieces].reshape(-1, g, g) for x in nodes)
    lowest, highest = _boxes(x0, x1, turning)
    box = np.array([lowest.min(axis=0, initial=np.inf) - reach, highest.max(axis=0, initial=-np.inf) + reach])
    rows = [np.flatnonzero(((low <= b[1]) & (high >= b[0])).all(axis=1)) for b in comm.allgather(box)]
    there = Exchange(comm, rows)
    q0, q1, number, keys, home = there.send(p0, p1, which, keys, np.full(len(which), comm.rank))
    sign = np.repeat(target.facets.sign, len(pieces))
    found = find_crossings((q0, x0), (q1, x1), sign, reach, lambda i, f: meet(keys[i], f // len(pieces)), turning)
    back, facet = Exchange.to(comm, home[found.point]), found.facet // len(pieces) + target.first[comm.rank]
    return Crossings(*back.send(number[found.point], facet, found.way, found.time, found.inwards, found.normal))


def entries_and_exits(found: Crossings) -> tuple[Ints, Ints, Ints]:
    """Pairs of an entry and a later exit of the same point ``(k,)`` each, and exits without an earlier entry."""
    ins, outs = np.flatnonzero(found.inwards), np.flatnonzero(~found.inwards)
    ins = ins[np.argsort(found.point[ins], kind="stable")]
    first, last = (np.searchsorted(found.point[ins], found.point[outs], side=side) for side in ("left", "right"))
    leaving = np.repeat(outs, last - first)
    begins = np.repeat(np.cumsum(last - first) - (last - first), last - first)
    entry = ins[np.repeat(first, last - first) + np.arange(len(leaving)) - begins]
    later = found.time[leaving] > found.time[entry]
    entry, leaving = entry[later], leaving[later]
    return entry, leaving, np.setdiff1d(outs, leaving)


def _carried_along(p0: Array, x0: Array, x1: Array, i: Ints, f: Ints) -> tuple[Array, Array]:
    """Points ``p0 (n, gdim)`` and simplices ``x0 (m, gdim, gdim)``, moved by the rigid motions of the simplices to ``x1``.

    Returns points ``i (k,)`` moved with simplices ``f (k,)``, ``(k, gdim)``, and these simplices ``(k, gdim, gdim)``.
    """
    middle, there = x0.mean(axis=1), x1.mean(axis=1)
    some, which = np.unique(f, return_inverse=True)
    a, b = (np.concatenate([x[:, 1:] - x[:, :1], _normals(x, as_long=True)[:, None]], axis=1) for x in (x0[some], x1[some]))
    turned = rotations(np.einsum("mai,maj->mij", b, a))[which]
    arms = np.concatenate([p0[i, None], x0[f]], axis=1) - middle[f, None]
    carried = there[f, None] + np.einsum("kij,kaj->kai", turned, arms)
    return carried[:, 0], carried[:, 1:]


def _pass_by(p0: Array, p1: Array, x0: Array, x1: Array, reach: float) -> tuple[Bools, Array]:
    """Mask of points that pass the middles of simplices within their radius and the reach, and lengths of relative paths ``(k,)``."""
    middles = x0.mean(axis=1), x1.mean(axis=1)
    radius = np.stack([np.linalg.norm(x - m[:, None], axis=2).max(axis=1, initial=0.0) for x, m in zip((x0, x1), middles)])
    a, b = p0 - middles[0], p1 - middles[1]
    way = b - a
    squares = np.einsum("kg,kg->k", way, way)
    nearest = np.clip(-np.einsum("kg,kg->k", a, way) / np.where(squares > 0, squares, 1.0), 0.0, 1.0)
    by = np.linalg.norm(a + nearest[:, None] * way, axis=1)
    return np.asarray(by <= radius.max(axis=0) + reach), np.sqrt(squares)


def _boxes(start: Array, end: Array, balls: bool = False) -> tuple[Array, Array]:
    """Lower and upper corners ``(m, gdim)`` of boxes around the paths of nodes ``(m, k, gdim)``, or around balls around these."""
    both = np.concatenate([start, end], axis=1)
    low, high = both.min(axis=1), both.max(axis=1)
    if not balls:
        return low, high
    middle, radius = 0.5 * (low + high), 0.5 * np.linalg.norm(high - low, axis=1, keepdims=True)
    return middle - radius, middle + radius


def _near(p0: Array, p1: Array, x0: Array, x1: Array, reach: float, boxes: bool) -> tuple[Ints, Ints]:
    """Points and simplices whose paths can meet ``(k,)`` each: balls around both paths intersect, and so do ``boxes``.

    The balls also contain paths relative to a simplex that rotates by at most a right angle.
    """
    if not len(p0) or not len(x0):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    low, high = _boxes(x0, x1)
    within, radius = 0.5 * np.linalg.norm(p1 - p0, axis=1) + reach, 0.5 * np.linalg.norm(high - low, axis=1)
    i, f = balls_that_meet(0.5 * (p0 + p1), within, 0.5 * (low + high), radius)
    if not boxes:
        return i, f
    meets = ((np.minimum(p0, p1)[i] - reach <= high[f]) & (np.maximum(p0, p1)[i] + reach >= low[f])).all(axis=1)
    return i[meets], f[meets]


def _normals(x: Array, as_long: bool = False) -> Array:
    """Normals of simplices ``x (k, gdim, gdim)`` in the sense of their numbering, of their size, or ``as_long`` as their sides."""
    t = x[:, 1:] - x[:, :1]
    if x.shape[1] == 2:
        return np.stack([t[:, 0, 1], -t[:, 0, 0]], axis=1)
    n = cross_products(t[:, 0], t[:, 1])
    return n / np.sqrt(np.linalg.norm(n, axis=1, keepdims=True)) if as_long else n


def _extremes(f: Callable[[Array], Array], low: Array, high: Array) -> list[Array]:
    """Ends of the intervals within which cubics ``f`` of time are monotone, from ``low`` to ``high``, each ``(k,)``."""
    t = np.linspace(0.0, 1.0, 4)
    values = np.stack([f(np.full(len(low), s)) for s in t])
    _, c, b, a = np.linalg.solve(np.vander(t, increasing=True), values)
    a, b = 3 * a, 2 * b
    with np.errstate(all="ignore"):
        q = -0.5 * (b + np.where(b < 0, -1.0, 1.0) * np.sqrt(b * b - 4 * a * c))
        roots = np.stack([q / a, c / q])
    inner = np.sort(np.clip(np.where(np.isfinite(roots), roots, low), low, high), axis=0)
    return [low, *inner, high]


def _contain_origin(x: Array) -> Bools:
    """Which simplices ``x (k, gdim, gdim)`` contain the origin, which lies in their planes."""
    t = x[:, 1:] - x[:, :1]
    m = np.einsum("kag,kbg->kab", t, t)
    flat = np.linalg.det(m) <= 0.0
    m[flat] = np.eye(m.shape[1])
    xi = np.linalg.solve(m, -np.einsum("kag,kg->ka", t, x[:, 0])[..., None])[..., 0]
    return (xi >= -ON_SIDE).all(axis=1) & (xi.sum(axis=1) <= 1 + ON_SIDE) & ~flat


#: Shallower crossings are caused by facets that are curved between their nodes.
#: [convention; length of an edge between nodes; test_crossing_edges.py::test_how_deep_edges_cross]
DEEP = 0.02


class Crossing(NamedTuple):
    """The deepest crossing of edges."""

    depth: float  # a length
    place: Array  # middle of the crossing ``(3,)``


class SharpEdges:
    """Sharp convex edges within a surface of 3D bodies, in straight pieces between neighbouring nodes (collective).

    Each edge occurs twice, once for each of its facets.
    """

    def __init__(self, facets: TargetFacets):
        self.facets, comm = facets, facets.config.comm
        convex = sharp_edges(facets).convex
        sides = [nodes for _, nodes, _, _ in facets.shape.edges]
        self._keys, (facet, side) = facets.side_keys()[convex.ravel()], np.nonzero(convex)
        #: Facet of each side ``(n,)``, and the ends of its one or two pieces.
        self._facet: Ints = facet
        order = np.array([[nodes[0], *nodes[2:], nodes[1]] for nodes in sides])
        along = facets.dofs[facet[:, None], order[side]]
        self._ends = np.stack([along[:, :-1], along[:, 1:]], axis=2).reshape(-1, 2)
        self._pieces = along.shape[1] - 1
        self.facet = np.repeat(facet, self._pieces)  # this rank's facet of each piece ``(k,)``
        self.total = int(reduced(comm, len(self.facet)))  # number of pieces over all ranks

    @property
    def nodes(self) -> Ints:
        """Global numbers of the ends of pieces ``(k, 2)``."""
        return np.asarray(self.facets.config.to_global(self._ends.ravel())).reshape(-1, 2)

    def now(self) -> tuple[Array, Array]:
        """Ends of pieces ``(k, 2, 3)``, and sums of the outward unit normals of both facets ``(k, 3)``, as bodies are now (collective)."""
        config = self.facets.config
        _, normal = self.facets.middles(self.facets.x)
        return config.x[self._ends], np.repeat(sums_by_keys(config.comm, self._keys, normal[self._facet]), self._pieces, axis=0)


def find_crossing(own: SharpEdges, theirs: SharpEdges, keys: tuple[Ints, Ints], meet: Any) -> Crossing | None:
    """The deepest crossing of edges of two surfaces, or of one, whose visibility ``keys`` may ``meet``; None without (collective)."""
    comm = own.facets.config.comm
    (x, n), (y, m) = own.now(), theirs.now()
    (c, r), (d, q) = (_balls(z) for z in (x, y))
    box = np.stack([(d - q[:, None]).min(axis=0, initial=np.inf), (d + q[:, None]).max(axis=0, initial=-np.inf)])
    rows = [np.flatnonzero(((c - r[:, None] <= b[1]) & (c + r[:, None] >= b[0])).all(axis=1)) for b in gathered(comm, box)]
    a, na, nodes, key = Exchange(comm, rows).send(x, n, own.nodes, keys[0])
    depth, place = np.zeros(0), np.zeros((0, 3))
    if len(a) and len(y):
        c, r = _balls(a)
        i, j = balls_that_meet(c, r, d, q)
        disjoint = (nodes[i][:, :, None] != theirs.nodes[j][:, None]).all(axis=(1, 2))
        some = disjoint & meet(key[i], keys[1][j])
        i, j = i[some], j[some]
        depth, place = _depths((a[i], na[i]), (y[j], m[j]))
        deep = depth > 2.0 * DEEP * np.minimum(r[i], q[j])
        depth, place = depth[deep], place[deep]
    k = int(np.argmax(depth)) if len(depth) else -1
    best = gathered(comm, np.append(depth[k], place[k]) if k >= 0 else np.zeros(4))
    deepest = best[int(np.argmax(best[:, 0]))]
    return Crossing(float(deepest[0]), deepest[1:]) if deepest[0] else None


def _balls(x: Array) -> tuple[Array, Array]:
    """Middles ``(k, 3)`` and radii ``(k,)`` of the smallest balls round pieces with these ends ``(k, 2, 3)``."""
    return x.mean(axis=1), 0.5 * np.linalg.norm(x[:, 1] - x[:, 0], axis=1)


def _depths(one: tuple[Array, Array], other: tuple[Array, Array]) -> tuple[Array, Array]:
    """Depths of crossings inside both bodies ``(k,)``, 0 without, and middles of the nearest points ``(k, 3)``, from ends and normals."""
    (a, na), (b, nb) = one, other
    e, f, w = a[:, 1] - a[:, 0], b[:, 1] - b[:, 0], b[:, 0] - a[:, 0]
    ee, ff, ef, ew, fw = (np.einsum("kg,kg->k", p, q) for p, q in ((e, e), (f, f), (e, f), (e, w), (f, w)))
    square = ee * ff - ef**2
    # parallel edges have no common normal
    across = square > np.finfo(float).eps ** 0.5 * ee * ff
    over = np.where(across, square, 1.0)
    s, t = (ew * ff - fw * ef) / over, (ew * ef - fw * ee) / over
    inside: Bools = across & (s > 0) & (s < 1) & (t > 0) & (t < 1)
    p, q = a[:, 0] + s[:, None] * e, b[:, 0] + t[:, None] * f
    way = q - p
    inside &= (np.einsum("kg,kg->k", way, na) < 0) & (np.einsum("kg,kg->k", way, nb) > 0)
    return np.where(inside, np.linalg.norm(way, axis=1), 0.0), 0.5 * (p + q)
