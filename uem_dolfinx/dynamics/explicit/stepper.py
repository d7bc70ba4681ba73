"""One explicit step: nodes with mass move by central differences, then the surface without mass comes into equilibrium in contact.

The surface's problem is that of a static step of the same united system, in which the nodes with mass have prescribed motion.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from copy import copy
from typing import Any

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.dynamics.explicit.critical import highest_eigenvalue
from uem_dolfinx.dynamics.explicit.surface import Prediction
from uem_dolfinx.dynamics.explicit.surface_solver import SurfaceSolver
from uem_dolfinx.errors import InvertedElementError, MassError, StepAccuracyError
from uem_dolfinx.parallel import gathered, reduced

#: A surface at rest makes the square of the highest frequency much larger if by more than this factor: contacts then change the step.
#: [convention; square of the highest frequency; test_explicit.py::test_stiff_contactors_do_not_shorten_steps]
STIFF_SURFACE = 1.25
#: Contacts that change the critical step bounce on a surface that is stiffer than the bodies: from their first touch on, steps are at
#: most this part of the critical one with closed contacts, so that they resolve the bounce.
#: [convention; critical step; test_explicit.py::test_a_thin_layer_at_the_wall]
RESOLVED = 0.25
#: How fast edges of cells are stretched is found anew after so many steps at most.
#: [convention; steps; test_explicit_materials.py::test_cells_that_are_flattened]
CHECKED_EVERY = 50
#: The critical step is found anew before an edge is stretched by more than this part, and where a step does that.
#: [convention; strain; test_explicit_materials.py::test_cells_that_are_flattened]
CHECKED_STRAIN = 0.1
#: A step stretches no edge of a vibration by more than this part: stiffnesses that change within a step make or take energy.
#: [convention; strain; test_explicit_materials.py::test_rubber_at_the_speed_of_its_waves]
STEADY_STRAIN = 0.1
#: A run ends where the shortest edge of all cells falls below this part of the mesh's shortest one: cells collapse, and steps with them.
#: [bound; the shortest edge; -]
COLLAPSED = 1e-3
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
        #: United system that a step solves, and how its solution is predicted.
        self.system, self.prediction = self._parts()
        #: Length that the last refused step might have had.
        self.limit = np.inf
        #: Part of the critical step that resolves closed contacts.
        self.part = 1.0
        from scipy.sparse import csr_matrix

        config = problem.config
        n_vertices, dofs = len(forms.reference_topology(compat.cell_name(config.mesh))[0]), compat.cell_dofs(config.V)
        pairs = np.sort(dofs[:, np.array(np.triu_indices(n_vertices, 1))].transpose(0, 2, 1).reshape(-1, 2), axis=1)
        edges = np.column_stack(np.divmod(np.unique(pairs @ [len(config.x), 1]), len(config.x)))
        ends = np.arange(0, edges.size + 1, 2)
        #: Differences of nodal values between the vertices of a cell ``(n, n_local)``.
        self._edges = csr_matrix((np.tile([1.0, -1.0], len(edges)), edges.ravel(), ends), shape=(len(edges), len(config.x)))
        #: Shortest distance of these vertices, and the fastest rate of stretching, as last looked at.
        self.shortest, self.rate = np.inf, 0.0
        self._of_mesh = self._lengths(config.X)
        self._least = COLLAPSED * reduced(problem.comm, float(self._of_mesh.min(initial=np.inf)), op=MPI.MIN)
        #: Whether accelerations may have stretched cells much in the last step.
        self.sudden = False
        self._inverse = np.where(self.moving, 1.0 / np.where(m > 0.0, m, 1.0), 0.0)

    def _parts(self) -> tuple[Any, Any]:
        """Make ``system`` and ``prediction`` (collective)."""
        # of the same bodies and contacts, with a solver of its own
        system = copy(self.problem.system)
        system.solver = SurfaceSolver(self.problem.config.unknowns, "uem_surface_")
        return system, Prediction(self.problem, system, self.interior)

    def forget(self) -> None:
        """Begin the next step as after a restart."""
        self.prediction.kept = False

    def begin(self) -> None:
        """Bring the surface into equilibrium at the start, and find the first accelerations (collective)."""
        problem, dynamics = self.problem, self.dynamics
        # no time passes, so that any length serves
        dynamics.begin(1.0)
        with problem.bodies.holding(self.interior):
            problem.attempt(start=problem.committed, system=self.system)
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
            self.prediction.predict(start)
            history = problem.attempt(start=start, system=self.system)
            a = self._accelerations()
        self._refuse_cells(dt, a, before)
        self._refuse_given_energy(dt)
        self.prediction.learn(history)
        dynamics.end_with(half + 0.5 * dt * a, a)
        problem.commit()
        return history

    def _accelerations(self) -> Array:
        """Accelerations of the moving components under the forces of bodies and contacts, zero elsewhere ``(n,)`` (collective)."""
        system = self.system
        return -self._inverse * system.rows.test.pass_on(system.residual()).array_r

    def pattern(self) -> tuple[int, ...]:
        """Fingerprint of the active contactors, if they change the critical step (collective)."""
        if not self.problem.step_control.of_contact:
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

    def _refuse_cells(self, dt: float, a: Array, before: tuple[int, ...]) -> None:
        """Refuse a step that turns a cell inside out, or is beyond the critical one of a state that differs much (collective).

        Args:
            dt: length of the step.
            a: accelerations at its end ``(n,)``.
            before: ``pattern`` at its beginning.

        Raises:
            InvertedElementError: with the place.
            StepAccuracyError: with both lengths.
        """
        problem, bodies, config, changed = self.problem, self.problem.bodies, self.problem.config, False
        if bodies.linear:
            # forces by a product do not show inverted cells
            if (where := bodies.inverted()) is not None:
                raise InvertedElementError(f"the cell at {where} is turned inside out: take a finer mesh there")
        else:
            largest = float(reduced(problem.comm, float(np.abs(a).max(initial=0.0)), op=MPI.MAX))
            self.sudden = 2.0 * largest * dt**2 > CHECKED_STRAIN * self.shortest
            if self.sudden:
                length, start = self._lengths(config.x), self._lengths(config.X + config.of(problem.committed))
                strain = float((np.abs(length - start) / start).max(initial=0.0))
                changed = reduced(problem.comm, strain, op=MPI.MAX) > CHECKED_STRAIN
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
        for pair in problem.system.pairs:
            opened = pair.committed.active & ~pair.trial.active
            given += (
                0.5 * float((pair.committed.lam * np.maximum(pair.kinematics.gap, 0.0))[opened].sum()) if opened.any() else 0.0
            )
        words = control.too_much(reduced(problem.comm, given), dt, self.dynamics.kinetic_energy)
        if words is not None:
            control.refuse_energy(words, dt)

    def _highest_square(self) -> float:
        """Square of the highest frequency by the present tangent (collective).

        The surface follows the masses in equilibrium: its stiffness alone does not count. If a surface at rest would hardly make the
        frequency higher, that bound is taken, which no contact exceeds; otherwise ``of_contact`` is set, as contacts change the step.
        """
        problem, control = self.problem, self.problem.step_control
        problem.bodies.update_tangent()
        fixed = self._highest(self._stiffness_if_fixed)
        with problem.bodies.holding(self.interior):
            # inertia holds the bodies, not supports
            self.system.floating.begin_motion()
            system, self._P = self.system, self.system.restriction()
            system.solver.set_operator(self._P, problem.bodies.tangent.K, None, self._P)
            condensed = self._highest(self._stiffness)
        stiff = fixed > STIFF_SURFACE * condensed
        # closed contacts leave nothing of the surface that could be at rest
        closed = control.of_contact and reduced(problem.comm, int(any(pair.united.any() for pair in problem.interfaces))) > 0
        control.of_contact, self.part = stiff or closed, RESOLVED if closed else 1.0
        return condensed if stiff else fixed

    def _differences(self, of: Array) -> Array:
        """Differences of nodal values ``(n_local, gdim)`` along all edges ``(n, gdim)``."""
        return np.asarray(self._edges @ of)

    def _lengths(self, of: Array) -> Array:
        """Lengths of these differences ``(n,)``."""
        along = self._differences(of)
        return np.sqrt(np.einsum("ng,ng->n", along, along))

    def look(self, stretch: float = np.inf) -> float:
        """Find how fast the velocities stretch edges of cells, and the shortest edge (collective).

        Args:
            stretch: of edges since the critical step was found, as far as known.

        Returns:
            This stretch, or that since the start if this is less than changes the critical step.

        Raises:
            InvertedElementError: if this is a small part of the shortest one of the mesh.
        """
        config = self.problem.config
        v = self.dynamics.velocity.x.array.reshape(-1, config.gdim)
        length = self._lengths(config.x)
        found = self._lengths(v) / length, 1.0 / length, np.abs(length / self._of_mesh - 1.0)
        self.rate, inverse, strain = reduced(self.problem.comm, np.array([of.max(initial=0.0) for of in found]), op=MPI.MAX)
        self.shortest = 1.0 / inverse
        if self.shortest < self._least:
            raise InvertedElementError(
                f"cells collapse: their shortest edge, {self._least / COLLAPSED:.3g} at the start, is {self.shortest:.3g}; "
                "take a finer mesh, or lower speeds"
            )
        return float(strain) if strain < CHECKED_STRAIN else stretch

    def steps_to_look(self, dt: float, stretch: float) -> int:
        """Number of steps of length ``dt`` until edges are stretched as far as they may, of which ``stretch`` is done; 0 for none."""
        strain = dt * self.rate
        left = max(CHECKED_STRAIN - stretch, 0.0)
        return int(min(left / strain, CHECKED_EVERY)) if strain > 0.0 else CHECKED_EVERY

    def steady_step(self, critical: float) -> float:
        """Longest step in which no edge is stretched further than it may, so that stiffnesses hardly change (collective).

        An edge of the highest frequency, ``2 / critical``, vibrates with rates up to ``sqrt(v^2 + (a critical / 2)^2)``, in any phase.
        """
        config, dynamics = self.problem.config, self.dynamics
        if self.problem.bodies.linear or not np.isfinite(critical):
            return np.inf
        along = self._differences(config.x)
        nodal = (of.x.array.reshape(-1, config.gdim) for of in (dynamics.velocity, dynamics.acceleration))
        # turning does not stretch
        v, a = ((self._differences(of) * along).sum(axis=1) for of in nodal)
        rates = np.hypot(v, 0.5 * critical * a) / (along**2).sum(axis=1)
        fastest = float(reduced(self.problem.comm, float(rates.max(initial=0.0)), op=MPI.MAX))
        return STEADY_STRAIN / fastest if fastest > 0.0 else np.inf

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
        P, solver = self._P, self.system.solver
        du = P.carried(field.reshape(-1, self.problem.config.gdim))
        dq, _ = solver.solve(-P.transpose(self._times_K(du)), 0.0)
        du.axpy(1.0, P.expand(solver.complete(dq)))
        return np.array(P.pass_on(self._times_K(du)).array_r) * self.moving
