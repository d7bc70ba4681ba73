"""Surfaces of a general contact: facets that may touch, and nodes and facets of users' parts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Bools
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.skin import Apart, Skin
from uem_dolfinx.geometry.surfaces import exterior_facets, surface_nodes
from uem_dolfinx.geometry.tags import Part, Tag, as_tag
from uem_dolfinx.parallel import reduced


def is_pair(one: Any) -> bool:
    """Whether this is a pair of parts, not a single part."""
    return (
        isinstance(one, tuple) and len(one) == 2 and not hasattr(one[0], "indices") and not isinstance(one[0], int | np.integer)
    )


def words_of(part: Any) -> Any:
    """A part, a pair of parts or a name in words that are the same on all ranks: the name, or the class of what has none."""
    if is_pair(part):
        return [words_of(one) for one in part]
    return part if isinstance(part, str) else getattr(part, "name", type(part).__name__)


def _n_sides(config: Configuration) -> int:
    """Number of facets of a cell."""
    return len(forms.reference_topology(compat.cell_name(config.mesh))[config.tdim - 1])


def as_part(config: Configuration, part: Part, role: str) -> Tag:
    """A part of facets or of cells (collective)."""
    return as_tag(part, config.mesh, (config.tdim - 1, config.tdim), role)


def touching_surface(config: Configuration, surfaces: Part | None, without: Sequence[Tag]) -> Tag:
    """The facets that may touch others (collective)."""
    mesh, facets = config.mesh, config.tdim - 1
    if surfaces is None:
        surfaces = exterior_facets(config)
    tag = as_tag(surfaces, mesh, (facets,), "surfaces")
    left = tag.entities
    for part in without:
        if part.dim == config.tdim:
            mesh.topology.create_connectivity(config.tdim, facets)
            of_cells = mesh.topology.connectivity(config.tdim, facets)
            left = np.setdiff1d(left, compat.cell_table(of_cells, _n_sides(config))[part.entities])
        else:
            left = np.setdiff1d(left, part.entities)
    if reduced(config.comm, len(left)) == 0:
        raise SurfaceError("general contact: exclude leaves no facet that may touch: leave some out of exclude")
    return Tag("all surfaces", 0, facets, mesh, left.astype(np.int32))


def with_border(skin: Skin, sets: Apart) -> Apart:
    """Two sets of facets, extended by adjacent facets with a common node (collective)."""
    config = skin.config

    def more(nodes: Bools) -> Bools:
        there = config.ask_owners(skin.nodes.ravel(), nodes[: config.n_owned, None].astype(float))
        return np.asarray((there.reshape(skin.nodes.shape) > 0).any(axis=1))

    one, _, other, _ = sets
    return one, more(one), other, more(other)


def where(skin: Skin, part: Part, role: str) -> tuple[Bools, Bools]:
    """Local nodes ``(n_local,)`` and this rank's facets ``(m,)`` of a part (collective)."""
    config = skin.config
    tag = as_part(config, part, role)
    nodes = np.zeros(config.n_local, bool)
    nodes[surface_nodes(config, tag)] = True
    if tag.dim == config.tdim:
        return nodes, np.isin(skin.cells, tag.entities)
    cells, sides = forms.cells_of_facets(config.mesh, tag.entities)
    n_sides = _n_sides(config)
    return nodes, np.isin(skin.cells * n_sides + skin.sides, cells * n_sides + sides)
