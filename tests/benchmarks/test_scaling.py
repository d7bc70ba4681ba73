"""What a search sends: counted exactly, bounded by a rank's own part of the surfaces, and the same answers while it is counted.

The test to read first is ``test_ranks_receive_what_is_theirs``.
"""

from __future__ import annotations

import json
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest
from benchmarks.traffic import Counting, plates, search_traffic, watched
from helpers import highest, serial, start_process

from uem_dolfinx.parallel import Exchange

SCRIPT = Path(__file__).parents[2] / "demos" / "scaling.py"
#: Bytes of the numbers in question and answer for one contactor over quadrilaterals, and what is said about each message.
ANSWER, MESSAGE = 8 * 37, 64


def test_counting_is_exact(comm):
    """Bytes that MPI puts into this rank's buffers, of what comes from others only; what arrives is what was sent."""
    counting = Counting(comm)
    exchange = Exchange(counting, [np.full(100 * comm.rank + to, to) for to in range(comm.size)])
    others = [r for r in range(comm.size) if r != comm.rank]
    assert counting.received == 4 * len(others)  # a count for each
    got, flags = exchange.send(np.arange(comm.size), np.ones(comm.size, bool))
    assert np.array_equal(got, np.full(sum(100 * r + comm.rank for r in range(comm.size)), comm.rank)) and flags.all()
    expected = 4 * len(others) + 9 * sum(100 * r + comm.rank for r in others)
    assert counting.received == (expected if others else 0)
    exchange.back(got)
    assert counting.received == expected + 8 * sum(100 * comm.rank + r for r in others)
    boxes = np.empty((comm.size, 6))
    counting.Allgather(np.full(6, float(comm.rank)), boxes)
    assert np.array_equal(boxes[:, 0], np.arange(comm.size))
    assert counting.received == expected + 8 * sum(100 * comm.rank + r for r in others) + 48 * len(others)


def test_every_call_is_counted(comm):
    """A call that is not counted fails, on a communicator that has it."""
    assert hasattr(comm, "alltoall") and hasattr(comm, "Gather")
    for call in ("alltoall", "Gather"):
        with pytest.raises(AttributeError):
            getattr(Counting(comm), call)


def test_answers_are_the_same_while_counted(comm):
    s = plates(8)
    plain = s.target.project(s.points)
    with watched(s.target) as watch:
        counted = s.target.project(s.points)
    for field in fields(plain):
        assert np.array_equal(getattr(plain, field.name), getattr(counted, field.name)), field.name
    assert comm.allreduce(watch.projected) >= comm.allreduce(len(s.points)) == 81
    assert (watch.counting.received > 0) == (comm.size > 1)
    # afterwards nothing is counted
    assert s.target.comm is s.config.comm
    before = watch.counting.received, watch.projected
    s.target.project(s.points)
    assert before == (watch.counting.received, watch.projected)


@pytest.mark.parametrize("n", [20, 40])
def test_ranks_receive_what_is_theirs(comm, n):
    """Few contactors ask several ranks, and what a rank receives is what its own contactors and facets need."""
    found = search_traffic(plates(n))
    assert found["contactors"] == (n + 1) ** 2 and found["facets"] == round(0.8 * n) ** 2
    assert found["searched_ranks"] <= 1.25
    if comm.size == 1:
        assert found["bytes_max"] == 0 and found["imbalance"] == 1.0
    else:
        assert 0 < found["bytes_max"] <= 1.25 * ANSWER * found["share_max"] + MESSAGE * comm.size
        assert found["halo_bytes_max"] > 0
        assert 1.0 <= found["imbalance"] < comm.size


def test_plates_touch_all_over(comm):
    """Every contactor is over the other plate, the gap away."""
    s = plates(6)
    p = s.target.project(s.points)
    assert highest(comm, np.abs(p.gap / (0.01 / 6) - 1)) < 1e-9
    assert highest(comm, np.abs(p.normal - [0.0, 0.0, 1.0])) < 1e-12
    assert highest(comm, np.abs(p.beyond)) < 1e-14
    assert comm.allreduce(len(s.points)) == 49


@serial
@pytest.mark.slow
def test_script(folder):
    """The demo on one and two ranks in a size that takes seconds: its file has all that is promised."""
    file = folder / "scaling.json"
    options = ["--dofs", "2000", "--plates", "6", "--plate-ranks", "2", "--searches", "4,8", "--json", str(file)]
    options += ["--counted", "6000", "--count-ranks", "2"]
    run = f"import runpy, sys; sys.argv = {[str(SCRIPT), *options]!r}; sys.path.insert(0, {str(SCRIPT.parent)!r}); "
    process = start_process(run + f"runpy.run_path({str(SCRIPT)!r}, run_name='__main__')")
    process.communicate(timeout=300)
    assert process.returncode == 0
    found = json.loads(file.read_text())
    assert [row["ranks"] for row in found["ranks"]] == [1, 2]
    for row in found["ranks"]:
        assert {"ranks", "dofs", "seconds", "speedup", "search_bytes_max", "contact_imbalance"} <= set(row)
        assert row["seconds"] > 0 and row["active"] > 0
    one, two = found["ranks"]
    assert one["dofs"] == two["dofs"] and one["active"] == two["active"]
    assert one["speedup"] == 1.0 and two["speedup"] == one["seconds"] / two["seconds"]
    assert one["search_bytes_max"] == 0 < two["search_bytes_max"]
    assert one["contact_imbalance"] == 1.0 <= two["contact_imbalance"] <= 2.0
    assert [row["ranks"] for row in found["plates"]] == [2]
    (measured,) = found["plates"]
    assert 0 < measured["bytes_per_rank"] < 200 and measured["partners"] == 1
    # what a rank receives for its own stays, what all tell all grows with the ranks
    few, *_, many = found["paper"]
    assert few["bytes_own"] == many["bytes_own"] > 0
    assert many["bytes_told_by_all"] == pytest.approx(few["bytes_told_by_all"] * (many["ranks"] - 1) / (few["ranks"] - 1))
    assert [row["contactors"] for row in found["search"]] == [25, 81]
    assert found["search"][0]["exponent"] is None and isinstance(found["search"][1]["exponent"], float)
    # every collective call is in a stage, and products near the contact make few
    (calls,) = found["collectives"]
    stages = {k: v for k, v in calls.items() if k not in ("ranks", "dofs", "newton_iterations", "all", "solver")}
    assert calls["ranks"] == 2 and sum(stages.values()) == calls["all"]
    assert 0 < stages["restriction matrix P"] + stages["united matrix P'KP"] < 0.25 * calls["all"]
