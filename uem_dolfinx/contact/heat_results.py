"""Results of heat, or of another field, that passes through a contact."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from dolfinx import fem

from uem_dolfinx.arrays import Indices
from uem_dolfinx.contact.laws.conductance import Conductance, one_of_fields
from uem_dolfinx.parallel import reduced

if TYPE_CHECKING:
    from uem_dolfinx.geometry.configuration import Configuration


class HeatResults:
    """Results of the conductances of a contact; attributes as in ``ContactResults``."""

    name: str
    heats: tuple[Conductance, ...]
    config: Configuration

    if TYPE_CHECKING:

        @property
        def pair(self) -> Any:
            """Interface of the contact."""

        @property
        def nodes(self) -> Indices:
            """Contactors."""

        def _field(self, what: str, values: Any, vector: bool = False) -> fem.Function:
            """Values at contactors as a field."""

    @property
    def heat_flux(self) -> fem.Function:
        """Power per area from the contactor to the target, as a scalar field on the contactor; 0 without ``heat`` (collective).

        Frictional heat is not included. With several conductances, it belongs to the field of the first one.
        """
        return self.flux_of_part(self.pair.heats[0].law.field) if self.pair.heats else self._field("heat_flux", 0.0)

    def heat_flux_of(self, field: int) -> fem.Function:
        """Flux of a field, such as an electric current, summed over all of its conductances (collective).

        Args:
            field: number of the part of the mixed space.

        Raises:
            InputError: if no conductance belongs to that field.
        """
        return self.flux_of_part(one_of_fields(self.name, self.heats, field))

    def heat_power_of(self, field: int) -> float:
        """Power from the contactor to the target in a field, see :meth:`heat_flux_of` (collective)."""
        field = one_of_fields(self.name, self.heats, field)
        power = sum(float(heat.power().sum()) for heat in self.pair.heats if heat.law.field == field)
        return float(reduced(self.config.comm, power))

    def flux_of_part(self, field: int) -> fem.Function:
        """Flux of a field, zero for fields without conductance (collective)."""
        fluxes = [heat.flux() for heat in self.pair.heats if heat.law.field == field]
        first = not self.pair.heats or self.pair.heats[0].law.field == field
        return self._field("heat_flux" if first else f"heat_flux_of_field_{field}", sum(fluxes, np.zeros(len(self.nodes))))

    @property
    def heat_power(self) -> float:
        """Power from the contactor to the target, without frictional heat; 0 without ``heat`` (collective)."""
        return self.heat_power_of(self.pair.heats[0].law.field) if self.pair.heats else 0.0

    @property
    def joule_power(self) -> float:
        """Power of electric currents that becomes heat in the contact; 0 without ``joule`` (collective)."""
        made = [source.power().sum() for heat in self.pair.heats for source in heat.sources if source.of_current]
        return float(reduced(self.config.comm, float(sum(made))))

    def heat_balance(self) -> float:
        """Sum of nodal heat of both bodies over the sum of its absolute values; zero is conservation (collective).

        With several conductances, the largest value.
        """
        passing = [heat.nodal()[0] for heat in self.pair.heats]
        sums = reduced(self.config.comm, np.array([[part.sum(), np.abs(part).sum()] for part in passing]).reshape(-1, 2))
        return max((float(abs(total) / size) for total, size in sums if size > 0), default=0.0)
