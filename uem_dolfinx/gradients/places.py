"""The shape as a control: changes of the positions of a mesh's nodes, in the nodes of a displacement of the same or a higher degree.

Cells of a lower degree than the displacement move the displacement's further nodes by their shape functions, ``V = N W``; derivatives by
the mesh's nodes are ``N'`` times those by the displacement's.
"""

from __future__ import annotations

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat, forms
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.gradients.derivatives import values_in


class Places:
    """Positions of the nodes of a mesh with a displacement.

    Args:
        config: of the displacement.

    Attributes:
        V: space of the displacement.
        W: space of vectors at the nodes of the mesh; V if they are the same.
    """

    def __init__(self, config: Configuration):
        mesh, self.V = config.mesh, config.V
        corners = len(forms.reference_topology(compat.cell_name(mesh))[0])
        own = compat.geometry_dofs(mesh).shape[1]
        self._degree, self.lower = config.degree, own < compat.cell_dofs(self.V).shape[1]
        #: Whether a change of the mesh's nodes can be a Function of V.
        self.known = own == compat.cell_dofs(self.V).shape[1] or (self.lower and own == corners)
        self.W = compat.function_space(mesh, 1, (config.gdim,)) if self.lower and self.known else self.V

    def at_nodes(self, change: fem.Function) -> fem.Function:
        """A change in W as a Function of V (collective)."""
        found = fem.Function(self.V)
        if self.lower:
            found.interpolate(change)
            found.x.scatter_forward()
        else:
            found.x.array[:] = values_in(self.V, change)
        return found

    def back(self, by: fem.Function) -> fem.Function:
        """Derivative by the nodes of the mesh, a Function of W, from the derivative by those of V (collective)."""
        if not self.lower:
            return by
        g, cell_type, found = self.V.dofmap.index_map_bs, compat.cell_name(self.V.mesh), fem.Function(self.W)
        points = forms.create_lagrange_element(cell_type, self._degree).points
        N = forms.create_lagrange_element(cell_type, 1).tabulate(0, points)[0, :, :, 0]
        nodes, corners = compat.cell_dofs(self.V), compat.cell_dofs(self.W)
        # each node of V in one cell, on its owner
        node, first = np.unique(nodes.ravel(), return_index=True)
        first = first[node < self.V.dofmap.index_map.size_local]
        cell, i = first // nodes.shape[1], first % nodes.shape[1]
        shares = N[i][:, :, None] * by.x.array.reshape(-1, g)[nodes[cell, i]][:, None]
        np.add.at(found.x.array.reshape(-1, g), corners[cell], shares)
        forms.sum_ghosts(found)
        return found
