"""Every bad input has its named error, on every rank, with a message that names the thing and the remedy; nothing is lost."""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, blocks, box, clamp, linear, modulus, raised, run, scene, slow, st_venant
from petsc4py import PETSc

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.parallel import agree

COMM = MPI.COMM_WORLD


def problem_of(b, *contacts, F=None, **options):
    F = linear(b.u, fem.Constant(b.scene.mesh, PETSc.ScalarType(1.0))) if F is None else F
    return uem.UnitedProblem(F, b.u, bcs=options.pop("bcs", clamp(b.V, b.bottom)), contacts=contacts, **options)


def test_agree_raises_the_first_error_on_all_ranks():
    error = uem.SurfaceError(f"from rank {COMM.rank}") if COMM.rank == COMM.size - 1 else None
    raised(uem.SurfaceError, f"from rank {COMM.size - 1}", lambda: agree(COMM, error))
    agree(COMM, None)


# -- surfaces ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("role", ["contactor", "target"])
def test_empty_tag(role):
    b = blocks(COMM, "triangle", 2, 2)
    nothing = uem.Tag("nothing", 9, 1, b.scene.mesh, np.zeros(0, np.int32))
    pair = (nothing, b.low) if role == "contactor" else (b.high, nothing)
    raised(uem.TagError, f"{role} '+nothing'+ holds no facets", lambda: problem_of(b, uem.Contact(*pair)))


def test_tag_of_cells():
    b = blocks(COMM, "triangle", 2, 2)
    cells = uem.Tag("body", 1, 2, b.scene.mesh, np.arange(2, dtype=np.int32))
    raised(uem.TagError, "dimension 2.*expected facets, dimension 1", lambda: problem_of(b, uem.Contact(cells, b.low)))


def test_tag_of_another_mesh():
    b, other = blocks(COMM, "triangle", 2, 2), blocks(COMM, "triangle", 2, 2)
    raised(uem.SpaceError, "another mesh", lambda: problem_of(b, uem.Contact(b.high, other.low)))
    raised(uem.SpaceError, "another mesh", lambda: problem_of(b, uem.Contact(other.high, b.low)))


def test_contactor_is_its_own_target():
    b = blocks(COMM, "tetrahedron", 2, 2)
    raised(uem.SurfaceError, "share the node at", lambda: problem_of(b, uem.Contact(b.high, b.high)))


def test_contactor_touches_its_target_in_one_node():
    b = blocks(COMM, "triangle", 2, 2)
    side = b.scene.tag("side", 0, at(0, 0.0))
    error = raised(uem.SurfaceError, "share the node at", lambda: problem_of(b, uem.Contact(side, b.low)))
    assert "'side'" in str(error) and "'low'" in str(error)


@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_target_between_two_cells(cell):
    """A surface inside a body, as of bodies meshed together, has no outside."""
    g = 2 if cell == "triangle" else 3
    s = scene(
        COMM,
        cell,
        [box(cell, [0.0] * g, [1.0] * g, [2] * g), box(cell, [0.0] * (g - 1) + [1.5], [1.0] * (g - 1) + [2.5], [2] * g)],
    )
    V = compat.function_space(s.mesh, 1, (g,))
    u = fem.Function(V)
    inside, high = s.tag("inside", 0, at(g - 1, 0.5)), s.tag("high", 1, at(g - 1, 1.5))
    F = linear(u, fem.Constant(s.mesh, PETSc.ScalarType(1.0)))
    raised(
        uem.OrientationError, "'inside'.*between two cells", lambda: uem.UnitedProblem(F, u, contacts=[uem.Contact(high, inside)])
    )


