"""Lengths of steps: how far they are cut, and when they grow again."""

from __future__ import annotations

from mpi4py import MPI

import ufl
from dolfinx import fem
from helpers import at, box, clamp, refused, scene

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.solve.step_control import StepControl
from uem_dolfinx.solve.united.newton import Iteration

COMM = MPI.COMM_WORLD


def loop(solves):
    """The history of a Newton loop with so many linear solves."""
    return [Iteration(0.0, 0.0, 1, False, int(k < solves), 1.0) for k in range(solves + 1)]


def test_steps_are_cut_ten_times():
    """Down to 1/1024 of the nominal length, whatever that is, and only for errors that a shorter step may mend."""
    control, failed = StepControl(0.1), uem.ConvergenceError("no")
    assert not control.shorten(0.1 / 700, failed) and control.length == 0.1
    assert control.shorten(0.1 / 170, failed) and control.length == 0.1 / 340
    control = StepControl(0.1)
    cuts = 0
    while control.shorten(control.length, failed):
        cuts += 1
    assert cuts == 10 and control.done(loop(0)) == (1, 10) and control.done(loop(0)) == (2, 0)
    assert not StepControl(0.1).shorten(0.1, uem.FloatingBodyError("falls"))


def test_attempts_that_repeat():
    """A step whose shorter attempt has the same iterations to the last bit is not cut again; others and short histories are."""
    for number, residual, again in ((3, 0.25, False), (3, 0.25 + 1e-16, True), (2, 0.25, True)):
        first, second = ([Iteration(r, 0.0, 1, False, 1, 1.0) for _ in range(number)] for r in (0.25, residual))
        control = StepControl(0.1)
        assert control.shorten(0.1, uem.ConvergenceError("no", first))
        error = uem.ConvergenceError("no", second)
        assert control.shorten(0.05, error) == again and ("repeat the same iterations" in str(error)) != again
        assert control.length == (0.025 if again else 0.1)


def test_an_interference_is_not_cut():
    """What does not depend on the load fails alike in steps of any length, of which two are tried."""
    s = scene(
        COMM,
        "quadrilateral",
        [box("quadrilateral", [0, -1], [1, 0], [4, 2]), box("quadrilateral", [0.1, -0.1], [0.9, 0.9], [3, 2])],
    )
    u = fem.Function(compat.function_space(s.mesh, 1, (2,)))
    v = ufl.TestFunction(u.function_space)
    bcs = [*clamp(u.function_space, s.tag("base", 0, at(1, -1.0))), *clamp(u.function_space, s.tag("lid", 1, at(1, 0.9)))]
    contact = uem.Contact(s.tag("foot", 1, at(1, -0.1)), s.tag("top", 0, at(1, 0.0)), max_penetration=0.2)
    F = uem.NeoHooke(1.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], max_iterations=2)
    attempts, solve = [], problem.solve
    problem.__dict__["solve"] = lambda **how: attempts.append(how) or solve(**how)
    refused(uem.ConvergenceError, "repeat the same iterations", lambda: list(uem.load_steps(problem, 4)))
    assert len(attempts) == 2


def test_easy_steps_are_doubled():
    """After 2 linear solves the next step may be twice as long, after 18 not; never longer than the nominal length.

    A step of two Newton loops, as one that wears surfaces, is easy if both are on average.
    """
    control = StepControl(1.0)
    control.shorten(0.5, uem.ConvergenceError("no"))
    control.done(loop(18))
    assert control.length == 0.25
    for length in (0.5, 1.0, 1.0):
        control.done(loop(2))
        assert control.length == length
    control.shorten(0.5, uem.ConvergenceError("no"))
    control.done([*loop(9), *loop(9)])
    assert control.length == 0.25
    control.done([*loop(5), *loop(4)])
    assert control.length == 0.5
