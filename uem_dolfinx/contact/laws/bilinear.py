"""Cohesive softening along a straight line."""

from __future__ import annotations

from typing import Any

import numpy as np


class Bilinear:
    """``t = strength (w_f - w) / (w_f - w_0)`` from the onset w_0 to the largest opening ``w_f = 2 energy / strength``."""

    def softening(self, w: Any, strength: Any, energy: Any, stiffness: float) -> Any:
        """See ``Softening``."""
        last = 2.0 * energy / strength
        t = strength * (last - w) / (last - strength / stiffness)
        return np.where(w.real < last.real, t, 0.0)

    def left(self, trial: Any, strength: Any, energy: Any, stiffness: float, before: Any) -> Any:
        """See ``Softening``."""
        slope = 2.0 * stiffness * energy / strength
        q = (slope * before - trial) / (slope - strength)
        return np.where(q.real > 0.0, q, 0.0)
