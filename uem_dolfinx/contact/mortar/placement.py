"""Weighted gaps of a mortar discretisation: ``Kinematics`` from the rows of integrals over segments."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints, cross_products
from uem_dolfinx.conditions.seams import seams_of
from uem_dolfinx.contact.mortar.duals import Basis, basis_of
from uem_dolfinx.contact.mortar.ends import curvature
from uem_dolfinx.contact.mortar.rows import Elimination, Remembered, Terms, WeightedRows, terms_of
from uem_dolfinx.contact.mortar.tangent import area_derivatives
from uem_dolfinx.contact.mortar.turning import Frictional, turning
from uem_dolfinx.contact.seam.base import OnTarget, PlacedOnTarget
from uem_dolfinx.contact.seam.ends import Ends, slide_off
from uem_dolfinx.contact.seam.placement import Along, GapRows
from uem_dolfinx.contact.seam.pressure_map import PressureMap, Stretch
from uem_dolfinx.contact.seam.relative_motion import Ties
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.overlaps import Planes
from uem_dolfinx.geometry.projection import Target
from uem_dolfinx.geometry.search import MeshTarget


class Contactors(OnTarget):
    """Contactor facets of one target; other arguments as for ``OnTarget``.

    Args:
        surface: the contactor's facets.

    Attributes:
        faced: keys, independent of the partition, of contactor and target facets that have faced each other in this step ``(p, 2)``.
        of_gaps: whether a law gives forces across open gaps.
    """

    of_gaps: bool = False

    def __init__(self, config: Configuration, nodes: Indices, target: Target, *, surface: TargetFacets, **how: Any):
        super().__init__(config, nodes, target, **how)
        self.surface = surface
        self.basis: Basis = basis_of(surface.shape)
        self.elimination = Elimination(config, nodes, seams_of(config))
        self.remembered = Remembered(config, nodes, surface)
        self.faced: Ints = np.zeros((0, 2), np.int64)

    def begin_step(self) -> None:
        """See ``OnTarget``; also resets the pairs of facets that have faced each other."""
        super().begin_step()
        self.faced = np.zeros((0, 2), np.int64)

    def keep_facing(self, facing: Ints) -> None:
        """Add pairs of facets that face each other ``(p, 2)``, until the end of the step."""
        self.faced = np.unique(np.concatenate([self.faced, facing]), axis=0)

    def sizes(self, x: Array) -> Array:
        """Areas of the contactor's facets in their planes, with their nodes at ``x (m, nn, gdim)``: ``(m,)``."""
        return Planes.of(self.surface.shape, x, self.surface.sign).size

    def growth(self, facets: Ints, x: Array) -> Array:
        """Derivatives of ``sizes`` of some facets by their nodes at ``x (m, nn, gdim)``: ``(m, nn, gdim)``."""
        planes, out = Planes.of(self.surface.shape, x, self.surface.sign[facets]), np.zeros(x.shape)
        if self.surface.shape.dim == 1:
            out[:, 1] = planes.axes[:, 0]
            out[:, 0] = -out[:, 1]
            return out
        # twice the area vector of a polygon is the sum of the cross products of consecutive corners
        ring, n = self.surface.shape.ring, planes.normal * self.surface.sign[facets, None]
        corners = x[:, ring]
        across = np.roll(corners, -1, axis=1) - np.roll(corners, 1, axis=1)
        out[:, ring] = 0.5 * cross_products(across, n[:, None])
        return out

    def shares(self, size: Array, x: Array) -> Array:
        """Integrals of the basis over facets of a ``size (m,)`` with nodes at ``x (m, nn, gdim)``: ``(m, nn)``."""
        if self.config.axisymmetric:
            return 2 * np.pi * size[:, None] * (x[:, :, 0] @ self.basis.products.T)
        return size[:, None] * self.basis.mean

    def share_slopes(self, facets: Ints, x: Array) -> tuple[Array, Array]:
        """The ``shares`` of some facets, and their derivatives by their nodes at ``x (m, nn, gdim)``: ``(m, nn, nn, gdim)``."""
        size = Planes.of(self.surface.shape, x, self.surface.sign[facets]).size
        shares = self.shares(size, x)
        out = (shares / size[:, None])[:, :, None, None] * self.growth(facets, x)[:, None]
        if self.config.axisymmetric:
            out[..., 0] += 2 * np.pi * size[:, None, None] * self.basis.products
        return shares, out

    def stretch(self, facets: Ints, size: Array) -> Array:
        """Current areas ``size (k,)`` of facets around contactors over their reference areas ``(n,)`` (collective)."""
        dofs, X = self.surface.dofs[facets], self.config.X[self.surface.dofs]
        shares = self.shares(size, self.surface.x[facets]), self.shares(self.sizes(X), X)[facets]
        now, then = (self.elimination.seam.sums(self.config.to_owners(dofs.ravel(), own.ravel()))[self.nodes] for own in shares)
        return np.where(then > 0, now / np.where(then > 0, then, 1.0), 1.0)

    def means_on(self, rows: WeightedRows, dofs: Indices) -> Array:
        """Means of the gaps, weighted with dual functions, at the nodes of facets ``dofs (m, nn)`` (collective)."""
        means = np.where(rows.covered, rows.plain.gap / np.where(rows.covered, rows.share, 1.0), rows.plain.gap)
        return self.config.from_owners(self.nodes, means[:, None], dofs.ravel()).reshape(dofs.shape)

    def heights(self, rows: WeightedRows) -> Array:
        """Nodal heights whose means, weighted with dual functions, equal the means of the gaps (collective).

        At degree 2 they are first computed in the Bernstein basis, and then converted to nodal values.
        """
        dofs = self.surface.dofs
        nodal = self.means_on(rows, dofs) @ np.linalg.inv(self.basis.T).T
        total, count = (self.config.to_owners(dofs.ravel(), values.ravel()) for values in (nodal, np.ones(dofs.shape)))
        return np.asarray(total[self.nodes] / count[self.nodes])

    def heights_of_facets(self, rows: WeightedRows) -> Array:
        """The same of each facet with rows ``(m, nn)``, also where dual functions are added to the foremost one (collective)."""
        duals, means = rows.points.duals, self.means_on(rows, self.surface.dofs[rows.facets])
        own: Bools = duals.own.copy()
        own[np.arange(len(own)), duals.foremost] = True
        fore = np.take_along_axis(means, duals.foremost[:, None], axis=1)
        return np.asarray(np.where(own, means, fore) @ np.linalg.inv(self.basis.T).T)


