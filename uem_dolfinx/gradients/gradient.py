"""Derivatives at an equilibrium with contact: of functionals by one adjoint solve, of displacement and pressures by one forward solve.

The active set of the state is kept. If a contactor has neither force nor gap, J has two one-sided gradients; one of them is returned.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, TypeAlias

from mpi4py import MPI  # before dolfinx and petsc4py: in the PyPI wheel it loads the MPI library

import numpy as np
import ufl
from dolfinx import fem

from uem_dolfinx import given
from uem_dolfinx.arrays import Array
from uem_dolfinx.contact.contact import Contact
from uem_dolfinx.contact.laws.law import is_of_position
from uem_dolfinx.contact.mortar.placement import Contactors
from uem_dolfinx.contact.nodes.node_to_surface import NodeToSurface
from uem_dolfinx.contact.pair.tables import slides
from uem_dolfinx.errors import InputError, InputTypeError
from uem_dolfinx.form_checks import Control, check_expression, check_functional, check_parts
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.gradients.assemblies import constants_of
from uem_dolfinx.gradients.contact_fields import check_field, fields_of
from uem_dolfinx.gradients.derivatives import Places
from uem_dolfinx.gradients.parameters import (
    ContactParameter,
    keeps_distance,
    motions_of,
    refuse_assembly,
    refuse_parameter,
    refuse_shape,
    refuse_soft,
)
from uem_dolfinx.parallel import agreed, ask_together, reduced
from uem_dolfinx.solve.checks import refuse_other_fields
from uem_dolfinx.solve.loading import holds, rules_of, set_by
from uem_dolfinx.solve.problem import UnitedProblem
from uem_dolfinx.solve.united.system import BodySystem

#: Fields of contacts, by the words in their names.
RESULTS = ("active", "force", "gap", "pressure", "slip", "status", "traction")
#: Kinds of controls, in words.
A_CONTROL = "a Constant, a Function, ufl.SpatialCoordinate(mesh) or a ContactParameter"
AnyControl: TypeAlias = Control | ContactParameter


def gradient(problem: UnitedProblem, J: ufl.Form, controls: Sequence[AnyControl] | AnyControl) -> list[Array | fem.Function]:
    """Derivatives of a functional at the present equilibrium by parameters of the problem, by one adjoint solve (collective).

    Exact for the discrete problem: contact conditions are eliminated, not smoothed. With mortar on warped facets of hexahedra (the shape
    as control is refused), and on curved rigid surfaces, it is as exact as Newton's tangent. The state is unchanged.

    Args:
        problem: in statics, without friction, heat through contacts and laws with history; its last step is the state.
        J: functional of ``problem.u``, of the ``pressure`` of the problem's contacts and of the controls, a UFL form without test
            functions. For mixed problems ``problem.u`` is the mixed Function, and J contains parts of ``ufl.split(problem.u)``. The
            reaction of Dirichlet conditions, or the force of contacts, on a part is a functional of ``problem.u``:
            ``ufl.replace(F, {v: w})`` with a Function w that is a unit vector at the part's nodes, 0 elsewhere.
        controls: Constants and Functions in F, J or the values of Dirichlet conditions: moduli, loads, fields of moduli, prescribed
            displacements; Constants in equations, couplings, forces at nodes and laws of soft contacts. The entries of a Function are
            its degrees of freedom.
            ``ufl.SpatialCoordinate(mesh)`` is the shape: the positions of the nodes.
            A ``ContactParameter`` is the offset of a contact, the position or rotation of its rigid target, or the force of a preload.

    Returns:
        For every control, in the same order, the derivatives by its entries: an array of the shape of a Constant's value or a parameter,
        or a Function of the control's space. For the shape, a Function of vectors at the mesh's nodes, of the displacement's space. For
        straight cells with a displacement of degree 2 it is of a vector space of degree 1.

    Raises:
        InputError, InputTypeError: if the gradient depends on the history of all steps, if the problem has no step or no consistent
            tangent, or if its parameters have changed since the last step. For an object that is no functional or no control of this
            problem. For a J with pressures of contactors in concave corners of the target, or of contactors with conflicting equations.
        LinearSolveError: if the constrained matrix is singular.
    """
    check_problem(problem, recorded=False)
    some = check_controls(problem, "controls", [controls] if isinstance(controls, AnyControl) else controls)
    with agreed(problem.comm):
        given.kind("J", J, isinstance(J, ufl.Form) and not J.empty(), "a UFL form with an integral")
        check_functional("J", J, problem.config.mesh)
        check_parts("J", J, problem.u)
    pressing = _check_results(problem, J)
    refuse_without_state(problem, [J], [problem.u, *(contact.pressure for contact in pressing)])
    refuse_idle_controls(problem, "controls", some, [J])
    from uem_dolfinx.gradients.adjoint import Adjoint
    from uem_dolfinx.gradients.linearised import Linearised
    from uem_dolfinx.gradients.shape_slopes import warn_of_edges

    with Linearised(problem) as linearised:
        if any(isinstance(m, ufl.SpatialCoordinate) for m in some):
            warn_of_edges(problem)
        adjoint = Adjoint(linearised, revolved(J), pressing)
        return [adjoint.by(m) for m in some]


def tangent(problem: UnitedProblem, direction: Sequence[tuple[AnyControl, Any]], of: fem.Function | None = None) -> fem.Function:
    """Directional derivative of the displacement, or of a contact pressure, by parameters of the problem, by one solve (collective).

    For mixed problems the result contains all fields, as one Function of the mixed space.

    Args:
        problem: as in :func:`gradient`.
        direction: pairs of a control, as in :func:`gradient`, and its change. For a Constant or a parameter of a contact this is an
            array of its shape, for a Function a Function of its space, and for the shape a Function as :func:`gradient` returns it.
        of: the ``pressure`` of a contact of the problem; None for the displacement.

    Returns:
        The derivative along the direction.

    Raises:
        InputError, InputTypeError, LinearSolveError: see :func:`gradient`.
    """
    check_problem(problem, recorded=False)
    pairs, contact = check_controls(problem, "direction", direction), None
    refuse_idle_controls(problem, "direction", [control for control, _ in pairs])
    if of is not None:
        pressures = [contact.pressure for contact in problem.contacts]
        with agreed(problem.comm):
            which = [k for k, pressure in enumerate(pressures) if pressure is of]
            given.kind("of", of, bool(which), "the pressure of a contact of the problem, or None for the displacement")
        contact = problem.contacts[which[0]]
    from uem_dolfinx.gradients.linearised import Linearised
    from uem_dolfinx.gradients.shape_slopes import warn_of_edges

    with Linearised(problem) as linearised:
        if any(isinstance(m, ufl.SpatialCoordinate) for m, _ in pairs):
            warn_of_edges(problem)
        motion = linearised.moved(pairs)
        return motion.du if contact is None else linearised.pressed(contact, motion)


def taylor_test(
    functional: Callable[[float], float], slope: float, size: float = 1e-2, halvings: int = 4, comm: MPI.Comm = MPI.COMM_WORLD
) -> float:
    """Order with which ``|J(h) - J(0) - h slope|`` vanishes with h: 2 if ``slope`` is the derivative of J, else 1 (collective).

    Args:
        functional: J(h), for instance after a change of controls by h in one direction and a new solution of the problem.
        slope: the derivative of J by h at 0, for instance from :func:`gradient`.
        size: the first h, a positive number.
        halvings: number of halvings of h.
        comm: communicator of the ranks that call this: an error on one of them is raised on all.

    Returns:
        The smallest order of all halvings.

    Raises:
        InputTypeError: if J is no number.
        InputError: if ``size`` is not positive, if J or the slope is not finite, or if the remainder is zero at some h.
        UserFunctionError: if the functional raises an error.
    """
    given.kind("functional", functional, given.function(functional), "a function of h that returns a number")
    slope, size = (
        given.number("slope", slope, given.Range("a number", lambda x: True)),
        given.number("size", size, given.POSITIVE),
    )
    halvings = given.count("halvings", halvings)

    def J(h: float) -> float:
        """Its value, a number on all ranks."""
        value = ask_together(comm, f"functional({h:g})", functional, h)
        with agreed(comm):
            return given.number(f"functional({h:g})", value, given.Range("a number", lambda x: True))

    first = J(0.0)
    left = np.array([abs(J(size / 2**k) - first - size / 2**k * slope) for k in range(halvings + 1)])
    with agreed(comm):
        with np.errstate(divide="ignore", invalid="ignore"):
            order = float(np.log2(left[:-1] / left[1:]).min())
        if not np.isfinite(left).all() or np.isnan(order):
            raise InputError(
                f"taylor_test: |J(h) - J(0) - h slope| = {left} for h from {size} on has no order: expected a finite J and slope, and a J "
                "that is not linear in h"
            )
    return order


def check_problem(problem: UnitedProblem, recorded: bool = True) -> None:
    """Refuse problems without derivatives, and path-dependent problems unless they are ``recorded`` (collective)."""
    given.kind("problem", problem, isinstance(problem, UnitedProblem), "a UnitedProblem")
    with agreed(problem.comm):
        if recorded or not problem.config.moves:
            refuse_other_fields(
                problem.config, "gradients of histories" if recorded else "gradients", "take differences of two solutions"
            )
        if problem.bodies.dead is not None:
            raise InputError("forces that a step has not released yet depend on all steps, whose derivatives are not known")
        for present, what in (
            (problem.dynamics is not None, "a problem in time"),
            (bool(problem.materials), "a law with history"),
            (any(pair.friction is not None for pair in problem.pairs), "a contact with friction"),
        ):
            if present and not recorded:
                raise InputError(
                    f"the gradient of {what} depends on all steps, of which only the last is known: take the steps within "
                    "uem.recording(problem), and use its history"
                )
        if not recorded:
            refuse_kept_projections(problem, problem.progress.steps)
        if not isinstance(problem.system, BodySystem) or not problem.system.consistent_tangent or problem.system.newton != "full":
            raise InputError("a gradient needs newton='full', consistent_tangent=True, and contact by elimination: the defaults")
        if problem.bodies.tangent.given:
            raise InputError("a gradient needs the derivative of F: expected J = None")
        if any(contact.heats for contact in problem.contacts):
            raise InputError("gradients do not support heat conducted through a contact: expected contacts without heat")
        for contact in problem.contacts:
            refuse_soft(contact)
        if any(contact.cohesion is not None for contact in problem.contacts):
            raise InputError("gradients do not support cohesion: expected cohesion = None")
        if any(contact.leak is not None for contact in problem.contacts):
            raise InputError("gradients do not support a fluid between surfaces: expected leak = None")
        if chords := [contact.name for contact in problem.contacts if contact.chords]:
            raise InputError(
                f"contact '{chords[0]}': there is no gradient with chords=True, whose rows are not the derivative of the gaps: expected "
                "chords=False"
            )
        refuse_assembly(problem, recorded)
        if any(
            not keeps_distance(contact) and contact.pair.discretisation.setting.offset is not None for contact in problem.contacts
        ):
            raise InputError(
                "gradients at an offset need a rigid plane, sphere or cylinder: gaps from other surfaces are distances on these alone"
            )


def refuse_kept_projections(problem: UnitedProblem, steps: int) -> None:
    """Refuse contacts with projections from earlier steps than the last, whose derivatives are not available."""
    for contact in problem.contacts:
        if steps > 1 and contact.sliding == "small":
            raise InputError(
                f"contact '{contact.name}': after {steps} steps, contactors of sliding='small' are projected where an earlier step ended, "
                "of which there is no derivative: expected one step, or sliding='finite' or 'fixed'"
            )


def check_controls(problem: UnitedProblem, what: str, handed: Any, later: bool = False) -> list[Any]:
    """Refuse items that are no controls or no pairs of a control and its change, and problems without a step but for ``later`` use.

    Collective.
    """
    with agreed(problem.comm):
        problem.config.refuse_moved()
        if not problem.progress.steps and not later:
            raise InputError("the problem has taken no step: expected a state of equilibrium; solve it first")
        if what == "controls":
            controls = found = given.items(what, handed, lambda one: isinstance(one, AnyControl), A_CONTROL)
        else:
            found = given.items(what, handed, _is_pair, f"a pair of {A_CONTROL} and its change")
            controls = [control for control, _ in found]
        for i, control in enumerate(controls):
            if control is problem.u:
                raise InputError(f"{what}[{i}] holds the displacement, which the problem solves for: expected what it is made of")
            if isinstance(control, fem.Function) and _is_result(control):
                raise InputError(
                    f"{what}[{i}] holds '{control.name}', a result of a contact: expected what the problem is made of"
                )
            if isinstance(control, Control):
                check_expression(f"{what}[{i}]", control, problem.config.mesh.ufl_domain(), "the displacement's mesh")
            if isinstance(control, ufl.SpatialCoordinate):
                _check_shape(problem)
            if isinstance(control, fem.Function):
                check_field(problem, f"{what}[{i}]", control)
            if isinstance(control, ContactParameter):
                _check_parameter(problem, f"{what}[{i}]", control)
        for i, (control, change) in enumerate(found if what == "direction" else ()):
            _check_change(problem, f"the change in {what}[{i}]", control, change)
        return found


def _check_results(problem: UnitedProblem, J: ufl.Form) -> list[Contact]:
    """The contacts whose pressures J contains; refuse other results of contacts, and results of other problems (collective)."""
    results = [f for f in J.coefficients() if _is_result(f)]
    pressures = [contact.pressure for contact in problem.contacts] if results else []
    copies = problem.config.functions().values() if problem.config.unknowns.mixed else []
    with agreed(problem.comm):
        for f in J.coefficients():
            if any(f is copy for copy in copies):
                raise InputError(
                    f"J holds '{f.name}', a copy of a part of the unknowns u: expected ufl.split(u), which J depends on"
                )
        for f in results:
            if all(f is not pressure for pressure in pressures):
                raise InputError(
                    f"J holds '{f.name}', a result of a contact: expected none but the pressures of contacts of this problem; of the gap "
                    "and of forces take what they are made of, the displacement and the residual"
                )
    found = [contact for contact, p in zip(problem.contacts, pressures) if any(f is p for f in results)]
    with agreed(problem.comm):
        if soft := [contact.name for contact in found if contact.normal is not None]:
            raise InputError(
                f"J holds the pressure of '{soft[0]}', a soft contact, whose pressures have no derivatives here: expected forces: the "
                "residual with a Function in place of its test function"
            )
        if tied := [contact.name for contact in found if contact.tied]:
            raise InputError(
                f"J holds the pressure of '{tied[0]}', which is tied, and whose pressures have no derivatives here: expected pressures of "
                "other contacts, or forces: the residual with a Function in place of its test function"
            )
    return found


def refuse_without_state(problem: UnitedProblem, functionals: Sequence[ufl.Form], state: Sequence[fem.Function]) -> None:
    """Refuse functionals if none of them contains a Function in ``state``, the unknowns of the problem (collective)."""
    with agreed(problem.comm):
        if not any(f is one for J in functionals for f in J.coefficients() for one in state):
            raise InputError(
                "J holds nothing that the problem solves for: expected problem.u, or pressures of its contacts; a displacement of another "
                "problem is a field of given numbers here"
            )


def refuse_idle_controls(
    problem: UnitedProblem, what: str, controls: Sequence[Any], functionals: Sequence[ufl.Form] = ()
) -> None:
    """Refuse Constants and Functions that occur neither in the problem nor in a functional (collective)."""
    forms = [problem.bodies.F, *functionals]
    further = [problem.dynamics, problem.materials, constants_of(problem), fields_of(problem)]
    n, bcs = len(problem.u.x.array), problem.bodies.bcs
    for i, m in enumerate(controls):
        if not isinstance(m, (fem.Constant, fem.Function)):
            continue
        held = any(m is one for form in forms for one in (*form.constants(), *form.coefficients()))
        held = held or holds(further, m) or bool(set_by([m], bcs, n).any())
        with agreed(problem.comm):
            moved = [value for value in motions_of(problem) if value is not m]
            if holds([*(rule.value for rule in rules_of(bcs)), *moved], m):
                raise InputError(
                    f"{what}[{i}], {given.described(m)}, is in a Dirichlet value or a motion by a function or an expression, which has no "
                    "derivative here: expected it as the value itself, uem.dirichlet(V, tag, component, m)"
                )
            if not reduced(problem.comm, held, op=MPI.LOR):
                raise InputError(
                    f"{what}[{i}], {given.described(m)}, is in no form, Dirichlet condition or law of the problem, nor in J: expected "
                    "what these are made of, by which there are derivatives"
                )


def refuse_results(J: ufl.Form) -> None:
    """Refuse a functional of results of contacts."""
    for f in J.coefficients():
        if _is_result(f):
            raise InputError(
                f"J holds '{f.name}', a result of a contact: functionals of histories hold the displacement; of forces take the residual"
            )


def _is_result(f: fem.Function) -> bool:
    return any(f.name.startswith(f"contact_{what}_") for what in RESULTS)


def _is_pair(one: Any) -> bool:
    return isinstance(one, (tuple, list)) and len(one) == 2 and isinstance(one[0], AnyControl)


def _check_parameter(problem: UnitedProblem, what: str, m: ContactParameter) -> None:
    """Refuse parameters on which the problem does not depend, or by which there are no derivatives."""
    known = any(contact is m.contact for contact in problem.contacts)
    given.kind(what, m, known, "a parameter of a contact of the problem")
    refuse_parameter(m, what)
    if m.contact.further_parts_touch():
        raise InputError(
            f"{what} is of contact '{m.contact.name}', whose corners or edges touch: expected corners=False, edges=False"
        )
    if m.parameter == "friction" and m.contact.pair.friction is None:
        raise InputError(
            f"{what} is the friction of contact '{m.contact.name}', which has none: expected a contact with friction"
        )
    if m.parameter == "offset" and not keeps_distance(m.contact):
        raise InputError(f"{what} is the offset from a rigid surface: expected a plane, a sphere or a cylinder, or a mesh")
    if m.parameter in ("place", "turn") and m.contact.adjust:
        raise InputError(
            f"{what} is the {m.parameter} of the target of contact '{m.contact.name}', with which gaps that are adjusted change: expected "
            "a contact with no adjust"
        )
    if m.contact.sliding != "finite" and m.parameter != "offset":
        raise InputError(
            f"{what} is a {m.parameter}, by which contacts of sliding='{m.contact.sliding}' have no gradient: expected 'finite'"
        )


def _check_change(problem: UnitedProblem, what: str, control: AnyControl, change: Any) -> None:
    """Refuse a change whose type, shape or space differs from its control."""
    if not isinstance(control, (fem.Function, ufl.SpatialCoordinate)):
        shape = np.shape(control.value) if isinstance(control, fem.Constant) else control.shape(problem.config.gdim)
        try:
            values = np.asarray(change, dtype=float)
        except (TypeError, ValueError):
            raise InputTypeError(given.sentence(what, change, f"finite numbers of shape {shape}")) from None
        if values.shape != shape:
            raise InputError(given.sentence(what, change, f"finite numbers of shape {shape}"))
        if not np.isfinite(values).all():
            raise InputError(given.sentence(what, change, "finite numbers"))
        return
    of, whose = Places(problem.config).W, "the mesh's nodes'"
    if isinstance(control, fem.Function):
        of, whose = control.function_space, "the control's"
    given.kind(what, change, isinstance(change, fem.Function), f"a Function of {whose} space")
    own = change.function_space
    if own.ufl_element() != of.ufl_element() or own.ufl_domain() != of.ufl_domain():
        raise InputError(f"{what} is a Function of another space: expected one of {whose} space")


def _check_shape(problem: UnitedProblem) -> None:
    """Refuse problems that have no gradient by the shape."""
    config = problem.config
    if not Places(config).known:
        raise InputError("a gradient by the shape needs straight cells, or cells of the displacement's degree")
    if not all(map(slides, problem.pairs)):
        raise InputError(
            "a gradient by the shape needs contacts of sliding='finite': others keep where they were projected at first"
        )
    for contact in problem.contacts:
        if not isinstance(contact.pair.discretisation, (NodeToSurface, Contactors)):
            raise InputError(
                f"contact '{contact.name}': there is no gradient by the shape with a discretisation of one's own, whose rows may change "
                "with the shape in ways that are not known: take differences of runs"
            )
    if config.gdim == 3 and config.mesh.topology.cell_name() == "hexahedron":
        for contact in problem.contacts:
            if contact.coupling == "mortar":
                raise InputError(
                    f"contact '{contact.name}': there is no gradient by the shape with coupling='mortar' on hexahedra, whose facets warp: "
                    "expected coupling='node_to_surface', or tetrahedra"
                )
    refuse_shape(problem)
    if any(contact.adjust or is_of_position(contact.offset) for contact in problem.contacts):
        raise InputError(
            "a gradient by the shape needs an offset that is a number or a Function, and no adjust: others change with the shape"
        )
