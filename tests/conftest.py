"""Fixtures for tests that run alike on any number of ranks; hypothesis draws the same examples on all of them."""

from __future__ import annotations

import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from mpi4py import MPI

import hypothesis
import pytest

import uem_dolfinx  # noqa: F401

hypothesis.settings.register_profile("ranks", deadline=None, derandomize=True, database=None, max_examples=25)
hypothesis.settings.load_profile("ranks")


_MEETING = MPI.COMM_WORLD.Dup()


@pytest.hookimpl(hookwrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Iterator[None]:
    """End the run when one rank leaves a test alone, instead of leaving the others in it for ever."""
    outcome = yield
    report = outcome.get_result()
    if report.when != "call" or _MEETING.size == 1:
        return
    request, end = _MEETING.Ibarrier(), time.monotonic() + (30 if report.failed else 600)
    while not request.Test():
        if time.monotonic() > end:
            print(f"\nrank {_MEETING.rank} is alone after {item.nodeid}\n{report.longreprtext}", file=sys.__stderr__, flush=True)
            _MEETING.Abort(1)
        time.sleep(1e-4)


@pytest.fixture
def comm() -> MPI.Intracomm:
    """All ranks."""
    return MPI.COMM_WORLD


@pytest.fixture
def folder(comm: MPI.Intracomm) -> Iterator[Path]:
    """An empty folder, the same on all ranks, removed after the test."""
    with tempfile.TemporaryDirectory() if comm.rank == 0 else _nothing() as name:
        yield Path(comm.bcast(name, root=0))
        comm.barrier()


class _nothing:
    def __enter__(self) -> None:
        return None

    def __exit__(self, *error: object) -> None:
        return None
