"""Fixtures for tests that run alike on any number of ranks; hypothesis draws the same examples on all of them.

Every state in which any test's Newton loop has converged is checked for equilibrium under the contact forces, complementarity and
action = reaction.
"""

from __future__ import annotations

import atexit
import gc
import json
import os
import shutil
import sys
import tempfile
import time
import zlib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from mpi4py import MPI

import hypothesis
import numpy as np
import pytest

pytest.register_assert_rewrite(
    "helpers", "bar_scenes", "body_scenes", "corner_scenes", "counting", "mass_scenes", "plastic_scenes", "ramp_scenes", "restart_scenes",
    "resting_scenes", "results_scenes",
)  # fmt: skip
from helpers import complementary, coulomb, highest

import uem_dolfinx as uem
from uem_dolfinx.contact.mortar.placement import Contactors
from uem_dolfinx.contact.nodes.concave_edges import MOST_CHANGES
from uem_dolfinx.solve.bodies.field_scales import first
from uem_dolfinx.solve.united.system import BodySystem

if "PYTEST_XDIST_WORKER" not in os.environ:
    # where two workers need a form at once the second waits for the compiler of the first, and longer than DOLFINx's 10 s; on meshes of
    # a few cells a kernel is compiled for longer than it runs
    _settings = Path(tempfile.mkdtemp())
    (_settings / "dolfinx").mkdir()
    for _name in ("dolfinx_jit_parameters.json", "dolfinx_jit_options.json"):
        (_settings / "dolfinx" / _name).write_text(json.dumps({"timeout": 240, "cffi_extra_compile_args": ["-O0", "-g0"]}))
    os.environ["XDG_CONFIG_HOME"] = str(_settings)
    atexit.register(shutil.rmtree, _settings, ignore_errors=True)

hypothesis.settings.register_profile("ranks", deadline=None, derandomize=True, database=None, max_examples=25)
hypothesis.settings.load_profile("ranks")


_MEETING = MPI.COMM_WORLD.Dup()


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_auto_num_workers() -> int:
    """Tests run side by side on all cores, under mpirun on its ranks alone."""
    return 0 if MPI.COMM_WORLD.size > 1 else len(os.sched_getaffinity(0))