@pytest.mark.parametrize(
    ("cell", "body", "coupling"),
    [
        ("triangle", 0, "mortar"), ("triangle", 1, "node_to_surface"), ("quadrilateral", 1, "mortar"),
        ("tetrahedron", 1, "node_to_surface"), slow("hexahedron", 0, "node_to_surface"),
    ],
)  # fmt: skip
def test_degenerate_facets(cell, body, coupling):
    """A facet of either side whose nodes have been moved onto each other is named; without contact the flat cell is."""
    b = blocks(COMM, cell, 2, 2)
    g, x, own = b.gdim, b.scene.mesh.geometry.x, np.unique(compat.geometry_dofs(b.scene.mesh)[b.scene.body == body])
    x[own[(np.abs(x[own, g - 1]) < 1e-9) & (x[own, 0] < 0.6)], 0] = 0.0
    words = "a facet without length" if g == 2 else "a facet without area"
    contact = uem.Contact(b.high, b.low, coupling=coupling)
    error = uem.SurfaceError
    if (cell, body, coupling) == ("triangle", 1, "node_to_surface"):
        # nodes alone do not show their facets
        error, words = uem.MeshError, "the cell of the mesh at .* is flat"
    raised(error, f"{words}.*mend the mesh", lambda: problem_of(b, contact).solve())
    if cell in ("triangle", "tetrahedron"):
        alone = uem.UnitedProblem(linear(b.u, 1.0), b.u, bcs=[*clamp(b.V, b.bottom), *clamp(b.V, b.top)])
        raised(uem.MeshError, "the cell of the mesh at .* is flat", alone.solve)


def test_contact_before_its_problem():
    b = blocks(COMM, "triangle", 2, 2)
    raised(uem.SurfaceError, "belongs to no problem yet", lambda: uem.Contact(b.high, b.low).resultant())


@pytest.mark.parametrize("option,value", [("sliding", "infinite"), ("normals", "smooth")])
def test_unknown_word(option, value):
    b = blocks(COMM, "triangle", 2, 2)
    with pytest.raises(ValueError, match=f"'{value}'.*expected one of"):
        uem.Contact(b.high, b.low, **{option: value})


def test_unknown_newton():
    b = blocks(COMM, "triangle", 2, 2)
    with pytest.raises(ValueError, match="'quasi'.*'full' or 'modified'"):
        problem_of(b, newton="quasi")


def test_rigid_direction_without_length():
    with pytest.raises(ValueError, match="non-zero"):
        uem.RigidPlane((0.0, 0.0), (0.0, 0.0))


# -- space -------------------------------------------------------------------------------------------------------------


def test_three_components_in_the_plane():
    b = blocks(COMM, "triangle", 2, 2)
    u = fem.Function(compat.function_space(b.scene.mesh, 1, (3,)))
    v = ufl.TestFunction(u.function_space)
    raised(uem.SpaceError, "3 component.*size 2", lambda: uem.UnitedProblem(ufl.inner(u, v) * ufl.dx, u))


def test_surface_in_space():
    """A mesh of triangles in 3D has no inside."""
    flat = box("triangle", [0.0, 0.0], [1.0, 1.0], [2, 2])
    s = scene(COMM, "triangle", [flat.mapped(lambda x: np.column_stack([x, 0 * x[:, 0]]))])
    u = fem.Function(compat.function_space(s.mesh, 1, (3,)))
    F = ufl.inner(ufl.grad(u), ufl.grad(ufl.TestFunction(u.function_space))) * ufl.dx
    raised(uem.SpaceError, "dimension 2 in 3D", lambda: uem.UnitedProblem(F, u))


def test_cubic_displacement():
    b = blocks(COMM, "triangle", 2, 2, degree=3)
    raised(uem.SpaceError, "degree 3.*degree 1 or 2", lambda: problem_of(b))


def test_residual_without_the_displacement():
    b = blocks(COMM, "triangle", 2, 2)
    other = fem.Function(b.V)
    F = linear(other, fem.Constant(b.scene.mesh, PETSc.ScalarType(1.0)))
    raised(uem.SpaceError, "does not depend on u", lambda: uem.UnitedProblem(F, b.u))


# -- initial penetration -----------------------------------------------------------------------------------------------


def test_initial_penetration_beyond_the_bound():
    b = blocks(COMM, "triangle", 2, 4, gap=-0.02, overhang=0.25)
    error = raised(
        uem.PenetrationError,
        "0.02 inside the target.*max_penetration = 0.01",
        lambda: problem_of(b, uem.Contact(b.high, b.low, max_penetration=0.01)),
    )
    assert "high on low" in str(error)


