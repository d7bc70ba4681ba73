"""Cohesive softening along an exponential curve."""

from __future__ import annotations

from typing import Any

import numpy as np

#: The strength that is left under plastic unloading is found by so many of Newton's steps, which converge monotonically.
#: [bound; iterations; -]
ITERATIONS = 30


class ExponentialSoftening:
    """``t = strength exp(-(w - w_0) / l)`` from the onset w_0 on, with ``l = energy / strength - w_0 / 2``.

    In plastic openings it is ``strength exp(-w_p strength / energy)``.
    """

    def softening(self, w: Any, strength: Any, energy: Any, stiffness: float) -> Any:
        """See ``Softening``."""
        onset = strength / stiffness
        return strength * np.exp(-(w - onset) / (energy / strength - 0.5 * onset))

    def left(self, trial: Any, strength: Any, energy: Any, stiffness: float, before: Any) -> Any:
        """See ``Softening``."""
        a, begin = stiffness * energy / strength, np.log(np.maximum(before.real, np.finfo(float).tiny))
        z = begin + 0.0 * trial
        for _ in range(ITERATIONS):
            e = strength * np.exp(z)
            z = z - (e - a * (z - begin) - trial) / (e - a)
        return np.exp(z)
