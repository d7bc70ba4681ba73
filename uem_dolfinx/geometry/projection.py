"""Projection of points onto a target: gap, normal, weights and the second derivative of the gap."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any, Protocol

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints, replace

#: A way from the foot that is shorter, in lengths of the facet, or leans from its normal by less, is rounding.
#: [bound; cosine, and length of the facet; test_offset_edges.py::test_points_on_their_feet]
ALONG_NORMAL = 1e-12
#: Facets go on below points that are behind an edge, and to the side by less than this part of their depth; at sharper edges, which hold
#: points by both facets, they do not. [convention; slope; test_behind_edges.py::test_shallow_edges]
SHALLOW = 0.25
#: Offsets of less than this part of the facet do not round a convex edge: Newton's steps are longer than such an arc.
#: [heuristic; length of the facet; test_offset_edges.py::test_what_rounds_an_edge]
ROUNDS_AN_EDGE = 1e-2

#: A normal that leans along its facet by more, in the cosine of the angle, is no facet's own.
#: [bound; cosine; test_offset_edges.py::test_hessian_of_the_way_from_an_edge]
FROM_EDGE = 1e-9
#: A foot whose weights leave less than this to other nodes is at a vertex.
#: [bound; shape functions; test_offset_edges.py::test_hessian_of_the_way_from_an_edge]
AT_VERTEX = 1e-9


class Projection(Protocol):
    """Projection of points onto a target: all data that the constraint equations need."""

    @property
    def gap(self) -> Array:
        """Signed distance minus the ``offset`` ``(n,)``, positive outside."""

    @property
    def offset(self) -> Array | None:
        """Additional thickness of the surfaces ``(n,)``; None without offset."""

    @property
    def height(self) -> Array:
        """Signed distance ``(n,)``."""

    @property
    def normal(self) -> Array:
        """Unit normals out of the target ``(n, gdim)``."""

    @property
    def nodes(self) -> Ints:
        """Global block numbers of the target's nodes ``(n, nn)``; ``nn = 0`` for a rigid target."""

    @property
    def weights(self) -> Array:
        """Shape functions at the closest point ``(n, nn)``."""

    @property
    def facet(self) -> Ints:
        """Number of the facet over all ranks ``(n,)``."""

    @property
    def foot(self) -> Array:
        """Point of action of the force on the target ``(n, gdim)``: closest point on a mesh, contactor position for a rigid target."""

    @property
    def facet_size(self) -> Array:
        """Length of a side of the facet ``(n,)``; infinite for targets without facets."""

    @property
    def beyond(self) -> Array:
        """Vector of the point past an open end of the target, in the tangent plane ``(n, gdim)``."""

    @property
    def way_beyond(self) -> Array:
        """Length of ``beyond`` ``(n,)``."""

    @property
    def from_end(self) -> Array:
        """Distance of the closest point from an open end on its facet, in reference coordinates ``(n,)``; infinite without open ends."""

    def hessians(self, which: Ints) -> Array:
        """Second derivative of the gap with respect to contactor and target nodes ``(k, (1 + nn) g, (1 + nn) g)``."""

    def turnings(self, which: Ints, s: Array) -> Array:
        """Derivative of the rows along tangents ``s (k, gdim)``, which rotate with the normal ``(k, (1 + nn) g, (1 + nn) g)``."""

    def normal_slopes(self, which: Ints) -> Array:
        """Derivative of the normal with respect to contactor and target nodes ``(k, g, (1 + nn) g)``."""


