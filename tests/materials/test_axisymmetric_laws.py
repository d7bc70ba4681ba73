"""Axisymmetric laws against closed forms: cylinders and spheres under pressure, spinning and yielding, and their energies."""

from __future__ import annotations

import numpy as np
import pytest
import ufl
from dolfinx import fem
from helpers import box, factors, highest, refused, scene, slow
from revolved_scenes import COMM, Revolved, rectangle

import uem_dolfinx as uem

E, NU = 1000.0, 0.3
A, B = 1.0, 2.0


def tube(n, cell="quadrilateral", degree=1, height=0.25):
    """A thick-walled cylinder between two planes, across which it does not move."""
    s = Revolved(rectangle((A, 0), (B, height), (n, max(2, n // 4)), cell), cell=cell, degree=degree)
    s.hold(1, 0.0)
    s.hold(1, height)
    return s


def shell(n, degree=1):
    """Half of a thick-walled sphere above its equator."""
    b = rectangle((0, A), (np.pi / 2, B), (2 * n, n))

    def round_off(x):
        return np.stack([x[:, 1] * np.cos(x[:, 0]), x[:, 1] * np.sin(x[:, 0])], axis=1).clip(0.0)

    s = Revolved(b, degree=degree, pose=round_off)
    s.hold(0, np.pi / 2, component=0)
    s.hold(0, 0.0, component=1)
    return s


@pytest.mark.parametrize(("cell", "degree", "order", "bound"), [
    slow("triangle", 1, 1.5, 3e-3), ("quadrilateral", 1, 1.9, 1e-3), slow("triangle", 2, 2.7, 3e-5), ("quadrilateral", 2, 3.8, 5e-7),
])  # fmt: skip
def test_cylinder_under_pressure(cell, degree, order, bound):
    """Lame's solution; the axial force is 2 nu p a^2 / (b^2 - a^2) on the ring, and the stored energy the load's work."""
    p, errors = 10.0, []
    for n in (8, 16):
        s = tube(n, cell, degree)
        law, inner = uem.LinearElastic(E, NU, kind="axisymmetric"), uem.ds(s.side(0, A))
        problem = s.problem(law.residual(s.u, s.v) * ufl.dx - p * s.v[0] * inner)
        problem.solve()
        r, c = s.X[:, 0], p * A**2 / (B**2 - A**2)
        exact = (1 + NU) / E * c * ((1 - 2 * NU) * r + B**2 / r)
        errors.append(highest(COMM, np.abs(s.U[:, 0] - exact)) / highest(COMM, exact))
    assert errors[1] < bound and np.log2(errors[0] / errors[1]) > order
    axial = problem.reaction(s.side(1, 0.25))
    assert axial[0] == 0.0 and axial[1] == pytest.approx(2 * NU * c * np.pi * (B**2 - A**2), rel=0.03)
    stored = uem.integrate(law.energy(s.u) * ufl.dx)
    assert stored == pytest.approx(0.5 * uem.integrate(p * s.u[0] * inner), rel=1e-11)


def test_spinning_cylinder():
    """A solid cylinder between two planes that spins: u = c r ((3 - 2 nu) R^2 - r^2), also where the axis is left free."""
    rho_w2, R, height, found = 5.0, 1.0, 0.25, []
    for held in (True, False):
        s = Revolved(rectangle((0, 0), (R, height), (8, 2)), degree=2)
        s.hold(1, 0.0)
        s.hold(1, height)
        if held:
            s.hold_axis()
        r = ufl.SpatialCoordinate(s.mesh)[0]
        s.problem(
            uem.LinearElastic(E, NU, kind="axisymmetric").residual(s.u, s.v) * ufl.dx - rho_w2 * r * s.v[0] * ufl.dx
        ).solve()
        exact = rho_w2 * (1 + NU) * (1 - 2 * NU) / (8 * E * (1 - NU)) * s.X[:, 0] * ((3 - 2 * NU) * R**2 - s.X[:, 0] ** 2)
        found.append(highest(COMM, np.abs(s.U[:, 0] - exact)) / highest(COMM, exact))
        assert highest(COMM, np.abs(s.U[s.X[:, 0] < 1e-9, 0])) < 1e-3 * highest(COMM, exact)
    assert max(found) < 1e-4


def test_sphere_under_pressure():
    """Lame's solution of a thick-walled sphere, whose hoop stresses are the same in both directions."""
    p, errors = 10.0, []
    for n in (4, 8):
        s = shell(n)
        law = uem.LinearElastic(E, NU, kind="axisymmetric")
        n_out = -ufl.SpatialCoordinate(s.mesh) / A
        s.problem(law.residual(s.u, s.v) * ufl.dx + p * ufl.dot(n_out, s.v) * uem.ds(s.side(1, A))).solve()
        r = np.linalg.norm(s.X, axis=1)
        c = p * A**3 / (B**3 - A**3)
        exact = c / E * ((1 - 2 * NU) * r + (1 + NU) * B**3 / (2 * r**2))
        errors.append(highest(COMM, np.abs(np.linalg.norm(s.U, axis=1) - exact)) / highest(COMM, exact))
    assert errors[1] < 0.01 and errors[0] > 3.2 * errors[1]


@pytest.mark.parametrize("law", [uem.LinearElastic, slow(uem.StVenantKirchhoff), uem.NeoHooke])
def test_stress_is_the_derivative_of_energy(law):
    """Internal forces are those of the stored energy, Newton's method is quadratic, and stresses have all three normal components."""
    s = Revolved(rectangle((0, 0), (1, 1), (3, 3)))
    s.hold_axis()
    s.hold(1, 0.0)
    s.hold(1, 0.0, component=0)
    s.hold(1, 1.0, component=1, value=-0.25)
    law = law(E, NU, kind="axisymmetric")
    problem = s.problem(law.residual(s.u, s.v) * ufl.dx, rtol=1e-12)
    history = problem.solve()
    assert len(history) < 9 and max(factors(history), default=0.0) < 20.0
    assert law.stress(s.u).ufl_shape == (3, 3)
    way = fem.Function(s.V)
    way.x.array.reshape(-1, 2)[:] = np.stack([s.X[:, 0] * np.cos(s.X[:, 1]), np.sin(2 * s.X[:, 0])], axis=1)
    force = uem.integrate(ufl.replace(law.residual(s.u, s.v) * ufl.dx, {s.v: way}))
    kept, h, energies = s.u.x.array.copy(), 1e-5, []
    for side in (1, -1):
        s.u.x.array[:] = kept + side * h * way.x.array
        energies.append(uem.integrate(law.energy(s.u) * ufl.dx))
    assert (energies[0] - energies[1]) / (2 * h) == pytest.approx(force, rel=1e-6, abs=1e-6 * E)


def test_stresses_on_the_axis():
    """At nodes on the axis the hoop strain is that along the radius, its limit: stresses can be interpolated."""
    s = Revolved(rectangle((0, 0), (1, 1), (2, 2)), degree=2)
    s.u.x.array.reshape(-1, 2)[:] = np.stack([0.1 * s.X[:, 0] * (1 + s.X[:, 1]), 0 * s.X[:, 0]], axis=1)
    strain = fem.Function(uem.function_space(s.mesh, 2, (3, 3)))
    uem.interpolate(strain, uem.LinearElastic(E, NU, kind="axisymmetric").strain(s.u))
    values = strain.x.array.reshape(-1, 9)
    assert highest(COMM, np.abs(values[:, 8] - 0.1 * (1 + s.X[:, 1]))) < 1e-14
    assert highest(COMM, np.abs(values[:, 0] - values[:, 8])) < 1e-14


@pytest.mark.long
@pytest.mark.parametrize("law", [slow(uem.LinearElastic), slow(uem.StVenantKirchhoff), uem.NeoHooke])
def test_hoop_stretch(law):
    """A homogeneous stretch: stresses are those of the law in 3D, with F_33 = 1 + u_r / r."""
    s, stretch = Revolved(rectangle((0.5, 0), (1, 1), (1, 1))), np.array([0.2, -0.1, 0.2])
    s.u.x.array.reshape(-1, 2)[:] = s.X * stretch[:2]
    cube = scene(COMM, "hexahedron", [box("hexahedron", (0, 0, 0), (1, 1, 1), (1, 1, 1))])
    V = uem.function_space(cube.mesh, 1, (3,))
    u = fem.Function(V)
    u.x.array.reshape(-1, 3)[:] = V.tabulate_dof_coordinates() * stretch
    own, other = law(E, NU, kind="axisymmetric"), law(E, NU)
    volume = np.pi * (1 - 0.25)
    for i in range(3):
        wanted = uem.integrate(other.first_piola(u)[i, i] * ufl.dx)
        assert uem.integrate(own.first_piola(s.u)[i, i] * ufl.dx) == pytest.approx(wanted * volume, rel=1e-9)
    assert uem.integrate(own.energy(s.u) * ufl.dx) == pytest.approx(uem.integrate(other.energy(u) * ufl.dx) * volume, rel=1e-9)


@pytest.mark.long
def test_bodies_that_hardly_change_their_volume():
    """Selective reduced integration: the expansion of a nearly incompressible tube, of which linear cells leave a fraction."""
    p, nu, found = 10.0, 0.49999, []
    for form, degree in (("residual_form", 2), ("residual", 1)):
        s = tube(8, degree=degree)
        law = uem.LinearElastic(E, nu, kind="axisymmetric")
        inside = law.residual_form(s.u, s.v) if form == "residual_form" else law.residual(s.u, s.v) * ufl.dx
        s.problem(inside - p * s.v[0] * uem.ds(s.side(0, A))).solve()
        c = p * A**2 / (B**2 - A**2)
        exact = (1 + nu) / E * c * ((1 - 2 * nu) * A + B**2 / A)
        found.append(highest(COMM, s.U[:, 0]) / exact)
    assert found[0] == pytest.approx(1.0, abs=0.01)
    assert found[1] < 0.9
    refused(uem.InputError, ["degree 1", "degree 2"], lambda: law.residual_form(s.u, s.v))


@pytest.mark.long
@pytest.mark.parametrize(("cell", "degree", "bound"), [
    ("quadrilateral", 1, 2e-3), slow("quadrilateral", 2, 2e-5), slow("triangle", 2, 2e-5),
])  # fmt: skip
def test_collapse_of_a_tube(cell, degree, bound):
    """A perfectly plastic tube yields throughout at a pressure of 2/sqrt(3) Y ln(b/a); its energy balance closes with the steps."""
    strength, height = 1.0, 0.25
    s = tube(10, cell, degree, height)
    s.hold(0, A, value=0.02)
    law = uem.VonMises(s.u, E, NU, strength, kind="axisymmetric")
    problem = s.problem(law.residual(s.v), materials=[law])
    push = fem.Function(s.V)
    push.x.array.reshape(-1, 2)[np.abs(s.X[:, 0] - A) < 1e-9, 0] = 1.0
    force = ufl.replace(law.residual(s.v), {s.v: push})
    work = before = 0.0
    for step in (*range(1, 9), 20):
        problem.attempt(fraction=step / 20, start=np.zeros_like(s.u.x.array))
        problem.commit()
        now = uem.integrate(force)
        work, before = work + 0.5 * (before + now) * 0.001 * (12 if step == 20 else 1), now
    assert now / (2 * np.pi * A * height) == pytest.approx(2 / np.sqrt(3) * strength * np.log(B / A), rel=bound)
    assert law.energy() + law.dissipation() == pytest.approx(work, rel=0.01)
    means = law.cell_averages()
    assert highest(COMM, np.abs(means["von_mises"].x.array - strength)) < 1e-9
    stress = means["stress"].x.array.reshape(-1, 3, 3)
    # between hoop and radial stress the axial one, in planes of shear
    assert highest(COMM, np.abs(stress[:, 2, 2] - stress[:, 0, 0] - 2 / np.sqrt(3) * strength)) < 0.02
    assert highest(COMM, np.abs(stress[:, 1, 1] - stress[:, [0, 2], [0, 2]].mean(axis=1))) < 0.05


@pytest.mark.slow
def test_collapse_of_a_sphere():
    """A perfectly plastic sphere yields throughout at a pressure of 2 Y ln(b/a)."""
    s = shell(6, 2)
    law = uem.VonMises(s.u, E, NU, 1.0, kind="axisymmetric")
    spread = fem.Function(s.V)
    inner = np.abs(np.linalg.norm(s.X, axis=1) - A) < 0.02
    spread.x.array.reshape(-1, 2)[inner] = s.X[inner] / np.linalg.norm(s.X[inner], axis=1)[:, None]
    wall = fem.Function(s.V)
    wall.x.array[:] = 0.02 * spread.x.array
    s.bcs.insert(0, uem.dirichlet(s.V, s.side(1, A), value=wall))
    list(uem.load_steps(s.problem(law.residual(s.v), materials=[law]), 8))
    force = uem.integrate(ufl.replace(law.residual(s.v), {s.v: spread}))
    assert force / (2 * np.pi * A**2) == pytest.approx(2 * np.log(B / A), rel=0.01)


@pytest.mark.parametrize(("degree", "bound"), [(1, 1e-7), (2, 1e-12)])
def test_patch_of_plasticity(degree, bound):
    """A uniform stress in a cylinder from the axis on, with the pressure at points of its own."""
    s = Revolved(rectangle((0, 0), (1, 1), (4, 4)), degree=degree)
    s.hold_axis()
    s.hold(1, 0.0)
    law = uem.VonMises(s.u, E, NU, 100.0, kind="axisymmetric")
    s.problem(law.residual(s.v) + 3.0 * s.v[1] * uem.ds(s.side(1, 1.0)), materials=[law]).solve()
    stress = law.cell_averages()["stress"].x.array.reshape(-1, 3, 3)
    assert highest(COMM, np.abs(stress - np.diag([0.0, -3.0, 0.0]))) < 3.0 * bound


@pytest.mark.long
@pytest.mark.parametrize("strain", [slow("small"), "green_lagrange"])
def test_tangent_of_plasticity(strain):
    """Newton's method is quadratic while a cylinder is upset between rough plates."""
    s = Revolved(rectangle((0, 0), (1, 1), (4, 4)))
    s.hold_axis()
    s.hold(1, 0.0)
    s.hold(1, 0.0, component=0)
    s.hold(1, 1.0, component=0)
    s.hold(1, 1.0, value=-0.02)
    law = uem.VonMises(s.u, E, NU, 1.0, 50.0, kind="axisymmetric", strain=strain)
    problem = s.problem(law.residual(s.v), materials=[law], rtol=1e-11)
    histories = [step.iterations for step in uem.load_steps(problem, 4)]
    assert all(len(history) < 9 for history in histories)
    assert highest(COMM, law.peeq.x.array) > 0.01


@pytest.mark.long
def test_pressure_that_follows_the_surface():
    """On all of a cylinder it shrinks it alike in all directions, until its energy falls by as much as p does work on the volume."""
    s, law, p = Revolved(rectangle((0, 0), (1, 1), (2, 2))), uem.NeoHooke(1.0, 0.3, kind="axisymmetric"), 0.5
    s.hold_axis()
    s.hold(1, 0.0)
    n, gradient = ufl.FacetNormal(s.mesh), ufl.Identity(3) + uem.displacement_gradient(s.u)
    t = -p * ufl.det(gradient) * ufl.inv(gradient).T * ufl.as_vector([n[0], n[1], 0])
    work = sum((t[0] * s.v[0] + t[1] * s.v[1]) * uem.ds(side) for side in (s.side(0, 1.0), s.side(1, 1.0)))
    s.problem(law.residual(s.u, s.v) * ufl.dx - work, rtol=1e-12).solve()
    stretch, x = 1.0 - highest(COMM, -s.u.x.array), np.array(s.u.x.array).reshape(-1, 2)
    assert 0.7 < stretch < 0.9 and highest(COMM, np.abs(x - (stretch - 1.0) * s.X)) < 1e-10

    def energy(stretch):
        s.u.x.array[:] = (stretch - 1.0) * s.X.ravel()
        return uem.integrate(law.energy(s.u) * ufl.dx) + p * np.pi * stretch**3

    assert abs(energy(stretch + 1e-5) - energy(stretch - 1e-5)) / 2e-5 < 1e-7 * p
