"""The active set as pure functions of arrays: who enters, who is released, in which order; no mesh, no ranks.

Read first: ``test_exchange_is_complementarity`` and ``test_linear_complementarity_is_solved``.
"""

from dataclasses import replace

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from uem_dolfinx.contact import active_set
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.errors import ConvergenceError


def state(active, lam=None, slips=None):
    active = np.array(active, dtype=bool)
    s = replace(PairState.initial(len(active), 2), active=active)
    s = s if lam is None else replace(s, lam=np.array(lam, dtype=float))
    return s if slips is None else replace(s, slips=np.array(slips))


def wrong_ones(s, gap, lam=None, *, off=None, movable=None, rounding=0.0, stiffness=1.0):
    """Wrong contactors of a single rank."""
    gap = np.array(gap, dtype=float)
    off = np.zeros(len(gap), bool) if off is None else np.array(off)
    movable = np.ones(len(gap), bool) if movable is None else np.array(movable)
    lam = s.lam if lam is None else np.array(lam, dtype=float)
    return active_set.find_wrong(
        s, gap, lam, off, movable, np.full(len(gap), stiffness), force_rounding=rounding, gap_rounding=1e-13
    )


numbers = hnp.arrays(float, 6, elements=st.floats(-1.0, 1.0))


@given(active=hnp.arrays(bool, 6), lam=numbers, gap=numbers)
def test_exchange_is_complementarity(active, lam, gap):
    """Closed contactors in tension open, open ones inside close, all others stay."""
    s = state(active, lam)
    wrong = wrong_ones(s, gap)
    assert np.array_equal(active_set.exchange(s, wrong).active, np.where(active, lam >= 0, gap < -1e-13))
    assert wrong.count == (wrong.enter | wrong.release).sum()
    assert wrong.worst == max(-lam[wrong.release].min(initial=0.0), -gap[wrong.enter].min(initial=0.0))


@given(active=hnp.arrays(bool, 6), lam=numbers, gap=numbers, order=st.permutations(range(6)), alone=st.booleans())
def test_the_order_of_contactors_does_not_matter(active, lam, gap, order, alone):
    s, t = state(active, lam), state(active[order], lam[order])
    a, b = wrong_ones(s, gap), wrong_ones(t, gap[order])
    if alone:
        a, b = a.among_the_worst(a.worst), b.among_the_worst(b.worst)
    assert np.array_equal(active_set.exchange(s, a).active[order], active_set.exchange(t, b).active)


@given(active=hnp.arrays(bool, 6), lam=numbers, gap=numbers, parts=hnp.arrays(bool, 6), alone=st.booleans())
def test_two_ranks_decide_as_one(active, lam, gap, parts, alone):
    """With the worst of all ranks, each rank's contactors do what they do on one rank."""
    s = state(active, lam)
    whole = wrong_ones(s, gap)
    pieces = [(part, state(active[part], lam[part])) for part in (parts, ~parts)]
    wrong = [wrong_ones(own, gap[part]) for part, own in pieces]
    assert sum(w.count for w in wrong) == whole.count
    worst = max(w.worst for w in wrong)
    if alone:
        whole, wrong = whole.among_the_worst(worst), [w.among_the_worst(worst) for w in wrong]
    for (part, own), w in zip(pieces, wrong):
        assert np.array_equal(active_set.exchange(own, w).active, active_set.exchange(s, whole).active[part])


@given(
    entries=hnp.arrays(float, (6, 6), elements=st.floats(-1.0, 1.0)), load=numbers, first=hnp.arrays(bool, 6),
    share=st.floats(0.01, 1.0),
)  # fmt: skip
def test_linear_complementarity_is_solved(entries, load, first, share):
    """``gap = A lam + load`` with any compliance A, from any first set: ``gap >= 0, lam >= 0``, one of them zero."""
    A = entries @ entries.T + share * np.eye(6)
    s, pivoting = state(first), active_set.Pivoting()
    for _ in range(100):
        lam = np.zeros(6)
        i = np.flatnonzero(s.active)
        lam[i] = np.linalg.solve(A[np.ix_(i, i)], -load[i])
        gap = np.where(s.active, 0.0, A @ lam + load)
        wrong = active_set.find_wrong(
            s, gap, lam, np.zeros(6, bool), np.ones(6, bool), 1 / np.diag(A), force_rounding=1e-9, gap_rounding=1e-9
        )
        if not wrong.count:
            break
        s = active_set.exchange(s, wrong if pivoting.all_at_once(wrong.count) else wrong.among_the_worst(wrong.worst))
    assert gap.min() >= -1e-9 and lam.min() >= -1e-9 and np.abs(gap * lam).max() <= 1e-9


def test_when_the_worst_goes_alone():
    """All at once while there are fewer wrong than ever before, and three times more; then the worst alone until there are fewer."""
    pivoting = active_set.Pivoting()
    counts, alone = (9, 5, 5, 7, 6, 5, 8, 4, 4), [5, 6]
    assert [i for i, n in enumerate(counts) if not pivoting.all_at_once(n)] == alone


