"""Anchors of frictional contactors on the target, and their relative motion. Functions of arrays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.seam.placement import Kinematics
from uem_dolfinx.contact.seam.state import FrictionState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import FacetProjection, Target
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.geometry.search import MeshTarget


def anchored(
    f: FrictionState, kinematics: Kinematics, target: Target, points: Array, loose: Bools, kept_feet: bool
) -> FrictionState:
    """The state in which contactors that do not stick get anchors at their current position.

    Args:
        f: state of friction.
        kinematics: of the contactors.
        target: that they are anchored to.
        points: positions of the contactors ``(n, gdim)``.
        loose: contactors that do not stick ``(n,)``.
        kept_feet: whether closest points are constant during the step, so that contactors move away from them.
    """
    p = kinematics.projection
    below = points - p.height[:, None] * p.normal
    if not target.n_nodes:
        motion: Motion | None = target.motion
        here = below if motion is None else motion.back(below)
        return replace(f, anchor=np.where(loose[:, None], here, f.anchor))
    nearest = kinematics.nearest
    assert isinstance(nearest, FacetProjection)
    left = below - nearest.foot if kept_feet else np.zeros_like(points)
    return replace(
        f,
        facet=np.where(loose, nearest.facet, f.facet),
        xi=np.where(loose[:, None], nearest.xi, f.xi),
        anchor=np.where(loose[:, None], left, f.anchor),
    )


def anchors_of(f: FrictionState, target: Target, terms: bool) -> tuple[Array, tuple[Ints, Ints, Array] | None]:
    """Current positions of the anchors on the target ``(n, gdim)``, and the nodes that they follow (collective).

    Args:
        f: state of friction.
        target: that they are anchored to.
        terms: whether to return contactors, global nodes and weights ``(k,)`` for a mesh.
    """
    if isinstance(target, MeshTarget):
        N, facets = target.shape.tabulate(f.xi).N, target.facets
        here = np.einsum("na,nag->ng", N, target.of_facets(f.facet, facets.x)) + f.anchor
        if not terms:
            return here, None
        nodes = target.of_facets(f.facet, facets.nodes)
        row, a = np.nonzero(nodes >= 0)
        return here, (row.astype(np.int64), nodes[row, a], N[row, a])
    motion: Motion | None = target.motion
    return f.anchor if motion is None else motion.carry(f.anchor), None


def way_since(config: Configuration, nodes: Indices, before: Array, motion: Motion | None, now: Motion | None) -> Array:
    """Displacement of the owned nodes ``(n_owned, gdim)`` since ``before``; for contactors relative to a rigid target.

    Args:
        config: configuration of the displacement.
        nodes: contactors ``(n,)``.
        before: positions ``(n_owned, gdim)``.
        motion: motion of the target then; None if it had not moved.
        now: its motion now.
    """
    way = config.x[: config.n_owned] - before
    if now is not motion:
        still = Motion.none(config.gdim)
        start = before[nodes]
        way[nodes] -= (now or still).carry((motion or still).back(start)) - start
    return way
