"""Sharp convex edges of surfaces in 3D, and crossings of edges of two surfaces inside both bodies, between their nodes.

The nearest points of two edges lie on their common normal. If the bodies overlap, each point lies behind the mean of the facets at the
other edge. An edge of degree 2 consists of two straight pieces.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints
from uem_dolfinx.geometry.candidates import balls_that_meet
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.sharp import sharp_edges
from uem_dolfinx.parallel import Exchange, gathered, reduced, sums_by_keys

#: Shallower crossings are caused by facets that are curved between their nodes.
#: [convention; length of an edge between nodes; test_crossing_edges.py::test_how_deep_edges_cross]
DEEP = 0.02


class Crossing(NamedTuple):
    """The deepest crossing of edges.

    Attributes:
        depth: a length.
        place: middle of the crossing ``(3,)``.
    """

    depth: float
    place: Array


class SharpEdges:
    """Sharp convex edges within a surface of 3D bodies, in straight pieces between neighbouring nodes (collective).

    Each edge occurs twice, once for each of its facets.

    Args:
        facets: of the surface.

    Attributes:
        total: number of pieces over all ranks.
        facet: this rank's facet of each piece ``(k,)``.
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
        self.facet = np.repeat(facet, self._pieces)
        self.total = int(reduced(comm, len(self.facet)))

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
    """The deepest crossing of edges of two surfaces, which may be identical; None without crossing (collective).

    Args:
        own: edges of one surface.
        theirs: edges of the other.
        keys: visibility keys of the edge segments of both ``(k, m)``.
        meet: function of two arrays of keys ``(n, m)`` that returns whether segments may meet ``(n,)``.
    """
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
    """Depths of crossings inside both bodies ``(k,)``, 0 without crossing, and middles of the nearest points ``(k, 3)``.

    Args:
        one: ends ``(k, 2, 3)`` and normals ``(k, 3)`` of the first.
        other: of the second.
    """
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