class Target(Protocol):
    """Anything that points can be projected onto, meshed or rigid.

    Attributes:
        n_nodes: number of nodes that a contactor follows; 0 if the target is rigid.
        stride: largest motion of a contactor that cannot pass through the target unnoticed, a length.
        averaged: whether normals are averaged at nodes and interpolated, so that they differ from the facets' normals.
        motion: of a rigid target from its reference position, a ``rigid.Motion``; None without motion, and for a mesh.
    """

    n_nodes: int
    stride: float
    averaged: bool
    motion: Any

    @property
    def faceted(self) -> bool:
        """Whether normals are discontinuous between facets."""

    @property
    def dofs(self) -> Indices:
        """Local nodes of this rank's facets ``(m, nn)``."""

    @property
    def keys(self) -> Ints:
        """Key of each of this rank's facets, independent of the partition ``(m,)``."""

    def project(self, points: Array) -> Projection:
        """Closest points in the current configuration (collective)."""

    def follow(self, points: Array, old: Any) -> Projection:
        """Gaps with closest points, normals and weights of an earlier projection of this target (small sliding, collective)."""

    def continued(self, projection: Any, which: Ints, places: Array) -> Projection:
        """The projection with some facets continued past their sides, up to below ``places (k, gdim)``."""

    def chords(self, projection: Any) -> Array:
        """Weights of the straight pieces between the nodes of curved facets at the closest points ``(n, nn)`` [UEM, 4.5]."""

    def reference(self, gdim: int) -> Array:
        """Point about which the moment on the target is taken ``(gdim,)``."""

    def keys_of(self, facet: Ints) -> Ints:
        """Keys of facets, independent of the partition, from their numbers ``(n,)``; -1 for -1 (collective)."""

    def facets_of(self, keys: Ints) -> Ints:
        """Numbers of the facets with these keys ``(n,)``; -1 for unknown keys (collective)."""


