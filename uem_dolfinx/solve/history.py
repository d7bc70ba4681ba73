"""Gradients of functionals of all steps: committed steps kept in memory, and swept backwards, each by one adjoint problem.

With displacements u_n, anchors h_n that a step leaves behind, and a residual R of a step that began with h_{n-1},

    R(u_n, h_{n-1}; m) = 0,        h_n = H(u_n, h_{n-1})

a sweep from the last step to the first hands derivatives back,

    d_n = dJ/du_n + (dH/du_n)' b_n,        b_{n-1} = (dH/dh_{n-1})' b_n + dJ/dh_{n-1} through a_n

where a_n is of the adjoint problem with the load d_n, as in ``adjoint``. Which contactors touch, stick and slip, and the number of steps,
are those that were found.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import forms, given
from uem_dolfinx.algebra.entries import is_symmetric
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.anchor_slopes import AnchorSlopes
from uem_dolfinx.contact.laws.coulomb import Coulomb
from uem_dolfinx.contact.laws.law import as_law, follows_load
from uem_dolfinx.contact.parameters import ContactParameter, keeps_distance, motion_of
from uem_dolfinx.contact.state import PairState
from uem_dolfinx.errors import InputError
from uem_dolfinx.form_checks import check_functional
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.rigid import Motion
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.solve.adjoint import Adjoint, Linearised
from uem_dolfinx.solve.gradient import AnyControl, check_controls, check_problem, refuse_results
from uem_dolfinx.solve.memory import Memory, move_targets
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.tangent import contact_curvature, curvature_of, slip_terms, together


@dataclass(frozen=True)
class Record:
    """One committed step: a value.

    Attributes:
        before: what the step began with.
        displacement: it ended with ``(n_local incl. ghosts,)``.
        states: of the pairs in equilibrium, before they were committed.
        motions: of the pairs' rigid targets.
        values: of what the residual is made of.
        friction, offsets: of the pairs' contactors ``(n,)`` each; None without.
        call: of ``load_steps`` that it was made in.
        factor: part of the loads and of the Dirichlet values that it was led to.
        ramp: how much of a change of its values a Dirichlet condition takes over.
    """

    before: Memory
    displacement: Array
    states: list[PairState]
    motions: list[Motion | None]
    values: list[Array]
    friction: list[Array | None]
    offsets: list[Array | None]
    call: int
    factor: float
    ramp: float


class History:
    """All steps that a problem takes while it is recorded, see :func:`recording`.

    Args:
        problem: in statics, without laws with history.
    """

    def __init__(self, problem: UnitedProblem):
        self.problem = problem
        self._first = problem.progress.steps
        self._records: list[Record] = []
        F = problem.bodies.F
        self._inputs = [*F.constants(), *(f for f in F.coefficients() if f is not problem.u)]

    def __len__(self) -> int:
        """Number of steps."""
        return len(self._records)

    def __repr__(self) -> str:
        """How many steps it has."""
        return f"History({len(self)} steps)"

    def note(self, before: Memory, start: Array | None, factor: float, arc: bool) -> None:
        """Keep the step that the problem is about to commit, in place of the last one if that is taken again."""
        problem, records = self.problem, self._records
        if arc:
            raise InputError(
                "the steps of an arc depend on each other by their lengths, of which there are no derivatives: record steps of given load"
            )
        del records[problem.progress.steps - self._first - 1 :]
        last, call = records[-1] if records else None, problem.progress.ramp
        # values that a ramp began with: of the step before, or of that before the first step of the ramp
        began = [r for r in records if start is None or r.call != call]
        ramp = factor + (1.0 - factor) * (began[-1].ramp if began else 0.0)
        inputs = [np.array(forms.values_of(m)) for m in self._inputs]
        self._records.append(
            Record(
                before=before,
                displacement=np.array(problem.u.x.array),
                states=[pair.trial for pair in problem.pairs],
                motions=problem.rigid_motions(),
                values=[b if last and np.array_equal(a, b) else a for a, b in zip(inputs, last.values if last else inputs)],
                friction=[None if pair.friction is None else pair.friction.value for pair in problem.pairs],
                offsets=[pair.discretisation.offset for pair in problem.pairs],
                call=call,
                factor=factor,
                ramp=ramp,
            )
        )

    def gradient(
        self, J: ufl.Form | Sequence[ufl.Form | None], controls: Sequence[AnyControl] | AnyControl
    ) -> list[Array | fem.Function]:
        """Derivatives of a functional of the recorded steps by parameters of the problem, by one adjoint solve a step (collective).

        Exact for the discrete steps: the derivatives are those of all that is computed, with the contactors that touched, stuck and slipped
        in each step. A change of a control is the same in all steps; of the values of ``load``, and of Dirichlet values that load steps
        lead to, it is a change of those at the full load. The problem is left as it is.

        Args:
            J: functional of ``problem.u`` in the last step and of the controls, as of :func:`uem_dolfinx.gradient`; or a list of
                functionals, one for each step or None, whose sum is differentiated.
            controls: as of :func:`uem_dolfinx.gradient`, coefficients of friction among them.

        Returns:
            As of :func:`uem_dolfinx.gradient`.

        Raises:
            InputError, InputTypeError: see :func:`uem_dolfinx.gradient` and :func:`recording`; if no step was recorded, or where anchors
                have no derivatives: beside edges of the target in space, and in its corners.
            LinearSolveError: if a united matrix is singular.
        """
        problem = self.problem
        some = check_controls(problem, "controls", [controls] if isinstance(controls, AnyControl) else controls)
        functionals = self._functionals(J)
        load = problem.load if isinstance(problem.load, Mapping) else {}
        with agreed(problem.comm):
            for k, m in enumerate(some):
                if isinstance(m, fem.Constant) and callable(load.get(m)):
                    raise InputError(
                        f"controls[{k}] is set by a function of the load factor: expected a Constant that is not, as one by which it is "
                        "multiplied in the residual"
                    )
        now, displacement = Memory.of(problem), np.array(problem.u.x.array)
        values, friction = [np.array(forms.values_of(m)) for m in self._inputs], [_friction_of(pair) for pair in problem.pairs]
        offsets = [pair.discretisation.offset for pair in problem.pairs]
        found: list[Any] = [None] * len(some)
        by_anchors = [np.zeros((0, 0))] * len(problem.pairs)
        try:
            begun = False
            for record, functional in zip(reversed(self._records), reversed(functionals)):
                begun = begun or functional is not None
                if not begun:
                    continue
                step = LinearisedStep(self, record)
                with step:
                    handed, by_anchors = step.handed_back(by_anchors)
                    adjoint = Adjoint(step, None if functional is None else revolved(functional), (), handed)
                    for k, m in enumerate(some):
                        found[k] = _added(found[k], adjoint.by(m))
                        if isinstance(m, ContactParameter):
                            found[k] += _left_behind(problem, m, handed)
                    by_anchors = step.by_anchors(adjoint, by_anchors)
            self._begin(some, found, by_anchors)
        finally:
            self._put(values, friction, offsets)
            now.put_back(problem)
            problem.u.x.array[:] = displacement
        return found

    def _functionals(self, J: Any) -> list[ufl.Form | None]:
        """One for each step, or None (collective)."""
        n, problem = len(self), self.problem
        with agreed(problem.comm):
            if not n:
                raise InputError("the history has no step: expected steps to be taken while it is recorded")
            one = isinstance(J, ufl.Form)
            some = (
                [None] * (n - 1) + [J]
                if one
                else given.items("J", J, lambda f: f is None or isinstance(f, ufl.Form), "a UFL form or None")
            )
            if len(some) != n:
                raise InputError(f"J has {len(some)} items: expected one for each of the {n} recorded steps")
            for k, functional in enumerate(some):
                if functional is not None:
                    what = "J" if one else f"J[{k}]"
                    given.kind(what, functional, not functional.empty(), "a UFL form with an integral")
                    check_functional(what, functional)
                    refuse_results(functional)
        return some

    def _begin(self, controls: list[AnyControl], found: list[Any], by_anchors: list[Array]) -> None:
        """Add derivatives by the anchors that the first step began with, where contactors stood before it (collective)."""
        problem = self.problem
        if not any(pair.frictional for pair in problem.pairs):
            return
        Memory.put_back(self._records[0].before, problem)
        handed, _ = _back(problem, by_anchors)
        for k, m in enumerate(controls):
            if isinstance(m, ContactParameter):
                found[k] += _left_behind(problem, m, handed)
            elif isinstance(m, ufl.SpatialCoordinate):
                found[k].x.array[: handed.size] += handed.ravel()
                found[k].x.scatter_forward()

    def _put(self, values: Sequence[Array], friction: Sequence[Array | None], offsets: Sequence[Array | None]) -> None:
        """Let the problem be made of these (collective)."""
        for m, value in zip(self._inputs, values):
            forms.values_of(m)[...] = value
        for pair, mu, offset in zip(self.problem.pairs, friction, offsets):
            if pair.friction is not None and mu is not None:
                pair.discretisation.with_friction(pair.friction.limits.change(mu))
            if pair.discretisation.offset is not offset:
                pair.discretisation.set_offset(offset)

    def place(self, record: Record) -> None:
        """Bring the problem to the end of a step, before it was committed (collective)."""
        problem = self.problem
        self._put(record.values, record.friction, record.offsets)
        record.before.put_back(problem)
        problem.u.x.array[:] = record.displacement
        move_targets(problem, record.motions)
        for pair, state in zip(problem.pairs, record.states):
            pair.trial = state

    def share(self, m: Any, record: Record) -> float:
        """How much of a change of a control a step has seen."""
        load = self.problem.load
        return record.factor if isinstance(load, Mapping) and m in load else 1.0


class LinearisedStep(Linearised):
    """The united problem linearised at the end of a recorded step (collective)."""

    def __init__(self, history: History, record: Record):
        super().__init__(history.problem)
        self._history, self._record, self.ramp = history, record, record.ramp
        self._slopes: list[AnchorSlopes | None] = []

    def share(self, m: Any) -> float:
        """How much of a change of a control the step has seen."""
        return self._history.share(m, self._record)

    def _linearise(self) -> None:
        problem = self.problem
        self._history.place(self._record)
        state, pairs = self._state(), problem.pairs
        self._slopes = [AnchorSlopes(pair, c.name) if pair.frictional else None for pair, c in zip(pairs, problem.contacts)]
        if state.rows.independent is not None and state.rows.independent.found and any(self._slopes):
            raise InputError(
                "equations of contactors with friction conflict with each other or with Dirichlet conditions, and have been replaced by "
                "others, through which histories have no derivatives; let nodes be contactors of one contact, with free normals"
            )
        forms.free_petsc_garbage(problem.comm)
        self.Q, self.K, self.G = state.test, problem.bodies.update_tangent(), self.stiffness_of(range(len(pairs)))
        K = self.K
        back = _transposed(K) if not is_symmetric(K, self.config.unknowns) else K
        self._K_back, self._G_back = back, None if self.G is None else _transposed(self.G)
        problem.solver.set_operator(self.Q, self._K_back, self._G_back, None if self.Q is self.P else self.P)
        self._tell_idle()

    def __exit__(self, *error: object) -> None:
        solver = self.problem.solver
        if solver.iterative or not solver.lasting or any(self._slopes):
            self.problem.system.forget()

    def stiffness_of(self, which: Sequence[int]) -> PETSc.Mat | None:
        """As that of ``Linearised``, with all that friction adds (collective)."""
        pairs, slopes = [self.problem.pairs[k] for k in which], [self._slopes[k] for k in which]
        states, like = [pair.trial for pair in pairs], self.config.unknowns.vector()
        for pair, own in zip(pairs, slopes):
            pair.trial = pair.trial if own is None else own.without_stuck()
        try:
            curvature = curvature_of(pairs, like, any(self._slopes), False)
        finally:
            for pair, state in zip(pairs, states):
                pair.trial = state
        if self.config.gdim == 2 or not any(slopes):
            return curvature
        turned, _ = slip_terms(pairs, like)
        leaning = contact_curvature([part for own in slopes if own is not None for part in own.leaning()], like)
        return together(together(curvature, turned), leaning)

    def solve_back(self, forces: PETSc.Vec) -> PETSc.Vec:
        """``Q mu`` with ``P'(K + G)'Q mu = P' forces`` (collective)."""
        mu, _ = self.problem.solver.solve(self.P.transpose(forces))
        return self.Q.expand(self.problem.solver.complete(mu))

    def stiffness_back(self, a: PETSc.Vec) -> PETSc.Vec:
        """``(K + G)' a`` (collective)."""
        return forms.product(self._K_back, a, self._G_back)

    def body_stiffness_back(self, a: PETSc.Vec) -> PETSc.Vec:
        """``K' a`` (collective)."""
        return forms.product(self._K_back, a)

    def handed_back(self, by_anchors: list[Array]) -> tuple[Any, list[Array]]:
        """Derivatives by anchors at the step's end as those by its places, and by the anchors that stay (collective)."""
        return _back(self.problem, by_anchors, self._slopes)

    def by_anchors(self, adjoint: Adjoint, kept: list[Array]) -> list[Array]:
        """Derivatives by the anchors that the step began with, those of anchors that stay among them (collective)."""
        n, g = self.config.n_owned, self.config.gdim
        a, first, found = adjoint.a.x.array[: n * g].reshape(n, g), 0, []
        for slopes, own, before in zip(self._slopes, self.rows.equations, kept):
            part = adjoint.by_gaps[first : first + len(own)]
            first += len(own)
            found.append(before if slopes is None else slopes.by_anchors(part, own, a) + before)
        return found


