"""Helpers for scripts, the same for all versions of DOLFINx: Dirichlet conditions and measures by tag, and integrals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Number
from typing import Any

import numpy as np
import ufl
from dolfinx import fem
from petsc4py import PETSc
from ufl.core.expr import Expr

from uem_dolfinx import compat, forms, given
from uem_dolfinx.compiled import with_options
from uem_dolfinx.errors import InputError, SpaceError
from uem_dolfinx.form_checks import check_functional, check_values
from uem_dolfinx.geometry.axisymmetry import revolved
from uem_dolfinx.geometry.tags import Part, Tag, as_tag, locate_dofs
from uem_dolfinx.parallel import agreed


def dirichlet(V: fem.FunctionSpace, tag: Part, component: int | None = None, value: Any = 0.0) -> fem.DirichletBC:
    """Prescribe the displacement, or one component of it, at all nodes of a part of the mesh (collective).

        uem.dirichlet(V, tags["edge"], 1, lambda x, t: 0.1 * t * np.sin(np.pi * x[0]))

    Args:
        V: a Lagrange space with ``size`` components, a part of a mixed space, e.g. ``W.sub(0)``, or a component of either.
        tag: facets, or entities of any dimension: a tag, a list of tags, ``(meshtags, value)``, or facet indices.
        component: 0 is x; None prescribes all components.
        value: a number, or for all components a vector ``(size,)``; or a Constant of one of these shapes, or a Function, both of which
            may be changed between steps. The Function is of ``V``; for one component of a scalar space, for a vector part of a mixed
            space of a vector space, of the same degree. Or a function of positions x ``(3, n)``, as in DOLFINx's ``interpolate``,
            which returns ``(n,)``, or for all components ``(size, n)``. With a second argument it depends on the load factor or time;
            it needs no ``load``, and is not ramped. Or a UFL expression, such as the component ``w[1]`` of a Function, which is
            evaluated in every step.

    Returns:
        DOLFINx's Dirichlet condition.

    Raises:
        SpaceError: ``V`` is no Lagrange space, or the tag or the Function does not belong to it.
        TagError: the tag is empty, or cannot be read.
        InputError, InputTypeError: no such component, or a value of another shape or not finite.
        UserFunctionError: if a function raises.
    """
    mesh = given.kind("V", V, hasattr(V, "dofmap"), "a function space, as u.function_space").mesh
    with agreed(mesh.comm):
        value = _checked(V, component, value)
    tdim = mesh.topology.dim
    tag = as_tag(tag, mesh, (tdim - 1, *range(tdim + 1)), "the support")
    part = bool(len(V.component()))
    sub = V if component is None or V.num_sub_spaces < 2 else V.sub(int(component))
    # DOLFINx takes no vectors of numbers for a part
    vectors = sub is V and part and V.num_sub_spaces > 1
    constant = isinstance(value, fem.Constant) and not vectors
    if not isinstance(value, fem.Function) and not constant and (isinstance(value, Expr) or callable(value)):
        return _by_rule(V, tag, component, value, sub is V and not part)
    if vectors and not isinstance(value, fem.Function):
        values, value = value, fem.Function(_values_space(V, True))
        value.x.array.reshape(-1, len(values))[:] = values
    if not isinstance(value, fem.Function):
        return compat.dirichletbc(value, locate_dofs(sub, tag), sub)
    if sub is V and not part:
        return fem.dirichletbc(value, locate_dofs(V, tag))
    return compat.dirichletbc(value, locate_dofs((sub, value.function_space), tag), sub)


def _by_rule(V: Any, tag: Tag, component: int | None, value: Any, whole: bool) -> fem.DirichletBC:
    """A condition whose values follow a function or an expression (collective)."""
    from uem_dolfinx.conditions.prescribed import Rule

    values = fem.Function(V if whole else _values_space(V, component is None))
    bc = dirichlet(V, tag, component, values)
    bc.rule = Rule(value, values, locate_dofs(values.function_space, tag), str(tag.name))
    bc.rule.take_load(V.mesh.comm, 0.0)
    return bc


def _values_space(V: Any, whole: bool) -> Any:
    """Lagrange space of the degree of a part of a mixed space: of vectors if it has components and they are prescribed as a whole."""
    shape = (V.num_sub_spaces,) if whole and V.num_sub_spaces > 1 else ()
    return compat.function_space(V.mesh, compat.highest_degree(V), shape)


def _checked(V: Any, component: int | None, value: Any) -> Any:
    """The value for ``fem.dirichletbc``, checked to be finite and to fit the space."""
    part, degree = bool(len(V.component())), compat.lagrange_degree(V)
    size = max(V.num_sub_spaces, 1) if part else V.dofmap.index_map_bs
    if degree is None or not (part or V.dofmap.bs == size):
        raise SpaceError(
            "V is no Lagrange space: expected that of the displacement, a part of a mixed one as W.sub(0), or a component"
        )
    if component is not None and (given.truth(component) or component not in range(size)):
        raise InputError(given.sentence("component", component, f"one of 0 to {size - 1}, or None for all"))
    n = size if component is None else 1
    if isinstance(value, list | tuple) and given.symbolic(value):
        value = ufl.as_vector(value)
    if isinstance(value, fem.Function) and value.ufl_shape == (size,) and n == 1 < size:
        value = value[component]
    if isinstance(value, Expr) and not isinstance(value, (fem.Function, fem.Constant)):
        if value.ufl_shape != ((n,) if n > 1 else ()):
            raise InputError(f"a Dirichlet condition for {n} components has a value of the shape {value.ufl_shape}: expected {n}")
        check_values("the value of a Dirichlet condition", value, V.mesh.ufl_domain(), "the mesh of V")
        return value
    if callable(value) and not isinstance(value, Expr):
        return value
    if isinstance(value, fem.Function):
        own, array = value.function_space, value.x.array
        alike = own.dofmap.index_map_bs == n and compat.lagrange_degree(own) == degree and own.mesh is V.mesh
        if not (own == V if n == size and not part else alike):
            space = f"a {'scalar' if n == 1 else 'vector'} Lagrange space of degree {degree} on its mesh"
            wanted = "the condition's space" if n == size and not part else space
            raise SpaceError(f"the value '{value.name}' of a Dirichlet condition is no Function of {wanted}")
    else:
        try:
            array = given.numbers(value.value if isinstance(value, fem.Constant) else value)
        except (TypeError, ValueError):
            array = None
        expected = "a number, or a Constant or a Function, or numbers for all components"
        fits = array is not None and value is not None and not given.truth(value)
        given.kind("the value of a Dirichlet condition", value, fits, expected)
        if array.ndim == 0 and n > 1 and not isinstance(value, fem.Constant):
            array = np.full(n, array)
        if array.shape != ((n,) if n > 1 else ()):
            words = f"{n} numbers" if n > 1 else "a number"
            raise InputError(f"a Dirichlet condition for {n} components has a value of the shape {array.shape}: expected {words}")
    if not np.isfinite(array).all():
        raise InputError(given.sentence("the value of a Dirichlet condition", value, "finite numbers"))
    return value if isinstance(value, (fem.Function, fem.Constant)) else array if n > 1 else array[()]


def ds(tag: Part, mesh: Any = None, **metadata: Any) -> ufl.Measure:
    """Measure of the exterior facets of a part of the mesh, as in ``p * v[1] * uem.ds(tags["top"])`` (collective).

    A form that the package compiles, in ``UnitedProblem`` and ``integrate``, may contain any number of such measures.

    Args:
        tag: a tag, a list of tags, ``(meshtags, value)``, or facet indices.
        mesh: needed unless one of these is a tag of ``read_gmsh``, which contains its mesh.
        metadata: for the form compiler, e.g. ``quadrature_degree=2``.
    """
    mesh = _mesh_of(tag, mesh)
    return forms.surface_measure(mesh, as_tag(tag, mesh, (mesh.topology.dim - 1,), "the measure ds").entities, metadata)


def dx(tag: Part, mesh: Any = None, **metadata: Any) -> ufl.Measure:
    """Measure of the cells of a part of the mesh, with the arguments of ``ds`` (collective)."""
    mesh = _mesh_of(tag, mesh)
    return forms.cell_measure(mesh, as_tag(tag, mesh, (mesh.topology.dim,), "the measure dx").entities, metadata)


def _mesh_of(part: Part, mesh: Any) -> Any:
    known = [one.mesh for one in (part if isinstance(part, (list, tuple)) else [part]) if isinstance(one, Tag)]
    if mesh is None and not known:
        raise InputError(
            f"a measure of {given.shown(part)} needs the mesh as its second argument: only tags of read_gmsh contain theirs"
        )
    found = known[0] if mesh is None else mesh
    return given.kind("mesh", found, hasattr(found, "topology"), "a mesh, as u.function_space.mesh")


def interpolate(u: fem.Function, expression: Any) -> None:
    """Interpolate a UFL expression, or a number, into a Function of a Lagrange, DG or quadrature space, ghosts included (collective).

    At points that several cells share, one of them gives the value of an expression that jumps there.

    Raises:
        InputTypeError: if ``u`` is no Function, or the expression no UFL expression.
        InputError: if the expression has another shape than the values of ``u``.
        SpaceError: if it is of another mesh, or ``u`` has no nodal values.
    """
    given.kind("u", u, isinstance(u, fem.Function), "a Function", "f = fem.Function(uem.function_space(mesh, 1))")
    remedy = "values of the places x go by u.interpolate(lambda x: ...)"
    if not isinstance(expression, Expr):
        given.kind("expression", expression, isinstance(expression, Number), "a UFL expression, or a number", remedy)
        expression = ufl.as_ufl(expression)
    V = u.function_space
    if expression.ufl_shape != u.ufl_shape:
        raise InputError(
            f"expression has the shape {expression.ufl_shape}: expected {u.ufl_shape}, that of u; take a component, or ufl.as_vector"
        )
    if (compat.element_family(V) or ("",))[0] not in ("Lagrange", "Discontinuous Lagrange", "Quadrature"):
        raise SpaceError(
            "u is of a space without nodal values: expected a Lagrange, DG or quadrature space; make it by uem.function_space"
        )
    check_values("expression", expression, V.mesh.ufl_domain(), "the mesh of u")
    forms.interpolation(u, expression)()


def integrate(integrals: ufl.Form | fem.Form) -> float:
    """Value of a functional, as in ``uem.integrate(p * uem.ds(tags["top"]))``, summed over all ranks (collective).

    Args:
        integrals: in UFL, on a mesh declared ``axisymmetric`` over whole circles; or compiled by ``fem.form``, which saves time for
            repeated evaluation, but is integrated as it is.

    Raises:
        InputError, InputTypeError: for anything else, or a form with a test function or without integrals.
        SpaceError: if it is of several meshes.
    """
    if not isinstance(integrals, ufl.Form):
        remedy = "multiply an expression by ufl.dx or uem.ds(tag)"
        given.kind(
            "integrals", integrals, hasattr(integrals, "function_spaces"), "a UFL form, or one compiled by fem.form", remedy
        )
    elif not integrals.empty():
        check_functional("the integral", integrals)
    else:
        raise InputError("the form of no integrals belongs to no mesh: expected one integral at least")
    M = forms.form(revolved(integrals)) if isinstance(integrals, ufl.Form) else integrals
    return forms.assemble_scalar(M, forms.parts_of(M)[0].mesh.comm)


def form(integrals: ufl.Form, jit_options: Mapping[str, Any] | None = None) -> Any:
    """Compile a UFL form with any number of ``uem.ds(tag)`` and ``uem.dx(tag)`` (collective).

        a = uem.form(ufl.inner(u, v) * ufl.dx + k * ufl.inner(u, v) * uem.ds(tags["left"]) + h * ufl.inner(u, v) * uem.ds(tags["top"]))

    UFL alone refuses measures with several ``subdomain_data`` in one form.

    Args:
        integrals: in UFL, on a mesh declared ``axisymmetric`` over whole circles.
        jit_options: for DOLFINx's compiler, e.g. ``{"cffi_extra_compile_args": ["-O3"]}``.

    Returns:
        DOLFINx's compiled form, for ``integrate``, ``assemble_vector``, ``assemble_matrix`` and DOLFINx. Integrals with one-point rules
        are compiled separately from others: a list of two forms, which DOLFINx's own functions do not take.

    Raises:
        InputError, InputTypeError: for anything else than a form of integrals.
    """
    given.kind(
        "integrals", integrals, isinstance(integrals, ufl.Form), "a UFL form", "multiply an expression by ufl.dx or uem.ds(tag)"
    )
    if integrals.empty():
        raise InputError("the form of no integrals belongs to no mesh: expected one integral at least")
    with with_options(given.kind("jit_options", jit_options or {}, isinstance(jit_options, Mapping | None), "a dictionary")):
        return forms.form(revolved(integrals))


def assemble_vector(L: Any) -> PETSc.Vec:
    """Vector of a linear form, in UFL or compiled by ``form``, summed over all ranks (collective).

    Returns:
        PETSc's ghosted vector; ``array`` has the values of this rank's unknowns, and ghosts are up to date.

    Raises:
        InputError, InputTypeError: for anything else, or a form of another number of arguments.
    """
    compiled = _of_rank("L", L, 1)
    b = compat.create_vector(forms.parts_of(compiled)[0].function_spaces[0])
    forms.assemble_vector(b, compiled)
    b.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)
    return b


def assemble_matrix(a: Any, bcs: Sequence[fem.DirichletBC] = ()) -> PETSc.Mat:
    """Matrix of a bilinear form, in UFL or compiled by ``form`` (collective).

    Args:
        a: the form.
        bcs: Dirichlet conditions, whose rows and columns are those of the identity.

    Returns:
        PETSc's assembled matrix.

    Raises:
        InputError, InputTypeError: for anything else, or a form of another number of arguments.
    """
    compiled = _of_rank("a", a, 2)
    bcs = given.items("bcs", bcs, compat.is_dirichlet, "a Dirichlet condition")
    A = forms.create_matrix(compiled)
    forms.assemble_matrix(A, compiled)
    if bcs:
        found = [compat.bc_dofs(bc) for bc in bcs]
        rows = np.unique(np.concatenate([dofs[:n] for dofs, n in found])).astype(np.int32)
        first = A.getOwnershipRange()[0]
        A.zeroRowsColumns(first + rows, diag=1.0)
    return A


def _of_rank(what: str, given_form: Any, rank: int) -> Any:
    """A form of so many arguments, compiled."""
    compiled = form(given_form) if isinstance(given_form, ufl.Form) else given_form
    parts = forms.parts_of(compiled)
    given.kind(what, given_form, all(hasattr(one, "function_spaces") for one in parts), "a UFL form, or one compiled by uem.form")
    if any(len(one.function_spaces) != rank for one in parts):
        words = {1: "linear in a test function", 2: "bilinear in a test and a trial function"}[rank]
        raise InputError(f"{what} has {len(parts[0].function_spaces)} argument(s): expected a form {words}")
    return compiled