@dataclass(frozen=True)
class FacetProjection:
    """Projection onto meshed facets; fields as in ``Projection``, and the facet's geometry at the closest point."""

    gap: Array
    normal: Array
    nodes: Ints
    weights: Array
    facet: Ints
    beyond: Array
    from_end: Array
    xi: Array  # reference coordinates of the closest point ``(n, fdim)``
    foot: Array  # closest points ``(n, gdim)``
    averaged: Array  # interpolated nodal normals ``(n, gdim)``
    x: Array  # positions of the facet's nodes ``(n, nn, gdim)``
    dN: Array  # derivatives of the weights ``(n, nn, fdim)``
    ddN: Array  # second derivatives ``(n, nn, fdim, fdim)``
    shape_operator: Array  # derivative of an averaged normal along the facet ``(n, fdim, gdim)``; zero for the facet's own normal
    offset: Array | None = None

    @property
    def height(self) -> Array:
        """Signed distance ``(n,)``."""
        return self.gap if self.offset is None else self.gap + self.offset

    @cached_property
    def facet_size(self) -> Array:
        """Length of a side of each facet ``(n,)``."""
        return np.linalg.norm(self.x[:, 0] - self.x[:, 1], axis=1)

    @cached_property
    def way_beyond(self) -> Array:
        """Length of ``beyond (n,)``."""
        return np.linalg.norm(self.beyond, axis=1)

    def with_rows(self, which: Ints, values: Mapping[str, Array | float]) -> FacetProjection:
        """Copy with some fields replaced at some points."""
        updates = {name: np.array(getattr(self, name)) for name in values}
        for name, value in values.items():
            updates[name][which] = value
        return replace(self, **updates)

    def with_those(self, which: Ints, other: FacetProjection) -> FacetProjection:
        """Copy with the rows ``which (k,)`` replaced by another projection of k points."""
        return self.with_rows(which, {f.name: v for f in fields(self) if (v := getattr(other, f.name)) is not None})

    def across_edges(self, points: Array, offset: Array) -> FacetProjection:
        """Copy with normals from the edge to ``points (n, gdim)`` near convex edges, which an ``offset (n,)`` rounds."""
        away = points - self.foot
        length, lean = np.linalg.norm(away, axis=1), np.einsum("ng,ng->n", away, self.normal)
        # the direction from the closest point is rounding if the distance vanishes
        rounded = (length > ALONG_NORMAL * self.facet_size) & (np.abs(lean) < (1.0 - ALONG_NORMAL) * length)
        rounded &= ~self.beyond.any(axis=1)
        side = np.where(lean < 0.0, -1.0, 1.0)
        # an arc about the edge with the offset as radius, extended to twice the radius
        rounded &= (np.abs(offset) > ROUNDS_AN_EDGE * self.facet_size) & (side * offset > 0.0) & (length < 2.0 * np.abs(offset))
        n = side[:, None] * away / np.where(length > 0.0, length, 1.0)[:, None]
        return replace(self, gap=np.where(rounded, side * length, self.gap), normal=np.where(rounded[:, None], n, self.normal))

    def behind_edges(self, points: Array) -> Ints:
        """Which ``points (n, gdim)`` are inside the target, and below no point of their facet, but behind a shallow concave edge of it."""
        lateral = np.linalg.norm(points - self.foot - self.height[:, None] * self.normal, axis=1)
        behind = (lateral > ALONG_NORMAL * self.facet_size) & (lateral < SHALLOW * -self.height)
        return (behind & ~self.beyond.any(axis=1)).nonzero()[0]

    @cached_property
    def from_middle(self) -> Array:
        """Ways from the middles of facets to the closest points ``(n, gdim)``."""
        return self.foot - self.x.mean(axis=1)

    def take(self, which: Ints) -> FacetProjection:
        """Some of its rows ``(k,)``."""
        return replace(self, **{f.name: v[which] for f in fields(self) if (v := getattr(self, f.name)) is not None})

    def hessians(self, which: Ints) -> Array:
        """Second derivative of the gap, for the consistent tangent (the term that [UEM, 5.7] drops).

        With the moving tangents ``t_a``, ``D_a`` the derivative of the closest point's coordinate and ``N_a`` that of the facet's
        slope, it reads ``- (D_a N_a' + N_a D_a') - b_ab D_a D_b' + g m^ab (N_a + b D)(N_b + b D)'`` summed over a, b.
        On a straight 2D facet this is the formula of the method's description.
        """
        H = gap_hessians(*self._at(which))
        if len(i := self._from_edge[which].nonzero()[0]):
            H[i] = _hessians_at_edges(*self._at(np.asarray(which)[i])[:-1])
        return H

    @cached_property
    def _from_edge(self) -> Bools:
        """Whether the normal points from a convex edge, and is neither the facet's nor averaged ``(n,)``; see ``across_edges``."""
        t = np.einsum("naf,nag->nfg", self.dN, self.x)
        leans = np.abs(np.einsum("nfg,ng->nf", t, self.normal)) > FROM_EDGE * np.linalg.norm(t, axis=2)
        own = (self.normal != self.averaged).any(axis=1) & (self.facet >= 0) & ~self.beyond.any(axis=1)
        return np.asarray(own & leans.any(axis=1))

    def turnings(self, which: Ints, s: Array) -> Array:
        """Derivative of the rows ``(s, -N_a s)`` along tangents ``s (k, gdim)``, which rotate with the normal.

        The normal changes by ``- t^a (N_a + b D)``, the tangent by as much along the normal, and the shape functions with ``D_a``.
        """
        n, _, w, dN, _, _, _ = self._at(which)
        t, m, _, _, D, L = _foot_derivatives(*self._at(which))
        along = np.linalg.solve(m, np.einsum("kfg,kg->kf", t, s)[..., None])[..., 0]
        ds = np.einsum("kg,kf,kfi->kgi", n, along, L)
        on_target = np.einsum("ka,kgi->kagi", w, ds) + np.einsum("kaf,kg,kfi->kagi", dN, s, D)
        k, size = len(n), ds.shape[2]
        return np.concatenate([ds[:, None], -on_target], axis=1).reshape(k, size, size)

    def normal_slopes(self, which: Ints) -> Array:
        """Derivative of the normal with the motion of the closest point and the rotation of the facet."""
        t, m, _, _, _, L = _foot_derivatives(*self._at(which))
        return -np.einsum("kfg,kfi->kgi", t, np.linalg.solve(m, L))

    def _at(self, which: Ints) -> list[Array]:
        return [getattr(self, f)[which] for f in ("normal", "height", "weights", "dN", "ddN", "x", "shape_operator")]