@dataclass(frozen=True)
class MortarKinematics(PlacedOnTarget):
    """Implements ``Kinematics`` with weighted gaps, which the projection contains with the directions of the plain rows."""

    of: Contactors
    rows: WeightedRows  # all equations and their data
    movable: Bools  # contactors that can move along the normal, or whose followed nodes can ``(n,)``
    out: Bools | None = None  # contactors that must not touch the target ``(n,)``, or None

    @property
    def corners(self) -> None:
        """None, since corners hold no facets."""
        return None

    @property
    def normal(self) -> Array:
        """Directions of the gaps' derivatives by the contactors' own displacements ``(n, gdim)``."""
        assert self.rows.normal is not None
        return self.rows.normal

    @cached_property
    def ties(self) -> Ties:
        """Weights are integrals of dual functions times shape functions of both sides, over the integral of the contactor's own."""
        rows = self.rows
        assert rows.weights is not None and rows.push is not None
        # relative to the sum of the facets' forces, each along its own derivative of the gap
        return self.of.ties(rows.weights, np.asarray(rows.share / rows.push))

    # -- the same contactors in another state ----------------------------------------------------------------------------

    def follow(self, state: PairState, off: Bools) -> tuple[MortarKinematics, PairState]:
        """Release contactors; count changes of facet by uncovered ones, until they get averaged normals. Equations do not change here.

        The state stores facets covered by a rigid target, or nodes with a dual function of their own on a mesh. Facets that face
        each other are stored until the end of the step.
        """
        of, rows, state = self.of, self.rows, slide_off(state, off)
        if of.sliding == "finite":
            covered = np.zeros(of.surface.dofs.shape, dtype=bool)
            if isinstance(of.target, MeshTarget):
                assert rows.facing is not None
                of.keep_facing(rows.facing)
                covered[rows.facets] = rows.points.duals.kept
            else:
                covered[rows.facets[rows.points.facet[rows.points.segments.pair]]] = True
            state = replace(state, cover=of.remembered.of(covered))
        if not (of.target.faceted and of.sliding == "finite"):
            return self, state
        number = self.projection.facet
        moved = state.active & ~rows.covered & (state.facet >= 0) & (state.facet != number)
        return self, replace(state, facet=number, changes=state.changes + moved)

    # -- deciding quantities ---------------------------------------------------------------------------------------------

    @cached_property
    def ends(self) -> Ends:
        """Open ends by the covered part of contactors; rigid targets have none."""
        rows, meshed = self.rows, self.of.target.n_nodes > 0
        share = np.where(rows.covered, rows.ratio, -1.0) if meshed else np.ones(len(self.points))
        return Ends(self.projection, self.of.thickness, share=share, out=self.out)

    # -- equations and forces --------------------------------------------------------------------------------------------

    @cached_property
    def gap_rows(self) -> GapRows:
        """One row for each contactor, divided by the length of the weighted gap's derivative."""
        return GapRows.along_normals(self.of.config, self.rows.equations, self.rows.length, self.of.free)

    def curvature(self, state: PairState, along: Along | None = None) -> list[tuple[Ints, Array]]:
        """Second derivatives of the weighted gaps.

        Friction of covered contactors turns, scales with the traction, and acts on other nodes opposite (collective).
        """
        of, rows = self.of, self.rows
        pressure = np.where(rows.covered, state.lam / np.where(rows.covered, rows.area, 1.0), 0.0)
        dofs = of.surface.dofs[rows.facets]
        at_nodes = of.config.from_owners(of.nodes, pressure[:, None], dofs.ravel()).reshape(dofs.shape)
        parts = curvature(rows.points, at_nodes)
        if of.of_gaps:
            parts = parts + self._with_areas(pressure / rows.sharing)
        if along is None:
            return parts
        assert rows.weights is not None
        kept = rows.covered[along.which]
        which = along.which[kept]
        frictional = Frictional(which, self.normal[which], along.tau[kept], ~along.held[kept])
        return parts + turning(of.elimination, rows, dofs, frictional, rows.weights)

    def _with_areas(self, pressure: Array) -> list[tuple[Ints, Array]]:
        """What areas add to minus the second derivatives of mean gaps g under ``pressure (n,)``: ``p (grad a grad g' + grad g grad b')``.

        The areas a are those of the dual functions, b the covered parts of reference areas (collective).
        """
        from uem_dolfinx.contact.seam.relative_motion import Terms as Gradients
        from uem_dolfinx.contact.seam.relative_motion import dyads

        of, rows, at = self.of, self.rows, self.rows.points
        on_facet, on_target = area_derivatives(at, of.growth(rows.facets, at.x))
        terms = terms_of(at.nodes, at.nodes, on_facet), terms_of(at.nodes[at.facet], at.opposite, on_target)
        full, slopes = of.share_slopes(rows.facets, at.x)
        shares, whole_area = (
            terms_of(at.nodes, at.nodes, slopes),
            of.elimination.total(at.nodes.ravel(), full.reshape(-1, 1))[:, 0],
        )
        # functions that are added to the foremost one are part of its area
        ratio = rows.area * rows.sharing / np.where(rows.covered, whole_area, 1.0)
        covered, whole = (Gradients(*of.elimination.at_owners(parts, np.ones(len(pressure)))) for parts in (terms, [shares]))
        gaps, scale = self.gap_rows.gradients, pressure * rows.length / rows.share
        return [dyads(scale, covered, gaps), dyads(scale * ratio, gaps, whole)]

    def pressure_map(self, current: bool) -> PressureMap:
        """Multipliers are current pressures with finite sliding, and forces over kept areas with small and fixed sliding (collective)."""
        of, rows, finite, every = self.of, self.rows, self.of.sliding == "finite", np.arange(len(self.of.surface.dofs))
        area = rows.area if current and finite else rows.area / rows.stretch
        stretch = None
        if current and not finite:
            area = area * of.stretch(every, of.sizes(of.surface.x))
        if current != finite:
            facets, power = rows.facets if finite else every, np.where(rows.covered, 1.0 if finite else -1.0, 0.0)
            stretch = Stretch(of.config, of.nodes, of.surface.dofs[facets], lambda x: of.share_slopes(facets, x), power)
        return PressureMap(rows.share / rows.length, known=rows.covered, area=area, stretch=stretch)

    def heights(self) -> Array:
        """Nodal heights of the rows (collective)."""
        heights, offset = self.of.heights(self.rows), self.of.offset
        return heights if offset is None else heights + offset

    def means(self) -> tuple[tuple[Ints, Ints, Array], tuple[Ints, Ints, Array]]:
        """Means by the integrals of the dual functions over the covered part; values at the nodes of other contactors (collective)."""
        of, rows, at = self.of, self.rows, self.rows.points
        own, area = at.nodes, at.duals.C.sum(axis=2)
        f, i = np.nonzero(area > 0)
        total = of.elimination.total(own[f, i], area[f, i, None])[:, 0]
        scale = np.where(rows.covered, total, 1.0)
        found = []
        for parts in (terms_of(own, own, (at.duals.C @ of.basis.T)[..., None]), self._opposite()):
            row, node, weight = of.elimination.at_owners([parts], scale)
            kept = rows.covered[row]
            found.append((row[kept], node[kept], weight[kept, 0]))
        alone, near = np.flatnonzero(~rows.covered), self.nearest
        k, a = np.nonzero(near.nodes[alone] >= 0)
        more = (
            (alone, of.config.to_global(of.nodes[alone]), np.ones(len(alone))),
            (alone[k], near.nodes[alone][k, a], near.weights[alone][k, a]),
        )
        own_terms, theirs = (tuple(np.concatenate(both) for both in zip(*parts)) for parts in zip(found, more))
        return own_terms, theirs  # type: ignore[return-value]

    def _opposite(self) -> Terms:
        """Integrals of the dual functions with the target's shape functions."""
        at = self.rows.points
        return terms_of(at.nodes[at.facet], at.opposite, (at.duals.A[at.facet] @ at.covered.N)[..., None])
