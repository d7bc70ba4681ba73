"""Derivatives at a state of equilibrium with contact: of functionals by one adjoint solve, of the displacement by one solve a direction.

With the residual F of the bodies, contact forces ``T' lam`` and gaps g, a change m' of the controls moves the bodies by

    du = P dq + c(m'),    P'(K + G)P dq = -P' [ dF/dm m' + (K + G) c(m') ]

where G is the curvature of the contact, and c what the Dirichlet values ask for. A functional J of u and m therefore has

    P'(K + G)P mu = P' dJ/du,    a = P mu                                              the adjoint problem
    dJ/dm m' = dJ/dm|u m' - a' dF/dm m' + [ dJ/du - (K + G)' a ]' c(m')

Gaps see the places X of the nodes as they see u: with ``x' = du + X'`` in place of du,

    x' = P dq + c(X'),    P'(K + G)P dq = -P' [ (dF/dX - K) X' + (K + G) c(X') ]
    dJ/dX = dJ/dX|u - dJ/du - (dF/dX - K)' a + [ dJ/du - (K + G)' a ]' c

The active set is that of the state: where a contactor has neither force nor gap, J has a gradient on either side, and this is one of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from petsc4py import PETSc

from uem_dolfinx import compat, forms, given
from uem_dolfinx.arrays import Array
from uem_dolfinx.errors import InputError
from uem_dolfinx.form_checks import check_functional
from uem_dolfinx.log import logger
from uem_dolfinx.parallel import agreed, reduced
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.system import CLOSED, BodySystem

#: What a functional may be differentiated by.
Control: TypeAlias = fem.Constant | fem.Function | ufl.SpatialCoordinate


def gradient(problem: UnitedProblem, J: ufl.Form, controls: Sequence[Control] | Control) -> list[Array | fem.Function]:
    """Derivatives of a functional at the present equilibrium by parameters of the problem, by one adjoint solve (collective).

    Exact for the discrete problem: the contact conditions are eliminated, not smoothed. The state is left as it is.

    Args:
        problem: in statics, without friction and without laws with history; its last step is the state.
        J: functional of ``problem.u`` and of the controls, a UFL form without test functions. The force with which Dirichlet
            conditions hold a part is one: ``ufl.replace(F, {v: w})`` with a Function w that is a unit vector at its nodes, 0 elsewhere.
        controls: Constants and Functions that F, J or the values of Dirichlet conditions are made of: moduli, loads, fields of moduli,
            prescribed displacements. A Function is taken by its degrees of freedom; ``ufl.SpatialCoordinate(mesh)`` stands for the places
            of the nodes: the shape.

    Returns:
        For every control, in their order, the derivatives by its entries: an array of the shape of a Constant's value, a Function of
        the control's space, or for the shape one of the displacement's space.

    Raises:
        InputError, InputTypeError: for a problem whose gradient needs the history of all steps, one without a step, one without the
            consistent tangent, or what is no functional or no control of this problem.
        LinearSolveError: if the united matrix is singular.
    """
    some = [controls] if isinstance(controls, Control) else list(controls)
    _check(problem, some)
    with agreed(problem.comm):
        given.kind("J", J, isinstance(J, ufl.Form) and not J.empty(), "a UFL form with an integral")
        check_functional("J", J)
    with _Linearised(problem) as linearised:
        adjoint = _Adjoint(linearised, J)
        return [adjoint.by(m) for m in some]


def tangent(problem: UnitedProblem, direction: Iterable[tuple[Control, Any]]) -> fem.Function:
    """How the displacement changes with parameters of the problem, by one solve (collective).

    Args:
        problem: as of :func:`gradient`.
        direction: controls, as of :func:`gradient`, and their changes: for a Constant an array of its shape, for a Function one of its
            space, for the places of the nodes one of the displacement's space.

    Returns:
        The derivative of the displacement along the direction.

    Raises:
        InputError, InputTypeError, LinearSolveError: see :func:`gradient`.
    """
    pairs = list(direction)
    _check(problem, [control for control, _ in pairs])
    with _Linearised(problem) as linearised:
        du = fem.Function(problem.config.V)
        moved = linearised.moved(pairs)
        du.x.array[: len(moved.array_r)] = moved.array_r
        du.x.scatter_forward()
        return du


def taylor_test(functional: Callable[[float], float], slope: float, size: float = 1e-2, halvings: int = 4) -> float:
    """Order with which ``|J(h) - J(0) - h slope|`` vanishes with h: 2 if ``slope`` is the derivative of J, else 1.

    Args:
        functional: J(h), as of controls that have been changed by h in one direction and a problem that was solved anew with them.
        slope: the derivative of J by h at 0, as from :func:`gradient`.
        size: the first h.
        halvings: how often it is halved.

    Returns:
        The least order of all halvings.
    """
    first = functional(0.0)
    left = np.array([abs(functional(size / 2**k) - first - size / 2**k * slope) for k in range(halvings + 1)])
    return float(np.log2(left[:-1] / left[1:]).min())


def _check(problem: UnitedProblem, controls: Sequence[Any]) -> None:
    """Refuse problems whose derivatives are not those of one state, and what is no control (collective)."""
    given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
    with agreed(problem.comm):
        for present, what in (
            (problem.dynamics is not None, "a problem in time"),
            (any(pair.frictional for pair in problem.pairs), "a contact with friction"),
            (bool(problem.materials), "a law with history"),
        ):
            if present:
                raise InputError(
                    f"the gradient of {what} depends on all steps, of which the last alone is known: only statics have one"
                )
        if not isinstance(problem.system, BodySystem) or not problem.system.consistent_tangent or problem.system.newton != "full":
            raise InputError("a gradient needs newton='full', consistent_tangent=True, and contact by elimination: the defaults")
        if not problem.progress.steps:
            raise InputError("the problem has taken no step: expected a state of equilibrium; solve it first")
        for control in controls:
            given.kind("controls", control, isinstance(control, Control), "Constants, Functions, or ufl.SpatialCoordinate(mesh)")
            if control is problem.u:
                raise InputError("controls hold the displacement, which the problem solves for: expected what it is made of")
            if isinstance(control, ufl.SpatialCoordinate):
                _check_shape(problem)


def _check_shape(problem: UnitedProblem) -> None:
    """Refuse problems whose nodes are not those that tell the shape."""
    config = problem.config
    if compat.geometry_dofs(config.mesh).shape[1] != compat.cell_dofs(config.V).shape[1]:
        raise InputError("a gradient by the shape needs cells of the displacement's degree: straight ones for degree 1")
    if any(pair.sliding != "finite" for pair in problem.pairs):
        raise InputError(
            "a gradient by the shape needs contacts of sliding='finite': others keep where they were projected at first"
        )


class _Linearised:
    """The united problem linearised at the state of equilibrium, which is left as it was in the end (collective).

    Attributes:
        F: the residual in UFL, and ``test`` its test function.
        P: restriction matrix of the active contactors.
    """

    def __init__(self, problem: UnitedProblem):
        self.problem, self.config = problem, problem.config
        self.F = problem.bodies.F
        self.test = self.F.arguments()[0]

    def __enter__(self) -> _Linearised:
        try:
            self._linearise()
        except BaseException:
            self.__exit__()
            raise
        return self

    def _linearise(self) -> None:
        bodies, system = self.problem.bodies, self.problem.system
        assert isinstance(system, BodySystem)
        bodies.wanted[:] = self.config.displacement
        system.place()
        bodies.assemble()
        state = system.assemble_constraints(lambda norm, scale, rounding: True)
        system.linearise(state, 0)
        self.P, self.K, self.G = state.trial, bodies.tangent.K, system.curvature
        idle = 0
        for pair in system.pairs:
            now, rounding = pair.trial, bodies.rounding_at(pair.nodes)
            touches = ~now.active & ~pair.off & (np.abs(pair.gap) <= CLOSED * self.config.size)
            idle += int(((now.active & (now.lam <= rounding)) | touches).sum())
        if idle := reduced(self.config.comm, idle):
            logger.warning(
                "%d contactor(s) have neither force nor gap: the functional has another gradient on either side, and this is that of "
                "the contactors that are active now", idle,
            )  # fmt: skip

    def __exit__(self, *error: object) -> None:
        # the next step makes a united matrix of its own
        self.problem.system.forget()
        self.problem.restore()

    def solve(self, forces: PETSc.Vec) -> PETSc.Vec:
        """``P dq`` under forces: symmetric, since P is Q without friction (collective)."""
        # as accurately as an iterative solver can
        dq, _ = self.problem.solver.solve(self.P.transpose(forces))
        return self.P.expand(dq)

    def held(self, v: PETSc.Vec) -> PETSc.Vec:
        """Without what bodies that contact alone holds move along it, where steps leave them; its own transpose (collective)."""
        assert isinstance(self.problem.system, BodySystem)
        return self.config.vector(self.problem.system.floating.without_open_motions(np.array(v.array_r)))

    def stiffness(self, du: PETSc.Vec) -> PETSc.Vec:
        """``(K + G) du`` (collective)."""
        forces = self.K * du
        if self.G is not None:
            forces.axpy(1.0, self.G * du)
        return forces

    def moved(self, direction: Sequence[tuple[Control, Any]]) -> PETSc.Vec:
        """The change of the displacement with changes of controls (collective)."""
        config = self.config
        forces, prescribed, shape = config.vector(), np.zeros((config.n_owned, config.gdim)), config.vector()
        for m, change in direction:
            if isinstance(m, ufl.SpatialCoordinate):
                shape.array[:] += change.x.array[: len(shape.array_r)]
                if (form := _expanded(ufl.derivative(self.F, m, change))) is not None:
                    forces.array[:] -= forms.assemble_array(config.V, forms.form(form))
                continue
            if (form := _along(self.F, m, change)) is not None:
                forces.array[:] -= forms.assemble_array(config.V, forms.form(form))
            values = change.x.array if isinstance(m, fem.Function) else np.asarray(change, dtype=float)
            prescribed += self.prescribed_by(m, values)
        forces.axpy(1.0, self.K * shape)
        held = ~self.problem.bodies.free[: config.n_owned]
        c = self.P.carried(prescribed + np.where(held, shape.array_r.reshape(-1, config.gdim), 0.0))
        du = self.solve(forces - self.stiffness(c))
        du.axpy(1.0, c)
        du.axpy(-1.0, shape)
        return self.held(du)

    def prescribed_by(self, m: Any, values: Array) -> Array:
        """What the ``values`` of a control make of the Dirichlet values of the owned components, zero where free ``(n_owned, gdim)``."""
        bodies, config, found = self.problem.bodies, self.config, []
        before = np.array(m.x.array if isinstance(m, fem.Function) else m.value)
        for now in (values, 0.0 * values):
            out = np.zeros(len(self.problem.u.x.array))
            _set(m, now)
            compat.set_bc_values(out, bodies.bcs)
            found.append(out)
        _set(m, before)
        return np.where(bodies.free, 0.0, (found[0] - found[1]).reshape(-1, config.gdim))[: config.n_owned]


class _Adjoint:
    """The adjoint problem of one functional (collective).

    Attributes:
        a: what forces do to J, a Function of the displacement's space.
        by_values: derivative of J by the prescribed displacement of every owned component, zero where free ``(n_owned, gdim)``.
    """

    def __init__(self, at: _Linearised, J: ufl.Form):
        self.at, self.config = at, at.config
        config, of_u = at.config, _derivative(J, at.problem.u, at.test)
        drive = config.vector() if of_u is None else config.vector(forms.assemble_array(config.V, forms.form(of_u)))
        drive = at.held(drive)
        along = at.solve(drive)
        self.a = fem.Function(config.V)
        self.a.x.array[: len(along.array_r)] = along.array_r
        self.a.x.scatter_forward()
        #: J, and the work of the residual along a, with their signs.
        self._forms = (J, 1.0), (ufl.replace(at.F, {at.test: self.a}), -1.0)
        held = ~at.problem.bodies.free[: config.n_owned]
        self.by_values = np.where(held, at.P.carried_back(drive - at.stiffness(along)), 0.0)
        #: Derivative by the places of the nodes, but for what J and F are integrals over ``(n_owned * gdim,)``.
        self._by_places = (at.K * along - drive).array_r + self.by_values.ravel()

    def by(self, m: Control) -> Array | fem.Function:
        """Derivative by a control."""
        if isinstance(m, fem.Constant):
            return self._by_constant(m)
        return self._by_function(m) if isinstance(m, fem.Function) else self._by_shape(m)

    def _by_constant(self, m: fem.Constant) -> Array:
        """An array of its shape."""
        comm, shape = self.config.comm, np.shape(m.value)
        found = np.zeros(shape)
        for entry in np.ndindex(shape):
            unit = np.zeros(shape)
            unit[entry] = 1.0
            for form, sign in self._forms:
                if (part := _along(form, m, unit)) is not None:
                    found[entry] += sign * forms.assemble_scalar(forms.form(part), comm)
            found[entry] += float(reduced(comm, float((self.by_values * self.at.prescribed_by(m, unit)).sum())))
        return found

    def _by_function(self, m: fem.Function) -> fem.Function:
        """A Function of its space."""
        V = m.function_space
        found = fem.Function(V)
        self._assemble(found, lambda form: _derivative(form, m, ufl.TestFunction(V)))
        # conditions that take its values tell which
        which = self.at.prescribed_by(m, np.arange(1.0, len(m.x.array) + 1))
        own, added = which > 0.5, fem.Function(V)
        np.add.at(added.x.array, np.rint(which[own]).astype(np.int64) - 1, self.by_values[own])
        forms.sum_ghosts(added)
        found.x.array[:] += added.x.array
        return found

    def _by_shape(self, X: ufl.SpatialCoordinate) -> fem.Function:
        """A Function of the displacement's space."""
        found = fem.Function(self.config.V)
        self._assemble(found, lambda form: _expanded(ufl.derivative(form, X, ufl.TestFunction(self.config.V))))
        found.x.array[: len(self._by_places)] += self._by_places
        found.x.scatter_forward()
        return found

    def _assemble(self, found: fem.Function, derivative: Callable[[ufl.Form], ufl.Form | None]) -> None:
        """Add up the derivatives of both forms."""
        for form, sign in self._forms:
            if (part := derivative(form)) is not None:
                values = forms.assemble_array(found.function_space, forms.form(part))
                found.x.array[: len(values)] += sign * values
        found.x.scatter_forward()


