"""Contactors at open ends of targets: the table of cases of ``Ends``, one contactor for each of its rows."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from uem_dolfinx.contact.seam.ends import Ends, slide_off
from uem_dolfinx.contact.seam.state import PairState

NONE = np.zeros(1, bool)


def at(size, past=0.0, gap=-0.01, from_end=0.0, **how):
    """One contactor at facets of a size, with lengths in parts of it."""
    p = SimpleNamespace(
        gap=np.array([gap * size]), way_beyond=np.array([past * size]), facet_size=np.array([size]), from_end=np.array([from_end])
    )
    return Ends(p, 0.5 * size, **how)


def remembered(**which):
    return replace(PairState.initial(1, 2), **{name: np.array([value]) for name, value in which.items()})


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e3])
@pytest.mark.parametrize(
    "state, where, out",
    [
        ({}, {"past": 0.0}, False),
        ({}, {"past": 0.05}, True),
        ({"at_end": True}, {"past": 0.05}, False),
        ({"at_end": True}, {"past": 0.15}, True),
        ({"at_end": True, "passed": True}, {"past": 0.05}, True),
        ({"passed": True}, {"past": 0.0}, False),
        ({"passed": True}, {"gap": -0.4}, False),
        ({"passed": True}, {"gap": -0.6}, True),
        ({}, {"gap": -0.6}, False),
        # under mortar
        ({}, {"past": 0.2, "share": np.array([0.01])}, False),
        ({}, {"past": 0.2, "share": np.array([-1.0])}, True),
        ({"at_end": True}, {"share": np.array([0.4])}, True),
        ({"at_end": True}, {"share": np.array([0.6])}, False),
        ({}, {"share": np.ones(1), "out": ~NONE}, True),
    ],
)
def test_which_are_out(state, where, out, size):
    """Past an end to rounding, or by what the end holds; behind a thin target; and uncovered under mortar."""
    assert at(size, **where).past(remembered(**state)).tolist() == [out]


@pytest.mark.parametrize(
    "state, where, held",
    [
        ({}, {"from_end": 0.05}, True),
        ({}, {"from_end": 0.2}, False),
        ({}, {"from_end": 0.05, "past": 0.01}, False),
        ({"at_end": True}, {"from_end": 0.05, "past": 0.01}, True),
        ({"active": True}, {"from_end": 0.05}, False),
        ({"active": True, "at_end": True}, {"from_end": 0.05}, True),
        ({"passed": True}, {"from_end": 0.05}, False),
    ],
)
def test_which_an_end_holds(state, where, held):
    """Those that come to it, not those that slide to it from within or have been past it; none where ends hold nothing."""
    assert at(1.0, **where, holds=True).held(remembered(**state)).tolist() == [held]
    assert not at(1.0, **where).held(remembered(**state)).any()


def test_sliding_off():
    """It is let go of, and remembered as having been past the end, until it is active again."""
    gone = slide_off(remembered(active=True), ~NONE)
    assert (gone.active.any(), gone.at_end.all(), gone.passed.all()) == (False, True, True)
    stays = slide_off(remembered(active=True, passed=True), NONE)
    assert (stays.active.all(), stays.at_end.any(), stays.passed.any()) == (True, False, False)


@pytest.mark.parametrize("size, gap, near", [(1.0, 0.9, True), (1.0, 1.1, False), (np.inf, 0.19, True), (np.inf, 0.21, False)])
def test_near_contactors(size, gap, near):
    """Within a facet of the target, or within the reach of a rigid one, which has none; active ones in any case."""
    found = Ends(SimpleNamespace(gap=np.array([gap]), way_beyond=np.zeros(1), facet_size=np.array([size])), np.inf)
    assert found.near(remembered(), 0.2)[0] == near and found.near(remembered(active=True), 0.2)[0]
