"""Contact surfaces of a function space: contactor nodes and their tributary areas, distributed over the ranks."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx.mesh import exterior_facet_indices, locate_entities_boundary

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.errors import OrientationError, SurfaceError
from uem_dolfinx.geometry.axisymmetry import circumference, on_axis
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets, facets_of
from uem_dolfinx.geometry.shapes import FacetShape, integrals
from uem_dolfinx.geometry.sharp import sharp_nodes
from uem_dolfinx.geometry.tags import Tag, as_tag, locate_dofs
from uem_dolfinx.parallel import Exchange, agree, reduced


def surface_nodes(config: Configuration, tag: Tag) -> Indices:
    """Owned nodes on the closure of a tag's facets, or at its points, sorted (collective)."""
    nodes = locate_dofs(config.V, tag)
    return np.unique(nodes[nodes < config.n_owned]).astype(np.int32)


def exterior_facets(config: Configuration) -> Tag:
    """Facets on the outside of all bodies; in axisymmetry those on the axis are inside (collective)."""
    mesh, dim = config.mesh, config.tdim - 1
    mesh.topology.create_connectivity(dim, config.tdim)
    facets = np.asarray(exterior_facet_indices(mesh.topology))
    if config.axisymmetric:
        facets = np.setdiff1d(facets, locate_entities_boundary(mesh, dim, on_axis(mesh)))
    return as_tag(facets, mesh, (dim,), "the outside")


