"""Load steps whose length follows their error: each is taken at once and in two halves, which differ by what the path is cut into."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.conditions.rigid_set import velocities
from uem_dolfinx.errors import StepAccuracyError
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.checks import depends_on_path
from uem_dolfinx.solve.loading import values_at
from uem_dolfinx.solve.memory import Memory
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.steps.by_load import ByLoad
from uem_dolfinx.solve.united.newton import Iteration

#: The error of a load step grows so much if its length doubles.
#: [derived; error; test_accuracy_of_load_steps.py::test_steps_are_doubled_in_load]
SECOND_ORDER = 4.0
#: Loads are compared with a straight way between so many points of each half of a step: a load that turns between two of these is not seen.
#: [bound; points; test_accuracy_of_load_steps.py::test_a_load_that_turns]
LOOKS = 4


@dataclass(frozen=True)
class Reached:
    """What a step leads to at this rank's nodes."""

    u: Array  # displacements ``(n_owned, gdim)``
    forces: Array  # forces of contacts and supports, which the bodies' residual leaves ``(n_owned, gdim)``

    @classmethod
    def of(cls, problem: UnitedProblem) -> Reached:
        """At the present displacement (collective)."""
        problem.bodies.assemble()
        u = problem.config.of(np.array(problem.u.x.array))[: problem.config.n_owned]
        return cls(u, np.array(problem.bodies.forces))

    @classmethod
    def loaded(cls, problem: UnitedProblem, factor: float) -> Reached:
        """Dirichlet values, and forces at the committed displacement, under the load of a factor (collective).

        Active contactors on rigid surfaces have the opposite of the displacement of these, which slip depends on, and move by offsets.
        Nodes of rigid couplings move by the prescribed components.
        """
        problem.set_load(factor)
        there, n, bodies = cls.of(problem), problem.config.n_owned, problem.bodies
        values = problem.config.of(np.where(bodies.held, values_at(problem.committed, bodies.bcs), problem.committed))[:n]
        for pair, before in zip(problem.interfaces, problem.motions):
            now, x, active = pair.target.motion, pair.points, pair.committed.active
            X = x if before is None else before.back(x)
            values[pair.nodes[active]] += (x - (X if now is None else now.carry(X)))[active]
            if (offset := pair.discretisation.setting.offset) is not None:
                values[pair.nodes[active]] += (offset[:, None] * pair.kinematics.normal)[active]
        for one in problem.couplings:
            at = one.nodes.placement(problem.config.of(problem.committed)[:n])
            rates = velocities(at.arms(one.nodes.X) - at.arms(one.point[None]))
            values[one.nodes.nodes] += rates[:, :, list(one.prescribed)] @ one.wanted()
        return cls(values, there.forces)

    def apart(self, other: Reached, stiffness: Array) -> Array:
        """Works, in the present stiffness, of the difference in displacements and in forces ``(2,)``."""
        weights = _weights(stiffness)
        return np.array([(weights[0] * (self.u - other.u) ** 2).sum(), (weights[1] * (self.forces - other.forces) ** 2).sum()])

    def away(self, other: Reached, stiffness: Array) -> Array:
        """The difference as a vector, of which the square is the sum of these works ``(2, n_owned, gdim)``."""
        return np.asarray(np.sqrt(_weights(stiffness)) * [self.u - other.u, self.forces - other.forces])


def _weights(stiffness: Array) -> tuple[Array, Array]:
    """Stiffness of each component and its inverse, zero where it vanishes."""
    weight = np.abs(stiffness)
    return weight, np.divide(1.0, weight, out=np.zeros_like(weight), where=weight > 0.0)


class ByError(ByLoad):
    """Advances a problem by steps of given load, each of which two halves confirm.

    Backward steps along a path have an error of second order in their length, so that a step and its halves differ by the error of
    the halves. Where the path does not matter, as without friction and plasticity, they agree. Where it does, loads that are functions
    must lead straight from the beginning of each half to its end, up to the tolerance: the halves would not see where they turn.

    Args:
        tolerance: bound on the error of a step, relative to the largest change over the whole load at the speeds so far. The error over the
            length does not vanish with it in steps where contactors begin to slip, or material to yield, so that it has no bound.
    """

    def __init__(self, problem: UnitedProblem, tolerance: float):
        super().__init__(problem)
        self._tolerance = tolerance

    def _step(self, done: float, factor: float) -> list[Iteration]:
        """Reach a load factor by two steps, whose difference from one step is their error, and commit these (collective)."""
        problem, self.shorter = self._problem, 0.5
        turns = callable(problem.load) or any(given.function(value) for one in problem.couplings for value in one.values_given())
        turn = self._largest_turn(done, factor) if turns and depends_on_path(problem) else 0.0
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
            self._refuse_error(start, at_once, Reached.of(problem), factor - done, turn)
        except BaseException:
            before.put_back(problem)
            raise
        problem.commit()
        return [*first, *second[1:]]

    def _largest_turn(self, done: float, factor: float) -> float:
        """Distance of the load of either half from its straight path, or along it backwards, the root of a work (collective)."""
        problem = self._problem
        stiffness = problem.bodies.stiffness
        if stiffness is None:
            problem.bodies.update_tangent()
            stiffness = problem.bodies.stiffness
        assert stiffness is not None
        found = 0.0
        for ends in ((done, 0.5 * (done + factor)), (0.5 * (done + factor), factor)):
            first, *others = [Reached.loaded(problem, float(at)) for at in np.linspace(*ends, LOOKS + 1)]
            away = np.array([one.away(first, stiffness).ravel() for one in others])
            dots = reduced(problem.comm, away @ away[-1])
            way = dots[-1]
            along = dots / way if way else np.zeros(LOOKS)
            nearest = np.clip(along, 0.0, 1.0)
            apart = reduced(problem.comm, ((away - nearest[:, None] * away[-1]) ** 2).sum(axis=1))
            back = np.maximum.accumulate(along) - along
            found = max(found, float(apart.max()), float(back.max()) ** 2 * float(way))
        return float(np.sqrt(found))

    def _refuse_error(self, start: Reached, at_once: Reached, halves: Reached, length: float, turn: float) -> None:
        """StepAccuracyError for halves that differ too much from a step at once; find whether the next may be longer (collective)."""
        problem, control = self._problem, self._problem.progress.control
        stiffness = problem.bodies.stiffness
        assert stiffness is not None
        errors, changes = reduced(problem.comm, np.array([halves.apart(one, stiffness) for one in (at_once, start)]))
        control.largest_speed = max(control.largest_speed, max(float(np.sqrt(changes.sum())), turn) / length)
        turns = turn > (error := float(np.sqrt(errors.sum())))
        found = max(error, turn) / control.largest_speed if control.largest_speed else 0.0
        # a step that is less than twice as long as it may be is cut by the root of half alone, which halves its error
        self.shorter = 0.5 if found > np.sqrt(SECOND_ORDER) * self._tolerance else np.sqrt(0.5)
        if found > self._tolerance:
            other, remedy = ("its straight load", ": choose steps that end where the load turns") if turns else ("its halves", "")
            raise StepAccuracyError(
                f"a load step of {length:.3g} and {other} differ by {found:.3g} of the largest change so far, above the tolerance "
                f"{self._tolerance:g}{remedy}"
            )
        self.longer = 2.0 if SECOND_ORDER * found <= self._tolerance else 1.0
