"""Forms that users hand over: residuals from energies are taken, those of other spaces, meshes and laws refused.

The test to read first is ``test_residual_from_an_energy``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from bar_scenes import Bar
from dolfinx import fem
from helpers import blocks, highest, linear, modulus, refused, run, st_venant

import uem_dolfinx as uem
from uem_dolfinx import forms
from uem_dolfinx.solve.checks import check_residual

COMM = MPI.COMM_WORLD
LAWS = [uem.LinearElastic, uem.StVenantKirchhoff, uem.NeoHooke]


# -- energies ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize(
    "cell, degree, kind",
    [
        ("triangle", 2, "plane_strain"), ("quadrilateral", 1, "plane_stress"), ("tetrahedron", 1, "3d"),
        pytest.param("hexahedron", 1, "3d", marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_residual_from_an_energy(law, cell, degree, kind):
    """The derivative of the stored energy is what the law calls its residual, however it is written."""
    b = blocks(COMM, cell, 2, 2, degree=degree)
    b.u.interpolate(lambda x: 0.03 * np.stack([np.sin(1 + i + x[0] + 2 * x[1] - x[2]) for i in range(b.gdim)]))
    v, law = ufl.TestFunction(b.V), law(modulus(b.scene, 1.0, 3.0), 0.3, kind)
    quadrature = ufl.dx(degree=4)
    wanted = law.residual(b.u, v) * quadrature
    check_residual(ufl.derivative(law.energy(b.u) * quadrature, b.u, v), b.u)
    pairs = [(wanted, ufl.derivative(law.energy(b.u) * quadrature, b.u))]
    if (degree, cell) != (1, "tetrahedron"):
        pairs.append((law.residual_form(b.u, v), ufl.derivative(law.energy_form(b.u), b.u, v)))
    for ours, theirs in pairs:
        check_residual(theirs, b.u)
        r, s = (forms.assemble_array(b.V, forms.form(F)) for F in (ours, theirs))
        assert highest(COMM, np.abs(r - s)) <= 1e-13 * highest(COMM, np.abs(r))


@pytest.mark.parametrize("law", LAWS)
def test_contact_from_an_energy(law):
    """A whole potential, that of the load among it, leads to the same contact as the residual."""
    forces = []
    for potential in (True, False):
        b = blocks(COMM, "triangle", 2, 4, overhang=0.25)
        v, body, down = ufl.TestFunction(b.V), law(modulus(b.scene, 1.0, 3.0), 0.3, "plane_strain"), ufl.as_vector((0.0, -0.01))
        top = uem.ds(b.top)
        F = ufl.derivative(body.energy(b.u) * ufl.dx - ufl.inner(down, b.u) * top, b.u, v)
        F = F if potential else body.residual(b.u, v) * ufl.dx - ufl.inner(down, v) * top
        contact = uem.Contact(b.high, b.low)
        bcs = [uem.dirichlet(b.V, b.bottom), uem.dirichlet(b.V, b.top, 0)]
        problem = uem.UnitedProblem(F, b.u, bcs=bcs, contacts=[contact], rtol=1e-11)
        assert run(problem)[-1].newton_iterations < 10
        forces.append((contact.resultant().force[1], contact.max_pressure()))
    assert forces[0] == pytest.approx(forces[1], rel=1e-9) and forces[0][0] > 0


@pytest.mark.parametrize(
    "wrong",
    [
        lambda u, v: ufl.inner(v, v),
        lambda u, v: ufl.inner(u, v) * v[0],
        lambda u, v: ufl.inner(u, v) + ufl.inner(u, u),
        lambda u, v: ufl.inner(u, v) / (1 + v[0]),
        lambda u, v: ufl.imag(v[0]),
    ],
)
def test_what_is_still_not_linear(wrong):
    b = blocks(COMM, "triangle", 2, 2)
    F = linear(b.u, 1.0) + wrong(b.u, ufl.TestFunction(b.V)) * ufl.dx
    refused(uem.InputError, ("F is not linear", "every term"), lambda: uem.UnitedProblem(F, b.u))


# -- other spaces and meshes -------------------------------------------------------------------------------------------


def other(b, degree=1, mesh=None):
    """A displacement that is not the problem's."""
    return fem.Function(uem.function_space(mesh or b.problem.config.mesh, degree, (2,)), name="other")


def elsewhere():
    """A displacement of another mesh."""
    return blocks(COMM, "triangle", 2, 3).u


def push(u, by=1, mesh=None):
    return by * ufl.TestFunction(u.function_space)[0] * ufl.dx(domain=mesh)


def stored(u):
    return ufl.inner(ufl.grad(u), ufl.grad(u)) * ufl.dx


@pytest.mark.parametrize(
    "how, words",
    [
        (lambda b: {"external": push(other(b, 2))}, ("test function of external", "another space")),
        (lambda b: {"external": push(elsewhere())}, ("external is integrated over another mesh",)),
        (lambda b: {"external": push(b.problem.u, elsewhere()[0], b.problem.config.mesh)}, ("external holds", "another mesh")),
        (lambda b: {"stored": stored(other(b))}, ("stored does not depend on the problem's displacement",)),
        (lambda b: {"stored": stored(elsewhere())}, ("stored is integrated over another mesh",)),
        (
            lambda b: {"stored": (b.problem.u[0] * elsewhere()[0]) * ufl.dx(domain=b.problem.config.mesh)},
            ("stored holds", "mesh"),
        ),
    ],
)
def test_energy_book_of_other_forms(how, words):
    bar = Bar(4)

    def made():
        options = how(bar)
        return uem.EnergyBook(bar.problem, options.get("stored"), external=options.get("external"))

    refused(uem.SpaceError, words, made)


