"""Normals averaged at the target's nodes: forces act along them, gaps close along the facets' own normals.

Rows of the forces are no gradients of the gaps, so that P differs from Q. They change as the closest point moves over its facet, whose
interpolated normal turns, and as the facets around its nodes turn, whose area vectors make the normals of the nodes.
"""

from __future__ import annotations

import numpy as np

from uem_dolfinx.algebra.blocks import Blocks, product
from uem_dolfinx.arrays import Array, Bools, Ints, replace
from uem_dolfinx.geometry.projection import FacetProjection, foot_slopes
from uem_dolfinx.geometry.search import LEAST_LEAN, MeshTarget


def closing(target: MeshTarget, p: FacetProjection, free: Bools) -> Array:
    """Derivatives of the gaps by the positions of contactors ``(n, gdim)``: the facets' own normals over their cosines with the averaged.

    Contactors that can hardly move along them in ``free (n, gdim)`` components have their averaged normals.
    """
    own = target.outward(p)
    lean = np.einsum("ng,ng->n", own, p.normal)
    own = own / np.where(lean > LEAST_LEAN, lean, 1.0)[:, None]
    across, along = (np.einsum("ng,ng->n", free * normal, p.normal) for normal in (own, p.normal))
    return np.where((across > LEAST_LEAN * along)[:, None], own, p.normal)


def turning(target: MeshTarget, own: Ints, p: FacetProjection, force: Array, tau: Array) -> list[tuple[Ints, Array]]:
    """Blocks of minus the derivatives of contact forces at fixed multipliers, see ``Kinematics.curvature`` (collective).

    Args:
        target: with averaged normals.
        own: global nodes of contactors ``(k,)``.
        p: their projection.
        force: their forces along the normals ``(k,)``.
        tau: their friction, along the target, which turns with the normals ``(k, gdim)``.

    Returns:
        Square blocks at fixed normals of the target's nodes, then blocks of single rows and columns.
    """
    k, g = p.normal.shape
    # forces ``f n + tau`` by the normal
    by_normal = force[:, None, None] * np.eye(g) - p.normal[:, :, None] * tau[:, None]
    facet_normal = target.outward(p)
    height = p.height * np.einsum("kg,kg->k", facet_normal, p.normal)
    plain = replace(p, gap=height, normal=facet_normal, offset=None, shape_operator=0.0 * p.shape_operator)
    _, D = foot_slopes(plain, np.arange(k))
    turned = np.einsum("kgh,kfh,kfi->kgi", by_normal, p.shape_operator, D)
    on_target = np.einsum("ka,kgi->kagi", p.weights, turned)
    on_target += np.einsum("kaf,kg,kfi->kagi", p.dN, force[:, None] * p.normal + tau, D)
    blocks = np.concatenate([-turned[:, None], on_target], axis=1).reshape(k, D.shape[2], D.shape[2])
    nodes = np.column_stack([own, p.nodes])
    around, slopes = target.facets.turning(p.facet)
    at_nodes = target.of_facets(p.facet, target.facets.current().nodal_normals)
    length = np.linalg.norm(np.einsum("ka,kag->kg", p.weights, at_nodes), axis=1)
    across = (np.eye(g) - p.averaged[:, :, None] * p.averaged[:, None]) / np.where(length > 0, length, np.inf)[:, None, None]
    change = np.einsum("kgh,ka,kapbhi->kapbgi", by_normal @ across, p.weights, slopes)
    m = int(np.prod(around.shape[1:]))
    around, change = around.reshape(k, m), change.reshape(k, m, g, g)
    # the same change of each force acts, in parts, on the contactor and on the target's nodes
    parts = np.concatenate([np.full((k, 1), -1.0), p.weights], axis=1)
    row, column = np.nonzero(around >= 0)
    acts = Blocks(nodes.ravel(), np.repeat(np.arange(k), nodes.shape[1]), parts.reshape(-1, 1, 1) * np.eye(g))
    found = product(acts, Blocks(row, around[row, column], change[row, column]))
    return [
        (nodes, blocks),
        (np.column_stack([found.row, found.column]), np.concatenate([0.0 * found.value, found.value], axis=2)),
    ]
