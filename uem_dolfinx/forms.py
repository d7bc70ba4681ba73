"""Measures, matrices, vectors and functionals of forms, and topology of reference cells.

Calls that are the same in all versions of DOLFINx, but would have to be repeated by every caller.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

from mpi4py import MPI  # before dolfinx and petsc4py: in the PyPI wheel it loads the MPI library

import basix
import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem, mesh
from petsc4py import PETSc
from ufl.algebra import Division, Power
from ufl.algorithms import expand_derivatives
from ufl.algorithms.apply_algebra_lowering import apply_algebra_lowering
from ufl.algorithms.estimate_degrees import estimate_total_polynomial_degree
from ufl.constantvalue import IntValue
from ufl.corealg.traversal import traverse_unique_terminals, unique_pre_traversal
from ufl.indexed import Indexed
from ufl.mathfunctions import MathFunction

from uem_dolfinx import compat
from uem_dolfinx.arrays import Indices
from uem_dolfinx.compiled import kept
from uem_dolfinx.parallel import reduced

#: Integrands that are no polynomials get a quadrature rule of this times the degree of the displacement.
#: [convention; degrees; test_elastic.py::test_degrees_that_are_set]
DEGREES_ENOUGH = 4


def original_cells(domain: Any) -> npt.NDArray[np.int64]:
    """Number of every cell in the mesh's input ``(n_cells incl. ghosts,)``; empty for a mesh made from another one."""
    try:
        return np.asarray(domain.topology.original_cell_index, dtype=np.int64)
    except RuntimeError:
        # a mesh made from another one may have no input cells
        return np.zeros(0, dtype=np.int64)


def vertex_nodes(domain: Any) -> Indices:
    """Local geometry node of every vertex ``(n_vertices incl. ghosts,)``."""
    topology = domain.topology
    vertex_map = topology.index_map(0)
    topology.create_connectivity(topology.dim, 0)
    n_vertices = len(reference_topology(compat.cell_name(domain))[0])
    vertices = compat.cell_table(topology.connectivity(topology.dim, 0), n_vertices)
    nodes = np.zeros(vertex_map.size_local + vertex_map.num_ghosts, dtype=np.int32)
    nodes[vertices] = compat.geometry_dofs(domain)[:, :n_vertices]
    return nodes


def expanded(form: ufl.Form) -> ufl.Form | None:
    """A form with expanded derivatives; None if it is empty."""
    found = ufl.algorithms.expand_derivatives(form)
    return None if found.empty() else found


def by_places(form: ufl.Form, domain: Any, direction: Any) -> ufl.Form | None:
    """Derivative of a form along a change of the positions of a mesh's nodes; None if the form does not depend on them.

    All coordinates in the form become one object: UFL compares them by hashes that FFCx 0.5 changes where users compile forms.
    """
    X = ufl.SpatialCoordinate(domain)
    own = X.ufl_domain()
    parts = [part for integral in form.integrals() for part in traverse_unique_terminals(integral.integrand())]
    found = {part: X for part in parts if isinstance(part, ufl.SpatialCoordinate) and part.ufl_domain() == own}
    return expanded(ufl.derivative(ufl.replace(form, found) if found else form, X, direction))


#: Numbers of the non-zero integrals of expanded forms, and of their Functions and Constants, by the forms' signatures.
_left: dict[str, tuple[list[int], list[int], list[int]]] = {}


def with_derivatives(form: ufl.Form) -> tuple[ufl.Form, list[Any]]:
    """The integrals of a form that do not vanish when derivatives are expanded, and their Functions and Constants.

    The derivatives are returned unexpanded, for the compiler. Equal forms are expanded once in a process.
    """
    key = form.signature()
    if key not in _left:
        integrals = [k for k, one in enumerate(form.integrals()) if expanded(ufl.Form([one])) is not None]
        kept_form = ufl.Form([form.integrals()[k] for k in integrals])
        found = ufl.algorithms.expand_derivatives(kept_form)
        functions = [kept_form.coefficients().index(f) for f in found.coefficients()]
        _left[key] = integrals, functions, [kept_form.constants().index(c) for c in found.constants()]
    integrals, functions, constants = _left[key]
    if len(integrals) < len(form.integrals()):
        form = ufl.Form([form.integrals()[k] for k in integrals])
    return form, [*(form.coefficients()[k] for k in functions), *(form.constants()[k] for k in constants)]


