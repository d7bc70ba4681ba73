"""A third discretisation, on the seam alone: gaps at Gauss points of the contactor's facets, weighted with dual functions.

The row of a contactor i is the mean of the gaps at the Gauss points q of its facets, ``g_i = sum_q w_q psi_i(q) g(q) / A_i``, over areas
as drawn, with ``A_i = sum_q w_q psi_i(q)``. The dual functions of whole facets, ``psi = D M^-1 phi`` with ``D = sum_q w_q phi`` and
``M = sum_q w_q phi phi'``, leave the contactor alone of its facet's nodes where the target is flat. A gap's multiplier times ``A_i`` is
the integral of the pressure; forces and curvature are those of the gaps at the points, which any ``Target`` has. There is no friction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from uem_dolfinx import forms
from uem_dolfinx.algebra.equations import MOSTLY_PRESCRIBED, UnitingEquations
from uem_dolfinx.arrays import Bools
from uem_dolfinx.contact.seam.base import OnTarget, PlacedOnTarget
from uem_dolfinx.contact.seam.placement import GapRows, Traits
from uem_dolfinx.contact.seam.pressure_map import PressureMap
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.projection import Projection
from uem_dolfinx.geometry.shapes import tangents
from uem_dolfinx.parallel import Exchange

#: Parts of a row that are smaller are rounding of normals that are equal.
ROUNDING = 1e-12


def gauss_points(degree):
    """The discretisation, for ``coupling=``, with a quadrature rule of this degree."""
    return type("GaussPoints", (GaussPoints,), {"degree": degree})


class GaussPoints(OnTarget):
    """Implements ``Discretisation`` for contactors of degree 1 and finite sliding."""

    traits = Traits(at_feet=False, pointwise=False, chained=True, two_pass=False)
    #: Of polynomials that the quadrature rule integrates exactly.
    degree = 3

    def __init__(self, config, nodes, target, *, chords, **how):
        super().__init__(config, nodes, target, **how)
        assert config.degree == 1 and self.sliding == "finite"
        self.surface = surface = TargetFacets(config, self.contactor, "contactor")
        m, nc = surface.dofs.shape
        self.place_of = np.full(config.n_owned, -1)
        self.place_of[nodes] = np.arange(len(nodes))
        xi, w = forms.quadrature_rule(surface.shape.cell, self.degree)
        tab = surface.shape.tabulate(np.tile(xi, (m, 1)))
        #: Shape functions at all points ``(q, nc)``, and the facets of these.
        self.phi, self.facet = tab.N, np.repeat(np.arange(m), len(w))
        T = tangents(tab, config.X[surface.dofs][self.facet])
        weight = np.tile(w, m) * np.sqrt(np.linalg.det(np.einsum("qfg,qeg->qfe", T, T)))
        phi, weight = self.phi.reshape(m, len(w), nc), weight.reshape(m, len(w))
        D, M = np.einsum("mq,mqi->mi", weight, phi), np.einsum("mq,mqi,mqj->mij", weight, phi, phi)
        #: Weights times dual functions ``(q, nc)``, and their sums at the contactors ``(n,)``.
        self.weighted = np.einsum("mq,mqj,mji,mi->mqi", weight, phi, np.linalg.inv(M), D).reshape(-1, nc)
        self.area = config.add_at_owners(surface.nodes.ravel(), D.ravel()[:, None])[nodes, 0]

    def set(self, **changed):
        """Without friction."""
        if "cones" in changed:
            raise InputError("Gauss points have no friction: leave it out")
        super().set(**changed)

    def place(self, points, state):
        """Project contactors and Gauss points (collective)."""
        x = np.einsum("qj,qjg->qg", self.phi, self.config.x[self.surface.dofs][self.facet])
        nearest, at = self.on_target(points), self.target.project(x)
        if self.offset is not None:
            dofs = self.surface.dofs
            offset = self.config.from_owners(self.nodes, self.offset[:, None], dofs.ravel()).reshape(dofs.shape)
            at = replace(at, gap=at.gap - np.einsum("qj,qj->q", self.phi, offset[self.facet]))
        rows = self._rows(at)
        seen = replace(nearest, gap=rows.scale * rows.equations.gap, normal=rows.equations.direction)
        if self.target.n_nodes:
            # forces and their reactions lie on one line through the contactor
            seen = replace(seen, foot=points)
        movable = np.linalg.norm(seen.normal * self.free, axis=1) > MOSTLY_PRESCRIBED
        return GaussKinematics(self, points, seen, nearest, seen.gap, movable, rows, at)

    def _rows(self, at):
        """The equations of all contactors, from the points' projection (collective)."""
        config, of, n = self.config, self.surface.nodes, len(self.nodes)
        V, N = self.weighted, np.concatenate([self.phi, -at.weights], axis=1)
        gap = config.add_at_owners(of[self.facet].ravel(), (V * at.gap[:, None]).ravel()[:, None])[self.nodes, 0]
        # a term for every contactor of the point's facet and every node that moves the gap there
        values = V[:, :, None, None] * N[:, None, :, None] * at.normal[:, None, None, :]
        row, term = np.broadcast_arrays(of[self.facet][:, :, None], np.concatenate([of[self.facet], at.nodes], axis=1)[:, None])
        row, term, value = row[term >= 0], term[term >= 0], values[term >= 0]
        row, term, value = Exchange.to(config.comm, config.owner_of(row)).send(row, term, value)
        pairs, place = np.unique(np.column_stack([row, term]), axis=0, return_inverse=True)
        value = np.column_stack([np.bincount(place.ravel(), part, minlength=len(pairs)) for part in value.T])
        i, followed = self.place_of[pairs[:, 0] - config.first], pairs[:, 1]
        itself = followed == pairs[:, 0]
        direction = np.zeros((n, config.gdim))
        direction[i[itself]] = value[itself]
        length = np.linalg.norm(direction, axis=1)
        other = ~itself & (np.abs(value).max(axis=1, initial=0.0) > ROUNDING * length[i])
        made = UnitingEquations(
            self.nodes, direction / length[:, None], gap / length, np.zeros(n, bool), i[other], followed[other],
            -value[other] / length[i[other], None],
        )  # fmt: skip
        return GapRows.along_normals(config, made, length / self.area, self.free)


