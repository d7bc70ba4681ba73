"""Mortar: uniting equations from integrals over segments, exact on any pair of meshes.

Where a node's part of the contactor is covered by the target, its equation says that the gap vanishes in the mean, weighted with the
node's dual function. The equations eliminate one component of the node each, like those of ``node_to_surface``; their multipliers
are pressures, and what they hand on balances in force and moment. Nodes that are farther from the target than a facet, until they come
nearer, and corners whose facets do not face it, have the equation of a node against the surface.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any, NamedTuple, cast

from mpi4py import MPI

import numpy as np

from uem_dolfinx import forms
from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.coupling import NORMAL, LabelledEquations, Placement
from uem_dolfinx.contact.duals import HARDLY_COVERED, Basis, Covered, basis_of, dual_functions
from uem_dolfinx.contact.mortar_rows import Elimination, Terms, WeightedRows, terms_of, with_terms
from uem_dolfinx.contact.mortar_tangent import SegmentPoints
from uem_dolfinx.contact.mortar_turning import Slips, turning
from uem_dolfinx.contact.node_to_surface import NEAR, NodeToSurface
from uem_dolfinx.contact.segment_motions import slopes
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.contact.valleys import MOST_CHANGES, with_averaged_normals
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.opposite import FACING, find_opposite
from uem_dolfinx.geometry.overlaps import Planes, Segments, overlap
from uem_dolfinx.geometry.projection import FacetProjection, Projection, Target
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.geometry.search import LEAST_LEAN, MeshTarget
from uem_dolfinx.geometry.shapes import tangents
from uem_dolfinx.log import timed

#: Facets are parallel if their normals differ by less: rows and gradients of the gaps are then the same.
#: [convention; radians; test_mortar.py::test_parallel_facets]
PARALLEL = 1e-10
#: A rigid surface covers a facet if the cosine of the angle between its normal and the facet's reversed is larger at all points: the
#: rows of small and fixed sliding are kept along the facet's normal.
#: [convention; cosine; test_mortar.py::test_rigid_surfaces_cover_what_faces_them]
COVERS = 0.75
#: A contactor that has lost its cover in a step is taken back within it where so much of its share is covered again.
#: [convention; part of its share of the facets; test_mortar.py::test_off_the_end_and_back]
COVERED_AGAIN = 0.5


class Pieces(NamedTuple):
    """Segments of pairs of facets, with their contactor facets and what is opposite; fields as those of ``SegmentPoints``."""

    segments: Segments
    facet: Ints
    to_gap: Array
    N: Array
    opposite: Ints
    y: Array
    bend: Array | None


class Mortar(NodeToSurface):
    """Implements ``Coupling``: contactor facets against the surface of one target; arguments as those of ``NodeToSurface``.

    Args:
        surface: the contactor's facets.
    """

    chained, two_pass = True, False
    nodal = at_feet = False
    #: Whether there is friction.
    _rubs = False

    def __init__(self, config: Configuration, nodes: Indices, target: Target, *, surface: TargetFacets, **how: Any):
        super().__init__(config, nodes, target, **how)
        self._valleys, self.surface = None, surface
        self.basis: Basis = basis_of(surface.shape)
        self._elimination = Elimination(config, nodes, self.free)
        # tells equal nodes apart, alike in any partition
        nn = surface.dofs.shape[1]
        code = (surface.keys[:, None] * nn + np.arange(nn)) * 2654435761 % 2**32 / 2**32
        self._code = config.to_owners(surface.dofs.ravel(), code.ravel()) % 1.0
        #: The last search that rows were made from, the contactors with averaged normals, and the rows; a search finds the same object
        #: as long as nothing moves.
        self._united: tuple[Projection, Bools, WeightedRows] | None = None
        #: Rows that a contact with small or fixed sliding keeps.
        self._kept: WeightedRows | None = None
        #: Motion of a rigid target when they were made.
        self._kept_at: Motion | None = None

    # -- placement -------------------------------------------------------------------------------------------------------

    def place(self, points: Array, state: PairState) -> Placement:
        """Project contactors and find the segments of their facets (collective); see ``Coupling``."""
        if self.sliding == "finite":
            nearest, locked = self._on_target(points), state.changes >= MOST_CHANGES
            same = self._united is not None and self._united[0] is nearest and np.array_equal(self._united[1], locked)
            if self._united is None or not self.config.comm.allreduce(same, op=MPI.LAND):
                placed = with_averaged_normals(nearest, locked, points) if self.target.faceted else nearest
                self._united = nearest, locked, self._unite(placed, points)
            rows = self._united[2]
        elif self._kept is None:
            nearest = self._anchor = self.target.project(points)
            rows = self._kept = self._unite(nearest, points)
            self._kept_at = self.target.motion
        else:
            nearest = self._on_target(points, self._anchor)
            rows = self._follow(self._kept, nearest)
        eq = rows.equations
        seen: Any = replace(nearest, gap=eq.gap, normal=eq.direction)  # type: ignore[type-var]
        if self.target.n_nodes:
            # forces and their reactions lie on one line through the contactor
            seen = seen.with_rows(np.flatnonzero(rows.covered), {"foot": points[rows.covered]})
        return Placement(seen, eq.gap, self._can_move(rows.plain) if self.prescribed else None, rows)

    def returned(self, placement: Placement, points: Array, state: PairState, gap: Array) -> Placement:
        """Nothing is returned."""
        return placement

    def change_facets(self, placement: Placement, points: Array, state: PairState) -> tuple[Placement, PairState, bool]:
        """Count how often contactors that nothing covers change facets, until they get averaged normals: equations do not change here."""
        if not (self.target.faceted and self.sliding == "finite"):
            return placement, state, False
        number = cast("FacetProjection", placement.projection).facet
        moved = state.active & ~placement.details.covered & (state.facet >= 0) & (state.facet != number)
        return placement, replace(state, facet=number, changes=state.changes + moved), False

    def return_vectors(self, placement: Placement, points: Array, state: PairState) -> Array:
        """Weighted gaps are closed by the linear solve."""
        return np.zeros(points.shape)

    def _can_move(self, equations: UnitingEquations) -> Bools:
        """Contactors whose equations follow anything that can move (collective)."""
        free = self.config.ask_owners(equations.followed, self._free_of_owned.astype(float))
        can = np.zeros(len(equations), dtype=bool)
        can[equations.row[np.abs(equations.coefficients * free).max(axis=1, initial=0.0) > MOSTLY_PRESCRIBED]] = True
        return can

    def _follow(self, rows: WeightedRows, nearest: Projection) -> WeightedRows:
        """The same rows where contactors and target are now (collective)."""
        eq, n = rows.equations, self.config.n_owned
        if self.target.n_nodes:
            gap = self._along(eq, self.config.x[:n])
        else:
            assert self._anchor is not None
            eq = self._turned(eq)
            # what the nodes have come nearer, as a displacement along the rows
            lean = np.einsum("ng,ng->n", nearest.normal, eq.direction)
            way = np.zeros((n, self.config.gdim))
            way[self.nodes] = ((nearest.gap - self._anchor.gap) / np.maximum(lean, LEAST_LEAN))[:, None] * eq.direction
            gap = eq.gap + self._along(eq, way)
        moved = replace(eq, gap=gap)
        return replace(rows, equations=moved, plain=moved, normal=eq.direction)

    def _turned(self, equations: UnitingEquations) -> UnitingEquations:
        """Kept rows, which turn with a rigid target."""
        now, then = self.target.motion, self._kept_at
        if now is then:
            return equations
        still = Motion.none(self.config.gdim)
        Q = (now or still).Q @ (then or still).Q.T
        return replace(equations, direction=equations.direction @ Q.T, coefficients=equations.coefficients @ Q.T)

    def _along(self, equations: UnitingEquations, values: Array) -> Array:
        """What the left sides of the equations make of the owned nodes' ``values (n_owned, gdim)``: ``(n,)`` (collective)."""
        nodes, place = np.unique(equations.followed, return_inverse=True)
        theirs = self.config.ask_owners(nodes, values)[place]
        own = np.einsum("ng,ng->n", equations.direction, values[equations.node])
        return own - np.bincount(equations.row, np.einsum("kg,kg->k", equations.coefficients, theirs), minlength=len(equations))

    # -- rows ------------------------------------------------------------------------------------------------------------

    @timed("segments")
    def _unite(self, nearest: Projection, points: Array) -> WeightedRows:
        """Equations of all contactors (collective)."""
        surface, config, nn = self.surface, self.config, self.surface.dofs.shape[1]
        x = surface.x
        away = np.linalg.norm(points - nearest.foot, axis=1) if self.target.n_nodes else np.abs(nearest.gap)
        away = config.from_owners(self.nodes, away[:, None], surface.dofs.ravel())[:, 0].reshape(-1, nn)
        size = np.linalg.norm(x - x.mean(axis=1, keepdims=True), axis=2).max(axis=1) * 2
        near = np.ones(len(x), dtype=bool)
        if self.target.n_nodes and self.sliding == "finite":
            near = away.min(axis=1) < (1 + NEAR) * size
        facets = np.flatnonzero(near)
        planes = Planes.of(surface.shape, x, surface.sign).take(facets)
        reach = away[facets].max(axis=1, initial=0.0) / FACING + 0.5 * size[facets]
        placed = self._over_segments if isinstance(self.target, MeshTarget) else self._over_facets
        segments, pairs, to_gap, N, nodes, y, bend = placed(planes, x[facets], facets, reach)
        b, phi = self.basis.at(segments.xi), surface.shape.functions(segments.xi)
        covered = Covered.of(segments, b, N, pairs, planes.size, self.basis.mean)
        dofs = surface.dofs[facets]
        part, full = (config.to_owners(dofs.ravel(), values.ravel()) for values in (covered.D, covered.full))
        ratio = part / np.where(full > 0, full, 1.0)
        duals = dual_functions(covered, self._precedence(ratio[dofs], dofs))
        other = self.target.shape if isinstance(self.target, MeshTarget) else None
        at = SegmentPoints(
            segments, pairs, surface.nodes[facets], nodes, planes, duals, covered, b, phi, N, to_gap,
            surface.shape, other, x[facets], y, surface.sign[facets], bend,
        )  # fmt: skip
        return self._gather(at, facets, ratio[self.nodes], nearest)

    def _over_segments(self, planes: Planes, x: Array, facets: Ints, reach: Array) -> Pieces:
        """Segments against a mesh (collective)."""
        assert isinstance(self.target, MeshTarget)
        shape = self.target.shape
        found = find_opposite(self.target, planes, x, reach)
        e = found.facet
        s = overlap(planes.take(e), (self.surface.shape, x[e]), (shape, found.x), self.surface.sign[facets[e]])
        # what lies behind the facets in reach is no contact
        weight = np.bincount(s.pair, s.weight, minlength=len(e))
        mean = np.bincount(s.pair, s.weight * s.gap, minlength=len(e)) / np.where(weight > 0, weight, 1.0)
        kept = ((weight > 0) & (np.abs(mean) <= reach[e]))[s.pair]
        s = Segments(s.pair[kept], s.xi[kept], s.eta[kept], s.weight[kept], s.gap[kept])
        to_gap = slopes(shape, found.x, planes.normal[e], s.pair, s.eta)
        return Pieces(s, e, to_gap, shape.functions(s.eta), found.nodes, found.x, None)

    def _over_facets(self, planes: Planes, x: Array, facets: Ints, reach: Array) -> Pieces:
        """Whole facets against a rigid surface, which covers all that face it."""
        shape, (m, g) = self.surface.shape, planes.origin.shape
        points, weights = forms.quadrature_rule(shape.cell, 4 * shape.degree)
        q = len(weights)
        xi, row = np.tile(points, (m, 1)), np.repeat(np.arange(m), q)
        tab = shape.tabulate(xi)
        p = self.target.project(np.einsum("qa,qag->qg", tab.N, x[row]))
        lean = -np.einsum("qg,qg->q", p.normal, planes.normal[row])
        flat = np.einsum("qfg,qeg->qfe", tangents(tab, x[row]), planes.axes[row][:, :-1])
        weight = np.tile(weights, m) * np.abs(np.linalg.det(flat))
        i = np.flatnonzero((lean.reshape(m, q) > COVERS).all(axis=1)[row])
        none = np.zeros((len(i), 0))
        s = Segments(row[i], xi[i], none, weight[i], p.gap[i])
        return Pieces(s, np.arange(m), p.normal[i], none, np.zeros((m, 0), np.int64), np.zeros((m, 0, g)), p.hessians(i))

    def _precedence(self, ratio: Array, dofs: Indices) -> Array:
        """Order in which nodes of facets ``dofs (m, nn)`` take in what is hardly covered, alike on all ranks ``(m, nn)``.

        A node's equation may take in nodes that come after it, so that no equation follows itself: middles come before vertices.

        Args:
            ratio: part of the node's share of all its facets that is covered ``(m, nn)``.
            dofs: local nodes of the facets ``(m, nn)``.
        """
        code = 1e-7 * self._code[dofs]
        well = 1.0 + self.basis.rank + 0.5 * np.round(np.minimum(ratio, 1.0), 6) + code
        return np.where(ratio >= HARDLY_COVERED, well, ratio * (1 + code))

    def _gather(self, at: SegmentPoints, facets: Ints, ratio: Array, nearest: Projection) -> WeightedRows:
        """Add up the facets' parts of each row at the owner of its node, and complete them (collective)."""
        config, n = self.config, len(self.nodes)
        own, e, normal, A, C = at.nodes, at.facet, -at.planes.normal, at.duals.A, at.duals.C
        coefficients = C @ self.basis.T
        on_facet = coefficients[:, :, :, None] * normal[:, None, None]
        followed = (A[e] @ at.covered.N)[..., None]
        on_target = followed * normal[e][:, None, None]
        area, gap = C.sum(axis=2), np.einsum("mij,mj->mi", A, at.covered.G)
        f, i = np.nonzero(area > 0)
        values = np.column_stack([on_facet[f, i, i], gap[f, i], area[f, i, None] * normal[f]])
        total = config.add_at_owners(own[f, i], values)[self.nodes]
        direction, gap, size = total[:, : config.gdim], total[:, config.gdim], np.linalg.norm(total[:, config.gdim + 1 :], axis=1)
        length = np.linalg.norm(direction, axis=1)
        is_covered = length > 0
        scale = np.where(is_covered, length, 1.0)
        direction = np.where(is_covered[:, None], direction / scale[:, None], nearest.normal)
        # a row follows its own facets' other nodes where it takes them in, and the target's
        other = ~np.eye(own.shape[1], dtype=bool)
        terms = [terms_of(own, own, -on_facet, other & (coefficients != 0)), terms_of(own[e], at.opposite, on_target)]
        row, term, value = self._elimination.at_owners(terms, scale)
        # the rest keep their places on the target
        alone = np.flatnonzero(~is_covered)
        k, a = np.nonzero(nearest.nodes[alone] >= 0)
        row, term = np.concatenate([row, alone[k]]), np.concatenate([term, nearest.nodes[alone][k, a]])
        value = np.concatenate([value, nearest.weights[alone][k, a, None] * nearest.normal[alone][k]])
        gap = np.where(is_covered, gap / scale, nearest.gap)
        beside: Terms = (np.zeros(0, np.int64), np.zeros(0, np.int64), np.zeros((0, config.gdim)))
        plain = equations = UnitingEquations(self.nodes, direction, gap, np.zeros(n, dtype=bool), row, term, value)
        if self.sliding == "finite" and config.comm.allreduce(bool((np.abs(at.tilt) > PARALLEL).any()), op=MPI.LOR):
            beside = self._elimination.beside(at, scale, direction)
            equations = with_terms(plain, beside)
        share = np.where(is_covered, size / scale, 1.0)
        weights = upright = slope = whole = None
        if self._rubs:
            along = self._elimination.of_themselves(plain, beside)
            slope = np.linalg.norm(along, axis=1)
            upright = along / slope[:, None]
            whole = config.add_at_owners(own[f, i], coefficients[f, i, i, None])[self.nodes, 0]
            means = [
                terms_of(own, own, -coefficients[..., None], other & (coefficients != 0)),
                terms_of(own[e], at.opposite, followed),
            ]
            whole = np.where(is_covered, whole, 1.0)
            r, t, w = self._elimination.at_owners(means, whole)
            near = nearest.nodes[alone][k, a], nearest.weights[alone][k, a]
            weights = np.concatenate([r, alone[k]]), np.concatenate([t, near[0]]), np.concatenate([w[:, 0], near[1]])
        return WeightedRows(equations, plain, beside, at, facets, is_covered, ratio, size, share, weights, upright, slope, whole)

    def rub(self, mu: Array) -> None:
        """Keep the weights that friction needs; see ``Coupling``."""
        self._rubs = True

    def weights(self, placement: Placement) -> Terms:
        """Integrals of the dual functions times the shape functions of both sides, over that of the contactor's own."""
        weights: Terms = placement.details.weights
        return weights

    def shares(self, placement: Placement, state: PairState) -> Array:
        """Of multipliers along the derivatives of the gaps with the contactors' own displacements."""
        rows: WeightedRows = placement.details
        assert rows.slope is not None
        return np.asarray(rows.share / rows.slope)

    def tilts(self, placement: Placement, state: PairState) -> Array:
        """Of equations that are taken apart, which makes the derivatives longer or shorter."""
        rows: WeightedRows = placement.details
        assert rows.slope is not None
        return np.asarray(rows.slope / self._elimination.apart(rows, state.active)[1])

    def normals(self, placement: Placement, state: PairState) -> Array:
        """Directions of the derivatives of the gaps with the contactors' own displacements."""
        rows: WeightedRows = placement.details
        assert rows.normal is not None
        return rows.normal

    # -- what decides on contact -----------------------------------------------------------------------------------------

    def foreseen(self, placement: Placement, du: Array) -> Array:
        """Weighted gaps after an increment (collective)."""
        eq = placement.details.equations
        return np.asarray(eq.gap + self._along(eq, du))

    def off(self, placement: Placement, state: PairState) -> Bools:
        """Contactors past an end of the target, or that it has let go of in this step and hardly covers again.

        A target that springs back when its end lets go would cover the contactor's last bit again, for ever.
        """
        rows: WeightedRows = placement.details
        if not self.target.n_nodes:
            return np.zeros(len(self.nodes), dtype=bool)
        return np.where(rows.covered, (state.slips > 0) & (rows.ratio < COVERED_AGAIN), super().off(placement, state))

    def at_end(self, placement: Placement, state: PairState) -> Bools:
        """No end holds contactors: what is covered of them fades away."""
        return np.zeros(len(self.nodes), dtype=bool)

    # -- equations and forces --------------------------------------------------------------------------------------------

    def approach(self, placement: Placement, which: Ints) -> UnitingEquations:
        """The equations that the contactors ``which (k,)`` would have if they were active."""
        part = self._select(placement.details.equations, which)
        return replace(part, active=np.ones(len(part), dtype=bool))

    def equations(self, placement: Placement, points: Array, state: PairState, which: Ints) -> LabelledEquations:
        """One equation for each contactor."""
        rows = replace(
            self._select(self._elimination.apart(placement.details, state.active)[0], which), active=state.active[which]
        )
        return LabelledEquations(rows, rows, which, np.full(len(which), NORMAL))

    def _select(self, rows: UnitingEquations, which: Ints) -> UnitingEquations:
        chosen = np.zeros(len(self.nodes), dtype=bool)
        chosen[which] = True
        return rows.select(chosen)

    def forces(
        self, placement: Placement, state: PairState, equations: LabelledEquations, multipliers: Array
    ) -> tuple[Array, Array, Array]:
        """Pressures times areas, and the contactors' forces (collective)."""
        rows: WeightedRows = placement.details
        mu = np.zeros(len(self.nodes))
        mu[equations.contactor] = multipliers
        made, by = self._elimination.apart(rows, state.active)
        nodes, values = self._handed_on(made, mu)
        force = np.asarray(self.config.add_at_owners(nodes, values)[self.nodes])
        return mu / by * rows.share, np.einsum("ng,ng->n", force, rows.equations.direction), force

    def _handed_on(self, eq: UnitingEquations, mu: Array) -> tuple[Ints, Array]:
        """Global nodes ``(k,)`` and forces ``(k, gdim)`` of multipliers ``mu (n,)`` on both bodies."""
        own, terms = mu != 0, mu[eq.row] != 0
        nodes = np.concatenate([self.config.to_global(self.nodes[own]), eq.followed[terms]])
        return nodes, np.concatenate([mu[own, None] * eq.direction[own], -mu[eq.row[terms], None] * eq.coefficients[terms]])

    def nodal_forces(self, placement: Placement, state: PairState) -> tuple[Ints, Array]:
        """What the equations hand on of the state's multipliers."""
        rows: WeightedRows = placement.details
        made, by = self._elimination.apart(rows, state.active)
        nodes, forces = self._handed_on(made, state.lam / rows.share * by)
        if state.friction is None:
            return nodes, forces
        tau = state.friction.tau / self.shares(placement, state)[:, None]
        row, followed, weight = self.weights(placement)
        return (
            np.concatenate([nodes, self.config.to_global(self.nodes), followed]),
            np.concatenate([forces, tau, -weight[:, None] * tau[row]]),
        )

    def curvature(self, placement: Placement, state: PairState) -> tuple[Ints, Array]:
        """Second derivatives of the weighted gaps."""
        rows: WeightedRows = placement.details
        pressure = np.where(rows.covered, state.lam / np.where(rows.covered, rows.area, 1.0), 0.0)
        dofs = self.surface.dofs[rows.facets]
        at_nodes = self.config.from_owners(self.nodes, pressure[:, None], dofs.ravel()).reshape(dofs.shape)
        return rows.points.curvature(at_nodes)

    def turning(self, placement: Placement, state: PairState, which: Ints, tau: Array) -> list[tuple[Ints, Array]]:
        """Of those that the target covers: traction turns, grows with its surface and is handed to what is opposite (collective)."""
        rows: WeightedRows = placement.details
        kept = rows.covered[which]
        i, tau = which[kept], tau[kept]
        push = state.lam / self.shares(placement, state)
        slips = Slips(i, push[i], state.lam[i] / rows.area[i], self.normals(placement, state)[i], tau)
        return turning(self._elimination, rows, self.surface.dofs[rows.facets], slips, self.weights(placement))

    def areas(self, placement: Placement, areas: Array) -> Array:
        """Integrals of the dual functions over what is covered."""
        rows: WeightedRows = placement.details
        return np.where(rows.covered, rows.area, areas)

    def commit(self) -> None:
        """Small sliding finds its segments anew in every step."""
        super().commit()
        if self.sliding == "small":
            self._kept = None
