"""Control gaps: what takes the place of nodal gaps on contactors of degree 2.

A part of the fourth step on the data's way. A quadratic facet's shape functions are partly negative, so that under a pressure its
nodal forces are zero or negative at vertices, and tell nothing about contact. In Bernstein's basis, which is positive, the same
gap has the coefficients

    g_v at a vertex,    2 g_m - (g_1 + g_2) / 2 in the middle of an edge,    and likewise in the middle of a quadrilateral,

and its forces are integrals of the pressure with positive weights. So contact is decided by these control gaps and control
forces: ``control gap >= 0, control force >= 0``, one of them zero. Where all nodes of a facet are active this unites the same
nodes as nodal gaps do; at the rim it keeps active sets stable and pressures positive. The equations scale a contactor's own
coefficient to one, so that its control gap is ``g_m - (g_1 + g_2) / 4``; the control forces are those of Bernstein's basis, and
add up to the resultant.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from uem_dolfinx import compat, forms

if TYPE_CHECKING:
    from uem_dolfinx.algebra.equations import UnitingEquations
    from uem_dolfinx.geometry.configuration import Configuration
    from uem_dolfinx.geometry.projection import Projection

Array = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

#: Nodes share a quadratic gap if their normals agree up to this cosine ...
SAME_SIDE = 0.9
#: ... and if the gap rises no steeper than this from one to the other.
STEEPEST = 0.2


class ControlGaps:
    """Control gaps of the contactors of a degree-2 surface.

    Every term subtracts ``weight`` times the gap of a parent, a vertex or an edge's middle, from the gap of a contactor in the
    middle of an edge or a facet. Parents may live on other ranks; children are always this rank's own.

    Args:
        config: configuration of the displacement, of degree 2.
        nodes: owned contactor nodes ``(n,)``.

    Attributes:
        child: place of the term's contactor ``(k,)``.
        parent: local node of the term's parent ``(k,)``.
        weight: ``(k,)``.
        shared: whether the gap is quadratic from the child to all its parents ``(k,)``.
        closed: terms whose parent's own equation makes its gap vanish ``(k,)``.
        normal: of the parents ``(k, gdim)``.
        targets: global nodes that the parents follow ``(k, nn)``.
        weights: their weights ``(k, nn)``.
    """

    def __init__(self, config: Configuration, nodes: npt.NDArray[np.int32]):
        self.config, self.nodes = config, nodes
        children, parents, weights, of_facet = _family(config, nodes)
        self.child, self.parent, self.weight = children, parents, weights
        self._of_facet = of_facet
        #: Whether a contactor in the middle of a facet follows one in the middle of an edge, on any rank.
        self.chained = bool(config.comm.allreduce(int(of_facet.sum())))
        self.shared: Bools = np.zeros(len(children), dtype=bool)
        self.closed: Bools = np.zeros(len(children), dtype=bool)
        self._gap: Array = np.zeros(len(children))
        self.normal: Array = np.zeros((len(children), config.gdim))
        self.targets: Ints = np.zeros((len(children), 0), np.int64)
        self.weights: Array = np.zeros((len(children), 0))

    def look(self, projection: Projection, usable: Bools) -> None:
        """Take in where contactors and their parents are (collective).

        Args:
            projection: of the contactors.
            usable: whose gap counts: those over the target that no corner holds ``(n,)``.
        """
        p, g, nn = projection, self.config.gdim, projection.nodes.shape[1]
        rows = np.column_stack([p.gap, usable, p.normal, p.nodes, p.weights])
        seen = self.config.from_owners(self.nodes, rows, self.parent)
        self._gap, self.normal = seen[:, 0], seen[:, 2 : 2 + g]
        self.targets, self.weights = seen[:, 2 + g : 2 + g + nn].astype(np.int64), seen[:, 2 + g + nn :]
        i = self.child
        length = np.linalg.norm(self.config.X[self.nodes[i]] - self.config.X[self.parent], axis=1)
        smooth = np.abs(self._gap - p.gap[i]) <= STEEPEST * length
        smooth &= np.einsum("kg,kg->k", self.normal, p.normal[i]) > SAME_SIDE
        smooth &= usable[i] & (seen[:, 1] > 0)
        alone = np.zeros(len(self.nodes), dtype=bool)
        alone[i[~smooth]] = True
        self.shared = ~alone[i]

    def follow(self, active: Bools) -> None:
        """Take in who is active ``(n,)`` (collective)."""
        at_parent = self.config.from_owners(self.nodes, active[:, None].astype(float), self.parent)[:, 0] > 0
        open_child = np.zeros(len(self.nodes), dtype=bool)
        open_child[self.child[self.shared & ~at_parent]] = True
        closes = active & ~open_child
        self.closed = self.config.from_owners(self.nodes, closes[:, None].astype(float), self.parent)[:, 0] > 0

    @property
    def kept(self) -> Bools:
        """Terms that matter, because the parent stays open ``(k,)``."""
        return self.shared & ~self.closed

    def gaps(self, gap: Array) -> Array:
        """Control gaps from nodal gaps ``(n,)``."""
        k = self.kept
        return gap - np.bincount(self.child[k], self.weight[k] * self._gap[k], minlength=len(gap))

    def forces(self, multipliers: Array, active: Bools) -> tuple[Array, Array]:
        """Control forces and nodal forces along the normals from the multipliers of the equations, each ``(n,)`` (collective)."""
        control = np.where(active, multipliers, 0.0)
        dropped = self.shared & self.closed
        # the middle of a facet hands on to edges, then both to vertices
        control = control + active * self._handed_on(control, dropped & self._of_facet)
        control = control + active * self._handed_on(control, dropped & ~self._of_facet)
        nodal = control - self._handed_on(control, self.shared)
        return self._scale * control, nodal

    @property
    def _scale(self) -> Array:
        """Bernstein's basis functions over those that belong to the scaled gaps ``(n,)``."""
        scale = np.ones(len(self.nodes))
        scale[self.child[self.shared]] = 0.5
        scale[self.child[self.shared & self._of_facet]] = 0.25
        return scale

    def extend(self, equations: UnitingEquations, united: Ints, active: Bools) -> UnitingEquations:
        """Add the terms of the parents whose gaps stay open.

        Args:
            equations: of some contactors.
            united: their places ``(m,)``.
            active: who is united ``(n,)``.
        """
        place = np.full(len(self.nodes), -1, dtype=np.int64)
        place[united] = np.arange(len(united))
        k = np.flatnonzero(self.kept & active[self.child])
        own = self.weight[k, None] * self.normal[k]
        a, b = np.nonzero(self.targets[k] >= 0)
        row = place[self.child[k]]
        return replace(
            equations,
            row=np.concatenate([equations.row, row, row[a]]),
            followed=np.concatenate([equations.followed, self.config.to_global(self.parent[k]), self.targets[k][a, b]]),
            coefficients=np.concatenate([equations.coefficients, own, -self.weights[k][a, b][:, None] * own[a]]),
        )

    def areas(self, areas: Array) -> Array:
        """What the control forces are integrals over, from the integrals of the shape functions ``(n,)`` (collective)."""
        areas = areas + self._handed_on(areas, self.shared & self._of_facet)
        return self._scale * (areas + self._handed_on(areas, self.shared & ~self._of_facet))

    def _handed_on(self, values: Array, terms: Bools) -> Array:
        """Sum over the children of each contactor of weight times value ``(n,)`` (collective)."""
        amounts = np.where(terms, self.weight * values[self.child], 0.0)
        return self.config.to_owners(self.parent, amounts)[self.nodes]


def _family(config: Configuration, nodes: npt.NDArray[np.int32]) -> tuple[Ints, Ints, Array, Bools]:
    """Places of the children, local nodes of the parents, weights, and whether a term leads from facet to edge, ``(k,)`` each."""
    place = np.full(config.n_local, -1, dtype=np.int64)
    place[nodes] = np.arange(len(nodes))
    layout = config.V.dofmap.dof_layout
    # also where a rank has no cell at all
    cells = compat.cell_dofs(config.V).reshape(-1, layout.num_dofs)
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
        # a middle lies in several cells, all of which know its parents
        first, row = np.unique(at, return_index=True)
        row = row[first >= 0]
        children.append(np.repeat(at[row], len(parents)))
        parents_of.append(cells[row][:, parents].ravel())
        weights.append(np.tile(w, len(row)))
        of_facet.append(np.tile(to_edge, len(row)))
    child, parent = np.concatenate(children), np.concatenate(parents_of).astype(np.int64)
    _, once = np.unique(np.column_stack([child, parent]), axis=0, return_index=True)
    return child[once], parent[once], np.concatenate(weights)[once], np.concatenate(of_facet)[once]
