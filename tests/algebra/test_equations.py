"""What counts as a part of an equation, and what as its rounding."""

from __future__ import annotations

import numpy as np
import pytest
from equation_scenes import triangles, united

import uem_dolfinx as uem


@pytest.mark.parametrize("part, enough", [(3e-7, False), (3e-6, True)])
def test_what_a_condition_leaves_of_a_normal(part, enough):
    """An equation can eliminate the free component of its node if its direction has some of it."""
    rows = [(0, [np.sqrt(1 - part**2), part], 3)]
    if enough:
        assert united(triangles(2), rows, fixed=[(0, 0)]).chain == 1
    else:
        with pytest.raises(uem.ConflictError, match="nothing is left to eliminate"):
            united(triangles(2), rows, fixed=[(0, 0)])


@pytest.mark.parametrize("size, rounding", [(3e-13, True), (3e-12, False)])
def test_coefficients_that_are_rounding(size, rounding):
    """They neither close a ring of equations nor make a new P."""
    ring = [(0, [0.0, 1.0], 3), (3, [0.0, 1.0], 0)]
    r = united(triangles(2), ring, coefficient=size)
    assert r.chain == (1 if rounding else 2) and r.fades != rounding
    prints = {united(triangles(2), ring[:1], coefficient=c).fingerprint(values=True) for c in (0.5, 0.5 + size)}
    assert len(prints) == (1 if rounding else 2)