def test_initial_penetration_below_the_bound_is_resolved(caplog):
    """An interference fit: the overlap is reported, becomes pressure, and the gap is closed."""
    b = blocks(COMM, "quadrilateral", 2, 4, gap=-0.02)
    bcs = b.oedometer(0.0)
    contact = uem.Contact(b.high, b.low, max_penetration=0.03)
    problem = problem_of(b, contact, F=linear(b.u, modulus(b.scene, 1.0, 1.0)), bcs=bcs)
    run(problem)
    M = 0.7 / (1.3 * 0.4)
    assert contact.resultant().force[1] == pytest.approx(M * 0.01, rel=1e-9)
    assert contact.max_gap() < 1e-15
    assert contact.initial_overlap == pytest.approx(0.02)
    assert COMM.rank or "5 contactors start up to 0.02 inside the target" in caplog.text


def test_deep_default_bound():
    """Without a bound of one's own it is 5 % of the model's size."""
    b = blocks(COMM, "triangle", 2, 4, gap=-0.3, overhang=0.25)
    raised(uem.PenetrationError, "0.3 inside", lambda: problem_of(b, uem.Contact(b.high, b.low)))


# -- the loop ----------------------------------------------------------------------------------------------------------


def test_nan_in_the_residual():
    b = blocks(COMM, "triangle", 2, 4)
    E = modulus(b.scene, 1.0, 1.0)
    # one cell of the last rank only
    if COMM.rank == COMM.size - 1:
        E.x.array[0] = np.nan
    problem = problem_of(b, uem.Contact(b.high, b.low), F=linear(b.u, E), bcs=b.oedometer(0.01))
    raised(uem.NotFiniteError, "not finite", lambda: problem.solve())
    assert not b.u.x.array.any()


def test_nan_in_the_displacement():
    """A start that is not finite on one rank is named on all; with another start the problem is solved."""
    b = blocks(COMM, "triangle", 2, 4)
    problem = problem_of(b, uem.Contact(b.high, b.low), bcs=b.oedometer(0.01))
    if COMM.rank == COMM.size - 1:
        b.u.x.array[0] = np.nan
    raised(uem.NotFiniteError, "before the step", problem.solve)
    b.u.x.array[:] = 0.0
    problem.solve()
    assert np.isfinite(b.u.x.array).all() and problem.contacts[0].n_active > 0


def test_residual_that_becomes_infinite():
    """A load that is defined up to a displacement only: cut, in the end refused, and the last good state kept."""
    b = blocks(COMM, "triangle", 2, 4)
    barrier = fem.Constant(b.scene.mesh, PETSc.ScalarType(1e-6))
    v = ufl.TestFunction(b.V)
    wall = barrier * ufl.ln(0.005 + b.u[1]) * v[1] * forms.surface_measure(b.scene.mesh, b.top.entities)
    problem = problem_of(
        b,
        uem.Contact(b.high, b.low),
        F=st_venant(b.u, modulus(b.scene, 1.0, 1.0)) + wall,
        bcs=b.oedometer(0.01),
        max_iterations=10,
    )
    reached = 0.0

    def load():
        nonlocal reached
        for step in uem.load_steps(problem, 2):
            reached = step.factor

    with pytest.raises((uem.NotFiniteError, uem.ConvergenceError)):
        load()
    assert 0.4 < reached < 0.51
    assert np.isfinite(b.u.x.array).all()
    top = b.scene.gather(b.u)[np.abs(b.scene.drawing[:, 1] - 1.0) < 1e-9, 1]
    assert np.allclose(top, -0.01 * reached)


def test_inverted_element():
    """A prescribed displacement that turns cells inside out is named with its place, and taken back."""
    b = blocks(COMM, "triangle", 2, 4)
    problem = problem_of(
        b, uem.Contact(b.high, b.low), F=st_venant(b.u, modulus(b.scene, 1.0, 1.0)), bcs=b.oedometer(2.5), line_search=False
    )
    raised(uem.InvertedElementError, r"cell at \[.*inside out", lambda: problem.solve())
    assert not b.u.x.array.any()


