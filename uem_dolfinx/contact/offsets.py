"""Offsets of gaps: additional thickness of surfaces, and initial gaps that are treated as closed."""

from __future__ import annotations

from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.laws.law import Field, evaluated_at
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.contact.pair.interface import Interface


class Offsets:
    """Heights minus gaps at the contactors of one interface.

    Args:
        name: of its contact, for messages.

    Attributes:
        pair: the present interface.
        declared: offsets of the user ``(n,)``.
        adjusted: initial heights of contactors that are treated as touching ``(n,)``.
        worn: wear depths ``(n,)``.
    """

    def __init__(self, pair: Interface, name: str):
        self.pair, self._name = pair, name
        self.declared: Array = np.zeros(len(pair.nodes))
        self.adjusted: Array = np.zeros(len(pair.nodes))
        self.worn: Array = np.zeros(len(pair.nodes))

    def set(self, offset: Field) -> None:
        """Set an offset, in addition to adjusted and worn lengths; contactors must be placed again (collective)."""
        config, nodes, words = self.pair.config, self.pair.nodes, f"contact '{self._name}': offset"
        self.declared = (
            evaluated_at(config, nodes, words, offset, given.FINITE) if callable(offset) else np.full(len(nodes), offset)
        )
        self._hand_over()

    def read_again(self, offset: fem.Function) -> bool:
        """Whether its values have changed since they were set (collective)."""
        pair = self.pair
        now = evaluated_at(pair.config, pair.nodes, f"contact '{self._name}': offset", offset, given.FINITE)
        return reduced(pair.config.comm, not np.array_equal(now, self.declared), op=MPI.LOR)

    def wear(self, worn: Array) -> None:
        """Set wear depths ``(n,)``; contactors must be placed again (collective)."""
        self.worn = worn
        self._hand_over()

    def _hand_over(self) -> None:
        total = self.declared + self.adjusted - self.worn
        some = reduced(self.pair.config.comm, bool(total.any()), op=MPI.LOR)
        self.pair.set_offset(total if some else None)

    def adjust(self, reach: float | bool) -> None:
        """Treat contactors with an initial gap or penetration of at most ``reach`` as touching (collective).

        Args:
            reach: a length; True is a side of a target's facet, or on a rigid surface the bound on the initial penetration.
        """
        pair = self.pair
        if not hasattr(pair, "kinematics"):  # contacts that are treated together are placed together
            pair.project()
        p, height, before = pair.kinematics.projection, pair.kinematics.heights(), np.inf
        most = np.where(np.isfinite(p.facet_size), p.facet_size, pair.max_penetration) if reach is True else reach
        near = (np.abs(height) <= most) & ~pair.off
        # weights of mortar change with what is open
        while 0.0 < (change := self._change(now := np.where(near, height, 0.0))) < before:
            self.adjusted, before = now, change
            self._hand_over()
            pair.project()
            height = pair.kinematics.heights()

    def _change(self, adjusted: Array) -> float:
        """Largest difference of lengths ``(n,)`` from those that are adjusted now (collective)."""
        return float(reduced(self.pair.config.comm, float(np.abs(adjusted - self.adjusted).max(initial=0.0)), op=MPI.MAX))
