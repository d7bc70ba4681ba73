"""UnitedProblem: a UFL residual, Dirichlet conditions and contacts, combined and solved step by step."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.compiled import with_options
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.joining import attached
from uem_dolfinx.contact.pair.interface import Interface, motions_of
from uem_dolfinx.contact.results import ManyContacts
from uem_dolfinx.contact.warnings.checks import check_moved, check_new
from uem_dolfinx.contact.warnings.watch import Watch
from uem_dolfinx.errors import InputError, UEMError
from uem_dolfinx.form_checks import check_bilinear
from uem_dolfinx.forms import in_all_cells
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.geometry.surfaces import surface_nodes
from uem_dolfinx.geometry.tags import Part, as_tag
from uem_dolfinx.parallel import agreed
from uem_dolfinx.restart.interruption import end_together
from uem_dolfinx.solve import checks, loading
from uem_dolfinx.solve.bodies.bodies import Bodies, configured, solver_of
from uem_dolfinx.solve.bodies.field_scales import Norm
from uem_dolfinx.solve.loading import check_load, forget_load, ramped, reactions, refuse_idle, set_loads, taken_by, values_at
from uem_dolfinx.solve.step_control import MENDABLE, control_of
from uem_dolfinx.solve.stepping import Progress
from uem_dolfinx.solve.united.newton import ContactMethod, Iteration, solve_united
from uem_dolfinx.solve.united.system import BodySystem

if TYPE_CHECKING:
    from uem_dolfinx.conditions.at_points import PointLoad, PointSpring
    from uem_dolfinx.conditions.equation import Equation, Periodic
    from uem_dolfinx.conditions.joints import Link
    from uem_dolfinx.conditions.rigid_coupling import RigidCoupling
    from uem_dolfinx.conditions.user_rows import UserRows
    from uem_dolfinx.contact.general.general import GeneralContact
    from uem_dolfinx.dynamics.inertia import Dynamics
    from uem_dolfinx.materials.elastic import HistoryMaterial
    from uem_dolfinx.restart.state import State
    from uem_dolfinx.solve.settings import Newton


class UnitedProblem(given.Sealed):
    """Bodies in contact by the United Elements Method, in statics or dynamics.

    Solves ``F(u; v) = 0`` with the contactors of every contact united to their targets:

        du = P dq + c,    P'KP dq = P'(r - K c),    r = -F,    K = dF/du      [UEM, 6.6]

    Args:
        F: UFL residual, internal minus external virtual work; linear in a test function of the space of ``u``. Inertia and damping
            forces are added by ``dynamics``. On a mesh declared ``axisymmetric`` it is integrated over whole circles.
        u: displacement, a Function of a vector Lagrange space; holds the solution. With ``displacement`` a Function of a mixed
            space. Or a scalar field, such as a temperature or a phase field: contacts are then ties of two meshes.
        displacement: number of the displacement's part of the mixed space; other parts, such as a pressure or a temperature, are
            solved for as well, without contact conditions.
        bcs: Dirichlet conditions.
        contacts: contacts between bodies or with rigid surfaces, or a general contact of all surfaces; may be empty.
        equations: linear equations between displacements of nodes: ``Equation`` and ``periodic``.
        couplings: parts that move rigidly with a point, or distribute its load: ``RigidCoupling``; and ``Hinge``, ``Slider``, ``Ball``
            and ``Spring`` between such parts.
        points: forces and springs at nodes in addition to F: ``PointLoad`` and ``PointSpring``.
        petsc_options_prefix: prefix of the linear solver's options.
        petsc_options: its options without prefix; by default MUMPS or CG with AMG, depending on the size. Unless they fix
            ``ksp_rtol``, the tolerance of iterative solves follows the Newton residual.
        load: a ``fem.Constant`` that is set to the load factor while the Dirichlet values are ramped. Or several,
            ``{constant: value}``, each with its value at the full load, to which it is ramped, or a function of the factor that
            returns it. Or one function of the factor that sets loads and Dirichlet values itself. None ramps the Dirichlet values
            only. In time steps the factor is replaced by the time.
        dynamics: mass, velocity and time integration; None is statics.
        materials: all laws with history in F, such as ``VonMises``.
        newton: settings of Newton's method, ``uem.Newton(...)``; or the name of its method, with the following six as its arguments.
        consistent_tangent, line_search, check_inversion, rtol, max_iterations, verbose: see ``Newton``.
        J: tangent in UFL, bilinear in a test and a trial function of the space of ``u``; by default the derivative of F by u. Laws with
            history, damping and inertia add their own. It need not be exact, but gradients need the derivative.
        jit_options: for the compiler of the forms of this problem, as in DOLFINx, e.g. ``{"cffi_extra_compile_args": ["-O3"]}``.
        method: method to impose contact, by default elimination: called with the arguments of ``solve.united.system.BodySystem``,
            it returns a ``solve.united.newton.ContactMethod``.

    Raises:
        InputError, InputTypeError: for an argument of another type or out of its range, with its name and value; on all ranks.
        SpaceError: if ``u``, or its part ``displacement``, is no vector Lagrange Function of the mesh's dimension, or F does not
            depend on it. If a Dirichlet condition, the test function or a law with history is of another space or displacement. If F
            contains objects of another mesh, or a contact belongs to another problem.
        MeshError: if the coordinates of a node are not finite, with the node.
        TagError, SurfaceError, OrientationError, PenetrationError: see ``Contact``.
        KeyboardInterrupt, SystemExit: on all ranks, if any rank has received Ctrl-C or SIGTERM meanwhile.
        MissingBackendError: if ``petsc_options`` name a library that PETSc was built without.
    """

    SETTABLE: ClassVar = {"load": check_load, **checks.NEWTON}

    @end_together(lambda self, F, u, **options: u.function_space.mesh.comm if isinstance(u, fem.Function) else None)
    def __init__(
        self,
        F: ufl.Form,
        u: fem.Function,
        *,
        displacement: int | None = None,
        bcs: Sequence[fem.DirichletBC] = (),
        contacts: Sequence[Contact | GeneralContact] = (),
        equations: Sequence[Equation | Periodic] = (),
        couplings: Sequence[RigidCoupling | Link] = (),
        points: Sequence[PointLoad | PointSpring] = (),
        petsc_options_prefix: str = "uem_",
        petsc_options: dict[str, Any] | None = None,
        load: fem.Constant | Mapping[fem.Constant, Any] | Callable[[float], None] | None = None,
        dynamics: Dynamics | None = None,
        materials: Sequence[HistoryMaterial] = (),
        J: ufl.Form | None = None,
        jit_options: Mapping[str, Any] | None = None,
        newton: Newton | Literal["full", "modified"] = "full",
        consistent_tangent: bool = True,
        line_search: bool = True,
        check_inversion: bool | None = None,
        rtol: float = 1e-8,
        max_iterations: int = 50,
        method: Callable[..., ContactMethod] = BodySystem,
        verbose: bool = False,
    ):
        self.u = given.kind("u", u, isinstance(u, fem.Function), "a Function of a vector Lagrange space")
        self.config = configured(u, displacement)
        self.comm = self.config.comm
        with agreed(self.comm):
            checks.check_residual(F, u)
            self.load = check_load(load)
            bcs = checks.check_conditions(self.config, bcs)
            kinds, what = Contact | ManyContacts, "an Equation, or what periodic returns"
            contacts = given.items("contacts", contacts, lambda one: isinstance(one, kinds), "a Contact or a GeneralContact")
            check_new(contacts)
            equations = given.items("equations", equations, lambda one: hasattr(one, "n_values"), what)
            couplings, linked = checks.check_couplings(couplings)
            points = given.items(
                "points", points, lambda one: hasattr(one, "force_and_stiffness"), "a PointLoad or a PointSpring"
            )
            if not self.config.moves:
                from uem_dolfinx.contact.scalar_ties import ScalarTie, check_ties

                others = {"materials": materials, "dynamics": dynamics, "points": points, "couplings": couplings}
                check_ties(self.config.gdim, contacts, **others)
            self.materials = checks.check_materials(materials, F, u, displacement)
            constraints = {"equations": equations, "couplings": linked}
            self.dynamics = checks.check_dynamics(dynamics, contacts, constraints, displacement is None and method is BodySystem)
            if J is not None:
                check_bilinear("J", J, u.function_space)
            jit_options = given.kind("jit_options", jit_options or {}, isinstance(jit_options, Mapping | None), "a dictionary")
            from uem_dolfinx.solve.settings import Settings, newton_of

            loop = newton_of(
                newton, consistent_tangent=consistent_tangent, line_search=line_search, check_inversion=check_inversion, rtol=rtol,
                max_iterations=max_iterations, verbose=verbose,
            )  # fmt: skip
            self.rtol, self.max_iterations = loop.rtol, loop.max_iterations
            self.line_search, self.verbose = loop.line_search, loop.verbose
            given.kind("method", given.function(method) or method, given.function(method), "what makes a system, as BodySystem")
            if method is not BodySystem and any(contact.heats or contact.normal for contact in contacts):
                raise InputError("heat and soft contact need the default method: leave method out, or heat and normal")
        given.alike(
            self.comm, "UnitedProblem", bcs=len(bcs), contacts=[contact.name for contact in contacts], materials=len(self.materials),
            equations=[type(one).__name__ for one in equations], points=[type(one).__name__ for one in points],
            couplings=[one.name for one in linked], load=loading.words_of(self.load), dynamics=type(dynamics).__name__,
            J=J is None, jit_options=jit_options, newton=loop.method, **{k: v for k, v in vars(loop).items() if k != "method"},
        )  # fmt: skip
        #: Contacts as declared, and, below, their parts: a general contact consists of several.
        ties, contacts = ([], contacts) if self.config.moves else (contacts, [])
        self.declared: list[Contact | GeneralContact] = contacts
        #: Other declared objects: ties of a scalar field, linear equations, couplings, and loads and springs at points.
        self.ties, self.equations, self.couplings, self.points = ties, equations, couplings, points
        damping = dynamics.attach(self.config) if dynamics is not None else None
        if damping is not None:
            checks.check_damping(damping, u, dynamics)
        # cells held by conditions or made rigid by a coupling may have no stiffness, and may be missing in F
        F, at_points = revolved(F if self.config.unknowns.mixed else in_all_cells(F, u, bool(self.materials))), None
        if points or couplings:
            from uem_dolfinx.conditions.at_points import AtPoints

            at_points = AtPoints(self.config, points, couplings)
        #: The bodies without contact.
        with with_options(jit_options):
            self.bodies = Bodies(
                self.config, F if damping is None else F + damping, bcs, materials=self.materials, dynamics=dynamics, points=at_points,
                check_inversion=loop.check_inversion, J=J if J is None or damping is None else J + ufl.derivative(damping, u),
            )  # fmt: skip
        for one in linked:
            one.attach(self.config, not self.bodies.tangent.linear)
        if couplings:
            from uem_dolfinx.dynamics.added_mass import add_masses

            add_masses(couplings, dynamics)
        self.solver = solver_of(self.config, petsc_options_prefix, petsc_options)
        free = self.bodies.free[: self.config.n_owned]
        rigid = checks.rigid_nodes(self.config, free, couplings if contacts else [])
        clock: dict[str, Any] = {} if dynamics is None else {"at": dynamics.time, "duration": lambda: dynamics.dt}
        self.config.equations = equations
        single = [one for one in contacts if isinstance(one, Contact)]
        many = [[one] if isinstance(one, Contact) else one.make_parts(self.config, single, rigid) for one in contacts]
        parts = [part for some in many for part in some]
        self.contacts: list[Contact] = attached(parts, self.config, free, clock, method is BodySystem)
        if dynamics is not None:
            from uem_dolfinx.dynamics.massless import warn_of_soft_targets

            dynamics.make_contactors_massless(self.contacts)
            warn_of_soft_targets(dynamics.mass, self.contacts, self.bodies.initial_stiffness)
        #: Options of the system that the Newton loop solves.
        options: dict[str, Any] = {"newton": loop.method, "consistent_tangent": loop.consistent_tangent}
        #: Equations of users, or None.
        self.linear: UserRows | None = None
        scalar = [ScalarTie(self.config, tie, free) for tie in ties] if ties else []
        self._of_users = [*scalar, *equations], couplings, [tie.followed for tie in scalar]
        self.unite(self.load, clock.get("at", 0.0))
        options |= {} if self.linear is None else {"linear": self.linear}
        self.stage: Any = None  # the present ``solve.steps.stages.Stage``
        self.system = method(self.bodies, self.interfaces, self.solver, **options)
        self.step_control = control_of(dynamics, self.config.V)  #: Length of time steps, with the history needed to control it.
        self.progress = Progress()  # in steps and in load
        self.committed = np.array(u.x.array)  # displacement of the last converged state ``(n_local incl. ghosts,)``
        #: Motions of the rigid targets in that state; None for targets that had not moved, and for meshes.
        self.motions = self.rigid_motions()
        self.largest_forces: Norm = 0.0  #: Norm of the largest forces of all steps, as far as they exceed rounding.
        #: State at the beginning of the last step, and ``led``: the start of its ramp, its fraction, and whether its load was controlled.
        from uem_dolfinx.solve.memory import Memory

        self._before = Memory.of(self)
        self.led: tuple[np.ndarray | None, float, bool] = None, 1.0, False
        #: Load factor or time for which loads have been set for the next step; None if they have not been set.
        self.set_at: float | None = None
        self.history: Any = None  # record of all steps for gradients
        self.impacts: Any = None  # contacts that act for whole steps
        if dynamics is not None and dynamics.contactors == "massy":
            from uem_dolfinx.solve.united.impacts import impacts_of

            self.impacts = impacts_of(self)
        for contact in self.contacts:
            contact.begin(getattr(self.system, "overlaps", {}))
        self.watch = Watch(self.contacts, rigid)  # warnings issued during steps
        #: Settings of the run, for checkpoints.
        declared = {"equations": equations, "couplings": linked, "points": points}
        names = {what: ", ".join(type(one).__name__ for one in some) for what, some in declared.items() if some}
        self.settings = Settings({"F": F, "damping": damping}, u, self.contacts, self.materials, dynamics, names)
        refuse_idle(self, self.load, self.bodies.bcs)
        checks.take_materials(self.materials)

    def __repr__(self) -> str:
        """Its size, contacts and progress."""
        config, dofmap = self.config, self.u.function_space.dofmap
        size = f"{dofmap.index_map_bs * dofmap.index_map.size_global} unknowns in {config.gdim}D"
        kind = "statics" if self.dynamics is None else f"dynamics at time {self.dynamics.time:.6g}"
        names = ", ".join(map(repr, [contact.name for contact in [*self.ties, *self.contacts]])) or "none"
        return f"UnitedProblem({size}, {kind}, contacts: {names}, steps committed: {self.progress.steps})"

    # -- one step ----------------------------------------------------------------------------------------------------

    def unite(self, load: Any, at: float) -> None:
        """Make the rows of users' equations under the present conditions, for a load and its factor or the time (collective)."""
        equations, couplings, followed = self._of_users
        if equations or couplings:
            from uem_dolfinx.conditions.user_rows import rows_of_users

            free, nodes = self.bodies.free[: self.config.n_owned], [pair.nodes for pair in self.pairs]
            self.linear = linear = rows_of_users(self.config, equations, couplings, free, nodes + followed, load, at)
            self.bodies.link(linear and linear.equations)

    def hold(self, bcs: Sequence[fem.DirichletBC]) -> None:
        """Replace all Dirichlet conditions between two time steps; in statics use ``Step(bcs=...)`` (collective).

        Raises:
            InputError, InputTypeError, SpaceError: in statics, with an explicit scheme or while recording, or for other conditions.
        """
        from uem_dolfinx.solve.united.starting import hold_others

        with agreed(self.comm):
            checks.check_hold(self)
            bcs = checks.check_conditions(self.config, bcs)
        hold_others(self, bcs)

    def set_load(self, at: float, known: bool = False) -> None:
        """Set ``load``, contacts and equations to a load factor or a time; UserFunctionError if a function raises (collective).

        ``known``: whether the committed state has been reached with these loads; otherwise the next step begins with them.
        """
        self.set_at = None if known else given.number("factor or time", at)
        if self.stage is not None:
            self.stage.take_load(at)
        set_loads(self.comm, self.load, at, self.bodies.bcs)
        for contact in self.contacts:
            contact.take_load(at, known)
        if self.linear is not None:
            self.linear.take_load(at)

    def solve(self, *, start: np.ndarray | None = None, fraction: float = 1.0) -> list[Iteration]:
        """Bring the bodies into equilibrium and commit the state (collective).

        The load factor is 1, or in dynamics the time is the present one, for ``load`` and all functions of equations, couplings, preloads
        and friction. Within a loop over ``load_steps`` or ``time_steps`` the step is repeated from its initial state, at the same
        load factor or time, under the present loads, Dirichlet values and fields. The result replaces the previous one. Histories
        of friction and plasticity, and velocities, count one step, however often it is repeated.

        Arguments, return value and errors are as in :meth:`attempt`, with loads of the factor ``fraction``. Loads are unchanged with a
        ``start``, or if ``set_load`` has set them since the last step. If the repeated step fails, the previous result is kept.
        KeyboardInterrupt and SystemExit are raised as in ``load_steps``.
        """
        from uem_dolfinx.solve.memory import take_again, take_alone

        with self.progress.checking_signals(self.comm):
            if self.progress.inside and start is None and fraction == 1.0:
                return take_again(self, self._before, self.led)
            return take_alone(self, start, fraction)

    def attempt(
        self, *, start: np.ndarray | None = None, fraction: float = 1.0, along: ContactMethod | None = None, system: Any = None
    ) -> list[Iteration]:
        """Bring the bodies into equilibrium, to be followed by ``commit`` or ``restore`` (collective).

        Args:
            start: displacement array at which the ramp of the Dirichlet values begins; None is the committed displacement.
            system: in place of the problem's own.
            fraction: part of the ramp of the Dirichlet values, from ``start`` (0) to the values of ``bcs`` (1).
            along: method that controls the load in every iteration, without line search, such as arc length; or None.

        Returns:
            The history of iterations.

        Raises:
            InputError, InputTypeError: if ``start`` is no displacement array, or ``fraction`` no number.
            ConvergenceError, LinearSolveError, NotFiniteError, InvertedElementError, ConflictError, FloatingBodyError,
            TunnellingError, UserFunctionError: after the committed state has been restored.
        """
        from uem_dolfinx.solve.rigid.rest import converge_or_rest
        from uem_dolfinx.solve.rigid.unheld import explain

        for pair in self.interfaces:
            check_moved(pair)
        self.led = start, fraction, along is not None
        with agreed(self.comm):
            start = self.committed if start is None else given.vector("start", start, len(self.committed))
            fraction = given.number("fraction", fraction)
        wanted = values_at(start, self.bodies.bcs)
        checks.check_values(self, wanted)
        self.bodies.wanted[:] = self.bodies.of_owners(ramped(self.load, self.bodies.bcs, start, wanted, fraction))
        try:
            self.bodies.begin_step()
            history = converge_or_rest(self, start, fraction, along, system or self.system)
        except UEMError as error:
            stiffness = self.bodies.stiffness
            self.restore()
            explain(self, error, stiffness, isinstance(error, MENDABLE))
            raise
        return history

    def converge(
        self, bodies: Bodies, system: Any, start: np.ndarray, fraction: float = 1.0, along: ContactMethod | None = None
    ) -> list[Iteration]:
        """Solve the united ``system`` of ``bodies``, its own or others in their place, see ``attempt``; the state stays (collective)."""
        if self.linear is not None:
            self.linear.begin_step(self.config.of(start)[: self.config.n_owned], fraction)
        method = along or system
        method.begin_step()
        history = solve_united(
            bodies, method, rtol=self.rtol, max_iterations=self.max_iterations, line_search=self.line_search and along is None,
            verbose=self.verbose, forces_before=self.largest_forces, check_signals=lambda: self.progress.check_signals(self.comm),
        )  # fmt: skip
        method.end_step()
        if on := {id(contact.pair.whole) for contact in self.contacts if contact.on}:
            from uem_dolfinx.solve.passages import refuse_passages

            pairs, motions = zip(*(p for p in zip(self.interfaces, self.motions) if id(p[0]) in on))
            refuse_passages(self.config, pairs, self.committed, motions, moving=self.dynamics is not None)
        return history

    def commit(self) -> None:
        """Commit the present displacement and contact state."""
        from uem_dolfinx.solve.memory import Memory

        self._before, self.progress.taken = Memory.of(self), taken_by(self)
        forget_load(self)
        self.progress.steps += 1
        self.keep()

    def keep(self) -> None:
        """Make the present state the committed one; the initial state of the step is unchanged (collective)."""
        if self.history is not None:
            self.history.note(self._before, self.led[2])
        pairs, self.committed = self.interfaces, np.array(self.u.x.array)
        self.largest_forces = self.bodies.remembered(bool(self.pairs), self.largest_forces)
        parts: list[Any] = [self.bodies, self.solver, self.impacts or self.dynamics]
        for part in filter(None, parts):
            part.commit()
        if self.linear is not None:
            self.linear.commit(self.dynamics)
        before = dict(zip(map(id, pairs), self._before.pairs))
        for pair in pairs:
            pair.commit()
            pair.project()
        self.motions = motions_of(pairs)
        self.watch.look(before, self.bodies.stiffness)

    def restore(self) -> None:
        """Return to the committed displacement and contact state."""
        self.u.x.array[:] = self.committed
        with_states: list[Any] = [self.bodies, self.dynamics, self.linear, self.solver]
        for part in filter(None, with_states):
            part.restore()
        for pair in self.interfaces:
            pair.restore()
            pair.discretisation.begin_step()
            pair.project()

    def state(self) -> State:
        """Contents of a checkpoint of the problem, from which the run continues as if uninterrupted (collective).

        Loads and Dirichlet values are not included: the script sets them before every step. Names of added Functions and numbers
        must differ from the names in use.
        """
        from uem_dolfinx.solve.kept import state_of

        return state_of(self)

    def reaction(self, tag: Part) -> np.ndarray:
        """Reaction force of the Dirichlet conditions on a part of the mesh, summed over its nodes ``(gdim,)`` (collective).

        Args:
            tag: of any dimension, or facets as in ``Contact``; components without Dirichlet condition count as zero. In
                axisymmetry radial forces cancel around the axis.
        """
        tdim = self.config.tdim
        nodes = surface_nodes(self.config, as_tag(tag, self.config.mesh, (tdim - 1, *range(tdim + 1)), "the support"))
        sums = self.comm.allgather(np.where(self.bodies.free, 0.0, self.config.of(reactions(self)))[nodes].sum(axis=0))
        return self.config.of_circles(np.sum(sums, axis=0))

    @property
    def pairs(self) -> list[Interface]:
        """The interface of every contact."""
        return [contact.pair for contact in self.contacts]

    @property
    def interfaces(self) -> list[Interface]:
        """The interfaces in use, with similar contacts joined into one."""
        return list({id(whole): whole for whole in [contact.pair.whole for contact in self.contacts]}.values())

    def rigid_motions(self) -> list[Motion | None]:
        """Present motions of the rigid targets of all ``interfaces``; None for targets that have not moved, and for meshes."""
        return motions_of(self.interfaces)
