"""Estimates of the error by the mesh: against exact solutions, in patches, for every law, and what has none.

Read first: ``test_effectivity``.
"""

from __future__ import annotations

from mpi4py import MPI

import numpy as np
import pytest
import ufl
from benchmarks.scenes import clamp
from benchmarks.signorini import signorini
from dolfinx import fem
from helpers import blocks, highest, modulus, refused, slow, st_venant

import uem_dolfinx as uem
from uem_dolfinx import compat, forms
from uem_dolfinx.accuracy.adapt import carry_over

COMM = MPI.COMM_WORLD


def westergaard(n, degree, coupling, finer):
    """Estimate and true error, both over the displacement, of two half-planes that touch up to a point."""
    s = signorini(n, degree=degree, finer=finer)
    tags = s.contact()
    contact = uem.Contact(tags.contactor, tags.target, coupling=coupling, sliding="fixed", name="interface")
    problem = uem.UnitedProblem(s.F, s.u, bcs=s.bcs, contacts=[contact])
    steps = list(uem.load_steps(problem, 1))
    return uem.error_estimate(problem), s.errors(problem, contact, steps)["error_energy"]


@pytest.mark.long
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("degree, finer", [(1, 1.0), (2, 2.0), slow(1, 2.0), slow(2, 1.0)])
def test_effectivity(degree, finer, coupling):
    """The estimate is 0.8 to 0.9 of the error on all meshes, matching or not, at order 1 and 3/2."""
    found = [westergaard(n, degree, coupling, finer) for n in (4, 8, 16)]
    ratios = [estimate.relative / error for estimate, error in found]
    assert min(ratios) > 0.75 and max(ratios) < 0.95
    assert max(ratios) < 1.05 * min(ratios)
    order = np.log2(found[1][0].total / found[2][0].total)
    assert abs(order - (1.0, 1.5)[degree - 1]) < 0.05


@pytest.mark.slow
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
@pytest.mark.parametrize("degree, finer", [(1, 1.0), (1, 2.0), (2, 1.0), (2, 2.0)])
def test_five_meshes(degree, finer, coupling):
    """The ratio of the estimate to the error varies by less than 10 % while the error falls by a factor of 16 or 60."""
    ratios = [
        estimate.relative / error for estimate, error in (westergaard(n, degree, coupling, finer) for n in (2, 4, 8, 16, 32))
    ]
    assert min(ratios) > 0.75 and max(ratios) < 1.1 * min(ratios) < 1.0


@pytest.mark.long
@pytest.mark.parametrize("led", ["displacement", "force", "both"])
def test_norm(led):
    """The norm of the displacement is the root of its work, ``u' K u``, however the body is loaded."""
    mesh, tags = uem.read_gmsh(uem.example_mesh("adapt_punch"), COMM, gdim=2, parameters={"h": 0.5})
    V = uem.function_space(mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    work = uem.LinearElastic(1.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["bottom"], 1, 0.0 if led == "force" else 0.01)]
    F = work - (0.02 * v[1] * ufl.dx if led != "displacement" else 0)
    problem = uem.UnitedProblem(
        F, u, bcs=bcs, contacts=[uem.Contact(tags["under_punch"], uem.RigidPlane((0.0, 0.0), (0.0, -1.0)))]
    )
    problem.solve()
    stored = COMM.allreduce(fem.assemble_scalar(forms.form(ufl.replace(work, {v: u}))))
    assert np.isclose(uem.error_estimate(problem).norm, np.sqrt(stored), rtol=1e-10) and stored > 0


def hertz(n, coupling, friction, degree=2):
    """A disc pressed on a block, three times as stiff, with n cells along a unit of length at the contact."""
    mesh, tags = uem.read_gmsh(
        uem.example_mesh("hertz_cylinder"), COMM, gdim=2, parameters={"h": 1 / n, "ratio": 1.4, "order": degree, "zone": 0.3}
    )
    V = uem.function_space(mesh, degree, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(modulus_of(mesh, tags), 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["symmetry"], 0), uem.dirichlet(V, tags["disc_top"], 1, -0.05)]
    bcs += [uem.dirichlet(V, tags["block_bottom"]) if friction else uem.dirichlet(V, tags["block_bottom"], 1)]
    contact = uem.Contact(tags["disc_arc"], tags["block_top"], coupling=coupling, friction=friction)
    problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact])
    list(uem.load_steps(problem, 2))
    return problem


def modulus_of(mesh, tags):
    E = fem.Function(compat.function_space(mesh, ("DG", 0)))
    E.x.array[:] = 1.0
    E.x.array[tags["disc"].entities] = 3.0
    return E


