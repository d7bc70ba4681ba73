"""Inertia: velocities, accelerations and the forces they make, by Newmark's rule or the generalised-alpha method.

They turn a static residual into a dynamic one: the solver adds these forces to the residual and a multiple of M to K.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc
from ufl.core.expr import Expr

from uem_dolfinx import compat, given
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.dynamics.mass import Mass
from uem_dolfinx.dynamics.massless import contactor_nodes, without_surfaces
from uem_dolfinx.dynamics.scheme import Scheme, newmark
from uem_dolfinx.errors import LinearSolveError, NotFiniteError, SpaceError
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.log import logger, timed
from uem_dolfinx.parallel import agree, agreed, ask_together

#: Components with less mass than this part of the largest have no acceleration at the start.
#: [convention; diagonal of P'MP; test_thresholds_motion.py::test_components_without_mass]
MASSLESS = 1e-12
#: Residual that the first acceleration is solved to.
#: [bound; forces; -]
ACCELERATED = 1e-13


class Dynamics:
    """What a problem needs to move in time; hand it to ``UnitedProblem`` and step by ``time_steps``.

    Args:
        mass: of all bodies; bodies without mass are allowed where others or supports hold them.
        scheme: ``newmark()`` or ``generalised_alpha(rho_inf)``.
        velocity: at the start: a Function of the displacement's space, the same for all ``(gdim,)``, or None for rest.
        gravity: acceleration of free fall ``(gdim,)``; every node weighs what its mass does, so that free fall strains nothing.
        damping: makes a form, linear in the test function, of the velocity as a UFL expression; it is added to the residual.
        contactors: ``"massless"`` hands the mass of the contactors on to the nodes around [UEM, 5], and that of the nodes that they
            follow in the bodies that can carry it, so that impact itself neither loses nor gives energy; ``"massy"`` leaves it.
        time: at the start.

    Attributes:
        velocity: a Function; at components without mass it is the mean over the last step.
        acceleration: a Function; zero at components without mass.
        time: of the committed state.
        start: time at the start.
        accelerated: whether the acceleration fits the forces yet.
        moving: whether a step has begun that is neither kept nor left.
        massy: components that have mass, of the owned nodes ``(n_owned, gdim)``.
        resumed: how often a checkpoint has been read into them.
    """

    def __init__(
        self,
        mass: Mass,
        *,
        scheme: Scheme | None = None,
        velocity: fem.Function | npt.ArrayLike | None = None,
        gravity: npt.ArrayLike | None = None,
        damping: Callable[[Expr], ufl.Form] | None = None,
        contactors: str = "massless",
        time: float = 0.0,
    ):
        given.kind(
            "mass", mass, isinstance(mass, Mass), "a Mass", "make it by uem.lumped_mass(V, density) or uem.consistent_mass"
        )
        given.kind("scheme", scheme, scheme is None or isinstance(scheme, Scheme), "a Scheme, as uem.newmark(), or None")
        given.kind(
            "damping", damping, damping is None or callable(damping), "a function of the velocity that makes a form, or None"
        )
        given.word("contactors", contactors, ("massless", "massy"))
        given.number("time", time)
        self.mass, self.scheme, self.damping, self.contactors = mass, scheme or newmark(), damping, contactors
        self.time = self.start = self._until = float(time)
        self.start_velocity, self.gravity = velocity, gravity
        self.resumed, self.accelerated, self.moving, self._attached = 0, False, False, False
        #: Factor of M in the tangent.
        self.factor = 0.0
        #: Virtual work of the damping forces.
        self.damping_form: ufl.Form | None = None

    def attach(self, config: Configuration) -> ufl.Form | None:
        """Take in the problem's displacement, refuse what does not fit it, and return the damping form (collective)."""
        if self._attached:
            raise SpaceError("these dynamics belong to another problem: make new ones for every problem")
        self._attached, self.config, g = True, config, config.gdim
        self._n, error = g * config.n_owned, None
        wanted = self._n, g * config.index_map.size_global
        if tuple(self.mass.M.getSizes()[0]) != wanted:
            error = SpaceError(
                f"the mass has {self.mass.M.getSize()[0]} rows, the displacement {wanted[1]} components: make the mass with the "
                "function space of the displacement"
            )
        # on other ranks the parts may be equally large by chance
        agree(config.comm, error)
        self.velocity = fem.Function(config.V, name="velocity")
        self.acceleration = fem.Function(config.V, name="acceleration")
        self._set_velocity()
        with agreed(config.comm):
            self._down = np.zeros(g) if self.gravity is None else given.vector("gravity", self.gravity, g)
        given.alike(
            config.comm, "Dynamics", gravity=self._down, time=self.time, contactors=self.contactors, scheme=str(self.scheme)
        )
        self._copy_committed()
        #: Inertia forces of the committed state, which balance all others.
        self.forces = fem.Function(config.V)
        if self.damping is not None:
            self._rate, self._past = fem.Constant(config.mesh, 0.0), fem.Function(config.V)
            self._past.x.array[:] = self.velocity.x.array
            self.damping_form = ask_together(config.comm, "damping", self.damping, self._rate * config.u + self._past)
        return self.damping_form

    def _set_velocity(self) -> None:
        v, g = self.start_velocity, self.config.gdim
        if isinstance(v, fem.Function):
            other = v.function_space.dofmap.index_map_bs != g or len(v.x.array) != len(self.velocity.x.array)
            words = "the velocity belongs to another space: make it with the function space of the displacement"
            agree(self.config.comm, SpaceError(words) if other else None)
            self.velocity.x.array[:] = v.x.array
        elif v is not None:
            with agreed(self.config.comm):
                expected = f"a Function of the displacement's space or {g} numbers"
                given.kind("velocity", v, np.shape(v) == (g,), expected)
                self.velocity.x.array.reshape(-1, g)[:] = v
        if not np.isfinite(compat.petsc_vector(self.velocity).norm()):
            raise NotFiniteError("the velocity at the start holds NaN or infinity")

    def make_contactors_massless(self, contacts: Sequence[Contact]) -> None:
        """Hand the mass of contact surfaces on as ``massless.without_surfaces`` does, or warn that contactors keep it (collective).

        Raises:
            MassError: if a body cannot do without the mass of its contactors.
        """
        contactors = contactor_nodes(contacts)
        massy = int(self.config.comm.allreduce(int((self.mass.of_nodes[contactors] > 0).any(axis=1).sum())))
        if self.contactors == "massless":
            self.mass = without_surfaces(self.mass, contacts)
        elif massy:
            logger.warning(
                "%d contactors have mass: impact will set them in vibration, and the trapezoidal rule then adds energy at every touch; "
                "contactors='massless' avoids both",
                massy,
            )
        self.massy = self.mass.of_nodes > 0
        self._weight = self.mass.M * self._like(np.broadcast_to(self._down, (self.config.n_owned, self.config.gdim)))

    def _like(self, values: Array) -> PETSc.Vec:
        vector = self.mass.M.createVecRight()
        vector.array[:] = np.ravel(values)
        return vector

    def begin(self, dt: float) -> None:
        """Begin a step of length ``dt`` from the committed state."""
        s, u, v, a = self.scheme, self._u, self._velocity, self._acceleration
        self._until, self.moving = self.time + dt, True
        # a(n+1) = rate (u - u(n)) + past, and likewise v(n+1); the difference of displacements keeps the digits
        self._a_rate = 1.0 / (s.beta * dt**2)
        self._a_past = -v / (s.beta * dt) - (0.5 / s.beta - 1.0) * a
        self._v_rate = s.gamma * dt * self._a_rate
        self._v_past = v + dt * ((1.0 - s.gamma) * a + s.gamma * self._a_past)
        self.factor = (1.0 - s.alpha_m) / (1.0 - s.alpha_f) * self._a_rate
        if self.damping is not None:
            self._rate.value = self._v_rate
            self._past.x.array[:] = self._v_past - self._v_rate * u

    def restore(self) -> None:
        """Leave a step that has begun; the forces are those of the committed state again."""
        self._until, self.moving = self.time, False

    @timed("inertia forces")
    def load(self) -> PETSc.Vec:
        """Inertia forces minus weight at the present displacement, what the residual lacks (collective)."""
        load = self._inertia() if self.moving else self._like(self.forces.x.array[: self._n])
        load.axpy(-1.0, self._weight)
        return load

    def _inertia(self) -> PETSc.Vec:
        """``(M ((1 - alpha_m) a(n+1) + alpha_m a(n)) - alpha_f I(n)) / (1 - alpha_f)``, which balances G at n + 1."""
        s, n = self.scheme, self._n
        du = self.config.u.x.array - self._u
        a = (1.0 - s.alpha_m) * (self._a_rate * du + self._a_past) + s.alpha_m * self._acceleration
        inertia = self.mass.M * self._like(a[:n])
        if s.alpha_f:
            inertia.axpy(-s.alpha_f, self._like(self.forces.x.array[:n]))
        inertia.scale(1.0 / (1.0 - s.alpha_f))
        return inertia

    def accelerate(self, restriction: Restriction, F: PETSc.Vec) -> None:
        """Acceleration at the start, of bodies united by P under F, the static residual minus weight: ``P'MP a = -P'F`` (collective).

        A NotFiniteError refuses forces that are not finite, a LinearSolveError negative masses.
        """
        if not np.isfinite(F.norm()):
            raise NotFiniteError(
                f"the forces at the start, time {self.time:.6g}, hold NaN or infinity: check loads, Dirichlet values and displacement"
            )
        M = self.mass.M.copy() if restriction.M is None else self.mass.M.PtAP(restriction.P)
        if restriction.M is None:
            restriction.cross_out(M)
        rhs = restriction.transpose(F)
        diagonal = M.getDiagonal()
        idle = diagonal.array_r <= MASSLESS * diagonal.max()[1]
        diagonal.array[idle], rhs.array[idle] = 1.0, 0.0
        M.setDiagonal(diagonal)
        ksp = PETSc.KSP().create(self.config.comm)
        ksp.setType("cg")
        ksp.getPC().setType("jacobi")
        ksp.setTolerances(rtol=ACCELERATED, max_it=10_000)
        ksp.setOperators(M)
        q = rhs.duplicate()
        with timed("first acceleration"):
            ksp.solve(-rhs, q)
        if ksp.getConvergedReason() < 0:
            raise LinearSolveError(
                f"the first acceleration was not found (KSP reason {ksp.getConvergedReason()}): check that no mass is negative"
            )
        a = restriction.expand(q)
        self.acceleration.x.array[: self._n] = a.array_r * self.massy.ravel()
        self.acceleration.x.scatter_forward()
        self._acceleration = np.array(self.acceleration.x.array)
        self.forces.x.array[: self._n] = (self.mass.M * self._like(self._acceleration[: self._n])).array_r
        self.forces.x.scatter_forward()
        self.accelerated = True

    def commit(self) -> None:
        """Keep velocity and acceleration that belong to the present displacement."""
        if self.moving:
            n, dt = self._n, self._until - self.time
            du, massy = (self.config.u.x.array - self._u)[:n], self.massy.ravel()
            self.forces.x.array[:n] = self._inertia().array_r
            self.acceleration.x.array[:n] = np.where(massy, self._a_rate * du + self._a_past[:n], 0.0)
            # what has no mass has no velocity of its own
            self.velocity.x.array[:n] = np.where(massy, self._v_rate * du + self._v_past[:n], du / dt)
            for field in (self.forces, self.acceleration, self.velocity):
                field.x.scatter_forward()
            self.time, self.moving = self._until, False
        self._copy_committed()

    def _copy_committed(self) -> None:
        """Displacement, velocity and acceleration as they are are those at the start of the next step."""
        self._u = np.array(self.config.u.x.array)
        self._velocity, self._acceleration = np.array(self.velocity.x.array), np.array(self.acceleration.x.array)

    def to_checkpoint(self) -> dict[str, Any]:
        """Numbers that a run goes on from beside the Functions, by name."""
        return {"time": self.time, "start": self.start, "accelerated": self.accelerated}

    def from_checkpoint(self, kept: dict[str, Any]) -> None:
        """Go on from the Functions as they are and what ``to_checkpoint`` returned; other numbers may stand beside it."""
        self.time, self.start, self.accelerated = (kept[name] for name in self.to_checkpoint())
        self.resumed += 1
        self.restore()
        self._copy_committed()

    def weight(self) -> PETSc.Vec:
        """Forces of gravity."""
        return self._weight.copy()

    def momentum(self) -> Array:
        """Momentum ``(gdim,)`` (collective)."""
        p = self.mass.M * self._like(self.velocity.x.array[: self._n])
        return np.asarray(self.config.comm.allreduce(p.array_r.reshape(-1, self.config.gdim).sum(axis=0)))

    def kinetic_energy(self) -> float:
        """``v'Mv / 2`` (collective)."""
        v = self._like(self.velocity.x.array[: self._n])
        return 0.5 * float(v.dot(self.mass.M * v))
