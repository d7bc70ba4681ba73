"""The active set as pure functions of arrays: contactors that enter and are released, and their order; no mesh, no ranks.

Read first: ``test_exchange_is_complementarity`` and ``test_linear_complementarity_is_solved``.
"""

from dataclasses import replace

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from uem_dolfinx.contact.seam import active_set
from uem_dolfinx.contact.seam.active_set import Rule
from uem_dolfinx.contact.seam.ends import slide_off
from uem_dolfinx.contact.seam.state import PairState


def state(active, lam=None):
    active = np.array(active, dtype=bool)
    s = replace(PairState.initial(len(active), 2), active=active)
    return s if lam is None else replace(s, lam=np.array(lam, dtype=float))


def wrong_ones(s, gap, lam=None, *, off=None, movable=None, rounding=0.0):
    """Wrong contactors of a single rank."""
    gap = np.array(gap, dtype=float)
    off = np.zeros(len(gap), bool) if off is None else np.array(off)
    movable = np.ones(len(gap), bool) if movable is None else np.array(movable)
    lam = s.lam if lam is None else np.array(lam, dtype=float)
    return active_set.find_violations(s, gap, lam, off, movable, force_rounding=rounding, gap_rounding=1e-13)


numbers = hnp.arrays(float, 6, elements=st.floats(-1.0, 1.0))


@given(active=hnp.arrays(bool, 6), lam=numbers, gap=numbers)
def test_exchange_is_complementarity(active, lam, gap):
    """Closed contactors in tension open, open ones inside close, all others stay."""
    s = state(active, lam)
    wrong = wrong_ones(s, gap)
    assert np.array_equal(active_set.exchange(s, wrong).active, np.where(active, lam >= 0, gap < -1e-13))
    assert wrong.count == (wrong.enter | wrong.release).sum()


@given(active=hnp.arrays(bool, 6), lam=numbers, gap=numbers, order=st.permutations(range(6)))
def test_the_order_of_contactors_does_not_matter(active, lam, gap, order):
    s, t = state(active, lam), state(active[order], lam[order])
    a, b = wrong_ones(s, gap), wrong_ones(t, gap[order])
    assert np.array_equal(active_set.exchange(s, a).active[order], active_set.exchange(t, b).active)


@given(active=hnp.arrays(bool, 6), lam=numbers, gap=numbers, parts=hnp.arrays(bool, 6))
def test_two_ranks_decide_as_one(active, lam, gap, parts):
    """Each rank's contactors do what they do on one rank."""
    s = state(active, lam)
    whole = wrong_ones(s, gap)
    pieces = [(part, state(active[part], lam[part])) for part in (parts, ~parts)]
    wrong = [wrong_ones(own, gap[part]) for part, own in pieces]
    assert sum(w.count for w in wrong) == whole.count
    for (part, own), w in zip(pieces, wrong):
        assert np.array_equal(active_set.exchange(own, w).active, active_set.exchange(s, whole).active[part])


def by_brute_force(M, q):
    """Sets of six contactors whose ``lam = -M^-1 q`` on them and ``gap = M lam + q`` elsewhere are no less than zero."""
    for bits in range(2 ** len(q)):
        active = (bits >> np.arange(len(q))) % 2 == 1
        lam = np.zeros(len(q))
        lam[active] = np.linalg.solve(M[np.ix_(active, active)], -q[active])
        if (np.where(active, lam, M @ lam + q) >= -1e-9).all():
            yield lam


def settle(M, q, first, most=100):
    """Forces, rules used, and number of exchanges from a first set, as a linearised problem is settled; None for a circle."""
    s, pivoting, rules = state(first), active_set.Pivoting(), []
    for number in range(most):
        lam, i = np.zeros(len(q)), np.flatnonzero(s.active)
        lam[i] = np.linalg.solve(M[np.ix_(i, i)], -q[i])
        gap = np.where(s.active, 0.0, M @ lam + q)
        wrong = active_set.find_violations(s, gap, lam, q != q, q == q, force_rounding=1e-9, gap_rounding=1e-9)
        if not wrong.count:
            return lam, rules, number
        rules.append(pivoting.choose(wrong.count, s.active.tobytes()))
        if rules[-1] == Rule.NONE:
            return None, rules, number
        if rules[-1] == Rule.FIRST:
            wrong = wrong.among(np.arange(len(q)) == np.argmax(wrong.which))
        s = active_set.exchange(s, wrong)
    raise AssertionError("no end")


