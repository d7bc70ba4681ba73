"""A scalar field of a mixed space at the nodes of the displacement, possibly of lower degree."""

from __future__ import annotations

from typing import Any

import numpy as np

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.errors import InputError, SpaceError
from uem_dolfinx.geometry.fields import ConfigurationAmongFields


class NodalField:
    """Values of a field at nodes, interpolated from the unknowns of one cell with its shape functions.

    Args:
        config: displacement among other fields.
        part: number of the field in the mixed space.
        what: user of the field, for messages.

    Attributes:
        unknowns: local unknowns of the mixed space for the value at each local node ``(n_local, k)``.
        weights: weights of these unknowns ``(n_local, k)``.

    Raises:
        InputError, SpaceError: if the space has no such part, or if it is not a scalar Lagrange field of at most the displacement's
            degree.
    """

    def __init__(self, config: ConfigurationAmongFields, part: int, what: str):
        self.config, self.part = config, part
        W = config.whole.function_space
        degree = _degree(config, part, what)
        cell = compat.cell_name(config.mesh)
        points = forms.create_lagrange_element(cell, config.degree).points
        # values are multiples of 1/8, for degree 1 at nodes of degree 2, or 1
        shape = np.rint(8.0 * forms.create_lagrange_element(cell, degree).tabulate(0, points)[0, :, :, 0]) / 8.0
        nodes, own = compat.cell_dofs(config.V), compat.part_dofs(W, part)
        # unknowns of the cell by their weight at each node, the largest first
        k = int((shape != 0).sum(axis=1).max())
        order = np.argsort(-np.abs(shape), axis=1, kind="stable")[:, :k]
        self.unknowns: Ints = np.zeros((config.n_local, k), dtype=np.int64)
        self.weights: Array = np.zeros((config.n_local, k))
        if len(nodes):
            self.unknowns[nodes] = own[:, order]
            self.weights[nodes] = np.take_along_axis(shape, order, axis=1)

    @property
    def values(self) -> Array:
        """Values at the owned nodes ``(n_owned,)``."""
        n = self.config.n_owned
        return np.asarray((self.weights[:n] * self.config.whole.x.array[self.unknowns[:n]]).sum(axis=1))

    def terms(self, nodes: Ints) -> Array:
        """Global vector components for the values at owned ``nodes (m,)``, followed by their weights ``(m, 2 k)``."""
        return np.column_stack([self.config.unknowns.numbers[self.unknowns[nodes]], self.weights[nodes]])

    def rows(self, nodal: Array) -> Array:
        """Nodal amounts ``nodal (n_owned,)`` as terms of the field's equations, in rows of vectors ``(n_rows * gdim,)`` (collective)."""
        from dolfinx import fem

        n, sent = self.config.n_owned, fem.Function(self.config.whole.function_space)
        np.add.at(sent.x.array, self.unknowns[:n].ravel(), (self.weights[:n] * nodal[:, None]).ravel())
        forms.sum_ghosts(sent)
        return np.asarray(self.config.rows(sent.x.array[: len(self.config.unknowns.place)]).ravel())


def nodal_field(config: ConfigurationAmongFields, part: int, what: str) -> NodalField:
    """The field of a part at nodes, made once; arguments and errors as for ``NodalField``."""
    if part not in config.nodal_fields:
        config.nodal_fields[part] = NodalField(config, part, what)
    found: NodalField = config.nodal_fields[part]
    return found


def _degree(config: Any, part: int, what: str) -> int:
    """Degree of the field, which must not exceed the displacement's degree."""
    W = config.whole.function_space
    others = [i for i in range(W.num_sub_spaces) if i != config.part]
    if part not in others:
        raise InputError(f"{what}: field = {part}: expected the number of a part other than the displacement, one of {others}")
    V = W.sub(part)
    degree = compat.lagrange_degree(V)
    if V.num_sub_spaces or degree is None or degree > config.degree:
        raise SpaceError(
            f"{what}: part {part} of the mixed space is no scalar Lagrange field of degree {config.degree} or less, whose "
            "values the contactors' nodes determine: give the field such an element, or the displacement a higher degree"
        )
    return degree
