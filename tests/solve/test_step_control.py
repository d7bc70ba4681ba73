"""Lengths of steps: how far they are cut, and when they grow again."""

from __future__ import annotations

import uem_dolfinx as uem
from uem_dolfinx.solve.step_control import StepControl
from uem_dolfinx.solve.united.newton import Iteration


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
