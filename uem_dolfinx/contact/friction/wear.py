"""Wear of contactors by Archard's law: depth removed by slip under pressure in a step, which increases gaps."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.contact.laws.law import Field, evaluated_at
from uem_dolfinx.contact.mortar.duals import basis_of
from uem_dolfinx.contact.seam.state import PairState
from uem_dolfinx.errors import InputError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.surfaces import Areas
from uem_dolfinx.geometry.tags import Tag
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced

#: A step wears too much where its depth, times the contactor's stiffness, is more than this times its contact force. The force then
#: overshoots in the next step, and neighbours alternate in carrying it (explicit Euler's bound).
#: [derived; force along the normal; test_wear.py::test_steps_that_wear_too_much]
MOST_WORN = 2.0


class Wear:
    """Wear of the contactors of one interface by Archard's law.

    Each contact force removes a volume at its contactor. The depth, a combination of the shape functions, has these volumes as its
    integrals with the basis of the forces: shape functions, or the Bernstein basis at degree 2.

    Args:
        nodes: owned contactor nodes ``(n,)``.
        k: coefficient of wear over hardness.
        tag: the contactor.
        areas: areas of its nodes.
        lower: function that increases gaps by depths ``(n,)``; contactors must be placed again afterwards.
        name: of the contact, for messages.

    Raises:
        InputError, UserFunctionError: if contactors are points, or if a function of position is invalid.
    """

    def __init__(
        self,
        config: Configuration,
        nodes: Indices,
        k: Field,
        *,
        tag: Tag,
        areas: Areas,
        lower: Callable[[Array], None],
        name: str,
    ):
        words = f"contact '{name}': wear"
        if tag.dim == 0:
            raise InputError(f"{words} needs areas, and points have none: give facets")
        given.kind(words, k, not isinstance(k, fem.Function), "a number or a function of position")
        self._config, self._nodes, self._lower, self._name, self._warned = config, nodes, lower, name, False
        #: coefficient at the contactors ``(n,)``.
        self.k = evaluated_at(config, nodes, words, k, given.NOT_NEGATIVE) if callable(k) else np.full(len(nodes), k)
        surface = TargetFacets(config, tag, "contactor")
        #: Integrals of the shape functions at the contactors ``(n,)``.
        self._areas: Array = areas.reference[nodes]
        self._dofs, self._to_nodes = surface.dofs, np.linalg.inv(basis_of(surface.shape).T)
        self._count = config.to_owners(self._dofs.ravel(), np.ones(self._dofs.size))[nodes]
        own = self._at_facets(self._areas / self._count) @ self._to_nodes
        self._integrals = config.to_owners(self._dofs.ravel(), own.ravel())[nodes]

    def _at_facets(self, values: Array) -> Array:
        """Values of contactors ``(n,)`` at the nodes of this rank's facets ``(m, nn)`` (collective)."""
        return self._config.from_owners(self._nodes, values[:, None], self._dofs.ravel()).reshape(self._dofs.shape)

    def depths(self, start: Array, end: Array) -> Array:
        """Wear depths of a step at nodes ``(n,)``; arguments as for ``worn_volume`` (collective)."""
        volume = worn_volume(self.k, start, end)
        nodal = self._at_facets(volume / self._integrals) @ self._to_nodes.T
        return np.asarray(self._config.to_owners(self._dofs.ravel(), nodal.ravel())[self._nodes] / self._count)

    def apply(self, worn: Array) -> None:
        """Increase gaps by depths ``(n,)``; contactors must be placed again (collective)."""
        self._lower(worn)

    def volume(self, state: PairState) -> float:
        """Worn volume of a state over all ranks (collective)."""
        assert state.friction is not None
        return float(reduced(self._config.comm, float(self._areas @ state.friction.worn)))

    def look_at_step(self, before: PairState, now: PairState, normal: Array, stiffness: Array) -> None:
        """Warn, once, if the wear depth of a step exceeds the elastic recovery of contactors (collective)."""
        if self._warned:
            return
        assert before.friction is not None and now.friction is not None
        force = (now.friction.worn - before.friction.worn) * np.einsum("ng,ng->n", stiffness[self._nodes], normal**2)
        fast = now.active & (force > MOST_WORN * np.maximum(now.lam, 0.0))
        count = int(reduced(self._config.comm, int(fast.sum())))
        if count:
            self._warned = True
            logger.warning(
                "%s: %d contactors wear by more in a step than they spring back under their force, so that they and their neighbours may "
                "take turns in bearing: let contactors slip by less in a step",
                self._name,
                count,
            )


def worn_volume(k: Array, start: Array, end: Array) -> Array:
    """Worn volume ``(n,)``: k times the mean of normal force times slip, an energy, at the start and at the end; tension causes none."""
    return np.asarray(0.5 * k * (np.maximum(start, 0.0) + np.maximum(end, 0.0)))
