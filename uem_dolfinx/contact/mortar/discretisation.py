"""Mortar: constraint equations from integrals over segments, exact on any pair of meshes.

For a node whose part of the contactor is covered, the mean gap, weighted with the node's dual function, is zero. The equations
eliminate one component of each node, as in ``node_to_surface``. Multipliers are pressures, and nodal forces balance in force and
moment. Nodes farther from the target than a facet, and corners whose facets do not face it, have node-to-surface equations.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

from mpi4py import MPI

import numpy as np

from uem_dolfinx import forms
from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.mortar.duals import HARDLY_COVERED, Covered, dual_functions
from uem_dolfinx.contact.mortar.placement import Contactors, MortarKinematics
from uem_dolfinx.contact.mortar.rows import Pieces, Terms, WeightedRows, terms_of
from uem_dolfinx.contact.mortar.segment_motions import slopes
from uem_dolfinx.contact.mortar.tangent import SegmentPoints
from uem_dolfinx.contact.nodes.concave_edges import MOST_CHANGES, with_averaged_normals
from uem_dolfinx.contact.seam.placement import GapRows, Traits
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.opposite import FACING, find_opposite
from uem_dolfinx.geometry.overlaps import Planes, Segments, overlap
from uem_dolfinx.geometry.projection import FacetProjection, Projection, Target
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.geometry.search import MeshTarget
from uem_dolfinx.geometry.shapes import tangents
from uem_dolfinx.log import timed_as
from uem_dolfinx.parallel import reduced

#: Facets are parallel if their normals differ by less: rows and gradients of the gaps are then the same.
#: [convention; radians; test_mortar.py::test_parallel_facets]
PARALLEL = 1e-10
#: A rigid surface covers a facet if the cosine of the angle between its normal and the facet's reversed is larger at all points.
#: [convention; cosine; test_mortar.py::test_rigid_surfaces_cover_what_faces_them]
COVERS = 0.75
#: One that it has covered before stays covered as long as this cosine is larger: a facet that turns with what covers it would else be
#: covered and let go for ever. [convention; cosine; test_mortar.py::test_rigid_surfaces_go_on_covering]
GOES_ON_COVERING = 0.7


class Mortar(Contactors):
    """Implements ``Discretisation``: contactor facets against the surface of one target; other arguments as those of ``Contactors``.

    Args:
        of_gaps: whether a law gives forces across open gaps. Rows are then derivatives of mean gaps, times their areas.
    """

    traits = Traits(at_feet=False, pointwise=False, chained=True, two_pass=False)

    _afresh = False  # whether the last rows were made before any facets had faced each other in the step

    def __init__(
        self, config: Configuration, nodes: Indices, target: Target, *, surface: TargetFacets, of_gaps: bool = False, **how: Any
    ):  # fmt: skip
        super().__init__(config, nodes, target, surface=surface, **how)
        self.of_gaps = of_gaps
        # distinguishes equal nodes, independent of the partition
        nn = surface.dofs.shape[1]
        code = (surface.keys[:, None] * nn + np.arange(nn)) * 2654435761 % 2**32 / 2**32
        self._code = self.elimination.seam.sums(config.to_owners(surface.dofs.ravel(), code.ravel())) % 1.0
        #: Rows of the last placement, with the search and the states of contactors that they depend on; a search returns the same
        #: object while no node moves.
        self._united: tuple[Projection, Ints, WeightedRows] | None = None
        #: Kept rows of a contact with small or fixed sliding, and what ``_follow`` needs with them.
        self._kept: tuple[WeightedRows, Array, Array, Motion | None] | None = None

    # -- placement -------------------------------------------------------------------------------------------------------

    def place(self, points: Array, state: PairState) -> MortarKinematics:
        """Project contactors and find the segments of their facets (collective); see ``Discretisation``."""
        if self.sliding == "finite":
            nearest, locked = self.on_target(points), state.changes >= MOST_CHANGES
            known = np.column_stack([locked, state.cover])
            same = self._united is not None and self._united[0] is nearest and np.array_equal(self._united[1], known)
            if not reduced(self.config.comm, same, op=MPI.LAND):
                self._afresh = not len(self.faced)
                placed = nearest
                if self.target.faceted and isinstance(nearest, FacetProjection):
                    placed = with_averaged_normals(nearest, locked, points)
                self._united = nearest, known, self._unite(placed, points, self.remembered.shares(state.cover))
            assert self._united is not None
            rows = self._united[2]
        elif self._kept is None:
            nearest = self.take_feet(points)
            rows = self._unite(nearest, points, np.zeros(self.surface.dofs.shape, dtype=bool))
            whole = rows.plain.gap if self.offset is None else rows.plain.gap + self._weighted_offset(rows)
            self._kept = rows, self.config.x[: self.config.n_owned].copy(), whole, self.target.motion
        else:
            nearest = self.on_target(points, self.anchor)
            rows = self._follow(*self._kept)
        gap = rows.length * rows.equations.gap
        # at degree 2 rows have other scales than means
        seen: Any = replace(nearest, gap=gap / rows.share, normal=rows.plain.direction)  # type: ignore[type-var]
        if self.target.n_nodes:
            # forces and their reactions lie on one line through the contactor
            seen = seen.with_rows(np.flatnonzero(rows.covered), {"foot": points[rows.covered]})
        movable = np.linalg.norm(seen.normal * self.free, axis=1) > MOSTLY_PRESCRIBED
        if self.setting.prescribed:
            movable |= self._can_move(rows.plain)
        return MortarKinematics(self, points, seen, nearest, gap, rows, movable, self.left(nearest))

    def _can_move(self, equations: UnitingEquations) -> Bools:
        """Contactors whose equations contain a free component of a followed node (collective)."""
        free = self.config.ask_owners(equations.followed, self.setting.free.astype(float))
        can = np.zeros(len(equations), dtype=bool)
        can[equations.row[np.abs(equations.coefficients * free).max(axis=1, initial=0.0) > MOSTLY_PRESCRIBED]] = True
        return can

    def _follow(self, rows: WeightedRows, then: Array, gap: Array, before: Motion | None) -> WeightedRows:
        """The kept rows in the current configuration: ``gap (n,)``, at the positions ``then``, changes along them (collective)."""
        now = self.target.motion
        if now is not before:
            still = Motion.none(self.config.gdim)
            now, before = now or still, before or still
            then, Q = now.carry(before.back(then)), now.Q @ before.Q.T
            rows = rows.turned(Q)
        moved = GapRows.along_normals(self.config, rows.equations, rows.length, self.free)
        gap = gap + rows.length * moved.along(self.config.x[: self.config.n_owned] - then)
        if self.offset is not None:
            gap = gap - self._weighted_offset(rows)
        return rows.at_gaps(gap)

    # -- rows ------------------------------------------------------------------------------------------------------------

    @timed_as("segments")
    def _unite(self, nearest: Projection, points: Array, before: Bools) -> WeightedRows:
        """Equations of all contactors; ``before (m, nn)`` are shares of facets that the target covered before (collective)."""
        surface, config, nn = self.surface, self.config, self.surface.dofs.shape[1]
        x = surface.x
        away = np.linalg.norm(points - nearest.foot, axis=1) if self.target.n_nodes else np.abs(nearest.height)
        seen = np.column_stack([away, nearest.height, nearest.normal])
        seen = config.from_owners(self.nodes, seen, surface.dofs.ravel()).reshape(-1, nn, seen.shape[1])
        away = seen[:, :, 0]
        size = np.linalg.norm(x - x.mean(axis=1, keepdims=True), axis=2).max(axis=1) * 2
        near = np.ones(len(x), dtype=bool)
        if self.target.n_nodes and self.sliding == "finite":
            near = away.min(axis=1) < 2 * size
        facets = np.flatnonzero(near)
        planes = Planes.of(surface.shape, x, surface.sign).take(facets)
        reach = away[facets].max(axis=1, initial=0.0) / FACING + 0.5 * size[facets]
        if isinstance(self.target, MeshTarget):
            # on the other side of their body facets look away from what is in front of them, and are not inside what is behind that
            cosine = np.einsum("mag,mg->ma", seen[facets, :, 2:], planes.normal)
            averted = ((seen[facets, :, 1] > 0.0) & (cosine > -FACING)).all(axis=1) & (cosine > FACING).any(axis=1)
            pieces = self._over_segments(planes, x[facets], facets, reach, averted)
        else:
            pieces = self._over_facets(planes, x[facets], np.where(before[facets].any(axis=1), GOES_ON_COVERING, COVERS))
        segments, pairs, to_gap, N, nodes, y, shape_operator, facing = pieces
        phi = surface.shape.functions(segments.xi)
        b = phi if surface.shape.degree == 1 else self.basis.at(segments.xi)
        radius = None
        if config.axisymmetric:
            radius = np.einsum("qa,qa->q", phi, x[facets][pairs[segments.pair], :, 0])
            segments = replace(segments, weight=2 * np.pi * radius * segments.weight)
        dofs = surface.dofs[facets]
        full, stretch = self.shares(planes.size, x[facets]), self.stretch(facets, planes.size)

        def less(offsets: Array | None) -> WeightedRows:
            """Rows of the gaps less offsets at the facets' nodes ``(m, nn)``."""
            offset = None if offsets is None else np.einsum("qa,qa->q", phi, offsets[pairs[segments.pair]])
            covered = Covered.of(segments, b, N, pairs, full, offset)
            ratio = self.covered_part(dofs, covered)[1]
            duals = dual_functions(covered, self.precedence(ratio[dofs], dofs), before[facets])
            other = self.target.shape if isinstance(self.target, MeshTarget) else None
            at = SegmentPoints(
                segments, pairs, surface.nodes[facets], nodes, planes, duals, covered, b, phi, N, to_gap,
                surface.shape, other, x[facets], y, surface.sign[facets], shape_operator, radius, offsets,
            )  # fmt: skip
            return self._gather(at, facets, ratio[self.nodes], stretch, nearest)

        rows = less(offsets := self._offsets(facets))
        if self.of_gaps or self.sliding != "finite":
            # areas do not grow with gaps: the derivatives are those of gaps that are closed in the mean
            heights = self.heights_of_facets(rows)
            rows = less(heights if offsets is None else heights + offsets).at_gaps(rows.plain.gap)
        return replace(rows, facing=facing)

    def covered_part(self, dofs: Indices, covered: Covered) -> tuple[Array, Array]:
        """Covered area of each local node's facets ``dofs (m, nn)``, and its part of their area ``(n_local,)`` (collective)."""
        areas = (self.config.to_owners(dofs.ravel(), values.ravel()) for values in (covered.D, covered.full))
        part, full = map(self.elimination.seam.sums, areas)
        return part, part / np.where(full > 0, full, 1.0)

    def visibility_keys(self, facets: Ints) -> Array | None:
        """Visibility keys of contactor facets ``(m,)``: ``(m, k)``; None if they may touch all target facets."""
        return None

    def _offsets(self, facets: Ints) -> Array | None:
        """Offsets at the nodes of facets ``(m, nn)``; None without offset (collective)."""
        if self.offset is None:
            return None
        dofs = self.surface.dofs[facets]
        return self.config.from_owners(self.nodes, self.offset[:, None], dofs.ravel()).reshape(dofs.shape)

    def _weighted_offset(self, rows: WeightedRows) -> Array:
        """Weighted means of the present offsets, for rows that may have been made with other offsets ``(n,)`` (collective)."""
        offsets = self._offsets(rows.facets)
        assert offsets is not None and self.offset is not None
        total, length = self._over_lengths(rows, offsets)
        return np.where(rows.covered, total / length, self.offset)

    def _over_lengths(self, rows: WeightedRows, values: Array) -> tuple[Array, Array]:
        """Weighted ``values (m, nn)`` at the facets' nodes, and divisors of plain rows ``(n,)`` each (collective)."""
        at = rows.points
        coefficients = at.duals.C @ self.basis.T
        weighted = np.einsum("mij,mj->mi", coefficients, values)
        own = np.einsum("mij,mij,mg->mig", coefficients, self.elimination.seam.same(at.nodes), at.planes.normal)
        parts = np.concatenate([weighted[..., None], own], axis=2).reshape(weighted.size, 1 + self.config.gdim)
        total = self.elimination.total(at.nodes.ravel(), parts)
        return total[:, 0], np.where(rows.covered, np.linalg.norm(total[:, 1:], axis=1), 1.0)

    def with_variation(self, kinematics: MortarKinematics) -> MortarKinematics:
        """The kinematics with rows that are exact derivatives of the gaps also on parallel facets (collective)."""
        rows = kinematics.rows
        if self.sliding != "finite":
            return kinematics
        _, scale = self._over_lengths(rows, np.zeros(rows.points.nodes.shape))
        variation, _ = self.elimination.variation(rows.points, scale, rows.plain)
        equations, length = self.elimination.derivatives(rows.plain, variation)
        return replace(kinematics, rows=replace(rows, equations=equations, length=length))

    def set(self, **changed: Any) -> None:
        """See ``OnTarget`` (collective)."""
        super().set(**changed)
        if "offset" in changed:
            self._united = None

    def _over_segments(self, planes: Planes, x: Array, facets: Ints, reach: Array, averted: Bools) -> Pieces:
        """Segments against a mesh, of facets ``averted (m,)`` from what they are near to only in front (collective)."""
        assert isinstance(self.target, MeshTarget)
        shape = self.target.shape
        keys = self.surface.keys[facets]
        found = find_opposite(self.target, planes, x, reach, (keys, self.faced), self.visibility_keys(facets))
        e = found.facet
        s = overlap(planes, (self.surface.shape, x), (shape, found.x), self.surface.sign[facets], e)
        # facets farther away than the reach have no contact
        weight = np.bincount(s.pair, s.weight, minlength=len(e))
        mean = np.bincount(s.pair, s.weight * s.gap, minlength=len(e)) / np.where(weight > 0, weight, 1.0)
        upon = (weight > 0) & (np.abs(mean) <= reach[e]) & ~(averted[e] & (mean < 0.0))
        kept, number = upon[s.pair], np.cumsum(upon) - 1
        s = Segments(number[s.pair[kept]], s.xi[kept], s.eta[kept], s.weight[kept], s.gap[kept])
        e, y = e[upon], found.x[upon]
        to_gap = slopes(shape, y, planes.normal[e], s.pair, s.eta)
        facing = np.column_stack([keys[e], found.key[upon]])
        return Pieces(s, e, to_gap, shape.functions(s.eta), found.nodes[upon], y, None, facing)

    def _over_facets(self, planes: Planes, x: Array, least: Array) -> Pieces:
        """Whole facets against a rigid surface, which covers all that face it with cosines above ``least (m,)``."""
        shape, (m, g) = self.surface.shape, planes.origin.shape
        points, weights = forms.quadrature_rule(shape.cell, 4 * shape.degree)
        q = len(weights)
        xi, row = np.tile(points, (m, 1)), np.repeat(np.arange(m), q)
        tab = shape.tabulate(xi)
        p = self.target.project(np.einsum("qa,qag->qg", tab.N, x[row]))
        lean = -np.einsum("qg,qg->q", p.normal, planes.normal[row])
        flat = np.einsum("qfg,qeg->qfe", tangents(tab, x[row]), planes.axes[row][:, :-1])
        weight = np.tile(weights, m) * np.abs(np.linalg.det(flat))
        i = np.flatnonzero((lean.reshape(m, q) > least[:, None]).all(axis=1)[row])
        none = np.zeros((len(i), 0))
        s = Segments(row[i], xi[i], none, weight[i], p.gap[i])
        nodes, y = np.zeros((m, 0), np.int64), np.zeros((m, 0, g))
        return Pieces(s, np.arange(m), p.normal[i], none, nodes, y, p.hessians(i), np.zeros((0, 2), np.int64))

    def precedence(self, ratio: Array, dofs: Indices) -> Array:
        """Order in which nodes of facets ``dofs (m, nn)`` receive hardly covered dual functions, equal on all ranks ``(m, nn)``.

        A node's equation may contain nodes later in the order, which excludes cycles; middles come before vertices.

        Args:
            ratio: covered part of the node's share of all its facets ``(m, nn)``.
            dofs: local nodes of the facets ``(m, nn)``.
        """
        code = 1e-7 * self._code[dofs]
        well = 1.0 + self.basis.rank + 0.5 * np.round(np.minimum(ratio, 1.0), 6) + code
        return np.where(ratio >= HARDLY_COVERED, well, ratio * (1 + code))

    def _gather(self, at: SegmentPoints, facets: Ints, ratio: Array, stretch: Array, nearest: Projection) -> WeightedRows:
        """Add up the facets' parts of each row at the owner of its node, and complete them (collective)."""
        config, n = self.config, len(self.nodes)
        own, e, normal, A, C = at.nodes, at.facet, -at.planes.normal, at.duals.A, at.duals.C
        coefficients = C @ self.basis.T
        on_facet = coefficients[:, :, :, None] * normal[:, None, None]
        followed = (A[e] @ at.covered.N)[..., None]
        on_target = followed * normal[e][:, None, None]
        area, gap = C.sum(axis=2), np.einsum("mij,mj->mi", A, at.covered.G)
        sharing, same = self.elimination.seam.sharing, self.elimination.seam.same(own)
        itself = np.einsum("mij,mij->mi", coefficients, same)
        f, i = np.nonzero(area > 0)
        values = np.column_stack([itself[f, i, None] * normal[f], gap[f, i], area[f, i], area[f, i, None] * normal[f]])
        direction, gap, size, vector = np.split(self.elimination.total(own[f, i], values), np.cumsum([config.gdim, 1, 1]), axis=1)
        gap, size = gap[:, 0], size[:, 0] if self.of_gaps else np.linalg.norm(vector, axis=1)
        length = np.linalg.norm(direction, axis=1)
        is_covered = length > 0
        scale = np.where(is_covered, length, 1.0)
        direction = np.where(is_covered[:, None], direction / scale[:, None], nearest.normal)
        # rows contain other nodes of their own facets if these have no function of their own, and nodes of the target
        other = ~same & (coefficients != 0)
        terms = [terms_of(own, own, -on_facet, other), terms_of(own[e], at.opposite, on_target)]
        row, term, value = self.elimination.at_owners(terms, scale)
        # other contactors have node-to-surface rows
        alone = np.flatnonzero(~is_covered)
        k, a = np.nonzero(nearest.nodes[alone] >= 0)
        row, term = np.concatenate([row, alone[k]]), np.concatenate([term, nearest.nodes[alone][k, a]])
        value = np.concatenate([value, nearest.weights[alone][k, a, None] * nearest.normal[alone][k]])
        gap = np.where(is_covered, gap / scale, nearest.gap)
        variation: Terms = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, config.gdim)))
        length, parts = np.ones(n), itself[:, :, None] * normal[:, None]
        plain_parts = parts
        plain = equations = UnitingEquations(self.nodes, direction, gap, np.zeros(n, dtype=bool), row, term, value)
        if reduced(config.comm, bool((np.abs(at.tilt) > PARALLEL).any()), op=MPI.LOR):
            variation, more = self.elimination.variation(at, scale, plain)
            parts = parts + more
            equations, length = self.elimination.derivatives(plain, variation)
        share = np.where(is_covered, size / scale, 1.0)
        weights = frictionless = slope = push = whole = None
        if self.setting.cones is not None:
            along = self.elimination.of_themselves(plain, variation)
            slope = np.linalg.norm(along, axis=1)
            pushed = np.linalg.norm([plain_parts[f, i], parts[f, i]], axis=2).T
            pushed = self.elimination.total(own[f, i], pushed)
            taken = np.bincount(variation[0], minlength=n) > 0
            push = np.where(is_covered, np.where(taken, pushed[:, 1], pushed[:, 0]) / scale, 1.0)
            frictionless = along / slope[:, None]
            whole = self.elimination.total(own[f, i], itself[f, i, None])[:, 0]
            means = [terms_of(own, own, -coefficients[..., None], other), terms_of(own[e], at.opposite, followed)]
            whole = np.where(is_covered, whole, 1.0)
            r, t, w = self.elimination.at_owners(means, whole)
            near = nearest.nodes[alone][k, a], nearest.weights[alone][k, a]
            weights = np.concatenate([r, alone[k]]), np.concatenate([t, near[0]]), np.concatenate([w[:, 0], near[1]])
        return WeightedRows(
            sharing, equations, length, plain, at, facets, is_covered, ratio, size / sharing, stretch, share, weights,
            frictionless, slope, push, parts, whole,
        )  # fmt: skip

    def begin_step(self) -> None:
        """Begin a step: pairs of facets that have faced each other are reset."""
        super().begin_step()
        if not self._afresh:
            self._united = None

    def let_go(self) -> None:
        """Drop the kept closest points and segments."""
        super().let_go()
        self._kept = None
