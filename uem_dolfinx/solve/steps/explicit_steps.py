"""Explicit time steps: lengths by the critical step, and the loop.

Explicit steps for contactors that keep their mass: nodes move freely, then contact, ties and equations correct them by a united system.

Bodies move by central differences to ``u*``. With the masses M in place of the stiffness, the united system

    P'(M / dt^2) P dq = P'((M / dt^2) (u* - u) - (M / dt^2) c)

finds the nearest state, in the norm of M, whose gaps are closed and whose contactors stick or slip: contact forces act for the whole step.
A node that touches takes the normal velocity of its target, as in a plastic impact: what is lost is the energy of the surface's mass.
Where contact lasts, the equations of the last step predict this state, from a factorisation that is kept.
"""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from types import SimpleNamespace
from typing import Any

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.warnings.checks import check_moved
from uem_dolfinx.dynamics.explicit.part_solver import MassSolver
from uem_dolfinx.dynamics.explicit.stepper import ExplicitStepper
from uem_dolfinx.errors import InputError, MassError, StepAccuracyError, UEMError
from uem_dolfinx.log import logger
from uem_dolfinx.solve.bodies.bodies import FORCE_ROUNDING, Bodies
from uem_dolfinx.solve.bodies.tangent import driven_on, not_finite
from uem_dolfinx.solve.stepping import TimeStep, events, touching


