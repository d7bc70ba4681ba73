"""Explicit time steps: lengths by the critical step, and the loop."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from uem_dolfinx.dynamics.explicit.stepper import ExplicitStepper
from uem_dolfinx.errors import InputError, StepAccuracyError, UEMError
from uem_dolfinx.log import logger
from uem_dolfinx.solve.steps.time_step import TimeStep, events, touching

#: What is left to the end is rounding below this part of a step.
#: [convention; length of a step; test_explicit.py::test_steps_that_end]
LEFT = 1e-6


def explicit_steps(problem: Any, dt: float | None, end: float) -> Iterator[TimeStep]:
    """The steps of ``time_steps`` with central differences.

    Args:
        problem: with central differences.
        dt: length of all steps; None takes the longest, a part ``safety`` of the critical one.
        end: time to reach.

    Raises:
        InputError: if ``dt`` exceeds the critical step, or strains cells too far.
    """
    control, dynamics = problem.step_control, problem.dynamics
    kind: type[ExplicitStepper] = ExplicitStepper
    if dynamics.contactors == "massy":
        from uem_dolfinx.solve.steps.explicit_masses import StepperWithMass

        kind = StepperWithMass
    stepper = kind(problem)
    resumed = dt is None and dynamics.resumed and dynamics.time > dynamics.start
    problem.set_load(dynamics.time)
    if not dynamics.accelerated:
        stepper.begin()
    length, before, pattern = control.nominal if resumed else _length(stepper, dt, end), touching(problem), stepper.pattern()
    control.begin(length)
    stepper.look()
    if resumed:
        stepper.shortest = control.shortest
    else:
        # bodies that touch deform from the first step on
        control.due, control.stretch, control.shortest = control.number + 1, 0.0, stepper.shortest
    while (remainder := end - dynamics.time) > LEFT * length:
        taken = min(length if remainder >= (1.0 - LEFT) * length else remainder, control.longest)
        try:
            problem.set_load(dynamics.time + taken)
            iterations = stepper.step(taken)
        except UEMError as error:
            dynamics.restore()
            problem.set_load(dynamics.time)
            problem.restore()
            stepper.forget()
            if isinstance(error, StepAccuracyError):
                # until the critical step is found anew, also from a checkpoint on
                length = control.lower(dynamics.scheme.safety * stepper.limit)
            if control.shorten(taken, error):
                continue
            raise
        number, cuts = control.done(iterations)
        after = touching(problem)
        done, last = TimeStep(number, dynamics.time, taken, iterations, cuts, *events(problem, before, after)), pattern
        # bodies that meet deform from now on
        due = not problem.bodies.linear and (number >= control.due or after != before or stepper.sudden)
        before, found = after, (pattern := stepper.pattern()) != last
        if due or found:
            control.stretch, control.shortest = stepper.look(control.stretch), stepper.shortest
        if end - dynamics.time > LEFT * length and (found or (due and not stepper.steps_to_look(length, control.stretch))):
            length, control.stretch = _length(stepper, dt, end), 0.0
            control.begin(length)
        if due or found:
            steps = max(stepper.steps_to_look(length, control.stretch), 1)
            control.due, control.stretch = number + steps, control.stretch + steps * length * stepper.rate
        # a checkpoint holds what the next step begins with
        yield done


def _length(stepper: ExplicitStepper, dt: float | None, end: float) -> float:
    """Length of steps that divide the time to the end; InputError for a given one that is too long (collective)."""
    critical, dynamics = stepper.critical_step(), stepper.dynamics
    steady = stepper.steady_step(critical)
    if dt is not None:
        if dt > min(critical, steady):
            limit = (
                f"critical step {critical:.4g} of central differences"
                if dt > critical
                else f"{steady:.4g} that hardly strain cells"
            )
            raise InputError(
                f"dt = {dt:.6g} at time {dynamics.time:.6g}: expected no more than the {limit}; take shorter steps, or dt=None"
            )
        return dt
    longest, control = dynamics.scheme.safety * critical, stepper.problem.step_control
    if stepper.part < 1.0:
        control.resolved = min(control.resolved, stepper.part * longest)
    longest = min(longest, control.resolved, steady)
    remainder = end - dynamics.time
    # the same on any ranks: rounding of the critical step does not change the number of steps
    length = remainder / max(np.ceil(remainder / longest - LEFT), 1.0)
    logger.debug("critical step %.6g, taken %.6g", critical, length)
    return float(length)
