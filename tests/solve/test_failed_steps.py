"""Load and time steps that fail: remainders are halved, and loads that raise end the run on all ranks."""

from __future__ import annotations

import io
import sys

import numpy as np
import pytest
from dolfinx import fem
from helpers import blocks, clamp, gathered_matrix, linear, modulus, raised, refused, st_venant
from resting_scenes import COMM, Bar

import uem_dolfinx as uem


def pressed_blocks(load=None):
    """Linear block on block, the top pushed down by a twentieth."""
    b = blocks(COMM, "triangle", 2, 4)
    contact = uem.Contact(b.high, b.low)
    return uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=b.oedometer(0.05), contacts=[contact], load=load)


@pytest.mark.parametrize("in_time", [False, True])
def test_bar_on_a_terminal(in_time, monkeypatch):
    """Who sits at a terminal sees how far the run is, once, whatever the number of ranks."""
    pytest.importorskip("tqdm")

    class Terminal(io.StringIO):
        def isatty(self):
            return True

    monkeypatch.setattr(sys, "stderr", Terminal())
    bar = Bar((0.0, -3.0)).problem if in_time else pressed_blocks()
    list(uem.time_steps(bar, 0.01, 0.03) if in_time else uem.load_steps(bar, 3))
    words = ("time steps" if in_time else "load steps", "3/3")
    assert [word in sys.stderr.getvalue() for word in words] == [COMM.rank == 0] * 2


# ---------------------------------------------------------------------------------------------- load steps


def test_failed_remainder_is_halved(monkeypatch):
    """What is left to the full load is tried once as a whole, then by halves, whatever the length of steps was to be."""
    problem, tried = pressed_blocks(), []
    solve = problem.solve

    def fails_on_long_ways(*, start, fraction):
        tried.append(fraction)
        if len(tried) in (1, 3):
            raise uem.ConvergenceError("too long")
        return solve(start=start, fraction=fraction)

    monkeypatch.setattr(problem, "solve", fails_on_long_ways)
    done = [step.factor for step in uem.load_steps(problem, 1)]
    assert tried == [1.0, 0.5, 1.0, 0.75, 1.0] and done == [0.5, 0.75, 1.0]


def test_stations_are_reached_after_a_cut(monkeypatch):
    """Steps that were cut come back to multiples of the nominal length, where loads may turn."""
    problem, solve, tried = pressed_blocks(), None, []
    solve = problem.solve

    def fails_once(*, start, fraction):
        tried.append(fraction)
        if len(tried) in (1, 4, 5):
            raise uem.ConvergenceError("too long")
        return solve(start=start, fraction=fraction)

    monkeypatch.setattr(problem, "solve", fails_once)
    done = [step.factor for step in uem.load_steps(problem, 5)]
    np.testing.assert_allclose(done, [0.1, 0.2, 0.25, 0.35, 0.4, 0.6, 0.8, 1.0], rtol=1e-14)
    assert done[1] == 0.2 and done[-1] == 1.0


@pytest.mark.parametrize("sendable", [True, False])
@pytest.mark.parametrize("in_time", [False, True])
def test_load_that_raises_on_one_rank(in_time, sendable):
    """All ranks leave the run with its words, and the last step stays."""

    class LocalError(Exception):
        """Of a class that other ranks cannot look up."""

    def load(at):
        if at > 0.03 and COMM.rank == COMM.size - 1:
            raise (ValueError if sendable else LocalError)("no tide table")

    problem = Bar((0.0, -3.0), load=load).problem if in_time else pressed_blocks(load)
    steps = uem.time_steps(problem, 0.02, 0.06) if in_time else uem.load_steps(problem, 50)
    words = r"load\(0.04\) raised (ValueError|LocalError): no tide table \(test_failed_steps.py, line \d+\)"
    before = []

    def go():
        for _ in steps:
            before[:] = [problem.u.x.array.copy()]

    found = raised(uem.UserFunctionError, words, go)
    assert np.array_equal(problem.u.x.array, before[0])
    if COMM.rank == COMM.size - 1:
        assert type(found.__cause__) is (ValueError if sendable else LocalError)


def test_back_to_nothing():
    """Unloaded step by step, a body comes to rest at its place in one step, though no force is left to compare with."""
    b = blocks(COMM, "triangle", 2, 4)
    top = fem.Function(b.V)
    contact = uem.Contact(b.high, b.low)

    def load(factor):
        top.x.array.reshape(-1, 2)[:, 1] = -0.2 * np.sin(np.pi * factor)

    bcs = [*clamp(b.V, b.bottom), fem.dirichletbc(top, fem.locate_dofs_topological(b.V, 1, b.top.entities))]
    problem = uem.UnitedProblem(st_venant(b.u, 1.0), b.u, bcs=bcs, contacts=[contact], load=load)
    steps, rounding = [], [0.0]
    for step in uem.load_steps(problem, 4):
        steps.append(step)
        rounding.append(problem.system.rounding())
    assert [step.cuts for step in steps] == [0] * 4 and steps[-1].newton_iterations <= 6
    # u'Ku = u'r, and r is no more than rounding of the displacement that the step began with
    free = np.concatenate(COMM.allgather(problem.bodies.free[: problem.config.n_owned].ravel()))
    least = np.linalg.eigvalsh(gathered_matrix(problem.bodies.update_tangent())[np.ix_(free, free)])[0]
    assert np.linalg.norm(b.scene.gather(b.u)) <= rounding[-2] / least < 1e-12 * 0.2


@pytest.mark.parametrize("moduli", [(-1.0, -1.0), (1.0, -1.0)])
def test_a_tangent_of_the_wrong_sign(moduli):
    """A negative modulus is named as an indefinite tangent of the bodies, without advice on meshes; what fails otherwise is not."""
    b = blocks(COMM, "triangle", 2, 3)
    F, contacts = linear(b.u, modulus(b.scene, *moduli)), [uem.Contact(b.high, b.low)]
    problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.01), contacts=contacts)
    error = refused(uem.ConvergenceError, ("the tangent of the bodies is indefinite", "along x at (", "sign of F"), problem.solve)
    assert "finer" not in str(error) and not b.u.x.array.any()
    b = blocks(COMM, "triangle", 2, 3)
    contacts = [uem.Contact(b.high, b.low)]
    problem = uem.UnitedProblem(st_venant(b.u, 1.0), b.u, bcs=b.oedometer(0.1), contacts=contacts, max_iterations=1)
    assert "indefinite" not in str(refused(uem.ConvergenceError, "no convergence", problem.solve))
