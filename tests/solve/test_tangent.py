"""The consistent tangent against central differences: of one gap, of the united residual, and by the order of Newton's convergence.

Two tests to read first: ``test_united_tangent_is_the_derivative_of_the_residual`` and ``test_order_of_convergence``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import at, blocks, box, clamp, gathered_matrix, modulus, run, scene, slow, st_venant, tangent_by_differences

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.geometry.configuration import Configuration
from uem_dolfinx.geometry.facets import TargetFacets
from uem_dolfinx.geometry.search import MeshTarget

COMM = MPI.COMM_WORLD


def bumpy_top(cell, degree):
    """Curved top of a box on this rank alone, as a target."""
    g = 2 if cell in ("triangle", "quadrilateral") else 3

    def bump(x):
        y = x.copy()
        y[:, -1] += 0.15 * x[:, -1] * np.sin(3 * x[:, 0] + 1) * np.cos(2 * x[:, g - 2])
        return y

    s = scene(MPI.COMM_SELF, cell, [box(cell, [0.0] * g, [1.0] * g, [2] * g)], pose=bump)
    u = fem.Function(compat.function_space(s.mesh, degree, (g,)))
    u.x.array[:] = 0.02 * np.random.default_rng(0).normal(size=len(u.x.array))
    config = Configuration(u)
    return config, MeshTarget(TargetFacets(config, s.tag("top", 0, at(g - 1, 1.0))))


@pytest.mark.parametrize("height", [0.0, 0.1, -0.05])
@pytest.mark.parametrize(
    "cell,degree",
    [
        ("triangle", 1),
        ("triangle", 2),
        ("tetrahedron", 1),
        pytest.param("tetrahedron", 2, marks=pytest.mark.slow),
        ("hexahedron", 1),
        ("hexahedron", 2),
    ],
)
def test_gap_derivatives_on_a_facet(cell, degree, height):
    """First and second derivative of the gap, projected anew at every displaced configuration."""
    config, target = bumpy_top(cell, degree)
    g = config.gdim
    # feet well inside their facets
    x, f = config.x[target.facets.dofs], target.facets
    xi = np.tile(0.4 * f.shape.middle + 0.25, (len(x), 1)) if f.shape.cell != "triangle" else np.tile([0.27, 0.38], (len(x), 1))
    tab = f.shape.tabulate(xi)
    foot = np.einsum("na,nag->ng", tab.N, x)
    points = foot + height * target.project(foot).normal
    p = target.project(points)
    assert np.abs(p.gap - height).max() < 1e-12

    def gradients(i=slice(None)):
        now = target.project(points[i])
        assert np.array_equal(now.facet, p.facet[i])
        # with respect to the point, then to the facet's nodes
        return now.gap, np.concatenate([now.normal[:, None], -now.weights[:, :, None] * now.normal[:, None]], axis=1)

    H, h = p.hessians(np.arange(len(points))), 1e-6
    assert np.abs(H - H.transpose(0, 2, 1)).max() < 1e-12
    u = config.displacement
    gap, gradient = gradients()
    for i in (0, len(points) - 1):
        for k in range(1 + p.weights.shape[1]):
            for c in range(g):
                values = []
                for step in (h, -h):
                    where = (points, i) if k == 0 else (u, f.dofs[p.facet[i], k - 1])
                    before = where[0][where[1], c]
                    where[0][where[1], c] = before + step
                    values.append([v[0].copy() for v in gradients(slice(i, i + 1))])
                    where[0][where[1], c] = before
                first = (values[0][0] - values[1][0]) / (2 * h)
                second = (values[0][1] - values[1][1]).ravel() / (2 * h)
                assert abs(first - gradient[i, k, c]) < 1e-8
                assert np.abs(second - H[i, k * g + c]).max() < 1e-7 * max(1.0, np.abs(H).max())


def surfaces_3d():
    shift = np.array([0.1, -0.2, 0.3])
    return {
        "plane": uem.RigidPlane(shift, (1, 2, 3)),
        "sphere": uem.RigidSphere(shift, 0.8),
        "hollow sphere": uem.RigidSphere(shift, 3.0, inside=True),
        "cylinder": uem.RigidCylinder(shift, (1, -1, 2), 0.5),
        "hollow cylinder": uem.RigidCylinder(shift, (1, -1, 2), 2.0, inside=True),
        "paraboloid": uem.RigidParaboloid(shift, (1, 1, -1), 0.7),
        "wave": uem.RigidSurface(
            lambda x: x[:, 2] - 0.1 * np.sin(3 * x[:, 0]),
            lambda x: np.column_stack([-0.3 * np.cos(3 * x[:, 0]), 0 * x[:, 0], np.ones(len(x))]),
        ),
    }


def onto(surface, points):
    """Points moved onto a rigid surface."""
    for _ in range(60):
        p = surface.project(points)
        points = points - p.gap[:, None] * p.normal
    return points


@pytest.mark.parametrize("name", surfaces_3d())
def test_gap_derivatives_on_a_rigid_surface(name):
    """On the surface, where contactors are, normal and curvature are the first and second derivative of the gap."""
    surface = surfaces_3d()[name]
    points = onto(surface, np.random.default_rng(2).uniform(-1, 1, (20, 3)))
    p, h = surface.project(points), 1e-5
    assert np.abs(p.gap).max() < 1e-13
    H = p.hessians(np.arange(20))
    tangent = np.eye(3) - p.normal[:, :, None] * p.normal[:, None, :]
    for e in np.eye(3):
        step = np.einsum("nij,j->ni", tangent, e) * h
        ahead, behind = surface.project(points + step), surface.project(points - step)
        assert np.abs((ahead.gap - behind.gap) / (2 * h)).max() < 1e-9
        normal = (surface.project(points + h * e).gap - surface.project(points - h * e).gap) / (2 * h)
        assert np.abs(normal - p.normal @ e).max() < 1e-8
        # the tangential change of the unit normal
        assert np.abs((ahead.normal - behind.normal) / (2 * h) - np.einsum("nij,j->ni", H, e)).max() < 1e-7


def test_plane_strain_disc_is_a_sphere():
    """In 2D a sphere is a disc."""
    p = uem.RigidSphere((1.0, 0.0), 2.0).project(np.array([[4.0, 4.0]]))
    assert np.allclose(p.gap, 3.0) and np.allclose(p.hessians(np.array([0])), (np.eye(2) - np.outer([0.6, 0.8], [0.6, 0.8])) / 5)


# -- the united tangent ----------------------------------------------------------------------------------------------------


def arched(x):
    """Bend the top of the lower block into an arch."""
    y = x.copy()
    low = x[:, -1] <= 1e-12
    y[:, -1] -= 0.3 * low * (x[:, -1] + 1) * (x[:, 0] - 0.5) ** 2
    return y


def contact_scene(cell, target="mesh", **options):
    b = blocks(
        COMM,
        cell,
        6 if cell in ("triangle", "quadrilateral") else 3,
        5 if cell == "triangle" else 2,
        gap=0.1,
        overhang=0.5,
        pose=arched,
    )
    slide = [0.2, -0.25] if b.gdim == 2 else [0.2, 0.0, -0.25]
    bcs = [*clamp(b.V, b.bottom), *clamp(b.V, b.top, value=slide)]
    other = uem.RigidSphere([0.4] * (b.gdim - 1) + [-1.0], 1.05) if target == "rigid" else b.low
    contact = uem.Contact(b.high, other, max_penetration=1.0, normals="averaged" if target == "averaged" else "facet")
    problem = uem.UnitedProblem(
        st_venant(b.u, modulus(b.scene, 1.0, 2.0)), b.u, bcs=bcs, contacts=[contact], petsc_options_prefix="tangent_", **options
    )
    return b, contact, problem


@pytest.mark.parametrize(
    "cell,target",
    [
        ("triangle", "mesh"), ("quadrilateral", "rigid"), ("tetrahedron", "mesh"), ("hexahedron", "mesh"), ("triangle", "averaged"),
        ("tetrahedron", "averaged"), ("hexahedron", "averaged"),
    ],
)  # fmt: skip
def test_united_tangent_is_the_derivative_of_the_residual(cell, target):
    """``K - sum lambda grad^2 g`` against differences of ``F - sum lambda grad g`` with the contact forces lambda held."""
    _, contact, problem = contact_scene(cell, target)
    difference, full, plain = tangent_by_differences(problem, contact)
    scale = plain.norm()
    assert (difference - full).norm() < 1e-8 * scale
    # and the term matters
    assert (difference - plain).norm() > 1e-3 * scale


def orders(history):
    """Orders of convergence seen in all runs of three residuals with one and the same active set."""
    r = np.array([i.residual for i in history])
    steady = np.array([not i.changed for i in history])
    found = []
    for k in range(2, len(r)):
        if steady[k - 2 : k + 1].all() and 1e-14 < r[k] < r[k - 1] < r[k - 2] < 0.5:
            found.append(np.log(r[k] / r[k - 1]) / np.log(r[k - 1] / r[k - 2]))
    return found


@pytest.mark.parametrize(
    "cell, target", [("triangle", "mesh"), ("hexahedron", "mesh"), ("triangle", "averaged"), slow("hexahedron", "averaged")]
)
def test_order_of_convergence(cell, target):
    """Quadratic with the curvature of the contact, linear without, and the same answer."""
    results = {}
    for consistent in (True, False):
        b, contact, problem = contact_scene(cell, target, consistent_tangent=consistent, rtol=1e-11, max_iterations=80)
        history = [step.iterations for step in run(problem, 2)]
        results[consistent] = [orders(h) for h in history], sum(len(h) - 1 for h in history), contact.resultant().force
    assert max(max(o, default=0.0) for o in results[True][0]) >= 1.8
    assert results[False][0][-1][-1] < 1.2
    assert results[True][1] < 0.7 * results[False][1]
    assert np.allclose(results[True][2], results[False][2], rtol=1e-7)


def test_one_ufl_residual_for_any_number_of_loads():
    """A follower load in the user's residual enters K like everything else: Newton stays quadratic."""
    b = blocks(COMM, "quadrilateral", 2, 4, overhang=0.25)
    p = fem.Constant(b.scene.mesh, 0.05)
    v, n = ufl.TestFunction(b.V), ufl.FacetNormal(b.scene.mesh)
    F = ufl.Identity(2) + ufl.grad(b.u)
    pressure = p * ufl.inner(ufl.det(F) * ufl.inv(F).T * n, v) * forms.surface_measure(b.scene.mesh, b.top.entities)
    side = b.scene.tag("axis", 1, at(0, 0.0))
    problem = uem.UnitedProblem(
        st_venant(b.u, modulus(b.scene, 1.0, 1.0)) + pressure,
        b.u,
        bcs=[*clamp(b.V, b.bottom), *clamp(b.V, side, 0)],
        contacts=[contact := uem.Contact(b.high, b.low)],
        rtol=1e-11,
    )
    history = problem.solve()
    assert max(orders(history)) >= 1.8
    # K is not symmetric, which the direct solver sees, and no LDL' takes half of it
    K = gathered_matrix(problem.system.bodies.tangent.K)
    assert np.abs(K - K.T).max() > 1e-3 * np.abs(K).max() and problem.system.solver.pc.getType() == "lu"
    # global equilibrium: what the pressure pushes on the current top arrives at the contact
    J = ufl.det(F) * ufl.dot(ufl.inv(F).T * n, ufl.as_vector([0.0, 1.0]))
    pushed = forms.assemble_scalar(forms.form(p * J * forms.surface_measure(b.scene.mesh, b.top.entities)), COMM)
    assert contact.resultant().force[1] == pytest.approx(pushed, rel=1e-9)
