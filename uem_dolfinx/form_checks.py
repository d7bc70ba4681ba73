"""Checks of UFL forms of users before compilation: arguments, spaces and meshes.

A form on another mesh or space would be assembled with wrong node numbers, or beyond the end of arrays.
"""

from __future__ import annotations

from itertools import chain
from typing import Any, TypeAlias

import numpy as np
import ufl
from dolfinx import fem
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.check_arities import ArityMismatch, check_form_arity
from ufl.algorithms.remove_complex_nodes import remove_complex_nodes
from ufl.constantvalue import ScalarValue
from ufl.core.expr import Expr
from ufl.corealg.traversal import unique_pre_traversal
from ufl.differentiation import CompoundDerivative, Derivative
from ufl.geometry import GeometricFacetQuantity

from uem_dolfinx import compat, given
from uem_dolfinx.errors import InputError, SpaceError

#: Signatures of forms in which every term contains all arguments once.
_with_all_arguments: set[str] = set()
#: Types that a functional may be differentiated by.
Control: TypeAlias = fem.Constant | fem.Function | ufl.SpatialCoordinate


def check_linear(what: str, form: Any, V: Any) -> None:
    """Refuse anything but a form that is linear in a test function of a space, on its mesh.

    Args:
        what: name of the form in messages.
        form: object to check.
        V: the displacement's space.

    Raises:
        InputTypeError, InputError, SpaceError: each with a remedy.
    """
    arguments = _arguments(what, form, V.mesh, "not linear in its test function", "every term to hold the test function once")
    if not arguments:
        remedy = f"of an energy, take {what} = ufl.derivative(energy, u, ufl.TestFunction(u.function_space))"
        raise InputError(f"{what} is a functional, without test function: expected a form linear in one; {remedy}")
    if len(arguments) > 1:
        remedy = "put u in place of the TrialFunction"
        raise InputError(f"{what} has {len(arguments)} arguments: expected a test function alone; {remedy}")
    if arguments[0].ufl_function_space() != V:
        raise SpaceError(
            f"the test function of {what} belongs to another space than the displacement: expected ufl.TestFunction(u.function_space)"
        )


def check_bilinear(what: str, form: Any, V: Any) -> None:
    """Refuse anything but a form bilinear in a test and a trial function of a space, on its mesh; raises as ``check_linear``."""
    arguments = _arguments(what, form, V.mesh, "not bilinear", "every term to hold the test and the trial function once")
    if [argument.number() for argument in arguments] != [0, 1]:
        raise InputError(
            f"{what} has {len(arguments)} argument(s): expected a test and a trial function, as ufl.derivative(F, u) has"
        )
    if any(argument.ufl_function_space() != V for argument in arguments):
        raise SpaceError(f"{what} has arguments of another space than the displacement: expected those of u.function_space")


def check_functional(what: str, form: Any, domain: Any = None) -> None:
    """Refuse anything but a functional on a mesh (None: the mesh of its first integral); raises as ``check_linear``."""
    arguments = _arguments(what, form, domain, "no functional", "no test function, or every term to hold it")
    if arguments:
        raise InputError(f"{what} has {len(arguments)} argument(s): expected a functional, without test function; leave it out")


def _arguments(what: str, form: Any, domain: Any, fault: str, expected: str) -> Any:
    """Arguments of a form on a mesh; every term must contain all of them once."""
    if not isinstance(form, ufl.Form):
        remedy = "integrate it: multiply it by ufl.dx" if isinstance(form, Expr) else "write it with ufl, and do not compile it"
        given.kind(what, form, False, "a UFL form", remedy)
    # UFL fails where meshes mix
    _check_mesh(what, form, domain)
    try:
        arguments, alike = form.arguments(), form.signature()
        if alike in _with_all_arguments:
            return arguments
        # expansion of gradients, which are linear, is the slowest part and is avoided if possible
        if not (_is_expanded(form) and _holds_once(apply_algebra_lowering(form), arguments)):
            # as in form compilers: conj of ufl.inner has no effect in a real form
            check_form_arity(remove_complex_nodes(ufl.algorithms.expand_derivatives(form)), arguments)
    except (Exception, ArityMismatch) as error:  # its class depends on the version of UFL
        raise InputError(f"{what} is {fault} ({error}): expected {expected}") from error
    _with_all_arguments.add(alike)
    return arguments


