"""Inertia: velocities, accelerations and inertia forces, by Newmark's method or the generalised-alpha method.

The solver adds these forces to the static residual, and a multiple of M to K.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc
from ufl.core.expr import Expr

from uem_dolfinx import compat, given
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Bools
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.dynamics.mass import Mass
from uem_dolfinx.dynamics.scheme import CentralDifferences, Scheme, newmark
from uem_dolfinx.errors import InputError, InputTypeError, NotFiniteError, SpaceError
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import agree, agreed, ask_together, reduced

if TYPE_CHECKING:
    from uem_dolfinx.dynamics.added_mass import AddedMass

#: Initial state of a time step: time, length of the last step, energy of prescribed motion, displacement, fields, masses at points.
DynamicsMemory = tuple[float, float, float, Array, list[Array], list[list[Array]]]


class Dynamics(given.Sealed):
    """Mass, initial velocity and time integration of a problem; pass it to ``UnitedProblem`` and solve by ``time_steps``.

    Args:
        mass: of all bodies; bodies without mass are allowed if others or supports restrain them.
        scheme: ``newmark()`` or ``generalised_alpha(rho_inf)``, or explicit, ``CentralDifferences()``.
        velocity: at the start: a Function of the displacement's space, a vector ``(gdim,)`` for all nodes, or None for rest.
        gravity: acceleration of free fall ``(gdim,)``; the weight of every node is its mass times gravity, so that free fall causes
            no strain.
        damping: function of the velocity, a UFL expression, that returns a form, linear in the test function, to add to the residual:
            ``lambda rate: eta * ufl.inner(ufl.sym(ufl.grad(rate)), ufl.sym(ufl.grad(v))) * ufl.dx``.
        contactors: ``"massless"`` moves the mass of the contactors to neighbouring nodes [UEM, 5], and also of the target nodes below
            them in bodies with fine meshes; impact itself then neither dissipates nor adds energy. ``"massy"`` does not move mass:
            contact acts for whole steps, and a first contact dissipates the energy of the masses that it stops.
        time: at the start.

    Attributes:
        velocity: a Function; at components without mass it is the mean over the last step.
        acceleration: a Function; zero at components without mass, at prescribed ones the mean over the last step.
        mean_velocity: a Function, increments of the last step over its length; at the start the velocity.
        driven: kinetic energy added by prescribed motion (this rank).
        struck: work of contact and equations on masses in explicit steps with massy contactors (this rank).
        time: of the committed state.
        start: time at the start.
        accelerated: whether the acceleration is consistent with the forces.
        moving: whether a step has begun that is neither committed nor restored.
        massy: components that have mass, of the owned nodes ``(n_owned, gdim)``.
        held: owned components that are prescribed ``(n,)``.
        past: velocity in the damping form minus its part from the displacement, a Function; only with damping.
        resumed: number of checkpoints that have been read.
        dt: length of the last step that was begun.
    """

    past: fem.Function

    def __init__(
        self,
        mass: Mass,
        *,
        scheme: Scheme | CentralDifferences | None = None,
        velocity: fem.Function | npt.ArrayLike | None = None,
        gravity: npt.ArrayLike | None = None,
        damping: Callable[[Expr], ufl.Form] | None = None,
        contactors: Literal["massless", "massy"] = "massless",
        time: float = 0.0,
    ):
        given.kind("mass", mass, isinstance(mass, Mass), "a Mass", "made by uem.lumped_mass(V, density) or uem.consistent_mass")
        given.kind(
            "scheme",
            scheme,
            scheme is None or isinstance(scheme, Scheme | CentralDifferences),
            "a Scheme, as uem.newmark(), or None",
        )
        # UFL forms are callable, too
        makes = callable(damping) and not isinstance(damping, ufl.Form)
        given.kind(
            "damping", damping, damping is None or makes, "a function of the velocity that makes a form, or None",
            "as lambda rate: eta * ufl.inner(rate, v) * ufl.dx",
        )  # fmt: skip
        given.word("contactors", contactors, ("massless", "massy"))
        given.number("time", time)
        self.mass, self.scheme, self.damping, self.contactors = mass, scheme or newmark(), damping, contactors
        self.time = self.start = self._until = float(time)
        self.start_velocity, self.gravity = velocity, gravity
        self.resumed, self.accelerated, self.moving, self._attached = 0, False, False, False
        #: Length of the last committed step, zero before the first, and the factor of M in the tangent.
        self.last = self.factor = self.driven = self.struck = self.dt = 0.0
        self._ends: tuple[Array, Array] | None = None  # velocity and acceleration at the end of an explicit step, once known
        self.added: list[AddedMass] = []  #: Masses at points of rigid couplings.
        self.damping_form: ufl.Form | None = None  #: Virtual work of the damping forces.

    def attach(self, config: Configuration) -> ufl.Form | None:
        """Attach to the problem's displacement, check that all arguments fit it, and return the damping form (collective)."""
        if self._attached:
            raise SpaceError("these dynamics belong to another problem: make new ones for every problem")
        self._attached, self.config, g = True, config, config.gdim
        #: The mass, and its matrix in the rows of the constrained system.
        self._in_rows: tuple[PETSc.Mat, PETSc.Mat] | None = None
        self._n, error = g * config.n_owned, None
        wanted = self._n, g * config.index_map.size_global
        if tuple(self.mass.M.getSizes()[0]) != wanted:
            error = SpaceError(
                f"the mass has {self.mass.M.getSize()[0]} rows, the displacement {wanted[1]} components: make the mass with the "
                "function space of the displacement"
            )
        elif not config.numbers_as(self.mass.config.V):
            error = SpaceError(
                "the mass is of another mesh than the displacement, or has another numbering, as a collapsed part of a mixed space: make "
                "it with the function space of the displacement, or uem.function_space(mesh, degree, (gdim,))"
            )
        elif self.mass.config.places != config.places:
            error = SpaceError("nodes have moved in the mesh since the mass was made: make a new mass")
        # the sizes may agree by chance on other ranks
        agree(config.comm, error)
        self.velocity = fem.Function(config.V, name="velocity")
        self.acceleration = fem.Function(config.V, name="acceleration")
        self.mean_velocity = fem.Function(config.V, name="mean_velocity")
        self._set_velocity()
        self.mean_velocity.x.array[:] = self.velocity.x.array
        self.hold(np.zeros(self._n, dtype=bool))
        with agreed(config.comm):
            self._down = np.zeros(g) if self.gravity is None else given.vector("gravity", self.gravity, g)
            if config.axisymmetric and self._down[0] != 0.0:
                raise InputError(given.sentence("gravity", self._down, "no radial component, as bodies are axisymmetric"))
        given.alike(
            config.comm, "Dynamics", gravity=self._down, time=self.time, contactors=self.contactors, scheme=str(self.scheme)
        )
        self._copy_committed()
        self.forces = fem.Function(config.V)  #: Inertia forces of the committed state, which balance all other forces.
        if self.damping is not None:
            self._rate, self.past = fem.Constant(config.mesh, 0.0), fem.Function(config.V)
            self.past.x.array[:] = self.velocity.x.array
            form = ask_together(config.comm, "damping", self.damping, self._rate * config.u + self.past)
            with agreed(config.comm):
                if form is None:
                    raise InputTypeError("damping(v) = None: expected a UFL form, linear in the test function; return it")
            self.damping_form = revolved(form) if isinstance(form, ufl.Form) else form
        return self.damping_form

    def _set_velocity(self) -> None:
        v, g = self.start_velocity, self.config.gdim
        if isinstance(v, fem.Function):
            own = v.function_space
            other = own.dofmap.index_map_bs != g or compat.lagrange_degree(own) != self.config.degree
            other |= not compat.is_on(own, self.config.mesh)
            words = "the velocity belongs to another space: make it with the function space of the displacement"
            agree(self.config.comm, SpaceError(words) if other else None)
            self.velocity.x.array[:] = v.x.array
        elif v is not None:
            with agreed(self.config.comm):
                expected = f"a Function of the displacement's space or {g} numbers"
                given.kind("velocity", v, not callable(v) and np.shape(v) == (g,), expected, "interpolate other velocities")
                self.velocity.x.array.reshape(-1, g)[:] = given.vector("velocity", v, g)
        if not np.isfinite(compat.petsc_vector(self.velocity).norm()):
            raise NotFiniteError("the velocity at the start contains NaN or infinity")

    @property
    def _displacement(self) -> Array:
        """Displacement of the local nodes ``(n_local * gdim,)``."""
        return self.config.displacement.ravel()

    @property
    def matrix(self) -> PETSc.Mat:
        """M, with the rows and columns of the constrained system (first time: collective)."""
        if self._in_rows is None or self._in_rows[0] is not self.mass.M:
            self._in_rows = self.mass.M, self.config.in_rows(self.mass.M)
        return self._in_rows[1]

    def hold(self, held: Bools) -> None:
        """Set the mask of prescribed owned components ``(n_owned, gdim)``, whose velocities follow the prescribed motion."""
        self.held = held.ravel()
        self._at_held = np.flatnonzero(self.held)

    def make_contactors_massless(self, contacts: Sequence[Contact]) -> None:
        """Redistribute the mass of contact surfaces by ``massless.without_surfaces``, unless they keep it (collective).

        Raises:
            MassError: if the other nodes of a body cannot take the mass of its contactors.
        """
        from uem_dolfinx.dynamics.massless import without_surfaces

        if self.contactors == "massless":
            self.mass = without_surfaces(self.mass, contacts)
        self.massy = self.mass.of_nodes > 0
        self._weight = self.mass.times(np.tile(self._down, self.config.n_owned))

    def add(self, one: AddedMass) -> None:
        """Add a mass at a point that moves with the nodes of its coupling (collective)."""
        one.start(self.velocity.x.array[: self._n].reshape(-1, self.config.gdim), self._down)
        self.added.append(one)

    @property
    def inert(self) -> Bools:
        """Mask of components with inertia in rigid motions: components with mass, and nodes with added masses (collective)."""
        found = self.massy.copy()
        for one in self.added:
            found[one.inert] = True
        return found

    def begin(self, dt: float) -> None:
        """Begin a step of length ``dt`` from the committed state."""
        self._until, self.moving, self.dt, self._ends = self.time + dt, True, dt, None
        ends = self.scheme.ending(self._velocity, self._acceleration, dt)
        self._a_rate, self._a_past, self._v_rate, self._v_past = ends
        self.factor = self.scheme.factor(dt)
        if self.damping is not None:
            self._rate.value = self._v_rate
            self.past.x.array[:] = self._v_past - self._v_rate * self._u
        for one in self.added:
            one.begin(self.scheme, dt)

    def _prescribed(self) -> tuple[Array, Array, Array]:
        """Final velocity, mean acceleration, and acceleration in the equation of motion, of prescribed components.

        Both integrators would repeat every jump of a prescribed velocity in all later steps: v(n+1) = 2 du/dt - v(n). Instead, with w the
        mean velocity of the step, v(n+1) = w + dt/2 times the smaller of two slopes, of w and of v in the previous step, or 0 if their
        signs differ. This is of second order for smooth motions, and equal to w after a jump, which is then an impact within the step.
        Accelerations are differences of v, extrapolated to the time of the equation of motion.
        """
        i, dt, last = self._at_held, self.dt, self.last
        v, before = self._velocity[i], self._acceleration[i]
        w = (self._displacement[i] - self._u[i]) / dt
        slope = 2.0 * (w - self.mean_velocity.x.array[i]) / (dt + last)
        slope = np.where(slope * before > 0.0, np.where(np.abs(slope) < np.abs(before), slope, before), 0.0)
        end = w + 0.5 * dt * slope
        mean = (end - v) / dt
        on = (0.5 - self.scheme.alpha_f) * 2.0 * dt / (dt + (last or dt))
        return end, mean, mean + on * (mean - before)

    def update_rates(self) -> None:
        """Update the velocity of prescribed components in the damping form to the present displacement (collective)."""
        if self.damping is None or not self.moving:
            return
        i = self._at_held
        self.past.x.array[i] = self._prescribed()[0] - self._v_rate * self._displacement[i]
        self.past.x.scatter_forward()

    def memory(self) -> DynamicsMemory:
        """Initial state of the next step."""
        fields = self.velocity, self.acceleration, self.mean_velocity, self.forces
        kept, added = [np.array(field.x.array) for field in fields], [one.kept for one in self.added]
        return self.time, self.last, self.driven, self._u, kept, added

    def remember(self, memory: DynamicsMemory) -> None:
        """Restore the state that ``memory`` returned."""
        self.time, self.last, self.driven, displacement, kept, added = memory
        for field, values in zip((self.velocity, self.acceleration, self.mean_velocity, self.forces), kept):
            field.x.array[:] = values
        self.restore()
        self._copy_committed()
        self._u = displacement
        for one, own in zip(self.added, added):
            one.kept = own

    def restore(self) -> None:
        """Leave a step that has begun, with the forces of the committed state."""
        self._until, self.moving = self.time, False
        for one in self.added:
            one.leave()

    def rate_error(self) -> tuple[float, float]:
        """Local error of a step over its length, and the final speed, in the norm of M (collective).

        The displacement's error is ``(beta - 1/6) dt^2 (a(n+1) - a(n))`` [O. C. Zienkiewicz, Y. M. Xie, Earthquake Engineering and
        Structural Dynamics 20 (1991) 871-887].
        """
        assert isinstance(self.scheme, Scheme)
        n, du = self._n, (self._displacement - self._u)[: self._n]
        jump = self._a_rate * du + (self._a_past - self._acceleration)[:n]
        speed = self._v_rate * du + self._v_past[:n]
        jump[self._at_held] = 0.0
        parts = (self.scheme.beta - 1 / 6) * self.dt * jump, speed
        error, v = reduced(self.config.comm, np.array([(part * self.mass.times(part)).sum() for part in parts]))
        return float(np.sqrt(max(error, 0.0))), float(np.sqrt(max(v, 0.0)))

    @contextmanager
    def without_inertia(self, damping: float = 0.0) -> Iterator[None]:
        """Context in which the tangent has no mass, and ``damping`` times the derivative of the damping form by the velocity."""
        rate = None if self.damping is None else float(self._rate.value)
        factor, self.factor = self.factor, 0.0
        if rate is not None:
            self._rate.value = damping
        try:
            yield
        finally:
            self.factor = factor
            if rate is not None:
                self._rate.value = rate

    def load(self) -> Array | None:
        """Inertia forces, which explicit steps find from others, minus weight, to add to residuals ``(n,)``; None for zero (collective)."""
        if self.moving and self.scheme.explicit:
            return -self._weight if self._down.any() else None
        with timed("inertia forces"):
            load = (self._inertia() if self.moving else self.forces.x.array[: self._n]) - self._weight
            return load + self.added_forces() if self.added else load

    def added_forces(self, carried: bool = False) -> Array:
        """Nodal inertia forces minus weight of masses at points, present or as last committed (``carried``) ``(n,)`` (collective)."""
        forces = np.zeros((self.config.n_owned, self.config.gdim))
        for one in self.added:
            forces[one.set.nodes] += one.nodal_forces(one.carried if carried else one.loads())
        return forces.ravel()

    def _inertia(self, prescribed: tuple[Array, Array, Array] | None = None) -> Array:
        """``(M ((1 - alpha_m) a(n+1) + alpha_m a(n)) - alpha_f I(n)) / (1 - alpha_f)``, which balances G at n + 1 ``(n,)``."""
        s, n = self.scheme, self._n
        if self._ends is None:
            du = self._displacement - self._u
            a = (1.0 - s.alpha_m) * (self._a_rate * du + self._a_past) + s.alpha_m * self._acceleration
        else:
            a = self._ends[1].copy()
        a[self._at_held] = (prescribed or self._prescribed())[2]
        inertia = self.mass.times(a[:n])
        return (inertia - s.alpha_f * self.forces.x.array[:n]) / (1.0 - s.alpha_f) if s.alpha_f else inertia

    def accelerate(self, restriction: Restriction, F: PETSc.Vec, added: PETSc.Mat | None = None) -> None:
        """Initial acceleration with constraints P under F, the static residual minus weight: ``P'MP a = -P'F`` (collective).

        ``added`` contains the masses at points. NotFiniteError for forces that are not finite, LinearSolveError for negative masses.
        """
        if not np.isfinite(F.norm()):
            raise NotFiniteError(
                f"the forces at the start, time {self.time:.6g}, contain NaN or infinity: check loads, Dirichlet values and displacement"
            )
        from uem_dolfinx.dynamics.massless import united_accelerations

        a = united_accelerations(self.matrix, restriction, -F, added)
        self.acceleration.x.array[: self._n] = a.array_r[: self._n] * self.massy.ravel()
        self.acceleration.x.scatter_forward()
        for one in self.added:
            one.accelerate(a.array_r[: self._n].reshape(-1, self.config.gdim))
        self._acceleration = np.array(self.acceleration.x.array)
        self.forces.x.array[: self._n] = self.mass.times(self._acceleration[: self._n])
        self.forces.x.scatter_forward()
        self.accelerated = True

    def rates(self, prescribed: tuple[Array, Array, Array] | None = None) -> tuple[Array, Array]:
        """Velocity and acceleration at the end of the present step, at the present displacement, ``(n,)`` each."""
        n, held, massy = self._n, self._at_held, self.massy.ravel()
        end, mean, _ = prescribed or self._prescribed()
        du = self._displacement[:n] - self._u[:n]
        if self._ends is None:
            v, a = self._v_rate * du + self._v_past[:n], self._a_rate * du + self._a_past[:n]
        else:
            v, a = (one.copy() for one in self._ends)
        a[held], v[held] = mean, end
        # components without mass have the mean velocity of the step
        return np.where(massy, v, du / self.dt), np.where(massy, a, 0.0)

    def commit(self) -> None:
        """Commit velocity and acceleration at the present displacement."""
        if self.moving:
            n, dt, i = self._n, self.dt, self._at_held
            self.forces.x.array[:n] = self._inertia(known := self._prescribed())
            self.velocity.x.array[:n], self.acceleration.x.array[:n] = self.rates(known)
            self.mean_velocity.x.array[:n] = (self._displacement[:n] - self._u[:n]) / dt
            if len(i) or not self.mass.diagonal:
                change = self.velocity.x.array[:n] - self._velocity[:n]
                self.driven += float((self.mass.times(change)[i] * (self._velocity[i] + 0.5 * change[i])).sum())
            for field in (self.forces, self.acceleration, self.velocity, self.mean_velocity):
                field.x.scatter_forward()
            self.time, self.last, self.moving = self._until, dt, False
        for one in self.added:
            one.commit()
        self._copy_committed()

    def end_with(self, velocity: Array, acceleration: Array, struck: float = 0.0) -> None:
        """Set velocity and acceleration of free components at the end of the present explicit step, before its ``commit`` ``(n,)``.

        ``struck`` is the work of contact and equations on masses in this step.
        """
        self.struck += struck
        self._ends = velocity, acceleration

    def change_rates(self, velocity: Array, acceleration: Array, part: float = 1.0) -> None:
        """Replace velocity and acceleration of free components of the committed state ``(n,)`` (collective).

        Accelerations change by this ``part`` of what balances the change of the inertia forces.
        """
        n, free = self._n, ~self.held
        change = np.where(free, acceleration - self.acceleration.x.array[:n], 0.0)
        self.velocity.x.array[:n] = np.where(free, velocity, self.velocity.x.array[:n])
        self.acceleration.x.array[:n] += change
        self.forces.x.array[:n] += self.mass.times(change) / part
        for field in (self.forces, self.acceleration, self.velocity):
            field.x.scatter_forward()
        self._copy_committed()

    def _copy_committed(self) -> None:
        """Copy displacement, velocity and acceleration as initial values of the next step."""
        self._u = np.array(self._displacement)
        self._velocity, self._acceleration = np.array(self.velocity.x.array), np.array(self.acceleration.x.array)

    def to_checkpoint(self) -> dict[str, Any]:
        """Numbers of a checkpoint in addition to the Functions, by name."""
        kept = {"time": self.time, "start": self.start, "accelerated": self.accelerated, "last length": self.last}
        kept |= {} if self.damping is None else {"rate in damping": float(self._rate.value)}
        return kept | ({"masses at points": [np.array(one.kept).tolist() for one in self.added]} if self.added else {})

    def from_checkpoint(self, kept: dict[str, Any]) -> None:
        """Restart from the present Functions and the numbers of ``to_checkpoint``; other numbers are ignored."""
        names = "time", "start", "accelerated", "last length"
        self.time, self.start, self.accelerated, self.last = (kept[name] for name in names)
        self.resumed += 1
        if self.damping is not None:
            self._rate.value = kept["rate in damping"]
        self.restore()
        self._copy_committed()
        for one, own in zip(self.added, kept.get("masses at points", [])):
            one.kept = own

    @property
    def weight_of_one(self) -> Array:
        """Acceleration of free fall ``(gdim,)``."""
        return self._down

    def weight(self) -> Array:
        """Forces of gravity on the mass of the nodes ``(n,)``."""
        return self._weight.copy()

    def momentum(self) -> Array:
        """Momentum ``(gdim,)``; in axisymmetry only along the axis (collective)."""
        p = self.mass.times(self.velocity.x.array[: self._n].reshape(-1, self.config.gdim))
        sums = reduced(self.config.comm, p.sum(axis=0))
        return self.config.of_circles(sums + sum(one.momentum for one in self.added))

    def kinetic_energy(self) -> float:
        """``v'Mv / 2``, plus the kinetic energy of masses at points (collective)."""
        v = self.velocity.x.array[: self._n]
        return 0.5 * float(reduced(self.config.comm, (v * self.mass.times(v)).sum())) + sum(
            one.kinetic_energy for one in self.added
        )
