"""Contactors ahead of a slip front that go along with it: how far ahead, and the same ones on any number of ranks."""

from mpi4py import MPI

import numpy as np

from uem_dolfinx.contact.friction.slip_front import Front


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