@dataclass(frozen=True)
class GaussKinematics(PlacedOnTarget):
    """Implements ``Kinematics`` without friction.

    Attributes:
        movable: contactors whose gap can be closed ``(n,)``.
        gap_rows: of all contactors.
        at: projection of the points.
    """

    movable: Bools
    gap_rows: GapRows
    at: Projection
    corners = None

    def pressure_map(self, current):
        """Integrals of the dual functions are those of the shape functions."""
        return PressureMap(1.0 / self.gap_rows.scale)

    def curvature(self, state):
        """Second derivatives of the gaps at the points, times minus their forces (collective)."""
        of, at, dofs, g = self.of, self.at, self.of.surface.dofs, self.of.config.gdim
        p = of.config.from_owners(of.nodes, (state.lam / of.area)[:, None], dofs.ravel()).reshape(dofs.shape)
        force = np.einsum("qi,qi->q", of.weighted, p[of.facet])
        q = np.flatnonzero(force)
        nc, nt = dofs.shape[1], at.nodes.shape[1]
        # from the nodes of the point's facet and those of the target to the point and those of the target
        E = np.zeros((len(q), 1 + nt, nc + nt))
        E[:, 0, :nc], E[:, 1:, nc:] = of.phi[q], np.eye(nt)
        H = at.hessians(q).reshape(len(q), 1 + nt, g, 1 + nt, g)
        blocks = -force[q, None, None, None, None] * np.einsum("qai,qagbh,qbj->qigjh", E, H, E)
        nodes = np.concatenate([of.surface.nodes[of.facet[q]], at.nodes[q]], axis=1)
        return [(nodes, blocks.reshape(len(q), (nc + nt) * g, (nc + nt) * g))]
