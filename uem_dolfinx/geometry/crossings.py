"""Where straight ways of points cross moving facets: the exact times, and whether they lead into the body or out of it.

Facets are cut into simplices between neighbouring nodes, whose nodes move straight as the points do: the height of a point over the
plane of its simplex is a cubic of time (in 2D a square), which is bracketed between its extremes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Ints, cross_products
from uem_dolfinx.geometry.search import ON_SIDE

#: Halvings that find a time to the last bit.
#: [bound; halvings; -]
HALVINGS = 53


@dataclass(frozen=True)
class Crossings:
    """Crossings of ``k`` simplices, in no order.

    Attributes:
        point: which point crosses ``(k,)``.
        time: when, 0 at the start and 1 at the end of its way ``(k,)``.
        inwards: whether it enters the body ``(k,)``, or leaves it.
        normal: outward unit normals there and then ``(k, gdim)``.
    """

    point: Ints
    time: Array
    inwards: Bools
    normal: Array


def find_crossings(
    start: tuple[Array, Array],
    end: tuple[Array, Array],
    sign: Array,
    reach: float,
    meet: Callable[[Ints, Ints], Bools] | None = None,
) -> Crossings:
    """Crossings of ``n`` points with ``m`` simplices of ``gdim`` nodes each, all of which move straight.

    Args:
        start: points ``(n, gdim)`` and simplices ``(m, gdim, gdim)`` at the beginning.
        end: the same at the end.
        sign: 1 where a simplex is numbered so that its normal points out of its body, -1 where it points inwards ``(m,)``.
        reach: length by which each point's way is continued at both ends: points that rest on a facet cross it.
        meet: which of points and simplices ``(k,)`` each count; None are all.
    """
    (p0, x0), (p1, x1) = start, end
    i, f = _near(p0, p1, x0, x1, reach)
    if meet is not None:
        some = meet(i, f)
        i, f = i[some], f[some]
    p0, p1, x0, x1 = p0[i], p1[i], x0[f], x1[f]
    way = np.linalg.norm(p1 - p0 - (x1 - x0).mean(axis=1), axis=1)
    further = np.minimum(reach / np.where(way > 0, way, np.inf), 1.0)

    def height(t: Array, k: Ints) -> tuple[Array, Array, Array]:
        """Volume under the points, simplices' nodes relative to the points, and outward normals, at times ``t (k,)``."""
        s = t[:, None]
        x = x0[k] + s[..., None] * (x1[k] - x0[k]) - (p0[k] + s * (p1[k] - p0[k]))[:, None]
        n = sign[f[k], None] * _normals(x)
        return -np.einsum("kg,kg->k", n, x[:, 0]), x, n

    every = np.arange(len(i))
    bounds = _extremes(lambda t: height(t, every)[0], -further, 1.0 + further)
    passed = np.stack([height(t, every)[0] >= 0 for t in bounds])
    # from one bound to the next, all of which are halved together
    interval, k = np.nonzero(passed[:-1] != passed[1:])
    times = np.stack(bounds)
    low, high, falls = times[interval, k], times[interval + 1, k], passed[interval, k]
    for _ in range(HALVINGS if len(k) else 0):
        middle = 0.5 * (low + high)
        beyond = (height(middle, k)[0] >= 0) != falls
        low, high = np.where(beyond, low, middle), np.where(beyond, middle, high)
    _, x, n = height(high, k)
    met = _contain_origin(x)
    return Crossings(i[k[met]], high[met], falls[met], n[met] / np.linalg.norm(n[met], axis=1, keepdims=True))


def _near(p0: Array, p1: Array, x0: Array, x1: Array, reach: float) -> tuple[Ints, Ints]:
    """Points and simplices whose ways can meet, ``(k,)`` each: balls about both ways intersect, and so do boxes."""
    none = np.zeros(0, np.int64)
    if not len(p0) or not len(x0):
        return none, none
    from scipy.spatial import cKDTree

    both = np.concatenate([x0, x1], axis=1)
    low, high = both.min(axis=1), both.max(axis=1)
    radius = 0.5 * np.linalg.norm(high - low, axis=1)
    found = []
    # a graded mesh does not pay for its largest facet everywhere
    size_class = np.floor(np.log2(radius / radius.max()))
    for c in np.unique(size_class):
        members = np.flatnonzero(size_class == c)
        arm = 0.5 * np.linalg.norm(p1 - p0, axis=1) + reach + radius[members].max()
        hits = cKDTree(0.5 * (low + high)[members]).query_ball_point(0.5 * (p0 + p1), arm, return_sorted=False)
        for i, hit in enumerate(hits):
            f = members[np.asarray(hit, dtype=np.int64)]
            meets = (np.minimum(p0[i], p1[i]) - reach <= high[f]) & (np.maximum(p0[i], p1[i]) + reach >= low[f])
            f = f[meets.all(axis=1)]
            found.append((np.full(len(f), i), f))
    return np.concatenate([i for i, _ in found]), np.concatenate([f for _, f in found])


def _normals(x: Array) -> Array:
    """Normals of simplices ``x (k, gdim, gdim)`` in the sense of their numbering, as long as the simplices are large."""
    t = x[:, 1:] - x[:, :1]
    return np.stack([t[:, 0, 1], -t[:, 0, 0]], axis=1) if x.shape[1] == 2 else cross_products(t[:, 0], t[:, 1])


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
    """Which simplices ``x (k, gdim, gdim)``, in whose plane the origin lies, contain it."""
    t = x[:, 1:] - x[:, :1]
    m = np.einsum("kag,kbg->kab", t, t)
    flat = np.linalg.det(m) <= 0.0
    m[flat] = np.eye(m.shape[1])
    xi = np.linalg.solve(m, -np.einsum("kag,kg->ka", t, x[:, 0])[..., None])[..., 0]
    return (xi >= -ON_SIDE).all(axis=1) & (xi.sum(axis=1) <= 1 + ON_SIDE) & ~flat
