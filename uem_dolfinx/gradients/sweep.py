"""A backward sweep over recorded steps, each linearised at its end, with one adjoint problem per step.

With displacements u_n, history variables h_n at the end of a step, and the residual R of a step that begins with h_{n-1},

    R(u_n, h_{n-1}; m) = 0,        h_n = H(u_n, h_{n-1})

derivatives are computed backwards,

    d_n = dJ/du_n + (dH/du_n)' b_n,        b_{n-1} = (dH/dh_{n-1})' b_n + dJ/dh_{n-1} through a_n

where a_n is the solution of the adjoint problem with the load d_n, as in ``adjoint``. History variables are anchors of contactors with
friction, velocities and accelerations, and the histories of laws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from typing import Any, NoReturn

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra.blocks import is_symmetric
from uem_dolfinx.arrays import Array, Ints
from uem_dolfinx.contact.pair.tables import table_of
from uem_dolfinx.dynamics.massless import united_accelerations
from uem_dolfinx.dynamics.rate_slopes import RateSlopes
from uem_dolfinx.errors import InputError, LinearSolveError
from uem_dolfinx.gradients.adjoint import Adjoint
from uem_dolfinx.gradients.anchor_slopes import AnchorSlopes
from uem_dolfinx.gradients.assemblies import Users, by_section, section_of
from uem_dolfinx.gradients.derivatives import Derivatives, Places, transposed
from uem_dolfinx.gradients.gradient import AnyControl
from uem_dolfinx.gradients.linearised import Linearised
from uem_dolfinx.gradients.mean_slopes import MeanSlopes
from uem_dolfinx.gradients.parameters import ContactParameter, contactors_of, led_for, motion_of
from uem_dolfinx.gradients.records import Record
from uem_dolfinx.materials.return_slopes import PlasticSlopes
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.bodies.tangent import contact_curvature, together
from uem_dolfinx.solve.memory import Memory
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.united.system import BodySystem

#: The part of rows that lean is found when it changes the load of the adjoint problem by no more than this part.
#: [bound; load of the adjoint problem; -]
LEANS_NO_MORE = 1e-12
#: Solves for that part. [bound; solves; -]
MOST_LEANING = 50


class Sweep:
    """Sums derivatives by controls over steps, from the last to the first.

    Args:
        problem: of the steps.
        controls: of the derivatives.
    """

    def __init__(self, problem: UnitedProblem, controls: Sequence[AnyControl]):
        self.problem, self._controls = problem, controls
        self.found: list[Any] = [None] * len(controls)  # derivatives by the controls so far; None before the first step
        self._derivatives = Derivatives(problem.bodies.F, problem.u.function_space, problem.config.V)
        self._by_anchors = [np.zeros((0, 0))] * len(problem.interfaces)
        self._sections = [section_of(pair) for pair in problem.interfaces]
        #: Derivatives by the openings of locked sections, by the number of their interface.
        self._by_opening = [0.0] * len(self._sections)
        self._rates = None if problem.dynamics is None else RateSlopes(problem.dynamics)
        laws: list[Any] = problem.materials
        self._laws = [law.slopes(self._derivatives.a, self._derivatives.test) for law in laws]

    def pass_back(self, record: Record, J: ufl.Form | None) -> None:
        """Process a step, with the problem set to its end, and a functional of its end or None (collective)."""
        step = LinearisedStep(self.problem, record, self._derivatives, self._rates)
        with step:
            at_end = self._by_anchors
            handed, self._by_anchors = _back(self.problem, at_end, step.slopes)
            load = (handed + self._by_openings()).ravel()
            if self._rates is not None:
                self._begin_rates(self._rates, J)
                load = load + self._rates.load()
            for law in self._laws:
                law.begin(None if J is None else self._derivatives.by_values(J, law.stress))
                load = load + law.load()
            adjoint = Adjoint(step, J, (), load)
            for k, m in enumerate(self._controls):
                self._add(k, adjoint.by(m))
                if isinstance(m, ContactParameter):
                    self._add(k, _left_behind(self.problem, m, at_end, step.slopes))
            self._by_anchors = step.by_anchors(adjoint, self._by_anchors)
            self._pass_back_openings(step, adjoint)
            if self._rates is not None:
                a = adjoint.a.x.array[: load.size]
                self._add_density(self._rates.by_density, a)
                self._rates.pass_back(a, step.damped)
            for law in self._laws:
                self._pass_back_law(law, adjoint)

    def _by_openings(self) -> Array | float:
        """Derivative by the positions through openings that are locked after this step ``(n_owned, gdim)`` (collective)."""
        found: Array | float = 0.0
        for k, section in enumerate(self._sections):
            if section is not None and not section.locked:
                # all ranks have the same sum
                by, self._by_opening[k] = self._by_opening[k], 0.0
                found = found + by * section.opening_back() if by else found
        return found

    def _pass_back_openings(self, step: LinearisedStep, adjoint: Adjoint) -> None:
        """Add derivatives by openings that were locked before this step (collective)."""
        first = 0
        for k, (section, own) in enumerate(zip(self._sections, step.equations)):
            if section is not None and section.locked and not section.shortened:
                by = -float(adjoint.by_gaps[first : first + len(own)] @ section.along)
                self._by_opening[k] += float(reduced(self.problem.comm, by))
            first += len(own)

    def _pass_back_law(self, law: PlasticSlopes, adjoint: Adjoint) -> None:
        """Compute derivatives by a law's history at the beginning of the step, and by its parameters (collective)."""
        by, by_bulk = law.pass_back(), None
        for k, m in enumerate(self._controls):
            if isinstance(m, fem.Constant | fem.Function) and law.is_made_of(m):
                by_bulk = by_bulk or self._derivatives.by_function(adjoint.terms, law.bulk)
                self._add(k, law.by_parameter(m, by, by_bulk))

    def _begin_rates(self, rates: RateSlopes, J: ufl.Form | None) -> None:
        """Begin the step's derivatives in time, with a functional of the velocity and acceleration at its end (collective)."""
        dynamics = self.problem.dynamics
        assert dynamics is not None
        rates.begin()
        for f, values in zip((dynamics.velocity, dynamics.acceleration), dynamics.rates()):
            f.x.array[: len(values)] = values
            f.x.scatter_forward()
        if J is not None:
            by = [self._derivatives.by_values(J, f) for f in (dynamics.velocity, dynamics.acceleration)]
            rates.look_at(*(0.0 * values if one is None else one for one in by))

    def _add_density(self, by: Callable[[Array], float], a: Array) -> None:
        """Add to the derivative by the density, from the adjoint displacement a and the derivative by its logarithm (collective)."""
        dynamics = self.problem.dynamics
        for k, m in enumerate(self._controls):
            if isinstance(m, fem.Constant) and dynamics is not None and m is dynamics.mass.density:
                self._add(k, np.asarray(by(a) / m.value))

    def _add(self, k: int, more: Array | fem.Function) -> None:
        """Add to the derivative by a control."""
        if self.found[k] is None:
            self.found[k] = more
        elif isinstance(more, fem.Function):
            self.found[k].x.array[:] += more.x.array
        else:
            self.found[k] = self.found[k] + more

    def begin(self, first: Record) -> None:
        """Add derivatives by the initial anchors of the first step, the positions of contactors before it (collective)."""
        problem = self.problem
        if not any(pair.friction is not None for pair in problem.interfaces):
            return
        Memory.put_back(first.before, problem)
        slopes = anchor_slopes_of(problem)
        handed, _ = _back(problem, self._by_anchors, slopes, True)
        for k, m in enumerate(self._controls):
            if isinstance(m, ContactParameter):
                self._add(k, _left_behind(problem, m, self._by_anchors, slopes, True))
            elif isinstance(m, ufl.SpatialCoordinate):
                by = fem.Function(problem.config.V)
                by.x.array[: handed.size] = handed.ravel()
                by.x.scatter_forward()
                self._add(k, Places(problem.config).back(by))

    def accelerate(self, start: Record) -> None:
        """Add derivatives by the first acceleration and velocity, with the problem set to the start (collective).

        With ``a = -P (P'MP)^-1 P'F`` under the initial forces F, a functional with derivative b by a has ``-P (P'MP)^-1 P'b`` by F.
        """
        problem, dynamics = self.problem, self.problem.dynamics
        if dynamics is None or self._rates is None:
            return
        place_at_start(problem, self._controls)
        a = accelerations(problem, self._rates.by_acceleration())
        by_velocity = self._rates.by.v + self._rates.by.w - damped_by(problem, self._derivatives, a)
        terms = [(self._derivatives.work, -1.0)]
        for k, m in enumerate(self._controls):
            if isinstance(m, fem.Constant):
                own = self._derivatives.by_constant(terms, m) - self._by_nodal_forces(m, a)
                self._add(k, start.shares.get(id(m), 1.0) * own)
            elif isinstance(m, ContactParameter) and (section := section_of(m.contact.pair)) is not None:
                self._add(k, -self._work(a, by_section(section, m.parameter, 0)[1]))
            elif isinstance(m, fem.Function):
                more = self._derivatives.by_function(terms, m)
                if m is dynamics.start_velocity:
                    more.x.array[: len(by_velocity)] += by_velocity
                    more.x.scatter_forward()
                self._add(k, more)
        self._add_density(self._rates.by_density_at_start, a.array_r[: by_velocity.size])

    def _by_nodal_forces(self, m: fem.Constant, a: PETSc.Vec) -> Array:
        """Work along ``a`` of the change of the residual with the entries of a Constant at nodes, of its shape (collective)."""
        found, users = np.zeros(np.shape(m.value)), Users(self.problem, 0.0)
        for entry in np.ndindex(found.shape) if users.have(m) else ():
            unit = np.zeros(found.shape)
            unit[entry] = 1.0
            found[entry] = self._work(a, users.changes(m, unit)[1])
        return found

    def _work(self, a: PETSc.Vec, forces: Array) -> Array:
        """Work of forces at the owned nodes ``(n_owned, gdim)`` along a (collective)."""
        return np.asarray(reduced(self.problem.comm, float(a.array_r[: forces.size] @ forces.ravel())))


