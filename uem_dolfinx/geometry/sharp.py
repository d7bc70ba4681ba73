"""Sharp edges and corners of surfaces in the reference configuration, where facet normals differ by more than an angle."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from uem_dolfinx.arrays import Bools, Ints, pairs_of_equals
from uem_dolfinx.parallel import Exchange, sums_by_keys

if TYPE_CHECKING:
    from uem_dolfinx.geometry.facets import TargetFacets

#: Facets whose normals have a smaller cosine are no pieces of a curve: their edge is sharp, and if it is convex none reaches round it.
#: [convention; cosine; test_skin.py::test_which_edges_are_sharp]
SHARP_EDGE = 0.7
#: Facets whose normals have a smaller cosine form a corner, which enters flat facets and is not seen by contactors around.
#: [convention; cosine; test_target_corners.py::test_what_is_a_corner]
CORNER = 0.955


class Edges(NamedTuple):
    """Neighbours and sharpness at each side of this rank's facets, ``(m, n_sides)`` each."""

    across: Ints  # number over all ranks of the facet that shares the side, -1 for no or several facets
    sharp: Bools  # sides at which the normals of both facets differ by more than the angle
    convex: Bools  # sharp sides that are convex


def sharp_edges(facets: TargetFacets, cosine: float = SHARP_EDGE) -> Edges:
    """Edges between facets whose normals differ by more than the angle with this cosine (collective)."""
    X, n_sides, g = facets.config.X[facets.dofs], len(facets.shape.edges), facets.config.gdim
    number = facets.first[facets.config.comm.rank] + np.arange(len(X))
    middle, normal = facets.middles(X)
    own = np.repeat(np.column_stack([np.ones(len(X)), normal, middle, number]), n_sides, axis=0)
    other = sums_by_keys(facets.config.comm, facets.side_keys(), own) - own
    one = other[:, 0] == 1
    sharp = one & (np.einsum("kg,kg->k", other[:, 1 : 1 + g], own[:, 1 : 1 + g]) < cosine)
    falls = np.einsum("kg,kg->k", other[:, 1 + g : -1] - own[:, 1 + g : -1], own[:, 1 : 1 + g]) < 0
    across = np.where(one, other[:, -1], -1).astype(np.int64)
    of_sides = len(X), n_sides
    return Edges(across.reshape(of_sides), sharp.reshape(of_sides), (sharp & falls).reshape(of_sides))


def sharp_nodes(facets: TargetFacets, cosine: float = SHARP_EDGE, convex: bool = False) -> Bools:
    """Nodes whose adjacent facets include two that differ by more than the angle; if ``convex``, at a convex corner (collective).

    ``(m, nn)``. This includes the tip of a cone, which has no sharp edge.
    """
    config, X = facets.config, facets.config.X[facets.dofs]
    nodes, arms = facets.nodes.ravel(), (X.mean(axis=1, keepdims=True) - X).reshape(-1, config.gdim)
    exchange = Exchange.to(config.comm, config.owner_of(nodes))
    there, normal, arm = exchange.send(nodes, facets.normals(drawn=True).reshape(-1, config.gdim), arms)
    i, j = pairs_of_equals(there)
    apart = np.einsum("kg,kg->k", normal[i], normal[j]) < cosine
    if convex:
        apart &= np.einsum("kg,kg->k", normal[i], arm[j]) < 0
    sharp = np.zeros(len(nodes), bool)
    (sharp[exchange.rows],) = exchange.back(np.isin(there, there[i[apart]]))
    return sharp.reshape(facets.nodes.shape)


def to_mean(cosine: float) -> float:
    """Cosine of half the angle with this cosine, which is the angle between a facet normal and the mean of two."""
    return float(np.sqrt(0.5 * (1.0 + cosine)))
