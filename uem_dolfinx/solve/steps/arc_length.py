"""Load steps of given arc length: the load factor is an additional unknown, to follow paths past limit points under dead load.

    Q'KP dq = Q'(r - K c) - dlam Q'F_lam,    a . (u + du - u0) + b (lam + dlam - lam0) = 1,    F_lam = dF/dlam

Riks' method is ``a = t / s``, ``b = 0`` with t the direction of the last step and s its length. This constraint plane is solved with a
single constrained matrix and two right-hand sides [Riks, International Journal of Solids and Structures 15 (1979) 529-551]. Lengths are
measured in the displacement only: other fields, with other units, have no part in t. ``Dissipation`` adds a dissipated energy.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import compat
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.laws.law import as_law, follows_load
from uem_dolfinx.contact.pair.cohesive import SofteningInterface
from uem_dolfinx.errors import ConvergenceError, InputError
from uem_dolfinx.log import say
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.solve.checks import refuse_other_fields
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.steps.dissipation import Dissipation, advise, refuse_other_laws
from uem_dolfinx.solve.united.equilibrium import InEquilibrium, IterationState
from uem_dolfinx.solve.united.newton import Increment, Iteration, LinearisedProblem
from uem_dolfinx.solve.united.rows import BodyState
from uem_dolfinx.solve.united.system import BodySystem

#: Difference of load factors over which the residual's derivative is taken; exact where the load is proportional to the factor.
#: [convention; load factor; test_arc_length.py::test_loads_that_are_not_proportional]
DIFFERENCE = 1e-4
#: The arc has its length to this part of it. [convention; arc length; test_arc_length.py::test_length_of_the_arc]
ON_THE_PLANE = 1e-8
#: A path that has not come to the full load after so many times the nominal number of steps is given up.
#: [bound; nominal number of steps; test_arc_length.py::test_path_without_end]
MOST_STEPS = 100


class ArcLength:
    """A problem's contact by elimination, with the load factor as additional unknown; a ``newton.ContactMethod``.

    Args:
        problem: with its method and load.
    """

    def __init__(self, problem: UnitedProblem):
        assert isinstance(problem.system, BodySystem)
        self._problem, self._system, self._bodies = problem, problem.system, problem.bodies
        self.factor = 0.0  # the present load factor
        #: Number of the displacement's components on this rank, which come first in vectors.
        self._n = problem.config.n_owned * problem.config.gdim
        #: Direction of the last step over the length of this one, and energy to dissipate, or infinity without.
        self._direction, self._energy = np.zeros(self._n), np.inf
        self._start, self._from = self._bodies.displacement(), 0.0  # displacement and load factor at the beginning of the step
        #: Change of the load factor in this iteration, and the residual's derivative with respect to it.
        self._change, self._slope = 0.0, problem.config.unknowns.vector()
        self.end_step, self.accelerate, self.forget = self._system.end_step, self._system.accelerate, self._system.forget
        self.complete, self.reduced_residual = self._system.complete, self._system.reduced_residual
        self.return_to_targets = self._system.return_to_targets

    def begin(self, factor: float, direction: Array, length: float, energy: float = np.inf) -> None:
        """Set the constraint of the next step.

        Args:
            factor: committed load factor.
            direction: of unit length over all ranks, at the displacement's owned components; shorter the more the last step dissipated.
            length: of the displacement increment along it.
            energy: to dissipate where direction is 0; infinity without a control by energy.
        """
        self._direction, self._energy = direction / length, energy
        self._start, self._from = self._bodies.displacement(), factor

    def begin_step(self) -> None:
        """Begin at the committed load factor, whatever factor a failed attempt has come to (collective)."""
        self._change = 0.0
        self._set(self._from)
        self._system.begin_step()

    def _set(self, factor: float) -> None:
        self.factor = factor
        self._problem.set_load(factor)

    def _over(self, values: Array) -> float:
        """Sum over all ranks of products with components of the displacement ``(n,)`` (collective)."""
        return float(reduced(self._problem.comm, values))

    def dissipated(self, way: Array, change: float) -> float:
        """Energy ``(lam0 f . way - change f . u0) / 2`` of an increment, for ``f = -F_lam`` (collective)."""
        f = -self._slope.array_r[: self._n]
        return 0.5 * self._over(self._from * (f @ way) - change * (f @ self._start.array_r[: self._n]))

    def _along(self, way: PETSc.Vec, change: float) -> float:
        """``a . way + b change`` of an increment in displacement and load factor (collective)."""
        u = way.array_r[: self._n]
        return self._over(self._direction @ u) + self.dissipated(u, change) / self._energy

    @property
    def _missing(self) -> float:
        """Missing part of the step (collective)."""
        return 1.0 - self._along(self._bodies.displacement() - self._start, self.factor - self._from)

    def place(self) -> None:
        """Project the contactors of displaced bodies, whose load factor has changed with the displacement."""
        self._set(self.factor + self._change)
        self._change = 0.0
        self._system.place()

    def assemble_constraints(self, in_equilibrium: InEquilibrium) -> IterationState:
        """The targets of the contactors and their equations; the state is closed only if the arc has its length."""
        state = self._system.assemble_constraints(in_equilibrium)
        there = abs(self._missing) <= ON_THE_PLANE
        return replace(state, closed=state.closed and there)

    def linearise(self, state: IterationState, iteration: int | None) -> LinearisedProblem:
        """Constrained matrix of a state, right-hand side without load increment, and the residual's derivative by the load factor."""
        if iteration is not None:
            self._differentiate()
        problem = self._system.linearise(state, iteration)
        # exact solves: near limit points, solutions with small residuals may have large errors, also in the load increment
        return problem._replace(exact=not problem.iterative, iterative=False, passing=True, convex=False)

    def _differentiate(self) -> None:
        """Derivative of the residual with respect to the load factor (collective)."""
        bodies, factor = self._bodies, self.factor
        before = self._system.residual()
        self._problem.set_load(factor + DIFFERENCE)
        bodies.assemble()
        self._slope = self._system.residual()
        self._slope.axpy(-1.0, before)
        self._slope.scale(1.0 / DIFFERENCE)
        self._problem.set_load(factor)
        bodies.assemble()

    def solve(self, problem: LinearisedProblem, accuracy: float, near: PETSc.Vec | None) -> Increment:
        """Unknowns with the load increment that satisfies the constraint plane."""
        system, state = self._system, problem.state
        load = state.test.transpose(self._slope)
        load.scale(-1.0)
        both = (problem._replace(rhs=rhs) for rhs in (problem.rhs, load))
        free, by_load = (system.complete(one, system.solve(one, accuracy, None)) for one in both)
        still = load.duplicate()
        still.set(0.0)
        along = self._along(by_load.du - system.move(state, still), 1.0)
        if along == 0.0:
            raise ConvergenceError("the load does not move the bodies in the direction they went: take smaller steps")
        self._change = (self._missing - self._along(free.du, 0.0)) / along
        dq, rhs = free.dq + self._change * by_load.dq, problem.rhs + self._change * load
        return Increment(dq, system.move(state, dq), rhs, free.linear_iterations + by_load.linear_iterations, free.left)

    def exchange(self, problem: LinearisedProblem, step: Increment) -> IterationState | None:
        """The state with a changed active set, as predicted under the new load; see ``ContactMethod``."""
        assert isinstance(problem.state, BodyState)
        forces = problem.state.forces + self._change * self._slope
        return self._system.exchange(problem._replace(state=replace(problem.state, forces=forces)), step)


