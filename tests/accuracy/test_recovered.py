"""Estimates by recovered stresses: against exact solutions, of every cell and law, and where patches end.

Read first: ``test_effectivity``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from benchmarks.signorini import signorini
from dolfinx import fem, mesh
from helpers import refused, slow
from ufl.algorithms import expand_derivatives

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.accuracy.recovered import MOST_VALUES, Recovered

COMM = MPI.COMM_WORLD


def grid(cell, n, comm=COMM):
    """A unit square or cube."""
    made = mesh.create_unit_cube if cell in ("tetrahedron", "hexahedron") else mesh.create_unit_square
    domain = made(comm, *[n] * (2 + (made is mesh.create_unit_cube)), getattr(mesh.CellType, cell))
    domain.topology.create_connectivity(domain.topology.dim - 1, domain.topology.dim)
    return domain


def held(V, value):
    """The condition that the outside moves as an expression says."""
    given, dim = fem.Function(V), V.mesh.topology.dim - 1
    forms.interpolation(given, value)()
    return fem.dirichletbc(given, fem.locate_dofs_topological(V, dim, mesh.exterior_facet_indices(V.mesh.topology)))


def made(cell, degree, n, law, displacement):
    """A problem with this solution, by forces on the body: the problem, and the energy of its error."""
    domain = grid(cell, n)
    g = domain.geometry.dim
    V = uem.function_space(domain, degree, (g,))
    u, v, w = fem.Function(V), ufl.TestFunction(V), ufl.TrialFunction(V)
    law = law(1.0, 0.3, kind="3d" if g == 3 else "plane_strain")
    exact = displacement(ufl.SpatialCoordinate(domain))
    force = ufl.inner(ufl.div(law.first_piola(exact)), v) * ufl.dx(metadata={"quadrature_degree": 2 * degree + 3})
    F = law.residual(u, v) * ufl.dx + force
    problem = uem.UnitedProblem(F, u, bcs=[held(V, exact)])
    list(uem.load_steps(problem, 1))
    away = ufl.grad(u - exact)
    J = expand_derivatives(ufl.derivative(law.residual(u, v), u, w))
    J = ufl.replace(J, {ufl.grad(v): away, ufl.grad(w): away})
    energy = forms.assemble_scalar(forms.form(J * ufl.dx(metadata={"quadrature_degree": 2 * degree + 3})), COMM)
    return problem, np.sqrt(energy), exact, law


def smooth(x):
    """A displacement with all strains."""
    third = [ufl.sin(x[0] * x[1] + x[2])] if len(x) == 3 else []
    return ufl.as_vector([ufl.sin(2 * x[0] + x[1]), ufl.cos(2 * x[0]) * ufl.exp(x[1]), *third])


def bent(x):
    """Strains of a half, and turns by up to 0.8."""
    a = 0.8 * x[0]
    across = 0.3 * ufl.sin(x[0]) * x[1] + 1.25 * ufl.sin(a) - x[0] - 0.5 * x[1] * ufl.sin(a)
    return ufl.as_vector([across, 0.3 * x[0] * x[1] ** 2 + (x[1] - 1.25) * (ufl.cos(a) - 1)])


KINDS = [("triangle", 1), ("quadrilateral", 1), ("triangle", 2), ("quadrilateral", 2)]


@pytest.mark.long
@pytest.mark.parametrize(
    "cell, degree, n",
    [(*kind, 8) for kind in KINDS]
    + [slow("tetrahedron", 1, 6), slow("hexahedron", 1, 6), slow("tetrahedron", 2, 4), slow("hexahedron", 2, 6)],
)
def test_effectivity(cell, degree, n):
    """Where the solution is smooth, estimates tend to the error, and the recovered stress is of a higher order than that of the cells."""
    errors = []
    for k in (n // 2, n):
        problem, energy, exact, law = made(cell, degree, k, uem.LinearElastic, smooth)
        found, stress = Recovered(problem), law.stress(exact)
        components = ufl.as_vector([stress[i, j] for i in range(len(exact)) for j in range(len(exact))])
        stress = found.points.evaluate(found.points.compile(components)).reshape(found.stress.shape)
        squares = (found.points.volumes[:, :, None] * (of - stress) ** 2 for of in (found.stress, found.recovered))
        errors.append([np.sqrt(COMM.allreduce(of.sum())) for of in squares])
    assert 0.93 < uem.error_estimate(problem, "recovery").total / energy < 1.15
    orders = np.log2(np.divide(*errors))
    assert abs(orders[0] - degree) < 0.1 and orders[1] > 1.3 * degree


@pytest.mark.slow
@pytest.mark.parametrize("cell, degree", [*KINDS[:3], slow(*KINDS[3])])
def test_large_strain(cell, degree):
    """The same of bodies that are bent and stretched: errors of the first Piola-Kirchhoff stress, without those of turns."""
    problem, energy, *_ = made(cell, degree, 8, uem.NeoHooke, bent)
    assert 0.9 < uem.error_estimate(problem, "recovery").total / energy < 1.2


@pytest.mark.parametrize("cell", ["triangle", "quadrilateral", slow("tetrahedron"), slow("hexahedron")])
def test_linear_stresses(cell):
    """Quadratic displacements have linear stresses, which are recovered exactly, and no error."""
    problem, *_ = made(cell, 2, 4, uem.LinearElastic, lambda x: ufl.as_vector([x[0] * x[i] - x[1] ** 2 for i in range(len(x))]))
    assert uem.error_estimate(problem, "recovery").relative < 1e-10
    found = Recovered(problem)
    assert np.allclose(found.stress, found.recovered, rtol=0, atol=1e-9)


@pytest.mark.long
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("degree, finer", [(1, 2.0), (2, 1.0), slow(1, 1.0), slow(2, 2.0)])
def test_contact(degree, finer, coupling):
    """Two half-planes that touch up to a point (Westergaard), where stresses have no second order."""
    ratios = []
    for n in (4, 8):
        s = signorini(n, degree=degree, finer=finer)
        tags = s.contact()
        contact = uem.Contact(tags.contactor, tags.target, coupling=coupling, sliding="fixed")
        problem = uem.UnitedProblem(s.F, s.u, bcs=s.bcs, contacts=[contact])
        steps = list(uem.load_steps(problem, 1))
        ratios.append(uem.error_estimate(problem, "recovery").relative / s.errors(problem, contact, steps)["error_energy"])
    low, high = (0.95, 1.0) if degree == 1 else (1.5, 1.65)
    assert low < min(ratios) and max(ratios) < high


def tube(cell, degree, n, law, steps=4):
    """A thick tube held at its ends, axisymmetric, under an inner pressure of 0.65; its radii are 1 and 2."""
    domain = uem.axisymmetric(mesh.create_rectangle(COMM, [[1.0, 0.0], [2.0, 0.5]], [2 * n, n], getattr(mesh.CellType, cell)))
    V = uem.function_space(domain, degree, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    inside, ends = (
        mesh.locate_entities_boundary(domain, 1, where)
        for where in (lambda x: np.isclose(x[0], 1.0), lambda x: np.isclose(x[1] % 0.5, 0.0))
    )
    bc = fem.dirichletbc(np.array(0.0), fem.locate_dofs_topological(V.sub(1), 1, ends), V.sub(1))
    materials = [law(u, 1000.0, 0.3, 1.0, 10.0, kind="axisymmetric")] if issubclass(law, uem.VonMises) else []
    F = materials[0].residual(v) if materials else law(1000.0, 0.3, kind="axisymmetric").residual(u, v) * ufl.dx
    F -= 0.65 * v[0] * forms.surface_measure(domain, inside)
    problem = uem.UnitedProblem(F, u, bcs=[bc], materials=materials)
    list(uem.load_steps(problem, steps))
    return problem


def by_radius(found):
    """Radii of the points of all ranks, ascending ``(n,)``, and the recovered stress there ``(n, 5)``."""
    r = found.points.evaluate(found.points.compile(ufl.SpatialCoordinate(found.mesh)))[:, :1]
    rows = np.concatenate(COMM.allgather(np.column_stack([r, found.recovered.reshape(-1, 5)])))
    return rows[np.argsort(rows[:, 0])]


@pytest.mark.slow
@pytest.mark.parametrize("law", [uem.LinearElastic, uem.VonMises, slow(uem.FinitePlasticity)])
@pytest.mark.parametrize(
    "cell, degree, band",
    [("quadrilateral", 1, (0.9, 1.05)), slow("quadrilateral", 2, (0.9, 2.3)), slow("triangle", 2, (0.9, 1.7))],
)
def test_tube(cell, degree, band, law):
    """Lame's stresses, and those of a tube that yields to half of its thickness, of a fine mesh: errors of stresses."""
    fine = by_radius(Recovered(tube("quadrilateral", 2, 12, law)))
    if law is uem.LinearElastic:
        a = 0.65 / 3
        assert np.allclose(fine[:, 1], a * (1 - 4 / fine[:, 0] ** 2), atol=2e-3 * a)
        assert np.allclose(fine[:, 5], a * (1 + 4 / fine[:, 0] ** 2), atol=2e-3 * a)
    for n in (2, 4):
        found = Recovered(tube(cell, degree, n, law))
        estimate = COMM.allreduce(found.energies().sum())
        r = found.points.evaluate(found.points.compile(ufl.SpatialCoordinate(found.mesh)))[:, 0]
        exact = np.column_stack([np.interp(r, fine[:, 0], fine[:, k]) for k in range(1, 6)])
        found.recovered = exact.reshape(found.stress.shape)
        assert band[0] < np.sqrt(estimate / COMM.allreduce(found.energies().sum())) < band[1]