def cells_of_facets(domain: Any, facets: npt.ArrayLike) -> tuple[Indices, Indices]:
    """Cells of facets, ghosts included, and each facet's number in its cell ``(k,)``; interior facets occur twice."""
    topology, entities = domain.topology, np.asarray(facets, dtype=np.int32)
    tdim = topology.dim
    topology.create_connectivity(tdim - 1, tdim)
    topology.create_connectivity(tdim, tdim - 1)
    f2c, width = topology.connectivity(tdim - 1, tdim), len(reference_topology(compat.cell_name(domain))[tdim - 1])
    starts, ends = np.asarray(f2c.offsets)[entities], np.asarray(f2c.offsets)[entities + 1]
    counts = ends - starts
    which = np.repeat(entities, counts)
    cells = np.asarray(f2c.array)[np.arange(counts.sum()) + np.repeat(ends - np.cumsum(counts), counts)]
    sides = (compat.cell_table(topology.connectivity(tdim, tdim - 1), width)[cells] == which[:, None]).argmax(axis=1)
    return cells, sides.astype(np.int32)


def mesh_tags(domain: Any, dim: int, entities: npt.ArrayLike, values: npt.ArrayLike) -> Any:
    """MeshTags of local entities in any order ``(n,)``, with one value for all or for each ``(n,)``; the first of duplicates counts."""
    indices = np.asarray(entities, dtype=np.int32).reshape(-1)
    numbers = np.broadcast_to(np.asarray(values, dtype=np.int32), indices.shape)
    unique, first = np.unique(indices, return_index=True)
    return mesh.meshtags(domain, dim, unique, np.ascontiguousarray(numbers[first]))


def surface_measure(domain: Any, facets: npt.ArrayLike, metadata: Mapping[str, Any] | None = None) -> Any:
    """Boundary measure ``ds`` over the given facets only.

    Args:
        domain: the mesh.
        facets: local indices of exterior facets, shape ``(n,)``; each rank integrates over those it owns.
        metadata: form compiler data, e.g. ``{"quadrature_degree": 2}``.

    Returns:
        The UFL measure.
    """
    domain.topology.create_connectivity(domain.topology.dim - 1, domain.topology.dim)
    tags = mesh_tags(domain, domain.topology.dim - 1, facets, 1)
    return ufl.Measure("ds", domain=domain, subdomain_data=tags, metadata=dict(metadata or {}))(1)


def cell_measure(domain: Any, cells: npt.ArrayLike, metadata: Mapping[str, Any] | None = None) -> Any:
    """Measure ``dx`` over the given cells only.

    Args:
        domain: the mesh.
        cells: local indices, shape ``(n,)``; each rank integrates over those it owns.
        metadata: form compiler data, e.g. ``{"quadrature_degree": 2}``.

    Returns:
        The UFL measure.
    """
    tags = mesh_tags(domain, domain.topology.dim, cells, 1)
    return ufl.Measure("dx", domain=domain, subdomain_data=tags, metadata=dict(metadata or {}))(1)


def quadrature_rule(cell: str, degree: int) -> tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]:
    """Points ``(n, tdim)`` and weights ``(n,)`` on the reference cell that forms use by default for polynomials of a degree."""
    points, weights = basix.make_quadrature(getattr(basix.CellType, cell), degree)
    return np.asarray(points), np.asarray(weights)


def create_lagrange_element(cell: str, degree: int) -> Any:
    """Basix's scalar Lagrange element with the nodes of function spaces; ``tabulate(n, points)`` is ``(n_derivatives, n, nn, 1)``."""
    return basix.create_element(basix.ElementFamily.P, getattr(basix.CellType, cell), degree, basix.LagrangeVariant.gll_warped)


def reference_topology(cell: str) -> list[list[list[int]]]:
    """Vertices of every sub-entity of a reference cell: ``topology[dim][i]``."""
    return [[list(entity) for entity in entities] for entities in basix.topology(getattr(basix.CellType, cell))]


def sum_ghosts(u: Any) -> None:
    """Add the ghost entries of a Function to their owners and send the sums back (collective)."""
    vector = compat.petsc_vector(u)
    vector.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)
    vector.ghostUpdate(addv=PETSc.InsertMode.INSERT, mode=PETSc.ScatterMode.FORWARD)


