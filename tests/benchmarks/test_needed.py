"""The table of what a user should take: it holds on meshes that are cheap to solve."""

from __future__ import annotations

import pytest
from benchmarks.needed import worst
from benchmarks.problems import hertz_answer


@pytest.mark.slow
def test_what_the_report_says():
    """Four linear cells, or two quadratic ones, per half-width give the force to 1 %, and the largest pressure to 2 %."""
    answer = hertz_answer(1 / 80)
    for cells, degree in ((4, 1), (2, 2)):
        for method in ("united", "mortar"):
            found = worst(cells, degree, method, answer)
            assert found["force"] < 0.01 and found["largest"] < 0.025, (cells, degree, method, found)
