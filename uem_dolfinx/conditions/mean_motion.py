"""A prescribed mean displacement of a part of the mesh that stays free to deform, as one linear equation."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import ufl

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Array
from uem_dolfinx.conditions.equation import GivenRows, Value, checked_value
from uem_dolfinx.conditions.places import nodes_at
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.tags import Part, as_tag
from uem_dolfinx.parallel import agreed


class MeanMotion(given.Sealed):
    """The mean of a displacement component over a part: ``integral of inner(c, u) / integral of 1 = b``.

        uem.MeanMotion(tags["top"], (0, 1), b=-0.01)                    # the top is lowered by 0.01 in the mean, and stays free to bend

    Pass it to ``UnitedProblem(..., equations=[...])``, which eliminates one component of one node. The part carries the force evenly, as
    under a uniform traction along c. Several means of one part, as of its components, are several equations.

    Args:
        part: facets or cells, over which the mean is an integral, or points, over which it is a sum.
        c: direction of the component, a vector ``(gdim,)`` of any length.
        b: a number, a ``fem.Constant`` or a function of the load factor or time, ramped as ``b`` of ``Equation``.

    Raises:
        InputError, InputTypeError: for a vector or values of another form. When the problem is made also a TagError for an invalid part,
            and a ConflictError if conditions hold all of its nodes.
    """

    firm = True

    def __init__(self, part: Part, c: npt.ArrayLike, b: Value = 0.0):
        self._part, self._c = part, given.vector("c", c)
        self.b = checked_value("b", b, 1)

    @property
    def places(self) -> list[Any]:
        """Its part."""
        return [self._part]

    def n_values(self, block: int) -> int:
        """See ``LinearEquations``."""
        return 1

    def rows(self, config: Configuration, role: str) -> GivenRows:
        """See ``LinearEquations``; all terms are on the first rank, which has one row (collective)."""
        with agreed(config.comm):
            c = given.vector(f"c of {role}", self._c, config.block)
        nodes = nodes_at(config, self._part, f"the part of {role}")
        weights = self._weights(config, role)[nodes]
        own = np.flatnonzero(weights != 0.0)
        every = config.comm.gather((config.to_global(nodes[own]), weights[own]), root=0)
        none = np.zeros(0, dtype=np.int64)
        node, weight = (np.concatenate(parts) for parts in zip(*every)) if every else (none, np.zeros(0))
        # the node of the largest weight is named in messages, and is eliminated if it is free
        order = np.argsort(-np.abs(weight), kind="stable")
        coefficients = (weight[order] / (weight.sum() or 1.0))[:, None] * c
        return GivenRows(np.zeros(min(len(node), 1), np.int64), np.zeros(len(node), np.int64), node[order], coefficients)

    def _weights(self, config: Configuration, role: str) -> Array:
        """Weights of all owned nodes in the mean, not divided by their sum ``(n_owned,)`` (collective)."""
        tdim = config.tdim
        tag = as_tag(self._part, config.mesh, (tdim - 1, *range(tdim + 1)), f"the part of {role}")
        if tag.dim < tdim - 1:
            return np.ones(config.n_owned)
        measure = (forms.surface_measure if tag.dim == tdim - 1 else forms.cell_measure)(config.mesh, tag.entities, {})
        V = compat.function_space(config.mesh, config.degree)
        found = forms.assemble_array(V, forms.form(revolved(ufl.TestFunction(V) * measure)))
        return np.asarray(found[: config.n_owned])
