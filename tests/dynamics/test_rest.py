"""Statics of bodies with mass: they come to rest on what holds them, and stay there in time.

The test to read first is ``test_body_with_mass_comes_to_rest``.
"""

from __future__ import annotations

import numpy as np
import pytest
from helpers import highest
from resting_scenes import COMM, DENSITY, LENGTH, Bar, E

import uem_dolfinx as uem

# ---------------------------------------------------------------------------------------------- statics of what has mass


@pytest.mark.parametrize("finite", [False, True])
@pytest.mark.parametrize("contactors", ["massless", "massy"])
@pytest.mark.parametrize("gap", [0.0, 0.5])
def test_body_with_mass_comes_to_rest(gap, contactors, finite):
    """It falls onto the floor if it must; the floor bears its weight, it shortens as in the closed form, and in time it stays so."""
    g = 3.0
    bar = Bar((0.0, -g), gap=gap, contactors=contactors, finite=finite)
    bar.problem.solve()
    weight = DENSITY * LENGTH * g
    force = bar.floor.resultant().force
    assert np.allclose(force, [0.0, weight], rtol=1e-7, atol=1e-7 * weight)
    if not finite and contactors == "massy":
        top = bar.s.gather(bar.u)[bar.s.drawing[:, 1] == gap + LENGTH]
        assert np.allclose(top[:, 1] + gap, -DENSITY * g * LENGTH**2 / (2 * E), rtol=1e-7)
    steps = list(uem.time_steps(bar.problem, 0.01, 0.05))
    assert len(steps) == 5
    assert highest(COMM, np.abs(bar.dynamics.velocity.x.array)) < 1e-5 * g * 0.05
    assert np.allclose(bar.floor.resultant().force, [0.0, weight], rtol=1e-5, atol=1e-5 * weight)


def test_what_is_held_at_rest_starts_freely():
    """On a floor without friction the first acceleration along it is that of free fall at every node with mass."""
    bar = Bar((0.5, -3.0))
    bar.problem.system.accelerate()
    a = bar.s.gather(bar.dynamics.acceleration)
    assert np.allclose(a[bar.s.drawing[:, 1] > 0.0, 0], 0.5, rtol=1e-10)
    bar = Bar((0.5, -3.0))
    with pytest.raises(uem.FloatingBodyError, match="moves along"):
        bar.problem.solve()