def place_at_start(problem: UnitedProblem, controls: Sequence[AnyControl]) -> None:
    """Place the contacts of a problem that is set to the start of its motion (collective).

    InputError for parameters of rigid targets that contactors touch then, and that so affect the first acceleration.
    """
    assert isinstance(problem.system, BodySystem)
    problem.system.place()
    problem.system.floating.begin_motion()
    for m in controls:
        moves = isinstance(m, ContactParameter) and m.parameter in ("place", "turn")
        if moves and reduced(problem.comm, int(m.contact.pair.trial.active.sum())):
            raise InputError(
                f"contact '{m.contact.name}' touches at the start, where the first acceleration has no derivative by its "
                f"{m.parameter}: expected a motion that begins before it touches"
            )


def accelerations(problem: UnitedProblem, forces: Array) -> PETSc.Vec:
    """``P (P'MP)^-1 P'`` times forces ``(n,)``, at the start of a motion (collective)."""
    assert isinstance(problem.system, BodySystem) and problem.dynamics is not None
    return united_accelerations(problem.dynamics.matrix, problem.system.restriction(), problem.config.vector(forces))


class LinearisedStep(Linearised):
    """The constrained problem linearised at the end of a recorded step (collective).

    Args:
        problem: set to the end of the step, before its commit.
        record: of the step.
        derivatives: of its residual and of functionals.
        rates: derivatives of the time step; None in statics.
    """

    def __init__(self, problem: UnitedProblem, record: Record, derivatives: Derivatives, rates: RateSlopes | None):
        super().__init__(problem, derivatives, record.held)
        self._led, self._rates = record.shares, rates
        #: Derivative of the work of damping along ``a`` by the velocity ``(n,)``; 0 without damping.
        self.damped: Array | float = 0.0

    def share(self, m: Any) -> float:
        """Share of a control in the step, see ``solve.loading``."""
        return self._led.get(id(led_for(m)), 1.0)

    def _linearise(self) -> None:
        problem = self.problem
        state = self._state()
        self.slopes = anchor_slopes_of(problem)
        if state.rows.conflict and any(self.slopes):
            raise InputError(
                "equations of contactors with friction conflict with each other or with Dirichlet conditions, and have been replaced by "
                "others, through which histories have no derivatives; let nodes be contactors of one contact, with free normals"
            )
        forms.free_petsc_garbage(problem.comm)
        self.K, self.G = problem.bodies.update_tangent(), self.stiffness_of()
        if problem.linear is not None and (parts := [*problem.linear.curvature(), *problem.linear.stiffness()]):
            self.G = together(self.G, contact_curvature(parts, self.config.unknowns.vector()))
        K = self.K
        back = transposed(K) if not is_symmetric(K, self.config.unknowns) else K
        self._K_back, self._G_back = back, None if self.G is None else transposed(self.G)
        self.set_operator()
        self._tell_idle()

    def __exit__(self, *error: object) -> None:
        solver = self.problem.solver
        if solver.iterative or not solver.lasting or any(self.slopes):
            self.problem.system.forget()

    def stiffness_back(self, a: PETSc.Vec) -> PETSc.Vec:
        """``(K + G)' a`` (collective)."""
        found = forms.product(self._K_back, a, self._G_back)
        if self._rates is not None:
            self.damped = damped_by(self.problem, self.derivatives, a)
            found.array[:] += self._rates.beyond_tangent(np.array(a.array_r), self.damped)
        return found

    def adjoint(self, drive: PETSc.Vec) -> tuple[PETSc.Vec, PETSc.Vec]:
        """With rows that lean, which the matrix leaves out: again and again, until their part stays as it is (collective)."""
        whole, left = super().adjoint(drive)
        before = None
        for _ in range(MOST_LEANING if self._leaning else 0):
            by_gaps, more = self.by_gaps(left), np.zeros((self.config.n_owned, self.config.gdim))
            for row, nodes, coefficients in self._leaning:
                by = (by_gaps[row, None, None] * coefficients).reshape(-1, self.config.gdim)
                more += self.config.add_at_owners(np.maximum(nodes, 0).ravel(), by)
            load = drive + self.vector(more)
            if before is not None and (load - before).norm() <= LEANS_NO_MORE * load.norm():
                return whole, left
            whole, left = super().adjoint(load)
            before = load
        return self._given_up() if self._leaning else (whole, left)

    def leaned(self, way: Array) -> Array:
        """Changes of the gaps of all equations by rows that lean, for changes of positions ``(n_owned, gdim)``: ``(m,)`` (collective)."""
        found = np.zeros_like(self.multipliers)
        for row, nodes, coefficients in self._leaning:
            there = self.config.ask_owners(np.maximum(nodes, 0).ravel(), way).reshape(coefficients.shape)
            found[row] = np.einsum("kcg,kcg->k", coefficients, there)
        return found

    def changes(self, m: ContactParameter, entry: tuple[int, ...]) -> tuple[Array, Array]:
        """With rows that lean as the target moves (collective)."""
        gaps, pushed = super().changes(m, entry)
        if m.parameter in ("place", "turn"):
            own, which = self.equations_of(m.contact)
            leaned = self.leaned(motion_of(m, self.config.x[: self.config.n_owned], entry))[which]
            gaps[which] -= np.where(contactors_of(own, m.contact.pair), leaned, 0.0)
        return gaps, pushed

    def _given_up(self) -> NoReturn:
        raise LinearSolveError(
            "contactors that stick have come so far along their normals in a step, while these turn, that its derivatives are not found: "
            "take shorter steps, or coupling='node_to_surface'"
        )

    @cached_property
    def _leaning(self) -> list[tuple[Ints, Ints, Array]]:
        """Parts of rows that the matrix leaves out, with numbers of equations; empty if no rank has any (first time: collective)."""
        found, first = [], 0
        for slopes, own in zip(self.slopes, self.equations):
            if slopes is not None and (part := slopes.leaning(own)) is not None:
                found.append((first + part[0], *part[1:]))
            first += len(own)
        return found if reduced(self.config.comm, int(any(part[2].any() for part in found))) else []

    def by_anchors(self, adjoint: Adjoint, kept: list[Array]) -> list[Array]:
        """Derivatives by the initial anchors of the step, including unchanged anchors (collective)."""
        n, g = self.config.n_owned, self.config.gdim
        a, first, found = adjoint.a.x.array[: n * g].reshape(n, g), 0, []
        for slopes, own, before in zip(self.slopes, self.equations, kept):
            part = adjoint.by_gaps[first : first + len(own)]
            first += len(own)
            found.append(before if slopes is None else slopes.by_anchors(part, own, a) + before)
        return found