def _back(
    problem: UnitedProblem, by_anchors: list[Array], slopes: Sequence[AnchorSlopes | None] | None = None
) -> tuple[Array, list[Array]]:
    """Derivatives by anchors as those by places of the owned nodes ``(n_owned, gdim)``, and by the anchors that stay (collective)."""
    first = slopes is None
    if slopes is None:
        slopes = [AnchorSlopes(pair, c.name) if pair.frictional else None for pair, c in zip(problem.pairs, problem.contacts)]
    handed, left = np.zeros((problem.config.n_owned, problem.config.gdim)), []
    for own, at, pair in zip(by_anchors, slopes, problem.pairs):
        if at is not None:
            places, own = at.back(own if own.size else np.zeros((len(pair.nodes), at.size)), first)
            handed += places
        left.append(own)
    return handed, left


def _left_behind(problem: UnitedProblem, m: ContactParameter, handed: Array) -> Array:
    """What derivatives by places of contactors are by a motion of their target, which leaves these behind (collective)."""
    found = np.zeros(m.shape(problem.config.gdim))
    for entry in np.ndindex(found.shape) if m.parameter in ("place", "turn") else ():
        found[entry] = -(handed * motion_of(m, problem.config.x[: len(handed)], entry)).sum()
    return np.asarray(reduced(problem.comm, found))


