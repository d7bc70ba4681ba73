"""How weighted gaps and the forces of segments change with the displacement: what makes Newton's method quadratic with mortar.

The quadrature points stay where they are on the contactor, with coordinates xi; the gap g and the coordinates eta of the point
opposite follow from ``y(eta) = x(xi) + g n``. Where segments end, on a side between two target facets, integrands are continuous, so
that the motion of their ends does not count; at the end of the target, and in what dual functions are of partly covered facets, it
is left out.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.duals import add_up
from uem_dolfinx.geometry.overlaps import Planes, Segments
from uem_dolfinx.geometry.shapes import FacetShape


@dataclass(frozen=True)
class SegmentPoints:
    """Quadrature points of segments with all that derivatives there need.

    Attributes:
        segments: of ``k`` pairs.
        facet: contactor facet of each pair, among ``m`` ``(k,)``, ascending.
        nodes: global nodes of the contactor facets ``(m, nc)``.
        opposite: of the target facets, pair by pair ``(k, nt)``.
        planes: of the contactor facets.
        turning: how area vectors change with the contactor facets' nodes ``(m, nc, gdim, gdim)``.
        A: dual functions in the basis of the facets ``(m, nc, nc)``.
        G: integrals of the basis and the gap ``(m, nc)``.
        b: functions of the basis at the points ``(q, nc)``.
        phi: the contactor's shape functions there ``(q, nc)``.
        N: the target's ``(q, nt)``.
        to_gap: change of the gap with ``x(xi) - y`` ``(q, gdim)``.
        to_shapes: change of N with it ``(q, nt, gdim)``.
    """

    segments: Segments
    facet: Ints
    nodes: Ints
    opposite: Ints
    planes: Planes
    turning: Array
    A: Array
    G: Array
    b: Array
    phi: Array
    N: Array
    to_gap: Array
    to_shapes: Array

    @property
    def tilt(self) -> Array:
        """Part of ``to_gap`` across the contactor's normal: zero where the facets are parallel ``(q, gdim)``."""
        return self.to_gap + self.planes.normal[self.facet[self.segments.pair]]

    def gap_derivatives(self) -> tuple[Array, Array]:
        """What the derivatives of weighted gaps have beyond ``n int psi_j (phi_a, -N_l)``.

        Returns:
            With respect to the contactor facets' nodes ``(m, nc, nc, gdim)`` and to the target's, pair by pair ``(k, nc, nt, gdim)``.
        """
        s, e, g = self.segments, self.facet, self.to_gap.shape[1]
        (m, nc), (k, nt) = self.nodes.shape, self.opposite.shape
        weighted = s.weight[:, None] * self.b
        lean = (weighted[:, :, None] * self.tilt[:, None, :]).reshape(len(s.pair), nc * g)
        own = (lean.reshape(-1, nc, 1, g) * self.phi[:, None, :, None]).reshape(-1, nc * nc * g)
        its = (lean.reshape(-1, nc, 1, g) * self.N[:, None, :, None]).reshape(-1, nc * nt * g) if nt else np.zeros((len(lean), 0))
        on_facet = add_up(e[s.pair], own, m).reshape(m, nc, nc * g)
        on_target = add_up(s.pair, its, k).reshape(k, nc, nt * g)
        # with the area, and with the normal, of what is not closed
        open_part = weighted * s.gap[:, None]
        n, size = self.planes.normal, self.planes.size
        turned = add_up(e[s.pair], (open_part[:, :, None] * self.tilt[:, None]).reshape(-1, nc * g), m).reshape(m, nc, g)
        vector = (self.G[:, :, None] * n[:, None] + turned) / size[:, None, None]
        on_facet += np.einsum("mjg,magh->mjah", vector, self.turning).reshape(m, nc, nc * g)
        return (self.A @ on_facet).reshape(m, nc, nc, g), -(self.A[e] @ on_target).reshape(k, nc, nt, g)

    def force_derivatives(self, pressure: Array) -> tuple[Ints, Array]:
        """Minus the derivatives of contact forces at constant multipliers.

        Args:
            pressure: multipliers of the contactor facets' nodes ``(m, nc)``.

        Returns:
            Global nodes of the pairs that press ``(p, nc + nt)``, and blocks ``(p, (nc + nt) gdim, (nc + nt) gdim)``.
        """
        nc, nt = self.nodes.shape[1], self.opposite.shape[1]
        g, size = self.to_gap.shape[1], nc + nt
        pressing = np.flatnonzero((pressure[self.facet] != 0).any(axis=1))
        place = np.full(len(self.facet), -1, dtype=np.int64)
        place[pressing] = np.arange(len(pressing))
        q = np.flatnonzero(place[self.segments.pair] >= 0)
        pair, e = place[self.segments.pair[q]], self.facet[pressing]
        at = e[pair]
        combined = np.einsum("mj,mjb->mb", pressure, self.A)
        force = np.einsum("qb,qb->q", self.b[q], combined[at]) * self.segments.weight[q]
        values = np.concatenate([self.phi[q], -self.N[q]], axis=1)
        blocks = np.zeros((len(pressing), size, g, size, g))
        # the area vector turns and grows
        part = add_up(pair, force[:, None] * values, len(pressing)) / self.planes.size[e, None]
        blocks[:, :, :, :nc] = np.einsum("pi,pagh->pigah", part, self.turning[e])
        if nt:
            n = self.planes.normal
            moved = force[:, None, None] * self.to_shapes[q]
            slide = (moved[:, :, None, :] * values[:, None, :, None]).reshape(-1, nt * size * g)
            slid = add_up(pair, slide, len(pressing)).reshape(-1, nt, size, g)
            lean = add_up(pair, (moved * self.segments.gap[q, None, None]).reshape(-1, nt * g), len(pressing)).reshape(-1, nt, g)
            lean = (lean - np.einsum("plg,pg->pl", lean, n[e])[:, :, None] * n[e][:, None]) / self.planes.size[e, None, None]
            slid[:, :, :nc] += np.einsum("plg,pagh->plah", lean, self.turning[e])
            blocks[:, nc:] -= n[e][:, None, :, None, None] * slid[:, :, None]
        nodes = np.concatenate([self.nodes[e], self.opposite[pressing]], axis=1)
        return nodes, blocks.reshape(len(pressing), size * g, size * g)