def column(how, comm=COMM, scale=1.0, n=6):
    """A bar pulled along y, of which the left half is ten times as stiff: strains are the same, stresses jump."""
    domain = grid("quadrilateral", n, comm)
    domain.geometry.x[:] *= scale
    V = uem.function_space(domain, 2, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    middles = domain.geometry.x[compat.geometry_dofs(domain)].mean(axis=1) / scale
    left = (middles[:, 0] < 0.5).astype(np.int32)
    E = fem.Function(compat.function_space(domain, ("DG", 0)))
    E.x.array[:] = 1.0 + 9.0 * left
    laws, materials = [uem.LinearElastic(one, 0.0, kind="plane_strain").residual(u, v) for one in (E, 1.0, 10.0)], []
    if how == "function":
        F = laws[0] * ufl.dx
    elif how == "tags":
        dx = ufl.Measure("dx", domain=domain, subdomain_data=forms.mesh_tags(domain, 2, np.arange(len(left)), left))
        F = laws[1] * dx(0) + laws[2] * dx(1)
    elif how == "material":
        cells = [np.flatnonzero(left == k).astype(np.int32) for k in range(2)]
        parts = [forms.mesh_tags(domain, 2, one, 1) for one in cells]
        materials = [uem.VonMises(u, 10.0**k, 0.0, np.inf, kind="plane_stress", cells=(parts[k], 1)) for k in range(2)]
        F = materials[0].residual(v) + materials[1].residual(v)
    else:
        # more values than MOST_VALUES: a field
        assert n**2 > MOST_VALUES
        E.x.array[:] = 1.0 + middles @ [1.0, 0.37, 0.0]
        F = laws[0] * ufl.dx
    x = ufl.SpatialCoordinate(domain)
    load = [0.01 * x[1] ** 2 / scale, 0.01 * x[0] * x[1] / scale] if how == "field" else [0.0 * x[0], 0.01 * x[1]]
    problem = uem.UnitedProblem(F, u, bcs=[held(V, ufl.as_vector(load))], materials=materials)
    problem.solve()
    return problem


@pytest.mark.long
@pytest.mark.parametrize("how", ["function", slow("tags"), slow("material")])
def test_laws_that_jump(how):
    """Patches end where the law does: a stress that jumps there has no error."""
    estimate = uem.error_estimate(column(how), "recovery")
    assert estimate.norm > 0 and estimate.relative < 1e-9


def test_units_and_partitions():
    """Estimates do not depend on units or on the number of ranks, and those of a field are not zero."""
    one, other, alone = (
        uem.error_estimate(column("field", *how), "recovery") for how in ((COMM,), (COMM, 1e-6), (MPI.COMM_SELF,))
    )
    assert one.relative > 1e-3 and np.isclose(one.relative, other.relative, rtol=1e-8)
    assert np.isclose(one.relative, alone.relative, rtol=1e-8)
    assert np.isclose(COMM.allreduce(one.shares.sum()), one.total**2, rtol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("kappa", [1e4, slow(10.0)])
def test_pressure_as_a_field(kappa):
    """A displacement with a pressure (Taylor-Hood), which hardly changes its volume or does: stresses include the pressure."""
    domain = grid("triangle", 8)
    W = uem.function_space(domain, [("Lagrange", 2, (2,)), ("Lagrange", 1)])
    w, (v, q), x = fem.Function(W), ufl.TestFunctions(W), ufl.SpatialCoordinate(domain)
    u, p = ufl.split(w)
    exact = ufl.as_vector([-1.5 * ufl.sin(2 * x[0]) * ufl.sin(1.5 * x[1]), -2 * ufl.cos(2 * x[0]) * ufl.cos(1.5 * x[1])])
    pressure = ufl.sin(3 * x[0] + x[1])
    force = ufl.div(2 * ufl.sym(ufl.grad(exact)) + pressure * ufl.Identity(2))
    F = ufl.inner(2 * ufl.sym(ufl.grad(u)) + p * ufl.Identity(2), ufl.grad(v)) * ufl.dx + ufl.inner(force, v) * ufl.dx
    F += q * (ufl.div(u) - (p - pressure) / kappa) * ufl.dx
    V, _ = W.sub(0).collapse()
    value = fem.Function(V)
    forms.interpolation(value, exact)()
    dofs = fem.locate_dofs_topological((W.sub(0), V), 1, mesh.exterior_facet_indices(domain.topology))
    problem = uem.UnitedProblem(F, w, bcs=[fem.dirichletbc(value, dofs, W.sub(0))], displacement=0)
    problem.solve()
    e = ufl.sym(ufl.grad(u - exact))
    square = forms.form((2 * ufl.inner(e, e) + (p - pressure) ** 2 / kappa) * ufl.dx(metadata={"quadrature_degree": 8}))
    assert 0.75 < uem.error_estimate(problem, "recovery").total / np.sqrt(forms.assemble_scalar(square, COMM)) < 1.0
    refused(uem.InputError, ["other fields", "recovery"], lambda: uem.error_estimate(problem))


@pytest.mark.slow
def test_steps_and_meshes():
    """Bounds on steps and meshes that follow the error take the same estimate; so do bodies with a mass."""

    def made(size):
        domain, tags = uem.read_gmsh(uem.example_mesh("adapt_punch"), COMM, gdim=2, parameters={"h": 0.5}, size=size)
        V = uem.function_space(domain, 2, (2,))
        u, v = fem.Function(V), ufl.TestFunction(V)
        F = uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
        bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["bottom"], 1, 0.01)]
        contact = uem.Contact(tags["under_punch"], uem.RigidPlane((0.0, 0.0), (0.0, -1.0)))
        return uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])

    limit = uem.ErrorLimit(0.9, by="recovery")
    found = uem.adapt(made, tolerance=0.05, by="recovery", solve=lambda one: list(uem.load_steps(one, 1, estimate=limit)))
    assert found.reached and found.estimate.relative < 0.05 and len(found.meshes) > 1
    assert limit.found == [pytest.approx(one.estimate) for one in found.meshes]
    refused(uem.InputError, "goal", lambda: uem.adapt(made, tolerance=0.05, by="recovery", goal=lambda one: one.u[0] * ufl.dx))
    refused(uem.InputError, ["by", "recovery"], lambda: uem.ErrorLimit(0.1, by="recovered"))


@pytest.mark.long
def test_few_cells():
    """One layer of cells does not determine how stresses change across it: refused on all ranks."""
    domain = mesh.create_rectangle(COMM, [[0.0, 0.0], [4.0, 1.0]], [8, 1], mesh.CellType.quadrilateral)
    domain.topology.create_connectivity(1, 2)
    V = uem.function_space(domain, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    problem = uem.UnitedProblem(
        F, u, bcs=[held(V, ufl.SpatialCoordinate(domain))], dynamics=uem.Dynamics(uem.lumped_mass(V, 1.0))
    )
    refused(uem.InputError, "no step", lambda: uem.error_estimate(problem, "recovery"))
    problem.progress.steps = 1
    refused(uem.InputError, ["inertia", "recovery"], lambda: uem.error_estimate(problem))
    refused(uem.InputError, ["too few cells", "refine"], lambda: uem.error_estimate(problem, "recovery"))
