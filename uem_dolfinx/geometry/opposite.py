"""Search for the target facets that may lie opposite to contactor facets, on any rank.

Target facets are sent only to ranks whose contactor facets may face them; no rank holds a whole surface.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.geometry.candidates import balls_that_meet
from uem_dolfinx.geometry.overlaps import Planes, overlap
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.shapes import FacetShape
from uem_dolfinx.log import timed_as
from uem_dolfinx.parallel import Exchange

#: Facets face each other if the cosine of the angle between one's normal and the other's reversed is larger.
#: [convention; cosine; test_opposite.py::test_facets_that_face_each_other]
FACING = 0.6
#: Facets that have been opposite to each other in a step remain so until its end unless the cosine is smaller than this. Sides of a
#: corner that rotate with the forces would otherwise alternate between opposite and not.
#: [convention; cosine; test_opposite.py::test_facets_that_have_faced_each_other]
STILL_FACING = 0.2


@dataclass(frozen=True)
class Opposite:
    """Pairs of facets, ordered by contactor facet and then by the key of the target facet."""

    facet: Ints  # number of the contactor facet among the given ones ``(k,)``, ascending
    x: Array  # nodes of the target facet ``(k, nt, gdim)``
    nodes: Ints  # their global block numbers ``(k, nt)``
    key: Ints  # of the target facet, independent of the partition ``(k,)``


@timed_as("search")
def find_opposite(
    target: MeshTarget,
    planes: Planes,
    x: Array,
    reach: Array,
    faced: tuple[Ints, Ints] | None = None,
    visibility: Array | None = None,
) -> Opposite:
    """Target facets that face contactor facets and may lie upon them, no farther than ``reach (m,)`` along the normal (collective).

    Args:
        target: the surface.
        planes: of the contactor facets ``(m,)``.
        x: their nodes ``(m, nc, gdim)``.
        reach: lengths ``(m,)``.
        faced: keys of the contactor facets, independent of the partition ``(m,)``, and pairs of keys of contactor and target facets
            that have faced each other before ``(p, 2)``; None without such pairs.
        visibility: keys that decide which target facets they may touch, see ``MeshTarget.allowed`` ``(m, k)``; None allows all.
    """
    comm = target.comm
    middle = x.mean(axis=1)
    radius = np.linalg.norm(x - middle[:, None], axis=2).max(axis=1, initial=0.0)
    here = target.facets.x
    queried = [middle, radius, reach, planes.normal]
    visibility = np.zeros((len(x), 0)) if visibility is None else visibility
    if comm.size == 1:
        i, f = _allowed(target, visibility, *_candidates(target, here, *queried))
        return _facing(target.shape, planes, faced, i, here[f], target.facets.nodes[f], target.keys[f], target.facets.sign[f])
    exchange = Exchange(comm, target.boxes(here).near(middle, radius + reach))
    mine = np.arange(len(x))
    *arrived, visibility, row, rank = exchange.send(*queried, visibility, mine, np.full(len(x), comm.rank))
    i, f = _allowed(target, visibility, *_candidates(target, here, *arrived))
    found = Exchange.to(comm, rank[i]).send(row[i], here[f], target.facets.nodes[f], target.keys[f], target.facets.sign[f])
    return _facing(target.shape, planes, faced, *found)


def thickness(target: MeshTarget, most: float) -> Array:
    """Least distance of the surface's other side behind this rank's facets, at most ``most`` ``(m,)`` (collective)."""
    shape, facets = target.shape, target.facets
    x, thick = facets.x, np.full(len(facets.dofs), most)
    planes = Planes.of(shape, x, facets.sign)
    found = find_opposite(target, planes, x, thick)
    s = overlap(planes, (shape, x), (shape, found.x), facets.sign, found.facet)
    weight = np.bincount(s.pair, s.weight, minlength=len(found.facet))
    mean = np.bincount(s.pair, s.weight * s.gap, minlength=len(found.facet)) / np.where(weight > 0, weight, 1.0)
    behind = (weight > 0) & (mean < 0)
    np.minimum.at(thick, found.facet[behind], -mean[behind])
    return thick


def _allowed(target: MeshTarget, visibility: Array, facet: Ints, opposite: Ints) -> tuple[Ints, Ints]:
    """The pairs of facets that may touch each other, by the keys ``visibility (m, k)`` of the contactor facets."""
    if not visibility.shape[1]:
        return facet, opposite
    may = target.allowed(visibility[facet], opposite)
    return facet[may], opposite[may]


def _facing(
    shape: FacetShape, planes: Planes, faced: tuple[Ints, Ints] | None, facet: Ints, y: Array, nodes: Ints, key: Ints, sign: Array
) -> Opposite:
    """The candidates that face each other now, or have ``faced`` each other before, in order."""
    kept = -np.einsum("kg,kg->k", planes.normal[facet], Planes.of(shape, y, sign).normal) > FACING
    if faced is not None and len(faced[1]):
        keys, before = faced
        unsure = np.flatnonzero(~kept)
        queried = np.column_stack([keys[facet[unsure]], key[unsure]])
        before = before[np.isin(before[:, 0], queried[:, 0])]
        _, number = np.unique(np.concatenate([before, queried]), axis=0, return_inverse=True)
        number = number.ravel()
        kept[unsure] = np.isin(number[len(before) :], number[: len(before)])
    i = np.flatnonzero(kept)
    i = i[np.lexsort((key[i], facet[i]))]
    return Opposite(facet[i], y[i], nodes[i], key[i])


def _candidates(target: MeshTarget, y: Array, middle: Array, radius: Array, reach: Array, normal: Array) -> tuple[Ints, Ints]:
    """Contactor facets, by middle, radius, reach and normal, and this rank's target facets that may cover them, ``(k,)`` each."""
    none = np.zeros(0, dtype=np.int64)
    if not len(middle) or not len(y):
        return none, none
    centre = y.mean(axis=1)
    size = np.linalg.norm(y - centre[:, None], axis=2).max(axis=1)
    outward = Planes.of(target.shape, y, target.facets.sign).normal
    ball, row, within = _balls_along(middle, radius, reach, normal, y.reshape(-1, y.shape[2]))
    if not len(ball):
        return none, none
    b, f = balls_that_meet(ball, within, centre, size)
    i, f = np.divmod(np.unique(row[b] * len(y) + f), len(y))
    away = centre[f] - middle[i]
    height = np.einsum("kg,kg->k", away, normal[i])
    lateral = np.sqrt(np.maximum(np.einsum("kg,kg->k", away, away) - height**2, 0.0))
    both = radius[i] + size[f]
    kept = (np.einsum("kg,kg->k", normal[i], outward[f]) < -STILL_FACING) & (lateral < both) & (np.abs(height) < reach[i] + both)
    return i[kept], f[kept]


