"""Densities on a contactor's surface whose integrals equal sums over contactors."""

from __future__ import annotations

import numpy as np

from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.contact.mortar.duals import basis_of
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import facets_of
from uem_dolfinx.geometry.tags import Tag


def density(config: Configuration, tag: Tag, nodes: Indices, amounts: Array, areas: Array) -> Array:
    """Values at the owned nodes ``(n_owned,)`` of a field of shape functions whose integral is the sum of the amounts (collective).

    Of degree 2 it is the combination of Bernstein's functions, which are nowhere negative, each with its amount over its integral.

    Args:
        config: configuration of the displacement.
        tag: facets of the contactor.
        nodes: owned contactor nodes ``(n,)``.
        amounts: at these ``(n,)``, which belong to shape functions, at degree 2 to Bernstein's functions.
        areas: integrals of these functions ``(n,)``.
    """
    whole, own = np.zeros((2, config.n_owned))
    whole[nodes], own[nodes] = amounts, areas
    if config.degree == 1:
        return _over(whole, own)
    surface, every = facets_of(config, tag, "contactor"), np.arange(config.n_owned)
    dofs, to_nodes = surface.dofs.ravel(), np.linalg.inv(basis_of(surface.shape).T)
    coefficients = config.from_owners(every, _over(whole, own)[:, None], dofs).reshape(surface.dofs.shape)
    values, count = (
        config.to_owners(dofs, part.ravel())[: config.n_owned]
        for part in (coefficients @ to_nodes.T, np.ones(surface.dofs.shape))
    )
    return _over(values, count)


def _over(values: Array, by: Array) -> Array:
    """Quotients, zero where there is nothing to divide by."""
    return np.where(by > 0, values / np.where(by > 0, by, 1.0), 0.0)
