"""Node to surface on contactors of degree 2, with control gaps instead of nodal gaps.

A quadratic facet's shape functions are partly negative, so that under a pressure its nodal forces are zero or negative at vertices,
and are no criterion for contact. In the Bernstein basis, which is positive, the same gap has the coefficients

    g_v at a vertex,    2 g_m - (g_1 + g_2) / 2 in the middle of an edge,    and likewise in the middle of a quadrilateral,

and its forces are integrals of the pressure with positive weights. The contact conditions are therefore ``control gap >= 0, control
force >= 0``, one of them zero. If all nodes of a facet are active, the constraints are equivalent to nodal gaps; at the rim active
sets are stable and pressures positive. The equations scale a contactor's own coefficient to one, so that its control gap is ``g_m -
(g_1 + g_2) / 4``; control forces belong to the Bernstein basis, and their sum is the resultant.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.equations import UnitingEquations
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.contact.nodes.node_to_surface import NodalKinematics, NodeToSurface
from uem_dolfinx.contact.seam.placement import Traits
from uem_dolfinx.contact.seam.pressure_map import Basis, PressureMap, Sums
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.projection import Projection, Target

#: Nodes on the same side of a target share a quadratic gap if it rises no steeper than this from one to the other.
#: [convention; slope; test_bernstein.py::test_pressed_on_an_arch]
STEEPEST = 0.2


@dataclass(frozen=True)
class Family:
    """Dependence of contactors in the middle of edges and facets on vertices and edge middles around them.

    Every term subtracts ``weight`` times the gap of a parent, a vertex or an edge's middle, from the gap of a child, a contactor in
    the middle of an edge or a facet. Parents may belong to other ranks; children are owned by this rank.
    """

    config: Configuration  # configuration of the displacement, of degree 2
    nodes: Indices  # owned contactor nodes ``(n,)``
    child: Ints  # index of the term's contactor ``(k,)``
    parent: Ints  # local node of the term's parent ``(k,)``
    weight: Array  # weight of each term ``(k,)``
    of_facet: Bools  # whether the child is the middle of a facet and the parent the middle of an edge ``(k,)``

    def control_gaps(self, projection: Projection, closing: Array, usable: Bools, share: Array) -> ControlGaps:
        """Terms for this projection, with gaps of ``usable (n,)`` contactors, above the target (collective).

        Args:
            projection: of the contactors.
            closing: derivatives of the nodes' gaps by their positions ``(n, gdim)``.
            usable: see above.
            share: gaps from the facets of a corner over the gap along its axis, 1 elsewhere ``(n,)``.
        """
        p, g, nn = projection, self.config.gdim, projection.nodes.shape[1]
        rows = np.column_stack([p.gap, usable, p.normal, p.nodes, p.weights, closing, share])
        seen = self.config.from_owners(self.nodes, rows, self.parent)
        gap, normal, i = seen[:, 0], seen[:, 2 : 2 + g], self.child
        length = np.linalg.norm(self.config.X[self.nodes[i]] - self.config.X[self.parent], axis=1)
        smooth = np.abs(gap - p.gap[i]) <= STEEPEST * length
        smooth &= np.einsum("kg,kg->k", normal, p.normal[i]) > 0.0
        smooth &= usable[i] & (seen[:, 1] > 0)
        alone = np.zeros(len(self.nodes), dtype=bool)
        alone[i[~smooth]] = True
        targets, weights, closing = np.split(seen[:, 2 + g : -1], [nn, 2 * nn], axis=1)
        weight = self.weight * seen[:, -1] / share[i]
        return ControlGaps(self, ~alone[i], weight, gap, normal, targets.astype(np.int64), weights, closing)

    def sums(self, terms: Bools, weight: Array | None = None) -> Sums:
        """Matrix of sums of weight times child at the parents, for some of the terms ``(k,)``; ``weight (k,)`` replaces their own."""
        found = self.weight if weight is None else weight
        return Sums(self.config, self.nodes, self.child[terms], self.parent[terms], found[terms])

    def basis(self, shared: Bools) -> Basis:
        """The Bernstein basis for terms ``shared (k,)`` with quadratic gaps; its scale is relative to the functions of scaled gaps."""
        scale = np.ones(len(self.nodes))
        scale[self.child[shared]] = 0.5
        scale[self.child[shared & self.of_facet]] = 0.25
        return Basis(scale, (self.sums(shared & ~self.of_facet), self.sums(shared & self.of_facet)))


@dataclass(frozen=True)
class ControlGaps:
    """The terms of a family at one displacement."""

    family: Family  # family of the terms
    shared: Bools  # whether the gap is quadratic between the child and all its parents ``(k,)``
    weight: Array  # weights of the terms, of gaps along the axes of corners ``(k,)``
    gap: Array  # of the parents ``(k,)``
    normal: Array  # of the parents ``(k, gdim)``
    targets: Ints  # global nodes that the parents follow ``(k, nn)``
    weights: Array  # their weights ``(k, nn)``
    closing: Array  # derivatives of the parents' gaps by their positions ``(k, gdim)``

    def of(self, gap: Array) -> Array:
        """Control gaps from nodal gaps ``(n,)``."""
        k, f = self.shared, self.family
        return gap - np.bincount(f.child[k], self.weight[k] * self.gap[k], minlength=len(gap))

    def forces(self, multipliers: Array, active: Bools) -> tuple[Array, Array]:
        """Control forces and nodal forces along the normals from the multipliers of the equations, each ``(n,)`` (collective)."""
        control = np.where(active, multipliers, 0.0)
        return self.basis.scale * control, control - self.sums.of(control)

    @property
    def sums(self) -> Sums:
        """Matrix of sums of weight times child at the parents."""
        return self.family.sums(self.shared, self.weight)

    @cached_property
    def basis(self) -> Basis:
        """Basis of the control forces."""
        return self.family.basis(self.shared)

    def extend(self, equations: UnitingEquations, normal: Array) -> UnitingEquations:
        """Add the terms of the parents, along ``normal (k, gdim)``, to the equations of all contactors."""
        f, k = self.family, np.flatnonzero(self.shared)
        own = self.weight[k, None] * normal[k]
        a, b = np.nonzero(self.targets[k] >= 0)
        row = f.child[k]
        return replace(
            equations,
            row=np.concatenate([equations.row, row, row[a]]),
            followed=np.concatenate([equations.followed, f.config.to_global(f.parent[k]), self.targets[k][a, b]]),
            coefficients=np.concatenate([equations.coefficients, own, -self.weights[k][a, b][:, None] * own[a]]),
        )


class Bernstein(NodeToSurface):
    """Implements ``Discretisation`` for contactors of degree 2; arguments as for ``NodeToSurface``."""

    #: A contactor in the middle of an edge or a facet follows contactors around it.
    traits = Traits(at_feet=True, pointwise=False, chained=True, two_pass=True)

    def __init__(self, config: Configuration, nodes: Indices, target: Target, **how: Any):
        super().__init__(config, nodes, target, **how)
        self.family = Family(config, nodes, *_family(config, nodes))

    def spread(self, values: Array) -> Array:
        """Integrals with the Bernstein basis (collective)."""
        return self.family.basis(np.ones(len(self.family.child), bool)).of(values)

    def measured(self, kinematics: NodalKinematics, state: PairState) -> ControlKinematics:
        """The kinematics with control gaps (collective)."""
        k, gap = kinematics, kinematics.projection.gap
        # in a corner a law of gaps acts along its axis, where the gaps from all its facets are equal
        usable, share = ~k.ends.past(state), np.ones(len(gap))
        if state.law_gap is None:
            usable &= ~state.in_corner
        elif k.corners is not None:
            share[k.corners.which] = 1.0 / np.linalg.norm(k.corners.summing, axis=1)
        control = self.family.control_gaps(k.projection, k.closing, usable, share)
        plain = (k.of, k.points, k.projection, k.nearest, control.of(gap), k.corners, k.target_moves, k.out)
        return ControlKinematics(*plain, control=control)


@dataclass(frozen=True)
class ControlKinematics(NodalKinematics):
    """``NodalKinematics`` with control gaps."""

    control: ControlGaps = field(kw_only=True)  # terms of the control gaps

    def weights(self) -> tuple[Ints, Ints, Array]:
        """Weights at the closest points, and of the terms of control gaps."""
        row, followed, weight = super().weights()
        c = self.control
        f, k = c.family, np.flatnonzero(c.shared)
        t, a = np.nonzero(c.targets[k] >= 0)
        return (
            np.concatenate([row, f.child[k], f.child[k][t]]),
            np.concatenate([followed, f.config.to_global(f.parent[k]), c.targets[k][t, a]]),
            np.concatenate([weight, c.weight[k], -c.weight[k][t] * c.weights[k][t, a]]),
        )

    @property
    def _share(self) -> Array:
        """Bernstein basis functions over the functions of the scaled gaps."""
        return np.asarray(self.control.basis.scale)

    def _normal_rows(self, normal: Array, weights: Array) -> UnitingEquations:
        c = self.control
        return c.extend(super()._normal_rows(normal, weights), c.normal if normal is self.projection.normal else c.closing)

    def _nodal(self, state: PairState, multipliers: Array) -> tuple[Array, Array]:
        return self.control.forces(multipliers, state.active)

    def _nodal_friction(self, tau: Array) -> Array:
        """Friction at the nodes from friction at the control points, without reactions on targets that are contactors (collective)."""
        sums = self.control.sums
        return np.column_stack([along - sums.of(along) for along in tau.T])

    def pressure_map(self, current: bool) -> PressureMap:
        """Map of control forces, which are integrals with the Bernstein basis."""
        return PressureMap(self.cone * self._share, self.control.basis)


def _family(config: Configuration, nodes: Indices) -> tuple[Ints, Ints, Array, Bools]:
    """Indices of the children, local nodes of the parents, weights, and ``of_facet``, ``(k,)`` each."""
    place = np.full(config.n_local, -1, dtype=np.int64)
    place[nodes] = np.arange(len(nodes))
    layout = config.V.dofmap.dof_layout
    cells = compat.cell_dofs(config.V)
    topology = forms.reference_topology(compat.cell_name(config.mesh))
    vertex = [layout.entity_dofs(0, v)[0] for v in range(len(topology[0]))]
    edge = [layout.entity_dofs(1, e)[0] for e in range(len(topology[1]))]
    relations = [(edge[e], [vertex[v] for v in ends], [0.25, 0.25], [False] * 2) for e, ends in enumerate(topology[1])]
    if config.tdim == 3:
        for f, corners in enumerate(topology[2]):
            if not len(layout.entity_dofs(2, f)):
                continue
            sides = [e for e, ends in enumerate(topology[1]) if set(ends) <= set(corners)]
            parents = [edge[e] for e in sides] + [vertex[v] for v in corners]
            relations.append((layout.entity_dofs(2, f)[0], parents, [0.25] * 4 + [-0.0625] * 4, [True] * 4 + [False] * 4))
    children, parents_of, weights, of_facet = [], [], [], []
    for middle, parents, w, to_edge in relations:
        at = place[cells[:, middle]]
        # a middle node belongs to several cells with the same parents
        first, row = np.unique(at, return_index=True)
        row = row[first >= 0]
        children.append(np.repeat(at[row], len(parents)))
        parents_of.append(cells[row][:, parents].ravel())
        weights.append(np.tile(w, len(row)))
        of_facet.append(np.tile(to_edge, len(row)))
    child, parent = np.concatenate(children), np.concatenate(parents_of).astype(np.int64)
    _, once = np.unique(np.column_stack([child, parent]), axis=0, return_index=True)
    return child[once], parent[once], np.concatenate(weights)[once], np.concatenate(of_facet)[once]
