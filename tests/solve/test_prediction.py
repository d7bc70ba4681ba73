"""The first active set of a step."""

import pytest

from uem_dolfinx.solve.problem import RIM


@pytest.mark.parametrize("pace", [1e-6, 0.1, 20.0])
def test_a_rim_that_moves_on_at_its_pace_is_found(pace):
    """The gap beside a smooth contact grows with the power 3/2: where the rim arrives next, the extrapolated gap vanishes."""
    now, before = pace**1.5, (2 * pace) ** 1.5
    assert abs(now + RIM * (now - before)) < 1e-14 * before
