"""Lengths of steps: how far they are cut, and when they grow again."""

from __future__ import annotations

import uem_dolfinx as uem
from uem_dolfinx.solve.step_control import StepControl


def test_steps_are_cut_ten_times():
    """Down to 1/1024 of the nominal length, whatever that is, and only for errors that a shorter step may mend."""
    control, failed = StepControl(0.1), uem.ConvergenceError("no")
    assert not control.shorten(0.1 / 700, failed) and control.length == 0.1
    assert control.shorten(0.1 / 170, failed) and control.length == 0.1 / 340
    control = StepControl(0.1)
    cuts = 0
    while control.shorten(control.length, failed):
        cuts += 1
    assert cuts == 10 and control.done([None]) == (1, 10) and control.done([None]) == (2, 0)
    assert not StepControl(0.1).shorten(0.1, uem.FloatingBodyError("falls"))


def test_easy_steps_are_doubled():
    """After 2 linear solves the next step may be twice as long, after 18 not; never longer than the nominal length."""
    control = StepControl(1.0)
    control.shorten(0.5, uem.ConvergenceError("no"))
    control.done([None] * 19)
    assert control.length == 0.25
    for length in (0.5, 1.0, 1.0):
        control.done([None] * 3)
        assert control.length == length
