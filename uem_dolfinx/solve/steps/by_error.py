"""Load steps whose length follows their error: each is taken at once and in two halves, which differ by what the path is cut into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import StepAccuracyError
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.memory import Memory
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.steps.by_load import ByLoad
from uem_dolfinx.solve.united.newton import Iteration

#: The error of a load step over its length grows so much if the length doubles.
#: [derived; error over length; test_accuracy_of_load_steps.py::test_steps_are_doubled_in_load]
SECOND_ORDER = 4.0


@dataclass(frozen=True)
class Reached:
    """What a step leads to at this rank's nodes.

    Attributes:
        u: displacements ``(n_owned, gdim)``.
        forces: forces of contacts and supports, which the bodies' residual leaves ``(n_owned, gdim)``.
    """

    u: Array
    forces: Array

    @classmethod
    def of(cls, problem: UnitedProblem) -> Reached:
        """At the present displacement (collective)."""
        problem.bodies.assemble()
        u = problem.config.of(np.array(problem.u.x.array))[: problem.config.n_owned]
        return cls(u, np.array(problem.bodies.forces))

    def apart(self, other: Reached, stiffness: Array) -> Array:
        """Works, in the present stiffness, of the difference in displacements and in forces ``(2,)``."""
        weight = np.abs(stiffness)
        compliance = np.divide(1.0, weight, out=np.zeros_like(weight), where=weight > 0.0)
        return np.array([(weight * (self.u - other.u) ** 2).sum(), (compliance * (self.forces - other.forces) ** 2).sum()])


class ByError(ByLoad):
    """Advances a problem by steps of given load, each of which two halves confirm.

    Backward steps along a path have an error of second order in their length, so that a step and its halves differ by the error of
    the halves. Where the path does not matter, as without friction and plasticity, they agree.

    Args:
        problem: the problem.
        tolerance: bound on the error of a step over its length, relative to the largest change over a length so far.
    """

    def __init__(self, problem: UnitedProblem, tolerance: float):
        super().__init__(problem)
        self._tolerance, self.loops = tolerance, 2

    def _step(self, done: float, factor: float) -> list[Iteration]:
        """Reach a load factor by two steps, after one has told their error, and commit these (collective)."""
        problem = self._problem
        problem.set_load(done)
        start = Reached.of(problem)
        self._reach(factor, problem.attempt)
        at_once = Reached.of(problem)
        problem.restore()
        before = Memory.of(problem)
        try:
            first = self._reach(0.5 * (done + factor), problem.attempt)
            problem.keep()
            second = self._reach(factor, problem.attempt)
            self._refuse_error(start, at_once, Reached.of(problem), factor - done)
        except BaseException:
            before.put_back(problem)
            raise
        problem.commit()
        return [*first, *second[1:]]

    def _refuse_error(self, start: Reached, at_once: Reached, halves: Reached, length: float) -> None:
        """Refuse halves that differ too much from a step at once; find whether the next step may be longer (collective).

        Raises:
            StepAccuracyError: above the tolerance.
        """
        problem, control = self._problem, self._problem.progress.control
        stiffness = problem.bodies.stiffness
        assert stiffness is not None
        errors, changes = reduced(problem.comm, np.array([halves.apart(one, stiffness) for one in (at_once, start)]))
        control.largest_speed = max(control.largest_speed, float(np.sqrt(changes.sum())) / length)
        found = float(np.sqrt(errors.sum())) / control.largest_speed if control.largest_speed else 0.0
        if found > self._tolerance:
            raise StepAccuracyError(
                f"a load step of {length:.3g} and its halves differ by {found:.3g} of the largest change so far, above the tolerance "
                f"{self._tolerance:g}"
            )
        self.longer = SECOND_ORDER * found <= self._tolerance
