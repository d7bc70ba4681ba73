"""All cases of `stability.py`, table by table."""

from __future__ import annotations

from benchmarks import (
    cases_attempts,
    cases_bending,
    cases_explicit,
    cases_friction,
    cases_motion,
    cases_pressing,
    cases_scales,
    cases_touching,
)

#: Modules with a list ``CASES`` each, in the order of the report.
TABLES = (
    cases_scales,
    cases_touching,
    cases_pressing,
    cases_bending,
    cases_friction,
    cases_motion,
    cases_explicit,
    cases_attempts,
)
CASES = [case for table in TABLES for case in table.CASES]
