"""The constrained problem linearised at an equilibrium, forwards along changes of controls, and backwards from a functional.

With the residual F of the bodies, contact forces ``T' lam`` and gaps g, a change m' of the controls changes the displacement by

    du = P dq + c(m'),    P'(K + G)P dq = -P' [ dF/dm m' + (K + G) c(m') ]

where G is the curvature of the contact, and c(m') the increment prescribed by the Dirichlet values. For a functional J of u and m,

    P'(K + G)P mu = P' dJ/du,    a = P mu                                              the adjoint problem
    dJ/dm m' = dJ/dm|u m' - a' dF/dm m' + [ dJ/du - (K + G)' a ]' c(m')

Gaps depend on positions X of the nodes in the same way as on u: with ``x' = du + X'`` in place of du,

    x' = P dq + c(X'),    P'(K + G)P dq = -P' [ (dF/dX - K) X' + (K + G) c(X') ]
    dJ/dX = dJ/dX|u - dJ/du - (dF/dX - K)' a + [ dJ/du - (K + G)' a ]' c

Contact forces, and their changes, follow from the residual at the contactors, by L and the series S of P. If J also depends on lam, the
adjoint problem has a further load w, a prescribed motion of contactors relative to their targets:

    lam' = L'S' [ (K + G) du + dF/dm m' ],    w = S L dJ/dlam
    dJ/du + (K + G) w in place of dJ/du,    a - w in place of a in products with dF/dm or dF/dX - K

Parameters of a contact change gaps and contact forces only: c closes the gaps, and the change of forces at the same multipliers counts
as dF/dm. With friction Q is not P, ``a = Q mu`` with ``P'(K + G)'Q mu = P' dJ/du``, and (K + G)' replaces (K + G) in the adjoint problem.
In mixed problems u contains all fields; contacts and positions of nodes affect the rows of the displacement only.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat, forms
from uem_dolfinx.algebra.blocks import is_symmetric
from uem_dolfinx.algebra.restriction import Restriction
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.seam.placement import ContactRows
from uem_dolfinx.errors import InputError
from uem_dolfinx.form_checks import Control
from uem_dolfinx.gradients.anchor_slopes import AnchorSlopes
from uem_dolfinx.gradients.assemblies import Users, by_section, section_of
from uem_dolfinx.gradients.contact_fields import PressureSlopes, along_field
from uem_dolfinx.gradients.derivatives import Derivatives, Places, along, derivatives_of, transposed, values_in
from uem_dolfinx.gradients.mean_slopes import MeanSlopes
from uem_dolfinx.gradients.parameters import (
    ContactParameter,
    acting,
    contactors_of,
    led_for,
    motion_of,
    refuse_sharp,
    rubbed,
    thickened,
    turned_by,
)
from uem_dolfinx.gradients.shape_slopes import Followers, Slopes, shape_slopes_of
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import reduced
from uem_dolfinx.solve.bodies.field_scales import ratio
from uem_dolfinx.solve.bodies.tangent import contact_curvature, curvature_of, is_skew, slip_terms, together
from uem_dolfinx.solve.loading import in_rows, uniform, wanted_by_step
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.united.rows import BodyState, Rows
from uem_dolfinx.solve.united.system import CLOSED, BodySystem

#: A residual this many times what steps leave is of other parameters than the step's.
#: [convention; norm of the residual; test_gradient.py::test_parameters_that_have_changed]
MORE_THAN_LEFT = 1e3


class Motion(NamedTuple):
    """Changes along a direction of controls."""

    du: fem.Function  # change of the displacement, and of all other fields
    shape: fem.Function  # change of the positions of the nodes in the reference configuration
    reactions: PETSc.Vec  # change of the forces of contacts and Dirichlet conditions on the bodies


class Linearised:
    """The constrained problem linearised at the equilibrium, which is restored in the end (collective).

    Attributes:
        F: the residual in UFL.
        derivatives: of F and of functionals.
        P: restriction matrix of the active contactors.
        Q: that of their forces; P, unless friction or averaged normals distinguish them.
        rows: their equations; ``equations`` lists the equations of each of the problem's ``interfaces``.
        multipliers: of all equations of contacts, and of users ``(m,)``.
        slopes: derivatives by the anchors of each interface, in a recorded step.
        ramp: shares of the Dirichlet values, see ``solve.loading``, in the rows of vectors ``(n_rows, gdim)``.
    """

    P: Restriction
    Q: Restriction
    rows: Rows
    multipliers: Array
    slopes: Sequence[AnchorSlopes | MeanSlopes | None] = ()

    def __init__(self, problem: UnitedProblem, derivatives: Derivatives | None = None, held: Array | float | None = None):
        self.problem, self.config = problem, problem.config
        self.ramp = in_rows(problem, problem.progress.taken.held if held is None else held)
        self.K = self._K_back = problem.bodies.tangent.K
        self.G: PETSc.Mat | None = None
        self._G_back: PETSc.Mat | None = None
        # number of the displacement's components on this rank, which come first in vectors
        self._n = problem.config.n_owned * problem.config.gdim
        self.F = problem.bodies.F
        self.derivatives = derivatives or derivatives_of(problem)
        known = uniform(problem, problem.progress.taken.held if held is None else held)
        self.users = Users(problem, float("nan" if known is None else known))

    def __enter__(self) -> Linearised:
        try:
            self._linearise()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _linearise(self) -> None:
        system, state = self.problem.system, self._state()
        assert isinstance(system, BodySystem)
        self._refuse_other_parameters(state)
        # no step begins: a factorisation of the same matrix is reused
        system.linearise(state, 1)
        # in addition to the curvature, springs between couplings
        self.K, self.G = self.problem.bodies.tangent.K, together(system.curvature, state.added)
        self._K_back = self.K if is_symmetric(self.K, self.config.unknowns) else transposed(self.K)
        turning = [] if self.problem.linear is None else self.problem.linear.curvature()
        skew = reduced(self.config.comm, int(self.P is not self.Q or any(is_skew(blocks) for _, blocks in turning)))
        self._G_back = transposed(self.G) if skew and self.G is not None else self.G
        self._tell_idle()

    def _state(self) -> BodyState:
        """Equations and multipliers of the present state (collective)."""
        bodies, system = self.problem.bodies, self.problem.system
        assert isinstance(system, BodySystem)
        bodies.wanted[:] = self.problem.u.x.array
        system.place()
        bodies.assemble()
        state = system.assemble_constraints(lambda norm, scale, rounding: True)
        assert isinstance(state, BodyState)
        self.P, self.Q, self.rows, self.equations = state.trial, state.test, state.rows, state.rows.of(self.problem.interfaces)
        if self.rows.whole.moved is not None and self.P is self.rows.frictionless:
            raise InputError(
                "contactors with averaged normals are held by several equations, whose derivatives are not known: expected "
                "normals='facet', or nodes that are contactors of one contact, with free normals"
            )
        for contact in self.problem.contacts:
            refuse_sharp(contact)
        self.multipliers = state.test.multipliers(state.test.pass_on(system.residual()))
        return state

    def _refuse_other_parameters(self, state: BodyState) -> None:
        """Refuse a displacement that is no equilibrium of the present parameters (collective)."""
        problem, bodies = self.problem, self.problem.bodies
        largest, found = np.maximum(state.scale, problem.largest_forces), ""
        if np.any(state.norm > MORE_THAN_LEFT * np.maximum(problem.rtol * largest, state.rounding)):
            found = f"forces are not in equilibrium, with a residual of {ratio(state.norm, largest):.1g} of the forces at work"
        if (wanted := wanted_by_step(problem)) is not None:
            bodies.wanted[:] = wanted
            if not bodies.dirichlet_met():
                found = "the displacement has other values than Dirichlet conditions prescribe"
            bodies.wanted[:] = problem.u.x.array
        if not found and not state.closed:
            found = "contactors are not where their targets are"
        if found:
            raise InputError(
                f"the displacement is not that of the present parameters: {found}; expected Constants, Functions, Dirichlet values, "
                "targets and nodes as the last step left them; put them back, or solve again"
            )

    def _tell_idle(self) -> None:
        """Warn of contactors at which functionals have two one-sided gradients (collective)."""
        bodies, system, idle = self.problem.bodies, self.problem.system, 0
        assert isinstance(system, BodySystem)
        for pair in system.pairs:
            now, rounding = pair.trial, bodies.rounding_at(pair.nodes)
            touches = ~now.active & ~pair.off & (np.abs(pair.kinematics.gap) <= CLOSED * self.config.size)
            idle += int(((now.active & (now.lam <= rounding)) | touches).sum())
        if idle := reduced(self.config.comm, idle):
            logger.warning(
                "%d contactor(s) have neither force nor gap: the functional has another gradient on either side, and this is that of "
                "the contactors that are active now", idle,
            )  # fmt: skip

    def __exit__(self, *error: object) -> None:
        # steps must not depend on whether a gradient was computed
        self.problem.restore()

    def pressures(self, contact: Contact) -> PressureSlopes:
        """Derivatives of a contact's pressures; InputError if they do not exist (collective)."""
        if self.rows.conflict:
            raise InputError(
                f"contact '{contact.name}': equations of contactors conflict with each other or with Dirichlet conditions, and have been "
                "replaced by others, so that pressures have no derivatives here; let nodes be contactors of one contact, with free normals"
            )
        return PressureSlopes(contact, self.equations_of(contact)[0])

    def lift(self, weights: dict[Contact, Array]) -> PETSc.Vec:
        """``S L w`` for weights of the multipliers of the equations of some contacts' interfaces (collective with weights)."""
        if not weights:
            # rows that replace conflicting equations may be on other ranks
            return self.config.vector()
        w = np.zeros(len(self.multipliers))
        for contact, own in weights.items():
            w[self.equations_of(contact)[1]] += own
        return self.Q.read_back(w)

    def vector(self, at_nodes: npt.ArrayLike = 0.0) -> PETSc.Vec:
        """A vector with values at the displacement's owned nodes ``(n_owned, gdim)``, zero in other fields."""
        v = self.config.unknowns.vector()
        v.array[: self._n] = np.ravel(at_nodes)
        return v

    def assembled(self, form: ufl.Form) -> Array:
        """A linear form of all unknowns in the rows of vectors ``(n_rows * gdim,)`` (collective)."""
        values = forms.assemble_array(self.problem.u.function_space, forms.form(form))
        return np.asarray(self.config.rows(values).ravel())

    def solve(self, forces: PETSc.Vec) -> PETSc.Vec:
        """``P dq`` with ``Q'(K + G)P dq = Q' forces`` (collective)."""
        # as accurately as an iterative solver can
        dq, _ = self.problem.solver.solve(self.Q.transpose(forces))
        return self.P.expand(self.problem.solver.complete(dq))

    def held(self, v: PETSc.Vec) -> PETSc.Vec:
        """A vector without open rigid motions of bodies that only contact holds; a symmetric projection (collective)."""
        assert isinstance(self.problem.system, BodySystem)
        out = v.copy()
        out.array[: self._n] = self.problem.system.floating.without_open_motions(np.array(v.array_r[: self._n]))
        return out

    def stiffness_of(self, contact: Contact | None = None) -> PETSc.Mat | None:
        """Derivative of the forces of a contact, or of all, by the displacement, with the opposite sign (collective)."""
        known, like = dict(zip(map(id, self.problem.interfaces), self.slopes)), self.config.unknowns.vector()
        acts = [(pair, state, known.get(id(pair))) for pair, state in acting(self.problem, contact)]
        pairs, states = [pair for pair, *_ in acts], [own.without_stuck(state) if own else state for _, state, own in acts]
        curvature = curvature_of(pairs, like, any(self.slopes) or not self.slopes, False, states=states)
        gaps, _ = slip_terms([pair for pair in pairs if pair.trial.has_law], like)
        turned = [part for _, state, own in acts if own for part in own.turned(state)]
        return together(together(curvature, gaps), contact_curvature(turned, like) if turned else None)

    def set_operator(self) -> None:
        """Set the matrix ``P'(K + G)'Q`` of the adjoint problem (collective)."""
        self.problem.solver.set_operator(self.Q, self._K_back, self._G_back, None if self.Q is self.P else self.P)

    def solve_back(self, forces: PETSc.Vec) -> PETSc.Vec:
        """``Q mu`` with ``P'(K + G)'Q mu = P' forces`` (collective)."""
        if self._K_back is not self.K or self._G_back is not self.G or self.P is not self.Q:
            self.set_operator()
        mu, _ = self.problem.solver.solve(self.P.transpose(forces))
        return self.Q.expand(self.problem.solver.complete(mu))

    def adjoint(self, drive: PETSc.Vec) -> tuple[PETSc.Vec, PETSc.Vec]:
        """``a = Q mu`` under a load of the adjoint problem, and the residual that it leaves (collective)."""
        whole = self.solve_back(drive)
        return whole, drive - self.stiffness_back(whole)

    def by_gaps(self, left: PETSc.Vec) -> Array:
        """Derivative by the gaps of all equations ``(m,)``, from the residual of the adjoint problem (collective)."""
        return -self.followers.back(self.P.multipliers(self.P.pass_on(left)))

    def stiffness(self, du: PETSc.Vec) -> PETSc.Vec:
        """``(K + G) du`` (collective)."""
        return forms.product(self.K, du, self.G)

    def stiffness_back(self, a: PETSc.Vec) -> PETSc.Vec:
        """``(K + G)' a`` (collective)."""
        return forms.product(self._K_back, a, self._G_back)

    def body_stiffness_back(self, a: PETSc.Vec) -> PETSc.Vec:
        """``K' a`` (collective)."""
        return forms.product(self._K_back, a)

    def share(self, m: Control | ContactParameter) -> float:
        """Share of a control, see ``solve.loading``: 1 unless steps ramp it."""
        return self.problem.progress.taken.of(led_for(m))

    def changes(self, m: ContactParameter, entry: tuple[int, ...]) -> tuple[Array, Array]:
        """Derivatives of gaps and residual by an entry of a contact's parameter, at fixed displacement (collective).

        A motion b(x) of a rigid surface is equivalent to a motion -b of the bodies, and a rotation of its forces. Returns changes
        of the gaps of all equations ``(m,)`` and of the residual at the owned nodes ``(n_owned, gdim)``.
        """
        pair, config, gaps = m.contact.pair, self.config, np.zeros_like(self.multipliers)
        if m.parameter == "friction":
            return gaps, rubbed(pair)
        own, which = self.equations_of(m.contact, f"its {m.parameter}")
        if (section := section_of(pair)) is not None:
            gaps[which], pushed = by_section(section, m.parameter, len(own))
            return gaps, pushed
        if m.parameter == "offset":
            gaps[which], forces = thickened(pair, own, self.multipliers[which])
            return gaps, forces
        rows, b, pushed = own.P, motion_of(m, config.x[: config.n_owned], entry), np.zeros((config.n_owned, config.gdim))
        there = np.einsum("kg,kg->k", rows.coefficients, config.ask_owners(rows.followed, b))
        opened = np.bincount(rows.row, there, len(rows)) - np.einsum("mg,mg->m", rows.direction, b[rows.node])
        gaps[which] = np.where(contactors_of(own, pair), opened, 0.0)
        if m.parameter == "turn":
            nodes, force = pair.nodal_forces(pair.trial)
            pushed = config.add_at_owners(nodes, turned_by(entry, force))
        if (stiffness := self.stiffness_of(m.contact)) is not None:
            pushed = pushed + forms.product(stiffness, self.vector(b)).array_r[: self._n].reshape(-1, config.gdim)
        return gaps, -pushed

    def equations_of(self, contact: Contact, what: str = "") -> tuple[ContactRows, slice]:
        """Equations of a contact's interface, and their place among all; refused if ``what`` has no derivatives (to be agreed on)."""
        if what:
            self._refuse_replaced(f"contact '{contact.name}'", what)
        k = self.problem.interfaces.index(contact.pair.whole)
        first = sum(len(own) for own in self.equations[:k])
        return self.equations[k], slice(first, first + len(self.equations[k]))

    def _refuse_replaced(self, whose: str, what: str) -> None:
        """Refuse derivatives by gaps if equations have been replaced by others."""
        if self.P.rings is not None or self.rows.conflict:
            raise InputError(
                f"{whose}: equations follow each other in rings, or conflict, so that {what} has no derivative here; let nodes be "
                "contactors of one contact, with free normals"
            )

    def changes_of_users(self, m: fem.Constant, change: Array) -> tuple[Array, Array]:
        """As ``changes``, along a change of a Constant in equations, couplings or forces at nodes (collective)."""
        (opened, pushed), gaps = self.users.changes(m, change), np.zeros_like(self.multipliers)
        if len(opened):
            self._refuse_replaced("equations and couplings", "a value in them")
            gaps[len(gaps) - len(opened) :] = opened
        return gaps, pushed

    @cached_property
    def followers(self) -> Followers:
        """Equations in which rigid parts have taken the place of their nodes."""
        return Followers(self.config, self.rows)

    @cached_property
    def places(self) -> Places:
        """The shape as a control."""
        return Places(self.config)

    @cached_property
    def shape_slopes(self) -> list[tuple[slice, Slopes]]:
        """Derivatives of ties and users' equations by positions of nodes, each with its equations (first time: collective)."""
        found = shape_slopes_of(self.problem, self.equations)
        if found:
            self._refuse_replaced("ties and equations", "the shape")
        return found

    def moved(self, direction: Sequence[tuple[Control, Any]], gaps: Array | float = 0.0, pushed: Array | float = 0.0) -> Motion:
        """Changes along a direction of controls (collective).

        ``gaps (m,)`` and ``pushed (n_owned, gdim)``: further changes of the gaps of all equations, and of the residual.
        """
        config, bodies = self.config, self.problem.bodies
        forces, prescribed, shape = self.vector(-np.asarray(pushed)), np.zeros(bodies.free_rows.shape), fem.Function(config.V)
        gaps = np.zeros_like(self.multipliers) + gaps
        for m, change in direction:
            if isinstance(m, ContactParameter):
                for entry, size in np.ndenumerate(np.asarray(change, dtype=float)):
                    opened, pushed = self.changes(m, entry)
                    gaps += self.share(m) * size * opened
                    forces.array[: self._n] -= self.share(m) * size * pushed.ravel()
                continue
            if isinstance(m, ufl.SpatialCoordinate):
                shape.x.array[:] += self.places.at_nodes(change).x.array
                if (form := forms.by_places(self.F, config.mesh, change)) is not None:
                    forces.array[:] -= self.assembled(form)
                continue
            if isinstance(m, fem.Constant):
                change = self.share(m) * np.asarray(change, dtype=float)
                if self.users.have(m):
                    opened, pushed = self.changes_of_users(m, change)
                    gaps += opened
                    forces.array[: self._n] -= pushed.ravel()
            if (form := along(self.F, m, change)) is not None:
                forces.array[:] -= self.assembled(form)
            values = change
            if isinstance(m, fem.Function):
                values = values_in(m.function_space, change)
                opened, pushed = along_field(self, m, values)
                gaps += opened
                forces.array[: self._n] -= pushed.ravel()
            prescribed += self.ramp * self.prescribed_by(m, values)
        shape.x.scatter_forward()
        drawn = self.vector(shape.x.array[: self._n])
        forces.axpy(1.0, forms.product(self.K, drawn))
        by_shape = any(isinstance(m, ufl.SpatialCoordinate) for m, _ in direction)
        for which, slopes in self.shape_slopes if by_shape else ():
            opened, pushed = slopes.along(drawn.array_r[: self._n].reshape(-1, config.gdim))
            gaps[which] += opened
            forces.array[: self._n] -= pushed.ravel()
        gaps = self.followers.opened(gaps)
        c = self.P.carried(prescribed + np.where(bodies.free_rows, 0.0, drawn.array_r.reshape(-1, config.gdim)))
        c.axpy(-1.0, self.P.read_back(gaps))
        way = self.solve(forces - self.stiffness(c))
        way.axpy(1.0, c)
        reactions = self.stiffness(way) - forces
        return Motion(self.function(self.held(way - drawn)), shape, reactions)

    def function(self, v: PETSc.Vec) -> fem.Function:
        """A Function of the problem's space with these values (collective)."""
        f, values = fem.Function(self.problem.u.function_space), self.config.from_rows(v.array_r)
        f.x.array[: len(values)] = values
        f.x.scatter_forward()
        return f

    def pressed(self, contact: Contact, motion: Motion) -> fem.Function:
        """Change of a contact's pressure with a motion (collective)."""
        slopes, (_, which) = self.pressures(contact), self.equations_of(contact)
        multipliers = self.Q.multipliers(self.Q.pass_on(motion.reactions))
        found = fem.Function(contact.pressure.function_space)
        found.x.array[contact.nodes] = slopes.along(multipliers[which], motion.du, motion.shape)
        found.x.scatter_forward()
        return found

    def prescribed_by(self, m: Any, values: Array) -> Array:
        """Change of Dirichlet values with the ``values`` of a control, in the rows of vectors, zero where free ``(n_rows, gdim)``."""
        bodies, found = self.problem.bodies, []
        before = np.array(forms.values_of(m))
        for now in (values, 0.0 * values):
            out = np.zeros(len(self.problem.u.x.array))
            forms.values_of(m)[...] = now
            compat.set_bc_values(out, bodies.bcs)
            found.append(out)
        forms.values_of(m)[...] = before
        change = np.where(bodies.held, found[0] - found[1], 0.0)
        return np.asarray(self.config.rows(change[: len(bodies.residual_of_all)]))
