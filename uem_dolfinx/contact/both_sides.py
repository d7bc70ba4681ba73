"""Results of a contact with a second part, whose contactors are nodes at corners of the target."""

from __future__ import annotations

from typing import Any, Literal

from mpi4py import MPI

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.results import ContactResults, Resultant
from uem_dolfinx.parallel import reduced


class OfBothSides(ContactResults):
    """Results of a contact and of its second part; those of a second part itself are zero, so that sums over contacts are right."""

    #: Whether its results are those of another contact, of which it is the second part.
    is_second_part = False
    #: The second part: nodes at corners of the target, and the contactor's facets; None without.
    at_corners: Any = None

    @property
    def parts_with_corners(self) -> list[Any]:
        """The contact, and its second part if there is one."""
        return [self] if self.at_corners is None else [self, self.at_corners]

    def corners_touch(self) -> bool:
        """Whether nodes at corners of the target are active contactors (collective)."""
        part = self.at_corners
        return part is not None and bool(reduced(self.config.comm, bool(part.pair.trial.active.any()), op=MPI.LOR))

    def _sum(self, what: str, together: Any, nothing: Any) -> Any:
        """A result of both parts (collective)."""
        if self.is_second_part:
            return nothing
        return together([getattr(ContactResults, what).__get__(part) for part in self.parts_with_corners])

    @property
    def n_active(self) -> int:
        """Number of active contactors over all ranks, those at corners of the target among them (collective)."""
        return int(self._sum("n_active", sum, 0))

    @property
    def dissipation(self) -> float:
        """Frictional dissipation in all committed steps: slip times the mean friction of each step (collective)."""
        return float(self._sum("dissipation", sum, 0.0))

    @property
    def force(self) -> fem.Function:
        """Nodal contact forces as a vector field: on the contactors, and opposite on the nodes of a meshed target (collective)."""
        f = super().force
        if self.is_second_part:
            f.x.array[:] = 0.0
        elif self.at_corners is not None:
            f.x.array[:] += self.at_corners.all_forces()
        return f

    def all_forces(self) -> Array:
        """Nodal forces of a second part on both bodies ``(n_local gdim,)`` (collective)."""
        return np.array(super().force.x.array)

    def force_on(self, side: Literal["contactor", "target"]) -> fem.Function:
        """Nodal contact forces on one of the bodies, as a vector field; zero on a rigid target, which has no nodes (collective).

        Args:
            side: ``"contactor"`` or ``"target"``; the sum of both fields is :attr:`force`.
        """
        f = super().force_on(side)
        if self.at_corners is not None:
            back = self.at_corners.all_forces() - super(OfBothSides, self.at_corners).force_on("contactor").x.array
            f.x.array[:] += back if side == "contactor" else -back
        return f

    def resultant(self, about: npt.ArrayLike | None = None, *, on: Literal["contactor", "target"] = "contactor") -> Resultant:
        """Force and moment that the contact exerts on one of the bodies; see ``ContactResults.resultant`` (collective)."""
        found = super().resultant(about, on=on)
        if self.is_second_part:
            return Resultant(0.0 * found.force, 0.0 * found.moment)
        if self.at_corners is None:
            return found
        other: Literal["contactor", "target"] = "target" if on == "contactor" else "contactor"
        centre = np.zeros(self.config.gdim) if about is None else about
        more = super(OfBothSides, self.at_corners).resultant(centre, on=other)
        return Resultant(found.force + more.force, found.moment + more.moment, found.normal + more.normal)

    def _with_corners(self, across: Array, along: Array) -> tuple[Array, Array]:
        """Forces on contactors, with those of the target's corners, by the contactors around these (collective)."""
        if self.at_corners is None:
            return across, along
        part, spread = self.at_corners.pair, self.pair.discretisation.spread
        row, node, weight = part.kinematics.means()[1]
        normal, tangential = part.pressing()
        told = np.column_stack([normal, -tangential])[row] * weight[:, None]
        received = self.config.add_at_owners(node, told)[self.pair.nodes]
        more = np.column_stack([spread(component) for component in received.T])
        return across + more[:, 0], along + more[:, 1:]
