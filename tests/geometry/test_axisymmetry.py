"""Axisymmetric meshes: what is refused, and integrals, areas, masses and resultants over whole circles."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import CELLS, box, highest, refused, scene, slow
from revolved_scenes import COMM, Revolved, rectangle

import uem_dolfinx as uem
from uem_dolfinx import compat
from uem_dolfinx.geometry.surfaces import Areas

PLANE = CELLS[:2]
R, H = 1.5, 0.8


def cylinder(cell="quadrilateral", degree=1, n=(4, 2)):
    return Revolved(rectangle((0, 0), (R, H), n, cell), cell=cell, degree=degree)


def plane_form(u):
    return uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(u, ufl.TestFunction(u.function_space)) * ufl.dx


class TestRefused:
    def test_nodes_beyond_the_axis(self):
        s = scene(COMM, "triangle", [box("triangle", (-0.1, 0), (1, 1), (2, 2))])
        refused(uem.MeshError, ["(-0.1, ", "beyond the axis", "x >= 0"], lambda: uem.axisymmetric(s.mesh))

    def test_other_than_plane_meshes(self):
        s = scene(COMM, "tetrahedron", [box("tetrahedron", (0, 0, 0), (1, 1, 1), (1, 1, 1))])
        refused(uem.MeshError, ["dimension 3", "plane"], lambda: uem.axisymmetric(s.mesh))
        refused(uem.InputTypeError, ["mesh", "read_gmsh"], lambda: uem.axisymmetric("mesh.msh"))

    def test_meshes_that_are_in_use(self):
        """A mass or a problem of a plane mesh would stay plane; declared twice is declared."""
        for use in (lambda u: uem.lumped_mass(u.function_space, 1.0), lambda u: uem.UnitedProblem(plane_form(u), u)):
            s = scene(COMM, "triangle", [box("triangle", (0, 0), (1, 1), (2, 2))])
            use(fem.Function(compat.function_space(s.mesh, 1, (2,))))
            refused(uem.MeshError, ["plane mass or problem", "right after"], lambda s=s: uem.axisymmetric(s.mesh))
        assert uem.axisymmetric(mesh := cylinder().mesh) is mesh

    def test_rounding_is_no_node_beyond_the_axis(self):
        b = rectangle((0, 0), (1, 1), (2, 2))
        Revolved(replace(b, x=b.x - [1e-16, 0.0]))

    def test_kinds_of_other_meshes(self):
        """The kind of a law and what has been said of the mesh must agree, whichever way round."""
        s, plane = cylinder(), scene(COMM, "triangle", [box("triangle", (0, 0), (1, 1), (2, 2))])
        u = fem.Function(uem.function_space(plane.mesh, 1, (2,)))
        for law in (uem.LinearElastic, uem.StVenantKirchhoff, uem.NeoHooke):
            refused(uem.InputError, "uem.axisymmetric(mesh)", lambda: law(1.0, 0.3, kind="axisymmetric").stress(u))  # noqa: B023
            refused(uem.InputError, "kind = 'axisymmetric'", lambda: law(1.0, 0.3, kind="plane_strain").energy(s.u))  # noqa: B023
        refused(uem.InputError, "uem.axisymmetric(mesh)", lambda: uem.VonMises(u, 1.0, 0.3, 1.0, kind="axisymmetric"))
        refused(uem.InputError, "kind = 'axisymmetric'", lambda: uem.VonMises(s.u, 1.0, 0.3, 1.0, kind="plane_stress"))
        refused(uem.InputError, "'axisymmetric'", lambda: uem.LinearElastic(1.0, 0.3).stress(s.u))

    def test_gravity_across_the_axis(self):
        s = cylinder()
        dynamics = uem.Dynamics(uem.consistent_mass(s.V, 1.0), gravity=(1.0, 0.0))
        F = uem.LinearElastic(1.0, 0.3, kind="axisymmetric").residual(s.u, s.v) * ufl.dx
        refused(uem.InputError, ["gravity", "radial"], lambda: s.problem(F, dynamics=dynamics))


@pytest.mark.parametrize(
    ("cell", "degree"), [("quadrilateral", 1), slow("quadrilateral", 2), slow("triangle", 1), ("triangle", 2)]
)
class TestWholeCircles:
    def test_integrals(self, cell, degree):
        """Volume, faces and mantle of a cylinder, and moments over them, in closed form."""
        s = cylinder(cell, degree)
        r, z = ufl.SpatialCoordinate(s.mesh)
        one = fem.Constant(s.mesh, 1.0)
        assert uem.integrate(one * ufl.dx) == pytest.approx(np.pi * R**2 * H, rel=1e-14)
        assert uem.integrate(r**2 * z * ufl.dx) == pytest.approx(np.pi * R**4 / 2 * H**2 / 2, rel=1e-14)
        assert uem.integrate(one * uem.ds(s.side(1, H))) == pytest.approx(np.pi * R**2, rel=1e-14)
        assert uem.integrate(r * uem.ds(s.side(0, R))) == pytest.approx(2 * np.pi * R**2 * H, rel=1e-14)

    def test_tributary_areas(self, cell, degree):
        """They add up to the circle, and are what is left of the disc around the axis there; in the current configuration they grow."""
        s = cylinder(cell, degree)
        problem = s.problem(uem.LinearElastic(1.0, 0.3, kind="axisymmetric").residual(s.u, s.v) * ufl.dx)
        areas, n = Areas(problem.config, s.side(1, H)), problem.config.n_owned
        h = R / 4
        at_axis = (np.abs(s.X[:n] - [0.0, H]) < 1e-9).all(axis=1)
        assert COMM.allreduce(areas.reference[:n].sum()) == pytest.approx(np.pi * R**2, rel=1e-14)
        # of degree 2, the shape function of a vertex has no integral over the disc
        wanted = np.pi * h**2 / 3 if degree == 1 else 0.0
        assert highest(COMM, np.abs(areas.reference[:n][at_axis] - wanted)) < 1e-15
        s.u.x.array.reshape(-1, 2)[:] = np.stack([0.1 * s.X[:, 0], 0.2 * s.X[:, 0]], axis=1)
        assert COMM.allreduce(areas.current[:n].sum()) == pytest.approx(np.pi * (1.1 * R) * R * np.hypot(1.1, 0.2), rel=1e-12)

    def test_masses(self, cell, degree):
        for make in (uem.consistent_mass, uem.lumped_mass):
            mass = make(cylinder(cell, degree).V, 2.0)
            assert mass.total == pytest.approx(2.0 * np.pi * R**2 * H, rel=1e-13)
            # Hinton's lumping of quadratic triangles uses the reference cell, where all radii are alike
            if make is uem.consistent_mass or degree == 1:
                assert mass.centre == pytest.approx([0.0, H / 2], abs=1e-13)


@pytest.mark.long
def test_a_form_of_ones_own():
    """UFL without a law of the package is integrated over circles as well: the same residual, and the same answer."""
    answers = []
    for own in (False, True):
        s = cylinder("triangle", 2)
        s.hold_axis()
        s.hold(1, 0.0)
        law = uem.NeoHooke(3.0, 0.3, kind="axisymmetric")
        inside = law.residual(s.u, s.v) * ufl.dx
        if own:
            C = ufl.variable(ufl.Identity(3) + uem.displacement_gradient(s.u))
            JJ, mu, lam = ufl.det(C) ** 2, 3.0 / 2.6, 0.9 / (1.3 * 0.4)
            W = mu / 2 * (ufl.inner(C, C) - 3 - ufl.ln(JJ)) + lam / 4 * (JJ - 1 - ufl.ln(JJ))
            inside = ufl.inner(ufl.diff(W, C), uem.displacement_gradient(s.v)) * ufl.dx
        s.problem(inside - 0.3 * s.v[1] * uem.ds(s.side(1, H)), rtol=1e-12).solve()
        answers.append(s.U.copy())
    assert highest(COMM, np.abs(answers[0])) > 0.05
    # by other rules of quadrature
    assert highest(COMM, np.abs(answers[1] - answers[0])) < 1e-6


def test_hoop_strains_get_a_sensible_rule():
    """Quotients by the radius ask for no more points than what is no polynomial, on triangles as on quadrilaterals."""
    from uem_dolfinx import forms

    for cell in PLANE:
        s = cylinder(cell)
        F = uem.NeoHooke(1.0, 0.3, kind="axisymmetric").residual(s.u, s.v) * ufl.dx
        for integral in forms._of_sensible_degree(F).integrals():
            assert integral.metadata()["quadrature_degree"] == 4


@pytest.mark.long
def test_the_shape_of_bodies_of_revolution():
    """The derivative of the volume by the places of nodes is that of circles; by a pressure, of a body with its own residual."""
    s = cylinder("triangle")
    s.hold_axis()
    s.hold(1, 0.0)
    p = fem.Constant(s.mesh, 0.2)
    law = uem.NeoHooke(1.0, 0.3, kind="axisymmetric")

    def solved():
        problem = s.problem(law.residual(s.u, s.v) * ufl.dx + p * s.v[1] * uem.ds(s.side(1, H)), rtol=1e-12)
        problem.solve()
        return problem

    problem = solved()
    x = ufl.SpatialCoordinate(s.mesh)
    J = (s.u[1] ** 2 + x[0]) * ufl.dx
    by_p, by_shape = uem.gradient(problem, J, [p, x])
    start, nodes = p.value.copy(), s.mesh.geometry.x.copy()
    way = np.stack([0.3 * nodes[:, 0] * (1 + nodes[:, 1]), 0.2 * nodes[:, 0] * nodes[:, 1], 0 * nodes[:, 0]], axis=1)

    def value(h, shape):
        p.value = start if shape else start + h
        s.mesh.geometry.x[:] = nodes + h * way * shape
        solved()
        return uem.integrate(J)

    h = 1e-4
    assert (value(h, False) - value(-h, False)) / (2 * h) == pytest.approx(float(by_p), rel=1e-6)
    X, n = s.V.tabulate_dof_coordinates(), problem.config.n_owned
    s.mesh.geometry.x[:] = nodes
    own = np.stack([0.3 * X[:, 0] * (1 + X[:, 1]), 0.2 * X[:, 0] * X[:, 1]], axis=1)[:n].ravel()
    reported = COMM.allreduce(float(by_shape.x.array[: 2 * n] @ own))
    assert (value(h, True) - value(-h, True)) / (2 * h) == pytest.approx(reported, rel=1e-5)
    s.mesh.geometry.x[:] = nodes


def test_the_axis_is_no_surface():
    """A general contact leaves out the facets on it."""
    s = Revolved(rectangle((0, -1), (1, 0), (3, 3)), rectangle((0, 0), (1, 1), (2, 2)))
    s.hold_axis(2)
    s.hold(1, -1.0)
    F = uem.LinearElastic(1.0, 0.3, kind="axisymmetric").residual(s.u, s.v) * ufl.dx
    contact = uem.GeneralContact(order=[s.side(1, 0.0, 1)])
    s.problem(F + 0.01 * s.v[1] * uem.ds(s.side(1, 1.0, 1)), [contact]).solve()
    facets = sum(COMM.allgather(len(contact._skin.keys)))
    assert facets == 3 * 3 + 3 * 2
    touch = contact.between("body 2")
    assert touch.force == pytest.approx([0.0, 0.01 * np.pi], rel=1e-9)
    assert compat.geometry_dofs(s.mesh).shape[1] == 4