@pytest.mark.parametrize("degree", [1, 2])
@pytest.mark.parametrize("cell", ["triangle", "hexahedron"])
def test_residuals_of_other_meshes(cell, degree):
    b, c = (blocks(COMM, cell, 2, n, degree=degree) for n in (2, 3))
    F, v, x = linear(b.u, 1.0), ufl.TestFunction(b.V), ufl.SpatialCoordinate(c.scene.mesh)
    for wrong, words in (
        (linear(c.u, 1.0), ("F is integrated over another mesh",)),
        (F + c.u[0] * v[0] * ufl.dx(domain=b.scene.mesh), ("F holds", "another mesh")),
        (F + x[0] * v[0] * ufl.dx(domain=b.scene.mesh), ("F holds a SpatialCoordinate", "another mesh")),
        (F + v[0] * uem.ds(c.top), ("F is integrated over another mesh",)),
        (
            F + v[0] * ufl.Measure("dx", b.scene.mesh, subdomain_data=forms.mesh_tags(c.scene.mesh, b.gdim, [0], 1))(1),
            ("MeshTags",),
        ),
    ):
        refused(uem.SpaceError, words, lambda wrong=wrong: uem.UnitedProblem(wrong, b.u))
    dynamics = uem.Dynamics(
        uem.lumped_mass(b.V, 1.0), damping=lambda rate: ufl.inner(rate, v) * c.u[0] * ufl.dx(domain=b.scene.mesh)
    )
    refused(uem.SpaceError, ("damping form", "another mesh"), lambda: uem.UnitedProblem(F, b.u, dynamics=dynamics))
    refused(uem.SpaceError, ("the integral", "another mesh"), lambda: uem.integrate(b.u[0] * ufl.dx + c.u[0] * ufl.dx))
    refused(
        uem.SpaceError,
        ("the integral holds", "another mesh"),
        lambda: uem.integrate(b.u[0] * c.u[0] * ufl.dx(domain=b.scene.mesh)),
    )
    refused(uem.SpaceError, ("another mesh",), lambda: uem.lumped_mass(b.V, modulus(c.scene, 1.0, 1.0)))


def test_mass_of_an_equal_mesh():
    """As large, and of another mesh all the same."""
    b, c = (blocks(COMM, "triangle", 2, 2) for _ in range(2))
    dynamics = uem.Dynamics(uem.lumped_mass(c.V, 1.0))
    refused(uem.SpaceError, ("the mass", "another mesh"), lambda: uem.UnitedProblem(linear(b.u, 1.0), b.u, dynamics=dynamics))
    moving = uem.Dynamics(uem.lumped_mass(b.V, 1.0), velocity=c.u)
    refused(uem.SpaceError, ("the velocity", "another"), lambda: uem.UnitedProblem(linear(b.u, 1.0), b.u, dynamics=moving))


def test_fields_of_other_meshes(folder):
    b, c = Bar(4), blocks(COMM, "triangle", 2, 3)
    refused(
        uem.SpaceError, ("fields['a']", "another mesh"), lambda: uem.ResultsWriter(folder / "a", b.problem, fields={"a": c.u[0]})
    )
    f = fem.Function(uem.function_space(c.scene.mesh, 1))
    refused(uem.SpaceError, ("expression holds", "another mesh"), lambda: uem.interpolate(f, b.problem.u[0]))


# -- laws with history -------------------------------------------------------------------------------------------------


def steel(u, **how):
    return uem.VonMises(u, 1.0, 0.3, 0.01, 0.1, kind="plane_strain", **how)


def test_laws_with_history_that_are_not_given():
    b = blocks(COMM, "triangle", 2, 2)
    v, law, twin = ufl.TestFunction(b.V), steel(b.u), steel(fem.Function(b.V))
    for F, materials, error, words in (
        (law.residual(v), [], uem.InputError, ("of a law with history", "materials=[material]")),
        (linear(b.u, 1.0) + law.peeq * v[0] * ufl.dx(degree=2), [], uem.InputError, ("F holds 'peeq'", "materials=[material]")),
        (law.residual(v) + steel(b.u).residual(v), [law], uem.InputError, ("of a law with history",)),
        (law.residual(v), [law, law], uem.InputError, ("materials[1], a VonMises", "earlier in the list")),
        (linear(b.u, 1.0), [law], uem.InputError, ("F is not made of materials[0]", "material.residual(v)")),
        (twin.residual(v), [twin], uem.SpaceError, ("materials[0], a VonMises", "another displacement")),
        (law.residual(v) + twin.residual(v), [law, twin], uem.SpaceError, ("materials[1]", "another displacement")),
    ):
        refused(error, words, lambda F=F, materials=materials: uem.UnitedProblem(F, b.u, materials=materials))


def test_two_laws_and_a_field_that_stays():
    """Two laws in parallel, and the copy of a field as a stress that was there before."""
    b = blocks(COMM, "triangle", 2, 2)
    v, laws = ufl.TestFunction(b.V), [steel(b.u), steel(b.u)]
    kept = fem.Function(laws[0].peeq.function_space)
    F = laws[0].residual(v) + laws[1].residual(v) + st_venant(b.u, 1.0) + kept * v[0] * ufl.dx(degree=1)
    problem = uem.UnitedProblem(F, b.u, bcs=b.oedometer(0.001), contacts=[uem.Contact(b.high, b.low)], materials=laws)
    assert len(run(problem)) == 1
