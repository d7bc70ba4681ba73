"""One explicit step: nodes with mass move by central differences, then the surface without mass comes into equilibrium in contact.

The surface's problem is that of a static step of the same united system, in which the nodes with mass have prescribed motion.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.dynamics.explicit.critical import highest_eigenvalue
from uem_dolfinx.dynamics.explicit.surface import SurfaceSolver
from uem_dolfinx.dynamics.scheme import MOST_GIVEN, SHORTEST_GIVEN
from uem_dolfinx.errors import EnergyGivenError, MassError, StepAccuracyError
from uem_dolfinx.parallel import gathered, reduced

#: A surface at rest makes the square of the highest frequency much larger if by more than this factor: contacts then change the step.
#: [convention; square of the highest frequency; test_explicit.py::test_stiff_contactors_do_not_shorten_steps]
STIFF_SURFACE = 1.25
#: Contacts that change the critical step bounce on a surface that is stiffer than the bodies: from their first touch on, steps are at
#: most this part of the critical one with closed contacts, so that they resolve the bounce.
#: [convention; critical step; test_explicit.py::test_a_thin_layer_at_the_wall]
RESOLVED = 0.25
#: The critical step is found anew after so many steps at most, since bodies may yield or turn.
#: [convention; steps; test_explicit_materials.py::test_cells_that_are_flattened]
CHECKED_EVERY = 50
#: It is found anew before the velocities stretch a cell by more than this part, and where accelerations change that by as much in a step.
#: [convention; strain; test_explicit_materials.py::test_cells_that_are_flattened]
CHECKED_STRAIN = 0.1
#: Wave numbers along the axes, times the model's size, of the field that frequencies are sought from.
#: [format; wave numbers; -]
IRRATIONAL = 1e3 * np.array([1.0, np.sqrt(2.0), np.sqrt(3.0)])


class ExplicitStepper:
    """Explicit steps of a problem (collective).

    Args:
        problem: a ``UnitedProblem`` with central differences.

    Raises:
        MassError: if nothing has mass.
    """

    def __init__(self, problem: Any):
        self.problem, self.dynamics, bodies = problem, problem.dynamics, problem.bodies
        self._n = problem.config.n_owned * problem.config.gdim
        m = self.dynamics.mass.of_nodes.ravel()
        heavy = np.zeros(len(bodies.held), dtype=bool)
        heavy[: self._n] = m > 0.0
        #: Unknowns whose motion the masses determine, ghosts included, and of them those of this rank without conditions.
        self.interior: Bools = bodies.of_owners(heavy)
        self.moving: Bools = heavy[: self._n] & ~self.dynamics.held
        if not problem.comm.allreduce(int(heavy.sum())):
            raise MassError("central differences need nodes with mass, and there are none: check the density")
        self._mass = m
        self.surface = SurfaceSolver(problem)
        #: Length that the last refused step might have had.
        self.limit = np.inf
        #: Part of the critical step that resolves closed contacts.
        self.part = 1.0
        #: Whether contacts change the critical step, and the shortest edge of a cell when it was last found.
        self.of_contact, self._shortest = False, np.inf
        self._inverse = np.where(self.moving, 1.0 / np.where(m > 0.0, m, 1.0), 0.0)

    def begin(self) -> None:
        """Bring the surface into equilibrium at the start, and find the first accelerations (collective)."""
        problem, dynamics = self.problem, self.dynamics
        # no time passes, so that any length serves
        dynamics.begin(1.0)
        with problem.bodies.holding(self.interior):
            problem.attempt(start=problem.committed)
            a = self._accelerations()
        dynamics.restore()
        problem.keep()
        dynamics.change_rates(np.array(dynamics.velocity.x.array[: self._n]), a)
        dynamics.accelerated = True

    def step(self, dt: float) -> Any:
        """Take a step of length ``dt`` and commit it; returns the history of iterations for the surface (collective)."""
        problem, dynamics, n = self.problem, self.dynamics, self._n
        # the surface, without acceleration, starts with its last velocity
        half = dynamics.velocity.x.array[:n] + 0.5 * dt * dynamics.acceleration.x.array[:n]
        start, before = np.array(problem.committed), self.pattern()
        start[:n] += dt * half
        dynamics.begin(dt)
        with problem.bodies.holding(self.interior):
            self.surface.predict(start)
            history = problem.attempt(start=start)
            a = self._accelerations()
        self._refuse_long(dt, a, before)
        self._refuse_given_energy(dt)
        self.surface.learn(history)
        problem.commit()
        dynamics.change_rates(np.where(self.moving, half + 0.5 * dt * a, dynamics.velocity.x.array[:n]), a)
        return history

    def _accelerations(self) -> Array:
        """Accelerations of the moving components under the forces of bodies and contacts, zero elsewhere ``(n,)`` (collective)."""
        system = self.problem.system
        return -self._inverse * system.rows.test.pass_on(system.residual()).array_r

    def pattern(self) -> tuple[int, ...]:
        """Fingerprint of the active contactors, if they change the critical step (collective)."""
        if not self.of_contact:
            return ()
        own = zlib.crc32(b"".join(pair.united.tobytes() for pair in self.problem.interfaces))
        return tuple(gathered(self.problem.comm, np.array(own)))

    # -- critical step ---------------------------------------------------------------------------------------------------

    def critical_step(self) -> float:
        """Longest stable step in the present state, infinite without stiffness (collective).

        With the largest eigenvalues k and c of stiffness and damping over mass it is ``2 / r`` of ``r^2 = k + r c``. Damping
        forces are those of the velocity in the middle of the step before.
        """
        # committed stresses are on the yield surface, from where the tangent is elastic, as it is in unloading
        self.problem.bodies.restore()
        with self.dynamics.without_inertia():
            k = self._highest_square()
        if k <= 0.0:
            return np.inf
        c = 0.0
        if self.dynamics.damping is not None:
            with self.dynamics.without_inertia(np.sqrt(k)):
                c = max(self._highest_square() - k, 0.0) / np.sqrt(k)
        return float(4.0 / (c + np.sqrt(c**2 + 4.0 * k)))

    def _refuse_long(self, dt: float, a: Array, before: tuple[int, ...]) -> None:
        """Refuse a step beyond the critical one of the state at its end, if this differs much from the state before (collective).

        Args:
            dt: length of the step.
            a: accelerations at its end ``(n,)``.
            before: ``pattern`` at its beginning.

        Raises:
            StepAccuracyError: with both lengths.
        """
        problem = self.problem
        if changed := not problem.bodies.linear:
            largest = reduced(problem.comm, float(np.abs(a).max(initial=0.0)), op=MPI.MAX)
            changed = 2.0 * largest * dt**2 > CHECKED_STRAIN * self._shortest
        if not changed and self.pattern() == before:
            return
        critical = self.critical_step()
        if dt > self.part * critical:
            self.limit = self.part * critical
            raise StepAccuracyError(
                f"a step of {dt:.4g} is too long for the critical step {critical:.4g} of the contact and the cells at its end"
            )

    def _refuse_given_energy(self, dt: float) -> None:
        """Refuse a step in which contacts that open do work on the bodies, with half of their last force (collective).

        Raises:
            EnergyGivenError: if this exceeds the limit, and a shorter step may be better.
        """
        problem, control, given = self.problem, self.problem.step_control, 0.0
        for pair in problem.interfaces:
            opened = pair.committed.active & ~pair.trial.active
            given += 0.5 * float((pair.committed.lam * np.maximum(pair.gap, 0.0))[opened].sum()) if opened.any() else 0.0
        given = reduced(problem.comm, given)
        if given <= MOST_GIVEN * control.largest_energy:
            return
        control.largest_energy = max(control.largest_energy, self.dynamics.kinetic_energy())
        if given > MOST_GIVEN * control.largest_energy and dt > SHORTEST_GIVEN * control.nominal:
            raise EnergyGivenError(
                f"contacts that open give the bodies {given:.3g} of energy within a step of {dt:.3g}, which have had "
                f"{control.largest_energy:.3g}"
            )

    def _highest_square(self) -> float:
        """Square of the highest frequency by the present tangent (collective).

        The surface follows the masses in equilibrium: its stiffness alone does not count. If a surface at rest would hardly make the
        frequency higher, that bound is taken, which no contact exceeds; otherwise ``of_contact`` is set, as contacts change the step.
        """
        problem = self.problem
        problem.bodies.update_tangent()
        fixed = self._highest(self._stiffness_if_fixed)
        with problem.bodies.holding(self.interior):
            # inertia holds the bodies, not supports
            problem.system.floating.begin_motion()
            system, self._P = problem.system, problem.system.restriction()
            system.solver.set_operator(self._P, problem.bodies.tangent.K, None, self._P)
            condensed = self._highest(self._stiffness)
        stiff = fixed > STIFF_SURFACE * condensed
        # closed contacts leave nothing of the surface that could be at rest
        closed = self.of_contact and reduced(problem.comm, int(any(pair.united.any() for pair in problem.interfaces))) > 0
        self.of_contact, self.part = stiff or closed, RESOLVED if closed else 1.0
        return condensed if stiff else fixed

    def steps_to_check(self, dt: float) -> int:
        """Number of steps of length ``dt`` after which the critical step is found anew (collective)."""
        config = self.problem.config
        n_vertices = len(forms.reference_topology(compat.cell_name(config.mesh))[0])
        v, vertices = self.dynamics.velocity.x.array.reshape(-1, config.gdim), compat.cell_dofs(config.V)[:, :n_vertices]
        one, other = vertices[:, np.array(np.triu_indices(n_vertices, 1))].transpose(1, 0, 2)
        speed, length = (np.linalg.norm(of[one] - of[other], axis=2) for of in (v, config.x))
        rates = [float((speed / length).max(initial=0.0)), float((1.0 / length).max(initial=0.0))]
        rate, inverse = reduced(self.problem.comm, np.array(rates), op=MPI.MAX)
        strain, self._shortest = dt * rate, 1.0 / inverse
        return int(np.clip(CHECKED_STRAIN / strain, 1, CHECKED_EVERY)) if strain > 0.0 else CHECKED_EVERY

    def _highest(self, apply: Callable[[Array], Array]) -> float:
        config, mass = self.problem.config, self._mass * self.moving
        along = config.X[: config.n_owned] @ IRRATIONAL[: config.gdim] / config.size
        start = np.sin(along[:, None] + np.arange(config.gdim)).ravel()
        return highest_eigenvalue(apply, mass, start, self.problem.comm)

    def _times_K(self, field: PETSc.Vec) -> PETSc.Vec:
        return forms.product(self.problem.bodies.tangent.K, field)

    def _stiffness_if_fixed(self, field: Array) -> Array:
        """K times a field of the moving components, with all others at rest ``(n,)`` (collective)."""
        return np.array(self._times_K(self.problem.config.unknowns.vector(field)).array_r) * self.moving

    def _stiffness(self, field: Array) -> Array:
        """``K_II - K_IS K_SS^-1 K_SI`` times a field, with the constraints of contact on the surface ``(n,)`` (collective)."""
        P, solver = self._P, self.problem.system.solver
        du = P.carried(field.reshape(-1, self.problem.config.gdim))
        dq, _ = solver.solve(-P.transpose(self._times_K(du)), 0.0)
        du.axpy(1.0, P.expand(solver.complete(dq)))
        return np.array(P.pass_on(self._times_K(du)).array_r) * self.moving