def _added(found: Any, more: Array | fem.Function) -> Any:
    """The sum of two derivatives, the first of which may be None."""
    if found is None:
        return more
    if isinstance(more, fem.Function):
        found.x.array[:] += more.x.array
        return found
    return found + more


def _transposed(A: PETSc.Mat) -> PETSc.Mat:
    """A matrix of its own."""
    out = PETSc.Mat()
    A.transpose(out)
    return out


def _friction_of(pair: Any) -> Array | None:
    return None if pair.friction is None else pair.friction.value


@contextmanager
def recording(problem: UnitedProblem) -> Iterator[History]:
    """Keep all steps that a problem takes in a ``with`` block, for gradients through their history (collective).

    Example::

        with uem.recording(problem) as history:
            for step in uem.load_steps(problem, 10):
                ...
        by_E, by_mu = history.gradient(J, [E, uem.ContactParameter(contact, "friction")])

    Each step keeps the displacement, what contactors remember, and the values of Constants and Functions in the residual that have changed.

    Args:
        problem: in statics; it may have Coulomb's friction between nodes of degree 1 and surfaces of sliding='finite'.

    Yields:
        The history, which may be asked in the block and after it.

    Raises:
        InputError, InputTypeError: for a problem that there are no such derivatives of: with mortar and friction, in time, with laws with
            history, other laws of friction, wear, ties, or offsets of contacts with friction.
    """
    check_problem(problem)
    with agreed(problem.comm):
        if problem.history is not None:
            raise InputError("the problem is being recorded: expected one history at a time")
        for contact in problem.contacts:
            if contact.pair.frictional:
                if problem.progress.steps:
                    raise InputError(
                        f"the problem has taken {problem.progress.steps} step(s), on which those of contact '{contact.name}' with friction "
                        "depend: expected a problem that is recorded from its first step on"
                    )
                _check_friction(problem, contact)
    history = problem.history = History(problem)
    try:
        yield history
    finally:
        problem.history = None


def _check_friction(problem: UnitedProblem, contact: Any) -> None:
    """Refuse contacts with friction through whose memory there are no derivatives."""
    pair, law = contact.pair, as_law(contact.friction)
    for wrong, expected in (
        (not pair.discretisation.pointwise or problem.config.degree > 1, "coupling='node_to_surface' and cells of degree 1"),
        (contact.of_all_surfaces, "Contacts of pairs of surfaces"),
        (contact.sliding != "finite", "sliding='finite'"),
        (contact.normals != "facet", "normals='facet'"),
        (type(law) is not Coulomb or law.per_area or law.per_point or follows_load(law), "Coulomb's law, without limit or load"),
        (pair.friction.wear is not None, "no wear"),
        (pair.discretisation.offset is not None, "no offset and no adjust"),
        (not keeps_distance(contact), "a rigid plane, sphere or cylinder"),
    ):
        if wrong:
            raise InputError(
                f"contact '{contact.name}': a history with friction has derivatives for {expected} alone; else take differences of runs"
            )