def test_when_others_go_with_the_worst():
    """When it goes alone, until it has gone alone from the same pattern twice."""
    pivoting = active_set.Pivoting()
    assert [pivoting.all_at_once(n) and pivoting.ahead for n in (1, 1, 1, 1)] == [False] * 4
    assert not pivoting.all_at_once(1) and not pivoting.repeats([7]) and pivoting.ahead
    pivoting.start_again()
    assert pivoting.all_at_once(5) and not pivoting.ahead
    for _ in range(4):
        pivoting.all_at_once(5)
    assert pivoting.ahead and pivoting.repeats([7]) and not pivoting.ahead


def test_circles_are_told():
    """What has come three times, while no fewer were wrong, comes for ever where the pattern tells all there is."""
    pivoting = active_set.Pivoting()
    assert [pivoting.repeats([n], told=True) for n in (7, 8, 7, 8)] == [False, False, True, True]
    # fewer are wrong than ever: what comes then has not been tried
    assert pivoting.all_at_once(1) and pivoting.repeats([7], told=True) and pivoting.repeats([7], told=True)
    assert pivoting.repeats([7])
    with pytest.raises(ConvergenceError, match="goes in a circle"):
        pivoting.repeats([7], told=True)


@pytest.mark.parametrize("radius", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize(("gdim", "slender"), [(3, 50.0), (2, 10.0), (2, 100.0), (2, 1000.0)])
@pytest.mark.parametrize("sides", [1, 2])
def test_first_touch_of_a_paraboloid(radius, gdim, slender, sides):
    """Hertz: a ball or cylinder touches within a, and would overlap within more; those inside a enter, to 2 % or 10 % in the plane.

    Pressed in by d, a is ``sqrt(R d)`` in space; in the plane ``d = a^2 / (2 R) (log(4 L / a) - 1/2)`` for bodies of radius L, of
    which the model holds the whole or one side of a plane of symmetry.
    """
    a = 1e-2 * radius
    d = a**2 / radius * (1.0 if gdim == 3 else (np.log(4 * slender) - 0.5) / 2)
    r = np.linspace(0.0, 4.0, 401) * a
    gap = r**2 / (2 * radius) - d
    wrong = wrong_ones(state([False] * len(r)), gap / radius)
    span = sides * r[wrong.enter].max() / (4 * slender * a)
    enter = wrong.on_first_touch(gap, active_set.deep_enough(span, gdim) * d).enter
    assert r[enter].max() == pytest.approx(a, rel=0.02 if gdim == 3 else 0.1)


@pytest.mark.parametrize("span", [0.0, 1.0, 1e3])
def test_first_touch_of_one_contactor_and_of_all(span):
    """In the plane no less than in space, nor where a single contactor overlaps."""
    assert active_set.deep_enough(span, 2) == active_set.DEEP_ENOUGH


@pytest.mark.parametrize("size", [1e-12, 1.0, 1e12])
def test_equals_are_exchanged_together(size):
    """Violations that differ by 1e-7 are equal, by 1e-5 they are not; overlaps count as the forces that would lift them."""
    for part, together in ((1e-7, True), (1e-5, False)):
        s = state([True, True, False], lam=[-size, -size * (1 - part), 0.0])
        wrong = wrong_ones(s, [0.0, 0.0, -size * (1 - part) / 4], stiffness=4.0)
        assert wrong.count == 3
        worst = wrong.among_the_worst(wrong.worst)
        assert worst.release.tolist() == [True, together, False] and worst.enter[2] == together


def test_past_the_end_is_let_go_and_counted():
    """Whatever the force; a contactor that has slid off enters again only in front of the target."""
    s = active_set.slide_off(state([True, False], lam=[5.0, 0.0]), np.array([True, True]))
    assert not s.active.any() and s.slips.tolist() == [1, 0] and s.passed.tolist() == [True, False]
    assert not wrong_ones(s, [-1.0, -1.0], off=[True, True]).count
    again = active_set.exchange(s, wrong_ones(s, [-1.0, 1.0]))
    assert again.active.tolist() == [True, False] and not again.passed.any()


def test_what_nothing_can_move_is_let_go():
    s = state([True, False], lam=[1.0, 0.0])
    wrong = wrong_ones(s, [0.0, -1.0], movable=[False, False])
    assert not active_set.exchange(s, wrong).active.any()
    # before all others
    assert wrong.among_the_worst(wrong.worst).release[0]


def test_forces_below_rounding_are_no_tension():
    assert not wrong_ones(state([True], lam=[-0.9]), [0.0], rounding=1.0).count
    assert wrong_ones(state([True], lam=[-1.1]), [0.0], rounding=1.0).release.all()


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
def test_gaps_below_rounding_do_not_activate(size):
    """Overlaps of 3e-14 of the model's size are rounding, of 3e-13 none."""
    for depth, enters in ((3e-14, False), (3e-13, True)):
        s, gap, none = state([False]), np.array([-depth * size]), np.zeros(1)
        rounding = active_set.GAP_ROUNDING * size
        wrong = active_set.find_wrong(s, gap, none, none > 0, none == 0, none, force_rounding=0.0, gap_rounding=rounding)
        assert wrong.enter.all() == enters


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
def test_what_touches_at_the_start(size):
    """Gaps of 3e-10 of the model's size, either way, count as none; of 3e-9 they do not."""
    gap = size * np.array([3e-10, -3e-10, 3e-9, -3e-9, 0.0])
    allowed = np.array([True, True, True, True, False])
    assert active_set.touching(state([False] * 5), gap, size, allowed).active.tolist() == [True, True, False, False, False]