class AlongArc:
    """Advances a problem by steps of given arc length; the first step, of given load, determines the length.

    The step after all damage that grew has separated has a given load as well, as the way that led there may have gone back.

    Args:
        by: energy to dissipate in a step; None for the arc length alone.

    Attributes:
        tried: intended length of the last step, relative to the arc of all nominal steps.
        most: largest number of steps relative to the nominal one, before the path is given up.
        longer: whether the next step may be longer if this one was easy.
    """

    def __init__(self, problem: UnitedProblem, by: Dissipation | None = None):
        if not isinstance(problem.system, BodySystem):
            raise InputError("arc_length needs contact by elimination: leave out the problem's method")
        for contact in problem.contacts:
            if follows_load(as_law(contact.friction)):
                raise InputError(
                    f"arc_length controls loads only, but friction of contact '{contact.name}' follows the load factor: "
                    "expected friction that does not"
                )
        if not problem.config.moves:
            refuse_other_fields(problem.config, "steps by arc length", "leave arc_length out")
        if by is not None:
            refuse_other_laws(problem.contacts, problem.materials)
        self._problem, self._arc, self._by = problem, ArcLength(problem), by
        self.tried, self.most, self.longer, self.shorter = 0.0, MOST_STEPS, 2.0, 0.5

    def advance(self, done: float) -> tuple[float, list[Iteration]]:
        """Take a step from the committed load factor ``done`` and commit it: the new factor, and the Newton loop's history (collective)."""
        problem, progress = self._problem, self._problem.progress
        before, self.tried, dissipating = np.array(problem.committed), progress.control.length, 0.0
        bonds = [pair for pair in problem.interfaces if isinstance(pair, SofteningInterface)]
        way = self._way(before - progress.start)
        size = self._size(way)
        if problem.verbose:
            say(f"load step {progress.control.number + 1}, along the arc from load factor {done:.6g}")
        if size == 0.0:
            # without a direction the load is given
            factor = min(1.0, done + self.tried)
            iterations = self._by_load(factor)
        else:
            energy = np.inf if self._by is None else self._by.energy * self.tried / progress.control.nominal
            self._arc.begin(done, (1.0 - progress.dissipating) * way / size, progress.reach * self.tried, energy)
            iterations = self._attempt(bonds)
            factor = self._arc.factor
            spent = self._arc.dissipated(self._way(np.array(problem.u.x.array) - before), factor - done)
            dissipating = float(np.clip(spent / energy, 0.0, 1.0))
            _check_values(problem)
            if factor > 1.0:
                # the last step has a given load, which is near
                factor = 1.0
                iterations = iterations[:-1] + self._by_load(factor)
        problem.commit()
        progress.start = before
        if progress.reach == 0.0:
            progress.reach = self._size(self._way(problem.committed - before)) / self.tried
            if progress.reach == 0.0:
                raise InputError("arc_length needs a load that moves the bodies: expected a load that F depends on")
        if dissipating > 0.0:
            grew, grows_on = np.any(problem.comm.allgather([pair.growth for pair in bonds] or [(False, False)]), axis=(0, 1))
            # what has separated dissipates no more, and the step in which it did may have gone back
            dissipating = dissipating if grows_on else 0.0
            if grew and not grows_on and not problem.solver.indefinite:
                progress.start = np.array(problem.committed)
        progress.dissipating = dissipating
        return factor, iterations

    def _attempt(self, bonds: Sequence[SofteningInterface]) -> list[Iteration]:
        """Equilibrium along the arc; an error names an energy that is too large (collective)."""
        try:
            return self._on_path(along=self._arc)
        except ConvergenceError as error:
            if self._by is not None:
                each = max((pair.largest_energy for pair in bonds), default=0.0)
                advise(error, self._by.energy, float(reduced(self._problem.comm, each, op=MPI.MAX)))
            raise

    def _by_load(self, factor: float) -> list[Iteration]:
        """Equilibrium under a given load, on the path."""
        self._problem.set_load(factor)
        _check_values(self._problem)
        return self._on_path()

    def _on_path(self, along: ArcLength | None = None) -> list[Iteration]:
        """Equilibrium on the path, which bodies do not leave where it becomes unstable."""
        system = self._problem.system
        assert isinstance(system, BodySystem)
        with system.exchanges.along_path():
            return self._problem.attempt(along=along)

    def _way(self, change: Array) -> Array:
        """Change of the displacement's owned components ``(n_owned * gdim,)``, from a change of all local unknowns ``(n,)``."""
        config = self._problem.config
        return np.asarray(config.of(change)[: config.n_owned]).ravel()

    def _size(self, way: Array) -> float:
        """Norm of an increment ``(n_owned * gdim,)`` (collective)."""
        return float(np.sqrt(reduced(self._problem.comm, way @ way)))


def _check_values(problem: UnitedProblem) -> None:
    """Refuse Dirichlet values that change with the load factor (collective)."""
    wanted = np.array(problem.committed)
    compat.set_bc_values(wanted, problem.bodies.bcs)
    wanted = problem.bodies.of_owners(wanted)
    with agreed(problem.comm):
        if not np.array_equal(wanted, problem.committed):
            at = problem.config.place_of(int(np.flatnonzero(wanted != problem.committed)[0]))
            raise InputError(
                f"arc_length controls loads only, but the Dirichlet values of {at} are not those of the committed state: expected values "
                "that do not change with the load factor; bring them there by load_steps of its own, with arc_length=False"
            )
