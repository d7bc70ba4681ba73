"""The constrained system: bodies, contact pairs, P and Q together, as the ``newton.ContactMethod`` of elimination."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING

from mpi4py import MPI

import numpy as np
from petsc4py import PETSc

from uem_dolfinx import forms
from uem_dolfinx.algebra.linear_solver import UnitedSolver
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array, Indices
from uem_dolfinx.contact.pair.interface import Interface, in_question
from uem_dolfinx.contact.seam.placement import Traction
from uem_dolfinx.contact.warnings.checks import check_initial, check_prescribed, check_signs
from uem_dolfinx.log import timed
from uem_dolfinx.parallel import gathered, reduced
from uem_dolfinx.solve.bodies.bodies import FORCE_ROUNDING, Bodies
from uem_dolfinx.solve.bodies.field_scales import first, ratio
from uem_dolfinx.solve.bodies.tangent import added_mass, curvature_of, known_forces, slip_terms, together
from uem_dolfinx.solve.rigid.first_touch import nodes_next_to, touch_ahead, way_ahead
from uem_dolfinx.solve.rigid.floating import FloatingBodies
from uem_dolfinx.solve.rigid.unheld import refuse_bare
from uem_dolfinx.solve.united import rows as united_rows
from uem_dolfinx.solve.united.equilibrium import InEquilibrium, IterationState
from uem_dolfinx.solve.united.exchanges import Exchanges, count, foreseen
from uem_dolfinx.solve.united.newton import FORCING, Increment, LinearisedProblem
from uem_dolfinx.solve.united.normal_return import move_back
from uem_dolfinx.solve.united.rows import BodyState, OverConstraints, Rows, make_rows

if TYPE_CHECKING:
    from uem_dolfinx.algebra.condensed import Solved
    from uem_dolfinx.conditions.user_rows import UserRows
    from uem_dolfinx.contact.thermal.heat import Heat

#: A direct solve predicts gaps to this part of the increment, and forces to what moves a contactor that far.
#: [convention; the increment; test_system.py::test_what_a_solve_predicts]
PREDICTED = 1e-8
#: Part of the model's size that an active contactor's gap may be left with.
#: [convention; the model's size; test_system.py::test_gaps_that_count_as_closed]
CLOSED = 1e-13


class BodySystem:
    """Bodies whose active contactors are eliminated.

    Args:
        pairs: of all contacts, newly made.
        solver: of the constrained system.
        newton: ``"full"`` or ``"modified"``.
        consistent_tangent: whether the curvature of the contact is added to K.
        linear: equations of users, or None.
    """

    def __init__(
        self,
        bodies: Bodies,
        pairs: Sequence[Interface],
        solver: UnitedSolver,
        *,
        newton: str = "full",
        consistent_tangent: bool = True,
        linear: UserRows | None = None,
    ):
        self.bodies, self.solver = bodies, solver
        self.config, self.unknowns, self.comm = bodies.config, bodies.unknowns, bodies.comm
        self._n = bodies.forces.size  # number of the displacement's components on this rank, which come first in vectors
        self.newton, self.consistent_tangent = newton, consistent_tangent
        solver.lasting = bodies.tangent.linear or newton == "modified"
        self.curvature: PETSc.Mat | None = None  # of the contact in the last constrained matrix
        self._petrov_galerkin = False  # whether P differs from Q
        #: The last state with a final active set, if its matrix has a negative determinant, or with other fields of either sign.
        self._not_unique: tuple[BodyState, bool] | None = None
        self._led = False  # whether the bodies have moved in this step
        self._adrift = False  # whether the last change of the active set has released a loaded body
        self._swept = False  # whether contactors that have slid off a thin target may pass it, before equilibrium is reached
        self._multipliers: Array = np.zeros(0)  # of the equations of users, as last computed ``(m,)``
        self.take(pairs, linear)
        self.place()
        #: Initial penetrations, see ``check_initial``.
        self.overlaps = {key: depth for pair in self.pairs for key, depth in check_initial(pair).items()}
        for pair in self.near:
            pair.activate_touching()

    def take(self, pairs: Sequence[Interface], linear: UserRows | None) -> None:
        """Replace all pairs and equations of users, under the bodies' present conditions, from the next step on (collective)."""
        from uem_dolfinx.solve.bodies.far_apart import FarApart

        self.linear, self.pairs = linear, list(pairs)
        self.rows: Rows | None = None  # equations of the last state
        self._here: Rows | None = None  # equations at the last projection, with its slip directions; None until needed
        self._forces_here: tuple[Rows, PETSc.Vec, PETSc.Vec, PETSc.Vec] | None = None  # see ``_present_forces``
        self._look()
        self.exchanges, self.far_apart = Exchanges(self.pairs), FarApart(self.config, self.pairs)
        self.over_constraints = OverConstraints(self.config, self.pairs, self.linear)
        self.solver.condensed.adjacent_nodes = nodes_next_to(self.config, self.pairs)
        self.floating = FloatingBodies(self.bodies, self.pairs, linear, self.far_apart)

    def _look(self) -> None:
        """Collect the pairs that may be in contact on any rank; iterations loop over these only."""
        self.near: list[Interface] = in_question(self.pairs)
        self._heats: list[Heat] = [heat for pair in self.near for heat in pair.heats]
        self._soft = any([pair.trial.has_law for pair in self.near])

    # -- projection of contactors ----------------------------------------------------------------------------------------

    def place(self) -> None:
        """Project the contactors at the present positions of bodies and targets."""
        if self.linear is not None:
            self.linear.place()
        self._here = self._forces_here = None
        if not self.pairs:
            return
        self.bodies.check_displacement(min([pair.target.stride for pair in self.pairs]))
        with timed("search and projection"):
            self.far_apart.place()
            for pair in self.pairs:
                pair.project()
        self._look()

    def return_to_targets(self, bound: float) -> bool:
        """Normal return [UEM, 4.2]: move active contactors back onto the moved targets (collective); see ``ContactMethod``."""
        moved = bool(self.pairs) and move_back(self.bodies, self.near, self.over_constraints.shared, bound)
        if moved:
            self.place()
        return moved

    def begin_step(self) -> None:
        """Begin a step: bodies that only contact holds fall until they touch; for others, the first contact is predicted."""
        self._not_unique, self._led = None, False
        self.exchanges.begin_step()
        for pair in self.pairs:
            pair.discretisation.begin_step()
            if pair.discretisation.traits.sliding == "small":
                pair.project()
        self.floating.begin_step(self.place)
        if self.pairs and self.bodies.dynamics is None and self.floating.motions is None:
            touch_ahead(self.bodies, self.pairs, self.floating.rigid, self.place, self.far_apart.look_within)
        self._look()

    def end_step(self) -> None:
        """Refuse an equilibrium with conflicting contacts and conditions, or one of several equilibria (collective)."""
        for pair in self.near:
            check_prescribed(pair)
        check_signs(self.near, [self.bodies.rounding_at(pair.nodes) for pair in self.near])
        if self.linear is not None:
            self.linear.check()
        self.floating.end_step()
        if self._not_unique is not None:
            state, negative = self._not_unique
            matrix = state.rows.frictionless, self.bodies.tangent.K, together(self.curvature, state.added)
            if negative != self.solver.negative_without(*matrix):
                raise united_rows.several_answers()

    # -- equations and forces --------------------------------------------------------------------------------------------

    def residual(self) -> PETSc.Vec:
        """Forces of the bodies minus loads of contacts and friction that is independent of the normal force (collective)."""
        F, known = self.bodies.residual, known_forces(self.near) if self.exchanges.frictional else []
        for nodes, forces in filter(None, [*known, *[pair.applied_forces() for pair in self.near]]):
            F.array[: self._n] -= self.config.add_at_owners(nodes, forces).ravel()
        if self._heats:
            F.array[:] += sum([heat.residual() for heat in self._heats])
        return F

    def assemble_constraints(self, in_equilibrium: InEquilibrium) -> IterationState:
        """The targets of the contactors at the present displacement, and their equations.

        1. Compute Q'F with the present equations.
        2. In equilibrium, compute the contact forces from F; otherwise they are the prediction of the last linearised problem.
        3. Release contactors past an end, and follow the others across bends, into corners and out of them.
        4. Project contactors with changed equations again; let bodies that contact no longer holds fall.
        5. Compute the new equations, Q'F with them, and the contactors that violate the contact conditions.
        """
        bodies, pairs, turning = self.bodies, self.near, self.linear is not None and self.linear.turning
        if bodies.stiffness is None and self.pairs:
            # for the rounding of contact forces
            bodies.update_tangent()
        rounding = self.rounding()
        with timed("uniting equations"):
            rows, F, y, residual = self._present_forces()
            self._here = self._forces_here = None
            at_rest = in_equilibrium(norm := self.unknowns.norms(residual), self.bodies.forces_at_work(F), rounding)
            if at_rest or (turning and not pairs):
                self._take(self._read_forces(rows, y))
                if any(heat.lags for heat in self._heats):
                    residual = rows.test.transpose(F := self.residual())
                    at_rest = in_equilibrium(norm := self.unknowns.norms(residual), self.bodies.forces_at_work(F), rounding)
            self._swept = not at_rest
            moved = bool(pairs) and reduced(self.comm, any([pair.follow() for pair in pairs]), op=MPI.LOR)
            found = [
                pair.violated(pair.kinematics.gap, pair.traction, bodies.rounding_at(pair.nodes), 0.0, self._swept)
                for pair in pairs
            ]
            violated = count(pairs, found)
            # a released body falls, even if the active set still changes
            unsettled = moved or (violated > 0 and not (at_rest and self.floating.adrift))
            wanting = not (at_rest and violated == 0 and not moved)
            # the residual at the beginning of a step does not include prescribed increments
            if wanting and pairs and self._led and self.exchanges.visit(first(norm)):
                moved = True
            fallen = self.floating.fall_again(self.place, unsettled, at_rest)
            if moved or fallen:
                rows = self._rows()
                residual = rows.test.transpose(self.residual())
                norm = self.unknowns.norms(residual)
        trial, added, forces, active, gap = self._trial_of(rows)
        self.rows = rows
        torn = max([heat.torn() for heat in self._heats], default=0.0)
        return BodyState(
            trial=trial,
            test=rows.test,
            residual=residual,
            norm=norm,
            scale=self.bodies.forces_at_work(),
            rounding=rounding,
            gap=gap,
            active=active,
            changed=moved or fallen,
            right=at_rest and violated == 0,
            closed=gap <= CLOSED * self.config.size and torn <= CLOSED and self.bodies.dirichlet_met(),
            in_contact=bool(self.pairs),
            rows=rows,
            added=added,
            forces=forces,
        )

    def rows_of_last(self) -> Rows:
        """Equations of the last state; those at the last projection if a run begins or continues, and of mortar (collective)."""
        if self.rows is None or not all(pair.discretisation.traits.two_pass for pair in self.near):
            self.rows = self.present_rows()
        return self.rows

    def present_rows(self) -> Rows:
        """Equations at the last projection, with its slip directions (collective)."""
        if self._here is None:
            for pair in self.near:
                assert self.bodies.stiffness is not None
                if pair.friction is not None:
                    pair.take(pair.friction.turn(pair.trial, pair.kinematics, self.bodies.stiffness))
            self._here = self._rows()
        return self._here

    def _present_forces(self) -> tuple[Rows, PETSc.Vec, PETSc.Vec, PETSc.Vec]:
        """Equations at the last projection, forces F there, the same transferred by Q, and Q'F (collective)."""
        if self._forces_here is None:
            rows, F = self.present_rows(), self.residual()
            self._forces_here = rows, F, (y := rows.test.pass_on(F)), rows.test.reduce(y)
        return self._forces_here

    def _rows(self) -> Rows:
        """Equations of all pairs in their present states, and Q (collective)."""
        hold = partial(self.floating.hold, self.bodies.free_rows)
        return make_rows(self.over_constraints, self.near, hold, self.bodies.prescribed, self.linear)

    def _trial_of(self, rows: Rows, convex: bool = False) -> tuple[Restriction, PETSc.Mat | None, PETSc.Vec, int, float]:
        """P, tangent of the slip directions, forces with their terms, number of active contactors, and their largest gap (collective)."""
        # if equations conflict, P might eliminate other components than Q
        trial, moved = rows.frictionless, None if rows.conflict else rows.whole.moved
        if moved is not None:
            trial = self.over_constraints.turned(moved, trial, self.bodies.prescribed) or trial
        self._petrov_galerkin = trial is not rows.frictionless or rows.test is not rows.frictionless
        gaps = [one.largest_gap_here() for one in (*self.near, self.linear) if one is not None]
        united = sum([int(pair.united.sum()) for pair in self.near])
        each = gathered(self.comm, np.array([united, max(gaps)])) if gaps else np.zeros((1, 2))
        added, held = slip_terms(self.near, self.unknowns.like, self.linear, convex)
        forces = self.residual() if held is None else self.residual() + held
        return trial, added, forces, int(each[:, 0].sum()), each[:, 1].max()

    def exchange(self, problem: LinearisedProblem, step: Increment) -> BodyState | None:
        """The state with an active set changed where gaps and forces, both to first order, violate contact conditions (collective)."""
        if not self.pairs:
            return None
        state, du, left = problem.state, step.du, step.left
        assert isinstance(state, BodyState)
        driving = max(first(self.unknowns.norms(rhs)) for rhs in (problem.rhs, step.rhs)) if left > 0.0 else 0.0
        with timed("uniting equations"):
            increment = du.array_r[: self._n].reshape(-1, self.config.gdim)
            way = float(reduced(self.comm, np.abs(increment).max(initial=0.0), op=MPI.MAX))
            if self.far_apart.look_within(way):
                self._look()
            F = self._predicted_forces(state, du, self.solver.forces(self.bodies.tangent.K, du))
            forces = self._read_forces(state.rows, state.rows.test.pass_on(F), increment)
            near = max(PREDICTED, left) * way
            sliding = self._sliding(F, forces)
            moved = increment if sliding is None else increment + sliding
            gaps, violated = foreseen(self.bodies, zip(self.pairs, forces), increment, moved, near, left * driving, self._swept)
            arrays = not self._adrift and self.exchanges.take_long(violated, self.solver.cheap, self.solver.gives_way)
            if arrays and (
                solved := state.rows.settle(self.bodies, self.solver, self.residual(), self.curvature, increment, left)
            ):
                return self._with_rows(state, solved)
            climbs = self.exchanges.softens and self.exchanges.climbs(self.solver, step)
            any_left = violated if self._adrift and count(self.pairs, violated) else None
            chosen = any_left if self._adrift else self.exchanges.choose(violated, gaps, self.curvature is not None, climbs)
            if chosen is None and sliding is not None and not self.exchanges.frozen:
                raise united_rows.not_held()
            if chosen is None or self._adrift:
                negative, either = self.solver.negative, self.unknowns.mixed and self.solver.tells_sign
                rotated = state.test is not state.rows.frictionless
                self._not_unique = (state, negative) if rotated and (negative or either) else None
                self._take(forces)
                return None
            self.curvature = None if self.exchanges.straight else self.curvature
            for pair, w in ((pair, w) for pair, w in zip(self.pairs, chosen) if pair.in_reach):
                pair.exchange(w)
            return self._with_rows(state)

    def _with_rows(self, state: BodyState, solved: Solved | None = None) -> BodyState:
        """The same bodies and residual with the rows of the pairs' present states, and their solution if known (collective)."""
        rows = self._rows()
        self._adrift = self.floating.adrift  # a released body has to fall first
        return state.with_rows(rows, solved, *self._trial_of(rows, self.exchanges.straight and self.exchanges.softens)[:4])

    def _predicted_forces(self, state: BodyState, du: PETSc.Vec, F: PETSc.Vec) -> PETSc.Vec:
        """``F = K du`` plus the terms of contact and friction, and the present forces (collective)."""
        for more in filter(None, (self.curvature, state.added)):
            F.axpy(1.0, forms.product(more, du))
        F.axpy(1.0, state.forces)
        return F

    def _sliding(self, F: PETSc.Vec, forces: list[Traction]) -> Array | None:
        """Unbounded sliding of bodies under predicted forces ``(n_owned, gdim)``; None if friction holds them (collective)."""
        if self.floating.motions is None or not any(pair.friction is not None for pair in self.pairs):
            return None
        # contact forces include the known forces
        every = F + (self.bodies.residual - self.residual())
        more = None if self.linear is None else self.linear.forces(self._multipliers)
        return self.floating.slide(*united_rows.unbalanced(self.pairs, every, forces, more))

    def restriction(self) -> Restriction:
        """Q of the present equations (collective)."""
        return self._rows().test

    def _read_forces(self, rows: Rows, y: PETSc.Vec, du: Array | None = None) -> list[Traction]:
        """Contact forces of every pair, from transferred forces y (collective)."""
        forces, self._multipliers = united_rows.read_forces(self.pairs, rows, y, du)
        return forces

    def _take(self, forces: list[Traction]) -> None:
        """Store the contact forces in the pairs."""
        for pair, own in [(pair, own) for pair, own in zip(self.pairs, forces) if pair.in_reach]:
            pair.set_forces(own)
        if self.linear is not None:
            self.linear.multipliers = self._multipliers

    def rounding(self) -> float:
        """Norm of the forces due to rounding of the displacement, and of the active contactors' positions (collective)."""
        active = [np.zeros(0, np.int32), *[pair.nodes[pair.united] for pair in self.near]]
        of_bodies = self.bodies.rounding(np.concatenate(active))
        of_heat = sum(self.unknowns.norms_of(heat.sizes()) for heat in self._heats)
        return of_bodies + FORCE_ROUNDING * (of_heat + self.bodies.of_fields(sum([pair.displaced() for pair in self.near])))

    def reduced_residual(self, state: IterationState) -> PETSc.Vec:
        """``Q'F`` of the last projection and the last assembled residual, with the active set of ``state``.

        Q uses the present normals and slips: with the old Q, rotated contact forces would count as residual.
        """
        return self._present_forces()[-1]

    def accelerate(self, restriction: Callable[[], Restriction] | None = None) -> None:
        """Find the initial acceleration of the bodies, with P of all equations or what ``restriction`` returns (collective)."""
        dynamics = self.bodies.dynamics
        if dynamics is not None and not dynamics.accelerated:
            self.place()
            self.bodies.assemble()
            self.floating.begin_motion()
            dynamics.accelerate((restriction or self.restriction)(), F := self.residual(), added_mass(self.linear, F))
            if self.linear is not None:
                self.linear.settle(dynamics)

    # -- linear system ---------------------------------------------------------------------------------------------------

    def _differentiate(self, first: bool) -> None:
        """Tangent of the bodies and curvature of the contact at the present displacement (collective)."""
        forms.free_petsc_garbage(self.comm)
        self._led = True
        if first:
            self.solver.begin_step()
        if first or self.newton == "full":
            self.bodies.update_tangent()
        with timed("contact curvature"):
            how = self.unknowns.like, self._petrov_galerkin, self.exchanges.convex, self.linear
            self.curvature = curvature_of(self.near, *how) if self.consistent_tangent else None
        self.exchanges.begin()
        self._adrift = False

    def linearise(self, state: IterationState, iteration: int | None) -> LinearisedProblem:
        """Constrained matrix ``Q'KP`` of a state, and the right-hand side ``Q'(r - K c)`` (collective)."""
        if iteration is not None:
            self._differentiate(first=iteration == 0)
        assert isinstance(state, BodyState)
        if iteration is not None and (way := way_ahead(self.bodies, self.solver, self.near, iteration == 0)) is not None:
            left = 0.0 if self.bodies.dynamics else FORCING * (min(ratio(state.norm, state.scale), 1.0) if iteration else 1.0)
            solved = state.rows.settle(self.bodies, self.solver, self.residual(), self.curvature, way, left)
            state = state if solved is None else self._with_rows(state, solved)
        K, P, Q, c = self.bodies.tangent.K, state.trial, state.test, state.trial.c
        state = state.with_pressures(K, self.curvature) if self._heats else state
        curvature = together(self.curvature, state.added)
        refuse_bare(self.bodies, P, Q, curvature)
        # modified Newton ignores changes of coefficients in P
        state.set_operator(self.solver, K, curvature, roughly=self.newton == "modified")
        inexact = self.solver.inexact
        linear = self.bodies.linear and not (self._soft or (self.linear is not None and self.linear.turning))
        # in dynamics momentum is conserved exactly by exact solves
        passing = not linear or (self.curvature is not None and self.bodies.dynamics is None)
        return LinearisedProblem(
            state=state,
            rhs=-Q.transpose(self._predicted_forces(state, c, forms.product(K, c))),
            exact=state.solved is not None or (not inexact and (self.bodies.dynamics is not None or not passing)),
            iterative=inexact and state.solved is None,
            passing=passing,
            fits=linear or (self.linear is not None and self.linear.joints_led(CLOSED * self.config.size)),
            convex=self.exchanges.convex or self.exchanges.jumps,
            softens=self.exchanges.softens,
        )

    def solve(self, problem: LinearisedProblem, accuracy: float, near: PETSc.Vec | None) -> Increment:
        """Unknowns dq, and ``du = P dq + c``, in all nodes if open motions or separated contacts need them (collective)."""
        self.solver.begin_at(problem.state.trial.c, first(problem.state.rounding))
        dq, iterations = self.solver.solve(problem.rhs, accuracy, near)
        dq = self.solver.complete(dq, self._needed) if near is None else dq
        return Increment(dq, self.move(problem.state, dq), problem.rhs, iterations, self.solver.left(accuracy))

    def _needed(self) -> list[Indices] | None:
        """Nodes whose motion decides on contact; None for all, if open motions or separated contacts need them."""
        return None if self.floating.neutral or (self.pairs and self.far_apart.any) else [pair.nodes for pair in self.pairs]

    def complete(self, problem: LinearisedProblem, step: Increment) -> Increment:
        """The increment in all unknowns, if the last solve was condensed onto the contact (collective)."""
        dq = self.solver.complete(step.dq)
        return step if dq is step.dq else step._replace(dq=dq, du=self.move(problem.state, dq))

    def forget(self) -> None:
        """Let the next step assemble and factorise anew, like the first step of a run (collective)."""
        self.solver.forget()

    def move(self, state: IterationState, dq: PETSc.Vec) -> PETSc.Vec:
        """``du = P dq + c``, without motion of bodies along neutral motions."""
        du = state.trial.expand(dq)
        du.axpy(1.0, state.trial.c)
        du.array[: self._n] = self.floating.without_open_motions(du.array_r[: self._n])
        return du