class Areas:
    """Integrals of the shape functions over a surface, zero for points, in the reference and the current configuration."""

    def __init__(self, config: Configuration, tag: Tag, facets: TargetFacets | None = None):
        self._config, self._tag, self._made = config, tag, facets

    def integral(self, q: Any, current: bool) -> ufl.Form:
        """Integral of a scalar q over the surface, current or in the reference configuration, in UFL."""
        stretch, metadata = 1.0, None
        if current:
            F = ufl.Identity(self._config.gdim) + ufl.grad(self._config.u)
            # area vectors transform with the cofactors of F (Nanson)
            n = ufl.cofac(F) * ufl.FacetNormal(self._config.mesh)
            # the integrand is not a polynomial
            stretch, metadata = ufl.sqrt(ufl.dot(n, n)), {"quadrature_degree": 2 * self._config.degree + 1}
        if self._config.axisymmetric:
            stretch = stretch * circumference(self._config.mesh, self._config.u if current else None)
        return q * stretch * forms.surface_measure(self._config.mesh, self._tag.entities, metadata)

    def _integrals(self, current: bool) -> Any:
        """Integrals of the shape functions, compiled."""
        return forms.form(self.integral(ufl.TestFunction(compat.function_space(self._config.mesh, self._config.degree)), current))

    def _assembled(self, form: Any) -> Array:
        b = compat.create_vector(compat.function_space(self._config.mesh, self._config.degree))
        forms.assemble_vector(b, form)
        areas = np.array(b.array_r)
        b.destroy()
        return areas

    @cached_property
    def reference(self) -> Array:
        """Integrals over the reference surface, per local node ``(n_local,)`` (first call: collective)."""
        if self._tag.dim == 0:
            return np.zeros(self._config.n_local)
        return self._assembled(self._integrals(False))

    @cached_property
    def _stretched(self) -> Any:
        return self._integrals(True)

    @property
    def current(self) -> Array:
        """Integrals over the current surface, per local node ``(n_local,)`` (collective)."""
        return self.reference if self._tag.dim == 0 else self._assembled(self._stretched)

    @cached_property
    def _sharp(self) -> tuple[TargetFacets, Ints, Ints, Exchange] | None:
        """Facets, pairs of facets and their nodes at sharp edges ``(k,)``, and the exchange with the nodes' owners.

        None if no rank has such nodes (first time: collective).
        """
        config, comm = self._config, self._config.comm
        try:
            facets = self._made or facets_of(config, self._tag, "contactor")
        except OrientationError:
            # a surface inside a body has no outer side
            return None
        facet, node = np.nonzero(sharp_nodes(facets))
        if not reduced(comm, len(facet)):
            return None
        return facets, facet, node, Exchange.to(comm, config.owner_of(facets.nodes[facet, node]))

    def at_sharp_edges(self, nodes: Indices) -> Bools:
        """Owned ``nodes (n,)`` at edges or corners where facet normals differ by more than 45 degrees (collective)."""
        if self._tag.dim == 0 or self._sharp is None:
            return np.zeros(len(nodes), bool)
        facets, facet, node, _ = self._sharp
        return followed_nodes(self._config, facets.dofs[facet, node])[nodes]

    def facing(self, nodes: Indices, normal: Array, current: bool) -> Array:
        """Areas of contactors that face the target ``(n,)`` (collective).

        Away from sharp edges, the area on the whole surface. At a sharp edge, facets are weighted by their orientation to the
        target: ``sum_f (int_f N_i) max(0, -n_f . n)``. So, for a block on a plane, only its base counts at its edges.

        Args:
            nodes: owned nodes of the surface ``(n,)``.
            normal: outward normals of the target ``(n, gdim)``.
            current: whether areas are current or in the reference configuration; normals are always current.
        """
        areas = np.array((self.current if current else self.reference)[nodes])
        if self._tag.dim == 0 or self._sharp is None:
            return areas
        facets = self._sharp[0]
        x = facets.x if current else self._config.X[facets.dofs]
        return self._towards(areas, integrals(facets.shape, x, self._config.axisymmetric), nodes, normal, False)

    def of_functions(self, nodes: Indices, normal: Array | None, coefficients: Callable[[FacetShape], Array]) -> Array:
        """Integrals of other functions over the reference surface, at sharp edges over facets that face the target ``(n,)`` (collective).

        Args:
            nodes: see ``facing``.
            normal: see ``facing``; None: the whole surface counts.
            coefficients: function of the facet shape that returns coefficients of these functions from nodal values ``(nn, nn)``.
        """
        config, facets = self._config, self._made or facets_of(self._config, self._tag, "contactor")
        parts = integrals(facets.shape, config.X[facets.dofs], config.axisymmetric) @ np.linalg.inv(coefficients(facets.shape))
        areas = config.to_owners(facets.dofs.ravel(), parts.ravel())[nodes]
        return areas if normal is None or self._sharp is None else self._towards(areas, parts, nodes, normal, True)

    def _towards(self, areas: Array, parts: Array, nodes: Indices, normal: Array, entire: bool) -> Array:
        """Areas ``(n,)``, at sharp edges from facets ``(m, nn)`` weighted by their orientation to the target (collective).

        If ``entire``, weights are 1 for facets that face the target at least half as much as the best one, and 0 for others.
        """
        assert self._sharp is not None
        config, (facets, facet, node, exchange) = self._config, self._sharp
        integral = parts[facet, node]
        there, area, facing = exchange.send(facets.nodes[facet, node], integral, facets.normals()[facet, node])
        row = np.full(config.n_owned, -1)
        row[nodes] = np.arange(len(nodes))
        row = row[there - config.first]
        row, area, facing = row[row >= 0], area[row >= 0], facing[row >= 0]
        areas[row] = 0.0
        part = np.maximum(-np.einsum("kg,kg->k", facing, normal[row]), 0.0)
        if entire:
            most = np.zeros(len(nodes))
            np.maximum.at(most, row, part)
            part = (part > 0) & (2 * part >= most[row])
        np.add.at(areas, row, area * part)
        return areas


def tributary_areas(config: Configuration, tag: Tag) -> Array:
    """Integral of each shape function over the reference surface, per local node; zero for points ``(n_local,)`` (collective)."""
    return Areas(config, tag).reference


def followed_nodes(config: Configuration, dofs: Indices) -> npt.NDArray[np.bool_]:
    """Local nodes ``(n_local,)`` that occur in ``dofs``, local nodes in an array of any shape, of any rank (collective)."""
    return config.to_owners(dofs.ravel(), np.ones(dofs.size)) > 0


def check_distinct(config: Configuration, contactor: Indices, target: TargetFacets, names: tuple[str, str]) -> None:
    """Raise SurfaceError, naming the first shared node, if a contactor is part of its own target (collective)."""
    shared = contactor[followed_nodes(config, target.dofs)[contactor]]
    error = None
    if len(shared):
        error = SurfaceError(
            f"contactor '{names[0]}' and target '{names[1]}' share the node at {config.describe(int(shared[0]))}: "
            "give each body its own nodes and its own surface; a body touches itself in GeneralContact(self_contact=True)"
        )
    agree(config.comm, error)
