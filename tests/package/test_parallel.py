"""What ranks send each other: rows of any kind to several ranks, answers to them, counts of keys.

The test to read first is ``test_answers_come_back_to_the_rows_they_answer``.
"""

from __future__ import annotations

import numpy as np
import pytest

from uem_dolfinx.parallel import Exchange, agree, count_keys

KINDS = [np.int8, np.int64, np.float32, np.float64, np.bool_, "U3", [("a", "i4"), ("b", "f8", (2,))]]


def values(kind, n, tail, seed):
    """Rows of a type, different on every rank."""
    raw = np.random.default_rng(seed).integers(0, 2 if kind == np.bool_ else 100, (n, *tail))
    if not isinstance(kind, list):
        return raw.astype(kind)
    a = np.zeros(raw.shape, kind)
    a["a"], a["b"] = raw, raw[..., None] + np.array([0.25, 0.5])
    return a


def sent_everywhere(n, seed=0):
    """Rows that each rank, which has ``n[rank]``, sends to each other, the same table on all ranks: ``[from][to]``."""
    rng = np.random.default_rng(seed)
    return [[np.sort(rng.permutation(k)[: rng.integers(0, k + 1)]) for _ in n] for k in n]


@pytest.mark.parametrize("kind", KINDS, ids=str)
@pytest.mark.parametrize("tail", [(), (3,), (2, 2), (0,)])
def test_rows_arrive_in_the_order_of_ranks(comm, kind, tail):
    """Several arrays of any type and shape, some ranks with rows and some without, rows that go to several ranks."""
    n = [0 if r == 1 else 5 + r for r in range(comm.size)]
    table = sent_everywhere(n)
    exchange = Exchange(comm, table[comm.rank])
    numbers = np.arange(n[comm.rank]) + 100 * comm.rank
    got, more, flags = exchange.send(values(kind, n[comm.rank], tail, comm.rank), numbers, numbers % 2 == 0)
    expected = [values(kind, n[r], tail, r)[table[r][comm.rank]] for r in range(comm.size)]
    assert got.dtype == np.dtype(kind) and np.array_equal(got, np.concatenate(expected))
    assert np.array_equal(more, np.concatenate([table[r][comm.rank] + 100 * r for r in range(comm.size)]))
    assert flags.dtype == bool and np.array_equal(flags, more % 2 == 0)


def test_answers_come_back_to_the_rows_they_answer(comm):
    """Each rank answers what it got with a number of its own; a row that went to several ranks gets all answers."""
    table = sent_everywhere([7] * comm.size, seed=1)
    exchange = Exchange(comm, table[comm.rank])
    assert np.array_equal(exchange.rows, np.concatenate(table[comm.rank]))
    x = np.random.default_rng(comm.rank).normal(size=(7, 2))
    (got,) = exchange.send(x)
    twice, by = exchange.back(2 * got, np.full(len(got), comm.rank))
    assert np.array_equal(twice, 2 * x[exchange.rows])
    assert np.array_equal(by, np.repeat(np.arange(comm.size), [len(rows) for rows in table[comm.rank]]))


def test_one_destination_for_each_row(comm):
    """Rows keep their order on the way; those that go nowhere are not answered."""
    rank = np.array([3, 0, -1, 1, 0, 2, 1, -1]) % comm.size
    rank[[2, 7]] = -1
    exchange = Exchange.to(comm, rank)
    number = 10 * comm.rank + np.arange(8)
    (got,) = exchange.send(number)
    assert np.array_equal(got, np.concatenate([10 * r + np.flatnonzero(rank == comm.rank) for r in range(comm.size)]))
    answers = np.full(8, -1)
    (answers[exchange.rows],) = exchange.back(-got)
    assert np.array_equal(answers, np.where(rank >= 0, -number, -1))


def test_nothing_to_send(comm):
    exchange = Exchange.to(comm, np.zeros(0, np.int64))
    a, b = exchange.send(np.zeros((0, 3)), np.zeros(0, bool))
    assert a.shape == (0, 3) and b.shape == (0,)
    assert [c.shape for c in exchange.back(a, b)] == [(0, 3), (0,)]


def test_one_rank_copies_nothing(comm):
    """What is all sent in order comes as it is, and what is picked is picked."""
    if comm.size > 1:
        pytest.skip("one rank only")
    x = np.arange(6.0).reshape(3, 2)
    (got,) = Exchange.to(comm, np.zeros(3, np.int64)).send(x)
    assert np.shares_memory(got, x) and np.array_equal(got, x)
    (got,) = Exchange(comm, [np.array([2, 0])]).send(x)
    assert np.array_equal(got, x[[2, 0]])


def test_objects_are_refused(comm):
    """Python objects cannot travel as bytes: an error on all ranks, before anything is sent."""
    if comm.size == 1:
        pytest.skip("nothing travels")
    exchange = Exchange.to(comm, np.zeros(1, np.int64))
    with pytest.raises(TypeError):
        exchange.send(np.array([None]))


def test_keys_are_counted_over_all_ranks(comm):
    """Against a count of all keys in one place."""
    keys = [np.random.default_rng(r).integers(0, 4, (0 if r == 2 else 30, 2)) for r in range(comm.size)]
    every = [tuple(key) for part in keys for key in part]
    assert list(count_keys(comm, keys[comm.rank])) == [every.count(tuple(key)) for key in keys[comm.rank]]


def test_one_error_for_all(comm):
    """The error of the first rank that has one is raised on all."""
    agree(comm, None)
    with pytest.raises(ValueError, match=f"of rank {comm.size // 2}"):
        agree(comm, ValueError(f"of rank {comm.rank}") if comm.rank >= comm.size // 2 else None)
