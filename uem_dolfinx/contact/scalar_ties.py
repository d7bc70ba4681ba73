"""Ties of a scalar field, such as a temperature, between non-matching meshes: linear equations with the weights of displacement ties.

    u_i = sum_a w_a u_a        for every contactor i within reach of the target

The weights are those of ``tied_rows``: shape functions at the closest point, or means over segments by dual functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from typing import Any

import numpy as np
from dolfinx import fem

from uem_dolfinx import compat
from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.conditions.equation import GivenRows
from uem_dolfinx.conditions.independent_rows import sizes
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.errors import InputError, SpaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.nodes import Halo


def check_ties(gdim: int, contacts: Sequence[Any], **others: Any) -> None:
    """Refuse contacts of a scalar field other than ties of two meshes, and options for displacements.

    Args:
        gdim: dimension of the mesh.
        contacts: of the problem.
        others: other arguments by name; they must be None or empty.

    Raises:
        SpaceError, InputError: naming the first such argument.
    """
    others_than_ties = [one for one in contacts if getattr(one, "tied", False) is not True or hasattr(one.target, "project")]
    if others_than_ties:
        raise SpaceError(
            f"contact '{others_than_ties[0].name}': the displacement has 1 component(s) in {gdim}D: use a vector Lagrange space of size "
            f"{gdim}; the contacts of a scalar u, as a temperature, are ties of two meshes: give Contact(..., tied=True) with facets of "
            "a mesh as its target"
        )
    for contact in contacts:
        if contact.heats:
            raise InputError(f"contact '{contact.name}': a tie of temperatures conducts heat without resistance: leave heat out")
    for name, value in others.items():
        if value:
            raise InputError(f"{name} is for displacements, and u is a scalar field: leave it out")


class ScalarTie:
    """A tie as ``LinearEquations`` of the scalar field (collective).

    Args:
        config: nodes of the scalar field.
        contact: the tie, marked as part of the problem.
        free: nodes without Dirichlet condition ``(n_owned, 1)``.
    """

    firm = False
    b = 0.0

    def __init__(self, config: Configuration, contact: Contact, free: Bools):
        # surfaces and segments are made for a zero displacement, which has the same nodes in another numbering
        still = Configuration(fem.Function(compat.function_space(config.mesh, config.degree, (config.gdim,))))
        place = np.zeros(still.n_local, dtype=np.int64)
        place[compat.cell_dofs(still.V)] = compat.cell_dofs(config.V)
        number = config.to_global(place)
        movable = config.ask_owners(number[: still.n_owned], free.astype(float)) > 0
        alone = copy(contact)
        alone.take_pair(alone.attach(still, np.repeat(movable, config.gdim, axis=1)).alone())
        pair = alone.pair
        assert pair.tie is not None and pair.tie.rows is not None
        tie = pair.tie.rows
        contact.taken = True
        tied, (row, node, weight) = np.flatnonzero(tie.has[:, 0]), tie.terms
        equation = np.full(len(pair.nodes), -1)
        equation[tied] = np.arange(len(tied))
        kept = equation[row] >= 0
        own: Ints = number[pair.nodes[tied]]
        theirs: Ints = still.ask_owners(node[kept], number[: still.n_owned, None].astype(float))[:, 0].astype(np.int64)
        rows = np.concatenate([np.arange(len(tied)), equation[row[kept]]])
        order = np.argsort(rows, kind="stable")
        weights: Array = np.concatenate([np.ones(len(tied)), -weight[kept, 0]])
        found = GivenRows(np.zeros(len(tied), np.int64), rows[order], np.concatenate([own, theirs])[order], weights[order, None])
        # without an equation where conditions prescribe both sides, as interpolated values differ
        able = np.zeros(len(tied), dtype=bool)
        able[found.row[(sizes(config, found, free) > 0).any(axis=1)]] = True
        self._rows = found.select(able)
        followed = np.zeros(config.n_owned, dtype=bool)
        followed[Halo(config, theirs).needed] = True
        followed[Halo(config, own).needed] = False
        #: owned nodes of the target, eliminated only in equations without another node to eliminate.
        self.followed: Indices = np.flatnonzero(followed).astype(np.int32)

    def n_values(self, block: int) -> int:
        """See ``LinearEquations``."""
        return 1

    def rows(self, config: Configuration, role: str) -> GivenRows:
        """See ``LinearEquations``."""
        return self._rows