def _balls_along(middle: Array, radius: Array, reach: Array, normal: Array, places: Array) -> tuple[Array, Ints, Array]:
    """Balls that together cover the given positions within ``reach`` of facets along their normals.

    The search region of a facet of ``radius (m,)`` is a tube. One ball around a long tube would contain many facets outside it.
    Only the part of the tube inside the bounding box of ``places (k, gdim)`` is covered. Returns middles ``(k, gdim)``, the facet
    of each ``(k,)`` and radii ``(k,)``.
    """
    box = np.stack([places.min(axis=0), places.max(axis=0)])
    centre, arm = box.mean(axis=0), 0.5 * (box[1] - box[0])
    height = np.einsum("mg,mg->m", normal, centre - middle)
    depth = np.abs(normal) @ arm
    half = radius + reach
    low, high = np.maximum(height - depth - radius, -half), np.minimum(height + depth + radius, half)
    length = np.maximum(high - low, 0.0)
    count = np.ceil(length / (2.0 * np.where(radius > 0, radius, 1.0))).astype(np.int64)
    row = np.repeat(np.arange(len(count)), count)
    part = length / np.maximum(count, 1)
    at = low[row] + (np.arange(len(row)) - (np.cumsum(count) - count)[row] + 0.5) * part[row]
    return middle[row] + at[:, None] * normal[row], row, np.hypot(radius, 0.5 * part)[row]
