"""Contactors a little past an end of the target whose own facets lie over the target, and have no other contactor there."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np

from uem_dolfinx.arrays import Bools, Indices
from uem_dolfinx.contact.seam.ends import END_HOLDS
from uem_dolfinx.errors import OrientationError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import facets_of, unit
from uem_dolfinx.geometry.projection import FacetProjection
from uem_dolfinx.geometry.search import ON_SIDE
from uem_dolfinx.geometry.sharp import SHARP_EDGE
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import reduced


def close_to_ends(p: FacetProjection, which: Bools) -> Bools:
    """Contactors of ``which (n,)`` that are past an end by at most ``END_HOLDS`` of the target's facet ``(n,)``."""
    return np.asarray(which & (p.way_beyond > ON_SIDE * p.facet_size) & (p.way_beyond <= END_HOLDS * p.facet_size))


def overhanging(config: Configuration, nodes: Indices, contactor: Tag, p: FacetProjection, which: Bools) -> Bools:
    """Contactors past an end by at most ``END_HOLDS`` of one of their own facets, which faces the target and is over it ``(n,)``.

    Collective.

    Args:
        config: configuration of the displacement.
        nodes: owned contactor nodes ``(n,)``.
        contactor: facets of the contactors.
        p: projection of the contactors.
        which: contactors that are looked at ``(n,)``.
    """
    g, near = config.gdim, close_to_ends(p, which)
    if not reduced(config.comm, bool(near.any()), op=MPI.LOR):
        return near
    try:
        own = facets_of(config, contactor, "contactor")
    except OrientationError:
        # a surface inside a body faces nothing
        return np.zeros(len(nodes), dtype=bool)
    at_nodes = np.zeros((config.n_owned, 2 * g))
    at_nodes[nodes[near]] = np.column_stack([unit(p.beyond), p.normal])[near]
    x, of_facets = own.x, own.nodes.ravel()
    there = config.ask_owners(of_facets, at_nodes).reshape(*own.nodes.shape, 2 * g)
    # along the way beyond the end, how far the facets' other nodes are behind each of their nodes
    along = np.einsum("mag,mbg->mab", there[..., :g], x)
    back = np.einsum("maa->ma", along) - along.min(axis=2, initial=np.inf)
    facing = np.einsum("mag,mg->ma", there[..., g:], own.middles(x)[1]) < -SHARP_EDGE
    node, back = config.send_to_owners(of_facets, np.where(facing, back, 0.0).ravel())
    reach = np.zeros(config.n_owned)
    np.maximum.at(reach, node, back)
    return np.asarray(near & (p.way_beyond <= END_HOLDS * reach[nodes]))