def turning(shape: FacetShape, x: Array, sign: Array) -> Array:
    """Derivatives of the area vectors of facets with nodes ``x (m, nn, gdim)`` with respect to these ``(m, nn, gdim, gdim)``."""
    m, nn, g = x.shape
    out = np.zeros((m, nn, g, g))
    if shape.dim == 1:
        quarter = np.array([[0.0, 1.0], [-1.0, 0.0]])
        out[:, 0], out[:, 1] = -quarter, quarter
    elif shape.cell == "triangle":
        a, b = _skew(x[:, 1] - x[:, 0]), _skew(x[:, 2] - x[:, 0])
        out[:, 0], out[:, 1], out[:, 2] = 0.5 * (b - a), -0.5 * b, 0.5 * a
    else:
        a, b = _skew(x[:, 3] - x[:, 0]), _skew(x[:, 2] - x[:, 1])
        out[:, 0], out[:, 1], out[:, 2], out[:, 3] = 0.5 * b, -0.5 * a, 0.5 * a, -0.5 * b
    return out * sign[:, None, None, None]


def _skew(v: Array) -> Array:
    """Matrices of the cross products with ``v (m, 3)`` from the left."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    return out - out.transpose(0, 2, 1)


def opposite_changes(normal: Array, tangents: Array, dN: Array) -> tuple[Array, Array]:
    """``to_gap`` and ``to_shapes`` of ``SegmentPoints`` on a mesh.

    Args:
        normal: of the contactor's facets at the points ``(q, gdim)``.
        tangents: of the target's facets there ``(q, fdim, gdim)``.
        dN: derivatives of its shape functions ``(q, nt, fdim)``.
    """
    A = np.concatenate([tangents, -normal[:, None]], axis=1).transpose(0, 2, 1)
    inverse = np.linalg.inv(A)
    return inverse[:, -1], np.einsum("qaf,qfg->qag", dN, inverse[:, :-1])
