"""The active set as pure functions of arrays: who enters, who is released, what caution does; no mesh, no ranks.

Read first: ``test_exchange_is_complementarity`` and ``test_the_order_of_contactors_does_not_matter``.
"""

from dataclasses import replace

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from uem_dolfinx.contact import active_set
from uem_dolfinx.contact.state import PairState


def state(active, lam=None, slips=None):
    active = np.array(active, dtype=bool)
    s = replace(PairState.initial(len(active), 2), active=active)
    s = s if lam is None else replace(s, lam=np.array(lam, dtype=float))
    return s if slips is None else replace(s, slips=np.array(slips))


def decide(s, gap, *, off=None, movable=None, cautious=False, settled=True, swept=False, rounding=0.0):
    """One decision of a single rank."""
    gap = np.array(gap, dtype=float)
    off = np.zeros(len(gap), bool) if off is None else np.array(off)
    movable = np.ones(len(gap), bool) if movable is None else np.array(movable)
    wrong = active_set.find_wrong(s, gap, off, movable, force_rounding=rounding, gap_rounding=1e-13, swept=swept)
    return active_set.exchange(s, wrong, gap, off, active_set.extremes(s, wrong, gap), cautious=cautious, settled=settled)


numbers = hnp.arrays(float, 6, elements=st.floats(-1.0, 1.0))


@given(active=hnp.arrays(bool, 6), lam=numbers, gap=numbers)
def test_exchange_is_complementarity(active, lam, gap):
    """Closed contactors in tension open, open ones inside close if they are deep enough, all others stay; forces go with the set."""
    s, changed = decide(state(active, lam), gap)
    inside = ~active & (gap < -1e-13)
    enters = inside & ((gap <= 0.5 * gap[inside].min(initial=0.0)) | (inside.sum() <= active.sum()))
    assert np.array_equal(s.active, (active & (lam >= 0)) | enters)
    assert changed == (not np.array_equal(s.active, active))
    assert np.array_equal(s.lam, np.where(s.active, lam, 0.0))


@given(active=hnp.arrays(bool, 6), lam=numbers, gap=numbers, order=st.permutations(range(6)), cautious=st.booleans())
def test_the_order_of_contactors_does_not_matter(active, lam, gap, order, cautious):
    s, _ = decide(state(active, lam), gap, cautious=cautious)
    t, _ = decide(state(active[order], lam[order]), gap[order], cautious=cautious)
    assert np.array_equal(s.active[order], t.active)


@given(active=hnp.arrays(bool, 6), lam=numbers, gap=numbers, parts=hnp.arrays(bool, 6), cautious=st.booleans())
def test_two_ranks_decide_as_one(active, lam, gap, parts, cautious):
    """With the extremes of all ranks, each rank's contactors do what they do on one rank."""
    off, movable = np.zeros(6, bool), np.ones(6, bool)
    whole, _ = decide(state(active, lam), gap, cautious=cautious)
    pieces = []
    for part in (parts, ~parts):
        s = state(active[part], lam[part])
        wrong = active_set.find_wrong(s, gap[part], off[part], movable[part], force_rounding=0.0, gap_rounding=1e-13, swept=False)
        pieces.append((part, s, wrong, active_set.extremes(s, wrong, gap[part])))
    of_all = active_set.Extremes(
        max(p[3].deepest for p in pieces), max(p[3].tension for p in pieces), sum(p[3].entering for p in pieces),
        sum(p[3].touching for p in pieces),
    )  # fmt: skip
    for part, s, wrong, _ in pieces:
        t, _ = active_set.exchange(s, wrong, gap[part], off[part], of_all, cautious=cautious, settled=True)
        assert np.array_equal(t.active, whole.active[part])


def test_caution_changes_the_worst_alone():
    """The deepest enters first; tension is let go only in equilibrium and when nothing enters, the largest first."""
    s = state([True, True, False, False], lam=[-1.0, -2.0, 0.0, 0.0])
    assert decide(s, [0, 0, -0.1, -0.3], cautious=True)[0].active.tolist() == [True, True, False, True]
    assert decide(s, [0, 0, 0.1, 0.1], cautious=True)[0].active.tolist() == [True, False, False, False]
    assert decide(s, [0, 0, 0.1, 0.1], cautious=True, settled=False)[1] is False


def test_past_the_end_is_let_go_and_counted():
    """Whatever the force; a contactor that has slid off enters again only in front of the target."""
    s, changed = decide(state([True, False], lam=[5.0, 0.0]), [0.0, -1.0], off=[True, True])
    assert changed and not s.active.any() and s.slips.tolist() == [1, 0] and s.passed.tolist() == [True, False]
    again, _ = decide(s, [-1.0, 1.0])
    assert again.active.tolist() == [True, False] and not again.passed.any()
    # while a thin target sweeps past, those that have slid off stay where they are
    assert not decide(s, [-1.0, 1.0], swept=True)[0].active.any()


def test_what_nothing_can_move_is_let_go():
    s, _ = decide(state([True, False], lam=[1.0, 0.0]), [0.0, -1.0], movable=[False, False])
    assert not s.active.any()


def test_forces_below_rounding_are_no_tension():
    assert decide(state([True], lam=[-0.9]), [0.0], rounding=1.0)[0].active.all()
    assert not decide(state([True], lam=[-1.1]), [0.0], rounding=1.0)[0].active.any()


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
def test_gaps_below_rounding_do_not_activate(size):
    """Overlaps of 3e-14 of the model's size are rounding, of 3e-13 none."""
    for depth, enters in ((3e-14, False), (3e-13, True)):
        s, gap = state([False]), np.array([-depth * size])
        none, every = np.zeros(1, bool), np.ones(1, bool)
        rounding = active_set.GAP_ROUNDING * size
        wrong = active_set.find_wrong(s, gap, none, every, force_rounding=0.0, gap_rounding=rounding, swept=False)
        assert wrong.enter.all() == enters


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
def test_what_touches_at_the_start(size):
    """Gaps of 3e-10 of the model's size, either way, count as none; of 3e-9 they do not."""
    gap = size * np.array([3e-10, -3e-10, 3e-9, -3e-9, 0.0])
    allowed = np.array([True, True, True, True, False])
    assert active_set.touching(state([False] * 5), gap, size, allowed).active.tolist() == [True, True, False, False, False]


def test_extrapolation():
    """Forces go on as they went in the last step, gaps are those at the extrapolated displacement."""
    before, last = state([True] * 3 + [False], lam=[2.0, 1.0, 1.0, 0.0]), state([True] * 3 + [False], lam=[3.0, 3.0, 0.0, 0.0])
    gap, allowed = np.array([0.0, 0.0, 0.0, -1.0]), np.ones(4, bool)
    full = active_set.extrapolate(before, last, before, 1.0, gap, allowed)
    assert full.active.tolist() == [True, False, True, True]
    assert active_set.extrapolate(before, last, before, 0.4, gap, ~allowed).active.tolist() == [True, True, True, False]