@pytest.mark.slow
@pytest.mark.parametrize("friction", [0.0, 0.3])
@pytest.mark.parametrize("coupling", ["node_to_surface", "mortar"])
def test_five_meshes_of_a_disc(coupling, friction):
    """The same for Hertz with quadratic curved cells, against a mesh of twice as many, from one cell at the contact on."""
    fine = hertz(96, coupling, friction)
    F, V, exact = fine.bodies.F, fine.u.function_space, fine.u.x.array.copy()
    for n in (3, 6, 12, 24, 48):
        problem = hertz(n, coupling, friction)
        carry_over(problem, fine)
        away = fem.Function(V)
        away.x.array[:] = exact - fine.u.x.array
        fine.u.x.array[:] = exact
        work = ufl.replace(ufl.derivative(F, fine.u, away), {F.arguments()[0]: away})
        error = np.sqrt(COMM.allreduce(fem.assemble_scalar(forms.form(work))))
        assert 0.7 < uem.error_estimate(problem).total / error < 1.3


@pytest.mark.parametrize("degree", [1, 2])
def test_coarser_contactors(degree):
    """Where a fine target enters between contactors, a third to a half of the error is not seen."""
    ratios = [estimate.relative / error for estimate, error in (westergaard(n, degree, "node_to_surface", 0.5) for n in (4, 8))]
    assert min(ratios) > 0.4 and max(ratios) < 0.75


