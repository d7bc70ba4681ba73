"""Results of a contact with further parts, whose contactors are nodes at corners of the target, or edges that cross."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.results import ContactResults, Resultant
from uem_dolfinx.parallel import reduced


class OfBothSides(ContactResults):
    """Results of a contact and of its further parts; those of a further part itself are zero, so that sums over contacts are right."""

    is_further_part = False  #: Whether its results are those of another contact, of which it is a further part.
    swaps = False  #: Whether the contactors of a further part are nodes of the contact's target.
    #: Further parts: nodes at corners of the target with the contactor's facets, and crossings of edges.
    further: Sequence[Any] = ()

    @property
    def all_parts(self) -> list[Any]:
        """The contact, and its further parts."""
        return [self, *self.further]

    def take_further(self, parts: Sequence[Any]) -> None:
        """Take its further parts, which then decide about common nodes (collective)."""
        self.further = parts
        for part in parts:
            part.share()

    def further_parts_touch(self) -> bool:
        """Whether further parts have active contactors (collective)."""
        active = any(part.pair.trial.active.any() for part in self.further)
        return bool(self.further) and bool(reduced(self.config.comm, active, op=MPI.LOR))

    def _sum(self, what: str, together: Any, nothing: Any) -> Any:
        """A result of all parts (collective)."""
        if self.is_further_part:
            return nothing
        return together([getattr(ContactResults, what).__get__(part) for part in self.all_parts])

    @property
    def n_active(self) -> int:
        """Number of active contactors over all ranks, those of further parts among them (collective)."""
        return int(self._sum("n_active", sum, 0))

    @property
    def dissipation(self) -> float:
        """Frictional dissipation in all committed steps: slip times the mean friction of each step (collective)."""
        return float(self._sum("dissipation", sum, 0.0))

    @property
    def force(self) -> fem.Function:
        """Nodal contact forces as a vector field: on the contactors, and opposite on the nodes of a meshed target (collective)."""
        f = super().force
        if self.is_further_part:
            f.x.array[:] = 0.0
        for part in self.further:
            f.x.array[:] += part.all_forces()
        return f

    def all_forces(self) -> Array:
        """Nodal forces of a further part on both bodies ``(n_local gdim,)`` (collective)."""
        return np.array(super().force.x.array)

    def force_on(self, side: Literal["contactor", "target"]) -> fem.Function:
        """Nodal contact forces on one of the bodies, as a vector field; zero on a rigid target, which has no nodes (collective).

        Args:
            side: ``"contactor"`` or ``"target"``; the sum of both fields is :attr:`force`.
        """
        f = super().force_on(side)
        if self.further:
            more = sum(part.all_forces() for part in self.further).reshape(-1, self.config.gdim)
            here = np.isin(np.arange(self.config.n_owned), self.nodes, invert=side == "target")
            f.x.array.reshape(more.shape)[: len(here)][here] += more[: len(here)][here]
            f.x.scatter_forward()
        return f

    def resultant(self, about: npt.ArrayLike | None = None, *, on: Literal["contactor", "target"] = "contactor") -> Resultant:
        """Force and moment that the contact exerts on one of the bodies; see ``ContactResults.resultant`` (collective)."""
        found = super().resultant(about, on=on)
        if self.is_further_part:
            return Resultant(0.0 * found.force, 0.0 * found.moment)
        other: Literal["contactor", "target"] = "target" if on == "contactor" else "contactor"
        centre = np.zeros(self.config.gdim) if about is None else about
        for part in self.further:
            more = super(OfBothSides, part).resultant(centre, on=other if part.swaps else on)
            found = Resultant(found.force + more.force, found.moment + more.moment, found.normal + more.normal)
        return found

    def _with_further(self, across: Array, along: Array) -> tuple[Array, Array]:
        """Forces on contactors, with those of further parts, by the contactors around their points (collective)."""
        for part in self.further:
            row, node, weight = part.pair.kinematics.means()[int(part.swaps)]
            normal, tangential = part.pair.pressing()
            given = np.column_stack([normal, -tangential if part.swaps else tangential])[row] * weight[:, None]
            received = self.config.add_at_owners(node, given)[self.pair.nodes]
            more = np.column_stack([self.pair.discretisation.spread(component) for component in received.T])
            across, along = across + more[:, 0], along + more[:, 1:]
        return across, along