def form(integrals: Any) -> Any:
    """Compile a UFL form, or a nested sequence of forms, for real numbers; a form with two kinds of rules becomes a list of parts."""
    if not isinstance(integrals, ufl.Form):
        with kept():
            return fem.form(integrals, dtype=np.float64)
    parts = [_compiled(part) for part in _by_rules(integrals)]
    return parts[0] if len(parts) == 1 else parts


def _compiled(F: ufl.Form) -> Any:
    with compat.named_for_code(F), kept():
        return fem.form(_of_one_subdomain_data(_of_sensible_degree(F)), dtype=np.float64)


def _by_rules(F: ufl.Form) -> list[ufl.Form]:
    """A form split into integrals with one-point rules and other integrals.

    In code for both, FFCx (0.5 to 0.11) uses the values of Functions at the one point for every point.
    """
    parts: dict[bool, list[Any]] = {}
    for integral in F.integrals():
        rule = integral.metadata()
        one = rule.get("quadrature_degree") in (0, 1) or len(rule.get("quadrature_weights", ())) == 1
        parts.setdefault(one, []).append(integral)
    if len(parts) < 2:
        return [F]
    # the part with cell integrals first, since it determines the pattern of matrices
    return [ufl.Form(own) for own in sorted(parts.values(), key=lambda own: all(i.integral_type() != "cell" for i in own))]


def parts_of(compiled: Any) -> list[Any]:
    """The compiled parts of a form."""
    return compiled if isinstance(compiled, list) else [compiled]


def _of_sensible_degree(F: ufl.Form) -> ufl.Form:
    """The form with quadrature rules of at most ``DEGREES_ENOUGH`` times the degree for quotients, logarithms and similar terms.

    Integrands that are no polynomials are never integrated exactly. On quadrilaterals and hexahedra UFL estimates 12 points in every
    direction for a neo-Hookean law at degree 1, and 22 at degree 2. Rules of 3 and 5 points have errors below 1e-6 at strains of 30 %.
    Hoop strains are quotients by a radius and are treated in the same way in all cells. Rules given in the measure are kept.
    """
    if not F.integrals():
        return F
    tensor = compat.cell_name(F.ufl_domain()) in ("quadrilateral", "hexahedron")
    if not tensor and not any(_has_hoop_strains(i.integrand()) for i in F.integrals_by_type("cell")):
        return F
    spaces = [f.ufl_function_space() for f in (*F.coefficients(), *F.arguments())]
    degree = int(DEGREES_ENOUGH * max(map(compat.highest_degree, spaces), default=0))
    integrals = []
    for integral in F.integrals():
        if integral.integral_type() == "cell" and not any(key.startswith("quadrature") for key in integral.metadata()):
            integrand = expand_derivatives(apply_algebra_lowering(integral.integrand()))
            smooth = not _has_hoop_strains(integrand) and _is_polynomial(integrand)
            if not smooth and estimate_total_polynomial_degree(integrand) > degree:
                integral = integral.reconstruct(metadata={**integral.metadata(), "quadrature_degree": degree})
        integrals.append(integral)
    return ufl.Form(integrals)


def _has_hoop_strains(integrand: Any) -> bool:
    """Whether an expression divides by a coordinate."""
    quotients = (part.ufl_operands[1] for part in unique_pre_traversal(integrand) if isinstance(part, Division))
    return any(isinstance(below.ufl_operands[0], ufl.SpatialCoordinate) for below in quotients if isinstance(below, Indexed))


def _is_polynomial(integrand: Any) -> bool:
    """Whether an expression of scalars and components is a polynomial of its Functions."""

    def varies(part: Any) -> bool:
        functions = (f for f in traverse_unique_terminals(part) if isinstance(f, ufl.Coefficient))
        return any(compat.highest_degree(f.ufl_function_space()) for f in functions)

    for part in unique_pre_traversal(integrand):
        below = part.ufl_operands[1] if isinstance(part, Division) else part if isinstance(part, MathFunction) else None
        if isinstance(part, Power) and not isinstance(part.ufl_operands[1], IntValue):
            below = part.ufl_operands[0]
        if below is not None and varies(below):
            return False
    return True