@given(
    entries=hnp.arrays(float, (6, 6), elements=st.floats(-1.0, 1.0)), load=numbers, first=hnp.arrays(bool, 6),
    share=st.floats(0.01, 1.0), turn=st.floats(0.0, 10.0),
)  # fmt: skip
def test_linear_complementarity_is_solved(entries, load, first, share, turn):
    """``gap = M lam + load`` with any compliance, and what friction adds to it, from any first set: ``gap >= 0, lam >= 0``, one zero.

    All principal minors of M are positive (a P-matrix), so that there is one answer, that of trying all sets.
    """
    M = entries @ entries.T + share * np.eye(6) + turn * (entries - entries.T)
    lam, _, _ = settle(M, load, first)
    assert lam is not None
    gap = M @ lam + load
    assert gap.min() >= -1e-8 and lam.min() >= -1e-8 and np.abs(gap * lam).max() <= 1e-8
    assert any(np.allclose(lam, one, atol=1e-6) for one in by_brute_force(M, load))


@given(
    entries=hnp.arrays(float, (6, 6), elements=st.floats(-1.0, 1.0)),
    load=numbers,
    first=hnp.arrays(bool, 6),
    mu=st.floats(0.0, 3.0),
)
def test_all_others_come_to_an_end(entries, load, first, mu):
    """Where there is no answer, or there are several, an answer or a circle is found after a few dozen exchanges."""
    M = entries @ entries.T + 0.1 * np.eye(6) + mu * entries
    lam, rules, number = settle(M, load, first)
    if lam is not None:
        gap = M @ lam + load
        assert gap.min() >= -1e-8 and lam.min() >= -1e-8
    assert number < 80


def test_murty_s_circle():
    """Exchanging all cycles in this problem of three (Murty, 1974); the first alone does not."""
    M, q = np.array([[1.0, 2.0, 0.0], [0.0, 1.0, 2.0], [2.0, 0.0, 1.0]]), -np.ones(3)
    lam, rules, number = settle(M, q, np.array([True, False, False]))
    assert np.allclose(lam, 1 / 3) and number < 20


def test_when_only_the_first_is_released():
    """All at once while there are fewer wrong than ever before, and thirty times more; then the first alone until there are fewer."""
    pivoting, new = active_set.Pivoting(), iter(range(99))
    counts, alone = (9, 5, 5, 7, 6, *[8] * 27, 5, 8, 4, 4), [32, 33]
    assert [i for i, n in enumerate(counts) if pivoting.choose(n, next(new)) == Rule.FIRST] == alone
    pivoting = active_set.Pivoting()
    assert [pivoting.choose(5, n) for n in range(70)] == [Rule.ALL] * 31 + [Rule.FIRST] * 39


def test_states_that_come_again():
    """A state that a rule has been in ends it at once; after the last rule nothing is left, unless fewer are wrong than ever."""
    pivoting = active_set.Pivoting()
    assert [pivoting.choose(5, n) for n in (7, 8, 7, 8, 7, 8)] == [0, 0, 1, 1, 2, 2]
    assert pivoting.choose(4, 7) == Rule.ALL


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


def test_past_the_end_is_let_go():
    """Whatever the force; a contactor that has slid off enters again only in front of the target."""
    s = slide_off(state([True, False], lam=[5.0, 0.0]), np.array([True, True]))
    assert not s.active.any() and s.at_end.tolist() == [True, False] and s.passed.tolist() == [True, False]
    assert not wrong_ones(s, [-1.0, -1.0], off=[True, True]).count
    again = active_set.exchange(s, wrong_ones(s, [-1.0, 1.0]))
    assert again.active.tolist() == [True, False] and not again.passed.any()


def test_what_nothing_can_move_is_let_go():
    s = state([True, False], lam=[1.0, 0.0])
    wrong = wrong_ones(s, [0.0, -1.0], movable=[False, False])
    assert not active_set.exchange(s, wrong).active.any()
    assert wrong.release.tolist() == [True, False]


def test_forces_below_rounding_are_no_tension():
    assert not wrong_ones(state([True], lam=[-0.9]), [0.0], rounding=1.0).count
    assert wrong_ones(state([True], lam=[-1.1]), [0.0], rounding=1.0).release.all()


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
def test_gaps_below_rounding_do_not_activate(size):
    """Overlaps of 3e-14 of the model's size are rounding, of 3e-13 none."""
    for depth, enters in ((3e-14, False), (3e-13, True)):
        s, gap, none = state([False]), np.array([-depth * size]), np.zeros(1)
        rounding = active_set.GAP_ROUNDING * size
        wrong = active_set.find_violations(s, gap, none, none > 0, none == 0, force_rounding=0.0, gap_rounding=rounding)
        assert wrong.enter.all() == enters


@pytest.mark.parametrize("size", [1e-9, 1.0, 1e6])
def test_what_touches_at_the_start(size):
    """Gaps of 3e-10 of the model's size, either way, count as none; of 3e-9 they do not."""
    gap = size * np.array([3e-10, -3e-10, 3e-9, -3e-9, 0.0])
    allowed = np.array([True, True, True, True, False])
    assert active_set.touching(state([False] * 5), gap, size, allowed).active.tolist() == [True, True, False, False, False]
