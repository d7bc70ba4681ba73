"""Candidates for nearest facets, and pairs of intersecting balls, by trees over facet midpoints. Pure geometry, on one rank."""

from __future__ import annotations

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.geometry.shapes import FacetShape, unit_normals
from uem_dolfinx.log import timed

#: Facets whose distances differ by less are equally near, and those whose heights do are faced alike.
#: [convention; part of the distance; test_thresholds_geometry.py::test_facets_equally_near]
EQUALLY_NEAR = 1e-9
#: So few pairs are all measured at once, which takes less time than trees.
#: [bound; points times facets; test_thresholds_geometry.py::test_no_facet_is_forgotten]
ALL_PAIRS = 2**15


@timed("search")
def candidate_pairs(
    shape: FacetShape, x: Array, points: Array, asked: Ints | None = None, surface: Ints | None = None
) -> tuple[Ints, Ints]:
    """Indices ``(k,)`` of points and of facets that can be closest; with many facets by one tree of midpoints per size class.

    A facet of radius R is a candidate if its middle is within R of the bound that the nearest middle gives; sorting the facets
    into classes of like radius keeps a graded mesh from paying for its largest facet everywhere. Every one of the
    ``points (n, gdim)`` occurs at least once if there are facets, whose nodes are at ``x (m, nn, gdim)``. With numbers of surfaces those of
    each point's surface, ``asked (n,)``, are candidates alone, ``surface (m,)``; every point's has some.
    """
    if len(points) == 0 or len(x) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    tab = shape.at_middle(len(x))
    middle = np.einsum("na,nag->ng", tab.N, x)
    arm = x - middle[:, None]
    radius = shape.lebesgue * np.linalg.norm(arm, axis=2).max(axis=1)
    normal = unit_normals(tab, x)
    bulge = shape.lebesgue * np.abs(np.einsum("mag,mg->ma", arm, normal)).max(axis=1)
    places, middles = points, middle
    if asked is not None and surface is not None:
        # a further axis, along which different surfaces are too far from each other to be near
        far = 4.0 * float(np.ptp(np.concatenate([points, middle]), axis=0).sum() + radius.max())
        places, middles = np.column_stack([points, far * asked]), np.column_stack([middle, far * surface])
    if len(places) * len(middles) <= ALL_PAIRS:
        distance = np.sqrt(sum((places[:, None, k] - middles[:, k]) ** 2 for k in range(places.shape[1])))
        bound = distance.min(axis=1) * (1 + EQUALLY_NEAR)
        i, f = np.nonzero(distance <= bound[:, None] + radius)
    else:
        from scipy.spatial import cKDTree

        bound = cKDTree(middles).query(places)[0] * (1 + EQUALLY_NEAR)
        i, f = balls_that_meet(places, bound, middles, radius)
    # a facet lies in a flat disc about its midpoint; from a distance, fewer discs than balls are near
    away = points[i] - middle[f]
    height = np.abs(np.einsum("kg,kg->k", away, normal[f]))
    beside = np.sqrt(np.maximum(np.einsum("kg,kg->k", away, away) - height**2, 0.0))
    too_far = np.hypot(np.maximum(height - bulge[f], 0.0), np.maximum(beside - radius[f], 0.0)) > bound[i]
    return i[~too_far], f[~too_far]


def balls_that_meet(points: Array, within: Array, middle: Array, radius: Array) -> tuple[Ints, Ints]:
    """Pairs ``(k,)`` of balls about ``points (n, gdim)`` and about facet midpoints ``(m, gdim)``, m > 0, that may intersect.

    There is a tree for each class of balls of similar radius on either side.

    Args:
        points: centres of the first balls.
        within: their radii ``(n,)``.
        middle: midpoints of the facets.
        radius: of the facets ``(m,)``.
    """
    from scipy.spatial import cKDTree

    rows, facets = [], []
    smallest = radius.min()
    theirs = [(which, cKDTree(middle[which]), radius[which].max()) for which in _like(radius)]
    for own in _like(np.maximum(within, smallest)):
        tree, largest = cKDTree(points[own]), within[own].max()
        for which, other, r in theirs:
            found = tree.sparse_distance_matrix(other, largest + r, output_type="ndarray")
            if not len(found):
                continue
            i, f = own[found["i"]], which[found["j"]]
            near = found["v"] <= within[i] + r
            rows.append(i[near])
            facets.append(f[near])
    none = np.zeros(0, np.int64)
    return np.concatenate([none, *rows]), np.concatenate([none, *facets])


def _like(sizes: Array) -> list[Ints]:
    """Indices of positive sizes in classes that differ by less than a factor of two."""
    size_class = np.floor(np.log2(sizes / sizes.max(initial=0.0)))
    order = np.argsort(size_class, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(size_class[order])) + 1) if len(order) else []