def gap_hessians(n: Array, g: Array, w: Array, dN: Array, ddN: Array, x: Array, shape_operator: Array) -> Array:
    """Second derivatives of the gap ``(k, (1 + nn) g, (1 + nn) g)``; arguments as the fields of ``FacetProjection``.

    This includes sides of facets: ``dN`` then has one column, and ``n`` is any direction across the side.
    """
    _, m, b, N, D, L = _foot_derivatives(n, g, w, dN, ddN, x, shape_operator)
    H = -np.einsum("kfi,kfj->kij", D, N)
    H = H + H.transpose(0, 2, 1) - np.einsum("kfe,kfi,kej->kij", b, D, D)
    return H + g[:, None, None] * np.einsum("kfi,kfj->kij", L, np.linalg.solve(m, L))


def _hessians_at_edges(n: Array, g: Array, w: Array, dN: Array, ddN: Array, x: Array) -> Array:
    """Second derivatives of the distance from a vertex, or from an edge with sliding closest point; arguments as for ``gap_hessians``."""
    (k, nn, _), gdim = dN.shape, n.shape[1]
    size = (1 + nn) * gdim
    relative = np.concatenate([np.ones((k, 1)), -w], axis=1)
    across = np.eye(gdim) - n[:, :, None] * n[:, None]
    H = np.einsum("ka,kb,kgh->kagbh", relative, relative, across / g[:, None, None]).reshape(k, size, size)
    i = (w.max(axis=1) < 1.0 - AT_VERTEX).nonzero()[0]
    if gdim == 2 or not len(i):
        return H
    n, g, w, dN, ddN, x, relative = (v[i] for v in (n, g, w, dN, ddN, x, relative))
    t = np.einsum("kaf,kag->kfg", dN, x)
    # the edge is the direction in the facet perpendicular to the normal
    lean = np.einsum("kfg,kg->kf", t, n)
    edge = np.stack([-lean[:, 1], lean[:, 0]], axis=1)
    edge /= np.linalg.norm(edge, axis=1)[:, None]
    dN, ddN = np.einsum("kaf,kf->ka", dN, edge)[..., None], np.einsum("kafe,kf,ke->ka", ddN, edge, edge)[..., None, None]
    H[i] = gap_hessians(n, g, w, dN, ddN, x, np.zeros((len(i), 1, gdim)))
    along = np.einsum("kaf,kag->kg", dN, x)
    square = np.cross(n, along / np.linalg.norm(along, axis=1)[:, None])
    rows = np.einsum("ka,kg->kag", relative, square).reshape(len(i), size)
    H[i] += np.einsum("ki,kj->kij", rows, rows) / g[:, None, None]
    return H


def foot_slopes(p: FacetProjection, which: Ints) -> tuple[Array, Array]:
    """Tangents at closest points ``(k, fdim, gdim)``, and derivatives of their coordinates ``(k, fdim, (1 + nn) gdim)``."""
    t, _, _, _, D, _ = _foot_derivatives(*p._at(which))
    return t, D


def _foot_derivatives(
    n: Array, g: Array, w: Array, dN: Array, ddN: Array, x: Array, shape_operator: Array
) -> tuple[Array, Array, Array, Array, Array, Array]:
    """Tangents, their products m, shape operator b, and the rows N, D and ``N + b D``, each ``(k, fdim, ...)``; see ``hessians``."""
    k, nn, fdim = dN.shape
    gdim = n.shape[1]
    size = (1 + nn) * gdim
    t = np.einsum("kaf,kag->kfg", dN, x)
    m = np.einsum("kfg,keg->kfe", t, t)
    slope = np.einsum("kfg,keg->kfe", t, shape_operator)
    b = np.einsum("kg,kag,kafe->kfe", n, x, ddN) - 0.5 * (slope + slope.transpose(0, 2, 1))
    # rows over (contactor, nodes) x gdim
    N = np.zeros((k, fdim, 1 + nn, gdim))
    N[:, :, 1:] = np.einsum("kaf,kg->kfag", dN, n)
    T = g[:, None, None, None] * N
    T[:, :, 0] = t
    T[:, :, 1:] -= np.einsum("ka,kfg->kfag", w, t)
    N, T = N.reshape(k, fdim, size), T.reshape(k, fdim, size)
    D = np.linalg.solve(m - g[:, None, None] * b, T)
    return t, m, b, N, D, N + np.einsum("kfe,kei->kfi", b, D)