def damped_by(problem: UnitedProblem, derivatives: Derivatives, a: PETSc.Vec) -> Array | float:
    """Derivative of the work of damping along ``a`` by the velocity ``(n,)``; 0 without damping (collective)."""
    derivatives.along(problem.config.from_rows(a.array_r))
    if problem.dynamics is None or problem.dynamics.damping is None:
        return 0.0
    found = derivatives.by_values(derivatives.work, problem.dynamics.past)
    return 0.0 if found is None else found


def anchor_slopes_of(problem: UnitedProblem) -> list[AnchorSlopes | MeanSlopes | None]:
    """Derivatives by anchors, or positions, in the present trial states, None without friction (collective)."""
    kinds = ((AnchorSlopes if pair.discretisation.traits.pointwise else MeanSlopes, pair) for pair in problem.interfaces)
    return [kind(pair) if pair.friction is not None else None for kind, pair in kinds]


def _back(
    problem: UnitedProblem, by_anchors: list[Array], slopes: Sequence[AnchorSlopes | MeanSlopes | None], first: bool = False
) -> tuple[Array, list[Array]]:
    """Derivatives by positions of the owned nodes ``(n_owned, gdim)``, from derivatives by anchors, and by unchanged ones (collective)."""
    handed, left = np.zeros((problem.config.n_owned, problem.config.gdim)), []
    for own, at in zip(by_anchors, slopes):
        if at is not None:
            places, own = at.back(own, first)
            handed += places
        left.append(own)
    return handed, left


def _left_behind(
    problem: UnitedProblem,
    m: ContactParameter,
    by_anchors: list[Array],
    slopes: Sequence[AnchorSlopes | MeanSlopes | None],
    first: bool = False,
) -> Array:
    """Derivatives by a motion of the target, from derivatives by anchors, the positions of its contactors relative to it (collective)."""
    found, (whole, rows) = np.zeros(m.shape(problem.config.gdim)), table_of(m.contact.pair)
    k = problem.interfaces.index(whole)
    if m.parameter in ("place", "turn") and (at := slopes[k]) is not None:
        handed, _ = at.back(at.of_contact(by_anchors[k], rows), first)
        for entry in np.ndindex(found.shape):
            found[entry] = -(handed * motion_of(m, problem.config.x[: len(handed)], entry)).sum()
    return np.asarray(reduced(problem.comm, found))
