"""Contactors in concave corners of a faceted target, held by two facets on an edge, or by three at a vertex.

Facet normals are discontinuous. At a concave edge between two facets, a contactor is held by both; with one facet at a time it
would alternate between them.
"""

from __future__ import annotations

from dataclasses import dataclass

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints, cross_products
from uem_dolfinx.contact.seam.corners import Corners
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.shapes import beneath, closest_point, tangents
from uem_dolfinx.parallel import reduced


def find_corners(comm: MPI.Comm, target: MeshTarget, points: Array, which: Ints, facets: Ints) -> Corners | None:
    """Corners formed by sets of facets; None if there are no sets on any rank (collective).

    Args:
        comm: communicator.
        target: target of these facets.
        points: positions of the contactors ``(k, gdim)``.
        which: their indices among the pair's contactors ``(k,)``.
        facets: at least two for each contactor, padded with -1 ``(k, gdim)``.
    """
    if not reduced(comm, len(which)):
        return None
    k, gdim = facets.shape
    row, j = np.nonzero(facets >= 0)
    every = target.project_on(points[row], facets[row, j])
    first = every.take(np.flatnonzero(j == 0))
    normals, middles = np.zeros((2, k, gdim, gdim))
    normals[row, j], middles[row, j] = target.outward(every), every.x.mean(axis=1)
    common = np.ones(first.nodes.shape, dtype=bool)
    for n in range(1, gdim):
        other, i = every.nodes[j == n], row[j == n]
        common[i] &= (first.nodes[i][:, :, None] == other[:, None, :]).any(axis=2)
    count = (facets >= 0).sum(axis=1)
    place = _shared_place(target, first, points, common, count, normals)
    arms = middles - place.foot[:, None]
    arm = arms[np.arange(k), count - 1]
    arm /= np.linalg.norm(arm, axis=1, keepdims=True)
    earlier = np.arange(gdim)[None, :] < count[:, None] - 1
    rising = np.where(earlier, np.einsum("kg,kjg->kj", arm, normals), np.inf).min(axis=1)
    return Corners(
        which, count, place.found, rising, normals, _away(arms, normals, count), _axes(normals, count), first.nodes,
        place.weights, place.foot, place.beyond, first.x, place.dN, place.ddN,
    )  # fmt: skip


@dataclass(frozen=True)
class _Place:
    found: Bools
    weights: Array
    foot: Array
    beyond: Array
    dN: Array
    ddN: Array


def _shared_place(
    target: MeshTarget, first: FacetProjection, points: Array, common: Bools, count: Ints, normals: Array
) -> _Place:
    """Closest points on the common side of two facets, or on the common vertex of three.

    A side is continued past the end of the target for contactors past that end. Two facets that share only a vertex approximate the
    edge between neighbouring facets; their planes meet in a line.
    """
    k, nn = common.shape
    shape = target.shape
    d = shape.dim - 1
    found, weights = np.zeros(k, bool), np.zeros((k, nn))
    dN, ddN = np.zeros((k, nn, d)), np.zeros((k, nn, d, d))
    x, beyond, past = first.x, np.zeros(points.shape), (first.beyond != 0).any(axis=1)
    for side, nodes, _, _ in shape.edges:
        i = np.flatnonzero((count == 2) & common[:, nodes].all(axis=1) & ~found)
        s, _ = closest_point(side, x[i][:, nodes], points[i])
        if d:
            j = np.flatnonzero(past[i])
            line, end = x[i[j]][:, nodes], s[j]
            s[j], there = beneath(side, line, end, points[i[j]])
            beyond[i[j]] = np.einsum("ka,kag->kg", there.N - side.functions(end), line)
        tab = side.tabulate(s)
        weights[i[:, None], nodes], dN[i[:, None], nodes], ddN[i[:, None], nodes] = tab.N, tab.dN, tab.ddN
        found[i] = True
    for node in range(len(shape.topology[0])):
        i = np.flatnonzero(common[:, node] & ~found)
        weights[i, node] = 1.0
        found[i] = True
        if d:
            i = i[count[i] == 2]
            weights[i], dN[i, :, 0] = _on_line(target, x[i], points[i], node, normals[i])
    foot = np.einsum("ka,kag->kg", weights, x)
    return _Place(found, weights, foot, beyond, dN, ddN)


def _on_line(target: MeshTarget, x: Array, points: Array, node: int, normals: Array) -> tuple[Array, Array]:
    """Closest points on the intersection line of the planes of two facets with a common vertex.

    Returns:
        Shape functions of the first facet, extrapolated if necessary, and their derivatives along the line ``(k, nn)``.
    """
    along = cross_products(normals[:, 0], normals[:, 1])
    length = np.linalg.norm(along, axis=1, keepdims=True)
    along /= np.where(length > 0, length, 1.0)
    vertex = x[:, node]
    foot = vertex + np.einsum("kg,kg->k", along, points - vertex)[:, None] * along
    _, tab = beneath(target.shape, x, np.tile(target.shape.nodes[node], (len(x), 1)), foot)
    t = tangents(tab, x)
    m = np.einsum("kfg,keg->kfe", t, t)
    rate = np.linalg.solve(m, np.einsum("kfg,kg->kf", t, along)[..., None])[..., 0]
    return tab.N, np.einsum("kaf,kf->ka", tab.dN, rate)


def _away(arms: Array, normals: Array, count: Ints) -> Array:
    """Unit directions along facets with these normals, away from and across the common edge ``(k, gdim, gdim)``.

    ``arms (k, gdim, gdim)`` are vectors from the common edge or vertex to the facets' midpoints.
    """
    gdim = arms.shape[2]
    along = arms - np.einsum("krg,krg->kr", arms, normals)[:, :, None] * normals
    if gdim == 3:
        edge = cross_products(normals[:, 0], normals[:, 1])
        size = np.linalg.norm(edge, axis=1, keepdims=True)
        edge = np.where((count == 2)[:, None], edge / np.where(size > 0, size, 1.0), 0.0)
        along -= np.einsum("krg,kg->kr", along, edge)[:, :, None] * edge[:, None]
    size = np.linalg.norm(along, axis=2, keepdims=True)
    here = np.arange(gdim)[None, :, None] < count[:, None, None]
    return np.where(here, along / np.where(size > 0, size, 1.0), 0.0)


def _axes(normals: Array, count: Ints) -> Array:
    """Orthonormal axes of the span of the normals, their mean direction first ``(k, gdim, gdim)``."""
    k, gdim, _ = normals.shape
    spread = normals[:, 0] - normals[:, 1]
    # two normals span a plane; for three normals any completion of the axes is valid
    basis = np.concatenate([normals.sum(axis=1)[:, None], spread[:, None], np.tile(np.eye(gdim), (k, 1, 1))], axis=1)
    axes = np.zeros((k, gdim, gdim))
    for r in range(gdim):
        rest = basis - np.einsum("kbg,krg,krh->kbh", basis, axes, axes)
        length = np.linalg.norm(rest, axis=2)
        # in this order, but never a direction that is spent
        best = np.argmax(length > (1e-12 if r < 2 else 0.5), axis=1)
        v = rest[np.arange(k), best]
        v -= np.einsum("kg,krg,krh->kh", v, axes, axes)
        axes[:, r] = v / np.linalg.norm(v, axis=1, keepdims=True)
    return axes