def _derivative(form: ufl.Form, m: fem.Function, direction: Any) -> ufl.Form | None:
    """Derivative of a form by a Function; None where it does not depend on it."""
    return _expanded(ufl.derivative(form, m, direction)) if m in form.coefficients() else None


def _along(form: ufl.Form, m: fem.Constant | fem.Function, change: Any) -> ufl.Form | None:
    """Derivative of a form along a change of a Constant or a Function; None where it does not depend on it."""
    if isinstance(m, fem.Function):
        return _derivative(form, m, change)
    if m not in form.constants():
        return None
    v, integrals = ufl.variable(m), []
    for integral in form.integrals():
        by, shape = ufl.diff(ufl.replace(integral.integrand(), {m: v}), v), np.shape(m.value)
        parts = [float(np.asarray(change)[i]) * (by[i] if i else by) for i in np.ndindex(shape) if np.asarray(change)[i] != 0.0]
        integrals += [integral.reconstruct(integrand=sum(parts[1:], parts[0]))] if parts else []
    return _expanded(ufl.Form(integrals))


def _expanded(form: ufl.Form) -> ufl.Form | None:
    """A form with its derivatives taken; None where nothing is left."""
    found = ufl.algorithms.expand_derivatives(form)
    return None if found.empty() else found


def _set(m: Any, values: npt.ArrayLike) -> None:
    """Give a Constant or a Function other values."""
    if isinstance(m, fem.Function):
        m.x.array[:] = values
    else:
        m.value[...] = values
