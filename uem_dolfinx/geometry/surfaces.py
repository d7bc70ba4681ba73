"""Contact surfaces of a function space: contactors' nodes and their tributary areas, each rank for its own part."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.errors import SurfaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.parallel import agree


def surface_nodes(config: Configuration, tag: Tag) -> Indices:
    """Owned nodes on the closure of a tag's facets, or at its points, sorted (collective)."""
    config.mesh.topology.create_connectivity(tag.dim, config.tdim)
    nodes = fem.locate_dofs_topological(config.V, tag.dim, tag.entities, True)
    return np.unique(nodes[nodes < config.n_owned]).astype(np.int32)


def tributary_areas(config: Configuration, tag: Tag) -> Array:
    """Integral of each shape function over the reference surface, per local node; zero for points ``(n_local,)`` (collective)."""
    if tag.dim == 0:
        return np.zeros(config.n_local)
    S = compat.function_space(config.mesh, config.degree)
    v = ufl.TestFunction(S)
    b = compat.create_vector(S)
    forms.assemble_vector(b, forms.form(v * forms.surface_measure(config.mesh, tag.entities)))
    areas = np.array(b.array_r)
    b.destroy()
    return areas


def followed_nodes(config: Configuration, dofs: Indices) -> npt.NDArray[np.bool_]:
    """Which local nodes ``(n_local,)`` any rank names among its local nodes ``dofs``, of any shape (collective)."""
    return config.to_owners(dofs.ravel(), np.ones(dofs.size)) > 0


def check_distinct(config: Configuration, contactor: Indices, target: TargetFacets, names: tuple[str, str]) -> None:
    """Raise SurfaceError, naming the first shared node, if a contactor is part of its own target (collective)."""
    shared = contactor[followed_nodes(config, target.dofs)[contactor]]
    error = None
    if len(shared):
        error = SurfaceError(
            f"contactor '{names[0]}' and target '{names[1]}' share the node at {config.describe(int(shared[0]))}: "
            "give each body its own nodes and its own surface"
        )
    agree(config.comm, error)
