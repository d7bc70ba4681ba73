"""Heat through a soft contact: the conductance h(p, g) gets the pressure of the law and the gap at which it acts, both at once.

With the gap g, the pressure p(g) and the jump of temperature j the power per area is ``h(p(g), g) j``; its derivative by the gap is
``(h_g + h_p p') j``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.seam.relative_motion import Terms
from uem_dolfinx.contact.thermal.heat import Heat


class SoftHeat(Heat):
    """Heat through one soft interface; arguments as for ``Heat``."""

    pair: Any  # the interface, a ``SoftInterface``
    _of_gaps = (0, 1)

    def _state(self) -> tuple[Array, ...]:
        """Pressures and gaps, negative where surfaces overlap, and temperatures (collective)."""
        p = np.maximum(self._contact.pressing()[0], 0.0) * self._per_area()
        state = p, self.pair.gaps()
        return (*state, *self._temperatures()) if self.law.of_temperatures else state

    def _moving(self) -> tuple[Bools, Bools]:
        """All contactors."""
        every = np.ones(len(self.pair.nodes), dtype=bool)
        return every, every

    def _opening(self, *slopes: Array) -> tuple[Array, Terms]:
        """By gaps at fixed pressures, and through these, along the rows of the gaps."""
        by_pressures, by_gaps = slopes
        _, slope = self.pair.pressures_at(self.pair.gaps())
        of_rows = self.pair.kinematics.gap_rows.gradients
        return by_gaps + by_pressures * slope, of_rows._replace(vector=of_rows.vector / self.passage.force[of_rows.row, None])