def press(parameters, degree=1, coupling="mortar", scale=1.0, force=1.0, law=uem.LinearElastic):
    """Two guided blocks pressed together, in any units."""
    mesh, tags = uem.read_gmsh(uem.example_mesh("two_blocks"), COMM, gdim=2, parameters=parameters)
    mesh.geometry.x[:] *= scale
    V = uem.function_space(mesh, degree, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = law(100.0 * force, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    bcs = [uem.dirichlet(V, tags["sides"], 0), uem.dirichlet(V, tags["lower_bottom"], 1)]
    bcs += [uem.dirichlet(V, tags["upper_top"], 1, -0.05 * scale)]
    return uem.UnitedProblem(F, u, bcs=bcs, contacts=[uem.Contact(tags["upper_bottom"], tags["lower_top"], coupling=coupling)])


@pytest.mark.long
@pytest.mark.parametrize("degree", [1, 2])
def test_patches_have_no_error(degree):
    """A constant stress passes a contact of meshes that do not match: contact tractions are estimated exactly on both sides."""
    problem = press({"n_lower": 3, "n_upper": 4}, degree)
    problem.solve()
    assert uem.error_estimate(problem).relative < 1e-9


def bent(cell="triangle", degree=1, n=3, what="node_to_surface", law=st_venant, E=(1.0, 2.0)):
    """A block on another one under a load of its top and a shear that friction holds."""
    b = blocks(COMM, cell, n, n + 1, degree=degree)
    top, v = forms.surface_measure(b.scene.mesh, b.top.entities), ufl.TestFunction(b.V)
    F = law(b.u, modulus(b.scene, *E)) + 0.02 * v[b.gdim - 1] * top
    contact = uem.Contact(b.high, b.low, friction=0.3, coupling=what) if what != "general" else uem.GeneralContact(friction=0.3)
    return uem.UnitedProblem(F, b.u, bcs=clamp(b.V, b.bottom), contacts=[contact])


@pytest.mark.long
@pytest.mark.parametrize("what", ["node_to_surface", "mortar", "general"])
@pytest.mark.parametrize("cell, degree", [("triangle", 1), ("quadrilateral", 2), slow("tetrahedron", 1), slow("hexahedron", 1)])
def test_all_kinds(cell, degree, what):
    """Finer meshes have smaller estimates, by declared or general contact; the sum over bodies and cells is the whole."""
    totals = []
    for n in (2, 4):
        problem = bent(cell, degree, n, what)
        list(uem.load_steps(problem, 2))
        estimate = uem.error_estimate(problem)
        assert np.isclose(np.linalg.norm(estimate.of_bodies), estimate.total, rtol=1e-12)
        assert np.isclose(COMM.allreduce(estimate.shares.sum()), estimate.total**2, rtol=1e-12)
        totals.append(estimate.relative)
    assert 0.01 < totals[1] < 0.75 * totals[0] < 0.4
    assert len(estimate.of_bodies) == 2 and estimate.of_bodies[0] != estimate.of_bodies[1]


@pytest.mark.long
@pytest.mark.parametrize("scale, force", [(1e-9, 1.0), (1e3, 1e9)])
def test_units(scale, force):
    """The relative estimate does not depend on units."""
    bumpy = {"n_lower": 2, "n_upper": 3}
    found = []
    for own in ((1.0, 1.0), (scale, force)):
        problem = press(bumpy, 1, "node_to_surface", *own)
        problem.solve()
        found.append(uem.error_estimate(problem).relative)
    assert found[0] > 1e-3 and np.isclose(found[0], found[1], rtol=1e-6)


def test_partitions_of_a_coupling():
    """The estimate does not depend on which ranks own the nodes of a rigid coupling."""
    found = []
    for comm in (MPI.COMM_SELF, COMM):
        mesh, tags = uem.read_gmsh(uem.example_mesh("two_blocks"), comm, gdim=2, parameters={"n_lower": 4, "n_upper": 7})
        V = uem.function_space(mesh, 1, (2,))
        u, v = fem.Function(V), ufl.TestFunction(V)
        F = uem.LinearElastic(100.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
        plate = uem.RigidCoupling(tags["upper_top"], (0.4, 2.0), motion=(0.0, -0.05, 0.01))
        contact = uem.Contact(tags["upper_bottom"], tags["lower_top"])
        problem = uem.UnitedProblem(F, u, bcs=[uem.dirichlet(V, tags["lower_bottom"])], contacts=[contact], couplings=[plate])
        list(uem.load_steps(problem, 2))
        found.append(uem.error_estimate(problem).relative)
    assert found[0] > 0.01 and np.isclose(found[0], found[1], rtol=1e-6)


def test_steps_do_not_depend_on_estimates():
    """Steps after an estimate are the same."""
    ends = []
    for estimates in (False, True):
        problem = bent(n=2)
        for _ in uem.load_steps(problem, 3):
            if estimates:
                uem.error_estimate(problem)
        ends.append(problem.u.x.array.copy())
    assert np.allclose(ends[0], ends[1], rtol=0, atol=1e-15)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["VonMises", "NeoHooke"])
def test_other_laws(kind):
    """Bodies that yield and bodies of large strain: the estimate falls with the size of cells on a punch without a sharp corner."""
    found = []
    for n in (4, 8):
        mesh, tags = uem.read_gmsh(uem.example_mesh("two_blocks"), COMM, gdim=2, parameters={"n_lower": n, "n_upper": n})
        V = uem.function_space(mesh, 1, (2,))
        u, v = fem.Function(V), ufl.TestFunction(V)
        flows, elastic = uem.VonMises(u, 100.0, 0.3, 4.0, 20.0, kind="plane_strain"), uem.NeoHooke(60.0, 0.3, kind="plane_strain")
        F = flows.residual(v) if kind == "VonMises" else elastic.residual(u, v) * ufl.dx
        x = ufl.SpatialCoordinate(mesh)
        F += 12.0 * ufl.sin(ufl.pi * x[0]) ** 2 * v[1] * uem.ds(tags["upper_top"])
        bcs = [uem.dirichlet(V, tags["sides"], 0), uem.dirichlet(V, tags["lower_bottom"], 1)]
        contact = uem.Contact(tags["upper_bottom"], tags["lower_top"])
        materials = [flows] if kind == "VonMises" else []
        problem = uem.UnitedProblem(F, u, bcs=bcs, contacts=[contact], materials=materials)
        list(uem.load_steps(problem, 4))
        assert kind != "VonMises" or highest(COMM, flows.peeq.x.array) > 0.01
        found.append(uem.error_estimate(problem).relative)
    assert 0.4 < found[1] / found[0] < 0.65


def test_what_has_no_estimate():
    """Refused by name, before any work."""
    problem = press({"n_lower": 2, "n_upper": 3})
    refused(uem.InputError, ["no step", "solution"], lambda: uem.error_estimate(problem))
    refused(uem.InputTypeError, "UnitedProblem", lambda: uem.error_estimate(problem.u))
    mesh, tags = uem.read_gmsh(uem.example_mesh("two_blocks"), COMM, gdim=2)
    V = uem.function_space(mesh, 1, (2,))
    u, v = fem.Function(V), ufl.TestFunction(V)
    F = uem.LinearElastic(100.0, 0.3, kind="plane_strain").residual(u, v) * ufl.dx
    clamped = [uem.dirichlet(V, tags[name]) for name in ("lower_bottom", "upper_top")]
    moving = uem.UnitedProblem(F, u, bcs=clamped, dynamics=uem.Dynamics(uem.lumped_mass(V, 1.0)))
    refused(uem.InputError, "inertia", lambda: uem.error_estimate(moving))