def _is_expanded(form: ufl.Form) -> bool:
    """Whether all derivatives in a form are derivatives in space."""
    parts = chain.from_iterable(unique_pre_traversal(integral.integrand()) for integral in form.integrals())
    return not any(isinstance(part, Derivative) and not isinstance(part, CompoundDerivative) for part in parts)


def _holds_once(form: ufl.Form, arguments: Any) -> bool:
    """Whether every term contains all arguments once, as far as this can be decided without expanding gradients."""
    try:
        check_form_arity(remove_complex_nodes(form), arguments)
    except (Exception, ArityMismatch):
        return False
    return True


def _check_mesh(what: str, form: Any, domain: Any = None) -> None:
    """SpaceError for a form on another mesh than that of its first integral, InputError for integrals over parts without tags."""
    own = None if domain is None else domain.ufl_domain()
    tagged = {integral.integral_type() for integral in form.integrals() if integral.subdomain_data() is not None}
    for integral in form.integrals():
        kind, part = integral.integral_type(), integral.subdomain_id()
        if kind not in tagged and part not in ("everywhere", "otherwise"):
            measure = {"cell": "dx", "exterior_facet": "ds", "interior_facet": "dS"}.get(kind, kind)
            ours = f"uem.{measure}(tag), or " if measure in ("dx", "ds") else ""
            raise InputError(
                f"{what} has an integral over {measure}({part}) without tags, so over nothing: expected {ours}"
                f"ufl.Measure('{measure}', subdomain_data=tags)({part})"
            )
        own = own or integral.ufl_domain()
        if integral.ufl_domain() != own:
            raise SpaceError(f"{what} is integrated over another mesh: expected {_mesh(domain)}; take ufl.dx(domain=mesh) of it")
        tags = integral.subdomain_data()
        if hasattr(tags, "indices") and not compat.belongs_to(tags, own.ufl_cargo()):
            raise SpaceError(f"{what} has a measure with MeshTags of another mesh: expected those of {_mesh(domain)}")
        check_expression(what, integral.integrand(), own, _mesh(domain))


def check_expression(what: str, expression: Any, own: Any, mesh: str) -> None:
    """Raise a SpaceError for a UFL expression with Functions or coordinates of another domain than ``own``, ``mesh`` in words."""
    for part in ufl.corealg.traversal.traverse_unique_terminals(expression):
        if any(other != own for other in ufl.domain.extract_domains(part)):
            held = f"'{part.name}'" if isinstance(part, fem.Function) else given.described(part)
            raise SpaceError(f"{what} holds {held} of another mesh: expected all of {mesh}; make both on one mesh")


def check_values(what: str, expression: Any, own: Any, mesh: str) -> None:
    """Raise an InputError for a UFL expression without finite values in cells; otherwise check as ``check_expression``."""
    for part in ufl.corealg.traversal.traverse_unique_terminals(expression):
        if isinstance(part, ufl.Argument):
            raise InputError(f"{what} holds a test or trial function: expected values alone; put a Function in its place")
        if isinstance(part, GeometricFacetQuantity):
            raise InputError(
                f"{what} holds {part}, which is of facets: expected values in cells; integrate it by ds, or leave it out"
            )
        if isinstance(part, ScalarValue) and not np.isfinite(complex(part)):
            raise InputError(f"{what} holds the number {part}: expected finite ones")
    check_expression(what, expression, own, mesh)


def check_parts(what: str, form: ufl.Form, u: fem.Function) -> None:
    """Raise an InputError for a form with ``u.sub(i)``, which UFL does not differentiate by u."""
    for f in form.coefficients():
        if f is not u and isinstance(f, fem.Function) and np.may_share_memory(f.x.array, u.x.array):
            raise InputError(
                f"{what} holds u.sub(i) of the Function u, by which it is not differentiated: expected ufl.split(u)[i]"
            )


def _mesh(domain: Any) -> str:
    return "one mesh" if domain is None else "the displacement's mesh"


def takes_values(form: ufl.Form, u: Any) -> bool:
    """Whether a form contains u itself, not only its derivatives, e.g. in springs."""
    seen: set[int] = set()
    kept = ufl.algorithms.expand_derivatives(form)
    todo = [integral.integrand() for integral in kept.integrals()]
    while todo:
        e = todo.pop()
        if e is u:
            return True
        if id(e) not in seen and not isinstance(e, Derivative):
            seen.add(id(e))
            todo.extend(e.ufl_operands)
    return False