def pytest_addoption(parser: pytest.Parser) -> None:
    """How many cases of each parametrised test run, and which share of the tests."""
    parser.addoption("--cases", type=int, default=1, help="so many cases of each parametrised test are not marked slow (1)")
    parser.addoption("--most", type=int, help="at most so many cases of each parametrised test run, slow ones among them (all)")
    parser.addoption("--every", type=int, default=1, help="every so many tests of each file run (1)")
    parser.addoption("--start", type=int, default=0, help="the first of them, from 0 (0)")


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Mark as slow all but a few cases of each parametrised test, and leave out those that are not to run."""
    quick, most, every, start = (config.getoption(name) for name in ("--cases", "--most", "--every", "--start"))
    files = defaultdict[Path, dict[str, list[pytest.Item]]](dict)
    for item in items:
        if MPI.COMM_WORLD.size == 1 and item.get_closest_marker("long") is not None:
            item.add_marker("slow")
        files[item.path].setdefault(item.nodeid.partition("[")[0], []).append(item)
    runs = set()
    for tests in files.values():
        for cases in list(tests.values())[start::every]:
            first = _spread([item for item in cases if item.get_closest_marker("slow") is None], quick)
            for item in cases:
                if item not in first:
                    item.add_marker("slow")
            others = [item for item in cases if item not in first]
            every_one = most is None or cases[0].get_closest_marker("every_case") is not None
            runs |= {*first, *_spread(others, len(others) if every_one else max(most - len(first), 0))}
    config.hook.pytest_deselected(items=[item for item in items if item not in runs])
    items[:] = [item for item in items if item in runs]


def _spread(items: list[pytest.Item], number: int) -> list[pytest.Item]:
    """So many of these, evenly spread over the list; where from hangs on the test's name, so that tests run different cases."""
    if number >= len(items):
        return items
    start = zlib.crc32(items[0].nodeid.partition("[")[0].encode())
    return [items[(start + len(items) * k // number) % len(items)] for k in range(number)]


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


@pytest.fixture(autouse=True)
def nothing_is_left() -> Iterator[None]:
    """Free what a test has left in circles: MPICH has communicators for a few hundred meshes only."""
    yield
    if "MPICH" in MPI.Get_library_version():
        gc.collect()


@pytest.fixture(autouse=True)
def every_converged_state(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Check every state that ``UnitedProblem.attempt`` finds (collective).

    Gaps are closed to 1e-12 of the size, where a test is marked as ``nearly_dependent`` to 1e-10.
    """
    closed = 1e-12 if request.node.get_closest_marker("nearly_dependent") is None else 1e-10
    attempt = uem.UnitedProblem.attempt
    largest: dict[uem.UnitedProblem, float] = {}

    def checked(self: uem.UnitedProblem, **how: Any) -> list[Any]:
        history = attempt(self, **how)
        if type(self.system) is not BodySystem:
            # another method of contact keeps other conditions
            return history
        # a step that unloads is in equilibrium against the forces that were there before
        largest[self] = max(largest.get(self, 0.0), first(self.bodies.unknowns.norms(self.bodies.residual)))
        # masses at points have forces that nodes in balance do not see
        largest[self] = max([largest[self], *(one.size() for one in (self.dynamics.added if self.dynamics else ()))])
        check_state(self, largest[self], closed)
        return history

    monkeypatch.setattr(uem.UnitedProblem, "attempt", checked)


def check_state(problem: uem.UnitedProblem, scale: float, closed: float) -> None:
    """Bodies in equilibrium, contacts closed or free of force, forces in pairs; ``scale`` is the norm of forces (collective)."""
    bodies, config = problem.bodies, problem.config
    bodies.assemble()
    left, n = bodies.forces.copy(), config.n_owned
    rounding = 10 * max(first(problem.system.rounding()), bodies.rounding_of_displacement())
    for contact in problem.contacts:
        if not contact.on:
            assert contact.n_active == 0 and highest(config.comm, np.abs(contact.force.x.array)) <= 0.0
            continue
        # a small-sliding contact has been projected anew since
        if contact.normal is not None:
            obeyed(contact)
        elif contact.sliding != "small":
            complementary(contact, closed * config.size, 1e-7 * scale + rounding)
        if contact.pair.friction is not None:
            coulomb(contact.pair.whole, 1e-12 * config.size, 1e-7 * scale + rounding)
        balance = contact.balance()
        # where the foot stays behind, the forces of a pair lie on two lines; forces of rounding balance as they please
        lines = contact.sliding != "finite" or highest(config.comm, np.abs(contact.force.x.array)) <= rounding
        assert balance is None or (balance.force < 1e-11 and (balance.moment < lever(contact) or lines))
        left -= contact.force.x.array.reshape(-1, config.gdim)[:n]
        if getattr(contact, "leak", None) is not None:
            left -= config.add_at_owners(*contact.pair.applied_forces())
    if problem.linear is not None:
        left -= problem.linear.forces(problem.linear.multipliers)
    assert highest(config.comm, np.abs(left * bodies.free[:n])) <= 1e-5 * scale + rounding


def obeyed(contact: uem.Contact) -> None:
    """Contactors of a soft contact press by the pressure of their gap, on one side of the surfaces alone (collective)."""
    pair = contact.pair
    if pair.in_reach:
        if contact.normal.damping:
            p, slope = pair.pressures_at(pair.gaps())
        else:
            p, slope = contact.normal.pressures(pair.config.comm, contact.name, pair.gaps(), 1e-9 * pair.config.size)
        wrong = contact.pressures - np.where(pair.off | ~contact.leads(), 0.0, p)
        # gaps are closed up to the same length as those of hard contact
        assert highest(pair.config.comm, np.abs(wrong) - 1e-12 * (p - slope * pair.config.size)) <= 0.0


def lever(contact: uem.Contact) -> float:
    """Bound on the moment that a contact leaves behind: friction of mortar acts where gaps vanish in the mean, not everywhere.

    So does friction on quadratic surfaces: a facet at the edge of the contact is closed at a control point, with open gaps g at its nodes
    of weights w, where ``sum w g = 0`` but ``sum w g n`` is not zero if normals n differ. It is of second order in the facet's turn.

    Friction and corners push at the foot, from which an offset holds contactors off, and shear of a preloaded section acts across its
    opening. Forces at a seam are those of both sides together.
    """
    pair = contact.pair
    cut = isinstance(pair.discretisation, Contactors) and pair.discretisation.elimination.seam.any
    if isinstance(contact, uem.Preload) or cut:
        return np.inf
    corners = pair.config.comm.allreduce(bool(pair.trial.in_corner.any()), op=MPI.LOR)
    if pair.kinematics.projection.offset is not None and (corners or pair.friction is not None):
        return np.inf
    # across a gap the averaged normals of a soft contact lean by the angle of the facets, and its forces in corners by more
    if contact.normal is not None and (corners or highest(pair.config.comm, pair.trial.changes) >= MOST_CHANGES):
        return 1e-6 + across_gaps(contact)
    means = not pair.discretisation.traits.at_feet or pair.config.degree > 1
    return 1e-7 if pair.friction is not None and means else 1e-11


def across_gaps(contact: uem.Contact) -> float:
    """Forces in corners times the distances from their edges, over the sum of absolute moments (collective)."""
    pair, config = contact.pair, contact.config
    i, force = pair.trial.in_corner, contact.force.x.array.reshape(-1, config.gdim)[: config.n_owned]
    across = np.abs(pair.kinematics.projection.gap[i]) @ np.linalg.norm(pair.trial.force[i], axis=1)
    every = np.linalg.norm(force, axis=1) @ np.linalg.norm(config.x[: config.n_owned], axis=1)
    across, every = config.comm.allreduce(np.array([across, every]))
    return float(across / every) if every > 0.0 else 0.0


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
