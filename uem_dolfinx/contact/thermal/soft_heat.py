"""Heat through a soft contact: the conductance h(p, g) gets the pressure of the law and the gap at which it acts, both at once.

With the gap g, the pressure p(g) and the jump of temperature j the power per area is ``h(p(g), g) j``; its derivative by the gap is
``(h_g + h_p p') j``.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.seam.dyads import Terms
from uem_dolfinx.contact.thermal.heat import Heat


class SoftHeat(Heat):
    """Heat through one soft interface; arguments as for ``Heat``."""

    #: The interface, a ``SoftInterface``.
    pair: Any

    def _state(self) -> tuple[Array, ...]:
        """Pressures and gaps, negative where surfaces overlap, and temperatures (collective)."""
        p = np.maximum(self._contact.pressing()[0], 0.0) * self._per_area()
        state = p, self.pair.gaps()
        return (*state, *self._temperatures()) if self.law.of_temperatures else state

    def _moving(self) -> tuple[Bools, Bools]:
        """All contactors."""
        every = np.ones(len(self.pair.nodes), dtype=bool)
        return every, every

    def _by_gaps(self) -> tuple[Array, Terms]:
        """By gaps at fixed pressures, and through these, along the rows of the gaps (collective)."""
        by_pressures, by_gaps = self._slopes(0, 1)
        _, slope = self.pair.pressures_at(self.pair.gaps())
        rows, force = self.pair.kinematics.gap_rows.equations, self.passage.force
        which = np.append(np.arange(len(rows)), rows.row)
        gradient = np.concatenate([rows.direction, -rows.coefficients]) / force[which, None]
        node = np.append(self.pair.config.to_global(rows.node), rows.followed)
        return by_gaps + by_pressures * slope, Terms(which, node, gradient)
