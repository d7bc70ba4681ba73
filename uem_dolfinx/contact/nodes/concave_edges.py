"""Change of facet by contactors on targets with discontinuous normals: crossing of edges, entering and leaving of corners.

States are arguments and results; nothing is stored.

Contactors in concave corners of a faceted target, held by two facets on an edge, or by three at a vertex.

Facet normals are discontinuous. At a concave edge between two facets, a contactor is held by both; with one facet at a time it
would alternate between them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, cast
from weakref import proxy

from mpi4py import MPI

import numpy as np

from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED
from uem_dolfinx.arrays import Array, Bools, Ints, cross_products, replace
from uem_dolfinx.contact.seam.base import OnTarget
from uem_dolfinx.contact.seam.corners import ON_PLANE, Corners
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.candidates import EQUALLY_NEAR
from uem_dolfinx.geometry.projection import FacetProjection, Projection
from uem_dolfinx.geometry.search import ON_SIDE, MeshTarget
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
    """Closest points on the line in which the planes of two facets with a common vertex meet.

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


#: So many bends a contactor passes freely in a step before a concave one holds it: sliding far is no chatter.
#: [heuristic; changes in a step; test_polygons.py::test_sliding_along_a_polygon]
HOLD_AFTER = 2
#: A concave bend whose facets rise above each other by more holds a contactor at once: nothing slides on across it.
#: [heuristic; slope; test_concave_corners.py::test_a_block_pressed_into_a_corner]
SHARP = 0.5
#: A contactor that has changed facets across bends this often in a step gets averaged normals for the rest of it.
#: [heuristic; changes in a step; test_polygons.py::test_sliding_along_a_polygon]
MOST_CHANGES = 8
#: The facet across a side is the nearest one to a point in the plane of the own facet, past the side by this part of the facet.
#: [bound; half a facet; test_conforming_rings.py::test_vertices_opposite_vertices]
ACROSS = 1e-3


