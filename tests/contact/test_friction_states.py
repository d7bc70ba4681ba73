"""Who sticks, who slips and where to: pure functions, without a mesh."""

from dataclasses import replace

from mpi4py import MPI

import numpy as np
import pytest

from uem_dolfinx.contact import friction
from uem_dolfinx.contact.active_set import Wrong
from uem_dolfinx.contact.slip_front import Front
from uem_dolfinx.contact.state import FrictionState


def state(stick, direction):
    known = FrictionState.initial(*np.shape(direction))
    return replace(known, stick=np.array(stick), direction=np.array(direction, dtype=float))


def nothing(n):
    return Wrong(np.zeros(n, bool), np.zeros(n, bool), np.zeros(n))


def test_tangents_in_free_components():
    """Directions across the normal, orthonormal, without a part in what is prescribed."""
    rng = np.random.default_rng(0)
    normal = rng.normal(size=(20, 3))
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    free = np.ones((20, 3), bool)
    T = friction.tangents(normal[:, None], free)
    assert np.abs(np.einsum("nrg,ng->nr", T, normal)).max() <= 1e-15
    assert np.abs(np.einsum("nrg,nsg->nrs", T, T) - np.eye(2)).max() <= 1e-14
    free[:, 1] = False
    T = friction.tangents(normal[:, None], free)
    assert (T.any(axis=2).sum(axis=1) == 1).all() and not T[:, :, 1].any()
    assert np.abs(np.einsum("nrg,ng->nr", T, normal)).max() <= 1e-15
    # a component that is free but for less than this part of the normal is none
    for lean, count in ((1e-5, 1), (1e-7, 1)):
        n = np.array([[lean, 0.0, np.sqrt(1 - lean**2)]])
        assert friction.tangents(n[:, None], np.array([[True, False, True]])).any(axis=2).sum() == count


def test_stick_and_slip():
    """Who sticks slides out of the cone; who slips sticks when the slip turns back; who is let go of does neither."""
    s = state([True, True, False, False, True], [[0, 0], [0, 0], [1, 0], [1, 0], [0, 0]])
    tau = np.array([[0.2, 0.0], [-0.4, 0.0], [-0.3, 0.0], [-0.3, 0.0], [1.0, 0.0]])
    slip = np.array([[0.0, 0], [0, 0], [0.1, 0], [-0.1, 0], [0, 0]])
    contact = nothing(5)
    contact.release[4] = True
    wrong = friction.find_wrong(
        contact,
        s,
        np.ones(5, bool),
        np.full(5, 0.3),
        np.ones(5),
        tau,
        slip,
        np.full(5, 2.0),
        force_rounding=1e-9,
        gap_rounding=1e-9,
    )
    assert wrong.slide.tolist() == [False, True, False, False, False]
    assert wrong.hold.tolist() == [False, False, False, True, False]
    assert wrong.count == 3
    assert wrong.violation == pytest.approx([0.0, 0.1, 0.0, 0.2, 0.0])
    assert wrong.among_the_worst(0.2).hold.sum() == 1 and wrong.among_the_worst(0.2).slide.sum() == 0
    after = friction.exchange(s, wrong, tau)
    assert after.stick.tolist() == [True, False, False, True, True]
    assert after.direction.tolist() == [[0, 0], [1, 0], [1, 0], [0, 0], [0, 0]]


def test_who_comes_sticks_and_who_goes_forgets():
    s = state([True, False, False], [[0, 0], [0, 1], [0, 0]])
    before, now = np.array([True, True, False]), np.array([False, True, True])
    after = friction.come_and_go(s, before, now, np.array([True, True, True]))
    assert after.stick.tolist() == [False, False, True]
    assert after.direction.tolist() == [[0, 0], [0, 1], [0, 0]]
    assert not friction.come_and_go(s, before, now, np.zeros(3, bool)).stick.any()
    assert not friction.come_and_go(s, before, ~now, np.ones(3, bool)).direction.any()


def test_the_direction_turns_with_the_motion():
    """The fixed point of the semismooth form is Coulomb's law: friction against the slip, whatever the stiffness."""
    s = friction.turned(state([False], [[1.0, 0, 0]]), np.array([True]), np.array([[3.0, 4.0, 0.0]]))
    assert s.direction[0] == pytest.approx([0.6, 0.8, 0.0])
    k, part = friction.turn_stiffness(np.array([2.0, 1.0]), np.array([1.0, 1.0]), np.array([10.0, 10.0]))
    assert (k[0], part[0]) == pytest.approx((10.0, 1.0))
    assert part[1] == pytest.approx(friction.LEAST_TURN / (1 - friction.LEAST_TURN))


def test_slip_that_eats_its_way_goes_ahead():
    """Others go along as far ahead as slip has come, twice as far the next time, and a quarter of that once it was too far."""
    front, points = Front(MPI.COMM_SELF), np.column_stack([np.arange(100.0), np.zeros(100)])

    def ahead(place, too_far=False):
        near, force = front.move(points[[place]], np.array([[2.0, 1.0]]), too_far, points)
        assert (force[near] == [2.0, 1.0]).all()
        return np.flatnonzero(near[place + 1 :]).size

    assert [ahead(0), ahead(1), ahead(3), ahead(6)] == [0, 1, 2, 4]
    assert [ahead(11), ahead(17, too_far=True), ahead(20)] == [8, 2, 4]
    assert not front.move(points[:0], points[:0], False, points)[0].any()


def test_who_goes_along_is_the_same_on_all_ranks():
    """Against one rank that has them all: contactors scattered over the ranks, slip that begins on some of them."""
    comm, rng = MPI.COMM_WORLD, np.random.default_rng(3)
    places, forces = rng.random((2, 400, 3))
    mine = np.flatnonzero(rng.integers(0, comm.size, 400) == comm.rank)
    spread, whole = Front(comm), Front(MPI.COMM_SELF)
    for first, last, too_far in ((0, 3, False), (3, 9, False), (9, 10, False), (10, 30, True)):
        begin = mine[(mine >= first) & (mine < last)]
        near, force = spread.move(places[begin], forces[begin], too_far and comm.rank == 0, places[mine])
        expected, taken = whole.move(places[first:last], forces[first:last], too_far, places)
        assert (near == expected[mine]).all() and (force == taken[mine]).all()
    assert 0 < expected.sum() < 400