class InertBodies(Bodies):
    """Bodies of a problem without stiffness, whose nodes return to a freely moved state by their inertia over a step.

    Args:
        bodies: of the problem.
        mass: of the owned components ``(n,)``.
    """

    def __init__(self, bodies: Bodies, mass: Array):
        self.__dict__.update(bodies.__dict__)
        self._mass, self._b = mass, compat.create_vector(bodies.u.function_space)
        self.materials, self.dead, self._assembled_at, self.inversions = [], None, None, None
        # lines of a node have the same columns, as in K
        g = bodies.config.gdim
        K = PETSc.Mat().createAIJ(bodies.tangent.K.getSizes(), bsize=g, nnz=g, comm=bodies.comm)
        first, last = K.getOwnershipRange()
        for node in range(first // g, last // g):
            K.setValuesBlocked([node], [node], np.zeros((g, g)))
        K.assemble()
        K.setOption(PETSc.Mat.Option.SPD, True)
        #: M over the square of the step.
        self.tangent: Any = SimpleNamespace(K=K, linear=True, given=False, bare=None, number=0, points=None, update=lambda: None)
        self.free_to: Array = np.zeros(len(mass))
        self._factor = np.zeros(0)
        self.begin(1.0, self.free_to)

    def begin(self, dt: float, free_to: Array) -> None:
        """Begin a step of length ``dt`` in which nodes without contact would move to ``free_to (n,)`` (collective)."""
        self.free_to = free_to
        factor = np.where(self._mass > 0.0, self._mass, 1.0) / dt**2
        if np.array_equal(factor, self._factor):
            return
        self._factor = factor
        diagonal = self.unknowns.vector()
        diagonal.array[:] = factor
        self.tangent.K.setDiagonal(diagonal)
        self.tangent.K.assemble()
        self.stiffness = self.stiffness_at_start = factor.reshape(-1, self.config.gdim)

    def assemble(self, write: Any = None) -> bool:
        """Inertia forces on the way from the freely moved state; whether they are finite on all ranks (collective)."""
        self._b.array[:] = self._factor * (self._u.array_r - self.free_to)
        return bool(np.isfinite(self._b.norm()))

    def above_rounding(self, positioned: bool) -> Any:
        """As of bodies; where nodes are moved to, as those of rigid parts, is rounded as positions are (collective)."""
        return super().above_rounding(True)

    def update_tangent(self) -> PETSc.Mat:
        """M over the square of the step."""
        return self.tangent.K


class StepperWithMass(ExplicitStepper):
    """Explicit steps of a problem whose contactors have mass, as ``ExplicitStepper``; MassError if a free component has none."""

    def __init__(self, problem: Any):
        super().__init__(problem)
        bare = problem.comm.allreduce(int((~self.moving & ~self.dynamics.held).sum()))
        if bare:
            raise MassError(
                f"{bare} free components have no mass, which CentralDifferences with contactors='massy' cannot move: give all bodies "
                "a density, or take contactors='massless'"
            )

    def _parts(self) -> tuple[Any, Any]:
        """Make ``system``, whose solution is not predicted (collective)."""
        problem = self.problem
        self.bodies = InertBodies(problem.bodies, self._mass)
        # the contacts stay in their state, which may be that of a checkpoint
        system = copy(problem.system)
        system.bodies, system.solver = self.bodies, MassSolver(problem.config.unknowns, "uem_masses_")
        # the turning of normals within a step hardly changes P'MP
        system.consistent_tangent, system.newton = False, "modified"
        system.take(problem.interfaces, problem.linear)
        return system, None

    def forget(self) -> None:
        """A step depends on its beginning alone."""

    def begin(self) -> None:
        """Find the first accelerations (collective)."""
        self.dynamics.begin(1.0)
        a = self._accelerations()
        self.dynamics.restore()
        self.dynamics.change_rates(np.array(self.dynamics.velocity.x.array[: self._n]), a)
        self.dynamics.accelerated = True
        self.problem.keep()

    def step(self, dt: float) -> Any:
        """Take a step of length ``dt`` and commit it; returns the history of iterations for contact (collective)."""
        problem, dynamics, bodies, n = self.problem, self.dynamics, self.bodies, self._n
        v, a, mean = (of.x.array[:n] for of in (dynamics.velocity, dynamics.acceleration, dynamics.mean_velocity))
        half, begin = v + 0.5 * dt * a, problem.committed[:n]
        if last := dynamics.last:
            # contact does not act between the middles of steps of other length, either
            half += (1.0 - dt / last) * (0.25 * last * a - 0.5 * (v - mean))
        free_to = np.array(problem.committed)
        free_to[:n] += dt * half
        compat.set_bc_values(free_to, bodies.bcs)
        bodies.wanted[:] = bodies.of_owners(free_to)
        dynamics.begin(dt)
        try:
            bodies.begin(dt, free_to[:n])
            self._predict(free_to)
            for pair in problem.interfaces:
                check_moved(pair)
            history = problem.converge(bodies, self.system, problem.committed)
        except UEMError:
            problem.restore()
            raise
        a = self._accelerations()
        self._refuse_cells(dt, a, ())
        # forces of contact act for the whole step, between the mean velocities of two steps
        ends, kick = (problem.u.x.array[:n] - begin) / dt, 0.5 * dt * a
        struck = 0.5 * float((self._mass * (ends - half) * (mean + ends))[self.moving].sum())
        # contact takes part in the change of the velocity, and the next step starts with the velocity in its middle all the same
        taken = self._along_contact(kick) if history[-1].active or problem.linear is not None else kick
        dynamics.end_with(ends + taken, a + (kick - taken) * 2.0 / dt, struck)
        problem.commit()
        return history

    def _predict(self, free_to: Array) -> None:
        """Move all nodes to ``free_to (n,)``, as far as the equations of the last state let them (collective)."""
        problem, bodies, system = self.problem, self.bodies, self.system
        rows = system.rows_of_last()
        P, Q = rows.frictionless, rows.test
        if problem.linear is not None or not Q.n_equations:
            system.solver.renew()
            bodies.u.x.array[:] = free_to
            bodies.u.x.scatter_forward()
            return
        way = (free_to - problem.committed)[: self._n].reshape(P.free.shape)
        bodies.move(P.carried(np.where(P.free, 0.0, way)))
        bodies.assemble()
        system.solver.set_operator(P, bodies.tangent.K, None, Q)
        dq, _ = system.solver.solve(-Q.transpose(system.residual()))
        bodies.move(P.expand(dq))
        compat.set_bc_values(bodies.u.x.array, bodies.bcs)

    def _along_contact(self, change: Array) -> Array:
        """Change of velocities ``(n,)`` by a kick and the impulses of contact and equations (collective)."""
        M, rows, solver = self.bodies.tangent.K, self.system.rows, self.system.solver
        assert rows is not None
        P, Q = rows.frictionless, rows.test
        solver.set_operator(P, M, None, Q)
        dq, _ = solver.solve(Q.transpose(forms.product(M, self.problem.config.unknowns.vector(change))), 0.0)
        return np.array(P.expand(solver.complete(dq)).array_r)[: self._n]

    def _accelerations(self) -> Array:
        """Accelerations of the moving components under the forces of the bodies, zero elsewhere ``(n,)`` (collective)."""
        bodies = self.problem.bodies
        if not bodies.assemble():
            raise not_finite(bodies, "at the end of the step", "check loads and material parameters for NaN and division by zero")
        return np.asarray(-self._inverse * bodies.residual.array_r)

    def _highest_square(self) -> float:
        """Square of the highest frequency by the present tangent (collective)."""
        self.problem.bodies.update_tangent()
        return self._highest(self._stiffness_if_fixed)


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
        InputError: if ``dt`` exceeds the critical step, or strains cells too far, or if the stiffness at the start is negative.
    """
    control, dynamics = problem.step_control, problem.dynamics
    kind: type[ExplicitStepper] = ExplicitStepper
    if dynamics.contactors == "massy":
        kind = StepperWithMass
    stepper = kind(problem)
    resumed = dt is None and dynamics.resumed and dynamics.time > dynamics.start
    problem.set_load(dynamics.time)
    if not dynamics.accelerated:
        # no inertia may hide what the bodies' own stiffness drives on
        with dynamics.without_inertia():
            diagonal = problem.bodies.initial_stiffness() * problem.bodies.free[: problem.config.n_owned]
        if words := driven_on(problem.config, diagonal, FORCE_ROUNDING):
            raise InputError(words)
        stepper.begin()
    if dynamics.time >= end:
        return
    length, before, pattern = control.nominal if resumed else _length(stepper, dt, end), touching(problem), stepper.pattern()
    control.begin(length)
    stepper.look()
    if resumed:
        stepper.count_from(control.known_at.x.array)
        stepper.shortest = control.shortest
    else:
        # bodies that touch deform from the first step on
        control.looked(stepper.shortest)
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
            stepper.look()
            anew = end - dynamics.time > LEFT * length and (found or not stepper.steps_to_look(length))
            if anew:
                length = _length(stepper, dt, end)
                control.begin(length)
            control.looked(stepper.shortest, stepper.steps_to_look(length, anew))
        # a checkpoint holds what the next step begins with
        yield done


def _length(stepper: ExplicitStepper, dt: float | None, end: float) -> float:
    """Length of steps that divide the time to the end; InputError for a given one that is too long (collective)."""
    critical, dynamics = stepper.critical_step(), stepper.dynamics
    stepper.count_from(stepper.problem.committed)
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
    resolved = control.resolve(stepper.part * longest if stepper.part < 1.0 else np.inf)
    longest = min(longest, resolved, steady)
    remainder = end - dynamics.time
    # the same on any ranks: rounding of the critical step does not change the number of steps
    length = remainder / max(np.ceil(remainder / longest - LEFT), 1.0)
    logger.debug("critical step %.6g, taken %.6g", critical, length)
    return float(length)