def _of_one_subdomain_data(F: ufl.Form) -> ufl.Form:
    """The form with the same tags for all integrals of a kind, as UFL requires (collective).

    Integrals over the whole mesh, without tags, get them as well: DOLFINx 0.9 treats them as a separate kind otherwise.
    """
    if all(i.subdomain_data() is None for i in F.integrals()):
        return F
    integrals = []
    for kind in dict.fromkeys(i.integral_type() for i in F.integrals()):
        own = F.integrals_by_type(kind)
        data = list({id(d): d for i in own if (d := i.subdomain_data()) is not None}.values())
        if len(data) > 1 and all(hasattr(d, "indices") for d in data):
            own, data = _of_common_tags(F, own)
        integrals += [i.reconstruct(subdomain_data=data[0]) if i.subdomain_data() is None and data else i for i in own]
    return ufl.Form(integrals)


def _of_common_tags(F: ufl.Form, integrals: Sequence[Any]) -> tuple[list[Any], list[Any]]:
    """Integrals of one kind with common MeshTags that number every overlap of their own MeshTags (collective)."""
    of = [[(i.subdomain_data(), n) for n in np.ravel(i.subdomain_id()) if n != "everywhere"] for i in integrals]
    pairs = list({(id(d), int(n)): (d, int(n)) for own in of for d, n in own}.values())
    entities = np.unique(np.concatenate([d.indices for d, _ in pairs]))
    within = np.stack([np.isin(entities, d.indices[d.values == n]) for d, n in pairs], axis=1)
    rows, which = np.unique(within, axis=0, return_inverse=True)
    cpp_mesh = F.ufl_domain().ufl_cargo()
    known = sorted({tuple(row) for part in cpp_mesh.comm.allgather(rows.tolist()) for row in part})
    numbers = np.array([known.index(tuple(row)) + 1 for row in rows.tolist()], dtype=np.int32)
    # attributes of the mesh that DOLFINx 0.5 and newer versions use
    domain = SimpleNamespace(_mesh=cpp_mesh, topology=SimpleNamespace(_cpp_object=cpp_mesh.topology))
    tags = mesh.meshtags(domain, pairs[0][0].dim, entities, numbers[which.ravel()] if len(entities) else numbers)
    column = {(id(d), n): k for k, (d, n) in enumerate(pairs)}
    out = []
    for integral, own in zip(integrals, of):
        columns = [column[id(d), int(n)] for d, n in own]
        ids = tuple(j for j, row in enumerate(known, 1) if any(row[k] for k in columns)) or (len(known) + 1,)
        out.append(integral.reconstruct(subdomain_data=tags, subdomain_id=ids if own else "everywhere"))
    return out, [tags]


def interpolation(u: Any, expression: Any) -> Callable[[], None]:
    """A UFL expression compiled to be interpolated into a Function of a Lagrange, DG or quadrature space.

    Returns:
        Function without arguments that interpolates its present values, ghosts included (collective).
    """
    V = u.function_space
    domain = V.mesh
    if not ufl.domain.extract_domains(expression):
        expression = ufl.as_ufl(expression) * fem.Constant(domain, 1.0)
    family, degree = compat.element_family(V) or ("", 0)
    at_points = family == "Quadrature"
    points = quadrature_rule(compat.cell_name(domain), degree)[0] if at_points else compat.interpolation_points(V)
    compiled = compat.compile_expression(expression, points)

    def interpolate() -> None:
        if at_points:
            cells = compat.all_cells(domain)
            if len(cells):
                values = u.x.array.reshape(-1, V.dofmap.bs)
                values[compat.cell_dofs(V)] = compat.evaluate(compiled, domain, cells)
        else:
            compat.interpolate_compiled(u, compiled)
        u.x.scatter_forward()

    return interpolate


def create_matrix(a: Any) -> PETSc.Mat:
    """Matrix without values, with the layout, block size and sparsity of a compiled bilinear form on all cells."""
    return compat.petsc_forms().create_matrix(parts_of(a)[0])


def assemble_matrix(A: PETSc.Mat, a: Any) -> None:
    """Assemble a compiled bilinear form into a matrix, zeroed first, without boundary conditions (collective)."""
    A.zeroEntries()
    for part in parts_of(a):
        compat.petsc_forms().assemble_matrix(A, part, [])
    A.assemble()


def assemble_vector(b: PETSc.Vec, L: Any) -> None:
    """Assemble a compiled linear form into a ghosted vector, zeroed first (collective).

    Ghost contributions are added to their owners; the ghost entries themselves are left unspecified.
    """
    with b.localForm() as local:
        local.set(0.0)
    for part in parts_of(L):
        compat.petsc_forms().assemble_vector(b, part)
    b.ghostUpdate(addv=PETSc.InsertMode.ADD, mode=PETSc.ScatterMode.REVERSE)


