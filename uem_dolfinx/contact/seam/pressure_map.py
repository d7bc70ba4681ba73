"""Linear maps between multipliers and pressures of contactors, made by a discretisation for each placement."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from uem_dolfinx.arrays import Array, Bools, Indices, Ints
from uem_dolfinx.geometry.configuration import Configuration


class Sums(NamedTuple):
    """A sparse matrix S over the contactors of all ranks."""

    config: Configuration
    nodes: Indices  # owned contactors ``(n,)``
    column: Ints  # index of the contactor of each entry ``(k,)``
    row: Ints  # local node of each entry ``(k,)``
    entry: Array  # value of each entry ``(k,)``

    def of(self, values: Array) -> Array:
        """``S values`` ``(n,)`` (collective)."""
        return self.config.to_owners(self.row, self.entry * values[self.column])[self.nodes]

    def back(self, weights: Array) -> Array:
        """``S' weights`` ``(n,)`` (collective)."""
        at_row = self.config.from_owners(self.nodes, weights[:, None], self.row)[:, 0]
        return np.asarray(np.bincount(self.column, self.entry * at_row, minlength=len(self.nodes)), dtype=float)


class Basis(NamedTuple):
    """Integrals with the basis of the forces, from integrals with the shape functions: ``B = W (I + S_1) ... (I + S_m)``."""

    scale: Array | float = 1.0  # the diagonal of W ``(n,)``
    sums: tuple[Sums, ...] = ()  # ``S_1 ... S_m``

    def of(self, integrals: Array) -> Array:
        """``B integrals`` ``(n,)`` (collective)."""
        for one in reversed(self.sums):
            integrals = integrals + one.of(integrals)
        return self.scale * integrals

    def back(self, weights: Array) -> Array:
        """``B' weights`` ``(n,)`` (collective)."""
        weights = self.scale * weights
        for one in self.sums:
            weights = weights + one.back(weights)
        return weights


@dataclass(frozen=True)
class Stretch:
    """Factor of pressures: a power of nodal sums of facet shares over the same sums in the reference configuration."""

    config: Configuration
    nodes: Indices  # owned contactors ``(n,)``
    dofs: Indices  # local nodes of the facets ``(m, nn)``
    #: function of node positions ``(m, nn, gdim)`` that returns shares ``(m, nn)`` and derivatives ``(m, nn, nn, gdim)``.
    shares: Callable[[Array], tuple[Array, Array]]
    power: Array  # exponents ``(n,)``

    @cached_property
    def _parts(self) -> list[tuple[Array, Array]]:
        """Derivatives of shares, and exponents over their sums ``(n,)``: current and reference (first time: collective)."""
        parts = []
        for x, sign in ((self.config.x, 1.0), (self.config.X, -1.0)):
            shares, slopes = self.shares(x[self.dofs])
            whole = self.config.to_owners(self.dofs.ravel(), shares.ravel())[self.nodes]
            parts.append((slopes, sign * self.power / np.where(self.power != 0.0, whole, 1.0)))
        return parts

    def along(self, now: Array, drawn: Array) -> Array:
        """Relative changes ``(n,)`` for changes of current and of reference positions ``(n_local, gdim)`` (collective)."""
        found = np.zeros(len(self.power))
        for (slopes, over), moved in zip(self._parts, (now, drawn)):
            change = np.einsum("mbag,mag->mb", slopes, moved[self.dofs])
            found += over * self.config.to_owners(self.dofs.ravel(), change.ravel())[self.nodes]
        return found

    def back(self, weights: Array) -> list[Array]:
        """Transpose of :meth:`along` for weights ``(n,)``: two arrays over the owned nodes ``(n_owned, gdim)`` (collective)."""
        config, dofs, found = self.config, self.dofs, []
        for slopes, over in self._parts:
            at = config.from_owners(self.nodes, (over * weights)[:, None], dofs.ravel()).reshape(dofs.shape)
            values = np.einsum("mb,mbag->mag", at, slopes)
            found.append(config.add_at_owners(config.to_global(dofs.ravel()), values.reshape(-1, config.gdim)))
        return found


class PressureMap(NamedTuple):
    """Pressures ``p = F mu / A``: multipliers mu of normal equations correspond to forces ``lam = F mu`` on areas A.

    Areas are ``A = B a`` with integrals a of the shape functions over the contactor, except where they are known.
    """

    force: Array  # the diagonal of F ``(n,)``; not valid in corners, where several rows contribute to a force
    basis: Basis = Basis()  # B
    known: Bools | bool = False  # contactors with known areas ``(n,)``
    area: Array | float = 0.0  # these areas ``(n,)``
    stretch: Stretch | None = None  # further dependence of pressures on positions at constant multipliers and areas; None without

    def areas(self, integrals: Array) -> Array:
        """Areas A from ``integrals (n,)`` of the shape functions (collective)."""
        return self.basis.of(self.of_means(integrals))

    def of_means(self, integrals: Array) -> Array:
        """Areas of means at the contactors' nodes ``(n,)``: A without B."""
        return np.where(self.known, self.area, integrals)

    def along(self, integrals: Array) -> Array:
        """Changes of A for changes of ``integrals (n,)`` (collective)."""
        return self.basis.of(np.where(self.known, 0.0, integrals))

    def back(self, weights: Array) -> Array:
        """Transpose of :meth:`along` for ``weights (n,)`` (collective)."""
        return np.where(self.known, 0.0, self.basis.back(weights))