def test_no_convergence():
    b = blocks(COMM, "triangle", 2, 4)
    problem = problem_of(
        b, uem.Contact(b.high, b.low), F=st_venant(b.u, modulus(b.scene, 1.0, 3.0)), bcs=b.oedometer(0.2), max_iterations=2
    )
    error = raised(uem.ConvergenceError, "no convergence in 2 iterations.*smaller load steps", lambda: problem.solve())
    assert [i.active for i in error.history] == [5, 5, 5]
    assert error.history[-1].linear_iterations == 0 and error.history[-1].residual > 1e-8
    assert not b.u.x.array.any()


@pytest.mark.parametrize("target", ["rigid", "prescribed"])
def test_prescribed_normal_of_a_contactor(target):
    """A contactor that cannot move along the normal, against a target that cannot either."""
    b = blocks(COMM, "triangle", 2, 4)
    contact = uem.Contact(b.high, b.low if target == "prescribed" else uem.RigidPlane((0.0, 0.0), (0.0, 1.0)))
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.low, 1), *clamp(b.V, b.high, 1, value=-0.01)]
    raised(uem.ConflictError, "prescribed.*neither body can move", lambda: run(problem_of(b, contact, bcs=bcs)))


# -- backends ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "backend,options", [("hypre", {"pc_type": "hypre"}), ("mumps", {"pc_type": "lu", "pc_factor_mat_solver_type": "mumps"})]
)
def test_missing_backend(monkeypatch, backend, options):
    monkeypatch.setattr(f"uem_dolfinx.algebra.options.has_{backend}", lambda: False)
    b = blocks(COMM, "triangle", 2, 2)
    error = raised(uem.MissingBackendError, f"{backend}.*built without {backend}", lambda: problem_of(b, petsc_options=options))
    assert "use" in str(error)


def test_without_backends_a_default_is_found(monkeypatch):
    """Without MUMPS and hypre the default options still solve."""
    for backend in ("hypre", "mumps"):
        monkeypatch.setattr(f"uem_dolfinx.algebra.options.has_{backend}", lambda: False)
    if COMM.size > 1:
        monkeypatch.setattr("uem_dolfinx.algebra.options.DIRECT_UP_TO", {2: 0, 3: 0})
    b = blocks(COMM, "triangle", 2, 4)
    contact = uem.Contact(b.high, b.low)
    problem = problem_of(b, contact, bcs=b.oedometer(0.01))
    run(problem)
    assert contact.resultant().force[1] == pytest.approx(0.005 * 0.7 / (1.3 * 0.4), rel=1e-7)


def test_linear_solver_that_gives_up():
    b = blocks(COMM, "triangle", 2, 4)
    options = {"ksp_type": "cg", "pc_type": "none", "ksp_max_it": 2, "ksp_rtol": 1e-12}
    problem = problem_of(b, uem.Contact(b.high, b.low), bcs=b.oedometer(0.01), petsc_options=options)
    raised(uem.LinearSolveError, "cg.*KSP reason", lambda: problem.solve())
    assert not b.u.x.array.any()


def test_options_do_not_leak():
    """The options of one problem are not left in PETSc's database."""
    b = blocks(COMM, "triangle", 2, 2)
    problem_of(b, petsc_options_prefix="leak_", petsc_options={"ksp_type": "cg", "pc_type": "jacobi"})
    assert not any(name.startswith("leak_") for name in PETSc.Options().getAll())


def test_every_error_is_one_of_ours():
    for name in ("TagError", "SpaceError", "SurfaceError", "OrientationError", "PenetrationError", "ConflictError", "NotFiniteError",
                 "InvertedElementError", "MissingBackendError", "LinearSolveError", "ConvergenceError"):  # fmt: skip
        assert issubclass(getattr(uem, name), uem.UEMError)
    assert str(uem.TagError("plain words")) == "plain words"