def assemble_array(V: Any, L: Any) -> npt.NDArray[np.float64]:
    """Owned entries ``(n_owned * block size,)`` of a compiled linear form in a space (collective)."""
    b = compat.create_vector(V)
    assemble_vector(b, L)
    values = np.array(b.array_r)
    b.destroy()
    return values


def assemble_scalar(M: Any, comm: MPI.Comm) -> float:
    """Sum of a compiled functional over all ranks of a communicator, known to all of them (collective)."""
    return float(reduced(comm, sum([fem.assemble_scalar(part) for part in parts_of(M)]), op=MPI.SUM))


class Vector(PETSc.Vec):
    """A vector that frees its memory when it is dropped, as its duplicates and copies do.

    petsc4py keeps others as garbage until ``free_petsc_garbage``. Nothing is communicated: its communicator is in use elsewhere.
    """

    __del__ = PETSc.Vec.destroy


def product(A: PETSc.Mat, x: PETSc.Vec, G: PETSc.Mat | None = None) -> PETSc.Vec:
    """``(A + G) x`` of square matrices; G may be None (collective).

    The vector has the layout of ``x``. For ``A * x`` petsc4py would make a new layout, with two more collective calls.
    """
    y = x.duplicate()
    A.mult(x, y)
    if G is not None:
        y.axpy(1.0, product(G, x))
    return y


def solve_mass(M: PETSc.Mat, rhs: PETSc.Vec, nothing: float, rtol: float, symmetric: bool = True) -> tuple[PETSc.Vec, int]:
    """``M^-1 rhs`` of a mass matrix by CG, zero where its diagonal is at most this part of the largest entry (collective).

    Rows without mass become rows of the identity; GMRES solves for what is not ``symmetric``. Returns the solution, and KSP's reason to
    stop, negative without convergence.
    """
    diagonal = M.getDiagonal()
    massless = diagonal.array_r <= nothing * diagonal.max()[1]
    diagonal.array[massless], rhs.array[massless] = 1.0, 0.0
    M.setDiagonal(diagonal)
    ksp = PETSc.KSP().create(M.comm)
    ksp.setType("cg" if symmetric else "gmres")
    ksp.getPC().setType("jacobi")
    ksp.setTolerances(rtol=rtol, max_it=10_000)
    ksp.setOperators(M)
    x = rhs.duplicate()
    ksp.solve(rhs, x)
    return x, int(ksp.getConvergedReason())


def free_petsc_garbage(comm: MPI.Comm) -> None:
    """Free the PETSc objects that Python has released; PETSc keeps them until then (collective)."""
    PETSc.garbage_cleanup(comm)


def values_of(m: fem.Constant | fem.Function) -> Any:
    """Values of a Constant, or of a Function with its ghosts (a view)."""
    return m.x.array if isinstance(m, fem.Function) else m.value


def read_values(inputs: Sequence[fem.Constant | fem.Function], before: list[Any] | None) -> tuple[list[Any], bool]:
    """Copies of the values of Constants and Functions, and whether they are those of ``before`` on this rank."""
    values = [np.array(values_of(one)) for one in inputs]
    return values, before is not None and all(np.array_equal(*pair) for pair in zip(values, before))


def in_all_cells(F: ufl.Form, u: fem.Function, laws: bool = False) -> ufl.Form:
    """A residual with a zero term in all cells, so that the sparsity of the tangent includes every diagonal entry.

    Args:
        F: residual; unchanged if it does not depend on u.
        u: unknowns.
        laws: whether it also depends on u by laws with history.
    """
    of_u = [i for i in F.integrals() if any(part is u for part in traverse_unique_terminals(i.integrand()))]
    some = of_u or (F.integrals() if laws else [])
    if not some or any(i.integral_type() == "cell" and i.subdomain_id() == "everywhere" for i in some):
        return F
    nothing = fem.Constant(u.function_space.mesh, 0.0)
    return F + nothing * ufl.inner(u, F.arguments()[0]) * ufl.dx(u.function_space.mesh)


def with_diagonal(J: ufl.Form, mixed: bool) -> ufl.Form:
    """A bilinear form with a zero term in all cells, so that its sparsity includes every diagonal entry; a mixed one as it is."""
    v, du = J.arguments()
    domain = v.ufl_function_space().mesh
    return J if mixed else fem.Constant(domain, 0.0) * ufl.inner(du, v) * ufl.dx(domain) + J