class ConcaveEdges:
    """Follows contactors from facet to facet of a target with the facets' own normals, and holds them in its concave edges."""

    def __init__(self, of: OnTarget):
        # the discretisation has these edges
        self._of, self.config, self.target = proxy(of), of.config, cast("MeshTarget", of.target)

    def place(self, nearest: Projection, points: Array, state: PairState) -> tuple[Projection, Corners | None]:
        """Project contactors held in corners onto these; contactors that change facets too often get averaged normals (collective).

        Args:
            nearest: the contactors on their nearest facets.
            points: current positions of the contactors ``(n, gdim)``.
            state: of the pair.

        Returns:
            The projection, and the corners that hold contactors; None if no rank has such a corner.
        """
        projection = with_averaged_normals(nearest, state.changes >= MOST_CHANGES, points)
        held = np.flatnonzero(state.in_corner)
        c = self._corners_of(state, points, held, state.held[held])
        if c is None:
            return projection, None
        at_corner: dict[str, Any] = {"normal": c.axes[:, 0], "gap": c.gaps(points[held])[:, 0], "facet": state.facet[held]}
        at_corner |= {"nodes": c.nodes, "weights": c.weights, "foot": c.foot, "beyond": c.beyond}
        return projection.with_rows(held, at_corner), c

    def place_again(
        self, nearest: Projection, left: Bools, points: Array, state: PairState
    ) -> tuple[Projection, Projection, Corners | None]:
        """Place contactors that have entered or left corners, at unchanged positions (collective).

        Args:
            nearest: the contactors on their nearest facets.
            left: those that have just left a corner ``(n,)``.
            points: current positions of the contactors ``(n, gdim)``.
            state: of the pair.

        Returns:
            ``nearest``, and the results of ``place``. A contactor that has just left a corner is equally near to the facet that it left.
        """
        nearest = cast("FacetProjection", nearest)
        i = np.flatnonzero(left & ~state.in_corner)
        if reduced(self.config.comm, len(i)):
            own = self.target.project_on(points[i], state.facet[i])
            own = replace(own, normal=self.target.outward(own))
            height = np.einsum("ng,ng->n", own.normal, points[i] - own.foot)
            own = replace(own, gap=height if self._of.offset is None else height - self._of.offset[i])
            nearest = nearest.with_those(i, own)
        return nearest, *self.place(nearest, points, state)

    def leave(self, corners: Corners | None, state: PairState) -> tuple[PairState, Bools]:
        """Release facets of corners that are in tension.

        Args:
            corners: that hold contactors.
            state: of the pair.

        Returns:
            The new state, and contactors that have left a facet ``(n,)``.
        """
        left = np.zeros(len(state.active), dtype=bool)
        if corners is None or not len(corners.which):
            return state, left
        i = corners.which
        cones = self._of.setting.cones
        slopes = np.zeros(len(i)) if cones is None else cones(np.linalg.norm(state.force, axis=1))[i]
        pulls = corners.pulls(state.force[i], slopes)
        leaving = (pulls < 0).any(axis=1) | ~state.active[i]
        facets = np.column_stack([state.facet[i], state.held[i]])
        rows = np.flatnonzero(leaving)
        facets[rows, np.argmin(pulls[rows], axis=1)] = -1
        facets = _moved_up(facets)
        facet, held = state.facet.copy(), state.held.copy()
        facet[i], held[i] = facets[:, 0], facets[:, 1:]
        held[~state.active] = -1
        left[i[leaving]] = True
        return replace(state, facet=facet, held=held), left

    def follow(self, nearest: Projection, left: Bools, points: Array, state: PairState) -> tuple[PairState, bool]:
        """Follow contactors onto new facets; in a concave corner they are held by the old facet, too (collective).

        Args:
            nearest: the contactors on their nearest facets.
            left: those that have just left a corner ``(n,)``.
            points: current positions of the contactors ``(n, gdim)``.
            state: of the pair, after ``leave``.

        Returns:
            The new state, and whether a contactor on this rank has entered a corner or left it for good.
        """
        nearest = cast("FacetProjection", nearest)
        number = nearest.facet
        known = (state.facet == number) | (state.held == number[:, None]).any(axis=1) | (state.facet < 0)
        free = state.active & ~left & (state.changes < MOST_CHANGES)
        moved = ~known & free
        slippery, cornered = self._of.setting.cones is None, state.in_corner
        i, tied = np.flatnonzero(moved), self._at_bends(nearest, known & free & ~cornered & slippery)
        facet, held, changes = state.facet.copy(), state.held.copy(), state.changes.copy()
        settled = ~moved & ~left & ~cornered
        facet[settled] = number[settled]
        taken = np.zeros(len(i), dtype=bool)
        entered = False
        some = reduced(self.config.comm, np.array([len(i), len(tied)]))
        if some[1]:
            tied, others = self._between(nearest, points, replace(state, facet=facet), tied)
            held[tied], entered = others, len(tied) > 0
        # first together with all its present facets, then with the first of these only
        together = _moved_up(np.column_stack([state.held[i], number[i]]))[:, : held.shape[1]]
        full = (state.held[i] >= 0).all(axis=1)
        alone = np.full_like(together, -1)
        alone[:, 0] = number[i]
        for others, allowed in ((together, ~full), (alone, (state.held[i] >= 0).any(axis=1) | full)) if some[0] else ():
            candidate = np.flatnonzero(allowed & ~taken)
            c = self._corners_of(state, points, i[candidate], others[candidate])
            if c is None:
                continue
            at_once = (state.changes[c.which] >= HOLD_AFTER) | (c.rising > SHARP)
            hold = c.concave & self._can_be_held(c) & at_once
            held[c.which[hold]] = others[candidate[hold]]
            taken[candidate[hold]] = True
            changes[c.which[~c.flat]] += 1
            entered |= bool(hold.any())
        switch = i[~taken]
        facet[switch], held[switch] = number[switch], -1
        # a contactor that still moves past the end of its corner gets averaged normals
        past = ~known & state.active & (state.changes >= MOST_CHANGES) & (held >= 0).any(axis=1)
        facet[past], held[past] = number[past], -1
        left_for_good = bool(past.any() or cornered[switch].any())
        return replace(state, facet=facet, held=held, changes=changes), entered or left_for_good

    def _at_bends(self, nearest: FacetProjection, which: Bools) -> Ints:
        """Contactors of ``which (n,)`` whose closest points are at a concave side or vertex of their facets ``(k,)``."""
        i = np.flatnonzero(which)
        i = i[(self.target.shape.side_distances(nearest.xi[i]) < ON_SIDE).any(axis=1)]
        return i[np.einsum("kg,kg->k", nearest.averaged[i], nearest.from_middle[i]) < -ON_PLANE * nearest.facet_size[i]]

    def _between(self, nearest: FacetProjection, points: Array, state: PairState, which: Ints) -> tuple[Ints, Ints]:
        """Contactors of ``which (k,)`` that are as deep in a further facet as in their own, with this facet in ``held`` (collective).

        With one of the two normals, which would be arbitrary, a frictionless force would lean to one side; friction holds the contactor.
        """
        none = np.full((len(which), self.config.gdim - 1), -1)
        none[:, 0] = across = self.target.project(nearest.foot[which] + ACROSS * nearest.from_middle[which], which).facet
        candidate = np.flatnonzero((across >= 0) & (across != state.facet[which]))
        c = self._corners_of(state, points, which[candidate], none[candidate])
        if c is None:
            return which[:0], none[:0]
        heights = np.einsum("kjg,kg->kj", c.normals[:, :2], points[c.which] - c.foot)
        alike = np.abs(heights[:, 0] - heights[:, 1]) <= EQUALLY_NEAR * nearest.facet_size[c.which]
        hold = candidate[c.concave & alike & self._can_be_held(c)]
        return which[hold], none[hold]

    def _corners_of(self, state: PairState, points: Array, which: Ints, others: Ints) -> Corners | None:
        """Corners between the facet of some contactors and other facets ``(k, gdim - 1)`` (collective)."""
        c = find_corners(self.config.comm, self.target, points[which], which, np.column_stack([state.facet[which], others]))
        return c if c is None or self._of.offset is None else replace(c, offset=self._of.offset[which])

    def _can_be_held(self, c: Corners) -> Bools:
        """Corners whose contactor has a free direction for every facet ``(k,)``."""
        used = np.arange(self.config.gdim) < c.count[:, None]
        A = np.where(used[:, :, None], c.axes * self._of.free[c.which][:, None, :], 0.0)
        return (np.linalg.svd(A, compute_uv=False) > MOSTLY_PRESCRIBED).sum(axis=1) == c.count


def with_averaged_normals(nearest: Projection, which: Bools, points: Array) -> FacetProjection:
    """The projection with averaged normals for some contactors ``(n,)`` at ``points (n, gdim)``."""
    p = cast("FacetProjection", nearest)
    gap = np.einsum("ng,ng->n", p.averaged, points - p.foot)
    if p.offset is not None:
        gap -= p.offset
    return replace(p, normal=np.where(which[:, None], p.averaged, p.normal), gap=np.where(which, gap, p.gap))


def _moved_up(facets: Ints) -> Ints:
    """Rows sorted with facets first and empty entries (-1) last."""
    return np.take_along_axis(facets, np.argsort(facets < 0, axis=1, kind="stable"), axis=1)
