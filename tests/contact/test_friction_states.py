"""Contactors that stick, and that slip, and their directions: pure functions, without a mesh."""

from dataclasses import replace

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given

from uem_dolfinx.contact.friction import stick_slip
from uem_dolfinx.contact.seam.active_set import Violations
from uem_dolfinx.contact.seam.state import FrictionState


def state(stick, direction):
    known = FrictionState.initial(*np.shape(direction))
    return replace(known, stick=np.array(stick), direction=np.array(direction, dtype=float))


def nothing(n):
    return Violations(np.zeros(n, bool), np.zeros(n, bool))


def test_tangents_in_free_components():
    """Directions across the normal, orthonormal, without a part in what is prescribed."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    free = np.ones((20, 3), bool)
    T = stick_slip.tangents(normal[:, None], free)
    assert np.abs(np.einsum("nrg,ng->nr", T, normal)).max() <= 1e-15
    assert np.abs(np.einsum("nrg,nsg->nrs", T, T) - np.eye(2)).max() <= 1e-14
    # rounding does not turn those of flat surfaces
    normal[:] = np.eye(3)[2] + 1e-9 * normal
    T = stick_slip.tangents(normal[:, None], free)
    assert np.ptp(T, axis=0).max() <= 1e-8
    free[:, 1] = False
    T = stick_slip.tangents(normal[:, None], free)
    assert (T.any(axis=2).sum(axis=1) == 1).all() and not T[:, :, 1].any()
    assert np.abs(np.einsum("nrg,ng->nr", T, normal)).max() <= 1e-15
    # a normal that leans from a prescribed component leaves of what is across both this part, over the root of two
    for lean, count in ((5e-6, 1), (5e-7, 2)):
        n = np.array([[lean, 0.0, np.sqrt(1 - lean**2)]])
        assert stick_slip.tangents(n[:, None], np.array([[True, True, False]])).any(axis=2).sum() == count


def test_stick_and_slip():
    """Sticking contactors slip outside the cone; slipping ones stick when the slip is reversed; released ones do neither."""
    s = state([True, True, False, False, True], [[0, 0], [0, 0], [1, 0], [1, 0], [0, 0]])
    tau = np.array([[0.2, 0.0], [-0.4, 0.0], [-0.3, 0.0], [-0.3, 0.0], [1.0, 0.0]])
    slip = np.array([[0.0, 0], [0, 0], [0.1, 0], [-0.1, 0], [0, 0]])
    contact = nothing(5)
    contact.release[4] = True
    seen = stick_slip.Seen(np.ones(5), tau, np.full(5, 0.3), slip, np.zeros(5))
    wrong = stick_slip.find_violations(contact, s, np.ones(5, bool), seen, force_rounding=1e-9, gap_rounding=1e-9)
    assert wrong.slide.tolist() == [False, True, False, False, False]
    assert wrong.hold.tolist() == [False, False, False, True, False]
    assert wrong.count == 3
    after = stick_slip.exchange(s, wrong, tau)
    assert after.stick.tolist() == [True, False, False, True, True]
    assert after.direction.tolist() == [[0, 0], [1, 0], [1, 0], [0, 0], [0, 0]]


@given(
    way=hnp.arrays(float, 8, elements=st.floats(-1.0, 1.0)),
    bound=hnp.arrays(float, 8, elements=st.floats(1e-3, 1.0)),
    stick=hnp.arrays(bool, 8),
    back=hnp.arrays(bool, 8),
)
def test_springs_that_are_dragged(way, bound, stick, back):
    """Springs whose ends are dragged, from any state: those that stick bear their stretch, the others the limit against the way."""
    s = state(stick, np.where(stick, 0.0, np.where(back, -1.0, 1.0))[:, None] * [[1.0, 0.0]])
    for _ in range(4):
        slipped = np.where(s.stick, 0.0, way - bound * s.direction[:, 0])
        tau = -(way - slipped)[:, None] * [[1.0, 0.0]]
        seen = stick_slip.Seen(np.ones(8), tau, bound, slipped[:, None] * [[1.0, 0.0]], np.zeros(8))
        wrong = stick_slip.find_violations(nothing(8), s, np.ones(8, bool), seen, force_rounding=1e-12, gap_rounding=1e-12)
        if not wrong.count:
            break
        s = stick_slip.exchange(s, wrong, tau)
    assert not wrong.count
    assert np.abs(-tau[:, 0] - np.clip(way, -bound, bound)).max() <= 2e-12


def test_new_contactors_stick_and_released_ones_forget():
    s = state([True, False, False], [[0, 0], [0, 1], [0, 0]])
    before, now = np.array([True, True, False]), np.array([False, True, True])
    after = stick_slip.come_and_go(s, before, now, np.array([True, True, True]))
    assert after.stick.tolist() == [False, False, True]
    assert after.direction.tolist() == [[0, 0], [0, 1], [0, 0]]
    assert not stick_slip.come_and_go(s, before, now, np.zeros(3, bool)).stick.any()
    assert not stick_slip.come_and_go(s, before, ~now, np.ones(3, bool)).direction.any()


def test_the_direction_turns_with_the_motion():
    """The fixed point of the semismooth form is Coulomb's law: friction against the slip, whatever the stiffness."""
    s = stick_slip.turned(state([False], [[1.0, 0, 0]]), np.array([True]), np.array([[3.0, 4.0, 0.0]]))
    assert s.direction[0] == pytest.approx([0.6, 0.8, 0.0])
    k, part = stick_slip.turn_stiffness(np.array([2.0, 1.0]), np.array([1.0, 1.0]), np.array([10.0, 10.0]))
    assert (k[0], part[0]) == pytest.approx((10.0, 1.0))
    assert part[1] == pytest.approx(stick_slip.LEAST_TURN / (1 - stick_slip.LEAST_TURN))
